"""``dahl-ident datasets``: lists the shipped data sets, or copies one."""

from __future__ import annotations

from typing import Annotated

import typer

from dahl_ident.cli import console
from dahl_ident.cli.files import write_data
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import General, Writing, starting
from dahl_ident.errors import ValidationError


def _names(incomplete: str) -> list[str]:
    from dahl_ident.synthetic.shipped import data_sets

    return starting(data_sets())(incomplete)


@with_option_groups
def datasets(
    general: General,
    writing: Writing,
    name: Annotated[
        str | None,
        typer.Argument(
            help="Data set to describe or copy; lists all if left out.", autocompletion=_names
        ),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option("--output", "-o", help="File to copy it to; - is standard output, as CSV."),
    ] = None,
) -> None:
    """List the shipped synthetic data sets, or copy one to a file.

    Example: dahl-ident datasets noisy -o noisy.csv
    """
    from dahl_ident.synthetic import load_dataset
    from dahl_ident.synthetic.shipped import data_sets

    if output is not None and name is None:
        raise ValidationError("--output needs the name of a data set; leave it out to list them")
    writing.check([output], json=general.json)
    if name is not None:
        data = load_dataset(name)
        if output is not None:
            write_data(data, output, overwrite=writing.overwrite)
        elif general.json:
            console.write_json(data.provenance)
        else:
            console.write(repr(data))
        return
    if general.json:
        console.write_json([_facts(one.name) for one in data_sets().values()])
        return
    for one in data_sets().values():
        kind = one.kind.replace("_", " ")
        console.write_wrapped(
            f"{one.name} ({kind}): {one.teaches}. Determines {', '.join(one.identifiable)}."
        )


def _facts(name: str) -> dict[str, object]:
    from dahl_ident.synthetic.shipped import data_sets

    one = data_sets()[name]
    return {k: v for k, v in vars(one).items() if k != "experiment"} | {"kind": one.kind}

"""Commands of one step: inspect, export, datasets, template and app."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, write_data, written
from dahl_ident.cli.estimate import finish, saved_fit
from dahl_ident.cli.options import (
    General,
    Laws,
    OutputFile,
    Seed,
    Writing,
    option,
    starting,
    with_option_groups,
)
from dahl_ident.cli.reading import Files
from dahl_ident.errors import ValidationError, choices

_TEMPLATES = ("report", "options", "columns", "campaign")


@with_option_groups
def inspect(
    files: Files,
    general: General,
    writing: Writing,
    sheet: Annotated[str | None, option("Sheet of an Excel workbook.")] = None,
    output: Annotated[
        Path | None,
        option("Column map to write, .toml, for --columns.", "--output", "-o"),
    ] = None,
) -> None:
    """List channels, units, ranges, sampling and gaps, and propose a column map.

    Example: dahl-ident datasets plant_recording -o - | dahl-ident inspect -
    """
    from dahl_ident.data import inspect as contents_of
    from dahl_ident.data.storage import write_whole

    writing.check([output])
    read_files = [contents_of(file, sheet=sheet) for file in files]
    if output is not None:
        proposed = {contents.column_map: contents.name for contents in read_files}
        if len(proposed) > 1:
            raise typer.BadParameter(
                f"{' and '.join(list(proposed.values())[:2])} need different column maps; "
                "write one for each"
            )
        content = f"{next(iter(proposed))}\n".encode()
        write_whole(output, content, overwrite=writing.overwrite)
    if general.json:
        console.write_json([asdict(contents) for contents in read_files])
        return
    console.write("\n\n".join(repr(contents) for contents in read_files))


@with_option_groups
def export(
    files: Files,
    general: General,
    laws: Laws,
    writing: Writing,
    to: Annotated[
        str,
        option(
            "Format: a simulator, a controller, a paper, or other budgets.",
            one_of="mujoco|mujoco-frictionloss|urdf|modelica|matlab|c|gtc|ufloat|latex|draws",
        ),
    ] = "",
    output: Annotated[str, option("File; - is standard output.", "--output", "-o")] = "-",
    size: Annotated[int, option("Number of draws.")] = 1000,
    seed: Seed = 0,
) -> None:
    """Write a fit saved by fit --save in the form that another program reads.

    Example: dahl-ident export fit.json --to mujoco -o joint.xml
    """
    laws.run()
    if not to:
        raise typer.BadParameter("missing; expected a format, such as --to c", param_hint="--to")
    if general.json:
        raise ValidationError("--json is given, but the format of an export is that of --to")
    if len(files) != 1:
        raise ValidationError(f"{len(files)} files are given; expected one saved fit")
    writing.check([output], files)
    fit = saved_fit(files[0])
    how: dict[str, Any] = {"overwrite": writing.overwrite, "size": size, "seed": seed}
    written(lambda place: Path(fit.export(to, place, **how)), output, ".csv")
    finish(fit)


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
    output: OutputFile = None,
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
        console.write_json(
            [
                {k: v for k, v in vars(one).items() if k != "experiment"} | {"kind": one.kind}
                for one in data_sets().values()
            ]
        )
        return
    for one in data_sets().values():
        kind = one.kind.replace("_", " ")
        console.write_wrapped(
            f"{one.name} ({kind}): {one.teaches}. Determines {', '.join(one.identifiable)}."
        )


@with_option_groups
def template(
    writing: Writing,
    name: Annotated[
        str,
        typer.Argument(
            help="report (for --metadata), options (for --config), columns (for --columns) or "
            "campaign.",
            autocompletion=starting(_TEMPLATES),
        ),
    ],
    output: Annotated[str, option("File; - is standard output.", "--output", "-o")] = STANDARD,
) -> None:
    """Print a TOML file with its fields explained, to fill in.

    Example: dahl-ident template report -o report.toml
    """
    from dahl_ident.data.storage import write_whole

    if name not in _TEMPLATES:
        raise ValidationError(
            f"there is no template {name!r}; there are {choices(_TEMPLATES, name)}"
        )
    writing.check([output])
    content = (Path(__file__).parent / "templates" / f"{name}.toml").read_bytes()

    if output == STANDARD:
        console.write(content.decode().removesuffix("\n"))
    else:
        write_whole(Path(output), content, overwrite=writing.overwrite)


@with_option_groups
def app(
    laws: Laws,
    folder: Annotated[
        Path, typer.Argument(help="Folder in which the work is kept, one folder for each.")
    ] = Path(),
    port: Annotated[int, option("Port; 0 takes a free one.", min=0, max=65535)] = 0,
    browser: Annotated[bool, option("Open the page in the browser.")] = True,
) -> None:
    """Open a page in the browser that goes from files to a signed report, on this machine alone.

    Example: dahl-ident app measurements
    """
    try:
        from dahl_ident.app import serve
    except ModuleNotFoundError as exc:
        raise ValidationError(
            f"the page needs {exc.name}, which is not installed; "
            "install it with pip install 'dahl_ident[app]'"
        ) from exc
    if not folder.is_dir():
        raise ValidationError(f"{folder} is not a folder; make it, or give one that is there")
    laws.run()
    serve(folder, port=port, laws=tuple(laws.laws or ()), browser=browser)

"""``dahl-ident export``: a saved fit for simulators, controllers and papers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dahl_ident.cli.files import written
from dahl_ident.cli.fit import finish, saved_fit
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import Files, General, Laws, Seed, Writing, one_of
from dahl_ident.errors import ValidationError


@with_option_groups
def export(
    files: Files,
    general: General,
    laws: Laws,
    writing: Writing,
    to: Annotated[
        str,
        one_of(
            "Format: a simulator, a controller, a paper, or other budgets.",
            None,
            "mujoco|mujoco-frictionloss|urdf|modelica|matlab|c|gtc|ufloat|latex|draws",
        ),
    ] = "",
    output: Annotated[
        str, typer.Option("--output", "-o", help="File; - is standard output.")
    ] = "-",
    size: Annotated[int, typer.Option(help="Number of draws.")] = 1000,
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

    def write(place: str | Path) -> Path:
        return Path(fit.export(to, place, overwrite=writing.overwrite, size=size, seed=seed))

    written(write, output, ".csv")
    finish(fit)

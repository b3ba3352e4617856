"""``dahl-ident template``: TOML files to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dahl_ident.cli.files import written
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import STANDARD, Writing, starting
from dahl_ident.errors import ValidationError, choices

NAMES = ("report", "options", "columns", "campaign")


@with_option_groups
def template(
    writing: Writing,
    name: Annotated[
        str,
        typer.Argument(
            help="report (for --metadata), options (for --config), columns (for --columns) or "
            "campaign.",
            autocompletion=starting(NAMES),
        ),
    ],
    output: Annotated[
        str, typer.Option("--output", "-o", help="File; - is standard output.")
    ] = STANDARD,
) -> None:
    """Print a TOML file with its fields explained, to fill in.

    Example: dahl-ident template report -o report.toml
    """
    from dahl_ident.data.storage import write_whole

    if name not in NAMES:
        raise ValidationError(f"there is no template {name!r}; there are {choices(NAMES, name)}")
    writing.check([output])
    content = (Path(__file__).parent / "templates" / f"{name}.toml").read_bytes()

    def write(place: str | Path) -> Path:
        write_whole(Path(place), content, overwrite=writing.overwrite)
        return Path(place)

    written(write, output, ".toml")

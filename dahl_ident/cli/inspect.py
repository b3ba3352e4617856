"""``dahl-ident inspect``: what a file holds, and the column map that would read it."""

from __future__ import annotations

from typing import Annotated

import typer

from dahl_ident.cli import console
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import Files, General


@with_option_groups
def inspect(
    files: Files,
    general: General,
    sheet: Annotated[str | None, typer.Option(help="Sheet of an Excel workbook.")] = None,
) -> None:
    """List channels, units, ranges, sampling and gaps, and propose a column map.

    Example: dahl-ident datasets plant_recording -o - | dahl-ident inspect -
    """
    from dataclasses import asdict

    from dahl_ident.data import inspect as contents_of

    found = [contents_of(file, sheet=sheet) for file in files]
    if general.json:
        console.write_json([asdict(contents) for contents in found])
        return
    console.write("\n\n".join(repr(contents) for contents in found))

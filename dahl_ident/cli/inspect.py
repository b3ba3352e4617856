"""``dahl-ident inspect``: what a file holds, and the column map that would read it."""

from __future__ import annotations

from typing import Annotated

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.options import Files, General


@grouped
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
        telling.say_json([asdict(contents) for contents in found])
        return
    telling.say("\n\n".join(repr(contents) for contents in found))

"""``dahl-ident inspect``: the contents of a file, and a column map to read it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dahl_ident.cli import console
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import Files, General, Writing


@with_option_groups
def inspect(
    files: Files,
    general: General,
    writing: Writing,
    sheet: Annotated[str | None, typer.Option(help="Sheet of an Excel workbook.")] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Column map to write, .toml, for --columns."),
    ] = None,
) -> None:
    """List channels, units, ranges, sampling and gaps, and propose a column map.

    Example: dahl-ident datasets plant_recording -o - | dahl-ident inspect -
    """
    from dataclasses import asdict

    from dahl_ident.data import inspect as contents_of
    from dahl_ident.data.storage import write_whole

    writing.check([output])
    found = [contents_of(file, sheet=sheet) for file in files]
    if output is not None:
        proposed = {contents.column_map: contents.name for contents in found}
        if len(proposed) > 1:
            raise typer.BadParameter(
                f"{' and '.join(list(proposed.values())[:2])} need different column maps; "
                "write one for each"
            )
        content = f"{next(iter(proposed))}\n".encode()
        write_whole(output, content, overwrite=writing.overwrite)
    if general.json:
        console.write_json([asdict(contents) for contents in found])
        return
    console.write("\n\n".join(repr(contents) for contents in found))

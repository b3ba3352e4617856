"""``dahl-ident app``: the page for those who do not program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import Laws
from dahl_ident.errors import ValidationError


@with_option_groups
def app(
    laws: Laws,
    folder: Annotated[
        Path, typer.Argument(help="Folder in which the work is kept, one folder for each.")
    ] = Path(),
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.", min=0, max=65535)] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
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

"""Files as commands take and give them: ``-`` is standard input or output, and all are whole."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

from dahl_ident.cli.options import STANDARD

_T = TypeVar("_T")


class Saved(Protocol):
    """Data that write themselves to a file."""

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write, and return the place."""
        ...


def write_data(data: Saved, output: str, *, overwrite: bool) -> None:
    """Write a table or a record to a file, or as CSV to standard output."""
    written(lambda place: data.save(place, overwrite=overwrite), output, ".csv")


def written(write: Callable[[str | Path], Path], output: str, ending: str) -> str:
    """Let `write` make a file; what is meant for standard output, with this ending."""
    if output != STANDARD:
        return str(write(output))
    with tempfile.TemporaryDirectory() as directory:
        content = write(Path(directory) / f"output{ending}").read_bytes()
    sys.stdout.flush()
    # UTF-8 as in a file, whatever the terminal's own encoding
    sys.stdout.buffer.write(content)
    return output


def make_folder(place: Path) -> None:
    """Make a folder where it is missing.

    Raises
    ------
    DataError
        If that cannot be done.
    """
    from dahl_ident.errors import DataError

    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise DataError(f"{place}: the folder cannot be made: {exc.strerror or exc}") from exc


def write_picture(axes: Any, path: str, *, overwrite: bool) -> None:
    """Write the figure of some axes in the format of the file's name."""
    from dahl_ident.data.storage import write_whole
    from dahl_ident.errors import DataError
    from dahl_ident.reporting.document import figure_of

    buffer = io.BytesIO()
    try:
        figure_of(axes).savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=150)
    except ValueError as exc:
        raise DataError(f"{path}: no picture of this kind: {exc}") from exc
    write_whole(Path(path), buffer.getvalue(), overwrite=overwrite)


def progress_bar() -> Any:
    """Return a progress bar on standard error that vanishes when done, or off a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    terminal = sys.stderr.isatty()
    console = Console(stderr=True, quiet=not terminal)  # some releases end with a line even so
    return Progress(console=console, transient=True, disable=not terminal)

"""Input and output files: ``-`` is standard input or output; files are written atomically."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from dahl_ident.cli.console import STANDARD


class Saved(Protocol):
    """Data with a method that writes them to a file."""

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write, and return the path."""
        ...


def write_data(data: Saved, output: str, *, overwrite: bool) -> None:
    """Write a table or a record to a file, or as CSV to standard output."""
    written(lambda place: data.save(place, overwrite=overwrite), output, ".csv")


def written(write: Callable[[str | Path], Path], output: str, ending: str) -> str:
    """Call `write` with a path; for standard output, with a temporary file of this ending."""
    if output != STANDARD:
        return str(write(output))
    with tempfile.TemporaryDirectory() as directory:
        content = write(Path(directory) / f"output{ending}").read_bytes()
    sys.stdout.flush()
    # UTF-8 as in a file, whatever the terminal's own encoding
    sys.stdout.buffer.write(content)
    return output


def make_folder(place: Path) -> None:
    """Make a folder if it does not exist."""
    from dahl_ident.errors import DataError

    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise DataError(f"{place}: the folder cannot be made: {exc.strerror or exc}") from exc


def write_picture(axes: Any, path: str, *, overwrite: bool) -> None:
    """Write the figure of some axes in the format given by the file name."""
    from dahl_ident.data.storage import write_whole
    from dahl_ident.errors import DataError
    from dahl_ident.reporting.document import figure_of

    buffer = io.BytesIO()
    try:
        figure_of(axes).savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=150)
    except ValueError as exc:
        raise DataError(f"{path}: not a format for plots: {exc}") from exc
    write_whole(Path(path), buffer.getvalue(), overwrite=overwrite)

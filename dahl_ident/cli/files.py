"""Files as commands take and give them: ``-`` is standard input or output, and all are whole."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STANDARD = "-"
_T = TypeVar("_T")


class Saved(Protocol):
    """Data that write themselves to a file."""

    def save(self, path: str | Path) -> Path:
        """Write, and return the place."""
        ...


def refuse_inputs(files: Sequence[str], *outputs: str | Path | None) -> None:
    """Refuse to write over what is being read.

    Raises
    ------
    ValidationError
        If an output is one of the input files.
    """
    from dahl_ident.errors import ValidationError

    inputs = {Path(file).resolve() for file in files if file != STANDARD}
    for output in outputs:
        if output is not None and str(output) != STANDARD and Path(output).resolve() in inputs:
            raise ValidationError(
                f"{output} is an input and would be overwritten; give the output another name"
            )


def write_data(data: Saved, output: str) -> None:
    """Write a table or a record to a file, or as CSV to standard output."""
    if output != STANDARD:
        data.save(output)
        return
    with tempfile.TemporaryDirectory() as directory:
        sys.stdout.write(data.save(Path(directory) / "table.csv").read_text(encoding="utf-8"))


def write_text(text: str, output: str) -> None:
    """Write a text to a file, or to standard output."""
    from dahl_ident.data.storage import write_whole

    if output == STANDARD:
        sys.stdout.write(text)
    else:
        write_whole(Path(output), text.encode())


def write_picture(axes: Any, path: str) -> None:
    """Write the figure of some axes in the format of the file's name."""
    import numpy as np

    from dahl_ident.data.storage import write_whole
    from dahl_ident.errors import DataError

    figure: Figure = np.ravel(np.asarray(axes, dtype=object))[0].figure
    buffer = io.BytesIO()
    try:
        figure.savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=150)
    except ValueError as exc:
        raise DataError(f"{path}: no picture of this kind: {exc}") from exc
    write_whole(Path(path), buffer.getvalue())


def with_progress(items: Sequence[_T], what: str) -> Iterator[_T]:
    """Yield the items under a progress bar, which appears on a terminal only."""
    with progress_bar() as bar:
        yield from bar.track(items, description=what)


def progress_bar() -> Any:
    """Return a progress bar on standard error that vanishes when done, or off a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    return Progress(console=console, transient=True, disable=not sys.stderr.isatty())

"""What commands read and write: results on standard output, files, warnings, errors.

Files are written atomically; ``-`` is standard input or output.
"""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from dahl_ident.errors import DataError, ValidationError
from dahl_ident.progress import spinner

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record

STANDARD = "-"  # standard input or output, in place of a file's name
BAD_INPUT = 1  # exit status, as of any uncaught error
WRONG_USE = 2  # exit status, as click has it for unknown options
NOT_TRUSTED = 3  # exit status: the first that is free
_NARROWEST = 40  # columns; in a narrower window indented lines would hold a word or two
_STATUS = re.compile(r"\s*(Trusted|Approximate|Not determined|Not described)(?=\.)")
_STYLES = {"Trusted": "1;32", "Approximate": "1;33"}
_RED = "1;31"
INTERRUPTED = 130  # exit status, as shells have it: 128 and the number of SIGINT


@dataclass
class _Session:
    """What holds for all output of a command; `quiet` leaves out all but errors and data."""

    color: bool = True
    quiet: bool = False
    typed: Sequence[str] = ()


session = _Session()


def begin(typed: Sequence[str]) -> None:
    """Store the command, and show warnings as plain lines, without file and code."""

    def show(message: Warning | str, *_: Any) -> None:
        note(f"warning: {message}")

    session.typed, session.quiet = typed, False
    if isinstance(sys.stdout, io.TextIOWrapper):
        # the name of a file, or a unit, may hold what the terminal's encoding does not
        sys.stdout.reconfigure(errors="backslashreplace")
    # setattr, because this function ignores file and line
    setattr(warnings, "showwarning", show)  # noqa: B010 - an assignment fails the type check


def open_streams() -> bool:
    """Open the standard streams that are closed, to nowhere; return whether output was open.

    Otherwise the next file that is opened would get what libraries print.
    """
    there = sys.stdout is not None
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            nowhere = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 - to the end
            setattr(sys, name, nowhere)
    return there


def option_name(name: str) -> str:
    """Return how an argument is written on the command line."""
    return f"--{name.replace('_', '-')}"


def refuse(names: Iterable[str], why: str) -> None:
    """Refuse the options of these names, if there are any; `why` ends "are given"."""
    if options := ", ".join(map(option_name, names)):
        raise ValidationError(f"{options} is given {why}")


def changed(*groups: Any) -> list[str]:
    """Return the names of the options of some groups that are not at their defaults."""
    return [
        name
        for group in groups
        for name, value in vars(group).items()
        if value != getattr(type(group)(), name)
    ]


def typed_command() -> str:
    """Return the command of this run, as typed."""
    command = shlex.join(["dahl-ident", *session.typed])
    command = command.encode(errors="backslashreplace").decode()  # as names of files are told
    piped = STANDARD in session.typed
    return f"{command}  # its input came through standard input" if piped else command


def _styled(text: str, style: str) -> str:
    """Return a text in a style (bold is 1) if results go to a terminal that may have colours."""
    plain = "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb"
    coloured = session.color and sys.stdout.isatty() and not plain
    return f"\x1b[{style}m{text}\x1b[0m" if coloured else text


def write(text: str) -> None:
    """Print a text unchanged, the status of a result in colour where there is a terminal."""
    if not session.quiet:
        status = _STATUS.match(text)
        shown = _styled(status[0], _STYLES.get(status[1], _RED)) if status else ""
        sys.stdout.write(f"{shown}{text[status.end() if status else 0 :]}\n")


def write_wrapped(text: str) -> None:
    """Print a text; long lines are wrapped and indented."""
    shown = sys.stdout.isatty() or "COLUMNS" in os.environ
    width = max(_NARROWEST, shutil.get_terminal_size().columns) if shown else None
    for line in text.splitlines():
        indent = " " * (len(line) - len(line.lstrip()) + 4)
        if width is None or len(line) <= width:
            write(line)
        else:
            write(textwrap.fill(line, width, subsequent_indent=indent, break_on_hyphens=False))


@contextmanager
def busy(task: str) -> Iterator[Callable[[float, float], None]]:
    """Show on a terminal, after two seconds, that a task goes on, and for how long.

    The function that is yielded takes the steps done and their number: then these, and the time
    left, are shown as well.
    """
    if session.quiet or not sys.stderr.isatty():
        yield lambda _done, _total: None
        return
    with spinner(task) as show:
        yield lambda done, total: show(f" {done:g} of {total:g}" * (total > 1.0), done, total)


def write_error(text: str) -> None:
    """Print one line on standard error."""
    sys.stderr.write(f"{text}\n")


def note(text: str) -> None:
    """Print one line on standard error that --quiet leaves out."""
    if not session.quiet:
        write_error(text)


def write_json(value: Any) -> None:
    """Print one JSON document."""
    from dahl_ident.data.storage import plain_data

    known = plain_data(value, not_finite=lambda _: None)
    text = json.dumps(known, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write(f"{text}\n")


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    from dahl_ident.diagnostics.formatting import table as aligned

    write(f"{title}\n{aligned([header, *rows], left=range(len(header)))}")


def heading(text: str) -> None:
    """Print the name of a step."""
    write(_styled(text, "1;36"))


def finish(trusted: bool, reason: str) -> None:
    """End a command with the exit status of its result."""
    if not trusted:
        write_error(f"not to be trusted: {reason}")
        raise typer.Exit(NOT_TRUSTED)


def write_data(data: FrequencyResponse | Record, output: str, *, overwrite: bool) -> None:
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


def write_picture(axes: Any, path: str, *, overwrite: bool) -> None:
    """Write the figure of some axes in the format given by the file name."""
    from dahl_ident.data.storage import write_whole
    from dahl_ident.reporting.document import figure_of

    buffer = io.BytesIO()
    try:
        figure_of(axes).savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=150)
    except ValueError as exc:
        raise DataError(f"{path}: not a format for plots: {exc}") from exc
    write_whole(Path(path), buffer.getvalue(), overwrite=overwrite)

"""Output of commands: results on standard output, files, warnings, errors.

Files are written atomically; ``-`` is standard input or output.
"""

from __future__ import annotations

import io
import json
import os
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

STANDARD = "-"  # standard input or output, in place of a file name
# exit statuses
BAD_INPUT = 1  # as of any uncaught error
WRONG_USE = 2  # that of click for unknown options
NOT_TRUSTED = 3  # the first that is free
INTERRUPTED = 130  # that of shells: 128 + the number of SIGINT
_MIN_WIDTH = 40  # columns; in a narrower window indented lines would hold a word or two
_STYLES = {"trusted": "1;32", "approximate": "1;33"}
_RED = "1;31"


@dataclass
class _Session:
    """Settings for all output of a command; `quiet` suppresses all but errors and data."""

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
        # a file name, or a unit, may have characters that the terminal's encoding lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    # setattr, because this function ignores file and line
    setattr(warnings, "showwarning", show)  # noqa: B010 - an assignment fails the type check


def open_streams() -> bool:
    """Connect closed standard streams to the null device; return whether output was open.

    Otherwise what libraries print would go into the next file that is opened.
    """
    output_is_open = sys.stdout is not None
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            null = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 - open to the end
            setattr(sys, name, null)
    return output_is_open


def option_name(name: str) -> str:
    """Return the command-line option for an argument."""
    return f"--{name.replace('_', '-')}"


def refuse(names: Iterable[str], why: str) -> None:
    """Refuse the options with these names, if there are any; `why` follows "is given"."""
    if options := ", ".join(map(option_name, names)):
        raise ValidationError(f"{options} is given {why}")


def changed(*groups: Any) -> list[str]:
    """Return the names of the options in some groups that differ from their defaults."""
    return [
        name
        for group in groups
        for name, value in vars(group).items()
        if value != getattr(type(group)(), name)
    ]


def typed_command() -> str:
    """Return the command of this run, as typed."""
    command = shlex.join(["dahl-ident", *session.typed])
    command = command.encode(errors="backslashreplace").decode()  # as file names are printed
    piped = STANDARD in session.typed
    return f"{command}  # its input came through standard input" if piped else command


def _styled(text: str, style: str) -> str:
    """Return a text in a style (1 is bold) if results go to a terminal that allows colours."""
    no_color = "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb"
    coloured = session.color and sys.stdout.isatty() and not no_color
    return f"\x1b[{style}m{text}\x1b[0m" if coloured else text


def write(text: str) -> None:
    """Print a text."""
    if not session.quiet:
        sys.stdout.write(f"{text}\n")


def write_wrapped(text: str, status: str = "") -> None:
    """Print a text; long lines are wrapped and indented, and the status coloured on a terminal."""
    word = status.capitalize()
    coloured = _styled(word, _STYLES.get(status, _RED))
    has_width = sys.stdout.isatty() or "COLUMNS" in os.environ
    width = max(_MIN_WIDTH, shutil.get_terminal_size().columns) if has_width else None
    for line in text.splitlines():
        indent = " " * (len(line) - len(line.lstrip()) + 4)
        if width is not None and len(line) > width:
            line = textwrap.fill(line, width, subsequent_indent=indent, break_on_hyphens=False)
        if status and line.lstrip().startswith(f"{word}."):
            line = line.replace(word, coloured, 1)
        write(line)


@contextmanager
def busy(task: str) -> Iterator[Callable[[float, float], None]]:
    """Show on a terminal, after two seconds, that a task is running, and the time elapsed.

    The yielded function takes the number of steps done and the total; these and the remaining time
    are then shown as well. Of a total of 1, of which a share is done, only the time is shown.
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
    """Print one line on standard error, except with --quiet."""
    if not session.quiet:
        write_error(text)


def write_json(value: Any) -> None:
    """Print one JSON document."""
    from dahl_ident.data.storage import plain_data

    plain = plain_data(value, not_finite=lambda _: None)
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write(f"{text}\n")


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    from dahl_ident.diagnostics.formatting import table as aligned_table

    write(f"{title}\n{aligned_table([header, *rows], left=range(len(header)))}")


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
    write_output(lambda path: data.save(path, overwrite=overwrite), output, ".csv")


def write_output(write: Callable[[str | Path], Path], output: str, suffix: str) -> str:
    """Call `write` with a path: for standard output, with that of a temporary file."""
    if output != STANDARD:
        return str(write(output))
    with tempfile.TemporaryDirectory() as directory:
        content = write(Path(directory) / f"output{suffix}").read_bytes()
    sys.stdout.flush()
    # UTF-8 as in a file, whatever the terminal's encoding
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

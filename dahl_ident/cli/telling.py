"""What a command says: text for people on standard output, doubts on standard error."""

from __future__ import annotations

import io
import json
import math
import shlex
import sys
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from dahl_ident.cli.options import STANDARD

if TYPE_CHECKING:
    from rich.console import Console

BAD_INPUT = 1
WRONG_USE = 2
NOT_TRUSTED = 3
INTERRUPTED = 130


@dataclass
class _Session:
    color: bool = True
    typed: Sequence[str] = ()


_session = _Session()


def begin(typed: Sequence[str]) -> None:
    """Remember what was typed, and show warnings as lines for people, without file and code."""

    def show(message: Warning | str, *_: Any) -> None:
        doubt(f"warning: {message}")

    _session.typed = typed
    if isinstance(sys.stdout, io.TextIOWrapper):
        # the name of a file, or a unit, may hold what the terminal's encoding does not
        sys.stdout.reconfigure(errors="backslashreplace")
    # setattr, because the signature here has no use for file and line
    setattr(warnings, "showwarning", show)  # noqa: B010


def typed_command() -> str:
    """Return the command of this run, as it would be typed again."""
    command = shlex.join(["dahl-ident", *_session.typed])
    command = command.encode(errors="backslashreplace").decode()  # as names of files are told
    piped = STANDARD in _session.typed
    return f"{command}  # its input came through standard input" if piped else command


def use_color(color: bool) -> None:
    """Turn colour on or off for all that follows."""
    _session.color = color


def console() -> Console:
    """Return where people read; colour and width follow the terminal."""
    from rich.console import Console

    terminal = sys.stdout.isatty()
    return Console(
        no_color=None if _session.color else True,
        highlight=False,
        soft_wrap=True,
        width=None if terminal else 100,
    )


def say(text: str) -> None:
    """Print one text as it is."""
    sys.stdout.write(f"{text}\n")


def doubt(text: str) -> None:
    """Print one line on standard error."""
    sys.stderr.write(f"{text}\n")


def say_json(value: Any) -> None:
    """Print one JSON document."""
    say(json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False))


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; text from files is not taken for markup."""
    from rich import box
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    drawn = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    cells = [list(row) for row in rows]
    for i, name in enumerate(header):
        # a number broken over two lines would be read as another
        whole = not any(" " in row[i] for row in cells)
        least = max(len(text) for text in [name, *(row[i] for row in cells)]) if whole else None
        drawn.add_column(Text(name), overflow="fold", no_wrap=whole, min_width=least)
    for row in cells:
        drawn.add_row(*(Text(cell) for cell in row))
    screen = console()
    wide = screen.options.update(max_width=10_000)
    screen.width = max(screen.width, Measurement.get(screen, wide, drawn).minimum)
    screen.print(drawn)


def heading(text: str) -> None:
    """Print the name of a step."""
    from rich.text import Text

    console().print(Text(text, style="bold cyan"))


def finish(trusted: bool, reason: str) -> None:
    """End a command with the status that its result deserves."""
    if not trusted:
        doubt(f"not to be trusted: {reason}")
        raise typer.Exit(NOT_TRUSTED)


def plain(value: Any) -> Any:
    """Return nested data that JSON knows: arrays as lists, complex numbers as pairs."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

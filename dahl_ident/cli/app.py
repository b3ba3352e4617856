"""All commands, and the handling of their errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.estimate import fit, report, sample
from dahl_ident.cli.experiments import plan, simulate
from dahl_ident.cli.extract import demo, extract
from dahl_ident.cli.one_step import app as app_page
from dahl_ident.cli.one_step import campaign, datasets, export, inspect, template
from dahl_ident.errors import DahlIdentError, arguments_as_options
from dahl_ident.version import __version__

_NAME = "dahl-ident"
# base class of all usage errors, whether Typer uses click or its own copy of it
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]

app = typer.Typer(
    name=_NAME,
    help="Identify friction from measurements, with an uncertainty budget.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
commands = (
    demo,
    app_page,
    inspect,
    extract,
    fit,
    sample,
    plan,
    campaign,
    report,
    export,
    simulate,
    datasets,
    template,
)
for command in commands:
    app.command()(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        console.write(f"{_NAME} {__version__}")
        raise typer.Exit


@app.callback(
    epilog="Exit status: 0 result can be used, 1 bad input, 2 wrong usage, "
    "3 result must not be used."
)
def common(
    color: Annotated[
        bool, typer.Option("--color/--no-color", help="Colour; NO_COLOR turns it off as well.")
    ] = True,
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Identify friction from measurements, with an uncertainty budget."""
    console.session.color = color


def main(arguments: list[str] | None = None) -> None:
    """Run the command line as typed after ``dahl-ident``; always ends with SystemExit."""
    typed = sys.argv[1:] if arguments is None else arguments
    # the matrices are small: numerical threads would spend more time waiting than computing
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not console.open_streams():
        console.write_error("error: standard output is closed; send it to a file, or /dev/null")
        sys.exit(console.BAD_INPUT)
    console.begin(typed)
    try:
        try:
            with arguments_as_options():
                status = app(args=typed, prog_name=_NAME, standalone_mode=False)
        finally:
            sys.stdout.flush()
    except _UsageError as exc:
        status = _report_usage_error(exc, typed)
    except DahlIdentError as exc:
        console.write_error(f"error: {' '.join(str(exc).split())}")
        status = console.BAD_INPUT
    except MemoryError:
        console.write_error("error: this takes more memory than is available; give smaller files")
        status = console.BAD_INPUT
    except OSError as exc:
        if not isinstance(exc, BrokenPipeError):  # a reader such as head has closed the pipe
            console.write_error(
                f"error: {exc.filename or 'standard output'}: {exc.strerror or exc}"
            )
        # Python flushes the rest of the buffer when it ends, which would fail again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = console.BAD_INPUT
    if status == console.INTERRUPTED:
        console.write_error("interrupted; no file is incomplete")
    sys.exit(status)


def _report_usage_error(error: Any, typed: Sequence[str]) -> int:
    """Print in two lines what is wrong with a command, and where its options are listed."""
    message = " ".join(error.format_message().split())
    if message:  # empty if nothing was typed: Typer has printed the help
        causes = getattr(error.__cause__, "errors", None)
        got = f"; got {causes()[0]['input']!r}" if causes else ""
        # errors of the option parser have no context; only flags can precede the command
        words = [word for word in typed if not word.startswith("-")]
        command = error.ctx.command_path if error.ctx else " ".join([_NAME, *words[:1]])
        console.write_error(f"error: {message}{got}\nSee {command} --help")
    return console.WRONG_USE

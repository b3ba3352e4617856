"""Messages of the library reach the command line in the words of its options."""

from __future__ import annotations

import io
import sys
import time

import pytest

from dahl_ident.cli import console
from dahl_ident.cli.console import in_options


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        (
            "record longer, give frequency=, or mode='sweep'",
            "record longer, give --frequency, or --mode 'sweep'",
        ),
        ("or lower min_share= if it is noise", "or lower --min-share if it is noise"),
        ("give frequency=1.25, or leave it out", "give --frequency 1.25, or leave it out"),
        ("it: di.fit(record, model)", "it: dahl-ident fit --record"),
        ("a = b, x=", "a = b, --x"),
        (
            "Name it with columns={'gain': ...}",
            'Name it with --columns columns.toml, a file with the line: gain = "..."',
        ),
        (
            "or give columns={'gain': {'column': 'K', 'unit': 'N/m'}}",
            "or give --columns columns.toml, a file with the line: "
            'gain = {column = "K", unit = "N/m"}',
        ),
    ],
)
def test_arguments_become_options(message: str, shown: str) -> None:
    assert in_options(message) == shown


def test_extract_names_its_own_options(monkeypatch: pytest.MonkeyPatch) -> None:
    message = "Name it with columns={'force': ...}, or columns={'force': 'friction force'}"
    monkeypatch.setattr(console._session, "typed", ["extract", "run.csv"])
    assert in_options(message) == "Name it with --force ..., or --force 'friction force'"
    monkeypatch.setattr(console._session, "typed", ["fit", "run.csv"])
    assert "--columns columns.toml" in in_options(message)


def test_ranges_are_options() -> None:
    shown = in_options("give ranges={'f_max': (low, high), 'mass': (low, high)} that hold")
    assert shown == "give --ranges f_max=low:high --ranges mass=low:high that hold"
    shown = in_options("give limits['frequency_hz'], or target={'f_max': 0.02}")
    assert shown == "give --frequency, or --target f_max=0.02"


@pytest.mark.parametrize("quiet", [False, True])
def test_a_long_task_shows_that_it_goes_on(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(console, "_PATIENCE", 0.01)
    monkeypatch.setattr(console._session, "quiet", quiet)
    monkeypatch.setenv("TERM", "xterm-256color")
    with console.busy("writing the report") as progress:
        progress(1, 4)
        time.sleep(0.5)
    assert ("writing the report" in screen.getvalue()) is not quiet

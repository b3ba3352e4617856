"""How long the command line takes to answer, and the demonstration from waveforms to report."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from benchmarks.harness import Row, print_table, seconds

TITLE = "Command line"
PROGRAM = Path(sys.executable).with_name("dahl-ident")
HELP_LIMIT, DEMO_LIMIT = 0.5, 120.0  # seconds


def answer(*arguments: str) -> None:
    """Run one command."""
    subprocess.run([str(PROGRAM), *arguments], check=True, capture_output=True)


def run() -> list[Row]:
    """Return the comparisons with the limits that are promised."""
    answer("--help")
    rows = [
        Row(
            f"dahl-ident {' '.join(arguments)}",
            min(seconds(partial(answer, *arguments)) for _ in range(5)),
            HELP_LIMIT,
            "the limit promised",
            1.0,
        )
        for arguments in (("--help",), ("fit", "--help"))
    ]
    with tempfile.TemporaryDirectory() as folder:
        demo = seconds(lambda: answer("demo", "--output", folder))
    return [*rows, Row("dahl-ident demo", demo, DEMO_LIMIT, "the limit promised", 1.0)]


if __name__ == "__main__":
    print_table(TITLE, run())

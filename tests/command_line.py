"""The command line run in this process: quick, and with its standard streams at hand."""

from __future__ import annotations

import io
import shlex
import sys
from dataclasses import dataclass

import pytest

from dahl_ident.cli import main


@dataclass
class Outcome:
    """What a command left behind."""

    status: int
    out: str
    err: str


class Runner:
    """Runs commands as a shell would, but in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> None:
        self._capsys, self._patch = capsys, patch

    def __call__(self, *arguments: object, stdin: str = "") -> Outcome:
        self._patch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin.encode())))
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in arguments])
        out, err = self._capsys.readouterr()
        code = ended.value.code
        return Outcome(code if isinstance(code, int) else 0, out, err)

    def refused(self, *arguments: object, stdin: str = "") -> str:
        """Return the error, of one line, of a command that ends with 1 and prints nothing else."""
        outcome = self(*arguments, stdin=stdin)
        assert (outcome.status, outcome.out, outcome.err.count("\n")) == (1, "", 1), outcome
        assert outcome.err.startswith("error: ")
        return outcome.err

    def line(self, command: str, *extra: str, stdin: str = "") -> Outcome:
        """Run a line of commands joined by pipes; `extra` options go to the last one."""
        stages = command.split(" | ")
        outcome = Outcome(0, stdin, "")
        for i, stage in enumerate(stages):
            program, *arguments = shlex.split(stage, comments=True)
            assert program == "dahl-ident"
            last = extra if i == len(stages) - 1 else ()
            outcome = self(*arguments, *last, stdin=outcome.out)
            assert outcome.status in (0, 3), outcome.err
        return outcome

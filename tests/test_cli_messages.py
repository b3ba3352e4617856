"""Messages of the library reach the command line in the words of its options."""

import io
import shlex
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from dahl_ident import read_frequency_response
from dahl_ident.cli import console
from dahl_ident.errors import DataError

TABLE = "drive [N],gain [m/N],phase_deg\n0.1,1e-3,-20\n0.2,2e-3,-30\n"
WAVES = "time [s],x [mm],pull [N]\n" + "".join(f"{i},{i % 5},{i % 3}\n" for i in range(30))
DRIVEN = "frequency_hz,drive [N],gain [m/N],phase_deg\n" + "".join(
    f"{1 + i},{0.1 * i + 0.1},{1e-3 * i + 1e-3},-{20 + i}\n" for i in range(9)
)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "fit table.csv --mass 0.1",
            'name it with --columns columns.toml, a file with the line: frequency = "...", or say '
            "what was swept, such as --sweep '1:100Hz log'",
        ),
        ("extract moved.csv", "Name it, such as --displacement x"),
        ("extract waves.csv --displacement x", "Name it with --force ... (inspect"),
        (
            "plan --frequency 5Hz --noise 0.01 --target f_max=0.01",
            "--ranges f_max=low:high --ranges",
        ),
        (
            "plan --displacement 1mm --noise 0.01 --ranges f_max=0.1:0.2 --ranges sigma=20:40 "
            "--target f_max",
            "give --time, or --target f_max=0.02",
        ),
        (
            "fit driven.csv --element dahl --element dahl",
            "such as --element 'dahl(name=pivot)'",
        ),
        ("fit shaken.csv --record --predicted motion", "; add --mass free, or predict the force"),
        ("sample driven.csv --alpha free --mass free --method grid", "or use --method mcmc"),
    ],
)
def test_messages_name_options(command, said, run):
    Path("table.csv").write_text(TABLE)
    Path("waves.csv").write_text(WAVES)
    Path("moved.csv").write_text(WAVES.replace("x [mm]", "moved [mm]"))
    Path("driven.csv").write_text(DRIVEN)
    Path("shaken.csv").write_text(WAVES.replace("pull", "force"))
    assert said in run.refused(*shlex.split(command))


def test_python_is_told_arguments():
    data = pd.read_csv(io.StringIO(TABLE))
    with pytest.raises(DataError, match=r"columns=\{'frequency': \.\.\.\}.*sweep='1:100Hz log'"):
        read_frequency_response(data)


@pytest.mark.parametrize("quiet", [False, True])
def test_a_long_task_shows_that_it_goes_on(quiet, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr("dahl_ident.progress.PATIENCE", 0.01)
    monkeypatch.setattr(console.session, "quiet", quiet)
    monkeypatch.setenv("TERM", "xterm-256color")
    with console.busy("writing the report") as progress:
        progress(1, 4)
        time.sleep(0.5)
    assert ("writing the report" in screen.getvalue()) is not quiet

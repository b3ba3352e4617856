"""The command in a report repeats its result: it is run, and the numbers are compared."""

import json
import re
from pathlib import Path

import numpy as np

import dahl_ident as di

A = np.geomspace(3e-4, 3e-2, 12)
NOISE = 0.01 * np.random.default_rng(3).standard_normal((2, 12))


def table(friction):
    response = friction.describing_function(A) * np.exp(NOISE[0] + 1j * NOISE[1])
    return di.FrequencyResponse(np.full(12, 2.0), response, A)


def test_of_what_the_command_line_wrote(run):
    table(di.Dahl(0.1, 30.0)).save("t.csv")
    run("report", "t.csv", "--stiffness", "free", "-o", "r.html", "-o", "one.json")
    page = Path("r.html").read_text(encoding="utf-8")
    found = re.search(r"<pre tabindex=\"0\">(dahl-ident [^<]*)</pre>", page)
    first = Path("one.json").read_bytes()
    run.line(found[1], "--overwrite")
    one, two = (json.loads(text)["fits"] for text in (first, Path("one.json").read_bytes()))
    assert one == two

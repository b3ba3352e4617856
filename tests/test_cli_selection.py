"""Elements and rows as they are typed: ``--element``, ``--where``, ``--levels``, ``--runs``."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.cli.model import elements
from dahl_ident.cli.row_selection import selected
from dahl_ident.elements import KINDS
from dahl_ident.errors import DahlIdentError, ValidationError
from tests.command_line import Runner


def table(**columns: Any) -> di.FrequencyResponse:
    A = np.geomspace(1e-4, 1e-2, 6)
    N = di.Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    return di.FrequencyResponse(
        [1.0, 1.0, 1.0, 2.0, 2.0, 2.0],
        N,
        A,
        level=["1", "2", "3", "1", "2", "10"],
        run=["a", "a", "a", "b", "b", "b"],
        harmonic=[1, 1, 3, 1, 1, 1],
        **columns,
    )


@pytest.mark.parametrize(
    ("where", "rows"),
    [
        ("level > 2", [2, 5]),
        ("level > 2 and harmonic == 1", [5]),
        ("run == 'a' or amplitude > 5e-3", [0, 1, 2, 5]),
        ("not (frequency_hz == 2)", [0, 1, 2]),
        ("1e-3 < amplitude <= 0.005", [3, 4]),
        ("level != '2'", [0, 2, 3, 5]),
        ("phase_deg > -1", [0, 1, 2, 3, 4, 5]),
    ],
)
def test_where_keeps_what_meets_the_condition(where: str, rows: list[int]) -> None:
    data = table()
    assert data.amplitude is not None
    found = selected(data, where, None, None)
    np.testing.assert_array_equal(found.amplitude, data.amplitude[rows])


def test_levels_and_runs_are_named() -> None:
    assert selected(table(), None, "1, 10", None).n == 3
    assert selected(table(), None, None, "b").n == 3
    assert selected(table(), "harmonic == 1", "2,3", "a").n == 1
    with pytest.raises(ValidationError, match="--levels names 7; the data have 1, 2, 3, 10"):
        selected(table(), None, "7,1", None)
    with pytest.raises(ValidationError, match="--runs names c; the data have a, b"):
        selected(table(), None, None, "c")


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("level >", "invalid syntax"),
        ("speed > 1", "there is no column speed"),
        ("level", "it contains no comparison"),
        ("level.__class__ == 1", "is not understood"),
        ("__import__('os') == 1", "is not understood"),
        ("harmonic in [1, 3]", "is not understood|in, is and the like"),
        ("run > 1", "a label that is not a number is compared with a number"),
        ("level > 100", "selects none of 6 rows"),
    ],
)
def test_conditions_that_cannot_be_met_are_refused(where: str, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        selected(table(), where, None, None)


def test_elements_are_written_by_their_kind() -> None:
    model = elements(["dahl(100 mN, alpha=free, name=pivot)", "mass(300g)", "spring"])
    known = {p.name: p.value for p in model.parameters if not p.free}
    assert known == {"pivot_f_max": 0.1, "mass": 0.3}
    free = [p.name for p in model.parameters if p.free]
    assert free == ["pivot_sigma", "pivot_alpha", "stiffness"]


@pytest.mark.parametrize("kind", [kind for kind, one in KINDS.items() if one.parameters])
def test_every_kind_can_be_typed(kind: str) -> None:
    assert elements([kind]).parameters


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "nosuch",
            "--element names the kind 'nosuch'; expected a law from a file given with --laws, or",
        ),
        ("mass(1, 2)", "mass takes mass"),
        ("mass(weight=1)", "weight"),
        ("mass(heavy)", "mass is 'heavy'; expected a number in SI units or with its unit, or 'fr"),
        ("mass(3 mm)", "mass has the unit [mm]; expected a unit of the dimension of kg"),
        ("dahll", "did you mean 'dahl'?"),
        ("mass(0.3", "expected a kind and its values"),
    ],
)
def test_elements_that_do_not_exist_are_refused(text: str, message: str) -> None:
    with pytest.raises(DahlIdentError, match=re.escape(message)):
        elements([text])


def test_a_law_that_a_user_wrote_is_simulated_and_fitted(run: Runner) -> None:
    class Typed(di.Friction):
        kind = "typed_jenkins"
        equation = "dF/dx = stiffness below f_max"
        parameters = (
            di.Parameter("stiffness", "N/m", "elastic stiffness", lower=0.0, transform="log"),
            di.Parameter("f_max", "N", "friction limit", lower=0.0, transform="log"),
        )

        def slope(self, force: Any, direction: Any, velocity: Any, values: Any) -> Any:
            stiffness, f_max = values
            return stiffness * (direction * force < f_max)

    try:
        law = "typed_jenkins(stiffness=30, f_max=0.1)"
        noise = ("--force-std", "0.01")
        made = run("simulate", "--element", law, "--levels", "1e-3:0.1:8", *noise, "-o", "t.csv")
        assert made.status == 0, made.err
        fit = json.loads(run("fit", "t.csv", "--element", "typed_jenkins", "--json").out)
        for name, truth in (("stiffness", 30.0), ("f_max", 0.1)):
            estimate = fit["params"][name]
            assert abs(estimate["value"] - truth) < 4.0 * estimate["stderr"]
    finally:
        del KINDS["typed_jenkins"]


def test_a_fit_is_told_on_few_lines_and_wrapped(
    run: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run("datasets", "microslip", "-o", "m.csv").status == 0
    brief = run("fit", "m.csv", "--mass", "free", "--damping", "free", "--stiffness", "free")
    report = brief.out.splitlines()
    assert len(report) <= 16
    assert report[0] == "Verdict"
    assert report[-1].startswith("-v prints")
    assert any(line.split()[:1] == ["sigma"] for line in report)
    assert "Solver" in run("fit", "m.csv", "-v").out
    monkeypatch.setenv("COLUMNS", "60")
    narrow = run("fit", "m.csv", "-v").out.splitlines()
    verdict = narrow[1 : narrow.index("Parameters")]
    assert max(map(len, verdict)) <= 60
    assert all(line.startswith("    ") for line in verdict)


def test_patterns_name_files(run: Runner, tmp_path: Path) -> None:
    """Quoted patterns, which some shells pass on as they are."""
    for run_name in ("a", "b"):
        table().select(run=run_name).save(tmp_path / f"day_{run_name}.csv")
    outcome = run("fit", str(tmp_path / "day_*.csv"), "--runs", "c")
    assert (outcome.status, "the data have a, b" in outcome.err) == (1, True)
    outcome = run("fit", str(tmp_path / "none*"))
    assert (outcome.status, "no file matches this pattern" in outcome.err) == (1, True)

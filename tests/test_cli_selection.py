"""Elements and rows as they are typed: ``--element``, ``--where``, ``--levels``, ``--runs``."""

import json
import re

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.elements import KINDS, describe_model
from tests.test_generic_friction import Jenkins


def table(**columns):
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


def kept(run, *options):
    """Return the rows that a fit used."""
    table().save("t.csv", overwrite=True)
    fit = ("fit", "t.csv", "--noise", "absolute", "--save", "f.json", "--overwrite")
    assert run(*fit, *options).status in (0, 3)
    data: di.FrequencyResponse = di.FitResult.load("f.json").data
    return data


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
def test_where_keeps_what_meets_the_condition(run, where, rows):
    amplitude = table().amplitude
    assert kept(run, "--where", where).amplitude == pytest.approx(amplitude[rows], rel=1e-12)


def test_levels_and_runs_are_named(run):
    assert kept(run, "--levels", "1, 10").n == 3
    assert kept(run, "--runs", "b").n == 3
    assert kept(run, "--where", "harmonic == 1", "--levels", "2,3", "--runs", "a").n == 1
    for option, says in (("--levels", "names 7; the data have 1, 2, 3, 10"),
                         ("--runs", "names 7; the data have a, b")):  # fmt: skip
        assert f"{option} {says}" in run("fit", "t.csv", option, "7").err


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
def test_conditions_that_cannot_be_met_are_refused(run, where, message):
    table().save("t.csv")
    assert re.search(message, run.refused("fit", "t.csv", "--where", where))


def test_elements_are_written_by_their_kind(run):
    known = ("dahl(100 mN, alpha=free, name=pivot)", "mass(300g)", "spring")
    told = run("simulate", *(word for text in known for word in ("--element", text)))
    assert "no value for pivot_sigma, pivot_alpha" in told.err
    known = ("dahl(100 mN, 30, name=pivot)", "mass(300g)", "spring(stiffness=1)")
    told = run("simulate", *(word for text in known for word in ("--element", text)), "--json")
    plant = di.Dahl(0.1, 30.0, name="pivot") + di.Mass(0.3) + di.Spring(1.0)
    assert json.loads(told.out)["plant"] == describe_model(plant)


@pytest.mark.parametrize("kind", [kind for kind, one in KINDS.items() if one.parameters])
def test_every_kind_can_be_typed(run, kind):
    assert " has no value for " in run("simulate", "--element", kind, "--levels", "1").err


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
def test_elements_that_do_not_exist_are_refused(run, text, message):
    assert message in run.refused("simulate", "--element", text)


def test_a_law_that_a_user_wrote_is_simulated_and_fitted(run):
    law, noise = f"{Jenkins.kind}(stiffness=30, slip=3mm)", ("--force-std", "0.01")
    made = run("simulate", "--element", law, "--levels", "1e-3:0.1:8", *noise, "-o", "t.csv")
    assert made.status == 0, made.err
    fit = json.loads(run("fit", "t.csv", "--element", Jenkins.kind, "--json").out)
    for name, truth in (("stiffness", 30.0), ("slip", 3e-3)):
        estimate = fit["params"][name]
        assert abs(estimate["value"] - truth) < 4.0 * estimate["stderr"]


def test_a_fit_is_told_on_few_lines_and_wrapped(run, monkeypatch):
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


def test_patterns_name_files(run, tmp_path):
    """Quoted patterns, which some shells pass on as they are."""
    for run_name in ("a", "b"):
        table().select(run=run_name).save(tmp_path / f"day_{run_name}.csv")
    assert "the data have a, b" in run.refused("fit", tmp_path / "day_*.csv", "--runs", "c")
    assert "no file matches this pattern" in run.refused("fit", tmp_path / "none*")

"""Every shipped data set through the whole chain: truth inside the intervals, or said why not.

Raw or table -> extract -> fit -> posterior. Flawed data must be caught by name: nothing may be
silently wrong.
"""

from typing import Any

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.data import FrequencyResponse
from dahl_ident.errors import FitError
from dahl_ident.extraction import extract
from tests.recovery import assert_near

PLANT = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
INSIDE = 0.9973


table: Any = di.load_dataset


def points(name):
    """Return the fundamentals that the extraction finds in a shipped recording."""
    return extract(table(name)).select(harmonic=1)


def truth(name):
    provenance = di.load_dataset(name).provenance
    return dict(provenance["truth"])


def assert_recovered(fit, true, *names):
    """Check that the profile intervals of `names` hold the truth."""
    intervals = fit.conf_interval("profile").at(INSIDE)
    for name in names:
        low, high = intervals[name].lower, intervals[name].upper
        assert low <= true[name] <= high, f"{name}: {true[name]} outside {low} to {high}"


def assert_posterior_holds(fit, true, *names):
    """Check that the posterior's central 99.73 % holds the truth."""
    posterior = di.posterior(fit, method="grid", tolerance=1e-2)
    for name in names:
        low, high = posterior.quantile(name, np.array([0.00135, 0.99865]))
        assert low <= true[name] <= high, f"{name}: {true[name]} outside {low} to {high}"


@pytest.mark.parametrize("name", ["noisy", "alpha_2"])
def test_tables_that_determine_everything(name):
    free = ["alpha"] if name == "alpha_2" else []
    fit = di.fit(table(name), di.Dahl(), free=free)
    assert fit.trusted, fit.verdict
    assert_recovered(fit, truth(name), *fit.var_names)
    assert_posterior_holds(fit, truth(name), *fit.var_names)


def test_clean():
    fit = di.fit(table("clean"), di.Dahl())
    assert fit.trusted, fit.verdict
    for name, value in truth("clean").items():
        assert fit.params[name].value == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("microslip", ("Only sigma is determined; not f_max.",
                       "no amplitude up to 6.7e-06 m reaches slip: drive above that")),
        ("gross_slip", ("Only f_max is determined; not sigma",)),
    ],
)  # fmt: skip
def test_what_is_only_bounded_below_is_said(name, words):
    fit = di.fit(table(name), di.Dahl())
    assert not fit.trusted
    assert fit.verdict.startswith("Not determined.")
    assert [text for text in words if text not in fit.verdict] == []
    assert_recovered(fit, truth(name), "f_max", "sigma")
    assert_posterior_holds(fit, truth(name), "f_max", "sigma")


def test_an_exponent_of_2_is_not_taken_for_linear_dahl():
    fit = di.fit(table("alpha_2"), di.Dahl(alpha=1.0))
    assert not fit.trusted
    assert "these data are not linear Dahl" in fit.verdict
    assert "alpha near 2.0" in str(fit.goodness)
    assert_near(di.fit(table("alpha_2"), di.Dahl()), {"alpha": 2.0}, 3.0)


def test_plant_of_figure_7():
    fit = di.fit(table("fig_7_plant"), PLANT)
    assert fit.trusted, fit.verdict
    assert_recovered(fit, truth("fig_7_plant"), *fit.var_names)


def test_levels_without_time_to_settle_are_caught():
    data = points("unsettled")
    assert "not settled" in " ".join(data.quality["verdict"])
    fit = di.fit(data, di.Dahl())
    assert not fit.trusted
    assert "The extraction flagged" in fit.verdict
    assert "not settled" in fit.verdict


def test_coarse_sensor_steps_are_caught_and_the_other_points_recover_the_truth():
    data = points("quantised")
    flagged = data.quality["verdict"] != "good"
    assert any("sensor steps" in verdict for verdict in data.quality["verdict"][flagged])
    everything = di.fit(data, di.Dahl())
    assert not everything.trusted
    assert "sensor steps" in everything.verdict
    fit = di.fit(data.select(rows=~flagged), di.Dahl())
    assert_recovered(fit, truth("quantised"), "f_max", "sigma")


def test_outliers_are_named_and_the_other_rows_recover_the_truth():
    data = table("outliers")
    rows = list(data.provenance["outlier_rows"])
    fit = di.fit(data, di.Dahl())
    assert not fit.trusted
    assert sorted(point.row for point in fit.goodness.suspicious) == rows
    rest = di.fit(data.select(rows=~np.isin(np.arange(data.n), rows)), di.Dahl())
    assert rest.trusted, rest.verdict
    assert_recovered(rest, truth("outliers"), "f_max", "sigma")
    robust = di.fit(data, di.Dahl(), loss="student_t")
    assert_near(robust, {name: truth("outliers")[name] for name in ("f_max", "sigma")}, 3.0)


def test_a_delayed_and_mis_scaled_sensor_is_caught():
    data, true = table("delayed"), truth("delayed")
    fit = di.fit(data, di.Dahl())
    assert not fit.trusted
    assert "which no rate-independent model can describe" in fit.verdict
    known_gain = di.Sensors(force_gain=true["force_gain"], delay=None)
    corrected = di.fit(data, di.Dahl(), sensors=known_gain)
    assert corrected.trusted, corrected.verdict
    assert_recovered(corrected, true, "f_max", "sigma", "delay")
    unknown = di.fit(data, di.Dahl(), sensors=di.Sensors(force_gain=None, delay=None), throw=False)
    assert not unknown.trusted


def test_friction_alone_that_a_drive_moves_without_bound_is_refused_with_what_to_add():
    data = table("fig_7_plant")
    few = data.select(rows=np.arange(data.n) % 4 == 0)
    for throw in (False, True):
        with pytest.raises(FitError, match=r"predict 0\.05 Hz, 150 mN.*add the mass, damper"):
            di.fit(few, di.Dahl(), throw=throw)


def test_degrees_of_freedom_without_bound_are_stated_alike_in_budget_and_intervals():
    two = table("noisy").select(rows=np.isin(np.arange(30), [5, 15]))  # noise as it is stated
    fit = di.fit(two, di.Dahl(alpha=1.0))
    assert fit.budget()["f_max"].dof == np.inf
    assert "normal distribution" in fit.conf_interval().note


def test_limits_in_the_verdict_are_those_at_the_parameters():
    fit = di.fit(table("microslip"), di.Dahl(), throw=False)
    limit = f"at least {fit.conf_interval()['f_max'][1].lower:.3g} N"
    assert fit.conf_interval("profile")["f_max"][1].lower > fit.conf_interval()["f_max"][1].lower
    assert f"f_max: {limit} (95.45 %), not determined" in fit.verdict
    assert limit in fit.fit_report()


def test_combinations_that_are_determined_have_the_uncertainty_of_their_budget():
    A = np.geomspace(1e-6, 1e-5, 12)
    exact = di.Dahl(0.1, 30.0).describing_function(A) + 100.0
    rng = np.random.default_rng(5)
    days = []
    for scatter in (-1, 0, 1):
        noise = np.exp(1e-4 * rng.standard_normal((12, 2)) @ [1, 1j])
        N = exact * (1.0 + 0.05 * scatter) * noise
        days.append(FrequencyResponse(np.ones(12), N, A, run=[f"day {scatter:+d}"] * 12))
    fit = di.fit(FrequencyResponse.concatenate(days), di.Dahl() + di.Spring(), throw=False)
    (combination, *_) = (c for c in fit.identifiability.combinations if "+" in c.name)
    stated = fit.budget()[combination.name]
    assert stated.u > 2.0 * stated.rows[-1].u
    assert (combination.value, combination.stderr) == (stated.value, stated.u)
    assert str(combination) in fit.verdict

"""Posteriors of records: their width, their priors, what they predict, and their chains on disk."""

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm, t

import dahl_ident as di
from dahl_ident.errors import ModelError, SamplingError, ValidationError
from tests.test_record_fit import DAHL, driven, recorded


def slow_noise(seed=0):
    """Return a record whose noise has a correlation of 0.95 from sample to sample."""
    clean = recorded(DAHL, "random", 500, 0.0)
    white = np.random.default_rng(seed).standard_normal(800)
    noise = 1e-3 * np.asarray(lfilter([1.0], [1.0, -0.95], white))[300:]
    return di.Record(clean.time, displacement=clean.displacement, force=clean.force_samples + noise)


def test_as_wide_as_the_error_bars_of_the_fit_where_residuals_are_correlated():
    fit = di.fit(slow_noise(), di.Dahl())
    found = di.posterior(fit, seed=1, steps=120, walkers=64)
    assert found.names == ("f_max", "sigma")
    for name in found.names:
        own, other = found.params[name].stderr or 0.0, fit.params[name].stderr or 0.0
        dof = fit.errors.least_dof  # the variance of Student's t is beyond its scale
        assert own == pytest.approx(other * (dof / (dof - 2.0)) ** 0.5, rel=0.08)
        assert own > 1.5 * _counted_as_independent(fit, name)
        assert abs(found.params[name].value - fit.params[name].value) < 0.3 * other


def _counted_as_independent(fit, name):
    """Return the standard error if every sample counted."""
    number = fit.var_names.index(name)
    J = fit.problem.predict(fit.optimum.values, 0).by
    covariance = np.linalg.inv(J.T @ J) * float(np.var(fit.residuals[0]))
    return float(covariance[number, number] ** 0.5)


def test_a_prior_of_a_fixed_exponent_needs_it_free():
    record, prior = recorded(DAHL, "random", 300, 1e-3), {"alpha": (0.5, 1.5)}
    with pytest.raises(ModelError, match=r"to estimate alpha, give free=\['alpha'\]"):
        di.posterior(record, di.Dahl(), method="grid", priors=prior)
    freed = di.posterior(
        record, di.Dahl(), method="grid", priors=prior, free=["alpha"], tolerance=0.03
    )
    assert freed.priors["alpha"] == "log-uniform from 0.5 to 1.5"


def test_outliers_are_left_to_the_intervals_of_a_robust_fit():
    record = recorded(DAHL, "random", 300, 1e-3)
    with pytest.raises(
        ValidationError, match="use the confidence intervals of a fit with a robust"
    ):
        di.posterior(record, di.Dahl(), likelihood="student_t")
    robust = di.fit(record, di.Dahl(), loss="student_t")
    with pytest.raises(ValidationError, match="use the fit's confidence intervals, or pass"):
        di.posterior(robust)
    assert robust.conf_interval()


@pytest.mark.parametrize("method", ["grid", "mcmc"])
def test_a_prior_that_excludes_the_data_is_refused_at_once(method):
    record, model = recorded(DAHL, "random", 300, 1e-3), di.Dahl(alpha=1.0)
    words = r"f_max is 0\.\d+, .* uncertainties outside its prior \(log-uniform from 1 to 2 N\)"
    with pytest.raises(SamplingError, match=words):
        di.posterior(record, model, method=method, priors={"f_max": (1.0, 2.0)})


def test_a_posterior_counts_noise_alone_or_the_stated_calibration():
    """By importance points, of which the width is that of the fit's covariance."""
    record, model = recorded(DAHL, "random", 300, 1e-3), di.Dahl(alpha=1.0)
    gain = di.Sensors(force_gain=norm(1.0, 0.05))
    fit = di.fit(record, model, sensors=gain)
    both = {
        kind: di.posterior(
            record, model, sensors=gain, method="grid", uncertainty=kind, tolerance=0.03
        )
        for kind in ("combined", "noise")
    }
    u = {kind: one.params["f_max"].stderr for kind, one in both.items()}
    assert u["combined"] == pytest.approx(fit.params["f_max"].stderr, rel=0.1)
    assert u["combined"] == pytest.approx(0.05 * 0.1, rel=0.1)
    assert u["noise"] == pytest.approx(fit.stderr_noise["f_max"], rel=0.1)
    assert "Noise alone is counted" in both["noise"].verdict


def test_priors_and_prediction():
    fit = di.fit(recorded(DAHL, "random", 300, 1e-3), di.Dahl())
    sigma = fit.params["sigma"]
    at = float(sigma.value) + 3.0 * sigma.stderr
    narrow = di.posterior(
        fit, priors={"sigma": norm(at, sigma.stderr or 0.0)}, seed=2, steps=100, walkers=64
    )
    shift = (narrow.params["sigma"].value - sigma.value) / sigma.stderr
    assert shift == pytest.approx(1.5, abs=0.15)  # half way: prior and data weigh the same
    other = recorded(DAHL, "multisine", 300, 1e-3)
    ours, theirs = narrow.predict(other, size=20), fit.predict(other)
    assert ours.rms_error < 1.5e-3
    assert np.mean((ours.measured > ours.lower) & (ours.measured < ours.upper)) > 0.9
    assert ours.stderr.max() < 1.5 * theirs.stderr.max()
    assert narrow.budget()["sigma"].u == pytest.approx(sigma.stderr)
    x_c = narrow.derived()[0]
    ratio = narrow.values[:, 0] / narrow.values[:, 1]  # of all draws: x_c is the mean of some
    assert x_c.value == pytest.approx(np.mean(ratio), abs=0.05 * float(np.std(ratio)))
    assert x_c.stderr == pytest.approx(float(np.std(ratio)), rel=0.05)


def test_a_stopped_chain_goes_on_as_if_it_had_not_been(tmp_path):
    fit = di.fit(recorded(DAHL, "random", 200, 1e-3), di.Dahl())
    place = tmp_path / "chain.h5"
    di.posterior(fit, seed=3, steps=60, walkers=32, resume=place)
    again = di.posterior(fit, seed=3, steps=120, walkers=32, resume=place)
    whole = di.posterior(fit, seed=3, steps=120, walkers=32)
    np.testing.assert_allclose(again.get_chain(), whole.get_chain(), rtol=1e-12)
    other = di.fit(recorded(DAHL, "random", 200, 1e-3, seed=1), di.Dahl())
    with pytest.raises(di.errors.SamplingError, match="chain of another run"):
        di.posterior(other, seed=3, steps=120, walkers=32, resume=place)


def test_command_line_and_report(run):
    recorded(DAHL, "random", 200, 1e-3).to_frame().to_csv("run.csv", index=False)
    words = ("sample", "run.csv", "--record", "--steps", "40", "--walkers", "64")
    done = run(*words, "--report", "run.json")
    assert done.status in (0, 3)  # too few steps to trust, perhaps
    assert "f_max" in done.out
    facts = json.loads(Path("run.json").read_text("utf-8"))
    schema = files("dahl_ident.reporting") / "report.schema.json"
    pytest.importorskip("jsonschema").validate(facts, json.loads(schema.read_text("utf-8")))
    assert facts["record_fits"][0]["parameters"]["sigma"]["value"] == pytest.approx(30.0, rel=0.05)
    assert len(facts["posteriors"]) == 1
    assert any(line.startswith("Posterior: Counted: ") for line in facts["verdict"])
    refused = run.refused(*words, "--likelihood", "student_t")
    assert "--likelihood is given with records" in refused


def test_data_that_the_model_misses_are_said():
    with_spring = recorded(DAHL + di.Spring(20.0), "random", 300, 1e-4)
    found = di.posterior(with_spring, di.Dahl(), seed=1, steps=200, walkers=32)
    assert found.status.value != "trusted"
    assert any(finding.code == "records_misfit" for finding in found.findings)
    assert "Counted: noise" in str(found)


def test_importance_points_of_a_plant_take_few_motions():
    """A record determines its parameters to first order nearly: the posterior is Student's t."""
    model = di.Dahl(alpha=1.0) + di.Mass(0.3) + di.Damper() + di.Spring(50.0)
    fit = di.fit(driven(1, 0.01, 400), model)
    grid = di.posterior(fit, method="grid")
    assert grid.converged
    assert grid.evaluations < 1000
    for name in grid.names:
        parameter, low, high = fit.params[name], *grid.quantile(name, np.array([0.16, 0.84]))
        half = t(fit.errors.least_dof).ppf(0.84) * parameter.stderr
        assert 0.5 * float(high - low) == pytest.approx(half, rel=0.03)
        assert 0.5 * float(high + low) == pytest.approx(parameter.value, abs=0.2 * half)

"""Harmonics of the displacement of driven plants, as rows of a table: X_k over the force."""

import functools
from dataclasses import replace

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.problem import TableProblem
from dahl_ident.synthetic import Experiment, SteppedSine, Table
from tests.derivatives import central_differences
from tests.friction_tables import driven, stated
from tests.recovery import assert_near

KNOWN = di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
FREE = di.Mass(0.3) + di.Damper() + di.Spring()
STEPS = SteppedSine(
    (0.05, 0.15, 0.4, 1.0), tuple(np.geomspace(0.4, 4.0, 6)), controlled="force"
)  # fmt: skip


def table(harmonics=(1, 3)):
    errors = Table(displacement_std=0.004, force_std=0.002, harmonics=harmonics)
    return di.simulate(Experiment(di.Dahl(0.1, 30.0) + KNOWN, STEPS, table=errors), seed=5)


def asymmetric():
    """Return rows of the mean, the fundamental and the second harmonic, with a covariance."""
    plant = di.Dahl(0.1, 30.0, asymmetry=0.2) + di.Mass(0.3) + di.Damper(0.24) + di.Spring(3.0)
    f, u = (g.ravel() for g in np.meshgrid(np.geomspace(0.4, 2.5, 3), [0.08, 0.2, 0.6]))
    X = di.response(plant, f, u).harmonics
    k = np.tile([0, 1, 2], f.size)
    row = np.repeat(np.arange(f.size), 3)
    R, size = X[row, k] / u[row], np.abs(X[row, 1]) / u[row]
    rng = np.random.default_rng(2)
    real, imag = 0.002 * size * rng.standard_normal((2, row.size))
    R = R + real + 1j * np.where(k == 0, 0.0, imag)
    covariance = stated(size, 0.002)
    covariance[k == 0, 1, 1] = 0.0
    data = driven(f[row], np.where(k == 0, R.real, R), u[row], harmonic=k)
    return replace(data, covariance=covariance)


@functools.cache
def fitted():
    return di.fit(table(), di.Dahl(alpha=1.0) + FREE)


def test_they_are_fitted_with_the_fundamental():
    fit = fitted()
    assert fit.status.usable, fit.verdict
    assert_near(fit, (("f_max", 0.1), ("sigma", 30.0), ("damping", 0.24), ("stiffness", 0.3)), 4.0)
    (third,) = fit.goodness.of("third harmonic")
    assert third.values["ratio"] == pytest.approx(1.0, abs=0.2)
    assert fit.plot_residuals() is not None
    assert fit.plot() is not None


def test_derivatives_are_differences():
    sensors = di.Sensors(force_gain=None, displacement_gain=1.02, delay=None)
    problem = TableProblem(table(), di.Dahl(alpha=1.0) + FREE, sensors=sensors)
    theta = problem.to_search([0.11, 28.0, 0.25, 0.33, 1.01, 1e-3])
    exact = problem.prediction_jacobian(theta)
    slopes = central_differences(problem.predict, theta, 1e-5).T
    assert np.all(np.abs(exact - slopes) < 1e-6 * np.abs(exact).max(axis=0))
    near = problem.near(theta)
    d = np.full(theta.size, 1e-3)
    apart = np.abs(near.predict(theta + d) - problem.predict(theta + d))
    assert apart.max() < 1e-5 * np.abs(problem.predict(theta)).max()


def test_means_and_second_harmonics_tell_the_asymmetry():
    fit = di.fit(asymmetric(), di.Dahl(alpha=1.0, asymmetry=None) + FREE)
    assert fit.status.usable, fit.verdict
    assert_near(fit, (("f_max", 0.1), ("sigma", 30.0), ("asymmetry", 0.2), ("stiffness", 3.0)), 4.0)


def test_files_keep_them(tmp_path):
    data = table()
    data.save(tmp_path / "rows.csv")
    again = di.read_frequency_response(tmp_path / "rows.csv")
    assert (again.quantity, again.harmonic.tolist()) == ("receptance", data.harmonic.tolist())
    np.testing.assert_allclose(again.response, data.response, rtol=1e-12)
    fit = fitted()
    fit.save(tmp_path / "fit.json")
    stored = di.FitResult.load(tmp_path / "fit.json")
    np.testing.assert_allclose(stored.best_fit, fit.best_fit, rtol=1e-9)


def test_a_describing_function_has_none():
    with pytest.raises(DataError, match=r"takes for a sine \(as asked for\): leave them out"):
        di.fit(table(), di.Dahl(alpha=1.0) + FREE, steady="describing function")
    with pytest.raises(DataError, match="the model has no mass"):
        di.fit(table(), di.Dahl(alpha=1.0) + di.Spring())


def test_rows_that_mean_nothing_are_refused():
    data = table()
    with pytest.raises(DataError, match="no row holds the fundamental of the same frequency"):
        di.fit(data.select(harmonic=3), di.Dahl(alpha=1.0) + FREE)
    with pytest.raises(ValidationError, match="harmonics of the force are rows of dynamic"):
        di.FrequencyResponse(
            [1.0], [1.0], drive=[1.0], harmonic=3, quantity="mobility", controlled="force"
        )
    with pytest.raises(ValidationError, match=r"take select\(harmonic=1\) first"):
        data.to("mobility")

"""Least squares against lmfit, curve_fit and general optimisers; coverage by simulation."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import lmfit
import numpy as np
import pytest
from scipy import integrate, optimize, stats

from dahl_ident import (
    Dahl,
    Damper,
    FrequencyResponse,
    Mass,
    Model,
    Parameter,
    Sensors,
    Spring,
    fit,
    response,
)
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import FitError, ModelError, ValidationError
from dahl_ident.fitting import Status, solve, solve_many
from dahl_ident.fitting.levenberg_marquardt import minimise
from dahl_ident.problem import ProblemBatch, Quadratic, TableProblem
from tests.friction_tables import driven, relative_noise

n = 20
A = np.geomspace(1e-4, 1e-1, n)
TRUE = Dahl(0.1, 30.0).describing_function(A)
RNG = np.random.default_rng(7)
ERROR = RNG.normal(size=n) + 1j * RNG.normal(size=n)
MEASURED = TRUE * np.exp(0.05 * ERROR)
LOSSES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "huber": lambda z: np.where(z < 1.345**2, z, 2.0 * 1.345 * np.sqrt(z) - 1.345**2),
    "soft_l1": lambda z: np.asarray(2.0 * (np.sqrt(1.0 + z) - 1.0)),
    "student_t": lambda z: np.asarray(6.0 * np.log1p(z / 4.0)),
}
COVARIANCE = np.abs(TRUE)[:, None, None] ** 2 * np.array([[2e-3, 1e-3], [1e-3, 4e-3]])


def table(response=MEASURED, **columns):
    return FrequencyResponse(np.ones(n), response, A, **columns)


def model(f_max, sigma):
    return Dahl(f_max, sigma).describing_function(A)


@pytest.mark.parametrize("noise", ["measured", "relative", "absolute"])
@pytest.mark.versions
def test_lmfit_finds_the_same_optimum_and_covariance(noise):
    problem = TableProblem(table(covariance=COVARIANCE), Dahl(), noise=noise)
    found = solve(problem)
    whitening = np.linalg.inv(np.linalg.cholesky(COVARIANCE))

    def rows(values):
        """Return whitened real and imaginary parts of values in the last axis."""
        parts = np.ascontiguousarray(values).view(np.float64).reshape(*values.shape, 2)
        if noise == "measured":
            parts = np.einsum("nij,...nj->...ni", whitening, parts)
        return np.asarray(parts.reshape(*values.shape[:-1], 2 * n))

    def residual(p):
        N = model(p["f_max"].value, p["sigma"].value)
        return rows(np.log(MEASURED / N) if noise == "relative" else MEASURED - N)

    def slopes(p):
        pivot = Dahl(p["f_max"].value, p["sigma"].value)
        by = np.array([pivot.gradient(A)[name] for name in ("f_max", "sigma")])
        return rows(-by / pivot.describing_function(A) if noise == "relative" else -by).T

    start = lmfit.Parameters()
    start.add("f_max", 0.1)
    start.add("sigma", 30.0)
    settings: dict[str, Any] = {"ftol": 1e-15, "xtol": 1e-15, "Dfun": slopes}
    settings["scale_covar"] = noise != "measured"
    # once more from the optimum, because MINPACK's covariance is that before the last step
    peer = lmfit.minimize(residual, lmfit.minimize(residual, start, **settings).params, **settings)
    values = [peer.params["f_max"].value, peer.params["sigma"].value]
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.values, values, rtol=1e-6)
    spread = np.sqrt(np.diagonal(peer.covar))
    off = np.abs(found.values_covariance - peer.covar)
    assert np.all(off < 1e-6 * np.outer(spread, spread))
    assert 2.0 * found.cost == pytest.approx(peer.chisqr, rel=1e-9)
    assert found.dof == 2 * n - 2
    if noise == "measured":
        assert found.scale == 1.0
        assert found.scale_known
    else:
        assert found.scale**2 == pytest.approx(peer.redchi, rel=1e-9)


@pytest.mark.versions
def test_a_driven_plant_is_recovered_from_every_quantity():
    true = np.array([0.1, 30.0, 0.3, 0.24, 0.3])
    plant = Dahl(0.1, 30.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)
    drive = np.repeat(np.geomspace(1e-3, 1.0, 5), 12)
    f = np.tile(np.geomspace(0.1, 10.0, 12), 5)
    R = response(plant, f, drive).receptance
    noise = np.exp(0.01 * (RNG.normal(size=60) + 1j * RNG.normal(size=60)))
    free = Dahl() + Mass() + Damper() + Spring()
    expected = None
    for quantity, factor in (("receptance", 1.0), ("accelerance", (2j * np.pi * f) ** 2)):
        receptance = driven(f, R * noise * factor, drive)
        data = replace(receptance, quantity=quantity)  # type: ignore[arg-type]
        found = solve(TableProblem(data, free))
        assert found.success
        z = (found.values - true) / list(found.stderr.values())
        assert np.all(np.abs(z) < 4.0)
        if expected is not None:  # relative noise does not care for the quantity
            np.testing.assert_allclose(found.values, expected, rtol=1e-7)
        expected = found.values


@pytest.mark.parametrize("exponent", [-30, 30])
@pytest.mark.versions
def test_units_do_not_matter(exponent):
    here = solve(TableProblem(table(), Dahl()))
    a = 10.0**exponent
    there = solve(TableProblem(FrequencyResponse(np.ones(n), MEASURED / a**2, A * a), Dahl()))
    np.testing.assert_allclose(there.values, here.values * [1.0 / a, 1.0 / a**2], rtol=1e-9)
    np.testing.assert_allclose(there.covariance, here.covariance, rtol=1e-6)


def test_a_parameter_at_its_bound_is_named():
    f_max = Parameter("f_max", "N", "friction limit", lower=0.0, upper=0.08, transform="log")
    found = solve(TableProblem(table(), Model(Dahl()).with_parameters({"f_max": f_max})))
    assert found.status is Status.AT_BOUND
    assert found.success
    assert found.values[0] == pytest.approx(0.08, rel=1e-7)
    assert "At its bound: f_max = 0.08." in found.message
    held = solve(TableProblem(table(), Dahl(), fixed={"f_max": 0.08}))
    assert found.values[1] == pytest.approx(held.values[0], rel=1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_robust_losses_stay_with_the_bulk(loss):
    spoiled = MEASURED.copy()
    spoiled[[3, 12]] *= [8.0, 0.2j]
    problem = TableProblem(table(spoiled), Dahl())
    clean, robust = solve(TableProblem(table(), Dahl())), solve(problem, loss=loss)
    assert robust.status is Status.CONVERGED
    assert robust.loss == loss
    off = np.abs(robust.theta - clean.theta)
    assert np.all(off / np.sqrt(np.diagonal(robust.covariance)) < 2.0)
    assert np.abs(solve(problem).theta - clean.theta).max() > 3.0 * off.max()
    # the cost is at its minimum for the scale found

    def cost(theta):
        y = problem.residuals(theta).view(np.complex128)
        return 0.5 * float(LOSSES[loss](np.abs(y / robust.scale) ** 2).sum())

    general = optimize.minimize(cost, robust.theta + 0.01, method="Nelder-Mead", tol=1e-10)
    np.testing.assert_allclose(robust.theta, general.x, atol=2e-5)
    assert robust.cost == pytest.approx(general.fun * robust.scale**2, rel=1e-8)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("factor", [pytest.param(1e9, marks=pytest.mark.long), 1e12])
@pytest.mark.parametrize("row", [7, -1])
def test_a_robust_estimate_does_not_depend_on_how_far_off_a_row_is(loss, factor, row):
    """Its pull is bounded, also where its cost is so large that the others' is rounding."""
    near, far = MEASURED.copy(), MEASURED.copy()
    near[row] *= 1e5
    far[row] *= factor
    expected, found = (
        solve(TableProblem(table(N), Dahl(), noise="absolute"), loss=loss) for N in (near, far)
    )
    assert found.status is expected.status is Status.CONVERGED
    error = np.sqrt(np.diagonal(expected.covariance))
    assert np.all(np.abs(found.theta - expected.theta) < 0.01 * error)
    assert found.scale == pytest.approx(expected.scale, rel=1e-3)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_likelihood_of_a_robust_fit_is_that_of_its_density(loss):
    measured = MEASURED * np.where(np.arange(n) == 3, 1.5, 1.0)
    found = fit(table(measured, covariance=COVARIANCE), Dahl(alpha=1.0), loss=loss, throw=False)
    predicted = Dahl(*found.optimum.values).describing_function(A)
    error = np.stack([(measured - predicted).real, (measured - predicted).imag], axis=-1)
    z = np.einsum("ni,nij,nj->n", error, np.linalg.inv(COVARIANCE), error)
    area, _ = integrate.quad(
        lambda r: 2.0 * np.pi * r * np.exp(-0.5 * LOSSES[loss](r * r)), 0.0, np.inf
    )
    size = 0.5 * np.linalg.slogdet(COVARIANCE)[1]
    expected = np.sum(-0.5 * LOSSES[loss](z) - np.log(area) - size)
    assert found.log_likelihood == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize(
    "loss",
    ["student_t", *(pytest.param(one, marks=pytest.mark.long) for one in ("huber", "soft_l1"))],
)
def test_robust_intervals_and_scale_hold_for_gaussian_noise(loss):
    rng, z, scales = np.random.default_rng(1), [], []
    for _ in range(30):
        error = rng.normal(size=n) + 1j * rng.normal(size=n)
        found = solve(TableProblem(table(TRUE * np.exp(0.05 * error)), Dahl()), loss=loss)
        z.append((found.theta - np.log([0.1, 30.0])) / np.sqrt(np.diagonal(found.covariance)))
        scales.append(found.scale)
    assert np.abs(np.std(z, axis=0) - 1.0).max() < 0.36  # of 30: more come once in 200 times
    assert np.mean(scales) == pytest.approx(0.05, rel=0.05)


@pytest.mark.versions
@pytest.mark.parametrize("covariance", [COVARIANCE, None], ids=["known scale", "unknown scale"])
def test_a_prior_joins_data(covariance):
    data, prior = table(covariance=covariance), stats.norm(1.0, 0.03)
    exact = solve(TableProblem(data, Dahl()))
    found = solve(TableProblem(data, Dahl(), sensors=Sensors(force_gain=prior)))
    # a force gain scales f_max and sigma alike, so its variance adds to both logarithms
    np.testing.assert_allclose(found.theta, [*exact.theta, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.covariance[:2, :2], exact.covariance + 0.03**2, rtol=1e-3)
    assert found.scale == pytest.approx(exact.scale, rel=1e-6)
    assert found.dof == 2 * n + 1 - 3


def test_what_cannot_be_told_apart_is_singular():
    found = solve(TableProblem(table(), Dahl(), sensors=Sensors(force_gain=None)))
    assert found.status is Status.SINGULAR
    assert not found.success
    assert "Involved: f_max, sigma, force_gain." in found.message
    assert found.stderr["f_max"] == np.inf
    known = solve(TableProblem(table(), Dahl())).theta  # of their ratio
    assert np.diff(found.theta[:2]) == pytest.approx(np.diff(known), abs=1e-6)


def test_stated_intervals_cover_with_relative_noise_of_ten_percent():
    rng, tables = np.random.default_rng(21), 2000
    points = np.geomspace(1e-3, 1e-2, 8)
    N = Dahl(0.1, 30.0).describing_function(points)
    problem = TableProblem(FrequencyResponse(np.ones(8), N, points), Dahl())
    error = rng.normal(size=(tables, 8)) + 1j * rng.normal(size=(tables, 8))
    found = solve_many(ProblemBatch.replicates(problem, N * np.exp(0.1 * error)))
    assert found.success.all()
    off = np.abs(found.theta - np.log([0.1, 30.0]))
    for level in (0.6827, 0.9545):
        half = stats.t(14).ppf(0.5 + level / 2.0)
        spread = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        covered = np.mean(off < half * spread, axis=0)
        assert np.all(np.abs(covered - level) < 4.0 * np.sqrt(level * (1.0 - level) / tables))


def test_a_start_is_completed_and_checked():
    problem = TableProblem(table(), Dahl())
    with pytest.raises(ModelError, match="start names mass; the free parameters are f_max, sigma"):
        solve(problem, start={"mass": 1.0})
    begun = solve(problem, start={"f_max": 5.0})
    np.testing.assert_allclose(begun.values, solve(problem).values, rtol=1e-6)


def test_too_little_data_are_refused():
    data = FrequencyResponse([1.0], [1.0 + 1.0j], [1.0])
    with pytest.raises(FitError, match="1 row, give 2 numbers, fewer than the 3 free parameters"):
        solve(TableProblem(data, Dahl() + Spring()))
    with pytest.raises(ValidationError, match="loss is 'cauchy'; expected linear, huber"):
        solve(TableProblem(data, Dahl()), loss="cauchy")


def test_as_many_numbers_as_parameters_leave_no_scale():
    data = FrequencyResponse([1.0], [20.0 + 10.0j], [1e-2])
    found = solve(TableProblem(data, Dahl()))
    assert found.dof == 0
    assert np.isnan(found.scale)
    assert np.isinf(np.diagonal(found.covariance)).all()
    assert np.abs(found.residuals).max() < 1e-9


@pytest.mark.parametrize("noise", ["relative", "absolute"])
@pytest.mark.parametrize("loss", ["linear", *LOSSES])
@pytest.mark.parametrize("copies", [1, pytest.param(2, marks=pytest.mark.long)])
def test_data_without_noise_are_met_to_rounding(noise, loss, copies):
    """Rounding errors are not noise: they repeat, and standard errors cannot be smaller."""
    amplitude = np.tile(np.geomspace(1e-3, 1e-1, 30), copies)
    N = Dahl(0.1, 30.0).describing_function(amplitude)
    found = fit(FrequencyResponse(np.ones(N.size), N, amplitude), Dahl(), noise=noise, loss=loss)
    assert found.optimum.is_exact
    size = 1.0 if noise == "relative" else np.sqrt(np.mean(np.abs(N) ** 2))
    assert found.scale == pytest.approx(2.0**-46 * size, rel=1e-3)
    for name, truth in (("f_max", 0.1), ("sigma", 30.0)):
        estimate = found.params[name]
        assert abs(estimate.value - truth) < 2.0 * estimate.stderr < 1e-13 * truth
    assert found.trusted, found.verdict
    assert "the limit of rounding" in found.fit_report()


def test_an_outlier_among_exact_data_is_no_rounding():
    amplitude = np.geomspace(1e-3, 1e-1, 30)
    N = Dahl(0.1, 30.0).describing_function(amplitude)
    N[4] *= 2.0
    data = FrequencyResponse(np.ones(30), N, amplitude)
    assert not fit(data, Dahl()).optimum.is_exact
    robust = fit(data, Dahl(), loss="student_t")
    assert robust.optimum.is_exact
    assert [point.row for point in robust.goodness.suspicious] == [4]


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("noise", ["relative", "absolute"])
@pytest.mark.parametrize("factor", [1e-9, 0.1, 1e3])
def test_one_wrong_row_does_not_even_rule_the_start(loss, noise, factor):
    rng = np.random.default_rng(0)
    error = 0.02 * (rng.normal(size=n) + 1j * rng.normal(size=n))
    N = Dahl(0.1, 30.0).describing_function(A) * np.exp(error)
    for row in (0, 7, n - 1):
        R = N.copy()
        R[row] *= factor
        found = fit(FrequencyResponse(np.ones(n), R, A), Dahl(), noise=noise, loss=loss)
        np.testing.assert_allclose(found.optimum.values, [0.1, 30.0], rtol=0.06)


ODD_RESPONSES: dict[str, ComplexArray] = {
    "negative loss": Dahl(0.1, 30.0).describing_function(A).conj(),
    "negative": -Dahl(0.1, 30.0).describing_function(A),
    "no loss": np.full(n, 3.0 + 0j),
    "loss alone": np.full(n, 3.0j),
}
RARE_RESPONSES: dict[str, ComplexArray] = {
    "mostly nothing": np.where(np.arange(n) < 5, 1.0 + 1.0j, 0.0),
    "noise alone": np.random.default_rng(3).normal(size=2 * n).view(np.complex128),
}


@pytest.mark.parametrize(
    "model", [Dahl(), pytest.param(Dahl() + Spring(), marks=pytest.mark.long)], ids=repr
)
@pytest.mark.parametrize(
    "R",
    [
        *(pytest.param(R, id=name) for name, R in ODD_RESPONSES.items()),
        *(pytest.param(R, id=name, marks=pytest.mark.long) for name, R in RARE_RESPONSES.items()),
    ],
)
def test_whatever_is_measured_ends_in_words_and_is_not_trusted(R, model):
    found = fit(table(R), model, noise="absolute", throw=False)
    assert not found.trusted
    assert f"    {found.status.capitalize()}. " in found.fit_report()
    assert not np.isnan(found.optimum.values).any()


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("loss", ["linear", "huber"])
def test_three_rows_of_two_runs_end_in_words(noise, loss):
    few = np.array([1e-3, 2e-2, 1e-2]) if noise else np.full(3, 5e-3)
    data = FrequencyResponse(
        np.ones(3), Dahl(0.1, 30.0).describing_function(few) * relative_noise(3, noise, 1), few,
        run=["a", "b", "b"],
    )  # fmt: skip
    found = fit(data, Dahl(alpha=1.0) + Spring() + Damper(), loss=loss, throw=False)
    assert not found.trusted
    assert f"    {found.status.capitalize()}. " in str(found)


ODD_SEEDS = (17, 28, 79, 108, 163, 191)


@pytest.mark.parametrize(
    "seed", [*ODD_SEEDS, *(pytest.param(k, marks=pytest.mark.long) for k in range(200, 300))]
)
def test_a_few_odd_rows_end_in_words(seed):
    """Fewer rows than the model needs, of any noise, some of them with runs or a covariance."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, 5))
    few = np.exp(rng.uniform(np.log(1e-4), np.log(1e-1), size))
    noise = rng.choice([1e-3, 0.03, 0.5])
    data = FrequencyResponse(
        np.ones(size), Dahl(0.1, 30.0).describing_function(few) * relative_noise(size, noise, seed),
        few, run=rng.choice(["a", "b"], size) if rng.random() < 0.5 else None,
        covariance=np.tile(1e-2 * np.eye(2), (size, 1, 1)) if rng.random() < 0.5 else None,
    )  # fmt: skip
    law = Dahl(alpha=1.0)
    models = (law + Damper(), law + Mass(), law + Spring(), law + Spring() + Damper())
    model = models[rng.integers(4)]
    if 2 * size < len(model.parameters) - 1:
        return
    found = fit(data, model, loss=rng.choice(["linear", "huber"]), throw=False)
    assert f"    {found.status.capitalize()}. " in str(found)
    with suppress(FitError):  # nothing is determined
        assert str(found.budget())


def test_columns_alike_to_rounding_end_no_search():
    """A Hessian of two columns whose cosine exceeds 1 by the first damping: exactly singular."""
    hessian = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(hessian + 1e-9 * np.eye(2), np.ones(2))

    def evaluate(theta, which):
        gradient = np.repeat(theta.sum(axis=1, keepdims=True), 2, axis=1)
        cost = 0.5 * theta.sum(axis=1) ** 2
        return Quadratic(cost, gradient, np.broadcast_to(hessian, (len(theta), 2, 2)).copy())

    found = minimise(evaluate, np.array([[1.0, 2.0]]), np.zeros(2, dtype=np.bool_), 4)
    assert found.cost[0] < 1e-12

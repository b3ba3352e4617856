"""Noise models: residuals and densities against scipy.stats and brute force."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from dahl_ident import Dahl, FrequencyResponse
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.rows import Rows
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.fitting import solve_many
from dahl_ident.noise import Measured, Student, bend, noise_for
from dahl_ident.problem import ProblemBatch, TableProblem

n = 8
A = np.geomspace(1e-4, 1e-1, n)
TRUE = Dahl(0.1, 30.0).describing_function(A)
RNG = np.random.default_rng(5)
MEASURED = TRUE * np.exp(0.05 * (RNG.normal(size=n) + 1j * RNG.normal(size=n)))
COVARIANCE = np.abs(TRUE)[:, None, None] ** 2 * np.array([[4e-4, 1e-4], [1e-4, 9e-4]])


def table(response=MEASURED, **columns):
    return FrequencyResponse(np.ones(n), response, A, **columns)


def pairs(z):
    return np.stack([z.real, z.imag], axis=-1)


def test_relative_noise_has_constant_variance_of_ln_gain_and_phase():
    problem = TableProblem(table(), Dahl())
    assert problem.noise == "relative"
    theta = problem.to_search([0.12, 25.0])
    model = Dahl(0.12, 25.0).describing_function(A)
    expected = np.stack(
        [np.log(np.abs(MEASURED) / np.abs(model)), np.angle(MEASURED) - np.angle(model)], axis=-1
    )
    np.testing.assert_allclose(problem.residuals(theta), expected.ravel(), atol=1e-14)
    # the density of (Re, Im) is that of (ln gain, phase) over gain^2
    density = stats.norm(0.0, 0.07).logpdf(expected).sum() - 2.0 * np.log(np.abs(MEASURED)).sum()
    assert problem.log_likelihood(theta, 0.07) == pytest.approx(density, rel=1e-12)


def test_absolute_noise_has_constant_variance_in_the_datas_quantity():
    problem = TableProblem(table(), Dahl(), noise="absolute")
    theta = problem.to_search([0.12, 25.0])
    expected = pairs(MEASURED - Dahl(0.12, 25.0).describing_function(A))
    np.testing.assert_allclose(problem.residuals(theta), expected.ravel(), rtol=1e-12)
    density = stats.norm(0.0, 0.5).logpdf(expected).sum()
    assert problem.log_likelihood(theta, 0.5) == pytest.approx(density, rel=1e-12)


def test_measured_noise_has_the_datas_covariance():
    problem = TableProblem(table(covariance=COVARIANCE), Dahl())
    assert problem.noise == "measured"
    assert problem.scale_known
    theta = problem.to_search([0.12, 25.0])
    r = pairs(MEASURED - Dahl(0.12, 25.0).describing_function(A))
    each = [stats.multivariate_normal(cov=C).logpdf(x) for x, C in zip(r, COVARIANCE, strict=True)]
    assert problem.log_likelihood(theta) == pytest.approx(np.sum(each), rel=1e-12)
    squares = np.einsum("ni,nij,nj->", r, np.linalg.inv(COVARIANCE), r)
    assert np.sum(problem.residuals(theta) ** 2) == pytest.approx(squares, rel=1e-12)


def test_few_degrees_of_freedom_count_less_the_farther_a_row_lies():
    dof = np.array([3.0, 4.0, 6.0, 9.0, 20.0, 50.0, np.inf, np.inf])
    problem = TableProblem(table(covariance=COVARIANCE, dof=dof), Dahl())
    gaussian = TableProblem(table(covariance=COVARIANCE), Dahl())
    theta = problem.to_search([0.12, 25.0])
    z = np.sum(gaussian.residuals(theta).reshape(n, 2) ** 2, axis=1)
    loss = np.append((dof[:6] - 2.0) * np.log1p(z[:6] / dof[:6]), z[6:])
    assert np.sum(problem.residuals(theta) ** 2) == pytest.approx(loss.sum(), rel=1e-9)
    # least squares on the residuals is maximum likelihood
    rise = problem.log_likelihood(theta) - gaussian.log_likelihood(theta)
    assert rise == pytest.approx(0.5 * np.sum(z - loss), rel=1e-9)


def test_stated_covariances_with_few_degrees_of_freedom_hold():
    """600 experiments whose covariances were estimated from 6 degrees of freedom each."""
    rng, dof, tables = np.random.default_rng(11), 6, []
    factor = np.linalg.cholesky(COVARIANCE)
    for _ in range(600):
        noise = np.einsum("nij,njk->nki", factor, rng.normal(size=(n, 2, dof + 1)))
        estimated = np.einsum("nki,nkj->nij", noise[:, 1:], noise[:, 1:]) / dof
        response = TRUE + noise[:, 0] @ np.array([1.0, 1.0j])
        tables.append(table(response, covariance=estimated, dof=float(dof)))
    batch = ProblemBatch(tables, Dahl())
    found = solve_many(batch)
    z = (found.theta - np.log([0.1, 30.0])) / np.sqrt(
        np.diagonal(found.covariance, axis1=1, axis2=2)
    )
    assert np.all(np.abs(z.std(axis=0) - 1.0) < 0.12)  # taking them as known gives 1.8
    # the likelihood ratio at the truth is chi-square of two degrees of freedom
    truth = np.broadcast_to(np.log([0.1, 30.0]), (600, 2))
    ratio = 2.0 * (batch.quadratic(truth).cost - found.cost)
    covered = np.mean(ratio < stats.chi2(2).ppf(0.95))
    assert abs(covered - 0.95) < 3.0 * np.sqrt(0.95 * 0.05 / 600)


@pytest.mark.parametrize("rounding", [0.0, 1e-8])
def test_few_predictions_find_the_true_amplitudes(rounding):
    """Also where a law is only known to some digits, as from an integration."""
    rng, calls = np.random.default_rng(0), 0

    class Rounded(Dahl):
        def settled(self, values, sine, derivatives):
            nonlocal calls
            calls += 1
            exact = super().settled(values, sine, derivatives)
            return exact._replace(value=exact.value * (1.0 + rounding * rng.standard_normal(n)))

    data = table(covariance=COVARIANCE, amplitude_std=0.05 * A)
    problem, exact = (TableProblem(data, law) for law in (Rounded(alpha=1.0), Dahl(alpha=1.0)))
    theta = problem.to_search([0.12, 25.0])
    calls = 0
    found = problem.residuals(theta)
    assert calls <= 8
    assert found == pytest.approx(exact.residuals(theta), rel=1e-5, abs=1e-5)


def test_amplitude_errors_are_profiled_out():
    s = 0.08
    cross = 0.5 * s * A[:, None] * np.sqrt(np.diagonal(COVARIANCE, axis1=1, axis2=2))
    data = table(covariance=COVARIANCE, amplitude_std=s * A, amplitude_covariance=cross)
    problem = TableProblem(data, Dahl())
    theta = problem.to_search([0.12, 25.0])
    total = 0.0
    for row in range(n):
        joint = np.empty((3, 3))
        joint[0, 0], joint[1:, 1:] = s**2, COVARIANCE[row]
        joint[0, 1:] = joint[1:, 0] = cross[row] / A[row]
        inverse: FloatArray = np.asarray(np.linalg.inv(joint), dtype=np.float64)

        def chi_square(error, row=row, inverse=inverse):
            N = Dahl(0.12, 25.0).describing_function(A[row] * np.exp(-error))
            r = MEASURED[row] - N
            e = np.array([error, r.real, r.imag])
            return float(e @ inverse @ e)

        total += optimize.minimize_scalar(chi_square, bounds=(-1.0, 1.0), method="bounded").fun
    assert np.sum(problem.residuals(theta) ** 2) == pytest.approx(total, rel=1e-7)
    # its gradient is exact although weights and amplitudes move with the parameters
    step = 1e-5 * np.eye(2)
    slope = [
        (np.sum(problem.residuals(theta + h) ** 2) - np.sum(problem.residuals(theta - h) ** 2))
        / 4e-5
        for h in step
    ]
    r, J = problem.residuals_and_jacobian(theta)
    np.testing.assert_allclose(J.T @ r, slope, rtol=1e-7)


def test_amplitude_errors_do_not_flatten_the_curve():
    """Averaged over 400 tables; taking noisy amplitudes as exact misses sigma by 20 deviations."""
    rng, s = np.random.default_rng(3), 0.3
    true_A = np.geomspace(1e-3, 1e-2, n)
    N = Dahl(0.1, 30.0).describing_function(true_A)
    C = np.abs(N)[:, None, None] ** 2 * 0.01**2 * np.eye(2)
    noisy = []
    for _ in range(400):
        measured = true_A * np.exp(s * rng.normal(size=n))
        response = N + 0.01 * np.abs(N) * (rng.normal(size=n) + 1j * rng.normal(size=n))
        noisy.append((measured, response))
    known = [
        FrequencyResponse(np.ones(n), R, m, covariance=C, amplitude_std=s * m) for m, R in noisy
    ]
    ignored = [FrequencyResponse(np.ones(n), R, m, covariance=C) for m, R in noisy]
    bias = []
    for tables in (known, ignored):
        theta = solve_many(ProblemBatch(tables, Dahl())).theta - np.log([0.1, 30.0])
        bias.append(np.abs(theta.mean(axis=0)) / (theta.std(axis=0) / np.sqrt(400)))
    assert np.all(bias[0] < 4.0)
    assert bias[1][1] > 12.0


def test_harmonics_refer_to_the_measured_fundamental():
    pivot = Dahl(0.1, 30.0)
    both = [pivot.dynamic_stiffness(0.01, harmonic=k) for k in (1, 3)]
    data = FrequencyResponse(np.ones(2), np.multiply(both, 1.1), [0.01, 0.01], harmonic=[1, 3])
    problem = TableProblem(data, Dahl())
    r = problem.residuals(problem.to_search([0.1, 30.0])).view(np.complex128)
    assert r[0] == pytest.approx(np.log(1.1))
    assert r[1] == pytest.approx(0.1 * both[1] / (1.1 * np.abs(both[0])))


def test_bend_keeps_direction_and_squares_to_the_loss():
    y = np.array([0.0, 1e-9, 0.5 + 1j, 30.0 - 40.0j])
    rho = Student(np.array(5.0))
    bent = bend(y.view(np.float64)[None], 2 * y.size, rho)[0].view(np.complex128)
    z = np.abs(y) ** 2
    np.testing.assert_allclose(np.abs(bent) ** 2, rho(z)[0], rtol=1e-12)
    np.testing.assert_allclose(np.angle(bent), np.angle(y), atol=1e-14)


TWO_POINTS = FrequencyResponse(
    [1.0, 1.0, 1.0, 1.0],
    [3.0 + 4.0j, 0.2 - 0.1j, 6.0 + 8.0j, 0.5j],
    [0.01, 0.01, 0.02, 0.02],
    harmonic=[1, 3, 1, 3],
)


def test_weights_and_density_of_harmonics_are_those_of_their_own_fundamental():
    noise = noise_for(Rows.of(TWO_POINTS), "relative")
    np.testing.assert_allclose(noise.weights, [0.2, 0.2, 0.1, 0.1])
    assert noise.log_area == pytest.approx(-4.0 * np.log(5.0 * 10.0))
    np.testing.assert_allclose(noise_for(Rows.of(table()), None).weights, 1.0 / np.abs(MEASURED))


@pytest.mark.parametrize("kind", ["relative", "absolute", "measured"])
def test_replicates_have_the_residuals_that_were_asked_for(kind):
    covariance = np.array([[0.5, 0.3], [0.3, 2.0]]) * np.array([1.0, 2.0, 3.0, 4.0])[:, None, None]
    rows = Rows.of(replace(TWO_POINTS, covariance=covariance))
    predicted = rows.response * (1.1 + 0.1j)
    y = np.array([0.1 - 0.2j, 0.3 + 0.4j, -0.2j, 0.5])
    measured = noise_for(rows, kind).replicate(predicted, y)
    again = Rows.of(replace(TWO_POINTS, response=measured, covariance=covariance))
    if kind == "relative":  # a residual refers to the fundamental that was measured
        size = np.abs(rows.response[[0, 2]] / measured[[0, 2]])
        y[[1, 3]] *= size
    np.testing.assert_allclose(noise_for(again, kind).residual(predicted), y, rtol=1e-12)


def test_weights_of_a_covariance_count_the_parts_that_have_one():
    covariance = [[[0.5, 0.0], [0.0, 1.5]], [[0.25, 0.0], [0.0, 0.0]]]
    mean = FrequencyResponse([1.0, 1.0], [1 + 1j, 0.5], [1.0, 1.0], covariance=covariance,
                             harmonic=[1, 0], dof=6.0)  # fmt: skip
    noise = noise_for(Rows.of(mean), None)
    assert isinstance(noise, Measured)
    np.testing.assert_allclose(noise.weights, [1.0, 2.0])
    z = np.array([3.0, 3.0])
    np.testing.assert_allclose(noise.tail(z)[0], np.array([4.0, 5.0]) * np.log(1.5))


@pytest.mark.parametrize("kind", ["relative", "absolute"])
def test_residuals_of_harmonics_have_their_own_derivatives(kind):
    noise, h = noise_for(Rows.of(TWO_POINTS), kind), 1e-6
    predicted, by = TWO_POINTS.response * (1.1 + 0.1j), np.array([1.0, -2.0j, 3.0 + 1.0j, 0.5])
    up, down = (noise.residual(predicted + s * h * by) for s in (1.0, -1.0))
    np.testing.assert_allclose(noise.change(predicted, by), (up - down) / (2.0 * h), rtol=1e-8)


def test_losses_have_their_own_derivatives():
    rho, z, h = Student(np.array(5.0)), np.array([0.3, 2.0, 40.0]), 1e-5
    loss, slope, curvature = rho(z)
    np.testing.assert_allclose(loss, 3.0 * np.log(1.0 + z / 5.0), rtol=1e-14)
    np.testing.assert_allclose(slope, (rho(z + h)[0] - rho(z - h)[0]) / (2.0 * h), rtol=1e-7)
    np.testing.assert_allclose(curvature, (rho(z + h)[1] - rho(z - h)[1]) / (2.0 * h), rtol=1e-7)
    y: ComplexArray = np.array([0.3 - 0.2j, 3.0 + 4.0j])
    d: ComplexArray = np.array([1.0 + 2.0j, -0.5j])
    at: list[ComplexArray] = [y, np.add(y, h * d), np.subtract(y, h * d)]
    exact, up, down = (bend(np.array([one, d]).view(np.float64), 4, rho) for one in at)
    np.testing.assert_allclose(exact[1], (up - down)[0] / (2.0 * h), rtol=1e-7)


@pytest.mark.parametrize(
    ("columns", "noise", "message"),
    [
        ({}, "measured", "needs a covariance, and the data have none"),
        ({"covariance": COVARIANCE * 0.0}, None, r"covariance\[0\] is singular"),
        ({"covariance": COVARIANCE, "dof": 2.0}, None, r"dof\[0\] is 2; .* more than 2 degrees"),
        ({"response": TRUE * (A < 0.05)}, None, r"response\[7\] is 0, which has no logarithm"),
        ({"harmonic": [1] * 7 + [3]}, None, r"row \[7\] is a harmonic, but no row holds"),
    ],
)
def test_data_that_the_noise_model_cannot_weigh(columns, noise, message):
    with pytest.raises(DataError, match=message):
        TableProblem(table(**columns), Dahl(), noise=noise)


def test_an_unknown_noise_model_is_named():
    with pytest.raises(ValidationError, match="noise is 'white'; expected one of measured"):
        TableProblem(table(), Dahl(), noise="white")

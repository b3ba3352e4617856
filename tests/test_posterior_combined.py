"""Posteriors that count every source of error: against matrices, Student's t, and the truth."""

import numpy as np
import pytest

import dahl_ident as di
from benchmarks.uncertainty import several_days
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.priors import joint_prior
from dahl_ident.diagnostics.contributions import NOISE, TESTS
from dahl_ident.diagnostics.error_model import row_errors
from dahl_ident.errors import SamplingError, ValidationError
from tests.bayes_cases import friction_table
from tests.friction_tables import relative_noise

LINEAR = di.Dahl(alpha=1.0)
Q = (0.02275, 0.97725)


def days(seed, rows=1):
    data, _ = several_days("f_max", 0.02)(np.random.default_rng(seed))
    return di.FrequencyResponse.concatenate([data] * rows) if rows > 1 else data


@pytest.mark.parametrize("rows", [1, 3])
def test_the_likelihood_is_that_of_the_covariance_by_source(rows):
    """Of 36 rows, and of 108; with each size of the errors, near the estimate."""
    fit = di.fit(days(3, rows), LINEAR)
    errors = fit.errors
    found = row_errors(errors)
    density = Density(fit.problem, joint_prior(fit.problem), errors=found)
    moves = np.array([[0.0, 0.0], [1e-4, -2e-5], [-3e-4, 1e-5]])
    m = fit.problem.n_residuals
    noise, shared = float(errors.noises[0]) * np.eye(m), np.zeros((m, m))
    for source, variance in zip(errors.sources, errors.variances.tolist(), strict=True):
        columns = source.columns[:m]
        (noise if source.name == NOISE else shared)[:] += variance * columns @ columns.T
    J = fit.problem.residuals_and_jacobian(errors.theta)[1] / errors.estimate.scale
    G = np.linalg.pinv(J)
    noise, shared = G @ noise @ G.T, G @ shared @ G.T
    shared += errors.contributions.get(TESTS, 0.0)
    squares = found.squares(errors.theta + moves, density.sums(errors.theta + moves))
    for (of_noise, of_shared), square in zip(found.sizes.T, squares.T, strict=True):
        precision = np.linalg.inv(of_noise * noise + of_shared * shared)
        expected = np.einsum("si,ij,sj->s", moves, precision, moves)
        assert square - square[0] == pytest.approx(expected, rel=1e-2)
    assert np.linalg.inv(found.information) == pytest.approx(errors.covariance, rel=1e-6)


def test_intervals_are_those_of_the_budget_where_all_is_linear():
    fit = di.fit(days(3), LINEAR)
    budget = fit.budget()["f_max"]
    assert budget.dof < 4.0
    grid = di.posterior(fit, method="grid", tolerance=1e-3)
    low, high = grid.quantile("f_max", Q)
    assert high - low == pytest.approx(2.0 * budget.U, rel=0.02)
    assert np.sqrt(low * high) == pytest.approx(budget.value, abs=0.1 * budget.u)
    chain = di.posterior(fit, seed=1, ess=500.0)
    assert chain.names == grid.names
    share = np.mean((chain.values[:, 0] > low) & (chain.values[:, 0] < high))
    assert share == pytest.approx(0.9545, abs=0.03)


def driven_table(seed):
    f, drive = np.repeat([6.0, 12.0, 18.0, 25.0], 3), np.tile([0.05, 0.15, 0.4], 4)
    plant = di.Dahl(f_max=0.1, sigma=300.0) + di.Mass(0.02) + di.Damper(0.05)
    R = di.response(plant, f, drive).receptance * relative_noise(12, 0.02, seed)
    return di.FrequencyResponse(f, R, drive=drive, controlled="force", quantity="receptance")


@pytest.mark.parametrize(
    ("data", "model", "name"),
    [
        (di.load_dataset("noisy"), di.Dahl(), "f_max"),
        (driven_table(14), LINEAR + di.Mass(0.02) + di.Damper(0.05), "sigma"),
    ],
)
def test_the_jackknife_over_tests_is_counted(data, model, name):
    """Where it is the largest source, the interval is as wide as that of the budget."""
    fit = di.fit(data, model)
    budget = fit.budget()[name]
    assert budget.rows[0].source == "jackknife over tests"
    grid = di.posterior(fit, method="grid", tolerance=1e-2)
    low, high = grid.quantile(name, Q)
    assert high - low == pytest.approx(2.0 * budget.U, rel=0.08)
    assert "Counted: noise; jackknife over tests" in grid.verdict


def test_a_posterior_is_where_the_fit_is_with_outliers():
    """Three of 30 rows are wrong: the fit and its posterior weigh them alike."""
    fit = di.fit(di.load_dataset("outliers"), LINEAR)
    grid = di.posterior(fit, method="grid", tolerance=1e-2)
    for name, row in fit.params.items():
        if name in grid.names:
            low, median, high = grid.quantile(name, (Q[0], 0.5, Q[1]))
            assert median == pytest.approx(row.value, abs=0.1 * row.stderr)
            assert high - low == pytest.approx(2.0 * fit.budget()[name].U, rel=0.05)


@pytest.mark.long
def test_coverage_with_scatter_between_days():
    inside = {"noise": 0, "combined": 0}
    for seed in range(8):
        fit = di.fit(days(100 + seed), LINEAR)
        for uncertainty in inside:
            grid = di.posterior(fit, method="grid", uncertainty=uncertainty, tolerance=3e-2)
            low, high = grid.quantile("f_max", Q)
            inside[uncertainty] += bool(low <= 0.1 <= high)
    assert inside["combined"] >= 7
    assert inside["noise"] <= 5


def test_an_exponent_that_was_not_given_is_sampled_over_its_range():
    microslip = friction_table(10, 0.003, 0.03, 0.02)
    grid = di.posterior(microslip, di.Dahl(sigma=30.0), method="grid", tolerance=1e-2)
    assert grid.names == ("f_max", "alpha")
    assert "alpha: log-uniform from 0.5 to 2 (its range)" in str(grid)
    given = di.posterior(microslip, di.Dahl(sigma=30.0, alpha=1.0), method="grid", tolerance=1e-2)
    assert "alpha" not in given.names
    assert "alpha = 1 exactly" in str(given)
    four = di.Dahl() + di.Spring()
    with pytest.raises(SamplingError, match="give alpha or fix some, or use method='mcmc'"):
        di.posterior(friction_table(), four, method="grid")


def test_the_verdict_says_what_is_counted():
    fit = di.fit(days(3), LINEAR)
    combined = di.posterior(fit, method="grid", tolerance=1e-2)
    assert "Counted: noise; scatter between runs" in combined.verdict
    assert "no error but noise" not in combined.verdict
    assert combined.status is fit.status
    alone = di.posterior(fit, method="grid", uncertainty="noise")
    noise_alone = "Noise alone is counted; with every source of its budget, u of the fit is 0.0"
    assert noise_alone in alone.verdict
    assert "no error but noise" in alone.verdict
    assert alone.uncertainty == "noise"


def test_a_parameter_that_a_default_prior_sets_is_not_determined():
    microslip = friction_table(10, 0.0003, 0.003, 0.05)
    for uncertainty in ("noise", "combined"):
        open_ = di.posterior(microslip, LINEAR, method="grid", uncertainty=uncertainty)
        assert str(open_.status) == "not determined"
        assert "f_max is known from its prior" in open_.verdict
    known = di.posterior(microslip, LINEAR, method="grid", priors={"f_max": (0.5, 2.0)})
    assert known.status.usable


@pytest.mark.parametrize(("noise", "status"), [(0.01, "not determined"), (0.001, "trusted")])
def test_a_parameter_with_a_wide_interval_is_not_determined(noise, status):
    microslip = friction_table(12, 0.01, 0.1, noise)
    grid = di.posterior(microslip, LINEAR, method="grid", tolerance=1e-2)
    low, high = grid.quantile("f_max", Q)
    assert low < 0.1 < high
    assert str(grid.status) == status, grid.verdict
    assert (high > 50.0 * low) == (status != "trusted")


def test_refusals():
    table = friction_table()
    with pytest.raises(ValidationError, match="uncertainty is 'all'; expected one of combined, no"):
        di.posterior(table, LINEAR, method="grid", uncertainty="all")

    def tie(p):
        return [p["sigma"] == 300 * p["f_max"]]

    tied = di.fit(table, LINEAR, method="ipopt", constraints=tie)
    with pytest.raises(ValidationError, match="had constraints, which a posterior"):
        di.posterior(tied, method="grid")


def test_errors_that_rows_share_may_be_the_only_ones():
    """Residuals along one smooth curve leave no noise."""
    A = np.geomspace(0.1, 10.0, 12) * 0.1 / 30.0
    plant = di.Dahl(0.1, 30.0) + di.Spring(0.3)
    data = di.FrequencyResponse(np.ones(12), plant.dynamic_stiffness(A, 2.0 * np.pi), A)
    fit = di.fit(data, LINEAR)
    grid = di.posterior(fit, method="grid", tolerance=1e-2)
    assert np.isfinite(grid.std()[:2]).all()
    weighed = float(fit.errors.state.K[1, 1]) ** 0.5
    assert grid.std()[1] > 0.1 * weighed * fit.params["sigma"].value

"""The searches themselves: standard problems, where they start, when they end, what they cost."""

import numpy as np
import pytest
from scipy import optimize
from scipy.signal import lfilter

import dahl_ident as di
from dahl_ident.fitting import Status, solve
from dahl_ident.fitting.global_start import global_starts
from dahl_ident.fitting.levenberg_marquardt import Minima, minimise
from dahl_ident.fitting.record_search import RecordSearch, noise_power
from dahl_ident.problem import Quadratic, RecordProblem, TableProblem
from tests import cold_records as cold
from tests.random_problems import friction_and_spring
from tests.test_cold_records import with_gap

TIME = np.linspace(0.0, 5.0, 30)
DECAY = 300.0 * np.exp(-2.0 * TIME) + 2.0 * np.random.default_rng(0).standard_normal(30)


def rosenbrock(theta):
    """Return residuals of Rosenbrock's curved valley, whose end is at (1, 1), and slopes."""
    x, y = theta.T
    slopes = np.zeros((len(theta), 2, 2))
    slopes[:, 0, 0], slopes[:, 0, 1], slopes[:, 1, 0] = -20.0 * x, 10.0, -1.0
    return np.array([10.0 * (y - x**2), 1.0 - x]).T, slopes


def decay(theta):
    """Return residuals of a decay, and slopes by the logarithms of its size and rate."""
    size, rate = np.exp(theta.T)[:, :, None]
    wave = size * np.exp(-rate * TIME)
    return wave - DECAY, np.stack([wave, -rate * TIME * wave], axis=-1)


def searched(function, starts, logarithmic=False, **settings):
    def evaluate(theta, _which):
        r, J = function(theta)
        gradient, hessian = np.einsum("si,sip->sp", r, J), np.einsum("sip,siq->spq", J, J)
        return Quadratic(0.5 * (r**2).sum(axis=1), gradient, hessian)

    rows = function(starts)[0].shape[1]
    return minimise(evaluate, starts, np.full(2, logarithmic), rows, **settings)


def test_a_curved_valley_is_followed_in_few_evaluations():
    starts = np.array([[-1.2, 1.0], *np.random.default_rng(1).uniform(-3.0, 3.0, (40, 2))])
    ends = searched(rosenbrock, starts)
    assert ends.converged.all()
    np.testing.assert_allclose(ends.theta, 1.0, rtol=1e-8)
    assert ends.evaluations.mean() < 14.0


def test_a_search_ends_where_a_bound_cuts_the_valley():
    low, high = np.array([-2.0, -2.0]), np.array([2.0, 0.5])
    starts = np.random.default_rng(3).uniform([0.1, -2.0], high, (40, 2))
    ends = searched(rosenbrock, starts, bounds=(low, high))
    x = np.roots([200.0, 0.0, -99.0, -1.0]).max()  # where the cost's slope along the bound is zero
    assert ends.converged.all()
    np.testing.assert_allclose(ends.theta, np.tile([x, 0.5], (40, 1)), rtol=1e-7)
    assert ends.evaluations.mean() < 6.5


def test_steps_to_the_limit_of_a_series_end_at_a_bound():
    """In Powell's example, each Gauss-Newton step is a fixed part of the one before."""
    low, high, lowest, ratio = np.full(2, 0.1), np.full(2, 2.0), np.inf, 0.9

    def series(theta):
        nonlocal lowest
        lowest = min(lowest, theta.min())
        residuals = np.concatenate([theta + 1.0, ratio * theta**2 + theta - 1.0], axis=1)
        slopes = np.stack([np.ones(theta.shape), 2.0 * ratio * theta + 1.0], axis=1)
        return residuals, (slopes[..., None] * np.eye(2)).reshape(-1, 4, 2)

    starts = np.random.default_rng(0).uniform(low, high, (400, 2))
    ends = searched(series, starts, bounds=(low, high))
    assert ends.converged.all()
    np.testing.assert_allclose(ends.theta, np.tile(low, (400, 1)), rtol=1e-12)
    assert lowest == pytest.approx(0.1, abs=1e-12)


def test_logarithms_far_off_are_found_in_few_evaluations():
    best = optimize.curve_fit(lambda t, a, b: a * np.exp(-b * t), TIME, DECAY, [300.0, 2.0])[0]
    starts = np.log(best) + np.random.default_rng(2).uniform([-7.0, -2.0], [7.0, 1.0], (40, 2))
    ends = searched(decay, starts, logarithmic=True)
    assert ends.converged.all()
    np.testing.assert_allclose(ends.theta, np.tile(np.log(best), (40, 1)), atol=1e-7)
    assert ends.evaluations.mean() < 11.5


def test_a_search_takes_no_steps_below_the_accuracy_of_predictions():
    starts = np.log([[300.0, 2.0]]) + np.random.default_rng(2).uniform(-1.0, 1.0, (40, 2))
    exact, rough = (searched(decay, starts, True, accuracy=e) for e in (1e-15, 1e-4))
    assert rough.converged.all()
    assert rough.evaluations.mean() < 6.5
    assert exact.evaluations.mean() > 7.0
    np.testing.assert_allclose(rough.theta, exact.theta, atol=1e-4)


@pytest.mark.parametrize(("steps", "error"), [(600, 2e-6), (1200, 2e-3)])
@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_a_start_has_the_accuracy_of_its_table(steps, error, alpha):
    """At a node of the grid, amplitudes at steps of the table, near the knee or far from it."""
    amplitude = np.exp(0.01 * np.round(np.linspace(-steps, steps, 60)))

    def start_for(f_max):
        N = di.Dahl(f_max, 30.0, alpha).describing_function(amplitude)
        table = di.FrequencyResponse(np.ones(60), N, amplitude)
        starts = global_starts(TableProblem(table, di.Dahl(alpha=None), noise="relative"))
        return np.exp(starts.theta[0])

    near = start_for(30.0)
    f_max = 30.0 * near[0] / near[1]  # its x_c is that of a node
    np.testing.assert_allclose(start_for(f_max), [f_max, 30.0, alpha], rtol=error)


@pytest.mark.parametrize("f_max", [1e-15, 1e15])
def test_a_friction_limit_of_any_size_may_be_given(f_max):
    amplitude = f_max / 30.0 * np.geomspace(0.1, 10.0, 20)
    error = np.random.default_rng(8).normal(size=40).view(complex)
    N = di.Dahl(f_max, 30.0).describing_function(amplitude) * np.exp(0.01 * error)
    table = di.FrequencyResponse(np.ones(20), N, amplitude)
    found = solve(TableProblem(table, di.Dahl(f_max), noise="relative"))
    assert found.status is Status.CONVERGED
    assert found.nfev < 8
    assert found.values == pytest.approx([30.0], rel=0.03)


def test_a_bound_does_not_keep_a_search_far_out():
    """Sticking alone determines sigma, and the best node of the grid lies at its end."""
    amplitude = np.geomspace(1e-6, 1e-5, 24)
    error = np.random.default_rng(8).normal(size=48).view(complex)
    table = di.FrequencyResponse(np.ones(24), 7.0 - 0.01j + 0.001 * error, amplitude)
    sigma = di.Parameter("sigma", "N/m", "stiffness", lower=10.0, transform="log")
    bounded = di.Model(di.Dahl()).with_parameters({"sigma": sigma})
    found = solve(TableProblem(table, bounded, noise="absolute"))
    at_bound = solve(TableProblem(table, di.Dahl(sigma=10.0), noise="absolute"))
    assert found.status is Status.AT_BOUND
    assert found.cost == pytest.approx(at_bound.cost, rel=1e-6)


def test_the_exponent_of_a_law_that_vanishes_is_one():
    error = np.random.default_rng(0).normal(size=40).view(complex)
    Z = (7.0 - 0.2j) * np.exp(0.01 * error)
    table = di.FrequencyResponse(np.ones(20), Z, np.geomspace(1e-4, 1e-1, 20))
    found = solve(TableProblem(table, di.Dahl(alpha=None) + di.Spring(), noise="absolute"))
    assert found.status is Status.NO_FRICTION
    assert found.values[2] == 1.0


def test_limits_are_found_in_few_evaluations():
    ends = [solve(problem) for problem, *_ in friction_and_spring(seed=5, count=12)]
    assert sum(end.status.at_infinity for end in ends) == 3
    assert sum(end.nfev for end in ends) < 360


class Stuck(RecordSearch):
    """A search whose steps do not lower the cost."""

    def minimise(self, problem, begin, most):
        cost, _, hessian = problem.quadratic(begin)
        return Minima(begin, cost, hessian, np.array([False]), np.array([1]))


@pytest.mark.parametrize(("errors", "ends"), [(0.18, True), (0.22, False)])
def test_a_search_that_is_stuck_ends_within_a_fifth_of_the_standard_error(errors, ends):
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.standard_normal(400))
    force = 5.0 * x + rng.standard_normal(400)
    record = di.Record(np.arange(400) / 100.0, displacement=x, force=force)
    problem = RecordProblem([record], di.Spring())
    best = solve(problem)
    off = errors * best.covariance[0] / best.covariance[0, 0] ** 0.5
    end = Stuck("lm", "linear").descend(problem, best.theta + off, 75)
    assert end.converged[0] == ends


@pytest.mark.parametrize(
    ("made", "noise", "most"),
    [
        (lambda: cold.unknown_slips(11), 5e-3, 80),
        (lambda: cold.free_decay("lugre", "mass", 3, 300), 1e-3, 72),
        (lambda: cold.free_decay("maxwell_slip", "spring", 3, 300), 1e-3, 105),
        (lambda: cold.free_decay("backlash", "spring", 2, 300), 1e-3, 40),
        (lambda: cold.maxwell_slip(3), 1e-3, 45),
    ],
)
def test_records_are_described_after_few_evaluations(made, noise, most):
    record, _, model = made()
    best = solve(RecordProblem([record], model))
    assert 2.0 * best.cost / len(record) < 1.1 * noise**2
    assert best.nfev < most


@pytest.mark.filterwarnings("ignore:.*2 parts are fitted")
@pytest.mark.parametrize(("seed", "most"), [(414, 60), (419, 35)])
def test_springs_start_with_the_loads_that_a_gap_leaves(seed, most):
    record, _, model = cold.maxwell_slip(seed)
    best = solve(RecordProblem([with_gap(record, 200, 260)], model))
    assert 2.0 * best.cost / len(record) < 1.5e-6
    assert best.nfev < most


@pytest.mark.parametrize("pole", [-0.5, 0.0, 0.9])
def test_correlated_residuals_count_by_their_power_at_low_frequencies(pole):
    white = np.random.default_rng(0).standard_normal(200_000)
    halves = np.array_split(lfilter([3.0], [1.0, -pole], white), 2)
    cost = 0.5 * float(sum(half @ half for half in halves))
    expected = (3.0 / (1.0 - pole)) ** 2
    assert noise_power(cost, white.size, halves) == pytest.approx(expected, rel=0.02)

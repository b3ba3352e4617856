"""Importance points against closed forms, scipy's integration, product rules, and their limits."""

from functools import partial

import numpy as np
import pytest
from scipy import integrate as scipy_integrate
from scipy import stats
from scipy.integrate import trapezoid

import dahl_ident as di
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.importance import integrate
from dahl_ident.bayes.priors import JointPrior, ParameterPrior, joint_prior
from dahl_ident.elements import Parameter
from dahl_ident.errors import ModelError, SamplingError, ValidationError
from dahl_ident.problem import TableProblem
from tests.bayes_cases import friction_table, spring_table, with_covariance
from tests.friction_tables import FRICTION, X_C

TIGHT = with_covariance(friction_table(30, 0.1, 10.0, 0.01), 0.01)  # f_max to 0.3 %
LEVELS = np.array([0.025, 0.16, 0.5, 0.84, 0.975])


def grid_of(data, model=None, **options):
    """Return the posterior by points, of independent noise alone."""
    model = di.Dahl() if model is None else model
    return di.posterior(data, model, method="grid", uncertainty="noise", **options)


def box(dims, low, high):
    parameters = [Parameter(f"p{i}", "", "a number") for i in range(dims)]
    return JointPrior(tuple(ParameterPrior(p, (low, high)) for p in parameters))


def gaussian_grid(mean, covariance, prior):
    density = stats.multivariate_normal(mean, covariance)
    low, high = prior.limits

    def log_density(theta):
        inside = ((theta >= low) & (theta <= high)).all(axis=1)
        return np.where(inside, np.atleast_1d(density.logpdf(theta)), -np.inf)

    centre = mean + 0.3 * np.sqrt(np.diagonal(covariance))
    return integrate(log_density, prior, centre, 1.3**2 * covariance)


@pytest.mark.parametrize("dims", [1, 2, 3])
@pytest.mark.parametrize("correlation", [0.0, 0.97])
def test_a_gaussian_in_a_wide_box(dims, correlation):
    std = np.array([0.5, 0.002, 0.05])[:dims]
    matrix = np.full((dims, dims), correlation) + (1.0 - correlation) * np.eye(dims)
    mean = np.array([1.0, -2.0, 0.3])[:dims]
    grid = gaussian_grid(mean, matrix * np.outer(std, std), box(dims, -10.0, 10.0))
    assert grid.error < 1e-3
    assert abs(grid.log_evidence) < 1e-3
    assert grid.weights.sum() == pytest.approx(1.0, abs=1e-12)
    for axis in range(dims):
        found = (grid.quantiles(axis, LEVELS) - mean[axis]) / std[axis]
        assert stats.norm.cdf(found) == pytest.approx(LEVELS, abs=1e-3)


def test_a_wall_cuts_the_density():
    grid = gaussian_grid(np.array([0.2, 0.0]), np.diag([1.0, 0.01]), box(2, 0.0, 10.0))
    inside = stats.norm.sf(-0.2) * 0.5
    assert grid.log_evidence == pytest.approx(np.log(inside), abs=1e-3)


def test_one_parameter_against_scipy():
    data = friction_table(rows=5, noise=0.3)
    prior = (0.01, 1.0)
    grid = grid_of(data, di.Dahl(sigma=30.0), priors={"f_max": prior})
    problem = TableProblem(data, di.Dahl(sigma=30.0))

    def density(theta, moment=0):
        # the scale integrated out by hand: Gamma(n) / (2 (pi S)^n) / |R|^2 ...
        y = np.log(data.response / problem.predict(np.array([theta])))
        S = float(np.sum(np.abs(y) ** 2))
        constants = 24.0 / 2.0 / np.pi**5 / np.prod(np.abs(data.response) ** 2)
        return float(constants * S**-5.0 / np.log(100.0) * np.exp(moment * theta))

    ends = float(np.log(prior[0])), float(np.log(prior[1]))
    moments = [
        scipy_integrate.quad(partial(density, moment=k), *ends, epsrel=1e-10, limit=400)[0]
        for k in range(3)
    ]
    assert grid.log_evidence == pytest.approx(np.log(moments[0]), abs=1e-3)
    mean = moments[1] / moments[0]
    assert grid.mean()[0] == pytest.approx(mean, rel=1e-3)
    assert grid.std()[0] == pytest.approx(np.sqrt(moments[2] / moments[0] - mean**2), rel=1e-3)


def gauss(low, high, panels):
    """Return nodes and weights of Gauss's rule of 8 points in each of many panels."""
    x, w = np.polynomial.legendre.leggauss(8)
    walls = np.linspace(low, high, panels + 1)
    half = 0.5 * np.diff(walls)[:, None]
    return (walls[:-1, None] + half * (1.0 + x)).ravel(), (half * w).ravel()


def brute_force(grid, priors, panels):
    """Return nodes all over the prior, (..., D), and the probability that the grid gives them."""
    density = Density(grid.problem, joint_prior(grid.problem, priors))
    rules = [gauss(low, high, panels) for low, high in np.transpose(density.prior.limits)]
    nodes = np.stack(np.meshgrid(*[x for x, _ in rules], indexing="ij"), axis=-1)
    mass = np.exp(density.marginal(nodes.reshape(-1, nodes.shape[-1])) - grid.log_evidence)
    mass = mass.reshape(nodes.shape[:-1])
    for axis, (_, weights) in enumerate(rules):
        mass = mass * weights.reshape(-1, *[1] * (mass.ndim - 1 - axis))
    return nodes, mass


@pytest.mark.parametrize(
    "seed", [10, *(pytest.param(s, marks=pytest.mark.long) for s in (0, 5, 13))]
)
def test_few_points_and_much_noise_stay_inside_the_stated_error(seed):
    random = np.random.default_rng(seed)
    low, noise = 10.0 ** random.uniform([-2.0, -1.2], [1.5, 0.0])
    data = friction_table(int(random.integers(2, 6)), low, 30.0 * low, noise, seed)
    priors = {"f_max": (1e-3, 10.0), "sigma": (0.3, 3e3)}
    grid = grid_of(data, priors=priors)
    assert grid.error < 1e-3
    _, mass = brute_force(grid, priors, 90)
    assert abs(mass.sum() - 1.0) < grid.error


@pytest.mark.parametrize("rows", [2, pytest.param(12, marks=pytest.mark.long)])
def test_the_noise_scale_is_a_mixture_of_inverse_gammas(rows):
    priors = {"f_max": (0.01, 1.0), "sigma": (3.0, 300.0)}
    data = friction_table(rows, noise=0.1)
    grid = grid_of(data, priors=priors)
    nodes, mass = brute_force(grid, priors, 40)
    theta, mass = nodes.reshape(-1, 2), mass.ravel() / mass.sum()
    y = np.log(data.response / TableProblem(data, di.Dahl()).predict(theta))
    squares = np.sum(np.abs(y) ** 2, axis=1)
    for level in LEVELS:
        s = float(grid.quantile("noise_scale", level))
        below = stats.invgamma(rows, scale=0.5 * squares).cdf(s**2)
        assert mass @ below == pytest.approx(level, abs=1e-3)


@pytest.mark.parametrize(
    ("data", "model", "priors", "panels"),
    [
        (friction_table(30, noise=0.01), di.Dahl(), {"f_max": (0.09, 0.11), "sigma": (25, 35)}, 40),
        pytest.param(
            friction_table(3, noise=0.5), di.Dahl(), {"f_max": (1e-5, 1e3), "sigma": (1e-3, 1e5)},
            60, marks=pytest.mark.long,
        ),
        (
            friction_table(10, 0.0003, 0.003, 0.05),
            di.Dahl(),
            {"f_max": (1e-4, 1e5), "sigma": (20.0, 50.0)},
            50,
        ),
        pytest.param(
            friction_table(10, 0.003, 0.03, 0.02), di.Dahl(),
            {"f_max": (1e-3, 1e2), "sigma": (20.0, 50.0)}, 50, marks=pytest.mark.long,
        ),
        (
            spring_table(0.3),
            di.Dahl() + di.Spring(),
            {"f_max": (0.02, 0.4), "sigma": (5.0, 60.0), "stiffness": (0.0, 60.0)},
            6,
        ),
    ],
    ids=["peak", "heavy tails", "open to the wall", "microslip", "spring cut by walls"],
)  # fmt: skip
def test_the_stated_error_holds_against_brute_force(data, model, priors, panels):
    grid = grid_of(data, model, priors=priors)
    assert grid.error < 1e-3
    nodes, mass = brute_force(grid, priors, panels)
    assert abs(mass.sum() - 1.0) < grid.error
    logarithmic = [name != "stiffness" for name in grid.problem.names]
    low, high = joint_prior(grid.problem, priors).limits
    weights, theta = grid.points
    for axis, name in enumerate(grid.problem.names):
        # the mass below a wall between panels has no error of its own
        for panel in range(1, panels):
            wall = low[axis] + (high[axis] - low[axis]) * panel / panels
            below = float(np.sum(mass * (nodes[..., axis] < wall)) / mass.sum())
            assert weights @ (theta[:, axis] < wall) == pytest.approx(below, abs=1e-3)
            if 0.02 < below < 0.98:
                value = float(grid.quantile(name, below))
                place = np.log(value) if logarithmic[axis] else value
                share = weights @ (theta[:, axis] < place)
                assert share == pytest.approx(below, abs=1e-4)


def test_a_second_mode_is_found_from_the_prior():
    def log_density(theta):
        first, second = (-0.5 * np.sum((theta - m) ** 2, axis=1) for m in ([0, 0], [12.0, 9.0]))
        return np.asarray(np.logaddexp(first, second))

    grid = integrate(log_density, box(2, -20.0, 20.0), np.zeros(2), np.eye(2))
    assert grid.log_evidence == pytest.approx(np.log(4.0 * np.pi), abs=1e-3)


def test_a_bolted_ridge_keeps_its_time():
    # what once took millions of points: f_max open to its wall with a free spring
    data = spring_table(1e-3, 20, 0.003, 0.03)
    grid = grid_of(data, di.Dahl() + di.Spring())
    assert grid.converged, grid.message
    assert grid.evaluations < 300_000
    rule_ = grid.prior_influences[0]
    assert (rule_.name, rule_.at_upper_end) == ("f_max", True)


def test_friction_that_may_be_none_at_either_end():
    # sigma alone shows; with a free spring friction may as well be none
    data = di.load_dataset("microslip")
    grid = grid_of(data, di.Dahl() + di.Spring())
    assert grid.converged
    # the product of Gauss's rule, 240 nodes in ln f_max and in ln sigma, with the trapezoidal rule
    # along the spring around its conditional mode
    assert abs(grid.log_evidence + 23.52020) < grid.error


def test_an_accuracy_that_is_not_reached_is_said():
    grid = grid_of(friction_table(), tolerance=1e-6)
    assert not grid.converged
    assert grid.message.startswith("NOT CONVERGED: error")
    assert grid.evaluations < 300_000


def test_the_same_answer_at_every_call():
    first, second = (grid_of(TIGHT, tolerance=1e-2) for _ in range(2))
    assert first.log_evidence == second.log_evidence
    np.testing.assert_array_equal(first.points[1], second.points[1])


def test_evidence_of_a_free_exponent_is_lower_where_the_exponent_is_one():
    data = friction_table(rows=8, noise=0.05)
    priors = {"f_max": (0.01, 1.0), "sigma": (3.0, 300.0)}
    plain = grid_of(data, priors=priors)
    wider = grid_of(data, priors={**priors, "alpha": (0.3, 3.0)}, free=["alpha"], tolerance=1e-2)
    assert wider.log_evidence < plain.log_evidence


def test_scale_free_and_scale_known_agree_for_many_rows():
    table = friction_table(rows=200, noise=0.02)
    free, known = (grid_of(data, tolerance=5e-3) for data in (table, with_covariance(table, 0.02)))
    assert known.names == ("f_max", "sigma")
    # the scale is known to 5 % from 400 residuals
    assert known.std()[:2] == pytest.approx(free.std()[:2], rel=0.15)
    assert float(free.quantile("noise_scale", 0.5)) == pytest.approx(0.02, rel=0.12)


def test_a_microslip_posterior_names_the_prior():
    grid = grid_of(friction_table(10, 0.0003, 0.003, 0.05))
    (rule_,) = grid.prior_influences
    assert str(rule_).startswith("f_max is known from its prior: posterior width 0.")
    assert rule_.at_upper_end
    assert "reaches the prior's upper end" in str(rule_)
    assert "f_max is known from its prior" in str(grid)


@pytest.mark.parametrize(
    "prior",
    [
        stats.norm(1.0, 0.1),
        stats.norm(1.0, 0.01),
        stats.norm(0.105, 0.0005),
        stats.lognorm(0.1, scale=1.0),
    ],
)
def test_data_outweigh_the_tail_of_a_prior(prior):
    grid = grid_of(TIGHT, priors={"f_max": prior})
    # the likelihood of f_max, sigma profiled out, is nearly normal over its value
    optimum = di.fit(TIGHT, di.Dahl()).optimum
    f, std = optimum.values[0], np.sqrt(optimum.values_covariance[0, 0])
    x = np.linspace(f - 8.0 * std, f + 16.0 * std, 20001)
    density = prior.logpdf(x) - 0.5 * ((x - f) / std) ** 2
    weights = np.exp(density - density.max())
    mean = (weights @ x) / weights.sum()
    assert grid.converged
    assert grid.mean()[0] == pytest.approx(mean, abs=0.2 * std)
    assert "PRIOR AGAINST DATA: f_max lies beyond 99 % of its prior's" in str(grid).splitlines()[1]
    assert not grid.trusted


def test_a_prior_that_keeps_the_data_out_is_told_with_its_misfit():
    walled = grid_of(TIGHT, priors={"f_max": (1.0, 2.0)})
    assert "at the lower end; check the prior, its unit" in str(walled)
    assert "MISFIT: the residuals are larger than the noise that the data state" in str(walled)
    assert [f.code for f in walled.findings[:2]] == ["prior_influence", "predictive_check"]
    free = grid_of(TIGHT)
    assert free.trusted
    assert "Noise alone is counted; with every source" in free.verdict


def test_marginals_are_densities_with_the_right_quantiles():
    grid = grid_of(friction_table())
    for name in grid.names:
        ends = grid.quantile(name, np.array([1e-5, 0.3, 1.0 - 1e-5]))
        x = np.linspace(ends[0], ends[2], 4001)
        density = grid.marginal(name, x)
        assert trapezoid(density, x) == pytest.approx(1.0, abs=1e-3)
        below = x <= ends[1]
        assert trapezoid(density[below], x[below]) == pytest.approx(0.3, abs=2e-3)
    low, high = np.exp(joint_prior(grid.problem).limits)
    assert grid.marginal("f_max", [0.5 * low[0], 2.0 * high[0]]).tolist() == [0.0, 0.0]
    with pytest.raises(ValidationError, match=r"f_max\[0\] is -1"):
        grid.marginal("f_max", [-1.0])


def test_expectation_and_draws():
    grid = grid_of(friction_table())
    x_c = grid.function(lambda f_max, sigma: f_max / sigma)["mean"]
    assert x_c == pytest.approx(X_C, rel=0.05)
    draws = grid.draws(4000, seed=1)
    assert (draws[:, 0] / draws[:, 1]).mean() == pytest.approx(x_c, rel=0.01)
    assert draws.mean(axis=0) == pytest.approx(grid.mean(), rel=0.01)
    assert draws.std(axis=0) == pytest.approx(grid.std(), rel=0.06)


@pytest.mark.parametrize("bad", [0.0, 1.0, 1.5, np.nan])
def test_quantiles_of_what_is_no_probability_are_refused(bad):
    grid = grid_of(friction_table())
    for name in grid.names:
        with pytest.raises(ValidationError, match=r"probabilities\[1\] is .*; expected"):
            grid.quantile(name, [0.5, bad])


def test_refusals():
    data = friction_table()
    plant = di.Dahl() + di.Spring() + di.Damper()
    with pytest.raises(SamplingError, match=r"4 parameters are free \(f_max, sigma, stiffness"):
        grid_of(data, plant)
    with pytest.raises(ModelError, match="there is no 'mass'; expected one of f_max, sigma"):
        grid_of(data).quantile("mass", 0.5)
    with pytest.raises(ValidationError, match="unknown noise scale has no closed integral"):
        di.posterior(data, di.Dahl(), likelihood="student_t", method="grid")
    exact = FRICTION.describing_function(np.array([1e-3, 2e-3, 4e-3]))
    perfect = di.FrequencyResponse(np.ones(3), exact, np.array([1e-3, 2e-3, 4e-3]))
    with pytest.raises(SamplingError, match="there is no noise whose scale could be estimated"):
        grid_of(perfect)
    two = friction_table(rows=1)
    with pytest.raises(SamplingError, match="2 residuals cannot determine 2 parameters"):
        grid_of(two)

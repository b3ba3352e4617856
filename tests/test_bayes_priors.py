"""Priors: densities, defaults, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident.bayes.priors import joint_prior
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.problem import TableProblem
from tests.bayes_cases import friction_table

pytestmark = pytest.mark.versions


def problem(**options):
    return TableProblem(friction_table(), di.Dahl(), **options)


def test_bounds_are_log_uniform():
    prior = joint_prior(problem(), {"f_max": (0.01, 1.0), "sigma": (3.0, 300.0)})
    theta = np.log([[0.1, 30.0], [0.001, 30.0], [0.1, 301.0]])
    density = prior.log_density(theta)
    assert density[0] == pytest.approx(-2.0 * np.log(np.log(100.0)))
    assert density[1:].tolist() == [-np.inf, -np.inf]
    assert prior.priors[0].quantile(np.array([0.5])) == pytest.approx(np.log(0.1))


def test_a_distribution_of_the_value_gets_its_jacobian():
    given = stats.lognorm(0.5, scale=0.1)
    part = joint_prior(problem(), {"f_max": given}).priors[0]
    theta = np.array([-3.0, -2.0])
    # the logarithm of a lognormal value is normal
    assert part.log_density(theta) == pytest.approx(stats.norm(np.log(0.1), 0.5).logpdf(theta))
    assert part.width == pytest.approx(0.5 * np.diff(stats.norm.ppf([0.16, 0.84]))[0])


def test_a_normal_prior_equals_that_of_scipy():
    sensors = di.Sensors(force_gain=stats.norm(1.0, 0.005), delay=stats.norm(0.0, 2e-5))
    prior = joint_prior(problem(sensors=sensors))
    gain, delay = prior.priors[2:]
    assert (gain.source, delay.source) == ("sensors", "sensors")
    theta = np.array([-0.01, 0.004])
    exact = stats.norm(1.0, 0.005).logpdf(np.exp(theta)) + theta
    assert gain.log_density(theta) == pytest.approx(exact)
    assert delay.log_density(1e-5 * theta) == pytest.approx(
        stats.norm(0.0, 2e-5).logpdf(1e-5 * theta)
    )


def test_draws_follow_the_prior():
    prior = joint_prior(problem(), {"f_max": stats.gamma(3.0, scale=0.03), "sigma": (1.0, 10.0)})
    draws = np.exp(prior.draw(np.random.default_rng(1), 4000))
    assert stats.kstest(draws[:, 0], stats.gamma(3.0, scale=0.03).cdf).pvalue > 0.01
    assert stats.kstest(np.log10(draws[:, 1]), "uniform").pvalue > 0.01


def test_defaults_hold_what_the_data_show():
    data = friction_table()
    prior = joint_prior(problem())
    stiffness = np.abs(data.response)
    assert data.amplitude is not None
    force = stiffness * data.amplitude
    low, high = np.exp(prior.priors[0].limits)
    assert (low, high) == pytest.approx((force.min() / 1e5, force.max() * 1e5))
    low, high = np.exp(prior.priors[1].limits)
    assert (low, high) == pytest.approx((stiffness.min() / 1e5, stiffness.max() * 1e5))
    assert "log-uniform from" in str(prior)
    assert "(from the size of the data)" in str(prior)
    text = str(joint_prior(problem(), {"f_max": (0.01, 1.0)}).priors[0])
    assert text == "log-uniform from 0.01 to 1 N"


def test_plants_and_sensors_have_defaults():
    plant = di.Dahl(alpha=1.0) + di.Spring() + di.Mass() + di.Damper()
    sensors = di.Sensors(force_gain=None, delay=None)
    made = TableProblem(friction_table(), plant, sensors=sensors, free=["alpha"])
    prior = joint_prior(made)
    limits = dict(zip(made.names, (part.limits for part in prior.priors), strict=True))
    assert np.exp(limits["alpha"]) == pytest.approx((0.1, 10.0))
    assert limits["delay"] == pytest.approx((-0.5, 0.5))
    assert limits["stiffness"][0] == -limits["stiffness"][1]
    largest = np.abs(friction_table().response).max()
    assert limits["stiffness"][1] == pytest.approx(1e3 * largest)
    assert limits["mass"][1] == pytest.approx(1e3 * largest / (2.0 * np.pi) ** 2)


def test_rotation_has_the_same_defaults():
    table = friction_table()
    turned = replace(table, motion="rotation")
    model = di.Dahl() + di.Spring() + di.Damper()
    here, there = (joint_prior(TableProblem(data, model)) for data in (table, turned))
    assert [p.limits for p in there.priors] == [p.limits for p in here.priors]


def test_a_law_gets_defaults_from_its_declaration():
    class Law(di.Friction):
        """dF/dx = k (1 - sign(v) F/g); two more parameters show what defaults they get."""

        parameters = (
            di.Parameter("g", "N", "limit", lower=0.0, transform="log"),
            di.Parameter("k", "N/m", "stiffness", lower=0.0, transform="log"),
            di.Parameter("c", "N s/m", "loss at high speed", lower=0.0, transform="log"),
            di.Parameter("skew", "", "skew", lower=-1.0, upper=1.0, prior=(-0.2, 0.2)),
        )

        def slope(self, force, direction, velocity, values):
            return values[1] * (1.0 - direction * force / values[0])

    table = friction_table()
    prior = joint_prior(TableProblem(table, Law()))
    dahl = joint_prior(TableProblem(table, di.Dahl()))
    assert [p.limits for p in prior.priors[:2]] == [p.limits for p in dahl.priors]
    per_speed = np.abs(table.response) / (2.0 * np.pi * table.frequency_hz)
    assert np.exp(prior.priors[2].limits[1]) == pytest.approx(1e5 * per_speed.max())
    assert prior.priors[3].limits == (-1.0, 1.0)  # five times wider, within its own bounds


def test_defaults_of_plants_hold_a_larger_estimate():
    made = TableProblem(friction_table(), di.Dahl() + di.Spring())
    prior = joint_prior(made, estimate=np.array([0.1, 30.0, -1e5]))
    assert prior.priors[2].limits == pytest.approx((-1e6, 1e6), rel=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((0.0, 1.0), "has the bounds 0 and 1; expected 0 < low < high"),
        ((2.0, 1.0), "has the bounds 2 and 1; expected 0 < low < high"),
        (3.0, "prior of f_max is 3.0; expected a frozen, continuous distribution"),
        (stats.poisson(3), "expected a frozen, continuous distribution of one number"),
        (stats.lognorm, "expected a frozen, continuous distribution of one number"),
        (stats.norm(1.0, 0.0), "prior of f_max, norm, is not defined"),
        (stats.norm(np.nan, 1.0), "prior of f_max, norm, is not defined"),
        (stats.norm(0.1, 0.1), "norm, mean 0.1, std 0.1, has 0.16 of its probability outside"),
        ((0.1, np.nan), r"prior of f_max\[1\] is nan"),
    ],
)
def test_bad_priors_are_refused(given, message):
    with pytest.raises(ValidationError, match=message):
        joint_prior(problem(), {"f_max": given})


def test_limits_reach_beyond_an_estimate_in_the_tail_unless_nothing_is_there():
    estimate = np.array([0.1, 30.0])
    for prior, low in (
        (stats.lognorm(0.01, scale=1.0), 2.0 * np.log(0.1) + 0.01 * 6.3613),  # 6.36 deviations
        (stats.uniform(1.0, 1.0), 0.0),
    ):
        part = joint_prior(problem(), {"f_max": prior}, estimate).priors[0]
        assert part.limits[0] == pytest.approx(low, abs=1e-4)
        assert part.limits[1] == part.bulk[1]


def test_a_prior_without_moments_is_told_by_its_quantiles():
    prior = joint_prior(problem(), {"f_max": stats.halfcauchy(scale=0.1)})
    assert str(prior.priors[0]) == "halfcauchy, median 0.1, 95 % from 0.003929 to 2.545 N"


def test_priors_of_unknown_names_are_refused():
    with pytest.raises(ModelError, match="a prior for alpha; the free parameters are f_max, sigma"):
        joint_prior(problem(), {"alpha": (0.1, 10.0)})

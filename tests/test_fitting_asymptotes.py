"""Optima at infinity: named, with what is determined, and never a huge number."""

import numpy as np
import pytest

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Sensors, Spring
from dahl_ident.fitting import Status, solve, solve_many
from dahl_ident.problem import ProblemBatch, TableProblem
from tests.friction_tables import driven
from tests.random_problems import friction_and_spring

n = 24
A = np.geomspace(1e-6, 1e-5, n)
RNG = np.random.default_rng(8)
ERROR = RNG.normal(size=n) + 1j * RNG.normal(size=n)


def fitted(Z, model, *, noise="absolute"):
    return solve(TableProblem(FrequencyResponse(np.ones(n), Z, A), model, noise=noise))


def test_microslip_with_a_spring_determines_two_combinations():
    kappa, K = 2e5, 7.0
    Z = K + 4j / (3.0 * np.pi) * kappa * A + 0.01 * ERROR
    found = fitted(Z, Dahl() + Spring())
    assert found.status is Status.MICROSLIP
    assert not found.success
    assert found.values.tolist() == [np.inf, np.inf, -np.inf]
    by_kappa = 4.0 / (3.0 * np.pi) * A  # in the limit the two columns are orthogonal
    expected = {
        "sigma^2/f_max": (by_kappa @ Z.imag / (by_kappa @ by_kappa), 1.0 / (by_kappa @ by_kappa)),
        "sigma + stiffness": (Z.real.mean(), 1.0 / n),
    }
    rest = np.sum((Z.real - Z.real.mean()) ** 2) + np.sum(
        (Z.imag - by_kappa * expected["sigma^2/f_max"][0]) ** 2
    )
    assert found.dof == 2 * n - 2
    assert 2.0 * found.cost == pytest.approx(rest, rel=1e-4)
    for combination in found.combinations:
        value, variance = expected.pop(combination.expression)
        assert combination.value == pytest.approx(value, rel=1e-4)
        assert combination.stderr == pytest.approx(np.sqrt(variance * rest / found.dof), rel=1e-3)
    assert not expected
    assert "sigma^2/f_max = " in found.message
    assert "f_max without bound" in found.message
    assert np.isinf(np.diagonal(found.covariance)).all()
    assert "No finite optimum: the fit improves as f_max grows" in found.message


def test_alpha_joins_the_combination():
    Z = 7.0 + 4j / (3.0 * np.pi) * 2e5 * A + 0.01 * ERROR
    found = fitted(Z, Dahl(alpha=None) + Spring())
    assert found.status is Status.MICROSLIP
    assert [c.expression for c in found.combinations] == [
        "alpha sigma^2/f_max",
        "sigma + stiffness",
    ]


def test_alpha_tends_to_zero_where_the_knee_is_sharp():
    slips = np.geomspace(3.0, 100.0, n) * 1e-5 / 7.0
    Z = Dahl(1e-5, 7.0, 1e-9).describing_function(slips) * (1.0 - 0.01j / 3.0)
    found = solve(TableProblem(FrequencyResponse(np.ones(n), Z, slips), Dahl(alpha=None)))
    assert found.status is Status.SHARP_KNEE
    assert found.values[2] == 0.0
    assert [c.expression for c in found.combinations] == ["f_max", "sigma"]
    assert found.combinations[0].value == pytest.approx(1e-5, rel=1e-2)


def test_alpha_and_f_max_grow_together_where_nothing_slips_fully():
    phi, sigma = 1e-5, 7.0
    places = np.geomspace(0.3, 3.0, n) * phi / sigma
    exponential = Dahl(phi * 1e3, sigma, 1e3).describing_function(places)
    Z = exponential * np.exp(0.02 * np.log(places / places[0]))  # even less slip than that
    found = solve(TableProblem(FrequencyResponse(np.ones(n), Z, places), Dahl(alpha=None)))
    assert found.status is Status.NO_FULL_SLIP
    assert found.values.tolist()[0::2] == [np.inf, np.inf]
    assert [c.expression for c in found.combinations] == ["f_max/alpha", "sigma"]
    assert found.combinations[0].value == pytest.approx(phi, rel=0.1)


def test_stiffness_without_loss_determines_sigma():
    found = fitted(7.0 - 0.01j + 0.001 * ERROR, Dahl())
    assert found.status is Status.NO_LOSS
    assert found.values[0] == np.inf
    assert found.values[1] == pytest.approx(7.0, rel=1e-3)
    assert [c.expression for c in found.combinations] == ["sigma"]
    assert found.stderr["sigma"] == pytest.approx(found.scale / np.sqrt(n), rel=1e-3)
    assert found.stderr["f_max"] == np.inf


def test_slip_alone_determines_f_max():
    found = fitted(1j * 4.0 / np.pi * 3e-5 / A - 0.01 * (1.0 + 0.1 * ERROR), Dahl())
    assert found.status is Status.GROSS_SLIP
    assert found.values[1] == np.inf
    assert found.values[0] == pytest.approx(3e-5, rel=1e-2)
    assert [c.expression for c in found.combinations] == ["f_max"]


def test_no_friction_leaves_the_other_elements():
    found = fitted(7.0 - 0.2j + 0.01 * ERROR, Dahl() + Spring())
    assert found.status is Status.NO_FRICTION
    assert found.values[:2].tolist() == [0.0, 0.0]
    assert found.values[2] == pytest.approx(7.0, rel=1e-2)
    assert found.stderr["stiffness"] == pytest.approx(found.scale / np.sqrt(n), rel=1e-2)


@pytest.mark.parametrize(
    ("model", "Z", "status", "value"),
    [
        (Dahl(sigma=7.0), 7.0 - 0.01j + 0.001 * ERROR, Status.NO_LOSS, np.inf),
        (Dahl(f_max=3e-5), 1j * 4.0 / np.pi * 3e-5 / A - 0.01, Status.GROSS_SLIP, np.inf),
        (Dahl(sigma=7.0) + Spring(1.0), 1.0 - 0.01j + 0.001 * ERROR, Status.NO_FRICTION, 0.0),
        (Dahl(f_max=1.0) + Spring(1.0), 1.0 - 0.1 + 0.01 * ERROR, Status.NO_FRICTION, 0.0),
    ],
)
def test_one_free_friction_parameter_can_run_away(model, Z, status, value):
    found = fitted(Z, model)
    assert found.status is status
    assert found.values.tolist() == [value]


@pytest.mark.parametrize(
    ("friction", "status"),
    [
        (4j / (3.0 * np.pi) * 2e5 * A + 5e9 * A**2, Status.MICROSLIP),  # stiffening, not softening
        (1j * 4.0 / np.pi * 3e-5 / A - 1e-6 / A, Status.GROSS_SLIP),  # a negative stiffness
    ],
)
def test_limits_hold_for_driven_plants(friction, status):
    f = np.geomspace(0.05, 5.0, n)[np.random.default_rng(0).permutation(n)]
    omega = 2.0 * np.pi * f
    Z = friction + 7.0 - 0.3 * omega**2 + 0.24j * omega
    data = driven(f, 1.0 / Z, A * np.abs(Z))
    plant = Dahl() + Mass() + Damper() + Spring()
    found = solve(TableProblem(data, plant, steady="describing function"))  # which made the data
    assert found.status is status
    np.testing.assert_allclose(found.values[2:4], [0.3, 0.24], rtol=0.05)
    assert np.isfinite(list(found.stderr.values())[2:4]).all()


def test_an_unknown_displacement_gain_is_no_limit():
    N = Dahl(0.1, 30.0).describing_function(np.geomspace(1e-4, 1e-1, n)) * np.exp(0.01 * ERROR)
    data = FrequencyResponse(np.ones(n), N, np.geomspace(1e-4, 1e-1, n))
    found = solve(TableProblem(data, Dahl(), sensors=Sensors(displacement_gain=None)))
    assert found.status is Status.SINGULAR
    assert found.values[0] == pytest.approx(0.1, rel=0.02)
    assert np.isfinite(found.stderr["f_max"])
    assert np.isinf(found.stderr["sigma"])


def test_limits_agree_with_dense_scans():
    """A finite optimum is as low as a dense scan's, and one at infinity is named as such."""
    named = set()
    for problem, least_cost, at_edge in friction_and_spring(seed=4, count=30):
        found = solve(problem)
        named.add(found.status)
        assert found.cost <= least_cost * (1.0 + 1e-4)
        assert found.status.at_infinity == at_edge
    assert named >= {Status.CONVERGED, Status.MICROSLIP, Status.GROSS_SLIP, Status.NO_FRICTION}


def test_a_given_f_max_far_beyond_the_data_leaves_sigma_to_be_found_with_a_spring():
    """Only sigma^2/f_max and sigma + stiffness show: a bent valley, as with f_max free."""
    f, amplitude = np.tile(np.geomspace(0.5, 2.0, 15), 3), np.repeat([1e-6, 3e-6, 1e-5], 15)
    truth = np.array([1e6, 2.0, 1.0, -9.9e5])
    plant = Dahl(1e5, truth[0]) + Mass(truth[1]) + Damper(truth[2]) + Spring(truth[3])
    rng = np.random.default_rng(3)
    error = 1e-3 * (rng.normal(size=45) + 1j * rng.normal(size=45))
    Z = plant.dynamic_stiffness(amplitude, 2.0 * np.pi * f) * np.exp(error)
    data, free = FrequencyResponse(f, Z, amplitude), Dahl(1e5) + Mass() + Damper() + Spring()
    found = solve(TableProblem(data, free))
    assert found.status is Status.CONVERGED
    off = np.abs(found.values - truth) / np.sqrt(np.diagonal(found.values_covariance))
    assert (off < 3.0).all()
    together = solve_many(ProblemBatch([data, data], free))
    np.testing.assert_allclose(together.cost, found.cost, rtol=1e-9)

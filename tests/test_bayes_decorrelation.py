"""Decorrelated coordinates of a plant: a shift that keeps volumes, and what it is for."""

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.bayes.moves import decorrelation_of
from dahl_ident.problem import TableProblem
from tests.bayes_cases import FRICTION, X_C, friction_table, spring_table

PLANT = di.Dahl() + di.Spring() + di.Damper() + di.Mass()


def problem():
    amplitude = np.tile(np.geomspace(0.01, 1.0, 6) * X_C, 3)
    frequency = np.repeat([1.0, 2.0, 3.0], 6)
    truth = FRICTION + di.Spring(20.0) + di.Damper(0.3) + di.Mass(0.1)
    response = truth.dynamic_stiffness(amplitude, 2.0 * np.pi * frequency)
    return TableProblem(di.FrequencyResponse(frequency, response, amplitude), PLANT)


@pytest.fixture(scope="module")
def decorrelation():
    found = decorrelation_of(problem())
    assert found is not None
    return found


def around(random):
    """Return points with a noise scale as their last coordinate."""
    centre = np.array([np.log(0.1), np.log(30.0), 20.0, 0.3, 0.1, -4.0])
    return centre + random.normal(size=(5, 6))


def test_bent_undoes_straight(decorrelation):
    x = around(np.random.default_rng(1))
    moved = decorrelation.decorrelated(x)
    assert np.abs(moved[:, 2:5] - x[:, 2:5]).min() > 1e-4
    np.testing.assert_array_equal(moved[:, [0, 1, 5]], x[:, [0, 1, 5]])
    np.testing.assert_allclose(decorrelation.original(moved), x, rtol=0.0, atol=1e-12)


def test_volumes_stay(decorrelation):
    x = around(np.random.default_rng(2))[0]
    step = 1e-6 * np.eye(6)
    jacobian = (decorrelation.decorrelated(x + step) - decorrelation.decorrelated(x - step)) / 2e-6
    assert np.linalg.det(jacobian) == pytest.approx(1.0, abs=1e-7)


def test_least_squares_for_given_friction_stays_in_place(decorrelation):
    # what the plant's parameters have to be for another friction, phi says of both
    made = problem()
    view = made.stiffness_data
    theta = made.to_search([0.1, 30.0, 20.0, 0.3, 0.1])
    w = 2.0 * np.pi * made.data.frequency_hz
    columns = np.stack([np.ones_like(w) + 0j, 1j * w, -(w**2) + 0j], axis=-1)
    other = di.Dahl(f_max=0.2, sigma=45.0)
    rest = (view.stiffness - other.describing_function(view.amplitude)) * view.weights
    weighted = columns * view.weights[:, None]
    real = np.concatenate([weighted.real, weighted.imag])
    best = np.linalg.lstsq(real, np.concatenate([rest.real, rest.imag]), rcond=None)[0]
    follows = np.array([np.log(0.2), np.log(45.0), *best])
    moved = decorrelation.decorrelated(np.stack([theta, follows]))
    np.testing.assert_allclose(moved[0, 2:], moved[1, 2:], rtol=1e-9)


def test_friction_or_a_plant_alone_needs_none():
    assert decorrelation_of(TableProblem(friction_table(), di.Dahl())) is None
    assert decorrelation_of(TableProblem(friction_table(), di.Dahl() + di.Spring(3.0))) is None
    assert decorrelation_of(TableProblem(friction_table(), FRICTION + di.Spring())) is None


def test_a_curved_ridge_is_walked_along():
    # microslip with a free spring: f_max is open upwards, stiffness = constant - sigma
    data = spring_table(1e-3, 20, 0.003, 0.03)
    posterior = di.posterior(
        data, di.Dahl() + di.Spring(), seed=1, max_steps=3000, uncertainty="noise"
    )
    assert posterior.converged, posterior.message
    sigma = posterior.function(lambda sigma, **_: sigma)
    total = posterior.function(lambda sigma, stiffness, **_: sigma + stiffness)
    assert sigma["97.5%"] - sigma["2.5%"] > 100.0 * (total["97.5%"] - total["2.5%"])
    assert total["median"] == pytest.approx(60.0, abs=4.0 * total["std"])

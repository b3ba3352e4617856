"""Mean force and even harmonics, against forces whose coefficients are known."""

import numpy as np
import pytest
from scipy import stats

from dahl_ident.data import Record
from dahl_ident.elements import Dahl
from dahl_ident.extraction import extract

RATE = 64.0
CYCLES = 8
A, PHASE = 0.01, 0.7
OFFSET, SQUARE = 0.3, 4e3  # N and N/m^2: F_0 = OFFSET + SQUARE A^2/2, F_2 = SQUARE A^2/2
FRICTION = Dahl(f_max=1.0, sigma=300.0)
TIME = np.arange(round(CYCLES * RATE)) / RATE
THETA = 2.0 * np.pi * TIME + PHASE


def friction(x):
    """Return the steady force: that of the third time round."""
    return np.asarray(FRICTION.force(np.tile(x, 3))[-x.size :])


def noisy(seed, x, force, noise=0.02):
    rng = np.random.default_rng(seed)
    return Record(
        TIME,
        displacement=x + 1e-3 * noise * A * rng.standard_normal(x.size),
        force=force + noise * rng.standard_normal(x.size),
    )


def test_mean_and_second_harmonic_cover_the_truth_as_often_as_stated():
    x = A * np.cos(THETA)
    force = friction(x) + OFFSET + SQUARE * x**2
    truth = {0: OFFSET / A + 0.5 * SQUARE * A, 2: 0.5 * SQUARE * A}
    runs, inside = 100, {0: 0, 2: 0}
    squares = {0: 0.0, 2: 0.0}
    for seed in range(runs):
        data = extract(noisy(seed, x, force), harmonics=[0, 1, 2], frequency=1.0)
        for row, k in ((0, 0), (2, 2)):
            error = data.response[row] - truth[k]
            if k == 0:
                assert data.response[row].imag == 0.0
                assert (data.covariance[row][:, 1] == 0.0).all()
                z = error.real**2 / data.covariance[row, 0, 0]
                inside[k] += z < stats.f.ppf(0.95, 1, data.dof[row])
            else:
                d = np.array([error.real, error.imag])
                z = 0.5 * float(d @ np.linalg.solve(data.covariance[row], d))
                inside[k] += z < stats.f.ppf(0.95, 2, data.dof[row])
            squares[k] += abs(error) ** 2 / np.trace(data.covariance[row])
    for k in (0, 2):
        assert stats.binomtest(inside[k], runs, 0.95).pvalue > 1e-3, (k, inside[k])
        assert 0.8 < squares[k] / runs < 1.6, (k, squares[k])  # a mean of F(1 or 2, 4 to 16)


def test_a_symmetric_force_is_hardly_ever_called_asymmetric():
    x = A * np.cos(THETA)
    force = friction(x) + OFFSET  # the zero of a load cell is not an asymmetry
    for seed in range(30):
        data = extract(noisy(seed, x, force), frequency=1.0)
        assert data.harmonic.tolist() == [1, 3, 5, 7, 9]
        assert data.quality["asymmetry"][0] == 0.0


def test_even_harmonics_of_the_displacement_are_no_asymmetry_of_the_force():
    x = A * (np.cos(THETA) + 0.05 * np.cos(2.0 * THETA + 1.0))
    velocity = -2.0 * np.pi * A * (np.sin(THETA) + 0.1 * np.sin(2.0 * THETA + 1.0))
    data = extract(noisy(0, x, friction(x) + 20.0 * velocity, 1e-3), frequency=1.0)
    assert data.harmonic.tolist() == [1, 3, 5, 7, 9]


def test_asymmetry_is_said_and_its_size_is_right():
    x = A * np.cos(THETA)
    record = noisy(0, x, friction(x) + OFFSET + SQUARE * x**2, 0.01)
    with pytest.warns(UserWarning, match=r"asymmetric in 1 of 1 points: even harmonics are up to"):
        data = extract(record)
    assert data.harmonic.tolist() == list(range(10))
    fundamental = abs(data.response[1]) * A
    assert data.quality["asymmetry"][0] == pytest.approx(0.5 * SQUARE * A**2 / fundamental, rel=0.1)


def test_the_mean_is_that_of_the_steady_loop():
    """A departure that fades is not a mean force, and its size adds to the mean's uncertainty."""
    time = np.arange(20 * 200) / 200.0
    x = A * np.cos(2.0 * np.pi * time)
    slow = Dahl(f_max=1.0, sigma=8.0)
    force = slow.force(x, initial_force=0.5) + 0.2
    rng = np.random.default_rng(3)
    force = force + 1e-4 * rng.standard_normal(x.size)
    record = Record(time, displacement=x + 1e-7 * rng.standard_normal(x.size), force=force)
    data = extract(record, harmonics=[0, 1], settling_periods=0)
    plain_mean = float(force.mean())
    assert abs(plain_mean - 0.2) > 0.01
    error = data.response[0].real * A - 0.2
    assert abs(error) < 4.0 * np.sqrt(data.covariance[0, 0, 0]) * A
    assert abs(error) < 0.2 * abs(plain_mean - 0.2)


def test_the_mean_has_the_degrees_of_freedom_of_four_lines():
    """Lines below the mean repeat those above it: four complex numbers are eight."""
    data = extract(noisy(1, A * np.cos(THETA), friction(A * np.cos(THETA))), harmonics=[0, 1])
    assert data.dof[0] == pytest.approx(8.0, rel=0.05)

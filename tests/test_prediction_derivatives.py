"""Derivatives of a driven plant's response, by the implicit function theorem."""

import mpmath
import numpy as np
import pytest

from dahl_ident.data import FrequencyResponse
from dahl_ident.elements import Dahl, Damper, Mass, Spring
from dahl_ident.problem import TableProblem

FIG_7 = {"f_max": 0.1, "sigma": 30.0, "mass": 0.3, "damping": 0.24, "stiffness": 0.3}


def driven(model, frequency, drive):
    """Return a problem whose force was controlled; its measured values do not matter here."""
    n = len(frequency)
    data = FrequencyResponse(
        frequency, np.ones(n), drive=drive, controlled="force", quantity="receptance"
    )
    return TableProblem(data, model, noise="absolute", steady="describing function")


def receptance_40_digits(p, omega, drive):
    """Return X/u_0 of linear Dahl friction, mass, damper and spring, by bisection."""
    f_max, sigma, mass, damping, stiffness = p

    def Z(A):
        beta = sigma * A / f_max
        real = 2 * mpmath.besseli(1, beta) / (beta * mpmath.cosh(beta))
        imag = 4 / mpmath.pi * (1 - mpmath.tanh(beta) / beta) / beta
        return stiffness - mass * omega**2 + 1j * damping * omega + sigma * mpmath.mpc(real, imag)

    root = mpmath.findroot(
        lambda y: mpmath.log(mpmath.exp(y) * abs(Z(mpmath.exp(y))) / drive),
        (mpmath.log(1e-8), mpmath.log(1e4)),
        solver="anderson",
        tol=1e-60,
        maxsteps=300,
    )
    return 1 / Z(mpmath.exp(root))


@pytest.mark.parametrize(("frequency", "drive"), [(0.05, 0.05), (0.3, 0.12), (1.4, 0.3)])
def test_against_40_digits(frequency, drive):
    problem = driven(Dahl() + Mass() + Damper() + Spring(), [frequency], [drive])
    values = [FIG_7[name] for name in problem.names]
    theta = problem.to_search(values)
    ours = problem.prediction_jacobian(theta)[0]
    # search coordinates: logarithms of f_max and sigma, the others as they are
    relative = ours * np.array([1.0, 1.0, *values[2:]])
    with mpmath.workdps(40):
        p = [mpmath.mpf(v) for v in values]
        omega = 2.0 * np.pi * frequency
        truth = receptance_40_digits(p, omega, mpmath.mpf(drive))
        assert abs(problem.predict(theta)[0] / complex(truth) - 1.0) < 1e-12
        step = mpmath.mpf(10) ** -12
        for i, slope in enumerate(relative):
            sides = [
                receptance_40_digits(
                    [v * (1 + s) if i == j else v for j, v in enumerate(p)],
                    omega,
                    mpmath.mpf(drive),
                )
                for s in (step, -step)
            ]
            assert slope == pytest.approx(complex((sides[0] - sides[1]) / (2 * step)), rel=1e-9)


def test_with_a_free_exponent_and_two_friction_elements():
    plant = Dahl(name="a", alpha=None) + Dahl(name="b") + Mass() + Damper()
    problem = driven(plant, [0.2, 1.0, 2.0] * 3, [0.3] * 3 + [1.1] * 3 + [4.0] * 3)
    values = {
        "a_f_max": 1.0, "a_sigma": 5.0, "a_alpha": 1.7, "b_f_max": 0.2, "b_sigma": 9.0,
        "mass": 0.1, "damping": 0.05,
    }  # fmt: skip
    theta = problem.to_search([values[name] for name in problem.names])
    ours = problem.prediction_jacobian(theta)
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-5
        numerical = (problem.predict(theta + step) - problem.predict(theta - step)) / 2e-5
        np.testing.assert_allclose(ours[:, i], numerical, atol=1e-7 * np.abs(numerical).max())


def test_a_missing_amplitude_has_no_prediction():
    # undamped resonance at 1 rad/s, where friction takes at most 4 f_max/pi
    problem = driven(Dahl() + Mass(1.0) + Spring(1.0), [0.5 / np.pi, 1.0 / np.pi], [2.0, 2.0])
    theta = problem.to_search([1.0, 10.0])
    assert np.isnan(problem.predict(theta)).tolist() == [True, False]
    assert np.isnan(problem.prediction_jacobian(theta)[:, 0]).tolist() == [True, False]


def test_by_level():
    """Of drives and amplitudes, against responses at levels a little higher and lower."""
    A = np.geomspace(1e-3, 0.1, 6)
    controlled = ["force", "displacement"] * 3

    def at(factor):
        data = FrequencyResponse(
            np.full(6, 0.3), np.ones(6), factor * A, drive=factor * A, controlled=controlled
        )
        model = Dahl() + Mass() + Damper()
        return TableProblem(data, model, noise="absolute", steady="describing function")

    theta = at(1.0).to_search([0.1, 30.0, 0.3, 0.24])
    change = at(np.exp(1e-5)).predict(theta) - at(np.exp(-1e-5)).predict(theta)
    np.testing.assert_allclose(at(1.0).level_slope(theta), change / 2e-5, rtol=1e-6)

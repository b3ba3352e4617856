"""Plants with python-control parts identified at several levels, also under feedback.

The data come from the equation of motion, solved in time by an ODE solver with the friction's
state (Eqn. 2) among its states, not from describing functions.
"""

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dahl_ident import Dahl, LinearSystem, fit
from dahl_ident.control_interop import closed_loop_response, level_responses
from dahl_ident.errors import ValidationError

F_MAX, SIGMA = 0.1, 30.0
MASS, DAMPING, STIFFNESS = 0.3, 0.24, 0.3
s = control.tf("s")
LINEAR_PART = 1 / (MASS * s**2 + DAMPING * s + STIFFNESS)


def simulated(frequency_hz, drive, gains=(0.0, 0.0), cycles=12):
    """Return X over the drive's phasor and abs(X), driven by force, or by a reference under PD."""
    w = 2.0 * np.pi * frequency_hz
    stiff, damp = gains
    closed = any(gains)

    def slope(t, y):
        x, v, F = y
        if closed:
            u = stiff * (drive * np.cos(w * t) - x) - damp * (drive * w * np.sin(w * t) + v)
        else:
            u = drive * np.cos(w * t)
        a = (u - DAMPING * v - STIFFNESS * x - F) / MASS
        return [v, a, SIGMA * (v - abs(v) * F / F_MAX)]

    period = 1.0 / frequency_hz
    time = (cycles - 2) * period + 2.0 * period * np.arange(512) / 512.0
    run = solve_ivp(
        slope, (0.0, cycles * period), [0.0, 0.0, 0.0], t_eval=time, rtol=1e-8, atol=1e-12
    )
    X = complex(2.0 * np.mean(run.y[0] * np.exp(-1j * w * time)))
    return X / drive, abs(X)


def table(points, **options):
    rows = [simulated(f, u, **options) for f, u in points]
    return np.array([r for r, _ in rows]), np.array([A for _, A in rows])


def test_plant_measured_under_feedback_with_a_known_controller():
    stiff, damp = 12.0, 0.6
    controller = stiff + damp * s
    points = [(f, r) for r in (0.004, 0.012, 0.04, 0.12) for f in (1.0, 1.8, 2.6)]
    f, r = np.array(points).T
    X_over_R, amplitude = table(points, gains=(stiff, damp))
    data = closed_loop_response(f, r, X_over_R, controller)
    assert data.levels == [0.004, 0.012, 0.04, 0.12]
    inside = LinearSystem(controller, quantity="dynamic_stiffness", name="controller")
    linear = LinearSystem(LINEAR_PART, quantity="receptance")
    result = fit(data, Dahl() + linear + inside)
    assert result.params["f_max"].value == pytest.approx(F_MAX, rel=0.03)
    assert result.params["sigma"].value == pytest.approx(SIGMA, rel=0.03)
    truth = Dahl(F_MAX, SIGMA) + linear + inside
    for point, reference in enumerate(r):
        C = complex(controller(2j * np.pi * f[point]))
        row = level_responses(truth, f[point], abs(C) * reference).response
        assert complex(row[0, 0]) * C == pytest.approx(X_over_R[point], rel=0.06)
    assert amplitude.min() < 0.02 < amplitude.max()


def test_covariance_turns_with_the_controller():
    rng = np.random.default_rng(2)
    controller = control.tf([3.0, 50.0], [0.01, 1.0])
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]]) * 1e-6
    noise = rng.multivariate_normal([0.0, 0.0], covariance, 200_000) @ [1.0, 1.0j]
    C = complex(controller(2j * np.pi * 2.0))
    data = closed_loop_response([2.0], 0.1, [0.5], controller, covariance=covariance[None])
    parts = (noise / C).view(np.float64).reshape(-1, 2)
    sampled, size = np.cov(parts.T), float(np.var(parts))
    assert np.max(np.abs(data.covariance[0] - sampled)) < 0.02 * size
    assert data.response[0] == pytest.approx(0.5 / C)


def test_bad_closed_loop_data_are_named():
    with pytest.raises(ValidationError, match=r"reference is 0\.0; expected numbers > 0"):
        closed_loop_response([1.0], 0.0, [1.0], LINEAR_PART)
    notch = (s**2 + 4.0) / (s + 1) ** 2
    with pytest.raises(ValidationError, match=r"the controller is 0 at 0\.31831 Hz"):
        closed_loop_response([1.0 / np.pi], 1.0, [1.0], notch)
    with pytest.raises(ValidationError, match="shapes do not go together"):
        closed_loop_response([1.0, 2.0], [1.0, 1.0, 1.0], [1.0, 1.0], LINEAR_PART)

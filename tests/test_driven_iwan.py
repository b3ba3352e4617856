"""Iwan's law driven by a force, against an integration with its exact memory."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dahl_ident as di
from tests.motions import Driven, differences, slopes
from tests.test_forced_motion import RATE, multisine

M, C, K = 2.0, 10.0, 3e4
LINEAR = di.Mass(M) + di.Damper(C) + di.Spring(K)
VALUES = [20.0, 4e4, -0.5, 1.0]
LAW = di.Iwan(*VALUES)


class Memory:
    """The turning points that the law remembers, and the force on from the last one."""

    def __init__(self):
        self.turns: list[tuple[float, float]] = []

    def force(self, x):
        at = [np.asarray(v) for v in VALUES]
        if not self.turns:
            return float(np.sign(x) * LAW.backbone(at, np.asarray(abs(x))))
        place, force = self.turns[-1]
        path = abs(x - place)
        return float(force + np.sign(x - place) * 2.0 * LAW.backbone(at, np.asarray(0.5 * path)))

    def limit(self):
        """Return the displacement at which the present path ends."""
        if not self.turns:
            return np.inf
        return self.turns[-2][0] if len(self.turns) > 1 else -self.turns[0][0]


def exact(samples, drive):
    """Return displacements by DOP853, stopped at every turn and where a loop closes."""
    times, memory = np.arange(samples) / RATE, Memory()
    out, filled, now, y = np.empty(samples), 0, 0.0, np.zeros(2)
    s = 1.0 if drive(0.0) > 0.0 else -1.0
    while filled < samples:

        def rates(t, y):
            return [y[1], (drive(t) - C * y[1] - K * y[0] - memory.force(float(y[0]))) / M]

        def turn(_, y):
            return float(y[1])

        def close(_, y, s=s):
            return float(s * (y[0] - memory.limit())) if memory.turns else -1.0

        for event, way in ((turn, -s), (close, 1.0)):
            event.terminal, event.direction = True, way  # type: ignore[attr-defined]
        found = solve_ivp(
            rates, (now, times[-1] + 1e-9), y, method="DOP853", rtol=1e-10, atol=1e-13,
            max_step=0.3 / RATE, events=[turn, close], dense_output=True,
        )  # fmt: skip
        now, y = float(found.t[-1]), found.y[:, -1].copy()
        here = times[filled:][times[filled:] <= now]
        if here.size and found.sol is not None:
            out[filled : filled + here.size] = found.sol(here)[0]
            filled += here.size
        turned, closed = found.t_events or ((), ())
        if len(turned):
            memory.turns.append((float(y[0]), memory.force(float(y[0]))))
            y[1], s = 0.0, -s
        elif len(closed):
            del memory.turns[-2:]
    return out


def motion(wave):
    driven = Driven(LAW + LINEAR, wave, RATE)
    return driven.motion(np.zeros(driven.order)).output


@pytest.mark.parametrize("values", [[2.0, 5.0, -0.9, 0.1], VALUES, [1.0, 1.0, 1.5, 0.3]])
def test_elements_are_a_polygon_in_the_backbone_curve(values):
    law = di.Iwan(*values)
    stiffnesses, places = law.sliders(values)
    slips = di.MaxwellSlip(places, stiffnesses)
    assert places[-1] == pytest.approx(law.onset)
    np.testing.assert_allclose(
        slips.force([0.0, *places]), law.force([0.0, *places]), rtol=1e-12, atol=1e-14
    )
    x = law.onset * np.linspace(0.0, 1.2, 3001)
    g, ratio = values[2] + 1.0, values[3]
    most = values[0] * g * (g + 1.0) / (2.0 * 30**2 * (ratio * (g + 1.0) + g))
    error = law.force(x) - slips.force(x)
    assert error.min() > -1e-12 * values[0]
    assert 0.9 * most < error.max() < 1.1 * most


def test_harmonics_have_the_error_that_is_stated():
    for chi in (-0.9, -0.5, 0.0):
        for ratio in (0.1, 1.0):
            law = di.Iwan(1.0, 1.0, chi, ratio)
            slips = di.MaxwellSlip(*law.sliders([1.0, 1.0, chi, ratio])[::-1])
            A = law.onset * np.geomspace(0.1, 10.0, 60)
            exact_one, other = (e.dynamic_stiffness(A) for e in (law, slips))
            assert np.abs(other / exact_one - 1.0).max() < 2e-3
            assert np.abs(other.imag / exact_one.imag - 1.0).max() < 0.02


def test_motion_converges_to_that_of_the_exact_law(monkeypatch):
    samples = 128
    wave, drive = multisine(samples)
    truth = exact(samples, drive)
    assert np.abs(truth).max() > 5.0 * LAW.onset
    errors = []
    for n in (30, 120):
        monkeypatch.setattr(di.Iwan, "_count", n)
        errors.append(float(np.abs(motion(wave) - truth).max() / np.abs(truth).max()))
    assert errors[0] < 1e-4
    assert errors[1] < errors[0] / 12.0


def test_slopes_are_derivatives():
    plant = Driven(di.Iwan() + di.Mass() + di.Damper() + di.Spring(), multisine(64)[0], RATE)
    starts, values = np.array([1e-4, 0.01, 0.4]), np.array([*VALUES, M, C, K])
    _, found = slopes(plant, starts, values)
    for i, expected in enumerate(differences(plant, starts, values, 1e-4)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 2e-6, i


def test_a_short_record_from_rest_is_fitted():
    """Its three shape parameters lie in a long curved valley."""
    rng, t = np.random.default_rng(0), np.arange(384) / 100.0
    lines = 2.0 * np.pi * np.arange(1, 9) / t[-1]
    drive = np.cos(lines[:, None] * t + rng.uniform(0.0, 6.3, (8, 1))).sum(axis=0)
    drive *= 0.15 / drive.std()
    plant = di.Iwan(0.1, 30.0, -0.3, 0.5) + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
    driven = Driven(plant, drive, 100.0)
    x = driven.motion(np.zeros(driven.order)).output
    x = x + 1e-3 * x.std() * rng.standard_normal(t.size)
    record = di.Record(t, displacement=x, force=drive)
    fit = di.fit(record, di.Iwan() + di.Mass(0.3) + di.Damper() + di.Spring())
    truth = {"f_max": 0.1, "sigma": 30.0, "chi": -0.3, "ratio": 0.5}
    for name, value in truth.items():
        assert abs(fit.params[name].value - value) < 3.0 * (fit.params[name].stderr or 0.0)

"""Iwan's law driven by a force: its polygon of sliders, derivatives, and a fit."""

import numpy as np
import pytest

import dahl_ident as di
from tests.motions import Driven, differences, slopes
from tests.test_forced_motion import RATE, multisine

M, C, K = 2.0, 10.0, 3e4
VALUES = [20.0, 4e4, -0.5, 1.0]


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
        assert abs(fit.params[name].value - value) < 3.0 * fit.params[name].stderr

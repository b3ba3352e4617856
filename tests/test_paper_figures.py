"""The numbers that the paper states about its Figs. 2 to 7, each from a few public calls.

Helmick and Messner, *Describing Function Analysis of Dahl Model Friction*; corrected where the
paper misprints: gain 4 f_max/(pi A) in gross slip, sigma = 3.2 in Fig. 6, phase 22.51 degrees
where sigma A = f_max.
"""

import numpy as np
import pytest

from dahl_ident import Dahl, Damper, Mass, Spring, response

PLANT = Dahl(f_max=0.1, sigma=30.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)
LEVELS = np.geomspace(1e-4, 1e1, 51)[:, None]


def test_fig_2_force_at_the_reversals():
    x, force = Dahl(f_max=1.0, sigma=1.0).loop(1.0, points=5)
    np.testing.assert_allclose(x[[0, 2]], [1.0, -1.0])
    np.testing.assert_allclose(force[[0, 2]], [np.tanh(1.0), -np.tanh(1.0)], rtol=1e-14)


@pytest.mark.parametrize("sigma", [0.1, 0.32, 1.0, 3.2, 10.0])
def test_fig_6_gain_and_phase(sigma):
    friction = Dahl(f_max=1.0, sigma=sigma)
    knee = friction.characteristic_displacement
    assert friction.gain(1e-6 * knee) == pytest.approx(sigma, rel=1e-9)
    assert friction.gain(knee) == pytest.approx(0.79291 * sigma, rel=1e-5)
    assert np.degrees(friction.phase(knee)) == pytest.approx(22.51, abs=5e-3)
    assert friction.gain(2.2 * knee) == pytest.approx(0.4988 * sigma, rel=1e-4)
    assert np.degrees(friction.phase(2.7 * knee)) == pytest.approx(44.96, abs=5e-3)
    far = 1e8 * knee
    assert friction.gain(far) == pytest.approx(4.0 / (np.pi * far), rel=1e-6)
    assert np.degrees(friction.phase(far)) == pytest.approx(90.0, abs=0.02)


def test_fig_6_curves_are_one_curve_shifted():
    A = np.geomspace(0.1, 100.0, 61)
    one = Dahl(f_max=1.0, sigma=1.0)
    for sigma in (0.1, 0.32, 3.2, 10.0):
        other = Dahl(f_max=1.0, sigma=sigma)
        np.testing.assert_allclose(other.gain(A / sigma), sigma * one.gain(A), rtol=1e-13)
        np.testing.assert_allclose(other.phase(A / sigma), one.phase(A), rtol=1e-12)


def test_fig_7_static_gain_changes_over_between_two_drives():
    gain = np.abs(
        response(PLANT, 0.0, [1e-4, 0.1, 0.2, 10.0], steady="describing function").receptance
    )
    assert gain[0] == pytest.approx(1.0 / (0.3 + 30.0), rel=1e-3)
    assert gain[1] == pytest.approx(0.0515, abs=5e-5)
    assert gain[2] == pytest.approx(2.36, abs=5e-3)
    assert gain[3] == pytest.approx(1.0 / 0.3, rel=2e-3)


def test_fig_7_resonance_moves_from_stiff_and_sharp_to_soft_and_damped():
    f = np.geomspace(0.01, 10.0, 2000)
    gain = np.abs(response(PLANT, f, LEVELS, steady="describing function").receptance)
    peak = f[np.argmax(gain, axis=1)]
    sharpness = gain.max(axis=1) / gain[:, 0]
    assert gain.shape == (51, 2000)
    stuck, free = np.sqrt([30.3 / 0.3, 0.3 / 0.3]) / (2.0 * np.pi)
    assert peak[0] == pytest.approx(stuck, rel=5e-3)
    assert peak[-1] < 1.05 * free
    # the damping of the stiff resonance grows as u0 comes near 0.1, before it jumps
    stiff = LEVELS.ravel() < 0.1
    assert np.all(np.diff(sharpness[stiff]) < 0.0)
    # the transition takes a small range of u0
    between = (peak < 0.9 * stuck) & (peak > 1.2 * free)
    assert 0 < between.sum() < 12

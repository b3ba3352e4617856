"""Sweeps of driven plants: trusted, the truth inside the intervals, on the branch measured.

``python -m benchmarks.driven_plants`` does the same for ten plants, with more tables and rows.
"""

import functools

import numpy as np
import pytest

import dahl_ident as di
from benchmarks.driven_plants import PLANTS, scored, simulated, table
from dahl_ident.elements.driven_motion import Shooting
from dahl_ident.engine import band_limited, march
from tests.friction_tables import driven, relative_noise
from tests.recovery import assert_near

UNKNOWN = di.Dahl(alpha=1.0) + di.Mass(0.3) + di.Damper() + di.Spring()


@pytest.mark.parametrize("number", [0, pytest.param(2, marks=pytest.mark.long)])
def test_a_sweep_of_another_integrator_is_trusted(number):
    plant = PLANTS[number]
    frequency, drive, receptance, closure = simulated(plant, 4, 6)
    assert closure < 1e-6
    tables = [table(plant, frequency, drive, receptance, seed) for seed in (1, 2)]
    score = scored(plant, tables, "exact")
    assert score.trusted == 2
    assert score.inside >= score.intervals - 1
    assert abs(np.mean(score.errors)) < 1.0
    assert max(score.spreads) < 0.1


STEPPED = np.linspace(0.8, 1.5, 9)
GAP = di.Backlash(di.Dahl(2.0, 60.0, alpha=1.0), gap=0.02)
STIFFENING = GAP + di.Mass(0.3) + di.Spring(3.0) + di.Damper(0.12)


@functools.cache
def motions_of_a_gap():
    return di.response(STIFFENING, STEPPED, 0.06, all_roots=True)


@pytest.mark.parametrize("upwards", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_jump_is_fitted_on_the_branch_that_was_measured(upwards):
    """A gap stiffens the plant: swept upwards the large motion lasts, downwards the small one."""
    frequency, motions = STEPPED, motions_of_a_gap()
    stable = np.where(motions.stable, motions.displacement, np.nan)
    assert (np.isfinite(stable).sum(axis=1) > 1).sum() > 4
    place = np.nanargmax(np.abs(stable) if upwards else -np.abs(stable), axis=1)
    measured = stable[np.arange(9), place] / 0.06 * relative_noise(9, 0.004, 1)
    order = slice(None) if upwards else slice(None, None, -1)
    data = driven(frequency[order], measured[order], np.full(9, 0.06))
    unknown = di.Backlash(di.Dahl(2.0, 60.0, alpha=1.0))
    fit = di.fit(data, unknown + di.Mass(0.3) + di.Spring(3.0) + di.Damper())
    assert fit.status.usable
    assert_near(fit, (("gap", 0.02), ("damping", 0.12)), 3.0)
    (jump,) = (finding for finding in fit.findings if finding.code == "jump")
    ((drive, low, high),) = jump.values["places"]
    assert (drive, 0.8 < low < 1.0, 1.3 < high <= 1.5) == (0.06, True, True)
    assert "The response jumps: at 0.06 N from " in fit.verdict


def test_a_delay_of_the_displacement_does_not_look_like_a_source_of_energy():
    """Above the resonance a lag of 0.2 ms turns the receptance beyond minus 180 degrees."""
    truth = {"f_max": 2.0, "sigma": 2e4, "mass": 0.5, "damping": 2.0, "stiffness": 2000.0}
    plant = di.Dahl(2.0, 2e4, 1.0) + di.Mass(0.5) + di.Damper(2.0) + di.Spring(2000.0)
    f, u = np.tile(np.geomspace(4.0, 60.0, 12), 2), np.repeat([0.5, 4.0], 12)
    noise = 0.003 * np.random.default_rng(1).standard_normal((f.size, 2)) @ [1.0, 1.0j]
    lagging = di.response(plant, f, u).receptance * np.exp(noise - 2j * np.pi * f * 2e-4)
    assert (lagging.imag > 0.0).any()
    unknown = di.Dahl(alpha=1.0) + di.Mass() + di.Damper() + di.Spring()
    fit = di.fit(driven(f, lagging, u), unknown, sensors=di.Sensors(delay=None))
    assert fit.trusted
    assert_near(fit, truth | {"delay": 2e-4}, 3.5)


def test_a_plant_that_feeds_energy_in_is_fitted_by_the_describing_function():
    f, u = np.tile(np.geomspace(0.4, 1.2, 6), 2), np.repeat([0.05, 0.3], 6)
    omega = 2.0 * np.pi * f
    R = relative_noise(12, 0.003, 3) / (10.0 - 0.3 * omega**2 - 0.3j * omega)
    fit = di.fit(driven(f, R, u, 0.003, level=u), UNKNOWN, throw=False)
    assert_near(fit, {"damping": -0.3}, 3.0)
    assert any(finding.code == "no_steady_motion" for finding in fit.findings)


def test_a_force_that_is_not_a_sine_is_named_with_the_command_for_its_waveforms():
    plant = di.Dahl(0.1, 30.0, 1.0) + di.Mass(0.3) + di.Damper(1.0) + di.Spring(8.0)
    f, u = np.tile(np.geomspace(0.4, 2.0, 5), 2), np.repeat([0.15, 0.4], 5)
    R = di.response(plant, f, u).receptance * relative_noise(10, 0.003, 3)
    quality = {"force_distortion": np.where(np.arange(10) == 3, 0.1, 0.01)}
    fit = di.fit(driven(f, R, u, 0.003, quality=quality, provenance={"file": "run 7.csv"}), UNKNOWN)
    assert fit.trusted
    assert f"The force at {f[3]:.4g} Hz, 150 mN is 10 % away from the sine" in fit.verdict
    assert "dahl-ident fit --record 'run 7.csv' --mass free" in fit.verdict


def test_a_motion_between_two_stops_settles_on_one_side():
    """Harmonics of 400 cycles from rest, by the last one's Fourier transform."""
    law = di.Backlash(di.Dahl(0.1, 30.0, 1.0), 0.01)
    plant = law + di.Mass(0.3) + di.Damper(0.3) + di.Spring(8.0)
    with pytest.warns(di.errors.MultipleSolutionsWarning, match="2 of 3 points"):
        steady = di.response(plant, [0.4, 0.58, 2.6], [0.05, 0.05, 0.6])
    assert steady.found.tolist() == steady.stable.tolist() == [True, True, True]
    expected = [[5.64893e-3, 1.25497e-3, 1.47644e-3], [6.22328e-3, 1.06179e-3, 0.56e-3]]
    np.testing.assert_allclose(abs(steady.harmonics[:2, 1:4]), expected, rtol=1e-3)


class TwoSlopes(di.Friction):
    """A law that goes on at a fifth of its slope beyond half of f_max."""

    parameters = di.Dahl.parameters[:2]

    def slope(self, force, direction, velocity, values):
        f_max, sigma = values
        return sigma * (1.0 - 0.8 * (direction * force >= 0.5 * f_max))


def test_motions_that_differ_in_both_directions_are_found_where_the_law_does_not():
    """Between two drives the motion that is alike in both directions is not stable."""
    plant = TwoSlopes(0.25, 16.4) + di.Mass(1.0) + di.Damper(0.045) + di.Spring(2.37)
    drive = 0.25 * np.geomspace(0.05, 30.0, 57)
    with pytest.warns(di.errors.MultipleSolutionsWarning):  # the other one is returned on request
        steady = di.response(plant, 0.165, drive[35:45])
    assert steady.found.all()
    assert steady.stable.all()
    one_sided = abs(steady.harmonics[:, 2]) > 0.01 * steady.amplitude
    assert 3 <= one_sided.sum() <= 6
    row = int(np.flatnonzero(one_sided)[1])
    t = np.arange(300 * 64 + 1) / (0.165 * 64)
    shooting = Shooting(plant)
    wave = band_limited(drive[35 + row] * np.cos(2.0 * np.pi * 0.165 * t), t[1])
    values = np.array([float(v) for v in plant.known_values()])
    x = march(shooting.system, t, wave, t, np.zeros(3), values).output[-64:]
    X = np.fft.rfft(x)[1:3] / 32.0
    np.testing.assert_allclose(abs(X), abs(steady.harmonics[row, 1:3]), rtol=1e-3)


def at_unloading(p, exponent):
    """Return amplitudes of a plant with Bouc-Wen friction that unloads at once."""
    law = di.BoucWen(30.0, 300.0, p, exponent=exponent)
    return di.response(law + LIGHT, 1.0, [0.05, 1.0]).amplitude


LIGHT = di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)


@pytest.mark.parametrize(
    ("exponent", "steep", "steeper"), [(1.0, 1e10, 1e17), (2.0, 1e8, 1e10), (4.0, 1e7, 1e13)]
)
def test_instant_unloading_in_a_plant_is_a_limit(exponent, steep, steeper):
    """Friction once vanished beyond p A = 1e11; the steepest had other amplitudes, in minutes."""
    limit, beyond = (at_unloading(p, exponent=exponent) for p in (steep, steeper))
    np.testing.assert_allclose(beyond, limit, rtol=1e-4 if exponent == 2.0 else 2e-4)


def test_unloading_that_time_does_not_resolve_has_no_steady_motion():
    with pytest.warns(di.errors.NoSteadyMotionWarning):
        assert np.isnan(at_unloading(1e6, exponent=10.0)).all()


class LinearAtFirst(di.Friction):
    """Stuck up to two thirds of its limit, from where its slope falls to zero."""

    parameters = (
        di.Parameter("k", "N/m", "stiffness", lower=0.0, transform="log"),
        di.Parameter("f_max", "N", "limit", lower=0.0, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        return k * np.minimum(1.0, 3.0 * np.maximum(1.0 - direction * force / f_max, 0.0))


@pytest.mark.parametrize(
    "stuck", [di.MaxwellSlip([0.0039], [52.0], name="m"), LinearAtFirst(52.0, 0.2, name="m")]
)
def test_an_element_that_does_not_slip_keeps_its_offset_beside_a_law_that_drifts(stuck):
    """The mean force of the first is what the mean of the motion began with, from rest."""
    law = di.Dahl(0.06, 0.21, asymmetry=0.14, name="d") + stuck
    plant = law + di.Mass(0.134) + di.Damper(0.36) + di.Spring(2.8)
    drive = [0.002, 0.01, 0.03, 0.06, 0.12]
    exact = di.response(plant, 0.93, drive)
    near = di.response(plant, 0.93, drive, steady="describing function")
    np.testing.assert_allclose(exact.amplitude, near.amplitude, rtol=1e-6)


@pytest.mark.parametrize(("exponent", "p"), [(1.0, 1e15), (2.0, 1e13)])
def test_motion_in_time_with_instant_unloading_is_a_limit(exponent, p):
    """Friction once vanished after the first reversal, where its force crept to zero."""
    plant = di.BoucWen(30.0, 300.0, 2.0, exponent=exponent) + LIGHT
    t = np.arange(400) / 50.0
    wave = band_limited(0.2 * np.cos(1.9 * t) + 0.15 * np.cos(4.4 * t + 1.0), 0.02)

    def at(p):
        values = np.array([float(v) for v in plant.with_values({"p": p}).known_values()])
        return march(Shooting(plant).system, t, wave, t, np.zeros(3), values).output

    exact = at(1e10)
    assert np.ptp(at(p) - exact) < 1e-3 * np.ptp(exact)


def test_a_response_follows_its_sweep_to_the_jump():
    frequency, every = STEPPED, motions_of_a_gap()
    amplitude = np.where(every.stable, every.amplitude, np.nan)
    for order, last in ((slice(None), np.nanmax), (slice(None, None, -1), np.nanmin)):
        with pytest.warns(di.errors.MultipleSolutionsWarning, match="that a sweep in their order"):
            one = di.response(STIFFENING, frequency[order], 0.06)
        assert one.stable.all()
        np.testing.assert_allclose(one.amplitude, last(amplitude, axis=1)[order], rtol=1e-6)


def test_rows_on_one_side_of_a_gap_do_not_stop_the_search():
    law = di.Backlash(di.Dahl(0.1, 30.0, 1.0), 0.01)
    known = di.Mass(0.3) + di.Spring(8.0)
    f, u = np.tile(np.linspace(0.4, 2.6, 8), 2), np.repeat([0.05, 0.6], 8)
    with pytest.warns(di.errors.MultipleSolutionsWarning):
        steady = di.response(law + known + di.Damper(0.3), f, u)
    assert steady.found.all()
    data = driven(f, steady.receptance * relative_noise(f.size, 0.003, 0), u)
    fit = di.fit(data, di.Backlash(di.Dahl(0.1, 30.0, alpha=1.0)) + known + di.Damper())
    assert fit.params["gap"].value == pytest.approx(0.01, rel=0.1)
    assert fit.params["damping"].value == pytest.approx(0.3, rel=0.1)
    assert "The predicted motion is not stable at 0.4 Hz, 50 mN" in fit.verdict
    assert not fit.trusted

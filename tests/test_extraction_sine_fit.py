import numpy as np
import pytest
from scipy.optimize import least_squares

from dahl_ident.extraction.sine_fit import (
    HARMONICS,
    estimate_frequency,
    sine_fit,
    steady_segment,
    track_phase,
)

MOTION = {1: 2.0 - 1.0j, 3: 0.1 + 0.2j, 4: -0.05j}
FORCE = {1: 1.0 + 3.0j, 2: 0.3 + 0.0j, 3: -0.7j, 5: 0.2 + 0.1j, 7: 0.1 + 0.0j, 9: 0.05j}


def waveform(theta, phasors):
    parts = [(Y * np.exp(1j * k * theta)).real for k, Y in phasors.items()]
    return np.asarray(np.sum(parts, axis=0))


def two_channels(time, omega, noise=0.0):
    rng = np.random.default_rng(5)
    both = np.stack([waveform(omega * time, MOTION), waveform(omega * time, FORCE)])
    drift = np.array([[3.0], [-2.0]]) + np.array([[0.3], [0.5]]) * time
    return both + drift + noise * rng.standard_normal(both.shape)


def uneven(n, seed=0):
    """Jittered samples with one of five missing and a gap."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / 100.0 + rng.uniform(-0.004, 0.004, n)
    kept = (rng.random(n) > 0.2) & ((time < 3.1) | (time > 4.7))
    return time[kept]


def phasors_at_zero(time, channels, omega, k):
    segment = steady_segment(time, channels, omega)
    return np.asarray(sine_fit(segment).phasors(k) * np.exp(-1j * k * omega * segment.centre))


def test_fit_is_exact_on_uneven_samples_with_harmonics_offset_and_drift():
    time, omega = uneven(900), 2.0 * np.pi * 1.3
    channels = two_channels(time, omega)
    for k in range(1, HARMONICS + 1):
        expected = [MOTION.get(k, 0.0), FORCE.get(k, 0.0)]
        np.testing.assert_allclose(
            phasors_at_zero(time, channels, omega, k), expected, rtol=0, atol=1e-11
        )


def test_frequency_minimises_the_weighted_squares_of_both_channels():
    time, omega = uneven(700), 2.0 * np.pi * 1.3
    rng = np.random.default_rng(3)
    clean = np.stack([waveform(omega * time, {1: 1.0}), waveform(omega * time, {1: 2.0j})])
    channels = clean + np.array([[0.2], [0.6]]) * rng.standard_normal(clean.shape)
    found = estimate_frequency(track_phase(steady_segment(time, channels, 1.001 * omega), 1))
    weights = 1.0 / np.std(sine_fit(found).residual, axis=1)

    def residual(relative):
        k = np.arange(1, 4)[:, None] * omega * relative[0]
        basis = np.vstack([np.ones_like(time), time, np.cos(k * time), np.sin(k * time)])
        fitted = np.linalg.lstsq(basis.T, channels.T, rcond=None)[0]
        return np.asarray((weights * (channels.T - basis.T @ fitted)).ravel())

    best = least_squares(residual, [1.0], x_scale=1e-4, xtol=1e-14, ftol=1e-14).x[0]
    allowed = 0.2 * np.sqrt(24.0 / time.size) * 0.2 / (omega * 0.5 * np.ptp(time))
    assert found.omega / omega == pytest.approx(best, abs=allowed)


def test_track_phase_follows_a_sweep():
    time = np.arange(4000) / 200.0
    phase = 2.0 * np.pi * (1.0 * time + 0.02 * time**2)
    x = np.cos(phase)
    segment = track_phase(steady_segment(time, np.stack([x, x]), 2.0 * np.pi * 1.35), 3)
    turned = segment.theta - phase
    assert np.ptp(turned) < 0.02
    expected = 2.0 * np.pi * (1.0 + 0.04 * segment.centre)
    assert segment.omega == pytest.approx(expected, rel=1e-4)

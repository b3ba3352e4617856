from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.sine_fit import (
    HARMONICS,
    estimate_frequency,
    first_cycles,
    last_cycles,
    sine_fit,
    steady_segment,
    thinned,
    track_phase,
    whole_cycles,
)

MOTION = {1: 2.0 - 1.0j, 3: 0.1 + 0.2j, 4: -0.05j}
FORCE = {1: 1.0 + 3.0j, 2: 0.3 + 0.0j, 3: -0.7j, 5: 0.2 + 0.1j, 7: 0.1 + 0.0j, 9: 0.05j}


def waveform(theta: FloatArray, phasors: dict[int, complex]) -> FloatArray:
    parts = [(Y * np.exp(1j * k * theta)).real for k, Y in phasors.items()]
    return np.asarray(np.sum(parts, axis=0))


def two_channels(time: FloatArray, omega: float, noise: float = 0.0) -> FloatArray:
    rng = np.random.default_rng(5)
    both = np.stack([waveform(omega * time, MOTION), waveform(omega * time, FORCE)])
    drift = np.array([[3.0], [-2.0]]) + np.array([[0.3], [0.5]]) * time
    return both + drift + noise * rng.standard_normal(both.shape)


def uneven(n: int, seed: int = 0) -> FloatArray:
    """Jittered samples with one of five missing and a gap."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / 100.0 + rng.uniform(-0.004, 0.004, n)
    kept = (rng.random(n) > 0.2) & ((time < 3.1) | (time > 4.7))
    return time[kept]


def phasors_at_zero(time: FloatArray, channels: FloatArray, omega: float, k: int) -> ComplexArray:
    segment = steady_segment(time, channels, omega)
    return np.asarray(sine_fit(segment).phasors(k) * np.exp(-1j * k * omega * segment.centre))


def test_fit_is_exact_on_uneven_samples_with_harmonics_offset_and_drift() -> None:
    time, omega = uneven(900), 2.0 * np.pi * 1.3
    channels = two_channels(time, omega)
    for k in range(1, HARMONICS + 1):
        expected = [MOTION.get(k, 0.0), FORCE.get(k, 0.0)]
        np.testing.assert_allclose(
            phasors_at_zero(time, channels, omega, k), expected, rtol=0, atol=1e-11
        )


def test_fit_agrees_with_numpy_lstsq_in_noise() -> None:
    time, omega = uneven(600), 2.0 * np.pi * 1.3
    channels = two_channels(time, omega, noise=0.3)
    segment = steady_segment(time, channels, omega)
    fit = sine_fit(segment)
    k = np.arange(1, fit.orders + 1)[:, None]
    basis = np.vstack(
        [np.ones_like(time), time, np.cos(k * segment.theta), np.sin(k * segment.theta)]
    )
    expected, left, _, _ = np.linalg.lstsq(basis.T, channels.T, rcond=None)
    phasor = expected[2] - 1j * expected[2 + fit.orders]
    np.testing.assert_allclose(fit.phasors(1), phasor, rtol=1e-10)
    np.testing.assert_allclose(np.sum(fit.residual**2, axis=1), left, rtol=1e-10)


def test_phasor_variance_is_that_of_white_noise() -> None:
    time, omega = uneven(500), 2.0 * np.pi * 1.3
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(400):
        segment = steady_segment(time, rng.standard_normal((2, time.size)), omega)
        fit = sine_fit(segment)
        errors.append(np.abs(fit.phasors(1)) ** 2 / fit.phasor_variance(1))
    assert np.mean(errors) == pytest.approx(1.0, abs=4.0 / np.sqrt(800))


def test_phasors_of_a_waveform_are_those_of_a_fit_to_it() -> None:
    time, omega = uneven(700), 2.0 * np.pi * 1.3
    channels = two_channels(time, omega, noise=0.3)
    fit = sine_fit(steady_segment(time, channels, omega))
    for channel, wave in enumerate(channels):
        expected = [fit.phasors(k)[channel] for k in range(1, fit.orders + 1)]
        found = fit.phasors_of(wave)
        np.testing.assert_allclose(found[1:], expected, rtol=1e-9, atol=1e-12)
        assert found[0].real == pytest.approx(fit.phasors(0)[channel].real, rel=1e-9)


def test_variance_of_the_mean_is_that_of_the_normal_equations() -> None:
    time, omega = uneven(400), 2.0 * np.pi * 1.3
    segment = steady_segment(time, two_channels(time, omega), omega)
    fit = sine_fit(segment)
    k = np.arange(1, fit.orders + 1)[:, None]
    basis = np.vstack(
        [np.ones_like(time), segment.tau, np.cos(k * segment.theta), np.sin(k * segment.theta)]
    )
    assert fit.phasor_variance(0) == pytest.approx(np.linalg.inv(basis @ basis.T)[0, 0], rel=1e-9)


def test_block_means_pass_each_harmonic_as_a_mean_of_its_samples_does() -> None:
    size, omega = 8, 2.0 * np.pi
    time = np.arange(640) / 64.0
    means = time.reshape(-1, size).mean(axis=1)
    segment = steady_segment(means, np.zeros((2, means.size)), omega, size)
    passed = segment.passed(3)
    assert passed is not None
    for k in (1, 2, 3):
        mean = np.exp(1j * k * omega * time).reshape(-1, size).mean(axis=1)
        np.testing.assert_allclose(mean, passed[k - 1] * np.exp(1j * k * omega * means), rtol=1e-12)


def test_trend_follows_a_growing_amplitude() -> None:
    time = np.arange(2000) / 100.0
    omega = 2.0 * np.pi * 1.3
    carrier = np.exp(1j * omega * time)
    x = ((1.0 + 0.02 * time) * carrier).real
    force = (((2.0 + 1.0j) + (0.1 - 0.3j) * time) * carrier).real
    segment = steady_segment(time, np.stack([x, force]), omega)
    fit = sine_fit(segment, trend=True)
    turn = np.exp(1j * omega * segment.centre)
    middle = [1.0 + 0.02 * segment.centre, (2.0 + 1.0j) + (0.1 - 0.3j) * segment.centre]
    np.testing.assert_allclose(fit.phasors(1), np.array(middle) * turn, atol=1e-10)
    slopes = np.array([0.02, 0.1 - 0.3j]) * segment.half_width * turn
    np.testing.assert_allclose(fit.slopes(1), slopes, atol=1e-10)


@pytest.mark.parametrize("wrong", [0.97, 0.999, 1.001, 1.03])
def test_frequency_is_found_from_a_wrong_start(wrong: float) -> None:
    time, omega = uneven(3000), 2.0 * np.pi * 1.3
    segment = steady_segment(time, two_channels(time, omega), wrong * omega)
    found = estimate_frequency(track_phase(segment, 1))
    assert found.omega == pytest.approx(omega, rel=1e-9)


def test_frequency_minimises_the_weighted_squares_of_both_channels() -> None:
    time, omega = uneven(700), 2.0 * np.pi * 1.3
    rng = np.random.default_rng(3)
    clean = np.stack([waveform(omega * time, {1: 1.0}), waveform(omega * time, {1: 2.0j})])
    channels = clean + np.array([[0.2], [0.6]]) * rng.standard_normal(clean.shape)
    found = estimate_frequency(track_phase(steady_segment(time, channels, 1.001 * omega), 1))
    weights = 1.0 / np.std(sine_fit(found).residual, axis=1)

    def residual(relative: FloatArray) -> FloatArray:
        k = np.arange(1, 4)[:, None] * omega * relative[0]
        basis = np.vstack([np.ones_like(time), time, np.cos(k * time), np.sin(k * time)])
        fitted = np.linalg.lstsq(basis.T, channels.T, rcond=None)[0]
        return np.asarray((weights * (channels.T - basis.T @ fitted)).ravel())

    best = least_squares(residual, [1.0], x_scale=1e-4, xtol=1e-14, ftol=1e-14).x[0]
    allowed = 0.2 * np.sqrt(24.0 / time.size) * 0.2 / (omega * 0.5 * np.ptp(time))
    assert found.omega / omega == pytest.approx(best, abs=allowed)


@pytest.mark.parametrize("wrong", [0.8, 1.1])
def test_frequency_that_is_not_there_is_refused(wrong: float) -> None:
    time, omega = np.arange(3000) / 100.0, 2.0 * np.pi * 1.3
    start = steady_segment(time, two_channels(time, omega), wrong * omega)
    with pytest.raises(ExtractionError, match=rf"no steady frequency near {wrong * 1.3:.6g} Hz"):
        estimate_frequency(start)


def test_track_phase_follows_a_sweep() -> None:
    time = np.arange(4000) / 200.0
    phase = 2.0 * np.pi * (1.0 * time + 0.02 * time**2)
    x = np.cos(phase)
    segment = track_phase(steady_segment(time, np.stack([x, x]), 2.0 * np.pi * 1.35), 3)
    turned = segment.theta - phase
    assert np.ptp(turned) < 0.02
    expected = 2.0 * np.pi * (1.0 + 0.04 * segment.centre)
    assert segment.omega == pytest.approx(expected, rel=1e-4)


@given(cycles=st.integers(2, 40), per_cycle=st.floats(5.0, 300.0))
def test_whole_cycles_counts_to_within_half_a_sample(cycles: int, per_cycle: float) -> None:
    n = int(np.ceil(cycles * per_cycle))
    time = np.arange(n) / per_cycle
    segment = steady_segment(time, np.zeros((2, n)), 2.0 * np.pi)
    assert whole_cycles(segment) == cycles
    assert whole_cycles(steady_segment(time[:-2], np.zeros((2, n - 2)), 2.0 * np.pi)) < cycles


@given(cycles=st.integers(3, 20), left=st.integers(1, 3))
def test_cycles_are_cut_from_either_end(cycles: int, left: int) -> None:
    time = np.arange(cycles * 50 + 17) / 50.0
    segment = steady_segment(time, np.tile(time, (2, 1)), 2.0 * np.pi)
    last = last_cycles(segment, left)
    assert last.time.size == left * 50
    assert last.time[-1] == time[-1]
    np.testing.assert_allclose(last.theta, segment.theta[-left * 50 :], atol=1e-9)
    first = first_cycles(segment, left)
    assert first.time[0] == time[0]
    assert first.time.size == left * 50


def test_block_means_keep_time_phase_and_phasors() -> None:
    time = np.arange(20_000) / 1000.0
    omega = 2.0 * np.pi * 1.7
    segment = steady_segment(time, two_channels(time, omega), omega)
    few = thinned(segment)
    assert 40 < few.time.size / (1.7 * 20.0) <= 65
    np.testing.assert_allclose(few.theta, np.interp(few.time, time, segment.theta), atol=1e-9)
    np.testing.assert_allclose(sine_fit(few).phasors(1), sine_fit(segment).phasors(1), rtol=1e-3)
    assert thinned(few) is few


def test_too_few_samples_are_refused_with_their_number() -> None:
    time = np.arange(40) / 2.1
    with pytest.raises(ExtractionError, match=r"40 samples at 2\.1 samples a cycle near t = 9\.2"):
        sine_fit(steady_segment(time, np.zeros((2, 40)), 2.0 * np.pi))


def test_samples_that_cannot_tell_harmonics_apart_are_refused() -> None:
    time = np.sort(np.concatenate([np.arange(60.0), np.arange(60.0) + 0.01]))
    segment = steady_segment(time, np.zeros((2, 120)), 2.0 * np.pi)
    with pytest.raises(ExtractionError, match="do not separate the harmonics of 1 Hz apart"):
        sine_fit(segment)

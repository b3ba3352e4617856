"""Points of extraction: dense samples, harmonics that alias, noise of lines."""

import numpy as np
import pytest

from benchmarks.extraction_validation import FRICTION, covers, steady
from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.elements import Dahl
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction import extract
from dahl_ident.extraction.sine_fit import line_noise, sine_fit, steady_segment

# A densely sampled record: points are those of all samples, and their errors hold.

RATE, FREQUENCY, CYCLES = 10_000.0, 5.0, 12
DENSE = Dahl(f_max=0.1, sigma=30.0)


def dense(noise=0.0, seed=0):
    """Return time, displacement and force at 2000 samples a cycle."""
    t = np.arange(int(CYCLES * RATE / FREQUENCY)) / RATE
    draws = noise * np.random.default_rng(seed).standard_normal((2, t.size))
    x = 4e-3 * np.sin(2.0 * np.pi * FREQUENCY * t)
    return t, x + 1e-3 * draws[0], DENSE.force(x) + draws[1]


def test_points_are_those_of_least_squares_on_the_samples():
    t, x, force = dense(1e-3)
    data = extract(Record(t, displacement=x, force=force), frequency=FREQUENCY, settling_periods=2)
    kept = t >= 2.0 / FREQUENCY
    theta = 2.0 * np.pi * FREQUENCY * t[kept]
    k = np.arange(1, 41)[:, None]
    basis = np.vstack([np.ones(theta.size), theta, np.cos(k * theta), np.sin(k * theta)])
    c = np.linalg.lstsq(basis.T, np.array([x[kept], force[kept]]).T, rcond=None)[0]
    X, F = np.vstack([c[2:42] - 1j * c[42:]]).T
    for row, order in enumerate(data.harmonic.tolist()):
        expected = F[order - 1] * (abs(X[0]) / X[0]) ** order / abs(X[0])
        error = np.sqrt(0.5 * np.trace(data.covariance[row]))
        assert abs(data.response[row] - expected) < 0.15 * error
    assert data.quality["num_periods"][0] == CYCLES
    assert data.quality["start_time"][0] == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize("harmonic", [1, 9])
def test_stated_errors_hold(harmonic):
    """The scatter of 60 records over the stated variance, by chi-square bounds of 1 in 1000."""
    errors, stated = [], []
    exact = complex(*DENSE.fourier_coefficients(4e-3, harmonic)) / 4e-3
    for seed in range(60):
        t, x, force = dense(1e-3, seed)
        data = extract(
            Record(t, displacement=x, force=force),
            frequency=FREQUENCY, harmonics=[harmonic], settling_periods=2,
        )  # fmt: skip
        errors.append(data.response[0] - exact.conjugate())
        stated.append(np.trace(data.covariance[0]))
    ratio = np.mean(np.abs(errors) ** 2) / np.mean(stated)
    assert 0.63 < ratio < 1.52  # chi-square of 120 over 120, with 2 % for the stated variance


def test_single_samples_are_judged():
    t, x, force = dense(1e-5)
    rounded = Record(t, displacement=np.round(x / 5e-4) * 5e-4, force=force)
    assert extract(rounded).quality["displacement_steps"][0] == pytest.approx(8.0, rel=0.02)
    clipped = Record(t, displacement=x, force=np.clip(force, -0.08, 0.08))
    assert "force clipped" in extract(clipped).quality["verdict"][0]
    buried = force + 0.2 * np.random.default_rng(1).standard_normal(t.size)
    with pytest.raises(
        ExtractionError, match=r"force .* the fundamental has 9\.\d* % of the power"
    ):
        extract(Record(t, displacement=x, force=buried))


def test_more_than_half_a_step_of_noise_dithers():
    t, x, force = dense(1e-4)
    noise, step = np.random.default_rng(3).standard_normal(t.size), 2e-4
    errors = []
    for steps in (0.48, 0.52):
        rounded = np.round((x + steps * step * noise) / step) * step
        errors.append(extract(Record(t, displacement=rounded, force=force)).amplitude_std[0])
    assert errors[0] > 3.0 * errors[1]


# Harmonics that alias, against exact forces sampled too seldom.


def sampled(per_cycle, beta, noise, cycles=20, phase=0.4):
    rng = np.random.default_rng(5)
    n = int(cycles * per_cycle)
    time: FloatArray = np.arange(n, dtype=np.float64) / per_cycle
    x, force = steady(beta, phase + 2.0 * np.pi * time)
    force = force + noise * rng.standard_normal(n)
    return extract(
        Record(time, displacement=x + beta * noise * rng.standard_normal(n), force=force),
        harmonics=(1,),
        frequency=1.0,
    )


def error_and_std(data, beta):
    exact = FRICTION.describing_function(beta)
    return abs(data.response[0] - exact), float(np.sqrt(np.trace(data.covariance[0])))


@pytest.mark.parametrize("per_cycle", [8, 16, 32, 64])
@pytest.mark.parametrize("beta", [0.3, 3.0, 10.0, 30.0])
def test_the_error_that_repeats_is_stated(per_cycle, beta):
    """Without noise nothing but aliases are left, more or less with the sampling's phase."""
    phases = 0.4 + np.arange(5) * 2.0 * np.pi / per_cycle / 5.0
    both = [error_and_std(sampled(per_cycle, beta, 1e-9, phase=p), beta) for p in phases.tolist()]
    error, std = np.sqrt(np.mean(np.square(both), axis=0))
    assert 0.9 * error < std < 5.0 * error


@pytest.mark.parametrize(("per_cycle", "beta"), [(200.0, 3.0), (31.5, 3.0)])
def test_nothing_is_added_where_nothing_aliases(per_cycle, beta):
    """The bound for white noise, with two channels, is hardly exceeded."""
    noise, cycles = 1e-3, 20
    data = sampled(per_cycle, beta, noise, cycles)
    _, std = error_and_std(data, beta)
    N = abs(FRICTION.describing_function(beta))
    bound = np.sqrt(4.0 / (cycles * per_cycle)) * noise * np.hypot(1.0 / beta, N)
    assert std == pytest.approx(bound, rel=0.35)
    assert covers(data, 0, complex(FRICTION.describing_function(beta)), 0.999)


def test_few_samples_are_reported():
    assert sampled(8, 10.0, 1e-4).quality["verdict"].tolist() == [
        "harmonics alias at 8 samples a cycle"
    ]
    assert sampled(64, 10.0, 1e-4).quality["verdict"].tolist() == ["good"]


@pytest.mark.parametrize(("per_cycle", "reported"), [(2.994, True), (4.0, True), (4.3, False)])
def test_harmonics_that_alias_unseen_are_reported(per_cycle, reported):
    verdict = "harmonics alias at" if reported else "good"
    assert str(sampled(per_cycle, 1.0, 1e-4).quality["verdict"][0]).startswith(verdict)


PER_CYCLE = 50


def noise_fit(channels, cycles, time=None):
    n = channels.shape[1]
    t = np.arange(n) / PER_CYCLE if time is None else time
    return sine_fit(steady_segment(t, channels, 2.0 * np.pi))


def test_what_repeats_is_no_noise():
    cycles, beta = 8, 30.0
    time: FloatArray = np.arange(cycles * 200) / np.float64(200.0)
    fit = noise_fit(np.stack(steady(beta, 2.0 * np.pi * time + 0.7)), cycles, time)
    assert np.std(fit.residual[1]) > 5e-4
    for noise in line_noise(fit, [1, 3, 9], cycles, fit.residual):
        assert np.sqrt(noise.matrix[1, 1].real) < 1e-5


def test_shared_noise_is_seen_with_its_phase():
    rng = np.random.default_rng(4)
    cycles = 40
    shared = rng.standard_normal(cycles * PER_CYCLE + 1)
    channels = np.stack([shared[1:], 2.0 * shared[:-1]])
    fit = noise_fit(channels, cycles)
    matrix = line_noise(fit, [1], cycles, fit.residual)[0].matrix
    coherence = matrix[0, 1] / np.sqrt(matrix[0, 0] * matrix[1, 1])
    assert abs(coherence) == pytest.approx(1.0, abs=1e-3)
    assert np.angle(coherence) == pytest.approx(2.0 * np.pi / PER_CYCLE, abs=0.02)
    np.testing.assert_allclose(matrix, matrix.conj().T)


def test_gaps_leave_the_noise_right_and_take_degrees_of_freedom():
    rng = np.random.default_rng(9)
    cycles = 20
    time = np.arange(cycles * PER_CYCLE) / PER_CYCLE
    time = time[(time < 4.3) | (time > 14.1)]
    levels, dof = [], 0.0
    for _ in range(200):
        fit = noise_fit(rng.standard_normal((2, time.size)), cycles, time)
        noise = line_noise(fit, [1], cycles, fit.residual)[0]
        levels += np.diagonal(noise.matrix).real.tolist()
        dof = noise.dof
    assert np.mean(levels) == pytest.approx(1.0, abs=0.06)
    assert dof < 36.0


@pytest.mark.parametrize(("cycles", "dof"), [(2, 3.2), (3, 6.26), (4, 6.92), (100, 40.0)])
def test_degrees_of_freedom(cycles, dof):
    rng = np.random.default_rng(0)
    fit = noise_fit(rng.standard_normal((2, cycles * PER_CYCLE)), cycles)
    assert line_noise(fit, [1], cycles, fit.residual)[0].dof == pytest.approx(dof, rel=0.01)

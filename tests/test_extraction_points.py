"""Points of extraction: joined parts, block means, harmonics that alias, noise of lines."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.extraction_validation import FRICTION, covers, steady
from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.elements import Dahl
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction import extract
from dahl_ident.extraction.from_record import Point, joined
from dahl_ident.extraction.sine_fit import line_noise, sine_fit, steady_segment

# Points of two parts of a level, against the weights and covariances written out by hand.

MEANS = (
    "bias_real", "bias_imag", "displacement_share", "force_share", "displacement_distortion",
    "force_distortion", "asymmetry", "displacement_steps", "force_steps", "displacement_clipped",
    "force_clipped",
)  # fmt: skip


def point(size, cycles, start, **changes):
    """Return a point at 2 Hz whose own variances are `size`, and a quarter of it repeats."""
    joint = size * np.array([np.diag([1.0, 2.0, 2.0]), np.diag([1.0, 6.0, 6.0])])
    quality = {
        **{name: np.full(2, size) for name in MEANS},
        "settled": np.array([True, True]),
        "more_periods": np.array([0, int(size)]),
        "num_periods": cycles + 1,
        "settling_periods": 1,
        "start_time": start,
        "end_time": start + (cycles + 1) / 2.0,
        "verdict": ["good", "good"],
    }
    return Point(
        2.0, 1.0 + 1e-4 * size, 3.0, [1, 3], np.array([1.0 + size * 1j, size]),
        joint, 0.25 * joint, np.array([4.0, 8.0]), False, {**quality, **changes},
    )  # fmt: skip


A, B = point(1.0, 6, 0.0), point(2.0, 2, 4.0)


def test_both_parts_count_by_their_cycles():
    (both,) = joined([A], [B])
    np.testing.assert_allclose(both.response, 0.75 * A.response + 0.25 * B.response)
    assert both.amplitude == pytest.approx(0.75 * A.amplitude + 0.25 * B.amplitude)
    own = 0.75**2 * 0.75 * A.joint + 0.25**2 * 0.75 * B.joint
    repeating = 0.25 * (0.75 * A.joint + 0.25 * B.joint)
    np.testing.assert_allclose(both.repeating, repeating)
    np.testing.assert_allclose(both.joint, own + repeating)
    share = 0.75**2 / (0.75**2 + 0.25**2 * 2.0)
    np.testing.assert_allclose(both.dof, A.dof / (share**2 + (1.0 - share) ** 2))
    quality = both.quality
    assert (quality["num_periods"], quality["settling_periods"]) == (10, 2)
    assert quality["end_time"] == B.quality["end_time"]
    assert quality["more_periods"].tolist() == [0, 2]
    np.testing.assert_allclose(quality["force_steps"], 1.25)


def test_what_speaks_against_either_part_is_told_once():
    a = point(1.0, 6, 0.0, verdict=["force clipped", "good"])
    b = point(2.0, 2, 4.0, verdict=["force clipped; not settled", "good"])
    assert joined([a], [b])[0].quality["verdict"] == ["force clipped; not settled", "good"]


def test_a_part_that_has_not_settled_is_settling_of_the_other():
    a = point(1.0, 6, 0.0, settled=np.array([True, False]))
    (both,) = joined([a], [B])
    np.testing.assert_array_equal(both.joint, B.joint)
    assert (both.quality["num_periods"], both.quality["settling_periods"]) == (10, 8)


@pytest.mark.parametrize(
    "other",
    [
        point(2.0, 2, 6.0),  # five cycles after the end of A at 3.5 s; four may be missing
        replace(B, harmonic=[1, 5]),
        replace(B, amplitude=1.1),
        replace(B, frequency_hz=2.2),
        replace(B, sweep=True),
    ],
)
def test_other_levels_stay_apart(other):
    assert joined([A], [other]) == [A, other]
    assert len(joined([A], [point(2.0, 2, 5.4)])) == 1


# Block means of a densely sampled record: no bias, no loss, and single samples still judged.

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


def test_a_look_at_some_samples_says_whether_noise_dithers(monkeypatch):
    t, x, force = dense(1e-4)
    noise, step = np.random.default_rng(3).standard_normal(t.size), 2e-4
    errors = []
    for steps in (0.48, 0.52):  # of noise; more than half a step dithers
        rounded = np.round((x + steps * step * noise) / step) * step
        record = Record(t, displacement=rounded, force=force)
        some = extract(record).amplitude_std
        with monkeypatch.context() as patch:
            patch.setattr("dahl_ident.extraction.phasors._RESIDUAL_SAMPLES", t.size)
            every = extract(record).amplitude_std
        np.testing.assert_array_equal(some, every)
        errors.append(every[0])
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

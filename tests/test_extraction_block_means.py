"""Block means of a densely sampled record: no bias, no loss, and single samples still judged."""

import numpy as np
import pytest

from dahl_ident.data import Record
from dahl_ident.elements import Dahl
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction import extract

RATE, FREQUENCY, CYCLES = 10_000.0, 5.0, 12
FRICTION = Dahl(f_max=0.1, sigma=30.0)


def dense(noise=0.0, seed=0):
    """Return time, displacement and force at 2000 samples a cycle."""
    t = np.arange(int(CYCLES * RATE / FREQUENCY)) / RATE
    draws = noise * np.random.default_rng(seed).standard_normal((2, t.size))
    x = 4e-3 * np.sin(2.0 * np.pi * FREQUENCY * t)
    return t, x + 1e-3 * draws[0], FRICTION.force(x) + draws[1]


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
    exact = complex(*FRICTION.fourier_coefficients(4e-3, harmonic)) / 4e-3
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

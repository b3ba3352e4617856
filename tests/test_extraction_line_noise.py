import numpy as np
import pytest
from scipy import stats

from benchmarks.extraction_validation import one_over_f, steady, white
from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.line_noise import line_noise
from dahl_ident.extraction.sine_fit import sine_fit, steady_segment

PER_CYCLE = 50


def noise_fit(channels, cycles, time=None):
    n = channels.shape[1]
    t = np.arange(n) / PER_CYCLE if time is None else time
    return sine_fit(steady_segment(t, channels, 2.0 * np.pi))


@pytest.mark.parametrize("cycles", [2, 3, 5, 20])
@pytest.mark.parametrize("harmonic", [1, 3])
def test_white_noise_has_its_variance_next_to_every_harmonic(cycles, harmonic):
    rng = np.random.default_rng(cycles)
    powers, dof = [], 0.0
    for _ in range(150):
        fit = noise_fit(rng.standard_normal((2, cycles * PER_CYCLE)) * [[0.1], [2.0]], cycles)
        noise = line_noise(fit, [harmonic], cycles, fit.residual)[0]
        powers.append(np.diagonal(noise.matrix).real / [0.01, 4.0])
        dof = noise.dof
    allowed = 4.0 * np.sqrt(2.0 / dof / 300)
    assert np.mean(powers) == pytest.approx(1.0, abs=allowed)


@pytest.mark.parametrize("noise", [white, one_over_f])
@pytest.mark.parametrize("cycles", [3, 12])
def test_stated_error_is_that_of_the_phasor(noise, cycles):
    rng = np.random.default_rng(7)
    records, inside, ratio = 300, 0, 0.0
    for _ in range(records):
        force = noise(rng, cycles * PER_CYCLE)
        fit = noise_fit(np.stack([force, force]), cycles)
        near = line_noise(fit, [1], cycles, fit.residual)[0]
        stated = float(near.matrix[1, 1].real) * fit.phasor_variance(1)
        error = abs(fit.phasors(1)[1]) ** 2
        inside += error / stated <= stats.f.ppf(0.95, 2, near.dof)
        ratio += error / stated / records
    assert stats.binomtest(inside, records, 0.95).pvalue > 0.01


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

import numpy as np
import pytest

from benchmarks.extraction_validation import steady
from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.sine_fit import line_noise, sine_fit, steady_segment

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

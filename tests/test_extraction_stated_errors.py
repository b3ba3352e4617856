"""Stated errors against noise that is known: covariance, degrees of freedom, chance, transient.

The samples in a cycle are not a whole number, so nothing aliases, and the stated covariance has
the theory's value: of n samples with noise sigma a phasor has E abs(e)^2 = 4 sigma^2/n.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from benchmarks.extraction_validation import FRICTION, one_over_f, steady
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import Record
from dahl_ident.extraction import extract
from dahl_ident.extraction.sine_fit import sine_fit, steady_segment
from dahl_ident.extraction.transient import estimate_transient

BETA, CYCLES, PER_CYCLE, RUNS = 2.0, 12, 60.37, 60
N = int(CYCLES * PER_CYCLE)
ORDERS = (1, 3, 5)


@dataclass(frozen=True)
class Simulated:
    """Errors along and across each response, their stated covariance, and dof: (runs, rows)."""

    error: ComplexArray
    covariance: FloatArray
    dof: FloatArray
    theory: FloatArray  # (rows, 2): variance along and across
    size: FloatArray


def simulated(displacement_noise, force_noise):
    rng = np.random.default_rng(5)
    time = np.arange(N) / PER_CYCLE
    x, force = steady(BETA, 0.4 + 2.0 * np.pi * time)
    exact = np.array([np.subtract(*_parts(k)) for k in ORDERS]) / BETA
    turn = exact / np.abs(exact)
    rotation = np.array([[[u.real, u.imag], [-u.imag, u.real]] for u in turn])
    errors, covariances, dof = [], [], []
    for _ in range(RUNS):
        noise = rng.standard_normal((2, N))
        data = extract(
            Record(
                time,
                displacement=x + displacement_noise * noise[0],
                force=force + force_noise * noise[1],
            ),
            frequency=1.0, harmonics=ORDERS, settling_periods=0,
        )  # fmt: skip
        assert data.covariance is not None
        errors.append((data.response - exact) / turn)
        covariances.append(rotation @ data.covariance @ rotation.transpose(0, 2, 1))
        dof.append(data.dof)
    relative, own = 2.0 / N * np.array([displacement_noise, force_noise]) ** 2 / BETA**2
    squares = relative * np.abs(exact) ** 2
    theory = np.array([own + squares, own + squares * np.array(ORDERS) ** 2]).T
    return Simulated(np.array(errors), np.array(covariances), np.array(dof), theory, np.abs(exact))


def _parts(k):
    a, b = FRICTION.fourier_coefficients(BETA, k)
    return complex(a), 1j * complex(b)


@pytest.fixture(scope="module")
def noisy_force():
    return simulated(0.0002, 0.02)


@pytest.fixture(scope="module")
def noisy_displacement():
    return simulated(0.02, 0.0002)


def test_stated_covariance_is_that_of_theory(noisy_force, noisy_displacement):
    """Its mean over the runs, within four standard deviations, and one per cent for the drift.

    Across the response a harmonic k has k^2 times the error of the displacement's phase.
    """
    for case, rows in ((noisy_force, (0, 1, 2)), (noisy_displacement, (0, 1))):
        for row in rows:
            bound = 0.02 + 4.0 * np.sqrt(2.0 / case.dof[:, row].mean() / RUNS)
            for axis in (0, 1):
                stated = case.covariance[:, row, axis, axis].mean()
                assert stated / case.theory[row, axis] == pytest.approx(1.0, abs=bound)


def test_errors_scatter_as_theory_has_it(noisy_force, noisy_displacement):
    """So the theory itself is right: chi-square bounds, each missed once in ten thousand."""
    low, high = (float(stats.chi2.ppf(q, RUNS)) / RUNS for q in (5e-5, 1.0 - 5e-5))
    for case in (noisy_force, noisy_displacement):
        for row in range(len(ORDERS)):
            along = np.mean(case.error[:, row].real ** 2) / case.theory[row, 0]
            across = np.mean(case.error[:, row].imag ** 2) / case.theory[row, 1]
            assert low < across < high
            assert low < along < high


def test_stated_variance_scatters_as_its_degrees_of_freedom_say(noisy_force, noisy_displacement):
    """The variance of chi-square over dof is 2/dof; of 240 runs it is known to about 11 %."""
    scatter = []
    for case in (noisy_force, noisy_displacement):
        variance = np.trace(case.covariance[:, 0], axis1=1, axis2=2)
        scatter.append(np.var(variance) / np.mean(variance) ** 2 * case.dof[:, 0].mean() / 2.0)
    assert 0.67 < np.mean(scatter) < 1.4


def test_a_region_of_95_per_cent_holds_the_truth_so_often(noisy_force, noisy_displacement):
    for case in (noisy_force, noisy_displacement):
        e = np.stack([case.error[:, 0].real, case.error[:, 0].imag], axis=1)
        statistic = 0.5 * np.einsum("ij,ijk,ik->i", e, np.linalg.inv(case.covariance[:, 0]), e)
        inside = int(np.sum(statistic < stats.f.ppf(0.95, 2, case.dof[:, 0])))
        assert stats.binomtest(inside, RUNS, 0.95).pvalue > 1e-3


@pytest.mark.parametrize("beta", [0.1, 0.5])
def test_the_transients_error_is_that_of_slow_noise(beta):
    """Error of a departure over the stated one, in 1/f noise."""
    rng = np.random.default_rng(8)
    theta: FloatArray = 0.4 + 2.0 * np.pi / PER_CYCLE * np.arange(N, dtype=np.float64)
    x, force = steady(beta, theta)
    response = complex(FRICTION.describing_function(beta))
    strokes = np.floor(theta / np.pi)
    path = 2.0 * strokes + 1.0 - np.cos(theta - np.pi * strokes)
    departing = force + 0.3 * np.exp(-beta * (path - path[0]))
    ratio = []
    for _ in range(100):
        channels = np.stack([x, departing + 0.01 * one_over_f(rng, N)])
        fit = sine_fit(steady_segment(np.arange(N) / PER_CYCLE, channels, 2.0 * np.pi))
        found = estimate_transient(fit, 1, float(np.angle(fit.phasors(1)[0])), response)
        ratio.append((found.departure - 0.3) / found.departure_std)
    assert 0.72 < np.sqrt(np.mean(np.square(ratio))) < 1.28

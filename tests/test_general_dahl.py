import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Chebyshev

from benchmarks.general_dahl_accuracy import errors
from dahl_ident.elements import linear_dahl
from dahl_ident.elements.general_dahl import stiffness, turning_force

ODD = (1, 3, 5, 7, 9, 11, 13, 15)
ALPHAS = st.floats(0.25, 4.0)


def at(value):
    return np.asarray(value, dtype=np.float64)


def larger_part(c):
    return np.maximum(np.abs(c.real), np.abs(c.imag))


@pytest.mark.parametrize(
    ("beta", "alpha"),
    [
        *((2e-6, 3.7), (1.12, 0.25), (0.9, 1 - 1e-8), (40.0, 100.0)),
        *(
            pytest.param(*point, marks=pytest.mark.long)
            for point in ((1.13, 0.25), (30.0, 1.4), (0.3, 0.01))
        ),
    ],
)
def test_agrees_with_fifty_digit_integration(beta, alpha):
    found = errors(beta, alpha, (1, 15))
    assert np.max(found[:, 0]) < 1e-12
    assert np.max(found[:, 1:]) < 1e-10


def harmonic(beta, alpha, k):
    """Return c_k."""
    return np.asarray(beta * stiffness(beta, alpha, k)[0])


def harmonic_gradient(beta, alpha, k):
    """Return c_k, beta dc_k/dbeta and dc_k/dalpha."""
    h, _, by_ln_sigma, by_alpha = stiffness(beta, alpha, k, 2)
    return [np.asarray(beta * part) for part in (h, by_ln_sigma, by_alpha)]


@pytest.mark.parametrize(
    ("alpha", "exact"),
    [
        (0.5, lambda beta: np.where(beta < np.sqrt(2.0), beta * np.sqrt(1 - beta**2 / 4), 1.0)),
        (1.0, np.tanh),
        (2.0, lambda beta: np.tanh(np.arcsinh(2.0 * beta) / 2.0)),
    ],
)
def test_turning_force_in_closed_form(alpha, exact):
    beta = np.geomspace(1e-60, 1.99, 400)
    np.testing.assert_allclose(turning_force(beta, at(alpha)), exact(beta), rtol=1e-14)


@pytest.mark.parametrize("k", ODD)
def test_meets_the_linear_model(k):
    beta = np.geomspace(1e-6, 1e6, 400)
    exact, slope = linear_dahl.harmonic_gradient(beta, k)
    c, by_ln_beta, by_alpha = harmonic_gradient(beta, at(1.0), k)
    assert np.max(np.abs(c - exact) / larger_part(exact)) < 1e-12
    assert np.max(np.abs(by_ln_beta - slope) / np.abs(slope)) < 1e-10
    for step in (1e-12, -1e-12, 1e-8, -1e-8, 1e-4, -1e-4):
        near = harmonic(beta, at(1.0 + step), k)
        straight = exact + step * by_alpha
        assert np.max(np.abs(near - straight) / larger_part(exact)) < 1e-12 + 1000 * k * step**2


def spectral_slope(values, nodes, width):
    """The derivative at the middle of the last axis, `values` being at Chebyshev nodes."""
    fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, nodes.size - 1))
    at_middle = [Chebyshev.basis(n).deriv()(0.0) for n in range(nodes.size)]
    return np.asarray(values @ (fit.T @ np.array(at_middle)) / width)


@pytest.mark.parametrize("k", [1, 5, 15])
def test_derivatives_are_those_of_the_values(k):
    nodes = np.cos(np.pi * (np.arange(14) + 0.5) / 14)
    beta = np.geomspace(1e-3, 1e6, 46)[:, None]
    alpha = np.array([0.3, 0.6, 0.95, 1.0, 1.3, 2.0, 3.9])
    _, by_ln_beta, by_alpha = harmonic_gradient(beta, alpha, k)
    wide = 0.02
    along_beta = harmonic(beta[..., None] * np.exp(wide * nodes), alpha[:, None], k)
    along_alpha = harmonic(beta[..., None], alpha[:, None] + wide * nodes, k)
    onset = np.array([2.0**-a / (1.0 - a) if a < 1.0 else np.inf for a in alpha])
    smooth = np.abs(beta / onset - 1.0) > 0.3
    for analytic, values in ((by_ln_beta, along_beta), (by_alpha, along_alpha)):
        slope = spectral_slope(values, nodes, wide)
        # differences of values hold their rounding, the more the more nodes
        rounding = np.finfo(float).eps * nodes.size**2 * np.abs(values).max(axis=-1) / wide
        assert np.all((np.abs(analytic - slope) < 1e-8 * np.abs(slope) + rounding)[smooth])


@given(exponent=st.floats(-60.0, -5.0), alpha=ALPHAS)
def test_small_amplitudes_show_alpha_times_beta(exponent, alpha):
    beta = 10.0**exponent
    h, by_ln_f_max, _, by_alpha = stiffness(at(beta), at(alpha), 1, 2)
    loss = 4.0 * alpha * beta / (3.0 * np.pi)
    assert h.real == pytest.approx(1.0, abs=20.0 * beta**2 + 1e-15)
    assert h.imag == pytest.approx(loss, rel=1e-8)
    assert complex(by_ln_f_max) == pytest.approx(-1j * loss, rel=1e-4)
    assert complex(by_alpha) == pytest.approx(1j * loss / alpha, rel=1e-4)


def test_slips_like_a_square_wave_at_large_amplitudes():
    for alpha in (0.25, 1.0, 2.0, 4.0):
        for k in ODD:
            c = harmonic(at(1e60), at(alpha), k)
            assert complex(c) == pytest.approx(4j / (np.pi * k), rel=1e-10)

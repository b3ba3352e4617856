"""The kernel of linear Dahl friction against Bessel functions with many digits."""

import math

import mpmath as mp
import numpy as np
import pytest

from dahl_ident.elements.linear_dahl import (
    describing_function,
    describing_function_gradient,
    harmonic_gradient,
)

SWITCHES = (0.2, 8.0, 75.0, 300.0)  # of the kernel, and of scipy's Bessel functions (8)
ODD = (1, 3, 5, 7, 9, 11, 13, 15)


def grid(per_decade):
    """Return random values of beta, a few per decade from 1e-12 to 1e12, and near the switches."""
    rng = np.random.default_rng(20240607)
    steps = np.arange(-12, 12, 1 / per_decade)
    full = 10.0 ** (steps + rng.random(steps.size) / per_decade)
    near = np.concatenate(
        [s * (1.0 + np.array([-1e-3, -1e-9, 0.0, 1e-9, 1e-3])) for s in SWITCHES]
        + [np.nextafter(s, [0.0, np.inf]) for s in SWITCHES]
    )
    return np.concatenate([full, near, [1e-12, 1e12]])


def exact_gradient(beta):
    """Return h, -beta h' and h + beta h' with 100 digits, of which up to 60 cancel."""
    with mp.workdps(100):
        b = mp.mpf(beta)
        tanh, sech = mp.tanh(b), mp.sech(b)
        i0, i1 = mp.besseli(0, b), mp.besseli(1, b)
        h = mp.mpc(2 * sech * i1 / b, 4 / mp.pi * (1 - tanh / b) / b)
        slope = mp.mpc(
            2 * sech * (i0 - 2 * i1 / b - i1 * tanh), 4 / (mp.pi * b) * (2 * tanh / b - 1 - sech**2)
        )
        return complex(h), complex(-slope), complex(h + slope)


def exact_harmonic(beta, k):
    """Return c_k and beta dc_k/dbeta; integration by parts makes the sine part a finite sum."""
    with mp.workdps(60):
        b = mp.mpf(beta)
        tanh, sech = mp.tanh(b), mp.sech(b)
        below, bessel, above = (mp.besseli(n, b) for n in (k - 1, k, k + 1))
        real = 2 * sech * bessel
        real_slope = b * (sech * (below + above) - tanh * real)
    lost = 4 * k + (k + 6) * max(0.0, -math.log10(beta))
    with mp.workdps(60 + int(lost)):
        b = mp.mpf(beta)
        tanh, sech = mp.tanh(b), mp.sech(b)
        imag, imag_slope = 4 / (mp.pi * k), mp.mpf(0)
        for m in range(k):
            derivative = 2**m * mp.factorial(m) * mp.binomial(k + m, 2 * m + 1)  # U^(m)_(k-1)(1)
            scale = (-1) ** m * 4 / mp.pi * derivative / b ** (m + 1)
            imag -= scale * (1 if m % 2 else tanh)
            imag_slope += scale * ((m + 1) if m % 2 else (m + 1) * tanh - b * sech**2)
        return complex(real, imag), complex(real_slope, imag_slope)


def modulus_error(value, reference):
    return float(np.max(np.abs(value - reference) / np.abs(reference)))


def part_error(value, reference):
    return float(np.max(np.abs(value / reference - 1.0)))


def test_describing_function_and_its_derivatives():
    betas = grid(20)
    exact = np.array([exact_gradient(b) for b in betas]).T
    h, by_ln_f_max, by_ln_sigma = describing_function_gradient(betas)
    np.testing.assert_array_equal(h, describing_function(betas))
    assert part_error(h.real, exact[0].real) < 1e-14
    assert part_error(h.imag, exact[0].imag) < 2e-14
    assert modulus_error(by_ln_f_max, exact[1]) < 1e-13
    assert modulus_error(by_ln_sigma, exact[2]) < 1e-12
    assert part_error(by_ln_f_max.real, exact[1].real) < 1e-12
    assert part_error(by_ln_sigma.imag, exact[2].imag) < 5e-14
    away = np.abs(np.log(betas / 1.7)) > 0.3  # from the changes of sign
    assert part_error(by_ln_f_max.imag[away], exact[1].imag[away]) < 1e-13
    assert part_error(by_ln_sigma.real[away], exact[2].real[away]) < 1e-12


@pytest.mark.parametrize("k", ODD)
def test_odd_harmonics_and_their_derivatives(k):
    betas = grid(6)
    c, by_ln_beta = harmonic_gradient(betas, k)
    reference = np.array([exact_harmonic(b, k) for b in betas]).T
    for value, expected in zip((c, by_ln_beta), reference, strict=True):
        larger = np.maximum(np.abs(expected.real), np.abs(expected.imag))
        assert np.max(np.abs(value.real - expected.real) / larger) < 1e-12
        assert np.max(np.abs(value.imag - expected.imag) / larger) < 1e-12


@pytest.mark.parametrize(("k", "tolerance"), [(31, 1e-11), (101, 1e-9)])
def test_high_harmonics(k, tolerance):
    switch = k * k / 3.0
    betas = np.array([1e-6, 0.1, 3.0, 100.0, 0.999 * switch, 1.001 * switch, 1e6])
    reference = np.array([exact_harmonic(b, k) for b in betas]).T
    c, by_ln_beta = harmonic_gradient(betas, k)
    assert modulus_error(c, reference[0]) < tolerance
    assert modulus_error(by_ln_beta, reference[1]) < tolerance


@pytest.mark.parametrize("shape", [(), (0,), (1,), (3, 4), (2, 0, 3), (8191,), (8193,), (3, 5500)])
def test_shapes_and_blocks(shape):
    beta = 10.0 ** np.random.default_rng(3).uniform(-3.0, 4.0, shape)
    values = (*describing_function_gradient(beta), *harmonic_gradient(beta, 3))
    assert {value.shape for value in values} == {shape}
    for index in list(np.ndindex(shape))[:: 1 + beta.size // 40]:
        alone = np.asarray(beta[index])
        one_by_one = (*describing_function_gradient(alone), *harmonic_gradient(alone, 3))
        np.testing.assert_allclose([v[index] for v in values], one_by_one, rtol=1e-12)

from __future__ import annotations

import math
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.linear_dahl import (
    describing_function,
    describing_function_gradient,
    harmonic,
    harmonic_gradient,
)
from tests import paper_series

SWITCHES = (0.2, 8.0, 75.0, 300.0)  # of the kernel, and of scipy's Bessel functions (8)
ODD = (1, 3, 5, 7, 9, 11, 13, 15)
BETAS = st.floats(-60.0, 60.0).map(lambda exponent: 10.0**exponent)


def grid(per_decade: int) -> FloatArray:
    """Amplitudes from 1e-12 to 1e12 at random places of a logarithmic grid, and the switches."""
    rng = np.random.default_rng(20240607)
    steps = np.arange(-12, 12, 1 / per_decade)
    full = 10.0 ** (steps + rng.random(steps.size) / per_decade)
    near = np.concatenate(
        [s * (1.0 + np.array([-1e-3, -1e-9, 0.0, 1e-9, 1e-3])) for s in SWITCHES]
        + [np.nextafter(s, [0.0, np.inf]) for s in SWITCHES]
    )
    return np.concatenate([full, near, [1e-12, 1e12]])


def exact_gradient(beta: float) -> tuple[complex, complex, complex]:
    """h, -beta h' and h + beta h' from Bessel functions at 100 digits, up to 60 of them lost."""
    with mp.workdps(100):
        b = mp.mpf(beta)
        tanh, sech = mp.tanh(b), mp.sech(b)
        i0, i1 = mp.besseli(0, b), mp.besseli(1, b)
        h = mp.mpc(2 * sech * i1 / b, 4 / mp.pi * (1 - tanh / b) / b)
        slope = mp.mpc(
            2 * sech * (i0 - 2 * i1 / b - i1 * tanh),
            4 / (mp.pi * b) * (2 * tanh / b - 1 - sech**2),
        )
        return complex(h), complex(-slope), complex(h + slope)


def exact_harmonic(beta: float, k: int) -> tuple[complex, complex]:
    """c_k and beta dc_k/dbeta; the sine part is a finite sum, by integration by parts."""
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


@pytest.fixture(scope="module")
def betas() -> FloatArray:
    return grid(60)


@pytest.fixture(scope="module")
def exact(betas: FloatArray) -> ComplexArray:
    """The three outputs of the gradient at `betas`, shape (3, n)."""
    return np.array([exact_gradient(b) for b in betas]).T


def modulus_error(value: ComplexArray, reference: ComplexArray) -> float:
    return float(np.max(np.abs(value - reference) / np.abs(reference)))


def part_error(value: FloatArray, reference: FloatArray) -> float:
    return float(np.max(np.abs(value / reference - 1.0)))


def test_each_part_of_the_describing_function(betas: FloatArray, exact: ComplexArray) -> None:
    h = describing_function(betas)
    assert part_error(h.real, exact[0].real) < 1e-14
    assert part_error(h.imag, exact[0].imag) < 2e-14


def test_derivatives_in_modulus(betas: FloatArray, exact: ComplexArray) -> None:
    h, by_ln_f_max, by_ln_sigma = describing_function_gradient(betas)
    np.testing.assert_array_equal(h, describing_function(betas))
    assert modulus_error(by_ln_f_max, exact[1]) < 1e-13
    assert modulus_error(by_ln_sigma, exact[2]) < 1e-12


def test_each_part_of_the_derivatives(betas: FloatArray, exact: ComplexArray) -> None:
    _, by_ln_f_max, by_ln_sigma = describing_function_gradient(betas)
    away = np.abs(np.log(betas / 1.7)) > 0.3  # from the changes of sign
    assert part_error(by_ln_f_max.real, exact[1].real) < 1e-12
    assert part_error(by_ln_f_max.imag[away], exact[1].imag[away]) < 1e-13
    assert part_error(by_ln_sigma.real[away], exact[2].real[away]) < 1e-12
    assert part_error(by_ln_sigma.imag, exact[2].imag) < 5e-14


@pytest.mark.parametrize("beta", [1e-3, 0.2, 1.0, 20.0, 1e4])
def test_the_reference_derivatives_are_derivatives(beta: float) -> None:
    with mp.workdps(60):
        real = mp.diff(lambda b: 2 * mp.besseli(1, b) / (b * mp.cosh(b)), beta)
        imag = mp.diff(lambda b: 4 / mp.pi * (1 - mp.tanh(b) / b) / b, beta)
        assert exact_gradient(beta)[1] == pytest.approx(complex(-beta * real, -beta * imag))


@pytest.mark.parametrize("k", ODD)
def test_odd_harmonics_and_their_derivatives(k: int) -> None:
    betas = grid(6)
    c, by_ln_beta = harmonic_gradient(betas, k)
    np.testing.assert_array_equal(c, harmonic(betas, k))
    reference = np.array([exact_harmonic(b, k) for b in betas]).T
    for value, expected in zip((c, by_ln_beta), reference, strict=True):
        larger = np.maximum(np.abs(expected.real), np.abs(expected.imag))
        assert np.max(np.abs(value.real - expected.real) / larger) < 1e-12
        assert np.max(np.abs(value.imag - expected.imag) / larger) < 1e-12


@pytest.mark.parametrize(("k", "tolerance"), [(31, 1e-11), (101, 1e-9)])
def test_high_harmonics(k: int, tolerance: float) -> None:
    switch = k * k / 3.0
    betas = np.array([1e-6, 0.1, 3.0, 100.0, 0.999 * switch, 1.001 * switch, 1e6])
    reference = np.array([exact_harmonic(b, k) for b in betas]).T
    c, by_ln_beta = harmonic_gradient(betas, k)
    assert modulus_error(c, reference[0]) < tolerance
    assert modulus_error(by_ln_beta, reference[1]) < tolerance


def test_the_first_harmonic_is_beta_times_h(betas: FloatArray) -> None:
    h, _, by_ln_sigma = describing_function_gradient(betas)
    c, by_ln_beta = harmonic_gradient(betas, 1)
    np.testing.assert_array_equal(c, betas * h)
    np.testing.assert_array_equal(by_ln_beta, betas * by_ln_sigma)


@pytest.mark.parametrize("k", [2, 4, 14, 100])
def test_even_harmonics_are_exactly_zero(k: int) -> None:
    for value in harmonic_gradient(np.array([0.0, 1e-12, 1.0, 1e3, 1e12]), k):
        assert value.dtype == np.complex128
        np.testing.assert_array_equal(value, np.zeros(5))


@pytest.mark.parametrize("k", ODD)
@pytest.mark.parametrize("beta", [1e-12, 1e-3, 0.19, 0.21, 1.0, 7.9, 40.0, 90.0])
def test_the_series_of_the_paper(beta: float, k: int) -> None:
    with mp.workdps(140):
        b = mp.mpf(beta)
        series = complex(
            paper_series.cosine_coefficient(b, k), -paper_series.sine_coefficient(b, k)
        )
    assert abs(complex(harmonic(np.array(beta), k)) - series) < 1e-12 * abs(series)


def steady_force(t: Any, beta: Any) -> Any:
    """F/f_max under x = A cos(t), Eqns. 10 (t below 0, rising x) and 11."""
    tanh = mp.tanh(beta)
    if t < 0:
        return 1 - (1 + tanh) * mp.exp(-beta * (mp.cos(t) + 1))
    return -1 + (1 + tanh) * mp.exp(beta * (mp.cos(t) - 1))


@pytest.mark.parametrize("k", [1, 2, 3, 8, 15])
@pytest.mark.parametrize("beta", [1e-3, 0.5, 2.2, 12.0, 80.0])
def test_integrals_over_the_steady_loop(beta: float, k: int) -> None:
    """Eqns. 13 and 14, with omega = 1."""
    with mp.workdps(25):
        b = mp.mpf(beta)
        corners = [-mp.pi, -mp.pi * 3 / 4, -mp.pi / 2, 0, mp.pi / 4, mp.pi / 2, mp.pi]
        a_k = mp.quad(lambda t: steady_force(t, b) * mp.cos(k * t), corners) / mp.pi
        b_k = mp.quad(lambda t: steady_force(t, b) * mp.sin(k * t), corners) / mp.pi
        expected = complex(a_k, -b_k)
    assert complex(harmonic(np.array(beta), k)) == pytest.approx(expected, rel=1e-12, abs=1e-20)


@pytest.mark.parametrize("beta", [0.3, 1.0, 6.0])
def test_the_settled_solution_of_the_differential_equation(beta: float) -> None:
    """Eqn. 2 from rest, stroke by stroke, until nothing of the start is left."""

    def slope(t: float, state: FloatArray) -> list[float]:
        velocity, force = -math.sin(t), state[0]
        rate = beta * velocity * (1.0 - force * math.copysign(1.0, velocity))
        return [rate, force * math.cos(3 * t), force * math.sin(3 * t)]

    force = 0.0
    for stroke in range(2 * math.ceil(9.0 / beta) + 1):
        start = stroke * math.pi
        # a hair inside the stroke, so that the velocity has its sign at both ends
        span = (start * (1 + 1e-15) + 1e-15, start + math.pi * (1 - 1e-15))
        stroke_end = solve_ivp(slope, span, [force, 0.0, 0.0], "DOP853", rtol=1e-12, atol=1e-13)
        force, cosine, sine = stroke_end.y[:, -1]
    expected = 2.0 / math.pi * complex(cosine, -sine)
    assert complex(harmonic(np.array(beta), 3)) == pytest.approx(expected, rel=1e-9)
    assert abs(force) == pytest.approx(math.tanh(beta), rel=1e-10)


@pytest.mark.parametrize(
    ("beta", "gain", "phase_deg"), [(1.0, 0.79291, 22.51), (2.2, 0.4988, None), (2.7, None, 44.96)]
)
def test_numbers_in_the_text_of_the_paper(
    beta: float, gain: float | None, phase_deg: float | None
) -> None:
    h = complex(describing_function(np.array(beta)))
    if gain is not None:
        assert abs(h) == pytest.approx(gain, abs=0.5 * 10.0 ** -(len(str(gain)) - 2))
    if phase_deg is not None:
        assert math.degrees(math.atan2(h.imag, h.real)) == pytest.approx(phase_deg, abs=0.005)


def test_where_the_derivatives_change_sign() -> None:
    def by_f_max_loss(beta: float) -> float:
        return float(describing_function_gradient(np.array(beta))[1].imag)

    def by_sigma_stiffness(beta: float) -> float:
        return float(describing_function_gradient(np.array(beta))[2].real)

    assert brentq(by_f_max_loss, 1.0, 3.0) == pytest.approx(1.6061, abs=5e-5)
    assert brentq(by_sigma_stiffness, 1.0, 3.0) == pytest.approx(1.8355, abs=5e-5)


def test_small_amplitudes() -> None:
    beta = np.array([1e-60, 1e-30, 1e-9, 1e-5])
    h, by_ln_f_max, by_ln_sigma = describing_function_gradient(beta)
    np.testing.assert_allclose(h.real, 1.0 - 3.0 * beta**2 / 8.0, rtol=1e-15)
    np.testing.assert_allclose(h.imag, 4.0 * beta / (3.0 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(by_ln_f_max.real, 3.0 * beta**2 / 4.0, rtol=1e-9)
    np.testing.assert_allclose(by_ln_f_max.imag, -h.imag, rtol=1e-9)
    np.testing.assert_allclose(by_ln_sigma.imag, 2.0 * h.imag, rtol=1e-9)
    for k in (3, 5, 15):
        b_k = -harmonic(beta, k).imag
        np.testing.assert_allclose(b_k, 4.0 * beta**2 / (np.pi * k * (k**2 - 4)), rtol=1e-9)


def test_large_amplitudes() -> None:
    beta = np.array([1e12, 1e30, 1e60])
    h, by_ln_f_max, by_ln_sigma = describing_function_gradient(beta)
    stiffness = 4.0 / np.sqrt(2.0 * np.pi) * beta**-1.5
    np.testing.assert_allclose(h.real, stiffness, rtol=1e-11)
    np.testing.assert_allclose(h.imag, 4.0 / (np.pi * beta), rtol=1e-11)
    np.testing.assert_allclose(by_ln_f_max.real, 1.5 * stiffness, rtol=1e-11)
    np.testing.assert_allclose(by_ln_f_max.imag, h.imag, rtol=1e-11)
    np.testing.assert_allclose(by_ln_sigma.real, -0.5 * stiffness, rtol=1e-11)
    np.testing.assert_allclose(by_ln_sigma.imag, 4.0 / (np.pi * beta**2), rtol=1e-11)
    for k in (3, 15):
        np.testing.assert_allclose(harmonic(beta, k).imag, 4.0 / (np.pi * k), rtol=1e-9)


def test_energy_is_the_area_of_the_loop() -> None:
    beta = 1.7
    with mp.workdps(25):
        rising = mp.quad(lambda t: 1 - (1 + mp.tanh(beta)) * mp.exp(-beta * (t + 1)), [-1, 1])
        area = float(2 * rising)
    assert area == pytest.approx(4.0 * (1.0 - math.tanh(beta) / beta), rel=1e-14)
    assert np.pi * harmonic(np.array(beta), 1).imag == pytest.approx(area, rel=1e-14)


def test_amplitude_zero() -> None:
    h, by_ln_f_max, by_ln_sigma = describing_function_gradient(np.array(0.0))
    assert complex(h) == 1.0
    assert complex(by_ln_f_max) == 0.0
    assert complex(by_ln_sigma) == 1.0
    for k in (1, 3, 15):
        for value in harmonic_gradient(np.zeros(1), k):
            assert value[0] == 0.0


def test_nothing_but_finite_numbers_over_the_whole_range() -> None:
    beta = np.concatenate([[0.0, 5e-324, 1e-308], np.logspace(-300, 300, 6001), [1.7e308]])
    for value in (*describing_function_gradient(beta), *harmonic_gradient(beta, 5)):
        assert np.isfinite(value).all()


@pytest.mark.parametrize("shape", [(), (0,), (1,), (3, 4), (2, 0, 3), (8191,), (8193,), (3, 5500)])
def test_shapes_and_blocks(shape: tuple[int, ...]) -> None:
    beta = 10.0 ** np.random.default_rng(3).uniform(-3.0, 4.0, shape)
    values = (*describing_function_gradient(beta), *harmonic_gradient(beta, 3))
    assert {value.shape for value in values} == {shape}
    for index in list(np.ndindex(shape))[:: 1 + beta.size // 40]:
        alone = np.asarray(beta[index])
        one_by_one = (*describing_function_gradient(alone), *harmonic_gradient(alone, 3))
        np.testing.assert_allclose([v[index] for v in values], one_by_one, rtol=1e-12)


def test_strided_amplitudes_are_left_alone() -> None:
    beta = np.logspace(-3, 4, 40).reshape(5, 8)
    before = beta.copy()
    np.testing.assert_array_equal(
        describing_function(beta.T[::2]), describing_function(beta.T[::2].copy())
    )
    np.testing.assert_array_equal(beta, before)


@given(beta=BETAS)
def test_the_two_derivatives_add_up_to_h(beta: float) -> None:
    """N is homogeneous of degree 1 in (f_max, sigma) at a given amplitude."""
    h, by_ln_f_max, by_ln_sigma = (complex(v) for v in describing_function_gradient(np.array(beta)))
    assert by_ln_f_max.real + by_ln_sigma.real == pytest.approx(h.real, rel=1e-14)
    assert by_ln_f_max.imag + by_ln_sigma.imag == pytest.approx(h.imag, rel=1e-14)


@given(beta=BETAS, factor=st.floats(1.001, 1e3))
def test_gain_falls_and_phase_rises_with_amplitude(beta: float, factor: float) -> None:
    h, further = describing_function(np.array([beta, factor * beta]))
    assert 0.0 < h.real <= 1.0
    assert 0.0 < h.imag < 1.0
    assert abs(further) <= abs(h)
    assert further.imag * h.real > h.imag * further.real

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from numpy.polynomial import Chebyshev
from numpy.typing import ArrayLike

from dahl_ident import Dahl
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import casadi_series as chebyshev
from dahl_ident.elements import general_dahl
from dahl_ident.elements.casadi_dahl import (
    Phasor,
    general_describing_function,
    linear_describing_function,
)
from dahl_ident.fitting.casadi_expansion import Expansion
from tests import chebyshev_series

Derivatives = tuple[complex, complex, complex]

BREAKS = (chebyshev.LOW, chebyshev.HIGH)


def jets(h: Phasor, variables: Sequence[ca.SX], *given: ca.SX) -> ca.Function:
    """Value, Jacobian and all second derivatives of (Re h, Im h) by `variables`."""
    v = ca.vertcat(*variables)
    parts = ca.vertcat(h.real, h.imag)
    first = ca.jacobian(parts, v)
    second = ca.jacobian(first, v)
    return ca.Function("jets", [v, *given], [parts, ca.vec(first), ca.vec(second)])


@pytest.fixture(scope="module")
def linear() -> Callable[[float], Derivatives]:
    beta = ca.SX.sym("beta")
    function = jets(linear_describing_function(beta), [beta])

    def evaluate(value: float) -> Derivatives:
        parts = (np.asarray(part).ravel() for part in function(value))
        first, second, third = (complex(re, im) for re, im in parts)
        return first, second, third

    return evaluate


def exact_linear(value: float) -> Derivatives:
    """h, h' and h'' of the closed form, with Bessel's equation for the derivatives."""
    with mp.workdps(90):
        b = mp.mpf(value)
        g = mp.besseli(1, b) / b
        g1 = (mp.besseli(0, b) - 2 * g) / b
        g2 = g - 3 * g1 / b
        t, sech = mp.tanh(b), 1 / mp.cosh(b)
        s = sech**2
        real = [2 * sech * x for x in (g, g1 - g * t, g2 - 2 * g1 * t + g * (t * t - s))]
        imag = [
            1 / b - t / b**2,
            -1 / b**2 - s / b**2 + 2 * t / b**3,
            2 / b**3 + 2 * s * t / b**2 + 4 * s / b**3 - 6 * t / b**4,
        ]
        h, h1, h2 = (complex(r, 4 / mp.pi * i) for r, i in zip(real, imag, strict=True))
        return h, h1, h2


def test_coefficients_are_those_of_mpmath() -> None:
    for name, function in chebyshev_series.SERIES.items():
        assert getattr(chebyshev, name) == chebyshev_series.coefficients(function)
    assert (chebyshev_series.LOW, chebyshev_series.HIGH) == BREAKS


@pytest.mark.parametrize("order", [0, 1, 2])
def test_linear_describing_function_and_derivatives(
    order: int, linear: Callable[[float], Derivatives]
) -> None:
    tolerance = (1e-13, 1e-11, 1e-10)[order]
    at_breaks = [b * (1.0 + step) for b in BREAKS for step in (-1e-15, 0.0, 3e-16, 1e-9, -1e-9)]
    betas = [*np.logspace(-12, 12, 97), *np.linspace(0.5, 12.0, 60), *at_breaks]
    for beta in betas:
        found, expected = linear(beta)[order], exact_linear(beta)[order]
        assert abs(found - expected) <= tolerance * abs(expected), beta
        if order == 0:
            assert abs(found.real - expected.real) <= tolerance * expected.real
            assert abs(found.imag - expected.imag) <= tolerance * expected.imag


def test_linear_limit_at_rest(linear: Callable[[float], Derivatives]) -> None:
    h, h1, h2 = linear(0.0)
    assert h == 1.0
    assert h1 == pytest.approx(4.0j / (3.0 * np.pi), rel=1e-15)
    assert h2 == pytest.approx(-0.75, rel=1e-14)


@pytest.fixture(scope="module")
def general() -> ca.Function:
    beta, alpha = ca.SX.sym("beta"), ca.SX.sym("alpha")
    return jets(general_describing_function(beta, alpha), [beta, alpha])


def general_values(function: ca.Function, beta: FloatArray, alpha: float) -> list[FloatArray]:
    points = np.array([beta, np.full(beta.shape, alpha)])
    return [np.asarray(part) for part in function.map(beta.size)(points)]


@pytest.mark.parametrize("alpha", [0.25, 0.5, 0.999, 1.0, 1.0 + 1e-9, 1.3, 2.0, 4.0])
def test_general_matches_the_quadrature_of_the_element(general: ca.Function, alpha: float) -> None:
    betas = np.logspace(-12.0, 12.0, 73)
    value, first, second = general_values(general, betas, alpha)
    h, by_ln_f_max, _, by_alpha = general_dahl.describing_function_gradient(
        betas, np.asarray(alpha)
    )
    assert np.abs(value[0] + 1j * value[1] - h).max() < 1e-12
    assert np.all(np.abs(value[0] + 1j * value[1] - h) < 1e-11 * np.abs(h))
    by_beta = first[0] + 1j * first[1]
    assert np.all(np.abs(betas * by_beta + by_ln_f_max) < 1e-9 * np.abs(h))
    assert np.all(np.abs(first[2] + 1j * first[3] - by_alpha) < 1e-9 * np.abs(h))
    assert np.isfinite(second).all()


def slope(function: Callable[[FloatArray], ComplexArray], at: float) -> complex:
    """Derivative of the polynomial of degree 16 through values within 10 % of a point."""
    domain = [at * 0.9, at * 1.1]
    real = Chebyshev.interpolate(lambda x: function(x).real, 16, domain)
    imag = Chebyshev.interpolate(lambda x: function(x).imag, 16, domain)
    return complex(real.deriv()(at), imag.deriv()(at))


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0, 3.5])
@pytest.mark.parametrize("beta", [0.02, 1.0, 30.0])
def test_general_second_derivatives(general: ca.Function, alpha: float, beta: float) -> None:
    def gradient(b: ArrayLike, a: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        b, a = np.broadcast_arrays(b, a)
        _, by_ln_f_max, _, by_alpha = general_dahl.describing_function_gradient(b, a)
        return -by_ln_f_max / b, by_alpha

    *_, second = general_values(general, np.array([beta]), alpha)
    found = second[0::2, 0] + 1j * second[1::2, 0]
    expected = [
        slope(lambda b: gradient(b, alpha)[0], beta),
        slope(lambda b: gradient(b, alpha)[1], beta),
        slope(lambda a: gradient(beta, a)[0], alpha),
        slope(lambda a: gradient(beta, a)[1], alpha),
    ]
    size = abs(complex(general_dahl.describing_function(np.asarray(beta), np.asarray(alpha))))
    for place, power in enumerate((2, 1, 1, 0)):
        assert abs(found[place] - expected[place]) < 1e-9 * size / beta**power


def test_values_of_other_exponents_known_beforehand(general: ca.Function) -> None:
    for beta, alpha, h in (
        (1.0, 2.0, 0.544039 + 0.354193j),
        (10.0, 2.0, 0.044846 + 0.103836j),
        (1.0, 0.5, 0.866025 + 0.212207j),
    ):
        re, im = general_values(general, np.array([beta]), alpha)[0].ravel()
        assert abs(complex(re, im) - h) < 1e-6


def test_general_becomes_linear_at_alpha_one(
    general: ca.Function, linear: Callable[[float], Derivatives]
) -> None:
    for beta in (1e-9, 1e-3, 0.7, 5.0, 20.999, 21.001, 1e3, 1e9):
        value, first, second = general_values(general, np.array([beta]), 1.0)
        h, h1, h2 = linear(beta)
        assert complex(*value.ravel()) == pytest.approx(h, rel=1e-12)
        assert complex(*first.ravel()[:2]) == pytest.approx(h1, rel=1e-11)
        assert complex(*second.ravel()[:2]) == pytest.approx(h2, rel=1e-9, abs=1e-15 / beta**2)


@pytest.mark.parametrize("harmonic", [3, 7])
def test_harmonics(harmonic: int) -> None:
    beta, alpha = ca.SX.sym("beta"), ca.SX.sym("alpha")
    h = general_describing_function(beta, alpha, harmonic)
    function = ca.Function("h", [ca.vertcat(beta, alpha)], [ca.vertcat(h.real, h.imag)])
    betas = np.logspace(-3.0, 6.0, 28)
    for exponent in (0.5, 1.0, 2.0):
        found = np.asarray(function.map(28)(np.array([betas, np.full(28, exponent)])))
        expected = general_dahl.harmonic(betas, np.asarray(exponent), harmonic) / betas
        size = np.abs(general_dahl.describing_function(betas, np.asarray(exponent)))
        assert np.all(np.abs(found[0] + 1j * found[1] - expected) < 1e-12 * size)


def test_even_harmonics_vanish() -> None:
    h = general_describing_function(ca.SX.sym("beta"), 2.0, 2)
    assert h.real.is_zero()
    assert h.imag.is_zero()


def test_full_slip_has_finite_derivatives(general: ca.Function) -> None:
    for alpha in (0.25, 0.4, 0.8):
        onset = 2.0**-alpha / (1.0 - alpha)
        betas = onset * (1.0 + np.array([-1e-6, -1e-12, 0.0, 1e-12, 1e-6]))
        parts = general_values(general, betas, alpha)
        assert all(np.isfinite(part).all() for part in parts)


@pytest.mark.parametrize("harmonic", [1, 2, 3])
@pytest.mark.parametrize(("at_x", "at_y"), [(0.02, -0.5), (1.0, 0.4), (30.0, 0.0)])
def test_an_expansion_has_the_derivatives_of_what_it_stands_for(
    harmonic: int, at_x: float, at_y: float
) -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    beta, alpha = x * ca.exp(y * x / (1.0 + x)), ca.exp(y)
    at = [at_x, at_y]
    expected = jets(general_describing_function(beta, alpha, harmonic), [x, y])(at)
    element = Dahl(1.0, None, None)
    expansion = Expansion(element, [ca.SX(1.0), beta, alpha], ca.SX(1.0), ca.SX(0.0), harmonic)
    point = ca.Function("point", [ca.vertcat(x, y)], [expansion.point])(at)
    known = jets(expansion.value.scaled(1.0 / beta), [x, y], expansion.symbols)
    for order in range(3):
        found = known(at, expansion.at(order, 1)(point))
        for part, exact in list(zip(found, expected, strict=True))[: order + 1]:
            np.testing.assert_allclose(part, ca.densify(exact), rtol=1e-11, atol=1e-11)


def test_phasor_arithmetic() -> None:
    symbols = [ca.SX.sym(name) for name in ("a", "b", "c", "d")]
    x, y = Phasor(symbols[0], symbols[1]), Phasor(symbols[2], symbols[3])
    for result, expected in (
        (x + y, (2 + 3j) + (5 - 7j)),
        (x - y, (2 + 3j) - (5 - 7j)),
        (x * y, (2 + 3j) * (5 - 7j)),
        (x / y, (2 + 3j) / (5 - 7j)),
    ):
        real, imag = ca.Function("f", symbols, [result.real, result.imag])(2, 3, 5, -7)
        assert complex(float(real), float(imag)) == pytest.approx(expected, rel=1e-15)

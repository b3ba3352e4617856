r"""The model as casadi expressions, which an optimiser can differentiate twice.

casadi has no complex numbers and no Bessel functions. A :class:`Phasor` holds a real and an
imaginary part; the two functions below it give the Dahl element as plain arithmetic, so that
casadi's own rules yield exact first and second derivatives.

**alpha = 1.** ``h = N/sigma`` is

    beta < 1        Re h = P(beta^2),  Im h = beta Q(beta^2)
    1 <= beta < 8   Re h = 2 (1 + tanh beta) R(beta)
    8 <= beta       Re h = 2 (1 + tanh beta) beta^(-3/2) S(1/beta)
    1 <= beta       Im h = (4/pi) (1 - tanh(beta)/beta) / beta

with Chebyshev series P, Q, R and S by Clenshaw's recurrence. Every series is evaluated at an
argument held inside its own range by ``if_else``, which casadi differentiates as the branch
that was taken: ``fmin`` and ``fmax`` would average both sides exactly at a break point.

**Any alpha, any harmonic.** The quadrature of :mod:`dahl_ident.elements.general_dahl`, written
out node by node. The loop is closed by Newton's method in ``ln E``: four steps reach rounding
from the limit of large beta wherever one starts, and each step more makes one further order of
derivative exact, since Newton's map has slope zero at its root.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident.elements import casadi_series as series
from dahl_ident.elements import general_dahl

if TYPE_CHECKING:
    import casadi as ca

_LEAST_BETA = 1e-200  # stands for rest: 0 has no logarithm
_NEWTON_STEPS = 6  # four reach rounding; both derivatives, taken through the steps, lag behind
_DEEPEST = 42.0
"""ln(z_0/z) beyond which the margin z to full slip is negligible."""


@dataclass(frozen=True)
class Phasor:
    """A complex number as two casadi expressions."""

    real: ca.SX
    imag: ca.SX

    def __add__(self, other: Phasor) -> Phasor:
        return Phasor(self.real + other.real, self.imag + other.imag)

    def __sub__(self, other: Phasor) -> Phasor:
        return Phasor(self.real - other.real, self.imag - other.imag)

    def __mul__(self, other: Phasor) -> Phasor:
        return Phasor(
            self.real * other.real - self.imag * other.imag,
            self.real * other.imag + self.imag * other.real,
        )

    def __truediv__(self, other: Phasor) -> Phasor:
        squared = other.real * other.real + other.imag * other.imag
        return (self * Phasor(other.real, -other.imag)).scaled(1.0 / squared)

    def scaled(self, factor: ca.SX) -> Phasor:
        """Return this number times a real factor."""
        return Phasor(self.real * factor, self.imag * factor)


def linear_describing_function(beta: ca.SX) -> Phasor:
    """Return h = N/sigma for alpha = 1 (Eqns. 51 and 52).

    Parameters
    ----------
    beta : casadi.SX
        sigma A/f_max >= 0, a scalar expression.

    Returns
    -------
    Phasor
        Each part within 1e-13 of itself, first and second derivatives within 1e-11 and 1e-10 of
        their absolute value, for beta from 0 to 1e12.

    Examples
    --------
    >>> import casadi as ca
    >>> beta = ca.SX.sym("beta")
    >>> h = linear_describing_function(beta)
    >>> ca.Function("h", [beta], [h.real, h.imag])(1.0)
    (DM(0.732508), DM(0.303548))
    """
    import casadi as ca

    low, high = series.LOW, series.HIGH
    is_low, is_high = beta < low, beta >= high
    below = ca.if_else(is_low, beta, low)
    above = ca.if_else(is_low, low, beta)
    between = ca.if_else(is_high, high, above)
    far = ca.if_else(is_high, beta, high)

    u = 2.0 * below * below - 1.0
    stiffness = _clenshaw(series.STIFFNESS_BELOW, u)
    loss = below * _clenshaw(series.LOSS_BELOW, u)

    tanh = ca.tanh(above)
    bessel = ca.if_else(
        is_high,
        _clenshaw(series.BESSEL_ABOVE, 2.0 * high / far - 1.0) / (far * ca.sqrt(far)),
        _clenshaw(series.BESSEL_BETWEEN, (2.0 * between - low - high) / (high - low)),
    )
    return Phasor(
        ca.if_else(is_low, stiffness, 2.0 * (1.0 + tanh) * bessel),
        ca.if_else(is_low, loss, 4.0 / np.pi * (1.0 - tanh / above) / above),
    )


def general_describing_function(beta: ca.SX, alpha: ca.SX | float, harmonic: int = 1) -> Phasor:
    """Return F_k/(X_1 sigma) for any exponent and any harmonic, by quadrature.

    Parameters
    ----------
    beta : casadi.SX
        sigma A/f_max > 0, a scalar expression.
    alpha : casadi.SX or float
        Exponent of Eqn. 2, > 0.
    harmonic : int, default 1
        k; even ones vanish.

    Returns
    -------
    Phasor
        Within 1e-11 of abs(h) for alpha from 0.25 to 4 and k = 1.

    Notes
    -----
    For alpha < 1/2 the second derivative is infinite where full slip begins, at
    beta = 2^-alpha/(1 - alpha); it is finite on either side.

    Examples
    --------
    >>> import casadi as ca
    >>> beta, alpha = ca.SX.sym("beta"), ca.SX.sym("alpha")
    >>> h = general_describing_function(beta, alpha)
    >>> ca.Function("h", [beta, alpha], [h.real, h.imag])(1.0, 2.0)
    (DM(0.544039), DM(0.354193))
    """
    import casadi as ca

    if harmonic % 2 == 0:
        return Phasor(ca.SX(0.0), ca.SX(0.0))
    return Phasor(*_quadrature(harmonic).call([ca.SX(beta), ca.SX(alpha)]))


@cache
def _quadrature(harmonic: int) -> ca.Function:
    """Return (beta, alpha) -> real and imaginary part; writing it out takes longer than a call."""
    import casadi as ca

    given, alpha = ca.SX.sym("beta"), ca.SX.sym("alpha")
    beta = ca.if_else(given > _LEAST_BETA, given, _LEAST_BETA)
    p = 1.0 - alpha
    path, length, is_deep = _close_loop(beta, p)
    # past _DEEPEST the far end of the branch holds no force: z_1 counts as 0
    line = ca.if_else(is_deep, 0.0, ca.exp(alpha * (ca.log1p(ca.tanh(length / 2.0)) - length)))
    beyond = ca.if_else(is_deep, path - _path(ca.SX(_DEEPEST), p), 0.0) / path
    beyond = ca.if_else(beyond > 0.0, beyond, 0.0)
    z0 = 1.0 + ca.tanh(length / 2.0)

    rule = general_dahl.quadrature_rule(harmonic)
    rise, fall, midpoint, fejer = (column.tolist() for column in rule)
    risen = [_path(length * node, p) / path for node in rise]
    real, imag = ca.SX(0.0), ca.SX(0.0)
    for i, to_go in enumerate(reversed(risen)):
        reached = length * rise[i]
        s, remaining = risen[i], ca.exp(-p * reached) * to_go + beyond
        sine, cosine = _multiple_angle(2.0 * ca.sqrt(s * remaining), 1.0 - 2.0 * s, harmonic)
        kept = ca.if_else(is_deep, 1.0, -ca.expm1(-alpha * length * fall[i]))
        excess = z0 * ca.exp(-reached) * kept
        real += midpoint[i] * sine * excess
        imag += fejer[i] * cosine * excess
    scale = length / (np.pi * harmonic * beta)
    if harmonic == 1:
        return ca.Function("h", [given, alpha], [scale * real + line, scale * imag])
    return ca.Function("h", [given, alpha], [scale * real, scale * imag])


def _close_loop(beta: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Solve ln E(L) = ln(2 beta) + p ln((1 + exp(-L))/2); return E, L up to _DEEPEST, L beyond."""
    import casadi as ca

    deepest = ca.SX(_DEEPEST)
    is_deep = beta >= _path(deepest, p) / 2.0 * ca.exp(p * np.log(2.0))
    solvable = ca.if_else(is_deep, 0.5, beta)  # beta = 1/2 is below full slip for every alpha
    path = 2.0 * solvable * ca.exp(-p * np.log(2.0))
    for _ in range(_NEWTON_STEPS):
        length = path * _log_ratio(p * path)
        residual = ca.log(path / (2.0 * solvable)) - p * ca.log1p(ca.expm1(-length) / 2.0)
        slope = 1.0 + p * path * ca.exp((p - 1.0) * length) / (1.0 + ca.exp(-length))
        path *= ca.exp(-residual / slope)
    length = path * _log_ratio(p * path)
    return (
        ca.if_else(is_deep, 2.0 * beta * ca.exp(-p * np.log(2.0)), path),
        ca.if_else(is_deep, deepest, length),
        is_deep,
    )


def _path(length: ca.SX, p: ca.SX) -> ca.SX:
    """Return E(L) = (1 - exp(-p L))/p, smooth through p = 0."""
    import casadi as ca

    half = p * length / 2.0
    is_small = ca.fabs(half) < 1.0
    t = ca.if_else(is_small, half, 0.0) ** 2
    series = _horner(_SINHC, t)
    x = ca.if_else(is_small, 1.0, half)
    return length * ca.exp(-half) * ca.if_else(is_small, series, ca.sinh(x) / x)


def _log_ratio(x: ca.SX) -> ca.SX:
    """Return -ln(1 - x)/x for x < 1, smooth through x = 0."""
    import casadi as ca

    is_small = ca.fabs(x) < 0.25
    y = ca.if_else(is_small, x, 0.0)
    far = ca.if_else(is_small, 0.5, x)
    series = 2.0 / (2.0 - y) * _horner(_ATANHC, (y / (2.0 - y)) ** 2)
    return ca.if_else(is_small, series, -ca.log1p(-far) / far)


_SINHC = tuple(1.0 / factorial(2 * k + 1) for k in range(10))  # in t^2 < 1; the last is 8e-18
_ATANHC = tuple(1.0 / (2 * k + 1) for k in range(10))  # in t^2 < 1/49; the last term is 3e-17


def _horner(coefficients: Sequence[float], t: ca.SX) -> ca.SX:
    total = t * 0.0 + coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * t + c
    return total


def _clenshaw(coefficients: Sequence[float], u: ca.SX) -> ca.SX:
    """Return the Chebyshev series at u in [-1, 1]."""
    after, next_after = 0.0 * u, 0.0 * u
    for c in coefficients[:0:-1]:
        after, next_after = 2.0 * u * after - next_after + c, after
    return u * after - next_after + coefficients[0]


def _multiple_angle(sine: ca.SX, cosine: ca.SX, k: int) -> tuple[ca.SX, ca.SX]:
    """Return sin(k theta) and cos(k theta)."""
    first = turned = Phasor(cosine, sine)
    for _ in range(k - 1):
        turned = turned * first
    return turned.imag, turned.real

"""A linear stiffness as polynomials in s, and as a state-space system for the time domain.

Masses, dampers, springs and linear systems in parallel have one dynamic stiffness
Z(s) = n(s)/d(s). Driven by force, the displacement obeys H(s) = d(s)/n(s); under a prescribed
displacement, Z splits into q2 s^2 + q1 s + q0, known from the motion's derivatives, and a
strictly proper rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ModelError


@dataclass(frozen=True)
class StateSpace:
    """z' = A z + B u, y = C z + D u with one input and one output, at rest at first."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: float

    @property
    def order(self) -> int:
        """Number of states."""
        return self.B.size


@dataclass(frozen=True)
class Rational:
    """n(s)/d(s), coefficients from the highest power down."""

    numerator: FloatArray
    denominator: FloatArray

    def __add__(self, other: Rational) -> Rational:
        crossed = np.polymul(self.numerator, other.denominator)
        crossed = np.polyadd(crossed, np.polymul(other.numerator, self.denominator))
        below = np.polymul(self.denominator, other.denominator).astype(np.float64)
        return Rational(crossed.astype(np.float64), below).without_common_zeros_at_0()

    def inverse(self) -> Rational:
        """Return d(s)/n(s)."""
        return Rational(self.denominator, self.numerator)

    def trimmed(self) -> Rational:
        """Return the function without leading coefficients that are rounding errors."""
        rate = typical_rate(np.trim_zeros(self.denominator, "f"))
        return Rational(_leading(self.numerator, rate), _leading(self.denominator, rate))

    def split(self) -> tuple[FloatArray, Rational]:
        """Return the polynomial part and the strictly proper rest."""
        quotient, rest = np.polydiv(self.numerator, self.denominator)
        return np.atleast_1d(quotient), Rational(np.atleast_1d(rest), self.denominator)

    def state_space(self) -> StateSpace:
        """Return a realisation whose time is scaled to the poles, so that its entries are even.

        Raises
        ------
        ModelError
            If the function is not proper.
        """
        n, d = np.trim_zeros(self.numerator, "f"), np.trim_zeros(self.denominator, "f")
        order = d.size - 1
        if n.size > d.size:
            raise ModelError(
                f"a response of degree {n.size - 1} over {order} in s has no state-space form; "
                "give the plant a mass or a damper that bounds it at high frequency"
            )
        if n.size == 0 or order == 0:
            D = float(n[0] / d[0]) if n.size else 0.0
            return StateSpace(np.zeros((0, 0)), np.zeros(0), np.zeros(0), D)
        rate = typical_rate(d)
        powers = rate ** np.arange(order, -1, -1)
        a = d * powers
        b = np.concatenate([np.zeros(d.size - n.size), n]) * powers
        a, b = a / a[0], b / a[0]
        A = np.diag(np.ones(order - 1), -1)
        A[0] = -a[1:]
        B = np.zeros(order)
        B[0] = 1.0
        return StateSpace(rate * A, rate * B, b[1:] - b[0] * a[1:], float(b[0]))

    def without_common_zeros_at_0(self) -> Rational:
        """Return the same function with powers of s that cancel left out."""
        n, d = self.numerator, self.denominator
        while n.size > 1 and d.size > 1 and n[-1] == 0.0 and d[-1] == 0.0:
            n, d = n[:-1], d[:-1]
        return Rational(n, d)


def _leading(polynomial: FloatArray, rate: float) -> FloatArray:
    """Return a polynomial without leading coefficients that are negligible at s = rate."""
    sizes = np.abs(polynomial) * rate ** np.arange(polynomial.size - 1, -1, -1)
    return polynomial[int(np.argmax(sizes > 1e-12 * np.max(sizes))) :]


def typical_rate(polynomial: FloatArray) -> float:
    """Return the geometric mean of the moduli of the roots that are not 0, rad/s."""
    nonzero = np.trim_zeros(polynomial, "b")
    if nonzero.size < 2:
        return 1.0
    return float(abs(nonzero[-1] / nonzero[0]) ** (1.0 / (nonzero.size - 1)))

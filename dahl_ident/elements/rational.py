"""Rational functions of s, such as the dynamic stiffness of a linear system, n(s)/d(s)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray


@dataclass(frozen=True)
class Rational:
    """n(s)/d(s), coefficients from the highest power down."""

    numerator: FloatArray
    denominator: FloatArray

    def __add__(self, other: Rational) -> Rational:
        numerator = np.polymul(self.numerator, other.denominator)
        numerator = np.polyadd(numerator, np.polymul(other.numerator, self.denominator))
        denominator = np.polymul(self.denominator, other.denominator).astype(np.float64)
        return Rational(numerator.astype(np.float64), denominator).without_common_zeros_at_0()

    @property
    def degrees(self) -> tuple[int, int]:
        """Degrees of numerator and denominator."""
        return self.numerator.size - 1, self.denominator.size - 1

    def trimmed(self) -> Rational:
        """Return the function without leading coefficients that are rounding errors."""
        rate = typical_rate(np.trim_zeros(self.denominator, "f"))
        return Rational(_leading(self.numerator, rate), _leading(self.denominator, rate))

    def split(self) -> tuple[FloatArray, Rational]:
        """Return the polynomial part and the strictly proper remainder."""
        quotient, remainder = np.polydiv(self.numerator, self.denominator)
        return np.atleast_1d(quotient), Rational(np.atleast_1d(remainder), self.denominator)

    def without_common_zeros_at_0(self) -> Rational:
        """Return the same function without powers of s that cancel."""
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

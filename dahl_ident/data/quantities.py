"""The six standard quantities R = s^p Z^q of ISO 7626-1, and the conversion of their errors.

Z = F/X is the dynamic stiffness, s = j omega and q = 1 or -1, so that Z = s^(-p q) R^q.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import ValidationError
from dahl_ident.units import Quantity


class QuantityForm(NamedTuple):
    """A quantity R = s^power Z^exponent."""

    power: int
    exponent: int  # 1 or -1

    @property
    def power_in_stiffness(self) -> int:
        """Power of s in Z = s^power_in_stiffness R^exponent."""
        return -self.power * self.exponent


DEFINITIONS: dict[Quantity, QuantityForm] = {
    "receptance": QuantityForm(0, -1),
    "mobility": QuantityForm(1, -1),
    "accelerance": QuantityForm(2, -1),
    "dynamic_stiffness": QuantityForm(0, 1),
    "mechanical_impedance": QuantityForm(-1, 1),
    "apparent_mass": QuantityForm(-2, 1),
}
COMPLIANCES = tuple(name for name, of in DEFINITIONS.items() if of.exponent < 0)
"""Motion over force."""
_POWERS_OF_J = (1.0 + 0.0j, 1.0j, -1.0 + 0.0j, -1.0j)  # exact, where (1j)**n rounds


def power_of_s(omega: FloatArray, power: int) -> ComplexArray:
    """Return (j omega)^power, without rounding of the direction."""
    return np.asarray(_POWERS_OF_J[power % 4] * omega ** float(power))


def converted(
    response: ComplexArray, omega: FloatArray, source: Quantity, target: Quantity
) -> tuple[ComplexArray, ComplexArray]:
    """Return the response as `target`, and its complex derivative with respect to the source."""
    old, new = DEFINITIONS[source], DEFINITIONS[target]
    turn = old.exponent * new.exponent
    factor = power_of_s(omega, new.power - turn * old.power)
    if turn == 1:
        return response * factor, factor
    zero = np.flatnonzero(response == 0.0)
    if zero.size:
        raise ValidationError(
            f"response[{zero[0]}] is 0 ({zero.size} such rows); a {source} of 0 has no {target}"
        )
    value = factor / response
    return value, -value / response


def jacobian(derivative: ComplexArray) -> FloatArray:
    """Return the (n, 2, 2) real Jacobian of a complex derivative on (Re, Im)."""
    re, im = derivative.real, derivative.imag
    return np.stack([np.stack([re, -im], -1), np.stack([im, re], -1)], -2)


def polar_std(response: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of gain and of phase (rad), to first order."""
    along = np.stack([response.real, response.imag], -1) / np.abs(response)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    gain, arc = (
        np.sqrt(np.einsum("ni,nij,nj->n", v, covariance, v).clip(0.0)) for v in (along, across)
    )
    return gain, arc / np.abs(response)

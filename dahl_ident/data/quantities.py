"""The six standard quantities, and how their errors travel from one to another.

With X the displacement phasor, F the force phasor and s = j omega, the receptance is X/F, the
mobility s X/F and the accelerance s^2 X/F; their inverses are the dynamic stiffness F/X, the
mechanical impedance F/(s X) and the apparent mass F/(s^2 X) (ISO 7626-1).
"""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import ValidationError
from dahl_ident.units import Quantity

# power of s on the displacement, and whether the quantity is force over motion
_DEFINITION: dict[Quantity, tuple[int, bool]] = {
    "receptance": (0, False),
    "mobility": (1, False),
    "accelerance": (2, False),
    "dynamic_stiffness": (0, True),
    "mechanical_impedance": (1, True),
    "apparent_mass": (2, True),
}
_POWERS_OF_J = (1.0 + 0.0j, 1.0j, -1.0 + 0.0j, -1.0j)  # exact, where (1j)**n rounds


def converted(
    response: ComplexArray, omega: FloatArray, source: Quantity, target: Quantity
) -> tuple[ComplexArray, ComplexArray]:
    """Return the response as `target`, and its complex derivative by the response.

    Raises
    ------
    ValidationError
        If a response of zero would have to be inverted.
    """
    from_power, from_inverted = _DEFINITION[source]
    to_power, to_inverted = _DEFINITION[target]
    exponent = from_power - to_power if to_inverted else to_power - from_power
    powers = _POWERS_OF_J[exponent % 4] * omega ** float(exponent)
    factor = np.asarray(powers, dtype=np.complex128)
    if from_inverted == to_inverted:
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

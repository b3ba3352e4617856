"""Friction and linear part of a plant, and data of plants measured in closed loop.

With F = C (r - x) the closed loop obeys (Z(A) + C) X = C R. It is therefore equivalent to the plant
with the controller as an additional parallel element, ``LinearSystem(C,
quantity="dynamic_stiffness")``, driven by the force C R, and can be identified like any other
force-driven plant. Dividing the response by the controller instead would give data in which neither
the force nor the displacement amplitude was controlled.
"""

from __future__ import annotations

from typing import Any

import control
import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    broadcast_shape,
    finite_array,
    positive_array,
)
from dahl_ident.data import FrequencyResponse
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.linear_system import LinearSystem, check_system
from dahl_ident.elements.rational import Rational
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.units import jacobian


def split(plant: Element) -> tuple[Model, Model]:
    """Return the friction and the linear part of a plant that has both, with their values."""
    elements = as_model(plant).elements
    plant.known_values()
    friction = [element for element in elements if not element.is_linear]
    linear = [element for element in elements if element.is_linear]
    for part, name, example in ((friction, "friction", "Dahl"), (linear, "linear part", "Mass")):
        if not part:
            raise ModelError(f"{plant!r} has no {name}; add one, such as {example}(...)")
    return Model(*friction), Model(*linear)


def rational_stiffness(model: Element) -> Rational:
    """Return the sum Z(s) of linear elements; common factors are not cancelled."""
    total = Rational(np.zeros(1), np.ones(1))
    for element in as_model(model).elements:
        rational = element.rational_stiffness()
        if rational is None:  # a discrete system or an FRD
            raise ModelError(f"{element!r} has no transfer function; expected a linear element")
        total = total + Rational(*rational)
    return total


def controller_response(controller: Any, omega: FloatArray) -> ComplexArray:
    """Return C(j omega) of a python-control system: force over displacement error."""
    check_system(controller, "controller")
    return LinearSystem(controller, quantity="dynamic_stiffness").dynamic_stiffness(0.0, omega)


def has_polynomials(model: Element) -> bool:
    """Return whether every linear system of the model is continuous and not an FRD."""
    return all(not isinstance(s, control.FRD) and s.isctime() for s in _systems(model))


def known_range(model: Element) -> tuple[float, float]:
    """Return the range of angular frequency in which every linear system is known, rad/s."""
    low, high = 0.0, np.inf
    for system in _systems(model):
        if isinstance(system, control.FRD):
            low, high = max(low, np.min(system.omega)), min(high, np.max(system.omega))
        elif system.isdtime(strict=True):
            high = min(high, np.pi / system.dt)
    return float(low), float(high)


def _systems(model: Element) -> list[Any]:
    """Return the python-control systems of a model at the values of their parameters."""
    systems = [e.system_at([float(v) for v in e.known_values()]) for e in as_model(model).elements]
    return [system for system in systems if system is not None]


def closed_loop_response(
    frequency_hz: ArrayLike,
    reference: ArrayLike,
    response: ArrayLike,
    controller: Any,
    *,
    covariance: ArrayLike | None = None,
) -> FrequencyResponse:
    """Return X/(C R) over the drive abs(C) r_0, from the closed loop's X/R.

    Parameters
    ----------
    frequency_hz : array_like, shape (n,)
        Hz, > 0.
    reference : array_like, shape (n,) or one number
        Zero-to-peak reference r_0 > 0, m.
    response : array_like of complex, shape (n,)
        X/R, displacement over reference.
    controller : control.TransferFunction, control.StateSpace or control.FRD
        C in F = C (r - x), N/m.
    covariance : array_like, shape (n, 2, 2), optional
        Covariance of the real and imaginary part of `response`.

    Returns
    -------
    FrequencyResponse
        Receptance with controlled force, one level for each reference. Fit a model that
        holds the controller: ``plant + LinearSystem(controller, quantity="dynamic_stiffness")``.

    Raises
    ------
    ValidationError
        If a frequency or reference is not above zero, shapes do not go together, or the
        controller is zero at a frequency.

    Examples
    --------
    >>> import control
    >>> from dahl_ident.control_interop import closed_loop_response
    >>> pd = control.tf([2.0, 100.0], [1.0])
    >>> data = closed_loop_response([1.0, 2.0], 1e-3, [0.9 - 0.1j, 0.8 - 0.3j], pd)
    >>> data.quantity, data.drive.round(4).tolist()
    ('receptance', [0.1008, 0.1031])
    """
    f = positive_array(frequency_hz, "frequency_hz")
    r = positive_array(reference, "reference")
    X_over_R = np.asarray(response, dtype=np.complex128)
    broadcast_shape(frequency_hz=f, reference=r, response=X_over_R)
    omega = 2.0 * np.pi * f
    C = controller_response(controller, omega)
    if np.any(C == 0.0):
        raise ValidationError(
            f"the controller is 0 at {f[C == 0.0][0]:g} Hz, where nothing drives the plant; "
            "leave that frequency out"
        )
    converted = None
    if covariance is not None:
        J = jacobian(1.0 / C)
        converted = J @ finite_array(covariance, "covariance") @ np.swapaxes(J, -1, -2)
    return FrequencyResponse(
        f,
        X_over_R / C,
        drive=np.abs(C) * r,
        covariance=converted,
        level=np.broadcast_to(r, f.shape),
        controlled="force",
        quantity="receptance",
    )

"""Everything linear of a model as one python-control transfer function."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.elements.linear import Damper, Mass, Spring
from dahl_ident.elements.linear_system import LinearSystem
from dahl_ident.elements.model import as_model
from dahl_ident.errors import ModelError

_POWER: dict[type[Element], int] = {Spring: 0, Damper: 1, Mass: 2}
_OF_RESPONSE = {
    "receptance": (True, 0),
    "mobility": (True, 1),
    "accelerance": (True, 2),
    "dynamic_stiffness": (False, 0),
    "mechanical_impedance": (False, 1),
    "apparent_mass": (False, 2),
}
"""Whether Z is the inverse of the response, and the power of s that it then takes."""


def system_of(element: LinearSystem) -> Any:
    """Return the python-control system of an element at the values of its parameters."""
    if not element.parameters:
        return element.system
    prefix = f"{element.name}_" if element.name else ""
    labels = [p.name.removeprefix(prefix) for p in element.parameters]
    values = [float(v) for v in element.known_values()]
    return element.system(**dict(zip(labels, values, strict=True)))


def transfer_stiffness(model: Element) -> Any:
    """Return the sum Z(s) of linear elements as a TransferFunction, its common factors kept.

    Raises
    ------
    ModelError
        If a linear system is discrete or an FRD, which no polynomials in s describe.
    """
    control = importlib.import_module("control")
    total = control.tf([0.0], [1.0])
    for element in as_model(model).elements:
        if isinstance(element, LinearSystem):
            total = total + _stiffness_of(element)
        else:
            (value,) = (float(v) for v in element.known_values())
            total = total + control.tf([value, *[0.0] * _POWER[type(element)]], [1.0])
    return total


def has_polynomials(model: Element) -> bool:
    """Return whether every linear system of the model is continuous and no FRD."""
    control = importlib.import_module("control")
    systems = [system_of(e) for e in as_model(model).elements if isinstance(e, LinearSystem)]
    return all(not isinstance(s, control.FRD) and s.isctime() for s in systems)


def known_range(model: Element) -> tuple[float, float]:
    """Return the angular frequencies between which every linear system is known, rad/s."""
    control = importlib.import_module("control")
    low, high = 0.0, np.inf
    for element in as_model(model).elements:
        if not isinstance(element, LinearSystem):
            continue
        system = system_of(element)
        if isinstance(system, control.FRD):
            low, high = max(low, np.min(system.omega)), min(high, np.max(system.omega))
        elif system.isdtime(strict=True):
            high = min(high, np.pi / system.dt)
    return float(low), float(high)


def coefficients(transfer: Any) -> tuple[FloatArray, FloatArray]:
    """Return numerator and denominator, from the highest power of s down."""
    numerator, denominator = transfer.num[0][0], transfer.den[0][0]
    return np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)


def _stiffness_of(element: LinearSystem) -> Any:
    control = importlib.import_module("control")
    system = system_of(element)
    if isinstance(system, control.FRD) or not system.isctime():
        raise ModelError(
            f"{element!r} is no rational function of s; give a continuous TransferFunction or "
            "StateSpace, or ask for a frequency response instead"
        )
    transfer = control.tf(system)
    inverted, power = _OF_RESPONSE[element.quantity]
    s_power = control.tf([1.0, *[0.0] * power], [1.0])
    return s_power / transfer if inverted else s_power * transfer

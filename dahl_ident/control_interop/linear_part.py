"""Friction and linear part of a plant, and the linear part as one transfer function."""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.linear_system import LinearSystem, check_system
from dahl_ident.errors import ModelError


class Split(NamedTuple):
    """The friction of a plant, and its linear elements."""

    friction: Model
    linear: Model


def split(plant: Element) -> Split:
    """Return the friction and the linear part of a plant that has both, values included.

    Raises
    ------
    ModelError
        If the plant has no friction or nothing else, or a parameter has no value.
    """
    elements = as_model(plant).elements
    plant.known_values()
    friction = [element for element in elements if not element.is_linear]
    linear = [element for element in elements if element.is_linear]
    for part, what, example in ((friction, "friction", "Dahl"), (linear, "linear part", "Mass")):
        if not part:
            raise ModelError(f"{plant!r} has no {what}; add one, such as {example}(...)")
    return Split(Model(*friction), Model(*linear))


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
        rational = element.rational_stiffness()
        if rational is None:
            raise ModelError(f"{element!r} has no transfer function; expected a linear element")
        total = total + control.tf(*rational)
    return total


def controller_response(controller: Any, omega: FloatArray) -> ComplexArray:
    """Return C(j omega) of a python-control system: force over displacement error."""
    check_system(controller, "controller")
    return LinearSystem(controller, quantity="dynamic_stiffness").dynamic_stiffness(0.0, omega)


def has_polynomials(model: Element) -> bool:
    """Return whether every linear system of the model is continuous and no FRD."""
    control = importlib.import_module("control")
    return all(not isinstance(s, control.FRD) and s.isctime() for s in _systems(model))


def known_range(model: Element) -> tuple[float, float]:
    """Return the angular frequencies between which every linear system is known, rad/s."""
    control = importlib.import_module("control")
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


def coefficients(transfer: Any) -> tuple[FloatArray, FloatArray]:
    """Return numerator and denominator, from the highest power of s down."""
    numerator, denominator = transfer.num[0][0], transfer.den[0][0]
    return np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)

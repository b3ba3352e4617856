"""Friction and linear part of a plant, and the linear part as a rational function of s."""

from __future__ import annotations

from typing import Any

import control
import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.linear_system import LinearSystem, check_system
from dahl_ident.elements.rational import Rational
from dahl_ident.errors import ModelError


def split(plant: Element) -> tuple[Model, Model]:
    """Return the friction and the linear part of a plant that has both, values included."""
    elements = as_model(plant).elements
    plant.known_values()
    friction = [element for element in elements if not element.is_linear]
    linear = [element for element in elements if element.is_linear]
    for part, what, example in ((friction, "friction", "Dahl"), (linear, "linear part", "Mass")):
        if not part:
            raise ModelError(f"{plant!r} has no {what}; add one, such as {example}(...)")
    return Model(*friction), Model(*linear)


def rational_stiffness(model: Element) -> Rational:
    """Return the sum Z(s) of linear elements, its common factors kept."""
    total = Rational(np.zeros(1), np.ones(1))
    for element in as_model(model).elements:
        rational = element.rational_stiffness()
        if rational is None:  # discrete or an FRD, which no polynomials in s describe
            raise ModelError(f"{element!r} has no transfer function; expected a linear element")
        total = total + Rational(*rational)
    return total


def controller_response(controller: Any, omega: FloatArray) -> ComplexArray:
    """Return C(j omega) of a python-control system: force over displacement error."""
    check_system(controller, "controller")
    return LinearSystem(controller, quantity="dynamic_stiffness").dynamic_stiffness(0.0, omega)


def has_polynomials(model: Element) -> bool:
    """Return whether every linear system of the model is continuous and no FRD."""
    return all(not isinstance(s, control.FRD) and s.isctime() for s in _systems(model))


def known_range(model: Element) -> tuple[float, float]:
    """Return the angular frequencies between which every linear system is known, rad/s."""
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

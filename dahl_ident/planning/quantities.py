"""Quantities that a plan is for: parameters, products of their powers, the predicted response."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.budget import coverage_factor
from dahl_ident.errors import ValidationError, choices

RESPONSE = "response"
_POWER = re.compile(r"(?P<name>[A-Za-z_]\w*)(?:\^(?P<power>-?\d+(?:\.\d+)?))?")
_EXPANDED = re.compile(r"U\((?P<quantity>.+)\)")


def is_expanded(name: str) -> bool:
    """Return whether a quantity is an expanded uncertainty, ``U(...)``."""
    return _EXPANDED.fullmatch(name) is not None


def sizes(parameters: Any, theta: FloatArray) -> FloatArray:
    """Return the scale of each parameter: 1 for logarithms, else its size."""
    spread = np.median(np.abs(theta), axis=0)
    spread = np.where(spread > 0.0, spread, np.maximum(theta.std(axis=0), 1e-300))
    spread = np.where(spread > 1e-290, spread, 1.0)
    return np.where([p.positive for p in parameters], 1.0, spread)


def direction(expression: str, parameters: Any, values: FloatArray) -> FloatArray:
    """Return d ln q/d theta of a product of powers at every draw, shape (S, P)."""
    names = [p.name for p in parameters]
    result = np.zeros(values.shape)
    for name, power in _powers(expression):
        if name not in names:
            raise ValidationError(
                f"target names {name!r}; expected a product of powers, such as 'f_max/sigma', of "
                f"{choices(names, name)}"
            )
        i = names.index(name)
        size = 1.0 if parameters[i].positive else values[:, i]
        result[:, i] += power / size
    return result


def _powers(expression: str) -> list[tuple[str, float]]:
    """Return names and powers in a product such as ``sigma^2/f_max``."""
    expanded = _EXPANDED.fullmatch(expression.replace(" ", ""))
    if expanded:
        expression = expanded["quantity"]
    found = []
    for place, part in enumerate(expression.replace(" ", "").split("/")):
        for factor in part.split("*"):
            match = _POWER.fullmatch(factor)
            if match is None:
                raise ValidationError(
                    f"target is {expression!r}; expected a parameter, or a product of powers such "
                    "as 'sigma^2/f_max'"
                )
            power = float(match["power"] or 1.0)
            found.append((match["name"], -power if place else power))
    return found


def least_factor(name: str) -> float:
    """Return the coverage factor of many degrees of freedom for an expanded uncertainty, else 1."""
    return coverage_factor(np.inf) if is_expanded(name) else 1.0


def product(expression: str, values: Mapping[str, FloatArray]) -> FloatArray:
    """Return the product of powers of values."""
    total = np.ones(())
    for name, power in _powers(expression):
        total = total * values[name] ** power
    return np.asarray(total)

"""What an identified model consists of, as numbers, for formats that cannot carry every law."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.errors import FitError, ModelError, argument
from dahl_ident.units import percent
from dahl_ident.version import __version__

LUMPED = {"mass": "mass", "damper": "damping", "spring": "stiffness"}
_EXPONENT_MATTERS = 0.02  # of f_max


@dataclass(frozen=True)
class Law:
    """A friction element: its kind, its equation, and its values by the names of its class."""

    kind: str
    equation: str
    values: Mapping[str, float]

    def __getitem__(self, name: str) -> float:
        return self.values[name]


@dataclass(frozen=True)
class Device:
    """The elements of a fit."""

    laws: tuple[Law, ...]  # all but masses, viscous dampers and springs
    mass: float  # sums, as are damping and stiffness
    damping: float
    stiffness: float
    rotation: bool  # whether forces are torques
    notes: tuple[str, ...]  # origin and verdict, and what the format leaves out


def device(result: Any, form: str, carried: Mapping[str, str]) -> Device:
    """Return the device of a fit."""
    laws, lumped = [], dict.fromkeys(LUMPED.values(), 0.0)
    notes = [f"made by dahl_ident {__version__}, SI units; the fit is {result.status.value}"]
    lost = [name for name, p in result.params.items() if not math.isfinite(p.value)]
    if lost:
        raise FitError(
            f"{', '.join(lost)} has no finite estimate, so there is no model to export; see the "
            "verdict"
        )
    for element in result.model.elements:
        values = _values(element)
        if element.kind in LUMPED and element.kind in carried:
            lumped[LUMPED[element.kind]] += values[LUMPED[element.kind]]
        elif element.kind in carried:
            laws.append(Law(element.kind, element.equation, values))
        else:
            raise ModelError(
                f"{form} carries {', '.join(carried)}, and the model has {element.kind}; fit "
                "without it, or export to another format, such as matlab"
            )
        if carried[element.kind]:
            notes.append(f"{element.kind}: {carried[element.kind]}")
    units = {p.unit for p in result.params.values()}
    rotation = any("rad" in unit or unit.startswith("N m") for unit in units)
    return Device(tuple(laws), **lumped, rotation=rotation, notes=tuple(notes))


def short(value: float) -> float:
    """Return a number of at most ten digits, more than any measurement has."""
    return float(f"{value:.10g}")


def _values(element: Any) -> dict[str, float]:
    """Return the values by the names that the class of the element has for them."""
    prefix = f"{element.name}_" if getattr(element, "name", None) else ""
    return {p.name.removeprefix(prefix): short(p.value) for p in element.parameters}


def linear(law: Law, form: str) -> tuple[str, ...]:
    """Return what to say where a format takes the exponent of Dahl for 1 and has one limit."""
    if law.values.get("asymmetry"):
        raise ModelError(f"{form} has one limit of friction for both directions, and the model two")
    a = law["alpha"] - 1.0
    if a == 0.0:
        return ()
    path = np.geomspace(1e-3, 1e3, 2001)  # from full slip the other way: 1 - s F/f_max = 2
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.maximum(2.0**-a + a * path, 0.0) ** (-1.0 / a)
    worst = float(np.max(np.abs(z - 2.0 * np.exp(-path))))
    if not worst <= _EXPONENT_MATTERS:
        raise ModelError(
            f"{form} carries Dahl with the exponent 1, and alpha is {1.0 + a:.4g}: the force would "
            f"differ by {percent(worst)} of f_max; fit with {argument('alpha', 1)} if that "
            "describes the data"
        )
    return (f"alpha = {1.0 + a:.5g} is taken as 1: within {percent(worst)} of f_max",)

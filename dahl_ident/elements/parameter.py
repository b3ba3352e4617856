"""A parameter: its name, unit, bounds and search coordinate, declared with its element."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from dahl_ident.arrays import LARGEST, SMALLEST, finite_number, positive_number, real_number
from dahl_ident.errors import ModelError, ValidationError, choices

_FREE, _ASSUMED = ("free", "start", "lower", "upper"), ("assumed",)  # keys of what is described

Dimension = tuple[int, int, int]
"""Powers of force, displacement and time in a unit."""
FORCE: Dimension = (1, 0, 0)
STIFFNESS: Dimension = (1, -1, 0)
UNITS: dict[str, Dimension] = {
    "N": FORCE,
    "m": (0, 1, 0),
    "s": (0, 0, 1),
    "kg": (1, -1, 2),
    "Pa": (1, -2, 0),
    "J": (1, 1, 0),
    "Hz": (0, 0, -1),
    "rad": (0, 0, 0),
    "1": (0, 0, 0),
}
"""The units of which the unit of a parameter is made."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of a model.

    Parameters
    ----------
    name : str
        Such as ``"f_max"``; elements with a name prefix it (``"pivot_f_max"``).
    unit : str
        SI unit for translation, such as ``"N/m"``; ``""`` for a pure number.
    description : str
        A few words for reports.
    value : float or None
        The fixed value, or the start if `free`; None if there is none.
    free : bool or None
        Whether the parameter is estimated. None (the default): estimated if `value` is None.
    lower, upper : float
        Bounds, in `unit`.
    transform : {"log", "linear"}
        The coordinate in which searches and priors work: the logarithm for positive
        parameters, the value itself for the others.
    scan : tuple of float
        Values that a global start tries where the unit gives no scale, such as 0.5, 1 and 2 for
        an exponent.
    prior : tuple of float or None
        Range that holds the value with 95 % probability before any data are seen; None where
        the size follows from the data's forces and displacements through the unit.
    assumed : bool
        True: the value is a default that the user did not give, such as the exponent of ``Dahl()``.

    Raises
    ------
    ValidationError
        If `value` is not finite or outside its bounds.

    Examples
    --------
    >>> Parameter("f_max", "N", "friction limit", lower=0.0, transform="log").free
    True
    """

    name: str
    unit: str
    description: str
    value: float | None = None
    free: bool | None = None
    lower: float = -np.inf
    upper: float = np.inf
    transform: Literal["log", "linear"] = "linear"
    scan: tuple[float, ...] = ()
    prior: tuple[float, float] | None = None
    assumed: bool = False

    def __post_init__(self) -> None:
        if self.value is not None:
            checked = positive_number if self.positive else finite_number
            value = checked(self.value, self.name)
            if not self.lower <= value <= self.upper:
                high = "" if np.isinf(self.upper) else f" and <= {self.upper:g}"
                raise ValidationError(
                    f"{self.name} is {value!r}; expected a number >= {self.lower:g}{high}"
                )
            object.__setattr__(self, "value", value)
        if self.free is None:
            object.__setattr__(self, "free", self.value is None)
        elif not self.free and self.value is None:
            raise ValidationError(f"{self.name} is fixed but has no value; give one, or free it")

    @property
    def positive(self) -> bool:
        """Whether the value is above zero, and searched by its logarithm."""
        return self.transform == "log"

    def nearest(self, value: float) -> float:
        """Return the possible value nearest to one that is infinite, or just beyond a bound."""
        low = max(self.lower, SMALLEST if self.positive else -LARGEST)
        return float(np.clip(value, low, min(self.upper, LARGEST)))

    @property
    def is_mechanical(self) -> bool:
        """Whether the unit is a product of powers of force, displacement and time."""
        return _dimension(self.unit) is not None

    @property
    def dimension(self) -> Dimension:
        """Powers of force, displacement and time in the unit: (1, -1, 0) for N/m.

        Raises
        ------
        ValidationError
            If the unit is not made of N, m, s, kg, Pa, J, Hz and rad.

        Examples
        --------
        >>> Parameter("damping", "N s/m", "viscous damping").dimension
        (1, -1, 1)
        """
        powers = _dimension(self.unit)
        if powers is None:
            raise ValidationError(
                f"{self.name} has the unit {self.unit!r}; expected a product of powers of "
                f"{', '.join(UNITS)}, such as 'N s/m'"
            )
        return powers

    @property
    def is_exponent(self) -> bool:
        """Whether it is a positive pure number whose usual range is known."""
        return self.positive and self.prior is not None and not any(self.dimension)

    @property
    def is_mass(self) -> bool:
        """Whether the unit is that of a mass."""
        return _dimension(self.unit) == (1, -1, 2)

    def bound(self, name: str, value: float | None) -> Parameter:
        """Return this declaration as a parameter called `name`: fixed at a number, or free."""
        if value is None and self.value is None and self.free and name == self.name:
            return self
        assumed = isinstance(value, Assumed)
        return replace(self, name=name, value=value, free=None, assumed=assumed)

    def describe(self) -> Any:
        """Return plain data: a fixed value, "free", or a mapping with the start and the bounds."""
        if not self.free:
            return {"assumed": self.value} if self.assumed else self.value
        limits = {"lower": self.lower, "upper": self.upper}
        bounds = {k: v for k, v in limits.items() if math.isfinite(v) and (k, v) != ("lower", 0.0)}
        if self.value is None and not bounds:
            return "free"
        start = {} if self.value is None else {"start": self.value}
        return {"free": True, **start, **bounds}

    def described(self, description: Any) -> Parameter:
        """Return this parameter with what :meth:`describe` returned."""
        if description == "free":
            return replace(self, value=None, free=True, assumed=False)
        if not isinstance(description, Mapping):
            return self.fixed(description)
        known = _ASSUMED if "assumed" in description else _FREE
        for key in sorted(description.keys() - known)[:1]:
            raise ModelError(
                f"{self.name} has the key {key!r}; expected a number, 'free', or a table with "
                f"{choices(known, key)}"
            )
        if "assumed" in description:
            return replace(self, value=description["assumed"], free=False, assumed=True)
        if description.get("free", True) is not True:
            raise ModelError(
                f"free of {self.name} is {description['free']!r}; expected true, or a number in "
                "place of the table"
            )
        lower, upper = (
            real_number(description.get(key, getattr(self, key)), f"{key} of {self.name}")
            for key in ("lower", "upper")
        )
        if not lower < upper:
            raise ModelError(
                f"{self.name} has the bounds {lower:g} and {upper:g}; expected the lower one first"
            )
        return replace(
            self,
            value=description.get("start"),
            free=True,
            assumed=False,
            lower=lower,
            upper=upper,
        )

    def freed(self) -> Parameter:
        """Return this parameter, to be estimated; its value becomes a start."""
        return replace(self, free=True, assumed=False)

    def fixed(self, value: float) -> Parameter:
        """Return this parameter, held at `value`."""
        return replace(self, value=value, free=False, assumed=False)


class Assumed(float):
    """A default value that the user did not give, and that a result must state."""


@lru_cache(maxsize=256)
def _dimension(unit: str) -> Dimension | None:
    """Return powers of force, displacement and time in a unit; None if it has other units."""
    total = [0, 0, 0]
    for place, part in enumerate(unit.split("/")):
        for factor in part.split():
            match = re.fullmatch(r"\(?([A-Za-z]+|1)(?:\^(-?\d+))?\)?", factor)
            if match is None or match[1] not in UNITS:
                return None
            power = (-1 if place else 1) * int(match[2] or 1)
            total = [t + power * u for t, u in zip(total, UNITS[match[1]], strict=True)]
    return total[0], total[1], total[2]

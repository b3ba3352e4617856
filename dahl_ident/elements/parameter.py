"""A parameter: its name, unit, bounds and search coordinate, declared beside its element."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dahl_ident.arrays import finite_number, positive_number
from dahl_ident.errors import ValidationError


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
        The fixed value, or the start where `free`; None where nothing is known.
    free : bool or None
        Whether the parameter is estimated. None (the default): exactly where `value` is None.
    lower, upper : float
        Bounds, in `unit`.
    transform : {"log", "linear"}
        The coordinate in which searches and priors work: the logarithm for positive
        parameters, the value itself for the others.

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

    def __post_init__(self) -> None:
        if self.value is not None:
            number = positive_number if self.transform == "log" else finite_number
            value = number(self.value, self.name)
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

    def freed(self) -> Parameter:
        """Return this parameter, to be estimated; its value becomes a start."""
        return replace(self, free=True)

    def fixed(self, value: float) -> Parameter:
        """Return this parameter, held at `value`."""
        return replace(self, value=value, free=False)

"""Checks of single numbers that several parts of an experiment share."""

from __future__ import annotations

from typing import Any

from dahl_ident.arrays import finite_number
from dahl_ident.errors import ValidationError


def non_negative_number(value: Any, name: str) -> float:
    """Return `value` as one finite float of at least zero."""
    number = finite_number(value, name)
    if number < 0.0:
        raise ValidationError(f"{name} is {number!r}; expected a number >= 0")
    return number

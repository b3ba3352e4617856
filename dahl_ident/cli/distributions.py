"""Parsing of numbers, bounds and distributions: ``0.3``, ``0.01:1``, ``norm(1, 0.005)``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.bayes.priors import PriorLike

FREE = "free"
_CALL = re.compile(r"(?:scipy\.)?(?:stats\.)?(\w+)\((.*)\)")


def number(name: str, text: str) -> float:
    """Return a parameter's value.

    Raises
    ------
    ModelError
        If the text is not a value.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ModelError(f"{name} is {text!r}; expected a number in SI units, or '{FREE}'")
    return value


def number_or_free(name: str, text: str | None) -> float | None:
    """Return a parameter's value, None where it is free."""
    return None if text is None or text == FREE else number(name, text)


def known(name: str, text: str) -> Any:
    """Return the value of a sensor: a number, None if it is free, or its prior.

    A share such as ``0.5 %`` is the standard uncertainty of a gain.
    """
    if text.endswith("%") and name != "delay":
        return distribution(name, f"norm(1, {number(name, text[:-1].strip()) / 100.0!r})")
    return distribution(name, text) if "(" in text else number_or_free(name, text)


def prior(assigned: str) -> tuple[str, PriorLike]:
    """Return name and prior of ``f_max=0.01:1`` or ``mass=norm(0.3, 0.001)``."""
    name, _, text = assigned.partition("=")
    if "(" in text:
        return name, distribution(name, text)
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError as exc:
        raise ValidationError(
            f"prior is {assigned!r}; expected a name and two bounds or a distribution, such as "
            "f_max=0.01:1 or mass=norm(0.3,0.001)"
        ) from exc
    return name, (low, high)


def values(option: str, assigned: Sequence[str]) -> dict[str, float]:
    """Return names and numbers of ``f_max=0.1``, one for each."""
    pairs = [text.partition("=") for text in assigned]
    return {name: number(f"{option} of {name}", text) for name, _, text in pairs}


def distribution(name: str, text: str) -> Any:
    """Return a frozen distribution of scipy.stats, called as in Python.

    Raises
    ------
    ValidationError
        If there is no such distribution, or these are not its arguments.
    """
    from scipy import stats

    call = _CALL.fullmatch(text.strip())
    kind = getattr(stats, call[1], None) if call else None
    if call is None or not isinstance(kind, stats.rv_continuous):
        raise ValidationError(
            f"{name} is {text!r}; expected a distribution of scipy.stats, such as norm(1,0.005) "
            "with mean and standard deviation"
        )
    parts = [part.rpartition("=") for part in call[2].split(",")]
    try:
        given = [float(value) for key, _, value in parts if not key]
        by_name = {key.strip(): float(value) for key, _, value in parts if key}
        frozen = kind(*given, **by_name)
    except (TypeError, ValueError) as exc:
        raise ValidationError(
            f"{name} is {text!r}, which are not arguments of {call[1]}: {exc}"
        ) from exc
    if not (math.isfinite(frozen.mean()) and frozen.std() > 0.0):
        raise ValidationError(f"{name} is {text!r}, which has no finite mean or no width")
    return frozen

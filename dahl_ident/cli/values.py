"""Values as typed: ``50um``, ``0.01:1``, ``norm(1, 0.005)``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dahl_ident.errors import ModelError, ValidationError, choices

if TYPE_CHECKING:
    from dahl_ident.bayes.priors import PriorLike

FREE = "free"
_CALL = re.compile(r"(?:scipy\.)?(?:stats\.)?(\w+)\((.*)\)")
_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([^\s\d.,]?.*?)\s*")


def number(name: str, text: str, unit: str | None = None, *, or_free: bool = False) -> float:
    """Return a value in SI units; the text may state a unit, ``50um``.

    It has the dimension of `unit`, or else of the parameter called `name`. With `or_free`, the
    error says that the parameter may be free as well.
    """
    share = unit == "1" and text.rstrip().endswith("%")
    try:
        value = 0.01 * float(text.rstrip()[:-1]) if share else float(text)
    except ValueError:
        value = math.nan if share else _quantity(name, text, unit)
    if not math.isfinite(value):
        free = f", or '{FREE}'" if or_free else ""
        raise ModelError(
            f"{name} is {text!r}; expected a number in SI units or with its unit{free}"
        )
    return value


def _quantity(name: str, text: str, unit: str | None) -> float:
    """Return the SI value of a number with a unit; NaN for other text."""
    if _QUANTITY.fullmatch(text) is None:
        return math.nan
    from dahl_ident.elements.element import KINDS
    from dahl_ident.units import SI_UNITS, parse_quantity

    if unit is None:
        units = {p.name: p.unit for law in KINDS.values() for p in law.parameters}
        units |= {"displacement_gain": "1", "force_gain": "1", "delay": "s"}
        parameter = name.split()[-1]
        unit = next((u for n, u in units.items() if f"_{parameter}".endswith(f"_{n}")), None)
        if unit is None:
            known = choices(dict.fromkeys(units), parameter)
            raise ModelError(
                f"{name} is {text!r}, but no parameter is called {parameter}; expected {known}"
            )
    kinds = tuple(kind for kind, both in SI_UNITS.items() if unit in both)
    return parse_quantity(text, kinds, name)[0] if kinds else math.nan


def numbers(name: str, text: str, unit: str | None = None, sep: str = ":") -> list[float]:
    """Return the numbers of ``1:50um``; the unit of the last holds for those without one."""
    parts = text.split(sep)
    matches = [_QUANTITY.fullmatch(part) for part in parts]
    last_unit = matches[-1][2] if matches[-1] else ""
    return [
        number(name, f"{match[1]}{match[2] or last_unit}" if match else part, unit)
        for match, part in zip(matches, parts, strict=True)
    ]


def ends(name: str, text: str, unit: str | None = None) -> float | tuple[float, float]:
    """Return the two ends of ``low:high``, or one number."""
    values = numbers(name, text, unit)
    if len(values) > 2:
        raise ValidationError(f"{name} is {text!r}; expected a number, or low:high")
    if values[0] > values[-1]:
        raise ValidationError(f"{name} is {text!r}; expected low:high, the low end below the high")
    return values[0] if len(values) == 1 else (values[0], values[1])


def number_or_free(name: str, text: str) -> float | None:
    """Return a parameter's value, None if it is free."""
    return None if text == FREE else number(name, text, or_free=True)


def sensor_value(name: str, text: str) -> Any:
    """Return a parameter of a sensor: a number, None if it is free, or its prior.

    A percentage such as ``0.5 %`` is the standard uncertainty of a gain.
    """
    if text.endswith("%") and name != "delay":
        return distribution(name, f"norm(1, {number(name, text[:-1].strip()) / 100.0!r})")
    return distribution(name, text) if "(" in text else number_or_free(name, text)


def prior(assigned: str) -> tuple[str, PriorLike]:
    """Return name and prior of ``f_max=0.01:1`` or ``mass=norm(0.3, 0.001)``."""
    name, _, text = assigned.partition("=")
    if "(" in text:
        return name, distribution(name, text)
    bounds = ends(f"prior of {name}", text) if text else None
    if not isinstance(bounds, tuple):
        raise ValidationError(
            f"prior is {assigned!r}; expected a name and two bounds or a distribution, such as "
            "f_max=0.01:1 or mass=norm(0.3,0.001)"
        )
    return name, bounds


def values(option: str, assigned: Sequence[str]) -> dict[str, float]:
    """Return names and numbers of ``f_max=0.1``, one for each."""
    pairs = [text.partition("=") for text in assigned]
    return {name: number(f"{option} of {name}", text) for name, _, text in pairs}


def distribution(name: str, text: str) -> Any:
    """Return a frozen distribution of scipy.stats, called as in Python."""
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
        positional = [float(value) for key, _, value in parts if not key]
        by_name = {key.strip(): float(value) for key, _, value in parts if key}
        frozen = kind(*positional, **by_name)
    except (TypeError, ValueError) as exc:
        raise ValidationError(
            f"{name} is {text!r}, which are not arguments of {call[1]}: {exc}"
        ) from exc
    shapes = [*(kind.shapes or "").replace(",", " ").split(), "loc", "scale"]
    if len(positional) < len(shapes) and "scale" not in by_name:  # scipy would take 1 in SI units
        raise ValidationError(
            f"{name} is {text!r}, which leaves out the scale; expected "
            f"{call[1]}({', '.join(shapes)}), such as norm(1,0.005)"
        )
    if not (math.isfinite(frozen.mean()) and frozen.std() > 0.0):
        raise ValidationError(f"{name} is {text!r}, which has no finite mean or no width")
    return frozen

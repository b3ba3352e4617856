"""The options of the model, and values as typed: ``50um``, ``0.01:1``, ``norm(1, 0.005)``."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from dahl_ident.cli.console import refuse
from dahl_ident.cli.options import setting
from dahl_ident.errors import ModelError, ValidationError, choices

if TYPE_CHECKING:
    from dahl_ident.bayes.priors import PriorLike
    from dahl_ident.elements import Element

FREE = "free"
_CALL = re.compile(r"(?:scipy\.)?(?:stats\.)?(\w+)\((.*)\)")
_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([^\s\d.,]?.*?)\s*")


def number(name: str, text: str, unit: str | None = None) -> float:
    """Return a number in SI, or one with its unit, ``50um``; by default the parameter has it."""
    share = unit == "1" and text.rstrip().endswith("%")
    try:
        value = 0.01 * float(text.rstrip()[:-1]) if share else float(text)
    except ValueError:
        value = math.nan if share else _quantity(name, text, unit)
    if not math.isfinite(value):
        raise ModelError(
            f"{name} is {text!r}; expected a number in SI units or with its unit, or '{FREE}'"
        )
    return value


def _quantity(name: str, text: str, unit: str | None) -> float:
    """Return a number with its unit in SI; NaN for other text."""
    if _QUANTITY.fullmatch(text) is None:
        return math.nan
    from dahl_ident.elements.law_files import KINDS
    from dahl_ident.units import SI_UNITS, parse_quantity

    if unit is None:
        units = {p.name: p.unit for law in KINDS.values() for p in law.parameters}
        units |= {"displacement_gain": "1", "force_gain": "1", "delay": "s"}
        parameter = name.split()[-1]
        unit = next((u for n, u in units.items() if f"_{parameter}".endswith(f"_{n}")), "")
    kinds = tuple(kind for kind, both in SI_UNITS.items() if unit in both)
    return parse_quantity(text, kinds, name)[0] if kinds else math.nan


def numbers(name: str, text: str, unit: str | None = None, sep: str = ":") -> list[float]:
    """Return the numbers of ``1:50um``; a unit after the last holds for those without one."""
    parts = text.split(sep)
    read = [_QUANTITY.fullmatch(part) for part in parts]
    last = read[-1][2] if read[-1] else ""
    parts = [f"{q[1]}{q[2] or last}" if q else part for q, part in zip(read, parts, strict=True)]
    return [number(name, part, unit) for part in parts]


def ends(name: str, text: str, unit: str | None = None) -> float | tuple[float, float]:
    """Return the two ends of ``low:high``, or one number."""
    values = numbers(name, text, unit)
    if len(values) > 2:
        raise ValidationError(f"{name} is {text!r}; expected a number, or low:high")
    return values[0] if len(values) == 1 else (values[0], values[1])


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
    if not (math.isfinite(frozen.mean()) and frozen.std() > 0.0):
        raise ValidationError(f"{name} is {text!r}, which has no finite mean or no width")
    return frozen


_KINDS = "a number, 'free', '0.5 %' (standard uncertainty), or a prior, 'norm(1, 0.005)'."
_CALL = re.compile(r"\s*(\w+)\s*(?:\((.*)\))?\s*", re.DOTALL)
_COMMA = re.compile(r",(?![^(]*\))")  # not within brackets
_FRICTION = ("f_max", "sigma", "alpha")
_CHANNELS = ("force_gain", "displacement_gain", "delay")
OTHERS = ("mass", "damping", "stiffness")


ELEMENT_HELP = (
    "An element instead of Dahl friction, by its kind and known values: 'bouc_wen', "
    "'dahl(f_max=0.1, alpha=free)', 'mass(0.3)'; once for each."
)


@dataclass(frozen=True)
class ModelOptions:
    """Elements and sensors, with their known and free parameters."""

    panel: ClassVar[str] = "Model"
    f_max: str | None = setting("Friction limit, 0.1N; estimated if left out.")
    sigma: str | None = setting("Contact stiffness, 30N/m; estimated if left out.")
    alpha: str | None = setting(
        "Exponent, or 'free'; if left out, it is estimated within 0.5 to 2."
    )
    element: list[str] | None = setting(ELEMENT_HELP)
    mass: str | None = setting("Add a mass: 300g, or 'free'.")
    damping: str | None = setting("Add a damper: '0.2 N s/m', or 'free'.")
    stiffness: str | None = setting("Add a spring: 0.3N/m, or 'free'.")
    force_gain: str | None = setting(f"Measured over true force: {_KINDS}", panel="Sensors")
    displacement_gain: str | None = setting(
        f"Measured over true displacement: {_KINDS}", panel="Sensors"
    )
    delay: str | None = setting(f"Lag of the displacement channel: {_KINDS}", panel="Sensors")
    metadata: Path | None = setting(
        "TOML file of the report: instruments with a channel, an uncertainty and k give the "
        "sensors' priors.",
        panel="Sensors",
    )

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``fit`` and ``posterior`` that describe plant and sensors."""
        from dahl_ident.data.laboratory import metadata_of
        from dahl_ident.sensors import Sensors, calibrations

        others = {name: number_or_free(name, text) for name, text in self._given(*OTHERS).items()}
        typed = self._given(*_CHANNELS)
        stated = {} if self.metadata is None else calibrations(metadata_of(self.metadata))
        sensed = stated | {name: known(name, text) for name, text in typed.items()}
        return {
            "model": in_parallel(self._friction(), others),
            "free": ["alpha"] if self.alpha == FREE else [],
            "sensors": Sensors(**sensed),
        }

    def _friction(self) -> Element:
        from dahl_ident.elements import Dahl

        stated = self._given(*_FRICTION)
        if self.element:
            refuse_with_elements(stated)
            return elements(self.element)
        values: dict[str, Any] = {name: number_or_free(name, text) for name, text in stated.items()}
        return Dahl(**{name: value for name, value in values.items() if value is not None})

    def _given(self, *names: str) -> dict[str, str]:
        return {name: text for name in names if (text := getattr(self, name)) is not None}


def refuse_with_elements(options: Mapping[str, Any]) -> None:
    """Refuse parameters of the Dahl element if --element describes the friction."""
    refuse(
        options,
        "together with --element; write such values inside the element, as in --element "
        "'dahl(f_max=0.1)'",
    )


def elements(texts: Sequence[str]) -> Element:
    """Return the sum of elements written as ``kind(label=value, ...)``."""
    return reduce(add, (_element(text) for text in texts))


def _element(text: str) -> Element:
    from dahl_ident.elements.model import model_from_description

    return model_from_description([_entry(text)]).elements[0]


def _entry(text: str) -> dict[str, Any]:
    """Return an element as plain data; that behind a gap is written inside its brackets."""
    from dahl_ident.elements.law_files import KINDS, class_named

    call = _CALL.fullmatch(text.strip())
    if call is None:
        raise ValidationError(
            f"--element is {text!r}; expected a kind and its values, such as 'dahl(f_max=0.1)'"
        )
    cls, inside = class_named(call[1]), call[2] or ""
    if cls is None:
        raise ModelError(
            f"--element names the kind {call[1]!r}; expected a law from a file given with --laws, "
            f"or one of {choices(KINDS, call[1])}"
        )
    kind = cls.kind
    entry: dict[str, Any] = {"kind": kind}
    labels = [parameter.name for parameter in cls.parameters]
    parts = [part.strip() for part in _COMMA.split(inside) if part.strip()]
    if kind == "backlash":
        labels = ["gap"]
        nested = bool(parts) and class_named(parts[0].partition("(")[0].strip()) is not None
        inner = parts.pop(0) if nested else "dahl"
        entry |= {"element": _entry(inner), "gap": FREE}
    for place, part in enumerate(parts):
        label, _, value = (word.strip() for word in part.rpartition("="))
        if not label and place >= len(labels):
            raise ModelError(f"--element is {text!r}; {kind} takes {', '.join(labels) or 'labels'}")
        label = label or labels[place]
        free = value == FREE
        entry[label] = value if label == "name" or free else number_or_free(label, value)
    return entry


def in_parallel(friction: Element, others: Mapping[str, float | None]) -> Element:
    """Return friction with the elements in parallel whose parameter is named."""
    from dahl_ident.elements import Damper, Mass, Spring

    kinds = dict(zip(OTHERS, (Mass, Damper, Spring), strict=True))
    model = friction
    for name, value in others.items():
        model = model + kinds[name](value)
    return model

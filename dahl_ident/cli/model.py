"""The options of the model: elements with their values, and sensors."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from dahl_ident.cli.console import refuse
from dahl_ident.cli.options import setting
from dahl_ident.cli.values import FREE, known, number_or_free
from dahl_ident.errors import ModelError, ValidationError, choices

if TYPE_CHECKING:
    from dahl_ident.elements import Element

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

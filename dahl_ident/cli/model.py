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
from dahl_ident.cli.values import FREE, number, number_or_free, sensor_value
from dahl_ident.errors import ModelError, ValidationError, choices

if TYPE_CHECKING:
    from dahl_ident.elements import Element

DAHL_PARAMETERS = ("f_max", "sigma", "alpha")
LINEAR_PARAMETERS = ("mass", "damping", "stiffness")
_SENSOR_PARAMETERS = ("force_gain", "displacement_gain", "delay")
_CALL = re.compile(r"\s*(\w+)\s*(?:\((.*)\))?\s*", re.DOTALL)
_COMMA = re.compile(r",(?![^(]*\))")  # not within brackets
_SENSOR_HELP = "a number, 'free', '0.5 %' (standard uncertainty), or a prior, 'norm(1, 0.005)'."
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
    force_gain: str | None = setting(f"Measured over true force: {_SENSOR_HELP}", panel="Sensors")
    displacement_gain: str | None = setting(
        f"Measured over true displacement: {_SENSOR_HELP}", panel="Sensors"
    )
    delay: str | None = setting(
        "Lag of the displacement channel: 0.1ms, 'free', or a prior in s, 'norm(0, 1e-4)'.",
        panel="Sensors",
    )
    metadata: Path | None = setting(
        "TOML file of the report: instruments with a channel, an uncertainty and k give the "
        "sensors' priors.",
        panel="Sensors",
    )

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``fit`` and ``posterior`` that describe plant and sensors."""
        from dahl_ident.data.laboratory import metadata_of
        from dahl_ident.sensors import Sensors, calibrations

        dahl, linear = (
            {name: number_or_free(name, text) for name, text in stated(self, *names).items()}
            for names in (DAHL_PARAMETERS, LINEAR_PARAMETERS)
        )
        instruments = {} if self.metadata is None else calibrations(metadata_of(self.metadata))
        typed = stated(self, *_SENSOR_PARAMETERS)
        sensors = instruments | {name: sensor_value(name, text) for name, text in typed.items()}
        return {
            "model": model_of(self.element, dahl, linear),
            "free": ["alpha"] if self.alpha == FREE else [],
            "sensors": Sensors(**sensors),
        }


def stated(options: Any, *names: str) -> dict[str, Any]:
    """Return those options of these names that are not left out."""
    return {name: value for name in names if (value := getattr(options, name)) is not None}


def model_of(
    elements: Sequence[str] | None,
    dahl: Mapping[str, float | None],
    linear: Mapping[str, float | None],
) -> Element:
    """Return the friction in parallel with the linear elements of the parameters in `linear`.

    The friction is the sum of `elements`, written as ``kind(label=value, ...)``, or else a Dahl
    element. A parameter that is None is free.
    """
    from dahl_ident.elements import Dahl, Damper, Mass, Spring
    from dahl_ident.elements.element import model_from_description

    friction: Element
    if elements:
        refuse(
            dahl,
            "together with --element; write such values inside the element, as in --element "
            "'dahl(f_max=0.1)'",
        )
        friction = model_from_description([_description(text) for text in elements])
    else:
        values: dict[str, Any] = {name: v for name, v in dahl.items() if v is not None}
        friction = Dahl(**values)
    kinds = dict(zip(LINEAR_PARAMETERS, (Mass, Damper, Spring), strict=True))
    return reduce(add, (kinds[name](value) for name, value in linear.items()), friction)


def _description(text: str) -> dict[str, Any]:
    """Return an element as plain data; the element behind a gap is in the gap's brackets."""
    from dahl_ident.elements.element import KINDS, class_named

    call = _CALL.fullmatch(text.strip())
    if call is None:
        raise ValidationError(
            f"--element is {text!r}; expected a kind and its values, such as 'dahl(f_max=0.1)'"
        )
    cls = class_named(call[1])
    if cls is None:
        raise ModelError(
            f"--element names the kind {call[1]!r}; expected a law from a file given with --laws, "
            f"or one of {choices(KINDS, call[1])}"
        )
    kind = cls.kind
    entry: dict[str, Any] = {"kind": kind}
    labels = [parameter.name for parameter in cls.parameters]
    parts = [part.strip() for part in _COMMA.split(call[2] or "") if part.strip()]
    if kind == "backlash":
        labels = ["gap"]
        has_inner = bool(parts) and class_named(parts[0].partition("(")[0].strip()) is not None
        inner = parts.pop(0) if has_inner else "dahl"
        entry |= {"element": _description(inner), "gap": FREE}
    for i, part in enumerate(parts):
        label, _, value = (word.strip() for word in part.rpartition("="))
        if not label and i >= len(labels):
            raise ModelError(f"--element is {text!r}; {kind} takes {', '.join(labels) or 'labels'}")
        label = label or labels[i]
        entry[label] = (
            value if label == "name" or value == FREE else number(label, value, or_free=True)
        )
    return entry

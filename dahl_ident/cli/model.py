"""The options that say what is fitted: elements, what is known of them, and the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli.distributions import known, number_or_free

if TYPE_CHECKING:
    from dahl_ident.elements import Element

_MODEL = "Model"
_SENSORS = "Sensors"
_KINDS = "a number, 'free', or a prior as scipy.stats has it, such as 'norm(1, 0.005)'."


def part(help_text: str) -> Any:
    """Return an option of the model."""
    return typer.Option(help=help_text, rich_help_panel=_MODEL)


def _sensor(help_text: str) -> Any:
    return typer.Option(help=f"{help_text}: {_KINDS}", rich_help_panel=_SENSORS)


@dataclass(frozen=True)
class ModelOptions:
    """Elements and sensors, which of their parameters are known, which are free."""

    f_max: Annotated[str | None, part("Coulomb friction, N; estimated if left out.")] = None
    sigma: Annotated[str | None, part("Rest stiffness, N/m; estimated if left out.")] = None
    alpha: Annotated[str, part("Exponent of the Dahl model, or 'free'.")] = "1"
    mass: Annotated[str | None, part("Add a mass: kg, or 'free'.")] = None
    damping: Annotated[str | None, part("Add a damper: N s/m, or 'free'.")] = None
    stiffness: Annotated[str | None, part("Add a spring: N/m, or 'free'.")] = None
    force_gain: Annotated[str | None, _sensor("Measured over true force")] = None
    displacement_gain: Annotated[str | None, _sensor("Measured over true displacement")] = None
    delay: Annotated[str | None, _sensor("Lag of the displacement channel, s")] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``fit`` and ``sample`` that describe plant and sensors."""
        from dahl_ident.elements import Dahl
        from dahl_ident.sensors import Sensors

        f_max, sigma, alpha = (
            number_or_free(name, getattr(self, name)) for name in ("f_max", "sigma", "alpha")
        )
        friction = Dahl(f_max, sigma, 1.0 if alpha is None else alpha)
        others = {name: number_or_free(name, text) for name, text in self._given(*OTHERS).items()}
        sensed = self._given("force_gain", "displacement_gain", "delay")
        return {
            "model": in_parallel(friction, others),
            "free": ["alpha"] if alpha is None else [],
            "sensors": Sensors(**{name: known(name, text) for name, text in sensed.items()}),
        }

    def _given(self, *names: str) -> dict[str, str]:
        return {name: text for name in names if (text := getattr(self, name)) is not None}


OTHERS = ("mass", "damping", "stiffness")


def in_parallel(friction: Element, others: Mapping[str, float | None]) -> Element:
    """Return friction with the elements beside it whose parameter is named."""
    from dahl_ident.elements import Damper, Mass, Spring

    kinds = dict(zip(OTHERS, (Mass, Damper, Spring), strict=True))
    model = friction
    for name, value in others.items():
        model = model + kinds[name](value)
    return model

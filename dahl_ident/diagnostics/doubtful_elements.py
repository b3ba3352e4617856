"""Masses, dampers and springs that a fit found but no device has, or that rest on little force."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.elements import Element, Parameter
from dahl_ident.units import Motion, shown_unit

_CLEARLY = 2.0  # standard uncertainties below zero
_FALLING = "fit a law whose force falls with speed (LuGre)"
_INSTEAD = {
    (1, -1, 2): "a mass: leave it out, or give its value",
    (1, -1, 1): f"a damper: {_FALLING}, leave the damper out, or give its value",
    (1, -1, 0): "a spring, except a buckled one: leave it out, or give its value",
}


def is_single(element: Element) -> bool:
    """Return whether an element is a mass, a damper or a spring."""
    return bool(
        element.is_linear
        and element.linear_parameters
        and len(element.parameters) == 1
        and element.parameters[0].dimension in _INSTEAD
    )


def below_zero(
    parameters: Sequence[Parameter],
    values: Mapping[str, float],
    stderr: Mapping[str, float],
    motion: Motion = "translation",
) -> Iterator[Finding]:
    """Yield a finding for every estimate clearly below zero, with what to do.

    Parameters
    ----------
    parameters : sequence of Parameter
        Of masses, dampers and springs; those that are not free were given, and are left out.
    values, stderr : mapping of str to float
    motion : {"translation", "rotation"}

    Yields
    ------
    Finding
    """
    for parameter in parameters:
        value, error = values[parameter.name], stderr.get(parameter.name, 0.0)
        if parameter.free and np.isfinite(value) and value < -_CLEARLY * error:
            given = {
                "name": parameter.name,
                "value": value,
                "stderr": error,
                "unit": shown_unit(parameter.unit, motion),
                "instead": _INSTEAD[parameter.dimension],
            }
            yield Finding(Question.DESCRIBED, VerdictStatus.APPROXIMATE, "negative", given)


def slight(
    parameter: Parameter, value: float, error: float, share: float, misfit: float
) -> Iterator[Finding]:
    """Yield a finding where an element carries less force than the model misses.

    Parameters
    ----------
    parameter : Parameter
        Of a mass, damper or spring.
    value, error : float
        Estimate and standard uncertainty.
    share, misfit : float
        Rms of its force and of the misfit, over that of the measured force.

    Yields
    ------
    Finding
    """
    if parameter.free and share < misfit and value >= -_CLEARLY * error:
        values = {
            "name": parameter.name,
            "value": value,
            "stderr": error,
            "unit": parameter.unit,
            "share": share,
            "misfit": misfit,
        }
        yield Finding(Question.DESCRIBED, VerdictStatus.TRUSTED, "slight", values)

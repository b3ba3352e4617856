"""Why a parameter is not determined, and what to do about it, in words with numbers."""

from __future__ import annotations

import numpy as np

from dahl_ident.diagnostics.intervals import Interval
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.elements import Dahl, Element, Spring
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_CHANNELS = {"force_gain": "force", "displacement_gain": "displacement"}


def advice(optimum: Optimum, name: str, limits: Interval, lost: frozenset[str]) -> str:
    """Return "because ...: do ...", for a parameter that is not identified.

    `limits` is its interval, `lost` the names of all such parameters.
    """
    if not optimum.scale_known and optimum.dof <= 0:
        return (
            "because no number is left to estimate the noise by: measure more points, or repeat "
            "them so that their covariance is known"
        )
    gain = _confounding_gain(optimum, name, lost)
    if gain:
        return gain
    for element in optimum.problem.model.elements:
        names = [p.name for p in element.parameters]
        if name not in names:
            continue
        if isinstance(element, Dahl):
            kind = ("f_max", "sigma", "alpha")[names.index(name)]
            return _of_friction(optimum, element, kind, limits, lost)
        if isinstance(element, Spring):
            return _of_spring(optimum, lost)
    return (
        "because its effect on these data is below their noise or like that of another parameter: "
        "fix it, or measure where it matters"
    )


def _confounding_gain(optimum: Optimum, name: str, lost: frozenset[str]) -> str:
    """Return the advice where an unknown gain is what hides a parameter."""
    priors = optimum.problem.priors
    for gain, channel in _CHANNELS.items():
        if gain not in lost or gain in priors:
            continue
        calibrate = f"calibrate the {channel} channel, or give {gain} a prior"
        if name == gain:
            return f"because the strength of friction is unknown as well: {calibrate}"
        return f"because the {gain} is free and scales with it: {calibrate}"
    return ""


def _of_friction(
    optimum: Optimum, element: Dahl, kind: str, limits: Interval, lost: frozenset[str]
) -> str:
    amplitude = optimum.problem.stiffness_data.amplitude
    unit = shown_unit("m", optimum.problem.data.motion)
    least, most = f"{amplitude.min():.2g} {unit}", f"{amplitude.max():.2g} {unit}"
    rival = _rival(optimum, element, kind, lost)
    if rival:
        return f"because {rival} can take its place: leave one of the two elements out"
    spring = _hiding_spring(optimum, lost)
    if kind == "alpha":
        return (
            "because the exponent shows only where stick turns to slip, and the data from "
            f"{least} to {most} do not resolve it: add amplitudes around f_max/sigma, or fix it"
        )
    unlimited = limits.lower <= 0.0 and np.isinf(limits.upper)
    if spring and unlimited and element.parameters[0].name in lost:
        return (
            f"because friction's share of the response from {least} to {most} is within the noise "
            f"beside the free {spring}: cover amplitudes where it is larger, reduce the noise, or "
            f"measure the spring and fix {spring}"
        )
    if kind == "f_max" and np.isinf(limits.upper):
        if spring:
            return (
                f"because the free {spring} hides it below {most}: drive above that, or measure "
                f"the spring and fix {spring}"
            )
        return f"because no amplitude up to {most} reaches slip: drive above that"
    if kind == "sigma" and (spring in lost or (spring and _sticks(optimum, element))):
        return (
            f"because the free {spring} can take its place: drive far into slip, or measure the "
            f"spring and fix {spring}"
        )
    if kind == "sigma" and np.isinf(limits.upper) and element.parameters[0].name not in lost:
        beside = f" beside the free {spring}" if spring else ""
        fix = f", or measure the spring and fix {spring}" if spring else ""
        return (
            f"because every amplitude from {least} slips and friction's stiffness fades{beside}: "
            f"drive below that{fix}"
        )
    if spring:
        return (
            f"because the free {spring} explains the data from {least} to {most} nearly as well: "
            f"cover more amplitudes, or measure the spring and fix {spring}"
        )
    return (
        f"because friction's share of the response from {least} to {most} is within the noise: "
        "cover amplitudes where it is larger, or reduce the noise"
    )


def _sticks(optimum: Optimum, element: Dahl) -> bool:
    """Return whether no amplitude reaches x_c, where an element begins to slip."""
    values = parameter_values(optimum)
    f_max, sigma = (values[p.name] for p in element.parameters[:2])
    return bool(optimum.problem.stiffness_data.amplitude.max() < f_max / sigma)


def _rival(optimum: Optimum, element: Dahl, kind: str, lost: frozenset[str]) -> str:
    """Return the same parameter of another Dahl element, if that is not identified either."""
    place = ("f_max", "sigma", "alpha").index(kind)
    others = (e for e in optimum.problem.model.elements if isinstance(e, Dahl) and e is not element)
    return next((e.parameters[place].name for e in others if e.parameters[place].name in lost), "")


def _of_spring(optimum: Optimum, lost: frozenset[str]) -> str:
    stiff = [
        e.parameters[1].name
        for e in optimum.problem.model.elements
        if isinstance(e, Dahl) and e.parameters[1].name in lost
    ]
    if stiff:
        return (
            f"because friction's stiffness {stiff[0]} can take its place: measure the spring "
            "without friction, or drive far into slip"
        )
    return "because its force is below the noise of the response: drive where it matters"


def _hiding_spring(optimum: Optimum, lost: frozenset[str]) -> str:
    """Return the name of a free spring that is not identified either, or of any free one."""
    springs = [e.parameters[0].name for e in optimum.problem.model.elements if _is_free_spring(e)]
    return next((name for name in springs if name in lost), springs[0] if springs else "")


def _is_free_spring(element: Element) -> bool:
    return isinstance(element, Spring) and bool(element.parameters[0].free)

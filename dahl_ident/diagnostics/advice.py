"""Advice: why a parameter is not determined, and the remedy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dahl_ident.diagnostics.contributions import ALONG_MOTION, EXPONENT, MODEL_ERROR, RUNS
from dahl_ident.diagnostics.information import parameter_values
from dahl_ident.diagnostics.intervals import Interval
from dahl_ident.diagnostics.physics import is_spring
from dahl_ident.diagnostics.record_errors import RecordErrors
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.elements.parameter import FORCE, STIFFNESS, Dimension
from dahl_ident.elements.recursion import Stretches, stretches
from dahl_ident.fitting import Optimum
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.units import Motion, shown_unit

_LONG_ENOUGH = 0.02  # share of samples near reversals that suffices
_INDISTINGUISHABLE = 0.95  # correlation at which two parameters cannot be distinguished
_BECAUSE = {  # reasons and remedies by the largest source of uncertainty
    EXPONENT: "of the exponent, which was not given: give it if it is known, or estimate it too",
    RUNS: "the records ask for different values: fit each alone, and look at what differs",
    ALONG_MOTION: "the residuals follow the motion: choose a model that describes what it does",
    MODEL_ERROR: (
        "parts of the records ask for different values: choose a model that describes them"
    ),
}
_CHANNELS = {"force_gain": "force", "displacement_gain": "displacement"}


def advice(optimum: Optimum, name: str, limits: Interval, lost: frozenset[str]) -> str:
    """Return "because ...: do ...", for a parameter that is not identified.

    `limits` is its interval, `lost` the names of all such parameters.
    """
    if not optimum.scale_known and optimum.dof <= 0:
        return (
            "because no residual is left from which to estimate the noise: measure more points, or "
            "repeat them so that their covariance is known"
        )
    gain = _confounding_gain(optimum, name, lost)
    if gain:
        return gain
    for element in optimum.problem.model.elements:
        names = [p.name for p in element.parameters]
        if name not in names:
            continue
        if element.has_memory:
            parameter = element.parameters[names.index(name)]
            return _friction_advice(optimum, element, parameter, limits, lost)
        if is_spring(element):
            return _spring_advice(optimum, lost)
    return (
        "because its effect on these data is below their noise or like that of another parameter: "
        "fix it, or measure where its effect is larger"
    )


def _confounding_gain(optimum: Optimum, name: str, lost: frozenset[str]) -> str:
    """Return the advice if a parameter is not determined because of an unknown gain."""
    priors = optimum.problem.priors
    for gain, channel in _CHANNELS.items():
        if gain not in lost or gain in priors:
            continue
        calibrate = f"calibrate the {channel} channel, or give {gain} a prior"
        if name == gain:
            return f"because the strength of friction is unknown as well: {calibrate}"
        return f"because the {gain} is free and scales with it: {calibrate}"
    return ""


def _friction_advice(
    optimum: Optimum, element: Element, parameter: Parameter, limits: Interval, lost: frozenset[str]
) -> str:
    """Return the advice on a parameter of friction."""
    label, dimension = element.label(parameter), parameter.dimension
    scales = label in element.scale_parameters
    amplitude = optimum.problem.stiffness_data.amplitude
    unit = shown_unit("m", optimum.problem.data.motion)
    least, most = f"{amplitude.min():.2g} {unit}", f"{amplitude.max():.2g} {unit}"
    elements = optimum.problem.model.elements
    for rival_element in elements:  # the same parameter of another element of this law
        if (
            rival_element is not element
            and rival_element.kind == element.kind
            and label in rival_element.labels
        ):
            rival = rival_element.parameter(label).name
            if rival in lost:
                return f"because {rival} can take its place: leave one of the two elements out"
    values = parameter_values(optimum)
    low, high = map(float, element.knee([np.asarray(values[p.name]) for p in element.parameters]))
    if not scales and not any(dimension):
        near = f"{low:.2g} {unit}" if low == high else f"{low:.2g} to {high:.2g} {unit}"
        return (
            f"because {parameter.name} shows only where stick turns to slip, and the data from "
            f"{least} to {most} do not resolve it: add amplitudes around {near}, or fix it"
        )
    springs = [p.name for e in elements if is_spring(e) for p in e.parameters if p.free]
    spring = next((name for name in springs if name in lost), springs[0] if springs else "")
    parallel = f" in parallel with the free {spring}" if spring else ""
    fix = f", or measure the spring and fix {spring}" if spring else ""
    share = f"friction's share of the response from {least} to {most}"
    unbounded = np.isinf(limits.upper)
    sticks = amplitude.max() < low
    is_limit, is_stiffness = scales and dimension == FORCE, scales and dimension == STIFFNESS
    limit_lost = any(p.name in lost for p in _scaled(element, FORCE))
    if spring and limits.lower <= 0.0 and unbounded and limit_lost:
        reason = f"{share},{parallel}, is within the noise"
        remedy = "cover amplitudes where it is larger, reduce the noise"
    elif is_limit and unbounded:
        hidden = f"the free {spring} hides it below {most}"
        reason = hidden if spring else f"no amplitude up to {most} reaches slip"
        remedy = "drive above that"
    elif is_stiffness and spring and (spring in lost or sticks):
        reason = f"the free {spring} can take its place"
        remedy = "drive far into slip"
    elif is_stiffness and unbounded and not limit_lost:
        reason = f"every amplitude from {least} slips and friction's stiffness fades{parallel}"
        remedy = "drive below that"
    elif spring:
        reason = f"the free {spring} explains the data from {least} to {most} nearly as well"
        remedy = "cover more amplitudes"
    else:
        reason = f"{share} is within the noise"
        remedy = "cover amplitudes where it is larger, or reduce the noise"
    return f"because {reason}: {remedy}{fix}"


def _scaled(element: Element, dimension: Dimension) -> list[Parameter]:
    """Return the scale parameters of a dimension."""
    scale = (element.parameter(label) for label in element.scale_parameters)
    return [p for p in scale if p.dimension == dimension]


def _spring_advice(optimum: Optimum, lost: frozenset[str]) -> str:
    """Return the advice on the stiffness of a spring in parallel with friction."""
    friction = (e for e in optimum.problem.model.elements if e.has_memory)
    stiff = [p.name for e in friction for p in _scaled(e, STIFFNESS) if p.name in lost]
    if stiff:
        return (
            f"because friction's stiffness {stiff[0]} can take its place: measure the spring "
            "without friction, or drive far into slip"
        )
    return "because its force is below the noise of the response: measure where it is larger"


def record_advice(
    model: Model, problem: RecordProblem, errors: RecordErrors, lost: Sequence[str]
) -> dict[str, str]:
    """Return "because ...: do ..." for parameters that records do not determine, by name.

    `model` has the estimates put in.
    """
    paths = [stretches(r.displacement) for r in problem.records if r.displacement is not None]
    why = {}
    for element in model.elements:
        for parameter in (p for p in element.parameters if p.name in lost):
            i = errors.names.index(parameter.name)
            known = float(errors.covariance[i, i]) ** 0.5 < abs(float(parameter.value or 0))
            missing = _missing_motion(element, paths, problem.motion, known=known)
            why[parameter.name] = f"because {missing or _largest_source(errors, i)}"
    return why


def _missing_motion(
    element: Element, paths: Sequence[Stretches], motion: Motion, *, known: bool
) -> str:
    """Return which motion is missing to determine a law; "" if none is.

    Slip begins at an unknown displacement if the estimate is not `known`.
    """
    farthest = max((float(p.path.max()) for p in paths), default=np.nan)
    if farthest == 0.0:
        return "the displacement is constant: move"
    if not element.has_memory or not paths:
        return ""
    values = [np.asarray(p.value if p.value is not None else 0.0) for p in element.parameters]
    low, high = (float(k) for k in element.knee(values))
    unit = shown_unit("m", motion)
    if farthest < 2.0 * low:
        needs = f"{2.0 * high:.2g} {unit}" if known else "more"
        return (
            f"the motion moves no farther than {farthest:.2g} {unit} after a reversal, and slip "
            f"needs {needs}: move farther"
        )
    if np.mean(np.concatenate([p.path < 2.0 * low for p in paths])) < _LONG_ENOUGH:
        return (
            f"the motion never stays below x_c = {low:.2g} {unit} long enough: add reversals and "
            "small motions of that size, sampled closely"
        )
    return ""


def _largest_source(errors: RecordErrors, place: int) -> str:
    """Return the largest source of uncertainty, or a parameter with a similar effect."""
    covariance = errors.covariance
    for source, C in errors.contributions.items():
        if source in _BECAUSE and 0.5 * covariance[place, place] < C[place, place] < np.inf:
            return _BECAUSE[source]
    with np.errstate(all="ignore"):
        size = np.sqrt(covariance.diagonal())
        alike = np.abs(covariance[place] / size / size[place]) > _INDISTINGUISHABLE
    if np.isinf(size[place]):  # with the others that are not determined at all
        alike = np.isinf(size)
    others = [n for i, n in enumerate(errors.names) if alike[i] and i != place]
    if others:
        return f"it cannot be distinguished from {', '.join(others)}: fix one of them"
    return "its effect is small compared with the residuals: fix it, or leave the element out"

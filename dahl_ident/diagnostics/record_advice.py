"""Advice on records: why a parameter is not determined, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dahl_ident.diagnostics.contributions import ALONG_MOTION, EXPONENT, MODEL_ERROR, RUNS
from dahl_ident.diagnostics.record_errors import RecordErrors
from dahl_ident.elements import Element, Model
from dahl_ident.elements.recursion import Stretches, stretches
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.units import Motion, si_unit

_UNCERTAIN = 0.3  # relative standard uncertainty of a parameter that is not determined
_LONG_ENOUGH = 0.02  # share of samples near a reversal
_ALIKE = 0.95  # correlation at which two parameters cannot be distinguished
_BECAUSE = {  # by the source of most of the uncertainty
    EXPONENT: "of the exponent, which was not given: give it if it is known, or estimate it too",
    RUNS: "the records ask for different values: fit each alone, and look at what differs",
    ALONG_MOTION: "the residuals follow the motion: choose a model that describes what it does",
    MODEL_ERROR: (
        "parts of the records ask for different values: choose a model that describes them"
    ),
}


def reasons(model: Model, problem: RecordProblem, errors: RecordErrors) -> dict[str, str]:
    """Return why parameters are not determined, by name: their uncertainty is a third of them.

    `model` has the estimates put in.
    """
    free = {p.name: i for i, p in enumerate(problem.free)}
    paths = [stretches(r.displacement) for r in problem.records if r.displacement is not None]
    why = {}
    for element in model.elements:
        for parameter in (p for p in element.parameters if p.name in free):
            place = free[parameter.name]
            error = float(errors.covariance[place, place]) ** 0.5
            value = abs(float(parameter.value or 0))
            # a parameter that may be zero, such as an asymmetry, is known whatever its bounds
            limit = min(parameter.upper, -parameter.lower) if parameter.lower < 0.0 else 0.0
            if error > _UNCERTAIN * max(limit if np.isfinite(limit) else 0.0, value):
                lacks = _motion_that_lacks(element, paths, problem.motion, known=error < value)
                why[parameter.name] = lacks or _largest_source(problem, errors, place)
    return why


def _motion_that_lacks(
    element: Element, paths: Sequence[Stretches], motion: Motion, *, known: bool
) -> str:
    """Return what the displacement lacks to determine a law; "" where it suffices.

    An estimate that is not `known` to its own size says nothing of where slip begins.
    """
    farthest = max((float(p.path.max()) for p in paths), default=np.nan)
    if farthest == 0.0:
        return ": the displacement is constant; move"
    if not element.has_memory or not paths:
        return ""
    values = [np.asarray(p.value if p.value is not None else 0.0) for p in element.parameters]
    low, high = (float(k) for k in element.knee(values))
    unit = si_unit("displacement", motion)
    if farthest < 2.0 * low:
        needs = f"{2.0 * high:.2g} {unit}" if known else "more"
        return (
            f": the motion moves no farther than {farthest:.2g} {unit} after a reversal, and slip "
            f"needs {needs}; move farther"
        )
    if np.mean(np.concatenate([p.path < 2.0 * low for p in paths])) < _LONG_ENOUGH:
        return (
            f": the motion never stays below x_c = {low:.2g} {unit} long enough; add reversals and "
            "small motions of that size, sampled closely"
        )
    return ""


def _largest_source(problem: RecordProblem, errors: RecordErrors, place: int) -> str:
    """Return the source of most of the uncertainty, or a parameter that acts alike."""
    covariance = errors.covariance
    for source, C in errors.contributions.items():
        if source in _BECAUSE and 0.5 * covariance[place, place] < C[place, place] < np.inf:
            return f" because {_BECAUSE[source]}"
    with np.errstate(all="ignore"):
        size = np.sqrt(covariance.diagonal())
        alike = np.abs(covariance[place] / size / size[place]) > _ALIKE
    others = [n for i, n in enumerate(problem.names) if alike[i] and i != place]
    if others:
        return f": it cannot be distinguished from {', '.join(others)}; fix one of them"
    return ": its effect is small compared with the residuals; fix it, or leave the element out"

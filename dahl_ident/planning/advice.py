"""What a plan does not determine, which limit prevents it, and what the prediction assumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import Candidates, evaluate, grid, level_range
from dahl_ident.planning.design import Design, Objective, continuous_design
from dahl_ident.planning.forecast import NOTHING, Expected, Forecast
from dahl_ident.planning.motion_information import evaluate_motions, motions_of
from dahl_ident.planning.question import BenchLimits, PlanRequest, is_expanded
from dahl_ident.planning.search import LONGEST, Search
from dahl_ident.planning.trajectories import PlannedMotion
from dahl_ident.units import percent, si_unit

_UNDETERMINED = 0.25  # relative standard uncertainty above which a parameter is not determined
_FEW_LEVELS = 60  # candidates with which the effect of a wider limit is judged
_NEARLY = 0.99  # of the longest plan: whole cycles leave some of the time
_RELAXED = 10.0  # times: a limit that prevents nothing then hardly helps
_MODEL_ERROR = {
    "none": "the model is right",
    "estimated": "the model errs as the earlier data show",
    "assumed": "levels chosen as if the model erred by the noise of the earlier data, "
    "which are too few to tell one from the other",
}


def options_of(
    question: PlanRequest,
    limits: BenchLimits,
    count: int = _FEW_LEVELS,
    lasting: float | None = None,
) -> Candidates:
    """Return the candidates of a question within limits; motions repeated for `lasting` s."""
    q = question
    if q.recorded is None:
        return evaluate(q, limits, *grid(q, limits, count))
    motions: Sequence[PlannedMotion] | str = q.motions
    if isinstance(motions, str):
        motions = motions_of(motions, limits, level_range(q, limits))
    return evaluate_motions(q.knowledge, motions, limits, q.recorded, lasting)


def undetermined(
    search: Search, design: Design, expected: Mapping[str, Expected]
) -> tuple[str, ...]:
    """Return a sentence for each undetermined quantity, with the limit that prevents it."""
    q = search.question
    lost = {
        name: f"{name} stays undetermined (standard uncertainty {_shown(e.after)})"
        for name, e in expected.items()
        if name not in (*q.target, *q.knowledge.assumed) and not e.after < _UNDETERMINED
    }
    for name, u in q.target.items() if q.has_numbers else ():
        if expected[name].after > 1.001 * u:
            what = "" if is_expanded(name) else "a standard uncertainty of "
            lost[name] = f"{name} reaches {what}{_shown(expected[name].after)}, not {_shown(u)}"
    if q.suspects and search.suspect_ratio(design) > 1.0:
        names = ", ".join(q.suspects)
        lost.setdefault(names, f"{names} is not seen as well as wanted")
    sentences = [f"{text}; {_prevented_by(search, name)}" for name, text in lost.items()]
    if not search.can_be_judged(design):
        sentences.append(
            "these levels are too few to tell a wrong model from noise, so that a fit to them "
            "alone cannot be used; give more time"
        )
    return tuple(sentences)


def _prevented_by(search: Search, name: str) -> str:
    """Return which limit, ten times wider, would help a quantity most."""
    q, most = search.question, {}
    if name not in search.forecast.directions:
        return "give more time or wider limits"
    base = _within_reach(q, name, q.limits)
    for limit in q.limits.stated:
        try:
            most[limit] = _within_reach(q, name, q.limits.relaxed(limit, _RELAXED))
        except ValidationError:
            continue
    if np.isfinite(q.limits.time):
        most["time"] = base / np.sqrt(_RELAXED)
    if not most:
        return "no limit was stated that prevents it"
    helps = min(most, key=lambda limit: most[limit])
    if not most[helps] < 0.8 * base:
        if search.forecast.model_error == "estimated":
            return "no limit alone prevents it: use a model that describes the data better"
        return "no limit alone prevents it: reduce the noise, or fix a parameter"
    return (
        f"the limit of {helps.removesuffix('_hz')} prevents it: ten times wider, it would be "
        f"{base / most[helps]:.2g} times smaller"
    )


def _within_reach(question: PlanRequest, name: str, limits: BenchLimits) -> float:
    """Return the uncertainty of one quantity by the best continuous design."""
    options = options_of(question, limits)
    few = Forecast.of(question, options).thinned()
    term = few.term({name: 1.0}, few.before + NOTHING * np.eye(few.before.shape[-1]))
    time = limits.time if np.isfinite(limits.time) else 1000.0
    design = continuous_design(Objective((term,)), options.frequency_hz, time, tolerance=0.1)
    return float(np.exp(-0.5 * design.value))


def assumptions_of(search: Search, design: Design) -> tuple[str, ...]:
    """Return the assumptions of the prediction."""
    q, known = search.question, search.question.knowledge
    force, length = (si_unit(kind, known.motion) for kind in ("force", "displacement"))
    noise: tuple[str, ...]
    if q.recorded is not None:
        noise = (
            f"white noise of {q.recorded.noise:.3g} {force} in each sample of force, "
            f"{q.recorded.sample_rate:g} samples a second; a record of each motion is fitted "
            "with its initial state, offset and drift",
        )
        within = [f"{name} within the range that a fit assumes" for name in known.assumed]
    else:
        noise = (
            f"noise of one cycle: {percent(q.noise.relative, 3)} of the response"
            + (f", {q.noise.force:.3g} {force}" if q.noise.force else "")
            + (f", {q.noise.displacement:.3g} {length}" if q.noise.displacement else ""),
            *["a row of the earlier data counts as one cycle"]
            * (known.row_noise is not None and known.row_cycles == 1.0),
            f"scatter between runs: {percent(q.scatter, 3)}"
            if q.scatter
            else "no scatter between runs",
        )
        within = [
            f"{', '.join(known.assumed)} within the range that a fit assumes (fix it in the model "
            "to plan without)"
        ] * bool(known.assumed)
    most = design.seconds > _NEARLY * LONGEST and not np.isfinite(q.limits.time)
    return (
        *noise, *within, _MODEL_ERROR[search.forecast.model_error], "calibrations are exact",
        *["no plan takes more than 30 days unless a time is given"] * most,
    )  # fmt: skip


def _shown(u: float) -> str:
    """Return a relative uncertainty in percent."""
    return percent(u, 3) if np.isfinite(u) else "without bound"

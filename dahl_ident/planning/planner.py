"""The public function that makes a plan from prior knowledge and the limits of the bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from dahl_ident.arrays import non_negative_array, positive_number, whole_number
from dahl_ident.data.columns import one_of
from dahl_ident.elements import Element
from dahl_ident.errors import ValidationError
from dahl_ident.planning.bench_time import LEAST_CYCLES
from dahl_ident.planning.candidates import (
    CONTROLLED,
    BenchLimits,
    Candidates,
    CycleNoise,
    bench_time,
    evaluate,
    grid,
    level_range,
)
from dahl_ident.planning.criteria import NOTHING, Objective, Term
from dahl_ident.planning.forecast import SEARCHED, Forecast
from dahl_ident.planning.knowledge import Ranges, gather
from dahl_ident.planning.level_search import LONGEST, LevelSearch, Solution
from dahl_ident.planning.measurement_plan import Expected, Plan, PlanStep
from dahl_ident.planning.motion_information import evaluate_motions, motions_of, root
from dahl_ident.planning.optimal_design import continuous_design
from dahl_ident.planning.quantities import RESPONSE, is_expanded, sizes
from dahl_ident.planning.question import (
    PlanRequest,
    larger_model,
    motions_asked,
    noise_of,
    recorded_force,
    targets_of,
)
from dahl_ident.planning.trajectories import PlannedMotion
from dahl_ident.steady_state import STEADY, Steady
from dahl_ident.units import si_unit

_UNDETERMINED = 0.25  # relative standard uncertainty above which a parameter is not determined
_FEW_LEVELS = 60  # candidates with which the effect of a wider limit is judged
_CORRECTIONS = 6  # of the repeats of motions, each by the whole information
_NEARLY = 0.99  # of the longest plan: whole cycles leave some of the time
_AIMED = 0.999  # fraction of the target
_RELAXED = 10.0  # times: a limit that prevents nothing then hardly helps


def plan(
    source: Any,
    *,
    limits: Mapping[str, Any],
    target: Mapping[str, float] | Sequence[str] | str | None = None,
    ranges: Ranges | None = None,
    noise: float | Mapping[str, float] | None = None,
    scatter: float | None = None,
    runs: int | None = None,
    controlled: str = "displacement",
    candidates: int | str | Sequence[tuple[float, float]] | Sequence[PlannedMotion] = 240,
    larger: Element | None = None,
    suspects: Mapping[str, float] | None = None,
    change_over: float = 1.0,
    settled: float = 0.01,
    between_runs: float = 0.0,
    sample_rate: float | None = None,
    steady: Steady | None = None,
    draws: int = 200,
    seed: int = 0,
) -> Plan:
    """Return the levels, frequencies and cycles to measure next.

    Parameters
    ----------
    source : Element, FitResult, RecordFit or posterior
        What is known: a model with `ranges` before any data, or the result of earlier ones,
        whose information is added.
    limits : mapping
        ``frequency_hz`` (needed for sines), ``displacement``, ``force``, ``speed`` and
        ``acceleration``: the highest value, or lowest and highest, zero-to-peak, SI; ``time``:
        seconds for everything.
    target : mapping, sequence of str, or str, optional
        Mapping from a parameter, or a product of powers such as ``"f_max/sigma"``, to its wanted
        relative standard uncertainty, or from ``"U(f_max)"`` to its relative expanded uncertainty
        (95.45 %): the least time that reaches all. Names alone: their least uncertainty in
        ``limits["time"]``. Left out: D-optimal in that time. ``"response"`` is the device's
        response over the candidates, root mean square of ln gain and phase.
    ranges : mapping of str to (float, float), optional
        Range that contains a parameter with 95 % probability. The search uses it, but the predicted
        uncertainty does not include it.
    noise : float or mapping, optional
        Of one cycle: standard deviation of ln gain and phase, or a mapping with ``relative``,
        ``force`` and ``displacement`` (N and m, standard deviation of each part of the
        fundamental). Left out, that of the earlier data. For motions in time ``{"force": s}``, the
        standard deviation of a sample, N.
    scatter : float, optional
        Standard deviation of ln gain and phase between runs. Left out, that of the earlier data,
        else 0.
    runs : int, optional
        Left out, as many as are best: 1 without scatter, else up to 8.
    controlled : {"displacement", "force"}
        What the exciter holds. With "force", levels are drives of the whole plant.
    candidates : int, sequence of (level, frequency_hz), str, or sequence of motions, default 240
        How many levels to choose from, or which. ``"trapezoid"`` and ``"multisine"`` stand for
        motions in time within the limits, to be fitted as records; or give them as
        :class:`dahl_ident.planning.Trapezoid` and :class:`dahl_ident.planning.Multisine`.
    larger : Element, optional
        Model in which `suspects` are parameters; left out, the model itself.
    suspects : mapping of str to float, optional
        Parameters that may be needed although the model fixes or omits them, such as ``{"alpha":
        0.1}``, and the standard uncertainty that the plan must reach for each in the larger model:
        relative for positive parameters, absolute for others.
    change_over : float, default 1
        Seconds from one level to the next.
    settled : float, default 0.01
        Share of the friction force below which a transient counts as settled.
    between_runs : float, default 0
        Seconds that each run takes in addition to its levels.
    sample_rate : float, optional
        Samples a second of the records of motions in time, which need it.
    steady : {"exact", "describing function"}, optional
        With ``controlled="force"``: how the response is predicted. Left out, as in the fit given,
        or "exact".
    draws : int, default 200
        Parameter vectors that the criterion is averaged over; of motions in time, and of exact
        steady motions, at most 24.
    seed : int, default 0
        Of the draws.

    Returns
    -------
    Plan
        Printed: table, predicted uncertainties, what stays undetermined and why.

    Raises
    ------
    ValidationError
        If a parameter has no range, the noise is unknown, the limits leave no level, or the time
        is too short for a single one.

    Notes
    -----
    From a fit, the plan takes its noise, model error and scatter between runs. The model error is
    alike at levels close to each other, so levels are spread; where the earlier data are too few
    to tell it from noise, levels are chosen as if both were equally large. A posterior has none.

    The criterion is the mean of its logarithm over the draws; see
    :mod:`dahl_ident.planning.criteria` and :mod:`dahl_ident.planning.optimal_design`.

    Examples
    --------
    >>> import dahl_ident as di
    >>> plan = di.plan(
    ...     di.Dahl(),
    ...     ranges={"f_max": (0.05, 0.2), "sigma": (15.0, 60.0)},
    ...     limits={"displacement": (1e-4, 3e-2), "frequency_hz": 5.0},
    ...     target={"f_max": 0.01, "sigma": 0.01},
    ...     noise=0.02,
    ... )
    >>> plan.reached, len(plan.steps) < 8
    (True, True)
    """
    whole_number(draws, "draws", 2)
    one_of(controlled, "controlled", CONTROLLED)
    bench = BenchLimits.of(limits)
    knowledge = gather(source, ranges, draws, seed)
    if steady is not None:
        one_of(steady, "steady", STEADY)
        knowledge = replace(knowledge, steady=steady)
    wanted, numbers = targets_of(target)
    if not numbers and not np.isfinite(bench.time):
        raise ValidationError(
            "plan: without a wanted uncertainty the time is needed: give limits['time'], or "
            "target={'f_max': 0.02}"
        )
    costs = {
        "change_over": float(non_negative_array(change_over, "change_over")),
        "settled": positive_number(settled, "settled"),
        "between_runs": float(non_negative_array(between_runs, "between_runs")),
    }
    asked = motions_asked(candidates)
    if asked:
        _only_motions(wanted, scatter, suspects, controlled, runs, larger)
        known = replace(knowledge.thinned(SEARCHED), errors=None, scatter=0.0)
        question = PlanRequest(
            known, bench, controlled, CycleNoise(0.0), wanted, numbers, 0.0, 1, costs, None, {},
            recorded_force(noise, sample_rate, knowledge), asked,
        )  # fmt: skip
        return _of_motions(question, bench)
    if sample_rate is not None:
        raise ValidationError(
            "plan: sample_rate is that of records of motions in time; leave it out for settled "
            "sines, or give candidates='trapezoid'"
        )
    if controlled == "force" and knowledge.steady == "exact":
        knowledge = knowledge.thinned(SEARCHED)
    question = PlanRequest(
        knowledge, bench, controlled, noise_of(noise, knowledge), wanted, numbers,
        knowledge.scatter if scatter is None else float(non_negative_array(scatter, "scatter")),
        None if runs is None else whole_number(runs, "runs", 1),
        costs, larger_model(knowledge, larger, suspects), dict(suspects or {}),
    )  # fmt: skip
    if isinstance(candidates, int):
        whole_number(candidates, "candidates", 2)
        return Planner(question, _options(question, bench, candidates)).plan()
    pairs = non_negative_array(
        [list(cast("tuple[float, float]", p)) for p in candidates], "candidates"
    )
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValidationError("candidates: expected pairs of level and frequency in Hz")
    level, frequency = pairs.T
    return Planner(
        question, evaluate(knowledge, level, frequency, controlled, bench, question.noise)
    ).plan()


def _only_motions(
    wanted: Any, scatter: Any, suspects: Any, controlled: str, runs: Any, larger: Any
) -> None:
    """Check that nothing is asked of motions in time that only settled sines have."""
    given = {
        "target 'response'": RESPONSE in wanted,
        "scatter": bool(scatter),
        "suspects": bool(suspects),
        "larger": larger is not None,
        "runs": runs not in (None, 1),
        "controlled='force'": controlled == "force",
    }
    for name, there in given.items():
        if there:
            raise ValidationError(
                f"plan: {name} is planned with settled sines only; leave it out for motions in "
                "time, or leave candidates out"
            )


def _of_motions(question: PlanRequest, limits: BenchLimits) -> Plan:
    """Return the better of two plans of motions.

    The first takes a repeat as worth the same share of a long record for every motion; the second
    as worth what it is in a record as long as the first plan, so that a motion of which that time
    holds few repeats, whose first is spent on the record's own unknowns, is not preferred.
    """
    first = Planner(question, _options(question, limits))
    plan = first.plan()
    second = Planner(question, _options(question, limits, lasting=plan.seconds))
    other = second.plan()
    return other if second.score(other) > first.score(plan) else plan


def _options(
    question: PlanRequest,
    limits: BenchLimits,
    count: int = _FEW_LEVELS,
    lasting: float | None = None,
) -> Candidates:
    """Return the candidates of a question within limits; motions repeated for `lasting` s."""
    q = question
    if q.recorded is None:
        level, frequency = grid(q.knowledge, limits, q.controlled, count)
        return evaluate(q.knowledge, level, frequency, q.controlled, limits, q.noise)
    asked: Sequence[PlannedMotion] | str = q.motions
    if isinstance(asked, str):
        asked = motions_of(asked, limits, level_range(q.knowledge, limits, q.controlled))
    return evaluate_motions(q.knowledge, asked, limits, q.recorded, lasting)


class Planner:
    """One planning problem: its candidates, the search among them, and the plan in words."""

    def __init__(self, question: PlanRequest, candidates: Candidates) -> None:
        self.question = q = question
        bench = bench_time(candidates, q.knowledge, **q.costs)
        settles = np.isfinite(bench.fixed(np.arange(candidates.count)[:, None]))
        if not settles.any():
            raise ValidationError(
                "plan: no candidate ever settles; widen limits['displacement'] upwards"
            )
        if not settles.all():
            candidates = candidates.only(np.flatnonzero(settles))
            bench = bench_time(candidates, q.knowledge, **q.costs)
        self.forecast = Forecast.of(q.knowledge, candidates, q.wanted, q.scatter)
        self.search = LevelSearch(q, self.forecast, bench)
        self.found: Solution | None = None

    def plan(self) -> Plan:
        """Return the plan."""
        q = self.question
        found = self.search.least_time() if q.numbers else self.search.solve(q.limits.time)
        if found is None:
            f = self.forecast.candidates.frequency_hz
            alone = self.search.bench.fixed(np.arange(len(f))[:, None])
            least = float((alone + LEAST_CYCLES / f).min())
            raise ValidationError(
                f"limits['time'] is {q.limits.time:g} s, and the quickest "
                f"{'level' if q.recorded is None else 'motion'} takes {least:.3g} "
                "s to change over, settle and measure; give more time"
            )
        self.found = found if q.recorded is None else self._exactly(found)
        return self._told(self.found)

    def score(self, plan: Plan) -> tuple[bool, float]:
        """Return what is larger for the better of two plans of the same question."""
        q = self.question
        if q.numbers and plan.reached:
            return True, -plan.seconds
        if q.numbers:
            return False, -max(plan.expected[name].after / u for name, u in q.wanted.items())
        assert self.found is not None
        chosen = self.found.selection
        some = Objective((self.forecast.thinned().term(q.wanted),)).only(chosen.levels)
        return True, float(some.at(chosen.cycles).value)

    def _exactly(self, found: Solution) -> Solution:
        """Return the repeats that reach the targets by the information of the whole records.

        The search takes each repeat of a motion as worth the same; the first ones, which also have
        to determine the state at the start, the offset and the drift, are worth less.
        """
        q, candidates = self.question, self.forecast.candidates
        levels, cycles = found.selection.levels, found.selection.cycles
        assert q.recorded is not None
        risen = False
        for attempt in range(_CORRECTIONS):
            rows = candidates.rows.copy()
            for k, n in zip(levels.tolist(), cycles.tolist(), strict=True):
                one = q.recorded.information(q.knowledge, candidates.motions[k], int(n))
                rows[:, k] = root(one / n) * sizes(q.knowledge.parameters, q.knowledge.theta)
            exact = replace(self.forecast, candidates=replace(candidates, rows=rows))
            self.search.forecast = exact
            ratio = self.search.ratio(replace(found.selection, cycles=cycles), 1)
            better = np.maximum(np.ceil(cycles * (ratio / _AIMED) ** 2), float(LEAST_CYCLES))
            possible = self.search.bench.seconds(levels, better) <= min(q.limits.time, LONGEST)
            done = (ratio <= 1.0 and risen) or bool((better == cycles).all())
            if done or not (q.numbers and possible) or attempt == _CORRECTIONS - 1:
                break
            risen = risen or ratio > 1.0
            cycles = better
        self.forecast = exact
        return Solution(
            replace(found.selection, cycles=cycles), 1,
            self.search.bench.seconds(levels, cycles), ratio,
        )  # fmt: skip

    def _told(self, found: Solution) -> Plan:
        q, chosen = self.question, found.selection
        settling = self.search.bench.settling_cycles(chosen.levels)
        options = self.forecast.candidates.only(chosen.levels)
        steps = tuple(
            PlanStep(level, f, int(wait), int(n), q.costs["change_over"] + (wait + n) / f, motion)
            for level, f, wait, n, motion in zip(
                options.level.tolist(), options.frequency_hz.tolist(), settling.tolist(),
                chosen.cycles.tolist(), options.motions or (None,) * len(settling), strict=True,
            )
        )  # fmt: skip
        expected = self.forecast.expected(chosen.levels, chosen.cycles, found.runs)
        reached = not q.numbers or found.ratio <= 1.0
        assumptions = self._assumptions()
        if found.seconds > _NEARLY * LONGEST and not np.isfinite(q.limits.time):
            assumptions = (*assumptions, "no plan takes more than 30 days unless a time is given")
        return Plan(
            controlled=q.controlled,
            steps=steps,
            runs=found.runs,
            seconds=found.seconds,
            expected=expected,
            target=dict(q.wanted) if q.numbers else {},
            reached=reached and found.ratio <= 1.0,
            undetermined=self._undetermined(found, expected),
            assumptions=assumptions,
            change_over=q.costs["change_over"],
            motion=q.knowledge.motion,
            planner=self,
        )

    def _undetermined(self, found: Solution, expected: Mapping[str, Expected]) -> tuple[str, ...]:
        """Return a sentence for each undetermined quantity, with the limit that prevents it."""
        q = self.question
        lost = {
            name: f"{name} stays undetermined (standard uncertainty {_percent(e.after)})"
            for name, e in expected.items()
            if name not in (*q.wanted, *q.knowledge.assumed) and not e.after < _UNDETERMINED
        }
        for name, u in q.wanted.items() if q.numbers else ():
            if expected[name].after > 1.001 * u:
                what = "" if is_expanded(name) else "a standard uncertainty of "
                lost[name] = (
                    f"{name} reaches {what}{_percent(expected[name].after)}, not {_percent(u)}"
                )
        if q.suspects and self.search.suspect_ratio(found.selection, found.runs) > 1.0:
            names = ", ".join(q.suspects)
            lost.setdefault(names, f"{names} is not seen as well as wanted")
        return tuple(f"{text}; {self._prevented_by(name)}" for name, text in lost.items())

    def _prevented_by(self, name: str) -> str:
        """Return which limit, ten times wider, would help a quantity most."""
        q, most = self.question, {}
        if name not in self.forecast.directions:
            return "give more time or wider limits"
        base = self._within_reach(name, q.limits)
        for limit in q.limits.stated:
            try:
                most[limit] = self._within_reach(name, q.limits.relaxed(limit, _RELAXED))
            except ValidationError:
                continue
        if np.isfinite(q.limits.time):
            most["time"] = base / np.sqrt(_RELAXED)
        if not most:
            return "no limit was stated that prevents it"
        helps = min(most, key=lambda limit: most[limit])
        if not most[helps] < 0.8 * base:
            if self.forecast.model_error == "estimated":
                return "no limit alone prevents it: use a model that describes the data better"
            return "no limit alone prevents it: reduce the noise, or fix a parameter"
        return (
            f"the limit of {helps.removesuffix('_hz')} prevents it: ten times wider, it would be "
            f"{base / most[helps]:.2g} times smaller"
        )

    def _within_reach(self, name: str, limits: BenchLimits) -> float:
        """Return the uncertainty of one quantity by the best continuous design."""
        q = self.question
        options = _options(q, limits)
        some = Forecast.of(q.knowledge, options, q.wanted, q.scatter).thinned()
        known = some.before + NOTHING * np.eye(some.before.shape[-1])
        levels = some.candidates.information(q.scatter)
        term = Term(levels, known, some.directions[name], np.zeros(1, dtype=int))
        time = limits.time if np.isfinite(limits.time) else 1000.0
        design = continuous_design(Objective((term,)), options.frequency_hz, time, tolerance=0.1)
        return float(np.exp(-0.5 * design.value))

    def _assumptions(self) -> tuple[str, ...]:
        q, found = self.question, []
        force, length = (si_unit(kind, q.knowledge.motion) for kind in ("force", "displacement"))
        if q.recorded is not None:
            return (
                f"white noise of {q.recorded.noise:.3g} {force} in each sample of force, "
                f"{q.recorded.sample_rate:g} samples a second; a record of each motion is fitted "
                "with its initial state, offset and drift",
                *(f"{n} within the range that a fit assumes" for n in q.knowledge.assumed),
                "the model is right", "calibrations are exact",
            )  # fmt: skip
        found.append(
            f"noise of one cycle: {100.0 * q.noise.relative:.3g} % of the response"
            + (f", {q.noise.force:.3g} {force}" if q.noise.force else "")
            + (f", {q.noise.displacement:.3g} {length}" if q.noise.displacement else "")
        )
        if q.knowledge.row_noise is not None and q.knowledge.row_cycles == 1.0:
            found.append("a row of the earlier data counts as one cycle")
        found.append(
            f"scatter between runs: {100.0 * q.scatter:.3g} %" if q.scatter
            else "no scatter between runs"
        )  # fmt: skip
        if q.knowledge.assumed:
            found.append(
                f"{', '.join(q.knowledge.assumed)} within the range that a fit assumes (fix it in "
                "the model to plan without)"
            )
        found.append(
            {
                "none": "the model is right",
                "estimated": "the model errs as the earlier data show",
                "assumed": "levels chosen as if the model erred by the noise of the earlier data, "
                "which are too few to tell one from the other",
            }[self.forecast.model_error]
        )
        found.append("calibrations are exact")
        return tuple(found)


def _percent(u: float) -> str:
    return f"{100.0 * u:.3g} %" if np.isfinite(u) else "without bound"

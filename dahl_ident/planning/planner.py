"""The public function that makes a plan from prior knowledge and the limits of the bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, non_negative_array, positive_number, whole_number
from dahl_ident.data.fields import one_of
from dahl_ident.elements import Element
from dahl_ident.errors import ValidationError
from dahl_ident.planning.bench_time import LEAST_CYCLES
from dahl_ident.planning.candidates import CONTROLLED, Limits, bench_time, evaluate, grid
from dahl_ident.planning.criteria import Objective, Term
from dahl_ident.planning.forecast import Forecast
from dahl_ident.planning.knowledge import Ranges, gather
from dahl_ident.planning.level_search import LevelSearch, Solution
from dahl_ident.planning.measurement_plan import Expected, Plan, Step
from dahl_ident.planning.optimal_design import continuous_design
from dahl_ident.planning.quantities import is_expanded
from dahl_ident.planning.question import Question, larger_model, noise_of, targets_of

_NOTHING = 1e-8  # information added so that a parameter without any has an uncertainty
_UNDETERMINED = 0.25  # relative standard uncertainty above which a parameter is not determined
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
    candidates: int | Sequence[tuple[float, float]] = 240,
    larger: Element | None = None,
    suspects: Mapping[str, float] | None = None,
    change_over: float = 1.0,
    settled: float = 0.01,
    between_runs: float = 0.0,
    draws: int = 200,
    seed: int = 0,
) -> Plan:
    """Return the levels, frequencies and cycles to measure next.

    Parameters
    ----------
    source : Element, FitResult or posterior
        What is known: a model with `ranges` before any data, or the result of earlier ones,
        whose information is added.
    limits : mapping
        ``frequency_hz`` (needed), ``displacement``, ``force`` and ``speed``: the highest value,
        or lowest and highest, zero-to-peak, SI; ``time``: seconds for everything.
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
        fundamental). Left out, that of the earlier data.
    scatter : float, optional
        Standard deviation of ln gain and phase between runs. Left out, that of the earlier data,
        else 0.
    runs : int, optional
        Left out, as many as are best: 1 without scatter, else up to 8.
    controlled : {"displacement", "force"}
        What the exciter holds. With "force", levels are drives of the whole plant.
    candidates : int or sequence of (level, frequency_hz), default 240
        How many to choose from, or which.
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
    draws : int, default 200
        Parameter vectors that the criterion is averaged over.
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
    bench = Limits.of(limits)
    knowledge = gather(source, ranges, draws, seed)
    per_cycle = noise_of(noise, knowledge)
    if isinstance(candidates, int):
        whole_number(candidates, "candidates", 2)
        level, frequency = grid(knowledge, bench, controlled, candidates)
    else:
        pairs = non_negative_array([list(pair) for pair in candidates], "candidates")
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ValidationError("candidates: expected pairs of level and frequency in Hz")
        level, frequency = pairs.T
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
    question = Question(
        knowledge, bench, controlled, per_cycle, wanted, numbers,
        knowledge.scatter if scatter is None else float(non_negative_array(scatter, "scatter")),
        None if runs is None else whole_number(runs, "runs", 1),
        costs, larger_model(knowledge, larger, suspects), dict(suspects or {}),
    )  # fmt: skip
    return Planner(question, level, frequency).plan()


class Planner:
    """One planning problem: its candidates, the search among them, and the plan in words."""

    def __init__(self, question: Question, level: FloatArray, frequency_hz: FloatArray) -> None:
        self.question = q = question
        candidates = evaluate(q.knowledge, level, frequency_hz, q.controlled, q.limits, q.noise)
        bench = bench_time(candidates, q.knowledge, **q.costs)
        settles = np.isfinite([bench.fixed([k]) for k in range(candidates.count)])
        if not settles.any():
            raise ValidationError(
                "plan: no candidate ever settles; widen limits['displacement'] upwards"
            )
        if not settles.all():
            candidates = candidates.only(np.flatnonzero(settles))
            bench = bench_time(candidates, q.knowledge, **q.costs)
        self.forecast = Forecast.of(q.knowledge, candidates, q.wanted, q.scatter)
        self.search = LevelSearch(q, self.forecast, bench)

    def plan(self) -> Plan:
        """Return the plan."""
        q = self.question
        found = self.search.least_time() if q.numbers else self.search.solve(q.limits.time)
        if found is None:
            least = min(
                self.search.bench.fixed([k]) + LEAST_CYCLES / f
                for k, f in enumerate(self.forecast.candidates.frequency_hz.tolist())
            )
            raise ValidationError(
                f"limits['time'] is {q.limits.time:g} s, and the quickest level takes {least:.3g} "
                "s to change over, settle and measure; give more time"
            )
        return self._told(found)

    def _told(self, found: Solution) -> Plan:
        q, chosen = self.question, found.selection
        settling = self.search.bench.settling_cycles(chosen.levels)
        steps = tuple(
            Step(level, f, int(wait), int(n), q.costs["change_over"] + (wait + n) / f)
            for level, f, wait, n in zip(
                self.forecast.candidates.level[chosen.levels].tolist(),
                self.forecast.candidates.frequency_hz[chosen.levels].tolist(),
                settling.tolist(), chosen.cycles.tolist(), strict=True,
            )
        )  # fmt: skip
        expected = self.forecast.expected(chosen.levels, chosen.cycles, found.runs)
        reached = not q.numbers or found.ratio <= 1.0
        return Plan(
            controlled=q.controlled,
            steps=steps,
            runs=found.runs,
            seconds=found.seconds,
            expected=expected,
            target=dict(q.wanted) if q.numbers else {},
            reached=reached and found.ratio <= 1.0,
            undetermined=self._undetermined(found, expected),
            assumptions=self._assumptions(),
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

    def _within_reach(self, name: str, limits: Limits) -> float:
        """Return the uncertainty of one quantity by the best continuous design."""
        q = self.question
        level, f = grid(q.knowledge, limits, q.controlled, 60)
        options = evaluate(q.knowledge, level, f, q.controlled, limits, q.noise)
        some = Forecast.of(q.knowledge, options, q.wanted, q.scatter).thinned()
        known = some.before + _NOTHING * np.eye(some.before.shape[-1])
        levels = some.candidates.information(q.scatter)
        term = Term(levels, known, some.directions[name], np.zeros(1, dtype=int))
        time = limits.time if np.isfinite(limits.time) else 1000.0
        design = continuous_design(Objective((term,)), options.frequency_hz, time, tolerance=0.1)
        return float(np.exp(-0.5 * design.value))

    def _assumptions(self) -> tuple[str, ...]:
        q, found = self.question, []
        found.append(
            f"noise of one cycle: {100.0 * q.noise.relative:.3g} % of the response"
            + (f", {q.noise.force:.3g} N" if q.noise.force else "")
            + (f", {q.noise.displacement:.3g} m" if q.noise.displacement else "")
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

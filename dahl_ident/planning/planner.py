"""The public function that makes a plan from prior knowledge and the limits of the bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from dahl_ident.arrays import non_negative_array, positive_number, whole_number
from dahl_ident.data.columns import one_of
from dahl_ident.elements import Element
from dahl_ident.elements.driven_motion import STEADY, Steady
from dahl_ident.errors import ValidationError, argument
from dahl_ident.planning.candidates import CONTROLLED, evaluate
from dahl_ident.planning.design import Design
from dahl_ident.planning.forecast import SEARCHED
from dahl_ident.planning.knowledge import Ranges, gather
from dahl_ident.planning.measurement_plan import (
    Plan,
    PlanStep,
    assumptions_of,
    options_of,
    undetermined,
)
from dahl_ident.planning.question import (
    RESPONSE,
    BenchLimits,
    PlanRequest,
    larger_model,
    limit,
    motions_among,
    noise_of_cycle,
    recorded_force,
    target_of,
)
from dahl_ident.planning.search import Search
from dahl_ident.planning.trajectories import PlannedMotion


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
    source : Element, FitResult or Posterior
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

    Without earlier data, a plan has as many levels as a fit to them alone needs to tell a wrong
    model from noise; where the time does not allow it, the target is not reached.

    The criterion is the mean of its logarithm over the draws; see
    :mod:`dahl_ident.planning.design`.

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
    wanted, has_numbers = target_of(target)
    if not has_numbers and not np.isfinite(bench.time):
        raise ValidationError(
            f"plan: without a wanted uncertainty the time is needed: give {limit('time')}, or "
            f"{argument('target', {'f_max': 0.02})}"
        )
    costs = {
        "change_over": float(non_negative_array(change_over, "change_over")),
        "settled": positive_number(settled, "settled"),
        "between_runs": float(non_negative_array(between_runs, "between_runs")),
    }
    motions = motions_among(candidates)
    if motions:
        of_sines = {
            "target 'response'": RESPONSE in wanted,
            "scatter": bool(scatter),
            "suspects": bool(suspects),
            "larger": larger is not None,
            "runs": runs not in (None, 1),
            argument("controlled", "force"): controlled == "force",
        }
        if any(of_sines.values()):
            name = next(name for name, stated in of_sines.items() if stated)
            raise ValidationError(
                f"plan: {name} is planned with settled sines only; leave it out for motions in "
                "time, or leave candidates out"
            )
        known = replace(knowledge.thinned(SEARCHED), errors=None, scatter=0.0)
        recorded = recorded_force(noise, sample_rate, knowledge)
        arguments = (known, bench, wanted, has_numbers, costs)
        return _of_motions(PlanRequest(*arguments, recorded=recorded, motions=motions))
    if sample_rate is not None:
        raise ValidationError(
            "plan: sample_rate is that of records of motions in time; leave it out for settled "
            f"sines, or give {argument('candidates', 'trapezoid', option='motion')}"
        )
    if controlled == "force" and knowledge.steady == "exact":
        knowledge = knowledge.thinned(SEARCHED)
    question = PlanRequest(
        knowledge, bench, wanted, has_numbers, costs, controlled, noise_of_cycle(noise, knowledge),
        knowledge.scatter if scatter is None else float(non_negative_array(scatter, "scatter")),
        None if runs is None else whole_number(runs, "runs", 1),
        larger_model(knowledge, larger, suspects), dict(suspects or {}),
    )  # fmt: skip
    if isinstance(candidates, int):
        options = options_of(question, bench, whole_number(candidates, "candidates", 2))
    else:
        pairs = non_negative_array(
            [list(cast("tuple[float, float]", p)) for p in candidates], "candidates"
        )
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ValidationError("candidates: expected pairs of level and frequency in Hz")
        options = evaluate(question, bench, *pairs.T)
    search = Search(question, options)
    return _plan(search, search.best())


def _of_motions(question: PlanRequest) -> Plan:
    """Return the better of two plans of motions.

    The first takes a repeat as worth the same share of a long record for every motion; the second
    as worth what it is in a record as long as the first plan, so that a motion of which that time
    holds few repeats, whose first is spent on the record's own unknowns, is not preferred.
    """
    first = Search(question, options_of(question, question.limits))
    first_best = first.best()
    second = Search(question, options_of(question, question.limits, lasting=first_best.seconds))
    second_best = second.best()
    better = second.score(second_best) > first.score(first_best)
    return _plan(second, second_best) if better else _plan(first, first_best)


def _plan(search: Search, design: Design) -> Plan:
    q, levels = search.question, design.levels
    options, change_over = search.forecast.candidates.only(levels), q.costs["change_over"]
    settling = search.bench.settling_cycles(levels)
    steps = tuple(
        PlanStep(level, f, int(wait), int(n), change_over + (wait + n) / f, motion)
        for level, f, wait, n, motion in zip(
            options.level.tolist(), options.frequency_hz.tolist(), settling.tolist(),
            design.cycles.tolist(), options.motions or (None,) * len(settling), strict=True,
        )
    )  # fmt: skip
    expected = search.forecast.expected(design)
    return Plan(
        controlled=q.controlled,
        steps=steps,
        runs=design.runs,
        seconds=design.seconds,
        expected=expected,
        target=dict(q.target) if q.has_numbers else {},
        reached=search.reached(design),
        undetermined=undetermined(search, design, expected),
        assumptions=assumptions_of(search, design),
        change_over=change_over,
        motion=q.knowledge.motion,
        search=search,
    )

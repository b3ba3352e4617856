"""The public function that plans measurements from prior knowledge and the limits of the bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from dahl_ident.arrays import non_negative_array, positive_number, whole_number
from dahl_ident.data.columns import CONTROLLED, one_of
from dahl_ident.elements import Element
from dahl_ident.elements.driven_motion import STEADY, Steady
from dahl_ident.errors import ValidationError, argument
from dahl_ident.planning.candidates import evaluate
from dahl_ident.planning.design import Design
from dahl_ident.planning.forecast import SEARCHED
from dahl_ident.planning.knowledge import Ranges, gather
from dahl_ident.planning.measurement_plan import (
    Plan,
    PlanStep,
    assumptions_of,
    candidates_within,
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
        Prior knowledge: a model with `ranges` before any data, or the result of earlier data,
        whose information is added.
    limits : mapping
        ``frequency_hz`` (needed for sines), ``displacement``, ``force``, ``speed`` and
        ``acceleration``: the highest value, or lowest and highest, zero-to-peak, SI; ``time``:
        seconds in total.
    target : mapping, sequence of str, or str, optional
        Mapping from a parameter, or a product of powers such as ``"f_max/sigma"``, to its target
        relative standard uncertainty, or from ``"U(f_max)"`` to its relative expanded uncertainty
        (95.45 %): the plan meets all targets in the least time. Names only: the plan minimises
        their uncertainty in ``limits["time"]``. By default the plan is D-optimal in that time.
        ``"response"`` is the device's response over the candidates, root mean square of ln gain
        and phase.
    ranges : mapping of str to (float, float), optional
        Range that contains a parameter with 95 % probability. The search uses it, but the predicted
        uncertainty does not include it.
    noise : float or mapping, optional
        Of one cycle: standard deviation of ln gain and phase, or a mapping with ``relative``,
        ``force`` and ``displacement`` (N and m, standard deviation of each part of the
        fundamental). By default that of the earlier data. For motions in time ``{"force": s}``, the
        standard deviation of a sample, N.
    scatter : float, optional
        Standard deviation of ln gain and phase between runs. By default that of the earlier data,
        or 0.
    runs : int, optional
        Number of runs. By default the best one: 1 without scatter, otherwise up to 8.
    controlled : {"displacement", "force"}
        The controlled quantity. With "force", levels are drives of the whole plant.
    candidates : int, sequence of (level, frequency_hz), str, or sequence of motions, default 240
        The levels to choose from, or their number. ``"trapezoid"`` and ``"multisine"`` stand for
        motions in time within the limits, to be fitted as records; or give them as
        :class:`dahl_ident.planning.Trapezoid` and :class:`dahl_ident.planning.Multisine`.
    larger : Element, optional
        Model in which `suspects` are parameters; by default the model itself.
    suspects : mapping of str to float, optional
        Parameters that may be needed although the model fixes or omits them, such as ``{"alpha":
        0.1}``, and the standard uncertainty of each in the larger model that the plan must meet:
        relative for positive parameters, absolute for others.
    change_over : float, default 1
        Seconds from one level to the next.
    settled : float, default 0.01
        Fraction of the friction force below which a transient counts as settled.
    between_runs : float, default 0
        Seconds that each run takes in addition to its levels.
    sample_rate : float, optional
        Of the records of motions in time, Hz; required for these.
    steady : {"exact", "describing function"}, optional
        With ``controlled="force"``: how the response is predicted. By default as in the earlier
        fit, or "exact".
    draws : int, default 200
        Number of parameter vectors over which the criterion is averaged; at most 24 for motions in
        time and for exact steady motions.
    seed : int, default 0
        Seed of the draws.

    Returns
    -------
    Plan
        Prints as a table, predicted uncertainties, and what stays undetermined and why.

    Raises
    ------
    ValidationError
        If a parameter has no range, the noise is unknown, the limits leave no level, or the time
        is too short for a single one.

    Notes
    -----
    A plan from a fit takes the fit's noise, model error and scatter between runs. The model error
    is similar at levels close to each other, so levels are spread; if the earlier data are too few
    to distinguish it from noise, levels are chosen as if both were equally large. A plan from a
    posterior has no model error.

    Without earlier data, a plan has as many levels as a fit needs to distinguish a wrong model from
    noise; if the time does not allow so many, the target is not met.

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
    whole_number(seed, "seed", 0, np.inf)
    one_of(controlled, "controlled", CONTROLLED)
    bench = BenchLimits.of(limits)
    knowledge = gather(source, ranges, draws, seed)
    if steady is not None:
        one_of(steady, "steady", STEADY)
        knowledge = replace(knowledge, steady=steady)
    targets, has_numbers = target_of(target)
    if not has_numbers and not np.isfinite(bench.time):
        raise ValidationError(
            f"plan: without a target uncertainty the time is needed: give {limit('time')}, or "
            f"{argument('target', {'f_max': 0.02})}"
        )
    costs = {
        "change_over": float(non_negative_array(change_over, "change_over")),
        "settled": positive_number(settled, "settled"),
        "between_runs": float(non_negative_array(between_runs, "between_runs")),
    }
    motions = motions_among(candidates)
    if motions:
        for_sines_only = {
            "target 'response'": RESPONSE in targets,
            "scatter": bool(scatter),
            "suspects": bool(suspects),
            "larger": larger is not None,
            "runs": runs not in (None, 1),
            argument("controlled", "force"): controlled == "force",
        }
        if stated := [name for name, is_stated in for_sines_only.items() if is_stated]:
            raise ValidationError(
                f"plan: {stated[0]} is planned with settled sines only; leave it out for motions "
                "in time, or leave candidates out"
            )
        thinned = replace(knowledge.thinned(SEARCHED), errors=None, scatter=0.0, between=None)
        recorded = recorded_force(noise, sample_rate, knowledge)
        arguments = (thinned, bench, targets, has_numbers, costs)
        return _of_motions(PlanRequest(*arguments, recorded=recorded, motions=motions))
    if sample_rate is not None:
        raise ValidationError(
            "plan: sample_rate is that of records of motions in time; leave it out for settled "
            f"sines, or give {argument('candidates', 'trapezoid', option='motion')}"
        )
    if scatter is not None:
        knowledge = replace(knowledge, between=None)
    if controlled == "force" and knowledge.steady == "exact":
        knowledge = knowledge.thinned(SEARCHED)
    question = PlanRequest(
        knowledge,
        bench,
        targets,
        has_numbers,
        costs,
        controlled,
        noise_of_cycle(noise, knowledge),
        knowledge.scatter if scatter is None else float(non_negative_array(scatter, "scatter")),
        None if runs is None else whole_number(runs, "runs", 1),
        larger_model(knowledge, larger, suspects),
        dict(suspects or {}),
    )
    if isinstance(candidates, int):
        options = candidates_within(question, bench, whole_number(candidates, "candidates", 2))
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
    """Return the plan with the information of a repeat in records that last as long as the plan.

    This information depends on the number of repeats, because a record's unknowns take about one.
    """
    lasting = Search(question, candidates_within(question, question.limits)).best().seconds
    search = Search(question, candidates_within(question, question.limits, lasting=lasting))
    return _plan(search, search.best())


def _plan(search: Search, design: Design) -> Plan:
    q, levels = search.question, design.levels
    options, change_over = search.forecast.candidates.only(levels), q.costs["change_over"]
    settling = search.bench.settling_cycles(levels)
    steps = tuple(
        PlanStep(level, f, int(wait), int(n), change_over + (wait + n) / f, motion)
        for level, f, wait, n, motion in zip(
            options.level.tolist(),
            options.frequency_hz.tolist(),
            settling.tolist(),
            design.cycles.tolist(),
            options.motions or (None,) * len(settling),
            strict=True,
        )
    )
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

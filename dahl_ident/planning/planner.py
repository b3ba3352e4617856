"""The public function that makes a plan from prior knowledge and the limits of the bench."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, non_negative_array, positive_number, whole_number
from dahl_ident.data.fields import one_of
from dahl_ident.diagnostics.budget import coverage_factor
from dahl_ident.elements import Element
from dahl_ident.elements.element import as_model
from dahl_ident.errors import ValidationError
from dahl_ident.planning.bench_time import LEAST_CYCLES, BenchTime
from dahl_ident.planning.candidates import (
    CONTROLLED,
    Candidates,
    CycleNoise,
    Limits,
    bench_time,
    evaluate,
    grid,
    larger_rows,
)
from dahl_ident.planning.criteria import LevelInformation, Objective, Term
from dahl_ident.planning.knowledge import Knowledge, Ranges, gather
from dahl_ident.planning.measurement_plan import Expected, Plan, Step
from dahl_ident.planning.optimal_design import Exchange, Selection, continuous_design
from dahl_ident.problem import Problem

_POWER = re.compile(r"(?P<name>[A-Za-z_]\w*)(?:\^(?P<power>-?\d+(?:\.\d+)?))?")
_EXPANDED = re.compile(r"U\((?P<quantity>.+)\)")
_SEARCHED = 24  # draws that the search for levels averages over
_POOL = 80
_MOST_RUNS = 8
_WEIGHTS = (0.0, 0.1, 0.25, 0.5, 0.75)  # of the suspected parameters, the least that is enough
_TIMES = 20  # corrections of the time that reaches a target
_CLOSE = 0.985  # fraction of the target at which the search stops
_NOTHING = 1e-8  # information added so that a parameter without any has an uncertainty
_UNKNOWN = 1e-2  # the same of a suspected parameter, which is known within a decade or so
_UNDETERMINED = 0.25  # relative standard uncertainty above which a parameter is not determined
_RELAXED = 10.0
_GRID_LEVELS = 10


def plan(
    source: Any,
    *,
    limits: Mapping[str, Any],
    target: Mapping[str, float] | Sequence[str] | str | None = None,
    ranges: Ranges | None = None,
    noise: float | Mapping[str, float] | None = None,
    scatter: float = 0.0,
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
        ``limits["time"]``. Left out: D-optimal in that time.
    ranges : mapping of str to (float, float), optional
        Range that contains a parameter with 95 % probability. The search uses it, but the predicted
        uncertainty does not include it.
    noise : float or mapping, optional
        Of one cycle: standard deviation of ln gain and phase, or a mapping with ``relative``,
        ``force`` and ``displacement`` (N and m, standard deviation of each part of the
        fundamental). Left out, that of the earlier data.
    scatter : float, default 0
        Standard deviation of ln gain and phase between runs.
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
    per_cycle = _noise_of(noise, knowledge)
    if isinstance(candidates, int):
        whole_number(candidates, "candidates", 2)
        level, frequency = grid(knowledge, bench, controlled, candidates)
    else:
        pairs = non_negative_array([list(pair) for pair in candidates], "candidates")
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ValidationError("candidates: expected pairs of level and frequency in Hz")
        level, frequency = pairs.T
    wanted, numbers = _targets(target)
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
        float(non_negative_array(scatter, "scatter")),
        None if runs is None else whole_number(runs, "runs", 1),
        costs, _larger(knowledge, larger, suspects), dict(suspects or {}),
    )  # fmt: skip
    return Planner(question, level, frequency).plan()


def _noise_of(given: float | Mapping[str, float] | None, knowledge: Knowledge) -> CycleNoise:
    if given is None:
        if knowledge.row_noise is None:
            raise ValidationError(
                "plan: the noise is unknown before any data; give noise=0.01 (of ln gain and phase "
                "in one cycle), or noise={'relative': 0.01, 'force': 1e-3, 'displacement': 1e-7}"
            )
        return CycleNoise(knowledge.row_noise * float(np.sqrt(knowledge.row_cycles)))
    if not isinstance(given, Mapping):
        return CycleNoise(positive_number(given, "noise"))
    unknown = sorted(set(given) - {"relative", "force", "displacement"})
    if unknown:
        raise ValidationError(
            f"noise has {', '.join(unknown)}; expected relative, force and displacement"
        )
    parts = {n: float(non_negative_array(v, f"noise[{n!r}]")) for n, v in given.items()}
    if not any(parts.values()):
        raise ValidationError("noise is zero; one cycle would determine everything")
    return CycleNoise(**{"relative": 0.0, **parts})


def _targets(target: Any) -> tuple[dict[str, float], bool]:
    """Return quantities with the uncertainty wanted, and whether numbers were given."""
    if target is None:
        return {}, False
    if isinstance(target, str):
        return {target: 1.0}, False
    if isinstance(target, Mapping):
        found = {str(n): positive_number(u, f"target[{n!r}]") for n, u in target.items()}
        return found, bool(found)
    return {str(name): 1.0 for name in target}, False


def _larger(
    knowledge: Knowledge, larger: Element | None, suspects: Mapping[str, float] | None
) -> Any:
    if not suspects:
        if larger is not None:
            raise ValidationError("larger is given without suspects; name its parameters there")
        return None
    for name, u in suspects.items():
        positive_number(u, f"suspects[{name!r}]")
    model = as_model(larger) if larger is not None else knowledge.model
    unknown = sorted(set(suspects) - {p.name for p in model.parameters})
    if unknown:
        raise ValidationError(
            f"suspects names {', '.join(unknown)}, which {model!r} does not have; give larger=, a "
            "model that has them"
        )
    same = {p.name for p in model.parameters} & set(knowledge.names)
    return model.with_free([*suspects, *same])


@dataclass(frozen=True)
class Question:
    """The arguments of :func:`plan` in checked form."""

    knowledge: Knowledge
    limits: Limits
    controlled: str
    noise: CycleNoise
    wanted: dict[str, float]
    numbers: bool
    scatter: float
    runs: int | None
    costs: dict[str, float]
    larger: Any
    suspects: dict[str, float]


@dataclass(frozen=True)
class Solution:
    """Levels for one run, the number of runs, and the largest ratio of uncertainty to target."""

    selection: Selection
    runs: int
    seconds: float
    ratio: float
    value: float


class Planner:
    """One planning problem with its candidates, evaluated once and then solved for any time."""

    def __init__(self, question: Question, level: FloatArray, frequency_hz: FloatArray) -> None:
        self.question = question
        q = question
        self.candidates: Candidates = evaluate(
            q.knowledge, level, frequency_hz, q.controlled, q.limits, q.noise
        )
        bench = bench_time(self.candidates, q.knowledge, **q.costs)
        settles = np.isfinite([bench.fixed([k]) for k in range(self.candidates.count)])
        if not settles.any():
            raise ValidationError(
                "plan: no candidate ever settles; widen limits['displacement'] upwards"
            )
        if not settles.all():
            kept = np.flatnonzero(settles)
            self.candidates = self.candidates.only(kept)
            bench = bench_time(self.candidates, q.knowledge, **q.costs)
        self.bench: BenchTime = bench
        known = q.knowledge
        size = _sizes(known.parameters, known.theta)
        self.candidates = replace(self.candidates, rows=self.candidates.rows * size)
        levels = self.candidates.information(q.scatter)
        self.before = known.information * np.outer(size, size)
        self.prior = known.prior * np.outer(size, size)
        self.directions = {
            name: _direction(name, known.parameters, known.values) * size
            for name in (*(p.name for p in known.parameters), *q.wanted)
        }
        targets = None
        if q.wanted:
            columns = [self.directions[n] * _least_factor(n) / u for n, u in q.wanted.items()]
            targets = np.stack(columns, axis=-1)
        self.main = Term(levels, self.before + self.prior, targets)
        self.suspected = self._suspected() if q.larger is not None else None
        self._pool: Any = None

    def _suspected(self) -> Term:
        q = self.question
        few = np.unique(np.linspace(0, len(q.knowledge.theta) - 1, _SEARCHED).astype(int))
        names, rows, offsets, problem, theta = larger_rows(
            q.larger, q.knowledge.only(few), self.candidates.at_draws(few)
        )
        size = _sizes(problem.parameters, theta)
        levels = LevelInformation.of(rows * size, offsets, q.scatter)
        S, P = theta.shape
        own = q.knowledge.problem
        known = np.zeros((S, P, P))
        if own is not None:
            before = Problem(own.data, q.larger, noise=own.noise, sensors=own.sensors)
            scale = 1.0 if own.scale_known else float(q.knowledge.row_noise or 1.0)
            known = known + before.information(theta, scale) * np.outer(size, size)
        self.suspected_before = known + _NOTHING * np.eye(P)
        known = known + _UNKNOWN * np.eye(P)
        for j, name in enumerate(q.knowledge.names):
            i = names.index(name)
            known[:, i, i] += self.prior[j, j]
        targets = np.zeros((S, P, len(q.suspects)))
        for t, (name, u) in enumerate(q.suspects.items()):
            i = names.index(name)
            targets[:, i, t] = size[i] / u
        return Term(levels, known, targets)

    def objective(self, weight: float = 0.0, runs: int = 1) -> Objective:
        """Return the objective, with a weight for suspected parameters."""
        terms = [replace(self.main, weight=1.0 - weight)]
        if self.suspected is not None and weight > 0.0:
            terms.append(replace(self.suspected, weight=weight))
        return Objective(tuple(terms), runs)

    # Levels for a time

    def solve(self, time: float, start: Sequence[int] = ()) -> Solution | None:
        """Return the best levels and runs for a time; None where it is too short."""
        weights = (0.0,) if self.suspected is None else _WEIGHTS
        best: Solution | None = None
        for weight in weights:
            found = self._solve(time, weight, start)
            if found is None:
                return None
            suspicious = self._suspect_ratio(found.selection, found.runs)
            if best is None or suspicious < self._suspect_ratio(best.selection, best.runs):
                best = found
            if suspicious <= 1.0:
                break
        return best

    def _solve(self, time: float, weight: float, start: Sequence[int]) -> Solution | None:
        q, best = self.question, None
        most = _MOST_RUNS if q.scatter > 0.0 else 1
        for runs in (q.runs,) if q.runs else range(1, most + 1):
            objective = self.objective(weight, runs).thinned(_SEARCHED)
            search = Exchange(objective, self.bench, self.pool(time), self._fewest)
            found = search.best(time / runs, start)
            if found is None:
                break
            full = self.objective(weight, runs).only(found.levels)
            value = full.at(found.cycles).value
            if best is not None and value <= best.value:
                break
            seconds = runs * self.bench.seconds(found.levels, found.cycles)
            ratio = self.ratio(found, runs)
            best = Solution(found, runs, seconds, ratio, value)
            start = found.levels.tolist()
        return best

    @property
    def _fewest(self) -> int:
        """Levels needed for at least one degree of freedom, with two numbers per level."""
        known = self.question.knowledge
        return 1 if known.problem is not None else len(known.names) // 2 + 1

    def pool(self, time: float) -> Any:
        """Return promising candidates: those of the continuous design, and evenly spread ones."""
        if self._pool is None:
            K = self.candidates.count
            if K <= _POOL:
                self._pool = np.arange(K)
                return self._pool
            f = self.candidates.frequency_hz
            alone = np.array([self.bench.fixed([k]) for k in range(K)])
            usual = 0.2 * time if np.isfinite(time) else 20.0 * float(np.median(alone))
            reachable = alone + LEAST_CYCLES / f <= time
            rate = f * usual / (usual + alone) * reachable + 1e-12
            design = continuous_design(
                self.objective(0.5 if self.suspected else 0.0).thinned(_SEARCHED),
                rate, usual, tolerance=0.05, iterations=200,
            )  # fmt: skip
            best = np.argsort(-design.seconds, kind="stable")[: _POOL // 2]
            spread = np.linspace(0, K - 1, _POOL // 2).astype(int)
            by_force = np.argsort(self.bench.force, kind="stable")[spread]
            self._pool = np.unique(np.concatenate([best[design.seconds[best] > 0.0], by_force]))
        return self._pool

    # What it gives

    def covariance(self, levels: Any, cycles: FloatArray, runs: int) -> FloatArray:
        """Return the covariance of the search coordinates after the plan, data alone, (S, P, P)."""
        term = replace(self.main, known=self.before)
        M = Objective((term,), runs).only(levels).information(cycles)[0]
        return _inverse(M)

    def uncertainty(self, covariance: FloatArray) -> dict[str, FloatArray]:
        """Return the relative standard uncertainty of every quantity at every draw."""
        return {
            name: np.sqrt(np.einsum("si,sij,sj->s", c, covariance, c))
            for name, c in self.directions.items()
        }

    def ratio(self, selection: Selection, runs: int) -> float:
        """Return the largest ratio of an uncertainty to its target, suspects included."""
        worst = self._suspect_ratio(selection, runs)
        if self.question.numbers:
            found, _ = self._after(selection.levels, selection.cycles, runs)
            worst = max(
                worst, *(_typical(found[name]) / u for name, u in self.question.wanted.items())
            )
        return worst

    def _suspect_ratio(self, selection: Selection, runs: int) -> float:
        if self.suspected is None:
            return 0.0
        term = replace(self.suspected, known=self.suspected_before)
        M = Objective((term,), runs).only(selection.levels).information(selection.cycles)
        inverse = np.linalg.inv(M[0])
        targets = self.suspected.targets
        assert targets is not None
        h = np.sqrt(np.einsum("sit,sij,sjt->st", targets, inverse, targets))
        return max(_typical(column) for column in h.T)

    def least_time(self) -> Solution | None:
        """Return the shortest plan that reaches the targets, or the best in the time allowed."""
        most = self.question.limits.time
        some = range(0, self.candidates.count, max(1, self.candidates.count // 20))
        usual = float(np.median([self.bench.fixed([k]) for k in some]))
        time = min(most, 30.0 * usual + 1.0)
        best: Solution | None = None
        found: Solution | None = None
        start: list[int] = []
        short, wide = 0.0, np.inf
        for _ in range(_TIMES):
            latest = self.solve(time, start)
            found = latest or found
            if (found is None or (found.ratio > 1.0 and best is None)) and time >= most:
                return found
            if found is not None:
                start = found.selection.levels.tolist()
            if latest is not None and latest.ratio <= 1.0:
                best = latest if best is None or latest.seconds < best.seconds else best
                if latest.ratio >= _CLOSE:
                    break
            else:
                short = max(short, time)
            if best is None:
                factor = 4.0 if found is None else float(np.clip(found.ratio**2, 1.3, 1e3))
                time = min(factor * time, most)
                continue
            if short >= _CLOSE * best.seconds:
                break
            fixed = best.runs * self.bench.fixed(best.selection.levels)
            time = fixed + (best.seconds - fixed) * (best.ratio / 0.995) ** 2
            narrow = np.log(best.seconds / max(short, 1e-3 * best.seconds))
            if not short < time < 0.99 * best.seconds or narrow > 0.6 * wide:
                time = float(np.sqrt(best.seconds * max(short, 0.25 * best.seconds)))
            wide = narrow
        return best or found

    def plan(self) -> Plan:
        """Return the plan."""
        q = self.question
        found = self.least_time() if q.numbers else self.solve(q.limits.time)
        if found is None:
            least = min(
                self.bench.fixed([k]) + LEAST_CYCLES / f
                for k, f in enumerate(self.candidates.frequency_hz.tolist())
            )
            raise ValidationError(
                f"limits['time'] is {q.limits.time:g} s, and the quickest level takes {least:.3g} "
                "s to change over, settle and measure; give more time"
            )
        return self._told(found)

    def _told(self, found: Solution) -> Plan:
        q, chosen = self.question, found.selection
        settling = self.bench.settling_cycles(chosen.levels)
        steps = tuple(
            Step(level, f, int(wait), int(n), q.costs["change_over"] + (wait + n) / f)
            for level, f, wait, n in zip(
                self.candidates.level[chosen.levels].tolist(),
                self.candidates.frequency_hz[chosen.levels].tolist(),
                settling.tolist(), chosen.cycles.tolist(), strict=True,
            )
        )  # fmt: skip
        expected = self.expected(chosen.levels, chosen.cycles, found.runs)
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

    def expected(self, levels: Any, cycles: FloatArray, runs: int) -> dict[str, Expected]:
        """Return the expected uncertainty of each quantity after a design."""
        q = self.question
        after, shares = self._after(levels, cycles, runs)
        before = self.uncertainty(_inverse(self.before))
        values = dict(zip(q.knowledge.names, q.knowledge.values.T, strict=True))
        return {
            name: Expected(
                value=float(np.median(_product(name, values))),
                before=_least_factor(name) * _typical(before[name]),
                after=_typical(u),
                low=_shown(float(np.quantile(u, 0.1))),
                high=_shown(float(np.quantile(u, 0.9))),
                scatter_share=shares[name],
            )
            for name, u in after.items()
        }  # fmt: skip

    def _after(
        self, levels: Any, cycles: FloatArray, runs: int
    ) -> tuple[dict[str, FloatArray], dict[str, float]]:
        """Return every quantity's uncertainty at every draw, and the share of scatter in it.

        Expanded uncertainties have the coverage factor of the runs' degrees of freedom; noise has
        many.
        """
        found = self.uncertainty(self.covariance(levels, cycles, runs))
        shares = dict.fromkeys(found, 0.0)
        if self.question.scatter > 0.0:
            term = Term(self.candidates.information(0.0), self.before)
            M = Objective((term,), runs).only(levels).information(cycles)[0]
            for name, quiet in self.uncertainty(_inverse(M)).items():
                if np.isfinite(_typical(found[name])):
                    shares[name] = max(0.0, 1.0 - (_typical(quiet) / _typical(found[name])) ** 2)
        for name, share in shares.items():
            if _EXPANDED.fullmatch(name):
                dof = max(runs - 1, 1) / share**2 if share > 0.0 else np.inf
                found[name] = coverage_factor(dof) * found[name]
        return found, shares

    def logarithmic_grid(self, time: float, levels: int = _GRID_LEVELS) -> Any:
        """Return levels, cycles and runs of an even logarithmic grid, equal cycles at each.

        In the same order and with the same settling; of several frequencies a third of the levels
        at each of three. None where the time is too short.
        """
        c = self.candidates
        frequencies = np.unique(c.frequency_hz)
        spread = self.question.knowledge.model.rate_independent
        if not (spread and self.question.controlled == "displacement") and len(frequencies) > 2:
            frequencies = frequencies[[0, len(frequencies) // 2, -1]]
            groups = [np.flatnonzero(c.frequency_hz == f) for f in frequencies]
        else:
            groups = [np.arange(c.count)]
        chosen: list[int] = []
        for group in groups:
            own = np.log(c.level[group])
            places = np.linspace(own.min(), own.max(), max(levels // len(groups), 2))
            chosen += [int(group[np.argmin(np.abs(own - p))]) for p in places]
        ordered = self.bench.order(np.unique(chosen))
        runs = self.question.runs or 1
        room = time / runs - self.bench.fixed(ordered)
        cycles = np.floor(room / float((1.0 / c.frequency_hz[ordered]).sum()))
        if cycles < 1.0:
            return None
        return ordered, np.full(len(ordered), cycles), runs

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
                what = "" if _EXPANDED.fullmatch(name) else "a standard uncertainty of "
                lost[name] = (
                    f"{name} reaches {what}{_percent(expected[name].after)}, not {_percent(u)}"
                )
        if self.suspected is not None and self._suspect_ratio(found.selection, found.runs) > 1.0:
            names = ", ".join(q.suspects)
            lost.setdefault(names, f"{names} is not seen as well as wanted")
        return tuple(f"{text}; {self._prevented_by(name)}" for name, text in lost.items())

    def _prevented_by(self, name: str) -> str:
        """Return which limit, ten times wider, would help a quantity most."""
        q, most = self.question, {}
        if name not in self.directions:
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
        time = limits.time if np.isfinite(limits.time) else 1000.0
        size = _sizes(q.knowledge.parameters, q.knowledge.theta)
        levels = replace(options, rows=options.rows * size).information(q.scatter)
        known = self.before + _NOTHING * np.eye(len(size))
        term = Term(levels, known, self.directions[name][..., None])
        objective = Objective((term,)).thinned(_SEARCHED)
        design = continuous_design(objective, options.frequency_hz, time, tolerance=0.1)
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
        found.append("the model is right, and calibrations are exact")
        return tuple(found)


def _sizes(parameters: Any, theta: FloatArray) -> FloatArray:
    """Return the scale of each parameter: 1 for logarithms, else its size."""
    spread = np.median(np.abs(theta), axis=0)
    spread = np.where(spread > 0.0, spread, np.maximum(theta.std(axis=0), 1e-300))
    spread = np.where(spread > 1e-290, spread, 1.0)
    return np.array(
        [1.0 if p.transform == "log" else s for p, s in zip(parameters, spread, strict=True)]
    )


def _direction(expression: str, parameters: Any, values: FloatArray) -> FloatArray:
    """Return d ln q/d theta of a product of powers at every draw, shape (S, P)."""
    names = [p.name for p in parameters]
    result = np.zeros(values.shape)
    for name, power in _powers(expression):
        if name not in names:
            raise ValidationError(
                f"target names {name!r}; free are {', '.join(names)}, alone or in a product of "
                "powers such as 'f_max/sigma'"
            )
        i = names.index(name)
        size = 1.0 if parameters[i].transform == "log" else values[:, i]
        result[:, i] += power / size
    return result


def _powers(expression: str) -> list[tuple[str, float]]:
    """Return names and powers in a product such as ``sigma^2/f_max``."""
    expanded = _EXPANDED.fullmatch(expression.replace(" ", ""))
    if expanded:
        expression = expanded["quantity"]
    found = []
    for place, part in enumerate(expression.replace(" ", "").split("/")):
        for factor in part.split("*"):
            match = _POWER.fullmatch(factor)
            if match is None:
                raise ValidationError(
                    f"target is {expression!r}; expected a parameter, or a product of powers such "
                    "as 'sigma^2/f_max'"
                )
            power = float(match["power"] or 1.0)
            found.append((match["name"], -power if place else power))
    return found


def _least_factor(name: str) -> float:
    """Return the coverage factor of many degrees of freedom for an expanded uncertainty, else 1."""
    return coverage_factor(np.inf) if _EXPANDED.fullmatch(name) else 1.0


def _product(expression: str, values: Mapping[str, FloatArray]) -> FloatArray:
    total = np.ones(())
    for name, power in _powers(expression):
        total = total * values[name] ** power
    return np.asarray(total)


def _inverse(M: FloatArray) -> FloatArray:
    """Return the inverse of the information; unknown directions get a very large variance."""
    return np.asarray(np.linalg.inv(M + _NOTHING * np.eye(M.shape[-1])))


def _typical(u: FloatArray) -> float:
    """Return the geometric mean over draws, inf where nothing is known."""
    return _shown(float(np.exp(np.mean(np.log(np.maximum(u, 1e-300))))))


def _shown(u: float) -> float:
    return u if u < 100.0 else float("inf")


def _percent(u: float) -> str:
    return f"{100.0 * u:.3g} %" if np.isfinite(u) else "without bound"

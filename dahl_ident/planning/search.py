"""The search for levels, cycles and runs: the best plan in a time, or the shortest for targets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from dahl_ident.arrays import IntArray
from dahl_ident.diagnostics.trends import LEAST_DOF, LEAST_RANGE
from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import LEAST_CYCLES, BenchTime, Candidates
from dahl_ident.planning.design import Coverage, Design, Exchange, Objective, continuous_design
from dahl_ident.planning.forecast import Expected, Forecast, forecast_of_suspects, typical
from dahl_ident.planning.knowledge import spread
from dahl_ident.planning.motion_information import RepeatSums
from dahl_ident.planning.question import PlanRequest, limit

_POOL = 80  # candidates: the time of the search grows with their number
_MOST_RUNS = 8  # to average scatter between runs: a ninth run would gain 6 %
_WEIGHTS = (0.0, 0.1, 0.25, 0.5, 0.75)  # of suspected parameters; the least that suffices
LONGEST = 30.0 * 86400.0  # s: a month, the longest plan if no time is given
_LONGER = 4.0  # factor from one time to the next until a target is reached
_HELPS = 0.1  # more time is useless below this fraction of the gain by the square root of time
_CLOSE = 0.985  # fraction of the plan's time in which the target is not reached any more
_APART = 2.0  # span of levels, in ranges that a fit takes as one amplitude: these are not exact
_GRID_LEVELS = 10  # levels of the usual logarithmic plan with which the best one is compared
_FILLED = 0.999  # fraction of the target that corrected repeats aim at


class Search:
    """The search for levels and cycles: candidates evaluated once, then solved for any time."""

    def __init__(self, question: PlanRequest, candidates: Candidates) -> None:
        self.question, knowledge = question, question.knowledge
        self.bench = BenchTime.of(candidates, knowledge, **question.costs)
        settles = np.isfinite(self.bench.alone)
        if not settles.any():
            raise ValidationError(
                f"plan: no candidate ever settles; widen {limit('displacement')} upwards"
            )
        if not settles.all():
            candidates = candidates.only(np.flatnonzero(settles))
            self.bench = BenchTime.of(candidates, knowledge, **question.costs)
        self.forecast = Forecast.of(question, candidates)
        few = self.forecast.thinned()
        self._terms, self._suspects = [few.term(question.target)], None
        if question.larger is not None:
            self._suspects = forecast_of_suspects(question, few.knowledge, few.candidates)
            self._terms.append(self._suspects.term(question.suspects))
        self._pool: IntArray | None = None

    def best(self) -> Design:
        """Return the shortest plan that reaches the targets, or the best in the time allowed."""
        q = self.question
        design = self.least_time() if q.has_numbers else self.solve(q.limits.time)
        if design is None:
            least = float((self.bench.alone + LEAST_CYCLES / self.bench.frequency_hz).min())
            raise ValidationError(
                f"{limit('time')} is {q.limits.time:g} s, and the quickest "
                f"{'level' if q.recorded is None else 'motion'} takes {least:.3g} "
                "s to change over, settle and measure; give more time"
            )
        return design if q.recorded is None else self._exactly(design)

    def solve(self, time: float, start: Sequence[int] = ()) -> Design | None:
        """Return the best levels and runs for a time; None where it is too short."""
        ratios: list[tuple[float, Design]] = []
        for weight in (0.0,) if self._suspects is None else _WEIGHTS:
            design = self._solve(time, weight, start)
            if design is None:
                return None
            ratios.append((self.suspect_ratio(design), design))
            if ratios[-1][0] <= 1.0:
                break
        return min(ratios, key=lambda pair: pair[0])[1]

    def _solve(self, time: float, weight: float, start: Sequence[int]) -> Design | None:
        q, best = self.question, None
        most = _MOST_RUNS if q.scatter > 0.0 or self.forecast.between is not None else 1
        for runs in (q.runs,) if q.runs else range(1, most + 1):
            objective = self._objective(weight, runs)
            search = Exchange(objective, self.bench, self._promising(time), self._coverage)
            design = search.best(time / runs, start)
            if design is None or (best is not None and design.value <= best.value):
                break
            best = replace(design, ratio=self.ratio(design))
            start = design.levels.tolist()
        return best

    def _objective(self, weight: float, runs: int = 1) -> Objective:
        weighted = zip(self._terms, (1.0 - weight, weight), strict=False)
        return Objective(tuple(replace(term, weight=w) for term, w in weighted if w > 0.0), runs)

    @cached_property
    def _coverage(self) -> Coverage:
        """Requirements on levels so that a fit to them alone can reveal a wrong model."""
        known, candidates = self.question.knowledge, self.forecast.candidates
        amplitude = np.log(np.median(candidates.amplitude, axis=0))
        if known.problem is not None or known.sample_noise is not None or candidates.motions:
            return Coverage(1, 0.0, amplitude)
        fitted = len(known.names) - len(known.assumed)
        span = _APART * LEAST_RANGE if np.ptp(amplitude) >= _APART * LEAST_RANGE else 0.0
        fewest = min((LEAST_DOF + fitted + 1) // 2, candidates.count)
        return Coverage(fewest, span, amplitude)

    def can_be_judged(self, design: Design) -> bool:
        """Return whether the data of a design alone can distinguish a wrong model from noise."""
        enough = design.runs * len(design.levels) >= self._coverage.fewest
        return enough and bool(self._coverage.wide(design.levels))

    def reached(self, design: Design) -> bool:
        """Return whether a design reaches every target, with data that can be judged."""
        judged = not self.question.has_numbers or self.can_be_judged(design)
        return bool(design.ratio <= 1.0) and judged

    def _promising(self, time: float) -> IntArray:
        """Return promising candidates: those of the continuous design, and evenly spread ones."""
        if self._pool is None:
            K, f, alone = self.forecast.candidates.count, self.bench.frequency_hz, self.bench.alone
            if K <= _POOL:
                self._pool = np.arange(K)
                return self._pool
            usual = 0.2 * time if np.isfinite(time) else 20.0 * float(np.median(alone))
            reachable = alone + LEAST_CYCLES / f <= time
            rate = f * usual / (usual + alone) * reachable + 1e-12
            objective = self._objective(0.5 if self._suspects else 0.0)
            seconds, _, _ = continuous_design(
                objective, rate, usual, tolerance=0.05, iterations=200
            )
            best = np.argsort(-seconds, kind="stable")[: _POOL // 2]
            even = np.argsort(self.bench.force, kind="stable")[spread(K, _POOL // 2)]
            self._pool = np.unique(np.concatenate([best[seconds[best] > 0.0], even]))
        return self._pool

    def ratio(self, design: Design) -> float:
        """Return the largest ratio of an uncertainty to its target, suspects included."""
        numbers = self.question.target if self.question.has_numbers else {}
        return max(_ratio(self.forecast, numbers, design), self.suspect_ratio(design))

    def suspect_ratio(self, design: Design) -> float:
        """Return the largest ratio of a suspected parameter's uncertainty to its target."""
        if self._suspects is None:
            return 0.0
        return _ratio(self._suspects, self.question.suspects, design)

    def least_time(self) -> Design | None:
        """Return the shortest plan that reaches the targets, or the best in the time allowed.

        Where no time is given, that is a month.
        """
        most = min(self.question.limits.time, LONGEST)
        time = min(most, 30.0 * float(np.median(self.bench.alone)) + 1.0)
        short, design = 0.0, self.solve(time)
        while design is None or not self.reached(design):
            if time >= most:
                return design
            short, time, before = time, min(_LONGER * time, most), design
            design = self.solve(time, () if before is None else before.levels.tolist())
            if before is not None and design is not None and design.ratio > 1.0:
                by_time = 0.5 * np.log(design.seconds / before.seconds)
                if np.log(before.ratio / design.ratio) < _HELPS * by_time:
                    return before
        while short < _CLOSE * design.seconds:
            time = float(np.sqrt(design.seconds * max(short, design.seconds / _LONGER)))
            shorter = self.solve(time, design.levels.tolist())
            if shorter is not None and self.reached(shorter):
                design = shorter
            else:
                short = time
        return design

    def _exactly(self, design: Design) -> Design:
        """Return the repeats that reach the targets by the information of the whole records.

        The search gives every repeat of a motion the same information. The first repeats give less,
        because they also have to determine the state at the start, the offset and the drift.
        """
        q, candidates, levels = self.question, self.forecast.candidates, design.levels
        assert q.recorded is not None
        sums = [RepeatSums.of(q.knowledge, candidates.motions[k], q.recorded) for k in levels]
        cycles = design.cycles
        while True:
            rows = candidates.rows.copy()
            for k, motion_sums, repeats in zip(levels.tolist(), sums, cycles.tolist(), strict=True):
                rows[:, k] = motion_sums.rows(int(repeats)) * q.knowledge.units
            self.forecast = replace(self.forecast, candidates=replace(candidates, rows=rows))
            design = replace(design, cycles=cycles, seconds=self.bench.seconds(levels, cycles))
            design = replace(design, ratio=self.ratio(design))
            cycles = np.maximum(np.ceil(cycles * (design.ratio / _FILLED) ** 2), cycles + 1.0)
            possible = self.bench.seconds(levels, cycles) <= min(q.limits.time, LONGEST)
            if not (q.has_numbers and possible) or design.ratio <= 1.0:
                return design

    def expected_after(self, time: float, *, grid: bool = False) -> dict[str, Expected]:
        """Return what the best plan of a time, or a grid, determines; empty if it is too short."""
        design = self.logarithmic_grid(time) if grid else self.solve(time)
        return {} if design is None else self.forecast.expected(design)

    def logarithmic_grid(self, time: float, levels: int = _GRID_LEVELS) -> Design | None:
        """Return an even logarithmic grid of levels, equal cycles at each.

        In the same order and with the same settling; of several frequencies a third of the levels
        at each of three. None where the time is too short.
        """
        c, rate_free = self.forecast.candidates, self.question.knowledge.model.rate_independent
        frequencies, groups = np.unique(c.frequency_hz), [np.arange(c.count)]
        single = c.motions or (rate_free and self.question.controlled == "displacement")
        if not single and len(frequencies) > 2:
            three = frequencies[[0, len(frequencies) // 2, -1]]
            groups = [np.flatnonzero(c.frequency_hz == f) for f in three]
        chosen: list[int] = []
        for group in groups:
            level = np.log(c.level[group])
            places = np.linspace(level.min(), level.max(), max(levels // len(groups), 2))
            chosen += [int(group[np.argmin(np.abs(level - p))]) for p in places]
        ordered, runs = self.bench.order(np.unique(chosen)), self.question.runs or 1
        room = time / runs - self.bench.fixed(ordered)
        cycles = np.floor(room / float((1.0 / c.frequency_hz[ordered]).sum()))
        if cycles < 1.0:
            return None
        each = np.full(len(ordered), cycles)
        seconds = runs * self.bench.seconds(ordered, each)
        return Design(ordered, each, runs, np.nan, seconds)


def _ratio(forecast: Forecast, target: Mapping[str, float], design: Design) -> float:
    """Return the largest ratio of an uncertainty to its target, 0 without any."""
    after = forecast.after(design)[0] if target else {}
    return max((typical(after[name]) / u for name, u in target.items()), default=0.0)

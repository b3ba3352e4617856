"""The search for levels, cycles and runs: the best plan in a time, or the shortest for targets."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from dahl_ident.diagnostics.trends import LEAST_DOF, LEAST_RANGE
from dahl_ident.errors import ValidationError
from dahl_ident.planning.candidates import LEAST_CYCLES, BenchTime, Candidates
from dahl_ident.planning.design import Coverage, Design, Exchange
from dahl_ident.planning.forecast import Expected, Forecast
from dahl_ident.planning.question import PlanRequest, limit

_MOST_RUNS = 8  # to average scatter between runs: a ninth run would gain 6 %
LONGEST = 30.0 * 86400.0  # s: a month, the longest plan if no time is given
_LONGER = 4.0  # factor from one time to the next until a target is reached
_HELPS = 0.1  # more time is useless below this fraction of the gain by the square root of time
_CLOSE = 0.985  # fraction of the plan's time in which the target is not reached any more
_APART = 2.0  # span of levels, in ranges that a fit takes as one amplitude: these are not exact


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
        self._criterion = self.forecast.thinned().criterion(question.target)

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
        return design

    def solve(self, time: float) -> Design | None:
        """Return the best levels and runs for a time; None where it is too short."""
        q, best = self.question, None
        most = _MOST_RUNS if q.scatter > 0.0 or self.forecast.between is not None else 1
        for runs in (q.runs,) if q.runs else range(1, most + 1):
            criterion = replace(self._criterion, runs=runs)
            design = Exchange(criterion, self.bench, self._coverage).best(time / runs)
            if design is None or (best is not None and design.value <= best.value):
                break
            best = replace(design, ratio=self.ratio(design))
        return best

    @cached_property
    def _coverage(self) -> Coverage:
        """Requirements on levels so that a fit to them alone can reveal a wrong model."""
        known, candidates = self.question.knowledge, self.forecast.candidates
        amplitude = np.log(np.median(candidates.amplitude, axis=0))
        if known.row_noise is not None or known.sample_noise is not None or candidates.motions:
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

    def ratio(self, design: Design) -> float:
        """Return the largest ratio of an uncertainty to its target, 0 without any."""
        target = self.question.target if self.question.has_numbers else {}
        after = self.forecast.after(design) if target else {}
        return max((after[name] / u for name, u in target.items()), default=0.0)

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
            design = self.solve(time)
            if before is not None and design is not None and design.ratio > 1.0:
                by_time = 0.5 * np.log(design.seconds / before.seconds)
                if np.log(before.ratio / design.ratio) < _HELPS * by_time:
                    return before
        while short < _CLOSE * design.seconds:
            time = float(np.sqrt(design.seconds * max(short, design.seconds / _LONGER)))
            shorter = self.solve(time)
            if shorter is not None and self.reached(shorter):
                design = shorter
            else:
                short = time
        return design

    def expected_after(self, time: float) -> dict[str, Expected]:
        """Return what the best plan of a time determines; empty if it is too short."""
        design = self.solve(time)
        return {} if design is None else self.forecast.expected(design)

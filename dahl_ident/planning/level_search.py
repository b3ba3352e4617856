"""The search for levels, cycles and runs: the best in a time, the least time for targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.diagnostics.stiffening import LEAST_DOF
from dahl_ident.diagnostics.trends import LEAST_RANGE
from dahl_ident.planning.bench_time import LEAST_CYCLES, BenchTime
from dahl_ident.planning.candidates import larger_rows
from dahl_ident.planning.criteria import NOTHING, LevelInformation, Objective, Term
from dahl_ident.planning.forecast import Forecast, typical
from dahl_ident.planning.optimal_design import Coverage, Exchange, Selection, continuous_design
from dahl_ident.planning.quantities import sizes
from dahl_ident.planning.question import PlanRequest

_POOL = 80  # candidates: the time of the search grows with their number
_MOST_RUNS = 8  # against scatter between runs: a ninth would gain 6 %
_WEIGHTS = (0.0, 0.1, 0.25, 0.5, 0.75)  # of the suspected parameters, the least that is enough
LONGEST = 30.0 * 86400.0  # s, of a plan for which no time is given: a month
_TIMES = 20  # corrections of the time that reaches a target
_HELPS = 0.1  # of what the square root of the time would do, below which more time is useless
_CLOSE = 0.985  # fraction of the target at which the search stops
_UNKNOWN = 1e-2  # the same of a suspected parameter, which is known within a decade or so
_APART = 2.0  # times the range that a fit takes as one amplitude: measured ones are not exact
_GRID_LEVELS = 10  # of the usual plan that the best one is compared with


@dataclass(frozen=True)
class Solution:
    """Levels for one run, the number of runs, and the largest ratio of uncertainty to target."""

    selection: Selection
    runs: int
    seconds: float
    ratio: float


class LevelSearch:
    """The search for levels and cycles: candidates evaluated once, then solved for any time."""

    def __init__(self, question: PlanRequest, forecast: Forecast, bench: BenchTime) -> None:
        self.question, self.forecast, self.bench = question, forecast, bench
        some = forecast.thinned()
        self._few, self._main = some.draws, some.term(question.wanted)
        self._suspects = self._suspected() if question.larger is not None else None
        self._pool: Any = None

    def _suspected(self) -> Term:
        q = self.question
        few = self._few
        names, rows, offsets, problem, theta = larger_rows(
            q.larger, q.knowledge.only(few), self.forecast.candidates.at_draws(few)
        )
        size = sizes(problem.parameters, theta)
        levels = LevelInformation.of(rows * size, offsets, q.scatter)
        S, P = theta.shape
        own = q.knowledge.problem
        known = np.zeros((S, P, P))
        if own is not None:
            before = own.like(model=q.larger, sensors=q.knowledge.sensors)
            scale = 1.0 if own.scale_known else float(q.knowledge.row_noise or 1.0)
            known = known + before.information(theta, scale) * np.outer(size, size)
        self._suspects_before = known + NOTHING * np.eye(P)
        known = known + _UNKNOWN * np.eye(P)
        for j, name in enumerate(q.knowledge.names):
            i = names.index(name)
            known[:, i, i] += q.knowledge.prior[j, j] * size[i] ** 2
        targets = np.zeros((S, P, len(q.suspects)))
        for t, (name, u) in enumerate(q.suspects.items()):
            i = names.index(name)
            targets[:, i, t] = size[i] / u
        return Term(levels, known, targets)

    def objective(self, weight: float = 0.0, runs: int = 1) -> Objective:
        """Return the objective, with a weight for suspected parameters."""
        terms = [replace(self._main, weight=1.0 - weight)]
        if self._suspects is not None and weight > 0.0:
            terms.append(replace(self._suspects, weight=weight))
        return Objective(tuple(terms), runs)

    def solve(self, time: float, start: Sequence[int] = ()) -> Solution | None:
        """Return the best levels and runs for a time; None where it is too short."""
        weights = (0.0,) if self._suspects is None else _WEIGHTS
        best: Solution | None = None
        for weight in weights:
            found = self._solve(time, weight, start)
            if found is None:
                return None
            suspicious = self.suspect_ratio(found.selection, found.runs)
            if best is None or suspicious < self.suspect_ratio(best.selection, best.runs):
                best = found
            if suspicious <= 1.0:
                break
        return best

    def _solve(self, time: float, weight: float, start: Sequence[int]) -> Solution | None:
        q, best = self.question, None
        most = _MOST_RUNS if self.forecast.scatter > 0.0 else 1
        for runs in (q.runs,) if q.runs else range(1, most + 1):
            search = Exchange(
                self.objective(weight, runs), self.bench, self.pool(time), self._coverage
            )
            found = search.best(time / runs, start)
            if found is None:
                break
            if best is not None and found.value <= best.selection.value:
                break
            seconds = runs * self.bench.seconds(found.levels, found.cycles)
            ratio = self.ratio(found, runs)
            best = Solution(found, runs, seconds, ratio)
            start = found.levels.tolist()
        return best

    @cached_property
    def _coverage(self) -> Coverage:
        """What levels need for a fit to them alone that can tell a wrong model from noise."""
        known, candidates = self.question.knowledge, self.forecast.candidates
        amplitude = np.log(np.median(candidates.amplitude, axis=0))
        if known.problem is not None or known.sample_noise is not None or candidates.motions:
            return Coverage(1, 0.0, amplitude)
        fitted = len(known.names) - len(known.assumed)
        span = _APART * LEAST_RANGE if np.ptp(amplitude) >= _APART * LEAST_RANGE else 0.0
        return Coverage((LEAST_DOF + fitted + 1) // 2, span, amplitude)

    def pool(self, time: float) -> Any:
        """Return promising candidates: those of the continuous design, and evenly spread ones."""
        if self._pool is None:
            K = self.forecast.candidates.count
            if K <= _POOL:
                self._pool = np.arange(K)
                return self._pool
            f = self.forecast.candidates.frequency_hz
            alone = self.bench.fixed(np.arange(K)[:, None])
            usual = 0.2 * time if np.isfinite(time) else 20.0 * float(np.median(alone))
            reachable = alone + LEAST_CYCLES / f <= time
            rate = f * usual / (usual + alone) * reachable + 1e-12
            design = continuous_design(
                self.objective(0.5 if self._suspects else 0.0),
                rate, usual, tolerance=0.05, iterations=200,
            )  # fmt: skip
            best = np.argsort(-design.seconds, kind="stable")[: _POOL // 2]
            spread = np.linspace(0, K - 1, _POOL // 2).astype(int)
            by_force = np.argsort(self.bench.force, kind="stable")[spread]
            self._pool = np.unique(np.concatenate([best[design.seconds[best] > 0.0], by_force]))
        return self._pool

    def ratio(self, selection: Selection, runs: int) -> float:
        """Return the largest ratio of an uncertainty to its target, suspects included."""
        worst = self.suspect_ratio(selection, runs)
        if self.question.numbers:
            found, _ = self.forecast.after(selection.levels, selection.cycles, runs)
            worst = max(
                worst, *(typical(found[name]) / u for name, u in self.question.wanted.items())
            )
        return worst

    def suspect_ratio(self, selection: Selection, runs: int) -> float:
        """Return the largest ratio of a suspected parameter's uncertainty to its target."""
        if self._suspects is None:
            return 0.0
        term = replace(self._suspects, known=self._suspects_before)
        M = Objective((term,), runs).only(selection.levels).information(selection.cycles)
        inverse = np.linalg.inv(M[0])
        targets = self._suspects.targets
        assert targets is not None
        h = np.sqrt(np.einsum("sit,sij,sjt->st", targets, inverse, targets))
        return max(typical(column) for column in h.T)

    def least_time(self) -> Solution | None:
        """Return the shortest plan that reaches the targets, or the best in the time allowed.

        Where no time is given, that is a month.
        """
        most = min(self.question.limits.time, LONGEST)
        some = range(
            0, self.forecast.candidates.count, max(1, self.forecast.candidates.count // 20)
        )
        usual = float(np.median(self.bench.fixed(np.array(some)[:, None])))
        time = min(most, 30.0 * usual + 1.0)
        best: Solution | None = None
        found: Solution | None = None
        before: Solution | None = None
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
                if latest is not None and before is not None:
                    expected = 0.5 * np.log(latest.seconds / before.seconds)
                    if np.log(before.ratio / latest.ratio) < _HELPS * expected:
                        return before
                before = latest
                factor = 4.0 if found is None else float(np.clip(found.ratio**2, 1.3, 1e3))
                time = min(factor * time, most)
                continue
            if short >= _CLOSE * best.seconds:
                break
            fixed = best.runs * float(self.bench.fixed(best.selection.levels))
            time = fixed + (best.seconds - fixed) * (best.ratio / 0.995) ** 2
            narrow = np.log(best.seconds / max(short, 1e-3 * best.seconds))
            if not short < time < 0.99 * best.seconds or narrow > 0.6 * wide:
                time = float(np.sqrt(best.seconds * max(short, 0.25 * best.seconds)))
            wide = narrow
        return best or found

    def logarithmic_grid(self, time: float, levels: int = _GRID_LEVELS) -> Any:
        """Return levels, cycles and runs of an even logarithmic grid, equal cycles at each.

        In the same order and with the same settling; of several frequencies a third of the levels
        at each of three. None where the time is too short.
        """
        c = self.forecast.candidates
        frequencies = np.unique(c.frequency_hz)
        spread = self.question.knowledge.model.rate_independent
        single = c.motions or (spread and self.question.controlled == "displacement")
        if not single and len(frequencies) > 2:
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

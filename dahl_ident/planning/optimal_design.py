"""Optimal designs: continuous ones by multiplication, those with fixed costs by exchange.

**Continuous.** Seconds t_k at each candidate, their sum given. With d_k the criterion's derivative
by t_k and d the mean of d_k weighted by t_k, every t_k is multiplied by (d_k/d)^p; at the optimum
d_k <= d everywhere (the equivalence theorem), with equality where t_k > 0. For D-optimality without
earlier data d times the time is 1, so that the derivative of ln det never exceeds the number of
parameters. Source: Silvey, Titterington and Torsney, *Commun. Stat. A* 7, 1379 (1978); Yu,
*Ann. Stat.* 38, 1593 (2010).

**With fixed costs** each level needs time for change-over and settling before it gives information.
Levels are added, exchanged and removed one at a time while this improves the criterion, and the
remaining time is distributed by multiplication; then the cycles are rounded to whole numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.planning.bench_time import LEAST_CYCLES, BenchTime
from dahl_ident.planning.criteria import DesignPoint, Objective

_IMPROVES = 1e-3  # least improvement of the logarithm by a change of the levels
_ROUNDS = 12  # at most; a round without improvement is the last
_TRIED = 3  # candidates whose times are optimised after a first look at all
_NO_TIME = 1e-9  # s, shared where there is none, so that the sums stay defined
_MOST_LEVELS = 24  # an optimum of six parameters takes at most 21 (Caratheodory)


@dataclass(frozen=True)
class ContinuousDesign:
    """Seconds at each candidate."""

    seconds: FloatArray  # (K,): their sum is the time given
    value: float  # the criterion
    excess: float  # largest d_k/d - 1 over all candidates: 0 at the optimum


def continuous_design(
    objective: Objective,
    frequency_hz: FloatArray,
    time: float,
    *,
    tolerance: float = 0.01,
    iterations: int = 400,
) -> ContinuousDesign:
    """Return the best seconds at each candidate, settling and change-over left out."""
    K = objective.candidates
    seconds = np.full(K, time / K)
    active = np.arange(K)
    excess = np.inf
    for _ in range(30):
        sub = objective.only(active)
        seconds[active] = _shared(
            sub, frequency_hz[active], time, seconds[active], iterations // 10, tolerance
        )
        point = sub.at(seconds[active] * frequency_hz[active])
        rate = objective.gradient(point) * frequency_hz
        mean = float(rate @ seconds) / time
        excess = float(rate.max() / mean) - 1.0
        if excess < tolerance:
            break
        # candidates that cannot matter are set aside; those that should be measured return
        resting = (seconds < 1e-4 * seconds.max()) & (rate < 0.9 * mean)
        seconds[resting] = 0.0
        missing = ~resting & (seconds == 0.0) & (rate > mean)
        seconds[missing] = 1e-3 * time / max(int(missing.sum()), 1)
        seconds *= time / seconds.sum()
        active = np.flatnonzero(seconds)
    return ContinuousDesign(seconds, float(point.value), excess)


def _shared(
    objective: Objective,
    frequency_hz: FloatArray,
    time: FloatArray | float,
    start: FloatArray,
    iterations: int,
    tolerance: float,
    least: FloatArray | float = 0.0,
) -> FloatArray:
    """Return seconds beyond `least` that share `time` best, by multiplication from `start`.

    Of each design, (..., m), with its own time, (..., 1).
    """
    seconds = start * (time / start.sum(axis=-1, keepdims=True))
    power = np.ones((*seconds.shape[:-1], 1))
    point = objective.at((least + seconds) * frequency_hz)
    rate = objective.gradient(point) * frequency_hz
    for _ in range(iterations):
        mean = (rate * seconds).sum(axis=-1, keepdims=True) / time
        better = (mean > 0.0) & (rate.max(axis=-1, keepdims=True) >= (1.0 + tolerance) * mean)
        if not better.any():
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = seconds * (rate / mean) ** power
            moved *= time / moved.sum(axis=-1, keepdims=True)
        moved = np.where(better, moved, seconds)
        new = objective.at((least + moved) * frequency_hz)
        # only D-optimality rises with full steps; a step that fell is tried again, half as long
        fell = (new.value < point.value)[..., None] & (power >= 0.1)
        power = np.where(fell, 0.5 * power, power)
        if fell.all():
            continue
        new_rate = objective.gradient(new) * frequency_hz
        seconds, rate = np.where(fell, seconds, moved), np.where(fell, rate, new_rate)
        point = DesignPoint(np.where(fell[..., 0], point.value, new.value), new.sensitivities)
    return np.asarray(seconds)


@dataclass(frozen=True)
class Selection:
    """Levels in the order of the run, whole cycles at each, and the criterion."""

    levels: NDArray[np.intp]
    cycles: FloatArray
    value: float


@dataclass(frozen=True)
class Coverage:
    """What levels need so that their data can be judged."""

    fewest: int  # number of levels, at least
    span: float  # ln of the largest displacement amplitude over the smallest, at least
    amplitude: FloatArray  # (K,): ln of the displacement amplitude of every candidate

    def wide(self, levels: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which sets of levels, (..., m), span enough."""
        return np.asarray(np.ptp(self.amplitude[levels], axis=-1) >= self.span)


class Exchange:
    """The search for levels, with settling and change-over.

    They have the coverage that their data need, where the time allows it.
    """

    def __init__(
        self,
        objective: Objective,
        bench: BenchTime,
        pool: NDArray[np.intp],
        coverage: Coverage | None = None,
    ) -> None:
        self._objective, self._bench, self._pool = objective, bench, pool
        self._coverage = coverage or Coverage(1, 0.0, np.zeros(objective.candidates))
        self._fewest = self._coverage.fewest

    def best(self, time: float, start: Sequence[int] = ()) -> Selection | None:
        """Return the best levels for one run of `time` s; None where nothing can be measured."""
        chosen, value = list(start), -np.inf
        if chosen:
            value = float(self._values([chosen], time)[0])
            if value == -np.inf:
                chosen = []
        for _ in range(_ROUNDS):
            before = value if len(chosen) >= self._fewest else -np.inf
            chosen, value = self._grow(chosen, value, time)
            chosen, value = self._exchange(chosen, value, time)
            if not value > before + _IMPROVES:
                break
        return self.whole(chosen, time) if chosen else None

    def _grow(self, chosen: list[int], value: float, time: float) -> tuple[list[int], float]:
        while len(chosen) < _MOST_LEVELS:
            trials = [[*chosen, k] for k in self._promising(chosen, time)]
            least = value if len(chosen) >= self._fewest else -np.inf
            found = self._better(trials, least, time)
            if found is None:
                break
            chosen, value = found
        return chosen, value

    def _exchange(self, chosen: list[int], value: float, time: float) -> tuple[list[int], float]:
        for _ in range(_ROUNDS):
            trials = []
            for k in chosen:
                rest = [j for j in chosen if j != k]
                if len(rest) >= self._fewest:
                    trials.append(rest)
                trials += [[*rest, j] for j in self._promising(rest, time) if j != k]
            found = self._better(trials, value, time)
            if found is None:
                break
            chosen, value = found
        return chosen, value

    def _better(
        self, trials: list[list[int]], value: float, time: float
    ) -> tuple[list[int], float] | None:
        values = self._values(trials, time)
        best = int(np.argmax(values)) if trials else -1
        if best < 0 or not values[best] > value + (_IMPROVES if np.isfinite(value) else 0.0):
            return None
        return trials[best], float(values[best])

    def _share(
        self, levels: NDArray[np.intp], time: float, iterations: int
    ) -> tuple[Objective, FloatArray]:
        """Return the cycles at the levels of each design, (..., m); NaN without enough time."""
        f = self._bench.frequency_hz[levels]
        least = LEAST_CYCLES / f
        room = (time - self._bench.fixed(levels) - least.sum(axis=-1))[..., None]
        sub = self._objective.only(levels)
        some = np.maximum(room, _NO_TIME)
        seconds = _shared(sub, f, some, np.ones(f.shape), iterations, 0.003, least)
        return sub, np.where(room >= 0.0, (least + np.where(room > 0.0, seconds, 0.0)) * f, np.nan)

    def _values(self, trials: list[list[int]], time: float) -> FloatArray:
        """Return the criterion of each set of levels; -inf without enough time."""
        result = np.full(len(trials), -np.inf)
        sizes = np.array([len(trial) for trial in trials])
        for size in np.unique(sizes[sizes > 0]).tolist():
            same = np.flatnonzero(sizes == size)
            levels = np.array([trials[i] for i in same], dtype=np.intp)
            sub, cycles = self._share(levels, time, 15)
            enough = np.asarray(np.isfinite(cycles).all(axis=-1))
            if size >= self._fewest:
                enough &= self._coverage.wide(levels)
            value = sub.at(np.where(enough[:, None], cycles, 1.0)).value
            result[same] = np.where(enough, value, -np.inf)
        return result

    def _promising(self, chosen: list[int], time: float) -> list[int]:
        """Return the candidates that look best in addition to the chosen ones, at equal shares."""
        rest = np.setdiff1d(self._pool, chosen)
        joined = np.column_stack([np.tile(chosen, (rest.size, 1)), rest]).astype(np.intp)
        least = (LEAST_CYCLES / self._bench.frequency_hz[joined]).sum(axis=-1)
        rooms = time - self._bench.fixed(joined) - least
        fits = rooms >= 0.0
        if joined.shape[1] >= self._fewest:
            fits &= self._coverage.wide(joined)
        possible, rooms = rest[fits], rooms[fits] / (len(chosen) + 1.0)
        if not possible.size:
            return []
        f = self._bench.frequency_hz
        own = LEAST_CYCLES + rooms * f[possible]
        totals = []
        for term in self._objective.terms:
            packed = term.levels.packed
            total = own[:, None] * packed[possible]
            if chosen:
                others = LEAST_CYCLES + rooms[:, None] * f[chosen]
                total = total + others @ packed[chosen]
            totals.append(total)
        values = self._objective.values(totals)
        return [int(k) for k in possible[np.argsort(-values)[:_TRIED]]]

    def whole(self, levels: Sequence[int], time: float) -> Selection:
        """Return whole cycles at the levels; the remaining time goes where it helps most."""
        ordered = self._bench.order(levels)
        f = self._bench.frequency_hz[ordered]
        sub, shared = self._share(ordered, time, 100)
        cycles = np.maximum(np.floor(shared + 1e-9), float(LEAST_CYCLES))
        while True:
            left = time - self._bench.seconds(ordered, cycles)
            possible = 1.0 / f <= left + 1e-9
            if not possible.any():
                break
            gain = np.where(possible, sub.gradient(sub.at(cycles)) * f, -np.inf)
            cycles[int(np.argmax(gain))] += 1.0
        return Selection(ordered, cycles, float(sub.at(cycles).value))

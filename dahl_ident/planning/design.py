"""Optimal designs: the criterion of a set of levels, and the search for the best set.

A level measured for n cycles adds n J'J to the information, where J is the Jacobian of its whitened
residuals. Errors of gain and phase that all rows of a run share, of standard deviation s, are two
further parameters of each run with the prior information 1/s^2; after their elimination a run gives

    S = M - B (C + I/s^2)^{-1} B'

on the parameters. Parameters that differ from run to run with the covariance T leave (S^{-1} +
T)^{-1} of it, and R equal runs give R times as much. S is a concave function of the cycles (a Schur
complement), and every criterion here is the mean over draws of the logarithm of a concave,
homogeneous function of the information, so that the search for the best design is a convex problem:

- D: ln det(M)/P; with departures of the model among the parameters, that of the other parameters
  only, -ln det((M^{-1})_PP) (D_s-optimality);
- targets: -ln(sum_t (c_t' M^{-1} c_t / u_t^2)^q)/q; with one target c-optimality, with several
  close to the largest ratio of variance to target.

**Continuous designs** are seconds t_k at each candidate, with a fixed sum. With d_k the derivative
of the criterion with respect to t_k and d the mean of d_k weighted by t_k, every t_k is multiplied
by (d_k/d)^p; at the optimum d_k <= d everywhere (the equivalence theorem), with equality where
t_k > 0. For D-optimality without earlier data d times the time is 1.

**With fixed costs** each level needs time for change-over and settling before it gives information.
Levels are added, exchanged and removed one at a time while this improves the criterion, and the
remaining time is distributed by the same multiplication; then cycles are rounded to whole numbers.

Source: Pukelsheim, *Optimal Design of Experiments*, 2006, chapters 3 and 5; Silvey, Titterington
and Torsney, *Commun. Stat. A* 7, 1379 (1978); Yu, *Ann. Stat.* 38, 1593 (2010).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.planning.candidates import LEAST_CYCLES, BenchTime

_NORM = 4.0  # of the norm over the targets: 1 adds their variances, infinity takes the largest
_IMPROVES = 1e-3  # smallest gain of the criterion for which a level is exchanged
_TRIED = 3  # candidates whose times are optimised, after a first comparison of all
_NO_TIME = 1e-9  # s, shared by levels without time, so that all quotients are defined
_MOST_LEVELS = 24  # six parameters need at most 21 levels (Caratheodory)


def packed_information(
    rows: FloatArray, offsets: FloatArray, scatter: float
) -> NDArray[np.float64]:
    """Return J'J of each candidate, (K, S Q Q).

    `rows`, (S, K, m, P), are J. `offsets`, (S, K, m, 2), are the derivatives with respect to a
    run's gain and phase, which are further parameters if runs scatter.
    """
    if scatter > 0.0:
        rows = np.concatenate([rows, offsets], axis=-1)
    products = rows.swapaxes(-1, -2) @ rows
    return np.ascontiguousarray(products.swapaxes(0, 1).reshape(rows.shape[1], -1))


@dataclass(frozen=True)
class Term:
    """One criterion on one model: D-optimality, or the uncertainty of targets."""

    # (..., K, S Q Q) information of one cycle at every candidate and draw; Q = P, or P + 2 with a
    # run's gain and phase after the parameters
    packed: FloatArray
    known: FloatArray  # (S, P, P) information before the plan
    # s, standard deviation of a run's ln gain and phase; 0 if runs do not differ
    scatter: float = 0.0
    # (S, P, C) directions over their target standard uncertainties; None for D-optimality
    targets: FloatArray | None = None
    # (T,) first of the columns of each target, whose variances are added; None for one column each
    starts: IntArray | None = None
    weight: float = 1.0  # in the sum of the terms
    between: FloatArray | None = None  # (P, P) covariance of the parameters between runs
    # number of the last parameters, departures, whose uncertainty is not part of the criterion
    departures: int = 0

    def of_run(self, cycles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return S for cycles (..., K), and L in dS = L dM L' with M of all Q parameters."""
        S, P = self.known.shape[:2]
        Q = P + 2 * (self.scatter > 0.0)
        total = (cycles[..., None, :] @ self.packed)[..., 0, :]
        M = total.reshape(*total.shape[:-1], S, Q, Q)
        identity = np.broadcast_to(np.eye(P), (*M.shape[:-2], P, P))
        if Q > P:
            C = M[..., P:, P:] + np.eye(2) / self.scatter**2
            lever = -M[..., :P, P:] @ np.linalg.inv(C)
            M = M[..., :P, :P] + lever @ M[..., P:, :P]
            identity = np.concatenate([identity, lever], axis=-1)
        if self.between is None:
            return M, identity
        left = np.linalg.inv(np.eye(P) + M @ self.between)
        return left @ M, left @ identity

    def at(self, cycles: FloatArray, runs: int) -> tuple[FloatArray, FloatArray]:
        """Return the weighted criterion, and its derivative with respect to the packed sums."""
        S, L = self.of_run(cycles)
        value, slope = self._criterion(self.known + runs * S)
        slope = (self.weight * runs / len(self.known)) * (L.swapaxes(-1, -2) @ slope @ L)
        return self.weight * value, slope.reshape(*value.shape, -1)

    def _criterion(self, M: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the mean over draws, (...), and S times its derivative, (..., S, P, P)."""
        inverse = np.linalg.inv(M)
        if self.targets is None:
            P = M.shape[-1] - self.departures
            if not self.departures:
                return np.linalg.slogdet(M)[1].mean(axis=-1) / P, inverse / P
            part, rows = inverse[..., :P, :P], inverse[..., :P, :]
            slope = rows.swapaxes(-1, -2) @ np.linalg.inv(part) @ rows
            return -np.linalg.slogdet(part)[1].mean(axis=-1) / P, slope / P
        inverse_c = inverse @ self.targets
        variances = np.einsum("...spc,spc->...sc", inverse_c, self.targets)
        count = variances.shape[-1]
        starts = np.arange(count) if self.starts is None else self.starts
        sums = np.add.reduceat(variances, starts, axis=-1)
        top = sums.max(axis=-1, keepdims=True)
        powers = (sums / top) ** (_NORM - 1.0)
        total = (powers * sums / top).sum(axis=-1)
        value = -(np.log(top[..., 0]) + np.log(total) / _NORM).mean(axis=-1)
        share = np.repeat(powers / (total[..., None] * top), np.diff([*starts, count]), axis=-1)
        return value, (inverse_c * share[..., None, :]) @ inverse_c.swapaxes(-1, -2)


@dataclass(frozen=True)
class Objective:
    """The sum of terms over the same candidates, as a function of the cycles in one of `runs`."""

    terms: tuple[Term, ...]
    runs: int = 1

    def only(self, candidates: Sequence[int] | IntArray) -> Objective:
        """Return the objective of some candidates, or of each of several sets, (designs, m)."""
        chosen = np.asarray(candidates, dtype=np.intp)
        return replace(self, terms=tuple(replace(t, packed=t.packed[chosen]) for t in self.terms))

    def at(self, cycles: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """Return the criterion and its sensitivities at the cycles of all candidates, (..., K)."""
        terms = [term.at(cycles, self.runs) for term in self.terms]
        return np.asarray(sum(value for value, _ in terms)), [slope for _, slope in terms]

    def gradient(self, sensitivities: Sequence[FloatArray]) -> FloatArray:
        """Return derivatives with respect to the cycles of this objective's candidates."""
        pairs = zip(self.terms, sensitivities, strict=True)
        return np.asarray(sum((t.packed @ s[..., None])[..., 0] for t, s in pairs))


class ContinuousDesign(NamedTuple):
    """Seconds at each candidate, the criterion, and the largest d_k/d - 1: 0 at the optimum."""

    seconds: FloatArray
    value: float
    excess: float


def continuous_design(
    objective: Objective,
    frequency_hz: FloatArray,
    time: float,
    *,
    tolerance: float = 0.01,
    iterations: int = 400,
) -> ContinuousDesign:
    """Return the best seconds at each candidate, without settling and change-over."""
    even = np.full(len(frequency_hz), time / len(frequency_hz))
    seconds = _best_seconds(objective, frequency_hz, time, even, iterations, tolerance)
    value, sensitivities = objective.at(seconds * frequency_hz)
    rate = objective.gradient(sensitivities) * frequency_hz
    excess = rate.max() / (rate @ seconds / time) - 1.0
    return ContinuousDesign(seconds, float(value), float(excess))


def _best_seconds(
    objective: Objective,
    frequency_hz: FloatArray,
    time: FloatArray | float,
    start: FloatArray,
    iterations: int,
    tolerance: float,
    least: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the best distribution of each design's `time` over its levels, (..., m).

    The seconds are in addition to `least`.
    """
    seconds = start * (time / start.sum(axis=-1, keepdims=True))
    power = np.ones((*seconds.shape[:-1], 1))
    value, sensitivities = objective.at((least + seconds) * frequency_hz)
    rate = objective.gradient(sensitivities) * frequency_hz
    for _ in range(iterations):
        mean = (rate * seconds).sum(axis=-1, keepdims=True) / time
        continues = (mean > 0.0) & (rate.max(axis=-1, keepdims=True) >= (1.0 + tolerance) * mean)
        if not continues.any():
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = seconds * (rate / mean) ** power
            moved *= time / moved.sum(axis=-1, keepdims=True)
        moved = np.where(continues, moved, seconds)
        new_value, sensitivities = objective.at((least + moved) * frequency_hz)
        # only D-optimality is sure to rise at full steps; a step that falls is halved and repeated
        fell = (new_value < value)[..., None] & (power >= 0.1)
        power = np.where(fell, 0.5 * power, power)
        if fell.all():
            continue
        new_rate = objective.gradient(sensitivities) * frequency_hz
        seconds, rate = np.where(fell, seconds, moved), np.where(fell, rate, new_rate)
        value = np.where(fell[..., 0], value, new_value)
    return np.asarray(seconds)


@dataclass(frozen=True)
class Design:
    """Levels in the order of a run, whole cycles at each, and how many runs."""

    levels: IntArray
    cycles: FloatArray
    runs: int
    value: float  # of the criterion
    seconds: float  # of all runs
    ratio: float = np.nan  # largest ratio of an uncertainty to its target


class Coverage(NamedTuple):
    """Requirements on levels, so that a fit to their data can be judged."""

    fewest: int  # smallest number of levels
    span: float  # smallest ln of the largest displacement amplitude over the smallest
    amplitude: FloatArray  # (K,) ln of the displacement amplitude of every candidate

    def wide(self, levels: IntArray) -> BoolArray:
        """Return which sets of levels, (..., m), have the required span."""
        return np.asarray(np.ptp(self.amplitude[levels], axis=-1) >= self.span)


class Exchange:
    """The search for the best levels with settling and change-over, within a coverage."""

    def __init__(
        self,
        objective: Objective,
        bench: BenchTime,
        pool: IntArray,
        coverage: Coverage | None = None,
    ) -> None:
        self._objective, self._bench, self._pool = objective, bench, pool
        self._coverage = coverage or Coverage(1, 0.0, np.zeros(len(bench.frequency_hz)))

    def best(self, time: float, start: Sequence[int] = ()) -> Design | None:
        """Return the best levels for one run of `time` s; None if no level can be measured."""
        chosen, value, fewest = list(start), -np.inf, self._coverage.fewest
        if chosen:
            value = float(self._values([chosen], time)[0])
            chosen = chosen if np.isfinite(value) else []
        improves = True
        while improves:
            added = self._promising(chosen, time) if len(chosen) < _MOST_LEVELS else []
            for sets, to_beat in (
                (([*chosen, k] for k in added), -np.inf if len(chosen) < fewest else value),
                (self._exchanges(chosen, time), value),
            ):
                trials = list(sets)
                values = self._values(trials, time)
                improves = bool(trials) and bool(values.max() > to_beat + _IMPROVES)
                if improves:
                    chosen, value = trials[int(values.argmax())], float(values.max())
                    break
        return self.whole(chosen, time) if chosen else None

    def _exchanges(self, chosen: list[int], time: float) -> Iterator[list[int]]:
        """Yield the chosen levels with one left out, or exchanged for another candidate."""
        for k in chosen:
            others = [j for j in chosen if j != k]
            if len(others) >= self._coverage.fewest:
                yield others
            yield from ([*others, j] for j in self._promising(others, time) if j != k)

    def _best_cycles(
        self, levels: IntArray, time: float, iterations: int
    ) -> tuple[Objective, FloatArray]:
        """Return the objective and the best cycles of each design, (..., m); NaN if too short."""
        f = self._bench.frequency_hz[levels]
        least = LEAST_CYCLES / f
        spare = (time - self._bench.fixed(levels) - least.sum(axis=-1))[..., None]
        sub = self._objective.only(levels)
        shared = np.maximum(spare, _NO_TIME)
        seconds = _best_seconds(sub, f, shared, np.ones(f.shape), iterations, 0.003, least)
        cycles = (least + np.where(spare > 0.0, seconds, 0.0)) * f
        return sub, np.where(spare >= 0.0, cycles, np.nan)

    def _values(self, trials: list[list[int]], time: float) -> FloatArray:
        """Return the criterion of each set of levels; -inf without enough time."""
        result = np.full(len(trials), -np.inf)
        sizes = np.array([len(trial) for trial in trials])
        for size in np.unique(sizes[sizes > 0]).tolist():
            same = np.flatnonzero(sizes == size)
            levels = np.array([trials[i] for i in same], dtype=np.intp)
            sub, cycles = self._best_cycles(levels, time, 15)
            # a single level has no span, but others may be added
            wide = self._coverage.wide(levels) | (size < 2)
            possible = np.isfinite(cycles).all(axis=-1) & wide
            value, _ = sub.at(np.where(possible[:, None], cycles, 1.0))
            result[same] = np.where(possible, value, -np.inf)
        return result

    def _promising(self, chosen: list[int], time: float) -> list[int]:
        """Return the candidates that are best in addition to the chosen ones, at equal times."""
        others = np.setdiff1d(self._pool, chosen)
        joined = np.column_stack([np.tile(chosen, (others.size, 1)), others]).astype(np.intp)
        least = (LEAST_CYCLES / self._bench.frequency_hz[joined]).sum(axis=-1)
        spare = time - self._bench.fixed(joined) - least
        fits = (spare >= 0.0) & (self._coverage.wide(joined) | (joined.shape[1] < 2))
        if not fits.any():
            return []
        joined, each = joined[fits], spare[fits] / joined.shape[1]
        cycles = LEAST_CYCLES + each[:, None] * self._bench.frequency_hz[joined]
        values, _ = self._objective.only(joined).at(cycles)
        return [int(k) for k in joined[np.argsort(-values)[:_TRIED], -1]]

    def whole(self, levels: Sequence[int], time: float) -> Design:
        """Return whole cycles at the levels, with the remaining time where it helps most."""
        ordered = self._bench.order(levels)
        f = self._bench.frequency_hz[ordered]
        sub, best = self._best_cycles(ordered, time, 100)
        cycles = np.maximum(np.floor(best + 1e-9), float(LEAST_CYCLES))
        while True:
            value, sensitivities = sub.at(cycles)
            seconds, runs = self._bench.seconds(ordered, cycles), self._objective.runs
            possible = 1.0 / f <= time - seconds + 1e-9
            if not possible.any():
                return Design(ordered, cycles, runs, float(value), runs * seconds)
            gain = np.where(possible, sub.gradient(sensitivities) * f, -np.inf)
            cycles[int(np.argmax(gain))] += 1.0

"""What records show of a fit's errors: noise, model, scatter between runs, values that it holds.

What a model misses differs from place to place, and what a device does from run to run. Blocks of
the records, or whole records, then ask for other parameters; the scatter beyond that of noise
counts as a separate error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.contributions import positive_part
from dahl_ident.diagnostics.correlated_residuals import inverse_normal, noise_in, sandwich
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.errors import FitError
from dahl_ident.fitting.record_search import STEPS, RecordSearch
from dahl_ident.problem.record_problem import RecordProblem

BLOCKS = 20
"""Number of blocks of all records together, from which the model error is estimated."""
_LEVEL = 0.9995  # of chance, at which scatter between blocks is not noise
_RUNS_LEVEL = 0.95  # the same between records: counted too often rather than too seldom
_LONG = 0.05  # step of an exponent's logarithm, beyond which slopes change
_CONTRADICTED = 3.3  # standard deviations: once in 1000 by chance


@dataclass(frozen=True)
class LinearFit:
    """A fit of records to first order; waves of each record are filtered as the fit weighs them."""

    problem: RecordProblem
    values: FloatArray  # (P,): the estimate
    jacobians: Sequence[FloatArray]  # (n, P): derivatives of each record's prediction
    residuals: Sequence[FloatArray]  # (n,): measured minus predicted
    noise: Sequence[FloatArray]  # autocovariances of the residuals' noise
    # (P,): the parameters in which a misfit shows: not the states and offsets of records
    judged: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        problem: RecordProblem,
        values: FloatArray,
        jacobians: Sequence[FloatArray],
        residuals: Sequence[FloatArray],
    ) -> LinearFit:
        """Return the fit with these waves, not filtered yet."""
        J, e = ([problem.filtered(wave) for wave in waves] for waves in (jacobians, residuals))
        judged = np.arange(values.size) < len(problem.free)
        return cls(problem, values, J, e, noise_in(J, e), judged)

    @cached_property
    def by_noise(self) -> tuple[FloatArray, float]:
        """Covariance of the estimate from noise, and the effective number of samples."""
        return sandwich(self.jacobians, self.residuals, self.noise)

    @cached_property
    def inverse(self) -> FloatArray:
        """Inverse of the normal matrix, (P, P)."""
        return inverse_normal(self.jacobians)

    @cached_property
    def outputs(self) -> Sequence[FloatArray]:
        """Predicted outputs."""
        return self.problem.outputs(self.values)

    @cached_property
    def exponent_slopes(self) -> Mapping[str, Sequence[FloatArray]]:
        """Derivatives of the outputs with respect to ln of each exponent that the fit holds.

        Nothing where there is no motion next to the estimate.
        """
        problem = self.problem
        if not problem.exponents:
            return {}
        free = problem.freed([p.name for p in problem.exponents])
        known = {p.name: p.value for p in problem.exponents}
        known |= dict(zip(problem.names, self.values.tolist(), strict=True))
        at = np.array([known[name] for name in free.names], dtype=np.float64)
        try:
            by = [free.predict(at, number).by for number in range(len(problem.records))]
        except FitError:
            return {}
        places = {p.name: free.names.index(p.name) for p in problem.exponents}
        return {
            name: [problem.filtered(at[i] * slopes[:, i]) for slopes in by]
            for name, i in places.items()
        }

    def with_freed(self, *slopes: Sequence[FloatArray]) -> LinearFit:
        """Return the fit with more parameters, which come last, of these derivatives."""
        joint = [np.column_stack(waves) for waves in zip(self.jacobians, *slopes, strict=True)]
        judged = np.append(self.judged, np.ones(len(slopes), dtype=bool))
        return replace(self, jacobians=joint, judged=judged)

    def projected(self, waves: Sequence[FloatArray]) -> FloatArray:
        """Return the change of the estimate by filtered changes of the measured outputs."""
        parts = zip(self.jacobians, waves, strict=True)
        return np.asarray(self.inverse @ sum(J.T @ y for J, y in parts))

    def changed(self, outputs: Sequence[FloatArray]) -> FloatArray:
        """Return the change of the estimate by changes of the measured outputs."""
        return self.projected([self.problem.filtered(y) for y in outputs])

    def difference_to(self, other: RecordProblem) -> Sequence[FloatArray]:
        """Return how the filtered outputs change if another problem is the right one."""
        ends = zip(self.outputs, other.outputs(self.values), strict=True)
        return [self.problem.filtered(b - a) for a, b in ends]

    @cached_property
    def delay_slopes(self) -> Sequence[FloatArray]:
        """Derivatives of the filtered outputs with respect to the delay, per second."""
        return [self.problem.filtered(slope) for slope in self.problem.delay_slopes(self.values)]

    @cached_property
    def variances(self) -> FloatArray:
        """Variances of the values by noise and by scatter between blocks, (P,)."""
        covariance, _ = self.by_noise
        beyond = between_blocks(self)
        return np.diagonal(covariance if beyond is None else covariance + beyond)


@dataclass(frozen=True)
class HeldValue:
    """An exponent that the fit holds."""

    name: str
    unit: str
    value: float  # what it is held at
    range: tuple[float, float]  # where it may lie; nothing but `value` where the user stated it
    std: float  # of its logarithm, by the records and its range together
    # logarithm of the ratio of the estimate by the records alone, which may be outside the range,
    # to `value`, and its standard deviation
    asked: float
    by_records: float
    # (P, P): covariance of the estimate through it: as if it were estimated too, and at least as
    # much as the value estimated from the records moves it
    contribution: FloatArray
    assumed: bool  # whether the user did not state it

    @property
    def contradicted(self) -> bool:
        """Whether the records contradict the value."""
        return abs(self.asked) > _CONTRADICTED * self.by_records

    @property
    def found(self) -> str:
        """The estimate by the records alone, in words."""
        value = self.value * np.exp(self.asked)
        return with_unit(value, value * self.by_records, self.unit)

    def __str__(self) -> str:
        low, high = self.range
        here = with_unit(self.value, self.value * self.std, self.unit)
        return f"{self.name} between {low:g} and {high:g} (here {here})"


def held_exponents(fit: LinearFit) -> tuple[HeldValue, ...]:
    """Return what the records say of each exponent that the fit holds, stated or not.

    By a search with a stated exponent free; with an assumed one, which the estimate fits already,
    by a Gauss-Newton step, and a search where that leads far. As for tables, the range counts as a
    uniform distribution of the logarithm, and for less where the records say more.
    """
    held = []
    for p in (p for p in fit.problem.exponents if p.name in fit.exponent_slopes):
        freed = _Freed.of(fit, fit.exponent_slopes[p.name])
        value, limits = float(p.value or 1.0), p.prior or (1.0, 1.0)
        low, high = (float(np.log(end / value)) for end in limits)
        low, high = min(low, 0.0), max(high, 0.0)
        asked, by_records = freed.asked, freed.variance**0.5
        std, contribution = freed.counted(float(np.clip(asked, low, high)), (high - low) / 12**0.5)
        if not p.assumed or abs(asked) > max(_LONG, _CONTRADICTED * by_records):
            asked, by_records = _asked(fit, p.name) or (asked, by_records)
        held.append(
            HeldValue(
                p.name, p.unit, value, limits, std, asked, by_records, contribution, p.assumed
            )
        )
    return tuple(held)


def _asked(fit: LinearFit, name: str) -> tuple[float, float] | None:
    """Return the logarithm of an exponent's estimate over its value, and its standard deviation.

    The displacement's noise is estimated anew: what was taken out of the records with the exponent
    held may be misfit. None where that describes the records better.
    """
    problem = fit.problem
    search, free = RecordSearch("lm", "linear"), problem.freed([name])
    place = free.names.index(name)
    (value,) = (float(p.value or 1.0) for p in problem.exponents if p.name == name)
    begin = free.to_search(np.insert(fit.values, place, value))
    held, free = float(free.quadratic(begin).cost), free.without_noise(0.0)
    end = search.descend(free, begin, STEPS)
    if problem.output == "force":
        free, end = search.without_noise(free, end)
    if not end.converged[0] or not end.cost[0] < held:
        return None
    at = free.to_values(end.theta[0])
    predicted = [free.predict(at, number) for number in range(len(problem.records))]
    e = [y - p.output for y, p in zip(free.measured, predicted, strict=True)]
    u = float(LinearFit.of(free, at, [p.by for p in predicted], e).variances[place]) ** 0.5
    return float(np.log(at[place] / value)), u / float(at[place])


def by_delay(fit: LinearFit) -> FloatArray:
    """Return the covariance of the estimate through the delay, which the user did not state.

    A normal distribution of one sample counts, and for less where the records say more; the
    estimated delay is taken out already.
    """
    sample = 1.0 / fit.problem.records[0].sample_rate
    freed = _Freed.of(fit, [sample * slope for slope in fit.delay_slopes])
    return freed.counted(freed.asked, 1.0)[1]


class _Freed(NamedTuple):
    """A value that a fit holds, estimated too by a Gauss-Newton step."""

    asked: float  # how far the records move it
    variance: float  # of that
    moved: FloatArray  # changes of the other values with it

    @classmethod
    def of(cls, fit: LinearFit, slopes: Sequence[FloatArray]) -> _Freed:
        """Return the value of which the outputs have these derivatives."""
        joint = fit.with_freed(slopes)
        moved = np.zeros(fit.values.size)
        if any(slope.any() for slope in slopes):  # a delay has none where nothing drives
            moved = joint.inverse[:-1, -1] / joint.inverse[-1, -1]
        asked = float(joint.projected(joint.residuals)[-1])
        return cls(asked, float(joint.variances[-1]), moved)

    def counted(self, mean: float, s: float) -> tuple[float, FloatArray]:
        """Return the standard deviation of the value, and the covariance that it makes.

        `mean` is the estimate by the records, `s` the standard deviation of what is known
        beforehand.
        """
        std, u2 = s, self.variance
        if np.isfinite(u2):
            s = max(s, s**2 / max(u2, 1e-300) ** 0.5)
            weight = s**2 / (s**2 + u2)
            mean, std = mean * weight, (u2 * weight) ** 0.5
        else:
            mean = 0.0
        change = self.moved * max(std, abs(mean))
        return std, np.outer(change, change)


def between_blocks(fit: LinearFit) -> FloatArray | None:
    """Return the covariance between blocks beyond that of noise, or None where it shows none."""
    if sum(e.size for e in fit.residuals) < BLOCKS * BLOCKS:
        return None
    blocks = [[block] for block in blocks_of(fit.residuals)]
    return _between(fit, blocks, fit.by_noise[0], _LEVEL)


def blocks_of(
    waves: Sequence[FloatArray], blocks: int = BLOCKS
) -> list[tuple[int, NDArray[np.intp]]]:
    """Return the number of each block's record, and the block's samples in it."""
    samples = sum(len(wave) for wave in waves)
    return [
        (number, rows)
        for number, wave in enumerate(waves)
        for rows in np.array_split(
            np.arange(len(wave)), max(1, round(blocks * len(wave) / samples))
        )
    ]


def between_records(fit: LinearFit, known: FloatArray) -> FloatArray | None:
    """Return the covariance between records beyond the `known` one, or None; see above.

    The deviations of a whole record count once, however many samples it has, and in however many
    parts it is: the problem's `runs` say which record each part is of.
    """
    runs = np.asarray(fit.problem.runs)
    whole = [np.arange(e.size) for e in fit.residuals]
    members = [np.flatnonzero(runs == run).tolist() for run in np.unique(runs)]
    records = [[(i, whole[i]) for i in each] for each in members]
    return _between(fit, records, known, _RUNS_LEVEL) if len(records) > 1 else None


def _between(
    fit: LinearFit,
    groups: Sequence[Sequence[tuple[int, NDArray[np.intp]]]],
    noise: FloatArray,
    level: float,
) -> FloatArray | None:
    """Return the covariance between groups of samples beyond `noise`, or None by chance.

    A group is a list of records' numbers, each with samples. The covariance between groups is that
    of Liang and Zeger, Biometrika 73 (1986) 13-22.
    """
    seen = np.flatnonzero(np.isfinite(noise.diagonal()))
    inside = np.ix_(seen, seen)
    if not noise[inside].any():
        return None
    size = np.sqrt(noise.diagonal()[seen])
    units, scores, parts = np.outer(size, size), [], []
    for group in groups:
        J = np.concatenate([fit.jacobians[i][rows] for i, rows in group])[:, seen]
        scores.append(size * (J.T @ np.concatenate([fit.residuals[i][rows] for i, rows in group])))
        parts.append(units * (J.T @ J))
    inverse = np.linalg.inv(sum(parts))
    steps = np.array(scores) @ inverse
    between = len(steps) / (len(steps) - 1.0) * steps.T @ steps
    by_chance = noise[inside] / units
    # how much each block says of each parameter
    weights = np.array([(inverse @ part @ inverse).diagonal() for part in parts])
    dof = np.maximum(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0) - 1.0, 1.0)
    ratio = between.diagonal() / by_chance.diagonal()
    if not (ratio > special.chdtri(dof, 1.0 - level) / dof)[fit.judged[seen]].any():
        return None
    excess = np.zeros(noise.shape)
    excess[inside] = positive_part(between - by_chance) * units
    return excess

"""Errors of a fit to records: noise, model error, scatter between runs, fixed exponents and delay.

A misfit changes along a record, and a device changes between runs. Estimates from blocks of the
records, or from single records, then scatter more than noise explains; the excess is a separate
source of error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy import special

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.diagnostics.contributions import excess, positive_part
from dahl_ident.diagnostics.correlated_residuals import inverse_normal, noise_in, sandwich
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.errors import FitError
from dahl_ident.fitting.record_search import STEPS, RecordSearch
from dahl_ident.problem.record_problem import RecordProblem

BLOCKS = 20
"""Number of blocks into which all records together are divided to estimate the model error."""
_BLOCKS_CONFIDENCE = 0.9995  # at which scatter between blocks exceeds the noise
_RECORDS_CONFIDENCE = 0.95  # the same between records; lower, so that scatter is seldom missed
_LINEAR = 0.05  # step of an exponent's logarithm up to which the model is linear
_CONTRADICTED = 3.3  # standard deviations: once in 1000 by chance


Waves: TypeAlias = Sequence[FloatArray]
"""A filtered change of the output of each record."""
Sources: TypeAlias = Callable[["LinearFit"], Iterable[tuple[str, FloatArray]]]
"""Returns covariances of a fit's values, (P, P), by source."""


@dataclass(frozen=True)
class LinearFit:
    """A fit of records to first order; residuals and derivatives are filtered as in the fit."""

    problem: RecordProblem
    values: FloatArray  # (P,): the estimate
    jacobians: Sequence[FloatArray]  # (n, P): derivatives of each record's prediction
    residuals: Sequence[FloatArray]  # (n,): measured minus predicted
    noise: Sequence[FloatArray]  # autocovariances of the residuals' noise
    of_model: BoolArray  # (P,): parameters that are not states or offsets of records

    @classmethod
    def of(
        cls,
        problem: RecordProblem,
        values: FloatArray,
        jacobians: Sequence[FloatArray],
        residuals: Sequence[FloatArray],
    ) -> LinearFit:
        """Return the fit with these derivatives and residuals, which are filtered here."""
        J, e = ([problem.filtered(wave) for wave in waves] for waves in (jacobians, residuals))
        of_model = np.arange(values.size) < len(problem.free)
        return cls(problem, values, J, e, noise_in(J, e), of_model)

    @cached_property
    def by_noise(self) -> tuple[FloatArray, float]:
        """Covariance of the estimate from noise, and the effective number of samples."""
        return sandwich(self.jacobians, self.residuals, self.noise)

    @cached_property
    def between_blocks(self) -> FloatArray | None:
        """Covariance from scatter between blocks in excess of noise; None if noise explains it."""
        if sum(e.size for e in self.residuals) < BLOCKS * BLOCKS:
            return None
        blocks = [[block] for block in blocks_of(self.residuals)]
        return _between(self, blocks, self.by_noise[0], _BLOCKS_CONFIDENCE)

    @cached_property
    def inverse(self) -> FloatArray:
        """Inverse of the normal matrix, (P, P)."""
        return inverse_normal(self.jacobians)

    @cached_property
    def outputs(self) -> Sequence[FloatArray]:
        """Predicted outputs."""
        return self.problem.outputs(self.values)

    @cached_property
    def exponent_slopes(self) -> Mapping[str, Waves]:
        """Derivatives of the outputs with respect to ln of each fixed exponent, by name.

        Empty if the motion near the estimate cannot be computed.
        """
        problem = self.problem
        if not problem.exponents:
            return {}
        free = problem.freed([p.name for p in problem.exponents])
        known = {p.name: p.value for p in problem.exponents}
        known |= dict(zip(problem.names, self.values.tolist(), strict=True))
        values = np.array([known[name] for name in free.names], dtype=np.float64)
        try:
            slopes = [free.predict(values, number).by for number in range(len(problem.records))]
        except FitError:
            return {}
        columns = {p.name: free.names.index(p.name) for p in problem.exponents}
        return {
            name: [problem.filtered(values[i] * J[:, i]) for J in slopes]
            for name, i in columns.items()
        }

    def with_freed(self, *slopes: Waves) -> LinearFit:
        """Return the fit with additional parameters at the end, which have these derivatives."""
        jacobians = [np.column_stack(waves) for waves in zip(self.jacobians, *slopes, strict=True)]
        of_model = np.append(self.of_model, np.ones(len(slopes), dtype=bool))
        return replace(self, jacobians=jacobians, of_model=of_model)

    def projected(self, waves: Waves) -> FloatArray:
        """Return the change of the estimate due to filtered changes of the measured outputs."""
        parts = zip(self.jacobians, waves, strict=True)
        return np.asarray(self.inverse @ sum(J.T @ y for J, y in parts))

    def changed(self, outputs: Sequence[FloatArray]) -> FloatArray:
        """Return the change of the estimate due to changes of the measured outputs."""
        return self.projected([self.problem.filtered(y) for y in outputs])

    def difference_to(self, other: RecordProblem) -> Waves:
        """Return the filtered outputs of another problem minus those of this one."""
        ends = zip(self.outputs, other.outputs(self.values), strict=True)
        return [self.problem.filtered(b - a) for a, b in ends]

    @cached_property
    def delay_slopes(self) -> Waves:
        """Derivatives of the filtered outputs with respect to the delay, per second."""
        return [self.problem.filtered(slope) for slope in self.problem.delay_slopes(self.values)]

    def covariance(self, sources: Sources | None = None) -> FloatArray:
        """Return the covariance from noise, scatter between blocks and other `sources`, (P, P)."""
        parts = [self.by_noise[0], self.between_blocks]
        parts += [part for _, part in sources(self)] if sources else []
        return np.asarray(sum(part for part in parts if part is not None))


@dataclass(frozen=True)
class FixedExponent:
    """An exponent that the fit holds fixed, and what the records show about it."""

    name: str
    unit: str
    value: float  # at which it is fixed
    range: tuple[float, float]  # in which it may lie; only `value` if the user stated it
    std: float  # of its logarithm, from the records and the range together
    # ln of the estimate from the records alone, which may be outside the range, over `value`, and
    # its standard deviation
    log_ratio: float
    log_ratio_std: float
    # (P, P): covariance of the estimate due to the exponent's uncertainty, or due to its distance
    # from the value that the records indicate, whichever is larger
    contribution: FloatArray
    assumed: bool  # whether the fit assumes it, because the user stated none

    @property
    def contradicted(self) -> bool:
        """Whether the records contradict the value."""
        return abs(self.log_ratio) > _CONTRADICTED * self.log_ratio_std

    def __str__(self) -> str:
        low, high = self.range
        value = with_unit(self.value, self.value * self.std, self.unit)
        return f"{self.name} between {low:g} and {high:g} (here {value})"


def fixed_exponents(
    fit: LinearFit, sources: Sources, exact: FloatArray
) -> tuple[FixedExponent, ...]:
    """Return what the records show about each fixed exponent, stated or assumed.

    Its uncertainty is due to noise, scatter between blocks, and `sources`; `exact` is the
    covariance of the estimate due to all of these with the exponents fixed.

    A stated exponent is estimated by a search in which it is free. An assumed one, which is close
    to its optimum, is estimated by a Gauss-Newton step, and by a search if that step is long. As
    for tables, the range is taken as a uniform distribution of the logarithm; its weight is less if
    the records contain more information.
    """
    exponents = []
    for p in (p for p in fit.problem.exponents if p.name in fit.exponent_slopes):
        freed = _FreedValue.of(fit, fit.exponent_slopes[p.name], sources)
        value, limits = float(p.value or 1.0), p.prior or (1.0, 1.0)
        low, high = (float(np.log(end / value)) for end in limits)
        low, high = min(low, 0.0), max(high, 0.0)
        ratio, ratio_std = freed.change, float(freed.covariance[-1, -1]) ** 0.5
        mean, s = float(np.clip(ratio, low, high)), (high - low) / 12**0.5
        std, covariance = freed.with_prior(mean, s, exact)
        if not p.assumed or abs(ratio) > max(_LINEAR, _CONTRADICTED * ratio_std):
            with suppress(FitError):  # the motion cannot be computed at values that are tried
                ratio, ratio_std = _searched_ratio(fit, p.name, sources) or (ratio, ratio_std)
        exponents.append(
            FixedExponent(
                p.name, p.unit, value, limits, std, ratio, ratio_std, covariance, p.assumed
            )
        )
    return tuple(exponents)


def _searched_ratio(fit: LinearFit, name: str, sources: Sources) -> tuple[float, float] | None:
    """Return ln of an exponent's estimate over its value, and its standard deviation, by a search.

    None if the fixed exponent describes the records better. The noise of the displacement is
    estimated again, because its estimate with the exponent fixed may contain misfit.
    """
    problem = fit.problem
    search, free = RecordSearch("lm", "linear"), problem.freed([name])
    i = free.names.index(name)
    (value,) = (float(p.value or 1.0) for p in problem.exponents if p.name == name)
    start = free.to_search(np.insert(fit.values, i, value))
    cost, free = float(free.quadratic(start).cost), free.smoothed(on=False).without_noise(0.0)
    end = search.descend(free, start, STEPS)
    if problem.output == "force":
        free, end = search.without_noise(free, end)
    if not end.converged[0] or not end.cost[0] < cost:
        return None
    values = free.to_values(end.theta[0])
    predicted = [free.predict(values, number) for number in range(len(problem.records))]
    e = [y - p.output for y, p in zip(free.measured, predicted, strict=True)]
    at_end = LinearFit.of(free, values, [p.by for p in predicted], e)
    u = float(at_end.covariance(sources)[i, i]) ** 0.5
    return float(np.log(values[i] / value)), u / float(values[i])


def by_delay(fit: LinearFit) -> FloatArray:
    """Return the covariance of the estimate due to the delay, which the user did not state.

    The estimated delay has been removed, unless it is too long for that. The prior of the rest has
    a standard deviation of one sample; its weight is less if the records contain more information.
    """
    sample = 1.0 / fit.problem.records[0].sample_rate
    freed = _FreedValue.of(fit, [sample * slope for slope in fit.delay_slopes])
    return freed.with_prior(freed.change, 1.0, fit.covariance())[1]


class _FreedValue(NamedTuple):
    """A value that a fit holds fixed, estimated by a Gauss-Newton step."""

    change: float  # its estimate from the records minus the fixed value
    covariance: FloatArray  # (P + 1, P + 1): of the other values and, last, of this one
    others: FloatArray  # (P,): changes of the other values per change of this one

    @classmethod
    def of(cls, fit: LinearFit, slopes: Waves, sources: Sources | None = None) -> _FreedValue:
        """Return the value with respect to which `slopes` are derivatives of the outputs."""
        joint = fit.with_freed(slopes)
        others = np.zeros(len(joint.inverse) - 1)
        if any(slope.any() for slope in slopes):  # without a drive, a delay has no effect
            others = joint.inverse[:-1, -1] / joint.inverse[-1, -1]
        change = float(joint.projected(joint.residuals)[-1])
        return cls(change, joint.covariance(sources), others)

    def with_prior(self, mean: float, s: float, exact: FloatArray) -> tuple[float, FloatArray]:
        """Return the standard deviation of the value, and what it adds to the others' covariance.

        `mean` is the estimate from the records, `s` the standard deviation of the prior, which is
        widened if the records contradict it, and `exact` the covariance of the other values if
        this one is exact.
        """
        u2, C = float(self.covariance[-1, -1]), self.covariance
        line = np.outer(self.others, self.others)
        if not np.isfinite(u2):
            return s, s**2 * line
        contradiction = max(mean**2 - _CONTRADICTED**2 * u2, 0.0) ** 0.5
        s = max(s, s**2 / max(u2, 1e-300) ** 0.5, contradiction)
        weight = s**2 / (s**2 + u2)
        shrink = np.column_stack([np.eye(self.others.size), (weight - 1.0) * self.others])
        total = shrink @ np.where(np.isfinite(C), C, 0.0) @ shrink.T
        total += ((1.0 - weight) * s) ** 2 * line
        lost = np.isinf(C.diagonal()[:-1])
        total[lost, lost] = np.inf
        beyond = max((weight * mean) ** 2 - weight * u2, 0.0)
        return (weight * u2) ** 0.5, excess(total, exact) + beyond * line


def blocks_of(waves: Sequence[FloatArray], blocks: int = BLOCKS) -> list[tuple[int, IntArray]]:
    """Return the blocks, each as the number of its record and the samples in that record."""
    samples = sum(len(wave) for wave in waves)
    return [
        (number, rows)
        for number, wave in enumerate(waves)
        for rows in np.array_split(
            np.arange(len(wave)), max(1, round(blocks * len(wave) / samples))
        )
    ]


def between_records(fit: LinearFit, known: FloatArray) -> FloatArray | None:
    """Return the covariance between records in excess of `known`; None if chance explains it.

    A record counts once, however many samples or parts it has: the problem's `runs` state to which
    record each part belongs.
    """
    runs = np.asarray(fit.problem.runs)
    whole = [np.arange(e.size) for e in fit.residuals]
    members = [np.flatnonzero(runs == run).tolist() for run in np.unique(runs)]
    records = [[(i, whole[i]) for i in each] for each in members]
    return _between(fit, records, known, _RECORDS_CONFIDENCE) if len(records) > 1 else None


def _between(
    fit: LinearFit,
    groups: Sequence[Sequence[tuple[int, IntArray]]],
    noise: FloatArray,
    level: float,
) -> FloatArray | None:
    """Return the covariance between groups of samples in excess of `noise`.

    None if chance explains it at the confidence `level`. A group is a list of records' numbers with
    samples of each. The covariance between groups is that of Liang and Zeger, Biometrika 73 (1986)
    13-22.
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
    # information of each block on each parameter
    weights = np.array([(inverse @ part @ inverse).diagonal() for part in parts])
    dof = np.maximum(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0) - 1.0, 1.0)
    ratio = between.diagonal() / by_chance.diagonal()
    if not (ratio > special.chdtri(dof, 1.0 - level) / dof)[fit.of_model[seen]].any():
        return None
    covariance = np.zeros(noise.shape)
    covariance[inside] = positive_part(between - by_chance) * units
    return covariance

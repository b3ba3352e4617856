"""Sources of error of a fit to records other than noise: model, scatter between runs, exponents.

What a model misses differs from place to place, and what a device does from run to run. Blocks of
the records, or whole records, then ask for other parameters; what their scatter exceeds that of
noise by counts as an error of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.correlated_residuals import inverse_normal, sandwich
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.elements import Parameter
from dahl_ident.errors import FitError
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.fitting.record_refinement import by_chance
from dahl_ident.fitting.record_search import followed
from dahl_ident.problem.record_problem import RecordProblem

BLOCKS = 20
"""Of all records together, from which the model error is estimated."""
_LEVEL = 0.9995  # of chance, at which scatter between blocks is not noise
_RUNS_LEVEL = 0.95  # the same between records: counted too often rather than too seldom
_LONG = 0.05  # of a step of it, beyond which slopes change
_SHORT = 0.01  # of a step that is the last
_STEPS = 6
_FARTHEST = 1.0  # of the logarithm of any other value in a step
_ROUNDS = 3  # of the exponents: each changes what is best for the delay and for the others
_SLIGHT = 0.1  # of its standard deviation, by which an exponent need not be moved
_CONTRADICTED = 3.3  # standard deviations: once in 1000 by chance


@dataclass(frozen=True)
class HeldValue:
    """A value that the fit holds: an exponent, or the delay between the channels.

    Attributes
    ----------
    name, unit : str
    value : float
        What it is held at.
    range : tuple of float
        Where it may lie; nothing but `value` where the user stated it.
    mean, std : float
        What the records and its range say together, relative to `value`: of its logarithm, of a
        delay in samples.
    asked, by_records : float
        What the records alone ask for, also outside the range, and its standard deviation.
    values : ndarray, shape (P,)
        The estimate with the value at `mean`, to first order.
    contribution : ndarray, shape (P, P)
        Covariance of the estimate through it: as if it were estimated too, and at least as much
        as what the records ask for moves the estimate.
    assumed : bool
        Whether nobody stated it.
    """

    name: str
    unit: str
    value: float
    range: tuple[float, float]
    mean: float
    std: float
    asked: float
    by_records: float
    values: FloatArray
    contribution: FloatArray
    assumed: bool

    @property
    def contradicted(self) -> bool:
        """Whether the records ask for another value."""
        return abs(self.asked) > _CONTRADICTED * self.by_records

    @property
    def estimate(self) -> float:
        """The value that the records and its range ask for together."""
        return self.value * float(np.exp(self.mean))

    @property
    def found(self) -> str:
        """What the records ask for, in words."""
        value = self.value * np.exp(self.asked)
        return with_unit(value, value * self.by_records, self.unit)

    def __str__(self) -> str:
        low, high = self.range
        here = with_unit(self.value, self.value * self.std, self.unit)
        return f"{self.name} between {low:g} and {high:g} (here {here})"


def held_exponents(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> tuple[HeldValue, ...]:
    """Return what the records say of each exponent that the fit holds, stated or not.

    Gauss-Newton steps from the estimate: one, or more where it is long. As for tables, the range
    counts as a uniform distribution of the logarithm, and for less where the records say more.

    Parameters
    ----------
    problem : RecordProblem
    values : ndarray, shape (P,)
        The estimate.
    jacobians, residuals : sequence of ndarray
        Of each record, filtered as the estimate weighs them.

    Returns
    -------
    tuple of HeldValue
    """
    found = []
    for parameter in problem.model.parameters:
        if parameter.free or parameter.prior is None:
            continue
        try:
            found.append(_Search(problem, parameter, values).result(jacobians, residuals))
        except FitError:
            continue  # no motion next to the estimate
    return tuple(found)


def with_exponents(optimum: Optimum) -> Optimum:
    """Return the estimate with exponents that nobody stated where records and range have them.

    The other parameters are those that go with them, so that all of them together are a model.
    """
    usual = {p.name: float(p.value or 1.0) for p in optimum.problem.assumed_exponents}
    left = list(usual) * _ROUNDS
    while left:
        name = left.pop(0)
        problem: RecordProblem = optimum.problem
        places = range(len(problem.records))
        predicted = [problem.predict(optimum.values, i) for i in places]
        residuals = [
            problem.filtered(y - p.output) for y, p in zip(problem.measured, predicted, strict=True)
        ]
        jacobians = [problem.filtered(p.by) for p in predicted]
        (parameter,) = (p for p in problem.assumed_exponents if p.name == name)
        try:
            search = _Search(problem, parameter, optimum.values, usual[name])
            one = search.result(jacobians, residuals)
        except FitError:
            continue  # no motion next to the estimate
        if abs(one.mean) < _SLIGHT * one.std:
            continue
        held, theta = problem.with_fixed({name: one.estimate}), problem.to_search(one.values)
        far = one.mean**2 > _SLIGHT * one.std  # beyond first order
        there = followed(optimum, held, theta, far=far)
        better = there.converged and _no_worse(there, optimum)
        optimum = there if better else optimum
        if not (far and better):
            left = [other for other in left if other != name]
    return optimum


def _no_worse(there: Optimum, optimum: Optimum) -> bool:
    """Return whether an estimate leaves no more of the records than another, beyond chance.

    Nor does it where no motion is next to it, so that its errors could not be stated.
    """

    def left(of: Optimum) -> list[FloatArray]:
        problem: RecordProblem = of.problem
        predicted = [problem.predict(of.values, i).output for i in range(len(problem.records))]
        parts = zip(problem.measured, predicted, problem.sizes, strict=True)
        return [(y - output) / size for y, output, size in parts]

    try:
        before, after = left(optimum), left(there)
    except FitError:
        return False
    sums = [sum(float(e @ e) for e in parts) for parts in (before, after)]
    return sums[1] - sums[0] <= by_chance(0.5 * sums[0], optimum.problem.n_residuals, before)


def by_delay(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> FloatArray:
    """Return the covariance of the estimate through the delay, which nobody stated.

    A normal distribution of one sample counts, and for less where the records say more; the
    estimated delay is taken out already.
    """
    place = len(problem.free)
    sample = 1.0 / problem.records[0].sample_rate
    slopes = [problem.filtered(slope * sample) for slope in problem.delay_slopes(values)]
    joint = [np.insert(J, place, s, axis=1) for J, s in zip(jacobians, slopes, strict=True)]
    step, moved = _freed(joint, residuals, place)
    return _counted(joint, residuals, place, float(step[place]), 1.0, moved)[-1]


def _freed(
    jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray], place: int
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton step, and how the other values change with that at `place`."""
    inverse = inverse_normal(jacobians)
    step = inverse @ sum(J.T @ e for J, e in zip(jacobians, residuals, strict=True))
    moved = np.delete(inverse[:, place], place)
    if not any(J[:, place].any() for J in jacobians):  # such as a delay where nothing drives
        return step, np.zeros(moved.size)
    return step, moved / inverse[place, place]


def _counted(
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    place: int,
    mean: float,
    s: float,
    moved: FloatArray,
    usual: float = 0.0,
) -> tuple[float, float, float, FloatArray]:
    """Return mean and std of a held value, its std by the records alone, and what it moves.

    `usual` is what is known of it beforehand, `s` its standard deviation.
    """
    covariance, _ = sandwich(jacobians, residuals)
    beyond = between_blocks(jacobians, residuals, covariance, place + 1)
    u2 = float((covariance if beyond is None else covariance + beyond)[place, place])
    if not np.isfinite(u2):
        mean, std = usual, s
    else:
        s = max(s, s**2 / max(u2, 1e-300) ** 0.5)
        weight = s**2 / (s**2 + u2)
        mean, std = usual + (mean - usual) * weight, (u2 * weight) ** 0.5
    change = moved * max(std, abs(mean))
    return mean, std, u2**0.5, np.outer(change, change)


class _Search:
    """The estimate with an exponent free, from where the exponent is held."""

    def __init__(
        self,
        problem: RecordProblem,
        parameter: Parameter,
        values: FloatArray,
        usual: float | None = None,
    ) -> None:
        self.problem, self.parameter, self.values = problem, parameter, values
        self.default = float(parameter.value or 1.0)
        self.usual = float(np.log((usual or self.default) / self.default))
        self.range = parameter.prior or (self.default, self.default)
        low, high = (np.log(end / self.default) for end in self.range)
        self.limits = np.array([min(low, 0.0), max(high, 0.0)])
        self.place = len(problem.free)

    def result(self, jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> HeldValue:
        """Return what the records say, given derivatives and residuals at the held value."""
        joint = self._joint(jacobians, self.values, 0.0)
        step, moved = _freed(joint, residuals, self.place)
        at, asked = self.values, float(step[self.place])
        mean = float(np.clip(asked, *self.limits))
        if abs(mean) > _LONG:
            at, mean, asked, joint, residuals = self._refined(step)
            moved = (at - self.values) / mean
        s = float(np.ptp(self.limits)) / 12.0**0.5
        mean, std, by_records, moves = _counted(
            joint, residuals, self.place, mean, s, moved, self.usual
        )
        values, p = self.values + mean * moved, self.parameter
        return HeldValue(
            p.name, p.unit, self.default, self.range, mean, std, asked, by_records, values, moves,
            p.assumed,
        )  # fmt: skip

    def _refined(
        self, step: FloatArray
    ) -> tuple[FloatArray, float, float, list[FloatArray], list[FloatArray]]:
        """Return values, the exponent's logarithm, derivatives and residuals after more steps.

        After the logarithm within the range stands the one that the next step would lead to.
        """
        problem, mean, at = self.problem, 0.0, self.values
        for _ in range(_STEPS):
            wanted = mean + float(step[self.place])
            after = float(np.clip(wanted, *self.limits))
            part = (after - mean) / (wanted - mean) if wanted != mean else 1.0
            chain = problem.space.slopes(at)
            turn = np.delete(step, self.place) / np.where(chain == 0.0, np.inf, chain)
            long = part * float(np.abs(turn[problem.space.relative]).max(initial=0.0))
            if long > _FARTHEST:
                part, after = part * _FARTHEST / long, mean + (after - mean) * _FARTHEST / long
            at, mean = problem.to_values(problem.to_search(at) + part * turn), after
            there = problem.with_fixed({self.parameter.name: self.default * np.exp(mean)})
            found = [there.predict(at, i) for i in range(len(problem.records))]
            left = [
                problem.filtered(y - p.output) for y, p in zip(problem.measured, found, strict=True)
            ]
            joint = self._joint([problem.filtered(p.by) for p in found], at, mean)
            step, _ = _freed(joint, left, self.place)
            if abs(float(step[self.place])) < _SHORT:
                break
        return at, mean, mean + float(step[self.place]), joint, left

    def _joint(
        self, jacobians: Sequence[FloatArray], at: FloatArray, mean: float
    ) -> list[FloatArray]:
        """Return the derivatives with respect to the parameters and the exponent's logarithm."""
        held = self.default * float(np.exp(mean))
        slopes = self.problem.slopes_with_respect_to(self.parameter, at, held)
        pairs = zip(jacobians, map(self.problem.filtered, slopes), strict=True)
        return [np.insert(J, self.place, slope, axis=1) for J, slope in pairs]


def between_blocks(
    jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray], noise: FloatArray, count: int
) -> FloatArray | None:
    """Return the covariance between blocks beyond that of noise, or None where it shows none.

    Parameters
    ----------
    jacobians, residuals : sequence of ndarray
        Of each record.
    noise : ndarray, shape (P, P)
        Covariance of the estimate from noise.
    count : int
        For how many parameters, the first ones, it is judged whether it exceeds noise.

    Returns
    -------
    ndarray or None
    """
    samples = sum(e.size for e in residuals)
    if samples < BLOCKS * BLOCKS:
        return None
    blocks = [(jacobians[i][rows], residuals[i][rows]) for i, rows in blocks_of(residuals)]
    return _beyond(blocks, noise, count, _LEVEL)


def blocks_of(waves: Sequence[FloatArray]) -> list[tuple[int, NDArray[np.intp]]]:
    """Return the number of each block's record, and the block's samples in it."""
    samples = sum(len(wave) for wave in waves)
    return [
        (number, rows)
        for number, wave in enumerate(waves)
        for rows in np.array_split(
            np.arange(len(wave)), max(1, round(BLOCKS * len(wave) / samples))
        )
    ]


def between_records(
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    known: FloatArray,
    count: int,
    runs: Sequence[int],
) -> FloatArray | None:
    """Return the covariance between records beyond the `known` one, or None; see above.

    The deviations of a whole record count once, however many samples it has, and in however many
    parts it is: `runs` says which record each part is of.
    """
    if len(set(runs)) < 2:
        return None
    whole: list[tuple[FloatArray, FloatArray]] = []
    for run in sorted(set(runs)):
        own = [i for i, other in enumerate(runs) if other == run]
        J, e = ([parts[i] for i in own] for parts in (jacobians, residuals))
        whole.append((J[0], e[0]) if len(own) == 1 else (np.concatenate(J), np.concatenate(e)))
    return _beyond(whole, known, count, _RUNS_LEVEL)


def _beyond(
    blocks: Sequence[tuple[FloatArray, FloatArray]], noise: FloatArray, count: int, level: float
) -> FloatArray | None:
    """Return the covariance between blocks beyond `noise`, or None where chance explains it.

    That between blocks is that of Liang and Zeger, Biometrika 73 (1986) 13-22.
    """
    seen = np.flatnonzero(np.isfinite(noise.diagonal()))
    if not noise[np.ix_(seen, seen)].any():
        return None
    if seen.size < len(noise):
        own, inside = [(J[:, seen], e) for J, e in blocks], noise[np.ix_(seen, seen)]
        found = _beyond(own, inside, int((seen < count).sum()), level)
        return None if found is None else _embedded(found, seen, len(noise))
    size = np.sqrt(noise.diagonal())
    scores = [(J * size).T @ e for J, e in blocks]
    parts = [(J * size).T @ (J * size) for J, _ in blocks]
    inverse = np.linalg.inv(sum(parts))
    steps = np.array(scores) @ inverse
    between = len(steps) / (len(steps) - 1.0) * steps.T @ steps
    correlation = noise / np.outer(size, size)
    weights = np.array([(inverse @ part @ inverse).diagonal() for part in parts])
    dof = np.maximum(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0) - 1.0, 1.0)
    ratio = between.diagonal() / correlation.diagonal()
    if not (ratio > special.chdtri(dof, 1.0 - level) / dof)[:count].any():
        return None
    values, vectors = np.linalg.eigh(between - correlation)
    beyond = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(beyond * np.outer(size, size))


def _embedded(part: FloatArray, places: NDArray[np.intp], size: int) -> FloatArray:
    whole = np.zeros((size, size))
    whole[np.ix_(places, places)] = part
    return whole

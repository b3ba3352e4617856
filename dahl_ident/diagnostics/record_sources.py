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
from dahl_ident.diagnostics.correlated_residuals import sandwich
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.elements import Parameter
from dahl_ident.errors import FitError
from dahl_ident.problem.record_problem import RecordProblem

BLOCKS = 20
"""Of all records together, from which the model error is estimated."""
_LEVEL = 0.9995  # of chance, at which scatter between blocks is not noise
_RUNS_LEVEL = 0.95  # the same between records: counted too often rather than too seldom
_STEP = 0.01  # of an exponent's logarithm, for slopes
_LONG = 0.05  # of a step of it, beyond which slopes change
_SHORT = 0.01  # of a step that is the last
_STEPS = 6
_FARTHEST = 1.0  # of the logarithm of any other value in a step
_CONTRADICTED = 3.3  # standard deviations: once in 1000 by chance


@dataclass(frozen=True)
class AssumedExponent:
    """An exponent that nobody gave, held at its default in the fit.

    Attributes
    ----------
    parameter : Parameter
    mean, std : float
        Of its logarithm over the default: what the records and its range say together.
    by_records : float
        The standard deviation that the records alone know it to.
    contribution : ndarray, shape (P, P)
        Covariance of the estimate through it: as if it were estimated too, and at least as much
        as what the records ask for moves the estimate.
    """

    parameter: Parameter
    mean: float
    std: float
    by_records: float
    contribution: FloatArray

    @property
    def name(self) -> str:
        """The parameter's name."""
        return self.parameter.name

    @property
    def contradicted(self) -> bool:
        """Whether the records ask for another value than the default."""
        return abs(self.mean) > _CONTRADICTED * self.by_records

    @property
    def found(self) -> str:
        """What the records ask for, in words."""
        value = float(self.parameter.value or 1.0) * np.exp(self.mean)
        return with_unit(value, value * self.std, self.parameter.unit)

    def __str__(self) -> str:
        low, high = self.parameter.prior or (0.0, np.inf)
        return f"{self.name} between {low:g} and {high:g} (here {self.found})"


def assumed_exponents(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> tuple[AssumedExponent, ...]:
    """Return what the records say of each exponent that nobody gave.

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
    tuple of AssumedExponent
    """
    found = []
    for parameter in problem.model.parameters:
        if parameter.free or not parameter.assumed or parameter.prior is None:
            continue
        try:
            found.append(_Search(problem, parameter, values).result(jacobians, residuals))
        except FitError:
            continue  # no motion next to the estimate
    return tuple(found)


class _Search:
    """The estimate with an exponent free, from where the exponent has its default."""

    def __init__(self, problem: RecordProblem, parameter: Parameter, values: FloatArray) -> None:
        self.problem, self.parameter, self.values = problem, parameter, values
        self.default = float(parameter.value or 1.0)
        low, high = parameter.prior or (self.default, self.default)
        self.limits = np.log([low / self.default, high / self.default])
        self.place = len(problem.free)

    def result(
        self, jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]
    ) -> AssumedExponent:
        """Return what the records say, given derivatives and residuals at the default."""
        rest = np.delete(np.arange(self.values.size + 1), self.place)
        joint = self._joint(jacobians, self.values, 0.0)
        step = _step(joint, residuals)
        normal = np.asarray(sum(J.T @ J for J in joint))
        size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        normal = normal / np.outer(size, size)
        moved = -np.linalg.pinv(normal[np.ix_(rest, rest)], hermitian=True)
        moved = moved @ normal[rest, self.place] * size[self.place] / size[rest]
        at, mean = self.values, float(step[self.place])
        if abs(mean) > _LONG:
            at, mean, joint, residuals = self._refined(step)
            moved = (at - self.values) / mean
        covariance, _ = sandwich(joint, residuals)
        beyond = between_blocks(joint, residuals, covariance, self.place + 1)
        u2 = float((covariance if beyond is None else covariance + beyond)[(self.place,) * 2])
        s = float(np.ptp(self.limits)) / 12.0**0.5
        if not np.isfinite(u2):
            mean, std = 0.0, s
        else:
            s = max(s, s**2 / max(u2, 1e-300) ** 0.5)
            weight = s**2 / (s**2 + u2)
            mean, std = mean * weight, (u2 * weight) ** 0.5
        change = moved * max(std, abs(mean))
        return AssumedExponent(self.parameter, mean, std, u2**0.5, np.outer(change, change))

    def _refined(
        self, step: FloatArray
    ) -> tuple[FloatArray, float, list[FloatArray], list[FloatArray]]:
        """Return values, the exponent's logarithm, derivatives and residuals after more steps."""
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
            step = _step(joint, left)
            if abs(float(step[self.place])) < _SHORT:
                break
        return at, mean, joint, left

    def _joint(
        self, jacobians: Sequence[FloatArray], at: FloatArray, mean: float
    ) -> list[FloatArray]:
        """Return the derivatives with respect to the parameters and the exponent's logarithm."""
        problem, name = self.problem, self.parameter.name
        ends = [
            problem.with_fixed({name: self.default * np.exp(mean + d)}) for d in (_STEP, -_STEP)
        ]
        found = []
        for i, J in enumerate(jacobians):
            high, low = (end.predict(at, i, derivatives=False).output for end in ends)
            slope = problem.filtered((high - low) / (2.0 * _STEP))
            found.append(np.insert(J, self.place, slope, axis=1))
        return found


def _step(jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> FloatArray:
    """Return the Gauss-Newton step of values."""
    normal = np.asarray(sum(J.T @ J for J in jacobians))
    size = np.sqrt(normal.diagonal())
    size = np.where(size > 0.0, size, 1.0)
    right = sum(J.T @ e for J, e in zip(jacobians, residuals, strict=True)) / size
    return np.asarray(np.linalg.pinv(normal / np.outer(size, size), hermitian=True) @ right / size)


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
    blocks = [
        (J[rows], e[rows])
        for J, e in zip(jacobians, residuals, strict=True)
        for rows in np.array_split(np.arange(e.size), max(1, round(BLOCKS * e.size / samples)))
    ]
    return _beyond(blocks, noise, count, _LEVEL)


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

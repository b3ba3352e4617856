r"""Residuals in units of the noise, and their component orthogonal to the fit.

A question such as "do the data fall with frequency against the model?" is one more column next to
those of the Jacobian: a small change u of the predicted responses, R -> R exp(gamma u). After
projection on what the parameters cannot explain, its coefficient and error follow from one inner
product; several columns together make a chi-square or F test. Nothing is fitted again.

Rows whose covariance has nu degrees of freedom follow Student's t; their residuals y are taken to
the normal ones of the same probability, |y|^2 -> (nu - 1) ln(1 + |y|^2/nu). Rows under a robust
loss enter by their scores. Residuals that are rounding errors count as none.

A force limit that differs by 5 % from day to day bends the response by second-order terms of
0.1 %, more than a quiet sensor's noise: residuals within runs are those at the run's parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.estimate import WeightedEstimate, scores_of
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.losses import loss_named
from dahl_ident.problem import TableProblem

_STEPS = 2  # of Gauss-Newton, from the linear mixed model's deviations of runs
_RANK = 1e-9  # singular value of the Jacobian, over the largest, that counts as none
_GAUSSIAN = 1e12  # degrees of freedom beyond which Student's t is the normal distribution
_NOTHING = 1e-100  # length of a column that is none
_LEFT = 1e-4  # length of a column after projection, over that before, that counts as none


@dataclass(frozen=True)
class RunDeviations:
    """How each of R runs deviates from theta."""

    labels: NDArray[np.str_]  # (R,): the runs
    # (R, Q + 2): added to the search coordinates, to ln gain, and to the phase of the fundamental
    each: FloatArray
    scatters: NDArray[np.bool_]  # (Q + 2,): which of them differ between runs


class Linearization:
    """Residuals of a problem's data, linearised at theta and the deviations of runs; no priors."""

    def __init__(self, problem: TableProblem, theta: FloatArray, runs: RunDeviations) -> None:
        self._harmonic = problem.data.harmonic
        m = problem.n_residuals
        self.residuals = np.zeros(m)  # of each run at its own parameters
        self.J = np.zeros((m, len(theta)))  # their derivatives with respect to theta
        # responses (n,), each run's at its own parameters; the same with its gain and phase
        self.predicted, self.fitted = np.zeros((2, m // 2), dtype=np.complex128)
        # problems, the rows (n,) that are theirs, and the theta of each
        self.parts: list[tuple[TableProblem, NDArray[np.bool_], FloatArray]] = []
        for label, b in zip(runs.labels, runs.each, strict=True):
            rows = np.asarray(problem.data.run) == label
            deviation = b[-2] + 1j * b[-1] * self._harmonic[rows]
            part = problem.part(rows, problem.data.response[rows] * np.exp(-deviation))
            there = np.clip(theta + b[:-2], *problem.bounds())
            both = np.repeat(rows, 2)
            at, by = part.residuals_and_jacobian(there, tails=False)
            self.residuals[both], self.J[both] = at[: part.n_residuals], by[: part.n_residuals]
            self.predicted[rows] = part.predict(there)
            self.fitted[rows] = self.predicted[rows] * np.exp(deviation)
            self.parts.append((part, rows, there))

    def of_run(self, number: int) -> tuple[NDArray[np.bool_], FloatArray]:
        """Return a run's residuals, and their derivatives with respect to its deviations."""
        problem, rows, theta = self.parts[number]
        turns = np.array([np.ones(rows.sum()), 1j * self._harmonic[rows]]) * self.predicted[rows]
        both = np.repeat(rows, 2)
        return both, np.column_stack([self.J[both], problem.residual_change(theta, turns).T])


def run_deviations(
    estimate: WeightedEstimate, mean: FloatArray, effects: FloatArray, spread: FloatArray,
    noise: float,
) -> RunDeviations | None:  # fmt: skip
    """Return how runs deviate, where each run's residuals and deviations together are least.

    None where the model has no response at the `mean`, as beyond a parameter that is hardly known.
    """
    problem, scale = estimate.problem, estimate.scale
    labels, scatters = np.unique(np.asarray(problem.data.run)), spread > 0.0
    unit, b = spread[scatters], effects.copy()
    centre = np.append(mean, [0.0, 0.0])
    for _ in range(_STEPS):
        near = Linearization(problem, estimate.theta, RunDeviations(labels, centre + b, scatters))
        if not (np.isfinite(near.residuals).all() and np.isfinite(near.J).all()):
            return None
        r = scale * scores_of(near.residuals / scale, len(near.residuals), estimate.loss)
        for i in range(len(labels)):
            both, columns = near.of_run(i)
            left = np.concatenate([r[both], noise * b[i, scatters] / unit])
            every = np.vstack([columns[:, scatters] * unit, noise * np.eye(len(unit))])
            b[i, scatters] -= unit * np.linalg.lstsq(every, left, rcond=None)[0]
    return RunDeviations(labels, centre + b, scatters)


class Coefficient(NamedTuple):
    """How far the data depart along one column, with its standard error."""

    value: float
    stderr: float


class _Complement(ABC):
    """Residuals orthogonal to the Jacobian's columns, and columns to compare them with."""

    residuals: FloatArray
    basis: FloatArray
    scale: float = 1.0  # standard deviation of one residual

    @abstractmethod
    def _raw(self, changes: ComplexArray) -> FloatArray:
        """Return the columns (k, m) of relative changes (k, n) of the predicted responses."""

    def columns(self, changes: ComplexArray) -> FloatArray:
        """Return the columns (k, m) of relative changes (k, n) of the predicted responses.

        What the parameters explain is taken out; a column of which nothing is left is zero. The
        sign is that of the data: positive where data exceed the model.
        """
        columns = self._raw(changes)
        before = np.linalg.norm(columns, axis=-1, keepdims=True)
        for _ in range(2):
            columns = columns - (columns @ self.basis) @ self.basis.T
        after = np.linalg.norm(columns, axis=-1, keepdims=True)
        return np.where(after > _LEFT * before, columns, 0.0)

    def coefficient(self, change: ComplexArray) -> Coefficient:
        """Return the coefficient of one relative change of the response, shape (n,)."""
        (column,) = self.columns(change[None])
        square = float(column @ column)
        if square == 0.0:
            return Coefficient(0.0, np.inf)
        return Coefficient(float(column @ self.residuals) / square, self.scale / square**0.5)

    def fitted(self, changes: ComplexArray) -> ComplexArray:
        """Return the relative departure of the data, shape (n,), that `changes` (k, n) explain."""
        columns = self.columns(changes)
        gamma = np.linalg.lstsq(columns.T, self.residuals, rcond=_RANK)[0]
        return np.asarray(gamma @ changes)


class RelativeSpace(_Complement):
    """ln(R/R_model) of fundamentals, neither 0, all rows alike: for the size of a departure.

    Whatever the noise model, the weights here do not depend on it, so that a departure of 30 %
    reads as one also where the data claim errors of 1 %.
    """

    def __init__(self, optimum: Optimum) -> None:
        problem, theta = optimum.problem, optimum.theta
        predicted = problem.predict(theta)
        some = (problem.data.response != 0.0) & (predicted != 0.0)
        self._rows = (problem.data.harmonic == 1) & some
        with np.errstate(divide="ignore", invalid="ignore"):
            y = np.log(problem.data.response / predicted)[self._rows]
            J = (problem.prediction_jacobian(theta) / predicted[:, None])[self._rows]
        J = J[:, [name not in problem.ranges for name in problem.names]]  # assumed ones stay
        self.basis = orthonormal(np.concatenate([J.real, J.imag]))
        r = np.concatenate([y.real, y.imag])
        self.residuals = r - self.basis @ (self.basis.T @ r)
        dof = r.size - self.basis.shape[1]
        self.scale = float(np.sqrt(self.residuals @ self.residuals / max(dof, 1)))

    def _raw(self, changes: ComplexArray) -> FloatArray:
        of_rows = changes[:, self._rows]
        return np.concatenate([of_rows.real, of_rows.imag], axis=-1)


class ResidualSpace(_Complement):
    """The residuals of an optimum in units of the noise: for whether a departure is one."""

    def __init__(
        self,
        optimum: Optimum,
        runs: RunDeviations | None = None,
        weights: WeightedEstimate | None = None,
    ) -> None:
        """Take residuals with the stated weights, or with those of an estimate.

        The size of the latter's misfit is itself an estimate, as an unknown scale is.
        """
        self._widened = weights is not None and weights.problem.has_misfit
        self._optimum, self._problem = optimum, optimum.problem
        if weights is not None and self._widened:
            self._problem = weights.problem
        self._scale_known = optimum.scale_known and not self._widened
        self.dof = optimum.dof
        m = optimum.problem.n_residuals
        scale = optimum.scale
        self._scale = scale if np.isfinite(scale) and scale > 0.0 else 1.0
        y, J = self._problem.residuals_and_jacobian(optimum.theta, self._scale, tails=False)
        of_runs = np.zeros((m, 0))
        if runs is not None:
            near = Linearization(self._problem, optimum.theta, runs)
            y[:m], J[:m] = near.residuals / self._scale, near.J / self._scale
            each = np.zeros((len(runs.labels), m, runs.scatters.sum()))
            for number, block in enumerate(each):
                both, columns = near.of_run(number)
                block[both] = columns[:, runs.scatters] / self._scale
            of_runs = np.hstack(list(each))
            self.dof -= orthonormal(np.hstack([J[:m], of_runs])).shape[1]
            self.dof += orthonormal(J[:m]).shape[1]
        self._column_weight, residual_weight = self._weights(y[:m])
        every = np.vstack(
            [np.hstack([J[:m], of_runs]), np.pad(J[m:], ((0, 0), (0, of_runs.shape[1])))]
        )
        every[:m] *= self._column_weight[:, None]
        self.basis = orthonormal(every)[:m]
        r = residual_weight * y[:m] * (not optimum.is_exact)
        self.residuals = r - self.basis @ (self.basis.T @ r)

    def _weights(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the weight of each row's columns, and that of its residuals."""
        z = np.repeat(y[0::2] ** 2 + y[1::2] ** 2, 2)
        loss, dof = loss_named(self._optimum.loss), self._problem.data.dof
        if loss is not None:
            inflation = np.sqrt(loss.inflation(z[0::2], max(self.dof, 1)))
            slope = loss.slope(z)
            spread = np.sqrt((slope**2 * z).sum() / (2.0 * max(self.dof, 1)))
            return np.full(y.shape, 1.0 / inflation), slope / (spread if spread > 0.0 else 1.0)
        if self._problem.gaussian or dof is None:
            return np.ones(y.shape), np.ones(y.shape)
        nu = np.minimum(np.repeat(dof, 2), _GAUSSIAN)
        z = np.maximum(z, 1e-300)
        weight = np.sqrt((nu + 1.0) * (nu - 1.0) / (nu * (nu + 3.0)))
        return weight, np.sqrt((nu - 1.0) * np.log1p(z / nu) / z)

    def _raw(self, changes: ComplexArray) -> FloatArray:
        theta = self._optimum.theta
        predicted = self._problem.predict(theta)
        columns = -self._problem.residual_change(theta, changes * predicted) / self._scale
        return np.asarray(columns * self._column_weight)

    def p_value(self, changes: ComplexArray) -> float:
        """Return the probability of such a departure along `changes`, (k, n), by noise alone."""
        basis = orthonormal(self.columns(changes).T)
        explained = float(np.sum((basis.T @ self.residuals) ** 2))
        return self.tail(explained, basis.shape[1])

    def tail(self, explained: float, k: int) -> float:
        """Return the probability of more than this sum of squares in `k` directions of noise."""
        return self.tail_of(explained, k, float(self.residuals @ self.residuals), self.dof)

    def tail_of(self, explained: float, k: int, total: float, dof: int) -> float:
        """Return the same where only `total`, with `dof` degrees of freedom, is left of them."""
        if k == 0:
            return np.nan
        if self._scale_known:
            return float(special.chdtrc(k, explained))
        if self._widened and (self._problem.data.harmonic != 1).any():
            total = max(total, float(dof))  # what fundamentals weigh down does not show small noise
        if dof <= k or total <= explained:
            return np.nan
        return float(special.fdtrc(k, dof - k, explained / k / ((total - explained) / (dof - k))))


def orthonormal(columns: FloatArray, least: float = _RANK) -> FloatArray:
    """Return an orthonormal basis of the column space, shape (m, rank)."""
    size = np.abs(columns).max(axis=0, initial=0.0)
    some = (size > _NOTHING) & np.isfinite(size)
    if not some.any():
        return np.zeros((len(columns), 0))
    used = columns[:, some] / size[some]  # squares of the smallest numbers would vanish
    U, singular, _ = np.linalg.svd(used / np.linalg.norm(used, axis=0), full_matrices=False)
    return np.asarray(U[:, singular > least * singular[0]])

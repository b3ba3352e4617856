r"""Residuals in units of the noise, and their component orthogonal to the fit.

A question such as "do the data fall with frequency against the model?" is one more column next to
those of the Jacobian: a small change u of the predicted responses, R -> R exp(gamma u). After its
projection onto the complement of the Jacobian's columns, which the parameters cannot explain, its
coefficient and error follow from one inner product; several columns together make a chi-square or F
test. Nothing is fitted again.

Rows whose covariance has nu degrees of freedom follow Student's t; their residuals y are mapped to
normal ones of the same probability, |y|^2 -> (nu - 1) ln(1 + |y|^2/nu). Rows under a robust
loss enter by their scores. Residuals that are rounding errors count as zero.

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

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray
from dahl_ident.diagnostics.estimate import WeightedEstimate, scores_of
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import NO_EFFECT
from dahl_ident.problem import TableProblem

_RUN_STEPS = 2  # of Gauss-Newton, from the linear mixed model's deviations of runs
_RANK = 1e-9  # singular value of the Jacobian, over the largest, that counts as zero
_GAUSSIAN = 1e12  # degrees of freedom beyond which Student's t is the normal distribution
_LEFT = 1e-4  # length of a column after projection, over that before, that counts as zero


@dataclass(frozen=True)
class RunDeviations:
    """How each of R runs deviates from theta."""

    labels: NDArray[np.str_]  # (R,): the runs
    # (R, Q + 2): added to the search coordinates, to ln gain, and to the phase of the fundamental
    each: FloatArray
    scatters: BoolArray  # (Q + 2,): which of them differ between runs


class Linearization:
    """Residuals of a problem's data, linearised at theta and the deviations of runs; no priors."""

    def __init__(self, problem: TableProblem, theta: FloatArray, runs: RunDeviations) -> None:
        self._harmonic = problem.data.harmonic
        m = problem.n_residuals
        self.residuals = np.zeros(m)  # of each run, at the parameters of that run
        self.J = np.zeros((m, len(theta)))  # their derivatives with respect to theta
        # predicted responses (n,) of each run at its parameters; the same with its gain and phase
        self.predicted, self.fitted = np.zeros((2, m // 2), dtype=np.complex128)
        # of each run: its problem, its rows (n,), and its theta
        self.parts: list[tuple[TableProblem, BoolArray, FloatArray]] = []
        for label, b in zip(runs.labels, runs.each, strict=True):
            rows = np.asarray(problem.data.run) == label
            deviation = b[-2] + 1j * b[-1] * self._harmonic[rows]
            part = problem.part(rows, problem.data.response[rows] * np.exp(-deviation))
            run_theta = np.clip(theta + b[:-2], *problem.bounds())
            both, count = np.repeat(rows, 2), part.n_residuals
            residuals, J = part.residuals_and_jacobian(run_theta, tails=False)
            self.residuals[both], self.J[both] = residuals[:count], J[:count]
            self.predicted[rows] = part.predict(run_theta)
            self.fitted[rows] = self.predicted[rows] * np.exp(deviation)
            self.parts.append((part, rows, run_theta))

    def of_run(self, number: int) -> tuple[BoolArray, FloatArray]:
        """Return which residuals belong to a run, and their derivatives.

        The derivatives are with respect to the deviations of that run.
        """
        problem, rows, theta = self.parts[number]
        changes = np.array([np.ones(rows.sum()), 1j * self._harmonic[rows]]) * self.predicted[rows]
        both = np.repeat(rows, 2)
        return both, np.column_stack([self.J[both], problem.residual_change(theta, changes).T])


def run_deviations(
    estimate: WeightedEstimate,
    mean: FloatArray,
    effects: FloatArray,
    spread: FloatArray,
    noise: float,
) -> RunDeviations | None:
    """Return the deviations of runs that minimise each run's residuals and deviations together.

    None if the model has no response at the `mean`, as may happen for a poorly known parameter.
    """
    problem, scale = estimate.problem, estimate.scale
    labels, scatters = np.unique(np.asarray(problem.data.run)), spread > 0.0
    unit, b = spread[scatters], effects.copy()
    centre = np.append(mean, [0.0, 0.0])
    for _ in range(_RUN_STEPS):
        near = Linearization(problem, estimate.theta, RunDeviations(labels, centre + b, scatters))
        if not (np.isfinite(near.residuals).all() and np.isfinite(near.J).all()):
            return None
        r = scale * scores_of(near.residuals / scale, len(near.residuals), estimate.loss)
        for i in range(len(labels)):
            both, columns = near.of_run(i)
            stacked = np.concatenate([r[both], noise * b[i, scatters] / unit])
            design = np.vstack([columns[:, scatters] * unit, noise * np.eye(len(unit))])
            b[i, scatters] -= unit * np.linalg.lstsq(design, stacked, rcond=None)[0]
    return RunDeviations(labels, centre + b, scatters)


class Coefficient(NamedTuple):
    """How far the data depart along one column, with its standard error."""

    value: float
    stderr: float


class _Complement(ABC):
    """Residuals orthogonal to the Jacobian's columns, and changes to compare them with."""

    residuals: FloatArray
    basis: FloatArray
    scale: float = 1.0  # standard deviation of one residual

    @abstractmethod
    def _raw(self, changes: ComplexArray) -> FloatArray:
        """Return the columns (k, m) of relative changes (k, n) of the predicted responses."""

    def columns(self, changes: ComplexArray) -> FloatArray:
        """Return the columns (k, m) of relative changes (k, n) of the predicted responses.

        The part that the parameters explain is removed; a column that they explain whole is zero.
        The sign is that of the data: positive where data exceed the model.
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
    """ln(R/R_model) of fundamentals with equal weights, which shows the size of a departure.

    The weights do not depend on the noise model, so that a departure of 30 % reads as 30 % even
    where the data claim errors of 1 %. Rows in which R or R_model is 0 are left out.
    """

    def __init__(self, optimum: Optimum) -> None:
        problem, theta = optimum.problem, optimum.theta
        predicted = problem.predict(theta)
        nonzero = (problem.data.response != 0.0) & (predicted != 0.0)
        self._rows = (problem.data.harmonic == 1) & nonzero
        with np.errstate(divide="ignore", invalid="ignore"):
            y = np.log(problem.data.response / predicted)[self._rows]
            J = (problem.prediction_jacobian(theta) / predicted[:, None])[self._rows]
        J = J[:, [name not in problem.ranges for name in problem.names]]  # assumed ones are fixed
        self.basis = orthonormal(np.concatenate([J.real, J.imag]))
        r = np.concatenate([y.real, y.imag])
        self.residuals = r - self.basis @ (self.basis.T @ r)
        dof = r.size - self.basis.shape[1]
        self.scale = float(np.sqrt(self.residuals @ self.residuals / max(dof, 1)))

    def _raw(self, changes: ComplexArray) -> FloatArray:
        of_rows = changes[:, self._rows]
        return np.concatenate([of_rows.real, of_rows.imag], axis=-1)


class ResidualSpace(_Complement):
    """Residuals of an optimum in units of the noise, which show if a departure is significant."""

    def __init__(
        self,
        optimum: Optimum,
        runs: RunDeviations | None = None,
        weights: WeightedEstimate | None = None,
    ) -> None:
        """Weigh residuals by the stated noise, or as an estimate does that allows for a misfit.

        The size of a misfit is itself estimated, as an unknown scale is.
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
                both, by_deviations = near.of_run(number)
                block[both] = by_deviations[:, runs.scatters] / self._scale
            of_runs = np.hstack(list(each))
            self.dof -= orthonormal(np.hstack([J[:m], of_runs])).shape[1]
            self.dof += orthonormal(J[:m]).shape[1]
        self._column_weight, residual_weight = self._weights(y[:m])
        columns = np.vstack(
            [np.hstack([J[:m], of_runs]), np.pad(J[m:], ((0, 0), (0, of_runs.shape[1])))]
        )
        columns[:m] *= self._column_weight[:, None]
        self.basis = orthonormal(columns)[:m]
        r = residual_weight * y[:m] * (not optimum.is_exact)
        self.residuals = r
        if optimum.constraint_cost is None:  # with constraints, parameters would explain more
            self.residuals = r - self.basis @ (self.basis.T @ r)

    def _weights(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the weights of each row in the columns, and in the residuals."""
        z = np.repeat(y[0::2] ** 2 + y[1::2] ** 2, 2)
        loss, dof = loss_named(self._optimum.loss), self._problem.data.dof
        if loss is not None:
            inflation = np.sqrt(loss.inflation(z[0::2], max(self.dof, 1)))
            slope = loss.slope(z)
            spread = np.sqrt((slope**2 * z).sum() / (2.0 * max(self.dof, 1)))
            return np.full(y.shape, 1.0 / (inflation or 1.0)), slope / (spread or 1.0)
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
        """Return the probability that noise alone departs so far along `changes`, (k, n)."""
        basis = orthonormal(self.columns(changes).T)
        explained = float(np.sum((basis.T @ self.residuals) ** 2))
        return self.tail(explained, basis.shape[1])

    def tail(self, explained: float, k: int) -> float:
        """Return the probability that noise has more than this sum of squares in `k` directions."""
        return self.tail_of(explained, k, float(self.residuals @ self.residuals), self.dof)

    def tail_of(self, explained: float, k: int, total: float, dof: int) -> float:
        """Return the same for residuals of the sum of squares `total`, of `dof` dof."""
        if k == 0:
            return np.nan
        if self._scale_known:
            return float(special.chdtrc(k, explained))
        if self._widened and (self._problem.data.harmonic != 1).any():
            # harmonics that the fundamentals' misfit weighs down do not show small noise
            total = max(total, float(dof))
        if dof <= k or total <= explained:
            return np.nan
        return float(special.fdtrc(k, dof - k, explained / k / ((total - explained) / (dof - k))))


def orthonormal(columns: FloatArray, least: float = _RANK) -> FloatArray:
    """Return an orthonormal basis of the column space, shape (m, rank)."""
    size = np.abs(columns).max(axis=0, initial=0.0)
    nonzero = (size > NO_EFFECT) & np.isfinite(size)
    if not nonzero.any():
        return np.zeros((len(columns), 0))
    used = columns[:, nonzero] / size[nonzero]  # squares of very small numbers underflow
    U, singular, _ = np.linalg.svd(used / np.linalg.norm(used, axis=0), full_matrices=False)
    return np.asarray(U[:, singular > least * singular[0]])

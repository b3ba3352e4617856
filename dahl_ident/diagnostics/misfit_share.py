r"""The estimate: weighted least squares, with one misfit in addition to the stated covariance.

A row of the covariance C and the fundamental force F_1 of its test counts as one of the covariance

    C + s^2 |F_1|^2,

the misfit s the same for all rows and harmonics, and such that chi-square equals its degrees of
freedom: zero where the model describes the data. So harmonics of tiny covariances cannot pull the
estimate from the fundamentals. Where no covariance is stated, the noise's scale takes its place.
Priors of sensors and ranges of assumed exponents are further rows. Source: Paule and Mandel,
Journal of Research of the National Bureau of Standards 87 (1982) 377.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.determined_directions import Basis
from dahl_ident.problem import Problem

_STEPS = 60  # Gauss-Newton steps; five are the rule
_SETTLED = 1e-5  # of a standard deviation that a step still moves the estimate
_LONGEST_STEP = 0.7  # of a logarithm, in one step: the model is linearised
_HALVINGS = 8  # of a step, until the sum of squares falls
_ROOT_STEPS = 200  # Newton's, from below, for the misfit: it doubles where it is far off
_LEAST_LEFT = 1e-3  # of a test, that the others do not determine
_SAME = 1e-9  # relative change of the misfit's square that no longer counts

Rows = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Residuals (M,) and their derivatives (M, Q) at theta: data first, then priors of unit variance"""


@dataclass(frozen=True)
class WeightedEstimate:
    """Weighted least squares.

    Attributes
    ----------
    theta : ndarray, shape (Q,)
        The estimate, search coordinates.
    misfit : float
        Share s of the fundamental force of a row's test.
    factors : ndarray, shape (n, 2, 2)
        What takes each row's residuals to unit variance.
    """

    theta: FloatArray
    misfit: float
    factors: FloatArray

    def weighted(self, rows: FloatArray) -> FloatArray:
        """Return residuals (M,), or columns (M, q), with their weights."""
        return _weighted(self.factors, rows)

    def lever(self, J: FloatArray, kept: NDArray[np.bool_] | None = None) -> FloatArray:
        """Return G = (J' W J)^-1 J' W, shape (q, M), for columns J (M, q), of the rows `kept`."""
        own = self.weighted(J)
        if kept is not None:
            own = own * kept[:, None]
        Q, R = np.linalg.qr(own)
        found = np.linalg.solve(R, Q.T)
        return _weighted(self.factors.swapaxes(1, 2), found.T).T

    def jackknife(
        self,
        J: FloatArray,
        y: FloatArray,
        tests: Sequence[NDArray[np.intp]],
        bounds: tuple[FloatArray, FloatArray],
    ) -> FloatArray:
        """Return the covariance of theta by leaving out each test, (Q, Q), to first order.

        Each counts with the root of its leverage, so that the sum is without bias where the
        weights are right. Source: Wu, Annals of Statistics 14 (1986) 1261.
        """
        J, y = self.weighted(J), self.weighted(y)
        Q, R = np.linalg.qr(J)
        moves = []
        for size in {len(rows) for rows in tests}:
            rows = np.array([rows for rows in tests if len(rows) == size])
            own = (2 * rows[:, :, None] + np.arange(2)).reshape(len(rows), -1)
            left, turn = np.linalg.eigh(np.eye(2 * size) - Q[own] @ Q[own].swapaxes(1, 2))
            along = np.einsum("bij,bi->bj", turn, y[own]) / np.sqrt(np.maximum(left, _LEAST_LEFT))
            moves.append(np.einsum("biq,bij,bj->bq", Q[own], turn, along))
        each = np.linalg.solve(R, np.concatenate(moves).T).T
        low, high = (bound - self.theta for bound in bounds)
        each = np.clip(each, low, high)
        return np.asarray(each.T @ each)


def weighted_estimate(
    problem: Problem,
    rows: Rows,
    theta: FloatArray,
    dof: int,
    basis: Basis | None = None,
) -> WeightedEstimate:
    """Return the estimate, searched from theta.

    Parameters
    ----------
    problem : Problem
        Its noise is that of the rows.
    rows : callable
        Returns residuals and derivatives.
    theta : ndarray, shape (Q,)
        Where to start.
    dof : int
        Degrees of freedom: of the data where their scale is unknown, else those of priors too.
    basis : Basis, optional
        Directions that the data determine, where these are not all.

    Returns
    -------
    WeightedEstimate
    """
    m = problem.n_residuals
    y, J = rows(theta)
    for _ in range(_STEPS):
        misfit, factors = _weights(problem, theta, y, m, dof)
        columns = J if basis is None else J @ basis.at(theta).matrix
        weighted, residuals = _weighted(factors, columns), _weighted(factors, y)
        step = np.linalg.lstsq(weighted, -residuals, rcond=1e-13)[0]
        size = np.linalg.norm(weighted @ step)
        if not np.isfinite(size):
            raise np.linalg.LinAlgError("no finite step from the estimate")
        if size < _SETTLED:
            break
        cost, length = float(residuals @ residuals), 1.0
        for _ in range(_HALVINGS):
            trial = _moved(problem, theta, np.asarray(length * step), basis)
            other, by = rows(trial)
            value = _weighted(factors, other)
            if np.isfinite(value).all() and value @ value < cost:
                break
            length *= 0.5
        else:
            break
        theta, y, J = trial, other, by
    return WeightedEstimate(theta, misfit, factors)


def fundamental_size(data: FrequencyResponse) -> FloatArray:
    """Return the size of the measured fundamental of each row's test, (n,)."""
    size, first = np.abs(data.response), data.harmonic == 1
    if first.all() or not first.any():
        return size
    held = np.ones(data.n) if data.amplitude is None else data.amplitude
    _, test = np.unique(np.column_stack([data.frequency_hz, held]), axis=0, return_inverse=True)
    total, count = (np.bincount(test.ravel(), w) for w in (np.where(first, size, 0.0), first))
    mean = np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)
    found = np.where(first, size, mean[test.ravel()])
    return np.asarray(np.where(np.isnan(found), size, found))


def _weights(
    problem: Problem, theta: FloatArray, y: FloatArray, m: int, dof: int
) -> tuple[float, FloatArray]:
    """Return the misfit, and the factors of the weights."""
    n = m // 2
    if not problem.scale_known:
        scale = max(float(np.sqrt(y[:m] @ y[:m] / max(dof, 1))), float(problem.rounding), 1e-300)
        return 0.0, np.broadcast_to(np.eye(2) / scale, (n, 2, 2))
    target = dof - float(y[m:] @ y[m:])
    if dof <= 0 or target <= 0.0 or y[:m] @ y[:m] <= target:
        return 0.0, np.broadcast_to(np.eye(2), (n, 2, 2))
    size = fundamental_size(problem.data)
    both = np.asarray(size[None] * np.array([[1.0], [1.0j]]), dtype=np.complex128)
    D = problem.residual_change(theta, both)
    D = D.reshape(2, n, 2).transpose(1, 2, 0)
    b, turn = np.linalg.eigh(D @ D.swapaxes(1, 2))
    z = np.einsum("nji,nj->ni", turn, y[:m].reshape(n, 2)) ** 2
    square = _root(z.ravel(), np.maximum(b, 0.0).ravel(), target)
    small = 1.0 / np.sqrt(1.0 + square * np.maximum(b, 0.0))
    return float(np.sqrt(square)), np.asarray(small[:, :, None] * turn.swapaxes(1, 2))


def _root(z: FloatArray, b: FloatArray, target: float) -> float:
    """Return x with sum z/(1 + b x) = target; the sum falls and is convex."""
    x = 0.0
    fixed = float(z[b == 0.0].sum())
    if fixed >= target:
        raise np.linalg.LinAlgError("no misfit makes these residuals as small as their covariance")
    for _ in range(_ROOT_STEPS):
        parts = z / (1.0 + b * x)
        excess = float(parts.sum()) - target
        slope = float((parts * b / (1.0 + b * x)).sum())
        step = excess / slope if slope > 0.0 else 0.0
        x += step
        if step <= _SAME * x:
            break
    return x


def _weighted(factors: FloatArray, rows: FloatArray) -> FloatArray:
    m = 2 * len(factors)
    own = rows[:m].reshape(len(factors), 2, -1)
    return np.concatenate([(factors @ own).reshape(rows[:m].shape), rows[m:]])


def _moved(
    problem: Problem, theta: FloatArray, step: FloatArray, basis: Basis | None
) -> FloatArray:
    def part(move: FloatArray) -> float:
        return min(1.0, _LONGEST_STEP / max(float(np.abs(move).max()), 1e-300))

    low, high = problem.bounds()
    if basis is None:
        return np.clip(theta + step * part(step), low, high)
    return np.clip(basis.at(theta).moved(theta, step, part), low, high)

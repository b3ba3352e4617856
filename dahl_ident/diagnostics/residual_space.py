r"""Residuals as unit vectors of noise, with what the fit has taken out of them.

A question such as "do the data fall with frequency against the model?" is one more column beside
those of the Jacobian: a small change u of the predicted responses, R -> R exp(gamma u). After
projection on what the parameters cannot explain, its coefficient and error follow from one inner
product; several columns together make a chi-square or F test. Nothing is fitted again.

Rows whose covariance has few degrees of freedom, and rows under a robust loss, enter by their
scores, with the weight that the likelihood (or the loss) gives them.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.losses import loss_named

_RANK = 1e-9  # singular value of the Jacobian, over the largest, that counts as none
_LEFT = 1e-4  # length of a column after projection, over that before, that counts as none


class Coefficient(NamedTuple):
    """How far the data depart along one column, with its standard error."""

    value: float
    stderr: float


class ResidualSpace:
    """The residuals of an optimum, orthogonal to its Jacobian, in units of the noise."""

    def __init__(self, optimum: Optimum) -> None:
        self._optimum, self._problem = optimum, optimum.problem
        self.dof = optimum.dof
        m = optimum.problem.n_residuals
        weight, score = self._weights(m)
        y, J = self._rows
        self.residuals = score * y[:m]
        self._column_weight = weight
        rows = np.vstack([weight[:, None] * J[:m], J[m:]])
        self.basis = _orthonormal(rows)[:m]

    @cached_property
    def _rows(self) -> tuple[FloatArray, FloatArray]:
        """Residuals and Jacobian in units of the noise."""
        scale = self._scale
        return self._problem.residuals_and_jacobian(self._optimum.theta, scale, tails=False)

    @property
    def _scale(self) -> float:
        scale = self._optimum.scale
        return scale if np.isfinite(scale) and scale > 0.0 else 1.0

    def _weights(self, m: int) -> tuple[FloatArray, FloatArray]:
        """Return the weight of each row's columns, and that of its residuals."""
        y = self._rows[0][:m]
        z = np.repeat(y[0::2] ** 2 + y[1::2] ** 2, 2)
        loss, dof = loss_named(self._optimum.loss), self._problem.data.dof
        if loss is not None:
            inflation = np.sqrt(loss.inflation(z[0::2], max(self.dof, 1)))
            slope = loss.slope(z)
            spread = np.sqrt((slope**2 * z).sum() / (2.0 * max(self.dof, 1)))
            return np.full(m, 1.0 / inflation), slope / (spread if spread > 0.0 else 1.0)
        if self._problem.gaussian or dof is None:
            return np.ones(m), np.ones(m)
        nu = np.minimum(np.repeat(dof, 2), 1e15)
        weight = np.sqrt((nu + 1.0) * (nu - 1.0) / (nu * (nu + 3.0)))
        return weight, (nu + 1.0) / (nu + z) / weight

    def columns(self, changes: ComplexArray) -> FloatArray:
        """Return the columns (k, m) of relative changes (k, n) of the predicted responses.

        What the parameters explain is taken out; a column of which nothing is left is zero. The
        sign is that of the data: positive where data exceed the model.
        """
        theta = self._optimum.theta
        predicted = self._problem.predict(theta)
        columns = -self._problem.residual_change(theta, changes * predicted) / self._scale
        columns = columns * self._column_weight
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
        return Coefficient(float(column @ self.residuals) / square, square**-0.5)

    def fitted(self, changes: ComplexArray) -> ComplexArray:
        """Return the relative departure of the data, shape (n,), that `changes` (k, n) explain."""
        columns = self.columns(changes)
        gamma = np.linalg.lstsq(columns.T, self.residuals, rcond=_RANK)[0]
        return np.asarray(gamma @ changes)

    def p_value(self, changes: ComplexArray) -> float:
        """Return how likely noise alone gives as much departure along `changes`, (k, n)."""
        basis = _orthonormal(self.columns(changes).T)
        k = basis.shape[1]
        if k == 0:
            return np.nan
        explained = float(np.sum((basis.T @ self.residuals) ** 2))
        return self.tail(explained, k)

    def tail(self, explained: float, k: int) -> float:
        """Return the probability of more than this sum of squares in `k` directions of noise."""
        return self.tail_of(explained, k, float(self.residuals @ self.residuals), self.dof)

    def tail_of(self, explained: float, k: int, total: float, dof: int) -> float:
        """Return the same where only `total`, with `dof` degrees of freedom, is left of them."""
        if self._optimum.scale_known:
            return float(special.chdtrc(k, explained))
        if dof <= k or total <= explained:
            return np.nan
        return float(special.fdtrc(k, dof - k, explained / k / ((total - explained) / (dof - k))))


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the column space, shape (m, rank)."""
    size = np.linalg.norm(columns, axis=0)
    used = columns[:, (size > 0.0) & np.isfinite(size)]
    if used.shape[1] == 0:
        return np.zeros((len(columns), 0))
    U, singular, _ = np.linalg.svd(used / np.linalg.norm(used, axis=0), full_matrices=False)
    return np.asarray(U[:, singular > _RANK * singular[0]])

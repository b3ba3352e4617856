"""scipy's trust-region reflective algorithm on the residuals of a problem, within its bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.losses import Loss
from dahl_ident.noise import bend
from dahl_ident.problem import Problem

_TOLERANCE = 1e-14
_EVALUATIONS = 1000


@dataclass(frozen=True)
class BoundedMinimum:
    """Where a bounded search ended."""

    theta: FloatArray
    cost: float
    converged: bool
    evaluations: int


def minimise_within(
    problem: Problem, start: FloatArray, scale: float, loss: Loss | None
) -> BoundedMinimum:
    """Return the minimum of the cost between the problem's bounds, from one start, shape (P,)."""
    rows = _Rows(problem, scale, loss)
    if not np.isfinite(rows.residuals(start)).all():
        return BoundedMinimum(start, np.inf, False, 1)
    with np.errstate(all="ignore"):
        found = optimize.least_squares(
            rows.residuals, start, rows.jacobian, bounds=problem.bounds(), x_scale="jac",
            ftol=_TOLERANCE, xtol=_TOLERANCE, gtol=_TOLERANCE, max_nfev=_EVALUATIONS,
        )  # fmt: skip
    return BoundedMinimum(found.x, float(found.cost), found.status > 0, int(found.nfev))


class _Rows:
    """Residuals and Jacobian by separate calls, as scipy wants them, evaluated together."""

    def __init__(self, problem: Problem, scale: float, loss: Loss | None) -> None:
        self._problem, self._scale, self._loss = problem, scale, loss
        self._theta = np.full(len(problem.parameters), np.nan)
        self._pair: tuple[FloatArray, FloatArray] = (self._theta, self._theta)

    def residuals(self, theta: FloatArray) -> FloatArray:
        return self._at(theta)[0]

    def jacobian(self, theta: FloatArray) -> FloatArray:
        return self._at(theta)[1]

    def _at(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not np.array_equal(theta, self._theta):
            self._theta = theta.copy()
            self._pair = self._evaluate(self._theta)
        return self._pair

    def _evaluate(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = self._bent(theta)
        if not np.isfinite(J).all():
            r = np.full(r.shape, np.nan)  # a step that scipy takes back
        return r, J

    def _bent(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals and Jacobian of which half the sum of squares is the cost."""
        r, J = self._problem.residuals_and_jacobian(theta, self._scale, tails=self._loss is None)
        if self._loss is None:
            return r, J
        m = self._problem.n_residuals
        y = np.ascontiguousarray(r[:m]).view(np.complex128)
        changes = [np.ascontiguousarray(column).view(np.complex128) for column in J[:m].T]
        y, changes = bend(y, changes, self._loss)
        r[:m] = y.view(np.float64)
        J[:m] = np.array(changes).view(np.float64).T
        return r, J

"""`scipy.optimize.least_squares` on the residuals and the Jacobian of a problem."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.asymptotes import Chart
from dahl_ident.fitting.levenberg_marquardt import Minima
from dahl_ident.fitting.losses import Loss
from dahl_ident.noise import bend
from dahl_ident.problem import BaseProblem

_COST, _STEP, _SLOPE = 1e-13, 1e-10, 1e-14  # relative changes that end a search
_EVALUATIONS = 300  # a limit for searches that do not end


def minimise_by_scipy(
    problem: BaseProblem,
    start: FloatArray,
    scale: float,
    loss: Loss | None,
    chart: Chart | None = None,
) -> Minima:
    """Return the minimum of one table's cost between its bounds, from one start, shape (P,).

    The trust-region reflective algorithm. In a `chart`, from phi and without bounds.
    """
    from scipy import optimize

    rows = _Rows(problem, scale, loss, chart)
    bounds = problem.bounds() if chart is None else (-np.inf, np.inf)
    converged, nfev, cost, at = False, 1, np.inf, start
    if np.isfinite(rows.residuals(start)).all():
        with np.errstate(all="ignore"):
            found = optimize.least_squares(
                rows.residuals, start, rows.jacobian, bounds=bounds, x_scale="jac",
                ftol=_COST, xtol=_STEP, gtol=_SLOPE, max_nfev=_EVALUATIONS,
            )  # fmt: skip
        at, converged, nfev = np.asarray(found.x), found.status > 0, int(found.nfev)
    theta = at if chart is None else chart.theta(at)
    slopes = None if chart is None else chart.derivative(theta)
    there = problem.quadratic(theta, scale, loss, slopes)
    cost = float(there.cost) if nfev > 1 or converged else np.inf
    return Minima(
        at[None],
        np.array([cost]),
        there.hessian[None],
        np.array([converged]),
        np.array([nfev]),
    )


class _Rows:
    """Residuals and Jacobian by separate calls, as scipy wants them, evaluated together."""

    def __init__(
        self, problem: BaseProblem, scale: float, loss: Loss | None, chart: Chart | None
    ) -> None:
        self._problem, self._scale, self._loss, self._chart = problem, scale, loss, chart
        self._logarithmic = problem.space.positive
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
        chart = self._chart
        at = theta if chart is None else chart.theta(theta)
        values = self._problem.to_values(at)
        if not np.isfinite(values).all() or (values[self._logarithmic] == 0.0).any():
            m = self._problem.n_residuals + len(self._problem.priors)
            return np.full(m, np.nan), np.full((m, theta.size), np.nan)
        r, J = self._weighted(at)
        if chart is not None:
            J = J @ chart.derivative(at)
        if not np.isfinite(J).all():
            r = np.full(r.shape, np.nan)  # a step that scipy takes back
        return r, J

    def _weighted(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals and Jacobian of which half the sum of squares is the cost."""
        r, J = self._problem.residuals_and_jacobian(theta, self._scale, tails=self._loss is None)
        if self._loss is None:
            return r, J
        m = self._problem.n_residuals
        rows = np.column_stack([r[:m], J[:m]]).T  # of two residuals a row, or of one
        pairs = rows[:, ::2] + 1j * rows[:, 1::2] if self._problem.parts == 2 else rows + 0j
        y, changes = bend(pairs[0], list(pairs[1:]), self._loss)
        bent = np.array([y, *changes]).view(np.float64)[:, :: 3 - self._problem.parts]
        r[:m], J[:m] = bent[0], bent[1:].T
        return r, J

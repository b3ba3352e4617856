"""`scipy.optimize.least_squares` on the residuals and the Jacobian of a problem."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.asymptotes import Chart
from dahl_ident.fitting.levenberg_marquardt import Minima
from dahl_ident.fitting.losses import Loss
from dahl_ident.noise import bend
from dahl_ident.problem import Problem

_COST, _STEP, _SLOPE = 1e-13, 1e-10, 1e-14  # relative changes that end a search
_EVALUATIONS = 300  # a limit for searches that do not end


def minimise_by_scipy(
    problem: Problem,
    start: FloatArray,
    scale: float,
    loss: Loss | None,
    chart: Chart | None = None,
) -> Minima:
    """Return the minimum of one table's cost between its bounds, from one start, shape (P,).

    The trust-region reflective algorithm. In a `chart`, from phi and without bounds.
    """
    from scipy import optimize

    rows = _rows(problem, scale, loss, chart)

    def residuals(at: FloatArray) -> FloatArray:
        return rows(at)[0]

    def jacobian(at: FloatArray) -> FloatArray:
        return rows(at)[1]

    bounds = problem.bounds() if chart is None else (-np.inf, np.inf)
    converged, nfev, cost, at = False, 1, np.inf, start
    if np.isfinite(residuals(start)).all():
        with np.errstate(all="ignore"):
            end = optimize.least_squares(
                residuals, start, jacobian, bounds=bounds, x_scale="jac",
                ftol=_COST, xtol=_STEP, gtol=_SLOPE, max_nfev=_EVALUATIONS,
            )  # fmt: skip
        at, converged, nfev = np.asarray(end.x), end.status > 0, int(end.nfev)
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


def _rows(
    problem: Problem, scale: float, loss: Loss | None, chart: Chart | None
) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """Return residuals and Jacobian, of which half the sum of squares is the cost, of a theta.

    scipy asks for one and then for the other: the last place is kept.
    """
    last: dict[bytes, tuple[FloatArray, FloatArray]] = {}
    m = problem.n_residuals

    def rows(phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = phi.tobytes()
        if key not in last:
            last.clear()
            last[key] = evaluated(phi)
        return last[key]

    def evaluated(phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        at = phi if chart is None else chart.theta(phi)
        values = problem.to_values(at)
        if not np.isfinite(values).all() or (values[problem.space.positive] == 0.0).any():
            size = m + len(problem.priors)
            return np.full(size, np.nan), np.full((size, phi.size), np.nan)
        both = problem.rows(at, scale, tails=loss is None)
        if loss is not None:
            both = bend(both, m, loss, problem.parts)
        r, J = both[0], both[1:].T
        if chart is not None:
            J = J @ chart.derivative(at)
        if not np.isfinite(J).all():
            r = np.full(r.shape, np.nan)  # a step that scipy takes back
        return r, J

    return rows

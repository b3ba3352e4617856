"""Least squares for many tables at once: fleets of mechanisms, bootstrap replicates.

The steps are those of :mod:`dahl_ident.fitting.least_squares`, each taken by all tables together:
one start a table, Levenberg and Marquardt's method, and for the tables that did not converge or
that leave friction badly determined the valleys and limits. The few that then still have no end
are solved one by one, as are all where there are bounds, or a prior beside noise of unknown scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Dahl
from dahl_ident.errors import ValidationError
from dahl_ident.fitting.least_squares import (
    AT_LIMIT,
    DOUBTFUL,
    FIRST_LOOK,
    HOPELESS,
    SAME,
    TIE,
    solve,
)
from dahl_ident.fitting.levenberg_marquardt import NEARLY, IntArray, Minima, minimise
from dahl_ident.fitting.limits import Chart, Limit, Reach, limits, stiffness_valleys, valleys
from dahl_ident.fitting.optimum import Optimum, OptimumBatch, estimated_scale, inverse, spread
from dahl_ident.fitting.start import best_starts, edge_starts, grid_size
from dahl_ident.fitting.status import Status
from dahl_ident.problem import ProblemBatch, Quadratic

_ROWS_AT_ONCE = 16384  # of data: their intermediate arrays stay in the processor's cache
_CURVES_AT_ONCE = 2**20  # rows of data times nodes of the grid where starts are searched
_LOOSENESS = 30.0  # a step of 3e-7 standard deviations no longer matters


def solve_many(batch: ProblemBatch, *, start: ArrayLike | None = None) -> OptimumBatch:
    """Return the optimum of every table of a batch.

    Parameters
    ----------
    batch : ProblemBatch
        What to solve.
    start : array_like, shape (P,) or (S, P), optional
        Search coordinates to start from, such as the optimum that replicates were drawn from;
        left out, every table finds its own start.

    Returns
    -------
    OptimumBatch
        What a table at a limit determines is found by :func:`solve` on ``batch.table(index)``.

    Raises
    ------
    FitError
        If there are fewer residuals than parameters, or a parameter cannot be started.
    ValidationError
        If `start` has the wrong shape, or a prior is not normal.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.data import FrequencyResponse
    >>> A = np.geomspace(1e-4, 1e-2, 5)
    >>> tables = [
    ...     FrequencyResponse(np.ones(5), Dahl(f, 30.0).describing_function(A), A)
    ...     for f in (0.1, 0.2)
    ... ]
    >>> solve_many(ProblemBatch(tables, Dahl())).values.round(6).tolist()
    [[0.1, 30.0], [0.2, 30.0]]
    """
    S, P = batch.n_tables, len(batch.parameters)
    begin = None
    if start is not None:
        begin = np.asarray(start, dtype=np.float64)
        if begin.shape not in ((P,), (S, P)):
            raise ValidationError(
                f"start has shape {begin.shape}; expected ({P},) or ({S}, {P}) for "
                f"{', '.join(batch.names)}"
            )
        begin = np.broadcast_to(begin, (S, P))
    singly = np.isfinite(batch.bounds()).any() or (batch.priors and not batch.scale_known)
    rows = batch.n_residuals // 2
    at_once = min(_ROWS_AT_ONCE, _CURVES_AT_ONCE // grid_size(batch.take(slice(0, 1))))
    size = 1 if singly else max(1, at_once // rows)
    parts = []
    for first in range(0, S, size):
        chunk = slice(first, first + size)
        if singly:
            parts.append(_as_part(solve(batch.table(first))))
        else:
            parts.append(_solve(batch.take(chunk), None if begin is None else begin[chunk]))
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("theta", "values", "covariance", "scale", "dof", "cost", "nfev")
    }
    status = tuple(status for part in parts for status in part.status)
    return OptimumBatch(batch, status=status, scale_known=batch.scale_known, **joined)


@dataclass
class _Part:
    """The optima of some tables."""

    theta: FloatArray
    values: FloatArray
    covariance: FloatArray
    scale: FloatArray
    dof: IntArray
    cost: FloatArray
    nfev: IntArray
    status: list[Status]

    def put(self, tables: IntArray, other: _Part) -> None:
        """Replace the optima of `tables`."""
        for name in ("theta", "values", "covariance", "scale", "dof", "cost", "nfev"):
            getattr(self, name)[tables] = getattr(other, name)
        for table, status in zip(tables, other.status, strict=True):
            self.status[table] = status


def _as_part(optimum: Optimum) -> _Part:
    """Return one optimum as a part of one table."""
    return _Part(
        optimum.theta[None],
        optimum.values[None],
        optimum.covariance[None],
        np.array([optimum.scale]),
        np.array([optimum.dof]),
        np.array([optimum.cost]),
        np.array([optimum.nfev]),
        [optimum.status],
    )


def _solve(batch: ProblemBatch, begin: FloatArray | None) -> _Part:
    minima = _descend(batch, best_starts(batch) if begin is None else begin)
    part = _finite(batch, minima)
    doubtful = np.flatnonzero(~minima.converged | (_friction_error(part, batch) > DOUBTFUL))
    if doubtful.size:
        part.put(doubtful, _look_wider(batch.take(doubtful), minima.take(doubtful)))
    lost = [index for index, status in enumerate(part.status) if status is Status.NOT_CONVERGED]
    for index in lost:
        part.put(np.array([index]), _as_part(solve(batch.table(index))))
    return part


def _descend(
    batch: ProblemBatch,
    begin: FloatArray,
    chart: Chart | None = None,
    looseness: float = _LOOSENESS,
    steps: int = 80,
) -> Minima:
    """Return the ends of all tables' searches, by phi in a chart where one is given."""
    logarithmic = np.array([p.transform == "log" for p in batch.parameters])
    reach, m = Reach(batch), batch.n_residuals + len(batch.priors)

    def evaluate(theta: FloatArray, which: IntArray | None) -> Quadratic:
        return (batch if which is None else batch.take(which)).quadratic(theta)

    if chart is None:
        return minimise(evaluate, begin, logarithmic, m, inside=reach, looseness=looseness)

    def evaluate_in_chart(phi: FloatArray, which: IntArray | None) -> Quadratic:
        part, own = (batch, chart) if which is None else (batch.take(which), chart.of(which))
        theta = own.theta(phi)
        return part.quadratic(theta, chart=own.derivative(theta))

    logarithmic, phi = ~((chart.matrix != 0.0).T @ ~logarithmic), chart.phi(begin)
    return minimise(evaluate_in_chart, phi, logarithmic, m, looseness=looseness, steps=steps)


def _look_wider(batch: ProblemBatch, end: Minima) -> _Part:
    """Return the best of the ends found, of the valleys' and of the limits."""
    begins = [end.theta, best_starts(batch)]
    end = end.better(_descend(batch, begins[1]))
    for chart in (*valleys(batch), *stiffness_valleys(batch)):
        for begin in begins:
            found = _descend(batch, begin, chart)
            theta = chart.theta(found.theta)
            hessian = batch.quadratic(theta).hessian
            inside = found.converged & Reach(batch)(theta)
            end = end.better(Minima(theta, found.cost, hessian, inside, found.evaluations))
    part = _finite(batch, end)
    real = end.converged & np.isfinite(_friction_error(part, batch))
    ceiling = end.cost * (1.0 + np.where(real, TIE, NEARLY))
    edges = [end.theta, *edge_starts(batch)]
    for limit in sorted(limits(batch), key=lambda lim: lim.chart.matrix.shape[1]):
        found = _descend_at_limit(batch, edges, limit.chart, end.cost * HOPELESS)
        wins = np.flatnonzero(found.converged & (found.cost <= ceiling))
        if wins.size:
            ceiling[wins] = found.cost[wins] * (1.0 - SAME)  # for limits with more parameters
            part.put(wins, _at_limit(batch.take(wins), limit, wins, found.take(wins)))
    return part


def _descend_at_limit(
    batch: ProblemBatch, edges: list[FloatArray], chart: Chart, hopeless: FloatArray
) -> Minima:
    """Return the best ends of searches in a limit's chart, left early above a `hopeless` cost."""
    looks = [_descend(batch, begin, chart, AT_LIMIT, FIRST_LOOK) for begin in edges]
    found = looks[0]
    for other in looks[1:]:
        found = found.lower(other)
    further = np.flatnonzero(~found.converged & (found.cost < hopeless))
    if further.size:
        own = chart.of(further)
        begin = own.theta(found.theta[further])
        found.put(further, _descend(batch.take(further), begin, own, AT_LIMIT))
    return found


def _finite(batch: ProblemBatch, minima: Minima) -> _Part:
    """Return optima at finite parameters."""
    theta, hessian = batch.in_order(minima.theta), minima.hessian
    if theta is not minima.theta or not batch.gaussian:
        hessian = batch.information(theta)
    covariance, undetermined = inverse(hessian)
    dof = np.full(len(theta), batch.n_residuals + len(batch.priors) - theta.shape[1])
    scale = _scale(batch, minima.cost, dof)
    singular = np.asarray(undetermined.any(axis=1))
    return _Part(
        theta,
        batch.to_values(theta),
        np.where(np.isinf(covariance), np.inf, covariance * scale[:, None, None] ** 2),
        scale,
        dof,
        minima.cost,
        minima.evaluations,
        [_status(*pair) for pair in zip(minima.converged, singular, strict=True)],
    )


def _status(converged: bool, singular: bool) -> Status:
    if not converged:
        return Status.NOT_CONVERGED
    return Status.SINGULAR if singular else Status.CONVERGED


def _at_limit(batch: ProblemBatch, limit: Limit, tables: IntArray, minima: Minima) -> _Part:
    """Return optima at a limit; `tables` are their places in the limit's batch."""
    chart = limit.chart.of(tables)
    theta = chart.theta(minima.theta)
    T = chart.derivative(theta)
    inner, lost = inverse(minima.hessian)
    covariance, _ = spread(limit, T, inner, lost)
    dof = np.full(len(theta), batch.n_residuals + len(batch.priors) - minima.theta.shape[1])
    scale = _scale(batch, minima.cost, dof)
    values = batch.to_values(theta)
    for name, extreme in limit.extremes.items():
        values[:, batch.names.index(name)] = extreme
    return _Part(
        theta,
        values,
        np.where(np.isinf(covariance), np.inf, covariance * scale[:, None, None] ** 2),
        scale,
        dof,
        minima.cost,
        minima.evaluations,
        [limit.status] * len(theta),
    )


def _scale(batch: ProblemBatch, cost: FloatArray, dof: IntArray) -> FloatArray:
    """Return the standard deviation of the residuals of each table."""
    if batch.scale_known:
        return np.ones(cost.shape)
    return estimated_scale(batch, cost, dof)


def _friction_error(part: _Part, batch: ProblemBatch) -> FloatArray:
    """Return the largest standard deviation of a friction parameter's logarithm."""
    friction = {p.name for e in batch.model.elements if isinstance(e, Dahl) for p in e.parameters}
    columns = [index for index, name in enumerate(batch.names) if name in friction]
    variances = np.diagonal(part.covariance, axis1=1, axis2=2)[:, columns]
    return np.asarray(np.sqrt(variances.max(axis=1, initial=0.0)))

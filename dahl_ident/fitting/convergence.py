"""From the results of searches to optima: covariance, status, and the message for the user."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.asymptotes import Limit
from dahl_ident.fitting.levenberg_marquardt import IntArray, Minima
from dahl_ident.fitting.losses import Loss
from dahl_ident.fitting.optimum import (
    DeterminedCombination,
    OptimumBatch,
    Status,
    at_bound,
    estimated_scale,
    information_of,
    inverse,
)
from dahl_ident.problem import Problem


class Ends:
    """Where the searches of S tables ended.

    Attributes
    ----------
    minima : Minima
        By theta, shape (S, P). At a limit, theta so far out that the model is its limit.
    limits : dict of int to (Limit, ndarray, ndarray)
        Tables at a limit, with phi and the Hessian with respect to phi.
    """

    def __init__(self, minima: Minima) -> None:
        self.minima = minima
        self.limits: dict[int, tuple[Limit, FloatArray, FloatArray]] = {}
        self._inverse: tuple[FloatArray, NDArray[np.bool_]] | None = None

    @property
    def inverse(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """The Hessians' inverses, and which parameters are undetermined."""
        if self._inverse is None:
            self._inverse = inverse(self.minima.hessian)
        return self._inverse

    def determined(self, table: int) -> int:
        """Return the number of parameters that a table's optimum has: fewer than P at a limit."""
        at = self.limits.get(table)
        return self.minima.theta.shape[1] if at is None else len(at[1])

    def take(self, tables: IntArray) -> Ends:
        """Return the ends of some tables."""
        ends = Ends(self.minima.take(tables))
        for new, old in enumerate(tables.tolist()):
            if old in self.limits:
                ends.limits[new] = self.limits[old]
        return ends

    def put(self, tables: IntArray, other: Ends) -> None:
        """Let some tables end where `other` says."""
        self.minima.assign(tables, other.minima)
        self._inverse = None
        for new, old in enumerate(tables.tolist()):
            self.limits.pop(old, None)
            if new in other.limits:
                self.limits[old] = other.limits[new]

    def at_limit(self, table: int, limit: Limit, there: Minima) -> None:
        """Let one table end at a limit, with the ends of all tables' searches there."""
        which = np.array([table])
        limit = limit.of(which)
        phi, hessian = there.theta[table], there.hessian[table]
        end = self.minima
        end.theta[table] = limit.chart.theta(phi)
        end.cost[table], end.converged[table] = there.cost[table], there.converged[table]
        end.evaluations[table] += there.evaluations[table]
        self.limits[table] = limit, phi, hessian


def optima(
    problem: Problem,
    ends: Ends,
    scale: float,
    loss: Loss | None,
    method: str,
    evaluations: IntArray,
) -> OptimumBatch:
    """Return the optima that searches with residuals divided by `scale` found.

    `scale` is 1 where the optimum does not depend on it; it is estimated here then.
    """
    theta, end = ends.minima.theta.copy(), ends.minima
    S = len(theta)
    ordered = problem.in_order(theta)
    moved = np.zeros(S, dtype=np.bool_)
    if ordered is not theta:
        moved = (ordered != theta).any(axis=1)
        moved[list(ends.limits)] = False  # a limit has names
        theta[moved] = ordered[moved]
    determined = np.array([ends.determined(table) for table in range(S)])
    dof = problem.n_numbers + len(problem.priors) - determined
    final = np.full(S, scale)
    if not problem.scale_known and loss is None and not problem.priors:
        final = estimated_scale(problem, end.cost, dof)
    if not ends.limits and loss is None and not moved.any() and problem.gaussian:
        inner, lost = ends.inverse
    elif loss is None:
        inner, lost = inverse(problem.information(theta, scale))
    else:  # one table
        one = problem.table(0)
        inner, lost = inverse(information_of(one, theta[0], scale, loss, int(dof[0]))[None])
    values = problem.to_values(theta)
    # infinite variances of parameters that no residual determines
    with np.errstate(invalid="ignore"):
        covariance = inner * (final / scale)[:, None, None] ** 2
    status: list[Status] = []
    combinations: dict[int, tuple[DeterminedCombination, ...]] = {}
    outside: NDArray[np.bool_] = np.zeros(S, dtype=np.bool_)
    if problem.is_bounded:
        outside = np.any(at_bound(problem, theta), axis=1)
    for table in range(S):
        at = ends.limits.get(table)
        if at is not None:
            limit, phi, hessian = at
            one = problem.table(table)
            chart = limit.chart.derivative(theta[table])
            information = hessian
            if loss is not None or not problem.gaussian:
                information = information_of(one, theta[table], scale, loss, int(dof[table]), chart)
            ratio = (final[table] / scale) ** 2
            small, gone = inverse(information)
            small = small * ratio
            combinations[table] = limit.combinations(theta[table], phi, chart, small, gone)
            covariance[table], lost[table] = limit.spread(chart, small, gone)
            for name, extreme in limit.extremes.items():
                values[table, problem.names.index(name)] = extreme
        status.append(
            Status.NOT_CONVERGED
            if not end.converged[table]
            else at[0].status
            if at is not None
            else Status.SINGULAR
            if lost[table].any()
            else Status.AT_BOUND
            if outside[table]
            else Status.CONVERGED
        )
    return OptimumBatch(
        problem=problem,
        theta=theta,
        values=values,
        covariance=np.where(np.isnan(covariance), np.inf, covariance),
        scale=np.asarray(final),
        dof=dof,
        cost=end.cost * scale**2,
        nfev=evaluations,
        status=tuple(status),
        undetermined=lost,
        method=method,
        loss="linear" if loss is None else loss.name,
        combinations=combinations,
        meanings={table: at[0].meaning for table, at in ends.limits.items()},
    )

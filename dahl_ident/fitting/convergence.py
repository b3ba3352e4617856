"""Optima from the ends of searches: covariance, status, and the message for the user."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import BoolArray
from dahl_ident.fitting.levenberg_marquardt import Minima
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


def optima(
    problem: Problem, end: Minima, scale: float, loss: Loss | None, method: str
) -> OptimumBatch:
    """Return the optima that searches with residuals divided by `scale` found.

    If the optimum does not depend on the scale, `scale` is 1, and the scale is estimated here.
    """
    theta, S = end.theta.copy(), len(end.theta)
    at_limit = {table: at for table, at in enumerate(end.limit) if at is not None}
    ordered = problem.in_order(theta)
    reordered = np.zeros(S, dtype=np.bool_)
    if ordered is not theta:
        reordered = (ordered != theta).any(axis=1)
        reordered[list(at_limit)] = False  # a limit refers to parameters by name
        theta[reordered] = ordered[reordered]
    dof = problem.n_nonzero + len(problem.priors) - end.determined
    final = np.full(S, scale)
    if not problem.scale_known and loss is None and not problem.priors:
        final = estimated_scale(problem, end.cost, dof)
    if not at_limit and loss is None and not reordered.any() and problem.gaussian:
        inner, lost = inverse(end.hessian)
    elif loss is None:
        inner, lost = inverse(problem.information(theta, scale))
    else:  # there is one table
        information = information_of(problem.table(0), theta[0], scale, loss, int(dof[0]))
        inner, lost = inverse(information[None])
    values = problem.to_values(theta)
    with np.errstate(invalid="ignore"):  # infinite variances of undetermined parameters
        covariance = inner * (final / scale)[:, None, None] ** 2
    status: list[Status] = []
    combinations: dict[int, tuple[DeterminedCombination, ...]] = {}
    outside: BoolArray = np.zeros(S, dtype=np.bool_)
    if problem.is_bounded:
        outside = np.any(at_bound(problem, theta), axis=1)
    for table in range(S):
        at = at_limit.get(table)
        if at is not None:
            limit, phi, hessian = at
            slopes = limit.chart.derivative(theta[table])
            information = hessian
            if loss is not None or not problem.gaussian:
                information = information_of(
                    problem.table(table), theta[table], scale, loss, int(dof[table]), slopes
                )
            of_phi, phi_lost = inverse(information)
            of_phi = of_phi * (final[table] / scale) ** 2
            combinations[table] = limit.combinations(theta[table], phi, slopes, of_phi, phi_lost)
            covariance[table], lost[table] = limit.spread(slopes, of_phi, phi_lost)
            for name, extreme in limit.extremes.items():
                values[table, problem.names.index(name)] = extreme
        status.append(
            Status.NOT_CONVERGED
            if not end.converged[table]
            else at.limit.status
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
        nfev=end.evaluations,
        status=tuple(status),
        undetermined=lost,
        method=method,
        loss="linear" if loss is None else loss.name,
        combinations=combinations,
        meanings={table: at.limit.meaning for table, at in at_limit.items()},
    )

"""Optima from the ends of searches: covariance, status, and the message for the user."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.levenberg_marquardt import Minima
from dahl_ident.fitting.losses import Loss
from dahl_ident.fitting.optimum import (
    DeterminedCombination,
    Optimum,
    OptimumBatch,
    Status,
    at_bound,
    estimated_scale,
    information_of,
    inverse,
    values_at_bounds,
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
    covariance = np.where(np.isnan(covariance), np.inf, covariance)
    outside = np.zeros(theta.shape, dtype=np.bool_)
    if problem.is_bounded:
        outside = at_bound(problem, theta)
    found = []
    for table in range(S):
        at, combinations = at_limit.get(table), tuple[DeterminedCombination, ...]()
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
            combinations = limit.combinations(theta[table], phi, slopes, of_phi, phi_lost)
            spread, lost[table] = limit.spread(slopes, of_phi, phi_lost)
            covariance[table] = np.where(np.isnan(spread), np.inf, spread)
            for name, extreme in limit.extremes.items():
                values[table, problem.names.index(name)] = extreme
        status = Status.CONVERGED
        if not end.converged[table]:
            status = Status.NOT_CONVERGED
        elif at is not None:
            status = at.limit.status
        elif lost[table].any():
            status = Status.SINGULAR
        elif outside[table].any():
            status = Status.AT_BOUND
        parts = [status.value]
        if at is not None:
            parts += _of_limit(problem, status, at.limit.meaning, values[table], combinations)
        elif status is Status.SINGULAR:
            parts.append(f"Involved: {', '.join(np.array(problem.names)[lost[table]])}.")
        elif status is Status.AT_BOUND:
            parts.append(values_at_bounds(problem, theta[table], values[table]))
        optimum = Optimum(
            source=problem,
            index=table,
            theta=theta[table],
            values=values[table],
            covariance=covariance[table],
            scale=float(final[table]),
            scale_known=problem.scale_known,
            dof=int(dof[table]),
            cost=float(end.cost[table]) * scale**2,
            nfev=int(end.evaluations[table]),
            status=status,
            message=" ".join(parts),
            method=method,
            loss="linear" if loss is None else loss.name,
            combinations=combinations,
        )
        found.append(optimum)
    return OptimumBatch(found)


def _of_limit(
    problem: Problem,
    status: Status,
    meaning: str,
    values: FloatArray,
    combinations: tuple[DeterminedCombination, ...],
) -> list[str]:
    """Return sentences about an optimum at infinity, with its names and numbers."""
    ends = {np.inf: "without bound", -np.inf: "without bound below", 0.0: "to zero"}
    parts = [f"In this limit {meaning}."] if status is Status.RUNS_AWAY and meaning else []
    limits = [
        f"{p.name} {ends[value]}"
        for p, value in zip(problem.parameters, values.tolist(), strict=True)
        if np.isinf(value) or (value == 0.0 and p.positive)
    ]
    parts.append(f"Here: {', '.join(limits)}.")
    if combinations:
        determined = (f"{c.expression} = {c.value:.4g} ± {c.stderr:.2g}" for c in combinations)
        parts.append(f"The limit depends on {', '.join(determined)}.")
    return parts

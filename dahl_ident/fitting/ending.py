"""From the end of a search to its optimum: covariance, status, and the sentence for the user."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.limits import Limit
from dahl_ident.fitting.losses import Loss
from dahl_ident.fitting.optimum import Combination, Optimum, inverse
from dahl_ident.fitting.status import Status
from dahl_ident.problem import Problem

_AT_BOUND = 1e-8


@dataclass(frozen=True)
class End:
    """Where a search ended."""

    theta: FloatArray
    cost: float
    hessian: FloatArray
    """Of the cost by theta, by Gauss and Newton."""
    converged: bool
    limit: Limit | None = None
    phi: FloatArray | None = None

    @property
    def determined(self) -> int:
        """Number of parameters that the optimum has: fewer than P at a limit."""
        return len(self.theta) if self.phi is None else len(self.phi)


def optimum(
    problem: Problem, end: End, scale: float, loss: Loss | None, evaluations: int
) -> Optimum:
    """Return the optimum that a search with residuals divided by `scale` found.

    `scale` is 1 where the optimum does not depend on it; it is estimated here then.
    """
    theta = problem.in_order(end.theta)
    dof = problem.n_residuals + len(problem.priors) - end.determined
    final = scale
    if not problem.scale_known and loss is None and not problem.priors:
        final = float(np.sqrt(2.0 * end.cost / dof)) if dof > 0 else np.nan
    information = end.hessian
    if loss is not None:
        information = _robust_information(problem, theta, scale, loss, dof)
    elif theta is not end.theta or not problem.gaussian:
        information = problem.information(theta, scale)
    values = problem.to_values(theta)
    combinations: tuple[Combination, ...] = ()
    if end.limit is None:
        covariance, undetermined = inverse(information)
        covariance = covariance * (final / scale) ** 2
    else:
        covariance, undetermined, combinations = _at_limit(
            end.limit, end.phi, theta, information, final / scale
        )
        runaway = end.limit.extremes
        values = np.array([runaway.get(n, v) for n, v in zip(problem.names, values, strict=True)])
    covariance = np.where(np.isnan(covariance), np.inf, covariance)
    status = _status(problem, end, theta, undetermined)
    return Optimum(
        problem=problem,
        theta=theta,
        values=values,
        covariance=covariance,
        scale=final,
        scale_known=problem.scale_known,
        dof=dof,
        cost=end.cost * scale**2,
        nfev=evaluations,
        status=status,
        message=_message(problem, status, theta, end.limit, combinations, undetermined),
        method="scipy",
        loss="linear" if loss is None else loss.name,
        combinations=combinations,
    )


def _robust_information(
    problem: Problem, theta: FloatArray, scale: float, loss: Loss, dof: int
) -> FloatArray:
    """Return the inverse of a robust estimate's covariance."""
    r, J = problem.residuals_and_jacobian(theta, scale, tails=False)
    m = problem.n_residuals
    kappa = loss.inflation(r[:m:2] ** 2 + r[1:m:2] ** 2, dof)
    return np.asarray(J[:m].T @ J[:m] / kappa + J[m:].T @ J[m:])


def _at_limit(
    limit: Limit,
    phi: FloatArray | None,
    theta: FloatArray,
    information: FloatArray,
    stretch: float,
) -> tuple[FloatArray, NDArray[np.bool_], tuple[Combination, ...]]:
    """Return covariance, undetermined parameters and combinations at a limit."""
    assert phi is not None
    by_phi = limit.chart.derivative(theta)
    inner, lost = inverse(by_phi.T @ information @ by_phi)
    inner = inner * stretch**2
    combinations = []
    for expression, index, logarithmic in limit.kept:
        value = float(np.exp(phi[index]) if logarithmic else phi[index])
        error = float(np.sqrt(inner[index, index])) * (value if logarithmic else 1.0)
        combinations.append(Combination(expression, value, error))
    with np.errstate(invalid="ignore"):
        covariance = by_phi @ np.where(np.isinf(inner), 0.0, inner) @ by_phi.T
    runaway = np.array([name in limit.extremes for name in limit.names])
    runaway |= np.abs(by_phi) @ lost.astype(np.float64) > 0.0
    runaway |= ~by_phi.any(axis=1)
    covariance[runaway, :] = covariance[:, runaway] = 0.0
    covariance[runaway, runaway] = np.inf
    return covariance, runaway, tuple(combinations)


def _status(
    problem: Problem, end: End, theta: FloatArray, undetermined: NDArray[np.bool_]
) -> Status:
    if not end.converged:
        return Status.NOT_CONVERGED
    if end.limit is not None:
        return end.limit.status
    if undetermined.any():
        return Status.SINGULAR
    return Status.AT_BOUND if _bound(problem, theta).any() else Status.CONVERGED


def _bound(problem: Problem, theta: FloatArray) -> NDArray[np.bool_]:
    """Return which parameters lie at a bound."""
    low, high = problem.bounds()
    with np.errstate(invalid="ignore"):
        near = _AT_BOUND * np.maximum(1.0, np.abs(theta))
        return np.asarray((theta - low <= near) | (high - theta <= near))


def _message(
    problem: Problem,
    status: Status,
    theta: FloatArray,
    limit: Limit | None,
    combinations: tuple[Combination, ...],
    undetermined: NDArray[np.bool_],
) -> str:
    """Return the status with the names and numbers that belong to it."""
    parts = [status.value]
    if limit is not None:
        ends = {np.inf: "without bound", -np.inf: "without bound below", 0.0: "to zero"}
        gone = [f"{name} {ends[value]}" for name, value in limit.extremes.items()]
        parts.append(f"Here: {', '.join(gone)}.")
        if combinations:
            known = [f"{c.expression} = {c.value:.6g} +- {c.stderr:.2g}" for c in combinations]
            parts.append(f"Determined: {', '.join(known)}.")
    elif status is Status.SINGULAR:
        names = [n for n, lost in zip(problem.names, undetermined, strict=True) if lost]
        parts.append(f"Involved: {', '.join(names)}.")
    elif status is Status.AT_BOUND:
        at = zip(problem.names, problem.to_values(theta), _bound(problem, theta), strict=True)
        parts.append(f"At its bound: {', '.join(f'{n} = {v:g}' for n, v, hit in at if hit)}.")
    return " ".join(parts)

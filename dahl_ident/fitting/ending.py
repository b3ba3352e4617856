"""From the end of a search to its optimum: covariance, status, and the sentence for the user."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.limits import Limit
from dahl_ident.fitting.losses import Loss
from dahl_ident.fitting.optimum import (
    Combination,
    Optimum,
    estimated_scale,
    inverse,
    robust_information,
    spread,
)
from dahl_ident.fitting.status import Status
from dahl_ident.problem import Problem

_AT_BOUND = 1e-8


@dataclass(frozen=True)
class End:
    """Where a search ended."""

    theta: FloatArray
    cost: float
    hessian: FloatArray
    """Of the cost by theta, at a limit by phi, by Gauss and Newton."""
    converged: bool
    limit: Limit | None = None
    phi: FloatArray | None = None

    @cached_property
    def inverse(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """The Hessian's inverse, and which parameters are undetermined."""
        return inverse(self.hessian)

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
    theta = end.theta if end.limit else problem.in_order(end.theta)  # a limit has names
    dof = problem.n_residuals + len(problem.priors) - end.determined
    final = scale
    if not problem.scale_known and loss is None and not problem.priors:
        final = float(estimated_scale(problem, end.cost, dof))
    chart = None if end.limit is None else end.limit.chart.derivative(theta)
    if loss is not None:
        inner, lost = inverse(robust_information(problem, theta, scale, loss, dof, chart))
    elif theta is not end.theta or not problem.gaussian:
        inner, lost = inverse(problem.information(theta, scale, chart))
    else:
        inner, lost = end.inverse
    with np.errstate(invalid="ignore"):  # infinite variances of what no residual holds
        inner = inner * (final / scale) ** 2
    values = problem.to_values(theta)
    combinations: tuple[Combination, ...] = ()
    covariance, undetermined = inner, lost
    if end.limit is not None and end.phi is not None and chart is not None:
        combinations = _combinations(end.limit, end.phi, inner)
        covariance, undetermined = spread(end.limit, chart, inner, lost)
        extremes = end.limit.extremes
        values = np.array([extremes.get(n, v) for n, v in zip(problem.names, values, strict=True)])
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


def _combinations(limit: Limit, phi: FloatArray, covariance: FloatArray) -> tuple[Combination, ...]:
    """Return what a limit determines."""
    found = []
    for expression, index, logarithmic in limit.kept:
        value = float(np.exp(phi[index]) if logarithmic else phi[index])
        error = float(np.sqrt(covariance[index, index])) * (value if logarithmic else 1.0)
        found.append(Combination(expression, value, error))
    return tuple(found)


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
            left = [f"{c.expression} = {c.value:.4g} +- {c.stderr:.2g}" for c in combinations]
            parts.append(f"The limit depends on {', '.join(left)}.")
    elif status is Status.SINGULAR:
        names = [n for n, lost in zip(problem.names, undetermined, strict=True) if lost]
        parts.append(f"Involved: {', '.join(names)}.")
    elif status is Status.AT_BOUND:
        at = zip(problem.names, problem.to_values(theta), _bound(problem, theta), strict=True)
        parts.append(f"At its bound: {', '.join(f'{n} = {v:g}' for n, v, hit in at if hit)}.")
    return " ".join(parts)

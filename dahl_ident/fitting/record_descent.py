"""Gauss-Newton steps for records: to a small part of what noise makes uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.levenberg_marquardt import Minima, minimise
from dahl_ident.fitting.losses import Loss
from dahl_ident.fitting.scipy_least_squares import minimise_by_scipy
from dahl_ident.problem.record_problem import RecordProblem

SLOW = 0.5  # correlation of neighbouring residuals that are weighted by their spectrum
EXACT = 1e-12  # share of variance left that is rounding
LOOSE = 1e4  # of the step at which a search of a long record has converged
ROUGH = 15  # steps after which the noise is known well enough to say what a step is worth
_STAGNANT = 0.01  # relative fall of the cost in as many steps, below which more lead nowhere
WORTHLESS = 1e-5  # fall of the cost, over the residuals' variance
SETTLED = 0.03  # step in standard errors that no longer matters
_CONFIRMED = 4.0  # fall of the sum of squares, in variances of the noise, that is not chance
STEPS = 75  # at most; a search without convergence is not an estimate


class Descent:
    """How a search steps, what it minimises, and the evaluations until now."""

    def __init__(self, method: str, loss: str) -> None:
        self.method, self.loss = method, loss
        self.evaluations, self.scale = 0, 1.0
        self.rho: Loss | None = None

    def descend(self, problem: RecordProblem, theta: FloatArray, steps: int) -> Minima:
        """Return the minimum near a start; first roughly, then to a small part of the noise."""
        begin, before = theta[None], np.inf
        for _ in range(0, steps, ROUGH):
            end = self.minimise(problem, begin, ROUGH, bounded=before < np.inf)
            if bool(end.converged[0]) or not np.isfinite(end.cost[0]) or steps == ROUGH:
                return end
            if problem.output == "motion" and end.cost[0] > (1.0 - _STAGNANT) * before:
                break
            begin, before = end.theta, float(end.cost[0])
        noise = 2.0 * float(end.cost[0]) / problem.n_residuals
        # where a motion comes to rest, errors of its integration hide the last falls of the cost
        with np.errstate(all="ignore"):
            at = problem.quadratic(end.theta[0], self.scale, self.rho)
            if not np.isfinite(at.cost):
                return end
            size = np.sqrt(at.hessian.diagonal())
            size[size == 0.0] = 1.0  # what vanishes, such as a damper that these data do not need
            slope = at.gradient / size
            left = slope @ np.linalg.pinv(at.hessian / np.outer(size, size), hermitian=True) @ slope
        return replace(end, converged=np.array([bool(left < SETTLED**2 * noise)]))

    def minimise(
        self, problem: RecordProblem, begin: FloatArray, most: int, *, bounded: bool = False
    ) -> Minima:
        """Return the minimum near a start, shape (1, P), after so many steps at most.

        With first states `bounded`, which a search from far off must not be: it would end there.
        """

        def within(at: FloatArray) -> tuple[FloatArray, FloatArray]:
            return problem.start_bounds(problem.to_values(at[0]))

        if self.method == "scipy":
            end = minimise_by_scipy(problem, begin[0], self.scale, self.rho)
        else:
            end = minimise(
                lambda at, _which: problem.quadratic(at, self.scale, self.rho),
                begin,
                problem.space.relative,
                problem.n_residuals,
                tolerance_factor=LOOSE,
                enough=lambda cost: WORTHLESS * 2.0 * cost / problem.n_residuals,
                steps=most,
                bounds=within if bounded else None,
            )
        self.evaluations += int(end.evaluations[0])
        return end


def by_chance(cost: float, samples: int, residuals: Sequence[FloatArray]) -> float:
    """Return the fall of the sum of squares that one more value makes by chance."""
    slow = correlation(residuals)
    return _CONFIRMED * 2.0 * cost / samples * (1.0 + slow) / (1.0 - slow)


def correlation(residuals: Sequence[FloatArray]) -> float:
    """Return the correlation of residuals with those one sample later."""
    return sum(float(e[1:] @ e[:-1]) for e in residuals) / sum(float(e @ e) for e in residuals)

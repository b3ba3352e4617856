"""Least squares for one problem: a start without guessing, a global look, an honest end.

1. Starts by variable projection (:mod:`dahl_ident.fitting.start`); what the user gave is one more.
2. Levenberg and Marquardt's method from all of them together, exact Jacobian, search coordinates.
3. Where the best of them has not converged, or leaves friction badly determined, the valleys of
   microslip and the limits at infinity are searched as well (:mod:`dahl_ident.fitting.limits`).
4. Where there are bounds, or nothing has converged, scipy's trust-region reflective algorithm
   goes on from there.

A robust loss, and a prior beside noise of unknown scale, make the optimum depend on the scale;
it is then estimated and the search repeated until both agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Dahl
from dahl_ident.errors import FitError, ModelError, ValidationError
from dahl_ident.fitting.ending import End, optimum
from dahl_ident.fitting.levenberg_marquardt import (
    NEARLY,
    Evaluate,
    Minima,
    gauss_newton,
    minimise,
)
from dahl_ident.fitting.limits import Chart, Limit, Reach, limits, stiffness_valleys, valleys
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.fitting.optimum import Optimum, scale_ratio
from dahl_ident.fitting.start import edge_starts, resistant_starts, starts
from dahl_ident.fitting.trust_region import minimise_within
from dahl_ident.problem import Problem, Quadratic

DOUBTFUL = 0.3  # standard deviation of a friction parameter's logarithm
_RESCALINGS = 100
_SAME_SCALE = 1e-9
_LONGEST_SECANT = 20.0
FIRST_LOOK, HOPELESS = 15, 3.0  # steps at a limit, and how much higher it may then still be
_PATIENCE = 1000  # steps where friction is so faint that each takes little
AT_LIMIT = 1e4  # looseness: so far out, large terms cancel
TIE = 1e-12  # relative difference of costs at which a limit wins over a real optimum
SAME = 1e-5  # among limits, of which the one with fewest parameters is then taken


def solve(
    problem: Problem, *, loss: str = "linear", start: Mapping[str, float] | None = None
) -> Optimum:
    """Return the minimum of a problem's sum of squares, wherever it lies.

    Parameters
    ----------
    problem : Problem
        What to solve.
    loss : {"linear", "huber", "soft_l1", "student_t"}, default "linear"
        See :mod:`dahl_ident.fitting.losses`.
    start : mapping of str to float, optional
        One more start: values of some or all free parameters; the others are completed.

    Returns
    -------
    Optimum
        Its `status` says how the search ended.

    Raises
    ------
    FitError
        If there are fewer residuals than parameters, or a parameter cannot be started.
    ModelError
        If `start` names a parameter that is not free.
    ValidationError
        If `loss` is unknown, or a prior is not normal.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.data import FrequencyResponse
    >>> A = np.geomspace(1e-4, 1e-2, 5)
    >>> N = Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> optimum = solve(Problem(FrequencyResponse(np.ones(5), N, A), Dahl()))
    >>> optimum.values.round(9).tolist()
    [0.1, 30.0]
    >>> optimum.status.name
    'CONVERGED'
    """
    return _Search(problem, loss_named(loss)).run(start)


class _Search:
    """One call of `solve`: what its steps share."""

    def __init__(self, problem: Problem, loss: Loss | None) -> None:
        self.problem, self.loss = problem, loss
        self.m = problem.n_residuals + len(problem.priors)
        P = len(problem.parameters)
        if self.m < P:
            raise FitError(
                f"{problem.n_residuals // 2} rows give {self.m} numbers, fewer than the {P} free "
                f"parameters ({', '.join(problem.names)}); measure more points, or fix some"
            )
        self.logarithmic = np.array([p.transform == "log" for p in problem.parameters])
        elements = [e for e in problem.model.elements if isinstance(e, Dahl)]
        friction = {p.name for element in elements for p in element.parameters}
        self.friction = [i for i, name in enumerate(problem.names) if name in friction]
        self.low, self.high = problem.bounds()
        self.bounded = bool(np.isfinite([self.low, self.high]).any())
        self.rescales = not problem.scale_known and bool(loss is not None or problem.priors)
        self.evaluations = 0

    @cached_property
    def reach(self) -> Reach:
        """Where a search is still at a finite optimum."""
        return Reach(self.problem)

    def run(self, start: Mapping[str, float] | None) -> Optimum:
        """Search, with the noise's scale adapted where the optimum depends on it."""
        begin, scale = self._starts(start), 1.0
        if self.rescales:
            y, _ = self.problem.whitened(begin, derivatives=False)
            size = float(np.median(np.abs(y), axis=-1).min()) / np.sqrt(np.log(4.0))
            scale = max(size, float(self.problem.rounding))
        end = self._search(begin, scale)
        step, last = 0.0, 0.0
        for _ in range(_RESCALINGS if self.rescales else 0):
            dof = self.m - end.determined
            excess = np.log(scale_ratio(self.problem, end.theta, scale, self.loss, dof))
            if abs(excess) < _SAME_SCALE or not np.isfinite(excess):
                break
            # the secant's step where it goes the same way, else the plain one
            factor = step / (last - excess) if last != excess else 1.0
            step = excess * (factor if 0.0 < factor < _LONGEST_SECANT else 1.0)
            last, scale = excess, scale * float(np.exp(step))
            end = self._search(end.theta[None], scale)
        return optimum(self.problem, end, scale, self.loss, self.evaluations)

    def _starts(self, start: Mapping[str, float] | None) -> FloatArray:
        begin = starts(self.problem) if self.loss is None else resistant_starts(self.problem)
        names = self.problem.names
        if start is not None:
            if not isinstance(start, Mapping):
                raise ValidationError(f"start is {start!r}; expected a mapping of names to numbers")
            unknown = [name for name in start if name not in names]
            if unknown:
                raise ModelError(
                    f"start names {', '.join(unknown)}; the free parameters are {', '.join(names)}"
                )
            values = self.problem.to_values(begin[0])
            given = [start.get(n, v) for n, v in zip(names, values, strict=True)]
            begin = np.vstack([self.problem.to_search(given), begin])
        return np.clip(begin, self.low, self.high) if self.bounded else begin

    # Searches

    def _search(self, begin: FloatArray, scale: float) -> End:
        end = self._descend(begin, scale)
        if not end.converged or self._friction_error(end, scale) > DOUBTFUL:
            end = self._look_wider(end, begin, scale)
        if end.limit is None and (self.bounded or not end.converged):
            end = self._trust_region(end, begin, scale)
        return end

    def _evaluate(self, scale: float, chart: Chart | None = None) -> Evaluate:
        problem, loss = self.problem, self.loss

        def evaluate(at: FloatArray, _which: object) -> Quadratic:
            if chart is None:
                return problem.quadratic(at, scale, loss)
            theta = chart.theta(at)
            return problem.quadratic(theta, scale, loss, chart.derivative(theta))

        return evaluate

    def _descend(self, begin: FloatArray, scale: float, steps: int = 80) -> End:
        """Return the best end of Levenberg and Marquardt's searches from `begin`."""
        minima = None
        if len(begin) == 1 and self.loss is None:
            minima = gauss_newton(
                lambda theta: self.problem.quadratic(theta, scale),
                begin[0],
                self.logarithmic,
                self.m,
            )
        minima = minima or minimise(
            self._evaluate(scale),
            begin,
            self.logarithmic,
            self.m,
            inside=lambda theta, _: self.reach(theta),
            steps=steps,
        )
        best = self._best(minima)
        theta = minima.theta[best]
        converged = bool(minima.converged[best]) and self._allowed(theta)
        return End(theta, float(minima.cost[best]), minima.hessian[best], converged)

    def _descend_in(
        self,
        chart: Chart,
        begin: FloatArray,
        scale: float,
        limit: Limit | None = None,
        steps: int = 80,
    ) -> End:
        """Return the best end of searches in a chart: at a limit, or along a valley."""
        minima = minimise(
            self._evaluate(scale, chart),
            chart.phi(begin),
            ~((chart.matrix != 0.0).T @ ~self.logarithmic),
            self.m,
            inside=None if limit else lambda phi, _: self.reach(chart.theta(phi)),
            looseness=1.0 if limit is None else AT_LIMIT,
            steps=steps,
        )
        best = self._best(minima)
        phi = minima.theta[best]
        theta = chart.theta(phi)
        cost, hessian = float(minima.cost[best]), minima.hessian[best]
        converged = bool(minima.converged[best]) and self._allowed(theta)
        if limit is not None:
            return End(theta, cost, hessian, converged, limit, phi)
        return End(theta, cost, self.problem.quadratic(theta, scale, self.loss).hessian, converged)

    def _best(self, minima: Minima) -> int:
        self.evaluations += int(minima.evaluations.max())
        lowest = minima.cost.min()
        good = minima.converged & (minima.cost <= lowest * (1.0 + NEARLY))
        return int(np.argmin(np.where(good, minima.cost, np.inf) if good.any() else minima.cost))

    def _look_wider(self, end: End, begin: FloatArray, scale: float) -> End:
        """Return the best of `end`, the ends of microslip's valleys, and the limits."""
        begin = np.vstack([end.theta, begin])
        for chart in (*valleys(self.problem), *stiffness_valleys(self.problem)):
            other = self._descend_in(chart, begin, scale)
            if other.cost < end.cost or (other.converged and not end.converged):
                end = other
        if not end.converged and self.reach(end.theta):
            end = self._descend(end.theta[None], scale, steps=_PATIENCE)
        edges = np.vstack([end.theta, *edge_starts(self.problem)])
        ends = []
        for limit in limits(self.problem):
            there = self._descend_in(limit.chart, edges, scale, limit, FIRST_LOOK)
            if not there.converged and there.cost < HOPELESS * end.cost:
                there = self._descend_in(limit.chart, there.theta[None], scale, limit)
            if there.converged:
                ends.append(there)
        if not ends:
            return end
        lowest = min(e.cost for e in ends)
        ends = [e for e in ends if e.cost <= lowest * (1.0 + SAME)]
        simplest = min(ends, key=lambda e: (e.determined, e.cost))
        real = end.converged and np.isfinite(self._friction_error(end, scale))
        slack = TIE if real else NEARLY
        return simplest if simplest.cost <= end.cost * (1.0 + slack) else end

    def _trust_region(self, end: End, begin: FloatArray, scale: float) -> End:
        """Return the best end of scipy's bounded searches."""
        best = end
        for start in np.clip(np.vstack([end.theta, begin]), self.low, self.high):
            found = minimise_within(self.problem, start, scale, self.loss)
            self.evaluations += found.evaluations
            if found.cost < best.cost or not best.converged:
                cost, _, hessian = self.problem.quadratic(found.theta, scale, self.loss)
                inside = bool(self.reach(found.theta))
                best = End(found.theta, float(cost), hessian, found.converged and inside)
        return best

    def _allowed(self, theta: FloatArray) -> bool:
        return not self.bounded or bool(np.all((theta >= self.low) & (theta <= self.high)))

    def _friction_error(self, end: End, scale: float) -> float:
        """Return the largest standard deviation of the logarithm of a friction parameter."""
        covariance, _ = end.inverse
        adapted = self.problem.scale_known or self.rescales
        variance = 1.0 if adapted else 2.0 * end.cost / max(self.m - len(end.theta), 1)
        largest = covariance.diagonal()[self.friction].max(initial=0.0)
        return float(np.sqrt(variance * largest)) if largest < np.inf else np.inf

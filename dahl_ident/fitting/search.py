"""Least squares for one table or for many at once: one search.

1. Starts by variable projection (:mod:`dahl_ident.fitting.global_start`); the user's
   values are one more.
2. Levenberg and Marquardt's method from all of them together, exact Jacobian, search coordinates.
   With ``method="scipy"``, `scipy.optimize.least_squares` from each of the same starts; only
   charts and limits are searched as before.
3. Where a table's search has not converged, or leaves friction badly determined, the charts of
   microslip and the limits at infinity are searched as well
   (:mod:`dahl_ident.fitting.asymptotes`).
4. Where a search has left the bounds, or nothing has converged, `scipy.optimize.least_squares`
   goes on from there.

A robust loss, and a prior with noise of unknown scale, make the optimum depend on the scale;
it is then estimated and the search repeated until both agree. One table is a batch of one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import BoolArray, FloatArray, IntArray, finite_number
from dahl_ident.errors import FitError, ModelError, ValidationError, choices
from dahl_ident.fitting.asymptotes import Chart, Reach, limits, microslip_charts
from dahl_ident.fitting.convergence import optima
from dahl_ident.fitting.global_start import Starts, edge_starts, global_starts, grid_size
from dahl_ident.fitting.levenberg_marquardt import (
    NEARLY,
    AtLimit,
    Minima,
    minimise,
    minimise_by_scipy,
)
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.fitting.optimum import Optimum, OptimumBatch, agreed_scale, inverse
from dahl_ident.fitting.record_search import Tell, solve_records, solve_repetitions
from dahl_ident.fitting.record_start import record_starts
from dahl_ident.problem import Problem, ProblemBatch, Quadratic, TableProblem

# standard deviation of the logarithm of a friction parameter, above which other minima and limits
# are searched as well: they may be as good
DOUBTFUL = 0.3
_MOST_STEPS = 80  # most steps of a search, of which ten are usual
_BRIEF = 30  # the same where no limit is searched: a repetition is near its optimum
# fall of the cost, over that of one residual, for which such a search takes no further step
_SLIGHT_FALL = 1e-5
_PATIENCE = 1000  # most steps where friction is so faint that each step gains little
_AT_LIMIT = 1e4  # factor on the tolerance at a limit, where large terms cancel
_MANY_TABLES = 30.0  # factor on the tolerance for them: 3e-7 standard deviations are enough
_TIE = 1e-12  # relative difference of costs within which a limit wins over a finite optimum
# relative difference of costs within which limits are alike; the one with fewest parameters counts
_LIMITS_TIE = 1e-5
_ROWS_AT_ONCE = 16384  # rows of data searched together: their arrays stay in the processor's cache
_CURVES_AT_ONCE = 2**20  # the same times the nodes of the grid of starts: 16 MB of complex numbers


def solve(
    problem: Problem,
    *,
    method: str = "lm",
    loss: str = "linear",
    start: Mapping[str, float] | None = None,
    limits: bool = True,
    tell: Tell | None = None,
) -> Optimum:
    """Return the minimum of a problem's sum of squares, wherever it lies.

    With method "lm", Levenberg and Marquardt's from all starts together, with "scipy",
    `scipy.optimize.least_squares` on the same residuals and Jacobian from each of them. `loss` is
    one of :mod:`dahl_ident.fitting.losses`, or "linear". `start` is one more start: values of some
    or all free parameters; the others are completed. Without `limits` (of tables) a search does not
    go on to limits at infinity, nor by other ways where nothing has converged, and values that all
    free parameters have are the only start. `tell` takes the number of evaluations and the share of
    variance left, of records.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.data import FrequencyResponse
    >>> A = np.geomspace(1e-4, 1e-2, 5)
    >>> N = Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> optimum = solve(TableProblem(FrequencyResponse(np.ones(5), N, A), Dahl()))
    >>> optimum.values.round(9).tolist()
    [0.1, 30.0]
    >>> optimum.status.name
    'CONVERGED'
    """
    if method not in ("lm", "scipy"):
        raise ValidationError(f"method is {method!r}; expected lm or scipy")
    loss_named(loss)  # an unknown loss is refused before the search
    _check(problem, {} if start is None else start)
    any_problem: Any = problem
    if problem.kind == "records":
        return solve_records(any_problem, method, loss, start or {}, tell)
    return _solve_table(any_problem, method, loss, start or {}, limits=limits)


def _solve_table(
    problem: TableProblem, method: str, loss: str, start: Mapping[str, float], *, limits: bool
) -> Optimum:
    """Return the optimum of one table."""
    search = TableSearch(
        problem, loss_named(loss, problem.residuals_per_row), method=method, limits=limits
    )
    stated = [p.value for p in problem.parameters if p.value is not None]
    if not limits and len(stated) == len(problem.parameters):
        return search.run(Starts(np.zeros(1, np.intp), problem.to_search(stated)[None]))[0]
    begin = global_starts(problem, resistant=loss != "linear")
    if start:
        values = zip(problem.names, problem.to_values(begin.theta[0]), strict=True)
        theta = problem.to_search([start.get(name, value) for name, value in values])
        begin = Starts(np.zeros(len(begin.theta) + 1, dtype=np.intp), np.vstack([theta, begin[1]]))
    optimum = search.run(begin)[0]
    if limits and problem.is_exact and not problem.takes_energy(optimum.theta):
        sine = problem.with_steady("describing function")
        by_sine = _solve_table(sine, method, loss, start, limits=True)
        if not problem.takes_energy(by_sine.theta):
            return by_sine  # the exact steady motion is not found there
    return optimum


def starts_of(problem: Problem, most: int) -> FloatArray:
    """Return the search coordinates of at most as many global starts, best first, (S, P)."""
    any_problem: Any = problem
    if problem.kind == "records":
        return np.array([problem.to_search(v) for v in islice(record_starts(any_problem), most)])
    return global_starts(any_problem).theta[:most]


def solve_many(batch: ProblemBatch, *, start: ArrayLike | None = None) -> OptimumBatch:
    """Return the optimum of every table of a batch.

    `start` holds search coordinates, (P,) or (S, P), such as the optimum that replicates were drawn
    from; left out, every table finds its own starts.

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
    _check(batch, {})
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
    rows = batch.n_residuals // 2
    at_once = min(_ROWS_AT_ONCE, _CURVES_AT_ONCE // grid_size(batch.take(slice(0, 1)))) // rows
    if batch.priors and not batch.scale_known:
        at_once = 1  # the scale of each is estimated separately
    at_once = max(1, at_once)
    optima = list[Optimum]()
    for first in range(0, S, at_once):
        part = batch.take(slice(first, first + at_once))
        search = TableSearch(part, None, tolerance=_MANY_TABLES)
        if begin is None:
            ends = search.run(global_starts(part))
        else:
            some = begin[first : first + at_once]
            ends = search.run(Starts(np.arange(len(some)), some), starts_given=True)
        optima += [replace(one, source=batch, index=first + i) for i, one in enumerate(ends)]
    return OptimumBatch(optima)


def repetitions(
    optimum: Optimum, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return search coordinates of repeated measurements that are drawn, and their errors, (S, P).

    NaN where a repetition has no finite optimum.
    """
    problem = optimum.problem
    if problem.kind == "records":
        return solve_repetitions(optimum, count, rng)
    scale = 1.0 if optimum.scale_known else optimum.scale
    responses = problem.draw(optimum.theta, scale, count, rng)
    drawn = [ProblemBatch.replicates(problem, responses)]
    if problem.priors:  # calibrations are measurements too
        drawn = [
            ProblemBatch.replicates(_calibrated_again(optimum, rng), one[None]) for one in responses
        ]
    theta, error = [], []
    for batch in drawn:
        ends = solve_many(batch, start=optimum.theta)
        theta.append(np.where(np.isfinite(ends.values), ends.theta, np.nan))
        error.append(np.sqrt(np.diagonal(ends.covariance, axis1=1, axis2=2)))
    return np.concatenate(theta), np.concatenate(error)


def _calibrated_again(optimum: Optimum, rng: np.random.Generator) -> TableProblem:
    """Return the problem with calibrations that are drawn around the estimates."""
    from scipy import stats

    problem, values = optimum.problem, dict(zip(optimum.names, optimum.values, strict=True))
    stds = {name: float(prior.std()) for name, prior in problem.priors.items()}
    drawn = {name: stats.norm(rng.normal(values[name], std), std) for name, std in stds.items()}
    again: TableProblem = problem.like(sensors=replace(problem.sensors, **drawn))
    return again


def _check(problem: Problem, start: Mapping[str, float]) -> None:
    """Refuse starts of parameters that are not free, and fewer numbers than free parameters."""
    names, m = problem.names, problem.n_residuals + len(problem.priors)
    if not isinstance(start, Mapping):
        raise ValidationError(f"start is {start!r}; expected a mapping of names to numbers")
    unknown = [str(name) for name in start if name not in names]
    if unknown:
        raise ModelError(
            f"start names {', '.join(unknown)}; the free parameters are {choices(names, *unknown)}"
        )
    for name, value in start.items():
        finite_number(value, f"start of {name}")
    if m < len(names):
        raise FitError(
            f"the data, {problem.extent}, give {m} numbers, fewer than the "
            f"{len(names)} free parameters ({', '.join(names)}); measure more points, or fix some"
        )


class TableSearch:
    """One search for all tables of a problem."""

    def __init__(
        self,
        problem: TableProblem,
        loss: Loss | None,
        method: str = "lm",
        tolerance: float = 1.0,
        *,
        limits: bool = True,
    ) -> None:
        self.limits = limits
        self.problem, self.loss, self.method, self.tolerance = problem, loss, method, tolerance
        self.m = problem.n_residuals + len(problem.priors)
        self.logarithmic = problem.space.positive
        self.friction = problem.friction_columns
        self.low, self.high = problem.bounds()
        self.bounded = problem.is_bounded
        self.rescales = not problem.scale_known and bool(loss is not None or problem.priors)
        self.starts_given = False
        self._strayed = np.zeros(problem.n_tables, dtype=np.bool_)  # where searches left the bounds

    @cached_property
    def reach(self) -> Reach:
        """Where a search is still at a finite optimum."""
        return Reach(self.problem)

    def run(self, begin: Starts, *, starts_given: bool = False) -> OptimumBatch:
        """Search, with the noise's scale adapted where the optimum depends on it."""
        self.starts_given, scale = starts_given, 1.0
        if self.bounded:
            begin = Starts(begin.table, np.clip(begin.theta, self.low, self.high))
        if self.rescales:
            squares = self.problem.squares(begin.theta)
            size = float(np.sqrt(np.median(squares, axis=1).min() / np.log(4.0)))
            scale = max(size, float(np.max(self.problem.rounding)))
        end = self._search(begin, scale)
        if self.rescales:
            evaluations = 0

            def search(scale: float) -> tuple[FloatArray, int]:
                nonlocal end, evaluations
                if evaluations:
                    end = self._search(Starts(np.zeros(1, np.intp), end.theta), scale)
                evaluations += int(end.evaluations[0])
                return end.theta[0], self.m - int(end.determined[0])

            scale = agreed_scale(self.problem.table(0), self.loss, search, scale)
            end.evaluations[:] = evaluations
        return optima(self.problem, end, scale, self.loss, self.method)

    def _search(self, begin: Starts, scale: float) -> Minima:
        coarser, near = self.problem.coarser(), begin
        several = len(begin.table) > self.problem.n_tables
        if coarser is not self.problem and (several or not self.limits):
            search = TableSearch(
                coarser, self.loss, self.method, self.tolerance, limits=self.limits
            )
            theta = search._descend(begin, scale).theta
            if not several:  # an end by the coarser problem may be no better than the beginning
                began, ended = (
                    self.problem.quadratic(t, scale, self.loss).cost for t in (begin.theta, theta)
                )
                theta = np.where((began <= ended)[:, None], begin.theta, theta)
            near = Starts(np.arange(self.problem.n_tables), theta)
        end = self._descend(near, scale)
        if not self.limits:
            return end
        begin = near if self.problem.is_exact else begin  # whose searches far out cost too much
        error = self._friction_error(end, scale)
        doubtful = np.flatnonzero(~end.converged | (error > DOUBTFUL))
        if doubtful.size and self.problem.is_exact:
            self._look_wider_by_sine(end, begin, scale, doubtful)
        elif doubtful.size:
            wider = self._of(doubtful)._look_wider(end.take(doubtful), begin.of(doubtful), scale)
            end.assign(doubtful, wider)
        for table in np.flatnonzero(self._strayed | ~end.converged).tolist():
            if end.limit[table] is None:
                bounded = self._trust_region(table, end, begin, scale)
                end.assign(np.array([table]), bounded)
        return end

    def _of(self, tables: IntArray) -> TableSearch:
        """Return the same search for some of the tables."""
        if len(tables) == self.problem.n_tables:
            return self
        part = TableSearch(self.problem.take(tables), self.loss, self.method, self.tolerance)
        part.starts_given = self.starts_given
        return part

    def _descend(
        self,
        begin: Starts,
        scale: float,
        chart: Chart | None = None,
        *,
        limit: bool = False,
        steps: int | None = None,
    ) -> Minima:
        """Return the best end of each table's searches; with a chart, they are in its phi."""
        problem, table = self.problem, begin.table
        logarithmic, phi = self.logarithmic, begin.theta
        if chart is not None:
            logarithmic = ~((chart.matrix != 0.0).T @ ~self.logarithmic)
            phi = chart.of(table).phi(begin.theta)

        def theta_at(at: FloatArray, which: IntArray) -> FloatArray:
            return at if chart is None else chart.of(table[which]).theta(at)

        def evaluate(at: FloatArray, which: IntArray) -> Quadratic:
            theta = theta_at(at, which)
            slopes = None if chart is None else chart.derivative(theta)
            return problem.take(table[which]).quadratic(theta, scale, self.loss, slopes)

        def inside(at: FloatArray, which: IntArray) -> BoolArray:
            return self.reach(theta_at(at, which), table[which])

        if self.method == "scipy" and chart is None:
            minima = self._by_scipy(begin, scale)
        else:
            minima = minimise(
                evaluate,
                phi,
                logarithmic,
                self.m,
                inside=None if limit else inside,
                owner=table,
                tolerance_factor=_AT_LIMIT if limit else self.tolerance,
                enough=None if self.limits else lambda cost: _SLIGHT_FALL * cost / self.m,
                steps=steps or (_MOST_STEPS if self.limits else _BRIEF),
                accuracy=problem.accuracy,
                bounds=(self.low, self.high) if self.bounded and chart is None else None,
            )
        if self.bounded:
            theta = theta_at(minima.theta, np.arange(len(table)))
            within = ((theta >= self.low) & (theta <= self.high)).all(axis=1)
            minima.converged[:] &= within
            self._strayed[table[~within]] = True
        return minima.best(table, problem.n_tables)

    def _by_scipy(self, begin: Starts, scale: float) -> Minima:
        """Return where `scipy.optimize.least_squares` ends from each start."""
        parts = []
        for table, theta in zip(begin.table.tolist(), begin.theta, strict=True):
            end = minimise_by_scipy(self.problem.table(table), theta, scale, self.loss)
            end.converged[:] &= self.reach(end.theta, np.array([table]))
            parts.append(end)
        return Minima.stacked(parts)

    def _look_wider_by_sine(
        self, end: Minima, begin: Starts, scale: float, doubtful: IntArray
    ) -> None:
        """Look for other optima, and for limits, with the describing function.

        Exact steady motions far out cost too much. A search without an optimum goes on from that of
        the describing function, and ends at the latter's limit if it still has none.
        """
        sine = TableSearch(
            self.problem.with_steady("describing function"), self.loss, self.method, self.tolerance
        )
        by_sine = sine._search(begin, scale)
        lost = doubtful[~end.converged[doubtful]]
        if lost.size:
            again = Starts(np.arange(lost.size), by_sine.theta[lost])
            further = self._of(lost)._descend(again, scale)
            better = np.flatnonzero(further.converged | (further.cost < end.cost[lost]))
            end.assign(lost[better], further.take(better))
        infinite = ~np.isfinite(self._friction_error(end, scale))
        at_limit = [by_sine.limit[table] is not None for table in doubtful]
        chosen = doubtful[at_limit & (infinite | ~end.converged)[doubtful]]
        end.assign(chosen, by_sine.take(chosen))

    def _look_wider(self, end: Minima, begin: Starts, scale: float) -> Minima:
        """Return the best of `end`, of searches in microslip's charts, and of the limits."""
        problem, every = self.problem, np.arange(self.problem.n_tables)
        if self.starts_given:
            begin = begin.joined(global_starts(problem))
            end = end.better(self._descend(begin, scale))
        begin = Starts(every, end.theta).joined(begin)
        charts = microslip_charts(problem) + microslip_charts(problem, scale_given=True)
        for chart in charts:
            minima = self._descend(begin, scale, chart)
            theta = chart.theta(minima.theta)
            hessian = problem.quadratic(theta, scale, self.loss).hessian
            end = end.better(replace(minima, theta=theta, hessian=hessian))
        faint = np.flatnonzero(~end.converged & self.reach(end.theta))
        if faint.size:
            part = self._of(faint)
            further = Starts(np.arange(faint.size), end.theta[faint])
            end.put(faint, part._descend(further, scale, steps=_PATIENCE))
        edges = Starts(every, end.theta)
        for theta in edge_starts(problem):
            edges = edges.joined(Starts(every, np.broadcast_to(theta, end.theta.shape)))
        self._put_limits(end, edges, scale)
        return end

    def _put_limits(self, end: Minima, edges: Starts, scale: float) -> None:
        """End each table at the best limit whose cost is no higher than that of its optimum."""
        ordered = sorted(limits(self.problem), key=lambda limit: limit.chart.matrix.shape[1])
        candidates = [(at, self._descend(edges, scale, at.chart, limit=True)) for at in ordered]
        if not candidates:
            return
        costs = np.array([np.where(m.converged, m.cost, np.inf) for _, m in candidates])
        sizes = np.array([limit.chart.matrix.shape[1] for limit, _ in candidates])[:, None]
        alike = (costs <= costs.min(axis=0) * (1.0 + _LIMITS_TIE)) & np.isfinite(costs)
        fewest = np.where(alike, sizes, np.inf).min(axis=0)
        chosen = np.where(alike & (sizes == fewest), costs, np.inf).argmin(axis=0)
        real = end.converged & np.isfinite(self._friction_error(end, scale))
        ceiling = end.cost * (1.0 + np.where(real, _TIE, NEARLY))
        for table in np.flatnonzero(costs.min(axis=0, initial=np.inf) < np.inf):
            limit, minima = candidates[chosen[table]]
            if minima.cost[table] <= ceiling[table]:
                limit, phi = limit.of(int(table)), minima.theta[table]
                end.theta[table] = limit.chart.theta(phi)
                end.cost[table], end.converged[table] = minima.cost[table], True
                end.evaluations[table] += minima.evaluations[table]
                end.limit[table] = AtLimit(limit, phi, minima.hessian[table])

    def _trust_region(self, table: int, end: Minima, begin: Starts, scale: float) -> Minima:
        """Return the best end of scipy's bounded searches for one table."""
        problem, best = self.problem.table(table), end.take(np.array([table]))
        starts = np.vstack([best.theta, begin.theta[begin.table == table]])
        for start in np.clip(starts, self.low, self.high):
            end = minimise_by_scipy(problem, start, scale, self.loss)
            end.converged[:] &= Reach(problem)(end.theta)
            if end.cost[0] < best.cost[0] or not best.converged[0]:
                best = end
        return best

    def _friction_error(self, end: Minima, scale: float) -> FloatArray:
        """Return the largest standard deviation of a friction parameter, relative to its value."""
        size = np.where(self.logarithmic, 1.0, np.abs(end.theta))[:, self.friction]
        variance: FloatArray | float = 1.0
        if not self.problem.scale_known and not self.rescales:
            variance = 2.0 * end.cost / max(self.m - end.theta.shape[1], 1)
        covariance, _ = inverse(end.hessian)
        spread = np.diagonal(covariance, axis1=1, axis2=2)[:, self.friction]
        with np.errstate(divide="ignore", invalid="ignore"):
            largest = np.sqrt(variance * (spread / size**2).max(axis=1, initial=0.0))
        return np.where(np.isnan(largest), np.inf, largest)

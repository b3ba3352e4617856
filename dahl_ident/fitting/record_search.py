"""Least squares for records of any motion: automatic starts, then Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.behaviour import Behaviour
from dahl_ident.errors import FitError, FitInterrupted, argument
from dahl_ident.fitting.convergence import Ends, optima
from dahl_ident.fitting.levenberg_marquardt import Minima, minimise
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import Optimum, agreed_scale
from dahl_ident.fitting.record_refinement import (
    EXACT,
    LOOSE,
    ROUGH,
    SLOW,
    STEPS,
    Descent,
    Tell,
    correlation,
    noise_power,
    refined,
)
from dahl_ident.fitting.record_start import MORE_STARTS, STARTS, record_starts, started_at
from dahl_ident.problem import Quadratic
from dahl_ident.problem.record_noise import prediction_error_filter
from dahl_ident.problem.record_problem import RecordProblem

_SHORT = {"force": 8192, "motion": 4096}  # samples with which a long record is begun
_COMPARED = 8  # steps after which starts of a driven motion are compared
_GOOD = 0.01  # share of variance left at which no further start is tried, if it may be noise
_SAME = 1e-3  # relative difference of the costs of one minimum
_PRIORS = 4  # descents until the noise is known of which a prior is one more sample
_SAME_NOISE = 1.3  # factor within which it is
_SETTLING = 2000  # samples after which simulated noise has forgotten its start
_MEDIAN = 0.6745  # of the absolute value of a normal variable of unit variance


def solve_records(
    problem: RecordProblem,
    method: str,
    loss: str,
    start: Mapping[str, float],
    tell: Tell | None,
) -> Optimum:
    """Return the least-squares estimate; see :func:`~dahl_ident.fitting.search.solve`.

    Where all parameters of the model are started, no other start is looked at.
    """
    search = RecordSearch(method, loss, tell)
    try:
        return search.solved(problem, start)
    except KeyboardInterrupt as stop:
        if search.lowest is None:
            raise
        part, theta, _ = search.lowest
        if part.records is not problem.records:  # of a shortened problem
            values = started_at(problem, part.to_values(theta)[: len(problem.free)].tolist())
            part, theta = problem, problem.to_search(values)
        at, count = part.quadratic(theta[None]), np.array([search.evaluations])
        end = Minima(theta[None], *at[::2], np.array([False]), count)
        so_far = RecordSearch("lm", "linear").optimum(part, end)
        raise FitInterrupted("the fit was stopped before it found a minimum", so_far) from stop


def solve_repetitions(
    optimum: Optimum, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return search coordinates and standard errors of simulated repetitions, (S, P) each.

    Noise of the residuals' spectrum is added to the prediction. Standard errors are those of the
    optimum, whose covariance counts that spectrum, times the size of what each repetition leaves.
    """
    from scipy.signal import lfilter  # slow to import, and for repetitions alone

    problem: RecordProblem = optimum.problem
    values, search = optimum.values, RecordSearch("lm", "linear")
    outputs, residuals = problem.outputs(values), problem.split_residuals(values)
    noise = prediction_error_filter(residuals)
    white = [lfilter(noise, [1.0], e)[noise.size - 1 :] for e in residuals]
    size = float(np.std(np.concatenate(white)))
    theta = np.full((count, values.size), np.nan)
    scales = np.full((count, 1), np.nan)
    for row in range(count):
        drawn = [size * rng.standard_normal(y.size + _SETTLING) for y in outputs]
        errors = [lfilter([1.0], noise, e)[_SETTLING:] for e in drawn]
        again = problem.measuring([y + e for y, e in zip(outputs, errors, strict=True)])
        end = search.descend(again, optimum.theta, STEPS)
        if end.converged[0]:
            theta[row] = end.theta[0]
            scales[row] = (2.0 * end.cost[0] / again.n_residuals) ** 0.5
    own = (2.0 * optimum.cost / problem.n_residuals) ** 0.5
    return theta, np.sqrt(np.diagonal(optimum.covariance)) * scales / own


class RecordSearch(Descent):
    """One search, from starts to the estimate with what is taken out of the records."""

    def solved(self, problem: RecordProblem, start: Mapping[str, float]) -> Optimum:
        """Return the optimum of a problem."""
        steps, begin = STEPS, None
        if all(p.name in start for p in problem.free):
            begin = [start[p.name] for p in problem.free]
        elif problem.n_residuals > 2 * _SHORT[problem.output]:
            part = problem.shortened(_SHORT[problem.output])
            first = self.searched(part, start)
            hopeless = problem.output == "motion" and not first.converged[0]
            steps = ROUGH if hopeless else STEPS
            begin = part.to_values(first.theta[0])[: len(problem.free)].tolist()
        if begin is None:
            end = self.searched(problem, start)
        else:
            starts = _changed(started_at(problem, begin)[None], problem, start)
            end = self.best(problem, starts, steps)
        problem, end = refined(self, *self.freed(problem, end))
        if self.loss != "linear":
            end = self.robust(problem, end)
        return self.optimum(problem, end)

    def optimum(self, problem: RecordProblem, end: Minima) -> Optimum:
        """Return the optimum where a search has ended, exponents that nobody stated held there."""
        if problem.ranges:
            values = dict(zip(problem.names, problem.to_values(end.theta[0]), strict=True))
            problem = problem.held({name: values.pop(name) for name in problem.ranges})
            theta = problem.to_search(list(values.values()))[None]
            cost, _, hessian = problem.quadratic(theta, self.scale, self.rho)
            end = replace(end, theta=theta, cost=cost, hessian=hessian)
        end = replace(end, evaluations=np.array([self.evaluations]))
        rho = loss_named(self.loss, problem.parts)
        return optima(problem, Ends(end), self.scale, rho, self.method, end.evaluations)[0]

    def freed(self, problem: RecordProblem, held: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate with exponents that nobody stated free, their ranges as priors.

        A prior counts as one more sample of the residuals' noise, of which neighbours are alike.
        The estimate stays as it was where no motion is next to it.
        """
        assumed = [p.name for p in problem.exponents if p.assumed]
        exact = 2.0 * held.cost[0] < EXACT * problem.n_residuals
        if not assumed or exact or not held.converged[0]:
            return problem, held
        wider, end, last = problem, held, 0.0
        for _ in range(_PRIORS):
            values = wider.to_values(end.theta[0])
            residuals = wider.split_residuals(values)
            noise = noise_power(float(end.cost[0]), problem.n_residuals, residuals) ** 0.5
            if last / _SAME_NOISE < noise < last * _SAME_NOISE:
                break
            known = dict(zip(wider.names, values.tolist(), strict=True))
            wider, last = problem.freed(assumed, noise), noise
            known = {p.name: p.value for p in problem.exponents} | known
            begin = wider.to_search([known[name] for name in wider.names])
            end = self.descend(wider, begin, STEPS)
            if not end.converged[0]:
                return problem, held
        return wider, end

    def robust(self, problem: RecordProblem, plain: Minima) -> Minima:
        """Return the end of searches with a robust loss, the noise's scale estimated with it."""
        self.rho, end = loss_named(self.loss, problem.parts), plain
        dof = problem.n_residuals - plain.theta.shape[1]

        def again(scale: float) -> tuple[FloatArray, int]:
            nonlocal end
            self.scale = scale
            end = self.descend(problem, end.theta[0], STEPS)
            return end.theta[0], dof

        typical = float(np.median(problem.squares(plain.theta[0]))) ** 0.5 / _MEDIAN
        agreed_scale(problem, self.rho, again, max(typical, float(problem.rounding)))
        return end

    def searched(self, problem: RecordProblem, start: Mapping[str, float]) -> Minima:
        """Return the best end of searches from automatic starts, some of their values given."""
        try:
            best = self.best(problem, _changed(record_starts(problem, 2 * STARTS), problem, start))
        except FitError:
            more = record_starts(problem, MORE_STARTS)[2 * STARTS :]
            if not len(more):
                raise
            best = self.best(problem, _changed(more, problem, start))
        near = 2.0 * best.cost[0] < _GOOD * problem.n_residuals
        if near and (_slips_at_first(problem, best.theta[0]) or _structured(problem, best)):
            end = self.descend(problem, _first_states_again(problem, best.theta[0]), STEPS)
            best = end if end.cost[0] < best.cost[0] else best
        return best

    def best(self, problem: RecordProblem, starts: FloatArray, steps: int = STEPS) -> Minima:
        """Return the best end of searches from the starts, in their order; few where one is good.

        A driven motion is expensive where nothing fits: its starts are compared after a few steps,
        and the best one alone is followed to its end. Where one fits nearly, but leaves residuals
        that are not noise, the search goes on until two starts lead to the same end.
        """
        finite, best, again = 0, None, False
        driven = problem.output == "motion" and len(starts) > 1
        for one in starts:
            theta = problem.to_search(one)
            end = self.minimise(problem, theta[None], _COMPARED) if driven else None
            if end is None or 2.0 * end.cost[0] < _GOOD * problem.n_residuals:
                end = self.descend(problem, theta if end is None else end.theta[0], steps)
            finite += bool(np.isfinite(end.cost[0]))
            if best is not None:
                again |= bool(abs(end.cost[0] - best.cost[0]) < _SAME * best.cost[0])
            if np.isfinite(end.cost[0]) and (best is None or end.cost[0] < best.cost[0]):
                again &= best is None or bool(end.cost[0] > (1.0 - _SAME) * best.cost[0])
                best = end
            near = best is not None and 2.0 * best.cost[0] < _GOOD * problem.n_residuals
            if best is not None and near:
                if again or len(starts) == 1 or not _structured(problem, best):
                    break
            elif driven and finite == STARTS:
                break
        if best is None:
            predict = argument("output", "force", option="predicted")
            imposed = f", or, if the exciter imposes the motion, fit the force: {predict}"
            raise FitError(
                "from no start does the model give a finite motion; give "
                f"{argument('start')}, or check the units"
                + (imposed if problem.output == "motion" else "")
            )
        if driven and not best.converged[0]:
            end = self.descend(problem, best.theta[0], STEPS)
            best = end if end.cost[0] <= best.cost[0] else best
        return best


def hold_model(problem: RecordProblem, values: FloatArray) -> FloatArray:
    """Return all values of a problem, states and offsets fitted, its model's values held.

    Parameters
    ----------
    problem : RecordProblem
    values : ndarray
        Of the model's free parameters.

    Returns
    -------
    ndarray, shape (P,)

    Raises
    ------
    FitError
        If the model gives no finite motion.
    """
    full = started_at(problem, values.tolist())
    held = values.size
    theta = problem.to_search(full)

    def evaluate(at: FloatArray, _which: object) -> Quadratic:
        whole = np.column_stack([np.tile(theta[:held], (len(at), 1)), at])
        found = problem.quadratic(whole)
        return Quadratic(found.cost, found.gradient[:, held:], found.hessian[:, held:, held:])

    linear = np.zeros(theta.size - held, dtype=np.bool_)
    end = minimise(
        evaluate,
        theta[None, held:],
        linear,
        problem.n_residuals,
        tolerance_factor=LOOSE,
        steps=STEPS,
    )
    if not np.isfinite(end.cost[0]):
        raise FitError("at these parameters the motion grows beyond all bounds")
    full[held:] = end.theta[0]
    return full


def _changed(starts: FloatArray, problem: RecordProblem, start: Mapping[str, float]) -> FloatArray:
    """Return starts with some of their values given."""
    for name, value in start.items():
        if name in problem.names:
            starts[:, problem.names.index(name)] = value
    return starts


def _slips_at_first(problem: RecordProblem, theta: FloatArray) -> bool:
    """Return whether a friction force at a first sample is beyond that of full slip.

    There it has no effect, so that a search cannot come back.
    """
    values = problem.to_values(theta)
    limits = {
        e.start[0] if e.name is None else f"{e.name}_{e.start[0]}": float(e.force_bounds(own)[1])
        for e, own in problem.model.of([np.asarray(v) for v in problem.full_values(values)])
        if e.has_memory and e.start is Behaviour.start
    }
    return any(
        abs(value) > limits.get(name.rstrip("0123456789").removesuffix("_"), np.inf)
        for name, value in zip(problem.names, values.tolist(), strict=True)
    )


def _first_states_again(problem: RecordProblem, theta: FloatArray) -> FloatArray:
    """Return a point with first states as at a start."""
    values = problem.to_values(theta)
    again = started_at(problem, values[: len(problem.free)].tolist())
    return problem.to_search(again)


def _structured(problem: RecordProblem, end: Minima) -> bool:
    """Return whether a search has left residuals that follow each other as noise seldom does."""
    if 2.0 * end.cost[0] < EXACT * problem.n_residuals:
        return False
    return correlation(problem.split_residuals(problem.to_values(end.theta[0]))) > SLOW

"""Least squares for records of any motion: automatic starts, then Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.behaviour import Behaviour
from dahl_ident.errors import FitError, FitInterrupted, ModelError, choices
from dahl_ident.fitting.convergence import Ends, optima
from dahl_ident.fitting.levenberg_marquardt import Minima, minimise
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.fitting.optimum import Optimum, agreed_scale, scale_ratio
from dahl_ident.fitting.record_start import MORE_STARTS, STARTS, record_starts, started_at
from dahl_ident.fitting.scipy_least_squares import minimise_by_scipy
from dahl_ident.problem import Quadratic
from dahl_ident.problem.record_noise import prediction_error_filter, share_in_band
from dahl_ident.problem.record_problem import RecordProblem

_STEPS = 60  # at most; a search without convergence is not an estimate
_SHORT = {"force": 8192, "motion": 4096}  # samples with which a long record is begun
_COMPARED = 8  # steps after which starts of a driven motion are compared
_ROUGH = 15  # steps after which the noise is known well enough to say what a step is worth
_STAGNANT = 0.01  # relative fall of the cost in as many steps, below which more lead nowhere
_WORTHLESS = 1e-5  # fall of the cost, in units of the noise's variance
_GOOD = 0.01  # share of variance left at which no further start is tried, if it may be noise
_SAME = 1e-3  # relative difference of the costs of one minimum
_SLOW = 0.5  # correlation of neighbouring residuals that are weighted by their spectrum
_DESCRIBED = 0.1  # share of variance left beyond which the model is wrong, not the drive noisy
_EXACT = 1e-12  # share of variance left that is rounding
_REPEATS = 12  # a limit for weights that do not settle
_SETTLED = 0.03  # step in standard errors that no longer matters
_BANDS = 3  # dead bands tried: one, two and four times the noise that differences show
_CONFIRMED = 4.0  # fall of the sum of squares, in variances of the noise, that is not chance
_ALIGNED = 0.02  # of the sum of squares that a delay has to explain to be taken out
_ALIGNMENTS = 4  # steps of the delay: each leaves a hundredth of the one before
_LONGEST_DELAY = 2.0  # samples: twice the standard deviation that nobody stated
_SETTLING = 2000  # samples after which simulated noise has forgotten its start
_MEDIAN = 0.6745  # of the absolute value of a normal variable of unit variance
_LOOSE = 1e4  # of the step at which a search of a long record has converged


Tell = Callable[[int, float], None]
"""Takes the number of evaluations and the share of variance left."""


class _Trace:
    """Remembers the best values of a search, and tells how it goes."""

    def __init__(self, tell: Tell | None) -> None:
        self._tell, self._count = tell, 0
        self._best: tuple[RecordProblem, FloatArray, float] | None = None

    def __call__(self, problem: RecordProblem, theta: FloatArray, cost: float) -> None:
        self._count += 1
        if self._best is None or self._best[0] is not problem or cost < self._best[2]:
            self._best = problem, theta.copy(), cost
        if self._tell is not None:
            self._tell(self._count, 2.0 * self._best[2] / problem.n_residuals)

    def optimum(self, problem: RecordProblem) -> Optimum | None:
        """Return the best so far, None before the first evaluation."""
        if self._best is None:
            return None
        part, theta, _ = self._best
        if part.records is not problem.records:  # of a shortened problem
            values = started_at(problem, part.to_values(theta)[: len(problem.free)].tolist())
            part, theta = problem, problem.to_search(values)
        return optimum_at(part, theta, converged=False, evaluations=self._count)


def solve_records(
    problem: RecordProblem,
    *,
    method: str = "lm",
    loss: str = "linear",
    start: Mapping[str, float] | None = None,
    tell: Tell | None = None,
) -> Optimum:
    """Return the least-squares estimate.

    Parameters
    ----------
    problem : RecordProblem
        What to solve.
    method, loss : str
        As for :func:`~dahl_ident.fitting.search.solve`.
    start : mapping of str to float, optional
        Values that the search begins with; it then looks at no other start.
    tell : callable, optional
        Called after each evaluation with their number and the share of variance left.

    Returns
    -------
    Optimum

    Raises
    ------
    FitInterrupted
        If stopped from the keyboard; its `result` is the best Optimum so far.
    FitError
        If there are fewer samples than parameters, or no start gives a finite motion.
    ModelError
        If `start` names a parameter that is not free.
    """
    if problem.n_residuals <= len(problem.parameters):
        raise FitError(
            f"{problem.n_residuals} samples are fewer than the {len(problem.parameters)} unknowns"
        )
    unknown = [name for name in start or () if name not in problem.names]
    if unknown:
        raise ModelError(
            f"start names {', '.join(unknown)}; the unknowns are {choices(problem.names, *unknown)}"
        )
    problem.watch = trace = _Trace(tell)
    try:
        found = _Search(method, loss).solved(problem, start)
    except KeyboardInterrupt as stop:
        problem.watch = None
        so_far = trace.optimum(problem)
        if so_far is None:
            raise
        raise FitInterrupted("the fit was stopped before it found a minimum", so_far) from stop
    finally:
        problem.watch = None
    found.problem.watch = None  # of a weighted problem
    return found


def optimum_at(
    problem: RecordProblem,
    theta: FloatArray,
    *,
    converged: bool,
    evaluations: int,
    scale: float = 1.0,
    method: str = "lm",
    loss: str = "linear",
) -> Optimum:
    """Return the optimum at search coordinates where a search has ended."""
    at = problem.quadratic(theta[None], scale, loss_named(loss, problem.parts))
    end = Minima(theta[None], *at[::2], np.array([converged]), np.array([evaluations]))
    return _optimum(problem, end, scale, method, loss)


def solve_repetitions(
    optimum: Optimum, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return search coordinates and standard errors of simulated repetitions, (S, P) each.

    Noise of the residuals' spectrum is added to the prediction. Standard errors are those of the
    optimum, whose covariance counts that spectrum, times the size of what each repetition leaves.
    """
    from scipy.signal import lfilter  # slow to import, and for repetitions alone

    problem: RecordProblem = optimum.problem
    values, search = optimum.values, _Search("lm", "linear")
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
        end = search.descend(again, optimum.theta, _STEPS)
        if end.converged[0]:
            theta[row] = end.theta[0]
            scales[row] = (2.0 * end.cost[0] / again.n_residuals) ** 0.5
    own = (2.0 * optimum.cost / problem.n_residuals) ** 0.5
    return theta, np.sqrt(np.diagonal(optimum.covariance)) * scales / own


def _optimum(problem: RecordProblem, end: Minima, scale: float, method: str, loss: str) -> Optimum:
    rho = loss_named(loss, problem.parts)
    return optima(problem, Ends(end), scale, rho, method, end.evaluations)[0]


class _Search:
    """One search: how it steps, what it minimises, and the evaluations until now."""

    def __init__(self, method: str, loss: str) -> None:
        self.method, self.loss = method, loss
        self.evaluations, self.scale = 0, 1.0
        self.rho: Loss | None = None

    def solved(self, problem: RecordProblem, start: Mapping[str, float] | None) -> Optimum:
        """Return the optimum of a problem."""
        steps, begin = _STEPS, None
        if start is not None and all(p.name in start for p in problem.free):
            begin = [start[p.name] for p in problem.free]
        elif problem.n_residuals > 2 * _SHORT[problem.output]:
            part = problem.shortened(_SHORT[problem.output])
            first = self.searched(part, start)
            hopeless = problem.output == "motion" and not first.converged[0]
            steps = _ROUGH if hopeless else _STEPS
            begin = part.to_values(first.theta[0])[: len(problem.free)].tolist()
        if begin is None:
            end = self.searched(problem, start)
        else:
            starts = _changed(started_at(problem, begin)[None], problem, start)
            end = self.best(problem, starts, steps)
        if problem.output == "force":
            problem, end = self.without_noise(problem, end)
        problem, end = self.aligned(problem, end)
        if problem.output == "motion" and self.loss == "linear":
            problem, end = self.weighted(problem, end)
        if self.loss != "linear":
            end = self.robust(problem, end)
        end = replace(end, evaluations=np.array([self.evaluations]))
        return _optimum(problem, end, self.scale, self.method, self.loss)

    def robust(self, problem: RecordProblem, plain: Minima) -> Minima:
        """Return the end of searches with a robust loss, the noise's scale estimated with it."""
        self.rho, end = loss_named(self.loss, problem.parts), plain
        dof = problem.n_residuals - plain.theta.shape[1]

        def excess(scale: float) -> float:
            nonlocal end
            self.scale = scale
            end = self.descend(problem, end.theta[0], _STEPS)
            return float(np.log(scale_ratio(problem, end.theta[0], scale, self.rho, dof)))

        typical = float(np.median(problem.squares(plain.theta[0]))) ** 0.5 / _MEDIAN
        agreed_scale(excess, max(typical, float(problem.rounding)))
        return end

    def aligned(self, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate with the delay between the channels that the residuals ask for.

        Steps of the delay with all values free, exponents that nobody stated too, as long as each
        explains more than chance does. A small share of the residuals may as well be a part of
        what the model misses: such a delay counts as an uncertainty alone. One beyond what
        channels sampled together have stands for something else, such as a damper that the model
        lacks: then, as where the user stated the delay, none is taken out.
        """
        share = 2.0 * float(plain.cost[0]) / problem.n_residuals
        if not plain.converged[0] or "delay" in problem.calibration or share < _EXACT:
            return problem, plain
        sample, found, end = 1.0 / problem.records[0].sample_rate, problem, plain
        for _ in range(_ALIGNMENTS):
            step, fall = self._delay_step(found, end.theta[0])
            residuals = found.split_residuals(found.to_values(end.theta[0]))
            by_chance = _by_chance(float(end.cost[0]), found.n_residuals, residuals)
            part = _ALIGNED * 2.0 * float(end.cost[0]) if found is problem else 0.0
            if not fall > max(by_chance, part):
                break
            if abs(found.delay + step) > _LONGEST_DELAY * sample:
                return problem, plain
            found = found.delayed(found.delay + step)
            end = self.descend(found, end.theta[0], _STEPS)
            if not end.converged[0]:
                return problem, plain
        return (found, end) if end.cost[0] < plain.cost[0] else (problem, plain)

    def _delay_step(self, problem: RecordProblem, theta: FloatArray) -> tuple[float, float]:
        """Return the delay's Gauss-Newton step, s, and by how much the sum of squares falls."""
        values = problem.to_values(theta)
        held = [*problem.exponent_slopes(values), problem.delay_slopes(values)]
        count = theta.size + len(held)
        normal, right = np.zeros((count, count)), np.zeros(count)
        for number, slopes in enumerate(zip(*held, strict=True)):
            residual, jacobian = problem.rows(theta, number)
            more = [problem.filtered(slope / -problem.sizes[number]) for slope in slopes]
            columns = np.column_stack([jacobian, *more])
            normal += columns.T @ columns
            right += columns.T @ residual
        self.evaluations += 1 + 2 * len(held)
        size = np.sqrt(normal.diagonal())
        size[size == 0.0] = 1.0
        inverse = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
        step = -(inverse @ (right / size))
        if not inverse[-1, -1] > 0.0:
            return 0.0, 0.0
        return float(step[-1] / size[-1]), float(step[-1] ** 2 / inverse[-1, -1])

    def without_noise(self, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate without the displacement's noise, where the residuals ask for it.

        Noise that counts as travel moves the friction where the device rests. The dead band doubles
        as long as a Gauss-Newton step then leaves smaller residuals, to four times the estimate at
        most: a correlated noise shows less in differences, but a wider band would be play.
        """
        theta, least = plain.theta[0], float(plain.cost[0])
        noise, before = problem.estimated_noise, least
        if not plain.converged[0] or not problem.with_memory or noise == 0.0:
            return problem, plain
        best = problem
        for _ in range(_BANDS):
            trial = problem.without_noise(noise)
            at = trial.quadratic(theta)
            self.evaluations += 1
            left = float(at.cost) - 0.5 * float(
                at.gradient @ np.linalg.pinv(at.hessian, hermitian=True) @ at.gradient
            )
            if not left < least:
                break
            best, least, noise = trial, left, 2.0 * noise
        residuals = problem.split_residuals(problem.to_values(theta))
        by_chance = _by_chance(least, problem.n_residuals, residuals)
        if best is problem or 2.0 * (before - least) < by_chance:
            return problem, plain
        end = self.descend(best, theta, _STEPS)
        if not end.converged[0] or not end.cost[0] < before:
            return problem, plain
        return best, end

    def weighted(self, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate with residuals weighted by their spectrum, where they are slow.

        Noise in the measured drive makes the plant wander, and plain least squares then takes up
        the wandering by stiffness. The residuals' spectrum is estimated and the search repeated
        until both agree. Kept only if it describes the motion at the drive's frequencies no worse:
        slow residuals may also come from a wrong model, of which plain least squares leaves less.
        """
        residuals = problem.split_residuals(problem.to_values(plain.theta[0]))
        share = 2.0 * float(plain.cost[0]) / problem.n_residuals
        if (
            not plain.converged[0]
            or _correlation(residuals) < _SLOW
            or not _EXACT < share < _DESCRIBED
        ):
            return problem, plain
        drives = [record.force_samples for record in problem.records]
        before = share_in_band(drives, problem.measured, residuals)
        white, end = problem, plain
        for _ in range(_REPEATS):
            white = white.weighted(prediction_error_filter(residuals))
            theta = end.theta
            end = self.minimise(white, theta, _WORTHLESS * share, _STEPS)
            if not end.converged[0]:
                return problem, plain
            change = end.theta[0] - theta[0]
            residuals = white.split_residuals(white.to_values(end.theta[0]))
            noise = 2.0 * float(end.cost[0]) / problem.n_residuals
            if change @ end.hessian[0] @ change < _SETTLED**2 * noise:
                break
        if share_in_band(drives, problem.measured, residuals) > before:
            return problem, plain
        return white, end

    def searched(self, problem: RecordProblem, start: Mapping[str, float] | None) -> Minima:
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
            end = self.descend(problem, _first_states_again(problem, best.theta[0]), _STEPS)
            best = end if end.cost[0] < best.cost[0] else best
        return best

    def best(self, problem: RecordProblem, starts: FloatArray, steps: int = _STEPS) -> Minima:
        """Return the best end of searches from the starts, in their order; few where one is good.

        A driven motion is expensive where nothing fits: its starts are compared after a few steps,
        and the best one alone is followed to its end. Where one fits nearly, but leaves residuals
        that are not noise, the search goes on until two starts lead to the same end.
        """
        finite, best, again = 0, None, False
        driven = problem.output == "motion" and len(starts) > 1
        for one in starts:
            theta = problem.to_search(one)
            end = self.minimise(problem, theta[None], 0.0, _COMPARED) if driven else None
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
            imposed = ", or, if the exciter imposes the motion, fit the force: output='force'"
            raise FitError(
                "from no start does the model give a finite motion; give start=, or check the units"
                + (imposed if problem.output == "motion" else "")
            )
        if driven and not best.converged[0]:
            end = self.descend(problem, best.theta[0], _STEPS)
            best = end if end.cost[0] <= best.cost[0] else best
        return best

    def descend(self, problem: RecordProblem, theta: FloatArray, steps: int) -> Minima:
        """Return the minimum near a start; first roughly, then to a small part of the noise."""
        end = self.minimise(problem, theta[None], 0.0, _ROUGH)
        if bool(end.converged[0]) or not np.isfinite(end.cost[0]) or steps == _ROUGH:
            return end
        noise = 2.0 * float(end.cost[0]) / problem.n_residuals
        for _ in range(0, steps, _ROUGH):
            before = float(end.cost[0])
            end = self.minimise(problem, end.theta, _WORTHLESS * noise, _ROUGH)
            if bool(end.converged[0]):
                return end
            if problem.output == "motion" and end.cost[0] > (1.0 - _STAGNANT) * before:
                break
        # where a motion comes to rest, errors of its integration hide the last falls of the cost
        with np.errstate(all="ignore"):
            at = problem.quadratic(end.theta[0], self.scale, self.rho)
            if not np.isfinite(at.cost):
                return end
            size = np.sqrt(at.hessian.diagonal())
            size[size == 0.0] = 1.0  # what vanishes, such as a damper that these data do not need
            slope = at.gradient / size
            left = slope @ np.linalg.pinv(at.hessian / np.outer(size, size), hermitian=True) @ slope
        return replace(end, converged=np.array([bool(left < _SETTLED**2 * noise)]))

    def minimise(
        self, problem: RecordProblem, begin: FloatArray, enough: float, most: int
    ) -> Minima:
        """Return the minimum near a start, shape (1, P), after so many steps at most."""
        if self.method == "scipy":
            end = minimise_by_scipy(problem, begin[0], self.scale, self.rho)
        else:
            end = minimise(
                lambda at, _which: problem.quadratic(at, self.scale, self.rho),
                begin,
                problem.space.relative,
                problem.n_residuals,
                tolerance_factor=_LOOSE,
                enough=enough,
                steps=most,
            )
        self.evaluations += int(end.evaluations[0])
        return end


def _by_chance(cost: float, samples: int, residuals: Sequence[FloatArray]) -> float:
    """Return the fall of the sum of squares that one more value makes by chance."""
    slow = _correlation(residuals)
    return _CONFIRMED * 2.0 * cost / samples * (1.0 + slow) / (1.0 - slow)


def _correlation(residuals: Sequence[FloatArray]) -> float:
    """Return the correlation of residuals with those one sample later."""
    return sum(float(e[1:] @ e[:-1]) for e in residuals) / sum(float(e @ e) for e in residuals)


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
        tolerance_factor=_LOOSE,
        steps=_STEPS,
    )
    if not np.isfinite(end.cost[0]):
        raise FitError("at these parameters the motion grows beyond all bounds")
    full[held:] = end.theta[0]
    return full


def _changed(
    starts: FloatArray, problem: RecordProblem, start: Mapping[str, float] | None
) -> FloatArray:
    """Return starts with some of their values given."""
    for name, value in (start or {}).items():
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
    if 2.0 * end.cost[0] < _EXACT * problem.n_residuals:
        return False
    return _correlation(problem.split_residuals(problem.to_values(end.theta[0]))) > _SLOW

"""Least squares for records of any motion, from which delay and noise are removed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import NORMAL_MEDIAN, FloatArray, unit_diagonal
from dahl_ident.errors import FitError, FitInterrupted, argument
from dahl_ident.fitting.convergence import optima
from dahl_ident.fitting.levenberg_marquardt import Minima, minimise, minimise_by_scipy
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.fitting.optimum import Optimum, agreed_scale
from dahl_ident.fitting.record_start import alternatives, record_starts, started_at
from dahl_ident.problem import Quadratic
from dahl_ident.problem.record_noise import prediction_error_filter, share_in_band
from dahl_ident.problem.record_problem import RecordProblem

_SHORT = {"force": 8192, "motion": 4096}  # samples of a first search of a long record
_LAGS = 20  # of the residuals' correlations
_CORRELATED = 5.0  # standard deviations of the statistic of white noise that reject it
_IDLE = 0.5  # standard error of a logarithm above which a parameter has hardly an effect
_ROUNDS = 8  # most rounds of searches elsewhere: a limit on time
_WORTH = 3  # searches in each round
_SAME_EFFECT = 1e-8  # eigenvalue over the largest, below which effects of parameters are equal
_ADAPTED = 0.1, 10.0  # least and largest factor by which a value is adapted
_PRIORS = 4  # most descents until the noise, and with it the weight of priors, is known
_SAME_NOISE = 1.3  # factor within which the noise is known
_SETTLING = 2000  # samples after which simulated noise is stationary
_DESCRIBED = 0.1  # unexplained share of variance that shows a wrong model, not a noisy drive
_REWEIGHTINGS = 12  # most iterations of the weights
_BANDS = 0.0, 1.0, 2.0, 4.0  # dead bands tried, in units of the noise that differences show
_ALIGNED = 0.02  # part of the sum of squares that a delay has to explain to be removed
_LONGEST_DELAY = 2.0  # samples, if none is stated
_FARTHEST_DELAY = 3.0  # standard deviations of a stated delay
_ALIGNMENTS = 4  # most steps of the delay: small ones are a hundredth of the one before
SLOW = 0.5  # correlation of neighbouring residuals above which they are weighted by their spectrum
EXACT = 1e-12  # unexplained share of variance that is rounding
LOOSE = 1e4  # factor of the step at which a search of a long record has converged
ROUGH = 15  # steps after which the limits of first states are taken anew
SETTLED = 0.03  # step in standard errors that is negligible
_HINDERED = 0.2  # the same where the cost does not fall along a step, as across the kinks of a law
_CONFIRMED = 4.0  # fall of the sum of squares, in variances of the noise, that is significant
STEPS = 75  # most steps; a search without convergence is not an estimate

Tell = Callable[[int, float], None]
"""Callback with the number of evaluations and the unexplained share of variance."""


def solve_records(
    problem: RecordProblem,
    method: str,
    loss: str,
    start: Mapping[str, float],
    tell: Tell | None,
) -> Optimum:
    """Return the least-squares estimate; see :func:`~dahl_ident.fitting.search.solve`.

    If `start` has all parameters of the model, no other start is tried.
    """
    search = RecordSearch(method, loss, tell)
    try:
        return search.solved(problem, start)
    except KeyboardInterrupt as stop:
        if search.lowest is None:
            raise
        part, theta, _ = search.lowest
        if part.records is not problem.records:  # part is a shortened problem
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

    Noise with the residuals' spectrum is added to the prediction. Standard errors are those of the
    optimum, whose covariance accounts for that spectrum, times the relative rms residual of each
    repetition.
    """
    from scipy.signal import lfilter  # slow to import, and only for repetitions

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
        noisy = tuple(y + e for y, e in zip(outputs, errors, strict=True))
        repetition = problem.altered(output_std=problem.output_std, measured=noisy)
        end = search.descend(repetition, optimum.theta, STEPS)
        if end.converged[0]:
            theta[row] = end.theta[0]
            scales[row] = unexplained(repetition, end) ** 0.5
    usual = (2.0 * optimum.cost / problem.n_residuals) ** 0.5
    return theta, np.sqrt(np.diagonal(optimum.covariance)) * scales / usual


class RecordSearch:
    """A search from starts to the estimate, with delay and noise removed from the records.

    It counts evaluations and stores the lowest point, for an interrupt.
    """

    def __init__(self, method: str, loss: str, tell: Tell | None = None) -> None:
        self.method, self.loss, self._tell = method, loss, tell
        self.evaluations, self.scale = 0, 1.0
        self.rho: Loss | None = None
        self.lowest: tuple[RecordProblem, FloatArray, float] | None = None
        """Problem, search coordinates and cost of the lowest point so far."""

    def evaluated(self, problem: RecordProblem, theta: FloatArray) -> Quadratic:
        """Return the cost at theta, (1, P), with its derivatives, and store the lowest."""
        at = problem.quadratic(theta, self.scale, self.rho)
        self.evaluations += 1
        cost = float(at.cost[0])
        if self.lowest is None or self.lowest[0] is not problem or cost < self.lowest[2]:
            self.lowest = problem, theta[0].copy(), cost
        if self._tell is not None:
            self._tell(self.evaluations, 2.0 * self.lowest[2] / problem.n_residuals)
        return at

    def descend(self, problem: RecordProblem, theta: FloatArray, steps: int) -> Minima:
        """Return the minimum near a start: first roughly, then to a small part of the noise."""
        begin = theta[None]
        for _ in range(0, steps, ROUGH):
            end = self.minimise(problem, begin, ROUGH)
            if bool(end.converged[0]) or not np.isfinite(end.cost[0]) or steps == ROUGH:
                return end
            begin = end.theta
        return self._judged(problem, end)

    def _judged(self, problem: RecordProblem, end: Minima) -> Minima:
        """Return the end, marked as converged if the next step would be negligible."""
        noise = unexplained(problem, end)
        low, high = problem.step_bounds(problem.to_values(end.theta[0]), of_starts=True)
        # errors of the integration hide small falls of the cost where a motion comes to rest
        with np.errstate(all="ignore"):
            at = problem.quadratic(end.theta[0], self.scale, self.rho)
            if not np.isfinite(at.cost):
                return end
            hessian, size = unit_diagonal(at.hessian)
            blocked = ((end.theta[0] <= low) & (at.gradient > 0.0)) | (
                (end.theta[0] >= high) & (at.gradient < 0.0)
            )
            slope = np.where(blocked, 0.0, at.gradient / size)
            fall = slope @ np.linalg.pinv(hessian, hermitian=True) @ slope
        return replace(end, converged=np.array([bool(fall < _HINDERED**2 * noise)]))

    def minimise(self, problem: RecordProblem, begin: FloatArray, most: int) -> Minima:
        """Return the minimum near a start, shape (1, P), after at most `most` steps."""
        bounds = problem.step_bounds(problem.to_values(begin[0]), of_starts=False)
        within = bounds if np.isfinite(bounds).any() else None
        if self.method == "scipy":
            end = minimise_by_scipy(problem, begin[0], self.scale, self.rho)
            self.evaluations += int(end.evaluations[0])
            return end
        end = minimise(
            lambda at, _which: self.evaluated(problem, at),
            np.clip(begin, *bounds),
            problem.space.relative,
            problem.n_residuals,
            tolerance_factor=LOOSE,
            steps=most,
            bounds=within,
            restrained=True,
        )
        theta, signs = problem.space.unfolded(end.theta)
        hessian = end.hessian * (signs[:, :, None] * signs[:, None, :])
        end = replace(end, theta=theta, hessian=hessian)
        if unexplained(problem, end) < EXACT:  # as predicted for the last step
            end = replace(end, cost=self.evaluated(problem, end.theta).cost)
        return end

    def refined(self, problem: RecordProblem, end: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate without noise and delay, and with weights if residuals are slow."""
        if problem.output == "force":
            problem, end = self.without_noise(problem, end)
        problem, end = self.aligned(problem, end)
        if problem.output == "motion" and self.loss == "linear":
            problem, end = self.weighted(problem, end)
        return problem, end

    def aligned(self, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate with the delay between the channels that the residuals show.

        Steps of the delay are taken, with all values free, as long as each explains more than
        chance; the first may be too long. A delay is not removed, but counted as an uncertainty
        only, if it explains little or the remaining residuals are not noise, because it may be due
        to a misfit; also if it is longer than stated, or than that between channels sampled
        together, such as the effect of a missing damper.
        """
        is_exact = unexplained(problem, plain) < EXACT
        if not plain.converged[0] or is_exact:
            return problem, plain
        farthest = _FARTHEST_DELAY if "delay" in problem.calibration else _LONGEST_DELAY
        delayed, end, longest = problem, plain, farthest * problem.delay_std
        for _ in range(_ALIGNMENTS):
            step, fall = self._delay_step(delayed, end.theta[0])
            residuals = delayed.split_residuals(delayed.to_values(end.theta[0]))
            chance = significant_fall(float(end.cost[0]), delayed.n_residuals, residuals)
            part = 0.0 if delayed.delay else _ALIGNED * 2.0 * float(end.cost[0])
            if not fall > max(chance, part):
                break
            delay = float(np.clip(delayed.delay + step, -longest, longest))
            if delay == delayed.delay:
                return problem, plain
            delayed = delayed.delayed(delay)
            end = self.descend(delayed, end.theta[0], STEPS)
            if not end.converged[0]:
                return problem, plain
        residuals = delayed.split_residuals(delayed.to_values(end.theta[0]))
        if not end.cost[0] < plain.cost[0] or correlation(residuals) > SLOW:
            return problem, plain
        return delayed, end

    def without_noise(self, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate without the displacement's noise, if the residuals become smaller.

        Noise that counts as travel changes the friction force where the device rests or is slow.
        The displacement is smoothed, or movements within a dead band are not counted, or both,
        whichever leaves the smallest residuals. The band is doubled as long as they become smaller,
        up to four times the estimated noise: correlated noise shows less in differences, but a
        wider band would be play.
        """
        theta, best, lowest = plain.theta[0], problem, plain
        if not plain.converged[0] or not problem.with_memory or problem.estimated_noise == 0.0:
            return problem, plain
        bases = [problem]
        if all(record.uniform for record in problem.records):
            bases.append(problem.smoothed())
        for base in bases:
            least = np.inf if base.is_smoothed else float(plain.cost[0])
            for factor in _BANDS if base.is_smoothed else _BANDS[1:]:
                trial = base.without_noise(factor * base.path_noise)
                end = self.descend(trial, theta, STEPS)
                if not end.converged[0] or not end.cost[0] < least:
                    break
                least = float(end.cost[0])
                if least < lowest.cost[0]:
                    best, lowest = trial, end
        residuals = problem.split_residuals(problem.to_values(theta))
        chance = significant_fall(float(lowest.cost[0]), problem.n_residuals, residuals)
        if not 2.0 * (plain.cost[0] - lowest.cost[0]) > chance:
            return problem, plain
        return best, lowest

    def weighted(self, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate with residuals weighted by their spectrum, where they are slow.

        Noise in the measured drive makes the plant drift, which plain least squares explains by
        stiffness. The spectrum of the residuals is estimated and the search repeated until they
        agree. The weights are discarded if they make the misfit at the drive's frequencies larger,
        because slow residuals may also be due to a wrong model.
        """
        residuals = problem.split_residuals(problem.to_values(plain.theta[0]))
        is_noise = EXACT < unexplained(problem, plain) < _DESCRIBED
        if not plain.converged[0] or correlation(residuals) < SLOW or not is_noise:
            return problem, plain
        drives = [record.force_samples for record in problem.records]
        before = share_in_band(drives, problem.measured, residuals)
        white, end = problem, plain
        for _ in range(_REWEIGHTINGS):
            white = white.with_whitening(prediction_error_filter(residuals))
            theta = end.theta
            end = self.minimise(white, theta, STEPS)
            if not end.converged[0]:
                return problem, plain
            change = end.theta[0] - theta[0]
            residuals = white.split_residuals(white.to_values(end.theta[0]))
            if change @ end.hessian[0] @ change < SETTLED**2 * unexplained(white, end):
                break
        if share_in_band(drives, problem.measured, residuals) > before:
            return problem, plain
        return white, end

    def _delay_step(self, problem: RecordProblem, theta: FloatArray) -> tuple[float, float]:
        """Return the Gauss-Newton step of the delay, s, and the fall of the sum of squares."""
        residual, jacobian = problem.residuals_and_jacobian(theta)
        waves = problem.delay_slopes(problem.to_values(theta))
        slope = np.concatenate([problem.filtered(wave / -problem.output_std) for wave in waves])
        columns = np.column_stack([jacobian, np.pad(slope, (0, len(residual) - len(slope)))])
        normal, size = unit_diagonal(columns.T @ columns)
        self.evaluations += 1 if problem.output == "motion" else 3
        inverse = np.linalg.pinv(normal, hermitian=True)
        step = -(inverse @ (columns.T @ residual / size))
        if not inverse[-1, -1] > 0.0:
            return 0.0, 0.0
        return float(step[-1] / size[-1]), float(step[-1] ** 2 / inverse[-1, -1])

    def solved(self, problem: RecordProblem, start: Mapping[str, float]) -> Optimum:
        """Return the optimum of a problem.

        A long record is searched from the end of a search of its part with the largest motion. That
        part may determine less than the whole; the search goes on if the end is near.
        """
        if all(p.name in start for p in problem.free):
            end = self.near(problem, [start[p.name] for p in problem.free], start, STEPS)
        elif problem.n_residuals > 2 * _SHORT[problem.output]:
            part = problem.shortened(_SHORT[problem.output])
            first = self.searched(part, start)
            hopeless = problem.output == "motion" and not first.converged[0]
            begin = part.to_values(first.theta[0])[: len(problem.free)].tolist()
            end = self.near(problem, begin, start, ROUGH if hopeless else STEPS)
        else:
            end = self.searched(problem, start)
        if not end.converged[0] and unexplained(problem, end) < _DESCRIBED:
            end = self.descend(problem, end.theta[0], STEPS)
        problem, end = self.refined(*self.freed(problem, end))
        if self.loss != "linear":
            end = self.robust(problem, end)
        return self.optimum(problem, end)

    def near(
        self, problem: RecordProblem, values: list[float], start: Mapping[str, float], steps: int
    ) -> Minima:
        """Return the end of a search from values of the model, changed to those in `start`."""
        return self.first(problem, [_changed(started_at(problem, values), problem, start)], steps)

    def optimum(self, problem: RecordProblem, end: Minima) -> Optimum:
        """Return the optimum at the end of a search, with assumed exponents fixed there."""
        ordered = problem.in_order(end.theta)
        if (ordered != end.theta).any():
            cost, _, hessian = problem.quadratic(ordered, self.scale, self.rho)
            end = replace(end, theta=ordered, cost=cost, hessian=hessian)
        if problem.ranges:
            values = dict(zip(problem.names, problem.to_values(end.theta[0]), strict=True))
            theta = end.theta[:, [name not in problem.ranges for name in problem.names]]
            problem = problem.held({name: values[name] for name in problem.ranges})
            cost, _, hessian = problem.quadratic(theta, self.scale, self.rho)
            end = replace(end, theta=theta, cost=cost, hessian=hessian)
        end = replace(end, evaluations=np.array([self.evaluations]))
        rho = loss_named(self.loss, problem.residuals_per_row)
        return optima(problem, end, self.scale, rho, self.method)[0]

    def freed(self, problem: RecordProblem, fixed: Minima) -> tuple[RecordProblem, Minima]:
        """Return the estimate with assumed exponents free, their ranges as priors.

        The noise with which a prior is weighted accounts for the correlation of the residuals. The
        estimate is not changed if the search does not converge.
        """
        assumed = [p.name for p in problem.exponents if p.assumed]
        if not assumed or unexplained(problem, fixed) < EXACT or not fixed.converged[0]:
            return problem, fixed
        wider, end, last = problem.freed(assumed, 1.0), fixed, 0.0
        theta = wider.to_search(problem.values_in(wider, problem.to_values(fixed.theta[0])))
        for _ in range(_PRIORS):
            residuals = wider.split_residuals(wider.to_values(theta))
            noise = noise_power(float(end.cost[0]), problem.n_residuals, residuals) ** 0.5
            if last / _SAME_NOISE < noise < last * _SAME_NOISE:
                break
            wider, last = problem.freed(assumed, noise), noise
            end = self.descend(wider, theta, STEPS)
            if not end.converged[0]:
                return problem, fixed
            theta = end.theta[0]
        return wider, end

    def robust(self, problem: RecordProblem, plain: Minima) -> Minima:
        """Return the end of searches with a robust loss, and estimate the noise's scale."""
        self.rho, end = loss_named(self.loss, problem.residuals_per_row), plain
        dof = problem.n_residuals - plain.theta.shape[1]

        def again(scale: float) -> tuple[FloatArray, int]:
            nonlocal end
            self.scale = scale
            end = self.descend(problem, end.theta[0], STEPS)
            return end.theta[0], dof

        typical = float(np.median(problem.squares(plain.theta[0]))) ** 0.5 / NORMAL_MEDIAN
        agreed_scale(problem, self.rho, again, max(typical, float(problem.rounding)))
        return end

    def searched(self, problem: RecordProblem, start: Mapping[str, float]) -> Minima:
        """Return the end of a search from the automatic start, with the values in `start`.

        The residuals of a right end are white noise, and every parameter has an effect there;
        otherwise the search goes on from other values.
        """
        starts = (_changed(values, problem, start) for values in record_starts(problem))
        best = self.first(problem, starts, STEPS)
        several = any(len(element.starts) > 1 for element in problem.with_memory)
        if several or _has_idle(problem, best) or not _is_white(problem, best):
            return self.elsewhere(problem, best)
        return best

    @np.errstate(all="ignore")  # laws far off may overflow
    def elsewhere(self, problem: RecordProblem, end: Minima) -> Minima:
        """Return the lowest end of searches from other values of one parameter at a time.

        At a wrong minimum a parameter has often lost its effect, such as a Stribeck speed far above
        the motion, or the initial loads of springs are wrong. The other values with the lowest
        predicted costs are tried.
        """
        for _ in range(_ROUNDS):
            values, candidates = problem.to_values(end.theta[0]), []
            for index, value in alternatives(problem, values):
                other = values.copy()
                other[index] = value
                candidates.append(self._adapted(problem, problem.to_search(other), index))
            candidates.sort(key=lambda candidate: candidate[0])
            starts = [theta for cost, theta in candidates if cost < np.inf][:_WORTH]
            ends = [self.minimise(problem, theta[None], ROUGH) for theta in starts]
            lowest = min(ends, key=lambda minimum: float(minimum.cost[0]), default=end)
            chance = 0.0
            with suppress(FitError):  # values so far off that their motion is not always found
                residuals = problem.split_residuals(values)
                chance = significant_fall(float(end.cost[0]), problem.n_residuals, residuals)
            better = 2.0 * (end.cost[0] - lowest.cost[0]) > chance
            if better or (lowest.cost[0] < end.cost[0] and not end.converged[0]):
                end = self.descend(problem, lowest.theta[0], STEPS)
            if not better:
                break
        return end

    def _adapted(
        self, problem: RecordProblem, theta: FloatArray, index: int
    ) -> tuple[float, FloatArray]:
        """Return predicted cost and theta after a Gauss-Newton step of all coordinates but one."""
        at = problem.quadratic(theta)
        self.evaluations += 1
        if not np.isfinite(at.cost):
            return np.inf, theta
        matrix, size = unit_diagonal(at.hessian)
        slope = at.gradient / size
        slope[index], matrix[index], matrix[:, index] = 0.0, 0.0, 0.0
        step = -np.linalg.pinv(matrix, rcond=_SAME_EFFECT, hermitian=True) @ slope
        predicted = float(at.cost) + 0.5 * float(step @ slope)
        step /= size
        # forces are linear in most values, not in their logarithms
        relative = problem.space.relative
        step[relative] = np.log(np.clip(1.0 + step[relative], *_ADAPTED))
        return predicted, theta + step

    def first(self, problem: RecordProblem, starts: Iterable[FloatArray], steps: int) -> Minima:
        """Return the end of a search from the first start whose motion is finite."""
        for start in starts:
            end = self.descend(problem, problem.to_search(start), steps)
            if np.isfinite(end.cost[0]):
                return end
        predict = argument("output", "force", option="predicted")
        imposed = f", or, if the exciter imposes the motion, fit the force: {predict}"
        raise FitError(
            "from no start does the model give a finite motion; give "
            f"{argument('start')}, or check the units"
            + (imposed if problem.output == "motion" else "")
        )


def unexplained(problem: RecordProblem, end: Minima) -> float:
    """Return the share of variance that the end of a search leaves: the residuals' mean square."""
    return 2.0 * float(end.cost[0]) / problem.n_residuals


def significant_fall(cost: float, samples: int, residuals: Sequence[FloatArray]) -> float:
    """Return the significant fall of the sum of squares due to one more parameter."""
    return _CONFIRMED * noise_power(cost, samples, residuals)


def noise_power(cost: float, samples: int, residuals: Sequence[FloatArray]) -> float:
    """Return the variance of residuals, times the factor that their correlation adds."""
    slow = correlation(residuals)
    return 2.0 * cost / samples * (1.0 + slow) / (1.0 - slow)


def correlation(residuals: Sequence[FloatArray]) -> float:
    """Return the correlation of residuals with those one sample later."""
    return sum(float(e[1:] @ e[:-1]) for e in residuals) / sum(float(e @ e) for e in residuals)


def hold_model(problem: RecordProblem, values: FloatArray) -> FloatArray:
    """Return all values of a problem: the model's free `values`, with fitted states and offsets."""
    held = problem.held(dict(zip(problem.names, values.tolist(), strict=False)))
    begin = held.to_search(started_at(held, []))
    end = RecordSearch("lm", "linear").descend(held, begin, STEPS)
    if not np.isfinite(end.cost[0]):
        raise FitError("at these parameters the motion grows beyond all bounds")
    return np.concatenate([values, held.to_values(end.theta[0])])


def _changed(values: FloatArray, problem: RecordProblem, start: Mapping[str, float]) -> FloatArray:
    """Return the values of a problem with those in `start`."""
    given = zip(problem.names, values.tolist(), strict=True)
    return np.array([start.get(name, value) for name, value in given])


def _is_white(problem: RecordProblem, end: Minima) -> bool:
    """Return whether the residuals are white noise, by the Box-Pierce test."""
    if unexplained(problem, end) < EXACT:
        return True
    products = np.zeros(_LAGS + 1)
    try:
        residuals = problem.split_residuals(problem.to_values(end.theta[0]))
    except FitError:  # values so far off that not every way to integrate them succeeds
        return False
    for e in residuals:
        products += [float(e[k:] @ e[: max(e.size - k, 0)]) for k in range(_LAGS + 1)]
    statistic = problem.n_residuals * float(((products[1:] / products[0]) ** 2).sum())
    return bool(statistic < _LAGS + _CORRELATED * (2.0 * _LAGS) ** 0.5)


def _has_idle(problem: RecordProblem, end: Minima) -> bool:
    """Return whether a parameter has hardly an effect, or friction starts at a bound.

    A parameter has hardly an effect if its logarithm has a standard error above 0.5.
    """
    theta, hessian = end.theta[0], end.hessian[0]
    low, high = problem.step_bounds(problem.to_values(theta), of_starts=True)
    if ((theta <= low) | (theta >= high)).any():
        return True
    noise = unexplained(problem, end)
    scaled, size = unit_diagonal(hessian)
    inverse = np.linalg.pinv(scaled, rcond=EXACT, hermitian=True)
    idle = (noise * inverse.diagonal() / size**2 > _IDLE**2) & problem.space.relative
    idle |= (hessian == np.eye(len(hessian))).all(axis=1)  # rows of parameters without effect
    return bool(idle[: len(problem.free)].any())

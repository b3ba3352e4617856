"""Steps of a search of records, and what an estimate takes out: a delay and noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.levenberg_marquardt import Minima, minimise
from dahl_ident.fitting.losses import Loss
from dahl_ident.fitting.scipy_least_squares import minimise_by_scipy
from dahl_ident.problem import Quadratic
from dahl_ident.problem.record_noise import prediction_error_filter, share_in_band
from dahl_ident.problem.record_problem import RecordProblem

_DESCRIBED = 0.1  # share of variance left beyond which the model is wrong, not the drive noisy
_REPEATS = 12  # a limit for weights that do not settle
_BANDS = 3  # dead bands tried: one, two and four times the noise that differences show
_ALIGNED = 0.02  # of the sum of squares that a delay has to explain to be taken out
_LONGEST_DELAY = 2.0  # samples: twice the standard deviation that nobody stated
_ALIGNMENTS = 4  # steps of the delay: each leaves a hundredth of the one before


def refined(search: Descent, problem: RecordProblem, end: Minima) -> tuple[RecordProblem, Minima]:
    """Return the estimate with everything taken out that the residuals ask for."""
    if problem.output == "force":
        problem, end = without_noise(search, problem, end)
    problem, end = aligned(search, problem, end)
    if problem.output == "motion" and search.loss == "linear":
        problem, end = weighted(search, problem, end)
    return problem, end


def aligned(search: Descent, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
    """Return the estimate with the delay between the channels that the residuals ask for.

    Steps of the delay with all values free, as long as each explains more than chance does. Where
    it explains little, or what remains is not noise, it may as well stand for a part of what the
    model misses: such a delay counts as an uncertainty alone. So does one beyond what channels
    sampled together have, such as that of a damper that the model lacks. None is taken out where
    the user stated the delay.
    """
    share = 2.0 * float(plain.cost[0]) / problem.n_residuals
    if not plain.converged[0] or "delay" in problem.calibration or share < EXACT:
        return problem, plain
    sample, found, end = 1.0 / problem.records[0].sample_rate, problem, plain
    for _ in range(_ALIGNMENTS):
        step, fall = _delay_step(search, found, end.theta[0])
        residuals = found.split_residuals(found.to_values(end.theta[0]))
        chance = by_chance(float(end.cost[0]), found.n_residuals, residuals)
        part = 0.0 if found.delay else _ALIGNED * 2.0 * float(end.cost[0])
        if not fall > max(chance, part):
            break
        if abs(found.delay + step) > _LONGEST_DELAY * sample:
            return problem, plain
        found = found.delayed(found.delay + step)
        end = search.descend(found, end.theta[0], STEPS)
        if not end.converged[0]:
            return problem, plain
    residuals = found.split_residuals(found.to_values(end.theta[0]))
    if not end.cost[0] < plain.cost[0] or correlation(residuals) > SLOW:
        return problem, plain
    return found, end


def without_noise(
    search: Descent, problem: RecordProblem, plain: Minima
) -> tuple[RecordProblem, Minima]:
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
        search.evaluations += 1
        left = float(at.cost) - 0.5 * float(
            at.gradient @ np.linalg.pinv(at.hessian, hermitian=True) @ at.gradient
        )
        if not left < least:
            break
        best, least, noise = trial, left, 2.0 * noise
    residuals = problem.split_residuals(problem.to_values(theta))
    chance = by_chance(least, problem.n_residuals, residuals)
    if best is problem or 2.0 * (before - least) < chance:
        return problem, plain
    end = search.descend(best, theta, STEPS)
    if not end.converged[0] or not end.cost[0] < before:
        return problem, plain
    return best, end


def weighted(
    search: Descent, problem: RecordProblem, plain: Minima
) -> tuple[RecordProblem, Minima]:
    """Return the estimate with residuals weighted by their spectrum, where they are slow.

    Noise in the measured drive makes the plant wander, and plain least squares then takes up
    the wandering by stiffness. The residuals' spectrum is estimated and the search repeated
    until both agree. Kept only if it describes the motion at the drive's frequencies no worse:
    slow residuals may also come from a wrong model, of which plain least squares leaves less.
    """
    residuals = problem.split_residuals(problem.to_values(plain.theta[0]))
    share = 2.0 * float(plain.cost[0]) / problem.n_residuals
    if not plain.converged[0] or correlation(residuals) < SLOW or not EXACT < share < _DESCRIBED:
        return problem, plain
    drives = [record.force_samples for record in problem.records]
    before = share_in_band(drives, problem.measured, residuals)
    white, end = problem, plain
    for _ in range(_REPEATS):
        white = white.weighted(prediction_error_filter(residuals))
        theta = end.theta
        end = search.minimise(white, theta, STEPS)
        if not end.converged[0]:
            return problem, plain
        change = end.theta[0] - theta[0]
        residuals = white.split_residuals(white.to_values(end.theta[0]))
        noise = 2.0 * float(end.cost[0]) / problem.n_residuals
        if change @ end.hessian[0] @ change < SETTLED**2 * noise:
            break
    if share_in_band(drives, problem.measured, residuals) > before:
        return problem, plain
    return white, end


def _delay_step(search: Descent, problem: RecordProblem, theta: FloatArray) -> tuple[float, float]:
    """Return the delay's Gauss-Newton step, s, and by how much the sum of squares falls."""
    residual, jacobian = problem.residuals_and_jacobian(theta)
    waves = problem.delay_slopes(problem.to_values(theta))
    slope = np.concatenate([problem.filtered(wave / -problem.sizes[0]) for wave in waves])
    columns = np.column_stack([jacobian, np.pad(slope, (0, len(residual) - len(slope)))])
    normal, right = columns.T @ columns, columns.T @ residual
    search.evaluations += 3
    size = np.sqrt(normal.diagonal())
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
    step = -(inverse @ (right / size))
    if not inverse[-1, -1] > 0.0:
        return 0.0, 0.0
    return float(step[-1] / size[-1]), float(step[-1] ** 2 / inverse[-1, -1])


SLOW = 0.5  # correlation of neighbouring residuals that are weighted by their spectrum
EXACT = 1e-12  # share of variance left that is rounding
LOOSE = 1e4  # of the step at which a search of a long record has converged
ROUGH = 15  # steps after which the noise is known well enough to say what a step is worth
_STAGNANT = 0.01  # relative fall of the cost in as many steps, below which more lead nowhere
WORTHLESS = 1e-5  # fall of the cost, over the residuals' variance
SETTLED = 0.03  # step in standard errors that no longer matters
_CONFIRMED = 4.0  # fall of the sum of squares, in variances of the noise, that is not chance
STEPS = 75  # at most; a search without convergence is not an estimate


Tell = Callable[[int, float], None]
"""Takes the number of evaluations and the share of variance left."""


class Descent:
    """How a search steps, what it minimises, and how far it has come."""

    def __init__(self, method: str, loss: str, tell: Tell | None = None) -> None:
        self.method, self.loss, self._tell = method, loss, tell
        self.evaluations, self.scale = 0, 1.0
        self.rho: Loss | None = None
        self.lowest: tuple[RecordProblem, FloatArray, float] | None = None
        """Problem, search coordinates and cost of the best place until now."""

    def evaluated(self, problem: RecordProblem, theta: FloatArray) -> Quadratic:
        """Return the cost at theta, (1, P), with its derivatives, and remember the lowest."""
        at = problem.quadratic(theta, self.scale, self.rho)
        self.evaluations += 1
        cost = float(at.cost[0])
        if self.lowest is None or self.lowest[0] is not problem or cost < self.lowest[2]:
            self.lowest = problem, theta[0].copy(), cost
        if self._tell is not None:
            self._tell(self.evaluations, 2.0 * self.lowest[2] / problem.n_residuals)
        return at

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
        bounds = problem.step_bounds(problem.to_values(begin[0]), of_starts=bounded)
        within = bounds if np.isfinite(bounds).any() else None
        known = bounded or problem.whitening.size > 1  # how large the noise is
        enough = (lambda cost: WORTHLESS * 2.0 * cost / problem.n_residuals) if known else None
        if self.method == "scipy":
            end = minimise_by_scipy(problem, begin[0], self.scale, self.rho)
            self.evaluations += int(end.evaluations[0])
            return end
        return minimise(
            lambda at, _which: self.evaluated(problem, at),
            np.clip(begin, *bounds),
            problem.space.relative,
            problem.n_residuals,
            tolerance_factor=LOOSE,
            enough=enough,
            steps=most,
            bounds=within,
            unseen=False,
        )


def by_chance(cost: float, samples: int, residuals: Sequence[FloatArray]) -> float:
    """Return the fall of the sum of squares that one more value makes by chance."""
    return _CONFIRMED * noise_power(cost, samples, residuals)


def noise_power(cost: float, samples: int, residuals: Sequence[FloatArray]) -> float:
    """Return the variance of residuals as slow as those given, times what slowness makes of it."""
    slow = correlation(residuals)
    return 2.0 * cost / samples * (1.0 + slow) / (1.0 - slow)


def correlation(residuals: Sequence[FloatArray]) -> float:
    """Return the correlation of residuals with those one sample later."""
    return sum(float(e[1:] @ e[:-1]) for e in residuals) / sum(float(e @ e) for e in residuals)

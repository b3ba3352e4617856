"""What an estimate of records takes out of them: a delay, noise of the displacement, slow noise."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.fitting.levenberg_marquardt import Minima
from dahl_ident.fitting.record_descent import (
    EXACT,
    SETTLED,
    SLOW,
    STEPS,
    Descent,
    by_chance,
    correlation,
)
from dahl_ident.problem.record_noise import prediction_error_filter, share_in_band
from dahl_ident.problem.record_problem import RecordProblem

_DESCRIBED = 0.1  # share of variance left beyond which the model is wrong, not the drive noisy
_REPEATS = 12  # a limit for weights that do not settle
_BANDS = 3  # dead bands tried: one, two and four times the noise that differences show
_ALIGNED = 0.02  # of the sum of squares that a delay has to explain to be taken out
_LONGEST_DELAY = 2.0  # samples: twice the standard deviation that nobody stated
_ALIGNMENTS = 4  # steps of the delay: each leaves a hundredth of the one before


def aligned(search: Descent, problem: RecordProblem, plain: Minima) -> tuple[RecordProblem, Minima]:
    """Return the estimate with the delay between the channels that the residuals ask for.

    Steps of the delay with all values free, exponents that nobody stated too, as long as each
    explains more than chance does. Where it explains little, or what remains is not noise, it may
    as well stand for a part of what the model misses: such a delay counts as an uncertainty alone.
    So does one beyond what channels sampled together have, such as that of a damper that the model
    lacks. None is taken out where the user stated the delay.
    """
    share = 2.0 * float(plain.cost[0]) / problem.n_residuals
    if not plain.converged[0] or "delay" in problem.calibration or share < EXACT:
        return problem, plain
    sample, found, end = 1.0 / problem.records[0].sample_rate, problem, plain
    for _ in range(_ALIGNMENTS):
        step, fall = _delay_step(search, found, end.theta[0])
        residuals = found.split_residuals(found.to_values(end.theta[0]))
        chance = by_chance(float(end.cost[0]), found.n_residuals, residuals)
        part = _ALIGNED * 2.0 * float(end.cost[0]) if found is problem else 0.0
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
    search.evaluations += 1 + 2 * len(held)
    size = np.sqrt(normal.diagonal())
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(normal / np.outer(size, size), hermitian=True)
    step = -(inverse @ (right / size))
    if not inverse[-1, -1] > 0.0:
        return 0.0, 0.0
    return float(step[-1] / size[-1]), float(step[-1] ** 2 / inverse[-1, -1])

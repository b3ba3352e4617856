"""Errors of a fit to records: noise, model error, drive, calibration; and their budget.

Residuals of a correct model are noise, white or not, which does not depend on the motion. Those of
a wrong model are a function of the motion's state: the friction force, the velocity or the
displacement. So functions of the state are fitted to the residuals together with the parameters,
and compared with the remaining noise: slow noise has few effective samples, and may look like a
function of the state by chance.

The changes of the parameters by these functions are the model error: the misfit is assumed to be as
large in the directions of the parameters, where the residuals cannot show it, as in others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from dahl_ident.arrays import FloatArray, IntArray
from dahl_ident.diagnostics.contributions import (
    ALONG_MOTION,
    EXPONENT,
    MODEL_ERROR,
    NOISE,
    RUNS,
    ErrorContributions,
    satterthwaite,
    variances,
)
from dahl_ident.diagnostics.estimate import assumed_exponents
from dahl_ident.diagnostics.record_channels import (
    DISPLACEMENT_GAIN,
    DRIVE,
    FORCE,
    by_calibration,
    by_drive,
    by_other_motions,
    motion_sources,
    with_noisier_displacement,
)
from dahl_ident.diagnostics.record_sources import (
    BLOCKS,
    ContradictedExponent,
    LinearFit,
    between_records,
    blocks_of,
    by_exponents,
    contradicted_exponents,
    correlated,
    delay_std,
    noise_in,
    sandwich,
    widened,
)
from dahl_ident.elements import Friction
from dahl_ident.elements.recursion import linear_recursion, stretches
from dahl_ident.errors import FitError
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.problem.record_noise import in_band
from dahl_ident.problem.record_problem import RecordProblem

_FUNCTION_BY_CHANCE = 1e-3  # of all functions together; wrong laws are far more significant
_SEEN = 0.01  # part of a function that the parameters do not explain, above which it counts
_FRICTION_LEVELS = np.linspace(-1.0, 1.0, 7)  # of the friction force in the direction of motion
_SPEEDS = 2.0 ** np.arange(1, 4)  # highest speed over the speeds of decaying functions
_BLOCKS = 60  # of all records, between which the noise may differ: far more than functions
_FORCE_STEP = 1e-3  # of the drive, for the motion's derivatives with respect to a force
FRICTION, VELOCITY, DISPLACEMENT = "the friction force", "the velocity", "the displacement"
REMEDY = {
    FRICTION: ("", "fit another friction law"),
    VELOCITY: ("damper", "fit a law that changes with the speed"),
    DISPLACEMENT: ("spring", "look for a stiffness that is not linear"),
}
"""An element to add, if the model has none, and another remedy, by what the residuals follow."""
_SLIGHT = 1e-6  # standard deviation along a direction, over the largest, that is rounding
_SHORTENS = 0.5  # part of u: without a smaller source, intervals are at most 10 % too short


@dataclass(frozen=True)
class MotionMisfit:
    """Dependence of the residuals on the motion's state that exceeds chance."""

    scores: FloatArray  # (Q, Q): covariance of J'e due to this dependence
    follows: str  # quantity that explains most of the residuals
    share: float  # of their variance that it explains
    functions: int  # number of functions from which the covariance was estimated

    def covariance(self, fit: LinearFit) -> FloatArray:
        """Return the covariance of the estimate due to this dependence."""
        return np.asarray(fit.inverse @ self.scores @ fit.inverse)


def motion_misfit(
    fit: LinearFit, other_motions: Collection[Sequence[FloatArray]]
) -> MotionMisfit | None:
    """Return the model error that the residuals show as functions of the motion's state.

    Residuals that the delay explains, or changes of the outputs by `other_motions`, are not a model
    error. None if chance explains the dependence.
    """
    problem, values, residuals = fit.problem, fit.values, fit.residuals
    ends, count = np.cumsum([e.size for e in residuals])[:-1], values.size
    J, e = np.concatenate(fit.jacobians), np.concatenate(residuals)
    channels = [np.concatenate(changes) for changes in other_motions]
    with suppress(FitError):  # no motion close to the estimate
        channels.append(np.concatenate(fit.delay_slopes))
    known = _basis(np.column_stack([J, *channels]))
    e = e - known @ (known.T @ e)
    waves = dict[str, FloatArray]()
    try:
        parts = [_functions(fit, number) for number in range(len(problem.records))]
    except FitError:  # no motion close to the estimate
        return None
    for name in parts[0]:
        wave = np.concatenate([problem.filtered(part[name]) for part in parts])
        waves[name] = _basis(wave, _SEEN)
    unexplained = {name: _part(B - known @ (known.T @ B), _SEEN) for name, B in waves.items()}
    starts = np.append(0, ends)
    blocks = [starts[number] + rows for number, rows in blocks_of(residuals, _BLOCKS)]
    scores, significant = np.zeros((count, count)), dict[str, tuple[float, int]]()
    for name, Q in unexplained.items():
        remaining = e - Q @ (Q.T @ e)
        if not (Q.shape[1] and remaining.any()):
            continue
        whole = np.column_stack([known, Q])
        noise = noise_in(np.split(whole, ends), np.split(remaining, ends))
        dof = max(_samples_of(noise, residuals) - whole.shape[1], 1.0)
        pieces = zip(np.split(Q, ends), noise, strict=True)
        by_noise = np.asarray(sum(q.T @ correlated(q, c) for q, c in pieces))
        fitted = Q.T @ e
        square = float(fitted @ np.linalg.solve(by_noise, fitted))
        expected = Q.shape[1] * max(_between_blocks(Q, remaining, blocks, by_noise), 1.0)
        chance = special.fdtrc(Q.shape[1], dof, square / expected)
        if not chance < _FUNCTION_BY_CHANCE / len(unexplained):
            continue
        along = Q.T @ waves[name]
        unit = float(np.trace(np.linalg.solve(by_noise, along @ along.T)))
        seen = J.T @ waves[name]
        scores += (square - expected) / unit * seen @ seen.T
        significant[name] = float(fitted @ fitted) / float(e @ e), Q.shape[1]
    if not significant:
        return None
    follows = max(significant, key=lambda name: significant[name][0])
    return MotionMisfit(scores, follows, *significant[follows])


def _between_blocks(
    Q: FloatArray, residuals: FloatArray, blocks: Sequence[IntArray], by_noise: FloatArray
) -> float:
    """Return the variance of the fitted coefficients, from blocks, over that `by_noise`.

    The noise may vary along a record, for example between sticking and slipping. Each block's
    residuals are those of a fit without it.
    """
    unit = np.eye(Q.shape[1])
    scores = [np.linalg.pinv(unit - Q[b].T @ Q[b]) @ Q[b].T @ residuals[b] for b in blocks]
    squares = [float(score @ np.linalg.solve(by_noise, score)) for score in scores]
    return float(sum(squares) / Q.shape[1])


def _samples_of(noise: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> float:
    """Return the number of samples of white noise that would determine its variance as well."""
    pairs = [(c, e.size) for c, e in zip(noise, residuals, strict=True)]
    spread = sum(n * float(2.0 * c @ c - c[0] ** 2) for c, n in pairs)
    return sum(n * float(c[0]) for c, n in pairs) ** 2 / spread


def _basis(waves: FloatArray, least: float = 1e-9) -> FloatArray:
    """Return an orthonormal basis of normalized columns, without directions below `least`."""
    length = np.linalg.norm(waves, axis=0)
    return _part(waves[:, length > 0.0] / length[length > 0.0], least)


def _part(waves: FloatArray, least: float) -> FloatArray:
    """Return an orthonormal basis of the directions that are not smaller than `least`."""
    vectors, sizes, _ = np.linalg.svd(waves, full_matrices=False)
    return np.asarray(vectors[:, sizes > least])


def _functions(fit: LinearFit, number: int) -> dict[str, FloatArray]:
    """Return the changes of a record's output by forces that depend on the state, (n, k) each."""
    problem, values = fit.problem, fit.values
    record = problem.records[number]
    if problem.output == "force":
        x, v, _ = problem.motions[number]
        x = x if problem.paths is None else problem.paths[number]
        return _forces(problem, values, x, v if v.size else np.gradient(x, record.time))
    plain = fit.outputs[number]
    step = _FORCE_STEP * float(problem.unit_sizes((1, 0, 0))[number])

    def moved(force: FloatArray) -> FloatArray:
        if not (size := np.std(force)):
            return np.zeros(plain.shape)  # as many columns as in other records
        driven = problem.driven_more({number: step / size * force})
        return driven.predict(values, number, derivatives=False).output - plain

    forces = _forces(problem, values, *in_band(record, plain)[:2])
    return {
        name: np.column_stack([moved(wave) for wave in waves.T]) for name, waves in forces.items()
    }


def _forces(
    problem: RecordProblem, values: FloatArray, x: FloatArray, v: FloatArray
) -> dict[str, FloatArray]:
    """Return forces that depend on the state of a motion, (n, k), by what they depend on.

    An error of the law's slope, a function of the force or of the speed, changes the friction
    force, and the change decays over the characteristic displacement.
    """
    parts = stretches(x)
    heading, farthest = parts.spread(parts.direction), float(parts.path.max()) or 1.0
    friction, lengths = 0.0 * x, set[float]()
    for element, at in problem.model.of(problem.full_values(values)):
        if isinstance(element, Friction):
            start: Any = np.zeros(len(element.starts)) if len(element.starts) > 1 else 0.0
            friction = friction + np.asarray(element.force_history(at, x, v, start))
            lengths |= {float(knee) for knee in element.knee([np.asarray(a) for a in at])}
    if not friction.any():
        friction = heading
    distances = [min(length, farthest) for length in sorted(lengths) if length > 0.0] or [farthest]
    ahead = heading * friction / (np.abs(friction).max() or 1.0)
    speed, position = v / (np.abs(v).max() or 1.0), (x - x.mean()) / (np.ptp(x) or 1.0)
    width = _FRICTION_LEVELS[1] - _FRICTION_LEVELS[0]
    levels = np.maximum(1.0 - np.abs(ahead[:, None] - _FRICTION_LEVELS) / width, 0.0)
    limits = ahead[:, None] * np.exp(-((speed[:, None] * _SPEEDS) ** 2))

    def decaying(slopes: FloatArray) -> FloatArray:
        steps = np.diff(x)
        term = 0.5 * (slopes[1:] + slopes[:-1]) * steps[:, None]
        zero = np.zeros(slopes.shape[1])
        return np.column_stack(
            [linear_recursion(np.exp(-np.abs(steps) / d), term, zero) for d in distances]
        )

    damping = np.column_stack([speed, speed * np.abs(speed), speed**3])
    return {
        FRICTION: decaying(levels),
        VELOCITY: np.column_stack([damping, decaying(limits)]),
        DISPLACEMENT: np.column_stack([position, position**2, position**3]),
    }


@dataclass(frozen=True)
class RecordErrors(ErrorContributions):
    """Covariance of the estimate, source by source."""

    problem: RecordProblem
    values: FloatArray  # (Q,): the estimate
    contributions: Mapping[str, FloatArray]  # (Q, Q) each, noise first
    effective: float  # samples of white noise with the same information as the residuals
    exact: tuple[str, ...]  # inputs without a stated uncertainty
    assumed: tuple[str, ...] = ()
    contradicted: tuple[ContradictedExponent, ...] = ()
    # dependence of the residuals on the motion, from which `ALONG_MOTION` was estimated
    misfit: MotionMisfit | None = None

    def of_values(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance: the estimates are the values."""
        return covariance

    @property
    def runs(self) -> int:
        """Number of runs that were fitted together."""
        return len(set(self.problem.runs))

    @property
    def least_dof(self) -> float:
        """The fewest degrees of freedom of any source."""
        return min(map(self.dof_of, self.contributions))

    def dof_of(self, source: str) -> float:
        """Degrees of freedom of one source."""
        known = {
            NOISE: max(self.effective - len(self.covariance), 1.0),
            MODEL_ERROR: BLOCKS - 1.0,
            ALONG_MOTION: float(self.misfit.functions) if self.misfit else np.inf,
            RUNS: self.runs - 1.0,
        }
        return known.get(source, np.inf)

    def dof(self, direction: FloatArray, source: str | None = None) -> float:
        """Return the degrees of freedom of direction . values, by Welch and Satterthwaite."""
        if source is not None:
            return self.dof_of(source)
        parts = {name: float(variances(direction, C)) for name, C in self.contributions.items()}
        total = sum(parts.values())
        if np.isinf(total):
            return min(self.dof_of(name) for name, part in parts.items() if np.isinf(part))
        shares = {name: part / total for name, part in parts.items()} if total else {}
        spread = sum(2.0 * share**2 / self.dof_of(name) for name, share in shares.items())
        return float(satterthwaite(np.ones(()), np.asarray(spread)))


def record_errors(
    problem: RecordProblem, values: FloatArray, residuals: Sequence[FloatArray]
) -> RecordErrors:
    """Return the errors of an estimate.

    A misfit differs between the parts of a record: if estimates from blocks of a record scatter
    more than noise explains, the excess is the model error; a misfit that depends on the motion is
    a separate source. If estimates from several records scatter more than that, the excess is the
    scatter between runs. An assumed exponent is estimated within its range, and contributes what
    that adds. Errors of the channels are those of :mod:`dahl_ident.diagnostics.record_channels`.

    `residuals` are measured minus predicted; for a robust fit, the scores.
    """
    assumed = assumed_exponents(problem.model)
    try:
        fit = LinearFit.of(problem, values, residuals, assumed)
    except FitError:  # no motion next to the estimate
        fit, assumed = LinearFit.of(problem, values, residuals), {}
    noisier, other_motions = with_noisier_displacement(fit), by_other_motions(fit)
    delay = None
    with suppress(FitError):  # no motion next to the estimate
        delay = delay_std(fit)
    by_motion = partial(motion_sources, noisier=noisier, other_motions=other_motions, delay=delay)
    misfit, exact = motion_misfit(fit, other_motions.values()), fit
    if assumed:
        free = fit.covariance(by_motion) + (misfit.covariance(fit) if misfit else 0.0)
        places = {fit.problem.names.index(name): std for name, std in assumed.items()}
        exact = fit.assuming(dict.fromkeys(places, 0.0), free.diagonal())
        stds = {i: widened(std * fit.values[i], free[i, i]) for i, std in places.items()}
        fit = fit.assuming(stds, free.diagonal())
    covariance, effective = exact.by_noise
    sources = {NOISE: covariance}
    if exact.between_blocks is not None:
        sources[MODEL_ERROR] = exact.between_blocks
    if (scatter := between_records(fit)) is not None:
        sources[RUNS] = scatter
    of_motion = dict(by_motion(exact))
    sources |= of_motion
    known = np.asarray(sum(sources.values()))
    if assumed:
        with_exact = np.asarray(sum([exact.covariance(), *of_motion.values()]))
        sources[EXPONENT] = by_exponents(fit, with_exact, by_motion)
    if misfit is not None:
        along_motion = misfit.covariance(fit)
        larger = along_motion.diagonal() > _SHORTENS**2 * known.diagonal()
        if larger[fit.of_model & (exact.unmeasured > 0.0)].any():
            sources[ALONG_MOTION] = along_motion
        else:
            misfit = None
    for name, contribution in by_calibration(fit):
        sources[name] = sources.get(name, 0.0) + contribution
    unstated = [name for name in (FORCE, DISPLACEMENT_GAIN) if name not in sources]
    if problem.output == "motion":
        of_drive = by_drive(fit)
        if of_drive is None:
            unstated.insert(FORCE in unstated, "the drive (its noise cannot be estimated)")
        elif of_drive.any():
            sources[DRIVE] = of_drive
    return RecordErrors(
        fit.problem,
        fit.values,
        sources,
        effective,
        tuple(unstated),
        tuple(assumed),
        tuple(contradicted_exponents(problem, values, residuals, by_motion)),
        misfit,
    )


def errors_on_constraints(
    optimum: Optimum, jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]
) -> RecordErrors:
    """Return the errors of an estimate under constraints, from noise alone.

    The optimum's covariance spans the directions that the constraints allow, in which the
    correlation of the residuals is accounted for.
    """
    slopes = optimum.problem.value_slopes(optimum.theta)
    lost = np.isinf(optimum.covariance.diagonal())
    values, vectors = np.linalg.eigh(np.where(lost | lost[:, None], 0.0, optimum.covariance))
    along = slopes[:, None] * vectors[:, values > _SLIGHT**2 * values[-1]]
    reduced, effective = sandwich([J @ along for J in jacobians], residuals)
    covariance = along @ reduced @ along.T
    covariance[lost, lost] = np.inf
    exact = ("every source other than noise",)
    return RecordErrors(optimum.problem, optimum.values, {NOISE: covariance}, effective, exact)

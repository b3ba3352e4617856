"""Errors of a fit to records: noise, model error, drive, calibration; and their budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.contributions import (
    AFTER_REVERSALS,
    CHANNELS,
    EXPONENT,
    MODEL_ERROR,
    NOISE,
    RUNS,
    Errors,
    positive_part,
    variances,
)
from dahl_ident.diagnostics.correlated_residuals import inverse_normal, noise_in, sandwich
from dahl_ident.diagnostics.formatting import listed
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.diagnostics.record_sources import (
    BLOCKS,
    HeldValue,
    after_reversals,
    between_blocks,
    between_records,
    by_delay,
    exponent_slopes,
    held_exponents,
)
from dahl_ident.diagnostics.turning_noise import noise_at_turns
from dahl_ident.errors import FitError
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.problem.record_noise import LEADS, drive_noise
from dahl_ident.problem.record_problem import RecordProblem

_SLIGHT = 1e-6  # relative: noise of the drive below does not count
_MATTERS = 0.2  # standard errors that noise in the displacement may shift without being counted
_DRIVE_DRAWS = 4, 16  # of the drive's noise, least and most: the latter know it to a third
_DRIVE_SAMPLES = 50_000  # that they may have in all: half a second
_BENT = 6.0  # times the displacement's noise: exceeded by a second difference by chance once in 100
_OTHER_WINDOW = 0.5  # of its length: errors of a polynomial of degree 4 fall to a thirtieth
_DRAWS = 8  # of noise: the mean square of what they change is known to a half
_NOT_FOUND = ", though it was not given: with another no motion was found"
RELATIVE_STEP = 1e-5
"""Relative step of parameters for the slopes of quantities that follow from them."""
DRIVE = "noise in the drive"
DISPLACEMENT = "noise in the displacement"
TURNS = "displacement at turning points"
SAMPLING = "turning points between samples"
WINDOW = "window of differentiation"
FORCE, DISPLACEMENT_GAIN, DELAY = CHANNELS.values()


@dataclass(frozen=True)
class RecordErrors(Errors):
    """Covariance of the estimate, source by source.

    Attributes
    ----------
    contributions : mapping of str to ndarray, shape (P, P)
        Noise first.
    effective : float
        Samples of white noise that would tell as much as the residuals.
    exact : tuple of str
        Inputs without a stated uncertainty.
    runs : int
        Records that were fitted together.
    exponents : tuple of HeldValue
        What the records say of exponents that the fit holds.
    groups : int
        Of the path since the last reversal, from which `AFTER_REVERSALS` was estimated.
    """

    contributions: Mapping[str, FloatArray]
    effective: float
    exact: tuple[str, ...]
    runs: int
    exponents: tuple[HeldValue, ...]
    groups: int = 0

    @property
    def assumed(self) -> list[HeldValue]:
        """The exponents that the user did not state."""
        return [one for one in self.exponents if one.assumed]

    @property
    def least_dof(self) -> float:
        """Degrees of freedom of the whole: of the source that was estimated from the fewest."""
        return min(map(self.dof_of, self.contributions))

    def dof_of(self, source: str) -> float:
        """Degrees of freedom of one source."""
        if source == NOISE:
            return max(self.effective - len(self.covariance), 1.0)
        return {
            MODEL_ERROR: BLOCKS - 1.0,
            AFTER_REVERSALS: self.groups - 1.0,
            RUNS: self.runs - 1.0,
        }.get(source, np.inf)

    def dof(self, direction: FloatArray, source: str | None = None) -> float:
        """Return the degrees of freedom of direction . values, by Welch and Satterthwaite."""
        if source is not None:
            return self.dof_of(source)
        parts = {name: float(variances(direction, C)) for name, C in self.contributions.items()}
        total = sum(parts.values())
        if np.isinf(total):  # which an infinite source alone decides
            return min(self.dof_of(name) for name, part in parts.items() if np.isinf(part))
        loss = sum(part**2 / self.dof_of(name) for name, part in parts.items())
        return total**2 / loss if loss > 0.0 else np.inf


def record_errors(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> RecordErrors:
    """Return the errors of an estimate.

    A model that misses more than noise does so differently from place to place: where the blocks of
    a record ask for parameters that scatter more than noise explains, the excess is the model
    error; what it misses alike after every reversal is a source of its own. Where several records
    ask for parameters that scatter more than that explains, the excess is the scatter between runs.
    What an assumed exponent changes counts with its range and with what the records say of it.
    Noise in a measured drive makes the response look smaller than it is, by the noise's share of
    the drive's power within its band, and makes the plant wander; a calibration error of the force
    scales every force. Noise in a measured displacement counts as far as it shifts the estimate;
    where the residuals show larger errors of the displacement at turning points, what these shift
    beyond that; and so does what samples miss of the turning points that lie between them.

    Parameters
    ----------
    problem : RecordProblem
    values : ndarray, shape (P,)
        The estimate.
    jacobians, residuals : sequence of ndarray
        Derivatives of the prediction and measured minus predicted, of each record; of a robust
        fit the scores in place of the latter, which then say nothing of the prediction.

    Returns
    -------
    RecordErrors
    """
    white = [problem.filtered(J) for J in jacobians]
    left = [problem.filtered(e) for e in residuals]
    noise = noise_in(white, left)
    covariance, effective = sandwich(white, left, noise)
    sources = {NOISE: covariance}
    by_model = between_blocks(white, left, covariance, len(problem.free))
    if by_model is not None:
        sources[MODEL_ERROR] = by_model
    so_far = np.asarray(sum(sources.values()))
    scatter = between_records(white, left, so_far, len(problem.free), problem.runs)
    if scatter is not None:
        sources[RUNS] = scatter
    slopes = exponent_slopes(problem, values)
    exponents = held_exponents(problem, values, white, left, noise, slopes)
    if assumed := [one.contribution for one in exponents if one.assumed]:
        sources[EXPONENT] = np.asarray(sum(assumed))

    def count(source: str, contribution: FloatArray) -> None:
        """Count a source that widens the interval of a parameter of the model."""
        matters = contribution.diagonal() > _MATTERS**2 * covariance.diagonal()
        if matters[: len(problem.free)].any():
            sources[source] = contribution

    if "delay" not in problem.calibration:
        with suppress(FitError):  # no motion next to the estimate
            count(DELAY, by_delay(problem, values, white, left, noise))
    if problem.output == "force":
        plain, change_of = problem.outputs(values), _change_of(problem, jacobians)

        def count_change(source: str, alternative: RecordProblem) -> None:
            """Count how far the estimate moves if another problem is the right one."""
            output = alternative.outputs(values)
            change = change_of([b - a for a, b in zip(plain, output, strict=True)])
            count(source, np.outer(change, change))

        moved = _by_displacement(problem, values, plain, jacobians, residuals)
        count(DISPLACEMENT, moved)
        if not problem.model.rate_independent:
            count_change(WINDOW, problem.differentiated_in(_OTHER_WINDOW * problem.window))
        if problem.with_memory and not problem.displacement_noise:
            unit = covariance.diagonal()
            unit = np.sqrt(np.where(np.isfinite(unit) & (unit > 0.0), unit, 1.0))
            more = noise_at_turns(problem, values, white, left, noise)
            beyond = (more - sources.get(DISPLACEMENT, 0.0)) / np.outer(unit, unit)
            count(TURNS, positive_part(beyond) * np.outer(unit, unit))
            count_change(SAMPLING, problem.altered("latest", motions=_beyond_samples(problem)))
    of_motion = {
        name: C for name, C in sources.items() if name in (DISPLACEMENT, TURNS, SAMPLING, DELAY)
    }
    alike = after_reversals(problem, values, white, left, slopes, of_motion.values())
    if alike is not None:
        sources[AFTER_REVERSALS] = alike[0]
    scale = np.zeros(values.size)
    for i, parameter in enumerate(problem.free):
        scale[i] = values[i] * parameter.dimension[0]
    sources |= _by_calibration(problem, values, jacobians)
    exact = [DISPLACEMENT_GAIN] if DISPLACEMENT_GAIN not in sources else []
    by_force = problem.output == "force" or problem.excitation == "force"
    if problem.output == "motion":
        of_drive = drive_noise([record.force_samples for record in problem.records])
        if of_drive is None:
            exact.insert(0, "the drive (its noise cannot be estimated)")
        else:
            more = _by_drive(problem, values, jacobians, covariance, of_drive.stds)
            if of_drive.share > _SLIGHT:
                more = more + of_drive.share**2 * np.outer(scale, scale)
            if more.any():
                sources[DRIVE] = more
    stated = [r.drive_factor_uncertainty for r in problem.records]
    factor = max((float(u) for u in stated), default=0.0)
    if factor > 0.0 and by_force:
        sources[FORCE] = sources.get(FORCE, 0.0) + factor**2 * np.outer(scale, scale)
    if FORCE not in sources:
        exact.insert(0, FORCE)
    return RecordErrors(
        sources,
        effective,
        tuple(exact),
        len(set(problem.runs)),
        exponents,
        alike[1] if alike else 0,
    )


def errors_on_constraints(
    optimum: Optimum, jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]
) -> RecordErrors:
    """Return the errors of an estimate on constraints, from noise alone.

    The optimum's covariance has the directions that the constraints leave; in these the residuals'
    correlation is accounted for.
    """
    slopes = optimum.problem.value_slopes(optimum.theta)
    lost = np.isinf(optimum.covariance.diagonal())
    values, vectors = np.linalg.eigh(np.where(lost | lost[:, None], 0.0, optimum.covariance))
    along = slopes[:, None] * vectors[:, values > _SLIGHT**2 * values[-1]]
    reduced, effective = sandwich([J @ along for J in jacobians], residuals)
    covariance = along @ reduced @ along.T
    covariance[lost, lost] = np.inf
    exact = ("every source other than noise",)
    runs = len(set(optimum.problem.runs))
    return RecordErrors({NOISE: covariance}, effective, exact, runs, ())


def _by_calibration(
    problem: RecordProblem, values: FloatArray, jacobians: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """Return the covariance of the estimate by stated calibrations, by source.

    A gain changes the units of force or of displacement, and every parameter with them, if all were
    estimated; known ones stay, which changes the others as if they had been given wrongly. A delay
    shifts the output in time.
    """
    moved = _change_of(problem, jacobians)

    def scaled(place: int) -> FloatArray:
        change = np.array([p.dimension[place] for p in problem.parameters]) * values
        known = {p.name: p for p in problem.model.parameters if not p.free and p.dimension[place]}
        for name, p in known.items():
            low, high = (
                problem.with_fixed({name: (p.value or 0.0) * (1.0 + step)}).outputs(values)
                for step in (-RELATIVE_STEP, RELATIVE_STEP)
            )
            slope = [(b - a) / (2.0 * RELATIVE_STEP) for a, b in zip(low, high, strict=True)]
            change = change + p.dimension[place] * moved(slope)
        return change

    def delayed() -> FloatArray:
        times = [record.time for record in problem.records]
        return moved(
            [np.gradient(y, t) for y, t in zip(problem.outputs(values), times, strict=True)]
        )

    ways: dict[str, tuple[str, Callable[[], FloatArray]]] = {
        "force_gain": (FORCE, partial(scaled, 0)),
        "displacement_gain": (DISPLACEMENT_GAIN, partial(scaled, 1)),
        "delay": (DELAY, delayed),
    }
    contributions = {}
    for name, u in problem.calibration.items():
        source, change_of = ways[name]
        change = u * change_of()
        contributions[source] = np.outer(change, change)
    return contributions


def _by_drive(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    known: FloatArray,
    stds: Sequence[float],
) -> FloatArray:
    """Return the effect of white noise in the drive on the estimate, beyond that in the residuals.

    It moves the plant most where it resonates or where friction slips, and parameters are
    determined at these places. The `known` covariance takes the residuals as equally large
    everywhere, so that it shows such noise in part. Draws of the noise have both.
    """
    white = [problem.filtered(J) for J in jacobians]
    change_of = _change_of(problem, jacobians)
    plain = problem.outputs(values)
    draws = int(np.clip(_DRIVE_SAMPLES // problem.n_residuals, *_DRIVE_DRAWS))
    moved, seen, none = np.zeros_like(known), np.zeros_like(known), np.zeros_like(known)
    for draw in range(draws):
        try:
            noisy = problem.with_noisier_drive(stds, draw).outputs(values)
        except FitError:
            return none
        wander = [b - a for a, b in zip(plain, noisy, strict=True)]
        change = change_of(wander)
        if not draw and not (change**2 > _MATTERS**2 * known.diagonal()).any():
            return none
        moved += np.outer(change, change) / draws
        seen += sandwich(white, [problem.filtered(y) for y in wander])[0] / draws
    certain = np.isfinite(known.diagonal()) & (known.diagonal() > 0.0)
    more = np.where(certain, np.maximum((moved - seen).diagonal(), 0.0), 0.0)
    size = np.sqrt(more / np.where(certain, known.diagonal(), 1.0))
    return np.asarray(np.where(np.isfinite(known), known, 0.0) * np.outer(size, size))


def _by_displacement(
    problem: RecordProblem,
    values: FloatArray,
    plain: Sequence[FloatArray],
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> FloatArray:
    """Return the mean square change of the estimate by the displacement's noise.

    As large as that of as much noise again, in addition to the `plain` prediction; or, with a dead
    band, from where in it the true displacement may be.
    """
    change_of = _change_of(problem, jacobians)

    def moved(low: Sequence[FloatArray], end: RecordProblem) -> tuple[FloatArray, float]:
        """Return the estimate's change to another problem, and the sum of squares it leaves."""
        output = [b - a for a, b in zip(low, end.outputs(values), strict=True)]
        change = change_of(output)
        left = (y - J @ change for y, J in zip(output, jacobians, strict=True))
        return change, sum(float(e @ e) for e in left)

    noise = problem.displacement_noise
    if noise:
        low, high = (problem.without_noise(noise, lead) for lead in LEADS[::2])
        change = 0.5 * moved(low.outputs(values), high)[0]
        return np.outer(change, change)

    def noisier(noise: float) -> tuple[FloatArray, float]:
        again = [moved(plain, problem.with_more_noise(noise, draw)) for draw in range(_DRAWS)]
        changes = np.array([change for change, _ in again])
        return changes.T @ changes / _DRAWS, float(np.mean([left for _, left in again]))

    noise = problem.estimated_noise
    covariance, left = noisier(noise)
    squares = sum(float(e @ e) for e in residuals)
    if left <= squares:
        return covariance
    # rough motion looks like noise, but so much noise would leave larger residuals
    return noisier(noise * (squares / left) ** 0.5)[0]


def _beyond_samples(problem: RecordProblem) -> tuple[tuple[FloatArray, ...], ...]:
    """Return the motions with the turning points that lie between samples.

    The motion is taken to turn at a sample. By how much it went farther follows from the parabola
    through three samples, unless noise bends it as much.
    """
    least = _BENT * problem.estimated_noise
    motions = []
    for record, (x, v, a) in zip(problem.records, problem.motions, strict=True):
        slope = np.diff(x) / np.diff(record.time)
        before, after = slope[:-1], slope[1:]
        bend = (after - before) / (record.time[2:] - record.time[:-2])
        gap = np.minimum(np.diff(record.time)[:-1], np.diff(record.time)[1:])
        turns = (before * after < 0.0) & (np.abs(bend) * gap**2 > least)
        middle = before + bend * np.diff(record.time)[:-1]  # the slope at the middle sample
        farther = x.copy()
        farther[1:-1][turns] -= middle[turns] ** 2 / (4.0 * bend[turns])
        motions.append((farther, v, a))
    return tuple(motions)


def _change_of(
    problem: RecordProblem, jacobians: Sequence[FloatArray]
) -> Callable[[Sequence[FloatArray]], FloatArray]:
    """Return how the estimate changes with the measured outputs, to first order."""
    white = [problem.filtered(J) for J in jacobians]
    inverse = inverse_normal(white)

    def change(output: Sequence[FloatArray]) -> FloatArray:
        parts = zip(white, map(problem.filtered, output), strict=True)
        return np.asarray(inverse @ sum(J.T @ y for J, y in parts))

    return change


def record_assumptions(problem: RecordProblem, errors: RecordErrors) -> Finding:
    """Return the assumptions of the estimate that the records cannot test."""
    parts = [str(one) for one in errors.assumed]
    known = {one.name for one in errors.assumed}
    parts += [
        f"{p.name} = {p.value:g} exactly" + (_NOT_FOUND if p.assumed else "")
        for p in problem.model.parameters
        if p.prior is not None and not p.free and p.name not in known
    ]
    if errors.exact:
        parts.append(f"{listed(errors.exact)} exact")
    if errors.runs < 2:
        parts.append("a single run")
    return Finding(
        Question.ASSUMED, VerdictStatus.TRUSTED, "records_assumed", {"parts": tuple(parts)}
    )

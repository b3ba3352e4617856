"""Errors of a fit to records: noise, model error, drive, calibration; and their budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dahl_ident.arrays import FloatArray
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
from dahl_ident.diagnostics.correlated_residuals import sandwich
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
from dahl_ident.diagnostics.record_misfit import MotionMisfit, motion_misfit
from dahl_ident.diagnostics.record_sources import (
    BLOCKS,
    FixedExponent,
    LinearFit,
    between_records,
    fixed_exponents,
)
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.problem.record_problem import RecordProblem

_SLIGHT = 1e-6  # standard deviation along a direction, over the largest, that is rounding
_SHORTENS = 0.5  # part of u: without a smaller source, intervals are at most 10 % too short


@dataclass(frozen=True)
class RecordErrors(ErrorContributions):
    """Covariance of the estimate, source by source."""

    contributions: Mapping[str, FloatArray]  # (P, P) each, noise first
    effective: float  # samples of white noise with the same information as the residuals
    exact: tuple[str, ...]  # inputs without a stated uncertainty
    runs: int  # records that were fitted together
    exponents: tuple[FixedExponent, ...]
    # dependence of the residuals on the motion, from which `ALONG_MOTION` was estimated
    misfit: MotionMisfit | None = None

    @property
    def assumed(self) -> list[FixedExponent]:
        """The exponents that the user did not state."""
        return [exponent for exponent in self.exponents if exponent.assumed]

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
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> RecordErrors:
    """Return the errors of an estimate.

    A misfit differs between the parts of a record: if estimates from blocks of a record scatter
    more than noise explains, the excess is the model error; a misfit that depends on the motion is
    a separate source. If estimates from several records scatter more than that, the excess is the
    scatter between runs. An assumed exponent contributes what it adds to all of these if it is
    estimated within its range. Errors of the channels are those of
    :mod:`dahl_ident.diagnostics.record_channels`.

    `jacobians` and `residuals` are the derivatives of each record's prediction, and measured minus
    predicted; for a robust fit, the scores.
    """
    fit = LinearFit.of(problem, values, jacobians, residuals)
    covariance, effective = fit.by_noise
    sources = {NOISE: covariance}
    if fit.between_blocks is not None:
        sources[MODEL_ERROR] = fit.between_blocks
    noisier, other_motions = with_noisier_displacement(fit), by_other_motions(fit)
    by_motion = partial(motion_sources, noisier=noisier, other_motions=other_motions)
    of_motion = dict(by_motion(fit))
    exact = np.asarray(sum([*sources.values(), *of_motion.values()]))
    exponents = fixed_exponents(fit, by_motion, exact)
    if (scatter := between_records(fit, np.asarray(sum(sources.values())))) is not None:
        sources[RUNS] = scatter
    sources |= of_motion
    known = np.asarray(sum(sources.values()))
    if assumed := [exponent.contribution for exponent in exponents if exponent.assumed]:
        sources[EXPONENT] = np.asarray(sum(assumed))
    misfit = motion_misfit(fit, other_motions.values())
    if misfit is not None:
        larger = misfit.covariance.diagonal() > _SHORTENS**2 * known.diagonal()
        if larger[fit.of_model].any():
            sources[ALONG_MOTION] = misfit.covariance
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
    runs = len(set(problem.runs))
    return RecordErrors(sources, effective, tuple(unstated), runs, exponents, misfit)


def errors_on_constraints(
    optimum: Optimum, jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]
) -> RecordErrors:
    """Return the errors of an estimate on constraints, from noise alone.

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
    runs = len(set(optimum.problem.runs))
    return RecordErrors({NOISE: covariance}, effective, exact, runs, ())

"""What a fit to records is uncertain of: noise, noise in the drive, calibration; and its budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dahl_ident.arrays import FloatArray, positive_array
from dahl_ident.diagnostics.bands import DerivedQuantity
from dahl_ident.diagnostics.budget import Budget, BudgetRow, ParameterBudget, coverage_factor
from dahl_ident.diagnostics.correlated_residuals import sandwich
from dahl_ident.problem.record_noise import drive_noise
from dahl_ident.problem.record_problem import RecordProblem

_SLIGHT = 1e-6  # relative: noise of the drive below does not count
_STEP = 1e-5  # relative, of parameters, for slopes of derived quantities
NOISE, DRIVE, FORCE = "noise", "noise in the drive", "force calibration"


@dataclass(frozen=True)
class RecordErrors:
    """Covariance of the estimate, source by source.

    Attributes
    ----------
    contributions : mapping of str to ndarray, shape (P, P)
        Noise first.
    effective : float
        Samples of white noise that would tell as much as the residuals.
    exact : tuple of str
        What nobody stated an uncertainty of.
    """

    contributions: Mapping[str, FloatArray]
    effective: float
    exact: tuple[str, ...]

    @property
    def covariance(self) -> FloatArray:
        """All sources together."""
        return np.asarray(sum(self.contributions.values()))

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise."""
        return max(self.effective - len(self.covariance), 1.0)


def record_errors(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> RecordErrors:
    """Return the errors of an estimate.

    Noise in a measured drive makes the response look smaller than it is, by the noise's share of
    the drive's power within its band; a calibration error of the force scales every force.

    Parameters
    ----------
    problem : RecordProblem
    values : ndarray, shape (P,)
        The estimate.
    jacobians, residuals : sequence of ndarray
        Derivatives of the prediction and measured minus predicted, of each record.

    Returns
    -------
    RecordErrors
    """
    white = [problem.filtered(J) for J in jacobians]
    covariance, effective = sandwich(white, [problem.filtered(e) for e in residuals])
    found = {NOISE: covariance}
    scale = np.zeros(values.size)
    for i, parameter in enumerate(problem.free):
        scale[i] = values[i] * parameter.dimension[0]
    exact = ["displacement calibration", "delay between the channels"]
    by_force = problem.output == "force" or problem.excitation == "force"
    if problem.output == "motion":
        ratio = drive_noise([record.force_samples for record in problem.records])
        if ratio is None:
            exact.insert(0, "the drive, whose noise cannot be told from it")
        elif ratio > _SLIGHT:
            found[DRIVE] = ratio**2 * np.outer(scale, scale)
    stated = [r.drive_factor_uncertainty for r in problem.records]
    factor = max((float(u) for u in stated), default=0.0)
    if factor > 0.0 and by_force:
        found[FORCE] = factor**2 * np.outer(scale, scale)
    else:
        exact.insert(0, FORCE)
    return RecordErrors(found, effective, tuple(exact))


def record_budget(problem: RecordProblem, values: FloatArray, errors: RecordErrors) -> Budget:
    """Return the uncertainty budget of the model's free parameters."""
    count = len(problem.free)
    total = errors.covariance
    parameters = []
    for i, parameter in enumerate(problem.free):
        u2 = float(total[i, i])
        rows = []
        for source, covariance in errors.contributions.items():
            kind: Literal["A", "B"] = "A" if source == NOISE else "B"
            own = float(covariance[i, i])
            dof = errors.dof if kind == "A" else np.inf
            rows.append(BudgetRow(source, kind, own**0.5, dof, own / u2 if u2 > 0.0 else 0.0))
        noise = float(errors.contributions[NOISE][i, i])
        dof = errors.dof * (u2 / noise) ** 2 if noise > 0.0 else np.inf
        rows.sort(key=lambda row: -row.u)
        parameters.append(
            ParameterBudget(
                parameter.name, parameter.unit, float(values[i]), tuple(rows), u2**0.5, dof,
                coverage_factor(dof),
            )
        )  # fmt: skip
    return Budget(tuple(parameters), total[:count, :count], errors.exact)


def record_derived(
    problem: RecordProblem,
    values: FloatArray,
    covariance: FloatArray,
    amplitudes: Sequence[float],
    frequency_hz: float | None,
) -> tuple[DerivedQuantity, ...]:
    """Return x_c of each law that has one, and at each amplitude stiffness, loss and damping.

    Of the laws that depend on amplitude, as for settled sines; slopes by central differences.
    """
    A = positive_array(amplitudes, "amplitudes").ravel() if len(amplitudes) else np.zeros(0)
    omega = 2.0 * np.pi * (frequency_hz or 1.0)
    labels: list[tuple[str, str, float | None]] = []
    for element in problem.model.elements:
        if element.has_memory:
            name = "x_c" if element.name is None else f"{element.name}_x_c"
            labels.append((name, "m", None))
    for a in A.tolist():
        labels.append(("energy lost in a cycle", "J", a))
        labels.append(("equivalent stiffness", "N/m", a))
        if frequency_hz is not None:
            labels.append(("equivalent damping", "N s/m", a))

    def quantities(at: FloatArray) -> FloatArray:
        found, N = [], np.zeros(A.size, dtype=np.complex128)
        for element, own in problem.model.of(problem.full_values(at)):
            if element.has_memory:
                low, high = element.knee([np.asarray(v) for v in own])
                found.append(float(low) if float(low) == float(high) else np.nan)
            if not element.is_linear and A.size:
                N = N + element.stiffness([np.asarray(v) for v in own], A, np.full(A.size, omega))
        for a, n in zip(A.tolist(), N.tolist(), strict=True):
            found += [np.pi * a**2 * n.imag, n.real]
            if frequency_hz is not None:
                found.append(n.imag / omega)
        return np.array(found)

    centre = quantities(values)
    slopes = np.zeros((centre.size, values.size))
    for i in range(len(problem.free)):
        step = np.zeros(values.size)
        step[i] = _STEP * abs(values[i])
        if step[i] > 0.0:
            slopes[:, i] = (quantities(values + step) - quantities(values - step)) / (2 * step[i])
    errors = np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
    return tuple(
        DerivedQuantity(name, unit, a, float(v), float(e))
        for (name, unit, a), v, e in zip(labels, centre, errors, strict=True)
        if np.isfinite(v)
    )

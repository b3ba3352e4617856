"""What a fit to records is uncertain of: noise, model error, drive, calibration; its budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dahl_ident.arrays import FloatArray, positive_array
from dahl_ident.diagnostics.bands import DerivedQuantity
from dahl_ident.diagnostics.budget import Budget, BudgetRow, ParameterBudget, coverage_factor
from dahl_ident.diagnostics.correlated_residuals import sandwich
from dahl_ident.problem.displacement_noise import LEADS
from dahl_ident.problem.record_noise import drive_noise
from dahl_ident.problem.record_problem import RecordProblem

_SLIGHT = 1e-6  # relative: noise of the drive below does not count
_MATTERS = 0.2  # standard errors that noise in the displacement may shift without being counted
_DRAWS = 8  # of noise: the mean square of what they change is known to a half
_STEP = 1e-5  # relative, of parameters, for slopes of derived quantities
_BLOCKS = 20  # of all records together, from which the model error is estimated
_LEVEL = 0.9995  # of chance, at which scatter between blocks is no noise
NOISE, DRIVE, FORCE = "noise", "noise in the drive", "force calibration"
MODEL, DISPLACEMENT = "model error", "noise in the displacement"


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
        Inputs without a stated uncertainty.
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
        """Degrees of freedom: of the noise, or of the blocks that show a model error."""
        return _BLOCKS - 1.0 if MODEL in self.contributions else self.dof_of(NOISE)

    def dof_of(self, source: str) -> float:
        """Degrees of freedom of one source."""
        if source == NOISE:
            return max(self.effective - len(self.covariance), 1.0)
        return _BLOCKS - 1.0 if source == MODEL else np.inf


def record_errors(
    problem: RecordProblem,
    values: FloatArray,
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
) -> RecordErrors:
    """Return the errors of an estimate.

    A model that misses more than noise does so differently from place to place: where the blocks
    of a record ask for parameters that scatter more than noise explains, the excess is the model
    error. What the model misses everywhere alike does not show. Noise in a measured drive makes
    the response look smaller than it is, by the noise's share of the drive's power within its
    band; a calibration error of the force scales every force. Noise in a
    measured displacement counts as far as it shifts the estimate.

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
    beyond = _model_error(
        white, [problem.filtered(e) for e in residuals], covariance, len(problem.free)
    )
    if beyond is not None:
        found[MODEL] = beyond
    if problem.output == "force":
        moved = _by_displacement(problem, values, jacobians)
        matters = moved.diagonal() > _MATTERS**2 * covariance.diagonal()
        if matters[: len(problem.free)].any():
            found[DISPLACEMENT] = moved
    scale = np.zeros(values.size)
    for i, parameter in enumerate(problem.free):
        scale[i] = values[i] * parameter.dimension[0]
    exact = ["displacement calibration", "delay between the channels"]
    by_force = problem.output == "force" or problem.excitation == "force"
    if problem.output == "motion":
        ratio = drive_noise([record.force_samples for record in problem.records])
        if ratio is None:
            exact.insert(0, "the drive (its noise cannot be estimated)")
        elif ratio > _SLIGHT:
            found[DRIVE] = ratio**2 * np.outer(scale, scale)
    stated = [r.drive_factor_uncertainty for r in problem.records]
    factor = max((float(u) for u in stated), default=0.0)
    if factor > 0.0 and by_force:
        found[FORCE] = factor**2 * np.outer(scale, scale)
    else:
        exact.insert(0, FORCE)
    return RecordErrors(found, effective, tuple(exact))


def _by_displacement(
    problem: RecordProblem, values: FloatArray, jacobians: Sequence[FloatArray]
) -> FloatArray:
    """Return the mean square change of the estimate with the displacement's noise.

    As large as that of as much noise again; or, with a dead band, from where in it the true
    displacement may be.
    """
    noise = problem.displacement_noise
    if noise:
        ends = [problem.without_noise(noise, lead) for lead in LEADS[::2]]
        change = 0.5 * _moved(ends, values, jacobians)[0]
        return np.outer(change, change)

    def noisier(noise: float) -> tuple[FloatArray, float]:
        again = [
            _moved([problem, problem.with_more_noise(noise, draw)], values, jacobians)
            for draw in range(_DRAWS)
        ]
        changes = np.array([change for change, _ in again])
        return changes.T @ changes / _DRAWS, float(np.mean([left for _, left in again]))

    noise = problem.estimated_noise
    moved, left = noisier(noise)
    residuals = sum(float(e @ e) for e in problem.split_residuals(values))
    if left <= residuals:
        return moved
    # rough motion looks like noise, but so much noise would leave larger residuals
    return noisier(noise * (residuals / left) ** 0.5)[0]


def _moved(
    ends: Sequence[RecordProblem], values: FloatArray, jacobians: Sequence[FloatArray]
) -> tuple[FloatArray, float]:
    """Return the estimate's change between two problems, and the sum of squares it leaves."""
    size = np.sqrt(sum((J**2).sum(axis=0) for J in jacobians))
    size = np.where(size > 0.0, size, 1.0)
    normal, right, square = np.zeros((values.size, values.size)), np.zeros(values.size), 0.0
    for i, J in enumerate(jacobians):
        low, high = (end.predict(values, i, derivatives=False).output for end in ends)
        scaled = J / size
        normal += scaled.T @ scaled
        right += scaled.T @ (high - low)
        square += float((high - low) @ (high - low))
    change = np.asarray(np.linalg.pinv(normal, hermitian=True) @ right)
    return change / size, square - float(change @ right)


def _model_error(
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    noise: FloatArray,
    count: int,
) -> FloatArray | None:
    """Return the covariance between blocks beyond that of noise, or None where it shows none.

    The covariance between blocks is that of Liang and Zeger, Biometrika 73 (1986) 13-22; whether
    it exceeds noise is judged for each of the first `count` parameters.
    """
    samples = sum(e.size for e in residuals)
    seen = np.flatnonzero(np.isfinite(noise.diagonal()))
    if samples < _BLOCKS * _BLOCKS or not noise[np.ix_(seen, seen)].any():
        return None
    if seen.size < len(noise):
        own, inside = [J[:, seen] for J in jacobians], noise[np.ix_(seen, seen)]
        found = _model_error(own, residuals, inside, int((seen < count).sum()))
        return None if found is None else _embedded(found, seen, len(noise))
    size = np.sqrt(noise.diagonal())
    scores, parts = [], []
    for J, e in zip(jacobians, residuals, strict=True):
        scaled = J * size
        for rows in np.array_split(np.arange(e.size), max(1, round(_BLOCKS * e.size / samples))):
            scores.append(scaled[rows].T @ e[rows])
            parts.append(scaled[rows].T @ scaled[rows])
    inverse = np.linalg.inv(sum(parts))
    steps = np.array(scores) @ inverse
    blocks = len(steps)
    between = blocks / (blocks - 1.0) * steps.T @ steps
    correlation = noise / np.outer(size, size)
    weights = np.array([(inverse @ part @ inverse).diagonal() for part in parts])
    dof = np.maximum(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0) - 1.0, 1.0)
    ratio = between.diagonal() / correlation.diagonal()
    if not (ratio > special.chdtri(dof, 1.0 - _LEVEL) / dof)[:count].any():
        return None
    values, vectors = np.linalg.eigh(between - correlation)
    beyond = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(beyond * np.outer(size, size))


def _embedded(part: FloatArray, places: NDArray[np.intp], size: int) -> FloatArray:
    whole = np.zeros((size, size))
    whole[np.ix_(places, places)] = part
    return whole


def record_budget(problem: RecordProblem, values: FloatArray, errors: RecordErrors) -> Budget:
    """Return the uncertainty budget of the model's free parameters."""
    count = len(problem.free)
    total = errors.covariance
    parameters = []
    for i, parameter in enumerate(problem.free):
        u2 = float(total[i, i])
        rows = []
        for source, covariance in errors.contributions.items():
            kind: Literal["A", "B"] = "A" if source in (NOISE, MODEL) else "B"
            own = float(covariance[i, i])
            dof = errors.dof_of(source)
            rows.append(BudgetRow(source, kind, own**0.5, dof, own / u2 if u2 > 0.0 else 0.0))
        loss = sum(row.u**4 / row.dof for row in rows)  # Welch and Satterthwaite
        dof = u2**2 / loss if loss > 0.0 else np.inf
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
    count = len(problem.free)
    slopes = np.zeros((centre.size, count))
    for i in range(count):
        step = np.zeros(values.size)
        step[i] = _STEP * abs(values[i])
        if step[i] > 0.0:
            slopes[:, i] = (quantities(values + step) - quantities(values - step)) / (2 * step[i])
    errors = np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance[:count, :count], slopes))
    return tuple(
        DerivedQuantity(name, unit, a, float(v), float(e))
        for (name, unit, a), v, e in zip(labels, centre, errors, strict=True)
        if np.isfinite(v)
    )

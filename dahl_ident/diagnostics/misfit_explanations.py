"""Possible causes of a misfit: a sign convention, or single rows. Nothing is corrected or dropped.

A row is suspicious if leaving it out (the mean-shift test, which accounts for leverage) lowers the
sum of squares by more than noise would. The most deviant row is removed before the next is judged,
so that outliers do not mask one another; up to a tenth of the rows, and of more than 500 several at
a time. The level is 1 % for the whole table, divided by the number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from scipy import special

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.diagnostics.trends import covariates
from dahl_ident.errors import DahlIdentError
from dahl_ident.fitting import Optimum, Status, solve
from dahl_ident.fitting.global_start import global_starts
from dahl_ident.problem import RecordProblem, TableProblem
from dahl_ident.problem.record_noise import in_band
from dahl_ident.units import percent

_CHANCE = 0.01  # false-alarm rate of the worst of all points
_SHARE = 0.1  # of the rows: if more deviate, the model or noise is wrong, not single rows
_ONE_BY_ONE = 500  # rows up to which each is removed before the next is judged
_LEAST_DOF = 4  # without the suspicious rows; fewer do not show the noise
_GOOD = "good"
EXPLAINS = 3.0  # factor by which a cause lowers the misfit
_PROMISING = 1.5  # the same at the start of a search
_CLUSTER_BY_CHANCE = 0.01  # probability that rows at random lie as close together
_FEWEST = 5  # fewest values of which the first and the last are ends


@dataclass(frozen=True)
class SuspiciousPoint:
    """A point that noise does not explain."""

    row: int  # its index in the table
    name: str  # in words: frequency, level, harmonic, run
    deviation: float  # distance from the fit to the others, in standard deviations
    p_value: float  # probability that the worst of all points deviates as far by noise alone

    def __str__(self) -> str:
        return f"{self.name} lies {self.deviation:.1f} standard deviations off"


def suspicious_points(optimum: Optimum, space: ResidualSpace) -> tuple[SuspiciousPoint, ...]:
    """Return the suspicious points, the most deviant first."""
    deviant = _outliers(optimum) if optimum.loss != "linear" else _suspicious(optimum, space)
    names = row_names(optimum.problem.data, [row for row, *_ in deviant])
    return tuple(
        SuspiciousPoint(row, name, deviation, p)
        for (row, deviation, p), name in zip(deviant, names, strict=True)
    )


def _suspicious(optimum: Optimum, space: ResidualSpace) -> list[tuple[int, float, float]]:
    """Return row, deviation and p-value of points that are judged one after the other."""
    n = optimum.problem.data.n
    at_once = 1 + n // _ONE_BY_ONE
    rows: list[int] = []
    deviant: list[tuple[int, float, float]] = []
    for _ in range(0, max(1, int(_SHARE * n)), at_once):
        worst = _most_deviant(optimum, space, rows, at_once)
        rows += [row for row, *_ in worst]
        deviant += worst
        if len(worst) < at_once:
            break
    significant = [i for i, (*_, p) in enumerate(deviant, start=1) if p < _CHANCE]
    return deviant[: max(significant, default=0)]


def _outliers(optimum: Optimum) -> list[tuple[int, float, float]]:
    """Return the same for a robust fit, on which outliers have no effect."""
    m, dof = optimum.problem.n_residuals, max(optimum.dof, 1)
    y, _ = optimum.problem.residuals_and_jacobian(optimum.theta, optimum.scale, tails=False)
    squares = y[:m:2] ** 2 + y[1:m:2] ** 2
    tail = special.chdtrc(2, squares) if optimum.scale_known else special.fdtrc(2, dof, squares / 2)
    p = np.minimum(1.0, squares.size * tail)
    order = np.argsort(-squares)
    return [(int(i), float(np.sqrt(squares[i])), float(p[i])) for i in order if p[i] < _CHANCE]


def _most_deviant(
    optimum: Optimum, space: ResidualSpace, without: list[int], count: int
) -> list[tuple[int, float, float]]:
    """Return row, deviation and p-value of the worst points, without some rows.

    Each is judged without those before it, whose effect on the fit is neglected.
    """
    m, n = space.residuals.size, space.residuals.size // 2
    kept = np.ones(n, dtype=np.bool_)
    kept[without] = False
    pairs = np.repeat(kept, 2)
    Q = np.linalg.qr(space.basis[pairs])[0] if without else space.basis
    r = np.zeros(m)
    r[pairs] = space.residuals[pairs] - Q @ (Q.T @ space.residuals[pairs])
    lever = np.zeros((m, Q.shape[1]))
    lever[pairs] = Q
    squares = _shifts(r, lever)
    squares[without] = -np.inf
    total = float(r @ r)
    deviant: list[tuple[int, float, float]] = []
    for row in np.argsort(-squares, kind="stable")[:count].tolist():
        removed = len(without) + len(deviant)
        dof, explained = space.dof - 2 * removed, float(squares[row])
        variance = 1.0 if optimum.scale_known else (total - explained) / max(dof - 2, 1)
        if dof < _LEAST_DOF or not variance > 0.0:
            break
        p = min(1.0, (n - removed) * space.tail_of(explained, 2, total, dof))
        deviant.append((row, float(np.sqrt(explained / variance)), p))
        total -= explained
    return deviant


def _shifts(r: FloatArray, lever: FloatArray) -> FloatArray:
    """Return how far the sum of squares falls without each point: r' (I - H)^-1 r."""
    pairs = r.reshape(-1, 2, 1)
    Q = lever.reshape(len(pairs), 2, -1)
    remaining = np.eye(2) - Q @ Q.swapaxes(1, 2)
    fixed = np.linalg.det(remaining) < 1e-8  # a point that alone determines a parameter
    remaining[fixed] = np.eye(2)
    squares = np.sum(pairs * np.linalg.solve(remaining, pairs), axis=(1, 2))
    return np.where(fixed, 0.0, squares)


def flagged_rows(data: FrequencyResponse) -> tuple[str, ...]:
    """Return each fundamental that the extraction flagged, such as "1 Hz, 2 m: not settled"."""
    verdicts = data.quality.get("verdict")
    if verdicts is None:
        return ()
    rows = np.flatnonzero((verdicts != _GOOD) & (data.harmonic == 1))
    return tuple(
        f"{name}: {verdicts[row]}"
        for row, name in zip(rows, row_names(data, rows.tolist()), strict=True)
    )


@dataclass(frozen=True)
class SignChange:
    """A change of sign of the response's real or imaginary part, and its likely cause."""

    name: str
    real: int
    imaginary: int
    check: str

    def __call__(self, data: FrequencyResponse) -> FrequencyResponse:
        """Return the data with these signs, their covariances included."""
        signs = np.array([self.real, self.imaginary])
        covariance = data.covariance
        cross, of_drive = data.amplitude_covariance, data.drive_covariance
        return replace(
            data,
            response=self.real * data.response.real + 1j * self.imaginary * data.response.imag,
            covariance=None if covariance is None else covariance * np.outer(signs, signs),
            amplitude_covariance=None if cross is None else cross * signs,
            drive_covariance=None if of_drive is None else of_drive * signs,
        )


_PHASE = (
    "check the sign of the phase, which is that of exp(+j omega t): the force leads the "
    "displacement where friction dissipates"
)
_SIGN = "check that force and displacement are positive in the same direction"
SIGN_CHANGES = (
    SignChange("conjugated", 1, -1, _PHASE),
    SignChange("negated", -1, -1, _SIGN),
    SignChange("negated and conjugated", -1, 1, f"{_PHASE}, and {_SIGN}"),
)


def rms_misfit_of(problem: TableProblem, fitted: ComplexArray) -> float:
    """Return the root mean square of abs(measured - fitted)/abs(measured) of fundamentals."""
    return float(np.sqrt(np.mean(_misfit(problem, fitted) ** 2)))


def sign_convention(optimum: Optimum, before: float, misfit_of: Callable[[Optimum], float]) -> str:
    """Return in words which sign convention explains the misfit; "" if none does.

    `before` is the misfit of the estimate, and `misfit_of` returns that of another optimum, which
    is infinite if tests object to it: a change of sign may also reduce the misfit due to a missing
    mass or spring, but not down to the noise.
    """
    fitted = optimum.problem.predict(optimum.theta)
    middle = float(np.median(_misfit(optimum.problem, fitted)))
    promising = []
    for change in SIGN_CHANGES:
        try:
            problem = optimum.problem.like(data=change(optimum.problem.data))
            # exact motions of a start far off take long
            sine = problem.with_steady("describing function")
            started = sine.predict(global_starts(sine).theta[0])
            # the median, as the start may be wrong for single rows near a resonance
            first = float(np.median(_misfit(problem, started)))
        except DahlIdentError:
            continue
        if first * _PROMISING < middle:
            promising.append((first, change, problem))
    if not promising:
        return ""
    _, change, problem = min(promising, key=lambda candidate: candidate[0])
    after = misfit_of(solve(problem, loss=optimum.loss))
    return _with_changed_sign(f"the response {change.name}", before, after, change.check)


def _with_changed_sign(what: str, before: float, after: float, check: str) -> str:
    misfits = f"from {percent(before)} to {percent(after)} rms"
    explains = after * EXPLAINS < before
    return f"With {what} the misfit falls {misfits}: {check}" if explains else ""


def force_convention(optimum: Optimum, before: float) -> str:
    """Return a sentence if the wrong sign of the records' force explains the misfit, or "".

    The opposite sign is only fitted if the force takes energy out of the mechanism.
    """
    problem: RecordProblem = optimum.problem
    if problem.excitation == "base" or _work(problem) >= 0.0:
        return ""
    force = [(r, "drive" if r.force is None else "force") for r in problem.records]
    records = [replace(r, **{name: -getattr(r, name)}) for r, name in force]
    try:
        changed = solve(problem.like(records=records), loss=optimum.loss)
    except DahlIdentError:
        return ""
    residuals = np.concatenate(changed.problem.split_residuals(changed.values))
    after = float(np.sqrt(np.mean(residuals**2))) / problem.output_std
    return _with_changed_sign("the force negated", before, after, _SIGN)


def _work(problem: RecordProblem) -> float:
    """Return the work of the force on the motion of all records, J."""
    work = 0.0
    for record in problem.records:
        x = record.displacement
        if x is None:
            x = in_band(record, record.motion_samples)[0]
        force = record.force_samples - record.force_samples.mean()
        work += float(np.trapezoid(force, x))
    return work


def refitted_without(optimum: Optimum, rows: Sequence[int]) -> Optimum | None:
    """Return the optimum without some rows; None if there is none."""
    data = optimum.problem.data
    kept = ~np.isin(np.arange(data.n), rows)
    try:
        refit = solve(optimum.problem.like(data=data.select(rows=kept)), loss=optimum.loss)
    except DahlIdentError:
        return None
    return None if refit.status is Status.NOT_CONVERGED else refit


def neighbourhood(optimum: Optimum, rows: Sequence[int]) -> str:
    """Return the range of several rows that are closer together than by chance, otherwise ""."""
    k, n = len(rows), optimum.problem.data.n
    if k < 2:
        return ""
    for name, values, unit in covariates(optimum):
        low, high = values[list(rows)].min(), values[list(rows)].max()
        span = int(((values >= low) & (values <= high)).sum())
        to_end = min(int((values >= low).sum()), int((values <= high).sum()))
        as_close = sum((n - s + 1) * comb(s - 2, k - 2) for s in range(k, span + 1))
        if min(as_close, 2 * comb(to_end, k)) < _CLUSTER_BY_CHANCE * comb(n, k):
            return f"{name} from {low:.3g} to {high:.3g} {unit}"
    return ""


def is_at_end(optimum: Optimum, rows: Sequence[int]) -> bool:
    """Return whether a row is the first or last of a covariate, where the model may fail."""
    if len(rows) != 1:
        return False
    ranges = (values for _, values, _ in covariates(optimum) if np.unique(values).size >= _FEWEST)
    return any(values[rows[0]] in (values.min(), values.max()) for values in ranges)


def _misfit(problem: TableProblem, fitted: ComplexArray) -> FloatArray:
    response, harmonic = problem.data.response, problem.data.harmonic
    order = 1 if (harmonic == 1).any() else harmonic.min()
    rows = (harmonic == order) & (response != 0.0)
    responding = rows & (fitted != 0.0)  # within a gap there is no response
    rows = responding if responding.any() else rows
    return np.asarray(np.abs(1.0 - fitted[rows] / response[rows]))

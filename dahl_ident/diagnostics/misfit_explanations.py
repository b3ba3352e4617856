"""Possible causes of a misfit: a sign convention, or single rows. Nothing is corrected or dropped.

A row is suspicious if leaving it out (the mean-shift test, which accounts for leverage) lowers the
sum of squares by more than noise would. The most deviant row is removed before the next is judged,
so that outliers do not mask one another; up to a tenth of the rows, and of more than 500 several at
a time. The level is 1 % for the whole table, divided by the number of rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from dahl_ident.problem import RecordProblem, TableProblem
from dahl_ident.problem.record_noise import in_band

_CHANCE = 0.01  # false-alarm rate of the worst of all points
_SHARE = 0.1  # of the rows: if more deviate, the model or noise is wrong, not single rows
_ONE_BY_ONE = 500  # rows up to which each is removed before the next is judged
_LEAST_DOF = 4  # without the suspicious rows; fewer do not show the noise
_GOOD = "good"
EXPLAINS = 3.0  # factor by which a cause lowers the misfit
_GIVES_ENERGY = -0.05  # mean sine of the stiffness's phase: a loss of energy makes it positive
_GIVING = "The mechanism gives energy to its drive, as no friction does"
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


def rms_misfit_of(problem: TableProblem, fitted: ComplexArray) -> float:
    """Return the root mean square of abs(measured - fitted)/abs(measured) of fundamentals."""
    return float(np.sqrt(np.mean(_misfit(problem, fitted) ** 2)))


def sign_convention(problem: TableProblem) -> str:
    """Return a sentence if the measured response gives energy to its source, otherwise ""."""
    view = problem.stiffness_data
    Z = view.stiffness[(view.harmonic == 1) & (view.stiffness != 0.0)]
    phase = float(np.mean(Z.imag / np.abs(Z))) if Z.size else 0.0
    if phase > _GIVES_ENERGY:
        return ""
    return (
        f"{_GIVING}: check the sign of the phase, which is that of exp(+j omega t), and that force "
        "and displacement are positive in the same direction"
    )


def force_convention(problem: RecordProblem) -> str:
    """Return a sentence if the force takes energy out of the mechanism, otherwise ""."""
    if problem.excitation == "base" or _work(problem) >= 0.0:
        return ""
    return f"{_GIVING}: check that force and displacement are positive in the same direction"


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

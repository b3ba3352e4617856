"""Suspicious points, which are listed but never dropped.

A point is tested by letting it have a response of its own (the mean-shift test): how much of the
sum of squares goes away with its two residuals, leverage included, against what noise would do.
The most deviant point is set aside and the others are judged without it, so that outliers do not
mask one another; up to a tenth of the points are set aside in this way, of more than 500 points
several at a time. A robust fit is little
affected by outliers, so its residuals are tested directly. The level is 1 % for the whole table,
divided by the number of points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import row_names
from dahl_ident.diagnostics.residual_space import ResidualSpace
from dahl_ident.fitting import Optimum

_LEVEL = 0.01  # false-alarm rate, of the worst of all points
_SHARE = 0.1  # of the rows: if more stand out, model or noise is wrong, not single rows
_ONE_BY_ONE = 500  # rows up to which each is set aside before the next is judged
_LEAST_DOF = 4  # without the suspected rows; fewer do not show the noise
_GOOD = "good"


@dataclass(frozen=True)
class SuspiciousPoint:
    """A point that noise does not explain."""

    row: int  # its index in the table
    name: str  # what a person calls it: frequency, level, harmonic, run
    frequency_hz: float  # where it is
    amplitude: float
    level: Any  # its label, None where the table has none
    deviation: float  # its distance from the fit to the others, in standard deviations
    p_value: float  # probability that the worst of all points deviates as far by noise alone

    def __str__(self) -> str:
        return f"{self.name} lies {self.deviation:.1f} standard deviations off"


def suspicious_points(optimum: Optimum, space: ResidualSpace) -> tuple[SuspiciousPoint, ...]:
    """Return the points that stand apart, the most deviant first."""
    found = _beyond_noise(optimum) if optimum.loss != "linear" else _standing_apart(optimum, space)
    data, amplitude = optimum.problem.data, optimum.problem.stiffness_data.amplitude
    return tuple(
        SuspiciousPoint(
            row,
            name,
            float(data.frequency_hz[row]),
            float(amplitude[row]),
            None if data.level is None else data.level[row].item(),
            deviation,
            p,
        )
        for (row, deviation, p), name in zip(
            found, row_names(data, [row for row, *_ in found]), strict=True
        )
    )


def _standing_apart(optimum: Optimum, space: ResidualSpace) -> list[tuple[int, float, float]]:
    """Return row, deviation and p-value of points found one after the other."""
    n = optimum.problem.data.n
    at_once = 1 + n // _ONE_BY_ONE
    rows: list[int] = []
    found: list[tuple[int, float, float]] = []
    for _ in range(0, max(1, int(_SHARE * n)), at_once):
        worst = _most_deviant(optimum, space, rows, at_once)
        rows += [row for row, *_ in worst]
        found += worst
        if len(worst) < at_once:
            break
    significant = [i for i, (*_, p) in enumerate(found, start=1) if p < _LEVEL]
    return found[: max(significant, default=0)]


def _beyond_noise(optimum: Optimum) -> list[tuple[int, float, float]]:
    """Return the same for a robust fit, which no outlier has bent: whatever noise cannot reach."""
    m, dof = optimum.problem.n_residuals, max(optimum.dof, 1)
    y, _ = optimum.problem.residuals_and_jacobian(optimum.theta, optimum.scale, tails=False)
    squares = y[:m:2] ** 2 + y[1:m:2] ** 2
    tail = special.chdtrc(2, squares) if optimum.scale_known else special.fdtrc(2, dof, squares / 2)
    p = np.minimum(1.0, squares.size * tail)
    order = np.argsort(-squares)
    return [(int(i), float(np.sqrt(squares[i])), float(p[i])) for i in order if p[i] < _LEVEL]


def _most_deviant(
    optimum: Optimum, space: ResidualSpace, without: list[int], count: int
) -> list[tuple[int, float, float]]:
    """Return row, deviation and p-value of the worst points, some rows set aside.

    Each is judged without those before it, the effect of these few on the fit to many left out.
    """
    m, n = space.residuals.size, space.residuals.size // 2
    keep = np.ones(n, dtype=np.bool_)
    keep[without] = False
    pairs = np.repeat(keep, 2)
    Q = np.linalg.qr(space.basis[pairs])[0] if without else space.basis
    r = np.zeros(m)
    r[pairs] = space.residuals[pairs] - Q @ (Q.T @ space.residuals[pairs])
    lever = np.zeros((m, Q.shape[1]))
    lever[pairs] = Q
    squares = _shifts(r, lever)
    squares[without] = -np.inf
    total = float(r @ r)
    found: list[tuple[int, float, float]] = []
    for row in np.argsort(-squares, kind="stable")[:count].tolist():
        aside = len(without) + len(found)
        dof, explained = space.dof - 2 * aside, float(squares[row])
        variance = 1.0 if optimum.scale_known else (total - explained) / max(dof - 2, 1)
        if dof < _LEAST_DOF or not variance > 0.0:
            break
        p = min(1.0, (n - aside) * space.tail_of(explained, 2, total, dof))
        found.append((row, float(np.sqrt(explained / variance)), p))
        total -= explained
    return found


def _shifts(r: FloatArray, lever: FloatArray) -> FloatArray:
    """Return by how much the sum of squares falls without each point: r' (I - H)^-1 r."""
    pairs = r.reshape(-1, 2)
    Q = lever.reshape(len(pairs), 2, -1)
    one, other = Q[:, 0], Q[:, 1]
    xx, xy, yy = (1.0 - (one * one).sum(1), -(one * other).sum(1), 1.0 - (other * other).sum(1))
    determinant = xx * yy - xy**2
    x, y = pairs.T
    form = yy * x**2 - 2.0 * xy * x * y + xx * y**2
    fixed = determinant < 1e-8  # a point that alone determines a parameter
    return np.where(fixed, 0.0, form / np.where(fixed, 1.0, determinant))


def flagged_rows(data: FrequencyResponse) -> tuple[str, ...]:
    """Return a sentence for each kind of flaw among the fundamentals, with its rows.

    Examples
    --------
    >>> from dahl_ident.data import FrequencyResponse
    >>> data = FrequencyResponse(
    ...     [1.0, 1.0], [1.0, 2.0], [1.0, 2.0], quality={"verdict": ["good", "not settled"]}
    ... )
    >>> flagged_rows(data)
    ('1 Hz, 2 m: not settled',)
    """
    verdicts = data.quality.get("verdict")
    if verdicts is None:
        return ()
    rows = np.flatnonzero((verdicts != _GOOD) & (data.harmonic == 1))
    return tuple(
        f"{name}: {verdicts[row]}"
        for row, name in zip(rows, row_names(data, rows.tolist()), strict=True)
    )

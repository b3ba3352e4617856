"""Every steady motion of known plants, exactly: from the describing function's to the true one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Model
from dahl_ident.steady_state.plant import BoolArray
from dahl_ident.steady_state.shooting import NEUTRAL, Shooting

_HARMONICS = (1, 0, *range(2, 10))
_SAME = 1e-6  # relative difference of two motions that are one
_CYCLES = 3  # that an estimate goes through, so that memory of its own start fades


class ExactMotions(NamedTuple):
    """Fundamentals X of every motion of every point, (points, most), NaN beyond the last.

    By rising size; `share` is the root sum of squares of the mean and the harmonics 2 to 9 over the
    fundamental, `multiplier` the largest modulus of the multipliers of a cycle.
    """

    displacement: ComplexArray
    share: FloatArray
    multiplier: FloatArray


def exact_motions(
    model: Model,
    omega: FloatArray,
    drive: FloatArray,
    near: ComplexArray,
    unique: BoolArray,
    *,
    every: bool,
) -> ExactMotions:
    """Return the exact motions of points, (n,), near estimates of their fundamentals, (n, most).

    Where the estimate is `unique`, so is the motion, and it is sought from rest. Elsewhere each
    estimate is a start. Stable motions come first unless `every` one is wanted, by rising size.
    """
    shooting = Shooting(model)
    values = np.array([float(v) for v in model.known_values()])
    n, most = near.shape
    X = np.full((n, most), np.nan, dtype=np.complex128)
    share, multiplier = np.full((n, most), np.nan), np.full((n, most), np.nan)
    for column in range(most):
        begin = np.isfinite(near[:, column])
        if column == 0:
            begin |= unique
        for only in (True, False):
            rows = np.flatnonzero(begin & (unique == only))
            if not rows.size or (only and column):
                continue
            starts = None
            if not only:
                starts = np.zeros((rows.size, shooting.system.order))
                starts[:, 0] = near[rows, column].real
                starts[:, 1] = -omega[rows] * near[rows, column].imag
            found = shooting(
                np.tile(values, (rows.size, 1)), omega[rows], drive[rows], harmonics=_HARMONICS,
                starts=starts, cycles=None if only else _CYCLES, stable=False,
            )  # fmt: skip
            X[rows, column] = found.harmonics[:, 0]
            rest = np.sqrt((np.abs(found.harmonics[:, 1:]) ** 2).sum(axis=1))
            share[rows, column] = rest / np.abs(found.harmonics[:, 0])
            multiplier[rows, column] = found.multiplier
    X[~np.isfinite(multiplier)] = np.nan
    size = np.abs(X)
    for column in range(1, most):  # one motion may be found from two estimates
        with np.errstate(invalid="ignore"):
            same = np.abs(X[:, :column] - X[:, column : column + 1]) < _SAME * size[:, :column]
        X[same.any(axis=1), column] = np.nan
    order = np.argsort(np.abs(X), axis=1)
    if not every:
        with np.errstate(invalid="ignore"):
            loose = ~(multiplier < 1.0 + NEUTRAL) & np.isfinite(X)
        order = np.lexsort((np.abs(X), loose), axis=1)
    return ExactMotions(*(np.take_along_axis(a, order, axis=1) for a in (X, share, multiplier)))

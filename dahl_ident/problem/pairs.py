"""Residuals in pairs: the two of a row of data count as one where a loss weighs them."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray


def squares(residuals: FloatArray) -> FloatArray:
    """Return the sum of squares of each pair, (..., 2 n) -> (..., n)."""
    return np.asarray(residuals[..., 0::2] ** 2 + residuals[..., 1::2] ** 2)


def weighted(rows: FloatArray, m: int, size: FloatArray, along: FloatArray) -> FloatArray:
    """Return residuals times `size`, derivatives d of each pair y as size d + along y (y' d).

    `rows` are residuals and, below them, their derivatives, (..., 1 + P, k); what stands after
    the first `m` residuals, those of priors, stays.
    """
    first, second = rows[..., :1, 0:m:2], rows[..., :1, 1:m:2]
    by_first, by_second = rows[..., 1:, 0:m:2], rows[..., 1:, 1:m:2]
    lever = along[..., None, :] * (first * by_first + second * by_second)
    result = rows.copy()
    result[..., :m] *= np.repeat(size, 2, axis=-1)[..., None, :]
    result[..., 1:, 0:m:2] += first * lever
    result[..., 1:, 1:m:2] += second * lever
    return result

"""Forces that depend on the history: motion in one direction, and linear recursions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtbtrs

from dahl_ident.arrays import FloatArray


@dataclass(frozen=True)
class Stretches:
    """A displacement of n samples, divided into m stretches of one direction each.

    Attributes
    ----------
    direction : ndarray, shape (m,)
        +1 or -1.
    length : ndarray, shape (m - 1,)
        Length of every stretch except the last, m.
    path : ndarray, shape (n,)
        Path from the last turning point to every sample, m.
    samples : ndarray of int, shape (m,)
        Number of samples in every stretch.
    """

    direction: FloatArray
    length: FloatArray
    path: FloatArray
    samples: np.ndarray[tuple[int], np.dtype[np.intp]]

    def spread(self, values: FloatArray) -> FloatArray:
        """Return values of the stretches, (m, ...), at every sample, (n, ...)."""
        return np.repeat(values, self.samples, axis=0)


def stretches(displacement: FloatArray) -> Stretches:
    """Return the stretches of a displacement.

    A step of zero continues the direction of the step before it. A turning point belongs to the
    stretch that starts there.

    Examples
    --------
    >>> parts = stretches(np.array([0.0, 1.0, 3.0, 2.0]))
    >>> parts.direction.tolist(), parts.length.tolist(), parts.path.tolist()
    ([1.0, -1.0], [3.0], [0.0, 1.0, 0.0, 1.0])
    """
    if displacement.size < 2:
        return Stretches(np.ones(1), np.zeros(0), np.zeros(1), np.ones(1, dtype=np.intp))
    steps = np.sign(np.diff(displacement))
    moves = steps != 0.0
    if not moves.all():
        last = np.maximum.accumulate(np.where(moves, np.arange(steps.size), moves.argmax()))
        steps = np.where(steps[last] < 0.0, -1.0, 1.0)
    turns = np.concatenate(([0], np.flatnonzero(steps[1:] != steps[:-1]) + 1))
    turning_points = displacement[turns]
    samples = np.diff(turns, append=displacement.size)
    path = np.abs(displacement - np.repeat(turning_points, samples))
    return Stretches(steps[turns], np.abs(np.diff(turning_points)), path, samples)


def linear_recursion(keep: FloatArray, term: FloatArray, first: FloatArray) -> FloatArray:
    """Return y with y[0] = first, (c,), and y[i + 1] = keep[i] y[i] + term[i]; `keep` is (n,).

    Examples
    --------
    >>> linear_recursion(np.array([0.5, 0.5]), np.ones((2, 1)), np.zeros(1)).ravel().tolist()
    [0.0, 1.0, 1.5]
    """
    return matrix_recursion(keep[:, None, None], term[:, None], first[None])[:, 0]


def matrix_recursion(keep: FloatArray, term: FloatArray, first: FloatArray) -> FloatArray:
    """Return y with y[0] = first, (order, c), and y[i + 1] = keep[i] y[i] + term[i].

    `keep` holds matrices, (n, order, order). LAPACK solves the banded triangular system by one
    forward substitution.
    """
    n, order, _ = keep.shape
    band = np.zeros((2 * order, (n + 1) * order), order="F")
    band[0] = 1.0
    columns = band.reshape(2 * order, n + 1, order)
    for i in range(order):  # row of the later state
        for j in range(order):  # column of the earlier one
            columns[order + i - j, :-1, j] = -keep[:, i, j]
    right = np.concatenate([first[None], term]).reshape((n + 1) * order, -1)
    solution, _ = dtbtrs(band, np.asfortranarray(right), uplo="L", diag="U", overwrite_b=1)
    return np.asarray(solution).reshape(n + 1, order, -1)

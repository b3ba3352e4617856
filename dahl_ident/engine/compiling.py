"""What all compiled functions share: how they are compiled, and the algebra of a step's stages."""

from __future__ import annotations

import numpy as np
from numba import float64, int64, njit, types

from dahl_ident.engine.collocation import STAGES

_PIVOT = 0.1  # of the largest number in a row: a smaller diagonal is not a pivot
_POLE = 3.0  # a slope at the end of a step, over the largest before, that counts as infinite
_GOES_ON = 0.5  # a rate at the end of a step, over the one before, that does not fade

FUNCTION = types.FunctionType(types.void(types.CPointer(float64)))
NUMBERS, VECTOR, TABLE = int64[::1], float64[::1], float64[:, ::1]
"""Types of the kernels' arguments."""

OPTIONS = {
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "_nrt": False,  # counting references to an array takes longer than computing with it
}
compiled = njit(**OPTIONS)
inlined = njit(inline="always", **OPTIONS)


@compiled
def eliminate(matrix, columns, n, q):
    """Solve matrix x = columns in place by Gaussian elimination; False if singular.

    A row with a large diagonal is not exchanged for one with larger numbers, such as accelerations:
    rounding would then leave some force where there is none.
    """
    for k in range(n):
        pivot, largest, off_diagonal = k, abs(matrix[k, k]), 0.0
        for j in range(k + 1, n):
            off_diagonal = max(off_diagonal, abs(matrix[k, j]))
        for i in range(k + 1, n if largest < _PIVOT * off_diagonal else 0):
            if abs(matrix[i, k]) > largest:
                pivot, largest = i, abs(matrix[i, k])
        if not 0.0 < largest < np.inf:
            return False
        if pivot != k:
            for j in range(k, n):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            for j in range(q):
                columns[k, j], columns[pivot, j] = columns[pivot, j], columns[k, j]
        inverse = 1.0 / matrix[k, k]
        for i in range(k + 1, n):
            factor = matrix[i, k] * inverse
            if factor != 0.0:
                for j in range(k + 1, n):
                    matrix[i, j] -= factor * matrix[k, j]
                for j in range(q):
                    columns[i, j] -= factor * columns[k, j]
    for k in range(n - 1, -1, -1):
        inverse = 1.0 / matrix[k, k]
        for j in range(q):
            columns[k, j] *= inverse
        for i in range(k):
            factor = matrix[i, k]
            for j in range(q):
                columns[i, j] -= factor * columns[k, j]
    return True


@compiled
def remove_pole(slopes, first, between, rates, rate, next_rate):
    """Replace a slope at the last stage by that before if it is infinite where the state goes on.

    A rate with a power of abs(force) below 1 has such a slope at zero force, where the step ends.
    Its integral is finite. Where the rate of the state fades, the state is at a limit instead, to
    which an infinite slope binds it.
    """
    last, largest = first + (STAGES - 1) * between, 0.0
    end = rate + (STAGES - 1) * next_rate
    if abs(rates[end]) < _GOES_ON * abs(rates[end - next_rate]):
        return
    for i in range(first, last, between):
        largest = max(largest, abs(slopes[i]))
    if abs(slopes[last]) > _POLE * largest:
        slopes[last] = slopes[last - between]

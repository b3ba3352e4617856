"""What all kernels share: Radau IIA tables, how functions are compiled, the algebra of stages.

The method has five stages: it is collocation of order 9.
"""

from __future__ import annotations

import numpy as np
from numba import float64, int64, njit, types
from numpy.polynomial import legendre

from dahl_ident.arrays import FloatArray

STAGES = 5
SHORTEST = 12.0  # least number of steps in a cycle of the highest harmonic
_PIVOT = 0.1  # of the largest number in a row: a smaller diagonal is not a pivot
_POLE = 3.0  # a slope at the end of a step, over the largest before, that counts as infinite
_GOES_ON = 0.5  # a rate at the end of a step, over the one before, that does not fade


def _tables() -> tuple[FloatArray, ...]:
    """Return nodes and matrix of the method, and weights of the stages at both ends of a step.

    The last three are weights of the changes at the stages in the slope at the beginning and at the
    end, and weights of values at the stages in the value at the beginning.
    """
    series = np.zeros(STAGES + 1)
    series[STAGES - 1 :] = -1.0, 1.0  # P_s - P_(s-1), whose roots are the nodes
    nodes = np.sort(np.real(legendre.legroots(series)))
    for _ in range(3):
        nodes -= legendre.legval(nodes, series) / legendre.legval(nodes, legendre.legder(series))
    nodes = 0.5 * (nodes + 1.0)
    nodes[-1] = 1.0
    powers = np.arange(STAGES)
    inverse = np.linalg.inv(nodes[:, None] ** powers)
    matrix = nodes[:, None] ** (powers + 1) / (powers + 1) @ inverse
    slopes = np.linalg.inv(matrix)  # of the stages, from the changes
    return nodes, matrix, inverse[0] @ slopes, slopes[-1], inverse[0]


NODES, MATRIX, SLOPE_BEFORE, SLOPE_AFTER, VALUE_BEFORE = _tables()
FACTORS = tuple(
    1.0 / np.prod([NODES[j]] + [NODES[j] - NODES[k] for k in range(STAGES) if k != j])
    for j in range(STAGES)
)
"""Leading coefficients of the polynomials that are 1 at one node, 0 at the others and at 0."""

CHECKED = np.array([0.5 * NODES[0], 0.5 * (NODES[-2] + NODES[-1])])  # positions of error checks
POSITIONS = np.concatenate(
    [a + (b - a) * np.arange(1, 5) / 4 for a, b in zip([0.0, *NODES[:-1]], NODES, strict=True)]
)
"""Positions in a step at which events are looked for."""

_POWERS = np.arange(STAGES + 1)
_CHANGES = np.linalg.inv(NODES[:, None] ** _POWERS[1:])  # coefficients, from changes at the stages
SLOPE_CHECKED = (_POWERS[1:] * CHECKED[:, None] ** _POWERS[:-1]) @ _CHANGES
CHANGE_CHECKED = CHECKED[:, None] ** _POWERS[1:] @ _CHANGES
"""Weights of the changes at the stages in the slopes, and in the changes, at `CHECKED`."""

VALUE_AT = POSITIONS[:, None] ** _POWERS @ np.linalg.inv(np.append(0.0, NODES)[:, None] ** _POWERS)
"""Weights of values at the beginning and the stages in those at `POSITIONS`."""

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

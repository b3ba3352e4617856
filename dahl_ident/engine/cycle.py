"""Settled motion under a sine: of a law under its displacement, or of a plant under its drive.

The settled motion is the fixed point of the map of one cycle, y(T) = y(0), which is solved by
Newton's method with the derivatives of that map (shooting). Equations that are the same in both
directions need half a cycle: y(T/2) = -y(0). Derivatives of the fixed point follow from the
implicit function theorem.
"""

from __future__ import annotations

import numpy as np
from numba import boolean, complex128, float64, int64, njit, types

from dahl_ident.engine.integrate import Asked, Scratch, advance
from dahl_ident.engine.radau import LAYOUT, Signal, at_unit_velocity, put_parameters, restart
from dahl_ident.engine.stages import (
    FUNCTION,
    NUMBERS,
    SHORTEST,
    STAGES,
    TABLE,
    VECTOR,
    compiled,
    eliminate,
)

_SHOTS = 40  # of shooting; five are typical
# Changes of the initial states over the largest states:
_CONVERGED = 1e-4  # the last cycle corrects the error, which is the square of this
_LARGEST_CHANGE = 1.0  # a larger change by Newton's method is replaced by a cycle,
_NEWTON_EVERY = 4  # except every fourth: in a sharp resonance cycles alone take too long
_AGREED = 1e-3  # a larger change by the last cycle is due to rounding: nothing settles
_FOLLOWS = 1e-9  # relative difference of two changes by a cycle that count as proportional
_UNDECIDED = 1e-9  # change of all states by a cycle that is an error of its steps
_FADING = 0.1  # weight of the sizes in earlier cycles, which may have been far too large
_COARSE = 300.0  # errors of steps while shooting, over those of the last cycle


@compiled
def keep_offsets(f, signal, y, chosen, w, at, matrix, columns):
    """Let states that follow the displacement through a whole cycle keep their offset from it.

    They return to any initial value: the equation is trivial, and is replaced.
    """
    n, o = at.n, at.outputs
    m = n + 1 + at.k
    at_unit_velocity(f, signal, 0.0, y, w, at)
    for i in range(2, n):
        g = w[o + i]
        follows = g != 0.0
        for j in range(n):
            difference = abs(matrix[i, j] - g * matrix[0, j]) * w[at.scale + j]
            size = w[at.scale + i] + abs(g) * w[at.scale]
            follows = follows and difference <= _FOLLOWS * size
        if follows:
            matrix[i] = 0.0
            matrix[i, i], matrix[i, 0] = 1.0, -g
            columns[i] = 0.0
            for z in range(chosen.size):
                columns[i, 2 + z] = w[o + m * (1 + n) + i * (1 + at.P) + 1 + chosen[z]] * y[0]


@njit(
    types.Tuple((NUMBERS, complex128[:, :, ::1], TABLE, float64[:, :, ::1]))(
        FUNCTION,
        LAYOUT,
        NUMBERS,
        NUMBERS,
        boolean,
        VECTOR,
        VECTOR,
        TABLE,
        TABLE,
        NUMBERS,
        VECTOR,
        int64,
        float64,
    ),
    cache=True,
    error_model="numpy",
)
def cycles(
    f,
    at,
    solved,
    followers,
    odd,
    amplitudes,
    omegas,
    parameters,
    starts,
    chosen,
    harmonics,
    initial_cycles,
    tolerance,
):
    """Return settled motions, row by row.

    Whether each converged; harmonics c_k of ``output = sum of Re c_k exp(j k omega t)`` with their
    derivatives with respect to the signal's amplitude and the parameters `chosen`; the initial
    states; the map of a cycle, or of half a cycle with its sign if the system is odd. The first
    `initial_cycles` iterations are cycles without Newton's method.
    """
    n, held, rows = at.n, at.held, amplitudes.size
    begin = 2 if held else 0
    free = n - begin
    sign = -1.0 if odd else 1.0
    q = free + 1 + chosen.size
    w = np.zeros(at.length)
    size = STAGES * n
    block, sides = np.zeros((size, size)), np.zeros((size, max(1, q)))
    converged = np.zeros(rows, dtype=np.int64)
    result = np.zeros((rows, harmonics.size, 2 + chosen.size), dtype=np.complex128)
    first, maps = starts.copy(), np.zeros((rows, n, n))
    no_array, no_parameters = np.empty(0), np.empty(0, dtype=np.int64)
    no_table, no_sums = np.empty((0, 0)), np.empty((0, 1 + q), dtype=np.complex128)
    sums = np.zeros((harmonics.size, 1 + q), dtype=np.complex128)
    nothing = Asked(no_array, no_sums, no_array, no_array, no_table, no_table)
    asked = Asked(harmonics, sums, no_array, no_array, no_table, no_table)
    scratch = Scratch(solved, followers, w, at, block, sides)
    matrix, columns = np.zeros((free, free)), np.zeros((free, 2 + chosen.size))
    highest = 1.0
    for k in harmonics:
        highest = max(highest, k)
    for row in range(rows):
        put_parameters(f, parameters[row], w, at)
        restart(w, at)
        signal = Signal(True, amplitudes[row], omegas[row], no_array, no_table)
        period = 2.0 * np.pi / omegas[row]
        times = np.array([0.0, 0.5 * period if odd else period])
        longest = period / (SHORTEST * highest)
        step = 0.1 * longest
        y = first[row]
        if held:
            y[0], y[1] = amplitudes[row], 0.0
        for coarse in (_COARSE, 1.0):  # if coarse steps fail, fine ones may not
            converged[row] = 0
            for iteration in range(_SHOTS):
                w[at.scale : at.scale + n] *= _FADING
                x, S = y.copy(), np.zeros((n, free + 1))
                for i in range(free):
                    S[begin + i, i] = 1.0
                step = advance(
                    f,
                    signal,
                    times,
                    x,
                    S,
                    no_parameters,
                    coarse * tolerance,
                    longest,
                    step,
                    nothing,
                    scratch,
                )
                if step <= 0.0:
                    break
                for i in range(free):
                    for j in range(free):
                        matrix[i, j] = (1.0 if i == j else 0.0) - sign * S[begin + i, j]
                    columns[i, 0] = sign * x[begin + i] - y[begin + i]
                if not held:
                    keep_offsets(f, signal, y, no_parameters, w, at, matrix, columns)
                largest = 0.0
                if iteration < initial_cycles or not eliminate(matrix, columns, free, 1):
                    largest = np.inf
                for i in range(free if iteration >= initial_cycles else 0):
                    if columns[i, 0] != 0.0:
                        largest = max(largest, abs(columns[i, 0]) / w[at.scale + begin + i])
                for i in range(free):
                    is_forced = largest < np.inf and iteration % _NEWTON_EVERY == _NEWTON_EVERY - 1
                    if largest <= _LARGEST_CHANGE or is_forced:
                        y[begin + i] += columns[i, 0]
                    else:
                        y[begin + i] = sign * x[begin + i]
                if largest < _CONVERGED:
                    converged[row] = 1
                    break
            if not converged[row]:
                continue
            x, S = y.copy(), np.zeros((n, q))
            for i in range(free):
                S[begin + i, i] = 1.0
            if held:
                S[0, free] = 1.0
            sums[:] = 0.0
            step = advance(f, signal, times, x, S, chosen, tolerance, longest, step, asked, scratch)
            if step <= 0.0:
                converged[row] = 0
                continue
            largest = 0.0
            for i in range(free):
                largest = max(largest, abs(1.0 - sign * S[begin + i, i]))
                for j in range(free):
                    maps[row, begin + i, begin + j] = S[begin + i, j]
                    matrix[i, j] = (1.0 if i == j else 0.0) - sign * S[begin + i, j]
                for z in range(1 + chosen.size):
                    columns[i, 1 + z] = sign * S[begin + i, free + z]
                columns[i, 0] = sign * x[begin + i] - y[begin + i]
            if not held:
                keep_offsets(f, signal, y, chosen, w, at, matrix, columns)
            if not eliminate(matrix, columns, free, 2 + chosen.size):
                columns[:] = np.inf
            if free and largest < _UNDECIDED:
                converged[row] = 0
            for i in range(free):
                if abs(columns[i, 0]) > _AGREED * w[at.scale + begin + i]:
                    converged[row] = 0
                y[begin + i] += columns[i, 0]
            if converged[row]:
                break
        if not converged[row]:
            continue
        for a in range(harmonics.size):
            k = harmonics[a]
            factor = 2.0 / period if k > 0.0 else 1.0 / period
            if odd:
                factor *= 2.0 if k % 2.0 == 1.0 else 0.0
            for z in range(2 + chosen.size):
                value = sums[a, free + z if z else 0]
                for i in range(free):
                    value += sums[a, 1 + i] * columns[i, z]
                result[row, a, z] = factor * value
    return converged, result, first, maps

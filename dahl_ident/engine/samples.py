"""Motion along given samples: of a plant under its drive, or of a law under its displacement."""

from __future__ import annotations

import numpy as np
from numba import float64, int64, njit, types

from dahl_ident.engine.integrate import Asked, Scratch, advance
from dahl_ident.engine.radau import LAYOUT, Signal, put_parameters, restart
from dahl_ident.engine.stages import FUNCTION, NUMBERS, STAGES, TABLE, VECTOR


@njit(
    types.Tuple((int64, VECTOR, TABLE, TABLE, TABLE))(
        FUNCTION,
        LAYOUT,
        NUMBERS,
        NUMBERS,
        VECTOR,
        TABLE,
        VECTOR,
        VECTOR,
        VECTOR,
        NUMBERS,
        int64,
        float64,
    ),
    cache=True,
    error_model="numpy",
)
def march(
    f,
    at,
    solved,
    followers,
    knots,
    coefficients,
    samples,
    first,
    parameters,
    chosen,
    derivatives,
    tolerance,
):
    """Return success; output at the samples, its derivatives, states; derivatives of the last one.

    The signal is polynomials between knots. If `derivatives` is 1, these are with respect to the
    initial states, the time by which a drive comes earlier, and the parameters `chosen`.
    """
    n, N = at.n, samples.size
    q = n + 1 + chosen.size if derivatives else 0
    w = np.zeros(at.length)
    matrix, columns = np.zeros((STAGES * n, STAGES * n)), np.zeros((STAGES * n, max(1, q)))
    restart(w, at)
    put_parameters(f, parameters, w, at)
    signal = Signal(False, 0.0, 1.0, knots, coefficients)
    y, S = first.copy(), np.zeros((n, q))
    for i in range(n if q else 0):
        S[i, i] = 1.0
    output, by, path = np.empty(N), np.empty((N, q)), np.empty((N, n))
    times = np.array([samples[0], samples[N - 1]])
    step = knots[1] - knots[0]
    no_sums = np.empty((0, 1 + q), dtype=np.complex128)
    asked = Asked(np.empty(0), no_sums, samples, output, by, path)
    scratch = Scratch(solved, followers, w, at, matrix, columns)
    done = advance(f, signal, times, y, S, chosen, tolerance, np.inf, step, asked, scratch)
    return int(done > 0.0), output, by, path, S

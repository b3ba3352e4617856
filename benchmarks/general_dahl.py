"""N for any exponent: seconds an amplitude, memory, and scipy's quad an amplitude."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from benchmarks.harness import Row, median_of_pairs, peak_bytes, print_table, seconds
from dahl_ident.arrays import FloatArray
from dahl_ident.elements.general_dahl import (
    stiffness,
)

ALPHA = 2.0
OURS, PEERS = 10_000, 100
REPEATS = 9


def by_quad(beta: FloatArray) -> None:
    """Integrate Eqns. 13 and 14 for each amplitude, the turning force by root finding."""
    p = 1.0 - ALPHA
    for b in beta:
        f_0 = brentq(lambda f, b=b: ((1 + f) ** p - (1 - f) ** p) / p - 2 * b, 0.0, 1 - 1e-12)

        def force(theta: float, b: float = b, start: float = (1 + f_0) ** p) -> float:
            return float((start - p * b * (1 - np.cos(theta))) ** (1 / p) - 1)

        quad(force, 0.0, np.pi, weight="cos", wvar=1)
        quad(force, 0.0, np.pi, weight="sin", wvar=1)


TITLE = f"Describing function, alpha = {ALPHA:g}"


def run() -> list[Row]:
    """Return times an amplitude, beta from 1e-3 to 1e3, and peak memory."""
    rng = np.random.Generator(np.random.PCG64(0))
    beta = 10.0 ** rng.uniform(-3.0, 3.0, OURS)
    alpha = np.asarray(ALPHA)
    calls = (
        ("N", partial(stiffness, beta, alpha), OURS, 5e-6, 2),
        ("N and derivatives", partial(stiffness, beta, alpha, derivatives=2), OURS, 1e-5, 8),
    )
    rows = []
    for name, call, n, bound, floats_out in calls:
        each = min(seconds(call) for _ in range(REPEATS)) / n
        rows.append(Row(f"{name}, each of {n:,} amplitudes", each, bound, "the bound", 1.0))
        size = 8 * n * (1 + floats_out)
        rows.append(
            Row(f"{name}, peak memory", peak_bytes(call), size, "input and output", 20.0, unit="B")
        )
    few = partial(stiffness, beta[:30], alpha, derivatives=2)
    once = min(seconds(few) for _ in range(100))
    rows.append(Row("N and derivatives, one call for 30", once, 5e-4, "the bound", 1.0))
    ours, peer = median_of_pairs(calls[0][1], partial(by_quad, beta[:PEERS]), REPEATS)
    rows.append(
        Row("N, each amplitude", ours / OURS, peer / PEERS, "scipy brentq, quad", 50.0, faster=True)
    )
    return rows


if __name__ == "__main__":
    print_table(TITLE, run())

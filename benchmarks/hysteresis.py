"""The exact force for a noisy displacement, against a general ODE solver."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.harness import Row, print_table, seconds
from dahl_ident.arrays import FloatArray
from dahl_ident.elements.hysteresis import force_history

F_MAX, SIGMA = 0.1, 30.0
OURS, PEERS = 1_000_000, 300


TITLE = "Force for a displacement history"


def run() -> list[Row]:
    """Return the seconds per sample of both, a reversal at almost every sample."""
    rng = np.random.Generator(np.random.PCG64(0))
    x = np.sin(np.linspace(0.0, 20.0, OURS)) + 0.1 * rng.standard_normal(OURS)
    x *= F_MAX / SIGMA
    rows = []
    for alpha in (1.0, 2.0):
        work = partial(force_history, x, F_MAX, SIGMA, alpha, 0.0)
        ours = min(seconds(work) for _ in range(5))
        peer = seconds(partial(by_solver, x[:PEERS], alpha))
        rows.append(
            Row(
                f"one sample of force, alpha = {alpha:g} (of {OURS:,}: {ours:.3f} s)",
                ours / OURS,
                peer / PEERS,
                "solve_ivp at rtol 1e-8",
                150.0,
                faster=True,
            )
        )
    return rows


def by_solver(x: FloatArray, alpha: float) -> float:
    """Integrate Eqn. 2 over a polyline, one run for each straight stretch."""
    force = 0.0
    for a, b in pairwise(x):
        s = float(np.sign(b - a))

        def slope(_: float, F: FloatArray, s: float = s) -> FloatArray:
            margin = 1.0 - s * F / F_MAX
            return np.asarray(SIGMA * np.abs(margin) ** alpha * np.sign(margin))

        run = solve_ivp(slope, (a, b), [force], rtol=1e-8, atol=1e-8 * F_MAX)
        force = float(run.y[0, -1])
    return force


if __name__ == "__main__":
    print_table(TITLE, run())

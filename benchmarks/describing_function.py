"""N and its derivatives at alpha = 1, against one Bessel function and python-control."""

from __future__ import annotations

import math
from functools import partial

import control
import numpy as np
from scipy import special

from benchmarks.harness import Row, median_of_pairs, peak_bytes, print_table, seconds
from dahl_ident import Dahl
from dahl_ident.arrays import FloatArray
from dahl_ident.elements.linear_dahl import describing_function_gradient

F_MAX, SIGMA = 0.1, 30.0
OURS, PEERS = 100_000, 300
REPEATS = 31


class DahlElement:
    """The force at each of a sequence of displacements, from rest, as python-control calls it."""

    def __init__(self) -> None:
        self.displacement = self.force = 0.0

    def __call__(self, displacement: float) -> float:
        """Return the force after a monotone move to `displacement` (Eqn. 3)."""
        step = displacement - self.displacement
        limit = math.copysign(F_MAX, step)
        self.force = limit + (self.force - limit) * math.exp(-SIGMA / F_MAX * abs(step))
        self.displacement = displacement
        return self.force


def by_control(amplitudes: FloatArray) -> None:
    """Evaluate N by python-control, an element at rest for each amplitude."""
    for amplitude in amplitudes:
        control.describing_function(DahlElement(), [amplitude])


TITLE = "Describing function, alpha = 1"


def run() -> list[Row]:
    """Return times and peak memory at 1e5 amplitudes, beta from 1e-3 to 1e3."""
    rng = np.random.Generator(np.random.PCG64(0))
    beta = 10.0 ** rng.uniform(-3.0, 3.0, OURS)
    amplitude = beta * (F_MAX / SIGMA)
    pivot = Dahl(F_MAX, SIGMA)
    values = pivot.known_values()
    bessel = partial(special.i1e, beta)
    calls = (
        ("N", partial(pivot.describing_function, amplitude), 1.5, 2),
        ("N/sigma and both derivatives", partial(describing_function_gradient, beta), 3.5, 6),
        (
            "N and all derivatives of the element",
            partial(pivot.stiffness_gradient, values, amplitude, np.zeros(())),
            3.5,
            10,
        ),
    )
    rows = []
    for name, call, bound, floats_out in calls:
        ours, peer = median_of_pairs(call, bessel, REPEATS)
        rows.append(Row(f"{name}, {OURS:,} amplitudes", ours, peer, "one scipy i1e", bound))
        size = beta.nbytes * (1 + floats_out)
        rows.append(
            Row(f"{name}, peak memory", peak_bytes(call), size, "input and output", 20.0, unit="B")
        )
    ours = min(seconds(calls[0][1]) for _ in range(REPEATS))
    peer = seconds(partial(by_control, amplitude[:PEERS])) * OURS / PEERS
    rows.append(
        Row(
            f"N, {OURS:,} amplitudes",
            ours,
            peer,
            f"python-control, scaled from {PEERS}",
            1000.0,
            faster=True,
        )
    )
    return rows


if __name__ == "__main__":
    print_table(TITLE, run())

"""Fig. 7 of the paper by its describing function, 51 levels x 500 frequencies, against brentq.

Run with ``python -m benchmarks.steady_state``. Three peers, since a loop over brentq can be
written in several ways: "same plant" evaluates the same plant object, whatever it is made of;
"plain" writes out this plant with scipy's Bessel function; "tuned" gives that the tightest bracket
that theory knows, and the math module. Only the first solves any other plant too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.special import i1e

from benchmarks.harness import Row, median_of_pairs, peak_bytes, print_table
from dahl_ident import Dahl, Damper, Mass, Spring, response
from dahl_ident.elements.driven_motion import Steady

F_MAX, SIGMA, MASS, DAMPING, STIFFNESS = 0.1, 30.0, 0.3, 0.24, 0.3
FREQUENCY_HZ = np.geomspace(0.01, 30.0, 500)
DRIVE = np.geomspace(1e-4, 10.0, 51)
SHARE = 20  # the peers solve every twentieth frequency; their time grows with the number of points
SINE: Steady = "describing function"
PLANT = Dahl(F_MAX, SIGMA) + Mass(MASS) + Damper(DAMPING) + Spring(STIFFNESS)


def ours() -> object:
    """Solve the whole figure."""
    return response(PLANT, FREQUENCY_HZ, DRIVE[:, None], steady=SINE)


def same_plant(omega: float, drive: float) -> float:
    """Solve one point of any plant."""
    return brentq(
        lambda A: A * abs(PLANT.dynamic_stiffness(A, omega)) - drive,
        1e-9,
        1e3,
        xtol=1e-300,
        rtol=1e-13,
    )


def plain(omega: float, drive: float) -> float:
    """Solve one point as first written down."""

    def excess(A: float) -> float:
        beta = SIGMA * A / F_MAX
        real = 2.0 * i1e(beta) * (1.0 + np.tanh(beta)) / beta
        imag = 4.0 / np.pi * (1.0 - np.tanh(beta) / beta) / beta
        N = SIGMA * (real + 1j * imag)
        return float(A * np.abs(STIFFNESS - MASS * omega**2 + 1j * DAMPING * omega + N) - drive)

    return brentq(excess, 1e-9, 1e3, xtol=1e-300, rtol=1e-13)


def tuned(omega: float, drive: float) -> float:
    """Solve one point with everything known beforehand put to use."""
    linear = complex(STIFFNESS - MASS * omega**2, DAMPING * omega)
    real, imag = 2.0 * SIGMA, 4.0 / math.pi * SIGMA

    def excess(A: float) -> float:
        beta = SIGMA * A / F_MAX
        tanh = math.tanh(beta)
        loss = (1.0 - tanh / beta) / beta if beta > 0.02 else beta / 3.0
        N = complex(real * i1e(beta) * (1.0 + tanh) / beta, imag * loss)
        return A * abs(linear + N) - drive

    low = 0.999 * drive / (abs(linear) + SIGMA)
    high = 1.001 * (drive + 4.0 / math.pi * F_MAX) / abs(linear)
    return brentq(excess, low, high, xtol=1e-300, rtol=1e-13)


def every_point(solve: Callable[[float, float], float]) -> Callable[[], object]:
    """Return a loop of `solve` over a share of the figure."""
    frequencies = (2.0 * np.pi * FREQUENCY_HZ[::SHARE]).tolist()
    return lambda: [solve(w, u0) for u0 in DRIVE.tolist() for w in frequencies]


def memory() -> Row:
    """Return the peak memory of one solution next to that of its input and output."""
    result = response(PLANT, FREQUENCY_HZ, DRIVE[:, None], steady=SINE)
    arrays = (result.amplitude, result.displacement, result.found, result.number_of_solutions)
    held = sum(a.nbytes for a in (*arrays, FREQUENCY_HZ, DRIVE))
    return Row("the same, peak memory", peak_bytes(ours), held, "input and output", 20.0, unit="B")


TITLE = "Steady response, describing function"


def run() -> list[Row]:
    """Return the comparisons."""
    rows = []
    for peer, target in ((same_plant, 150.0), (plain, 150.0), (tuned, 20.0)):
        mine, theirs = median_of_pairs(ours, every_point(peer), repeats=3)
        rows.append(
            Row(
                "Fig. 7: 51 levels x 500 frequencies",
                mine,
                SHARE * theirs,
                f"scipy brentq a point, {peer.__name__.replace('_', ' ')}",
                target,
                faster=True,
            )
        )
    return [*rows, memory()]


if __name__ == "__main__":
    print_table(TITLE, run())

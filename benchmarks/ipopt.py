"""A driven plant of 12 levels x 60 frequencies by its describing function: 5 or 6 parameters.

Run with ``python -m benchmarks.ipopt``. The time starts at the least-squares optimum: that of the
search before is taken off.
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness import Row, median_of_pairs, print_table
from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, response
from dahl_ident.elements.driven_motion import Steady
from dahl_ident.fitting import solve
from dahl_ident.fitting.ipopt import solve_ipopt
from dahl_ident.problem import TableProblem

LEVELS, FREQUENCIES = 12, 60
ALLOWED = 0.5
SINE: Steady = "describing function"
TRUTH = (0.1, 30.0, 0.3, 0.24, 0.3)


def problem(alpha: float | None = 1.0) -> TableProblem:
    """Return the estimation problem, 2 % noise."""
    f_max, sigma, mass, damping, stiffness = TRUTH
    plant = Dahl(f_max, sigma) + Mass(mass) + Damper(damping) + Spring(stiffness)
    drive = np.repeat(np.geomspace(0.01, 10.0, LEVELS), FREQUENCIES)
    frequency = np.tile(np.geomspace(0.03, 3.0, FREQUENCIES), LEVELS)
    rng = np.random.default_rng(1)
    error = 0.02 * (rng.standard_normal(drive.size) + 1j * rng.standard_normal(drive.size))
    measured = response(plant, frequency, drive).receptance * np.exp(error)
    data = FrequencyResponse(
        frequency, measured, drive=drive, controlled="force", quantity="receptance"
    )
    return TableProblem(data, Dahl(alpha=alpha) + Mass() + Damper() + Spring(), steady=SINE)


def _from_optimum(plant: TableProblem) -> float:
    """Return the median seconds that IPOPT adds to the least-squares search."""
    before, whole = median_of_pairs(lambda: solve(plant), lambda: solve_ipopt(plant))
    return whole - before


TITLE = "IPOPT"


def run() -> list[Row]:
    """Return the comparisons."""
    return [
        Row(f"12 x 60 plant, {label}", _from_optimum(problem(alpha)), ALLOWED, "0.5 s allowed", 1.0)
        for label, alpha in (("alpha = 1", 1.0), ("alpha free", None))
    ]


if __name__ == "__main__":
    print_table(TITLE, run())

"""A driven plant of 12 levels x 60 frequencies in full space: 5 or 6 parameters, 720 phasors.

Run with ``python -m benchmarks.ipopt``. The time starts at the least-squares optimum: that of the
search before is taken off. The last row leaves the sparse derivatives to casadi, which colours
the whole problem.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from benchmarks.harness import Row, median_of_pairs, print_table
from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, response
from dahl_ident.fitting import solve
from dahl_ident.fitting.casadi_nlp import RowwiseProblem, SharedTerms
from dahl_ident.fitting.casadi_rows import Target, row_blocks
from dahl_ident.fitting.ipopt import solve_ipopt
from dahl_ident.problem import Problem

LEVELS, FREQUENCIES = 12, 60
ALLOWED = 0.5
TRUTH = (0.1, 30.0, 0.3, 0.24, 0.3)


def problem(alpha: float | None = 1.0) -> Problem:
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
    return Problem(data, Dahl(alpha=alpha) + Mass() + Damper() + Spring())


def derivatives(*, coloured: bool) -> Callable[[], object]:
    """Return the work of building the problem and evaluating its Hessian three times."""
    plant = problem()
    start = plant.to_search(TRUTH)

    def work() -> object:
        theta = ca.SX.sym("theta", start.size)
        shared = SharedTerms(theta, ca.SX(0.0), ca.SX(0, 1))
        rowwise = RowwiseProblem(shared, row_blocks(Target(plant), theta, start), 1.0)
        hessian = rowwise.hessian()
        if coloured:
            hessian = rowwise.values().factory(
                "coloured",
                ["x", "p", "lam:f", "lam:g"],
                ["triu:hess:gamma:x:x"],
                {"gamma": ["f", "g"]},
            )
        x = np.zeros(rowwise.n_variables)
        x[: start.size] = start
        return [hessian(x, [], 1.0, 1.0) for _ in range(3)]

    return work


def _from_optimum(plant: Problem) -> float:
    """Return the median seconds that IPOPT adds to the least-squares search."""
    before, whole = median_of_pairs(lambda: solve(plant), lambda: solve_ipopt(plant))
    return whole - before


TITLE = "IPOPT"


def run() -> list[Row]:
    """Return the comparisons."""
    rows = [
        Row(f"12 x 60 plant, {label}", _from_optimum(problem(alpha)), ALLOWED, "0.5 s allowed", 1.0)
        for label, alpha in (("alpha = 1", 1.0), ("alpha free", None))
    ]
    ours, theirs = median_of_pairs(derivatives(coloured=False), derivatives(coloured=True), 3)
    work = "12 x 60 plant, alpha = 1, Hessian"
    return [*rows, Row(work, ours, theirs, "casadi, whole problem", 2.0, faster=True)]


if __name__ == "__main__":
    print_table(TITLE, run())

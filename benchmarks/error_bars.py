"""Uncertainties of fits to driven plants: exact steady motion and describing function.

Run with ``python -m benchmarks.error_bars``. The tables are those of
:mod:`benchmarks.driven_plants`, simulated by DOP853; u is the combined standard uncertainty over
the true value. The time is that of fitting five parameters to the shipped table of 150 rows,
verdict included.
"""

from __future__ import annotations

import numpy as np

import dahl_ident as di
from benchmarks.driven_plants import PLANTS, SEED, scored, simulated, table
from benchmarks.harness import Row, print_table, seconds

_PLANTS = (0, 2, 5, 8)  # the plant of the paper, a linear guide, a soft plant and a light one
_TARGET_RATIO = 10.0  # u with the describing function over u with the exact motion, at least
_ALLOWED = 3.0  # s, for a fit with its verdict

TITLE = "Error bars of driven plants"


def run() -> list[Row]:
    """Return the comparisons."""
    rows = []
    for number in _PLANTS:
        plant = PLANTS[number]
        f, u, R, _ = simulated(plant)
        data = [table(plant, f, u, R, 1000 * SEED + 10 * (number + 1))]
        exact, sine = (
            100.0 * float(np.median(scored(plant, data, steady).spreads))
            for steady in ("exact", "describing function")
        )
        work = f"u of four parameters (median), plant {number + 1}, {100.0 * plant.noise:g} % noise"
        rows.append(
            Row(work, exact, sine, "describing function", _TARGET_RATIO, faster=True, unit="%")
        )
    levels = di.load_dataset("frf_levels")
    model = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
    di.fit(levels, model)
    best = min(seconds(lambda: di.fit(levels, model).verdict) for _ in range(3))
    return [*rows, Row("150 rows, fit and verdict", best, _ALLOWED, "3 s allowed", 1.0)]


if __name__ == "__main__":
    print_table(TITLE, run())

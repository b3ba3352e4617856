"""Uncertainties of fits to driven plants: exact steady motion and describing function.

Run with ``python -m benchmarks.error_bars``. The tables are those of
:mod:`benchmarks.driven_plants`, simulated by DOP853; u is the combined standard uncertainty over
the true value. The time is that of a fit of five parameters and its verdict to the shipped table of
150 rows.
"""

from __future__ import annotations

import numpy as np

import dahl_ident as di
from benchmarks.driven_plants import PLANTS, SEED, scored, simulated, table
from benchmarks.harness import Row, print_table, seconds

CHOSEN = (0, 2, 5, 8)  # the plant of the paper, a guide, a soft and a light one
NARROWER = 10.0  # times: what is wanted of each
ALLOWED = 3.0  # s

TITLE = "Error bars of driven plants"


def run() -> list[Row]:
    """Return the comparisons."""
    rows = []
    for number in CHOSEN:
        plant = PLANTS[number]
        f, u, R, _ = simulated(plant)
        made = [table(plant, f, u, R, 1000 * SEED + 10 * (number + 1))]
        exact, sine = (
            100.0 * float(np.median(scored(plant, made, way).spreads))
            for way in ("exact", "describing function")
        )
        work = f"u of four parameters (median), plant {number + 1}, {100.0 * plant.noise:g} % noise"
        rows.append(Row(work, exact, sine, "describing function", NARROWER, faster=True, unit="%"))
    data = di.load_dataset("frf_levels")
    assert isinstance(data, di.FrequencyResponse)
    model = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
    di.fit(data, model)
    best = min(seconds(lambda: di.fit(data, model).verdict) for _ in range(3))
    return [*rows, Row("150 rows, fit and verdict", best, ALLOWED, "3 s allowed", 1.0)]


if __name__ == "__main__":
    print_table(TITLE, run())

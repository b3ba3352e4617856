"""A record of a million samples: extraction against its budget and against plain least squares.

Run with ``python -m benchmarks.extraction``. The peer is told where each level begins, its
frequency and that it has settled, and only fits: numpy's lstsq on the same columns as
extraction fits (nine harmonics, offset, drift). Extraction also finds levels, frequencies and
settling, and gives the covariance.
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness import Row, median_of_pairs, print_table
from dahl_ident import Dahl, Record
from dahl_ident.arrays import FloatArray
from dahl_ident.extraction import extract

TITLE = "Extraction"
SAMPLES = 1_000_000
RATE = 10_000.0
FREQUENCY = 10.0
HARMONICS = 9


def record(levels: FloatArray) -> Record:
    """Return levels of equal length, one after another."""
    rng = np.random.default_rng(0)
    t = np.arange(SAMPLES) / RATE
    x = np.repeat(levels, SAMPLES // levels.size) * np.sin(2.0 * np.pi * FREQUENCY * t)
    force = Dahl(f_max=0.1, sigma=30.0).force(x)
    return Record(
        t,
        displacement=x + 1e-7 * rng.standard_normal(SAMPLES),
        force=force + 1e-4 * rng.standard_normal(SAMPLES),
    )


def least_squares(measured: Record, levels: int) -> list[complex]:
    """Return the response of each level, everything but the phasors being known."""
    responses = []
    for part in np.array_split(np.arange(SAMPLES), levels):
        t = measured.time[part]
        theta = 2.0 * np.pi * FREQUENCY * t * np.arange(1, HARMONICS + 1)[:, None]
        columns = np.vstack([np.ones_like(t), t - t.mean(), np.cos(theta), np.sin(theta)])
        both = np.stack([measured.motion_samples[part], measured.force_samples[part]], axis=1)
        fitted = np.linalg.lstsq(columns.T, both, rcond=None)[0]
        x, force = fitted[2] - 1j * fitted[2 + HARMONICS]
        responses.append(complex(force / x))
    return responses


def run() -> list[Row]:
    """Time one long level and ten levels."""
    rows = []
    for count in (1, 10):
        levels: FloatArray = 0.02 * 0.8 ** np.arange(count, dtype=np.float64)
        measured = record(levels)

        def ours(measured: Record = measured) -> object:
            return extract(measured)

        def peer(measured: Record = measured, count: int = count) -> object:
            return least_squares(measured, count)

        mine, theirs = median_of_pairs(ours, peer, repeats=5)
        work = f"extract 1e6 samples, {count} level{'s'[: count - 1]}"
        rows.append(Row(work, mine, 1.0, "the budget, 1 s", target=1.0))
        rows.append(Row(work, mine, theirs, "lstsq on known levels", target=2.0))
    return rows


if __name__ == "__main__":
    print_table(TITLE, run())

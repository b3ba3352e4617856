"""A million samples, and a folder of files: extraction against budgets and plain least squares.

Run with ``python -m benchmarks.extraction``. The peer is given where each level begins, its
frequency and that it has settled, and only fits: numpy's lstsq on the same columns as
extraction fits (nine harmonics, offset, drift). Extraction also finds levels, frequencies and
settling, and gives the covariance. Of a folder of 31 CSV files of 14,000 to 29,000 samples the
peer reads each with pandas, and fits it with lstsq.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

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


def folder(place: Path) -> list[Path]:
    """Write files of one level each, as a laboratory has them."""
    rng = np.random.default_rng(1)
    files = []
    for i, n in enumerate(np.linspace(14_000, 29_000, 31).astype(int).tolist()):
        t = np.arange(n) / 1024.0
        x = 0.02 * 0.95**i * np.sin(2.0 * np.pi * 0.5 * t)
        force = Dahl(f_max=0.1, sigma=30.0).force(x) + 1e-4 * rng.standard_normal(n)
        files.append(place / f"level{i:02}.csv")
        table = pd.DataFrame({"time [s]": t, "displacement [m]": x, "force [N]": force})
        table.to_csv(files[-1], index=False, float_format="%.9g")
    return files


def pandas_and_lstsq(files: list[Path]) -> list[complex]:
    """Return the response of each file, its frequency being known."""
    responses = []
    for file in files:
        t, x, force = pd.read_csv(file).to_numpy().T
        theta = 2.0 * np.pi * 0.5 * t * np.arange(1, HARMONICS + 1)[:, None]
        columns = np.vstack([np.ones_like(t), t - t.mean(), np.cos(theta), np.sin(theta)])
        fitted = np.linalg.lstsq(columns.T, np.stack([x, force], axis=1), rcond=None)[0]
        X, F = fitted[2] - 1j * fitted[2 + HARMONICS]
        responses.append(complex(F / X))
    return responses


def run() -> list[Row]:
    """Time one long level, ten levels, and a folder of files."""
    rows = []
    with TemporaryDirectory() as place:
        files = folder(Path(place))
        mine, theirs = median_of_pairs(
            lambda: extract(str(Path(place) / "*.csv")), lambda: pandas_and_lstsq(files), repeats=3
        )
    work = "read and extract 31 files of 14,000 to 29,000 samples"
    rows.append(Row(work, mine, 1.5, "the budget, 1.5 s", target=1.0))
    rows.append(Row(work, mine, theirs, "pandas and lstsq", target=4.0))
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

"""Reading a long record from a text file, against the bare parser."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from benchmarks.harness import Row, median_of_pairs, print_table
from dahl_ident.data import read_record

TITLE = "Reading a record"
SAMPLES = 1_000_000


def run() -> list[Row]:
    """Return the seconds to a checked record in SI, and of pandas on the same bytes."""
    rng = np.random.Generator(np.random.PCG64(0))
    time = np.arange(SAMPLES) / 1024.0
    noise = rng.standard_normal((2, SAMPLES)) / 100.0
    columns = {
        "time [s]": time,
        "x [mm]": np.sin(time) + noise[0],
        "F [kN]": np.cos(time) + noise[1],
    }
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.csv"
        pd.DataFrame(columns).to_csv(path, index=False)
        ours, peer = median_of_pairs(partial(read_record, path), partial(pd.read_csv, path), 5)
        work = f"{SAMPLES:,} rows of three columns, {path.stat().st_size / 1e6:.0f} MB"
    return [Row(work, ours, peer, "pandas.read_csv alone, unchecked", 3.0)]


if __name__ == "__main__":
    print_table(TITLE, run())

"""Records of 1e7 and 1e8 samples from HDF5, TDMS, npy and Parquet: processor time and memory.

Run with ``python -m benchmarks.long_records``. Each row is a process of its own, imports included.
The file holds time, displacement and force in float64, and the displacement is a sine at 5 Hz
sampled at 10 kHz; of the larger files memory is what is bounded.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from benchmarks.harness import Row, print_table
from dahl_ident import Dahl
from dahl_ident.arrays import FloatArray
from dahl_ident.data.storage import library

TITLE = "Long records"
RATE, FREQUENCY, BLOCK = 10_000.0, 5.0, 1_000_000
NAMES = ("time", "displacement", "force")
WORK = """
import resource, sys, numpy as np
from dahl_ident import extract
units = {"time": "time [s]", "displacement": "displacement [m]", "force": "force [N]"}
points = extract(sys.argv[1], columns=units)
assert np.allclose(points.amplitude, 1e-3, rtol=1e-3), points.amplitude
used = resource.getrusage(resource.RUSAGE_SELF)
with open("/proc/self/status") as status:  # ru_maxrss is also that of the process that started this
    peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
print(used.ru_utime + used.ru_stime, 1024 * peak)
"""


def blocks(samples: int) -> Iterator[dict[str, FloatArray]]:
    """Yield the record a million samples at a time; a block holds whole cycles."""
    rng = np.random.default_rng(0)
    t = np.arange(BLOCK) / RATE
    x = 1e-3 * np.sin(2.0 * np.pi * FREQUENCY * t)
    force = Dahl(f_max=0.1, sigma=300.0).force(x)
    force[: BLOCK // 2] = force[BLOCK // 2 :]  # settled
    for start in range(0, samples, BLOCK):
        noise = rng.standard_normal((2, BLOCK))
        channels = (t + start / RATE, x + 1e-7 * noise[0], force + 1e-4 * noise[1])
        yield dict(zip(NAMES, channels, strict=True))


def write(path: Path, samples: int) -> None:
    """Write the record in the format of the file's name."""
    if path.suffix == ".h5":
        with library("h5py").File(path, "w") as file:
            sets = {n: file.create_dataset(n, samples, dtype="f8") for n in NAMES}
            for i, block in enumerate(blocks(samples)):
                for name, values in block.items():
                    sets[name][i * BLOCK : (i + 1) * BLOCK] = values
    elif path.suffix == ".npy":
        dtype = [(name, "f8") for name in NAMES]
        with path.open("wb") as file:
            header = {"descr": dtype, "fortran_order": False, "shape": (samples,)}
            np.lib.format.write_array_header_1_0(file, header)
            for block in blocks(samples):
                np.rec.fromarrays(list(block.values()), dtype=dtype).tofile(file)
    elif path.suffix == ".parquet":
        arrow, parquet = library("pyarrow"), library("pyarrow.parquet")
        schema = arrow.schema([(name, arrow.float64()) for name in NAMES])
        with parquet.ParquetWriter(path, schema) as file:
            for block in blocks(samples):
                file.write_table(arrow.Table.from_pandas(pd.DataFrame(block), schema))
    else:
        tdms = library("nptdms")
        with tdms.TdmsWriter(path) as file:
            for block in blocks(samples):
                file.write_segment([tdms.ChannelObject("run", n, v) for n, v in block.items()])


def measured(path: Path) -> tuple[float, float]:
    """Return seconds of processor time and the peak of memory in bytes of one process."""
    command = [sys.executable, "-c", WORK, str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    cpu, memory = map(float, done.stdout.split())
    return cpu, memory


def run() -> list[Row]:
    """Return time and memory against their budgets."""
    rows = []
    with TemporaryDirectory() as folder:
        for samples, formats in ((10**7, ("h5",)), (10**8, ("h5", "tdms", "npy", "parquet"))):
            for suffix in formats:
                path = Path(folder) / f"record.{suffix}"
                write(path, samples)
                cpu, memory = measured(path)
                path.unlink()
                work = f"read and extract {samples:.0e} samples from {suffix}"
                if samples == 10**7:
                    rows.append(Row(work, cpu, 5.0, "the budget, 5 s of processor", 1.0))
                    share = "the three channels"
                    rows.append(Row(work, memory, 24.0 * samples, share, 4.0, unit="B"))
                else:
                    rows.append(Row(work, cpu, 50.0, "ten times the budget of 1e7", 1.0))
                    rows.append(Row(work, memory, 2e9, "the budget, 2 GB", 1.0, unit="B"))
    return rows


if __name__ == "__main__":
    print_table(TITLE, run())

"""Campaigns at size: a thousand devices of ten records, and what it costs beside the work itself.

``python -m benchmarks.campaigns`` makes the records with the synthetic laboratory, runs the
campaign, disturbs it with SIGKILLs, runs it on a Dask cluster over TCP, pools the devices, and
writes what held into the manual. ``--devices 20 --records 2`` is a quick look.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import dahl_ident as di
from dahl_ident.data.storage import library
from dahl_ident.synthetic.acquisition import Acquisition, Channel
from dahl_ident.synthetic.excitation import SteppedSine

DESTINATION = Path("docs/validation/campaigns.md")
F_MAX, SIGMA = 0.1, 30.0
SLOPE, BETWEEN_DEVICES, BETWEEN_RUNS = 0.01, 0.04, 0.01
KILLS = 20
UNTIMED = ["seconds"]


def make_records(folder: Path, device: int, records: int) -> dict[str, Any]:
    """Write the records of one device as HDF5 files and return its truth."""
    rng = np.random.default_rng([2026, device])
    temperature = float(rng.uniform(10.0, 30.0))
    level = SLOPE * (temperature - 20.0) + rng.normal(0.0, BETWEEN_DEVICES)
    (folder / f"d{device:05}").mkdir(parents=True, exist_ok=True)
    for run in range(records):
        f_max = F_MAX * np.exp(level + rng.normal(0.0, BETWEEN_RUNS))
        experiment = di.Experiment(
            di.Dahl(f_max, SIGMA),
            SteppedSine(levels=(2e-3, 5e-3, 1e-2, 2e-2), settling_periods=3, num_periods=5),
            Acquisition(200.0, force=Channel(noise_std=3e-4), displacement=Channel(noise_std=1e-6)),
        )
        record = di.simulate(experiment, seed=1000 * device + run)
        assert isinstance(record, di.Record)
        record.save(folder / f"d{device:05}" / f"r{run}.h5")
    return {"device": f"d{device:05}", "temperature": temperature, "ln": level}


def definition(folder: Path, results: Path) -> Path:
    """Write the campaign and return its path."""
    path = folder / f"{results.name}.toml"
    path.write_text(
        f'[files]\npattern = "{folder.as_posix()}/{{device}}/{{run}}.h5"\n'
        f'covariates = "{folder.as_posix()}/devices.csv"\n'
        '[[model]]\nkind = "dahl"\nalpha = 1.0\n'
        f'[output]\nfolder = "{results.as_posix()}"\n'
    )
    return path


def main() -> None:
    """Run everything and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=1000)
    parser.add_argument("--records", type=int, default=10)
    parser.add_argument("--write", type=Path, default=DESTINATION)
    given = parser.parse_args()
    lines = [
        "# Campaigns",
        "",
        f"`python -m benchmarks.campaigns`: {given.devices} devices of {given.records} records, "
        "made by the synthetic laboratory.",
        "",
        "| what | required | measured | |",
        "|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as name:
        for what, required, measured, holds in _measured(Path(name), given.devices, given.records):
            lines.append(f"| {what} | {required} | {measured} | {'holds' if holds else '**no**'} |")
            print(lines[-1], flush=True)
    given.write.write_text("\n".join(lines) + "\n")


def _measured(folder: Path, devices: int, records: int) -> Any:
    with ProcessPoolExecutor() as pool:
        made = [pool.submit(make_records, folder, d, records) for d in range(devices)]
        truth = pd.DataFrame([m.result() for m in made])
    truth[["device", "temperature"]].to_csv(folder / "devices.csv", index=False)
    serial, began = folder / "serial", time.perf_counter()
    reference = di.campaign(definition(folder, serial), jobs=1).table
    one = time.perf_counter() - began
    work = float(reference["seconds"].sum())
    overhead = 1e3 * (one - work) / devices
    yield "overhead beyond the computation", "5 ms a device", f"{overhead:.2f} ms", overhead <= 5.0
    began = time.perf_counter()
    two = di.campaign(definition(folder, folder / "two"), jobs=2)
    both = time.perf_counter() - began
    share = one / (2.0 * both)
    yield "efficiency of two processes", "85 %", f"{100 * share:.0f} %", share >= 0.85
    same = _equal(two.table, reference)
    yield "two processes give the serial table", "equal", "equal" if same else "differs", same
    kills, table = _disturbed(folder, folder / "killed")
    same = _equal(table, reference)
    yield f"table after {kills} SIGKILLs", "equal", "equal" if same else "differs", same
    table, lost = _dask(folder, folder / "dask")
    same = _equal(table, reference)
    yield (
        f"Dask over TCP, {lost} workers killed", "equal", "equal" if same else "differs", same
    )  # fmt: skip
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    yield "memory of the driver", "500 MB", f"{memory:.0f} MB", memory < 500.0
    yield from _population(reference, truth)


def _equal(table: pd.DataFrame, reference: pd.DataFrame) -> bool:
    return bool(table.drop(columns=UNTIMED).equals(reference.drop(columns=UNTIMED)))


def _disturbed(folder: Path, results: Path) -> tuple[int, pd.DataFrame]:
    """Run the command line and kill it, or one of its workers, at random moments."""
    rng = random.Random(1)
    command = [
        str(Path(sys.executable).with_name("dahl-ident")), "campaign",
        str(definition(folder, results)), "--jobs", "2",
    ]  # fmt: skip
    journal, kills = results / "journal.jsonl", 0
    while True:
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        before = journal.stat().st_size if journal.exists() else 0
        while run.poll() is None:
            time.sleep(0.05)
            grown = journal.exists() and journal.stat().st_size > before
            if kills < KILLS and grown and rng.random() < 0.3:
                workers = _children(run.pid)
                victim = rng.choice([run.pid, *workers])
                os.kill(victim, signal.SIGKILL)
                kills += 1
                before = journal.stat().st_size
        if run.returncode == 0:
            break
    return kills, pd.read_csv(results / "results.csv", dtype={"device": str})


def _children(pid: int) -> list[int]:
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(child) for child in path.read_text().split()] if path.exists() else []


def _dask(folder: Path, results: Path) -> tuple[pd.DataFrame, int]:
    """Run on a cluster of processes reached over TCP; kill a worker on the way."""
    distributed = library("distributed", "dask")

    lost = 0

    def kill_one(done: int, total: int, _: Any) -> None:
        nonlocal lost
        if done in (total // 4, total // 2):
            workers = client.run(os.getpid)
            os.kill(next(iter(workers.values())), signal.SIGKILL)
            lost += 1

    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1",
            dashboard_address=None,
        ) as cluster,
        distributed.Client(cluster.scheduler_address) as client,
    ):  # fmt: skip
        done = di.campaign(
            definition(folder, results), jobs=2, executor=client.get_executor(), progress=kill_one
        )
    return done.table, lost


def _population(table: pd.DataFrame, truth: pd.DataFrame) -> Any:
    merged = table.merge(truth[["device", "ln"]], on="device")
    found = di.population(table, ["f_max"], covariates=["temperature"])["f_max"]
    value, u = found.coefficients["mean"]
    mean = np.log(F_MAX) + SLOPE * (truth["temperature"].mean() - 20.0)
    off = abs(value - mean) / u
    yield "population mean of ln f_max", "within 2 u", f"{off:.1f} u", off <= 2.0
    value, u = found.coefficients["temperature"]
    off = abs(value - SLOPE) / u
    yield "change with temperature", "within 2 u", f"{off:.1f} u", off <= 2.0
    _, low, high = found.between_devices
    inside = low <= BETWEEN_DEVICES <= high
    yield "scatter between devices (4 %)", "inside", f"{low:.2%} to {high:.2%}", inside
    own = np.log(found.devices["own"].to_numpy())
    shrunken = np.log(found.devices["shrunken"].to_numpy())
    exact = np.log(F_MAX) + merged.set_index("device").loc[found.devices.index, "ln"].to_numpy()
    rms = [float(np.sqrt(np.mean((x - exact) ** 2))) for x in (shrunken, own)]
    yield (
        "error of each device, drawn towards the mean and alone", "smaller",
        f"{rms[0]:.2%} and {rms[1]:.2%}", rms[0] < rms[1],
    )  # fmt: skip


if __name__ == "__main__":
    main()

"""Campaigns at size: a thousand devices of ten records, and what they cost beyond the work itself.

``python -m benchmarks.campaigns`` makes the records with the synthetic laboratory, runs the
campaign, disturbs it with SIGKILLs, runs it on a Dask cluster over TCP, pools the devices, and
writes what held into the manual. ``--devices 20 --records 2`` is a quick look.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

import dahl_ident as di
from dahl_ident.campaigns.population import USABLE
from dahl_ident.data.storage import library
from dahl_ident.synthetic.acquisition import Acquisition, Channel
from dahl_ident.synthetic.excitation import SteppedSine

DESTINATION = Path("docs/validation/campaigns.md")
F_MAX, SIGMA = 0.1, 30.0
SLOPE, BETWEEN_DEVICES, BETWEEN_RUNS = 0.01, 0.04, 0.01
KILLS = 20
GROUP, COVERAGE = 20, 0.9545
COMPUTED = 100
UNTIMED = ["seconds"]


def make_records(folder: Path, device: int, records: int) -> dict[str, Any]:
    """Write the records of one device as HDF5 files and return its truth."""
    rng = np.random.default_rng([2026, device])
    temperature = float(rng.uniform(10.0, 30.0))
    level = SLOPE * (temperature - 20.0) + rng.normal(0.0, BETWEEN_DEVICES)
    (folder / f"d{device:05}").mkdir(parents=True, exist_ok=True)
    for run in range(records):
        place = folder / f"d{device:05}" / f"r{run}.h5"
        f_max = F_MAX * np.exp(level + rng.normal(0.0, BETWEEN_RUNS))
        if place.exists():
            continue
        experiment = di.Experiment(
            di.Dahl(f_max, SIGMA),
            SteppedSine(levels=(2e-3, 5e-3, 1e-2, 2e-2), settling_periods=3, num_periods=5),
            Acquisition(200.0, force=Channel(noise_std=3e-3), displacement=Channel(noise_std=1e-5)),
        )
        record = di.simulate(experiment, seed=1000 * device + run)
        assert isinstance(record, di.Record)
        record.save(place)
    return {"device": f"d{device:05}", "temperature": temperature, "ln": level}


def definition(folder: Path, results: Path, per: str = "device") -> Path:
    """Write the campaign and return its path."""
    path = folder / f"{results.name}.toml"
    path.write_text(
        f'[files]\npattern = "{folder.as_posix()}/{{device}}/{{run}}.h5"\n'
        f'covariates = "{folder.as_posix()}/devices.csv"\n'
        '[[model]]\nkind = "dahl"\nalpha = 1.0\n'
        f'[output]\nfolder = "{results.as_posix()}"\nper = "{per}"\n'
    )
    return path


PARTS = ("driver", "scale", "interruptions", "population", "million")


def main() -> None:
    """Run the parts and write their sections of the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--devices", type=int, default=1000)
    parser.add_argument("--records", type=int, default=10)
    parser.add_argument("--folder", type=Path, help="kept, so that an interrupted run goes on")
    parser.add_argument("--write", type=Path, default=DESTINATION)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for part in given.parts:
            section = globals()[f"_{part}"](folder, given.devices, given.records)
            print(section, flush=True)
            _replace(given.write, section)


def _replace(page: Path, section: str) -> None:
    """Put a section into the page, in place of the one with its heading."""
    head, *there = (page.read_text() if page.exists() else HEAD).split("\n## ")
    sections = {text.partition("\n")[0]: text.rstrip() for text in there}
    title = section.partition("\n")[0]
    sections[title] = section.rstrip()
    order = [t for t in TITLES if t in sections]
    page.write_text("\n\n## ".join([head.rstrip(), *(sections[t] for t in order)]) + "\n")


HEAD = """# Campaigns

`python -m benchmarks.campaigns` makes the records with the synthetic laboratory (stepped sines at
four levels, 3 % noise of the force), runs the campaigns and writes this page; `--parts` runs some
sections alone. Load is the machine's mean number of running processes: above the number of
processors (2), wall time measures the others too, and processor time is given instead.
"""
TITLES = ("Driver", "Scale", "Interruptions", "Population", "A million devices")
Row = tuple[str, str, str, bool | None]


def _section(title: str, sentence: str, rows: list[Row]) -> str:
    lines = [title, "", sentence, "", "| what | required | measured | |", "|---|---|---|---|"]
    verdict = {True: "holds", False: "**no**", None: ""}
    lines += [f"| {what} | {need} | {got} | {verdict[ok]} |" for what, need, got, ok in rows]
    return "\n".join(lines)


def _load() -> str:
    return f"load {os.getloadavg()[0]:.1f}"


def _laboratory(folder: Path, devices: int, records: int) -> pd.DataFrame:
    """Make the records that are not there yet; return the truth."""
    folder.mkdir(exist_ok=True)
    with ProcessPoolExecutor() as pool:
        truth = pd.DataFrame(
            pool.map(make_records, [folder] * devices, range(devices), [records] * devices)
        )
    truth[["device", "temperature"]].to_csv(folder / "devices.csv", index=False)
    return truth


class _AtOnce(Executor):
    """Does the work at once, and adds up its seconds, and what of this process's time it takes.

    After `most` jobs it returns the last row again.
    """

    def __init__(self, most: float = np.inf) -> None:
        self.time, self.worked, self._most, self.done = np.zeros(2), 0.0, most, 0
        self._row: Any = None

    def submit(self, function: Any, /, *arguments: Any, **_: Any) -> Future[Any]:
        """Return a future that is done."""
        future: Future[Any] = Future()
        began = _clocks()
        if self.done < self._most:
            self._row, self.done = function(*arguments), self.done + 1
            self.worked += self._row["seconds"]
        future.set_result(dict(self._row))
        self.time += _clocks() - began
        return future


def _clocks() -> Any:
    return np.array([time.process_time(), time.perf_counter()])


def _timed(source: Path | dict[str, Any], most: float = np.inf) -> tuple[di.Campaign, Any, Any]:
    """Run a campaign; return seconds and wall time of a fit, and times of the driver for all."""
    executor, began = _AtOnce(most), _clocks()
    done = di.campaign(source, executor=executor, jobs=1)
    work = np.array([executor.worked, executor.time[1]]) / executor.done
    return done, work, _clocks() - began - executor.time


def _driver(folder: Path, devices: int, records: int) -> str:
    devices = min(devices, 100)
    place = folder / "driver"
    _laboratory(place, devices, records)
    few = {
        "files": {"pattern": f"{place.as_posix()}/d00000/{{device}}.h5"},
        "model": [{"kind": "dahl", "alpha": 1.0}],
        "output": {"folder": str(place / "warm")},
    }
    _timed(few)  # imports
    done, work, driver = _timed(definition(place, place / "serial"))
    reference, overhead = done.table, 1e3 * driver / devices
    began = time.perf_counter()
    two = di.campaign(definition(place, place / "two"), jobs=2).table
    elapsed = time.perf_counter() - began
    busy = float(two["seconds"].sum()) / (2.0 * elapsed)
    speedup = work[1] * devices / (2.0 * elapsed)
    same = _equal(two, reference)
    sizes = {
        name: (place / "serial" / f"{name}").stat().st_size / devices
        for name in ("journal.jsonl", "results.csv", "results.parquet")
    }
    rows: list[Row] = [
        ("driver in addition to the computation, processor time", "5 ms a device",
         f"{overhead[0]:.2f} ms", bool(overhead[0] <= 5.0)),
        ("the same, wall time", "", f"{overhead[1]:.2f} ms", None),
        ("share of elapsed time in which two processes compute", "85 %", f"{busy:.0%}",
         busy >= 0.85),
        ("one process's time over twice that of two", "", f"{speedup:.0%}", None),
        ("two processes give the serial table", "equal", "equal" if same else "differs", same),
        ("computation", "", f"{work[0]:.2f} s a device", None),
        *(((f"size of {name}", "", f"{size / 1e3:.1f} kB a device", None))
          for name, size in sizes.items()),
    ]  # fmt: skip
    return _section("Driver", f"{devices} devices of {records} records; {_load()}.", rows)


def _scale(folder: Path, devices: int, _records: int) -> str:
    counts = [n for n in (100, 1000, 10000) if n <= 10 * devices]
    found = []
    for n in counts:
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=spawn) as pool:  # memory from nothing each time
            found.append(pool.submit(_scaled, folder / f"scale{n}", n).result())
    each = np.array([cost for cost, _, _ in found])
    spread = each.max() / each.min() - 1.0
    memory = [m for _, _, m in found]
    growth = 1e3 * (memory[-1] - memory[0]) / (counts[-1] - counts[0])
    rows: list[Row] = [
        (f"{n} devices", "", f"{1e3 * cost:.1f} ms a device, of them the driver "
         f"{1e3 * driver:.2f} ms; {mb:.0f} MB", None)
        for n, (cost, driver, mb) in zip(counts, found, strict=True)
    ]  # fmt: skip
    rows += [
        ("rate, largest against smallest", "within 10 %", f"{spread:.1%}", bool(spread <= 0.1)),
        ("memory", "500 MB", f"{max(memory):.0f} MB", max(memory) < 500.0),
        ("growth of memory", "", f"{growth:.1f} kB a device", None),
    ]
    text = (
        f"Devices of one table of four points, one process, processor time; {_load()}. The first "
        f"{COMPUTED} of them are fitted, the others get a ready row, so that many devices measure "
        "the driver."
    )
    return _section("Scale", text, rows)


def _scaled(folder: Path, devices: int) -> tuple[float, float, float]:
    """Return seconds a device, those of the driver, and MB, for `devices` small tables."""
    A = np.geomspace(1e-3, 2e-2, 4)
    rng = np.random.default_rng(0)
    noise = 1.0 + 3e-3 * (rng.normal(size=4) + 1j * rng.normal(size=4))
    N = di.Dahl(F_MAX, SIGMA).describing_function(A) * noise
    folder.mkdir(exist_ok=True)
    first = di.FrequencyResponse(np.ones(4), N, A).save(folder / "d0.csv", overwrite=True)
    content = first.read_bytes()
    for i in range(1, devices):
        (folder / f"d{i}.csv").write_bytes(content)
    warm, whole = folder / "warm.toml", folder / "whole.toml"
    for path, pattern in ((warm, "{device}0.csv"), (whole, "{device}.csv")):
        path.write_text(
            f'[files]\npattern = "{pattern}"\nkind = "response"\n'
            f'[[model]]\nkind = "dahl"\nalpha = 1.0\n[output]\nfolder = "{path.stem}"\n'
        )
    _timed(warm)
    _, work, driver = _timed(whole, most=COMPUTED)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    own = float(driver[0]) / devices
    return float(work[0]) + own, own, memory


def _interruptions(folder: Path, devices: int, records: int) -> str:
    devices, place = min(devices, 100), folder / "driver"
    _laboratory(place, devices, records)
    reference = di.campaign(definition(place, place / "serial"), jobs=1).table
    kills, table = _disturbed(place, place / "killed")
    repeated = _repeated(place / "killed")
    same = _equal(table, reference)
    rows: list[Row] = [
        (f"table after {kills} SIGKILLs of the driver and of workers", "equal",
         "equal" if same else "differs", same),
        ("fits that were finished and done again", "0", str(repeated), repeated == 0),
    ]  # fmt: skip
    table, lost = _dask(place, place / "dask")
    same = _equal(table, reference)
    rows.append(
        (f"table of a Dask cluster over TCP, {lost} workers killed", "equal",
         "equal" if same else "differs", same)
    )  # fmt: skip
    return _section("Interruptions", f"{devices} devices of {records} records; {_load()}.", rows)


def _repeated(results: Path) -> int:
    lines = (results / "journal.jsonl").read_bytes().splitlines()
    keys = [row["key"] for row in map(json.loads, lines) if not row.get("retry")]
    return len(keys) - len(set(keys))


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
    """Return the processes in which a driver has its fits done."""
    of = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            of[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    return [child for child, parent in of.items() if parent == pid]


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

    patient = {  # a busy machine starts workers slowly; a cluster that gives them up never ends
        "distributed.comm.timeouts.connect": "300s",
        "distributed.comm.timeouts.tcp": "300s",
    }
    with (
        library("dask").config.set(patient),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1",
            dashboard_address=None,
        ) as cluster,
        distributed.Client(cluster.scheduler_address) as client,
    ):  # fmt: skip
        done = di.campaign(
            definition(folder, results), scheduler=cluster.scheduler_address, progress=kill_one
        )
    return done.table, lost


def _population(folder: Path, devices: int, records: int) -> str:
    place = folder / "population"
    truth = _laboratory(place, devices, records).set_index("device")
    table = di.campaign(definition(place, place / "results", per="run"), jobs=2).table
    usable = int(table["status"].isin(USABLE).sum())
    rows_each = GROUP * records
    groups = [table.iloc[i : i + rows_each] for i in range(0, devices * records, rows_each)]
    hits = np.sum([_hits(group) for group in groups], axis=0)
    least = int(stats.binom.ppf(0.01, len(groups), COVERAGE))
    every = _hits(table)
    found = di.population(table, ["f_max"], covariates=["temperature"])["f_max"]
    exact = np.log(F_MAX) + truth.loc[found.devices.index, "ln"].to_numpy()
    rms = [
        float(np.sqrt(np.mean((np.log(found.devices[c].to_numpy()) - exact) ** 2)))
        for c in ("shrunken", "own")
    ]
    names = ("mean of ln f_max", "scatter between devices", "scatter between runs",
             "change with temperature")  # fmt: skip
    rows: list[Row] = [
        ("usable fits", "99 %: tests find fault with noise in one table of 100",
         f"{usable} of {len(table)}", usable >= 0.99 * len(table)),
        *((f"{name}: groups whose 95.45 % interval holds the truth", f"at least {least}",
           f"{hit} of {len(groups)}", bool(hit >= least))
          for name, hit in zip(names, hits, strict=True)),
        *((f"{name}: interval of all devices", "holds the truth", "yes" if hit else "no", bool(hit))
          for name, hit in zip(names, every, strict=True)),
        ("error of each device, drawn towards the mean and alone", "smaller",
         f"{rms[0]:.3%} and {rms[1]:.3%}", rms[0] < rms[1]),
    ]  # fmt: skip
    return _section(
        "Population",
        f"{devices} devices of {records} records, a fit each; f_max scatters by "
        f"{BETWEEN_DEVICES:.0%} between devices and {BETWEEN_RUNS:.0%} between runs, and grows by "
        f"{SLOPE:.0%} a kelvin. Groups of {GROUP} devices: fewer hits than required come once in "
        "100 times where coverage is true.",
        rows,
    )


def _hits(table: pd.DataFrame) -> Any:
    """Return whether the intervals hold mean, scatter and slope."""
    found = di.population(table, ["f_max"], covariates=["temperature"])["f_max"]
    used = table.loc[table["status"].isin(USABLE), "temperature"]
    mean, u = found.coefficients["mean"]
    slope, u_slope = found.coefficients["temperature"]
    exact = np.log(F_MAX) + SLOPE * (used.mean() - 20.0)
    return np.array(
        [
            abs(mean - exact) < 2 * u,
            found.between_devices[1] < BETWEEN_DEVICES < found.between_devices[2],
            found.between_runs[1] < BETWEEN_RUNS < found.between_runs[2],
            abs(slope - SLOPE) < 2 * u_slope,
        ],
        dtype=int,
    )


def _million(folder: Path, devices: int, records: int) -> str:
    """Plan from one device measured here: processors, storage, memory of the driver."""
    place = folder / "driver"
    _laboratory(place, min(devices, 100), records)
    few = {
        "files": {"pattern": f"{place.as_posix()}/d0000{{device}}/{{run}}.h5"},
        "model": [{"kind": "dahl", "alpha": 1.0}],
        "output": {"folder": str(place / "few")},
    }
    done, work, _ = _timed(few)
    table, seconds = done.table, float(work[0])
    size = sum(f.stat().st_size for f in (place / "d00000").iterdir()) / 1e6
    row = sum(
        (place / "few" / name).stat().st_size / len(table) / 1e3
        for name in ("journal.jsonl", "results.csv", "results.parquet")
    )
    hours = 1e6 * seconds / 3600.0
    return f"""A million devices

One device of {records} records takes {seconds:.2f} s of one processor here ({_load()}),
{size:.1f} MB of records and {row:.1f} kB of results. A million of them:

| | |
|---|---|
| processor hours | {hours:,.0f} |
| days on 64 processors | {hours / 64 / 24:.1f} |
| days on 1,000 processors | {hours / 1000 / 24:.2f} |
| cost at 0.04 EUR a processor hour | {0.04 * hours:,.0f} EUR |
| records | {size:,.1f} TB |
| results | {row:,.1f} GB |
| network to 1,000 processors, records read once | {1e3 * size / seconds:,.0f} MB/s |

The driver's memory grows with the number of files (see Scale), so make it 50 campaigns of 20,000
devices, one TOML file and folder each, on one Dask cluster; a driver each, as many at a time as
keep the workers busy. Put records where workers read them by path (object storage that
is mounted, or a parallel file system); `--send-files` makes the driver's network the limit. A
driver keeps about {seconds * 200:,.0f} workers busy, at 5 ms a device. `pandas.read_parquet` of the
folders' `results.parquet` gives the table for `di.population`, one parameter at a time.
"""


if __name__ == "__main__":
    main()

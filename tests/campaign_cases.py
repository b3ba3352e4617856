"""Campaigns that several tests run: tables of devices, their definition, workers of any kind."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

import dahl_ident as di

SECONDS = ["seconds"]


def make_tables(folder, devices, runs=1, seed=1):
    """Write response tables of devices whose f_max grows with temperature; return the truth."""
    rng = np.random.default_rng(seed)
    amplitude = np.geomspace(1e-4, 3e-2, 9)
    truth = []
    for device in range(devices):
        temperature = float(rng.uniform(10.0, 30.0))
        f_max = 0.1 * np.exp(rng.normal(0.01 * (temperature - 20.0), 0.04))
        truth.append({"device": f"d{device:03}", "temperature": temperature, "f_max": f_max})
        for run in range(runs):
            N = di.Dahl(f_max, 30.0).describing_function(amplitude)
            noise = rng.normal(0.0, 0.003, (2, amplitude.size))
            N = N * np.exp(noise[0] + 1j * noise[1])
            table = di.FrequencyResponse(np.ones(amplitude.size), N, amplitude)
            table.save(folder / f"d{device:03}_r{run}.csv")
    frame = pd.DataFrame(truth)
    frame[["device", "temperature"]].to_csv(folder / "devices.csv", index=False)
    return frame


def definition(folder, **changes):
    content: dict[str, Any] = {
        "files": {
            "pattern": f"{folder.as_posix()}/{{device}}_{{run}}.csv",
            "kind": "response",
            "covariates": str(folder / "devices.csv"),
        },
        "model": [{"kind": "dahl"}],
        "output": {"folder": str(folder / "results")},
    }
    for name, value in changes.items():
        table, _, key = name.partition("__")
        content[table] = {**content.get(table, {}), key: value} if key else value
    return content


def as_toml(folder):
    path = folder / "lab.toml"
    path.write_text(
        '[files]\npattern = "{device}_{run}.csv"\nkind = "response"\n'
        'covariates = "devices.csv"\n[[model]]\nkind = "dahl"\n'
    )
    return path


def results(folder):
    """Return the table that a campaign has written."""
    return pd.read_csv(folder / "results" / "results.csv", dtype={"device": str})


def serial(folder):
    """Return the table of the same campaign, done one by one in this process."""
    return di.campaign(definition(folder, output__folder=str(folder / "serial")), jobs=1).table


def assert_equal(table, other):
    """Check that two tables are the same but for the time that each fit took."""
    pd.testing.assert_frame_equal(table.drop(columns=SECONDS), other.drop(columns=SECONDS))


class Changed(ThreadPoolExecutor):
    """Workers whose jobs for one device are changed on the way."""

    def __init__(self, device, **changes):
        super().__init__(1)
        self.device, self.changes = device, changes

    def submit(self, function, /, *arguments, **_):
        job, *others = arguments
        job = replace(job, **self.changes) if job.name == self.device else job
        return super().submit(function, job, *others)

"""Measured devices: what limits the laws on a friction damper and on a bolted beam.

The folder of measured data is named by DAHL_IDENT_MEASURED_DATA.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

import dahl_ident as di
from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.misfit_explanations import rms_misfit_of
from dahl_ident.diagnostics.slip_density import slip_density
from dahl_ident.fitting import solve
from dahl_ident.problem import TableProblem
from dahl_ident.problem.record_problem import RecordProblem

FOLDER = Path(os.environ.get("DAHL_IDENT_MEASURED_DATA", "absent"))
_CYCLES = 3  # at the full amplitude, in the middle of every record
_STROKE, _FAST = 0.5, 0.5  # of the largest displacement and speed: mid-stroke
_SMALLEST = 1e-3  # asymmetry that counts as a unit of the search
# An acceleration's amplitude with a displacement's phase, as the file's own README says.
_BEAM_UNITS = {"frequency": "Hz", "force": "N", "amplitude": "m/s^2", "phase": "rad"}


def beam_table() -> di.FrequencyResponse:
    """Return the Brake-Reuss beam near its first mode."""
    columns = {
        "drive" if name == "force" else name: {"column": f"FRdata.*[*].{name}", "unit": unit}
        for name, unit in _BEAM_UNITS.items()
    }
    controlled = {"force": "ForceControl*", "displacement": "ResponseControl*"}
    return di.read_frequency_response(
        FOLDER / "brb" / "ForcedFrequencyResponses.mat", quantity="receptance",
        columns={**columns, "controlled": controlled},
    )  # fmt: skip


def middle(record: di.Record, hz: float) -> slice:
    """Return the samples of the cycles at the full amplitude."""
    n, c = len(record), round(record.sample_rate / hz)
    return slice((n - _CYCLES * c) // 2, (n + _CYCLES * c) // 2)


def limits(record: di.Record, hz: float) -> tuple[float, float]:
    """Return the mean force at mid-stroke on the way up, and on the way down with its sign turned.

    No law is involved.
    """
    assert record.displacement is not None
    assert record.force is not None
    cut = middle(record, hz)
    x, F = np.asarray(record.displacement)[cut], np.asarray(record.force)[cut]
    v = np.gradient(x)
    near = np.abs(x) < _STROKE * np.abs(x).max()
    up, down = near & (v > _FAST * v.max()), near & (v < _FAST * v.min())
    return float(F[up].mean()), -float(F[down].mean())


def without(problem: RecordProblem, values: FloatArray, dropped: tuple[str, ...]) -> FloatArray:
    """Return the least squares of the plain residuals, parameters of some names held at zero."""
    kept = np.array([not name.startswith(dropped) for name in problem.names])
    positive = problem.space.positive[kept]
    unit = np.where(positive, 1.0, np.maximum(np.abs(values[kept]), _SMALLEST))

    def at(z: FloatArray) -> FloatArray:
        found = np.zeros(values.shape)
        found[kept] = np.where(positive, np.exp(np.where(positive, z, 0.0)), z * unit)
        return found

    def missed(z: FloatArray) -> FloatArray:
        return np.concatenate(problem.split_residuals(at(z)))

    start = np.where(positive, np.log(np.where(positive, values[kept], 1.0)), values[kept] / unit)
    return at(least_squares(missed, start, x_scale="jac", max_nfev=60).x)


def damper() -> None:
    """Print the friction damper's limits in each test, and the asymmetry by what else is free."""
    print("| test | limit up, N | limit down, N | asymmetry |\n|---|---|---|---|")
    names: dict[str, list[di.Record]] = {}
    for file in sorted((FOLDER / "brfd").glob("band30lb_*.csv")):
        record = di.read_record(file, displacement="displacement", force="friction force")
        hz = re.search(r"_([\d.]+)Hz", file.name)
        assert hz is not None
        up, down = limits(record, float(hz[1]))
        name = file.stem.removeprefix("band30lb_")
        print(f"| {name} | {up:.0f} | {down:.0f} | {(up - down) / (up + down):+.3f} |", flush=True)
        if hz[1] == "0.5":
            names.setdefault("all at 0.5 Hz", []).append(record)
            names[name] = [record]
    print("\n| tests | offset and drift free | offset free | neither |\n|---|---|---|---|")
    for name, records in names.items():
        model = di.Backlash(di.Dahl(asymmetry=None)) + di.Mass() + di.Damper()
        problem = RecordProblem(records, model, output="force")
        first = solve(problem).values
        cells = []
        for dropped in ((), ("drift",), ("drift", "offset")):
            values = without(problem, first, dropped) if dropped else first
            left = np.concatenate(problem.split_residuals(values))
            share = np.sqrt(np.mean(left**2) / np.mean(np.concatenate(problem.measured) ** 2))
            asymmetry = values[problem.names.index("asymmetry")]
            cells.append(f"{asymmetry:+.3f} ({100.0 * share:.1f} %)")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def beam() -> None:
    """Print the misfit of laws with a mode to the bolted beam, and the least of any Masing law."""
    table = beam_table()
    print("\n| levels | rows | any Masing law | Iwan | Dahl |\n|---|---|---|---|---|")
    for kind in ("Force", "Response"):
        data = table.select(level=[level for level in table.levels if level.startswith(kind)])
        least = slip_density(data, di.Mass() + di.Damper()).least_misfit
        cells = [f"{100.0 * least:.1f} %"]
        for law in (di.Iwan(), di.Dahl()):
            found = solve(TableProblem(data, law + di.Mass() + di.Damper()))
            cells.append(
                f"{100.0 * rms_misfit_of(found.problem, found.problem.predict(found.theta)):.1f} %"
            )
        print(f"| {kind.lower()} | {data.n} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    damper()
    beam()

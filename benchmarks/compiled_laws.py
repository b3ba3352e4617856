"""Laws that are compiled: in plants, tables and records, and what their first use costs.

Run with ``python -m benchmarks.compiled_laws``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import dahl_ident as di
from benchmarks.harness import Row, print_table, seconds
from dahl_ident.arrays import FloatArray
from dahl_ident.elements.driven_motion import Shooting
from dahl_ident.elements.element import as_model
from tests.motions import Driven

TITLE = "Laws that are compiled"
KNOWN = di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
PLANT = di.Dahl(0.1, 30.0) + KNOWN
FREE = di.Mass() + di.Damper() + di.Spring()
_FORCE, _STIFFNESS = di.Dahl.parameters[:2]


class SlopeOfDahl(di.Friction):
    """Linear Dahl by its slope alone, as a user writes it."""

    kind = "slope_of_dahl"
    parameters: tuple[di.Parameter, ...] = (_FORCE, _STIFFNESS)

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx."""
        f_max, sigma = values
        return sigma * (1.0 - direction * force / f_max)


class Softening(SlopeOfDahl):
    """Dahl with an exponent and a second scale of force, by its slope alone."""

    kind = "softening"
    parameters = (
        _FORCE, _STIFFNESS,
        di.Parameter("f_b", "N", "force of softening", lower=0.0, transform="log"),
        di.Parameter("n", "", "exponent", lower=0.1, upper=5.0, transform="log", scan=(0.5, 1, 2)),
    )  # fmt: skip

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx."""
        f_max, sigma, f_b, n = values
        margin = 1.0 - direction * force / f_max
        return sigma * np.sign(margin) * np.abs(margin) ** n / (1.0 + np.abs(force) / f_b)


OWN = SlopeOfDahl()


def verdict(data: Any, model: di.Element) -> object:
    """Return the verdict on a fit."""
    return di.fit(data, model, throw=False).verdict


def errors_of(fit: Any) -> list[float | None]:
    """Return standard uncertainties."""
    return [p.stderr for p in fit.params.values()]


def best(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the least processor time of a call, after one that compiles."""
    work()
    return min(seconds(work) for _ in range(repeats))


def run() -> list[Row]:
    """Return times against their bounds, or over those of other laws."""
    return [
        *_first_use(), *_own_law_in_a_plant(), *_tables(), *_rates(), _sweeps(), _iwan(),
        *_steady(), *_errors(),
    ]  # fmt: skip


def _bound(work: str, ours: float, bound: float) -> Row:
    return Row(work, ours, bound, "the bound", 1.0)


def _first_use() -> list[Row]:
    """Return a fit of a record on a fresh installation, and the same again."""
    rows = []
    with TemporaryDirectory() as cache:
        command = [str(Path(sys.executable).with_name("dahl-ident")), "fit", "--record"]
        record = Path(cache) / "record.csv"
        made = _driven(PLANT, 500)
        columns = np.column_stack([made.time, np.asarray(made.displacement), made.force_samples])
        names = "time [s],displacement [m],force [N]"
        np.savetxt(record, columns, delimiter=",", header=names, comments="")
        command += [str(record), "--element", "dahl", "--element", "Mass(mass=0.3)", "--element",
                    "damper", "--element", "spring"]  # fmt: skip
        environment = os.environ | {"XDG_CACHE_HOME": cache}
        for which, bound in (("first", 60.0), ("second", 5.0)):
            spent = seconds(
                lambda: subprocess.run(command, env=environment, check=True, capture_output=True)
            )
            rows.append(_bound(f"{which} fit --record of a fresh installation", spent, bound))
    return rows


def _own_law_in_a_plant() -> list[Row]:
    rows = []
    for name in ("fig_7_plant", "frf_levels"):
        data = di.load_dataset(name)
        own, built_in = (best(partial(verdict, data, law + FREE)) for law in (OWN, di.Dahl()))
        work = f"own Dahl + mass + damper + spring, {name}, fit and verdict"
        rows.append(Row(work, own, built_in, "the built-in law", 2.0))
    return rows


def _tables() -> list[Row]:
    """Return fits of 30 points, and of a table with harmonics."""
    rows = []
    laws: dict[str, tuple[di.Element, di.Element]] = {
        "Dahl by its slope": (SlopeOfDahl(0.1, 30.0), SlopeOfDahl()),
        "a law of four parameters": (Softening(0.1, 30.0, 0.05, 1.6), Softening()),
        "Bouc-Wen": (di.BoucWen(30.0, 200.0, 150.0), di.BoucWen()),
        "Bouc-Wen, exponent free": (
            di.BoucWen(30.0, 200.0, 150.0, exponent=1.7), di.BoucWen(exponent=None),
        ),
        "LuGre": (di.LuGre(0.1, 30.0, 1.5, 0.02), di.LuGre()),
    }  # fmt: skip
    for name, (law, asked) in laws.items():
        data = _table(law, 30, (1,))
        spent = best(partial(verdict, data, asked))
        rows.append(_bound(f"fit of 30 points and verdict: {name}", spent, 0.3))
    linear = di.Mass(0.02) + di.Damper(0.1)
    data = _table(di.BoucWen(30.0, 200.0, 150.0) + linear, 75, (1, 3, 5, 7, 9))
    model = di.BoucWen() + di.Mass() + di.Damper()
    spent = best(partial(verdict, data, model))
    return [*rows, _bound("Bouc-Wen + mass + damper, 75 points of 5 harmonics", spent, 10.0)]


def _table(law: di.Element, points: int, orders: Sequence[int]) -> di.FrequencyResponse:
    A, f = np.geomspace(1e-4, 0.1, points), np.resize([0.5, 1.0, 2.0], points)
    Z = np.array([law.dynamic_stiffness(A, 2.0 * np.pi * f, harmonic=k) for k in orders]).T
    rng = np.random.default_rng(1)
    noise = rng.standard_normal(Z.shape) + 1j * rng.standard_normal(Z.shape)
    Z = Z + 0.007 * np.abs(Z[:, :1]) * noise
    A, f = (np.repeat(v, len(orders)) for v in (A, f))
    harmonic = np.tile(orders, points)
    return di.FrequencyResponse(f, Z.ravel(), A, harmonic=harmonic, controlled="displacement")


def _rates() -> list[Row]:
    """Return N of a law that depends on the rate, and its gradient, over Dahl's closed form."""
    A, omega = np.geomspace(1e-3, 10.0, 1000), np.full(1000, 2.0 * np.pi)
    pairs = [as_model(di.LuGre(1.0, 30.0, 1.5, 0.1)), as_model(di.Dahl(1.0, 30.0))]
    values = [[np.asarray(p.value) for p in m.parameters] for m in pairs]
    free = [m.with_free([p.name for p in m.parameters if p.name != "alpha"]) for m in pairs]
    rows = []
    for models, method, work, bound in (
        (pairs, "stiffness", "LuGre, N at 1,000 amplitudes", 30.0),
        (free, "stiffness_gradient", "LuGre, all derivatives", 60.0),
    ):
        ours, dahl = (
            best(partial(getattr(m, method), v, A, omega), 7)
            for m, v in zip(models, values, strict=True)
        )
        rows.append(Row(work, ours, dahl, "Dahl's closed form", bound))
    return rows


def _driven(plant: di.Element, samples: int, rate: float = 100.0) -> di.Record:
    """Return a record of a plant under a multisine, with noise of 0.1 %."""
    rng, t = np.random.default_rng(0), np.arange(samples) / rate
    lines = 2.0 * np.pi * np.arange(1, 9) / t[-1]
    drive = np.cos(lines[:, None] * t + rng.uniform(0.0, 6.3, (8, 1))).sum(axis=0)
    return _record(plant, t, drive * (0.15 / drive.std()), rng)


def _record(
    plant: di.Element, t: FloatArray, drive: FloatArray, rng: np.random.Generator
) -> di.Record:
    motion = Driven(as_model(plant), drive, 1.0 / (t[1] - t[0]))
    x = motion.motion(np.zeros(motion.order)).output
    return di.Record(t, displacement=x + 1e-3 * x.std() * rng.standard_normal(t.size), force=drive)


def _sweeps() -> Row:
    rng, t = np.random.default_rng(3), np.arange(48_000) / 200.0
    phase = 2.0 * np.pi * 0.3 * 240.0 / np.log(20.0) * np.expm1(t / 240.0 * np.log(20.0))
    records = [_record(PLANT, t, u * np.sin(phase), rng) for u in (0.1, 0.3, 1.0)]
    model = di.Dahl() + di.Mass(0.3) + di.Damper() + di.Spring()
    work = "three sweeps of 48,000 samples, fit and verdict"
    return _bound(work, best(partial(verdict, records, model), 1), 6.0)


def _iwan() -> Row:
    record = _driven(di.Iwan(0.1, 30.0, -0.3, 0.5) + KNOWN, 384)
    model = di.Iwan() + di.Mass(0.3) + di.Damper() + di.Spring()
    return _bound("Iwan driven, 384 samples", best(lambda: di.fit(record, model), 2), 1.0)


def _steady() -> list[Row]:
    """Return 150 exact steady motions with derivatives, from rest and from nearby orbits."""
    data = di.load_dataset("frf_levels")
    assert isinstance(data, di.FrequencyResponse)
    assert data.drive is not None
    omega, drive = 2.0 * np.pi * data.frequency_hz, data.drive
    shooting = Shooting(di.Dahl() + FREE)
    values = np.tile([0.1, 30.0, 1.0, 0.3, 0.24, 0.3], (omega.size, 1))
    chosen = (0, 1, 4, 5)
    starts = shooting(values, omega, drive, chosen=chosen).starts
    near = values * [1.01, 1.01, 1.0, 1.0, 1.01, 1.01]
    return [
        _bound("exact steady response, 150 rows with derivatives, from rest",
               best(lambda: shooting(values, omega, drive, chosen=chosen)), 1.0),
        _bound("the same, from orbits at parameters 1 % away",
               best(lambda: shooting(near, omega, drive, chosen=chosen, starts=starts)), 0.1),
    ]  # fmt: skip


def _errors() -> list[Row]:
    """Return the standard uncertainties of long records, after the fit."""
    rows = []
    for samples, bound in ((100_000, 0.3), (1_000_000, 3.0)):
        t = np.arange(samples) / 1000.0
        x = 1e-2 * np.sin(8.2 * t) * np.cos(0.69 * t)
        force = di.Dahl(0.1, 30.0).force(x) + 5.0 * x
        force += 1e-3 * np.random.default_rng(1).standard_normal(samples)
        record = di.Record(t, displacement=x, force=force)
        fits = [di.fit(record, di.Dahl() + di.Spring()) for _ in range(2)]
        spent = [seconds(partial(errors_of, fit)) for fit in fits]
        rows.append(_bound(f".stderr of a record of {samples:,} samples", min(spent), bound))
    return rows


if __name__ == "__main__":
    print_table(TITLE, run())

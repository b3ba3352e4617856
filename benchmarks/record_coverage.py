"""Coverage of 95.45 % intervals of fits to records: ``python -m benchmarks.record_coverage N M``.

N records of a force and M of a driven motion in each scenario; the table is written to
docs/validation/records.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import dahl_ident as di
from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE
from dahl_ident.elements import Element
from tests.motions import Driven

PAGE = Path(__file__).parents[1] / "docs" / "validation" / "records.md"
RATE = 500.0
LOWEST, HIGHEST = 0.91, 0.99
_OTHER = 1_000_000  # added to a seed: the displacement's noise is not the force's


@dataclass(frozen=True)
class Scenario:
    """Records of one kind, the model fitted to them, and the truth."""

    name: str
    model: Element
    truth: dict[str, float]
    record: Callable[[int], di.Record]
    driven: bool


def coloured(seed: int, samples: int, pole: float) -> FloatArray:
    """Return noise of unit variance with the correlation `pole` from sample to sample."""
    rng = np.random.default_rng([1, seed])
    noise = lfilter([1.0], [1.0, -pole], rng.standard_normal(samples + 300))[300:]
    return np.asarray(np.sqrt(1.0 - pole**2) * noise)


def force_record(
    seed: int,
    pole: float,
    *,
    travel_noise: float = 0.0,
    travel_pole: float = 0.0,
    alpha: float = 1.0,
) -> di.Record:
    """Return a random displacement and the force of friction and a spring, both with noise."""
    samples = 600
    rng = np.random.default_rng([0, seed])
    x = lfilter([1.0], np.poly([0.97, 0.97, 0.9]), rng.standard_normal(samples))
    x = 1e-2 * x / np.abs(x).max()
    force = di.Dahl(0.1, 30.0, alpha).force(x) + 5.0 * x + 1e-3 * coloured(seed, samples, pole)
    x = x + travel_noise * coloured(seed + _OTHER, samples, travel_pole)
    return di.Record(np.arange(samples) / RATE, displacement=x, force=force)


def motion_record(seed: int, pole: float, samples: int = 1024) -> di.Record:
    """Return a multisine force and the displacement of a plant with friction, driven by it."""
    rng = np.random.default_rng([0, seed])
    t = np.arange(samples) / RATE
    lines = np.arange(3, 60) * RATE / samples
    drive = 0.03 * np.sum([np.sin(2 * np.pi * (f * t + rng.random())) for f in lines], axis=0)
    plant = di.Dahl(0.1, 300.0) + di.Mass(0.3) + di.Damper(0.5) + di.Spring(50.0)
    x = Driven(plant, drive, RATE).motion([1e-4, 0.0, 0.0]).output
    x = x + 0.01 * x.std() * coloured(seed, samples, pole)
    return di.Record(t, displacement=x, force=drive)


def scenarios() -> list[Scenario]:
    """Return every scenario: kind, noise, noise of the displacement, exponent not stated."""
    found = []
    spring = {"f_max": 0.1, "sigma": 30.0, "stiffness": 5.0}
    plant = {"f_max": 0.1, "sigma": 300.0, "mass": 0.3, "damping": 0.5, "stiffness": 50.0}
    for pole in (0.0, 0.9):
        noise = f"correlation {pole}" if pole else "white noise"
        found.append(
            Scenario(
                f"force from displacement, {noise}", di.Dahl(alpha=1.0) + di.Spring(), spring,
                partial(force_record, pole=pole), False,
            )
        )  # fmt: skip
        found.append(
            Scenario(
                f"motion from force, {noise}",
                di.Dahl(alpha=1.0) + di.Mass() + di.Damper() + di.Spring(), plant,
                partial(motion_record, pole=pole), True,
            )
        )  # fmt: skip
    for travel, pole in ((5e-6, 0.0), (2e-5, 0.0), (5e-6, 0.9), (2e-5, 0.9)):
        kind = f"correlation {pole}" if pole else "white"
        found.append(
            Scenario(
                f"force from displacement, white noise; noise in the displacement {travel:g} m, "
                f"{kind}",
                di.Dahl(alpha=1.0) + di.Spring(), spring,
                partial(force_record, pole=0.0, travel_noise=travel, travel_pole=pole), False,
            )
        )  # fmt: skip
    for pole, alpha in ((0.0, 0.8), (0.9, 1.3)):
        noise = f"correlation {pole}" if pole else "white noise"
        found.append(
            Scenario(
                f"force from displacement, {noise}; exponent {alpha}, not stated",
                di.Dahl() + di.Spring(), {**spring, "alpha": alpha},
                partial(force_record, pole=pole, alpha=alpha), False,
            )
        )  # fmt: skip
    return found


def coverage(scenario: Scenario, records: int) -> dict[str, float]:
    """Return the share of records whose 95.45 % interval holds the truth, by parameter."""
    inside = dict.fromkeys(scenario.truth, 0)
    start = {name: value for name, value in scenario.truth.items() if name != "alpha"}
    for seed in range(records):
        fit = di.fit(scenario.record(seed), scenario.model, start=start, throw=False)
        within = fit.conf_interval(levels=CONFIDENCE).at(CONFIDENCE)
        for name, value in scenario.truth.items():
            inside[name] += within[name].lower < value < within[name].upper
    return {name: count / records for name, count in inside.items()}


def main() -> None:
    """Print the table, and write it to its page."""
    forces, motions = (int(n) for n in sys.argv[1:3])
    lines = [
        "# Coverage of the intervals of fits to records",
        "",
        f"Made by `python -m benchmarks.record_coverage {forces} {motions}`. Each record has its",
        "own motion and noise; every record counts. Coverage of 95.45 % intervals in percent;",
        f"values outside {100 * LOWEST:.0f} to {100 * HIGHEST:.0f} are marked (!).",
        "",
        "The displacement moves 10 mm to either side, and the force's noise is 1e-3 N; with a",
        "contact stiffness of 30 N/m, noise in the displacement of 3e-5 m is as large. If it is",
        "correlated, as the error of an encoder between its lines, fourth differences show little",
        "of it. Friction goes on from where the motion turned, so errors there last for some x_c",
        "of path, where the parameters show most; the residuals after reversals show their size.",
        "",
        "| scenario | records | coverage |",
        "|---|---|---|",
    ]
    for scenario in scenarios():
        count = motions if scenario.driven else forces
        found = coverage(scenario, count)
        cells = [
            f"{name} {100 * share:.1f}{'' if LOWEST <= share <= HIGHEST else ' (!)'}"
            for name, share in found.items()
        ]
        lines.append(f"| {scenario.name} | {count} | {', '.join(cells)} |")
        print(lines[-1], flush=True)
    PAGE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

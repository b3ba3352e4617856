"""Fits of driven plants to motions that another program integrated.

``python -m benchmarks.driven_plants`` simulates sine sweeps of ten plants at five drive levels,
from below to above resonance, by scipy's DOP853, which is stopped and restarted where the velocity
changes sign. Noise of 0.2 to 1 % is added. Each table is fitted with the exact steady motion, the
first of each plant with the describing function as well. The page has the share of tables that are
trusted, how often the combined 95.45 % intervals hold the truth, the mean error in standard
uncertainties, and the uncertainties themselves.

A simulation starts on the orbit that the engine found and goes on for two cycles. Its own second
cycle makes the data; the change between the two cycles says how far it is from settled.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import integrate

import dahl_ident as di
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.driven_motion import Shooting, Steady

DESTINATION = Path("docs/validation/driven_plants.md")
SEED = 31
TABLES = 4  # of each plant, each with noise of its own
LEVELS, FREQUENCIES = 5, 12
solve_ivp: Any = integrate.solve_ivp
SAMPLES = 512  # of a cycle, for its fundamental
WAYS: tuple[Steady, ...] = ("exact", "describing function")
NAMES = ("f_max", "sigma", "damping", "stiffness")


class Plant(NamedTuple):
    """A Dahl plant, the noise of its tables, and the lowest and highest drive over f_max."""

    f_max: float
    sigma: float
    alpha: float
    mass: float
    damping: float
    stiffness: float
    noise: float
    drives: tuple[float, float]

    @property
    def element(self) -> di.Element:
        """The plant as a model with a value for every parameter."""
        friction = di.Dahl(self.f_max, self.sigma, self.alpha)
        linear = di.Damper(self.damping) + di.Spring(self.stiffness)
        return friction + di.Mass(self.mass) + linear

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency: around the resonances of the sliding and stuck plant."""
        low, high = (
            np.sqrt(k / self.mass) / (2.0 * np.pi)
            for k in (self.stiffness, self.stiffness + self.sigma)
        )
        return 0.6 * float(low), 1.3 * float(high)


PLANTS = (
    Plant(0.1, 30.0, 1.0, 0.3, 0.24, 0.3, 0.01, (0.3, 10.0)),  # of the paper
    Plant(0.1, 30.0, 1.0, 0.3, 0.24, 0.3, 0.002, (0.3, 10.0)),
    Plant(2.0, 5e4, 1.0, 1.2, 6.0, 900.0, 0.005, (0.3, 8.0)),  # a linear guide
    Plant(0.02, 400.0, 1.0, 0.05, 0.02, 8.0, 0.01, (0.4, 6.0)),
    Plant(15.0, 2e6, 1.0, 40.0, 300.0, 2e5, 0.005, (0.3, 5.0)),
    Plant(0.5, 200.0, 1.0, 2.0, 1.5, 60.0, 0.002, (0.3, 10.0)),
    Plant(1.0, 1e4, 0.7, 0.5, 2.0, 500.0, 0.005, (0.4, 6.0)),
    Plant(1.0, 1e4, 1.5, 0.5, 2.0, 500.0, 0.005, (0.4, 6.0)),
    Plant(0.3, 3e3, 1.0, 0.02, 0.05, 300.0, 0.01, (0.3, 10.0)),
    Plant(0.1, 50.0, 1.0, 0.1, 0.05, 20.0, 0.005, (0.5, 10.0)),
)


def simulated(
    plant: Plant, n_levels: int = LEVELS, n_frequencies: int = FREQUENCIES
) -> tuple[FloatArray, FloatArray, ComplexArray, float]:
    """Return frequencies, drives and receptance of a sweep, and the largest change in a cycle."""
    levels = plant.f_max * np.geomspace(*plant.drives, n_levels)
    band = np.geomspace(*plant.band, n_frequencies)
    u, f = (g.ravel() for g in np.meshgrid(levels, band, indexing="ij"))
    values = np.tile(plant[:6], (u.size, 1)).astype(np.float64)
    orbits = Shooting(plant.element)(values, 2.0 * np.pi * f, u)
    assert orbits.found.all()
    first, second = np.empty((2, u.size), dtype=np.complex128)
    for i, start in enumerate(orbits.starts):
        first[i], second[i] = _two_cycles(plant, float(u[i]), 2.0 * np.pi * float(f[i]), start)
    return f, u, second / u, float(np.max(np.abs(second / first - 1.0)))


def _two_cycles(plant: Plant, u: float, omega: float, start: FloatArray) -> list[complex]:
    """Return the fundamentals of two cycles of Eqn. 2, integrated from turn to turn."""

    def rates(t: float, y: FloatArray, side: float) -> list[float]:
        x, v, force = y.tolist()
        margin = 1.0 - side * force / plant.f_max
        slope = plant.sigma * math.copysign(abs(margin) ** plant.alpha, margin)
        push = u * math.cos(omega * t) - force - plant.damping * v - plant.stiffness * x
        return [v, push / plant.mass, slope * v]

    def turn(_t: float, y: FloatArray, _side: float) -> float:
        return float(y[1])

    turn.terminal = True  # type: ignore[attr-defined]  # solve_ivp reads it
    period = 2.0 * np.pi / omega
    sizes = np.array([abs(start[0]), abs(start[1]), plant.f_max]) + 1e-3 * np.array(
        [u / plant.stiffness, omega * u / plant.stiffness, 0.0]
    )
    t, y = 0.0, start.copy()
    side = float(np.sign(y[1]))
    sampled = (np.arange(2 * SAMPLES) + 0.5) / SAMPLES * period
    x = np.empty(sampled.size)
    while t < 2.0 * period:
        turn.direction = -side  # type: ignore[attr-defined]  # solve_ivp reads it
        run = solve_ivp(
            rates, (t, 2.0 * period), y, "DOP853", events=turn, dense_output=True, args=(side,),
            rtol=1e-9, atol=1e-11 * sizes,
        )  # fmt: skip
        inside = (sampled >= t) & (sampled <= run.t[-1])
        if inside.any():
            x[inside] = run.sol(sampled[inside])[0]
        t, y = float(run.t[-1]), run.y[:, -1].copy()
        if run.status == 1:
            y[1] = 0.0
            side = -side
    turned = 2.0 / SAMPLES * x * np.exp(-1j * omega * sampled)
    return [complex(part.sum()) for part in np.split(turned, 2)]


def table(
    plant: Plant, f: FloatArray, u: FloatArray, R: ComplexArray, seed: int
) -> di.FrequencyResponse:
    """Return the sweep with noise, and its covariance stated."""
    rng = np.random.default_rng(seed)
    s = plant.noise * np.abs(R)
    noisy = R + s * (rng.standard_normal(R.size) + 1j * rng.standard_normal(R.size))
    return di.FrequencyResponse(
        f, noisy, drive=u, level=u, covariance=s[:, None, None] ** 2 * np.eye(2),
        controlled="force", quantity="receptance",
    )  # fmt: skip


class Score(NamedTuple):
    """What fits of one plant in one way gave."""

    trusted: int
    inside: int
    intervals: int
    errors: list[float]
    spreads: list[float]
    seconds: list[float]


def scored(plant: Plant, tables: list[di.FrequencyResponse], steady: Steady) -> Score:
    """Return how fits of the tables in one way compare with the truth."""
    trusted, inside, intervals = 0, 0, 0
    errors: list[float] = []
    spreads: list[float] = []
    seconds: list[float] = []
    truth = dict(
        zip(NAMES, (plant.f_max, plant.sigma, plant.damping, plant.stiffness), strict=True)
    )
    alpha = None if plant.alpha != 1.0 else 1.0
    model = di.Dahl(alpha=alpha) + di.Mass(plant.mass) + di.Damper() + di.Spring()
    for one in tables:
        begin = time.process_time()
        fit = di.fit(one, model, throw=False, steady=steady)
        trusted += fit.trusted
        seconds.append(time.process_time() - begin)
        limits = fit.conf_interval().at(0.9545)
        for name, true in truth.items():
            value, u = fit.params[name].value, fit.params[name].stderr
            _, low, high = limits[name]
            inside += low <= true <= high
            intervals += 1
            if u:
                errors.append((value - true) / u)
                spreads.append(u / true)
    return Score(trusted, inside, intervals, errors, spreads, seconds)


def page(tables: int) -> str:
    """Return the page."""
    lines = [_INTRODUCTION.format(tables=tables, cells=len(PLANTS), seed=SEED)]
    lines += [
        "| plant | noise | closure | way | trusted | intervals that hold the truth | mean error/u "
        "| u (median) | fit and verdict |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    totals: dict[Steady, list[Score]] = {way: [] for way in WAYS}
    for number, plant in enumerate(PLANTS, start=1):
        f, u, R, closure = simulated(plant)
        made = [table(plant, f, u, R, 1000 * SEED + 10 * number + k) for k in range(tables)]
        for way in WAYS:  # the second for comparison, of one table
            score = scored(plant, made if way == "exact" else made[:1], way)
            totals[way].append(score)
            name = f"{number} | {100.0 * plant.noise:g} % | {closure:.1g} | {way}"
            lines.append(f"| {name} | {_row([score])} |")
            print(lines[-1], flush=True)
    for way, scores in totals.items():
        lines.append(f"| all | | | {way} | {_row(scores)} |")
    return "\n".join(lines) + "\n"


def _row(scores: list[Score]) -> str:
    trusted = sum(score.trusted for score in scores) / sum(len(score.seconds) for score in scores)
    held = sum(score.inside for score in scores) / sum(score.intervals for score in scores)
    errors, spreads, seconds = (np.concatenate([score[i] for score in scores]) for i in (3, 4, 5))
    return (
        f"{100.0 * trusted:.0f} % | {100.0 * held:.1f} % | {np.mean(errors):+.2f} "
        f"| {100.0 * np.median(spreads):.2g} % | {np.median(seconds):.1f} s"
    )


_INTRODUCTION = """# Driven plants

Ten plants, {tables} tables each of 60 rows, simulated by scipy's DOP853 with events
(`python -m benchmarks.driven_plants`, seed {seed}). Drives go from 0.3 to 10 times the friction
force, frequencies from below the resonance of the sliding plant to above that of the stuck one.
"closure" is the largest change of a fundamental between two cycles of the simulation, so far is
the engine's orbit from DOP853's. The describing function fits the first table of each plant. u is
the combined standard uncertainty over the true value, of f_max, sigma, damping and stiffness
together.
"""


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", type=int, default=TABLES)
    parser.add_argument("--to", type=Path, default=DESTINATION)
    given = parser.parse_args()
    given.to.write_text(page(given.tables), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Which law compare_models chooses on tables made by each law.

Each table: 20 amplitudes from a tenth of the knee to ten times it, two frequencies, three runs;
mean force, fundamental, second and third harmonic with errors of 1 % of the fundamental. Linear
Dahl is fitted, then the usual candidates are compared. A choice is right where it is the law that
made the table, and equivalent where it meets the table without its noise within 0.5 % rms of the
fundamental, half of what one row's noise is.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

import dahl_ident as di
from dahl_ident.diagnostics.comparison import ComparedModel

NOISE = 0.01
EQUIVALENT = 0.005
HARMONICS = (0, 1, 2, 3)

Maker = Callable[[np.random.Generator], di.Element]


def _scale(rng: np.random.Generator) -> tuple[float, float]:
    return 10.0 ** rng.uniform(-1.0, 2.0), 10.0 ** rng.uniform(2.0, 6.0)


def _dahl(rng: np.random.Generator) -> di.Element:
    return di.Dahl(*_scale(rng))


def _exponent(rng: np.random.Generator) -> di.Element:
    return di.Dahl(*_scale(rng), rng.choice([0.5, 1.5, 2.0]))


def _two_limits(rng: np.random.Generator) -> di.Element:
    return di.Dahl(*_scale(rng), asymmetry=rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.4))


def _gap(rng: np.random.Generator) -> di.Element:
    f_max, sigma = _scale(rng)
    return di.Backlash(di.Dahl(f_max, sigma), f_max / sigma * rng.uniform(0.03, 0.15))


def _bouc_wen(rng: np.random.Generator) -> di.Element:
    f_max, sigma = _scale(rng)
    return di.BoucWen(sigma, sigma / f_max, sigma / f_max * rng.uniform(0.0, 0.6))


def _iwan(rng: np.random.Generator) -> di.Element:
    return di.Iwan(*_scale(rng), rng.uniform(-0.7, 0.0), rng.uniform(0.2, 3.0))


def _power_damper(rng: np.random.Generator) -> di.Element:
    f_max, sigma = _scale(rng)
    exponent = rng.uniform(0.3, 0.8)
    speed = 2.0 * np.pi * f_max / sigma  # at the knee
    coefficient = f_max * rng.uniform(0.2, 0.6) / speed**exponent
    return di.Dahl(f_max, sigma) + di.PowerDamper(coefficient, exponent)


def _two_elements(rng: np.random.Generator) -> di.Element:
    f_max, sigma = _scale(rng)
    late = di.Dahl(f_max, sigma / rng.uniform(10.0, 20.0), name="late")
    return di.Dahl(0.5 * f_max, sigma, name="early") + late


def _lugre(rng: np.random.Generator) -> di.Element:
    f_max, sigma = _scale(rng)
    speed = 2.0 * np.pi * f_max / sigma * rng.uniform(1.0, 10.0)
    return di.LuGre(f_max, sigma, rng.uniform(1.3, 2.0), speed)


def _maxwell(rng: np.random.Generator) -> di.Element:
    f_max, sigma = _scale(rng)
    slips = f_max / sigma * np.array([0.3, 1.0, 3.0]) * np.exp(rng.uniform(-0.3, 0.3, 3))
    return di.MaxwellSlip(slips, sigma * rng.uniform(0.2, 0.5, 3))


LAWS: dict[str, tuple[str, Maker]] = {
    "linear Dahl": ("as fitted", _dahl),
    "Dahl, other exponent": ("as fitted", _exponent),
    "two limits": ("two limits", _two_limits),
    "gap": ("gap", _gap),
    "Bouc-Wen": ("Bouc-Wen", _bouc_wen),
    "Iwan": ("Iwan", _iwan),
    "power-law damper": ("power damper added", _power_damper),
    "LuGre": ("LuGre", _lugre),
    "Maxwell slip": ("Maxwell slip", _maxwell),
    "two Dahl elements": ("two Dahl elements", _two_elements),
}


def table(
    law: di.Element, knee: float, rng: np.random.Generator, amplitudes: int = 20
) -> tuple[di.FrequencyResponse, np.ndarray]:
    """Return a noisy table, and its responses without noise."""
    A = np.tile(np.repeat(knee * np.geomspace(0.1, 10.0, amplitudes), 2), 3)
    f = np.tile([1.0, 3.0], A.size // 2)
    run = np.repeat(["1", "2", "3"], A.size // 3)
    first = law.dynamic_stiffness(A, 2.0 * np.pi * f)
    error = NOISE * np.abs(first)
    parts, truth = [], []
    for k in HARMONICS:
        exact = law.dynamic_stiffness(A, 2.0 * np.pi * f, harmonic=k)
        noise = rng.standard_normal(A.size) + (k > 0) * 1j * rng.standard_normal(A.size)
        covariance = error[:, None, None] ** 2 * np.diag([1.0, float(k > 0)])
        parts.append(
            di.FrequencyResponse(
                f, exact + error * noise, A, harmonic=np.full(A.size, k), covariance=covariance,
                run=run,
            )
        )  # fmt: skip
        truth.append(exact)
    return di.FrequencyResponse.concatenate(parts), np.concatenate(truth)


def is_equivalent(model: ComparedModel, truth: np.ndarray) -> bool:
    """Return whether a model meets the table without its noise."""
    problem = model.optimum.problem
    first = problem.data.harmonic == 1
    size = np.tile(np.abs(truth[first]), len(HARMONICS))
    missed = np.abs(problem.predict(model.optimum.theta) - truth) / size
    return bool(np.sqrt(np.mean(missed**2)) < EQUIVALENT)


def choices(name: str, tables: int, seed: int, amplitudes: int = 20) -> list[tuple[str, bool]]:
    """Return what was chosen for tables of one law, and whether it is right or equivalent."""
    right, maker = LAWS[name]
    found = []
    for i in range(tables):
        rng = np.random.default_rng([seed, i])
        law = maker(rng)
        friction = di.Model(law).elements[0]
        assert isinstance(friction, di.Friction)
        values = friction.known_values()
        stiffness = float(friction.rest_stiffness(values))
        if not stiffness:  # behind a gap
            stiffness = float(friction.quasi_static_slope(np.zeros(()), 1.0, values))
        knee = float(np.mean(friction.force_limits(values))) / stiffness
        data, truth = table(law, knee, rng, amplitudes)
        best = di.compare_models(di.fit(data, di.Dahl(), throw=False)).best
        found.append((best.name, best.name == right or is_equivalent(best, truth)))
    return found


def main() -> None:
    """Print shares of right choices."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tables", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--law", choices=LAWS, action="append")
    options = parser.parse_args()
    for name in options.law or LAWS:
        begin = time.perf_counter()
        found = choices(name, options.tables, options.seed)
        seconds = (time.perf_counter() - begin) / len(found)
        right = sum(ok for _, ok in found)
        counts = ", ".join(f"{n} {what}" for what, n in Counter(c for c, _ in found).most_common())
        print(f"{name}: {right} of {len(found)} right ({counts}); {seconds:.1f} s each", flush=True)


if __name__ == "__main__":
    main()

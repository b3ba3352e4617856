"""Random loops, force histories, motions and settled motions of all laws, against DOP853.

    python -m benchmarks.engine_oracles --write docs/validation/engine.md

Each case has random units of force, length and time (1e-6 to 1e6), so that nothing depends on them.
The error is the largest difference of harmonics 0 to 5 over the largest of them, or of the motion
over its largest value.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

import dahl_ident as di
from benchmarks import loop_oracles
from benchmarks.motion_oracles import (
    HARMONICS,
    BoucWenByHand,
    DahlByHand,
    JenkinsByHand,
    Oracle,
    PowerDamperByHand,
    dahl_history,
    fixed_point,
    integrated,
)
from dahl_ident.arrays import FloatArray
from dahl_ident.elements.equations import law_equations, plant_equations
from dahl_ident.engine import System, band_limited, loops, march, settled, translate

SEED, CASES = 1, 216
_EXACT = 20  # times as many cases where the reference is a closed form


class Drawn(NamedTuple):
    """A law by hand, as an element, its values, and its units of force and of displacement."""

    hand: Any
    element: di.Element
    values: Sequence[float]
    force: float
    length: float


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _general(F: float, x: float, rng: np.random.Generator) -> Drawn:
    alpha = rng.uniform(0.5, 2.5)
    return Drawn(DahlByHand(F, F / x, alpha), di.Dahl(alpha=None), [F, F / x, alpha], F, x)


def _asymmetric(F: float, x: float, rng: np.random.Generator) -> Drawn:
    values = [F, F / x, rng.uniform(0.7, 2.5), rng.uniform(-0.6, 0.6)]
    return Drawn(DahlByHand(*values), di.Dahl(alpha=None, asymmetry=None), values, F, x)


def _backlash(F: float, x: float, rng: np.random.Generator) -> Drawn:
    gap = x * between(rng, 0.1, 5.0)
    hand = DahlByHand(F, F / x, gap=gap)
    return Drawn(hand, di.Backlash(di.Dahl()), [F, F / x, gap], F, x)


def _bouc_wen(F: float, x: float, rng: np.random.Generator) -> Drawn:
    values = [F / x, rng.uniform(-0.1, 1.0) / x, rng.uniform(-0.5, 2.0) / x]
    return Drawn(BoucWenByHand(values[0], values[1], values[2]), di.BoucWen(), values, F, x)


def _maxwell(F: float, x: float, rng: np.random.Generator) -> Drawn:
    slips = np.sort(x * np.exp(rng.uniform(-2.0, 2.0, 3)))
    stiffnesses = F / x * rng.uniform(0.1, 1.0, 3)
    hand = JenkinsByHand(stiffnesses, slips)
    return Drawn(hand, di.MaxwellSlip(3), [*stiffnesses, *slips], F, x)


def _iwan(F: float, x: float, rng: np.random.Generator) -> Drawn:
    values = [F, F / x, rng.uniform(-0.9, 0.5), between(rng, 0.1, 10.0)]
    return Drawn(JenkinsByHand(*di.Iwan().sliders(values)), di.Iwan(), values, F, x)


def _lugre(F: float, x: float, rng: np.random.Generator) -> Drawn:
    ratio, speed = rng.uniform(1.0, 2.0), 1e3 * x  # x/s: frequencies are about 1e3 rad/s
    speed *= between(rng, 0.1, 10.0)
    micro, viscous = (F / speed * between(rng, 0.01, 1.0) for _ in range(2))
    hand = DahlByHand(
        F, F / x, static_ratio=ratio, speed=speed, micro_damping=micro, viscous=viscous
    )
    element = di.LuGre(micro_damping=None, viscous=None)
    return Drawn(hand, element, [F, F / x, ratio, speed, micro, viscous], F, x)


def _power(F: float, x: float, rng: np.random.Generator) -> Drawn:
    exponent, speed = rng.uniform(0.2, 2.5), 1e3 * x
    hand = PowerDamperByHand(F, exponent, speed)
    return Drawn(hand, di.PowerDamper(reference_speed=speed), [F, exponent], F, x)


LAWS: dict[str, Callable[[float, float, np.random.Generator], Drawn]] = {
    "Dahl": lambda F, x, _: Drawn(DahlByHand(F, F / x), di.Dahl(), [F, F / x], F, x),
    "Dahl, any exponent": _general,
    "Dahl, two limits": _asymmetric,
    "Backlash": _backlash,
    "Bouc-Wen": _bouc_wen,
    "Maxwell slip": _maxwell,
    "Iwan": _iwan,
    "LuGre": _lugre,
    "Power damper": _power,
}
KINKS = (
    "Backlash", "Bouc-Wen", "Maxwell slip", "Iwan", "Power damper", "Dahl, any exponent", "LuGre",
)  # fmt: skip
BRANCHES: dict[str, Callable[[Any, float], list[loop_oracles.Branch]]] = {
    "Dahl": loop_oracles.dahl,
    "Dahl, any exponent": loop_oracles.dahl,
    "Dahl, two limits": loop_oracles.dahl,
    "Backlash": loop_oracles.dahl,
    "Bouc-Wen": loop_oracles.bouc_wen,
    "Maxwell slip": loop_oracles.jenkins,
    "Iwan": loop_oracles.jenkins,
}
CLOSED = ("Dahl", "Dahl, any exponent", "Dahl, two limits", "Backlash")  # force histories


@dataclass
class Case:
    """What a case is compared on: the engine's numbers, the oracle's, and the error."""

    error: float
    note: str
    seconds: float = 0.0


_SYSTEMS: dict[tuple[str, str, bool], System] = {}


def system_of(name: str, drawn: Drawn, held: bool) -> System:
    """Return the compiled law, or the plant of the law, a mass, a damper and a spring."""
    key = (name, drawn.element.kind, held)
    if key not in _SYSTEMS:
        plant = drawn.element + di.Mass() + di.Damper() + di.Spring()
        equations = law_equations(drawn.element) if held else plant_equations(plant)
        _SYSTEMS[key] = translate(equations)
    return _SYSTEMS[key]


def all_values(drawn: Drawn, *others: float) -> FloatArray:
    """Return the values of all parameters, the fixed ones too."""
    values = iter(drawn.values)
    law = [next(values) if p.free else float(p.value or 0.0) for p in drawn.element.parameters]
    return np.array([*law, *others])


def draw(name: str, rng: np.random.Generator) -> Drawn:
    """Return a law of that name in random units."""
    return LAWS[name](between(rng, 1e-6, 1e6), between(rng, 1e-6, 1e3), rng)


def _sizes(drawn: Drawn, *others: float) -> FloatArray:
    own = [drawn.force] * drawn.hand.n
    if drawn.hand.n == 2:  # a gap: the second state is a place
        own[1] = drawn.length
    return np.array([*others, *own])


def loop(name: str, rng: np.random.Generator) -> Case:
    """Check a settled loop under a sine displacement, beta from 0.01 to 100."""
    drawn = draw(name, rng)
    amplitude = drawn.length * between(rng, 0.01, 5.0 if name == "Bouc-Wen" else 100.0)
    omega = 1e3 * drawn.length / amplitude * between(rng, 0.1, 10.0)
    system = system_of(name, drawn, True)
    start = time.process_time()
    found = settled(
        system, np.array([amplitude]), np.array([omega]), all_values(drawn)[None],
        harmonics=HARMONICS,
    )  # fmt: skip
    seconds = time.process_time() - start
    note = f"amplitude {amplitude / drawn.length:.3g} x_c, {np.array(drawn.values)}"
    if not found.found[0]:
        return Case(np.inf, note)

    def displacement(t: float) -> tuple[float, float]:
        angle = omega * t
        return amplitude * np.cos(angle), -amplitude * omega * np.sin(angle)

    oracle = Oracle([drawn.hand], displacement, True, sizes=_sizes(drawn))
    _, c, _ = fixed_point(oracle, found.starts[0, 2:], found.maps[0, 2:, 2:], omega, system.odd)
    error = _share(c, found.harmonics[0])
    if name not in ("Iwan", "Power damper"):  # the law itself, where it is the one by hand
        values, at = [np.asarray(v) for v in all_values(drawn)], np.asarray(amplitude)
        law = [drawn.element.stiffness(values, at, np.asarray(omega), k) for k in HARMONICS]
        error = max(error, _share(c, amplitude * np.array(law)))
    return Case(error, note, seconds)


def any_amplitude(name: str, rng: np.random.Generator) -> Case:
    """Check a settled loop in closed form, beta from 1e-8 to 1e8."""
    drawn = draw(name, rng)
    amplitude = drawn.length * between(rng, 1e-8, 1e8)
    if name == "Bouc-Wen" and drawn.hand.q <= max(0.0, -drawn.hand.p):  # the force has no limit
        amplitude = min(amplitude, 0.5 * drawn.length)
    if name == "Backlash":  # a gap that is not crossed leaves nothing
        amplitude += 0.5 * drawn.hand.gap
    note = f"amplitude {amplitude / drawn.length:.3g} x_c, {np.array(drawn.values)}"
    branches = BRANCHES[name](drawn.hand, amplitude)
    expected = loop_oracles.harmonics_of(branches, amplitude, HARMONICS)
    law, behind_gap = drawn.element, isinstance(drawn.element, di.Backlash)
    if isinstance(law, di.Backlash):
        law = law.element
    system, values = system_of(name, drawn._replace(element=law), True), all_values(drawn)[None]
    at, one = np.array([amplitude]), np.ones(1)
    start = time.process_time()
    if system.order > 3:
        found: Any = settled(system, at, one, values, harmonics=HARMONICS)
    else:
        found = loops(system, at, one, values, harmonics=HARMONICS, gap=behind_gap)
    seconds = time.process_time() - start
    if not found.found[0]:
        return Case(np.inf, note)
    error = _share(expected, found.harmonics[0])
    if name != "Iwan":  # whose own are those of infinitely many elements
        own = drawn.element.stiffness(list(values[0]), at, one, np.array(HARMONICS))
        error = max(error, _share(expected, amplitude * own))
    return Case(error, note, seconds)


def _plant(drawn: Drawn, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Return mass, damping, stiffness and the natural frequency of about 1e3 rad/s."""
    k = drawn.force / drawn.length * between(rng, 0.03, 30.0)
    omega = 1e3 * between(rng, 0.3, 3.0)
    m = (k + drawn.force / drawn.length) / omega**2
    return m, 2.0 * between(rng, 0.003, 0.3) * np.sqrt(k * m), k, omega


def periodic(name: str, rng: np.random.Generator) -> Case:
    """Check a settled motion of a plant: from below the friction to far above, in resonance."""
    drawn = draw(name, rng)
    m, c, k, natural = _plant(drawn, rng)
    drive, omega = drawn.force * between(rng, 0.05, 30.0), natural * between(rng, 0.2, 3.0)
    system = system_of(name, drawn, False)
    start = time.process_time()
    found = settled(
        system, np.array([drive]), np.array([omega]), all_values(drawn, m, c, k)[None],
        harmonics=HARMONICS,
    )  # fmt: skip
    seconds = time.process_time() - start
    note = f"drive {drive / drawn.force:.3g} F, {omega / natural:.3g} of resonance, "
    note += f"{np.array(drawn.values)}"
    if not found.found[0]:
        return Case(np.inf, note)
    size = max(drive / k, float(abs(found.starts[0, 0])))
    oracle = Oracle(
        [drawn.hand], lambda t: (drive * np.cos(omega * t), 0.0), False, m, c, k,
        _sizes(drawn, size, size * omega),
    )  # fmt: skip
    _, harmonics, _ = fixed_point(oracle, found.starts[0], found.maps[0], omega, system.odd)
    return Case(_share(harmonics, found.harmonics[0]), note, seconds)


def history(name: str, rng: np.random.Generator) -> Case:
    """Check the force along a displacement of cubic polynomials, read at uneven times."""
    drawn = draw(name, rng)
    knots = 1e-3 * np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 1.5, 30))])
    size = drawn.length * between(rng, 0.1, 3.0 if name == "Bouc-Wen" else 30.0)
    spline = CubicSpline(knots, size * rng.standard_normal(31))
    widths = np.diff(knots)
    samples = np.sort(np.append(rng.uniform(0.0, knots[-1], 200), [0.0, knots[-1]]))
    first = np.array([float(spline(0.0)), float(spline(0.0, 1)), *np.zeros(drawn.hand.n)])
    system = system_of(name, drawn, True)
    start = time.process_time()
    motion = march(
        system, knots, spline.c[::-1] * widths ** np.arange(4)[:, None], samples, first,
        all_values(drawn),
    )  # fmt: skip
    seconds = time.process_time() - start

    def displacement(t: float) -> tuple[float, float]:
        return float(spline(t)), float(spline(t, 1))

    if name in CLOSED:
        turns = spline.derivative().roots(extrapolate=False)
        times = np.unique(np.concatenate([samples, turns[np.isfinite(turns)]]))
        force = dahl_history(drawn.hand, spline(times))
        written = force[np.searchsorted(times, samples)]
    else:
        oracle = Oracle([drawn.hand], displacement, True, sizes=_sizes(drawn))
        kinks = knots[1:-1]
        if name == "LuGre":  # steps would pass over the short time near rest
            speeds = drawn.hand.speed * np.array([-6, -3, -1, 0, 1, 3, 6])
            slow = [spline.derivative().solve(v, extrapolate=False) for v in speeds]
            places = np.unique(np.concatenate([kinks, *slow]))
            kinks = places[(places > 0.0) & (places < knots[-1])]
        _, written, _ = integrated(oracle, first[2:], 0.0, knots[-1], samples, kinks=kinks.tolist())
    note = f"size {size / drawn.length:.3g} x_c, {np.array(drawn.values)}"
    return Case(_share(written, motion.output), note, seconds)


def motion(name: str, rng: np.random.Generator) -> Case:
    """Check a plant under a sampled drive of five lines, from rest."""
    drawn = draw(name, rng)
    m, c, k, natural = _plant(drawn, rng)
    n, lines = 400, np.arange(1, 6)
    interval = 2.0 * np.pi / natural / between(rng, 20.0, 40.0)
    omega = 2.0 * np.pi * 2 * lines / (n * interval)
    size, phase = drawn.force * between(rng, 0.1, 30.0), rng.uniform(0.0, 2.0 * np.pi, 5)

    def drive(t: float) -> tuple[float, float]:
        return float(np.sum(size / 5.0 * np.cos(omega * t + phase))), 0.0

    times: FloatArray = interval * np.arange(n, dtype=float)
    sampled = np.array([drive(t)[0] for t in times])
    system = system_of(name, drawn, False)
    start = time.process_time()
    values = all_values(drawn, m, c, k)
    coefficients = band_limited(sampled, interval)
    result = march(system, times, coefficients, times, np.zeros(system.order), values)
    seconds = time.process_time() - start
    sizes = _sizes(drawn, size / k, size / k * natural)
    oracle = Oracle([drawn.hand], drive, False, m, c, k, sizes)
    _, written, _ = integrated(oracle, np.zeros(system.order), 0.0, times[-1], times)
    note = f"drive {size / drawn.force:.3g} F, stiffness {k * drawn.length / drawn.force:.3g}, "
    note += f"{np.array(drawn.values)}"
    return Case(_share(written, result.output), note, seconds)


def _share(expected: Any, computed: Any) -> float:
    error = float(np.max(np.abs(expected - computed)))
    return np.inf if np.isnan(error) else error and error / float(np.max(np.abs(expected)))


KINDS: dict[str, Callable[[str, np.random.Generator], Case]] = {
    "settled loop": loop,
    "force history": history,
    "settled motion of a plant": periodic,
    "driven motion": motion,
    "loop of any amplitude": any_amplitude,
}


def table(cases: int, seed: int = SEED) -> tuple[str, list[str]]:
    """Return the page's table, and what was worst."""
    each = -(-cases // (len(KINDS) * len(LAWS)))
    rows = ["| motion | law | cases | refused | median error | 95 % | largest | > 1e-6 | time |"]
    rows.append("|---|---|---|---|---|---|---|---|---|")
    worst = []
    for i, (kind, check) in enumerate(KINDS.items()):
        for j, name in enumerate(LAWS):
            rng = np.random.default_rng([seed, i, j])
            done, refused = [], 0
            if name == "Iwan" and check not in (history, any_amplitude):
                continue  # thirty events in each half cycle take the oracle half a minute
            if check is any_amplitude and name not in BRANCHES:
                continue
            exact = check is any_amplitude or (check is history and name in CLOSED)
            for _ in range(_EXACT * each if exact else each):
                try:
                    done.append(check(name, rng))
                except RuntimeError:  # friction too stiff for an explicit oracle
                    refused += 1
            if not done:
                continue
            errors = np.array([case.error for case in done])
            seconds = float(np.median([case.seconds for case in done]))
            rows.append(
                f"| {kind} | {name} | {errors.size} | {refused} | {np.median(errors):.0e} | "
                f"{np.quantile(errors, 0.95):.0e} | {errors.max():.0e} | "
                f"{np.sum(errors > 1e-6)} | {1e3 * seconds:.1f} ms |"
            )
            print(rows[-1], flush=True)
            last = done[int(np.argmax(errors))]
            worst.append(f"{kind}, {name}: {last.error:.1e}: {last.note}")
    return "\n".join(rows), worst


_PAGE = """# The engine against an independent integrator

Every kind of motion that the engine computes, for every law, against Dormand and Prince's method
of order 8 (scipy's DOP853, relative tolerance 1e-12) with the laws written out again by hand and
events located by scipy. Force histories of Dahl, of
any exponent, with two limits or behind a gap are compared with their closed form from turning point
to turning point instead, and loops of any amplitude, 1e-8 to 1e8 characteristic displacements, with
their closed form and Gauss's quadrature, both in {times} times as many cases. Units of force and
length are random, from 1e-6 to 1e6; other amplitudes are 0.01 to 100 characteristic displacements;
drives are 0.05 to 30 times the friction limit, at 0.2 to 3 times the natural frequency. Errors of
loops and settled motions are those of harmonics 0 to 5, over the largest; those of others are over
the largest value of the motion.

Refused: the friction is too stiff for the explicit reference; such cases are left out, because they
do not test the engine. An error of inf is a motion that the engine did not find. Iwan's
thirty elements are compared along force histories and in loops, as sums in closed form: another
settled motion takes the reference half a minute. `make validation` renews this page; the tests run
a part of it.

{table}
"""


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--write", type=Path)
    arguments = parser.parse_args()
    text, worst = table(arguments.cases, arguments.seed)
    print("\n".join(worst))
    if arguments.write:
        arguments.write.write_text(_PAGE.format(table=text, times=_EXACT), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Records from independent solvers, which a fit has to describe without a start."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import dahl_ident as di
from benchmarks.motion_oracles import (
    BoucWenByHand,
    DahlByHand,
    HandLaw,
    JenkinsByHand,
    Oracle,
    PowerDamperByHand,
    dahl_history,
)
from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, Model
from tests.histories import jenkins_force

Wave = Callable[[float], float]


class Case(NamedTuple):
    """A record, the plant that made it, and the model to be fitted."""

    record: di.Record
    truth: Model
    model: Model


def multisine(
    samples: int, rate: float, low: float, high: float, rms: float, seed: int
) -> tuple[FloatArray, Wave]:
    """Return the samples of one period of a multisine, and its value as a function of time."""
    rng = np.random.default_rng(seed)
    f = np.arange(1, samples // 2) * rate / samples
    f = f[(f >= low) & (f <= high)]
    w, phase, size = 2.0 * np.pi * f, 2.0 * np.pi * rng.random(f.size), rms * np.sqrt(2.0 / f.size)

    def wave(t: float) -> float:
        return float(size * np.sum(np.cos(w * t + phase)))

    return np.array([wave(i / rate) for i in range(samples)]), wave


def simulated(
    law: HandLaw, linear: tuple[float, float, float], drive: Wave, samples: int, rate: float,
    first: float = 0.0, stiff: bool = False,
) -> FloatArray:  # fmt: skip
    """Return displacement, velocity and states of a law with mass, damper and spring, by scipy."""
    plant = Oracle([law], lambda t: (drive(t), 0.0), False, *linear)

    def rates(t: float, y: FloatArray) -> list[float]:
        sides = np.where(plant.functions(t, y, float(np.sign(y[1]))) >= 0.0, 1.0, -1.0)
        return plant.rates(t, y, sides)

    t = np.arange(samples) / rate
    solution = solve_ivp(
        rates, (0.0, t[-1]), [first, *np.zeros(1 + law.n)], "Radau" if stiff else "DOP853",
        t_eval=t, rtol=1e-8, atol=1e-11, max_step=0.5 / rate,
    )  # fmt: skip
    assert solution.success
    return np.asarray(solution.y)


def noisy(x: FloatArray, share: float, seed: int) -> FloatArray:
    """Return a wave with noise, a share of its standard deviation."""
    noise = np.random.default_rng(seed + 1000).standard_normal(x.size)
    return np.asarray(x + share * x.std() * noise)


def driven_case(
    truth: Element, model: Element, linear: tuple[float, float, float], x: FloatArray,
    force: FloatArray, rate: float, seed: int, noise: float = 1e-3,
) -> Case:  # fmt: skip
    """Return the displacement of a driven plant with unknown mass, damping and stiffness."""
    m, c, k = linear
    record = di.Record(np.arange(x.size) / rate, displacement=noisy(x, noise, seed), force=force)
    whole = truth + di.Mass(m) + di.Damper(c) + di.Spring(k)
    return Case(record, whole, model + di.Mass() + di.Damper() + di.Spring())


def driven_dahl(sigma: float, seed: int, n: int = 768) -> Case:
    """Return Dahl friction; for a high sigma, x_c/v is far below the sampling interval."""
    rate, f_max, linear = 100.0, 0.5, (1.0, 1.0, 400.0)
    force, drive = multisine(n, rate, 0.3, 7.7, 3.0, seed)
    x = simulated(DahlByHand(f_max, sigma), linear, drive, n, rate, stiff=sigma > 1000.0)[0]
    return driven_case(di.Dahl(f_max, sigma), di.Dahl(), linear, x, force, rate, seed)


def with_accelerometer(seed: int) -> Case:
    """Return friction with an accelerometer, whose displacement drifts below the drive's band."""
    n, rate, f_max, sigma, linear = 1024, 1000.0, 1.0, 2e4, (0.5, 4.0, 2000.0)
    force, drive = multisine(n, rate, 1.0, 40.0, 3.0, seed)
    x, v, friction = simulated(DahlByHand(f_max, sigma), linear, drive, n, rate)
    m, c, k = linear
    a = noisy((force - c * v - k * x - friction) / m, 1e-3, seed)
    by_displacement = driven_case(di.Dahl(f_max, sigma), di.Dahl(), linear, x, force, rate, seed)
    record = di.Record(by_displacement.record.time, acceleration=a, force=force)
    return by_displacement._replace(record=record)


def backlash(gap: float, seed: int) -> Case:
    """Return the force of Dahl friction behind a gap of `gap` x_c, for a measured displacement."""
    n, f_max, sigma = 2000, 0.1, 30.0
    x_c = f_max / sigma
    rng = np.random.default_rng(seed)
    t = np.arange(n) / n
    lines, phases = np.arange(1, 26), 2.0 * np.pi * rng.random(25)
    x = np.cos(2.0 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
    x *= 8.0 * x_c / np.abs(x).max()
    measured = dahl_history(DahlByHand(f_max, sigma, gap=gap * x_c), x)
    measured = measured + 5e-3 * measured.std() * rng.standard_normal(n)
    record = di.Record(np.arange(n) / 200.0, displacement=x, force=measured)
    return Case(
        record, Model(di.Backlash(di.Dahl(f_max, sigma), gap * x_c)), Model(di.Backlash(di.Dahl()))
    )


LINEAR = (0.3, 0.5, 50.0)


def lugre(seed: int, speed: float = 0.20, noise: float = 1e-3) -> Case:
    """Return a driven plant with LuGre friction, slower and faster than the Stribeck speed.

    `speed` is in m/s rms.
    """
    n, rate = 1024, 100.0
    f_max, sigma, ratio, v_s = 0.1, 30.0, 1.5, 0.05
    force, drive = multisine(n, rate, 0.3, 6.0, 1.0, seed)
    law, scale = DahlByHand(f_max, sigma, static_ratio=ratio, speed=v_s), 1.0

    def scaled(t: float) -> float:
        return scale * drive(t)

    for _ in range(2):  # scale the drive to that speed
        scale *= speed / float(simulated(law, LINEAR, scaled, n, rate)[1].std())
    x = simulated(law, LINEAR, scaled, n, rate)[0]
    truth = di.LuGre(f_max, sigma, ratio, v_s)
    return driven_case(truth, di.LuGre(), LINEAR, x, scale * force, rate, seed, noise)


def maxwell_slip(seed: int) -> Case:
    """Return a driven plant with Jenkins elements of known slips."""
    samples, rate, k, d = 512, 500.0, [200.0, 100.0], [1e-3, 4e-3]
    force, drive = multisine(samples, rate, 2.0, 40.0, 1.0, seed)
    x = simulated(JenkinsByHand(k, d), LINEAR, drive, samples, rate)[0]
    return driven_case(di.MaxwellSlip(d, k), di.MaxwellSlip(d), LINEAR, x, force, rate, seed)


def unknown_slips(seed: int) -> Case:
    """Return the force of three random Jenkins elements under four sines of displacement."""
    rng, count, samples = np.random.default_rng(seed), 3, 1000
    t = np.arange(samples) / 100.0
    f, phase = np.exp(rng.uniform(np.log(0.4), np.log(4.0), 4)), 2.0 * np.pi * rng.random(4)
    x = np.sin(2.0 * np.pi * np.outer(t, f) + phase).sum(axis=1)
    x *= 1e-3 / np.abs(x).max()
    d = np.asarray(3e-5 * np.cumprod(np.exp(rng.uniform(np.log(1.5), np.log(3.0), count))))
    k = 0.1 * rng.dirichlet(np.full(count, 3.0)) / d
    force = noisy(jenkins_force(x, k, d), 5e-3, seed)
    record = di.Record(t, displacement=x, force=force)
    return Case(record, Model(di.MaxwellSlip(d.tolist(), k.tolist())), Model(di.MaxwellSlip(count)))


def iwan_elements(
    f_max: float, sigma: float, chi: float, ratio: float
) -> tuple[FloatArray, FloatArray]:
    """Return stiffnesses and slips of 400 Jenkins elements on Segalman's backbone curve.

    F(x) = sigma x (1 - (x/d)^(chi + 1)/((1 + ratio)(chi + 2))) up to F(d) = f_max.
    """
    loss = 1.0 / ((1.0 + ratio) * (chi + 2.0))
    d = f_max / (sigma * (1.0 - loss))
    x = d * np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 400)])
    slope = np.diff(sigma * x * (1.0 - (x / d) ** (chi + 1.0) * loss)) / np.diff(x)
    return slope - np.append(slope[1:], 0.0), x[1:]


def simulated_elements(
    k: FloatArray, d: FloatArray, first: float, drive: Wave, samples: int, rate: float
) -> FloatArray:
    """Return displacements of m = 0.3, c = 0.5, k = 50 with Jenkins elements, by small steps.

    The elements are exact over a step; the plant is integrated by the velocity Verlet method.
    """
    substeps = 40
    h = 1.0 / rate / substeps
    x, v, f, out = first, 0.0, np.zeros(k.size), np.empty(samples)
    force = drive(0.0)
    for i in range(samples * substeps):
        if i % substeps == 0:
            out[i // substeps] = x
        a = (force - 0.5 * v - 50.0 * x - f.sum()) / 0.3
        move = h * (v + 0.5 * h * a)
        x, f = x + move, np.clip(f + k * move, -k * d, k * d)
        w, force = v + h * a, drive((i + 1) * h)
        v += 0.5 * h * (a + (force - 0.5 * w - 50.0 * x - f.sum()) / 0.3)
    return out


def iwan(seed: int) -> Case:
    """Return a driven plant with Segalman's four-parameter Iwan friction."""
    samples, rate = 384, 500.0
    force, drive = multisine(samples, rate, 2.0, 40.0, 1.0, seed)
    x = simulated_elements(*iwan_elements(0.3, 200.0, -0.5, 0.5), 0.0, drive, samples, rate)
    return driven_case(di.Iwan(0.3, 200.0, -0.5, 0.5), di.Iwan(), LINEAR, x, force, rate, seed)


DECAYS: dict[str, tuple[Element, Element, HandLaw | None]] = {
    "dahl": (di.Dahl(0.1, 300.0), di.Dahl(), DahlByHand(0.1, 300.0)),
    "exponent": (
        di.Dahl(0.1, 300.0, alpha=1.5), di.Dahl(alpha=1.5), DahlByHand(0.1, 300.0, alpha=1.5)
    ),
    "asymmetric": (
        di.Dahl(0.1, 300.0, asymmetry=0.2), di.Dahl(asymmetry=None),
        DahlByHand(0.1, 300.0, asymmetry=0.2),
    ),
    "bouc_wen": (
        di.BoucWen(300.0, 2500.0, 500.0), di.BoucWen(), BoucWenByHand(300.0, 2500.0, 500.0)
    ),
    "lugre": (
        di.LuGre(0.1, 300.0, 1.5, 0.05), di.LuGre(),
        DahlByHand(0.1, 300.0, static_ratio=1.5, speed=0.05),
    ),
    "maxwell_slip": (
        di.MaxwellSlip([3e-4, 2e-3], [200.0, 30.0]), di.MaxwellSlip([3e-4, 2e-3]),
        JenkinsByHand([200.0, 30.0], [3e-4, 2e-3]),
    ),
    "iwan": (di.Iwan(0.1, 200.0, -0.5, 0.5), di.Iwan(), None),  # simulated by many elements
    "power_damper": (di.PowerDamper(0.3, 0.5), di.PowerDamper(), PowerDamperByHand(0.3, 0.5)),
    "backlash": (
        di.Backlash(di.Dahl(0.1, 300.0), 2e-3), di.Backlash(di.Dahl()),
        DahlByHand(0.1, 300.0, gap=2e-3),
    ),
}  # fmt: skip
"""A law, the law to be fitted, and the law by hand."""


def free_decay(name: str, known: str, seed: int, samples: int = 600) -> Case:
    """Return a free decay of m = 0.3, k = 50 from 20 mm; either the mass or the spring is known."""
    rate = 250.0
    truth, model, law = DECAYS[name]
    damping = 0.0 if name == "power_damper" else 0.5

    def drive(_: float) -> float:
        return 0.0

    if law is None:
        x = simulated_elements(*iwan_elements(0.1, 200.0, -0.5, 0.5), 0.02, drive, samples, rate)
    else:
        x = simulated(law, (0.3, damping, 50.0), drive, samples, rate, first=0.02)[0]
    record = di.Record(
        np.arange(samples) / rate, displacement=noisy(x, 1e-3, seed), force=np.zeros(samples)
    )
    if damping:
        truth, model = truth + di.Damper(damping), model + di.Damper()
    mass, spring = (0.3, None) if known == "mass" else (None, 50.0)
    return Case(
        record, truth + di.Mass(0.3) + di.Spring(50.0), model + di.Mass(mass) + di.Spring(spring)
    )

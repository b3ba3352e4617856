"""Records from independent solvers, that a fit has to solve without any start."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import dahl_ident as di
from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, Model

Rates = Callable[[float, FloatArray, float], list[float]]


class Case(NamedTuple):
    """A record, the plant that it is of, and the model that is asked."""

    record: di.Record
    truth: Model
    model: Model


def multisine(
    samples: int, rate: float, low: float, high: float, rms: float, seed: int
) -> tuple[FloatArray, Callable[[float], float]]:
    """Return a whole period of equal lines with random phases, and the wave as a function."""
    rng = np.random.default_rng(seed)
    f = np.arange(1, samples // 2) * rate / samples
    f = f[(f >= low) & (f <= high)]
    w, phase, size = 2.0 * np.pi * f, 2.0 * np.pi * rng.random(f.size), rms * np.sqrt(2.0 / f.size)

    def wave(t: float) -> float:
        return float(size * np.sum(np.cos(w * t + phase)))

    return np.array([wave(i / rate) for i in range(samples)]), wave


def integrated(rates: Rates, first: FloatArray, drive: Callable[[float], float],
               samples: int, rate: float, stiff: bool = False) -> FloatArray:  # fmt: skip
    """Return displacements of a plant by scipy."""
    t = np.arange(samples) / rate
    found = solve_ivp(
        lambda at, y: rates(at, y, drive(at)), (0.0, t[-1]), first,
        "Radau" if stiff else "DOP853",
        t_eval=t, rtol=1e-8, atol=1e-11, max_step=0.5 / rate,
    )  # fmt: skip
    assert found.success
    return np.asarray(found.y)


def noisy(x: FloatArray, share: float, seed: int) -> FloatArray:
    return np.asarray(
        x + share * x.std() * np.random.default_rng(seed + 1000).standard_normal(x.size)
    )


def fast(sigma: float, seed: int, n: int = 768) -> Case:
    """Return friction whose x_c/v is far below the sampling interval where sigma is high."""
    rate, f_max = 100.0, 0.5
    force, drive = multisine(n, rate, 0.3, 7.7, 3.0, seed)

    def rates(t: float, y: FloatArray, u: float) -> list[float]:
        v = y[1]
        return [v, u - v - 400.0 * y[0] - y[2], sigma * v * (1.0 - np.sign(v) * y[2] / f_max)]

    x = integrated(rates, np.zeros(3), drive, n, rate, sigma > 1000.0)[0]
    truth = di.Dahl(f_max, sigma) + di.Mass(1.0) + di.Damper(1.0) + di.Spring(400.0)
    record = di.Record(np.arange(n) / rate, displacement=noisy(x, 1e-3, seed), force=force)
    return Case(record, truth, di.Dahl() + di.Mass() + di.Damper() + di.Spring())


def accelerated(seed: int, n: int = 1024) -> Case:
    """Return friction with an accelerometer, whose displacement drifts below the drive's band."""
    rate, f_max, sigma, m, c, k = 1000.0, 1.0, 2e4, 0.5, 4.0, 2000.0
    force, drive = multisine(n, rate, 1.0, 40.0, 3.0, seed)

    def rates(t: float, y: FloatArray, u: float) -> list[float]:
        v = y[1]
        friction = sigma * v * (1.0 - np.sign(v) * y[2] / f_max)
        return [v, (u - c * v - k * y[0] - y[2]) / m, friction]

    x, v, friction = integrated(rates, np.zeros(3), drive, n, rate)
    a = noisy((force - c * v - k * x - friction) / m, 1e-3, seed)
    truth = di.Dahl(f_max, sigma) + di.Mass(m) + di.Damper(c) + di.Spring(k)
    record = di.Record(np.arange(n) / rate, acceleration=a, force=force)
    return Case(record, truth, di.Dahl() + di.Mass() + di.Damper() + di.Spring())


def play(gap: float, seed: int) -> Case:
    """Return linear Dahl friction behind a gap of so many x_c, its displacement measured."""
    n, f_max, sigma = 2000, 0.1, 30.0
    x_c = f_max / sigma
    rng = np.random.default_rng(seed)
    t = np.arange(n) / n
    lines, phases = np.arange(1, 26), 2.0 * np.pi * rng.random(25)
    x = np.cos(2.0 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
    x *= 8.0 * x_c / np.abs(x).max()
    # by hand: the play's far end touches, and only then the friction moves
    fine = 40
    path = np.interp(np.arange((n - 1) * fine + 1) / fine, np.arange(n), x)
    half, force, slack, F = 0.5 * gap * x_c, np.zeros(path.size), path[0], 0.0
    for i in range(1, path.size):
        F, slack = _play_step(F, slack, path[i] - path[i - 1], half, path[i], f_max, sigma)
        force[i] = F
    measured = force[::fine]
    measured = measured + 5e-3 * measured.std() * rng.standard_normal(n)
    record = di.Record(np.arange(n) / 200.0, displacement=x, force=measured)
    return Case(
        record, Model(di.Backlash(di.Dahl(f_max, sigma), gap * x_c)), Model(di.Backlash(di.Dahl()))
    )


def _play_step(
    F: float, slack: float, step: float, half: float, x: float, f_max: float, sigma: float
) -> tuple[float, float]:
    """Return force and middle of the gap after a step; exact for a monotone step."""
    s = 1.0 if step > 0.0 else -1.0
    left = abs(step)
    if s * F < 0.0:  # unloads in contact, to zero force at most
        # F' = sigma (1 - s F / f_max): s F rises from below to 0 over so much
        needed = f_max / sigma * np.log(1.0 - s * F / f_max)
        if left < needed:
            return _dahl(F, s, left, f_max, sigma), slack + step
        left -= needed
        slack += s * needed
        F = 0.0
    if F == 0.0:  # crosses the gap
        room = s * slack + half - (s * x - left)
        if left <= room:
            return 0.0, slack
        left -= max(room, 0.0)
    return _dahl(F, s, left, f_max, sigma), slack + s * left


def _dahl(F: float, s: float, distance: float, f_max: float, sigma: float) -> float:
    return s * f_max + (F - s * f_max) * float(np.exp(-sigma * distance / f_max))


def lugre(seed: int, speed: float = 0.20, noise: float = 1e-3) -> Case:
    """Return a driven plant with LuGre friction whose speed is on both sides of Stribeck's.

    `speed` is in m/s rms.
    """
    n, rate = 1024, 100.0
    f_max, sigma, ratio, v_s = 0.1, 30.0, 1.5, 0.05
    force, drive = multisine(n, rate, 0.3, 6.0, 1.0, seed)

    def rates(t: float, y: FloatArray, u: float) -> list[float]:
        v = y[1]
        level = f_max * (1.0 + (ratio - 1.0) * np.exp(-((v / v_s) ** 2)))
        return [
            v,
            (u - 0.5 * v - 50.0 * y[0] - y[2]) / 0.3,
            sigma * v - sigma * abs(v) * y[2] / level,
        ]

    def moved(scale: float) -> FloatArray:
        return integrated(rates, np.zeros(3), lambda t: scale * drive(t), n, rate)

    scale = 1.0
    for _ in range(2):  # the drive of that speed
        y = moved(scale)
        scale *= speed / float(y[1].std())
    y = moved(scale)
    truth = di.LuGre(f_max, sigma, ratio, v_s) + di.Mass(0.3) + di.Damper(0.5) + di.Spring(50.0)
    record = di.Record(
        np.arange(n) / rate, displacement=noisy(y[0], noise, seed), force=scale * force
    )
    return Case(record, truth, di.LuGre() + di.Mass() + di.Damper() + di.Spring())


def slips(seed: int, samples: int = 512) -> Case:
    """Return a driven plant with Jenkins elements of known slips."""
    rate, k, d = 500.0, np.array([200.0, 100.0]), np.array([1e-3, 4e-3])
    force, drive = multisine(samples, rate, 2.0, 40.0, 1.0, seed)

    def rates(t: float, y: FloatArray, u: float) -> list[float]:
        v = y[1]
        own = k * v * (np.sign(v) * y[2:] < k * d)
        return [v, (u - 0.5 * v - 50.0 * y[0] - y[2:].sum()) / 0.3, *own]

    x = integrated(rates, np.zeros(4), drive, samples, rate)[0]
    truth = di.MaxwellSlip(d, k) + di.Mass(0.3) + di.Damper(0.5) + di.Spring(50.0)
    record = di.Record(np.arange(samples) / rate, displacement=noisy(x, 1e-3, seed), force=force)
    return Case(record, truth, di.MaxwellSlip(d) + di.Mass() + di.Damper() + di.Spring())


def unknown_slips(seed: int, count: int = 3, samples: int = 1000) -> Case:
    """Return the force of Jenkins elements, drawn at random, under four sines of displacement."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / 100.0
    f, phase = np.exp(rng.uniform(np.log(0.4), np.log(4.0), 4)), 2.0 * np.pi * rng.random(4)
    x = np.sin(2.0 * np.pi * np.outer(t, f) + phase).sum(axis=1)
    x *= 1e-3 / np.abs(x).max()
    d = 3e-5 * np.cumprod(np.exp(rng.uniform(np.log(1.5), np.log(3.0), count)))
    k = 0.1 * rng.dirichlet(np.full(count, 3.0)) / d
    force, springs = np.zeros(samples), np.zeros(count)
    for i, step in enumerate(np.diff(x), 1):
        springs = np.clip(springs + k * step, -k * d, k * d)
        force[i] = springs.sum()
    record = di.Record(t, displacement=x, force=noisy(force, 5e-3, seed))
    return Case(record, Model(di.MaxwellSlip(d.tolist(), k.tolist())), Model(di.MaxwellSlip(count)))


def joint(f_max: float, sigma: float, chi: float, ratio: float) -> tuple[FloatArray, FloatArray]:
    """Return stiffnesses and slips of 400 Jenkins elements on Segalman's backbone curve.

    F(x) = sigma x (1 - (x/d)^(chi + 1)/((1 + ratio)(chi + 2))) up to F(d) = f_max.
    """
    last = 1.0 / ((1.0 + ratio) * (chi + 2.0))
    d = f_max / (sigma * (1.0 - last))
    x = d * np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 400)])
    slope = np.diff(sigma * x * (1.0 - (x / d) ** (chi + 1.0) * last)) / np.diff(x)
    return slope - np.append(slope[1:], 0.0), x[1:]


def sliding(
    k: FloatArray, d: FloatArray, first: float, drive: Callable[[float], float],
    samples: int, rate: float, substeps: int = 40,
) -> FloatArray:  # fmt: skip
    """Return displacements of m = 0.3, c = 0.5, k = 50 with Jenkins elements, by small steps.

    Each element is exact over a step; the plant goes by velocity Verlet.
    """
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


def iwan(seed: int, samples: int = 384) -> Case:
    """Return a driven plant with Segalman's four-parameter Iwan friction."""
    rate = 500.0
    force, drive = multisine(samples, rate, 2.0, 40.0, 1.0, seed)
    x = sliding(*joint(0.3, 200.0, -0.5, 0.5), 0.0, drive, samples, rate)
    record = di.Record(np.arange(samples) / rate, displacement=noisy(x, 1e-3, seed), force=force)
    truth = di.Iwan(0.3, 200.0, -0.5, 0.5) + di.Mass(0.3) + di.Damper(0.5) + di.Spring(50.0)
    return Case(record, truth, di.Iwan() + di.Mass() + di.Damper() + di.Spring())


def _dahl_rate(alpha: float, up: float, down: float) -> Callable[[float, float], float]:
    def rate(v: float, f: float) -> float:
        margin = 1.0 - np.sign(v) * f / (up if v > 0.0 else down)
        return float(300.0 * v * np.sign(margin) * abs(margin) ** alpha)

    return rate


def _bouc_wen_rate(v: float, f: float) -> float:
    return 300.0 * v - 1500.0 * abs(v) * f - 1000.0 * v * abs(f)


def _lugre_rate(v: float, f: float) -> float:
    level = 0.1 * (1.0 + 0.5 * np.exp(-((v / 0.05) ** 2)))
    return float(300.0 * v - 300.0 * abs(v) * f / level)


class Decay(NamedTuple):
    """A law, what is asked of it, and its force as a function or as a rate."""

    truth: Element
    model: Element
    rate: Callable[[float, float], float] | None = None
    elements: tuple[FloatArray, FloatArray] | None = None
    force: Callable[[float], float] | None = None
    gap: float = 0.0


DECAYS: dict[str, Decay] = {
    "dahl": Decay(di.Dahl(0.1, 300.0), di.Dahl(), _dahl_rate(1.0, 0.1, 0.1)),
    "exponent": Decay(
        di.Dahl(0.1, 300.0, alpha=1.5), di.Dahl(alpha=1.5), _dahl_rate(1.5, 0.1, 0.1)
    ),
    "asymmetric": Decay(
        di.Dahl(0.1, 300.0, asymmetry=0.2), di.Dahl(asymmetry=None), _dahl_rate(1.0, 0.12, 0.08)
    ),
    "bouc_wen": Decay(di.BoucWen(300.0, 2500.0, 500.0), di.BoucWen(), _bouc_wen_rate),
    "lugre": Decay(di.LuGre(0.1, 300.0, 1.5, 0.05), di.LuGre(), _lugre_rate),
    "maxwell_slip": Decay(
        di.MaxwellSlip([3e-4, 2e-3], [200.0, 30.0]), di.MaxwellSlip([3e-4, 2e-3]),
        elements=(np.array([200.0, 30.0]), np.array([3e-4, 2e-3])),
    ),
    "iwan": Decay(
        di.Iwan(0.1, 200.0, -0.5, 0.5), di.Iwan(), elements=joint(0.1, 200.0, -0.5, 0.5)
    ),
    "power_damper": Decay(
        di.PowerDamper(0.3, 0.5), di.PowerDamper(),
        force=lambda v: 0.3 * np.sign(v) * abs(v) ** 0.5,
    ),
    "backlash": Decay(
        di.Backlash(di.Dahl(0.1, 300.0), 2e-3), di.Backlash(di.Dahl()),
        _dahl_rate(1.0, 0.1, 0.1), gap=2e-3,
    ),
}  # fmt: skip


def decay(name: str, known: str, seed: int, samples: int = 600) -> Case:
    """Return a free decay of m = 0.3, k = 50 from 20 mm; either the mass or the spring is known."""
    law, rate = DECAYS[name], 250.0
    damping = 0.0 if law.force else 0.5

    def rates(t: float, y: FloatArray, u: float) -> list[float]:
        x, v, f = y[:3].tolist()
        friction = law.force(v) if law.force else f
        found = [v, (-damping * v - 50.0 * x - friction) / 0.3]
        if law.rate is None:
            return [*found, 0.0]
        if not law.gap:
            return [*found, law.rate(v, f)]
        s, play = np.sign(v), float(y[3])
        crossing = s * play < 0.5 * law.gap and not s * f < 0.0
        return [*found, 0.0 if crossing else law.rate(v, f), v if crossing else 0.0]

    if law.elements is None:
        x = integrated(rates, np.array([0.02, 0.0, 0.0, 0.0][: 4 if law.gap else 3]),
                       lambda _: 0.0, samples, rate)[0]  # fmt: skip
    else:
        x = sliding(*law.elements, 0.02, lambda _: 0.0, samples, rate)
    record = di.Record(
        np.arange(samples) / rate, displacement=noisy(x, 1e-3, seed), force=np.zeros(samples)
    )
    truth = law.truth + di.Mass(0.3) + di.Spring(50.0)
    model = law.model
    if not law.force:
        truth, model = truth + di.Damper(0.5), model + di.Damper()
    mass, spring = (0.3, None) if known == "mass" else (None, 50.0)
    return Case(record, Model(truth), Model(model + di.Mass(mass) + di.Spring(spring)))

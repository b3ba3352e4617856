"""Motions of laws and plants by an integrator that is not the engine's: DOP853 between events.

The laws are written out again by hand, in plain Python, with the sides of their switches as
arguments. Between two events the equations are smooth; an event is located by scipy, the side is
changed, and the integration begins again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.integrate import solve_ivp

from dahl_ident.arrays import ComplexArray, FloatArray

RTOL = 1e-12
_REST = 1e-9  # of a switching function's largest value: its side is that of what it becomes
_MOST = 200_000
HARMONICS = tuple(range(6))

Numbers = Sequence[float] | FloatArray


class HandLaw(Protocol):
    """A law by hand: states z, displacement x, velocity v, direction s and sides of switches."""

    n: int
    switches: int

    def rates(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> list[float]:
        """Return the rates of the states."""
        ...

    def force(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> float:
        """Return the force."""
        ...

    def functions(self, x: float, v: float, s: float, z: Numbers) -> list[float]:
        """Return the switching functions."""
        ...


@dataclass
class DahlByHand:
    """Dahl with exponent and two limits; also with a gap, and with the level of LuGre."""

    f_max: float
    sigma: float
    alpha: float = 1.0
    asymmetry: float = 0.0
    gap: float | None = None
    static_ratio: float = 1.0
    speed: float = 1.0
    micro_damping: float = 0.0
    viscous: float = 0.0

    def __post_init__(self) -> None:
        self.n = 1 if self.gap is None else 2
        self.switches = 0 if self.gap is None else 2

    def _slope(self, v: float, s: float, F: float) -> float:
        level = self.f_max * (1.0 + s * self.asymmetry)
        level *= 1.0 + (self.static_ratio - 1.0) * np.exp(-((v / self.speed) ** 2))
        margin = 1.0 - s * F / level
        if self.alpha == 1.0:
            return float(self.sigma * margin)
        return float(self.sigma * np.sign(margin) * abs(margin) ** self.alpha)

    def rates(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> list[float]:
        """Return the rates of the states."""
        slope = self._slope(v, s, z[0])
        if self.gap is None:
            return [slope * v]
        crossing = sides[0] > 0.0 and sides[1] > 0.0
        return [0.0, v] if crossing else [slope * v, 0.0]

    def force(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> float:
        """Return the force."""
        damping = self.micro_damping / self.sigma * self._slope(v, s, z[0]) + self.viscous
        return float(z[0] + damping * v)

    def functions(self, x: float, v: float, s: float, z: Numbers) -> list[float]:
        """Return the switching functions."""
        if self.gap is None:
            return []
        return [0.5 * self.gap - s * z[1], s * z[0]]


@dataclass
class BoucWenByHand:
    """Bouc-Wen: one softening while the force is ahead, another after a turn."""

    sigma: float
    q: float
    p: float
    n: int = 1
    switches: int = 1

    def rates(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> list[float]:
        """Return the rates of the states."""
        ahead = s * z[0]
        softening = self.q if sides[0] > 0.0 else self.p
        return [(self.sigma - softening * ahead) * v]

    def force(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> float:
        """Return the force."""
        return z[0]

    def functions(self, x: float, v: float, s: float, z: Numbers) -> list[float]:
        """Return the switching functions."""
        return [s * z[0]]


@dataclass
class JenkinsByHand:
    """Jenkins elements in parallel."""

    stiffnesses: Numbers
    slips: Numbers

    def __post_init__(self) -> None:
        self.n = self.switches = len(self.slips)

    def rates(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> list[float]:
        """Return the rates of the states."""
        return [k * v if a > 0.0 else 0.0 for k, a in zip(self.stiffnesses, sides, strict=True)]

    def force(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> float:
        """Return the force."""
        return float(np.sum(z))

    def functions(self, x: float, v: float, s: float, z: Numbers) -> list[float]:
        """Return the switching functions."""
        springs = zip(self.stiffnesses, self.slips, z, strict=True)
        return [k * d - s * F for k, d, F in springs]


@dataclass
class PiecewiseByHand:
    """Slopes that change where s F/f_max passes given places; also with a part of the velocity."""

    f_max: float
    places: Sequence[float]
    slopes: Sequence[float]
    n: int = 1

    def __post_init__(self) -> None:
        self.switches = len(self.places)

    def rates(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> list[float]:
        """Return the rates of the states."""
        passed = sum(1 for side in sides if side < 0.0)
        return [self.slopes[passed] * v]

    def force(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> float:
        """Return the force."""
        return z[0]

    def functions(self, x: float, v: float, s: float, z: Numbers) -> list[float]:
        """Return the switching functions."""
        return [place * self.f_max - s * z[0] for place in self.places]


@dataclass
class PowerDamperByHand:
    """A power of the velocity, smooth at zero as the element is."""

    coefficient: float
    exponent: float
    speed: float = 1.0
    n: int = 0
    switches: int = 0

    def rates(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> list[float]:
        """Return the rates of the states."""
        return []

    def force(self, x: float, v: float, s: float, z: Numbers, sides: Numbers) -> float:
        """Return the force."""
        ratio = v / self.speed
        smooth = (ratio * ratio + 1e-12) ** (0.5 * (self.exponent - 1.0))
        return float(self.coefficient * ratio * smooth)

    def functions(self, x: float, v: float, s: float, z: Numbers) -> list[float]:
        """Return the switching functions."""
        return []


def dahl_branch(z: float, path: float, alpha: float) -> float:
    """Return 1 - s F/limit after a path in units of limit/sigma; before the path it is z.

    The law is dF/dx = sigma (1 - s F/limit)^alpha.
    """
    if alpha == 1.0 or z <= 0.0:
        return max(z, 0.0) * float(np.exp(-path))
    change = (alpha - 1.0) * path * z ** (alpha - 1.0)
    return float(z * np.exp(-np.log1p(change) / (alpha - 1.0))) if change > -1.0 else 0.0


def dahl_history(law: DahlByHand, x: FloatArray) -> FloatArray:
    """Return the force at the displacements x, (n,), from rest in the middle of the gap.

    The closed form of a law that does not depend on velocity, for a motion that is monotone from
    each displacement to the next.
    """
    alpha, half_gap = law.alpha, 0.5 * (law.gap or 0.0)
    force, position_in_gap, forces = 0.0, 0.0, [0.0]
    for step in np.diff(x).tolist():
        if step == 0.0:
            forces.append(force)
            continue
        s, path = float(np.sign(step)), abs(step)
        limit = law.f_max * (1.0 + s * law.asymmetry)
        z = 1.0 - s * force / limit
        unloading = 0.0  # path to zero force, where the motion across the gap begins
        if law.gap is not None and z > 1.0:
            u = np.log(z)
            unloading = u if alpha == 1.0 else np.expm1((1.0 - alpha) * u) / (1.0 - alpha)
            unloading *= limit / law.sigma
        if law.gap is not None and s * force <= 0.0 and path >= unloading:
            crossed = min(path - unloading, half_gap - s * position_in_gap)
            position_in_gap += s * crossed
            z, path = 1.0, path - unloading - crossed
        force = s * limit * (1.0 - dahl_branch(z, path * law.sigma / limit, alpha))
        forces.append(force)
    return np.array(forces)


@dataclass
class Oracle:
    """A motion: of laws along x(t), v(t) where `held`, or of a plant under u(t).

    States: those of the laws; in a plant x and v come first.
    """

    laws: Sequence[HandLaw]
    signal: Callable[[float], tuple[float, float]]
    held: bool
    mass: float = 1.0
    damping: float = 0.0
    stiffness: float = 0.0
    sizes: FloatArray | None = None

    def parts(self, t: float, y: FloatArray) -> tuple[float, float, FloatArray]:
        """Return displacement, velocity and the states of the laws."""
        if self.held:
            x, v = self.signal(t)
            return x, v, y
        return y[0], y[1], y[2:]

    def total(self, t: float, y: FloatArray, sides: FloatArray) -> float:
        """Return the force of laws, damper and spring."""
        x, v, z = self.parts(t, y)
        force, i, e = self.damping * v + self.stiffness * x, 0, 1
        for law in self.laws:
            force += law.force(x, v, sides[0], z[i : i + law.n], sides[e : e + law.switches])
            i, e = i + law.n, e + law.switches
        return force

    def output(self, t: float, y: FloatArray, sides: FloatArray) -> float:
        """Return the force along a motion, or the displacement of a plant."""
        return self.total(t, y, sides) if self.held else float(y[0])

    def rates(self, t: float, y: FloatArray, sides: FloatArray) -> list[float]:
        """Return the rates of all states."""
        x, v, z = self.parts(t, y)
        result, i, e = [], 0, 1
        if not self.held:
            result = [v, (self.signal(t)[0] - self.total(t, y, sides)) / self.mass]
        for law in self.laws:
            own = z[i : i + law.n]
            result += law.rates(x, v, sides[0], own, sides[e : e + law.switches])
            i, e = i + law.n, e + law.switches
        return result

    def functions(self, t: float, y: FloatArray, s: float) -> FloatArray:
        """Return the velocity and all switching functions."""
        x, v, z = self.parts(t, y)
        result, i = [v], 0
        for law in self.laws:
            result += law.functions(x, v, s, z[i : i + law.n])
            i += law.n
        return np.array(result)


def integrated(
    oracle: Oracle,
    y: FloatArray,
    start: float,
    end: float,
    samples: FloatArray | None = None,
    omega: float = 0.0,
    harmonics: Sequence[int] = (),
    kinks: Sequence[float] = (),
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Return the last state, output at samples, and integrals of output exp(-j k omega t).

    The signal is smooth between its kinks.
    """
    n, k = y.size, len(harmonics)
    orders = np.array(harmonics, dtype=float)
    whole = np.concatenate([y, np.zeros(2 * k)])
    count = 1 + sum(law.switches for law in oracle.laws)
    sides, largest = np.ones(count), np.zeros(count)
    sizes = np.full(n, 1.0) if oracle.sizes is None else oracle.sizes
    scale = np.concatenate([sizes, np.full(2 * k, (end - start) * np.max(sizes[-1:] if n else 1))])

    def choose(t: float, fixed: int) -> None:
        for e in range(count):
            if e == fixed:
                continue
            g = oracle.functions(t, whole[:n], sides[0])
            np.maximum(largest, np.abs(g), out=largest)
            if abs(g[e]) > _REST * largest[e]:
                sides[e] = np.sign(g[e])
                continue
            dt = 1e-5 * (end - start)
            ahead = whole[:n] + dt * np.array(oracle.rates(t, whole[:n], sides))
            ahead = ahead + dt * np.array(oracle.rates(t + dt, ahead, sides))
            later = oracle.functions(t + dt, ahead, sides[0])[e]
            if abs(later - g[e]) > 1e-12 * largest[e]:
                sides[e] = np.sign(later - g[e])

    evaluations = 0

    def rates(t: float, w: FloatArray) -> Any:
        nonlocal evaluations
        evaluations += 1
        if evaluations > _MOST:
            raise RuntimeError("the oracle needs too many steps")
        result = np.array(oracle.rates(t, w[:n], sides))
        if k:
            turn = oracle.output(t, w[:n], sides) * np.exp(-1j * orders * omega * t)
            result = np.concatenate([result, turn.real, turn.imag])
        return result

    def event_of(e: int) -> Callable[[float, FloatArray], float]:
        def event(t: float, w: FloatArray) -> float:
            shift = 1e-14 * (largest[e] or 1.0) * sides[e]  # what stays at zero is not an event
            return float(oracle.functions(t, w[:n], sides[0])[e] + shift)

        event.terminal = True  # type: ignore[attr-defined]  # solve_ivp reads it
        return event

    parts = 60 if omega else 20 * (len(kinks) + 1) if kinks else 2000
    longest = (2.0 * np.pi / omega if omega else end - start) / parts
    t, written = start, np.empty(0 if samples is None else samples.size)
    done = 0
    stops = [*kinks, end]
    choose(t, -1)
    for _ in range(4000):
        events = [event_of(e) for e in range(count)]
        for e, event in enumerate(events):
            event.direction = -sides[e]  # type: ignore[attr-defined]  # as above
        found = solve_ivp(
            rates, (t, stops[0]), whole, method="DOP853", rtol=RTOL, atol=1e-14 * scale,
            events=events, dense_output=samples is not None, max_step=longest,
        )  # fmt: skip
        if not found.success:
            raise RuntimeError(found.message)
        late = float(found.t[-1])
        while samples is not None and done < samples.size and samples[done] <= late:
            assert found.sol is not None
            state = found.sol(samples[done])[:n]
            written[done] = oracle.output(samples[done], state, sides)
            done += 1
        t, whole = late, found.y[:, -1].copy()
        if t >= stops[0]:
            stops.pop(0)
            if not stops:
                break
            continue
        assert found.t_events is not None
        which = next(e for e, times in enumerate(found.t_events) if times.size)
        sides[which] *= -1.0
        if which == 0 and not oracle.held:
            whole[1] = 0.0
        choose(t, which)
    else:
        raise RuntimeError("more than 4000 events")
    while samples is not None and done < samples.size:
        written[done] = oracle.output(samples[done], whole[:n], sides)
        done += 1
    return whole[:n], written, whole[n : n + k] + 1j * whole[n + k :]


def fixed_point(
    oracle: Oracle,
    guess: FloatArray,
    slopes: FloatArray,
    omega: float,
    odd: bool,
    harmonics: Sequence[int] = HARMONICS,
) -> tuple[FloatArray, ComplexArray, float]:
    """Return first states and harmonics of the settled motion, and how well it closes.

    From a guess, by Newton's method with given derivatives of the map; these decide how fast it
    is found, not what.
    """
    sign = -1.0 if odd else 1.0
    period = 2.0 * np.pi / omega
    end = 0.5 * period if odd else period
    y = guess.copy()
    sizes = np.ones(y.size) if oracle.sizes is None else oracle.sizes
    closed = 0.0
    for _ in range(8):
        last, _, sums = integrated(oracle, y, 0.0, end, None, omega, harmonics)
        gap = sign * last - y
        closed = float(np.max(np.abs(gap) / sizes)) if y.size else 0.0
        if closed < 3e-13:
            break
        y = y + np.linalg.solve(np.eye(y.size) - sign * slopes, gap)
    factor = np.where(np.array(harmonics) == 0, 1.0, 2.0) / period
    if odd:
        factor = factor * 2.0 * (np.array(harmonics) % 2)
    return y, factor * sums, closed

"""Motions in time that a plan can choose from: trapezoidal trajectories and multisines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, FloatArray, non_negative_array, positive_number
from dahl_ident.errors import ValidationError

KINDS = ("trapezoid", "multisine")
SAMPLES_PER_CYCLE = 10  # fewest samples in the fastest part of a waveform
UNITS = {
    "stroke": "m",
    "speed": "m/s",
    "acceleration": "m/s^2",
    "dwell": "s",
    "lowest_hz": "Hz",
    "highest_hz": "Hz",
    "peak": "m",
    "rms": "m",
    "period": "s",
    "frequency_hz": "Hz",
    "seconds": "s",
}
_FINE = 64  # points for each spectral line: a multisine's peak then errs by less than 0.1 %


@dataclass(frozen=True)
class Trapezoid:
    """A stroke forwards and back about zero, with trapezoidal velocity and dwells at the ends.

    Attributes
    ----------
    stroke : float
        Displacement from end to end, m.
    speed, acceleration : float
        Largest values, m/s and m/s^2.
    dwell : float, default 0
        Seconds at each end.

    Examples
    --------
    >>> motion = Trapezoid(stroke=0.01, speed=0.02, acceleration=0.1)
    >>> round(motion.period, 9), motion.displacement(np.array([0.0, 0.7])).round(6).tolist()
    (1.4, [-0.005, 0.005])
    """

    kind: ClassVar[str] = "trapezoid"
    stroke: float
    speed: float
    acceleration: float
    dwell: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stroke", "speed", "acceleration"):
            positive_number(getattr(self, name), f"{name} of a trapezoid")
        non_negative_array(self.dwell, "dwell of a trapezoid")

    @property
    def parameters(self) -> Mapping[str, float]:
        """The parameters of the motion, SI."""
        return dict(vars(self))

    @property
    def _top_speed(self) -> float:
        """The speed that is reached, m/s."""
        return min(self.speed, float(np.sqrt(self.acceleration * self.stroke)))

    @property
    def _move_time(self) -> float:
        """Seconds from end to end."""
        return self.stroke / self._top_speed + self._top_speed / self.acceleration

    @property
    def period(self) -> float:
        """Seconds."""
        return 2.0 * (self._move_time + self.dwell)

    @property
    def fastest_hz(self) -> float:
        """One over the time from end to end."""
        return 1.0 / self._move_time

    @property
    def peaks(self) -> tuple[float, float, float]:
        """Largest displacement, speed and acceleration."""
        return 0.5 * self.stroke, self._top_speed, self.acceleration

    def displacement(self, time: FloatArray) -> FloatArray:
        """Return the displacement, m; it begins at the negative end."""
        t = np.mod(time, self.period)
        back = t >= 0.5 * self.period
        s = np.clip(np.where(back, t - 0.5 * self.period, t), 0.0, self._move_time)
        v, a = self._top_speed, self.acceleration
        rise, left = np.minimum(s, v / a), np.minimum(self._move_time - s, v / a)
        x = 0.5 * a * rise**2 + v * np.clip(s - v / a, 0.0, self._move_time - 2.0 * v / a)
        x = x + 0.5 * a * ((v / a) ** 2 - left**2)
        return np.asarray((x - 0.5 * self.stroke) * np.where(back, -1.0, 1.0))


@dataclass(frozen=True)
class Multisine:
    """Sines of equal amplitude and Schroeder's phases, at all multiples of the lowest frequency.

    It starts at its largest displacement, at rest. Source of the phases: Schroeder, *IEEE Trans.
    Inf. Theory* 16, 85 (1970).

    Attributes
    ----------
    lowest_hz, highest_hz : float
        Band, Hz; the period is one over the lowest.
    peak : float
        Largest displacement, m.

    Examples
    --------
    >>> motion = Multisine(lowest_hz=0.5, highest_hz=5.0, peak=1e-3)
    >>> motion.period, motion.displacement(np.array([0.0, 2.0])).round(9).tolist()
    (2.0, [0.001, 0.001])
    """

    kind: ClassVar[str] = "multisine"
    lowest_hz: float
    highest_hz: float
    peak: float

    def __post_init__(self) -> None:
        for name in ("lowest_hz", "highest_hz", "peak"):
            positive_number(getattr(self, name), f"{name} of a multisine")
        if self.highest_hz < self.lowest_hz:
            raise ValidationError(
                f"a multisine's band is {self.lowest_hz:g} to {self.highest_hz:g} Hz; expected "
                "rising frequencies"
            )

    @property
    def period(self) -> float:
        """Seconds."""
        return 1.0 / self.lowest_hz

    @property
    def fastest_hz(self) -> float:
        """The highest frequency."""
        return self.highest_hz

    @property
    def parameters(self) -> Mapping[str, float]:
        """Band, peak and rms."""
        w, _, _, gain = self._shape()
        return {**vars(self), "rms": abs(gain) * float(np.sqrt(0.5 * w.size))}

    def _shape(self) -> tuple[FloatArray, FloatArray, float, float]:
        """Return angular frequencies and phases, where the period starts, and the amplitude."""
        k = np.arange(1.0, np.floor(self.highest_hz / self.lowest_hz + 1e-9) + 1.0)
        phase = -np.pi * k * (k - 1) / k.size
        w = 2.0 * np.pi * self.lowest_hz * k
        fine = self._fine(k.size)
        start = float(fine[np.argmax(np.abs(np.cos(np.outer(fine, w) + phase).sum(axis=-1)))])
        for _ in range(8):  # Newton's method, to zero velocity
            angle = w * start + phase
            start -= float((w * np.sin(angle)).sum() / (w**2 * np.cos(angle)).sum())
        top = float(np.cos(w * start + phase).sum())
        return w, phase, start, self.peak / top

    def _fine(self, lines: int) -> FloatArray:
        return np.arange(_FINE * lines) * self.period / (_FINE * lines)

    def displacement(self, time: FloatArray) -> FloatArray:
        """Return the displacement, m; it begins at the peak."""
        w, phase, start, gain = self._shape()
        return np.asarray(gain * np.cos(np.multiply.outer(time + start, w) + phase).sum(axis=-1))

    @property
    def peaks(self) -> tuple[float, float, float]:
        """Largest displacement, speed and acceleration."""
        w, phase, _, gain = self._shape()
        angle = np.multiply.outer(self._fine(w.size), w) + phase
        speed = abs(gain) * float(np.abs((w * np.sin(angle)).sum(axis=-1)).max())
        acceleration = abs(gain) * float(np.abs((w**2 * np.cos(angle)).sum(axis=-1)).max())
        return self.peak, speed, acceleration


PlannedMotion = Trapezoid | Multisine
"""One period of a motion, which begins and ends at rest at the same place."""


def seconds_of_move(distance: float, speed: float, acceleration: float) -> float:
    """Return the least time of a move along a quintic, from rest to rest, within these limits."""
    v, a = 15.0 / 8.0, 10.0 / np.sqrt(3.0)  # its peaks for 1 m in 1 s
    return max(v * distance / speed, float(np.sqrt(a * distance / acceleration)))


def course(
    motions: Sequence[PlannedMotion], repeats: Sequence[int], change_over: float, time: FloatArray
) -> tuple[FloatArray, NDArray[np.int64], BoolArray]:
    """Return displacement, number of the motion, and whether it is measured, at any times.

    The exciter begins at zero and moves from motion to motion along a quintic, from rest to rest,
    in `change_over` seconds.
    """
    value, measured = np.zeros(time.size), np.zeros(time.size, dtype=np.bool_)
    number = np.full(time.size, len(motions), dtype=np.int64)
    start = position = 0.0
    for i, (motion, count) in enumerate(zip(motions, repeats, strict=True)):
        first = float(motion.displacement(np.zeros(1))[0])
        begin = start + change_over
        stop = begin + count * motion.period
        moving = (time >= start) & (time < begin)
        tau = (time[moving] - start) / change_over if change_over > 0.0 else time[moving]
        value[moving] = position + (first - position) * tau**3 * (10.0 - tau * (15.0 - 6.0 * tau))
        inside = (time >= begin - 1e-9) & (time < stop - 1e-9)
        value[inside] = motion.displacement(time[inside] - begin)
        number[(time >= start) & (time < stop)] = i + 1
        measured |= inside
        start, position = stop, first
    value[time >= start - 1e-9] = position
    return value, number, measured

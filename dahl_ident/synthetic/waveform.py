"""Smooth excitation waveforms: sines whose amplitude and frequency change from step to step.

A waveform is a sequence of segments a(t) sin(phi(t)) with continuous phase, so that value,
velocity and acceleration are known in closed form at every instant. Amplitude and frequency change
along the quintic 10 tau^3 - 15 tau^4 + 6 tau^5, whose first two derivatives are zero at both ends:
the acceleration has no jumps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray

Course = Literal["smooth", "linear", "log"]
_GRID_PER_PERIOD, _BISECTIONS = 64, 44  # for turning points


class WaveValues(NamedTuple):
    """Value of a waveform, and its first and second derivative with respect to time."""

    value: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class Window(NamedTuple):
    """The time of the whole periods of one step that are to be measured."""

    level: float
    frequency_hz: float
    start: float
    stop: float


@dataclass(frozen=True)
class SineStep:
    """a(t) sin(phi(t)) from `start` for `duration` s; amplitude and frequency follow a `course`."""

    start: float
    duration: float
    amplitude: tuple[float, float]
    frequency_hz: tuple[float, float]
    phase: float
    course: Course = "smooth"

    @property
    def stop(self) -> float:
        """End of the segment, s."""
        return self.start + self.duration

    def motion(self, time: FloatArray) -> WaveValues:
        """Return the waveform and its derivatives at times within the segment."""
        T = self.duration
        tau = (time - self.start) / T
        a, a1, a2 = _between(*self.amplitude, self.course, tau)
        f, f1, _ = _between(*self.frequency_hz, self.course, tau)
        w, w1 = 2.0 * np.pi * f, 2.0 * np.pi * f1 / T
        phase = self.phase_at(tau)
        sin, cos = np.sin(phase), np.cos(phase)
        return WaveValues(
            a * sin,
            a1 / T * sin + a * w * cos,
            (a2 / T**2 - a * w**2) * sin + (2.0 * a1 / T * w + a * w1) * cos,
        )

    def phase_at(self, tau: FloatArray) -> FloatArray:
        """Return the phase, rad, at tau from 0 (start) to 1 (stop)."""
        cycles = self.duration * _integral(*self.frequency_hz, self.course, tau)
        return np.asarray(self.phase + 2.0 * np.pi * cycles)


@dataclass(frozen=True)
class Waveform:
    """Consecutive segments without gaps, and the windows to be measured."""

    segments: tuple[SineStep, ...]
    windows: tuple[Window, ...] = ()

    @property
    def duration(self) -> float:
        """End of the last segment, s; the first starts at 0."""
        return self.segments[-1].stop

    @property
    def highest_frequency_hz(self) -> float:
        """Highest instantaneous frequency, Hz."""
        return max(max(s.frequency_hz) for s in self.segments)

    def motion(self, time: FloatArray) -> WaveValues:
        """Return value and derivatives at any times; the value is constant outside the segments."""
        parts = np.zeros((3, *np.shape(time)))
        for i, inside, t in self.by_segment(time):
            parts[:, inside] = self.segments[i].motion(t)
        outside = (np.asarray(time) < 0.0) | (np.asarray(time) > self.duration)
        parts[1:, outside] = 0.0
        return WaveValues(*parts)

    def by_segment(self, time: FloatArray) -> Iterator[tuple[int, BoolArray, FloatArray]]:
        """Yield the number of each segment, a mask of the times in it, and these times."""
        t = np.clip(np.asarray(time), 0.0, self.duration)
        starts = np.array([s.start for s in self.segments])
        segment = np.searchsorted(starts, t, side="right") - 1
        for i in np.unique(segment).tolist():
            yield i, segment == i, t[segment == i]

    def value(self, time: FloatArray) -> FloatArray:
        """Return the waveform at any times."""
        return self.motion(time).value

    def turning_times(self) -> FloatArray:
        """Return the instants between which the motion is monotone, from 0 to the end, s."""
        turns = [_turning_times(segment) for segment in self.segments]
        ends = [segment.stop for segment in self.segments]
        return np.unique(np.concatenate([[0.0], ends, *turns]))


class WaveformBuilder:
    """Appends segments that continue the phase, amplitude and frequency of the last one."""

    def __init__(self, frequency_hz: float) -> None:
        self._segments: list[SineStep] = []
        self._windows: list[Window] = []
        self._time = self._phase = self._amplitude = 0.0
        self._frequency = frequency_hz

    def go_to(
        self, amplitude: float, frequency_hz: float, duration: float, course: Course = "smooth"
    ) -> None:
        """Change amplitude and frequency within `duration`; at once if that is 0."""
        if duration > 0.0:
            amplitudes, frequencies = (self._amplitude, amplitude), (self._frequency, frequency_hz)
            segment = SineStep(self._time, duration, amplitudes, frequencies, self._phase, course)
            self._segments.append(segment)
            self._time = segment.stop
            self._phase = float(segment.phase_at(np.asarray(1.0))) if amplitude > 0.0 else 0.0
        self._amplitude, self._frequency = amplitude, frequency_hz

    def stay(self, duration: float) -> None:
        """Hold amplitude and frequency."""
        self.go_to(self._amplitude, self._frequency, duration)

    def measure(self, duration: float) -> None:
        """Hold amplitude and frequency, and mark the time as measured."""
        start = self._time
        self.stay(duration)
        self._windows.append(Window(self._amplitude, self._frequency, start, self._time))

    def finish(self) -> Waveform:
        """Return the waveform built so far."""
        return Waveform(tuple(self._segments), tuple(self._windows))


def _between(
    q0: float, q1: float, course: Course, tau: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the course from q0 to q1, and its first two derivatives with respect to tau."""
    step = q1 - q0
    if course == "linear" or step == 0.0:
        return q0 + step * tau, np.full_like(tau, step), np.zeros_like(tau)
    if course == "log":
        rate = np.log(q1 / q0)
        q = q0 * np.exp(rate * tau)
        return q, rate * q, rate**2 * q
    return (
        q0 + step * tau**3 * (10.0 - tau * (15.0 - 6.0 * tau)),
        step * 30.0 * (tau * (1.0 - tau)) ** 2,
        step * 60.0 * tau * (1.0 - tau) * (1.0 - 2.0 * tau),
    )


def _integral(q0: float, q1: float, course: Course, tau: FloatArray) -> FloatArray:
    """Return the integral from 0 to tau of the course from q0 to q1."""
    step = q1 - q0
    if step == 0.0:
        return q0 * tau
    if course == "linear":
        return tau * (q0 + 0.5 * step * tau)
    if course == "log":
        rate = np.log(q1 / q0)
        return np.asarray(q0 * np.expm1(rate * tau) / rate)
    return q0 * tau + step * tau**4 * (2.5 - tau * (3.0 - tau))


def _turning_times(segment: SineStep) -> FloatArray:
    """Return the times at which the velocity changes sign: bracketed on a grid, then bisected."""
    cells = int(np.ceil(segment.duration * max(segment.frequency_hz) * _GRID_PER_PERIOD)) + 1
    grid = np.linspace(segment.start, segment.stop, cells + 1)
    sign = np.sign(segment.motion(grid).velocity)
    turns = np.flatnonzero(sign[1:] * sign[:-1] < 0.0)
    exact = grid[1:-1][(sign[1:-1] == 0.0) & (sign[:-2] * sign[2:] < 0.0)]
    low, high, before = grid[turns], grid[turns + 1], sign[turns]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = np.sign(segment.motion(middle).velocity) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.sort(np.concatenate([0.5 * (low + high), exact]))

"""Spans: the segments of a record that hold one amplitude and one frequency, or a sweep.

Cycle by cycle a piece grows while amplitude and frequency stay what they were on average, to
within a tolerance that the noise may widen. A piece that is long enough and has no trend is a
plateau, and becomes a point; the others are ramps, and are left out. Where there is more ramp
than plateau the record is a sweep; it is cut into windows short enough that amplitude and
frequency change little in each.

A drive such as a crank may be steady for no two cycles. Where plateaus hold less than half of
cycles that neither sweep nor ramp, these are grouped with a wider tolerance, and halved as long as
they have a trend: points with an amplitude of their own, whose scatter is part of the covariance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.cycles import Cycles

Mode = Literal["auto", "steps", "sweep"]
MODES: tuple[Mode, ...] = ("auto", "steps", "sweep")
AMPLITUDE_TOLERANCE = 0.02  # of a logarithm, within a plateau: steps of level are larger
FREQUENCY_TOLERANCE = 0.01  # the same
_UNSTEADY = 5.0  # times wider tolerances, of groups of cycles that a drive varies
_NOISE_FACTOR = 6.0  # standard deviations of a cycle: noise alone splits no plateau
_WIDEST = 0.3  # tolerance that noise makes
_LEAST_NOISE = 1e-12  # of a log amplitude: inverse squares, as weights, stay finite
_NOISIEST = 0.2  # noise of a cycle's log amplitude above which it is not a cycle
_EDGE_TOLERANCE = 0.005  # of the amplitude: cycles at the ends of a plateau that stray more go
_MOSTLY_HELD = 0.5  # plateaus over cycles that change smoothly: with less it is a sweep
_CLEARLY_MORE = 1.5  # times the cycles of plateaus that groups have to hold to replace them
_SLOW = 0.005  # change of log amplitude in a cycle that friction follows without a lag
_SCATTERED = 4.0  # standard deviations about a straight line within which a trend is scatter
_SWEEP_RANGE = 0.2  # change of log amplitude or frequency that makes a sweep
_SWEEP_STEP = 0.2  # change of log amplitude or frequency in a cycle that a sweep may make
_SWEEP_CHANGE = 0.1  # in a window
_SWEEP_CYCLES = (4, 20)  # in a window


@dataclass(frozen=True)
class Span:
    """Start and stop in s, and the frequency in the middle, Hz.

    `earliest` and `latest` are where the spans next to it end and begin.
    """

    start: float
    stop: float
    frequency_hz: float
    sweep: bool = False
    earliest: float = -np.inf
    latest: float = np.inf


@dataclass(frozen=True)
class _Piece:
    """Cycles first to last (not included) of one run of cycles."""

    cycles: Cycles
    first: int
    last: int

    def __len__(self) -> int:
        return self.last - self.first

    @property
    def log_amplitude(self) -> FloatArray:
        return self.cycles.log_amplitude[self.first : self.last]

    @property
    def log_frequency(self) -> FloatArray:
        return self.cycles.log_frequency[self.first : self.last - 1]

    @property
    def noise(self) -> float:
        return float(np.median(self.cycles.noise[self.first : self.last]))

    @property
    def trending(self) -> bool:
        """Whether amplitude or frequency changes from end to end by more than the tolerance."""
        amplitude, frequency = _tolerances(self.noise)
        return (
            abs(_change(self.log_amplitude)) > amplitude
            or abs(_change(self.log_frequency)) > frequency
        )

    @property
    def ramping(self) -> bool:
        """Whether the amplitude goes one way, faster than friction follows."""
        a, n = self.log_amplitude, len(self)
        change = abs(_change(a))
        line = np.polyfit(np.arange(n), a, 1)
        scatter = float(np.std(a - np.polyval(line, np.arange(n)), ddof=min(2, n - 1)))
        return self.trending and change > max(_SLOW * n, _SCATTERED * scatter)

    def halves(self) -> tuple[_Piece, _Piece]:
        middle = (self.first + self.last) // 2
        return _Piece(self.cycles, self.first, middle), _Piece(self.cycles, middle, self.last)

    def span(self, *, sweep: bool = False) -> Span:
        frequency = self.log_frequency
        start, stop = self.cycles.start[self.first], self.cycles.stop[self.last - 1]
        return Span(float(start), float(stop), float(np.exp(np.mean(frequency))), sweep)


def find_spans(runs: Sequence[Cycles], mode: Mode, fewest: int, window: int | None) -> list[Span]:
    """Return the spans of runs of consecutive cycles, in order of time.

    Plateaus of `fewest` cycles at least, windows of sweeps, or whichever there is more of. A
    `window` has that many cycles, or else as many as change little.
    """
    pieces = [piece for cycles in runs for piece in _pieces(cycles) if len(piece) >= fewest]
    plateaus = [piece for piece in pieces if not piece.trending]
    sweeps = [sweep for cycles in runs for sweep in _sweeps(cycles)]
    held, swept = sum(map(len, plateaus)), sum(map(len, sweeps))
    if mode == "steps" or (mode == "auto" and held >= _MOSTLY_HELD * swept):
        moving = sum(int(np.sum(cycles.noise < _NOISIEST)) for cycles in runs)
        if held < _MOSTLY_HELD * moving:
            groups = [group for cycles in runs for group in _groups(cycles, fewest)]
            if sum(map(len, groups)) > _CLEARLY_MORE * held:
                plateaus = groups
        return [_trimmed(p, fewest).span() for p in plateaus]
    return [span for sweep in sweeps for span in _windows(sweep, window)]


def _tolerances(noise: float) -> tuple[float, float]:
    """Return how much log amplitude and log frequency may vary within a plateau."""
    widened = min(_NOISE_FACTOR * noise, _WIDEST)
    return max(AMPLITUDE_TOLERANCE, widened), max(FREQUENCY_TOLERANCE, widened / np.pi)


def _change(values: FloatArray) -> float:
    """Return the change from end to end of the straight line through the values."""
    if values.size < 2:
        return 0.0
    place = np.linspace(-0.5, 0.5, values.size)
    return float(place @ values / (place @ place))


def _pieces(cycles: Cycles, unsteady: float = 1.0) -> Iterator[_Piece]:
    """Grow pieces cycle by cycle against the mean of what they have."""
    amplitude, frequency = cycles.log_amplitude.tolist(), cycles.log_frequency.tolist()
    noise = np.clip(cycles.noise, _LEAST_NOISE, 1.0).tolist()
    first, a_sum, f_sum, inverse = 0, 0.0, 0.0, 0.0
    for j in range(len(cycles)):
        held = j - first
        if held:
            usual = min(noise[j], held / inverse)  # a transition is noisier than its neighbours
            a_tolerance, f_tolerance = _tolerances(usual)
            f_mean = f_sum / (held - 1) if held > 1 else frequency[j - 1]
            if (
                max(noise[j], noise[first]) < _NOISIEST
                and abs(amplitude[j] - a_sum / held) <= unsteady * a_tolerance
                and abs(frequency[j - 1] - f_mean) <= unsteady * f_tolerance
            ):
                f_sum += frequency[j - 1]
            else:
                yield _Piece(cycles, first, j)
                first, a_sum, f_sum, inverse = j, 0.0, 0.0, 0.0
        a_sum += amplitude[j]
        inverse += 1.0 / noise[j]
    if len(cycles):
        yield _Piece(cycles, first, len(cycles))


def _groups(cycles: Cycles, fewest: int) -> Iterator[_Piece]:
    """Group the cycles of a drive that is not steady; ramps are none of them."""
    waiting = [p for p in _pieces(cycles, _UNSTEADY) if len(p) >= fewest]
    while waiting:
        piece = waiting.pop(0)
        if piece.trending and len(piece) >= 2 * fewest:
            waiting[:0] = piece.halves()
        elif not piece.ramping:
            yield piece


def _trimmed(piece: _Piece, fewest: int) -> _Piece:
    """Leave out cycles at the ends that stray from the plateau's level, the rest of a ramp."""
    a = piece.log_amplitude
    level = float(np.median(a))
    scatter = 1.5 * float(np.median(np.abs(a - level)))
    within = np.abs(a - level) <= max(_EDGE_TOLERANCE, _NOISE_FACTOR * max(piece.noise, scatter))
    kept = np.flatnonzero(within)
    if kept.size == 0 or kept[-1] + 1 - kept[0] < fewest:
        return piece
    return _Piece(piece.cycles, piece.first + int(kept[0]), piece.first + int(kept[-1]) + 1)


def _sweeps(cycles: Cycles) -> Iterator[_Piece]:
    """Return the parts of a run in which nothing jumps, yet something changes much."""
    if len(cycles) < 2:
        return
    jump = np.abs(np.diff(cycles.log_amplitude)) > _SWEEP_STEP
    jump[1:] |= np.abs(np.diff(cycles.log_frequency)) > _SWEEP_STEP
    jump |= np.maximum(cycles.noise[1:], cycles.noise[:-1]) > _NOISIEST
    bounds = np.concatenate([[0], np.flatnonzero(jump) + 1, [len(cycles)]])
    for first, last in pairwise(bounds.tolist()):
        sweep = _Piece(cycles, first, last)
        ranges = [np.ptp(v) for v in (sweep.log_amplitude, sweep.log_frequency) if v.size]
        if len(sweep) >= _SWEEP_CYCLES[0] and max(ranges) > _SWEEP_RANGE:
            yield sweep


def _windows(sweep: _Piece, window: int | None) -> Iterator[Span]:
    """Cut a sweep into windows in which amplitude and frequency change little."""
    least, most = _SWEEP_CYCLES
    first = sweep.first
    while sweep.last - first >= (window or least):
        ahead = _Piece(sweep.cycles, first, min(first + most, sweep.last))
        change = max(abs(_change(ahead.log_amplitude)), abs(_change(ahead.log_frequency)))
        fitting = int(len(ahead) * min(1.0, _SWEEP_CHANGE / max(change, 1e-12)))
        size = window or max(least, fitting)
        yield _Piece(sweep.cycles, first, first + size).span(sweep=True)
        first += size

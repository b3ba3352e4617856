"""Segments: the samples of a record's spans, with their phase.

The frequency of each span is estimated, and adjacent cycles that fit the same sine are added. At
the start or end of a ramp, cycles deviate by a percent. The limit follows from the m cycles inside
the span: the part Q_i of each cycle's residual that is a fundamental scatters with the noise, and
with h the relative error of the sine

    s^2 = sum_i Q_i / (2 m - 4),      F = Q / (2 (1 + h) s^2)

follows F(2, 2 m - 4) for a cycle of the same sine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.errors import ExtractionError, Placeholder, argument
from dahl_ident.extraction.cycles import (
    Cycles,
    Mode,
    Span,
    find_cycles,
    find_spans,
    sine_in_each,
)
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    Segment,
    estimate_frequency,
    steady_segment,
    track_phase,
)

_PLATEAU_CYCLES = 3  # least cycles of a plateau; if no plateau has so many, fewer are allowed ...
_NO_CHANCE = 0.1  # ... if they are this fraction of all cycles, as two may be alike by chance
_QUIET_CROSSINGS = 0.01  # noise of a cycle's log amplitude up to which crossings are reliable
_WELL_COVERED = 0.5  # fraction of a record in plateaus above which crossings are trusted
_SWEEP_DEGREE = 3  # degree of the polynomial of the phase in a window
_DRIFTED = 0.2  # rad over a segment; it reduces the amplitude by 0.2 %, harmonics by more
_EVENLY = 0.5  # largest difference of the drifts in both halves, as a fraction of their sum
_FEWEST_IN_HALF = 2  # cycles in each half, which show a slope
_BY_CHANCE = 1e-6  # fraction of segments without a drift in which one is detected
_PADDED = 16  # spectral lines for each cycle, so that one lies near any peak
_SAMPLES_PER_CYCLE = 4  # samples in a cycle, one more than sine and offset have parameters
_STRAY_BY_CHANCE = 1e-3  # fraction of the cycles of a sine that are called stray
_LEAST_DRIFT = 1e-4  # fraction of the amplitude that a cycle may stray in any case
_END_CYCLES = 2  # cycles at either end that are not part of the reference ...
_CYCLES_PER_END_CYCLE = 5  # ... but at most one in this many of all
_STRAYING = 0.005  # fraction of the amplitude that a further cycle may stray from the sine
_MOST_CYCLES_MORE = 2  # cycles by which a segment may grow on either side
_MOST_CYCLES_LESS = 3  # cycles by which it may shrink on either side; more means slow change


def record_spans(
    time: FloatArray,
    motion: FloatArray,
    runs: Sequence[Cycles],
    frequency: float | None,
    mode: Mode,
    window: int | None,
) -> list[Span]:
    """Return the spans of a record in order of time, each with the bounds of its neighbours.

    If noise makes the crossings unreliable, periods of the strongest line are tried as well.
    """
    noise = [float(np.median(run.noise)) for run in runs if len(run)]
    for fewest in (_PLATEAU_CYCLES, FEWEST_CYCLES):
        spans = find_spans(runs, mode, fewest, window)
        noisy = max(noise, default=np.inf) > _QUIET_CROSSINGS
        covered = _covered(spans) / float(time[-1] - time[0])
        if frequency is None and (noisy or covered < _WELL_COVERED):
            periods = find_cycles(time, motion, _strongest_line(time, motion))
            spans = max(spans, find_spans(periods, mode, fewest, window), key=_covered)
        moving = sum(float(np.sum(run.stop - run.start)) for run in runs)
        if spans and (fewest == _PLATEAU_CYCLES or _covered(spans) > _NO_CHANCE * moving):
            ordered = sorted(spans, key=lambda s: s.start)
            earliest = [-np.inf, *(s.stop for s in ordered[:-1])]
            latest = [*(s.start for s in ordered[1:]), np.inf]
            return [
                replace(span, earliest=low, latest=high)
                for span, low, high in zip(ordered, earliest, latest, strict=True)
            ]
    if frequency is not None and mode != "sweep" and len(runs):
        return [Span(float(time[0]), float(time[-1]), frequency)]
    cycles = sum(len(run) for run in runs)
    read = "" if frequency is None else f" of {frequency:.6g} Hz"
    raise ExtractionError(
        f"no segment of constant amplitude and frequency in {time[-1] - time[0]:.6g} s: "
        f"{cycles} cycles{read}, motion from {motion.min():.4g} to {motion.max():.4g}; expected "
        f"at least {FEWEST_CYCLES} similar cycles: record longer, give "
        f"{argument('frequency')}, or {argument('mode', 'sweep')}"
    )


def _covered(spans: Sequence[Span]) -> float:
    return sum(span.stop - span.start for span in spans)


def _strongest_line(time: FloatArray, motion: FloatArray) -> float:
    """Return the frequency with the most power, assuming evenly spaced samples."""
    spectrum = np.abs(np.fft.rfft(motion - motion.mean()))
    line = int(np.argmax(spectrum[1:])) + 1
    return line / float((time[-1] - time[0]) * time.size / (time.size - 1))


def segment_of(
    time: FloatArray, channels: FloatArray, span: Span, frequency: float | None, block: int = 1
) -> Segment:
    """Return the samples of a span, or means of a block of them, with their phase."""
    first, last = np.searchsorted(time, [span.start, span.stop]).tolist()
    if last - first < 2:
        raise ExtractionError(
            f"{last - first} samples from t = {span.start:.6g} to {span.stop:.6g} s; "
            "expected at least 3 a cycle and 2 cycles: sample faster, or check "
            f"{argument('frequency')}"
        )
    omega = 2.0 * np.pi * (span.frequency_hz if frequency is None else frequency)
    segment = steady_segment(time[first:last], channels[:, first:last], omega, block)
    if span.sweep:
        return track_phase(segment, _SWEEP_DEGREE)
    if frequency is not None and segment.whole_cycles < FEWEST_CYCLES:
        return segment  # refused when it is measured
    if frequency is None:
        segment = estimate_frequency(track_phase(segment, 1))
    else:
        _refuse_drift(segment)
    least, most = np.searchsorted(time, [span.earliest, span.latest]).tolist()
    room = slice(min(least, first), max(most, last))
    part = _steady_part(time, channels[0], segment, slice(first, last), room)
    if part == slice(first, last):
        return segment
    segment = steady_segment(time[part], channels[:, part], segment.omega, block)
    return segment if frequency is not None else estimate_frequency(segment)


def _refuse_drift(segment: Segment) -> None:
    """Refuse a given frequency at which the motion's phase drifts from cycle to cycle."""
    thinned = segment.thinned()
    cuts = np.searchsorted(thinned.time, _cycle_edges(segment))
    counts = np.diff(cuts)
    cycle = np.flatnonzero(counts >= _SAMPLES_PER_CYCLE)
    dof = 2 * cycle.size - 4
    if dof < 1:
        return
    every, _ = _EachCycle(thinned.theta, thinned.channels[0], cuts).fits
    phasor, phasors = every[cycle], np.nan_to_num(every)
    power = np.abs(np.fft.fft(phasors, _PADDED * counts.size)) ** 2 / cycle.size
    peak = int(np.argmax(power))
    slip = float(np.fft.fftfreq(power.size)[peak])  # relative deviation of the frequency
    phases = np.angle(phasor * np.exp(-2j * np.pi * slip * cycle))
    evenly = True
    if cycle.size >= 2 * _FEWEST_IN_HALF:
        n = cycle.size // 2
        parts = (slice(None, n), slice(n, None))
        halves = [float(np.polyfit(cycle[half], phases[half], 1)[0]) for half in parts]
        evenly = abs(halves[1] - halves[0]) < _EVENLY * abs(sum(halves) + 4.0 * np.pi * slip)
    slip += float(np.polyfit(cycle, phases, 1)[0]) / (2.0 * np.pi)
    drift = 2.0 * np.pi * slip * counts.size
    remainder = float(np.sum(np.abs(phasor) ** 2)) - power[peak]
    clear = (power[peak] - power[0]) * dof > 2.0 * _highest_by_chance(_BY_CHANCE, dof) * remainder
    if clear and evenly and abs(drift) > _DRIFTED:
        stated = segment.omega / (2.0 * np.pi)
        measured = stated * (1.0 + slip)
        raise ExtractionError(
            f"the motion around t = {segment.centre:.6g} s has {measured:.6g} Hz, not the given "
            f"{stated:.6g} Hz: its phase drifts by {drift:.3g} rad in {counts.size} cycles; "
            f"expected less than {_DRIFTED:g} rad: give "
            f"{argument('frequency', Placeholder(f'{measured:.6g}'))}, or leave it out"
        )


def _steady_part(
    time: FloatArray, motion: FloatArray, segment: Segment, part: slice, room: slice
) -> slice:
    """Return the part of a record without stray cycles at its ends, or with more that fit.

    `segment` is the part with the phase of a steady sine; `room` bounds its growth.
    """
    cycle = 2.0 * np.pi / segment.omega
    inner = np.searchsorted(time, _cycle_edges(segment)[1:-1]).tolist()
    edges = [part.start, *inner, part.stop]
    for _ in range(_MOST_CYCLES_MORE):
        edges.insert(0, int(np.searchsorted(time, time[edges[0]] - cycle)))
        edges.append(int(np.searchsorted(time, time[edges[-1] - 1] + cycle, side="right")))
    cuts = np.clip(edges, room.start, room.stop)
    where = slice(int(cuts[0]), int(cuts[-1]))
    theta = np.asarray(segment.phase((time[where] - segment.centre) / segment.half_width))
    cycles = _EachCycle(theta, motion[where], cuts - cuts[0])
    phasor, variance = cycles.fits
    first, last = begun, ended = _MOST_CYCLES_MORE, phasor.size - _MOST_CYCLES_MORE
    while (stray := cycles.strays(first, last)) is not None:
        early, late = stray[[first, last - 1]].tolist()
        if 2 * (last - first + 1) <= ended - begun or not (early or late):
            break
        first, last = first + early, last - late
        if max(first - begun, ended - last) > _MOST_CYCLES_LESS:
            first, last, stray = begun, ended, None
            break
    if stray is not None:  # enough cycles remain; those next to stray ones deviate as well
        first, last = first + (first > begun), last - (last < ended)
    known = phasor[begun:ended][np.isfinite(phasor[begun:ended])]
    mean = known.sum() / max(known.size, 1)
    misfit = np.sqrt(variance + cycles.power(phasor - mean) / cycles.count)
    fits = misfit <= 1.5 * misfit[first] + _STRAYING * abs(mean)
    if stray is not None:
        fits &= ~stray
    if first == begun:
        while first > 0 and fits[first - 1]:
            first -= 1
    if last == ended:
        while last < phasor.size and fits[last]:
            last += 1
    return slice(int(cuts[first]), int(cuts[last]))


@dataclass(frozen=True)
class _EachCycle:
    """Samples with their phase, cut into cycles that may be incomplete at the ends."""

    theta: FloatArray
    motion: FloatArray
    cuts: IntArray

    @cached_property
    def count(self) -> FloatArray:
        """Number of samples of each cycle, or 1 if there are none."""
        return np.maximum(np.diff(self.cuts), 1).astype(np.float64)

    @cached_property
    def fits(self) -> tuple[ComplexArray, FloatArray]:
        """Phasor and residual variance of each cycle; NaN where samples are too few."""
        full = self.count >= _SAMPLES_PER_CYCLE
        bounds = np.column_stack([self.cuts[:-1], self.cuts[1:]])[full].ravel()
        n = np.diff(self.cuts)[full]
        phasor, variance = np.full((2, full.size), np.nan + 0j)
        phasor[full], variance[full] = sine_in_each(self.theta, self.motion, bounds, n)
        return phasor, variance.real

    def power(self, sine: ComplexArray) -> FloatArray:
        """Return the sum of squares of a sine in each cycle, without its mean; 0 for NaN."""
        size = np.repeat(np.nan_to_num(sine), np.diff(self.cuts))
        values = (size * np.exp(1j * self.theta)).real
        running = np.cumsum(np.pad([values, values**2], ((0, 0), (1, 0))), axis=1)
        total, square = np.diff(running[:, self.cuts], axis=1)
        return np.asarray(square - total**2 / self.count)

    def strays(self, first: int, last: int) -> BoolArray | None:
        """Return which cycles deviate from a sine that changes linearly in some cycles.

        Those at the ends are not part of the sine; None if too few others remain.
        """
        excluded = min(_END_CYCLES, (last - first) // _CYCLES_PER_END_CYCLE)
        phasor, n = self.fits[0], self.count
        inner = np.arange(first + excluded, last - excluded)
        inner = inner[np.isfinite(phasor[inner])]
        dof = 2 * inner.size - 4
        if excluded == 0 or dof < 2:
            return None
        k = np.arange(n.size) - np.average(inner, weights=n[inner])
        sine = np.polyval(np.polyfit(k[inner], phasor[inner], 1, w=np.sqrt(n[inner])), k)
        explained = self.power(phasor - sine)
        leverage = n * (1.0 / n[inner].sum() + k**2 / (n[inner] @ k[inner] ** 2))
        scatter = (1.0 + leverage) * explained[inner].sum() / dof
        bound = 2.0 * _highest_by_chance(_STRAY_BY_CHANCE, dof)
        least = 0.5 * n * (_LEAST_DRIFT * np.abs(sine).mean()) ** 2
        return np.asarray(explained > np.maximum(bound * scatter, least))


def _highest_by_chance(share: float, dof: int) -> float:
    return float(0.5 * dof * (share ** (-2.0 / dof) - 1.0))


def _cycle_edges(segment: Segment) -> FloatArray:
    """Return the bounds of the whole cycles; a partial one is before the first."""
    end = segment.time[-1] + 0.5 * segment.sample_phase / segment.omega
    cycle = 2.0 * np.pi / segment.omega
    return np.asarray(end - cycle * np.arange(segment.whole_cycles, -1.0, -1.0))

"""Segments: the spans of a record as samples with their phase.

Spans are looked for between crossings first. Where noise drowns those, or they cover little
of the record, the periods of its strongest line are tried as well, and the longer reading wins.
Each span then gets its frequency, and the cycles next to it that the same sine fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ExtractionError, Placeholder, argument
from dahl_ident.extraction.cycles import Cycles, cut_cycles, find_cycles, sine_in_each
from dahl_ident.extraction.plateaus import Mode, Span, find_spans
from dahl_ident.extraction.segment_bounds import cycle_edges, highest_by_chance, steady_part
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    Segment,
    estimate_frequency,
    steady_segment,
    thinned,
    track_phase,
    whole_cycles,
)

_PLATEAU_CYCLES = 3  # fewer only where no plateau has so many ...
_NO_CHANCE = 0.1  # ... and they are this share of all cycles: noise has two alike at times
_QUIET_CROSSINGS = 0.01  # noise of a cycle's log amplitude that no crossing suffers from
_WELL_COVERED = 0.5  # of a record: where crossings find spans so long, they are right
_SWEEP_DEGREE = 3  # of the phase in a window
_DRIFTED = 0.2  # phase over a segment, rad, that costs 0.2 % of the amplitude, more of harmonics
_EVENLY = 0.5  # of the turn's sum over both halves, by which they may differ
_FEWEST_IN_HALF = 2  # cycles that show a slope
_BY_CHANCE = 1e-6  # of segments without a drift, how many seem to have one
_PADDED = 16  # lines for each cycle, so that a peak lies near one
_FEWEST_SAMPLES = 4  # that a cycle's sine and offset leave something of


def record_cycles(time: FloatArray, motion: FloatArray, frequency: float | None) -> list[Cycles]:
    """Return the runs of cycles between crossings, or of the period where it is known."""
    return find_cycles(time, motion) if frequency is None else cut_cycles(time, motion, frequency)


def record_spans(
    time: FloatArray,
    motion: FloatArray,
    runs: Sequence[Cycles],
    frequency: float | None,
    mode: Mode,
    window: int | None,
) -> list[Span]:
    """Return the spans of a record in order of time, each with where its neighbours end and begin.

    In noise that drowns the crossings, periods of the strongest line are tried as well.
    """
    noise = [float(np.median(run.noise)) for run in runs if len(run)]
    for fewest in (_PLATEAU_CYCLES, FEWEST_CYCLES):
        spans = find_spans(runs, mode, fewest, window)
        noisy = max(noise, default=np.inf) > _QUIET_CROSSINGS
        covered = _covered(spans) / float(time[-1] - time[0])
        if frequency is None and (noisy or covered < _WELL_COVERED):
            periods = cut_cycles(time, motion, _strongest_line(time, motion))
            spans = max(spans, find_spans(periods, mode, fewest, window), key=_covered)
        moving = sum(float(np.sum(run.stop - run.start)) for run in runs)
        if spans and (fewest == _PLATEAU_CYCLES or _covered(spans) > _NO_CHANCE * moving):
            ordered = sorted(spans, key=lambda s: s.start)
            ends = [-np.inf, *(s.stop for s in ordered[:-1])]
            begins = [*(s.start for s in ordered[1:]), np.inf]
            return [
                replace(span, earliest=end, latest=begin)
                for span, end, begin in zip(ordered, ends, begins, strict=True)
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
    """Return the frequency with most power, samples taken as evenly spaced."""
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
    if frequency is not None and whole_cycles(segment) < FEWEST_CYCLES:
        return segment  # which whoever measures it will refuse
    if frequency is None:
        segment = estimate_frequency(track_phase(segment, 1))
    else:
        _refuse_drift(segment)
    least, most = np.searchsorted(time, [span.earliest, span.latest]).tolist()
    room = slice(min(least, first), max(most, last))
    part = steady_part(time, channels[0], segment, slice(first, last), room)
    if part == slice(first, last):
        return segment
    segment = steady_segment(time[part], channels[:, part], segment.omega, block)
    return segment if frequency is not None else estimate_frequency(segment)


def _refuse_drift(segment: Segment) -> None:
    """Refuse a given frequency at which the motion's phase drifts from cycle to cycle."""
    few = thinned(segment)
    cuts = np.searchsorted(few.time, cycle_edges(segment))
    counts = np.diff(cuts)
    cycle = np.flatnonzero(counts >= _FEWEST_SAMPLES)
    dof = 2 * cycle.size - 4
    if dof < 1:
        return
    bounds = np.column_stack([cuts[:-1], cuts[1:]])[cycle].ravel()
    phasor, _ = sine_in_each(few.theta, few.channels[0], bounds, counts[cycle])
    phasors = np.zeros(counts.size, dtype=np.complex128)
    phasors[cycle] = phasor
    power = np.abs(np.fft.fft(phasors, _PADDED * counts.size)) ** 2 / cycle.size
    peak = int(np.argmax(power))
    turns = float(np.fft.fftfreq(power.size)[peak])
    phases = np.angle(phasor * np.exp(-2j * np.pi * turns * cycle))
    evenly = True
    if cycle.size >= 2 * _FEWEST_IN_HALF:
        halves = [float(np.polyfit(*half, 1)[0]) for half in _halves(cycle, phases)]
        evenly = abs(halves[1] - halves[0]) < _EVENLY * abs(sum(halves) + 4.0 * np.pi * turns)
    turns += float(np.polyfit(cycle, phases, 1)[0]) / (2.0 * np.pi)
    drift = 2.0 * np.pi * turns * counts.size
    left = float(np.sum(np.abs(phasor) ** 2)) - power[peak]
    clear = (power[peak] - power[0]) * dof > 2.0 * highest_by_chance(_BY_CHANCE, dof) * left
    if clear and evenly and abs(drift) > _DRIFTED:
        stated = segment.omega / (2.0 * np.pi)
        shown = stated * (1.0 + turns)
        raise ExtractionError(
            f"the motion around t = {segment.centre:.6g} s has {shown:.6g} Hz, not the given "
            f"{stated:.6g} Hz: its phase drifts by {drift:.3g} rad in {counts.size} cycles; "
            f"expected less than {_DRIFTED:g} rad: give "
            f"{argument('frequency', Placeholder(f'{shown:.6g}'))}, or leave it out"
        )


def _halves(cycle: NDArray[np.intp], phase: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the cycles' numbers and phases of the first and the second half."""
    middle = cycle.size // 2
    for half in (slice(None, middle), slice(middle, None)):
        yield cycle[half].astype(np.float64), phase[half]

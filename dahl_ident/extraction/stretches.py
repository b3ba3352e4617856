"""Stretches: the segments of a record as samples with their phase.

Segments are looked for between crossings first. Where noise drowns those, or they cover little
of the record, the periods of its strongest line are tried as well, and the longer reading wins.
Each segment then gets its frequency, and the cycles beside it that the same sine fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.cycles import Cycles, cut_cycles, find_cycles
from dahl_ident.extraction.segments import Mode, Segment, find_segments
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    Stretch,
    columns,
    estimate_frequency,
    solvable_inverse,
    steady_stretch,
    thinned,
    track_phase,
    whole_cycles,
)

_PLATEAU_CYCLES = 3  # fewer only where no plateau has so many ...
_NO_CHANCE = 0.1  # ... and they are this share of all cycles: noise has two alike at times
_QUIET_CROSSINGS = 0.01  # noise of a cycle's log amplitude that no crossing suffers from
_WELL_COVERED = 0.5  # of a record: where crossings find segments so long, they are right
_SWEEP_DEGREE = 3  # of the phase in a window
_STRAYING = 0.005  # of the amplitude, that a further cycle may stray from the sine
_MOST_CYCLES_MORE = 2  # on either side


def record_segments(
    time: FloatArray,
    motion: FloatArray,
    frequency: float | None,
    mode: Mode,
    window: int | None,
) -> list[Segment]:
    """Return the segments of a record, or say that it has none.

    In noise that drowns the crossings, periods of the strongest line are tried as well.
    """
    runs = find_cycles(time, motion) if frequency is None else cut_cycles(time, motion, frequency)
    noise = [float(np.median(run.noise)) for run in runs if len(run)]
    for fewest in (_PLATEAU_CYCLES, FEWEST_CYCLES):
        segments = find_segments(runs, mode, fewest, window)
        noisy = max(noise, default=np.inf) > _QUIET_CROSSINGS
        covered = _covered(segments) / float(time[-1] - time[0])
        if frequency is None and (noisy or covered < _WELL_COVERED):
            periods = cut_cycles(time, motion, _strongest_line(time, motion))
            segments = max(segments, find_segments(periods, mode, fewest, window), key=_covered)
        moving = sum(float(np.sum(run.stop - run.start)) for run in runs)
        if segments and (fewest == _PLATEAU_CYCLES or _covered(segments) > _NO_CHANCE * moving):
            return _with_room(segments)
    if frequency is not None and mode != "sweep" and len(runs):
        return [Segment(float(time[0]), float(time[-1]), frequency)]
    raise ExtractionError(_no_segments(time, motion, runs, frequency))


def _with_room(segments: Sequence[Segment]) -> list[Segment]:
    """Return the segments in order of time, each with where its neighbours end and begin."""
    ordered = sorted(segments, key=lambda s: s.start)
    ends = [-np.inf, *(s.stop for s in ordered[:-1])]
    begins = [*(s.start for s in ordered[1:]), np.inf]
    return [
        replace(segment, earliest=end, latest=begin)
        for segment, end, begin in zip(ordered, ends, begins, strict=True)
    ]


def _covered(segments: Sequence[Segment]) -> float:
    return sum(segment.stop - segment.start for segment in segments)


def _strongest_line(time: FloatArray, motion: FloatArray) -> float:
    """Return the frequency with most power, samples taken as evenly spaced."""
    spectrum = np.abs(np.fft.rfft(motion - motion.mean()))
    line = int(np.argmax(spectrum[1:])) + 1
    return line / float((time[-1] - time[0]) * time.size / (time.size - 1))


def _no_segments(
    time: FloatArray, motion: FloatArray, runs: Sequence[Cycles], frequency: float | None
) -> str:
    cycles = sum(len(run) for run in runs)
    read = "" if frequency is None else f" of {frequency:.6g} Hz"
    return (
        f"no stretch of constant amplitude and frequency in {time[-1] - time[0]:.6g} s: "
        f"{cycles} cycles{read}, motion from {motion.min():.4g} to {motion.max():.4g}; expected "
        f"at least {FEWEST_CYCLES} cycles alike: record longer, give frequency=, or mode='sweep'"
    )


def stretch_of(
    time: FloatArray, channels: FloatArray, segment: Segment, frequency: float | None
) -> Stretch:
    """Return the samples of a segment with their phase."""
    first, last = np.searchsorted(time, [segment.start, segment.stop]).tolist()
    if last - first < 2:
        raise ExtractionError(
            f"{last - first} samples from t = {segment.start:.6g} to {segment.stop:.6g} s; "
            "expected at least 3 a cycle and 2 cycles: sample faster, or check frequency="
        )
    omega = 2.0 * np.pi * (segment.frequency_hz if frequency is None else frequency)
    stretch = steady_stretch(time[first:last], channels[:, first:last], omega)
    if segment.sweep:
        return track_phase(stretch, _SWEEP_DEGREE)
    if frequency is not None and whole_cycles(stretch) < FEWEST_CYCLES:
        return stretch  # which whoever measures it will refuse
    if frequency is None:
        stretch = estimate_frequency(track_phase(stretch, 1))
    least, most = np.searchsorted(time, [segment.earliest, segment.latest]).tolist()
    room = slice(min(least, first), max(most, last))
    part = _extended(time, channels[0], stretch, slice(first, last), room)
    if part == slice(first, last):
        return stretch
    stretch = steady_stretch(time[part], channels[:, part], stretch.omega)
    return stretch if frequency is not None else estimate_frequency(stretch)


def _extended(
    time: FloatArray, motion: FloatArray, stretch: Stretch, part: slice, room: slice
) -> slice:
    """Return the slice with the cycles before and after it that its sine fits as well.

    Where the room ends they may be partial.
    """
    few = thinned(stretch)
    basis = columns(few.theta, few.tau, 1)
    fitted = solvable_inverse(basis @ basis.T, few) @ (basis @ few.channels[0])
    cycle = 2.0 * np.pi / stretch.omega

    def misfit(where: slice) -> float:
        tau = (time[where] - stretch.centre) / stretch.half_width
        model = fitted @ columns(np.asarray(stretch.phase(tau)), tau, 1)
        return float(np.sqrt(np.mean((motion[where] - model) ** 2)))

    start, stop = part.start, part.stop
    inside = slice(start, int(np.searchsorted(time, time[start] + cycle)))
    allowed = 1.5 * misfit(inside) + _STRAYING * float(np.hypot(*fitted[2:]))
    for _ in range(_MOST_CYCLES_MORE):
        earlier = max(int(np.searchsorted(time, time[start] - cycle)), room.start)
        if earlier < start and misfit(slice(earlier, start)) <= allowed:
            start = earlier
        later = min(int(np.searchsorted(time, time[stop - 1] + cycle, side="right")), room.stop)
        if later > stop and misfit(slice(stop, later)) <= allowed:
            stop = later
    return slice(start, stop)

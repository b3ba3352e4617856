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

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ExtractionError, Placeholder, argument
from dahl_ident.extraction.cycles import (
    Cycles,
    Mode,
    Span,
    find_cycles,
    find_spans,
    groups_of_cycles,
    sine_in_each,
)
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    Segment,
    checked_inverse,
    column_blocks,
    columns,
    estimate_frequency,
    is_solvable,
    normal_equations,
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
    bounds = np.column_stack([cuts[:-1], cuts[1:]])[cycle].ravel()
    phasor, _ = sine_in_each(thinned.theta, thinned.channels[0], bounds, counts[cycle])
    phasors = np.zeros(counts.size, dtype=np.complex128)
    phasors[cycle] = phasor
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
    edges = _cycle_edges(segment)
    start, stop = part.start, part.stop
    count, fewer = edges.size - 1, np.zeros(2, dtype=np.intp)
    while True:
        inside = _inside(segment, edges)
        if inside is None or 2 * edges.size <= count:
            break
        if fewer.max() > _MOST_CYCLES_LESS:
            return _extended(time, motion, segment, part, room, None)
        second, last = np.searchsorted(time, edges[[1, -2]]).tolist()
        early = inside.strays(time[start:second], motion[start:second])
        late = inside.strays(time[last:stop], motion[last:stop])
        if not early and not late:
            break
        start, stop = (second if early else start), (last if late else stop)
        edges = edges[int(early) : edges.size - int(late)]
        fewer += [early, late]
    if inside is not None:  # enough cycles remain; those next to stray ones deviate as well
        start = int(np.searchsorted(time, edges[1])) if start > part.start else start
        stop = int(np.searchsorted(time, edges[-2])) if stop < part.stop else stop
    room = slice(
        room.start if start == part.start else start, room.stop if stop == part.stop else stop
    )
    return _extended(time, motion, segment, slice(start, stop), room, inside)


def _highest_by_chance(share: float, dof: int) -> float:
    return float(0.5 * dof * (share ** (-2.0 / dof) - 1.0))


def _cycle_edges(segment: Segment) -> FloatArray:
    """Return the bounds of the whole cycles; a partial one is before the first."""
    end = segment.time[-1] + 0.5 * segment.sample_phase / segment.omega
    cycle = 2.0 * np.pi / segment.omega
    return np.asarray(end - cycle * np.arange(segment.whole_cycles, -1.0, -1.0))


@dataclass(frozen=True)
class _Inside:
    """The sine of the inner cycles, which may change linearly, and the variance about it."""

    segment: Segment
    coefficients: FloatArray
    inverse: FloatArray
    variance: float
    dof: int

    def strays(self, time: FloatArray, motion: FloatArray) -> bool:
        """Return whether samples of the record deviate significantly from the sine."""
        tau = (time - self.segment.centre) / self.segment.half_width
        basis = columns(np.asarray(self.segment.phase(tau)), tau, 1, 1)
        sine = basis[2:4] - basis[2:4].mean(axis=1, keepdims=True)  # the mean may wander
        inverse = np.linalg.pinv(sine @ sine.T)
        products = sine @ (motion - self.coefficients @ basis)
        explained = float(products @ inverse @ products)
        cross = sine @ basis.T
        fitted = 0.5 * float(np.trace(inverse @ cross @ self.inverse @ cross.T))
        bound = _highest_by_chance(_STRAY_BY_CHANCE, self.dof)
        amplitude = float(np.hypot(*self.coefficients[2:4]))
        least = 0.5 * time.size * (_LEAST_DRIFT * amplitude) ** 2
        return bool(explained > max(2.0 * bound * (1.0 + fitted) * self.variance, least))


def _inside(segment: Segment, edges: FloatArray) -> _Inside | None:
    """Return the sine of all cycles except those at the ends, None if too few remain."""
    excluded = min(_END_CYCLES, (edges.size - 1) // _CYCLES_PER_END_CYCLE)
    if excluded == 0:
        return None
    cuts = np.searchsorted(segment.time, edges[excluded:-excluded])
    within = slice(int(cuts[0]), int(cuts[-1]))
    blocks = column_blocks(segment.theta[within], segment.tau[within], 1, 1)
    normal, right = normal_equations(segment.channels[:1, within], 6, blocks)
    if not is_solvable(normal):
        return None
    inverse = np.asarray(np.linalg.inv(normal), np.float64)
    coefficients = inverse @ right[:, 0]
    sums = np.zeros((5, cuts.size - 1))
    for first, last in groups_of_cycles(cuts):
        part = slice(int(cuts[first]), int(cuts[last]))
        basis = columns(segment.theta[part], segment.tau[part], 1, 1)
        residual = segment.channels[0, part] - coefficients @ basis
        cos, sin = basis[2:4]
        products = np.stack([cos * cos, sin * sin, cos * sin, cos * residual, sin * residual])
        running = np.cumsum(np.pad(products, ((0, 0), (1, 0))), axis=1)
        sums[:, first:last] = np.diff(running[:, cuts[first : last + 1] - cuts[first]], axis=1)
    cc, ss, cs, c, s = sums
    determinant = cc * ss - cs**2
    full = determinant > 0.1 * cc * ss  # a cycle without samples carries no information
    dof = 2 * int(full.sum()) - 4
    if dof < 2:
        return None
    explained = (ss * c**2 + cc * s**2 - 2.0 * cs * c * s)[full] / determinant[full]
    return _Inside(segment, coefficients, inverse, float(explained.sum()) / dof, dof)


def _extended(
    time: FloatArray,
    motion: FloatArray,
    segment: Segment,
    part: slice,
    room: slice,
    inside: _Inside | None,
) -> slice:
    """Return the slice extended by adjacent cycles that fit the segment's sine."""
    thinned = segment.thinned()
    basis = columns(thinned.theta, thinned.tau, 1)
    fitted = checked_inverse(basis @ basis.T, thinned) @ (basis @ thinned.channels[0])
    cycle = 2.0 * np.pi / segment.omega

    def misfit(where: slice) -> float:
        tau = (time[where] - segment.centre) / segment.half_width
        model = fitted @ columns(np.asarray(segment.phase(tau)), tau, 1)
        return float(np.sqrt(np.mean((motion[where] - model) ** 2)))

    start, stop = part.start, part.stop
    within = slice(start, int(np.searchsorted(time, time[start] + cycle)))
    allowed = 1.5 * misfit(within) + _STRAYING * float(np.hypot(*fitted[2:]))

    def fits(where: slice) -> bool:
        strays = inside is not None and inside.strays(time[where], motion[where])
        return misfit(where) <= allowed and not strays

    for _ in range(_MOST_CYCLES_MORE):
        earlier = max(int(np.searchsorted(time, time[start] - cycle)), room.start)
        if earlier < start and fits(slice(earlier, start)):
            start = earlier
        later = min(int(np.searchsorted(time, time[stop - 1] + cycle, side="right")), room.stop)
        if later > stop and fits(slice(stop, later)):
            stop = later
    return slice(start, stop)

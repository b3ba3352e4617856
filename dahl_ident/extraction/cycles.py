"""Cycles of a waveform, and the spans of a record that hold one level or a sweep.

A record of unknown frequency is cut at its rising crossings, from below ``-h`` to above ``+h`` with
``h`` a fraction of the amplitude, so that noise causes none. Parts in which the motion stays within
``±h`` for long are searched again with their own amplitude. A record of known frequency is cut into
its periods, whatever the noise. A sine fitted to each cycle then corrects its phase.

A piece grows cycle by cycle as long as amplitude and frequency stay near its mean. A piece that is
long enough and has no trend is a plateau, and becomes a point; the others are ramps. If ramps
outweigh plateaus, the record is a sweep, and is cut into windows of little change. A drive such as
a crank may never be steady for two cycles: if plateaus hold less than half of the cycles outside
sweeps and ramps, these cycles are grouped with wider tolerances.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import (
    TINY,
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    whole_number,
)

_THRESHOLD = 0.3  # fraction of the amplitude that half a cycle exceeds; noise may be a tenth
_QUANTILES = (0.995, 0.9, 0.7)  # that give the amplitude, tried in turn: a few peaks may be large
_QUIET = 1.5  # half cycles; a longer time within the threshold may hold another level
_SHORTEST_PART = 16  # a shorter quiet part is not searched for cycles
_ONE_SINE = 0.1  # of one sine: largest relative difference of periods, and phase error in cycles
_MOST_BRIDGED = 10.0  # cycles; a longer pause ends a sine
_MOST_NESTED = 12  # quiet parts within quiet parts, each below _THRESHOLD of the last: 5e-7 in all
_QUANTILE_SAMPLES = 50_000  # samples at most from which the quantiles are computed
_FEWEST_PER_CYCLE = 3  # samples; mean and phasor of a cycle are three numbers
_NOISIEST_CUT = 0.05  # largest noise of the log amplitude of a cycle whose frequency is known
_FEWEST_CUTS = 3  # cycles that must remain; fewer do not show whether the level is constant
_NOISIEST_CROSSING = 0.1  # largest noise of the log amplitude of a cycle between two crossings
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # its multiples are spread most evenly
_SAMPLES_AT_ONCE = 100_000  # computed together, so that intermediate arrays stay in the cache
_GAP = 1.0 / 3.0  # fraction of a cycle without samples that makes its amplitude unknown
Mode = Literal["auto", "steps", "sweep"]
MODES: tuple[Mode, ...] = ("auto", "steps", "sweep")
AMPLITUDE_TOLERANCE = 0.02  # of log amplitude within a plateau; steps of level are larger
FREQUENCY_TOLERANCE = 0.01  # of log frequency within a plateau
_UNSTEADY = 5.0  # factor by which tolerances widen for groups of cycles whose drive varies
_NOISE_FACTOR = 6.0  # least tolerance in standard deviations, so that noise splits no plateau
_LARGEST_TOLERANCE = 0.3  # largest tolerance, however large the noise
_LEAST_NOISE = 1e-12  # least noise of a log amplitude: its inverse square, a weight, stays finite
_NOISIEST = 0.2  # noise of a cycle's log amplitude above which it is not a cycle
_EDGE_TOLERANCE = 0.005  # relative; cycles at the ends of a plateau that differ more are left out
_MOSTLY_HELD = 0.5  # least share of the cycles in plateaus; with less, the record is a sweep
_CLEARLY_MORE = 1.5  # groups replace plateaus if they hold this many times as many cycles
_SLOW_CHANGE = 0.005  # largest change of log amplitude per cycle that friction follows without lag
_SCATTERED = 4.0  # largest trend, in standard deviations about a line, that may be scatter
_SWEEP_RANGE = 0.2  # least change of log amplitude or frequency over a whole sweep
_SWEEP_STEP = 0.2  # largest change of log amplitude or frequency from cycle to cycle of a sweep
_SWEEP_CHANGE = 0.1  # largest change of log amplitude or frequency in one window of a sweep
_SWEEP_CYCLES = (4, 20)  # least and most cycles in one window of a sweep


@dataclass(frozen=True)
class Span:
    """Start and stop, s, frequency in the middle, Hz, and the bounds set by the adjacent spans."""

    start: float
    stop: float
    frequency_hz: float
    sweep: bool = False
    earliest: float = -np.inf
    latest: float = np.inf


@dataclass(frozen=True)
class Cycles:
    """Consecutive cycles of a sine; those with a gap in the sampling are left out.

    `noise` is the standard deviation of `log_amplitude`, and of the phase in rad. `log_frequency`
    is the mean from the middle of one cycle to that of the next.
    """

    start: FloatArray
    stop: FloatArray
    log_amplitude: FloatArray
    noise: FloatArray
    log_frequency: FloatArray

    def __len__(self) -> int:
        return self.start.size

    def part(self, first: int, last: int) -> Cycles:
        """Return the cycles from `first` to `last`, excluding `last`."""
        names = ("start", "stop", "log_amplitude", "noise")
        of_cycles = {name: getattr(self, name)[first:last] for name in names}
        return Cycles(**of_cycles, log_frequency=self.log_frequency[first : max(last - 1, first)])

    @property
    def usual_noise(self) -> float:
        """Median of the noise."""
        return float(np.median(self.noise))

    @property
    def trending(self) -> bool:
        """Whether amplitude or frequency changes from end to end by more than the tolerance."""
        amplitude, frequency = _tolerances(self.usual_noise)
        return (
            abs(_change(self.log_amplitude)) > amplitude
            or abs(_change(self.log_frequency)) > frequency
        )

    @property
    def ramping(self) -> bool:
        """Whether the amplitude rises or falls throughout, faster than friction follows."""
        a = self.log_amplitude
        n = len(self)
        line = np.polyfit(np.arange(n), a, 1)
        scatter = float(np.std(a - np.polyval(line, np.arange(n)), ddof=min(2, n - 1)))
        return self.trending and abs(_change(a)) > max(_SLOW_CHANGE * n, _SCATTERED * scatter)

    def span(self, *, sweep: bool = False) -> Span:
        """Return the time span of the cycles, and their mean frequency."""
        frequency = float(np.exp(np.mean(self.log_frequency)))
        return Span(float(self.start[0]), float(self.stop[-1]), frequency, sweep)


def find_cycles(
    time: FloatArray, motion: FloatArray, frequency_hz: float | None = None
) -> list[Cycles]:
    """Cut a record into runs of consecutive cycles; of known frequency, into one run.

    If noise hides the amplitude of single periods of known frequency, several make one cycle.
    """
    if frequency_hz is None:
        runs = _crossing_runs(time, motion, 0)
        runs.sort(key=lambda edges: float(edges[0]))
        measured = [_measured(time, motion, edges) for edges in _joined(runs)]
        return [  # cycles that may be noise alone have infinite noise
            replace(c, noise=np.where(c.noise > _NOISIEST_CROSSING, np.inf, c.noise))
            for c in measured
        ]
    cycles = _cut(time, motion, frequency_hz, 1)
    if len(cycles):
        periods = int(np.ceil((cycles.usual_noise / _NOISIEST_CUT) ** 2))
        periods = min(periods, len(cycles) // _FEWEST_CUTS)
        if periods > 1:
            cycles = _cut(time, motion, frequency_hz, periods)
    return [cycles]


def _cut(time: FloatArray, motion: FloatArray, frequency_hz: float, periods: int) -> Cycles:
    interval = float(np.median(np.diff(time)))
    cycles = (time[-1] - time[0] + 1.5 * interval) * frequency_hz / periods
    count = whole_number(int(cycles), "the number of cycles", 0)
    edges = time[0] - 0.5 * interval + np.arange(count + 1) * periods / frequency_hz
    return _measured(time, motion, edges, periods)


def _joined(runs: list[FloatArray]) -> list[FloatArray]:
    """Join runs that are a few cycles of the same period apart, and cut the pause into cycles."""
    joined: list[FloatArray] = []
    for edges in runs:
        if joined:
            last = joined[-1]
            period, next_period = last[-1] - last[-2], edges[1] - edges[0]
            pause = (edges[0] - last[-1]) / period
            whole = round(pause)
            alike = abs(next_period / period - 1.0) < _ONE_SINE
            if alike and pause < _MOST_BRIDGED and abs(pause - whole) < _ONE_SINE:
                bridge = np.linspace(last[-1], edges[0], whole + 1)[1:-1]
                joined[-1] = np.concatenate([last, bridge, edges[0 if whole else 1 :]])
                continue
        joined.append(edges)
    return joined


def _crossing_runs(time: FloatArray, motion: FloatArray, depth: int) -> list[FloatArray]:
    """Return the rising crossings, split at quiet parts, and those within these parts."""
    if time.size < _SHORTEST_PART or depth > _MOST_NESTED:
        return []
    trials = (_runs_at(time, motion, quantile, depth) for quantile in _QUANTILES)
    return next(filter(None, trials), [])


def _runs_at(time: FloatArray, motion: FloatArray, quantile: float, depth: int) -> list[FloatArray]:
    """Return the rising crossings for the amplitude given by a quantile."""
    low, high = np.quantile(scattered(motion, _QUANTILE_SAMPLES), [1.0 - quantile, quantile])
    middle, threshold = 0.5 * (low + high), 0.5 * _THRESHOLD * (high - low)
    if not threshold > 1e-12 * max(abs(low), abs(high)):
        return []
    motion = motion - middle
    beyond = np.flatnonzero(np.abs(motion) > threshold)
    above = motion[beyond] > 0.0
    pause = np.diff(beyond) - 1
    long = np.flatnonzero(pause >= _SHORTEST_PART)
    quiet = long[pause[long] > _QUIET * _lobe_spacing(beyond, above, long)]
    breaks = np.concatenate([[0], quiet + 1, [beyond.size]])
    runs: list[FloatArray] = []
    searched = 0
    for first, last in pairwise(breaks.tolist()):
        rising = first + np.flatnonzero(~above[first : last - 1] & above[first + 1 : last])
        if rising.size < 2:
            continue
        runs.append(_crossings(time, motion, beyond[rising], beyond[rising + 1]))
        # the cycle before and the cycle after may be transitions, and are not searched
        at = beyond[rising]
        start = max(int(2 * at[0] - at[1]), 0)
        runs += _crossing_runs(time[searched:start], motion[searched:start], depth + 1)
        searched = int(2 * at[-1] - at[-2])
    if searched:
        runs += _crossing_runs(time[searched:], motion[searched:], depth + 1)
    return runs


def scattered(samples: FloatArray, count: int) -> FloatArray:
    """Return `count` samples, spread over the record and over the phases of any period."""
    size = samples.shape[-1]
    if size <= count:
        return samples
    fractions = np.arange(count) * _GOLDEN % 1.0  # equal steps could match the motion's period
    return np.asarray(samples[..., np.sort((fractions * size).astype(np.intp))])


def _lobe_spacing(beyond: IntArray, above: BoolArray, pairs: IntArray) -> IntArray:
    """Return the half period, in samples, near pairs of samples beyond the threshold."""
    changes = np.flatnonzero(above[1:] != above[:-1]) + 1
    lobe = np.searchsorted(changes, pairs, side="right")
    starts = beyond[np.concatenate([[0], changes])]
    unknown = np.full(1, beyond[-1] + 1)
    spacing = np.concatenate([unknown, np.diff(starts), unknown, unknown])
    return np.asarray(np.minimum(spacing[lobe], spacing[lobe + 2]))


def _crossings(
    time: FloatArray, motion: FloatArray, before: IntArray, after: IntArray
) -> FloatArray:
    """Return the times of upward zero crossings between samples `before` and `after`."""
    upward = np.flatnonzero((motion[:-1] < 0.0) & (motion[1:] >= 0.0))
    first = upward[np.searchsorted(upward, before)]
    last = upward[np.searchsorted(upward, after) - 1]
    at = np.array([first, last])  # noise may cause several
    fraction = motion[at] / (motion[at] - motion[at + 1])
    return np.asarray(np.mean(time[at] + fraction * (time[at + 1] - time[at]), axis=0))


def _measured(time: FloatArray, motion: FloatArray, edges: FloatArray, periods: int = 1) -> Cycles:
    """Return amplitudes and frequencies of cycles of one or more periods between `edges`."""
    cuts = np.searchsorted(time, edges)
    counts = np.diff(cuts)
    sampled = np.flatnonzero((counts >= _FEWEST_PER_CYCLE) & ~_with_gap(time, edges))
    start, stop, n = edges[sampled], edges[sampled + 1], counts[sampled]
    fits = []
    # in groups of cycles whose samples fit in the cache
    at = np.arange(cuts[0], cuts[-1], _SAMPLES_AT_ONCE)
    groups = np.unique(np.searchsorted(cuts, at, side="right") - 1).tolist()
    for first, last in pairwise([*groups, cuts.size - 1]):
        inside = slice(int(cuts[first]), int(cuts[last]))
        per_cycle = counts[first:last]
        omega = np.repeat(2.0 * np.pi * periods / np.diff(edges[first : last + 1]), per_cycle)
        theta = (time[inside] - np.repeat(edges[first:last], per_cycle)) * omega
        group = sampled[(sampled >= first) & (sampled < last)]
        bounds = np.column_stack([cuts[group], cuts[group + 1]]).ravel() - cuts[first]
        fits.append(sine_in_each(theta, motion[inside], bounds, counts[group]))
    if not fits:
        fits = [sine_in_each(time[:0], motion[:0], sampled, n)]
    phasor, variance = (np.concatenate(column) for column in zip(*fits, strict=True))
    amplitude = np.maximum(np.abs(phasor), TINY)
    noise = np.sqrt(2.0 * variance / n) / amplitude
    frequency = _log_frequency(start, stop, np.angle(phasor), periods)
    return Cycles(start, stop, np.log(amplitude), noise, frequency)


def sine_in_each(
    theta: FloatArray, y: FloatArray, bounds: IntArray, n: IntArray
) -> tuple[ComplexArray, FloatArray]:
    """Return the phasor of each cycle, fitted with an offset, and the residual variance."""
    middle = 0.5 * float(y.min() + y.max()) if y.size else 0.0
    y = y - middle
    rotor = np.exp(-1j * theta)
    first, second, with_y = (_sums(v, bounds) for v in (rotor, rotor * rotor, rotor * y))
    total, power = _sums(y, bounds), _sums(y * y, bounds)
    c, s = first.real, -first.imag
    cc, ss, cs = 0.5 * (n + second.real), 0.5 * (n - second.real), -0.5 * second.imag
    normal = np.array([[n, c, s], [c, cc, cs], [s, cs, ss]]).transpose(2, 0, 1)
    right = np.array([total, with_y.real, -with_y.imag]).T
    normal += 1e-9 * n[:, None, None] * np.eye(3)
    fitted = np.linalg.solve(normal, right[:, :, None])[..., 0]
    variance = np.maximum(power - np.sum(fitted * right, axis=1), 0.0) / n
    return fitted[:, 1] - 1j * fitted[:, 2], variance


def _sums(values: NDArray[Any], bounds: IntArray) -> NDArray[Any]:
    return np.add.reduceat(np.append(values, 0.0), bounds)[::2] if bounds.size else values[:0]


def _log_frequency(
    start: FloatArray, stop: FloatArray, phase: FloatArray, periods: int
) -> FloatArray:
    """Return the mean frequency from the middle of each cycle to that of the next."""
    middle, period = 0.5 * (start + stop), stop - start
    missing = (start[1:] - stop[:-1]) / (0.5 * (period[1:] + period[:-1]))
    fraction = np.diff(phase) / (2.0 * np.pi)
    whole = np.round(periods * (1.0 + missing) - fraction)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.log((whole + fraction) / np.diff(middle)))


def _with_gap(time: FloatArray, edges: FloatArray) -> BoolArray:
    """Return which cycles lack samples over a part of their time."""
    periods = np.diff(edges)
    broken = np.zeros(periods.size, dtype=bool)
    steps = np.diff(time)
    for i in np.flatnonzero(steps > _GAP * periods.min(initial=np.inf)):
        first = max(int(np.searchsorted(edges, time[i], side="right")) - 1, 0)
        last = int(np.searchsorted(edges, time[i + 1]))
        broken[first:last] |= steps[i] > _GAP * periods[first:last]
    return broken


def find_spans(runs: Sequence[Cycles], mode: Mode, fewest: int, window: int | None) -> list[Span]:
    """Return the spans of runs of consecutive cycles, in order of time.

    The spans are plateaus of at least `fewest` cycles or windows of sweeps (of `window` cycles, or
    as many as change little), whichever there is more of.
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
    widened = min(_NOISE_FACTOR * noise, _LARGEST_TOLERANCE)
    return max(AMPLITUDE_TOLERANCE, widened), max(FREQUENCY_TOLERANCE, widened / np.pi)


def _change(values: FloatArray) -> float:
    """Return the change from end to end of the straight line through the values."""
    if values.size < 2:
        return 0.0
    x = np.linspace(-0.5, 0.5, values.size)
    return float(x @ values / (x @ x))


def _pieces(cycles: Cycles, widening: float = 1.0) -> Iterator[Cycles]:
    """Yield pieces, each grown by the next cycle as long as that is near the mean so far."""
    amplitude, frequency = cycles.log_amplitude.tolist(), cycles.log_frequency.tolist()
    noise = np.clip(cycles.noise, _LEAST_NOISE, 1.0).tolist()
    first, a_sum, f_sum, inverse = 0, 0.0, 0.0, 0.0
    for j in range(len(cycles)):
        n = j - first
        if n:
            usual = min(noise[j], n / inverse)  # a transition is noisier than its neighbours
            a_tolerance, f_tolerance = _tolerances(usual)
            f_mean = f_sum / (n - 1) if n > 1 else frequency[j - 1]
            if (
                max(noise[j], noise[first]) < _NOISIEST
                and abs(amplitude[j] - a_sum / n) <= widening * a_tolerance
                and abs(frequency[j - 1] - f_mean) <= widening * f_tolerance
            ):
                f_sum += frequency[j - 1]
            else:
                yield cycles.part(first, j)
                first, a_sum, f_sum, inverse = j, 0.0, 0.0, 0.0
        a_sum += amplitude[j]
        inverse += 1.0 / noise[j]
    if len(cycles):
        yield cycles.part(first, len(cycles))


def _groups(cycles: Cycles, fewest: int) -> Iterator[Cycles]:
    """Yield groups of cycles of a drive that is not steady, without ramps."""
    pieces = [p for p in _pieces(cycles, _UNSTEADY) if len(p) >= fewest]
    while pieces:
        piece = pieces.pop(0)
        n = len(piece)
        if piece.trending and n >= 2 * fewest:
            pieces[:0] = piece.part(0, n // 2), piece.part(n // 2, n)
        elif not piece.ramping:
            yield piece


def _trimmed(piece: Cycles, fewest: int) -> Cycles:
    """Return a plateau without cycles at its ends that belong to a ramp."""
    deviation = np.abs(piece.log_amplitude - np.median(piece.log_amplitude))
    scatter = 1.5 * float(np.median(deviation))
    noise = _NOISE_FACTOR * max(piece.usual_noise, scatter)
    kept = np.flatnonzero(deviation <= max(_EDGE_TOLERANCE, noise))
    if kept.size == 0 or kept[-1] + 1 - kept[0] < fewest:
        return piece
    return piece.part(int(kept[0]), int(kept[-1]) + 1)


def _sweeps(cycles: Cycles) -> Iterator[Cycles]:
    """Return the parts of a run without jumps in which amplitude or frequency changes greatly."""
    if len(cycles) < 2:
        return
    jump = np.abs(np.diff(cycles.log_amplitude)) > _SWEEP_STEP
    jump[1:] |= np.abs(np.diff(cycles.log_frequency)) > _SWEEP_STEP
    jump |= np.maximum(cycles.noise[1:], cycles.noise[:-1]) > _NOISIEST
    bounds = np.concatenate([[0], np.flatnonzero(jump) + 1, [len(cycles)]])
    for first, last in pairwise(bounds.tolist()):
        sweep = cycles.part(first, last)
        ranges = [np.ptp(v) for v in (sweep.log_amplitude, sweep.log_frequency) if v.size]
        if len(sweep) >= _SWEEP_CYCLES[0] and max(ranges) > _SWEEP_RANGE:
            yield sweep


def _windows(sweep: Cycles, window: int | None) -> Iterator[Span]:
    """Cut a sweep into windows in which amplitude and frequency change little."""
    least, most = _SWEEP_CYCLES
    while len(sweep) >= (window or least):
        ahead = sweep.part(0, most)
        change = max(abs(_change(ahead.log_amplitude)), abs(_change(ahead.log_frequency)))
        fitting = int(len(ahead) * min(1.0, _SWEEP_CHANGE / max(change, 1e-12)))
        size = window or max(least, fitting)
        yield sweep.part(0, size).span(sweep=True)
        sweep = sweep.part(size, len(sweep))

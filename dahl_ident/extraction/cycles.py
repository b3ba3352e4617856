"""Cycles of a waveform, and the spans of a record that hold one level or a sweep.

A record of unknown frequency is cut at its rising crossings: from below ``-h`` to above ``+h``,
``h`` being a part of the amplitude, so noise makes none. Where the motion stays within ``±h`` for
long the search goes on with that part's own amplitude. A record of known frequency is cut into its
periods, in any noise. The phase of each cycle's own sine then puts its beginning right.

Cycle by cycle a piece grows while amplitude and frequency stay what they were on average. One that
is long enough and has no trend is a plateau, and becomes a point; the others are ramps. Where there
is more ramp than plateau the record is a sweep, cut into windows of little change. A drive such as
a crank may be steady for no two cycles: where plateaus hold less than half of the cycles that
neither sweep nor ramp, these are grouped with a wider tolerance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray

_THRESHOLD = 0.3  # fraction of the amplitude that a lobe exceeds; noise may be a tenth of it
_QUANTILES = (0.995, 0.9, 0.7)  # for the amplitude; the next where large lobes mislead the first
_QUIET = 1.5  # half cycles: a longer time within the threshold may hold another level
_FEWEST_SAMPLES = 16  # a shorter quiet part is not searched for cycles of its own
_ALIKE = 0.1  # of one sine: relative difference of periods, and part of a cycle off at most
_MOST_BRIDGED = 10.0  # cycles; a longer pause ends a sine
_DEEPEST = 12  # quiet parts within quiet parts: each below _THRESHOLD of the last, in all 5e-7
_SAMPLED = 50_000  # samples at most from which the quantiles are computed
_FEWEST_A_CYCLE = 3  # samples in a cycle: its mean and phasor are three numbers
_NOISIEST_CUT = 0.05  # largest noise of the log amplitude of a cycle whose frequency is known
_FEWEST_CUTS = 3  # averages that must be left: fewer do not show whether a level is held
_NOISIEST_CROSSING = 0.1  # largest noise of the log amplitude of a cycle between two crossings
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # its multiples are spread most evenly
_TOGETHER = 100_000  # samples computed at once, so that intermediate arrays stay in the cache
_HOLE = 1.0 / 3.0  # fraction of a cycle without samples that makes its amplitude unknown
Mode = Literal["auto", "steps", "sweep"]
MODES: tuple[Mode, ...] = ("auto", "steps", "sweep")
AMPLITUDE_TOLERANCE = 0.02  # of log amplitude within a plateau; steps of level are larger
FREQUENCY_TOLERANCE = 0.01  # of log frequency within a plateau
_UNSTEADY = 5.0  # factor by which tolerances widen for groups of cycles whose drive varies
_NOISE_FACTOR = 6.0  # tolerance in standard deviations of a cycle: noise alone splits no plateau
_WIDEST = 0.3  # largest tolerance, however large the noise
_LEAST_NOISE = 1e-12  # least noise of a log amplitude: its inverse square, a weight, stays finite
_NOISIEST = 0.2  # noise of a cycle's log amplitude above which it is not a cycle
_EDGE_TOLERANCE = 0.005  # relative; cycles at the ends of a plateau that differ more are left out
_MOSTLY_HELD = 0.5  # least share of the cycles in plateaus; with less, the record is a sweep
_CLEARLY_MORE = 1.5  # groups replace plateaus where they hold this many times as many cycles
_SLOW = 0.005  # largest change of log amplitude in a cycle that friction follows without a lag
_SCATTERED = 4.0  # standard deviations about a straight line within which a trend is scatter
_SWEEP_RANGE = 0.2  # least change of log amplitude or frequency over a whole sweep
_SWEEP_STEP = 0.2  # largest change of log amplitude or frequency from cycle to cycle of a sweep
_SWEEP_CHANGE = 0.1  # largest change of log amplitude or frequency in one window of a sweep
_SWEEP_CYCLES = (4, 20)  # least and most cycles in one window of a sweep


@dataclass(frozen=True)
class Span:
    """Start and stop, s, frequency in the middle, Hz, and where the spans next to it are."""

    start: float
    stop: float
    frequency_hz: float
    sweep: bool = False
    earliest: float = -np.inf
    latest: float = np.inf


@dataclass(frozen=True)
class Cycles:
    """Consecutive cycles of a sine; those with a hole in the sampling are left out.

    `noise` is the standard deviation of `log_amplitude`, and of the phase in rad. `log_frequency`
    is from the middle of one cycle to that of the next.
    """

    start: FloatArray
    stop: FloatArray
    log_amplitude: FloatArray
    noise: FloatArray
    log_frequency: FloatArray

    def __len__(self) -> int:
        return self.start.size

    def part(self, first: int, last: int) -> Cycles:
        """Return the cycles from `first` on, `last` not among them."""
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
        """Whether the amplitude goes one way, faster than friction follows."""
        a = self.log_amplitude
        n = len(self)
        line = np.polyfit(np.arange(n), a, 1)
        scatter = float(np.std(a - np.polyval(line, np.arange(n)), ddof=min(2, n - 1)))
        return self.trending and abs(_change(a)) > max(_SLOW * n, _SCATTERED * scatter)

    def span(self, *, sweep: bool = False) -> Span:
        """Return the time that they take, and their mean frequency."""
        frequency = float(np.exp(np.mean(self.log_frequency)))
        return Span(float(self.start[0]), float(self.stop[-1]), frequency, sweep)


def find_cycles(
    time: FloatArray, motion: FloatArray, frequency_hz: float | None = None
) -> list[Cycles]:
    """Cut a record into runs of consecutive cycles, or where their frequency is known into those.

    Where noise hides the amplitude of a period, several make one cycle.
    """
    if frequency_hz is None:
        runs = _crossing_runs(time, motion, 0)
        runs.sort(key=lambda edges: float(edges[0]))
        cycles = [_measured(time, motion, edges) for edges in _joined(runs)]
        return [  # noise alone may have made some of them: theirs is infinite
            replace(c, noise=np.where(c.noise > _NOISIEST_CROSSING, np.inf, c.noise))
            for c in cycles
        ]
    periods = _cut(time, motion, frequency_hz, 1)
    if len(periods):
        turns = min(
            int(np.ceil((periods.usual_noise / _NOISIEST_CUT) ** 2)), len(periods) // _FEWEST_CUTS
        )
        if turns > 1:
            periods = _cut(time, motion, frequency_hz, turns)
    return [periods]


def _cut(time: FloatArray, motion: FloatArray, frequency_hz: float, turns: int) -> Cycles:
    interval = float(np.median(np.diff(time)))
    count = int((time[-1] - time[0] + 1.5 * interval) * frequency_hz / turns)
    edges = time[0] - 0.5 * interval + np.arange(count + 1) * turns / frequency_hz
    return _measured(time, motion, edges, turns)


def _joined(runs: list[FloatArray]) -> list[FloatArray]:
    """Join runs that are a few cycles of the same period apart; what lies between is measured."""
    joined: list[FloatArray] = []
    for edges in runs:
        if joined:
            last = joined[-1]
            period, next_period = last[-1] - last[-2], edges[1] - edges[0]
            apart = (edges[0] - last[-1]) / period
            alike = abs(next_period / period - 1.0) < _ALIKE
            if alike and apart < _MOST_BRIDGED and abs(apart - round(apart)) < _ALIKE:
                bridge = np.linspace(last[-1], edges[0], round(apart) + 1)[1:-1]
                joined[-1] = np.concatenate([last, bridge, edges[0 if round(apart) else 1 :]])
                continue
        joined.append(edges)
    return joined


def _crossing_runs(time: FloatArray, motion: FloatArray, depth: int) -> list[FloatArray]:
    """Return the rising crossings, split where the motion is quiet, and those found there."""
    if time.size < _FEWEST_SAMPLES or depth > _DEEPEST:
        return []
    tried = (_runs_at(time, motion, quantile, depth) for quantile in _QUANTILES)
    return next(filter(None, tried), [])


def _runs_at(time: FloatArray, motion: FloatArray, quantile: float, depth: int) -> list[FloatArray]:
    """Return the rising crossings of the amplitude that a quantile gives."""
    seen = scattered(motion, _SAMPLED)
    low, high = np.quantile(seen, [1.0 - quantile, quantile])
    middle, threshold = 0.5 * (low + high), 0.5 * _THRESHOLD * (high - low)
    if not threshold > 1e-12 * max(abs(low), abs(high)):
        return []
    moved = motion - middle
    beyond = np.flatnonzero(np.abs(moved) > threshold)
    above = moved[beyond] > 0.0
    pause = np.diff(beyond) - 1
    long = np.flatnonzero(pause >= _FEWEST_SAMPLES)
    quiet = long[pause[long] > _QUIET * _lobe_spacing(beyond, above, long)]
    breaks = np.concatenate([[0], quiet + 1, [beyond.size]])
    runs: list[FloatArray] = []
    done = 0
    for first, last in pairwise(breaks.tolist()):
        rising = first + np.flatnonzero(~above[first : last - 1] & above[first + 1 : last])
        if rising.size < 2:
            continue
        runs.append(_crossings(time, moved, beyond[rising], beyond[rising + 1]))
        # a cycle before and after, the motion may have been on its way to or from these
        at = beyond[rising]
        start = max(int(2 * at[0] - at[1]), 0)
        runs += _crossing_runs(time[done:start], motion[done:start], depth + 1)
        done = int(2 * at[-1] - at[-2])
    if done:
        runs += _crossing_runs(time[done:], motion[done:], depth + 1)
    return runs


def scattered(samples: FloatArray, count: int) -> FloatArray:
    """Return so many samples, spread over the record and over the phases of any period."""
    size = samples.shape[-1]
    if size <= count:
        return samples
    places = np.arange(count) * _GOLDEN % 1.0  # a plain stride may fit the period of the motion
    return np.asarray(samples[..., np.sort((places * size).astype(np.intp))])


def _lobe_spacing(
    beyond: NDArray[np.intp], above: NDArray[np.bool_], pairs: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return, for pairs of samples beyond the threshold, how far lobes near each are apart."""
    turns = np.flatnonzero(above[1:] != above[:-1]) + 1
    lobe = np.searchsorted(turns, pairs, side="right")
    starts = beyond[np.concatenate([[0], turns])]
    far = np.full(1, beyond[-1] + 1)
    spacing = np.concatenate([far, np.diff(starts), far, far])
    before, after = spacing[lobe], spacing[lobe + 2]
    return np.asarray(np.minimum(before, after))


def _crossings(
    time: FloatArray, moved: FloatArray, before: NDArray[np.intp], after: NDArray[np.intp]
) -> FloatArray:
    """Return where zero is crossed between samples before and after."""
    upward = np.flatnonzero((moved[:-1] < 0.0) & (moved[1:] >= 0.0))
    first = upward[np.searchsorted(upward, before)]
    last = upward[np.searchsorted(upward, after) - 1]
    at = np.array([first, last])
    share = moved[at] / (moved[at] - moved[at + 1])
    return np.asarray(np.mean(time[at] + share * (time[at + 1] - time[at]), axis=0))


def _measured(time: FloatArray, motion: FloatArray, edges: FloatArray, turns: int = 1) -> Cycles:
    """Return the amplitude of each cycle, of so many turns, and the frequency to the next."""
    cuts = np.searchsorted(time, edges)
    counts = np.diff(cuts)
    known = np.flatnonzero((counts >= _FEWEST_A_CYCLE) & ~_with_hole(time, edges))
    start, stop, n = edges[known], edges[known + 1], counts[known]
    fits = []
    for first, last in groups_of_cycles(cuts):
        inside = slice(int(cuts[first]), int(cuts[last]))
        per_cycle = counts[first:last]
        turn = np.repeat(2.0 * np.pi * turns / np.diff(edges[first : last + 1]), per_cycle)
        theta = (time[inside] - np.repeat(edges[first:last], per_cycle)) * turn
        those = known[(known >= first) & (known < last)]
        bounds = np.column_stack([cuts[those], cuts[those + 1]]).ravel() - cuts[first]
        fits.append(sine_in_each(theta, motion[inside], bounds, counts[those]))
    if not fits:
        fits = [sine_in_each(time[:0], motion[:0], known, n)]
    phasor, left = (np.concatenate(column) for column in zip(*fits, strict=True))
    amplitude = np.maximum(np.abs(phasor), np.finfo(np.float64).tiny)
    noise = np.sqrt(2.0 * left / n) / amplitude
    return Cycles(
        start, stop, np.log(amplitude), noise, _log_frequency(start, stop, np.angle(phasor), turns)
    )


def groups_of_cycles(cuts: NDArray[np.intp]) -> Iterator[tuple[int, int]]:
    """Yield first and last cycle of groups whose samples, from cut to cut, stay in the cache."""
    groups = np.searchsorted(cuts, np.arange(cuts[0], cuts[-1], _TOGETHER), side="right") - 1
    yield from pairwise([*np.unique(groups).tolist(), cuts.size - 1])


def sine_in_each(
    theta: FloatArray, y: FloatArray, bounds: NDArray[np.intp], n: NDArray[np.intp]
) -> tuple[ComplexArray, FloatArray]:
    """Return the phasor of each cycle, offset fitted as well, and the variance it leaves."""
    middle = 0.5 * float(y.min() + y.max()) if y.size else 0.0
    y = y - middle
    rotor = np.exp(-1j * theta)
    one, two, with_y = (_sums(v, bounds) for v in (rotor, rotor * rotor, rotor * y))
    total, power = _sums(y, bounds), _sums(y * y, bounds)
    c, s = one.real, -one.imag
    cc, ss, cs = 0.5 * (n + two.real), 0.5 * (n - two.real), -0.5 * two.imag
    normal = np.array([[n, c, s], [c, cc, cs], [s, cs, ss]]).transpose(2, 0, 1)
    right = np.array([total, with_y.real, -with_y.imag]).T
    fitted = np.linalg.solve(normal + 1e-9 * n[:, None, None] * np.eye(3), right[:, :, None])[
        ..., 0
    ]
    left = np.maximum(power - np.sum(fitted * right, axis=1), 0.0) / n
    return fitted[:, 1] - 1j * fitted[:, 2], left


def _sums(values: NDArray[Any], bounds: NDArray[np.intp]) -> NDArray[Any]:
    """Return the sums between pairs of bounds."""
    return np.add.reduceat(np.append(values, 0.0), bounds)[::2] if bounds.size else values[:0]


def _log_frequency(
    start: FloatArray, stop: FloatArray, phase: FloatArray, turns: int
) -> FloatArray:
    """Return the mean frequency from the middle of each cycle to that of the next."""
    middle, period = 0.5 * (start + stop), stop - start
    missing = (start[1:] - stop[:-1]) / (0.5 * (period[1:] + period[:-1]))
    fraction = np.diff(phase) / (2.0 * np.pi)
    whole = np.round(turns * (1.0 + missing) - fraction)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.log((whole + fraction) / np.diff(middle)))


def _with_hole(time: FloatArray, edges: FloatArray) -> NDArray[np.bool_]:
    """Return which cycles have a part of them without samples."""
    periods = np.diff(edges)
    broken = np.zeros(periods.size, dtype=bool)
    steps = np.diff(time)
    for i in np.flatnonzero(steps > _HOLE * periods.min(initial=np.inf)):
        first = max(int(np.searchsorted(edges, time[i], side="right")) - 1, 0)
        last = int(np.searchsorted(edges, time[i + 1]))
        broken[first:last] |= steps[i] > _HOLE * periods[first:last]
    return broken


def find_spans(runs: Sequence[Cycles], mode: Mode, fewest: int, window: int | None) -> list[Span]:
    """Return the spans of runs of consecutive cycles, in order of time.

    Plateaus of `fewest` cycles at least, windows of sweeps (of `window` cycles, or as many as
    change little), or whichever there is more of.
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


def _pieces(cycles: Cycles, unsteady: float = 1.0) -> Iterator[Cycles]:
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
                yield cycles.part(first, j)
                first, a_sum, f_sum, inverse = j, 0.0, 0.0, 0.0
        a_sum += amplitude[j]
        inverse += 1.0 / noise[j]
    if len(cycles):
        yield cycles.part(first, len(cycles))


def _groups(cycles: Cycles, fewest: int) -> Iterator[Cycles]:
    """Group the cycles of a drive that is not steady; ramps are none of them."""
    waiting = [p for p in _pieces(cycles, _UNSTEADY) if len(p) >= fewest]
    while waiting:
        piece = waiting.pop(0)
        n = len(piece)
        if piece.trending and n >= 2 * fewest:
            waiting[:0] = piece.part(0, n // 2), piece.part(n // 2, n)
        elif not piece.ramping:
            yield piece


def _trimmed(piece: Cycles, fewest: int) -> Cycles:
    """Leave out cycles at the ends that stray from the plateau's level, the rest of a ramp."""
    stray = np.abs(piece.log_amplitude - np.median(piece.log_amplitude))
    scatter = 1.5 * float(np.median(stray))
    noise = _NOISE_FACTOR * max(piece.usual_noise, scatter)
    kept = np.flatnonzero(stray <= max(_EDGE_TOLERANCE, noise))
    if kept.size == 0 or kept[-1] + 1 - kept[0] < fewest:
        return piece
    return piece.part(int(kept[0]), int(kept[-1]) + 1)


def _sweeps(cycles: Cycles) -> Iterator[Cycles]:
    """Return the parts of a run in which nothing jumps, yet something changes much."""
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

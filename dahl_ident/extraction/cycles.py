"""Cycles of a waveform: their starts, amplitudes and frequencies.

A record of unknown frequency is cut at its rising crossings. A crossing counts when the motion
goes from below ``-h`` to above ``+h``, so noise makes none; ``h`` is a part of the amplitude, and
where the motion stays within ``±h`` for long the search goes on there with that part's own
amplitude. So levels that differ by any factor are found, each about its own mean. Where the
frequency is known the record is cut into its periods instead, which works in any noise.

The phase of each cycle's own sine then puts its beginning right, so amplitude and frequency of a
cycle have the noise of a sine fit, and not that of a few samples near zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray

_THRESHOLD = 0.3  # of the amplitude; sine noise may be a tenth of it
_QUANTILES = (0.995, 0.9, 0.7)  # for the amplitude; the next where a part of a lobe misleads
_QUIET = 1.5  # half cycles: a longer time within the threshold may hold another level
_FEWEST_SAMPLES = 16  # of a quiet part that is searched for cycles of its own
_ALIKE = 0.1  # relative difference of periods, and cycles off a whole number, of one sine
_MOST_BRIDGED = 10.0  # cycles
_DEEPEST = 12  # quiet parts within quiet parts: each below _THRESHOLD of the last, in all 5e-7
_SAMPLED = 50_000  # samples that the quantiles are taken from
_FEWEST_A_CYCLE = 3  # samples, as many as mean and phasor have numbers
_NOISIEST_CUT = 0.05  # noise of the log amplitude that a cycle of known frequency may have
_FEWEST_CUTS = 3  # that averaging leaves: fewer do not show whether a level is held
_NOISIEST_CROSSING = 0.1  # noise of the log amplitude that a cycle between crossings may have
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # its multiples are spread most evenly
_TOGETHER = 100_000  # samples: what is computed of them stays in the cache
_HOLE = 1.0 / 3.0  # of a cycle without samples: its amplitude is not known


@dataclass(frozen=True)
class Cycles:
    """Consecutive cycles of a sine; those with a hole in the sampling are left out.

    `noise` is the standard deviation of `log_amplitude`, and of the phase in rad.
    `log_frequency` belongs to the boundaries, from the middle of one cycle to that of the next.
    """

    start: FloatArray
    stop: FloatArray
    log_amplitude: FloatArray
    noise: FloatArray
    log_frequency: FloatArray

    def __len__(self) -> int:
        return self.start.size


def find_cycles(time: FloatArray, motion: FloatArray) -> list[Cycles]:
    """Cut a record of unknown frequencies into runs of consecutive cycles, in order of time."""
    runs = _crossing_runs(time, motion, 0)
    runs.sort(key=lambda edges: float(edges[0]))
    cycles = [_measured(time, motion, edges) for edges in _joined(runs)]
    return [  # noise alone may have made some of them: theirs is infinite
        replace(c, noise=np.where(c.noise > _NOISIEST_CROSSING, np.inf, c.noise)) for c in cycles
    ]


def cut_cycles(time: FloatArray, motion: FloatArray, frequency_hz: float) -> list[Cycles]:
    """Cut a record of known frequency into its periods, from the first sample on.

    Where noise hides the amplitude of a period, so many periods are taken for one cycle that it
    does not.
    """
    cycles = _cut(time, motion, frequency_hz, 1)
    if len(cycles):
        noise = float(np.median(cycles.noise))
        turns = min(int(np.ceil((noise / _NOISIEST_CUT) ** 2)), len(cycles) // _FEWEST_CUTS)
        if turns > 1:
            cycles = _cut(time, motion, frequency_hz, turns)
    return [cycles]


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
            period, other = last[-1] - last[-2], edges[1] - edges[0]
            apart = (edges[0] - last[-1]) / period
            alike = abs(other / period - 1.0) < _ALIKE
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
    for quantile in _QUANTILES:
        runs = _runs_at(time, motion, quantile, depth)
        if runs:
            return runs
    return []


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
    """Return so many samples, evenly spread over the record and over the phases of any period.

    The places are multiples of the golden section. A plain stride may fit the period of the
    motion, and then sees a few phases only.
    """
    if samples.size <= count:
        return samples
    places = np.arange(count) * _GOLDEN % 1.0
    return np.asarray(samples[np.sort((places * samples.size).astype(np.intp))])


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
    groups = np.searchsorted(cuts, np.arange(cuts[0], cuts[-1], _TOGETHER), side="right") - 1
    fits = []
    for first, last in pairwise([*np.unique(groups).tolist(), edges.size - 1]):
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

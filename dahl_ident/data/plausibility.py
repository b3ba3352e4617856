"""Plausibility of tables and records: warnings that list the rows, and errors.

A passive structure dissipates ``pi A^2 Im Z`` per cycle. Single negative rows may be due to noise;
a sum that is negative by more than its noise means a wrong sign of the phase, or wrong columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.rows import sizes
from dahl_ident.errors import DataError
from dahl_ident.units import percent

Warn = Callable[[BoolArray, str], None]
"""A function that warns about the marked rows, if any, with a message."""
_SIGNIFICANT = 0.00135  # one-sided probability of three standard deviations
_ASSUMED_ERROR = 0.1  # relative error of the gain if no covariance is known
_MISMATCH = 0.1  # of a logarithm (rms for zero to peak causes 0.35); also of a change of gain
_FEWEST_ROWS, _FEW_ROWS = 3, 0.26  # rows to compare, and fraction of them that may be wrong
_STUCK_SAMPLES, _STUCK_TRAVEL = 8, 0.02  # samples of one value; change of the other signal
_SELDOM, _MOSTLY = 0.01, 0.5  # fractions of repeated values: hardly any, and most of the signal
_SWITCH = 8  # samples before and after a change of unit that are compared
_DECADES = 1.0  # by which an apparent change of unit may differ from a factor of 1000
_CONTINUOUS = 4.0  # steps within which a smooth signal continues; beyond twice it is not zero
_LARGEST_STEP = 5.0  # mean steps that a signal may move from one sample to the next
_MOST_CHANGES = 2  # of the unit, there and back; more mean a signal of many scales
_AT_ONCE = 1 << 20  # samples compared at once, to limit memory
_SMALL_PHASE = 0.1  # rad, over the relative change of the gain


def check_phase_unit(phase: FloatArray, degrees: bool, name: str, warn: Warn) -> None:
    """Warn if a phase in degrees looks like radians, or the reverse."""
    size = np.abs(phase)
    if degrees and 0.5 <= size.max() <= 2.0 * np.pi and phase.size > 1:
        warn(
            np.ones(phase.shape, dtype=bool),
            f"column {name!r} is in degrees, yet no phase is above 2 pi; are they radians?",
        )
    if not degrees:
        warn(
            size > 4.0 * np.pi,
            f"column {name!r} is in radians, yet these phases are above 4 pi; are they degrees?",
        )


def check_drive(data: FrequencyResponse, warn: Warn) -> None:
    """Warn about rows whose drive is not the response times the amplitude."""
    amplitude, drive, fundamental = data.amplitude, data.drive, data.harmonic == 1
    if amplitude is None or drive is None or not fundamental.any():
        return
    gain = data.select(harmonic=1).to("dynamic_stiffness").gain
    mismatch = np.zeros(data.n)
    mismatch[fundamental] = np.log(gain) + np.log(amplitude / drive)[fundamental]
    warn(
        np.abs(mismatch) > _MISMATCH,
        "drive and amplitude do not agree with the response by more than "
        f"{percent(_MISMATCH)} (rms against zero to peak?)",
    )


def check_energy(file: str, data: FrequencyResponse, warn: Warn) -> None:
    """Warn about single rows that create energy; refuse a table that does so as a whole."""
    fundamental = data.harmonic == 1
    if not fundamental.any():
        return
    part = data.select(harmonic=1).to("dynamic_stiffness")
    amplitude = np.asarray(sizes(part)[1])
    stiffness = part.gain.max()  # scaled by the largest, squares stay within range
    weight = (amplitude / amplitude.max()) ** 2
    loss = weight * part.response.imag / stiffness
    if part.covariance is None:
        std = weight * _ASSUMED_ERROR * part.gain / stiffness
    else:
        std = weight * np.sqrt(part.covariance[:, 1, 1]) / stiffness
    dof = np.full(part.n, np.inf) if part.dof is None else part.dof
    variance = (std / std.max()) ** 2 if std.any() else std  # relative to the largest
    total, total_std = loss.sum(), std.max() * np.sqrt(variance.sum())
    denominator = np.sum(variance**2 / dof)  # of the Welch-Satterthwaite formula
    total_dof = np.inf if denominator == 0.0 else variance.sum() ** 2 / denominator
    if total < -_limit(total_dof) * total_std:
        raise DataError(
            f"{file}: the table as a whole creates energy: the sum of A^2 Im(F/X) is negative, "
            f"{-total / total_std if total_std else np.inf:.3g} times its standard error. Does the "
            "instrument count the phase the other way round (sign = -1 for the phase), or do the "
            "columns hold another quantity?"
        )
    creating = np.zeros(data.n, dtype=bool)
    creating[fundamental] = creates_energy(loss, std, dof)
    sine = part.response.imag / part.gain
    negative = sine < 0.0
    few = part.n >= _FEWEST_ROWS and negative.sum() <= max(1.0, _FEW_ROWS * part.n)
    if part.covariance is None and few:  # phases as large as those of the others, but negative
        creating[fundamental] |= sine < -0.5 * np.median(sine[~negative])
    warn(creating, "the phase's sign creates energy")


def check_phase_size(data: FrequencyResponse, warn: Warn) -> None:
    """Warn if the gain changes with the amplitude and the phase is far too small for that.

    Friction that reduces the gain by a fraction d changes the phase by about d rad.
    """
    fundamental = data.harmonic == 1
    for frequency in np.unique(data.frequency_hz[fundamental]):
        rows = fundamental & (data.frequency_hz == frequency)
        response, gain = data.response[rows], data.gain[rows]
        change = 1.0 - gain.min() / gain.max()
        angle = np.abs(np.arcsin(np.clip(response.imag / gain, -1.0, 1.0))).max()
        small = 0.0 < angle < _SMALL_PHASE * change
        if gain.size >= _FEWEST_ROWS and change > _MISMATCH and small:
            warn(
                rows,
                f"the gain varies by {percent(change)} at {frequency:g} Hz, yet no phase is above "
                f"{np.degrees(angle):.2g} degrees; are the phases in radians?",
            )


def record_warnings(
    time: FloatArray, motion: FloatArray, force: FloatArray
) -> Iterator[tuple[IntArray, str]]:
    """Yield samples where a sensor sticks, samples are lost or the unit changes; and a message."""
    if not 2 < force.size == motion.size == time.size:
        return
    yield (
        _stuck(force, motion),
        "the force repeats one value while the motion goes on, from {}: does a converter stick?",
    )
    yield (
        _stuck(motion, force, smooth=True),
        "the motion repeats one value while the force goes on, from {}: does a sensor stick?",
    )
    starts, stops = _runs((motion == 0.0) & (force == 0.0))
    least = np.where((starts > 0) & (stops < time.size - 1), 0.2, 3.0)  # at an end it may be a rest
    lost = np.zeros(starts.shape, dtype=bool)
    for values in (motion, force) if starts.size else ():
        lost |= _edges(values, starts, stops) > least * _usual(np.abs(np.diff(values)))
    yield starts[lost], "motion and force are 0 for a while, from {}: are samples missing?"
    for name, values, partner in (("motion", motion, force), ("force", force, motion)):
        yield (
            _few(np.union1d(_unit_changes(values, partner), _scaled_values(values))),
            f"the {name} is 1000 times larger or smaller from {{}}: another unit?",
        )
    ratio = np.log10(np.diff(time)[2:] / np.diff(time)[:-2])
    places = _few(2 + np.flatnonzero(np.abs(np.abs(ratio) - 3.0) < 0.05 * _DECADES))
    yield places, "steps of time are 1000 times larger or smaller from {}: another unit?"


def _stuck(signal: FloatArray, partner: FloatArray, *, smooth: bool = False) -> IntArray:
    """Return the first samples of runs in which one signal is constant while the other changes."""
    steps = np.abs(np.diff(signal))
    starts, stops = _runs(np.concatenate([[False], steps == 0.0]))
    starts = starts - 1  # the first sample of the repeated value
    travel = np.abs(partner[[(starts + stops) // 2, stops]] - partner[starts]).max(axis=0)
    moved = travel > _STUCK_TRAVEL * np.ptp(partner)
    starts, stops = starts[moved], stops[moved]
    if not starts.size or not steps.any():  # a force that is always 0 is a free decay
        return np.asarray(starts[:1] if smooth else starts[:0])
    usual, count = _usual(steps), np.sum(steps == 0.0)
    jumps = np.append(steps, 0.0)[stops] > 5.0 * usual
    jumps |= (signal[starts] == 0.0) & (_edges(signal, starts, stops) > 3.0 * usual)
    if smooth:  # a smooth signal has no step much larger than its usual second differences
        bend = np.quantile(np.abs(np.diff(signal, 2)), 0.98)
        jumps |= _edges(signal, starts, stops) > 5.0 * float(bend)
    stuck_samples = np.sum(stops - starts)
    if count - stuck_samples < _SELDOM * signal.size and stuck_samples < _MOSTLY * signal.size:
        value, first, count = np.unique(signal[starts], return_index=True, return_counts=True)
        once = (count == 1) & (value > signal.min()) & (value < signal.max())
        jumps[first[once]] = True
    return np.asarray(starts[jumps])


def _runs(marked: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first and the last sample of each long run of marked samples."""
    change = np.diff(np.concatenate([[False], marked, [False]]).view(np.int8))
    starts, stops = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    long = stops - starts + 1 >= _STUCK_SAMPLES
    return starts[long], stops[long]


def _edges(values: FloatArray, starts: IntArray, stops: IntArray) -> FloatArray:
    """Return the larger of the steps into and out of each run; 0 at the ends of the record."""
    steps = np.concatenate([[0.0], np.abs(np.diff(values)), [0.0]])
    return np.asarray(np.maximum(steps[starts], steps[stops + 1]))


def _usual(steps: FloatArray) -> float:
    """Return the 95 % quantile of the nonzero steps; 0 if there are none."""
    return float(np.quantile(steps[steps > 0.0], 0.95)) if steps.any() else 0.0


def _unit_changes(values: FloatArray, partner: FloatArray) -> IntArray:
    """Return the samples from which values are 1000 times larger or smaller than before."""
    if values.size > 2 * _AT_ONCE:
        parts = [slice(i, i + _AT_ONCE + 2 * _SWITCH) for i in range(0, values.size, _AT_ONCE)]
        return np.unique(
            np.concatenate([p.start + _unit_changes(values[p], partner[p]) for p in parts])
        )
    at = np.arange(4, values.size - 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        before, after = _sizes(values, at, 1)
        change = np.log10(after / before)
        bend = np.log10(np.divide(*_sizes(values, at, 2)))
        later = np.minimum(at + _SWITCH, values.size - 4)
        others = [np.log10(np.divide(*_sizes(partner, i, 1))) for i in (at, later)]
        step = np.abs(values[at] * 10.0 ** (-3.0 * np.sign(change)) - values[at - 1])
    changed = (step < _LARGEST_STEP * before) & ~(np.abs(others) > 1.5 * _DECADES).any(axis=0)
    for ratio in (change, bend):
        changed &= np.abs(np.abs(ratio) - 3.0) < _DECADES
    return np.asarray(at[changed])


def _scaled_values(values: FloatArray) -> IntArray:
    """Return the samples from which a smooth signal, far from zero, is scaled by 1000 or 1/1000."""
    if values.size < _SWITCH:
        return np.zeros(0, dtype=np.intp)
    steps = np.abs(np.diff(values))
    before, first, second = values[2:-2], values[3:-1], values[4:]
    least = _CONTINUOUS * np.maximum(steps[:-3], steps[1:-2])
    far = (np.abs(before) > 2.0 * least) & (least > 0.0)
    scaled = np.zeros(before.shape, dtype=bool)
    for factor in (1e3, 1e-3):
        continues = np.abs(factor * first - before) < least
        scaled |= continues & (np.abs(factor * (second - first)) < least)
    return np.asarray(3 + np.flatnonzero(far & scaled))


def _sizes(values: FloatArray, at: IntArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Return mean differences of the given order before and after some samples."""
    size = np.abs(np.diff(values, order))
    total = np.concatenate([[0.0], np.cumsum(size)])
    low, high = np.maximum(at - order - _SWITCH, 0), np.minimum(at + _SWITCH, size.size)
    before = (total[at - order] - total[low]) / (at - order - low)
    return before, (total[high] - total[at]) / (high - at)


def _few(samples: IntArray) -> IntArray:
    """Return the first of neighbouring samples; none if there are many, as in random numbers."""
    first = samples[np.diff(samples, prepend=-2 * _SWITCH) > _SWITCH]
    return first if first.size <= _MOST_CHANGES else first[:0]


def creates_energy(loss: FloatArray, std: FloatArray, dof: FloatArray) -> BoolArray:
    """Return which losses are negative by more than their noise."""
    return np.asarray(loss < -_limit(dof) * std)


def _limit(dof: ArrayLike) -> FloatArray:
    """Return the critical value of Student's t; of the normal distribution for infinite dof."""
    return -np.asarray(stdtrit(np.minimum(dof, 1e9), _SIGNIFICANT))

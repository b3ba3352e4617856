"""Check that a record is a sine measurement: one spectral line, or similar neighbouring cycles.

Random motion, an earthquake, or point-to-point motion of a drive cross zero as well, and a few of
their cycles look alike by chance. In a sine test (steady levels, steps, sweeps, an unsteady
crank) almost every cycle is like the one before it. Cycles count by their energy, so noise during
rests does not.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import spelled
from dahl_ident.extraction.cycles import Cycles
from dahl_ident.units import percent

_PERIOD_CHANGE = 0.03  # limit from one cycle to the next (median by energy) of a sine measurement
_AMPLITUDE_CHANGE = 0.1  # the same of the amplitude, which resonances change faster
_SWEEP_RANGE = 0.2  # of the log period: less may be chance
_FEWEST_OF_SWEEP = 6  # cycles: four changes of the period's change
_FEWEST_PAIRS = 2  # of cycles, that show how alike they are
_NOISY = 0.03  # of a cycle's log amplitude
_SINE_IN_NOISE = 0.3  # of the power near the strongest line, where noise spoils the cycles
_ONE_LINE = 0.8  # of the power, of one level whatever its cycles look like
_LEAK = 2  # lines on either side that a line leaks into
_SPECTRUM_OF = 2**20  # samples at most


def route(file: str | None = None) -> str:
    """Return what else can be done with a record; `file` is that of a sweep of the force."""
    if file is None:
        how = spelled("di.fit(record, model)", "dahl-ident fit --record")
        return (
            "expected levels or a sweep of one sine; for any other motion fit the waveform itself: "
            f"{how}"
        )
    model = "--mass free --damping free --stiffness free"
    how = spelled("di.fit(record, model)", f"dahl-ident fit --record {shlex.quote(file)} {model}")
    return (
        "the force is a sweep of one sine, which the motion is too unsteady to follow in a table; "
        f"fit the waveforms: {how}"
    )


def not_a_sine_test(motion: FloatArray, runs: Sequence[Cycles], covered: float) -> str:
    """Return why the motion is not a sine measurement; empty where it may be one.

    `runs` are its cycles between crossings, `covered` is the share of the moving time that points
    cover; chance makes some of any motion.
    """
    noise, period, amplitude, pairs = _neighbours(runs)
    unlike = period > _PERIOD_CHANGE or amplitude > _AMPLITUDE_CHANGE
    if pairs >= _FEWEST_PAIRS and not unlike:
        return ""
    line, turns = _strongest_line(motion)
    in_noise = pairs >= _FEWEST_PAIRS and (covered > 0.0 or noise > _NOISY)
    if line > (_SINE_IN_NOISE if in_noise else _ONE_LINE) and turns > 1:
        return ""
    power = f"its strongest line has {percent(line)} of the power"
    if pairs < _FEWEST_PAIRS:
        short = ", or a record too short for one" if turns < _FEWEST_PAIRS else ""
        return f"not a sine test{short}: the motion has no two consecutive cycles, and {power}"
    return (
        f"not a sine test: neighbouring cycles of the motion differ by {percent(period)} in "
        f"period and {percent(amplitude)} in amplitude (median), and {power}"
    )


def is_sweep(runs: Sequence[Cycles]) -> bool:
    """Return whether a drive is one sine whose period changes evenly from cycle to cycle."""
    if not runs:
        return False
    run = max(runs, key=len)
    period = np.log(run.stop - run.start)
    if len(run) < _FEWEST_OF_SWEEP or np.ptp(period) < _SWEEP_RANGE:
        return False
    energy = np.exp(2.0 * (run.log_amplitude - run.log_amplitude.max()) + period)[1:-1]
    bend = _median(np.abs(np.diff(period, 2)), energy)
    steps = _median(np.abs(np.diff(run.log_amplitude))[1:], energy)
    return bend <= _PERIOD_CHANGE and steps <= _AMPLITUDE_CHANGE


def _neighbours(runs: Sequence[Cycles]) -> tuple[float, float, float, int]:
    """Return medians by energy: noise of cycles, change of period and amplitude; and pairs."""
    pairs = [
        (
            np.maximum(run.noise[1:], run.noise[:-1]),
            np.abs(np.diff(np.log(run.stop - run.start))),
            np.abs(np.diff(run.log_amplitude)),
            2.0 * np.minimum(run.log_amplitude[1:], run.log_amplitude[:-1])
            + np.log(run.stop[1:] - run.start[:-1]),
        )
        for run in runs
        if len(run) > 1
    ]
    if not pairs:
        return np.inf, np.inf, np.inf, 0
    noise, period, amplitude, log_energy = (np.concatenate(c) for c in zip(*pairs, strict=True))
    energy = np.exp(log_energy - log_energy.max())
    return (
        _median(noise, energy), _median(period, energy), _median(amplitude, energy), energy.size
    )  # fmt: skip


def _median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


def _strongest_line(motion: FloatArray) -> tuple[float, int]:
    """Return the share of the power near the strongest line, and its periods in what is seen."""
    start = max(0, (motion.size - _SPECTRUM_OF) // 2)
    part = motion[start : start + _SPECTRUM_OF]
    power = np.abs(np.fft.rfft(part - part.mean())[1:]) ** 2
    total = float(power.sum())
    strongest = int(np.argmax(power))
    near = power[max(strongest - _LEAK, 0) : strongest + _LEAK + 1]
    return (float(near.sum()) / total, strongest + 1) if total else (1.0, motion.size)

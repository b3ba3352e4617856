"""Plausibility of a table: warnings that list the rows, an error where a table must be wrong.

A passive structure takes energy from its drive: each cycle dissipates ``pi A^2 Im Z`` at the
fundamental, where Z is the dynamic stiffness. Single negative rows may be noise; if the sum of a
whole table is negative by more than its noise, the sign of the phase or the choice of columns is
wrong.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from dahl_ident.arrays import FloatArray
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.errors import DataError

Doubt = Callable[[NDArray[np.bool_], str], None]
"""What warns of the rows that are marked, with a message, if there are any."""
_SIGNIFICANT = 0.00135  # one-sided; three standard deviations of a normal distribution
_ASSUMED_ERROR = 0.1  # of the gain, where no covariance is known
_MISMATCH = 0.1  # of a logarithm: rms for zero to peak is 0.35; also a fall of the gain
_FEWEST_ROWS, _FEW_ROWS = 3, 0.26  # rows to compare, and the share of them that may be wrong
_STUCK_SAMPLES, _STUCK_TRAVEL = 8, 0.02  # samples of one value, and share of the motion's range
_SELDOM, _MOSTLY = 0.01, 0.5  # shares of a signal that repeats no value, and of one that holds it
_SMALL_PHASE = 0.1  # rad, for a gain that falls to nothing


def check_phase_unit(phase: FloatArray, degrees: bool, name: str, doubt: Doubt) -> None:
    """Warn where a phase in degrees looks like radians, or the reverse."""
    largest = np.abs(phase).max()
    everywhere = np.ones(phase.shape, dtype=bool)
    if degrees and 0.5 <= largest <= 2.0 * np.pi and phase.size > 1:
        doubt(
            everywhere,
            f"column {name!r} is in degrees, yet no phase is above 2 pi; are they radians?",
        )
    if not degrees:
        doubt(
            np.abs(phase) > 4.0 * np.pi,
            f"column {name!r} is in radians, yet these phases are above 4 pi; are they degrees?",
        )


def check_drive(data: FrequencyResponse, doubt: Doubt) -> None:
    """Warn where the drive is not the response times the amplitude."""
    amplitude, drive, fundamental = data.amplitude, data.drive, data.harmonic == 1
    if amplitude is None or drive is None or not fundamental.any():
        return
    gain = data.select(harmonic=1).to("dynamic_stiffness").gain
    mismatch = np.zeros(data.n)
    mismatch[fundamental] = np.log(gain) + np.log(amplitude / drive)[fundamental]
    doubt(
        np.abs(mismatch) > _MISMATCH,
        "drive and amplitude do not agree with the response by more than "
        f"{_MISMATCH:.0%} (rms against zero to peak?)",
    )


def check_energy(file: str, data: FrequencyResponse, doubt: Doubt) -> None:
    """Warn of single rows that create energy, refuse a table that does as a whole.

    Raises
    ------
    DataError
        If the sum of A^2 Im Z is significantly below zero. Without a covariance an error of
        10 % of each response is allowed for.
    """
    fundamental = data.harmonic == 1
    if not fundamental.any():
        return
    part = data.select(harmonic=1).to("dynamic_stiffness")
    amplitude = _amplitude(part)
    stiffness = part.gain.max()  # scaled by the largest, squares stay within range
    weight = (amplitude / amplitude.max()) ** 2
    loss = weight * part.response.imag / stiffness
    if part.covariance is None:
        std = weight * _ASSUMED_ERROR * part.gain / stiffness
    else:
        std = weight * np.sqrt(part.covariance[:, 1, 1]) / stiffness
    dof = np.full(part.n, np.inf) if part.dof is None else part.dof
    share = (std / std.max()) ** 2 if std.any() else std
    total, total_std = loss.sum(), std.max() * np.sqrt(share.sum())
    spread = np.sum(share**2 / dof)
    total_dof = np.inf if spread == 0.0 else share.sum() ** 2 / spread  # Welch and Satterthwaite
    if total < -_limit(total_dof) * total_std:
        raise DataError(
            f"{file}: the table as a whole creates energy: the sum of A^2 Im(F/X) is negative, "
            f"{-total / total_std if total_std else np.inf:.3g} times its standard error. Does the "
            "instrument count the phase the other way round (sign = -1 for the phase), or do the "
            "columns hold another quantity?"
        )
    creating = np.zeros(data.n, dtype=bool)
    creating[fundamental] = creates_energy(loss, std, dof)
    if part.covariance is None:
        creating[fundamental] |= _against_the_others(part)
    doubt(creating, "the phase's sign creates energy")


def _against_the_others(part: FrequencyResponse) -> NDArray[np.bool_]:
    """Return the rows whose phase is as large as that of nearly all others, with opposite sign."""
    sine = part.response.imag / part.gain
    against = sine < 0.0
    if part.n < _FEWEST_ROWS or against.sum() > max(1.0, _FEW_ROWS * part.n):
        return np.zeros(part.n, dtype=bool)
    return np.asarray(sine < -0.5 * np.median(sine[~against]))


def check_phase_size(data: FrequencyResponse, doubt: Doubt) -> None:
    """Warn where the gain falls with the amplitude and the phase is far too small for it.

    Friction that takes a share d off the gain at one frequency turns the phase by about d rad;
    radians read as degrees are 57 times too small.
    """
    fundamental = data.harmonic == 1
    if data.amplitude is None and data.drive is None:
        return
    for frequency in np.unique(data.frequency_hz[fundamental]):
        rows = fundamental & (data.frequency_hz == frequency)
        part = data.select(rows=rows)
        fall = 1.0 - part.gain.min() / part.gain.max()
        angle = np.abs(np.arcsin(np.clip(part.response.imag / part.gain, -1.0, 1.0))).max()
        if part.n >= _FEWEST_ROWS and fall > _MISMATCH and 0.0 < angle < _SMALL_PHASE * fall:
            doubt(
                rows,
                f"the gain varies by {fall:.0%} at {frequency:g} Hz, yet no phase is above "
                f"{np.degrees(angle):.2g} degrees; are the phases in radians?",
            )


def stuck_samples(motion: FloatArray, force: FloatArray) -> NDArray[np.intp]:
    """Return where the force stays at one value while the motion continues.

    Dry friction and a coarse converter keep a value as well, but leave it by no more than their
    usual steps. A converter that sticks jumps afterwards; or it keeps a value within the range of
    a signal that else hardly ever repeats one, because of its noise.
    """
    if force.size < 2 or force.size != motion.size:
        return np.zeros(0, dtype=np.intp)
    same = np.concatenate([[False], np.diff(force) == 0.0, [False]]).view(np.int8)
    starts, stops = np.flatnonzero(np.diff(same) == 1), np.flatnonzero(np.diff(same) == -1)
    long = stops - starts >= _STUCK_SAMPLES
    starts, stops = starts[long], stops[long]
    travel = np.abs(motion[[(starts + stops) // 2, stops]] - motion[starts]).max(axis=0)
    moved = travel > _STUCK_TRAVEL * np.ptp(motion)
    starts, stops = starts[moved], stops[moved]
    steps = np.abs(np.diff(force))
    if not starts.size or not steps.any():
        return np.zeros(0, dtype=np.intp)
    usual = np.quantile(steps[steps > 0.0], 0.95)
    jumps = np.append(steps, 0.0)[stops] > 5.0 * usual
    held, repeated = np.sum(stops - starts), np.sum(steps == 0.0)
    if repeated - held < _SELDOM * force.size and held < _MOSTLY * force.size:
        value, place, count = np.unique(force[starts], return_index=True, return_counts=True)
        once = (count == 1) & (value > force.min()) & (value < force.max())
        jumps[place[once]] = True
    return np.asarray(starts[jumps])


def creates_energy(loss: FloatArray, std: FloatArray, dof: FloatArray) -> NDArray[np.bool_]:
    """Return which losses are below zero by more than their noise."""
    return np.asarray(loss < -_limit(dof) * std)


def _amplitude(part: FrequencyResponse) -> FloatArray:
    if part.amplitude is not None:
        return part.amplitude
    assert part.drive is not None  # one of the two always exists
    return part.drive / part.gain


def _limit(dof: ArrayLike) -> FloatArray:
    """Student's t at the level of significance; the normal distribution for infinite dof."""
    return -np.asarray(stdtrit(np.minimum(dof, 1e9), _SIGNIFICANT))

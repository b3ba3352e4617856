"""Plausibility of tables: warnings that list the rows, and errors.

A passive structure dissipates ``pi A^2 Im Z`` per cycle. Single negative rows may be due to noise;
a sum that is negative by more than its noise means a wrong sign of the phase, or wrong columns.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from dahl_ident.arrays import BoolArray, FloatArray
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


def creates_energy(loss: FloatArray, std: FloatArray, dof: FloatArray) -> BoolArray:
    """Return which losses are negative by more than their noise."""
    return np.asarray(loss < -_limit(dof) * std)


def _limit(dof: ArrayLike) -> FloatArray:
    """Return the critical value of Student's t; of the normal distribution for infinite dof."""
    return -np.asarray(stdtrit(np.minimum(dof, 1e9), _SIGNIFICANT))

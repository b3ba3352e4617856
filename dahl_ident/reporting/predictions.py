"""The fitted response between the measured points, with its band."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.plots.friction import Curve
from dahl_ident.results import FitResult

_POINTS = 160


def over_amplitude(fit: FitResult, part: FrequencyResponse) -> Curve:
    """Return the prediction over the amplitude held in some rows, at their middle frequency."""
    held = held_amplitude(part)
    grid = np.geomspace(held.min(), held.max(), _POINTS)
    return _curve(fit, part, grid, np.full(_POINTS, np.median(part.frequency_hz)), grid)


def over_frequency(fit: FitResult, part: FrequencyResponse) -> Curve:
    """Return the prediction over frequency through some rows, at their amplitudes."""
    f = part.frequency_hz
    grid = np.geomspace(f.min(), f.max(), _POINTS)
    order = np.argsort(f)
    held = np.exp(np.interp(grid, f[order], np.log(held_amplitude(part)[order])))
    return _curve(fit, part, grid, grid, held)


def is_force_controlled(data: FrequencyResponse) -> bool:
    """Return whether most rows were driven by force."""
    return bool(np.mean(np.asarray(data.controlled) == "force") > 0.5)


def held_amplitude(data: FrequencyResponse) -> FloatArray:
    """Return the amplitude that the laboratory held: of displacement, or of force."""
    held = data.drive if is_force_controlled(data) else data.amplitude
    assert held is not None  # a fit has refused such rows
    return held


def displacement_amplitude(data: FrequencyResponse) -> FloatArray:
    """Return the displacement amplitude of every row, from the drive where it is not given."""
    if data.amplitude is not None:
        return data.amplitude
    return held_amplitude(data) * data.to("receptance").gain


def _curve(
    fit: FitResult, data: FrequencyResponse, x: FloatArray, f: FloatArray, held: FloatArray
) -> Curve:
    forced = is_force_controlled(data)
    band = fit.predict(f, drive=held) if forced else fit.predict(f, amplitude=held)
    return Curve(x, band.response, band.gain(), band.phase())

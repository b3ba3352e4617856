"""The fitted response between the measured points, with its band.

To first order the prediction's relative change is ``dR/R = (dR/dtheta) dtheta / R``; its real
part is the change of ln gain, its imaginary part that of the phase, so both bands follow from
the covariance of theta exactly as for real models.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.levels import thresholds
from dahl_ident.problem import Problem
from dahl_ident.results import FitResult

BAND_LEVEL = 0.9545
_POINTS = 160


@dataclass(frozen=True)
class Prediction:
    """The response on a fine grid: `x` is amplitude, drive or frequency."""

    x: FloatArray
    response: ComplexArray
    gain_band: tuple[FloatArray, FloatArray]
    phase_band: tuple[FloatArray, FloatArray]


def over_amplitude(fit: FitResult, part: FrequencyResponse) -> Prediction:
    """Return the prediction over the amplitude held in some rows, at their middle frequency."""
    held = held_amplitude(part)
    grid = np.geomspace(held.min(), held.max(), _POINTS)
    f = np.full(_POINTS, np.median(part.frequency_hz))
    return _prediction(fit, _like(part, f, grid), grid)


def over_frequency(fit: FitResult, part: FrequencyResponse) -> Prediction:
    """Return the prediction over frequency through some rows, at their amplitudes."""
    f = part.frequency_hz
    grid = np.geomspace(f.min(), f.max(), _POINTS)
    order = np.argsort(f)
    held = np.interp(grid, f[order], held_amplitude(part)[order])
    return _prediction(fit, _like(part, grid, held), grid)


def is_force_controlled(data: FrequencyResponse) -> bool:
    """Return whether most rows were driven by force."""
    return bool(np.mean(np.asarray(data.controlled) == "force") > 0.5)


def held_amplitude(data: FrequencyResponse) -> FloatArray:
    """Return the amplitude that the laboratory held: of displacement, or of force."""
    held = data.drive if is_force_controlled(data) else data.amplitude
    assert held is not None  # a fit has refused such rows
    return held


def _like(data: FrequencyResponse, f: FloatArray, held: FloatArray) -> FrequencyResponse:
    forced = is_force_controlled(data)
    return FrequencyResponse(
        f,
        np.ones(f.size, dtype=complex),
        amplitude=None if forced else held,
        drive=held if forced else None,
        controlled="force" if forced else "displacement",
        quantity=data.quantity,
        motion=data.motion,
    )


def _prediction(fit: FitResult, grid: FrequencyResponse, x: FloatArray) -> Prediction:
    optimum, problem = fit.optimum, fit.problem
    fine = Problem(grid, problem.model, sensors=problem.sensors, noise="relative")
    R = fine.predict(optimum.theta)
    relative = fine.prediction_jacobian(optimum.theta) / R[:, None]
    covariance = np.where(np.isfinite(optimum.covariance), optimum.covariance, 0.0)
    width = thresholds(optimum, np.array([BAND_LEVEL]))[0]
    log_gain, phase = (
        width * np.sqrt(np.einsum("ni,ij,nj->n", part, covariance, part).clip(0.0))
        for part in (relative.real, relative.imag)
    )
    gain, angle = np.abs(R), np.angle(R)
    return Prediction(
        x, R,
        (gain * np.exp(-log_gain), gain * np.exp(log_gain)),
        (angle - phase, angle + phase),
    )  # fmt: skip

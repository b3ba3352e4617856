"""Small problems for the tests of sampling and integration."""

from __future__ import annotations

import numpy as np

import dahl_ident as di
from dahl_ident.arrays import FloatArray

FRICTION = di.Dahl(f_max=0.1, sigma=30.0)
X_C = 0.1 / 30.0


def friction_table(
    rows: int = 12, low: float = 0.3, high: float = 3.0, noise: float = 0.02, seed: int = 1
) -> di.FrequencyResponse:
    """Return describing-function data between two values of beta, noise in ln gain and phase."""
    return _table(0.0, np.geomspace(low, high, rows) * X_C, noise, seed)


def spring_table(
    noise: float, rows: int = 8, low: float = 0.3, high: float = 10.0
) -> di.FrequencyResponse:
    """Return the same for friction with a spring as stiff as it is at small amplitudes."""
    return _table(30.0, np.geomspace(low, high, rows) * X_C, noise, 1)


def _table(
    stiffness: float, amplitude: FloatArray, noise: float, seed: int
) -> di.FrequencyResponse:
    random = np.random.default_rng(seed)
    rows = amplitude.size
    error = noise * (random.normal(size=rows) + 1j * random.normal(size=rows))
    response = (FRICTION.describing_function(amplitude) + stiffness) * np.exp(error)
    return di.FrequencyResponse(np.ones(rows), response, amplitude)


def with_covariance(table: di.FrequencyResponse, noise: float) -> di.FrequencyResponse:
    """Return the table with the covariance of a relative error of each part."""
    variance = (noise * np.abs(table.response)) ** 2
    covariance = variance[:, None, None] * np.eye(2)
    return di.FrequencyResponse(
        table.frequency_hz, table.response, table.amplitude, covariance=covariance
    )


def harmonic_table(amplitude_error: float) -> di.FrequencyResponse:
    """Return fundamental and third harmonic at 6 amplitudes, themselves measured with error."""
    random = np.random.default_rng(4)
    amplitude = np.tile(np.geomspace(0.5, 5.0, 6) * X_C, 2)
    harmonic = np.repeat([1, 3], 6)
    exact = np.concatenate([FRICTION.dynamic_stiffness(amplitude[:6], harmonic=k) for k in (1, 3)])
    error = 0.02 * np.abs(exact) * (random.normal(size=12) + 1j * random.normal(size=12))
    measured = amplitude * (1.0 + amplitude_error * np.tile(random.normal(size=6), 2))
    return di.FrequencyResponse(
        np.ones(12),
        exact + error,
        measured,
        harmonic=harmonic,
        covariance=(0.02 * np.abs(exact))[:, None, None] ** 2 * np.eye(2),
        amplitude_std=amplitude_error * amplitude if amplitude_error else None,
    )

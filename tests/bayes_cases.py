"""Small problems for the tests of sampling and quadrature."""

from __future__ import annotations

import numpy as np

import dahl_ident as di

FRICTION = di.Dahl(f_max=0.1, sigma=30.0)
X_C = 0.1 / 30.0


def friction_table(
    rows: int = 12, low: float = 0.3, high: float = 3.0, noise: float = 0.02, seed: int = 1
) -> di.FrequencyResponse:
    """Return describing-function data between two values of beta, noise in ln gain and phase."""
    amplitude = np.geomspace(low, high, rows) * X_C
    random = np.random.default_rng(seed)
    error = noise * (random.normal(size=rows) + 1j * random.normal(size=rows))
    response = FRICTION.describing_function(amplitude) * np.exp(error)
    return di.FrequencyResponse(np.ones(rows), response, amplitude)


def with_covariance(table: di.FrequencyResponse, noise: float) -> di.FrequencyResponse:
    """Return the table with the covariance of a relative error of each part."""
    variance = (noise * np.abs(table.response)) ** 2
    covariance = variance[:, None, None] * np.eye(2)
    return di.FrequencyResponse(
        table.frequency_hz, table.response, table.amplitude, covariance=covariance
    )

"""Small problems for the tests of sampling and integration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import dahl_ident as di
from tests.friction_tables import FRICTION, X_C, stated, table


def friction_table(
    rows: int = 12, low: float = 0.3, high: float = 3.0, noise: float = 0.02, seed: int = 1
) -> di.FrequencyResponse:
    """Return a table of friction between two values of beta."""
    return table(FRICTION, (low, high), rows, noise, seed)


def spring_table(
    noise: float, rows: int = 8, low: float = 0.3, high: float = 10.0
) -> di.FrequencyResponse:
    """Return a table of friction with a spring as stiff as the friction at small amplitudes."""
    return table(FRICTION + di.Spring(30.0), (low, high), rows, noise)


def with_covariance(table: di.FrequencyResponse, noise: float) -> di.FrequencyResponse:
    """Return the table with a covariance: real and imaginary part have a relative error `noise`."""
    return replace(table, covariance=stated(table.response, noise))


def harmonic_table(amplitude_error: float) -> di.FrequencyResponse:
    """Return fundamental and third harmonic at 6 amplitudes, which have relative errors as well."""
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
        covariance=stated(exact, 0.02),
        amplitude_std=amplitude_error * amplitude if amplitude_error else None,
    )

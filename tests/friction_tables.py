"""Synthetic tables of friction that several tests fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, response
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import Element
from dahl_ident.elements.driven_motion import Steady

F_MAX, SIGMA = 0.1, 30.0
X_C = F_MAX / SIGMA
FRICTION = Dahl(F_MAX, SIGMA)
PLANT = FRICTION + Mass(0.3) + Damper(0.24) + Spring(0.3)


def table(
    model: Element = FRICTION,
    beta: tuple[float, float] = (0.1, 10.0),
    n: int = 30,
    noise: float = 0.01,
    seed: int = 1,
) -> FrequencyResponse:
    """Return dynamic stiffness over amplitude with relative noise."""
    A = np.geomspace(*beta, n) * X_C
    Z = model.dynamic_stiffness(A, 2.0 * np.pi)
    return FrequencyResponse(np.ones(n), Z * relative_noise(n, noise, seed), A)


def plant_table(noise: float = 0.01, seed: int = 1, steady: Steady = "exact") -> FrequencyResponse:
    """Return the receptance of the plant of Eqn. 53, five drives by twelve frequencies."""
    f = np.tile(np.geomspace(0.1, 2.0, 12), 5)
    u = np.repeat(np.geomspace(0.02, 1.0, 5), 12)
    R = response(PLANT, f, u, steady=steady).receptance * relative_noise(60, noise, seed)
    return driven(f, R, u, level=u)


def driven(f: Any, R: Any, u: Any, share: float | None = None, **columns: Any) -> FrequencyResponse:
    """Return the receptance under held forces; a share of it may be its stated standard error."""
    C = None if share is None else stated(R, share)
    return FrequencyResponse(
        f, R, drive=u, covariance=C, controlled="force", quantity="receptance", **columns
    )


def stated(R: ComplexArray, share: float) -> FloatArray:
    """Return the covariance of a response whose standard error is a share of it."""
    return np.asarray((share * np.abs(R))[:, None, None] ** 2 * np.eye(2))


def amplitudes(data: FrequencyResponse) -> FloatArray:
    """Return the displacement amplitudes of a table that has them."""
    assert data.amplitude is not None
    return data.amplitude


def relative_noise(n: int, size: float, seed: int) -> ComplexArray:
    """Return exp of complex Gaussian noise."""
    pairs = np.random.default_rng(seed).standard_normal((2, n))
    return np.asarray(np.exp(size * (pairs[0] + 1j * pairs[1])))

"""The displacement amplitude as a function of parameters, for estimation; nothing is checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.steady_state.plant import flatten
from dahl_ident.steady_state.roots import all_roots


def solve(
    model: Element,
    values: Sequence[FloatArray],
    omega: FloatArray,
    drive: FloatArray,
    start: FloatArray | None = None,
) -> FloatArray:
    """Return the displacement amplitude A with A |Z(A, omega)| = drive, unchecked.

    All arguments broadcast, `values` (in the order of the model's parameters) included, so a
    batch of parameter vectors has arrays of shape (S, 1). NaN where there is no amplitude. Of
    several amplitudes the one nearest to `start` in ratio, else the smallest.
    """
    plant, shape = flatten(model, values, omega, drive)
    roots = all_roots(plant) * plant.unit[:, None]
    if start is None or roots.shape[1] == 1:
        return roots[:, 0].reshape(shape)
    near = np.broadcast_to(start, shape).reshape(-1, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log(roots / near))
    distance[np.isnan(distance)] = np.inf
    nearest = distance.argmin(axis=1)[:, None]
    return np.take_along_axis(roots, nearest, axis=1).reshape(shape)


class ReceptanceGradient(NamedTuple):
    """X/u_0 = 1/Z(A, omega) at the solved amplitude, with its derivatives.

    Attributes
    ----------
    value : ndarray of complex
        X/u_0, m/N; NaN where there is no amplitude.
    amplitude : ndarray
        A, m.
    by_drive : ndarray of complex
        d(X/u_0)/du_0.
    by_parameter : tuple of ndarray of complex
        d(X/u_0)/dp for each parameter p of the model, in its order.
    """

    value: ComplexArray
    amplitude: FloatArray
    by_drive: ComplexArray
    by_parameter: tuple[ComplexArray, ...]


def receptance_gradient(
    model: Element,
    values: Sequence[FloatArray],
    omega: FloatArray,
    drive: FloatArray,
    start: FloatArray | None = None,
) -> ReceptanceGradient:
    """Return X/u_0 with its derivatives, by implicit differentiation of A |Z| = u_0, unchecked.

    dA/A = (du_0/u_0 - Re(dZ/Z)) / (1 + Re(A Z_A/Z)) with dZ the change of Z at constant A, then
    d(1/Z) = -(dZ + Z_A dA)/Z^2. One root search serves the value and all derivatives.
    Arguments as in :func:`solve`.
    """
    amplitude = solve(model, values, omega, drive, start)
    found = np.isfinite(amplitude)
    A = np.where(found, amplitude, 1.0)
    Z, by_amplitude, by_parameter = model.stiffness_gradient(values, A, omega)
    X = np.where(found, 1.0 / Z, np.nan)
    turn = A * by_amplitude / Z
    share = turn / (1.0 + turn.real)
    relative = [d / Z for d in by_parameter]
    return ReceptanceGradient(
        X,
        amplitude,
        -X * share / drive,
        tuple(-X * (change - share * change.real) for change in relative),
    )

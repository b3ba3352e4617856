"""The displacement amplitude as a function of parameters, for estimation; unchecked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.steady_state.plant import flatten
from dahl_ident.steady_state.roots import find_roots

_SCAN_PER_DECADE = 32  # coarse, because only one amplitude is needed


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
    several amplitudes the one nearest to `start` in ratio, else the smallest; two may be
    missed where A |Z| turns twice within 7.5 % of amplitude.
    """
    plant, shape = flatten(model, values, omega, drive)
    roots = find_roots(plant, _SCAN_PER_DECADE).amplitude * plant.unit[:, None]
    if start is None or roots.shape[1] == 1:
        return roots[:, 0].reshape(shape)
    near = np.broadcast_to(start, shape).reshape(-1, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log(roots / near))
    distance[np.isnan(distance)] = np.inf
    nearest = distance.argmin(axis=1)[:, None]
    return np.take_along_axis(roots, nearest, axis=1).reshape(shape)

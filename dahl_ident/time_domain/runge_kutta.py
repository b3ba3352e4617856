"""One step of Luther's explicit Runge-Kutta method of order 6, as a casadi expression.

H. A. Luther, An explicit sixth-order Runge-Kutta formula, Math. Comp. 22 (1968) 434-436.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

_ROOT = float(np.sqrt(21.0))  # in Luther's coefficients
PLACES = (0.0, 1.0, 0.5, 2.0 / 3.0, (7.0 - _ROOT) / 14.0, (7.0 + _ROOT) / 14.0, 1.0)
"""Where in the step the stages are."""
_STAGES = (
    (),
    (1.0,),
    (3.0 / 8.0, 1.0 / 8.0),
    (8.0 / 27.0, 2.0 / 27.0, 8.0 / 27.0),
    tuple(
        v / 392.0
        for v in (
            3.0 * (3.0 * _ROOT - 7.0),
            -8.0 * (7.0 - _ROOT),
            48.0 * (7.0 - _ROOT),
            -3.0 * (21.0 - _ROOT),
        )
    ),
    tuple(
        v / 1960.0
        for v in (
            -5.0 * (231.0 + 51.0 * _ROOT),
            -40.0 * (7.0 + _ROOT),
            -320.0 * _ROOT,
            3.0 * (21.0 + 121.0 * _ROOT),
            392.0 * (6.0 + _ROOT),
        )
    ),
    tuple(
        v / 180.0
        for v in (
            15.0 * (22.0 + 7.0 * _ROOT),
            120.0,
            40.0 * (7.0 * _ROOT - 5.0),
            -63.0 * (3.0 * _ROOT - 2.0),
            -14.0 * (49.0 + 9.0 * _ROOT),
            70.0 * (7.0 - _ROOT),
        )
    ),
)
"""Weights of the earlier slopes in each stage, as Luther (1968) has them."""

_WEIGHTS = tuple(v / 180.0 for v in (9.0, 0.0, 64.0, 0.0, 49.0, 49.0, 9.0))  # of slopes


def step(
    rates: Callable[[ca.SX, ca.SX], ca.SX], state: ca.SX, drive: Sequence[ca.SX], length: ca.SX
) -> ca.SX:
    """Return the state after a step.

    Parameters
    ----------
    rates : callable
        The state's rate of change at a state and a drive.
    state : SX
        At the step's start.
    drive : sequence of SX
        At the six different :data:`PLACES`, in their order.
    length : SX
        Of the step, s.

    Returns
    -------
    SX
    """
    slopes: list[ca.SX] = []
    for i, weights in enumerate(_STAGES):
        at = state
        for weight, slope in zip(weights, slopes, strict=True):
            at = at + length * weight * slope
        slopes.append(rates(at, drive[i if i < 6 else 1]))
    total = state
    for weight, slope in zip(_WEIGHTS, slopes, strict=True):
        if weight:
            total = total + length * weight * slope
    return total

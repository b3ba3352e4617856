"""Difference quotients, with which tests compare exact derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def central_differences(function: Callable[[Any], Any], point: ArrayLike, steps: ArrayLike) -> Any:
    """Return the derivatives of a function of n numbers, (n, ...)."""
    point = np.asarray(point, dtype=np.float64)
    slopes = []
    for step in np.diag(np.broadcast_to(steps, point.shape)):
        change = np.asarray(function(point + step)) - np.asarray(function(point - step))
        slopes.append(change / (2.0 * step.sum()))
    return np.array(slopes)

r"""Asymmetry of the force: even harmonics that neither noise nor the displacement explains.

A loop that is alike in both directions has odd harmonics alone. Even ones appear where friction,
clearance or a spring differ between the directions, and where the displacement has even harmonics
itself: a linear element turns X_k/X_1 into k^2 X_k/X_1 of the force at most (a mass), and a
symmetric but nonlinear one spreads X_2 over all even orders, each about as large as X_2/X_1. The
mean (k = 0) is not judged, because a load cell's zero and a weight shift it as well.

Without asymmetry abs(F_k)^2 over its variance follows F(2, dof_k) for each order. Above the limit
of F(2 m, smallest dof) the mean of m orders lies less often than one of that distribution would.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fdtri

from dahl_ident.arrays import TINY, ComplexArray, FloatArray

EVEN = (2, 4, 6, 8)  # the lowest harmonics, which are the largest
BY_CHANCE = 1e-4  # of symmetric points, how many seem asymmetric at most
_LEAST = 1e-3  # of the fundamental: smaller even harmonics do not matter


def asymmetry(
    orders: FloatArray,
    force: ComplexArray,
    variance: FloatArray,
    dof: FloatArray,
    displacement: FloatArray,
) -> float:
    """Return the force's even harmonics over its fundamental, 0 where they are not significant.

    `force` and `displacement` are phasors of even orders over those of the fundamental, with E
    abs(error)^2 of the former as `variance` and its degrees of freedom.
    """
    if orders.size == 0:
        return 0.0
    distorted = float(np.sqrt(np.sum(displacement**2)))
    explained = np.maximum(orders**2 * displacement + distorted, _LEAST)
    excess = np.maximum(np.abs(force) - explained, 0.0) ** 2 / np.maximum(variance, TINY)
    if np.mean(excess) <= fdtri(2 * orders.size, float(np.min(dof)), 1.0 - BY_CHANCE):
        return 0.0
    return float(np.sqrt(np.maximum(np.sum(np.abs(force) ** 2 - variance), 0.0)))

"""Forces along a displacement that starts at rest, by small steps and independent of the engine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dahl_ident.arrays import FloatArray


def integrated_force(
    slope: Callable[[float, float], float], x: FloatArray, start: float = 0.0, steps: int = 100
) -> FloatArray:
    """Return the force with dF/dx = slope(F, direction), by Runge-Kutta steps between samples."""
    forces = [start]
    for change in np.diff(x).tolist():
        h, s, force = change / steps, float(np.sign(change)), forces[-1]
        for _ in range(steps):
            k1 = slope(force, s)
            k2 = slope(force + 0.5 * h * k1, s)
            k3 = slope(force + 0.5 * h * k2, s)
            force += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(force + h * k3, s))
        forces.append(force)
    return np.array(forces)


def jenkins_force(
    x: FloatArray, stiffness: FloatArray, slip: FloatArray, start: FloatArray | float = 0.0
) -> FloatArray:
    """Return the force of Jenkins elements; `start` are their forces at the first sample."""
    limits = stiffness * slip
    forces = [start * np.ones_like(limits)]
    for change in np.diff(x):
        forces.append(np.clip(forces[-1] + stiffness * change, -limits, limits))
    return np.asarray(np.sum(forces, axis=1))

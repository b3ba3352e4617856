r"""The steady loop of a law with one state whose slope depends on the velocity, by collocation.

Under x = A cos(theta), theta = omega t, the force obeys

    dF/dtheta = -A sin(theta) s(F, direction, v),    v = -A omega sin(theta),

with F(2 pi) = F(0). Newton's method makes it linear, y' = -a y + r; Radau's implicit collocation
(order 11, stable however fast the force follows the velocity) solves that panel by panel, and the
periodic start closes the cycle. A law that is linear in its force takes one such step, and half of
the cycle where both directions are alike. Panels are graded towards both turning points of each
half cycle, where the force turns round and the speed passes through zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray

Slope = Callable[[FloatArray, float, FloatArray], FloatArray]
"""dF/dx over F, direction and velocity; force and velocity have the shape (rows, nodes)."""

_PANELS, _STAGES = 32, 6  # of a half cycle, and of a panel
_GRADING = 4.5  # panels at a turning point are 1e-4 of a half cycle
_NEWTON_STEPS = 60  # at most; a loop that has not settled by then has no number
_CONVERGED = 1e-12  # of the largest force: what the next step would change is below rounding
_STALLS, _ROUNDED = 9, 1e-9  # after so many steps, a change that may be rounding alone
_SAME = 1e-13  # relative difference of slopes that is rounding
FORCE_STEP = 1e-6  # of the force, for the derivative of the slope


@dataclass(frozen=True)
class RatedLoop:
    """Settled forces at nodes over a cycle, (rows, nodes), with weights of an integral over theta.

    Attributes
    ----------
    theta, weight : ndarray, shape (nodes,)
    velocity, force : ndarray, shape (rows, nodes)
    slope : ndarray, shape (rows, nodes)
        dF/dx.
    decay : ndarray, shape (rows,)
        The factor by which a deviation shrinks in one cycle.
    """

    theta: FloatArray
    weight: FloatArray
    velocity: FloatArray
    force: FloatArray
    slope: FloatArray
    decay: FloatArray

    def coefficients(self, force: FloatArray, k: int) -> ComplexArray:
        """Return c_k = a_k - j b_k of a force at the nodes; for k = 0 the mean."""
        wave = self.weight * np.exp(-1j * k * self.theta) / (2.0 * np.pi if k == 0 else np.pi)
        return np.asarray(force @ wave)


def rated_loop(
    slope: Slope, amplitude: FloatArray, omega: FloatArray, start: FloatArray
) -> RatedLoop:
    """Return the settled loops of a law.

    Parameters
    ----------
    slope : callable
        s(F, direction, v).
    amplitude, omega : ndarray, shape (rows,)
        A > 0, m, and angular frequency, rad/s.
    start : ndarray, shape (rows,)
        Size of the force, N, from which the search starts.

    Returns
    -------
    RatedLoop
        NaN in rows where no settled loop is found: the slope has to fall with the force and be
        continuous in it.
    """
    theta, weight, width, matrix = _nodes()
    n = theta.size // 2
    travel = -amplitude[:, None] * np.sin(theta)
    velocity = omega[:, None] * travel
    size = np.abs(start)[:, None]

    def along(F: FloatArray) -> FloatArray:
        down = slope(F[:, :n], -1.0, velocity[:, :n]) + 0.0 * F[:, :n]
        if F.shape[1] == n:
            return down
        up = slope(F[:, n:], 1.0, velocity[:, n:])
        return np.concatenate([down, up + 0.0 * F[:, n:]], axis=1)

    with np.errstate(all="ignore"):  # a row that runs away becomes NaN
        force = start[:, None] * np.cos(theta)
        high, s, low = along(force + size), along(force), along(force - size)
        rounding = _SAME * (np.abs(high) + np.abs(s) + np.abs(low))
        linear = bool(np.all(np.abs(high + low - 2.0 * s) <= rounding))
        # of an odd loop half a cycle is enough
        back = slope(-force[:, :n], 1.0, -velocity[:, :n])
        odd = linear and bool(np.all(np.abs(back - s[:, :n]) <= rounding[:, :n]))
        cycle = slice(n if odd else None)
        force, travel, sign = force[:, cycle], travel[:, cycle], -1.0 if odd else 1.0
        for iteration in range(_NEWTON_STEPS):
            s = along(force)
            largest = np.abs(force).max(axis=1)
            h = size if linear else FORCE_STEP * np.maximum(size, largest[:, None])
            by_force = (along(force + h) - along(force - h)) / (2.0 * h)
            moved, decay = _linear(
                -travel * by_force, travel * (s - by_force * force), width, matrix, sign
            )
            change = np.max(np.abs(moved - force), axis=1)
            force = moved
            largest = np.abs(force).max(axis=1)
            settled = change <= (_CONVERGED if iteration < _STALLS else _ROUNDED) * largest
            settled |= linear
            if np.all(settled | ~np.isfinite(largest)):
                break
        force = np.where(settled[:, None], force, np.nan)
        if odd:
            force, decay = np.concatenate([force, -force], axis=1), decay**2
        return RatedLoop(theta, weight, velocity, force, along(force), decay)


def _linear(
    a: FloatArray, r: FloatArray, width: FloatArray, matrix: FloatArray, sign: float
) -> tuple[FloatArray, FloatArray]:
    """Return the solution of y' = -a y + r that ends at `sign` times its start, and its decay."""
    rows, m = a.shape[0], _STAGES
    panels = a.reshape(rows, -1, m)
    step = width[: panels.shape[1], None, None] * matrix
    system = np.eye(m) + step * panels[:, :, None, :]
    right = np.stack(
        [np.ones(panels.shape), np.einsum("pij,rpj->rpi", step, r.reshape(rows, -1, m))], axis=-1
    )
    both = np.linalg.solve(system, right)
    keep, gain = both[..., 0], both[..., 1]
    total_keep, total_gain = np.ones(rows), np.zeros(rows)
    for i in range(panels.shape[1]):
        total_gain = keep[:, i, -1] * total_gain + gain[:, i, -1]
        total_keep = total_keep * keep[:, i, -1]
    y = total_gain / (sign - total_keep)
    found = np.empty(panels.shape)
    for i in range(panels.shape[1]):
        found[:, i] = keep[:, i] * y[:, None] + gain[:, i]
        y = found[:, i, -1]
    return found.reshape(rows, -1), total_keep


@lru_cache(maxsize=1)
def _nodes() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return theta and weights over a cycle, panel widths, and Radau's integration matrix."""
    # the nodes of Radau's rule with the right end: roots of P_m - P_(m-1)
    series = np.zeros(_STAGES + 1)
    series[-2:] = -1.0, 1.0
    places = 0.5 * (1.0 + np.sort(np.polynomial.legendre.legroots(series).real))
    places[-1] = 1.0
    powers = np.arange(_STAGES)
    vandermonde = np.vander(places, increasing=True)
    matrix = (places[:, None] ** (powers + 1) / (powers + 1)) @ np.linalg.inv(vandermonde)
    s = np.linspace(-1.0, 1.0, _PANELS + 1)
    half = 0.5 * np.pi * (1.0 + np.tanh(_GRADING * s) / np.tanh(_GRADING))
    edges = np.concatenate([half, np.pi + half[1:]])
    width = np.diff(edges)
    theta = (edges[:-1, None] + width[:, None] * places).ravel()
    return theta, (width[:, None] * matrix[-1]).ravel(), width, matrix

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
_ROWS = 32  # whose systems are solved together: their arrays stay in the processor's cache
_NEWTON_STEPS = 60  # at most; a loop that has not settled by then has no number
_CONVERGED = 1e-12  # of the largest force: what the next step would change is below rounding
_STALLS, _ROUNDED = 9, 1e-9  # after so many steps, a change that may be rounding alone
_SAME = 1e-13  # relative difference of slopes that is rounding
_FORCE_STEP = 1e-6  # of the force, for the derivative of the slope


@dataclass(frozen=True)
class RatedLoop:
    """Settled forces at nodes over a cycle, (rows, nodes), with weights of an integral over theta.

    Attributes
    ----------
    theta, weight : ndarray, shape (nodes,)
    velocity, force : ndarray, shape (rows, nodes)
    slope : ndarray, shape (rows, nodes)
        dF/dx.
    by_force : ndarray, shape (rows, nodes)
        Derivative of the slope by the force.
    direction : ndarray, shape (nodes,)
        Sign of the velocity.
    decay : ndarray, shape (rows,)
        The factor by which a deviation shrinks in one cycle.
    """

    theta: FloatArray
    weight: FloatArray
    velocity: FloatArray
    force: FloatArray
    slope: FloatArray
    by_force: FloatArray
    direction: FloatArray
    decay: FloatArray

    def changed(self, amplitude: FloatArray, rates: FloatArray) -> FloatArray:
        """Return changes of the settled force, (rows, Q, nodes), where dF/dx changes by `rates`.

        The variational equation over one cycle; `rates` likewise, at constant force.
        """
        _, _, width, matrix = _nodes()
        travel = -amplitude[:, None] * np.sin(self.theta)
        with np.errstate(all="ignore"):
            pulled = travel[:, None] * rates
            return _linear(-travel * self.by_force, pulled, width, matrix, 1.0)[0]

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
        for cycle in (slice(n), slice(None)):  # of an odd loop half a cycle is enough
            force = start[:, None] * np.cos(theta[cycle])
            high, s, low = along(force + size), along(force), along(force - size)
            rounding = _SAME * (np.abs(high) + np.abs(s) + np.abs(low))
            linear = bool(np.all(np.abs(high + low - 2.0 * s) <= rounding))
            back = slope(-force[:, :n], 1.0, -velocity[:, :n])
            odd = linear and bool(np.all(np.abs(back - s[:, :n]) <= rounding[:, :n]))
            if odd:
                break
        travel, sign = travel[:, cycle], -1.0 if odd else 1.0
        if linear:
            by_force = (high - low) / (2.0 * size)
            right = travel * (s - by_force * force)
            found, decay = _linear(-travel * by_force, right[:, None], width, matrix, sign)
            force = found[:, 0]
        else:
            force, by_force, decay = _settled(along, force, travel, size, width, matrix)
        s = along(force)
        if odd:
            force, s = np.concatenate([force, -force], axis=1), np.tile(s, 2)
            by_force, decay = np.concatenate([by_force, -by_force], axis=1), decay**2
        direction = np.repeat([-1.0, 1.0], n)
        return RatedLoop(theta, weight, velocity, force, s, by_force, direction, decay)


def _settled(
    along: Callable[[FloatArray], FloatArray],
    force: FloatArray,
    travel: FloatArray,
    size: FloatArray,
    width: FloatArray,
    matrix: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what settles of a law that is not linear in its force, NaN where nothing does.

    The forces, the derivative of the slope by them, and the decays.
    """
    for iteration in range(_NEWTON_STEPS):
        s = along(force)
        h = _FORCE_STEP * np.maximum(size, np.abs(force).max(axis=1)[:, None])
        by_force = (along(force + h) - along(force - h)) / (2.0 * h)
        right = travel * (s - by_force * force)
        found, decay = _linear(-travel * by_force, right[:, None], width, matrix, 1.0)
        moved = found[:, 0]
        change = np.max(np.abs(moved - force), axis=1)
        force = moved
        largest = np.abs(force).max(axis=1)
        settled = change <= (_CONVERGED if iteration < _STALLS else _ROUNDED) * largest
        if np.all(settled | ~np.isfinite(largest)):
            break
    return np.where(settled[:, None], force, np.nan), by_force, decay


def _linear(
    a: FloatArray, r: FloatArray, width: FloatArray, matrix: FloatArray, sign: float
) -> tuple[FloatArray, FloatArray]:
    """Return the solutions of y' = -a y + r that end at `sign` times their start, and the decay.

    `a` is (rows, nodes), `r` and the solutions (rows, Q, nodes).
    """
    (rows, _), (_, Q, _), m = a.shape, r.shape, _STAGES
    panels = a.reshape(rows, -1, m)
    count = panels.shape[1]
    step = width[:count]
    # stages first: the system, and its right sides
    system = np.empty((m, m + 1 + Q, rows, count))
    system[:, :m] = matrix[..., None, None] * (step * panels.transpose(2, 0, 1))
    system[range(m), range(m)] += 1.0
    system[:, m] = 1.0
    right = r.reshape(rows, Q, count, m).transpose(3, 1, 0, 2)
    system[:, m + 1 :] = step * np.tensordot(matrix, right, axes=1)
    for first in range(0, rows, _ROWS):
        _eliminate(system[:, :, first : first + _ROWS])
    keep, gain = system[:, m], system[:, m + 1 :]
    total_keep, total_gain = np.ones(rows), np.zeros((Q, rows))
    for i in range(count):
        total_gain = keep[-1, :, i] * total_gain + gain[-1, :, :, i]
        total_keep = total_keep * keep[-1, :, i]
    y = total_gain / (sign - total_keep)
    starts = np.empty((Q, rows, count))
    for i in range(count):
        starts[..., i] = y
        y = keep[-1, :, i] * y + gain[-1, :, :, i]
    found = keep[:, None] * starts + gain
    return found.transpose(2, 1, 3, 0).reshape(rows, Q, -1), total_keep


def _eliminate(system: FloatArray) -> None:
    """Solve many small systems in place, (m, m + k, ...): the last k columns are the right sides.

    Without pivoting, which a force that falls back to its limit never needs: Radau's matrix times
    a positive diagonal has positive minors. Much faster than LAPACK, one call a system.
    """
    m = len(system)
    for i in range(m):
        system[i, i + 1 :] /= system[i, i]
        system[i + 1 :, i + 1 :] -= system[i + 1 :, i, None] * system[i, i + 1 :]
    for i in range(m - 1, 0, -1):
        system[:i, m:] -= system[:i, i, None] * system[i, m:]


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

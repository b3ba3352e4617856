"""The force of any rate-independent law with one state over any displacement history.

On a stretch of one direction the force follows one curve F(u) of the path, the same from every
start: dF/du = s(F). The curve is tabulated once for each direction, with the path as an integral
over the force (see :mod:`dahl_ident.elements.steady_loop`), and interpolated by cubics. A history
is then carried from turning point to turning point.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.steady_loop import ONE, Slope, branch_limit

_BELOW, _ABOVE = 400, 720  # panels for forces against and with the motion
_DEEPEST = 18.0  # y beyond which the law slips fully
_GAUSS = np.polynomial.legendre.leggauss(4)  # per panel; of 8th order, rounding on 400 panels
_ROW = np.zeros(1, dtype=np.intp)  # the one set of parameters


class ForceCurve:
    """The force over the path in one direction; forces are positive with the motion.

    Parameters
    ----------
    slope : callable
        s(F) of this direction.
    span : float
        The largest path that will be asked for, m.
    reach : float
        The largest force against the motion, N.
    """

    def __init__(self, slope: Slope, span: float, reach: float) -> None:
        self._limit = float(branch_limit(slope, np.array([span]), ONE)[0])
        self._reach = reach
        low = np.linspace(-reach, 0.0, _BELOW + 1)
        y = np.linspace(0.0, _DEEPEST, _ABOVE + 1)
        nodes, weights = (0.5 + 0.5 * _GAUSS[0]), 0.5 * _GAUSS[1]
        inner = (low[:-1, None] + nodes * (reach / _BELOW)).ravel()
        deep = (y[:-1, None] + nodes * (_DEEPEST / _ABOVE)).ravel()
        tanh = np.tanh(deep)
        force = np.concatenate([inner, self._limit * tanh])
        rate = np.concatenate(
            [np.full(inner.shape, reach / _BELOW),
             self._limit * (1.0 - tanh) * (1.0 + tanh) * (_DEEPEST / _ABOVE)]
        )  # fmt: skip
        with np.errstate(all="ignore"):
            path = rate / slope(force[None, :], _ROW)[0]
        path = np.where(np.isfinite(path) & (path > 0.0), path, 0.0)
        self._force = np.concatenate([low, self._limit * np.tanh(y[1:])])
        self._path = np.concatenate([[0.0], np.cumsum(path.reshape(-1, 4) @ weights)])
        # at a kink the two sides of a node differ, so each panel has slopes of its own
        inside = self._force[:-1] + (self._force[1:] - self._force[:-1]) * np.array(
            [[1e-9], [1.0 - 1e-9]]
        )
        with np.errstate(all="ignore"):
            self._slopes = np.maximum(slope(inside.reshape(1, -1), _ROW).reshape(2, -1), 0.0)

    @property
    def limit(self) -> float:
        """The force at which the law slips fully, or beyond which it is not tabulated."""
        return self._limit

    def after(self, path: FloatArray) -> FloatArray:
        """Return the force at a path counted from the table's start."""
        panel = np.clip(np.searchsorted(self._path, path, side="right") - 1, 0, self._path.size - 2)
        width = self._path[panel + 1] - self._path[panel]
        with np.errstate(all="ignore"):
            t = np.clip(np.nan_to_num((path - self._path[panel]) / width), 0.0, 1.0)
        low, high = self._force[panel], self._force[panel + 1]
        m0, m1 = self._slopes[0][panel] * width, self._slopes[1][panel] * width
        rise = high - low
        return np.asarray(
            low + t * (m0 + t * ((3.0 * rise - 2.0 * m0 - m1) + t * (m0 + m1 - 2.0 * rise)))
        )

    def path_to(self, force: float) -> float:
        """Return the path from the table's start to a force, by bisection in its panel."""
        panel = int(np.searchsorted(self._force, force, side="right")) - 1
        panel = min(max(panel, 0), self._path.size - 2)
        low, high = float(self._path[panel]), float(self._path[panel + 1])
        middle = 0.5 * (low + high)
        while low < middle < high:
            below = float(self.after(np.asarray(middle))) < force
            low, high = (middle, high) if below else (low, middle)
            middle = 0.5 * (low + high)
        return middle


def force_history(
    rising: Slope,
    falling: Slope,
    displacement: FloatArray,
    initial_force: float,
    gap: float = 0.0,
) -> FloatArray:
    """Return the force at every sample of a displacement, unchecked.

    Parameters
    ----------
    rising, falling : callable
        s(F, +1) and s(-F, -1), for forces of shape (rows, nodes).
    displacement : ndarray, shape (n,)
        m; between samples the motion is taken as monotone.
    initial_force : float
        Force at the first sample, N.
    gap : float, default 0
        Play of the link to the law, m, crossed at zero force; at first in its middle where the
        initial force is zero.

    Returns
    -------
    ndarray, shape (n,)
        N.
    """
    span = float(np.ptp(displacement)) if displacement.size else 0.0
    if displacement.size < 2 or span == 0.0:
        return np.full(displacement.shape, initial_force)
    tops = [float(branch_limit(s, np.array([span]), ONE)[0]) for s in (rising, falling)]
    reach = [max(tops[1], -initial_force), max(tops[0], initial_force)]
    curves = ForceCurve(rising, span, reach[0]), ForceCurve(falling, span, reach[1])
    steps = np.sign(np.diff(displacement))
    moves = steps != 0.0
    last = np.maximum.accumulate(np.where(moves, np.arange(steps.size), moves.argmax()))
    direction = np.where(steps[last] < 0.0, -1.0, 1.0)
    turns = np.concatenate([[0], np.flatnonzero(direction[1:] != direction[:-1]) + 1])
    ends = np.append(turns[1:], displacement.size - 1)
    result = np.empty(displacement.shape)
    force = result[0] = initial_force
    play = 0.5 * gap * float(np.sign(initial_force))  # from -gap/2 to gap/2: in contact
    for first, stop in zip(turns.tolist(), ends.tolist(), strict=True):
        sign = float(direction[first])
        curve = curves[0 if sign > 0.0 else 1]
        travelled = np.abs(displacement[first + 1 : stop + 1] - displacement[first])
        start = curve.path_to(sign * force)
        free = max(curve.path_to(0.0) - start, 0.0) if gap else 0.0  # path to zero force
        cross = 0.5 * gap - sign * play  # path through the gap, from there
        used = np.clip(travelled - free, 0.0, cross)
        slips = sign * force >= curve.limit
        result[first + 1 : stop + 1] = (
            force if slips else sign * curve.after(start + travelled - used)
        )
        play += sign * float(used[-1])
        force = float(result[stop])
        if gap and abs(play) < 0.5 * gap * (1.0 - 1e-12):
            force = result[stop] = 0.0
    return result

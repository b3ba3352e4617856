r"""Linear Dahl friction behind a gap in the time domain, with exact derivatives.

From a turning point with the force F0 and heading s the force is

    F = s (f - left),    left = (f - s F0) exp(-kappa y),    kappa = sigma/f,

y the path of the element and f the limit of this direction. Where F0 is against the motion, F = 0
after the path ln(1 - s F0/f)/kappa; the gap is crossed there. A history is carried from turning
point to turning point, the derivatives by the variational equation of the same map.
"""

from __future__ import annotations

from math import exp, log

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.behaviour import HistoryGradient
from dahl_ident.elements.recursion import Stretches, stretches

_INSIDE = 1.0 - 1e-12  # of half the gap: nearer to its end is contact


def force_history(
    displacement: FloatArray,
    f_max: float,
    sigma: float,
    asymmetry: float,
    gap: float,
    initial_force: float,
    *,
    derivatives: bool = True,
) -> HistoryGradient:
    """Return the force at every sample, and its derivatives by f_max, sigma, asymmetry and gap.

    Parameters
    ----------
    displacement : ndarray, shape (n,)
        m; between samples the motion is monotone.
    f_max, sigma, asymmetry, gap : float
        Mean limit, N, stiffness, N/m, difference of the limits over their sum, and play, m.
    initial_force : float
        At the first sample, N; where it is zero the motion starts in the middle of the gap.
    derivatives : bool, default True
        Without, they are empty.

    Returns
    -------
    HistoryGradient

    Examples
    --------
    >>> x = np.array([0.0, 0.4, 1.4, 1.0])
    >>> force_history(x, 1.0, 1.0, 0.0, 0.8, 0.0).value.round(6) + 0.0
    array([0.      , 0.      , 0.632121, 0.094043])
    """
    legs = stretches(displacement)
    limits = f_max * (1.0 + legs.heading * asymmetry)
    forces, plays = _turns(legs, limits, sigma, gap, initial_force)
    leg = np.repeat(np.arange(forces.size), legs.samples)
    at = _Stretch(legs.heading, limits, sigma, gap, forces, plays)
    there = at.take(leg)
    value = there.force(legs.path)
    if not derivatives:
        return HistoryGradient(value, np.zeros(0), ())
    by_limit = np.column_stack([1.0 + legs.heading * asymmetry, legs.heading * f_max])
    by_turn = _slopes_of_turns(at, legs, by_limit, float(np.sign(initial_force)))
    keep, term = there.force_slopes(legs.path, by_limit[leg])
    by = np.einsum("ni,nij->nj", keep, by_turn[leg]) + term
    return HistoryGradient(value, by[:, 4], tuple(by[:, :4].T))


def _turns(
    legs: Stretches, limits: FloatArray, sigma: float, gap: float, force: float
) -> tuple[FloatArray, FloatArray]:
    """Return force and place in the gap, from -gap/2 to gap/2, at every turning point."""
    half = 0.5 * gap
    play = half * ((force > 0.0) - (force < 0.0))
    found = [(force, play)]
    for s, f, path in zip(
        legs.heading[:-1].tolist(), limits[:-1].tolist(), legs.length.tolist(), strict=True
    ):
        g = s * force
        free = f / sigma * log(1.0 - g / f) if g < 0.0 else 0.0
        used = min(max(path - free, 0.0), half - s * play)
        play += s * used
        y = path - used
        force = 0.0 if abs(play) < half * _INSIDE else s * (f - (f - g) * exp(-sigma / f * y))
        found.append((force, play))
    forces, plays = np.array(found).T
    return forces, plays


class _Stretch:
    """Stretches of one direction: force and place in the gap along each, with derivatives.

    Derivatives are by force and place at the turning point before, and directly by f_max, sigma,
    asymmetry, gap and the initial force.
    """

    def __init__(
        self,
        s: FloatArray,
        f: FloatArray,
        sigma: float,
        gap: float,
        F0: FloatArray,
        play: FloatArray,
    ) -> None:
        self.s, self.f, self.sigma, self.gap, self.F0, self.play = s, f, sigma, gap, F0, play
        self.kappa, self.start = sigma / f, s * F0
        self.free = np.log(np.maximum(1.0 - self.start / f, 1.0)) / self.kappa
        self.cross = 0.5 * gap - s * play

    def take(self, rows: NDArray[np.intp]) -> _Stretch:
        """Return some of the stretches."""
        own = (v[rows] for v in (self.s, self.f, self.F0, self.play))
        s, f, F0, play = own
        return _Stretch(s, f, self.sigma, self.gap, F0, play)

    def _moved(self, path: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return the element's path, the margin left, and whether the gap is being crossed."""
        used = np.clip(path - self.free, 0.0, self.cross)
        y = path - used
        inside = np.abs(self.play + self.s * used) < 0.5 * self.gap * _INSIDE
        return y, (self.f - self.start) * np.exp(-self.kappa * y), inside

    def force(self, path: FloatArray) -> FloatArray:
        """Return the force."""
        _, left, inside = self._moved(path)
        return np.where(inside, 0.0, self.s * (self.f - left))

    def force_slopes(self, path: FloatArray, by_limit: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the force's derivatives, (n, 2) and (n, 5)."""
        y, left, inside = self._moved(path)
        s, f, kappa = self.s, self.f, self.kappa
        fade = np.exp(-kappa * y)
        by_place = left * kappa * (path >= self.free + self.cross)
        by_f = s * (1.0 - fade - left * y * kappa / f)
        term = np.column_stack([
            by_f * by_limit[:, 0], s * left * y / f, by_f * by_limit[:, 1], -0.5 * s * by_place,
            np.zeros(y.size),
        ])  # fmt: skip
        keep = np.column_stack([fade, by_place])
        keep[inside], term[inside] = 0.0, 0.0
        return keep, term

    def place_slopes(self, path: FloatArray, by_limit: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of the place in the gap, (n, 2) and (n, 5)."""
        s, f, kappa = self.s, self.f, self.kappa
        keep, term = np.zeros((s.size, 2)), np.zeros((s.size, 5))
        far = path >= self.free + self.cross
        crossing = (path > self.free) & ~far
        keep[:, 1] = ~far
        term[far, 3] = 0.5 * s[far]
        against = crossing & (self.start < 0.0)
        keep[against, 0] = (1.0 / (kappa * (f - self.start)))[against]
        by_f = -s * ((1.0 / (f - self.start) - 1.0 / f) / kappa + self.free / f)
        direct = np.column_stack([by_f * by_limit[:, 0], s * self.free / self.sigma,
                                  by_f * by_limit[:, 1]])  # fmt: skip
        term[against, :3] = direct[against]
        return keep, term


def _slopes_of_turns(
    at: _Stretch, legs: Stretches, by_limit: FloatArray, side: float
) -> FloatArray:
    """Return the derivatives of force and place at every turning point, (m, 2, 5)."""
    found = np.empty((at.s.size, 2, 5))
    found[0] = [[0.0, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.5 * side, 0.0]]
    before = at.take(np.arange(at.s.size - 1))
    pairs = [
        slopes(legs.length, by_limit[:-1]) for slopes in (before.force_slopes, before.place_slopes)
    ]
    keep, term = (np.stack([pair[i] for pair in pairs], axis=1) for i in range(2))
    for i in range(at.s.size - 1):
        found[i + 1] = keep[i] @ found[i] + term[i]
    return found

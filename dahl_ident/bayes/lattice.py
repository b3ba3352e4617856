r"""Integrals over all parameters except one, at many values of that one at once.

At each value of the outer parameter the others have a conditional mode c and a spread L, lower
triangular. A lattice of step h in u covers them,

    theta = c + L t,    t = sinh(K u')/K,

where the sinh covers heavy tails. The trapezoidal rule on such a lattice converges exponentially
in 1/h for a smooth density that dies away (Trefethen and Weideman, SIAM Review 56, 2014). Far from
the bounds of the prior u' = u. Near bounds at u' = a and b the map is bent smoothly, so that they
are reached only at infinity:

    u' = a + ln(1 + exp(u - a)) - ln(1 + exp(u - b)).

The lattice grows from the mode, block by block, as long as blocks contribute. The error is
estimated from the changes when every second point is left out, and every second of the rest again:
e(h) is about e(2 h)^2/e(4 h) or smaller, for exponential as well as power-law convergence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_expit

from dahl_ident.arrays import FloatArray

LogDensity = Callable[[FloatArray], FloatArray]
Box = tuple[FloatArray, FloatArray]

_STRETCH = 0.3  # K
_FIRST = 3.5  # radius in u of what is computed at once
_REACH = 30.0  # of the lattice in u
_SIDE = {1: 8, 2: 2}  # points along each axis of a block, by the number of axes
_LITTLE = 1e-7  # of the highest point, below which a block is negligible
_NOTHING = 45.0  # below the peak's logarithm at the mode
_BLOCK = 4096  # points to a call of the density


class Slicer(Protocol):
    """Conditional modes and spreads of the density at given values of the outer parameter."""

    @property
    def outer(self) -> int:
        """The axis of the outer parameter."""

    @property
    def inner(self) -> tuple[int, ...]:
        """The other axes, in the order of the triangular spread."""

    @property
    def followers(self) -> int:
        """How many of the last inner axes depend on the others along a curve."""

    def charts(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return modes, (S, D), and spreads of the inner axes, (S, d, d), at S values."""

    def follow(self, theta: FloatArray) -> FloatArray:
        """Return the dependent axes for given other axes, up to a constant, (N, followers)."""


class Sums(NamedTuple):
    """Integrals over the inner axes at S values of the outer one."""

    log_value: FloatArray
    errors: FloatArray
    """Relative change without every second, and three of four, points; (2, d, S)."""
    ids: NDArray[np.intp]
    """Under which the points of each value are kept."""


@dataclass
class Points:
    """All points computed so far: theta, ln of density times volume, and whose they are."""

    theta: list[FloatArray]
    log_mass: list[FloatArray]
    ids: list[NDArray[np.intp]]

    def joined(self) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
        """Return them as three arrays."""
        return np.concatenate(self.theta), np.concatenate(self.log_mass), np.concatenate(self.ids)


class Lattice:
    """Computes integrals over the inner axes, and keeps the points; `step` is h of each axis."""

    def __init__(self, log_density: LogDensity, box: Box, slicer: Slicer, step: FloatArray) -> None:
        self._log_density, self._box, self._slicer, self._step = log_density, box, slicer, step
        self._peak = self._highest = -np.inf  # density at a mode; mass of a point
        self.points = Points([], [], [])
        self.evaluations, self.values = 0, 0

    def __call__(self, values: FloatArray) -> Sums:
        """Return the integrals at `values` of the outer parameter, (S,)."""
        modes, roots = self._slicer.charts(values)
        ids = self.values + np.arange(len(values))
        self.values += len(values)
        at_mode = self._at(modes)
        self._peak = max(self._peak, at_mode.max())
        errors = np.zeros((2, len(self._step), len(values)))
        if not self._slicer.inner:
            self._highest = self._peak
            self._keep(modes[:, None], at_mode[:, None], ids)
            return Sums(at_mode, errors, ids)
        log_value = np.full(len(values), -np.inf)
        chosen = np.flatnonzero(at_mode > self._peak - _NOTHING)
        if chosen.size:
            found = self._grown(modes[chosen], roots[chosen], ids[chosen])
            log_value[chosen], errors[..., chosen] = found
        return Sums(log_value, errors, ids)

    def _grown(
        self, modes: FloatArray, roots: FloatArray, ids: NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        """Return ln of the integrals and relative errors, adding blocks while they contribute."""
        S, d = len(modes), len(self._step)
        done, within = self._blocks(S), _corners(d)
        side = _SIDE[d]
        half = np.array(done.shape[1:]) // 2
        sums = np.zeros((1 + 2 * d, S))  # all points; every second and fourth along each axis
        reference = np.full(S, np.nan)
        new = done.copy()
        while new.any():
            who, *block = np.nonzero(new)
            index = side * (np.stack(block, axis=-1) - half)[:, None] + within
            theta, log_volume = self._places(modes[who], roots[who], index)
            values = self._at(theta.reshape(-1, theta.shape[-1])).reshape(log_volume.shape)
            values = values + log_volume
            self._highest = max(self._highest, values.max())
            self._keep(theta, values, ids[who])
            if np.isnan(reference[0]):
                reference = _highest_of_each(values.max(axis=1), who, S)
            mass = np.exp(values - reference[who, None])
            for row, part in zip(sums, _thinned(mass, index), strict=True):
                row += np.bincount(who, part, S)
            counts = mass.sum(axis=1) * np.exp(reference[who] - self._highest) > _LITTLE
            some = np.zeros_like(done)
            some[(who[counts], *(b[counts] for b in block))] = True
            new = _widened(some) & ~done
            done |= new
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.abs(np.nan_to_num(sums[1:] / sums[0] - 1.0))
            return reference + np.log(sums[0]), relative.reshape(2, d, S)

    def _blocks(self, S: int) -> NDArray[np.bool_]:
        """Return which blocks of S lattices are computed first."""
        side = _SIDE[len(self._step)]
        sides = [np.arange(-n, n) for n in np.ceil(_REACH / (side * self._step)).astype(int)]
        nearest = [
            h * np.minimum(np.abs(side * b), np.abs(side * b + side - 1))
            for h, b in zip(self._step, sides, strict=True)
        ]
        radius = np.sqrt(sum(n**2 for n in np.meshgrid(*nearest, indexing="ij")))
        return np.repeat((radius <= _FIRST)[None], S, axis=0)

    def _places(
        self, modes: FloatArray, roots: FloatArray, index: NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        """Return theta, (M, L, D), and ln of the volume, (M, L), of points `index`, (M, L, d)."""
        u, inner = self._step * index, self._slicer.inner
        L, d = index.shape[1:]
        log_volume = np.full(u.shape[:-1], np.log(self._step).sum())
        theta = np.repeat(modes[:, None], L, axis=1)
        t = np.empty(u.shape)
        leaders = d - self._slicer.followers
        for j, axis in enumerate(inner):
            centre = modes[:, axis, None] + np.einsum("slj,sj->sl", t[..., :j], roots[:, j, :j])
            if j == leaders:
                curve = self._curve(theta, modes)
            if j >= leaders:
                centre = centre + curve[..., j - leaders]
            size = roots[:, j, j, None]
            walls = ((limit[axis] - centre) / size for limit in self._box)
            t[..., j], log_slope = _stretched(u[..., j], *walls)
            theta[..., axis] = np.clip(centre + size * t[..., j], *(w[axis] for w in self._box))
            log_volume += np.log(size) + log_slope
        return theta, log_volume

    def _curve(self, theta: FloatArray, modes: FloatArray) -> FloatArray:
        """Return the dependent axes minus their values at the mode, (S, L, followers)."""
        S, L, D = theta.shape
        there = self._slicer.follow(theta.reshape(-1, D)).reshape(S, L, -1)
        return np.asarray(there - self._slicer.follow(modes)[:, None])

    def _at(self, theta: FloatArray) -> FloatArray:
        """Return the log-density, block by block to keep memory small."""
        self.evaluations += len(theta)
        blocks = range(0, len(theta), _BLOCK)
        return np.concatenate([self._log_density(theta[i : i + _BLOCK]) for i in blocks])

    def _keep(self, theta: FloatArray, log_mass: FloatArray, ids: NDArray[np.intp]) -> None:
        """Keep points, (S, L, D) with masses (S, L), of S values."""
        chosen = log_mass > self._highest - _NOTHING
        self.points.theta.append(theta[chosen])
        self.points.log_mass.append(log_mass[chosen])
        self.points.ids.append(np.repeat(ids, chosen.sum(axis=1)))


def _stretched(u: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return t at u, between walls of t, and ln of dt/du."""
    low, high = (np.arcsinh(_STRETCH * wall) / _STRETCH for wall in (low, high))
    above, below = u - low, high - u
    bent = low + np.logaddexp(0.0, above) - np.logaddexp(0.0, -below)
    with np.errstate(divide="ignore", under="ignore"):
        gap = np.log(-np.expm1(low - high))
    log_slope = log_expit(above) + log_expit(below) + gap
    return np.sinh(_STRETCH * bent) / _STRETCH, log_slope + np.log(np.cosh(_STRETCH * bent))


@lru_cache(maxsize=4)
def _corners(dims: int) -> NDArray[np.intp]:
    """Return the places of a block's points within it, (side^dims, dims)."""
    return np.indices([_SIDE[dims]] * dims).reshape(dims, -1).T


def _thinned(mass: FloatArray, index: NDArray[np.intp]) -> list[FloatArray]:
    """Return sums over blocks of all points, of every second along each axis, of every fourth."""
    kept = [mass.sum(axis=1)]
    for stride in (2, 4):
        kept += [
            stride * np.sum(mass * (index[..., axis] % stride == 0), axis=1)
            for axis in range(index.shape[-1])
        ]
    return kept


def _highest_of_each(values: FloatArray, who: NDArray[np.intp], S: int) -> FloatArray:
    """Return the highest of the values of each lattice; 0 where there is none."""
    highest = np.full(S, -np.inf)
    np.maximum.at(highest, who, values)
    return np.where(np.isfinite(highest), highest, 0.0)


def _widened(blocks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return blocks, (S, ...), and their neighbours."""
    for axis in range(1, blocks.ndim):
        wider = blocks.copy()
        ahead, behind = (np.moveaxis(x, axis, 0) for x in (wider, blocks))
        ahead[1:] |= behind[:-1]
        ahead[:-1] |= behind[1:]
        blocks = wider
    return blocks

r"""The steady loop of any rate-independent law with one state, by quadrature over the force.

On a rising branch dF/dx = s(F), so the path travelled since the lower tip is
``u(F) = Int dF/s``. The loop under x = A cos(theta) closes where both branches, between the same
two tips, have the path 2A; or where a branch reaches the force at which s vanishes, and slips at
constant force for the rest of its way. Partial integration of the Fourier integrals gives

    c_k = (a_k - j b_k) = 1/(j k pi) * (closed integral of) exp(-j k theta) dF,     k > 0,

in which slip at constant force does not appear. So neither the onset of full slip nor a law whose
stiffness drops to zero at once (an elastoplastic element) needs any event to be located in time.

**Nodes.** A branch is split at F = 0, where laws often have a kink. Below, Gauss points over
sqrt(F - F_tip), which removes the square root of theta at the tip. Above, with L the force at
which s vanishes, ``F = L tanh y`` and Gauss points over sqrt(Y - y): s may vanish at L in any
power. A law with no such force has an arbitrary L beyond its tip.

Laws with s(F, -1) = s(-F, +1) have odd loops: one branch and one tip are enough.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray

Rows = NDArray[np.intp]
Slope = Callable[[FloatArray, Rows], FloatArray]
"""dF/dx of a rising branch over F, shape (n, nodes), and the n rows whose parameters are meant."""

_FINE, _COARSE = (24, 48), (10, 14)
"""Nodes below and above F = 0, by trials with exponents of Dahl's law from 0.25 to 4; and those
with which a tip is approached."""
_DEEPEST = 18.0  # y beyond which L - F is rounding
_SECTIONS = 16  # of a bracket, when the force is sought at which s vanishes
_NEWTON_STEPS = 60  # three are the rule; more where bisection takes over
_CLOSE, _CONVERGED = 1e-3, 1e-5  # last steps of y, with the coarse and the fine rule
_OPEN = 1e-6  # of the path: a loop that misses it by more is not resolved


@dataclass(frozen=True)
class Branch:
    """One rising branch from its lower to its upper tip, rows along the first axis.

    Attributes
    ----------
    force : ndarray, shape (rows, nodes)
        At the nodes.
    weight : ndarray, shape (rows, nodes)
        Of the integral over the force.
    travelled, left : ndarray, shape (rows, nodes)
        Path from the lower tip, and to the upper one, at most 2A in sum.
    path : ndarray, shape (rows,)
        Between the tips.
    """

    force: FloatArray
    weight: FloatArray
    travelled: FloatArray
    left: FloatArray
    path: FloatArray

    def phasor(self, amplitude: FloatArray) -> ComplexArray:
        """Return exp(-j psi), with x = -A cos(psi), at the nodes."""
        missing = 2.0 * amplitude - self.path
        missing[np.abs(missing) < 1e-10 * amplitude] = 0.0
        left = np.maximum(self.left + missing[:, None], 0.0)
        whole = 1.0 / (self.travelled + left)
        gone, left = self.travelled * whole, left * whole
        result = np.empty(left.shape, dtype=np.complex128)
        result.real = left - gone
        result.imag = -2.0 * np.sqrt(left * gone)
        return result


@dataclass(frozen=True)
class Loop:
    """Closed loops: the rising branch, and the falling one turned about the origin.

    `falling` is None for odd loops, in which both are the same.
    """

    amplitude: FloatArray
    top: FloatArray
    bottom: FloatArray
    rising: Branch
    falling: Branch | None

    def coefficients(self, k: int) -> ComplexArray:
        """Return c_k, N; for k = 0 the mean force."""
        if self.falling is None and k % 2 == 0:
            return np.zeros(self.amplitude.shape, dtype=np.complex128)
        rising = self.rising.phasor(self.amplitude)
        if self.falling is None:
            return np.asarray(2j / (np.pi * k) * _transform(rising, self.rising.weight, k))
        falling = self.falling.phasor(self.amplitude)
        if k == 0:
            turned = np.sum(np.angle(falling) * self.falling.weight, axis=1)
            turned -= np.sum(np.angle(rising) * self.rising.weight, axis=1)
            return np.asarray(0.5 * (self.top + self.bottom) - 0.5 / np.pi * turned + 0j)
        up = _transform(rising, self.rising.weight, k)
        down = _transform(falling, self.falling.weight, k)
        return np.asarray(((-1) ** k * up - down) / (1j * np.pi * k))


def _transform(phasor: ComplexArray, weight: FloatArray, k: int) -> ComplexArray:
    """Return Int exp(-j k psi) dF, from exp(-j psi)."""
    return np.asarray(np.einsum("rn,rn->r", phasor if k == 1 else phasor**k, weight))


def closed_loop(rising: Slope, falling: Slope, amplitude: FloatArray, owner: Rows) -> Loop:
    """Return the steady loops of a law.

    Parameters
    ----------
    rising : callable
        s(F, +1), for forces of shape (rows, nodes).
    falling : callable
        s(-F, -1): the falling branch turned about the origin.
    amplitude : ndarray, shape (rows,)
        A > 0, m.
    owner : ndarray of int, shape (rows,)
        The same number for rows that have the same parameters.

    Returns
    -------
    Loop
        With the Fourier coefficients.
    """
    A, rows = amplitude, np.arange(amplitude.size)
    _, first, group = np.unique(owner, return_index=True, return_inverse=True)
    same = Groups(first, group)
    top = branch_limit(rising, A, same)
    up = _odd_tip(rising, top, A, same)
    if _same(rising, falling, top, first):
        force = top * np.tanh(up)
        return Loop(A, force, -force, _branch(rising, rows, -force, top, up), None)
    bottom = branch_limit(falling, A, same)
    down = _odd_tip(falling, bottom, A, same)
    up, down = _both_tips(rising, falling, top, bottom, up, down, A)
    highest, lowest = top * np.tanh(up), -bottom * np.tanh(down)
    return Loop(
        A,
        highest,
        lowest,
        _branch(rising, rows, lowest, top, up),
        _branch(falling, rows, -highest, bottom, down),
    )


class Groups(NamedTuple):
    """Rows that have the same parameters: the first of each group, and every row's group."""

    first: Rows
    of: Rows


def _same(rising: Slope, falling: Slope, top: FloatArray, rows: Rows) -> bool:
    """Return whether the law is odd, judged at nine forces."""
    force = top[rows, None] * np.linspace(-0.93, 0.97, 9)
    one, other = rising(force, rows), falling(force, rows)
    return bool(np.all(np.abs(one - other) <= 1e-13 * (np.abs(one) + np.abs(other))))


def force_limit(rising: Slope, start: FloatArray, first: Rows | None = None) -> FloatArray:
    """Return the least force above 0 at which s vanishes, inf where there is none below `start`.

    `first` are the rows whose parameters are meant, if not all.
    """
    fractions = np.arange(1, _SECTIONS + 1) / _SECTIONS
    result = np.full(start.shape, np.inf)
    place = np.arange(start.size)
    rows = place if first is None else first
    low, width = np.zeros(start.shape), start.copy()
    for step in range(60):
        with np.errstate(all="ignore"):
            stuck = ~(rising(low[:, None] + width[:, None] * fractions, rows) > 0.0)
        if step == 0:
            found = stuck.any(axis=1)
            place, rows, stuck = place[found], rows[found], stuck[found]
            low, width = low[found], width[found]
        stuck[:, -1] = True
        width = width / _SECTIONS
        low = low + width * stuck.argmax(axis=1)
        result[place] = low
        if np.all(width <= 1e-16 * low):
            break
    return result


def branch_limit(rising: Slope, A: FloatArray, same: Groups) -> FloatArray:
    """Return L of every row: where s vanishes, or else a force beyond the loop's tip."""
    start = 2.0 * rising(np.zeros((A.size, 1)), np.arange(A.size))[:, 0] * A
    while True:
        farthest = np.zeros(same.first.shape)
        np.maximum.at(farthest, same.of, start)
        limit = np.minimum(force_limit(rising, farthest, same.first)[same.of], start)
        beyond = np.flatnonzero((limit == start) & (start < 1e150) & (start > 0.0))
        if not beyond.size:
            return limit
        top = limit[beyond]
        path = _path(rising, beyond, -top, top, np.full(top.shape, _DEEPEST), _COARSE)
        short = beyond[path < 2.0 * A[beyond]]
        if not short.size:
            return limit
        start[short] *= 4.0


def _odd_tip(rising: Slope, limit: FloatArray, A: FloatArray, same: Groups) -> FloatArray:
    """Return Y at which an odd loop of this branch closes; the deepest where it slips fully."""
    result = np.full(A.shape, _DEEPEST)
    # rows of one group with the same limit have the same longest path
    _, first, group = np.unique(
        np.stack([same.of, limit]), axis=1, return_index=True, return_inverse=True
    )
    longest = _path(rising, first, -limit[first], limit[first], result[first])[group.ravel()]
    rows = np.flatnonzero(longest > 2.0 * A)
    stiffness = rising(np.zeros((rows.size, 1)), rows)[:, 0]
    guess = np.minimum(stiffness * A[rows] / limit[rows], 0.5 * _DEEPEST)
    result[rows] = _newton(rising, rows, limit[rows], A[rows], guess, _COARSE, _CLOSE)
    result[rows] = _newton(rising, rows, limit[rows], A[rows], result[rows], _FINE, _CONVERGED)
    return result


def _newton(
    rising: Slope,
    rows: Rows,
    limit: FloatArray,
    A: FloatArray,
    guess: FloatArray,
    nodes: tuple[int, int],
    tolerance: float,
) -> FloatArray:
    """Return Y by Newton's method for the logarithm of the path, within a bracket."""
    result = guess
    going = np.arange(rows.size)
    low, high = np.zeros(going.shape), np.full(going.shape, _DEEPEST)
    for _ in range(_NEWTON_STEPS):
        y, top = result[going], limit[going]
        force = top * np.tanh(y)
        path = _path(rising, rows[going], -force, top, y, nodes)
        excess = np.log(path / (2.0 * A[going]))
        ends = rising(np.stack([force, -force], axis=1), rows[going])
        with np.errstate(all="ignore"):
            rate = (1.0 / ends[:, 0] + 1.0 / ends[:, 1]) * top / np.cosh(y) ** 2
            step = excess * path / rate
        above = excess > 0.0
        high[going[above]], low[going[~above]] = y[above], y[~above]
        moved = y - step
        inside = (moved >= low[going]) & (moved <= high[going])
        moved = np.where(inside, moved, 0.5 * (low[going] + high[going]))
        result[going] = moved
        going = going[(np.abs(moved - y) > tolerance * y) & (np.abs(excess) > 1e-14)]
        if not going.size:
            break
    return result


def _both_tips(
    rising: Slope,
    falling: Slope,
    top: FloatArray,
    bottom: FloatArray,
    up: FloatArray,
    down: FloatArray,
    A: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return Y of both tips, by Newton's method from those of two odd loops."""
    rows = np.arange(A.size)
    for _ in range(_NEWTON_STEPS):
        highest, lowest = top * np.tanh(up), bottom * np.tanh(down)
        one = np.log(_path(rising, rows, -lowest, top, up) / (2.0 * A))
        other = np.log(_path(falling, rows, -highest, bottom, down) / (2.0 * A))
        s = rising(np.stack([highest, -lowest], axis=1), rows)
        t = falling(np.stack([lowest, -highest], axis=1), rows)
        p, q = top / np.cosh(up) ** 2, bottom / np.cosh(down) ** 2
        with np.errstate(all="ignore"):
            a, b = p / s[:, 0], q / s[:, 1]  # of the rising path by up and down
            c, d = p / t[:, 1], q / t[:, 0]
            r, s_ = one * 2.0 * A * np.exp(one), other * 2.0 * A * np.exp(other)
            determinant = a * d - b * c  # vanishes with A: the mean is forgotten ever more slowly
            steps = (d * r - b * s_) / determinant, (a * s_ - c * r) / determinant
        before = up, down
        up, down = (
            np.clip(y - np.clip(np.nan_to_num(step), -1.0, 0.5 * y), 0.0, _DEEPEST)
            for y, step in zip(before, steps, strict=True)
        )
        if np.all(np.abs(up - before[0]) <= _CONVERGED * up) and np.all(
            np.abs(down - before[1]) <= _CONVERGED * down
        ):
            break
    return up, down


def _path(
    rising: Slope,
    rows: Rows,
    bottom: FloatArray,
    limit: FloatArray,
    Y: FloatArray,
    nodes: tuple[int, int] = _FINE,
) -> FloatArray:
    """Return the path of the branch from the force `bottom` up to ``limit tanh(Y)``."""
    return np.asarray(_steps(rising, rows, bottom, limit, Y, _rule(*nodes))[2].sum(axis=1))


def _branch(
    rising: Slope, rows: Rows, bottom: FloatArray, limit: FloatArray, Y: FloatArray
) -> Branch:
    """Return the branch from the force `bottom` up to ``limit tanh(Y)``."""
    rule = _rule(*_FINE)
    force, weight, path = _steps(rising, rows, bottom, limit, Y, rule)
    down, up = path[:, : _FINE[0]], path[:, _FINE[0] :]
    below, above = down.sum(axis=1)[:, None], up.sum(axis=1)[:, None]
    # what is small near a tip is summed from there, the rest is its complement
    to, rest = down @ rule.below_to, up @ rule.above_from
    travelled = np.concatenate([to, below + (above - rest)], axis=1)
    left = np.concatenate([(below - to) + above, rest], axis=1)
    whole = (below + above)[:, 0]
    return Branch(force, weight, np.abs(travelled), np.abs(left), whole)


def _steps(
    rising: Slope,
    rows: Rows,
    bottom: FloatArray,
    limit: FloatArray,
    Y: FloatArray,
    rule: _Rule,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return forces, their weights and the path's weighted slopes at the nodes of a branch."""
    start, limit = np.minimum(bottom, 0.0)[:, None], limit[:, None]
    y = Y[:, None] * rule.rise
    tanh = np.tanh(y)
    force = np.concatenate([start * rule.fall, limit * tanh], axis=1)
    high_weight = (limit * Y[:, None]) * (1.0 - tanh) * (1.0 + tanh) * rule.above_weight
    weight = np.concatenate([start * rule.below_weight, high_weight], axis=1)
    with np.errstate(all="ignore"):
        path = weight / rising(force, rows)
    return force, weight, np.where(path > 0.0, path, 0.0)  # L itself, to rounding


@dataclass(frozen=True)
class _Rule:
    """Gauss points of a branch: places and weights; integrals of weighted values to each node."""

    fall: FloatArray  # the force below 0 over the tip's
    below_weight: FloatArray  # of the force, over the tip's
    below_to: FloatArray
    rise: FloatArray  # y over Y
    above_weight: FloatArray  # of y, over Y
    above_from: FloatArray


@lru_cache
def _rule(below: int, above: int) -> _Rule:
    root, weight, to = _gauss(below)
    down = 1.0 - root * root, -2.0 * root * weight, to
    node, weight, to = _gauss(above)
    return _Rule(*down, 1.0 - (1.0 - node) ** 2, 2.0 * (1.0 - node) * weight, 1.0 - to)


def _gauss(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return places and weights between 0 and 1, and integrals of weighted values to each."""
    node, weight = legendre.leggauss(n)
    to = np.zeros((n, n))
    for degree in range(n):
        series = np.zeros(degree + 1)
        series[degree] = 1.0
        # the coefficient of a Legendre polynomial is a weighted sum of the values
        share = (degree + 0.5) * legendre.legval(node, series)
        to += np.outer(share, legendre.legval(node, legendre.legint(series, lbnd=-1.0)))
    return (1.0 + node) / 2.0, weight / 2.0, to

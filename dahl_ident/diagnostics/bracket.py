"""Roots of rising functions: Newton's method inside brackets, for many functions at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_NEAR = 1e-3  # of the target's distance; one more Newton step needs no evaluation
_NARROW = 1e-4  # width of a bracket over its distance
_MARGIN = 0.02  # of a bracket's width that a step keeps from its ends
_LONGEST = 3.0  # step of a logarithm
_GROWTH, _SHRINKAGE = 3.0, 0.3  # of a step over the last, until the target is bracketed


class Bracket:
    """S searches outwards from 0, each for the point where its function reaches its target.

    Attributes
    ----------
    position : ndarray, shape (S,)
        Where the functions are wanted next.
    active : ndarray of int
        Searches that go on.
    end : ndarray, shape (S,)
        Where the targets are met; infinite where they are not.
    """

    def __init__(
        self,
        target: FloatArray,
        first: FloatArray,
        step: FloatArray,
        furthest: FloatArray,
        logarithmic: BoolArray,
        narrow_enough: FloatArray,
    ) -> None:
        self._target, self._furthest, self._logarithmic = target, furthest, logarithmic
        self._narrow_enough = narrow_enough
        self.position, self._step = np.minimum(first, furthest), step
        self._inner, self._outer = np.zeros(target.shape), np.full(target.shape, np.inf)
        self.end = np.full(target.shape, np.nan)
        self.active: IntArray = np.arange(target.size)

    def narrow(self, value: FloatArray, slope: FloatArray, hopeless: BoolArray) -> BoolArray:
        """Take the functions' values and slopes at the active positions, and move on.

        Searches below their target that are `hopeless`, or as far out as they may go, end there.
        Returns which of the active ones were below their targets.
        """
        a = self.active
        position, target = self.position[a], self._target[a]
        below = value < target
        self._inner[a[below]] = position[below]
        self._outer[a[~below]] = position[~below]
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = (target - value) / slope
            width = self._outer[a] - self._inner[a]
            met = (np.abs(value - target) < _NEAR) & np.isfinite(newton)
            narrow = np.minimum(_NARROW * self._outer[a], self._narrow_enough[a])
            met |= np.isfinite(self._outer[a]) & (width <= narrow)
        newton = np.where(np.isfinite(newton), newton, np.inf)
        stuck = below & (position >= self._furthest[a]) & ~met
        lost = below & hopeless & ~met & ~stuck
        polished = position + np.where(np.abs(newton) < self._step[a], newton, 0.0)
        self.end[a[met]] = polished[met]
        self.end[a[stuck]] = position[stuck]
        self.end[a[lost]] = np.inf
        going = ~(met | stuck | lost)
        self.active = a[going]
        self._move(newton[going], below[going])
        return below

    def give_up(self) -> FloatArray:
        """Return the ends; searches that have none end at the outer side of their brackets."""
        self.end[self.active] = self._outer[self.active]
        return self.end

    def _move(self, newton: FloatArray, below: BoolArray) -> None:
        """Choose the next positions: Newton's, kept between what is known and what is bearable."""
        a = self.active
        position, inner, outer = self.position[a], self._inner[a], self._outer[a]
        bracketed = np.isfinite(outer)
        last = np.where(below, self._step[a], np.inf)
        shortest = np.where(bracketed, 0.0, _SHRINKAGE * last)
        longest = _GROWTH * last
        longest = np.where(self._logarithmic[a], np.minimum(_LONGEST, longest), longest)
        forward = np.clip(np.where(newton > 0.0, newton, np.inf), shortest, longest)
        new = position + np.where(below, forward, newton)
        width = np.where(bracketed, outer - inner, 0.0)
        inside = (new > inner + _MARGIN * width) & (new < outer - _MARGIN * width)
        new = np.where(bracketed & ~inside, inner + 0.5 * width, new)
        new = np.minimum(new, self._furthest[a])
        self.position[a], self._step[a] = new, np.maximum(np.abs(new - position), 1e-300)

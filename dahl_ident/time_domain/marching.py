"""The motion of a driven plant whose laws have many kinks, one step after the other.

Newton's method on all intervals at once hardly converges where dozens of Jenkins elements begin to
slip at places that move with the guess. Steps, kinks and drive are those of
:mod:`~.forced_motion`; the plant's functions are evaluated at one state at a time, by casadi.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.time_domain.plant import Plant
from dahl_ident.time_domain.runge_kutta import PLACES

_PLACES = np.array(PLACES[:6])[:, None]  # of the drive: the seventh stage is at the second's
_POWERS = np.arange(8)  # of time, in the drive's polynomial over a step
_MOVING = 1e-200  # m/s, where the velocity is exactly 0: switches still pass or do not
_LOCATED = 1e-12  # of a step
_LOCATING = 30  # evaluations, for one passage
_PARTS = 4  # parts of a step for every kink that the laws have, at most


class March:
    """A plant at some parameters, on its way.

    Parameters
    ----------
    plant : Plant
    values : ndarray, shape (P,)
        Free parameters.
    length : float
        Of a step, s.
    derivatives : bool
        Whether the states' derivatives are wanted too.
    """

    def __init__(
        self, plant: Plant, values: FloatArray, length: float, *, derivatives: bool
    ) -> None:
        self._plant, self._values, self._length = plant, values, length
        self._signs = np.ones(1 + plant.n_switches)  # direction of motion, sides of the switches
        self._slopes = np.eye(plant.order, plant.order + values.size) if derivatives else None

    def run(self, first: FloatArray, drive: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return states and derivatives at all samples, or None where they grow without bound.

        Parameters
        ----------
        first : ndarray, shape (order,)
        drive : ndarray, shape (8, n - 1, substeps)
            Polynomials over each step.

        Returns
        -------
        states : ndarray, shape (n, order)
        by : ndarray, shape (n, order, order + P)
            By the first state and the free parameters; empty where they are not wanted.
        """
        polynomials = drive.transpose(1, 2, 0)
        states = np.empty((len(polynomials) + 1, first.size))
        slopes = self._slopes
        by = np.empty(
            (len(states) if slopes is not None else 0, first.size, first.size + self._values.size)
        )
        state = first
        self._begin(state, polynomials[0, 0, 0])
        for k in range(len(states)):
            if k:
                for polynomial in polynomials[k - 1]:
                    state = self._step(state, polynomial)
                if not np.isfinite(state).all():
                    return None
            states[k] = state
            if self._slopes is not None:
                by[k] = self._slopes
        return states, by

    def _begin(self, state: FloatArray, drive: float) -> None:
        heading = state[1]
        if heading == 0.0:
            heading = self._plant.one_push(state, [drive], self._signs, self._values)[0]
        self._signs[0] = -1.0 if heading < 0.0 else 1.0
        self._choose_sides(state, drive)

    def _choose_sides(self, state: FloatArray, drive: float) -> None:
        self._signs[1:] = 1.0
        self._signs[1:] = np.where(self._switches(state, drive)[0][1:] < 0.0, -1.0, 1.0)

    def _switches(self, state: FloatArray, drive: float) -> FloatArray:
        """Return velocity and switching functions, then their rates, (2, 1 + n)."""
        found = self._plant.one_switches(state, [drive], self._signs, self._values)
        return found.reshape(2, -1)

    def _moved(
        self, state: FloatArray, polynomial: FloatArray, done: float, share: float
    ) -> FloatArray:
        return self._plant.one_advance(
            state, self._stages(polynomial, done, share), self._signs, self._values
        )

    def _stages(self, polynomial: FloatArray, done: float, share: float) -> FloatArray:
        """Return the drive at the stages of a part of a step, and its length."""
        found = np.empty(7)
        found[:6] = (done + share * _PLACES) ** _POWERS @ polynomial
        found[6] = share * self._length
        return found

    def _step(self, state: FloatArray, polynomial: FloatArray) -> FloatArray:
        done = 0.0
        for left in range(_PARTS * self._signs.size, -1, -1):
            share = 1.0 - done
            after = self._moved(state, polynomial, done, share)
            which = passed = -1
            while left:
                passed = self._passed(after, _at(polynomial, done + share), which)
                if passed < 0:
                    break
                which = passed
                after, share = self._located(state, polynomial, done, share, after, which)
            if self._slopes is not None:
                self._chain(
                    self._plant.one_advance_by_all(
                        state, self._stages(polynomial, done, share), self._signs, self._values
                    )[state.size :]
                )
            state = after
            if which < 0:
                break
            done += share
            self._pass(state, _at(polynomial, done), which)
        return state

    def _pass(self, state: FloatArray, drive: float, which: int) -> None:
        """Change the branch of the laws where a switching function passes through zero."""
        if which == 0:
            state[1] = 0.0
            self._signs[0] *= -1.0
            self._choose_sides(state, drive)
            return
        if self._slopes is not None:
            passage = self._plant.one_passages[which - 1]
            self._chain(passage(state, [drive], self._signs, self._values)[state.size :])
        self._signs[which] *= -1.0

    def _chain(self, entries: FloatArray) -> None:
        """Continue the derivatives through a part, whose own are given column by column."""
        assert self._slopes is not None
        order = len(self._slopes)
        own = entries.reshape(-1, order).T
        self._slopes = own[:, :order] @ self._slopes
        self._slopes[:, order:] += own[:, order:]

    def _passed(self, state: FloatArray, drive: float, known: int) -> int:
        """Return a switching function that has passed, other than a known one; -1 where none has.

        That of a slipping element is zero but for rounding, and its rate is zero.
        """
        if state[1] == 0.0:
            state = state.copy()
            state[1] = self._signs[0] * _MOVING
        now, rates = self._switches(state, drive)
        beyond = (now * self._signs < 0.0) & (rates != 0.0)
        if known >= 0:
            beyond[known] = False
        places = np.flatnonzero(beyond)
        if not places.size:
            return -1
        return int(places[np.argmax(np.abs(now[places] / rates[places]))])

    def _located(
        self,
        state: FloatArray,
        polynomial: FloatArray,
        done: float,
        share: float,
        after: FloatArray,
        which: int,
    ) -> tuple[FloatArray, float]:
        """Return the state where a switching function passes through zero, and the share."""
        sign = self._signs[which]
        low, high, where = 0.0, share, share
        for _ in range(_LOCATING):
            now, rates = self._switches(after, _at(polynomial, done + where))
            value, rate = sign * now[which], sign * rates[which] * self._length
            low, high = (low, where) if value < 0.0 else (where, high)
            trial = where - value / rate if rate else high
            new = float(trial) if low <= trial <= high else 0.5 * (low + high)
            change, where = abs(new - where), new
            after = self._moved(state, polynomial, done, where)
            if change < _LOCATED:
                break
        return after, where


def _at(coefficients: FloatArray, place: float) -> float:
    return float(coefficients @ place**_POWERS)

"""The motion of a driven plant, all samples at once, with exact sensitivities.

Every interval between two samples is integrated from a guess of its first state, all intervals
side by side on arrays; Newton's method then makes the ends fit the beginnings, which is a linear
recursion. The motion found is that of one integration after the other, but costs a few passes
over arrays instead of a loop. Where the guess is poor, the recursion is first cut into short
segments that double from pass to pass, so that errors cannot grow along the record; where that
fails, the motion is found stretch by stretch.

Within an interval the method is of order 6, and the drive band-limited. Where the velocity or a
friction force passes through zero, or a Jenkins element begins to slip, the laws have kinks: those
places are located and the step is divided there, so that each part is smooth. Where the rates jump,
so do the sensitivities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.recursion import matrix_recursion
from dahl_ident.errors import FitError
from dahl_ident.time_domain.marching import March
from dahl_ident.time_domain.plant import Plant
from dahl_ident.time_domain.runge_kutta import PLACES
from dahl_ident.time_domain.vectorised import BLOCK

_PLACES = np.array(PLACES[:6])  # of the drive: the seventh stage is at the second's
_PIECES = 6  # parts that a step is divided into at most, and one more for every switch
_KINKS = 4  # switching functions beyond which the motion is found step by step
_LOCATING = 8  # Newton steps for a passage through zero, at most
_LOCATED = 1e-9  # of a step: the error of the next Newton step is below rounding
_SMALL = 1e-6  # of a switching function's largest value: more is not near to its passage
_PASSES = 50  # at most; corrections shrink or the search ends
_GROWTHS = 3  # passes in which the correction may grow
_SEGMENT = 32  # samples, within which motions stay near a wrong start
_STRETCHES = 100  # at most; a motion that asks for more is too unstable to be fitted
_SHORTER = 4  # where a stretch was too long; each success doubles it
_TOLERANCE = 1e-11  # of the largest motion: the next pass changes rounding alone
_POWERS = np.arange(8)  # of time, in the drive's polynomial over a step


@dataclass(frozen=True)
class Flow:
    """The end of every interval from its first state, with derivatives.

    Attributes
    ----------
    end : ndarray, shape (n, order)
    by_state : ndarray, shape (n, order, order)
    by_value : ndarray, shape (n, order, P)
        Derivatives by the free parameters; P = 0 where they were not asked for.
    """

    end: FloatArray
    by_state: FloatArray
    by_value: FloatArray


class ForcedMotion:
    """A plant and its drive; gives the motion for any parameters and first state.

    Parameters
    ----------
    plant : Plant
        Equation of motion.
    drive : ndarray, shape (8, n - 1, substeps)
        From :func:`dahl_ident.time_domain.drive.band_limited`.
    interval : float
        Between samples, s.
    """

    def __init__(self, plant: Plant, drive: FloatArray, interval: float) -> None:
        self.plant = plant
        self._drive = drive
        self._n, self._substeps = drive.shape[1:]
        self._length = interval / self._substeps
        # at the stages of undivided steps
        powers = _PLACES[:, None] ** _POWERS
        self._stages = np.einsum("sk,knr->rsn", powers, drive)

    def solve(self, values: FloatArray, first: FloatArray, guess: FloatArray) -> FloatArray:
        """Return the state at every sample.

        Parameters
        ----------
        values : ndarray, shape (P,)
            Free parameters.
        first : ndarray, shape (order,)
            State at the first sample.
        guess : ndarray, shape (n, order)
            Of the motion; a better guess takes fewer passes.

        Returns
        -------
        ndarray, shape (n, order)

        Raises
        ------
        FitError
            If the motion grows beyond all bounds.
        """
        if self.plant.n_switches > _KINKS:
            return self._march(values, first, derivatives=False)[0]
        motion = guess.copy()
        motion[0] = first
        found = self._newton(values, motion, self._n)
        if found is None:
            motion[1:] = first
            found = self._newton(values, motion, _SEGMENT)
        return self._marched(values, motion) if found is None else found

    def _march(
        self, values: FloatArray, first: FloatArray, *, derivatives: bool
    ) -> tuple[FloatArray, FloatArray]:
        march = March(self.plant, values, self._length, derivatives=derivatives)
        with np.errstate(all="ignore"):
            found = march.run(first, self._drive)
        if found is None:
            raise self._beyond_bounds(values)
        return found

    def _beyond_bounds(self, values: FloatArray) -> FitError:
        return FitError(
            "the motion grows beyond all bounds at the parameters "
            f"{dict(zip(self.plant.free, values.tolist(), strict=True))}"
        )

    def _marched(self, values: FloatArray, motion: FloatArray) -> FloatArray:
        """Return the motion stretch by stretch, each guessed to stay where it begins."""
        start, width, stretches = 0, _SEGMENT, 0
        while start < self._n:
            stretches += 1
            stop = min(start + width, self._n)
            motion[start + 1 : stop + 1] = motion[start]
            size = np.abs(motion[: start + 1]).max(axis=0)
            found = self._newton(values, motion[start : stop + 1], self._n, start, size)
            if found is not None:
                motion[start : stop + 1] = found
                start, width = stop, 2 * width
            elif width > 1 and stretches < _STRETCHES:
                width = max(1, width // _SHORTER)
            else:
                raise self._beyond_bounds(values)
        return motion

    def sensitivities(self, values: FloatArray, motion: FloatArray) -> FloatArray:
        """Return the states' derivatives by the first state and the free parameters.

        Parameters
        ----------
        values : ndarray, shape (P,)
        motion : ndarray, shape (n, order)
            From :meth:`solve` at these values.

        Returns
        -------
        ndarray, shape (n, order, order + P)
        """
        if self.plant.n_switches > _KINKS:
            return self._march(values, motion[0], derivatives=True)[1]
        flow = self.flow(values, motion[:-1], derivatives=2)
        order, count = self.plant.order, flow.by_value.shape[2]
        terms = np.zeros((self._n, order, order + count))
        terms[:, :, order:] = flow.by_value
        first = np.zeros((order, order + count))
        first[:, :order] = np.eye(order)
        return matrix_recursion(flow.by_state, terms, first)

    def accelerations(
        self,
        values: FloatArray,
        motion: FloatArray,
        drive: FloatArray,
        sensitivities: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the acceleration at every sample, and its derivatives where `sensitivities` are.

        Parameters
        ----------
        values : ndarray, shape (P,)
        motion : ndarray, shape (n, order)
        drive : ndarray, shape (n,)
        sensitivities : ndarray, shape (n, order, order + P), or None

        Returns
        -------
        acceleration : ndarray, shape (n,)
        slopes : ndarray, shape (n, order + P), or None
        """
        order, n = self.plant.order, motion.shape[0]
        y = motion.T
        direction, sides = self._branch(values, y, drive)
        found = self.plant.acceleration(*y, drive, direction, *sides, *values)
        acceleration, *by = (np.broadcast_to(entry, (n,)) for entry in found)
        if sensitivities is None:
            return np.array(acceleration), None
        slopes = np.einsum("in,nij->nj", np.array(by[:order]), sensitivities)
        slopes[:, order:] += np.array(by[order:]).T.reshape(n, -1)
        return np.array(acceleration), slopes

    def _newton(
        self,
        values: FloatArray,
        motion: FloatArray,
        segment: int,
        start: int = 0,
        earlier: FloatArray | float = 0.0,
    ) -> FloatArray | None:
        """Return the motion from a guess, or None where Newton's method does not find it.

        In the first pass corrections run through `segment` samples, then through twice as many.
        From sample `start` on, before which states have at most the size `earlier`.
        """
        order = self.plant.order
        last, growths = np.inf, 0
        for _ in range(_PASSES):
            with np.errstate(all="ignore"):
                flow = self.flow(values, motion[:-1], start, derivatives=1)
                gaps = flow.end - motion[1:]
                keep = flow.by_state
                if segment < len(gaps):
                    keep = keep.copy()
                    keep[segment - 1 :: segment] = 0.0
                change = matrix_recursion(keep, gaps[:, :, None], np.zeros((order, 1)))[..., 0]
                motion = motion + change
                size = np.maximum(np.abs(motion).max(axis=0), earlier) + 1e-300
                largest = float(np.max(np.abs(change).max(axis=0) / size))
            if not largest < np.inf:
                return None
            if segment >= len(gaps):
                # the next change is smaller by the same ratio at least
                ratio = min(1.0, largest / last) if last < np.inf else 1.0
                if largest * ratio < _TOLERANCE:
                    return motion
                growths += largest > last
                if growths > _GROWTHS:
                    return None
                last = largest
            segment = min(2 * segment, self._n)
        return None

    def flow(
        self, values: FloatArray, states: FloatArray, start: int = 0, *, derivatives: int
    ) -> Flow:
        """Return where the intervals that begin at `states`, (m, order), end.

        The first one begins at sample `start`. `derivatives`: 0 none, 1 by the state, 2 by the
        free parameters as well.
        """
        order = self.plant.order
        y, total = states.T, None
        for r in range(self._substeps):
            y, by = self._step(values, y, start, r, derivatives)
            if by is not None:
                total = by if total is None else _chained(by, total, order)
        if total is None:
            total = np.empty((order, order, 0))
        by_all = total.transpose(2, 0, 1)
        return Flow(y.T, by_all[:, :, :order], by_all[:, :, order:])

    def _step(
        self, values: FloatArray, y: FloatArray, start: int, r: int, derivatives: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the states after one fine step, and their derivatives (order, order + P, n)."""
        stages = self._stages[r][:, start : start + y.shape[1]]
        direction, sides = self._branch(values, y, stages[0])
        after, by = self._advance(values, y, stages, self._length, direction, sides, derivatives)
        crosses = after[1] * direction < 0.0
        if len(sides):
            both = self._switches(values, after, stages[1], direction, sides)
            now, soon = both[1 : 1 + len(sides)], both[2 + len(sides) :]
            crosses |= ((now * sides < 0.0) & (soon != 0.0)).any(axis=0)
        places = np.flatnonzero(crosses)
        if places.size:
            coefficients = self._drive[:, start + places, r]
            end, d = self._divided(
                values, y[:, places], coefficients, direction[places], sides[:, places], derivatives
            )
            after[:, places] = end
            if by is not None and d is not None:
                by[:, :, places] = d
        return after, by

    def _branch(
        self, values: FloatArray, y: FloatArray, drive: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the direction of motion, and the side of every switch, at the states `y`.

        Where the velocity is zero, or a switching function as near to zero as its passage is
        located, what it is about to become.
        """
        n, count = y.shape[1], self.plant.n_switches
        direction = np.where(y[1] < 0.0, -1.0, 1.0)
        sides = np.ones((count, n))
        still = np.flatnonzero(y[1] == 0.0)
        if still.size:
            (push,) = self.plant.push(*y[:, still], drive[still], 1.0, *sides[:, still], *values)
            direction[still] = np.where(np.broadcast_to(push, still.shape) < 0.0, -1.0, 1.0)
        if count:
            now = self._switches(values, y, drive, direction, sides)[1 : 1 + count]
            sides = np.where(now < 0.0, -1.0, 1.0)
            small = np.abs(now) <= _SMALL * np.abs(now).max(axis=1, keepdims=True)
            places = np.flatnonzero(small.any(axis=0))
            if places.size:
                own = sides[:, places]
                both = self._switches(values, y[:, places], drive[places], direction[places], own)
                soon = both[2 + count :]
                passes = np.abs(now[:, places]) <= _LOCATED * self._length * np.abs(soon)
                sides[:, places] = np.where(passes & (own * soon < 0.0), -own, own)
        return direction, sides

    def _switches(
        self,
        values: FloatArray,
        y: FloatArray,
        drive: FloatArray,
        direction: FloatArray,
        sides: FloatArray,
    ) -> FloatArray:
        """Return velocity and switching functions, then their rates; (2 + 2 switches, n)."""
        found = self.plant.switches(*y, drive, direction, *sides, *values)
        return np.array([np.broadcast_to(entry, y.shape[1:]) for entry in found])

    def _advance(
        self,
        values: FloatArray,
        y: FloatArray,
        stages: FloatArray,
        length: FloatArray | float,
        direction: FloatArray,
        sides: FloatArray,
        derivatives: int,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the states after a step on one branch, block by block, and their derivatives."""
        plant, (order, n) = self.plant, y.shape
        evaluate = (plant.advance, plant.advance_by_state, plant.advance_by_all)[derivatives]
        width = (0, order, order + len(plant.free))[derivatives]
        after = np.empty((order, n))
        by = np.empty((order, width, n))
        # casadi stores a matrix column by column
        rows = [*after, *(by[i, j] for j in range(width) for i in range(order))]
        for start in range(0, n, BLOCK):
            b = slice(start, start + BLOCK)
            part = length[b] if isinstance(length, np.ndarray) else length
            found = evaluate(*y[:, b], *stages[:, b], part, direction[b], *sides[:, b], *values)
            for row, entry in zip(rows, found, strict=True):
                row[b] = entry
        return after, by if derivatives else None

    def _divided(
        self,
        values: FloatArray,
        y: FloatArray,
        coefficients: FloatArray,
        direction: FloatArray,
        sides: FloatArray,
        derivatives: int,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return steps that are divided where the velocity or a switching function is zero."""
        order, n = y.shape
        y, direction, sides = y.copy(), direction.copy(), sides.copy()
        done = np.zeros(n)  # share of the step
        total: FloatArray | None = None
        if derivatives:
            count = len(self.plant.free) if derivatives == 2 else 0
            total = np.zeros((order, order + count, n))
            total[np.arange(order), np.arange(order)] = 1.0
        active: NDArray[np.intp] = np.arange(n)
        pieces = _PIECES + len(sides)
        for piece in range(pieces):
            part = _Part(
                y[:, active], coefficients[:, active], done[active], direction[active],
                sides[:, active],
            )  # fmt: skip
            share = 1.0 - done[active]
            after, by = self._part(values, part, share, derivatives)
            first, which = share.copy(), np.full(active.size, -1)
            divided = which[:0]
            # a switch may pass through zero before the motion turns, and back until the step's end
            for _ in range(1 + min(1, self.plant.n_switches)):
                if piece == pieces - 1:
                    break
                changed = self._earliest(values, part, after, first, which)
                if changed.size:
                    again, d = self._part(values, part.take(changed), first[changed], derivatives)
                    after[:, changed] = again
                    if by is not None and d is not None:
                        by[:, :, changed] = d
            divided = np.flatnonzero(which >= 0)
            y[:, active] = after
            if total is not None and by is not None:
                total[:, :, active] = _chained(by, total[:, :, active], order)
            if not divided.size:
                break
            done[active[divided]] += first[divided]
            hit, cause = active[divided], which[divided]
            turned = hit[cause == 0]
            if turned.size:
                y[1, turned] = 0.0
                direction[turned] *= -1.0
                drive = _polynomial(coefficients[:, turned], done[turned])
                if len(sides):
                    both = self._switches(
                        values, y[:, turned], drive, direction[turned], sides[:, turned]
                    )
                    now = both[1 : 1 + len(sides)]
                    sides[:, turned] = np.where(now < 0.0, -1.0, 1.0)
            for i in range(len(sides)):
                switched = hit[cause == i + 1]
                if switched.size:
                    drive = _polynomial(coefficients[:, switched], done[switched])
                    change, passed = self._passed(
                        values, y[:, switched], drive, direction[switched], sides[:, switched], i
                    )
                    y[:, switched] += change
                    if total is not None:
                        width = total.shape[1]
                        total[:, :, switched] = _chained(
                            passed[:, :width], total[:, :, switched], order
                        )
                    sides[i, switched] *= -1.0
            active = hit
        return y, total

    def _earliest(
        self,
        values: FloatArray,
        part: _Part,
        after: FloatArray,
        first: FloatArray,
        which: NDArray[np.intp],
    ) -> NDArray[np.intp]:
        """Shorten parts, in place, to where the first switching function passes through zero.

        `after` is the state at the share `first` of the step, where `which` passes already;
        return the parts that are shorter now.
        """
        signs = np.vstack([part.direction, part.sides])
        drive, count = part.drive(part.done + first), len(signs)
        both = self._switches(values, after, drive, part.direction, part.sides)
        ends, soon = both[:count], both[count:]
        before, share = which.copy(), first.copy()
        for i in range(count):
            beyond = (ends[i] * signs[i] < 0.0) & (before != i)
            places = np.flatnonzero(beyond & (soon[i] != 0.0) if i else beyond)
            if not places.size:
                continue
            where = self._passage(values, part.take(places), share[places], ends[i, places], i)
            earlier = where < first[places]
            first[places[earlier]] = where[earlier]
            which[places[earlier]] = i
        return np.flatnonzero(which != before)

    def _passed(
        self,
        values: FloatArray,
        y: FloatArray,
        drive: FloatArray,
        direction: FloatArray,
        sides: FloatArray,
        i: int,
    ) -> tuple[FloatArray, FloatArray]:
        """Return what switch `i` changes where it passes through zero; see `Plant.passages`."""
        order, n = y.shape
        found = self.plant.passages[i](*y, drive, direction, *sides, *values)
        entries = np.array([np.broadcast_to(entry, (n,)) for entry in found])
        return entries[:order], entries[order:].reshape(-1, order, n).transpose(1, 0, 2)

    def _part(
        self, values: FloatArray, part: _Part, share: FloatArray, derivatives: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the states after a share of a step."""
        stages = part.drive(part.done + _PLACES[:, None] * share)
        length = share * self._length
        return self._advance(
            values, part.y, stages, length, part.direction, part.sides, derivatives
        )

    def _passage(
        self, values: FloatArray, part: _Part, share: FloatArray, end: FloatArray, i: int
    ) -> FloatArray:
        """Return the share of the step after which switching function `i` passes through zero."""
        count = 1 + self.plant.n_switches
        low, high = np.zeros(share.shape), share.copy()
        sign = np.where(end < 0.0, -1.0, 1.0)
        begin = self._switches(values, part.y, part.drive(part.done), part.direction, part.sides)[i]
        where = share * np.clip(begin / (begin - end), 0.02, 0.98)
        for _ in range(_LOCATING):
            at, _ = self._part(values, part, where, 0)
            drive = part.drive(part.done + where)
            both = self._switches(values, at, drive, part.direction, part.sides)
            now, slope = both[i], both[count + i] * self._length
            beyond = now * sign > 0.0
            high, low = np.where(beyond, where, high), np.where(beyond, low, where)
            with np.errstate(divide="ignore", invalid="ignore"):
                trial = where - now / slope
            inside = (trial >= low) & (trial <= high)
            new = np.where(inside, trial, 0.5 * (low + high))
            moved, where = np.abs(new - where).max(), new
            if moved < _LOCATED:
                break
        return np.asarray(where)


@dataclass(frozen=True)
class _Part:
    """Some states within a step: where they are, and on which branch of the laws."""

    y: FloatArray
    coefficients: FloatArray
    done: FloatArray
    direction: FloatArray
    sides: FloatArray

    def take(self, places: NDArray[np.intp]) -> _Part:
        return _Part(
            self.y[:, places], self.coefficients[:, places], self.done[places],
            self.direction[places], self.sides[:, places],
        )  # fmt: skip

    def drive(self, place: FloatArray) -> FloatArray:
        return _polynomial(self.coefficients, place)


def _polynomial(coefficients: FloatArray, place: FloatArray) -> FloatArray:
    value = coefficients[7]
    for power in range(6, -1, -1):
        value = value * place + coefficients[power]
    return np.asarray(value)


def _chained(later: FloatArray, earlier: FloatArray, order: int) -> FloatArray:
    """Return the derivatives of a step after another one; arrays (order, order + P, n)."""
    total = np.empty_like(earlier)
    for i in range(order):
        row = later[i, 0] * earlier[0]
        for j in range(1, order):
            row += later[i, j] * earlier[j]
        row[order:] += later[i, order:]
        total[i] = row
    return total

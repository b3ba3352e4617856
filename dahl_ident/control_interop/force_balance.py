"""All amplitudes at which A |L + N(A)| equals the drive, by the describing function.

L is the linear part of a plant, N the describing function of the others; points and vectors of
parameters are rows of arrays.

**Passive points** (Im L >= 0) of laws that allow it have one amplitude. It lies between the bounds
that |N| and A |N| set, and is found by Newton's method in ln A, which never leaves its bracket.

**Other points** may have several, between the same bounds. A grid over this range finds the cells
where A |Z| crosses the drive, each of which contains one amplitude, and those where A |Z| has an
extremum, which contain two if it reaches the drive. Extrema closer to each other than the grid's
nodes, 1.8 % in amplitude, may be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.elements.facts import Sine
from dahl_ident.elements.model import as_model

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
_Scalar = TypeVar("_Scalar", bound=np.generic)
_Values = list[Sequence[FloatArray]]

_EPS = float(np.finfo(np.float64).eps)  # distance from 1 to the next number
_ROUNDING = 8.0 * _EPS  # of k - m omega^2 and its like, relative to the terms' sizes
_LARGEST = 1e300  # represents an unbounded amplitude
_REACH = 40  # decades of amplitude, m, to both sides, that are searched where N has no bounds
_SCAN_PER_DECADE = 128  # 1.8 % apart: closer pairs of roots may be missed
_COARSE_SCAN = 32  # the same where only one amplitude is needed
_TOGETHER = 2**15  # points times nodes: their arrays stay in the processor's cache
_AT_REST = np.zeros(())


@dataclass(frozen=True)
class Nonlinear:
    """The elements that depend on the amplitude, with one or many vectors of their parameters.

    `values` has those of each element, all of shape () or all (vectors,). `omega` likewise; it
    is 0 where no element depends on it.
    """

    elements: tuple[Element, ...]
    values: tuple[tuple[FloatArray, ...], ...]
    omega: FloatArray
    unique: bool
    """Whether the amplitude is unique if the linear part is passive."""

    def force_and_slope(
        self, amplitude: FloatArray, vector: IntArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return A N, the force's fundamental, and its derivative with respect to ln A.

        `vector` is the parameter vector of each row.
        """
        force, slope = np.zeros((2, *amplitude.shape), dtype=np.complex128)
        (omega,) = _rows((self.omega,), vector)
        for element, values in zip(self.elements, self.values, strict=True):
            N, by_amplitude, _ = element.settled(_rows(values, vector), Sine(amplitude, omega), 1)
            force += amplitude * N
            slope += amplitude * (N + amplitude * by_amplitude)
        return force, slope

    def over(self, grid: FloatArray, vector: IntArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the same for several rows over one grid of amplitudes, (rows or 1, n)."""
        shared = all(v.ndim == 0 for v in (self.omega, *(v for n in self.values for v in n)))
        vectors, which = np.unique(vector, return_inverse=True)
        if shared:
            vectors, which = vectors[:1], np.zeros(1, dtype=np.intp)
        force, slope = (
            table.reshape(vectors.size, -1)[which]
            for table in self.force_and_slope(
                np.tile(grid, vectors.size), np.repeat(vectors, grid.size)
            )
        )
        return force, slope

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Upper bounds of |N| and A |N| for each vector; infinite where unknown."""
        steepest, largest = np.zeros(()), np.zeros(())
        for element, values in zip(self.elements, self.values, strict=True):
            of_element = element.force_bounds(values)
            steepest, largest = steepest + of_element[0], largest + of_element[1]
        return steepest, largest

    def sound(self) -> BoolArray:
        """Return which vectors are within the laws' range, (1,) or (vectors,)."""
        knees = [e.knee(values) for e, values in zip(self.elements, self.values, strict=True)]
        with np.errstate(divide="ignore", invalid="ignore"):
            sizes = [np.log(np.atleast_1d(knee)) for pair in knees for knee in pair]
        return np.asarray(np.isfinite(sum(sizes)))


@dataclass(frozen=True)
class Plant:
    """A |L + N(A)| = drive at every point, in units scaled to the friction.

    All arrays have one entry a point.
    """

    linear: ComplexArray
    rounding: FloatArray  # rounding error of L from its terms
    drive: FloatArray
    vector: IntArray
    unit: FloatArray  # of amplitude, m
    friction: Nonlinear

    def at(self, points: IntArray) -> Plant:
        """Return the plant at some of its points."""
        names = ("linear", "rounding", "drive", "vector", "unit")
        return replace(self, **{name: getattr(self, name)[points] for name in names})

    def force(self, amplitude: FloatArray) -> ComplexArray:
        """Return A (L + N), the force phasor for a displacement phasor A."""
        return amplitude * self.linear + self.friction.force_and_slope(amplitude, self.vector)[0]

    def largest_friction(self) -> FloatArray:
        """Return the friction force's fundamental in gross slip."""
        return _rows((self.friction.bounds[1],), self.vector)[0] + np.zeros(self.drive.shape)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return amplitudes below and above every solution."""
        steepest, largest = _rows(self.friction.bounds, self.vector)
        stiffness = np.abs(self.linear)
        with np.errstate(divide="ignore", over="ignore"):
            low = 0.999 * self.drive / (stiffness + steepest)
            high = np.minimum(1.001 * (self.drive + largest) / stiffness, _LARGEST)
        bounded = np.isfinite(steepest) & np.isfinite(largest)
        unbounded = np.flatnonzero(~np.broadcast_to(bounded, stiffness.shape))
        grid = 10.0 ** np.arange(-_REACH, _REACH, 0.25)
        for start in range(0, unbounded.size, _TOGETHER // grid.size):
            points = unbounded[start : start + _TOGETHER // grid.size]
            least, most = self.at(points)._reach(grid)
            low[points] = np.maximum(low[points], least)
            high[points] = np.minimum(high[points], most)
        return low, high

    def _reach(self, grid: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return amplitudes beyond which A |Z| is far from the drive, where N has no bounds."""
        with np.errstate(all="ignore"):
            total = self.linear[:, None] * grid + self.friction.over(grid, self.vector)[0]
            ratio = np.abs(total) / self.drive[:, None]
        reached = ~(ratio < 0.1)  # true as well where A |Z| overflows
        first = np.where(reached.any(axis=1), reached.argmax(axis=1) - 1, grid.size - 1)
        last = grid.size - 1 - (ratio < 10.0)[:, ::-1].argmax(axis=1)
        return grid[np.maximum(first, 0)], grid[np.minimum(last + 1, grid.size - 1)]


def flatten(
    model: Element, values: Sequence[FloatArray], omega: FloatArray, drive: FloatArray
) -> tuple[Plant, tuple[int, ...]]:
    """Return the plant at every point of the broadcast arguments, and their shape."""
    shape = np.broadcast_shapes(np.shape(omega), np.shape(drive), *(np.shape(v) for v in values))
    linear, size = np.zeros((), dtype=np.complex128), np.zeros(())
    elements: list[Element] = []
    friction: _Values = []
    for element, numbers in as_model(model).of(values):
        if element.is_linear:
            part = element.stiffness(numbers, _AT_REST, omega)
            linear, size = linear + part, size + np.abs(part)
        else:
            elements.append(element)
            friction.append(numbers)
    rates = [] if all(e.rate_independent for e in elements) else [np.asarray(omega)]
    which: IntArray | None = None
    if rates and rates[0].ndim == 1 and all(np.shape(v)[-1:] in ((), (1,)) for v in values):
        one, which = np.unique(rates[0], return_inverse=True)  # rows of one frequency are alike
        rates = [one]
    finite = [np.isfinite(v) for numbers in friction for v in numbers]
    if not all(np.all(f) for f in finite):  # a search overflowed: no L, and no amplitude, there
        sound = np.all(np.broadcast_arrays(*finite), axis=0)
        linear = np.where(sound, linear, np.nan)
        friction = [[np.where(sound, v, 1.0) for v in numbers] for numbers in friction]
    force, stiffness, friction = _units(elements, friction)
    batch = np.broadcast_shapes(*(np.shape(v) for numbers in (*friction, rates) for v in numbers))
    vectors = np.arange(np.prod(batch, dtype=np.intp)).reshape(batch)
    if which is not None:
        vectors = vectors[..., which]
    nonlinear = Nonlinear(
        tuple(elements),
        tuple(tuple(_flat_values(v, batch) for v in numbers) for numbers in friction),
        _flat_values(rates[0], batch) if rates else np.zeros(()),
        all(element.unique_response for element in elements),
    )
    return Plant(
        _flat(linear / stiffness, shape), _flat(_ROUNDING * size / stiffness, shape),
        _flat(drive / force, shape), _flat(vectors, shape), _flat(force / stiffness, shape),
        nonlinear,
    ), shape  # fmt: skip


def _units(
    elements: Sequence[Element], friction: _Values
) -> tuple[FloatArray, FloatArray, _Values]:
    """Return units of force and stiffness, and the friction in them.

    In its own units one element may have the same numbers for every vector: Dahl friction of one
    exponent, say.
    """
    one = np.ones(())
    if len(friction) == 1 and elements[0].rate_independent:
        force, stiffness, numbers = elements[0].normalised(friction[0])
        if all(np.size(v) and np.all(v == np.ravel(v)[0]) for v in numbers):
            return force, stiffness, [[np.asarray(np.ravel(v)[0]) for v in numbers]]
    return one, one, friction


def _flat_values(values: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    return _flat(values, batch) if np.prod(batch) > 1 else np.reshape(values, ())


def _flat(array: NDArray[_Scalar], shape: tuple[int, ...]) -> NDArray[_Scalar]:
    """Return the broadcast array in one dimension; a single number is not copied."""
    if np.size(array) == 1:
        return np.broadcast_to(np.ravel(array), int(np.prod(shape)))
    return np.broadcast_to(array, shape).ravel()


def _rows(values: Sequence[FloatArray], vector: IntArray) -> list[FloatArray]:
    return [v[vector] if v.ndim else v for v in values]


def solve(
    model: Element,
    values: Sequence[FloatArray],
    omega: FloatArray,
    drive: FloatArray,
    start: FloatArray | None = None,
) -> FloatArray:
    """Return the displacement amplitude A with A |Z(A, omega)| = drive, unchecked.

    All arguments broadcast, `values` (in the order of the model's parameters) included, so a
    batch of parameter vectors has arrays of shape (S, 1). NaN where there is no amplitude. Of
    several amplitudes the one nearest to `start` in ratio, else the smallest; two may be
    missed where A |Z| turns twice within 7.5 % of amplitude.
    """
    plant, shape = flatten(model, values, omega, drive)
    roots = find_roots(plant, _COARSE_SCAN) * plant.unit[:, None]
    if start is None or roots.shape[1] == 1:
        return roots[:, 0].reshape(shape)
    near = np.broadcast_to(start, shape).reshape(-1, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log(roots / near))
    distance[np.isnan(distance)] = np.inf
    nearest = distance.argmin(axis=1)[:, None]
    return np.take_along_axis(roots, nearest, axis=1).reshape(shape)


def find_roots(plant: Plant, per_decade: int = _SCAN_PER_DECADE) -> FloatArray:
    """Return every amplitude of every point in the plant's units, shape (points, most).

    They rise along a row; a row with fewer than the most is filled up with NaN. `per_decade` is
    the number of nodes a decade of amplitude in the search for several.
    """
    resonant = np.abs(plant.linear) <= plant.rounding
    if not plant.friction.elements:
        with np.errstate(divide="ignore", over="ignore"):
            return np.where(resonant, np.nan, plant.drive / np.abs(plant.linear))[:, None]
    known = np.isfinite(plant.linear)
    if plant.friction.unique:
        sound = plant.friction.sound()
        known &= sound[plant.vector] if sound.size > 1 else sound
    passive = known & plant.friction.unique & (plant.linear.imag >= -plant.rounding)
    single = passive & ~(resonant & (plant.drive >= plant.largest_friction()))
    amplitude = np.full(plant.drive.shape, np.nan)
    alone = np.flatnonzero(single)
    if alone.size:
        amplitude[alone] = _single_roots(plant.at(alone))
    others = np.flatnonzero(known & ~passive)
    if not others.size:
        return amplitude[:, None]
    point, crossing = _scan(plant, others, per_decade)
    _, first, counts = np.unique(point, return_index=True, return_counts=True)
    column = np.arange(point.size) - np.repeat(first, counts)
    roots = np.full((amplitude.size, 1 + int(column.max(initial=0))), np.nan)
    roots[:, 0] = amplitude
    roots[point, column] = crossing
    return roots


def _single_roots(plant: Plant) -> FloatArray:
    """Return the one amplitude of each passive point."""
    low, high = plant.bounds()
    largest = plant.largest_friction()
    with np.errstate(divide="ignore", invalid="ignore"):  # in gross slip the friction is known
        slipping = np.sqrt(plant.drive - largest) * np.sqrt(plant.drive + largest)
        start = slipping / np.abs(plant.linear)
    return _polish(plant, low, high, start, np.ones(low.shape, dtype=bool))


def _polish(
    plant: Plant, low: FloatArray, high: FloatArray, start: FloatArray, rising: BoolArray
) -> FloatArray:
    """Return the amplitude in each bracket, by Newton steps in ln A or else bisection.

    A |Z| - u_0 changes sign once between `low` and `high`, upwards where `rising`. A `start`
    outside its bracket, or NaN, stands for the middle.
    """
    low, high = low.copy(), high.copy()
    amplitude = np.where((start > low) & (start < high), start, np.sqrt(low) * np.sqrt(high))
    active = np.arange(amplitude.size)
    for _ in range(200):
        A, part = amplitude[active], plant.at(active)
        force, slope = part.friction.force_and_slope(A, part.vector)
        linear = A * part.linear
        total = linear + force
        # amplification of rounding near a sharp resonance, where L and N cancel
        kappa = (np.abs(linear) + np.abs(force)) / part.drive
        with np.errstate(all="ignore"):  # a step from a turning point is not a number: bisect
            g = np.log(np.abs(total) / part.drive)
            step = -g / ((linear + slope) / total).real
            newton = A * np.exp(step)
            excess = np.expm1(g)  # A |Z|/u_0 - 1, of which rounding leaves eps kappa
        beyond = (g > 0.0) == rising[active]
        high[active[beyond]] = A[beyond]
        low[active[~beyond]] = A[~beyond]
        left, right = low[active], high[active]
        inside = (newton >= left) & (newton <= right)
        settled = (np.abs(excess) <= 64.0 * _EPS * kappa) | (right <= left * (1.0 + 4.0 * _EPS))
        amplitude[active] = np.where(
            inside, newton, np.where(settled, A, np.sqrt(left) * np.sqrt(right))
        )
        settled |= inside & (np.abs(step) * kappa < 1e-8)
        active = active[~settled]
        if not active.size:
            break
    return amplitude


class _Cells(NamedTuple):
    """Cells of a grid in which A |Z| crosses the drive, or may cross it twice at an extremum."""

    point: IntArray
    low: FloatArray
    high: FloatArray
    above: BoolArray  # whether A |Z| exceeds u_0 at the lower end
    above_after: BoolArray  # and at the upper
    falling: BoolArray  # whether it falls at the lower end

    def take(self, which: BoolArray) -> _Cells:
        point, low, high, *signs = self
        return _Cells(point[which], low[which], high[which], *(sign[which] for sign in signs))


def _scan(plant: Plant, points: IntArray, per_decade: int) -> tuple[IntArray, FloatArray]:
    """Return every amplitude of the chosen points, as pairs (point, amplitude) in rising order."""
    chosen = plant.at(points)
    low, high = chosen.bounds()
    order = np.argsort(high)  # groups the few points near resonance, which need a long grid
    decades = np.log10(high[order[order.size // 2]] / low.min())
    together = max(1, int(_TOGETHER / (per_decade * max(decades, 1.0))))
    parts = []
    for first in range(0, points.size, together):
        part = order[first : first + together]
        least, most = low[part].min(), high[part].max()
        nodes = 2 + int(np.ceil(per_decade * (np.log10(most) - np.log10(least))))
        parts.append(_cells(chosen.at(part), part, np.geomspace(least, most, nodes)))
    cells = _Cells(*map(np.concatenate, zip(*parts, strict=True)))
    once = cells.take(cells.above != cells.above_after)
    twice, between = _separated(chosen, cells.take(cells.above == cells.above_after))
    at = np.concatenate((once.point, twice.point, twice.point))
    amplitude = _polish(
        chosen.at(at),
        np.concatenate((once.low, twice.low, between)),
        np.concatenate((once.high, between, twice.high)),
        np.full(at.shape, np.nan),
        np.concatenate((~once.above, ~twice.above, twice.above)),
    )
    order = np.lexsort((amplitude, at))
    return points[at[order]], amplitude[order]


def _cells(plant: Plant, names: IntArray, grid: FloatArray) -> _Cells:
    """Return the cells of every point that need a closer look; `names` are the points' numbers."""
    force, slope = plant.friction.over(grid, plant.vector)
    linear, drive = plant.linear[:, None], plant.drive[:, None]
    above, falling, near = _compared(linear, drive, grid, force, slope, grid[1] / grid[0])
    crosses = above[:, 1:] != above[:, :-1]
    turns_towards = (falling[:, :-1] == above[:, :-1]) & (falling[:, 1:] != above[:, 1:])
    row, cell = np.nonzero(crosses | (turns_towards & (near[:, 1:] | near[:, :-1])))
    ends = above[row, cell], above[row, cell + 1]
    return _Cells(names[row], grid[cell], grid[cell + 1], *ends, falling[row, cell])


def _compared(
    linear: ComplexArray,
    drive: FloatArray,
    amplitude: FloatArray,
    force: ComplexArray,
    slope: ComplexArray,
    ratio: FloatArray,
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return whether A |Z| exceeds u_0, whether it falls, and whether a change of A may reach u_0.

    `force` and `slope` are A N and its derivative with respect to ln A. A changes by at most
    `ratio`; A |Z| then changes by no more than twice its steepest slope at A.
    """
    total, slope = linear * amplitude + force, linear * amplitude + slope
    size = np.abs(total)
    falling = (total.conj() * slope).real < 0.0
    near = np.abs(size - drive) <= 2.0 * np.log(ratio) * np.abs(slope)
    return size > drive, falling, near


def _separated(plant: Plant, cells: _Cells) -> tuple[_Cells, FloatArray]:
    """Return the cells where A |Z| crosses u_0 twice, and an amplitude between the two.

    By bisection towards the turning point, until it is beyond u_0 or too far to reach it.
    """
    crossed, between = np.zeros(cells.point.shape, dtype=np.bool_), np.empty(cells.point.shape)
    low, high = cells.low.copy(), cells.high.copy()
    active = np.arange(crossed.size)
    while active.size:
        middle = np.sqrt(low[active]) * np.sqrt(high[active])
        part = plant.at(cells.point[active])
        force, slope = part.friction.force_and_slope(middle, part.vector)
        above, falling, near = _compared(
            part.linear, part.drive, middle, force, slope, high[active] / low[active]
        )
        across = above != cells.above[active]
        going = near & ~across & (middle > low[active]) & (middle < high[active])
        crossed[active[across]], between[active[across]] = True, middle[across]
        before = falling == cells.falling[active]
        low[active[before]], high[active[~before]] = middle[before], middle[~before]
        active = active[going]
    return cells.take(crossed), between[crossed]

"""All amplitudes at which A |L + N(A)| equals the drive, by the describing function.

L is the linear part of a plant, N the describing function of the other elements; points and vectors
of parameters are rows of arrays.

**Passive points** (Im L >= 0) have one amplitude if the laws are such that it is unique. It is
found by Newton's method in ln A, within a bracket that follows from the bounds of |N| and A |N|.

**Other points** may have several amplitudes within the same bracket. A grid is searched for the
cells in which A |Z| crosses the drive, each of which contains one amplitude, and for those with an
extremum of A |Z|, which contain two if the extremum is beyond the drive. Extrema closer together
than the nodes of the grid, 1.8 % in amplitude, may be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import EPS, BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.elements.element import Element, as_model
from dahl_ident.elements.facts import Sine

_Scalar = TypeVar("_Scalar", bound=np.generic)
_Values = list[Sequence[FloatArray]]

_ROUNDING_OF_SUMS = 8.0 * EPS  # of sums such as k - m omega^2, relative to the sizes of the terms
_UNBOUNDED = 1e300  # represents an unbounded amplitude
_DECADES = 40  # of amplitude below and above 1 m that are searched if N has no bounds
_SCAN_PER_DECADE = 128  # nodes, 1.8 % apart; closer pairs of roots may be missed
_COARSE_SCAN = 32  # nodes per decade if only one amplitude is needed
_POINTS_AT_ONCE = 2**15  # points times nodes computed at once, so that arrays stay in the cache


@dataclass(frozen=True)
class Nonlinear:
    """The elements that depend on the amplitude, with one or many vectors of their parameters.

    `values` are the parameters of each element, all of shape () or all (vectors,). So is `omega`,
    which is 0 if no element depends on it.
    """

    elements: tuple[Element, ...]
    values: tuple[tuple[FloatArray, ...], ...]
    omega: FloatArray
    unique: bool
    """Whether the amplitude is unique if the linear part is passive."""

    def force_and_slope(
        self, amplitude: FloatArray, vector: IntArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return A N, the fundamental of the force, and its derivative with respect to ln A.

        `vector` is the parameter vector of each row.
        """
        force, slope = np.zeros((2, *amplitude.shape), dtype=np.complex128)
        (omega,) = _rows((self.omega,), vector)
        for element, values in zip(self.elements, self.values, strict=True):
            N, by_amplitude, _ = element.settled(_rows(values, vector), Sine(amplitude, omega), 1)
            force += amplitude * N
            slope += amplitude * (N + amplitude * by_amplitude)
        return force, slope

    def on_grid(self, grid: FloatArray, vector: IntArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the same for several rows on one grid of amplitudes, (rows or 1, n)."""
        shared = all(v.ndim == 0 for v in (self.omega, *(v for n in self.values for v in n)))
        vectors, index = np.unique(vector, return_inverse=True)
        if shared:
            vectors, index = vectors[:1], np.zeros(1, dtype=np.intp)
        tables = self.force_and_slope(np.tile(grid, vectors.size), np.repeat(vectors, grid.size))
        force, slope = (table.reshape(vectors.size, -1)[index] for table in tables)
        return force, slope

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Upper bounds of |N| and A |N| for each vector; infinite where unknown."""
        steepest, largest = np.zeros(()), np.zeros(())
        for element, values in zip(self.elements, self.values, strict=True):
            stiffness, force = element.force_bounds(values)
            steepest, largest = steepest + stiffness, largest + force
        return steepest, largest

    def is_valid(self) -> BoolArray:
        """Return which vectors are within the range of the laws, (1,) or (vectors,)."""
        knees = [e.knee(values) for e, values in zip(self.elements, self.values, strict=True)]
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = [np.log(np.atleast_1d(knee)) for pair in knees for knee in pair]
        return np.asarray(np.isfinite(sum(logs)))


@dataclass(frozen=True)
class Plant:
    """The equation A |L + N(A)| = drive at every point, in units scaled to the friction.

    All arrays have one entry per point.
    """

    linear: ComplexArray
    rounding: FloatArray  # rounding error of L
    drive: FloatArray
    vector: IntArray
    unit: FloatArray  # unit of amplitude, m
    friction: Nonlinear

    def at(self, points: IntArray) -> Plant:
        """Return the equation at some of the points."""
        names = ("linear", "rounding", "drive", "vector", "unit")
        return replace(self, **{name: getattr(self, name)[points] for name in names})

    def force(self, amplitude: FloatArray) -> ComplexArray:
        """Return A (L + N), the force phasor for a displacement phasor A."""
        return amplitude * self.linear + self.friction.force_and_slope(amplitude, self.vector)[0]

    def largest_friction(self) -> FloatArray:
        """Return the fundamental of the friction force in gross slip."""
        return _rows((self.friction.bounds[1],), self.vector)[0] + np.zeros(self.drive.shape)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return a lower and an upper bound of all solutions."""
        steepest, largest = _rows(self.friction.bounds, self.vector)
        stiffness = np.abs(self.linear)
        with np.errstate(divide="ignore", over="ignore"):
            low = 0.999 * self.drive / (stiffness + steepest)
            high = np.minimum(1.001 * (self.drive + largest) / stiffness, _UNBOUNDED)
        bounded = np.isfinite(steepest) & np.isfinite(largest)
        unbounded = np.flatnonzero(~np.broadcast_to(bounded, stiffness.shape))
        grid = 10.0 ** np.arange(-_DECADES, _DECADES, 0.25)
        for start in range(0, unbounded.size, _POINTS_AT_ONCE // grid.size):
            points = unbounded[start : start + _POINTS_AT_ONCE // grid.size]
            least, most = self.at(points)._grid_bounds(grid)
            low[points] = np.maximum(low[points], least)
            high[points] = np.minimum(high[points], most)
        return low, high

    def _grid_bounds(self, grid: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return grid amplitudes outside which A |Z| is far from the drive."""
        with np.errstate(all="ignore"):
            total = self.linear[:, None] * grid + self.friction.on_grid(grid, self.vector)[0]
            ratio = np.abs(total) / self.drive[:, None]
        reached = ~(ratio < 0.1)  # also true where A |Z| overflows
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
            part = element.stiffness(numbers, np.zeros(()), omega)
            linear, size = linear + part, size + np.abs(part)
        else:
            elements.append(element)
            friction.append(numbers)
    rates = [] if all(e.rate_independent for e in elements) else [np.asarray(omega)]
    index: IntArray | None = None
    if rates and rates[0].ndim == 1 and all(np.shape(v)[-1:] in ((), (1,)) for v in values):
        distinct, index = np.unique(rates[0], return_inverse=True)
        rates = [distinct]
    finite = [np.isfinite(v) for numbers in friction for v in numbers]
    if not all(np.all(f) for f in finite):  # a search overflowed; there is no amplitude there
        valid = np.all(np.broadcast_arrays(*finite), axis=0)
        linear = np.where(valid, linear, np.nan)
        friction = [[np.where(valid, v, 1.0) for v in numbers] for numbers in friction]
    force, stiffness, friction = _units(elements, friction)
    batch = np.broadcast_shapes(*(np.shape(v) for numbers in (*friction, rates) for v in numbers))
    vectors = np.arange(np.prod(batch, dtype=np.intp)).reshape(batch)
    if index is not None:
        vectors = vectors[..., index]
    nonlinear = Nonlinear(
        tuple(elements),
        tuple(tuple(_flat_values(v, batch) for v in numbers) for numbers in friction),
        _flat_values(rates[0], batch) if rates else np.zeros(()),
        all(element.unique_response for element in elements),
    )
    return Plant(
        _flat(linear / stiffness, shape),
        _flat(_ROUNDING_OF_SUMS * size / stiffness, shape),
        _flat(drive / force, shape),
        _flat(vectors, shape),
        _flat(force / stiffness, shape),
        nonlinear,
    ), shape


def _units(
    elements: Sequence[Element], friction: _Values
) -> tuple[FloatArray, FloatArray, _Values]:
    """Return units of force and stiffness, and the friction parameters in these units.

    In suitable units a single element, such as Dahl friction with a given exponent, has the same
    parameters in every vector.
    """
    if len(friction) == 1 and elements[0].rate_independent:
        force, stiffness, numbers = elements[0].normalised(friction[0])
        if all(np.size(v) and np.all(v == np.ravel(v)[0]) for v in numbers):
            return force, stiffness, [[np.asarray(np.ravel(v)[0]) for v in numbers]]
    return np.ones(()), np.ones(()), friction


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
    """Return the displacement amplitude A with A |Z(A, omega)| = drive, without checks.

    All arguments, including `values` (in the order of the model's parameters), are broadcast, so a
    batch of parameter vectors has arrays of shape (S, 1). The result is NaN where there is no
    amplitude. Of several amplitudes it is the one whose ratio to `start` is nearest to 1, by
    default the smallest; two may be missed if A |Z| has two extrema within 7.5 % of amplitude.
    """
    plant, shape = flatten(model, values, omega, drive)
    roots = find_roots(plant, _COARSE_SCAN) * plant.unit[:, None]
    if start is None or roots.shape[1] == 1:
        return roots[:, 0].reshape(shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log(roots / np.broadcast_to(start, shape).reshape(-1, 1)))
    distance[np.isnan(distance)] = np.inf
    nearest = distance.argmin(axis=1)[:, None]
    return np.take_along_axis(roots, nearest, axis=1).reshape(shape)


def find_roots(plant: Plant, per_decade: int = _SCAN_PER_DECADE) -> FloatArray:
    """Return all amplitudes of every point in the plant's units, shape (points, largest number).

    They increase along a row, and are followed by NaN. `per_decade` is the number of nodes per
    decade of amplitude in the search for several.
    """
    resonant = np.abs(plant.linear) <= plant.rounding
    if not plant.friction.elements:
        with np.errstate(divide="ignore", over="ignore"):
            return np.where(resonant, np.nan, plant.drive / np.abs(plant.linear))[:, None]
    known = np.isfinite(plant.linear)
    if plant.friction.unique:
        valid = plant.friction.is_valid()
        known &= valid[plant.vector] if valid.size > 1 else valid
    passive = known & plant.friction.unique & (plant.linear.imag >= -plant.rounding)
    single = passive & ~(resonant & (plant.drive >= plant.largest_friction()))
    amplitude = np.full(plant.drive.shape, np.nan)
    if single.any():
        amplitude[single] = _single_roots(plant.at(np.flatnonzero(single)))
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
    """Return the amplitude of each passive point."""
    low, high = plant.bounds()
    largest = plant.largest_friction()
    with np.errstate(divide="ignore", invalid="ignore"):  # in gross slip the friction is known
        slipping = np.sqrt(plant.drive - largest) * np.sqrt(plant.drive + largest)
        start = slipping / np.abs(plant.linear)
    return _polish(plant, low, high, start, np.ones(low.shape, dtype=bool))


def _polish(
    plant: Plant, low: FloatArray, high: FloatArray, start: FloatArray, rising: BoolArray
) -> FloatArray:
    """Return the amplitude in each bracket, by Newton steps in ln A, otherwise by bisection.

    A |Z| - u_0 changes sign once between `low` and `high`, upwards if `rising`. A `start` outside
    its bracket, or NaN, is replaced by the middle.
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
        with np.errstate(all="ignore"):  # at an extremum the step is NaN: bisect
            g = np.log(np.abs(total) / part.drive)
            step = -g / ((linear + slope) / total).real
            newton = A * np.exp(step)
            excess = np.expm1(g)  # A |Z|/u_0 - 1, with a rounding error of eps kappa
        is_high = (g > 0.0) == rising[active]
        high[active[is_high]] = A[is_high]
        low[active[~is_high]] = A[~is_high]
        left, right = low[active], high[active]
        inside = (newton >= left) & (newton <= right)
        converged = (np.abs(excess) <= 64.0 * EPS * kappa) | (right <= left * (1.0 + 4.0 * EPS))
        amplitude[active] = np.where(
            inside, newton, np.where(converged, A, np.sqrt(left) * np.sqrt(right))
        )
        converged |= inside & (np.abs(step) * kappa < 1e-8)
        active = active[~converged]
        if not active.size:
            break
    return amplitude


class _Cells(NamedTuple):
    """Cells of a grid in which A |Z| crosses the drive, or may cross it twice at an extremum."""

    point: IntArray
    low: FloatArray
    high: FloatArray
    above_low: BoolArray  # whether A |Z| exceeds u_0 at the lower end
    above_high: BoolArray  # and at the upper end
    falling: BoolArray  # whether it falls at the lower end

    def take(self, mask: BoolArray) -> _Cells:
        point, low, high, *signs = self
        return _Cells(point[mask], low[mask], high[mask], *(sign[mask] for sign in signs))


def _scan(plant: Plant, points: IntArray, per_decade: int) -> tuple[IntArray, FloatArray]:
    """Return all amplitudes of the chosen points, as pairs (point, amplitude) in rising order."""
    low, high = plant.at(points).bounds()
    bounded = ~np.isnan(low + high)  # outside the range of a law there is no solution
    points, low, high = points[bounded], low[bounded], high[bounded]
    if not points.size:
        return points, low
    chosen = plant.at(points)
    order = np.argsort(high)  # groups the few points near a resonance, which need a long grid
    decades = np.log10(high[order[order.size // 2]] / low.min())
    block = max(1, int(_POINTS_AT_ONCE / (per_decade * max(decades, 1.0))))
    parts = []
    for first in range(0, points.size, block):
        part = order[first : first + block]
        least, most = low[part].min(), high[part].max()
        nodes = 2 + int(np.ceil(per_decade * (np.log10(most) - np.log10(least))))
        parts.append(_cells(chosen.at(part), part, np.geomspace(least, most, nodes)))
    cells = _Cells(*map(np.concatenate, zip(*parts, strict=True)))
    crosses = cells.above_low != cells.above_high
    once = cells.take(crosses)
    twice, between = _double_crossings(chosen, cells.take(~crosses))
    point = np.concatenate((once.point, twice.point, twice.point))
    amplitude = _polish(
        chosen.at(point),
        np.concatenate((once.low, twice.low, between)),
        np.concatenate((once.high, between, twice.high)),
        np.full(point.shape, np.nan),
        np.concatenate((~once.above_low, ~twice.above_low, twice.above_low)),
    )
    order = np.lexsort((amplitude, point))
    return points[point[order]], amplitude[order]


def _cells(plant: Plant, numbers: IntArray, grid: FloatArray) -> _Cells:
    """Return the cells of all points, with their numbers, that contain or may contain roots."""
    force, slope = plant.friction.on_grid(grid, plant.vector)
    linear, drive = plant.linear[:, None], plant.drive[:, None]
    above, falling, near = _compared(linear, drive, grid, force, slope, grid[1] / grid[0])
    crosses = above[:, 1:] != above[:, :-1]
    turns_towards = (falling[:, :-1] == above[:, :-1]) & (falling[:, 1:] != above[:, 1:])
    row, cell = np.nonzero(crosses | (turns_towards & (near[:, 1:] | near[:, :-1])))
    ends = above[row, cell], above[row, cell + 1]
    return _Cells(numbers[row], grid[cell], grid[cell + 1], *ends, falling[row, cell])


def _compared(
    linear: ComplexArray,
    drive: FloatArray,
    amplitude: FloatArray,
    force: ComplexArray,
    slope: ComplexArray,
    ratio: FloatArray,
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return whether A |Z| exceeds u_0, whether it falls, and whether it is near u_0.

    `force` and `slope` are A N and its derivative with respect to ln A. It is near if a change of A
    by the factor `ratio`, with twice the largest possible slope of A |Z| at A, reaches u_0.
    """
    total, slope = linear * amplitude + force, linear * amplitude + slope
    size = np.abs(total)
    falling = (total.conj() * slope).real < 0.0
    near = np.abs(size - drive) <= 2.0 * np.log(ratio) * np.abs(slope)
    return size > drive, falling, near


def _double_crossings(plant: Plant, cells: _Cells) -> tuple[_Cells, FloatArray]:
    """Return the cells in which A |Z| crosses u_0 twice, and an amplitude between the two.

    The extremum is approached by bisection until A |Z| has crossed u_0 or is too far from it.
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
        beyond = above != cells.above_low[active]
        continues = near & ~beyond & (middle > low[active]) & (middle < high[active])
        crossed[active[beyond]], between[active[beyond]] = True, middle[beyond]
        before = falling == cells.falling[active]
        low[active[before]], high[active[~before]] = middle[before], middle[~before]
        active = active[continues]
    return cells.take(crossed), between[crossed]

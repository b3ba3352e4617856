"""All amplitudes at which A |L + N(A)| equals the drive.

**Passive points** (Im L >= 0) have one. It lies between the bounds that |N| and A |N| set, and is
found by Newton's method in ln A, which never leaves its bracket.

**Active points** (Im L < 0) may have several, between the same bounds. A grid over this range finds
the cells where A |Z| crosses the drive, each of which contains one amplitude, and those where A |Z|
has an extremum near the drive, which contain two if it reaches the drive. Extrema closer to each
other than the grid's nodes, 1.8 % in amplitude, may be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.steady_state.plant import EPS, BoolArray, IntArray, Nonlinear, Plant, flatten

_SCAN_PER_DECADE = 128  # 1.8 % apart: closer pairs of roots may be missed
_COARSE_SCAN = 32  # the same where only one amplitude is needed
_SCAN_CELLS = 2**15  # points times nodes of the scan that are processed at once


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
    the number of nodes a decade of amplitude in the search at active points.
    """
    resonant = np.abs(plant.linear) <= plant.rounding
    if not plant.friction.elements:
        with np.errstate(divide="ignore", over="ignore"):
            return np.where(resonant, np.nan, plant.drive / np.abs(plant.linear))[:, None]
    known = np.isfinite(plant.linear)
    if plant.friction.unique:
        sound = _sound(plant.friction)
        known &= sound[plant.vector] if sound.size > 1 else sound
    passive = known & plant.friction.unique & (plant.linear.imag >= -plant.rounding)
    single = passive & ~(resonant & (plant.drive >= plant.largest_friction()))
    amplitude = np.full(plant.drive.shape, np.nan)
    alone = np.flatnonzero(single)
    if alone.size:
        amplitude[alone] = _single_roots(plant.at(alone))
    active = np.flatnonzero(known & ~passive)
    if not active.size:
        return amplitude[:, None]
    point, crossing = _scan(plant, active, per_decade)
    column = _places(point)
    roots = np.full((amplitude.size, 1 + int(column.max(initial=0))), np.nan)
    roots[:, 0] = amplitude
    roots[point, column] = crossing
    return roots


def _sound(friction: Nonlinear) -> BoolArray:
    """Return which vectors are within the laws' range, (1,) or (vectors,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (np.log(np.atleast_1d(knee)) for knee in friction.knees())
    return np.asarray(np.isfinite(low + high))


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
        g, s = part.misfit(A, force, slope)
        beyond = (g > 0.0) == rising[active]
        high[active[beyond]] = A[beyond]
        low[active[~beyond]] = A[~beyond]
        left, right = low[active], high[active]
        kappa = part.conditioning(A, force)
        with np.errstate(all="ignore"):  # a step from a turning point is not a number: bisect
            step = -g / s
            newton = A * np.exp(step)
            excess = np.expm1(g)  # A |Z|/u_0 - 1, of which rounding leaves eps kappa
        inside = (newton >= left) & (newton <= right)
        settled = (np.abs(excess) <= 64.0 * EPS * kappa) | (right <= left * (1.0 + 4.0 * EPS))
        amplitude[active] = np.where(
            inside, newton, np.where(settled, A, np.sqrt(left) * np.sqrt(right))
        )
        settled |= inside & (np.abs(step) * kappa < 1e-8)
        active = active[~settled]
        if not active.size:
            break
    return amplitude


def _scan(plant: Plant, points: IntArray, per_decade: int) -> tuple[IntArray, FloatArray]:
    """Return every amplitude of the chosen points, as pairs (point, amplitude) in rising order."""
    chosen = plant.at(points)
    low, high = chosen.bounds()
    order = np.argsort(high)  # groups the few points near resonance, which need a long grid
    decades = np.log10(high[order[order.size // 2]] / low.min())
    together = max(1, int(_SCAN_CELLS / (per_decade * max(decades, 1.0))))
    parts = []
    for first in range(0, points.size, together):
        part = order[first : first + together]
        least, most = low[part].min(), high[part].max()
        nodes = 2 + int(np.ceil(per_decade * (np.log10(most) - np.log10(least))))
        parts.append(_scan_grid(chosen.at(part), part, np.geomspace(least, most, nodes)))
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


class _Cells(NamedTuple):
    """Cells of a grid in which A |Z| crosses the drive, or may cross it twice at an extremum."""

    point: IntArray
    low: FloatArray
    high: FloatArray
    above: BoolArray  # whether A |Z| exceeds u_0 at the lower end
    above_after: BoolArray  # and at the upper
    falling: BoolArray  # whether it falls at the lower end

    def take(self, which: BoolArray | IntArray) -> _Cells:
        point, low, high, *signs = self
        return _Cells(point[which], low[which], high[which], *(sign[which] for sign in signs))


def _scan_grid(plant: Plant, names: IntArray, grid: FloatArray) -> _Cells:
    """Return the cells of every point that need a closer look; `names` are the points' numbers."""
    above, falling, near = _signs(plant, grid)
    crosses = above[:, 1:] != above[:, :-1]
    turns_towards = (falling[:, :-1] == above[:, :-1]) & (falling[:, 1:] != above[:, 1:])
    row, cell = np.nonzero(crosses | (turns_towards & near))
    ends = above[row, cell], above[row, cell + 1]
    return _Cells(names[row], grid[cell], grid[cell + 1], *ends, falling[row, cell])


def _signs(plant: Plant, grid: FloatArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return where A |Z| exceeds u_0 and where it falls, (points, nodes), and where it is near.

    The last for every cell: whether A |Z| may reach u_0 from either of its ends.
    """
    shared = plant.friction.shared
    vectors, which = np.unique(plant.vector, return_inverse=True)
    if shared:
        vectors, which = vectors[:1], np.zeros(1, dtype=np.intp)
    force, slope = (
        table.reshape(vectors.size, -1)[which]
        for table in plant.friction.force_and_slope(
            np.tile(grid, vectors.size), np.repeat(vectors, grid.size)
        )
    )
    wide = Plant(
        plant.linear[:, None],
        plant.rounding[:, None],
        plant.drive[:, None],
        plant.vector[:, None],
        plant.friction,
        plant.unit[:, None],
    )
    above, falling, near = _compared(wide, grid, force, slope, grid[1] / grid[0])
    return above, falling, near[:, 1:] | near[:, :-1]


def _compared(
    plant: Plant,
    amplitude: FloatArray,
    force: ComplexArray,
    slope: ComplexArray,
    ratio: FloatArray,
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return whether A |Z| exceeds u_0, whether it falls, and whether a change of A may reach u_0.

    `force` and `slope` are A N and its derivative with respect to ln A. A changes by at most
    `ratio`; A |Z| then changes by no more than twice its steepest slope at A.
    """
    linear = plant.linear * amplitude
    total, slope = linear + force, linear + slope
    size = np.sqrt(total.real**2 + total.imag**2)
    steepest = np.sqrt(slope.real**2 + slope.imag**2)
    falling = total.real * slope.real + total.imag * slope.imag < 0.0
    near = np.abs(size - plant.drive) <= 2.0 * np.log(ratio) * steepest
    return size > plant.drive, falling, near


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
        above, falling, near = _compared(part, middle, force, slope, high[active] / low[active])
        across = above != cells.above[active]
        going = near & ~across & (middle > low[active]) & (middle < high[active])
        crossed[active[across]], between[active[across]] = True, middle[across]
        before = falling == cells.falling[active]
        low[active[before]], high[active[~before]] = middle[before], middle[~before]
        active = active[going]
    return cells.take(crossed), between[crossed]


def _places(point: IntArray) -> IntArray:
    """Return the index of each entry within its point; equal points are adjacent."""
    _, first, counts = np.unique(point, return_index=True, return_counts=True)
    return np.arange(point.size) - np.repeat(first, counts)

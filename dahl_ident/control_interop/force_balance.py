"""All amplitudes at which A |L + N(A)| equals the drive, by the describing function.

L is the linear part of a plant, N the describing function of the other elements; points are rows of
arrays.

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

import numpy as np

from dahl_ident.arrays import EPS, BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.facts import Sine

_ROUNDING_OF_SUMS = 8.0 * EPS  # of sums such as k - m omega^2, relative to the sizes of the terms
_UNBOUNDED = 1e300  # represents an unbounded amplitude
_DECADES = 40  # of amplitude below and above 1 m that are searched if N has no bounds
_SCAN_PER_DECADE = 128  # nodes, 1.8 % apart; closer pairs of roots may be missed
_COARSE_SCAN = 32  # nodes per decade if only one amplitude is needed
_EXTREMUM_BISECTIONS = 56  # from 1.8 % of the amplitude to neighbouring numbers
_POINTS_AT_ONCE = 2**15  # points times nodes computed at once, so that arrays stay in the cache


@dataclass(frozen=True)
class Balance:
    """The equation A |L + N(A)| = drive at points, (n,).

    `friction` are the elements that depend on the amplitude, None if there are none, and `values`
    their parameters at each point, (n, P), followed by the frequency, which is 0 if none of them
    depends on it.
    """

    friction: Model | None
    values: FloatArray
    linear: ComplexArray
    rounding: FloatArray  # rounding error of L
    drive: FloatArray

    def at(self, points: IntArray) -> Balance:
        """Return the equation at some of the points."""
        names = ("values", "linear", "rounding", "drive")
        return replace(self, **{name: getattr(self, name)[points] for name in names})

    @property
    def unique(self) -> bool:
        """Whether the amplitude is unique if the linear part is passive."""
        return not self.friction or all(e.unique_response for e in self.friction.elements)

    def force_and_slope(self, amplitude: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return A N, the fundamental of friction, and its derivative with respect to ln A.

        At one amplitude for each point or, if that has a second axis, on a grid, (1, m).
        """
        if self.friction is None:
            zero = np.zeros(amplitude.shape, dtype=np.complex128)
            return zero, zero
        values, index = self.values, None
        if amplitude.ndim > 1:
            values, index = np.unique(values, axis=0, return_inverse=True)
            values = values[..., None]
        *columns, omega = np.moveaxis(values, 1, 0)
        N, by_amplitude, _ = self.friction.settled(columns, Sine(amplitude, omega), 1)
        force, slope = amplitude * N, amplitude * (N + amplitude * by_amplitude)
        return (force, slope) if index is None else (force[index.ravel()], slope[index.ravel()])

    def force(self, amplitude: FloatArray) -> ComplexArray:
        """Return A (L + N), the force phasor for a displacement phasor A."""
        return np.asarray(amplitude * self.linear + self.force_and_slope(amplitude)[0])

    def largest_friction(self) -> FloatArray:
        """Return an upper bound of A |N| at each point: friction in gross slip."""
        return self._friction_bounds()[1]

    def _friction_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of |N| and A |N| at each point; infinite where unknown."""
        if self.friction is None:
            return np.zeros(self.drive.shape), np.zeros(self.drive.shape)
        steepest, largest = self.friction.force_bounds(list(self.values.T[:-1]))
        return steepest + np.zeros(self.drive.shape), largest + np.zeros(self.drive.shape)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return a lower and an upper bound of all solutions."""
        steepest, largest = self._friction_bounds()
        stiffness = np.abs(self.linear)
        with np.errstate(divide="ignore", over="ignore"):
            low = 0.999 * self.drive / (stiffness + steepest)
            high = np.minimum(1.001 * (self.drive + largest) / stiffness, _UNBOUNDED)
        unbounded = np.flatnonzero(~np.isfinite(steepest + largest))
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
            total = self.linear[:, None] * grid + self.force_and_slope(grid[None])[0]
            ratio = np.abs(total) / self.drive[:, None]
        reached = ~(ratio < 0.1)  # also true where A |Z| overflows
        first = np.where(reached.any(axis=1), reached.argmax(axis=1) - 1, grid.size - 1)
        last = grid.size - 1 - (ratio < 10.0)[:, ::-1].argmax(axis=1)
        return grid[np.maximum(first, 0)], grid[np.minimum(last + 1, grid.size - 1)]


def balance_of(
    model: Element, values: Sequence[FloatArray], omega: FloatArray, drive: FloatArray
) -> tuple[Balance, tuple[int, ...]]:
    """Return the equation at every point of the broadcast arguments, and their shape."""
    shape = np.broadcast_shapes(np.shape(omega), np.shape(drive), *(np.shape(v) for v in values))
    linear, size = np.zeros((), dtype=np.complex128), np.zeros(())
    friction: list[Element] = []
    columns: list[FloatArray] = []
    for element, numbers in as_model(model).of(values):
        if element.is_linear:
            part = element.stiffness(numbers, np.zeros(()), omega)
            linear, size = linear + part, size + np.abs(part)
        else:
            friction.append(element)
            columns += numbers
    columns.append(np.zeros(()) if all(e.rate_independent for e in friction) else omega)
    table = np.stack([np.broadcast_to(column, shape).ravel() for column in columns], axis=-1)
    valid = np.isfinite(table).all(axis=1)  # a search may overflow; there is no amplitude there
    table[~valid] = 1.0
    rounding = _ROUNDING_OF_SUMS * size
    balance = Balance(
        Model(*friction) if friction else None,
        table,
        np.where(valid, np.broadcast_to(linear, shape).ravel(), np.nan),
        np.broadcast_to(rounding, shape).ravel(),
        np.broadcast_to(drive, shape).ravel(),
    )
    return balance, shape


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
    balance, shape = balance_of(model, values, omega, drive)
    roots = find_roots(balance, _COARSE_SCAN)
    if start is None or roots.shape[1] == 1:
        return roots[:, 0].reshape(shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log(roots / np.broadcast_to(start, shape).reshape(-1, 1)))
    distance[np.isnan(distance)] = np.inf
    nearest = distance.argmin(axis=1)[:, None]
    return np.take_along_axis(roots, nearest, axis=1).reshape(shape)


def find_roots(balance: Balance, per_decade: int = _SCAN_PER_DECADE) -> FloatArray:
    """Return all amplitudes of every point, shape (points, largest number).

    They increase along a row, and are followed by NaN. `per_decade` is the number of nodes per
    decade of amplitude in the search for several.
    """
    linear, drive, largest = balance.linear, balance.drive, balance.largest_friction()
    known = np.isfinite(linear)
    passive = known & balance.unique & (linear.imag >= -balance.rounding)
    resonant = np.abs(linear) <= balance.rounding
    single = np.flatnonzero(passive & ~(resonant & (drive >= largest)))
    with np.errstate(divide="ignore", invalid="ignore"):  # in gross slip the friction is known
        slipping = np.sqrt(drive - largest) * np.sqrt(drive + largest) / np.abs(linear)
    low, high = balance.bounds()
    rising = np.ones(single.size, dtype=np.bool_)
    unique = _polish(balance.at(single), low[single], high[single], slipping[single], rising)
    others = np.flatnonzero(known & ~passive & ~np.isnan(low + high))  # NaN outside a law's range
    point, several = _scan(balance, others, low, high, per_decade)
    _, first, counts = np.unique(point, return_index=True, return_counts=True)
    column = np.arange(point.size) - np.repeat(first, counts)
    roots = np.full((drive.size, 1 + int(column.max(initial=0))), np.nan)
    roots[single, 0] = unique
    roots[point, column] = several
    return roots


def _polish(
    balance: Balance, low: FloatArray, high: FloatArray, start: FloatArray, rising: BoolArray
) -> FloatArray:
    """Return the amplitude in each bracket, by Newton steps in ln A, otherwise by bisection.

    A |Z| - u_0 changes sign once between `low` and `high`, upwards if `rising`. A `start` outside
    its bracket, or NaN, is replaced by the middle.
    """
    low, high = low.copy(), high.copy()
    amplitude = np.where((start > low) & (start < high), start, np.sqrt(low) * np.sqrt(high))
    active = np.arange(amplitude.size)
    for _ in range(200):
        if not active.size:
            break
        A, part = amplitude[active], balance.at(active)
        force, slope = part.force_and_slope(A)
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
    return amplitude


def _scan(
    balance: Balance, points: IntArray, low: FloatArray, high: FloatArray, per_decade: int
) -> tuple[IntArray, FloatArray]:
    """Return all amplitudes of the chosen points, as pairs (point, amplitude) in rising order."""
    if not points.size:
        return points, np.zeros(0)
    order = points[np.argsort(high[points])]  # the few near a resonance need a long grid
    decades = np.log10(high[order[order.size // 2]] / low[points].min())
    block = max(1, int(_POINTS_AT_ONCE / (per_decade * max(decades, 1.0))))
    parts = []
    for first in range(0, order.size, block):
        part = order[first : first + block]
        least, most = low[part].min(), high[part].max()
        nodes = 2 + int(np.ceil(per_decade * (np.log10(most) - np.log10(least))))
        row, *bracket = _brackets(balance.at(part), np.geomspace(least, most, nodes))
        parts.append((part[row], *bracket))
    point, left, right, rising = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    amplitude = _polish(balance.at(point), left, right, np.full(point.shape, np.nan), rising)
    order = np.lexsort((amplitude, point))
    return point[order], amplitude[order]


def _brackets(
    balance: Balance, grid: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Return brackets of all amplitudes on a grid: point, ends, and whether A |Z| rises there."""
    above, falling, near = _compared(balance, grid[None], grid[1] / grid[0])
    crosses = above[:, 1:] != above[:, :-1]
    turns_towards = (falling[:, :-1] == above[:, :-1]) & (falling[:, 1:] != above[:, 1:])
    once = np.nonzero(crosses)
    twice = np.nonzero(~crosses & turns_towards & (near[:, 1:] | near[:, :-1]))
    falls, (row, cell) = above[twice], twice
    extremum = _extremum(balance.at(row), grid[cell], grid[cell + 1], falls)
    beyond = _compared(balance.at(row), extremum)[0] != falls
    row, cell, extremum, falls = row[beyond], cell[beyond], extremum[beyond], falls[beyond]
    return (
        np.concatenate([once[0], row, row]),
        np.concatenate([grid[once[1]], grid[cell], extremum]),
        np.concatenate([grid[once[1] + 1], extremum, grid[cell + 1]]),
        np.concatenate([~above[once], ~falls, falls]),
    )


def _compared(
    balance: Balance, amplitude: FloatArray, ratio: float = 1.0
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return whether A |Z| exceeds the drive u_0, whether it falls, and whether it is near u_0.

    It is near if a change of A by the factor `ratio`, with twice the largest possible slope of
    A |Z| at A, reaches u_0.
    """
    force, slope = balance.force_and_slope(amplitude)
    linear, drive = balance.linear, balance.drive
    if amplitude.ndim > 1:
        linear, drive = linear[:, None], drive[:, None]
    total, slope = linear * amplitude + force, linear * amplitude + slope
    size = np.abs(total)
    falling = (total.conj() * slope).real < 0.0
    near = np.abs(size - drive) <= 2.0 * np.log(ratio) * np.abs(slope)
    return size > drive, falling, near


def _extremum(balance: Balance, low: FloatArray, high: FloatArray, falls: BoolArray) -> FloatArray:
    """Return the amplitude in each bracket at which A |Z|, which `falls` at first, turns."""
    for _ in range(_EXTREMUM_BISECTIONS if low.size else 0):
        middle = np.sqrt(low) * np.sqrt(high)
        before = _compared(balance, middle)[1] == falls
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return low

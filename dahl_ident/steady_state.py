"""The steady response of a plant to a sine force: displacement amplitude from drive.

A plant with friction answers a force u_0 cos(omega t) with a displacement amplitude A that is
not proportional to u_0, because its dynamic stiffness depends on A (Eqn. 53):

    A |Z(A, omega)| = u_0,    Z = L(omega) + N(A),    L = k - m omega^2 + j omega c + ...

N is the sum of the describing functions of the friction elements, L all the rest. Where L is
passive (Im L >= 0) the left side rises with A, so there is one amplitude. It is bracketed in a
table of the friction force A N over ln A, started by inverse cubic interpolation, and polished
by Newton's method in ln A that never leaves its bracket. An active plant (Im L < 0: negative
damping) can have several amplitudes. A scan between the bounds that |N| <= (4/pi) 2^alpha sigma
and A |N| <= 4 f_max/pi set, with the turning points of A |Z| located, finds all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
)
from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import Element
from dahl_ident.elements.model import as_model

IntArray = NDArray[np.intp]
_Scalar = TypeVar("_Scalar", bound=np.generic)

_EPS = float(np.finfo(np.float64).eps)
_ROUNDING = 8.0 * _EPS  # of k - m omega^2 and its like, relative to the terms' sizes
_LARGEST = 1e300  # stands for an amplitude without bound
_TABLE_PER_DECADE = 16
_SCAN_PER_DECADE = 128
_CHUNK = 8192  # points solved together: their scratch arrays stay in the processor's cache


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
    several amplitudes the one nearest to `start` in ratio, else the smallest.
    """
    plant = _flatten(model, values, omega, drive)
    roots = _roots(plant)
    if start is None or roots.shape[1] == 1:
        return roots[:, 0].reshape(plant.shape)
    near = np.broadcast_to(start, plant.shape).reshape(-1, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log(roots / near))
    distance[np.isnan(distance)] = np.inf
    chosen = np.take_along_axis(roots, distance.argmin(axis=1)[:, None], axis=1)
    return chosen.reshape(plant.shape)


class ReceptanceGradient(NamedTuple):
    """X/u_0 = 1/Z(A, omega) at the solved amplitude, with its derivatives.

    Attributes
    ----------
    value : ndarray of complex
        X/u_0, m/N.
    amplitude : ndarray
        A, m.
    by_drive : ndarray of complex
        d(X/u_0)/du_0.
    by_parameter : tuple of ndarray of complex
        d(X/u_0)/dp for each parameter p of the model, in its order.
    """

    value: ComplexArray
    amplitude: FloatArray
    by_drive: ComplexArray
    by_parameter: tuple[ComplexArray, ...]


def receptance_gradient(
    model: Element,
    values: Sequence[FloatArray],
    omega: FloatArray,
    drive: FloatArray,
    start: FloatArray | None = None,
) -> ReceptanceGradient:
    """Return X/u_0 with its derivatives, by implicit differentiation of A |Z| = u_0, unchecked.

    dA/A = (du_0/u_0 - Re(dZ/Z)) / (1 + Re(A Z_A/Z)), dZ the change of Z at constant A; then
    d(1/Z) = -(dZ + Z_A dA)/Z^2. One root search serves the value and all derivatives.
    Arguments and missing amplitudes as in :func:`solve`.
    """
    amplitude = solve(model, values, omega, drive, start)
    found = np.isfinite(amplitude)
    A = np.where(found, amplitude, 1.0)
    Z, by_amplitude, by_parameter = model.stiffness_gradient(values, A, omega)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = np.where(found, 1.0 / Z, np.nan)
        turn = A * by_amplitude * X
        share = 1.0 / (1.0 + turn.real)
        relative = [d * X for d in by_parameter]
        by_drive = -X * turn * share / drive
        derivatives = tuple(-X * (r - turn * share * r.real) for r in relative)
    return ReceptanceGradient(X, amplitude, by_drive, derivatives)


@dataclass(frozen=True)
class _Friction:
    """The elements that depend on the amplitude, their values flattened over vectors."""

    elements: tuple[Dahl, ...]
    values: tuple[tuple[FloatArray, ...], ...]  # of one shape: () or (vectors,)

    def force(self, amplitude: FloatArray, vector: IntArray) -> tuple[ComplexArray, ComplexArray]:
        """Return A N and its derivative by ln A, element `vector` naming the parameters."""
        force = np.zeros(amplitude.shape, dtype=np.complex128)
        slope = np.zeros(amplitude.shape, dtype=np.complex128)
        for element, values in zip(self.elements, self.values, strict=True):
            at = [v[vector] if v.ndim else v for v in values]
            Z = element.stiffness_gradient(at, amplitude, np.zeros(()))
            force += amplitude * Z.value
            slope += amplitude * (Z.value + amplitude * Z.by_amplitude)
        return force, slope

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of |N| and of A |N|, a number or one a vector."""
        steepest, largest = np.zeros(()), np.zeros(())
        for f_max, sigma, alpha in self.values:
            steepest = steepest + 4.0 / np.pi * 2.0**alpha * sigma
            largest = largest + 4.0 / np.pi * f_max
        return steepest, largest


@dataclass(frozen=True)
class _Plant:
    """One row a point: linear part, drive, and which parameter vector its friction has."""

    shape: tuple[int, ...]
    linear: ComplexArray
    size: FloatArray  # sum of the sizes of the linear elements, which sets their rounding
    drive: FloatArray
    vector: IntArray
    friction: _Friction

    def at(self, points: IntArray | slice) -> _Plant:
        """Return the chosen points."""
        return _Plant(
            (),
            self.linear[points],
            self.size[points],
            self.drive[points],
            self.vector[points],
            self.friction,
        )

    def bracket(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return amplitudes below and above every solution, and the largest friction force."""
        steepest, largest = (b[self.vector] if b.ndim else b for b in self.friction.bounds())
        stiffness = np.abs(self.linear)
        low = 0.999 * self.drive / (stiffness + steepest)
        with np.errstate(divide="ignore", over="ignore"):
            high = np.minimum(1.001 * (self.drive + largest) / stiffness, _LARGEST)
        return low, high, np.broadcast_to(largest, self.drive.shape)


def _flatten(
    model: Element, values: Sequence[FloatArray], omega: FloatArray, drive: FloatArray
) -> _Plant:
    omega, drive = np.asarray(omega), np.asarray(drive)
    values = [np.asarray(v) for v in values]
    shape = np.broadcast_shapes(omega.shape, drive.shape, *(v.shape for v in values))
    rest = np.zeros(())
    linear, size = np.zeros((), dtype=np.complex128), np.zeros(())
    friction: list[tuple[Dahl, list[FloatArray]]] = []
    first = 0
    for element in as_model(model).elements:
        own = values[first : first + len(element.parameters)]
        first += len(element.parameters)
        if isinstance(element, Dahl):
            friction.append((element, own))
        else:
            part = element.stiffness(own, rest, omega)
            linear = linear + part
            size = size + np.abs(part)
    batch = np.broadcast_shapes(*(v.shape for _, own in friction for v in own))
    count = int(np.prod(batch))
    return _Plant(
        shape,
        _flat(linear, shape),
        _flat(size, shape),
        _flat(drive, shape),
        _flat(np.arange(count).reshape(batch), shape),
        _Friction(
            tuple(element for element, _ in friction),
            tuple(
                tuple(v.reshape(()) if count == 1 else _flat(v, batch) for v in own)
                for _, own in friction
            ),
        ),
    )


def _flat(array: NDArray[_Scalar], shape: tuple[int, ...]) -> NDArray[_Scalar]:
    return np.broadcast_to(array, shape).ravel()


def _roots(plant: _Plant) -> FloatArray:
    """Return all amplitudes of every point, rising, shape (points, most), NaN where fewer."""
    resonant = np.abs(plant.linear) <= _ROUNDING * plant.size
    if not plant.friction.elements:
        with np.errstate(divide="ignore", over="ignore"):
            amplitude = plant.drive / np.abs(plant.linear)
        return np.where(resonant, np.nan, amplitude)[:, None]
    _, _, largest = plant.bracket()
    unbounded = resonant & (plant.drive >= largest)
    passive = plant.linear.imag >= -_ROUNDING * plant.size
    single = np.flatnonzero(passive & ~unbounded)
    roots = np.full((plant.drive.size, 1), np.nan)
    if single.size:
        table = _tabulate(plant.friction)
        for first in range(0, single.size, _CHUNK):
            points = single[first : first + _CHUNK]
            roots[points, 0] = _single_roots(plant.at(points), table)
    active = np.flatnonzero(~passive)
    if active.size:
        roots = _insert(roots, *_scan(plant, active))
    return roots


class _Table(NamedTuple):
    """Friction force over amplitude for every parameter vector, shape (vectors, nodes)."""

    amplitude: FloatArray
    force: ComplexArray
    slope: ComplexArray


def _tabulate(friction: _Friction) -> _Table:
    """Return the friction force from deep microslip to deep slip of every element."""
    knees = [np.atleast_1d(f_max / sigma) for f_max, sigma, _ in friction.values]
    low = np.log10(np.min(knees, axis=0)) - 4.0
    high = np.log10(np.max(knees, axis=0)) + 4.0
    nodes = 1 + int(np.ceil(_TABLE_PER_DECADE * np.max(high - low)))
    amplitude = 10.0 ** np.linspace(low, high, nodes, axis=-1)
    vector = np.repeat(np.arange(low.size), nodes)
    force, slope = friction.force(amplitude.ravel(), vector)
    return _Table(amplitude, force.reshape(amplitude.shape), slope.reshape(amplitude.shape))


def _single_roots(plant: _Plant, table: _Table) -> FloatArray:
    """Return the one amplitude of each point of a passive plant."""
    nodes = table.amplitude.shape[1]
    offset = plant.vector * nodes
    flat = _Table(table.amplitude.ravel(), table.force.ravel(), table.slope.ravel())
    below, above = np.full(offset.shape, -1), np.full(offset.shape, nodes)
    for _ in range(nodes.bit_length()):
        middle = (below + above) // 2
        at = offset + np.clip(middle, 0, nodes - 1)
        rises = np.abs(flat.amplitude[at] * plant.linear + flat.force[at]) >= plant.drive
        inside = above - below > 1
        above = np.where(inside & rises, middle, above)
        below = np.where(inside & ~rises, middle, below)
    low, high, largest = plant.bracket()
    left, right = offset + np.maximum(below, 0), offset + np.minimum(above, nodes - 1)
    start = _inverse_cubic(plant, flat, left, right)
    microslip, slip = below < 0, above == nodes
    if microslip.any() or slip.any():
        with np.errstate(divide="ignore"):
            stiffness = np.abs(plant.linear + flat.force[left] / flat.amplitude[left])
            start = np.where(microslip, plant.drive / stiffness, start)
            excess = np.sqrt(np.abs(plant.drive - largest)) * np.sqrt(plant.drive + largest)
            start = np.where(slip, excess / np.abs(plant.linear), start)
    low = np.where(microslip, np.minimum(low, flat.amplitude[right]), flat.amplitude[left])
    high = np.where(slip, np.maximum(high, flat.amplitude[left]), flat.amplitude[right])
    return _polish(plant, low, high, start, np.ones(low.shape, dtype=bool))


def _inverse_cubic(plant: _Plant, table: _Table, left: IntArray, right: IntArray) -> FloatArray:
    """Return A from Hermite's cubic of ln A over ln(A |Z|/u_0) between two nodes of the table."""
    A0, A1 = table.amplitude[left], table.amplitude[right]
    g0, s0 = _misfit(plant.linear, plant.drive, A0, table.force[left], table.slope[left])
    g1, s1 = _misfit(plant.linear, plant.drive, A1, table.force[right], table.slope[right])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        width = g1 - g0
        t = -g0 / width
        bend0, bend1 = t * (1 - t) ** 2 * width / s0, t**2 * (t - 1) * width / s1
        return A0 * np.exp(t**2 * (3 - 2 * t) * np.log(A1 / A0) + bend0 + bend1)


def _misfit(
    linear: ComplexArray,
    drive: FloatArray,
    amplitude: FloatArray,
    force: ComplexArray,
    slope: ComplexArray,
) -> tuple[FloatArray, FloatArray]:
    """Return ln(A |Z|/u_0) and its derivative by ln A."""
    inertial = amplitude * linear
    total = inertial + force
    size = np.abs(total)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = total.conj() / size
        return np.log(size / drive), ((inertial + slope) * unit).real / size


def _polish(
    plant: _Plant, low: FloatArray, high: FloatArray, start: FloatArray, rising: NDArray[np.bool_]
) -> FloatArray:
    """Return the amplitude in each bracket, by Newton steps in ln A or else bisection."""
    amplitude = np.where((start > low) & (start < high), start, np.sqrt(low) * np.sqrt(high))
    active = np.arange(amplitude.size)
    for _ in range(200):
        A, L, u0 = amplitude[active], plant.linear[active], plant.drive[active]
        force, slope = plant.friction.force(A, plant.vector[active])
        g, s = _misfit(L, u0, A, force, slope)
        beyond = (g > 0.0) == rising[active]
        high[active] = np.where(beyond, A, high[active])
        low[active] = np.where(beyond, low[active], A)
        kappa = (np.abs(L) * A + np.abs(force)) / u0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = -g / s
            newton = A * np.exp(step)
        inside = (newton >= low[active]) & (newton <= high[active])
        settled = np.abs(g) <= 64.0 * _EPS * kappa
        settled |= high[active] <= low[active] * (1.0 + 4.0 * _EPS)
        middle = np.where(settled, A, np.sqrt(low[active]) * np.sqrt(high[active]))
        amplitude[active] = np.where(inside, newton, middle)
        settled |= inside & (np.abs(step) * kappa < 1e-8)
        active = active[~settled]
        if not active.size:
            break
    return amplitude


def _scan(plant: _Plant, points: IntArray) -> tuple[IntArray, FloatArray]:
    """Return every root of the chosen points as pairs (point, amplitude)."""
    low, high, _ = plant.at(points).bracket()
    decades = np.log10(np.max(high)) - np.log10(np.min(low))
    nodes = 2 + int(np.ceil(_SCAN_PER_DECADE * decades))
    grid = np.geomspace(np.min(low), np.max(high), nodes)
    at, roots = [], []
    per_chunk = max(1, 2**20 // nodes)
    for first in range(0, points.size, per_chunk):
        chunk = points[first : first + per_chunk]
        found, amplitude = _scan_grid(plant.at(chunk), grid)
        at.append(chunk[found])
        roots.append(amplitude)
    return np.concatenate(at), np.concatenate(roots)


def _scan_grid(plant: _Plant, grid: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the roots between the nodes of `grid`, pairs that share a cell included."""
    vectors, which = np.unique(plant.vector, return_inverse=True)
    force, slope = plant.friction.force(np.tile(grid, vectors.size), np.repeat(vectors, grid.size))
    force, slope = (part.reshape(vectors.size, -1)[which] for part in (force, slope))
    g, s = _misfit(plant.linear[:, None], plant.drive[:, None], grid, force, slope)
    above, falls = g > 0.0, s < 0.0
    turns = falls[:, 1:] != falls[:, :-1]
    point, cell = np.nonzero((above[:, 1:] != above[:, :-1]) & ~turns)
    low, high, rising = [grid[cell]], [grid[cell + 1]], [above[point, cell + 1]]
    points = [point]
    point, cell = np.nonzero(turns)
    extreme, over = _extreme(plant.at(point), grid[cell], grid[cell + 1], falls[point, cell])
    for left, right, start, end in (
        (grid[cell], extreme, above[point, cell], over),
        (extreme, grid[cell + 1], over, above[point, cell + 1]),
    ):
        crossed = start != end
        points.append(point[crossed])
        low.append(left[crossed])
        high.append(right[crossed])
        rising.append(end[crossed])
    pieces = np.concatenate(points)
    start = np.full(pieces.shape, np.nan)  # in the middle
    return pieces, _polish(
        plant.at(pieces), np.concatenate(low), np.concatenate(high), start, np.concatenate(rising)
    )


def _extreme(
    plant: _Plant, low: FloatArray, high: FloatArray, falls: NDArray[np.bool_]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return where A |Z| turns in each bracket, by bisection, and whether it exceeds u_0 there."""
    for _ in range(54):
        middle = np.sqrt(low) * np.sqrt(high)
        force, slope = plant.friction.force(middle, plant.vector)
        g, s = _misfit(plant.linear, plant.drive, middle, force, slope)
        before = (s < 0.0) == falls
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return middle, g > 0.0


def _insert(roots: FloatArray, point: IntArray, amplitude: FloatArray) -> FloatArray:
    """Return `roots` with the pairs (point, amplitude) sorted into their rows."""
    order = np.lexsort((amplitude, point))
    point, amplitude = point[order], amplitude[order]
    counts = np.bincount(point, minlength=len(roots))
    place = np.arange(point.size) - np.repeat(np.cumsum(counts) - counts, counts)
    wide = np.full((len(roots), max(1, counts.max())), np.nan)
    wide[:, :1] = roots
    wide[point, place] = amplitude
    return wide

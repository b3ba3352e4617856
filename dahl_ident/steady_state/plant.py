"""A plant at many points: linear part, friction and drive in arrays with one row per point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element, as_model
from dahl_ident.elements.facts import Sine

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
_Scalar = TypeVar("_Scalar", bound=np.generic)
_Values = list[Sequence[FloatArray]]

EPS = float(np.finfo(np.float64).eps)  # distance from 1 to the next number
_ROUNDING = 8.0 * EPS  # of k - m omega^2 and its like, relative to the terms' sizes
_LARGEST = 1e300  # represents an unbounded amplitude
_REACH = 40  # decades of amplitude, m, to both sides, that are searched where N has no bounds
_TOGETHER = 64  # points, 20,000 numbers: their arrays stay in the processor's cache
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

    @property
    def shared(self) -> bool:
        """Whether all points have one vector of parameters."""
        return self.omega.ndim == 0 and all(v.ndim == 0 for numbers in self.values for v in numbers)

    def force(self, amplitude: FloatArray, vector: IntArray) -> ComplexArray:
        """Return A N, the force's fundamental; `vector` is the parameter vector of each row."""
        force = np.zeros(amplitude.shape, dtype=np.complex128)
        (omega,) = _rows((self.omega,), vector)
        for element, values in zip(self.elements, self.values, strict=True):
            force += element.stiffness(_rows(values, vector), amplitude, omega)
        force *= amplitude
        return force

    def forces(self, grid: FloatArray, vector: IntArray) -> ComplexArray:
        """Return A N of several parameter vectors over one grid of amplitudes, (vectors, n)."""
        if self.shared:
            return self.force(grid, np.zeros(grid.shape, dtype=np.intp))[None]
        one, which = np.unique(vector, return_inverse=True)
        force = self.force(np.tile(grid, one.size), np.repeat(one, grid.size))
        return force.reshape(one.size, -1)[which]

    def force_and_slope(
        self, amplitude: FloatArray, vector: IntArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return A N and its derivative with respect to ln A."""
        force = np.zeros(amplitude.shape, dtype=np.complex128)
        slope = np.zeros(amplitude.shape, dtype=np.complex128)
        (omega,) = _rows((self.omega,), vector)
        for element, values in zip(self.elements, self.values, strict=True):
            N, by_amplitude, _ = element.settled(_rows(values, vector), Sine(amplitude, omega), 1)
            force += amplitude * N
            slope += amplitude * (N + amplitude * by_amplitude)
        return force, slope

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Upper bounds of |N| and A |N| for each vector; infinite where unknown."""
        steepest, largest = np.zeros(()), np.zeros(())
        for element, values in zip(self.elements, self.values, strict=True):
            of_element = element.force_bounds(values)
            steepest, largest = steepest + of_element[0], largest + of_element[1]
        return steepest, largest

    def knees(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest amplitude at which N changes, for each vector."""
        low, high = zip(
            *(e.knee(values) for e, values in zip(self.elements, self.values, strict=True)),
            strict=True,
        )
        return np.minimum.reduce(low), np.maximum.reduce(high)


@dataclass(frozen=True)
class Plant:
    """A |L + N(A)| = drive at every point, in units scaled to the friction.

    All arrays have one entry a point.
    """

    linear: ComplexArray
    rounding: FloatArray  # rounding error of L from its terms
    drive: FloatArray
    vector: IntArray
    friction: Nonlinear
    unit: FloatArray  # of amplitude, m

    def at(self, points: IntArray | slice) -> Plant:
        """Return the plant at some of its points."""
        return Plant(
            self.linear[points],
            self.rounding[points],
            self.drive[points],
            self.vector[points],
            self.friction,
            self.unit[points],
        )

    def force(self, amplitude: FloatArray) -> ComplexArray:
        """Return A (L + N), the force phasor for a displacement phasor A."""
        return amplitude * self.linear + self.friction.force(amplitude, self.vector)

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
        if unbounded.size:
            least, most = self.at(unbounded)._reach()
            low[unbounded] = np.maximum(low[unbounded], least)
            high[unbounded] = np.minimum(high[unbounded], most)
        return low, high

    def _reach(self) -> tuple[FloatArray, FloatArray]:
        """Return amplitudes beyond which A |Z| is far from the drive, where N has no bounds."""
        grid = 10.0 ** np.arange(-_REACH, _REACH, 0.25)
        least, most = np.empty(self.drive.shape), np.empty(self.drive.shape)
        for start in range(0, least.size, _TOGETHER):
            points = np.arange(start, min(start + _TOGETHER, least.size))
            part = self.at(points)
            with np.errstate(all="ignore"):
                total = part.linear[:, None] * grid + part.friction.forces(grid, part.vector)
                ratio = np.abs(total) / part.drive[:, None]
            reached = ~(ratio < 0.1)  # true as well where A |Z| overflows
            first = np.where(reached.any(axis=1), reached.argmax(axis=1) - 1, grid.size - 1)
            last = grid.size - 1 - (ratio < 10.0)[:, ::-1].argmax(axis=1)
            least[points] = grid[np.maximum(first, 0)]
            most[points] = grid[np.minimum(last + 1, grid.size - 1)]
        return least, most

    def misfit(
        self, amplitude: FloatArray, force: ComplexArray, slope: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ln(A |Z| / u_0) and its derivative with respect to ln A."""
        linear = amplitude * self.linear
        total = linear + force
        size = np.abs(total)
        with np.errstate(divide="ignore", invalid="ignore"):  # Z = 0 at a limit cycle
            return np.log(size / self.drive), ((linear + slope) / total).real

    def conditioning(self, amplitude: FloatArray, force: ComplexArray) -> FloatArray:
        """Return (|L| + |N|) A/u_0, the amplification of rounding near a sharp resonance."""
        return (np.abs(self.linear) * amplitude + np.abs(force)) / self.drive


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
    linear, friction = _without_overflow(linear, friction)
    force, stiffness, friction = _units(elements, friction)
    batch = np.broadcast_shapes(*(np.shape(v) for numbers in (*friction, rates) for v in numbers))
    vectors = np.arange(np.prod(batch, dtype=np.intp)).reshape(batch)
    if which is not None:
        vectors = vectors[..., which]
    plant = Plant(
        _flat(linear / stiffness, shape),
        _flat(_ROUNDING * size / stiffness, shape),
        _flat(drive / force, shape),
        _flat(vectors, shape),
        Nonlinear(
            tuple(elements),
            tuple(tuple(_flat_values(v, batch) for v in numbers) for numbers in friction),
            _flat_values(rates[0], batch) if rates else np.zeros(()),
            all(element.unique_response for element in elements),
        ),
        _flat(force / stiffness, shape),
    )
    return plant, shape


def _without_overflow(linear: ComplexArray, friction: _Values) -> tuple[ComplexArray, _Values]:
    """Mask values at which a search overflowed: no L, and no amplitude, there."""
    finite = [np.isfinite(v) for numbers in friction for v in numbers]
    if all(np.all(f) for f in finite):
        return linear, friction
    sound = np.all(np.broadcast_arrays(*finite), axis=0)
    return np.where(sound, linear, np.nan), [
        [np.where(sound, v, 1.0) for v in numbers] for numbers in friction
    ]


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

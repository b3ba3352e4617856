"""A plant at many points: linear part, friction and drive in flat arrays, one row a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.dahl import Dahl
from dahl_ident.elements.element import Element
from dahl_ident.elements.model import as_model

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
_Scalar = TypeVar("_Scalar", bound=np.generic)
_Values = list[Sequence[FloatArray]]

EPS = float(np.finfo(np.float64).eps)
_ROUNDING = 8.0 * EPS  # of k - m omega^2 and its like, relative to the terms' sizes
_LARGEST = 1e300  # stands for an amplitude without bound
_DAHL = Dahl()  # evaluated at any values; its alpha is fixed, so that dN/dalpha is left out
_AT_REST = np.zeros(())


@dataclass(frozen=True)
class Friction:
    """The elements that depend on the amplitude, with one or many vectors of their parameters.

    `values` has f_max, sigma and alpha of each element, all of shape () or all (vectors,).
    """

    values: tuple[tuple[FloatArray, ...], ...]

    def force(self, amplitude: FloatArray, vector: IntArray) -> ComplexArray:
        """Return A N, the force's fundamental; `vector` says whose parameters each row has."""
        force = np.zeros(amplitude.shape, dtype=np.complex128)
        for values in self.values:
            force += _DAHL.stiffness(_rows(values, vector), amplitude, _AT_REST)
        force *= amplitude
        return force

    def force_and_slope(
        self, amplitude: FloatArray, vector: IntArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return A N and its derivative by ln A."""
        force = np.zeros(amplitude.shape, dtype=np.complex128)
        slope = np.zeros(amplitude.shape, dtype=np.complex128)
        for values in self.values:
            Z = _DAHL.stiffness_gradient(_rows(values, vector), amplitude, _AT_REST)
            force += amplitude * Z.value
            slope += amplitude * (Z.value + amplitude * Z.by_amplitude)
        return force, slope

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return what |N| and A |N| never exceed, for each vector.

        The force is largest where the motion turns: there it is at most f_max and, since z^-alpha
        is convex, at most sigma A. The fundamental of a wave of height 1 is at most 4/pi, that of
        the square wave.
        """
        steepest, largest = np.zeros(()), np.zeros(())
        for f_max, sigma, _ in self.values:
            steepest = steepest + 4.0 / np.pi * sigma
            largest = largest + 4.0 / np.pi * f_max
        return steepest, largest


@dataclass(frozen=True)
class Plant:
    """A |L + N(A)| = drive at every point, all in units that suit the friction.

    All arrays have one entry a point.
    """

    linear: ComplexArray
    rounding: FloatArray  # what rounding the terms of L leaves of it
    drive: FloatArray
    vector: IntArray
    friction: Friction
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
        """Return A (L + N), the phasor that a displacement phasor A takes."""
        return amplitude * self.linear + self.friction.force(amplitude, self.vector)

    def largest_friction(self) -> FloatArray:
        """Return the friction force's fundamental in gross slip."""
        return _rows((self.friction.bounds()[1],), self.vector)[0] + np.zeros(self.drive.shape)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return amplitudes below and above every solution."""
        steepest, largest = _rows(self.friction.bounds(), self.vector)
        stiffness = np.abs(self.linear)
        with np.errstate(divide="ignore", over="ignore"):
            low = 0.999 * self.drive / (stiffness + steepest)
            high = np.minimum(1.001 * (self.drive + largest) / stiffness, _LARGEST)
        return low, high

    def misfit(
        self, amplitude: FloatArray, force: ComplexArray, slope: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ln(A |Z| / u_0) and its derivative by ln A."""
        rest = amplitude * self.linear
        total = rest + force
        size = np.abs(total)
        with np.errstate(divide="ignore", invalid="ignore"):  # Z = 0 at a limit cycle
            return np.log(size / self.drive), ((rest + slope) / total).real

    def conditioning(self, amplitude: FloatArray, force: ComplexArray) -> FloatArray:
        """Return (|L| + |N|) A/u_0, by which rounding grows near a sharp resonance."""
        return (np.abs(self.linear) * amplitude + np.abs(force)) / self.drive


def flatten(
    model: Element, values: Sequence[FloatArray], omega: FloatArray, drive: FloatArray
) -> tuple[Plant, tuple[int, ...]]:
    """Return the plant at every point of the broadcast arguments, and their shape."""
    shape = np.broadcast_shapes(np.shape(omega), np.shape(drive), *(np.shape(v) for v in values))
    linear, size = np.zeros((), dtype=np.complex128), np.zeros(())
    friction: _Values = []
    first = 0
    for element in as_model(model).elements:
        own = values[first : first + len(element.parameters)]
        first += len(element.parameters)
        if isinstance(element, Dahl):
            friction.append(own)
        else:
            part = element.stiffness(own, _AT_REST, omega)
            linear, size = linear + part, size + np.abs(part)
    linear, friction = _without_overflow(linear, friction)
    force, stiffness, friction = _units(friction)
    batch = np.broadcast_shapes(*(np.shape(v) for own in friction for v in own))
    vectors = np.arange(np.prod(batch, dtype=np.intp)).reshape(batch)
    plant = Plant(
        _flat(linear / stiffness, shape),
        _flat(_ROUNDING * size / stiffness, shape),
        _flat(drive / force, shape),
        _flat(vectors, shape),
        Friction(tuple(tuple(_flat_values(v, batch) for v in own) for own in friction)),
        _flat(force / stiffness, shape),
    )
    return plant, shape


def _without_overflow(linear: ComplexArray, friction: _Values) -> tuple[ComplexArray, _Values]:
    """Put values at which a search overflowed out of the way: no L, and no amplitude, there."""
    finite = [np.isfinite(v) for own in friction for v in own]
    if all(np.all(f) for f in finite):
        return linear, friction
    sound = np.all(np.broadcast_arrays(*finite), axis=0)
    return np.where(sound, linear, np.nan), [
        [np.where(sound, v, 1.0) for v in own] for own in friction
    ]


def _units(friction: _Values) -> tuple[FloatArray, FloatArray, _Values]:
    """Return units of force and stiffness, and the friction in them.

    In units of f_max and sigma one element of one exponent is the same for every vector.
    """
    one = np.ones(())
    if len(friction) == 1:
        f_max, sigma, alpha = friction[0]
        if np.size(alpha) and np.all(alpha == np.ravel(alpha)[0]):
            return f_max, sigma, [(one, one, np.ravel(alpha)[0])]
    return one, one, friction


def _flat_values(values: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    return _flat(values, batch) if np.prod(batch) > 1 else np.reshape(values, ())


def _flat(array: NDArray[_Scalar], shape: tuple[int, ...]) -> NDArray[_Scalar]:
    """Return the broadcast array in one dimension; one number is not copied."""
    if np.size(array) == 1:
        return np.broadcast_to(np.ravel(array), int(np.prod(shape)))
    return np.broadcast_to(array, shape).ravel()


def _rows(values: Sequence[FloatArray], vector: IntArray) -> list[FloatArray]:
    return [v[vector] if v.ndim else v for v in values]

"""Coefficients of the equation of motion of models whose linear systems have free parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Model
from dahl_ident.elements.facts import Mechanics
from dahl_ident.elements.linear_system import Equation, LinearSystem, coefficients_of, differences
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.rational import Rational, typical_rate


class Coefficients:
    """The numbers in a model's equation of motion, from the values of its parameters.

    They are the values themselves, except for linear systems that have free parameters.

    Attributes
    ----------
    model : Model
        The model with these coefficients as parameters; the original one if they are its values.
    """

    def __init__(self, model: Model) -> None:
        elements = [
            _LinearEquation(element)
            if isinstance(element, LinearSystem) and any(p.free for p in element.parameters)
            else element
            for element in model.elements
        ]
        self._pairs = list(zip(model.elements, elements, strict=True))
        self.are_values = all(new is old for old, new in self._pairs)
        self.model = model if self.are_values else Model(*elements)

    def __call__(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients, (rows, Q), and their derivatives, (rows, Q, P)."""
        numbers, blocks, first = [], [], 0
        for element, counterpart in self._pairs:
            last = first + len(element.parameters)
            part = values[:, first:last]
            block = np.zeros((len(values), len(counterpart.parameters), values.shape[1]))
            if isinstance(counterpart, _LinearEquation):
                part, block[:, :, first:last] = counterpart.coefficients(part)
            else:
                diagonal = np.arange(len(element.parameters))
                block[:, diagonal, first + diagonal] = 1.0
            numbers.append(part)
            blocks.append(block)
            first = last
        return np.concatenate(numbers, axis=1), np.concatenate(blocks, axis=1)


class _LinearEquation(LinearSystem):
    """A linear system whose parameters are the coefficients of its equation of motion.

    The degree of the equation is that near the starts of the original system's parameters.
    """

    def __init__(self, system: LinearSystem) -> None:
        self.__dict__.update(system.__dict__)
        self._origin = system
        Z = system.typical_stiffness()
        self._above, self._below = Z.degrees
        self._rate = typical_rate(Z.denominator)
        order = range(1, self._below + 1)
        labels = ["k", "c", "m", *(f"a{i}" for i in order), *(f"b{i}" for i in order)]
        first = system.parameters[0].name
        self.parameters = tuple(
            Parameter(f"{label} of {first}", "", "coefficient") for label in labels
        )

    @property
    def n_states(self) -> int:
        """Poles of the dynamic stiffness."""
        return self._below

    @property
    def has_inertia(self) -> bool:
        """Whether Z(s) grows as s^2."""
        return self._above - self._below == 2

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return mass, the remaining force, and the rates of the states, in metres."""
        return Equation(self._rate, self._below, values).mechanics(x, velocity, states)

    def coefficients(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients, (rows, Q), at values of the system's parameters, and slopes.

        They are NaN where the values are not finite, or the system has another degree.
        """
        vectors, which = np.unique(values, axis=0, return_inverse=True)
        names = [p.name for p in self._origin.parameters]
        rows = np.array(
            [
                np.stack([self._at(vector), *differences(self._at, vector, names)], axis=-1)
                for vector in map(tuple, vectors.tolist())
            ]
        )[which.ravel()]
        return rows[..., 0], rows[..., 1:]

    def _at(self, vector: Sequence[float]) -> FloatArray:
        """Return the coefficients at one vector of the system's parameters."""
        if np.isfinite(vector).all():
            Z = Rational(*self._origin.rational_stiffness(vector)).without_common_zeros_at_0()
            above = _of_degree(Z.numerator, self._above)
            below = _of_degree(Z.denominator, self._below)
            if above is not None and below is not None and below[0] != 0.0:
                return coefficients_of(Rational(above, below), self._rate)
        return np.full(3 + 2 * self._below, np.nan)


def _of_degree(polynomial: FloatArray, degree: int) -> FloatArray | None:
    """Return a polynomial padded to a degree; None if its degree is higher."""
    size = degree + 1
    if np.any(polynomial[: max(0, polynomial.size - size)]):
        return None
    return np.append(np.zeros(max(0, size - polynomial.size)), polynomial[-size:])

"""Models whose linear systems have free parameters, in the coefficients of their equations."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Model
from dahl_ident.elements.linear_system import LinearEquation, LinearSystem


class Coefficients:
    """The numbers in a model's equation of motion, from the values of its parameters.

    They are the values themselves, but for linear systems that have free parameters.

    Parameters
    ----------
    model : Model

    Attributes
    ----------
    model : Model
        The same with coefficients for parameters; the one that was given where none is needed.
    """

    def __init__(self, model: Model) -> None:
        elements = [
            LinearEquation(element)
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
        for element, other in self._pairs:
            last = first + len(element.parameters)
            own = values[:, first:last]
            block = np.zeros((len(values), len(other.parameters), values.shape[1]))
            if isinstance(other, LinearEquation):
                own, block[:, :, first:last] = other.coefficients(own)
            else:
                place = np.arange(len(element.parameters))
                block[:, place, first + place] = 1.0
            numbers.append(own)
            blocks.append(block)
            first = last
        return np.concatenate(numbers, axis=1), np.concatenate(blocks, axis=1)

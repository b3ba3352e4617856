"""Directions in which a law is nonlinear, and their scales from the data.

The force of most laws is proportional to some parameters. The others are **directions**, in which
it is nonlinear: ratios of parameters that scale the force together, such as x_c = f_max/sigma,
lengths, speeds and pure numbers. The dimension of a direction gives its scale: the amplitudes of
the data for a length, amplitude times angular frequency for a speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, Parameter
from dahl_ident.elements.parameter import STIFFNESS, Dimension
from dahl_ident.problem import TableProblem
from dahl_ident.problem.stiffness import StiffnessData


@dataclass(frozen=True)
class Direction:
    """A free parameter, or its ratio to another one of the element."""

    parameter: Parameter
    over: Parameter | None
    dimension: Dimension
    """Powers of force, displacement and time."""

    @classmethod
    def of(cls, parameter: Parameter, over: Parameter | None) -> Direction:
        """Return a parameter, or its ratio to another one, with its dimension."""
        divisor = (0, 0, 0) if over is None else over.dimension
        force, displacement, time = (
            a - b for a, b in zip(parameter.dimension, divisor, strict=True)
        )
        return cls(parameter, over, (force, displacement, time))

    @property
    def is_number(self) -> bool:
        """Whether it has no unit."""
        return not any(self.dimension)

    def row(self, problem: TableProblem) -> tuple[FloatArray, float]:
        """Return row and offset with which its logarithm is row @ theta + offset."""
        row = np.zeros(len(problem.parameters))
        offset = 0.0
        for parameter, sign in ((self.parameter, 1.0), (self.over, -1.0)):
            if parameter is None:
                continue
            if parameter.free:
                row[problem.names.index(parameter.name)] = sign
            elif parameter.value is not None:
                offset += sign * float(np.log(parameter.value))
        return row, offset

    def sizes(self, view: StiffnessData) -> FloatArray:
        """Return the logarithm of its scale at each row of the data, (n,) or (S, n)."""
        force, displacement, time = self.dimension
        ln_size = displacement * np.log(view.amplitude)
        if time:
            ln_size = ln_size - time * np.log(np.maximum(view.omega, 1e-300))
        if force:
            stiffness = np.log(view.typical_stiffness)[..., None]
            ln_size = ln_size + force * (stiffness + np.log(view.amplitude))
        return np.asarray(ln_size)


@dataclass(frozen=True)
class Directions:
    """How an element depends on its free parameters."""

    element: Element
    linear: tuple[Parameter, ...]
    """Free parameters in which the force is linear."""
    scale: tuple[Parameter, ...]
    """Parameters that scale the remaining force together."""
    reference: Parameter | None
    """The parameter of `scale` by which the others are divided."""
    nonlinear: tuple[Direction, ...]

    @property
    def is_free(self) -> bool:
        """Whether the common scale of the force is free, so that it can be solved for."""
        return bool(self.scale) and all(p.free for p in self.scale)

    @cached_property
    def lengths(self) -> tuple[Direction, ...]:
        """The directions with a unit, if all are powers of a length, so that they scale the curve.

        N over the reference then depends only on the amplitude over one of these lengths, their
        ratios, and numbers.
        """
        with_unit = tuple(d for d in self.nonlinear if not d.is_number)
        fixed = [
            p
            for p in self.element.parameters
            if not p.free and p not in self.scale and any(p.dimension)
        ]
        scales = self.element.rate_independent and self.is_free and not fixed and not self.linear
        of_length = all(not d.dimension[0] and not d.dimension[2] for d in with_unit)
        return with_unit if scales and of_length else ()


@lru_cache(maxsize=256)
def directions(element: Element) -> Directions:
    """Return how an element depends on its free parameters."""
    parameters = dict(zip(element.labels, element.parameters, strict=True))
    linear = tuple(p for label, p in parameters.items() if label in element.linear_parameters)
    scale = tuple(
        p
        for label, p in parameters.items()
        if label in element.scale_parameters and p not in linear
    )
    reference = _reference(scale)
    searched = []
    for parameter in element.parameters:
        if not parameter.free or parameter in linear or parameter is reference:
            continue
        if element.is_linear:  # its dependence on the parameter is unknown
            continue
        searched.append(Direction.of(parameter, reference if parameter in scale else None))
    return Directions(
        element, tuple(p for p in linear if p.free), scale, reference, tuple(searched)
    )


def is_positive(parameter: Parameter) -> bool:
    """Return whether a parameter takes values above zero only."""
    return parameter.positive or parameter.lower >= 0.0


def _reference(scale: tuple[Parameter, ...]) -> Parameter | None:
    """Return the divisor of the other scale parameters: a known one, or a stiffness."""
    known = [p for p in scale if not p.free]
    stiff = [p for p in scale if p.dimension == STIFFNESS]
    return next(iter((*known, *stiff, *scale)), None)


def free_springs(problem: TableProblem) -> list[Parameter]:
    """Return the free stiffnesses of linear springs without a lower bound."""
    return [
        p
        for element in problem.model.elements
        if element.is_linear and element.rate_independent
        for p in directions(element).linear
        if p.dimension == STIFFNESS and np.isinf(p.lower)
    ]

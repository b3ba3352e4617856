"""The exact steady motion of a plant under a sinusoidal force, by the engine.

The describing function assumes a sinusoidal displacement. With friction the motion is periodic, but
has harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.equations import plant_equations
from dahl_ident.elements.facts import Mechanics
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.linear_system import Equation, LinearSystem, coefficients_of, differences
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.rational import Rational, typical_rate
from dahl_ident.errors import ModelError

if TYPE_CHECKING:
    from dahl_ident.engine import Settled, System

Steady = Literal["exact", "describing function"]
STEADY: tuple[Steady, ...] = ("exact", "describing function")
"""Ways to predict the steady response to a sinusoidal force."""

ACCURACY = 1e-9
"""Largest relative difference between solutions of one motion from different starts."""

NEUTRAL = 1e-6
"""Deviation from 1, by rounding, of the multiplier of a motion that no spring holds in place."""

_STATES = 24  # random states at which the two directions are compared
_SAME_RATE = 1e-9  # relative difference of their rates

LINEAR = "the model is linear"
"""The obstacle to an exact motion of a plant whose response is a sine."""


def obstacle(model: Element) -> str:
    """Return why the exact steady motion of a plant cannot be computed; empty if it can.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> obstacle(Dahl() + Mass(1.0)), obstacle(Dahl())
    ('', 'the model has no mass')
    """
    model = as_model(model)
    if all(element.is_linear for element in model.elements):
        return LINEAR
    try:
        model = Coefficients(model).model
        if not model.has_inertia:
            return "the model has no mass"
        plant_equations(model)
    except ModelError as error:
        return error.fault
    return ""


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


class Shooting:
    """The steady motions of one model, whose equations are compiled at first use.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> plant = Shooting(Dahl() + Mass() + Damper() + Spring())
    >>> values = np.array([[0.1, 30.0, 1.0, 0.3, 0.24, 0.3]])
    >>> steady = plant(values, np.array([2.0 * np.pi]), np.array([0.2]), harmonics=(1, 3))
    >>> abs(steady.harmonics).round(5).tolist(), bool(steady.multiplier[0] < 1.0)
    ([[0.01811, 0.00028]], True)
    """

    def __init__(self, model: Element) -> None:
        self._model = as_model(model)
        self._coefficients = Coefficients(self._model)

    @cached_property
    def system(self) -> System:
        """The compiled equations."""
        from dahl_ident.engine import translate

        return translate(plant_equations(self._coefficients.model))

    def drifts(self, values: FloatArray) -> bool:
        """Return whether the mean displacement drifts from cycle to cycle, at one vector of values.

        It does if no spring acts and friction differs between the directions; then no motion has
        the period of the drive.
        """
        if self.system.odd or self._rates is None or not np.isfinite(values).all():
            return False
        if not self._coefficients.are_values:
            values = self._coefficients(values[None])[0][0]
        rng = np.random.default_rng(0)
        size = (self.system.order + 1, _STATES)
        states = rng.standard_normal(size) * 10.0 ** rng.uniform(-3.0, 3.0, size)
        rates, sums = self._rates(np.vstack([states, np.sign(states[1])]), values)
        return bool(np.any(np.abs(sums.full()) > _SAME_RATE * np.abs(rates.full())))

    @cached_property
    def _rates(self) -> Any:
        """The rates of a state, and their sum with the opposite state's; None if a spring acts."""
        import casadi as ca

        equations = plant_equations(self._coefficients.model)
        rates = equations.rates
        if ca.depends_on(rates, equations.states[0]):
            return None
        states = ca.vertcat(*equations.states, equations.drive, equations.direction)
        sums = rates + ca.substitute(rates, states, -states)
        return ca.Function("rates", [states, ca.vertcat(*equations.parameters)], [rates, sums])

    def __call__(
        self,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        *,
        chosen: Sequence[int] = (),
        stable: bool = True,
        **options: Any,
    ) -> Settled:
        """Return the steady motions of many rows, with values that the engine can resolve.

        If `stable`, a motion that is not stable counts as none. Options and result are those of
        :func:`dahl_ident.engine.steady_motions`.
        """
        if omega.size and self.drifts(values[0]):
            values = np.full(values.shape, np.nan)  # for which no motion is sought
        options["largest"] = 1.0 + NEUTRAL if stable else np.inf
        with np.errstate(all="ignore"):
            smallest = self._smallest_amplitude(values, omega, drive)
            resolved = np.stack(self._model.resolved(list(values.T), smallest), axis=-1)
            rows, limited = np.nonzero((resolved < values)[:, list(chosen)])
        result = self._motions(resolved, omega, drive, chosen, **options)
        result.by_parameter[rows, :, limited] = 0.0
        return result

    def _smallest_amplitude(
        self, values: FloatArray, omega: FloatArray, drive: FloatArray
    ) -> FloatArray:
        """Return lower bounds of the amplitudes of displacement.

        They are those with stuck friction, in phase with the force of the linear part.
        """
        linear, stuck = np.zeros(omega.shape, dtype=np.complex128), np.zeros(omega.shape)
        for element, numbers in self._model.of(list(values.T)):
            if element.is_linear:
                linear += element.stiffness(numbers, np.zeros(()), omega)
            elif isinstance(element, Friction):
                (law,) = element.inner_elements or (element,)
                stuck += law.rest_stiffness(numbers[: len(law.parameters)])
        return np.asarray(drive / (np.abs(linear) + stuck))

    def _motions(
        self,
        values: FloatArray,
        omega: FloatArray,
        drive: FloatArray,
        chosen: Sequence[int],
        **options: Any,
    ) -> Settled:
        """Return the steady motions of many rows, at values that the engine resolves."""
        from dahl_ident.engine import steady_motions

        if self._coefficients.are_values:
            return steady_motions(self.system, values, omega, drive, chosen=chosen, **options)
        numbers, slopes = self._coefficients(values)
        slopes = slopes[:, :, tuple(chosen)]
        needed = np.flatnonzero(slopes.any(axis=(0, 2))).tolist()
        result = steady_motions(self.system, numbers, omega, drive, chosen=needed, **options)
        return result._replace(by_parameter=result.by_parameter @ slopes[:, needed])

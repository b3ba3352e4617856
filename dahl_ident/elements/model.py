"""Elements in parallel: the plant of Eqn. 53 and its relatives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element, StiffnessGradient
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    import casadi as ca

Value = TypeVar("Value")


class Model(Element):
    """Elements in parallel: Z(A, omega) is the sum of theirs, at one displacement.

    Usually written with ``+``. Sums of sums are flattened.

    Parameters
    ----------
    *elements : Element
        One or more elements or sums.

    Raises
    ------
    ModelError
        If there is no element, or two parameters share a name.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> plant = Dahl() + Mass(0.3) + Damper() + Spring()
    >>> [p.name for p in plant.parameters if p.free]
    ['f_max', 'sigma', 'damping', 'stiffness']
    """

    def __init__(self, *elements: Element) -> None:
        flat: list[Element] = []
        for element in elements:
            flat.extend(element.elements if isinstance(element, Model) else [element])
        if not flat:
            raise ModelError("a model needs at least one element, got none")
        self._elements = tuple(flat)
        self.parameters = tuple(p for element in flat for p in element.parameters)
        self.is_linear = all(element.is_linear for element in flat)
        self.rate_independent = all(element.rate_independent for element in flat)
        self.has_memory = any(element.has_memory for element in flat)
        names = [p.name for p in self.parameters]
        if len(set(names)) < len(names):
            clashes = [name for name, count in Counter(names).items() if count > 1]
            raise ModelError(
                f"two elements share the parameter names {', '.join(clashes)}; "
                "give each a name, such as Dahl(name='pivot')"
            )
        self._slices: list[slice] = []
        start = 0
        for element in flat:
            self._slices.append(slice(start, start + len(element.parameters)))
            start += len(element.parameters)

    @property
    def elements(self) -> tuple[Element, ...]:
        """The elements, in the order in which they were added."""
        return self._elements

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return the sum of the elements' F_k/X_1 at `values`, unchecked."""
        parts = [
            element.stiffness(values[s], amplitude, omega, harmonic)
            for element, s in zip(self._elements, self._slices, strict=True)
        ]
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return total

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return the sum of the elements' F_k/X_1 with all derivatives, unchecked."""
        parts = [
            element.stiffness_gradient(values[s], amplitude, omega, harmonic)
            for element, s in zip(self._elements, self._slices, strict=True)
        ]
        value, by_amplitude = parts[0].value, parts[0].by_amplitude
        for part in parts[1:]:
            value = value + part.value
            by_amplitude = by_amplitude + part.by_amplitude
        return StiffnessGradient(
            value, by_amplitude, tuple(d for part in parts for d in part.by_parameter)
        )

    def stiffness_slope(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the sum of the elements' F/X and its derivative by amplitude, unchecked."""
        pairs = [e.stiffness_slope(own, amplitude, omega) for e, own in self.of(values)]
        value, slope = pairs[0]
        for one, other in pairs[1:]:
            value, slope = value + one, slope + other
        return value, slope

    def force_history(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> FloatArray:
        """Return the sum of the elements' forces, unchecked; `state` is the friction's."""
        total = np.zeros(np.shape(displacement))
        for element, s in zip(self._elements, self._slices, strict=True):
            start = state if element.has_memory else 0.0
            total += element.force_history(
                values[s], displacement, velocity, start, acceleration=acceleration
            )
        return total

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        remember = [e for e in self._elements if e.has_memory]
        if not remember:
            super()._check_start(values, initial_force)
        if initial_force and len(remember) > 1:
            raise ValidationError(
                f"initial_force is {initial_force!r} for {len(remember)} elements with memory; "
                "evaluate them one by one, or leave it out"
            )
        for element, s in zip(self._elements, self._slices, strict=True):
            if element.has_memory:
                element._check_start(values[s], initial_force)

    def force_bounds(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return the sums of the elements' bounds of abs(N) and A abs(N)."""
        steepest, largest = np.zeros(()), np.zeros(())
        for element, s in zip(self._elements, self._slices, strict=True):
            own = element.force_bounds(values[s])
            steepest, largest = steepest + own[0], largest + own[1]
        return steepest, largest

    def knee(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest knee of the elements; NaN where all are linear."""
        low, high = np.full((), np.nan), np.full((), np.nan)
        for element, s in zip(self._elements, self._slices, strict=True):
            own = element.knee(values[s])
            low, high = np.fmin(low, own[0]), np.fmax(high, own[1])
        return low, high

    def transient_decay(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the decay of the element that forgets most slowly."""
        slowest = np.zeros(np.broadcast_shapes(np.shape(amplitude), np.shape(omega)))
        for element, s in zip(self._elements, self._slices, strict=True):
            slowest = np.maximum(slowest, element.transient_decay(values[s], amplitude, omega))
        return slowest

    def casadi_stiffness(
        self, values: Sequence[ca.SX], amplitude: ca.SX, omega: ca.SX, harmonic: int = 1
    ) -> tuple[ca.SX, ca.SX]:
        """Return real and imaginary part of the sum as casadi expressions."""
        real, imag = 0.0 * amplitude, 0.0 * amplitude
        for element, s in zip(self._elements, self._slices, strict=True):
            own = element.casadi_stiffness(values[s], amplitude, omega, harmonic)
            real, imag = real + own[0], imag + own[1]
        return real, imag

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return the objections of all elements to their values."""
        return tuple(
            text
            for element, s in zip(self._elements, self._slices, strict=True)
            for text in element.physics(values[s])
        )

    def tabulated(self) -> Model:
        """Return the model with tables in place of quadratures; itself where it needs none.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> Model(Dahl(alpha=2.0)).tabulated()
        TabulatedDahl(f_max=free, sigma=free, alpha=2)
        """
        faster = [element.tabulated() for element in self._elements]
        if all(new is old for new, old in zip(faster, self._elements, strict=True)):
            return self
        return Model(*faster)

    def of(self, values: Sequence[Value]) -> Iterator[tuple[Element, Sequence[Value]]]:
        """Yield every element with its own part of the model's parameter `values`."""
        for element, s in zip(self._elements, self._slices, strict=True):
            yield element, values[s]

    def with_parameters(self, changes: Mapping[str, Parameter]) -> Model:
        """Return this model with some parameters replaced, by name."""
        self._check_names(changes)
        elements = []
        for element in self._elements:
            parameters = tuple(changes.get(p.name, p) for p in element.parameters)
            if parameters == element.parameters:
                elements.append(element)
                continue
            elements.append(element.with_bound(parameters))
        return Model(*elements)

    def with_free(self, names: Iterable[str]) -> Model:
        """Return this model with the named parameters estimated, started from their values."""
        known = {p.name: p for p in self.parameters}
        names = list(names)
        self._check_names(names)
        return self.with_parameters({name: known[name].freed() for name in names})

    def with_fixed(self, values: Mapping[str, float]) -> Model:
        """Return this model with the named parameters held at the given values."""
        known = {p.name: p for p in self.parameters}
        self._check_names(values)
        return self.with_parameters({n: known[n].fixed(v) for n, v in values.items()})

    def with_values(self, values: Mapping[str, float]) -> Model:
        """Return this model with values put in, each parameter staying free or fixed as it was."""
        known = {p.name: p for p in self.parameters}
        self._check_names(values)
        return self.with_parameters({n: replace(known[n], value=v) for n, v in values.items()})

    def _check_names(self, names: Iterable[str]) -> None:
        known = [p.name for p in self.parameters]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ModelError(
                f"the model has no parameter {', '.join(unknown)}; it has {', '.join(known)}"
            )

    def __repr__(self) -> str:
        return " + ".join(repr(element) for element in self._elements)


def as_model(model: Element) -> Model:
    """Return `model` as a sum, so that one element alone needs no special case."""
    if isinstance(model, Model):
        return model
    if not isinstance(model, Element):
        raise ModelError(f"expected a model such as Dahl() + Mass(0.3), got {type(model).__name__}")
    return Model(model)


Element._in_parallel = Model

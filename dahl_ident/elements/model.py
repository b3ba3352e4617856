"""Elements in parallel: the plant of Eqn. 53 and its relatives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray, finite_array
from dahl_ident.elements.element import Element, StiffnessGradient
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError


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
        self._name = None
        self._parameters = tuple(p for element in flat for p in element.parameters)
        clashes = [n for n, count in Counter(p.name for p in self._parameters).items() if count > 1]
        if clashes:
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

    def force(
        self,
        displacement: ArrayLike,
        *,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
    ) -> FloatArray:
        """Return the sum of the elements' forces for one displacement history.

        Parameters
        ----------
        displacement : array_like, shape (n,)
            m.
        velocity, acceleration : array_like, shape (n,), optional
            m/s and m/s^2; needed where the model has a damper or a mass.

        Returns
        -------
        ndarray, shape (n,)
            N. Friction starts from zero force.

        Raises
        ------
        ValidationError
            If a needed history is missing or not as long as the displacement, or a value is
            NaN, infinite or complex.

        Examples
        --------
        >>> from dahl_ident import Damper, Spring
        >>> (Spring(2.0) + Damper(1.0)).force([0.0, 1.0], velocity=[3.0, 0.0])
        array([3., 2.])
        """
        x = finite_array(displacement, "displacement")
        total = np.zeros(x.shape)
        for element in self._elements:
            total += element.force(x, velocity=velocity, acceleration=acceleration)
        return total

    def with_parameters(self, changes: Mapping[str, Parameter]) -> Model:
        """Return this model with some parameters replaced, by name."""
        self._check_names(changes)
        elements = []
        for element in self._elements:
            parameters = tuple(changes.get(p.name, p) for p in element.parameters)
            if parameters == element.parameters:
                elements.append(element)
                continue
            copy = object.__new__(type(element))
            copy.__dict__.update(element.__dict__)
            copy._parameters = parameters  # the one place where an element is rebuilt
            elements.append(copy)
        return Model(*elements)

    def with_free(self, names: Iterable[str]) -> Model:
        """Return this model with the named parameters estimated, started from their values."""
        known = {p.name: p for p in self._parameters}
        names = list(names)
        self._check_names(names)
        return self.with_parameters({name: known[name].freed() for name in names})

    def with_fixed(self, values: Mapping[str, float]) -> Model:
        """Return this model with the named parameters held at the given values."""
        known = {p.name: p for p in self._parameters}
        self._check_names(values)
        return self.with_parameters({n: known[n].fixed(v) for n, v in values.items()})

    def with_values(self, values: Mapping[str, float]) -> Model:
        """Return this model with values put in, each parameter staying free or fixed as it was."""
        known = {p.name: p for p in self._parameters}
        self._check_names(values)
        return self.with_parameters({n: replace(known[n], value=v) for n, v in values.items()})

    def _check_names(self, names: Iterable[str]) -> None:
        known = [p.name for p in self._parameters]
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

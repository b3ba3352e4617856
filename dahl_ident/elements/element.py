"""What every element of a model provides: its dynamic stiffness, derivatives and force."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    broadcast_shape,
    finite_array,
    non_negative_array,
    real_array,
    whole_number,
)
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.elements.model import Model


class StiffnessGradient(NamedTuple):
    """A dynamic stiffness with its first derivatives; all of one broadcast shape.

    Attributes
    ----------
    value : ndarray of complex
        Z(A, omega), N/m (N m/rad in rotation).
    by_amplitude : ndarray of complex
        dZ/dA.
    by_parameter : tuple of ndarray of complex
        dZ/dp for each parameter p of the element, in the order of its `parameters`.
    """

    value: ComplexArray
    by_amplitude: ComplexArray
    by_parameter: tuple[ComplexArray, ...]


class Element(ABC):
    """Part of a mechanism: Z(A, omega) = F/X, its share of the dynamic stiffness.

    Elements act in parallel: ``+`` adds their forces at one displacement. A number given to an
    element fixes that parameter; one left out is free, to be estimated.
    """

    _parameters: tuple[Parameter, ...]
    _name: str | None

    @property
    def name(self) -> str | None:
        """The element's name, which prefixes its parameters, or None."""
        return self._name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The element's parameters, in the order of its constructor."""
        return self._parameters

    @abstractmethod
    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1 at the parameter `values`, unchecked; all arguments broadcast."""

    @abstractmethod
    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives by amplitude and by each parameter, unchecked."""

    def dynamic_stiffness(
        self, amplitude: ArrayLike, omega: ArrayLike = 0.0, *, harmonic: int = 1
    ) -> ComplexArray:
        """Return the dynamic stiffness Z(A, omega) = F/X of this element or sum.

        Parameters
        ----------
        amplitude : array_like
            Zero-to-peak displacement amplitude A >= 0, m (rad in rotation).
        omega : array_like, default 0
            Angular frequency, rad/s; broadcast with `amplitude`.
        harmonic : int, default 1
            k >= 1: the k-th force harmonic over the displacement's fundamental.

        Returns
        -------
        ndarray of complex, or complex for scalar arguments
            N/m.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If `amplitude` is negative, or either argument is NaN, infinite or complex.

        Examples
        --------
        >>> from dahl_ident import Mass, Spring
        >>> print((Mass(0.3) + Spring(0.3)).dynamic_stiffness(1e-3, 2.0))
        (-0.8999999999999999+0j)
        """
        A = non_negative_array(amplitude, "amplitude")
        w = non_negative_array(omega, "omega")
        shape = broadcast_shape(amplitude=A, omega=w)
        k = whole_number(harmonic, "harmonic", 1)
        Z = self.stiffness(self.known_values(), A, w, k)
        return np.broadcast_to(Z, shape).copy()[()]

    @abstractmethod
    def force(
        self,
        displacement: ArrayLike,
        *,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
    ) -> FloatArray:
        """Return the element's force, N, for a displacement history, m."""

    def known_values(self) -> tuple[FloatArray, ...]:
        """Return the value of every parameter, or name those that have none."""
        missing = [p.name for p in self.parameters if p.value is None]
        if missing:
            raise ModelError(
                f"{self!r} has no value for {', '.join(missing)}; "
                "give a number to evaluate the model, or estimate it with fit"
            )
        return tuple(np.asarray(p.value) for p in self.parameters)

    def __add__(self, other: Element) -> Model:
        """Put two elements, or sums of elements, in parallel."""
        from dahl_ident.elements.model import Model

        if not isinstance(other, Element):
            return NotImplemented
        return Model(self, other)

    def __repr__(self) -> str:
        parts = []
        for parameter in self.parameters:
            label = parameter.name.removeprefix(f"{self.name}_")
            value = "free" if parameter.value is None else f"{parameter.value:g}"
            if parameter.free and parameter.value is not None:
                value += " free"
            parts.append(f"{label}={value}")
        if self.name:
            parts.append(f"name={self.name!r}")
        return f"{type(self).__name__}({', '.join(parts)})"


def prefixed(name: str | None, label: str) -> str:
    """Return the full name of the parameter `label` of an element called `name`."""
    if name is None:
        return label
    if not str(name).isidentifier():
        raise ValidationError(
            f"name is {name!r}; expected letters, digits and underscores, such as 'pivot'"
        )
    return f"{name}_{label}"


def motion(
    value: ArrayLike | None, name: str, displacement: ArrayLike, needed_by: Element
) -> FloatArray:
    """Return a checked history as long as `displacement`, or say which element needs it."""
    if value is None:
        raise ValidationError(f"{needed_by!r} needs {name} to give its force; pass {name}=")
    history, x = finite_array(value, name), real_array(displacement, "displacement")
    if history.shape != x.shape:
        raise ValidationError(
            f"{name} has shape {history.shape}; expected that of displacement, {x.shape}"
        )
    return history

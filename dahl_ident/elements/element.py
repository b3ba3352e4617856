"""Elements and their sums: what every law answers, names, plain data, checked calls, and ``+``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    broadcast_shape,
    finite_array,
    finite_number,
    non_negative_array,
    real_array,
    whole_number,
)
from dahl_ident.elements.behaviour import Behaviour
from dahl_ident.elements.facts import (
    HistoryGradient,
    Path,
    Sine,
    StiffnessGradient,
    Values,
)
from dahl_ident.elements.law_files import file_of, register, restored
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError, ValidationError

Value = TypeVar("Value")


class Element(Behaviour):
    """Part of a mechanism: Z(A, omega) = F/X, its share of the dynamic stiffness.

    Elements act in parallel: ``+`` adds their forces at one displacement. A number given to an
    element fixes that parameter; one left out is free, to be estimated. A subclass with a `kind`
    can be written to files under this name.

    Attributes
    ----------
    kind : str
        Name in JSON, TOML and on the command line, such as "dahl".
    equation : str
        The law in plain text.
    is_linear : bool
        True: the stiffness does not depend on the amplitude.
    rate_independent : bool
        True: the stiffness does not depend on the frequency.
    has_memory : bool
        True: the force depends on the displacement's history.
    unique_response : bool
        True: in parallel with a passive linear part the response to a sine force is unique, because
        A abs(L + N(A)) rises with A.
    parameters : tuple of Parameter
        In the order of the constructor: declarations on the class, with values on an element.
    optional : (Parameter, float) or None
        One more parameter, and the number at which an element does not have it.
    linear_parameters : tuple of str
        Labels in each of which the force is proportional, the others held.
    scale_parameters : tuple of str
        Labels that scale the whole force when multiplied together by one factor.
    like_parts : tuple of tuple of str
        Labels of parts that could be exchanged; estimates are ordered by the first label of each.
    softens : bool
        True: Re N falls with the amplitude, whatever the values.
    holds_at_rest : bool
        True: a displacement held constant may take a force.
    start : tuple of str
        Name, unit and meaning of the unknown from which the states of a driven motion start.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.__dict__.get("kind"):
            register(cls)

    def __reduce_ex__(self, protocol: Any) -> Any:
        file = file_of(type(self))
        if file is None:
            return super().__reduce_ex__(protocol)
        return restored, (file, type(self).__qualname__), self.__dict__

    def _bind(self, arguments: Mapping[str, float | None], name: str | None) -> None:
        """Give the declared parameters their full names and values."""
        self._name = name
        declared = type(self).parameters
        if self.optional and arguments[self.optional[0].name] != self.optional[1]:
            declared = (*declared, self.optional[0])
        self.parameters = tuple(
            p.bound(prefixed(name, p.name), arguments.get(p.name, p.value)) for p in declared
        )

    @property
    def has_optional(self) -> bool:
        """Whether the element has the parameter that is optional."""
        return self.optional is not None and self.optional[0].name in self.labels

    def with_bound(self, parameters: tuple[Parameter, ...]) -> Self:
        """Return a copy of this element with other values, bounds or free flags."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__)
        copy.parameters = parameters
        return copy

    def started(self, values: Sequence[float]) -> Self:
        """Return this element with values to start from where it is free."""
        return self.with_bound(
            tuple(
                replace(p, value=p.nearest(v), assumed=False) if p.free else p
                for p, v in zip(self.parameters, values, strict=True)
            )
        )

    def describe(self) -> dict[str, Any]:
        """Return kind, name and parameters as plain data."""
        name = {"name": self.name} if self.name else {}
        parameters = {self.label(p): p.describe() for p in self.parameters}
        return {"kind": self.kind, **name, **parameters}

    @classmethod
    def from_description(cls, rest: Mapping[str, Any], name: str | None) -> Element:
        """Return the element that :meth:`describe` described; `rest` has neither kind nor name."""
        options: dict[str, Any] = {"name": name}
        if cls.optional and cls.optional[0].name in rest:
            options[cls.optional[0].name] = None
        return cls(**options)._described(rest)

    def _described(self, description: Mapping[str, Any]) -> Self:
        """Return this element with the parameters that plain data describe, by label."""
        known = self.labels
        unknown = [label for label in description if label not in known]
        if unknown:
            raise ModelError(
                f"the {self.kind} element has the keys {', '.join(unknown)}; expected "
                f"{', '.join(known)}"
            )
        return self.with_bound(
            tuple(
                p.described(description[label]) if label in description else p
                for label, p in zip(known, self.parameters, strict=True)
            )
        )

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
            k >= 1: the k-th force harmonic over the displacement's fundamental. 0: the mean
            force over the amplitude.

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
        k = whole_number(harmonic, "harmonic", 0)
        Z = self.stiffness(self.known_values(), A, w, k)
        return np.broadcast_to(Z, shape).copy()[()]

    def force(
        self,
        displacement: ArrayLike,
        initial_force: float = 0.0,
        *,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        time: ArrayLike | None = None,
    ) -> FloatArray:
        """Return the element's force for a displacement history.

        Parameters
        ----------
        displacement : array_like, shape (n,)
            m; between samples the motion is taken as monotone or, by an element that depends on
            the rate, as a polynomial with the velocity (and acceleration) of both.
        initial_force : float, default 0
            Force at the first sample, N; for an element with memory.
        velocity, acceleration : array_like, shape (n,), optional
            m/s and m/s^2; needed where the element depends on them.
        time : array_like, shape (n,), optional
            s; gives the velocity and acceleration that are left out, by central differences.
            Without it samples are taken as even where displacement and velocity agree with that.

        Returns
        -------
        ndarray, shape (n,)
            N; a scalar displacement gives a scalar.

        Raises
        ------
        ModelError
            If a parameter has no value.
        ValidationError
            If a needed history is missing or not as long as the displacement, a value is NaN,
            infinite or complex, or an element without memory is given an initial force.

        Examples
        --------
        >>> from dahl_ident import Mass
        >>> Mass(2.0).force([0.0], acceleration=[3.0])
        array([6.])
        """
        x = finite_array(displacement, "displacement")
        if x.ndim > 1 or not x.size:
            raise ValidationError(
                f"displacement has shape {x.shape}; expected one history, shape (n,)"
            )
        values = [float(v) for v in self.known_values()]
        start = finite_number(initial_force, "initial_force")
        self._check_start(values, start)
        v, a = (
            None if channel is None else np.atleast_1d(motion(channel, name, x, self))
            for channel, name in ((velocity, "velocity"), (acceleration, "acceleration"))
        )
        t = None
        if time is not None and x.size > 1:
            t = motion(time, "time", x, self)
            if np.any(np.diff(t) <= 0.0):
                raise ValidationError("time does not rise from sample to sample")
            v = np.gradient(x, t) if v is None else v
            a = np.gradient(v, t) if a is None else a
        start = self.start_with(values, start)
        force = self.force_history(values, np.atleast_1d(x), v, start, acceleration=a, time=t)
        return force if x.ndim else force[0]

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        """Refuse an initial force that the element cannot have."""
        if initial_force and not self.has_memory:
            raise ValidationError(
                f"initial_force is {initial_force!r}, but {self!r} has no memory; leave it out"
            )

    def __add__(self, other: Element) -> Model:
        """Put two elements, or sums of elements, in parallel."""
        if not isinstance(other, Element):
            return NotImplemented
        return Model(self, other)

    def __repr__(self) -> str:
        parts = []
        for parameter in self.parameters:
            value = "free" if parameter.value is None else f"{parameter.value:g}"
            if parameter.free and parameter.value is not None:
                value += " free"
            parts.append(f"{self.label(parameter)}={value}")
        if self.name:
            parts.append(f"name={self.name!r}")
        return f"{type(self).__name__}({', '.join(parts)})"


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
        clashes = [n for n, count in Counter(p.name for p in self.parameters).items() if count > 1]
        if clashes:
            raise ModelError(
                f"two elements share the parameter names {', '.join(clashes)}; "
                "give each a name, such as Dahl(name='pivot')"
            )
        ends = np.cumsum([0, *(len(element.parameters) for element in flat)]).tolist()
        self._slices = [slice(a, b) for a, b in pairwise(ends)]

    @property
    def elements(self) -> tuple[Element, ...]:
        """The elements, in the order in which they were added."""
        return self._elements

    def of(self, values: Sequence[Value]) -> Iterator[tuple[Element, Sequence[Value]]]:
        """Yield every element with its own part of the model's parameter `values`."""
        for element, s in zip(self._elements, self._slices, strict=True):
            yield element, values[s]

    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return the sum of the elements' F_k/X_1 with its derivatives, unchecked."""
        parts = [
            element.settled(numbers, sine, derivatives) for element, numbers in self.of(values)
        ]
        value, by_amplitude, _ = parts[0]
        for part in parts[1:]:
            value, by_amplitude = value + part.value, by_amplitude + part.by_amplitude
        return StiffnessGradient(
            value, by_amplitude, tuple(d for part in parts for d in part.by_parameter)
        )

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the sum of the elements' forces, unchecked; `state` is the friction's."""
        parts = [
            element.history(numbers, path, state if element.has_memory else 0.0, slopes=slopes)
            for element, numbers in self.of(values)
        ]
        value = np.asarray(sum(part.value for part in parts))
        by_state = np.asarray(sum(part.by_state for part in parts))
        return HistoryGradient(value, by_state, tuple(d for p in parts for d in p.by_parameter))

    def start_with(self, values: Sequence[Any], force: float) -> float:
        """Return the unknown of the friction, of which there is one if there is a force."""
        return sum(e.start_with(numbers, force) for e, numbers in self.of(values) if e.has_memory)

    @property
    def has_inertia(self) -> bool:
        """Whether a force determines the motion."""
        return any(element.has_inertia for element in self._elements)

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        remember = [(e, numbers) for e, numbers in self.of(values) if e.has_memory]
        if not remember:
            super()._check_start(values, initial_force)
        if initial_force and len(remember) > 1:
            raise ValidationError(
                f"initial_force is {initial_force!r} for {len(remember)} elements with memory; "
                "evaluate them one by one, or leave it out"
            )
        for element, numbers in remember:
            element._check_start(numbers, initial_force)

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the sums of the elements' bounds of abs(N) and A abs(N)."""
        bounds = [element.force_bounds(numbers) for element, numbers in self.of(values)]
        steepest, largest = (np.asarray(sum(b[i] for b in bounds)) for i in (0, 1))
        return steepest, largest

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest knee of the elements; NaN where all are linear."""
        low, high = np.full((), np.nan), np.full((), np.nan)
        for element, numbers in self.of(values):
            first, last = element.knee(numbers)
            low, high = np.fmin(low, first), np.fmax(high, last)
        return low, high

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the decay of the element that forgets most slowly."""
        slowest = super().transient_decay(values, amplitude, omega)
        for element, numbers in self.of(values):
            slowest = np.maximum(slowest, element.transient_decay(numbers, amplitude, omega))
        return slowest

    def resolved(self, values: Values, amplitude: FloatArray) -> Values:
        """Return the values of all elements, those that no longer matter held where they do."""
        return [
            v for element, numbers in self.of(values) for v in element.resolved(numbers, amplitude)
        ]

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return the objections of all elements to their values."""
        return tuple(
            text for element, numbers in self.of(values) for text in element.physics(numbers)
        )

    def coarser(self) -> Model:
        """Return the model of elements whose motion under a force costs less, or itself."""
        elements = [element.coarser() for element in self._elements]
        same = all(new is old for new, old in zip(elements, self._elements, strict=True))
        return self if same else Model(*elements)

    def with_parameters(self, changes: Mapping[str, Parameter]) -> Model:
        """Return this model with some parameters replaced, by name."""
        self._known(changes)
        elements = []
        for element in self._elements:
            parameters = tuple(changes.get(p.name, p) for p in element.parameters)
            same = parameters == element.parameters
            elements.append(element if same else element.with_bound(parameters))
        return Model(*elements)

    def with_free(self, names: Iterable[str]) -> Model:
        """Return this model with the named parameters estimated, started from their values."""
        names = list(names)
        known = self._known(names)
        return self.with_parameters({name: known[name].freed() for name in names})

    def with_fixed(self, values: Mapping[str, float]) -> Model:
        """Return this model with the named parameters held at the given values."""
        known = self._known(values)
        return self.with_parameters({n: known[n].fixed(v) for n, v in values.items()})

    def with_values(self, values: Mapping[str, float]) -> Model:
        """Return this model with values put in, each parameter staying free or fixed as it was."""
        known = self._known(values)
        return self.with_parameters({n: replace(known[n], value=v) for n, v in values.items()})

    def _known(self, names: Iterable[str]) -> dict[str, Parameter]:
        """Return the parameters by name; refuse unknown names."""
        known = {p.name: p for p in self.parameters}
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ModelError(
                f"the model has no parameter {', '.join(unknown)}; it has {', '.join(known)}"
            )
        return known

    def __repr__(self) -> str:
        return " + ".join(repr(element) for element in self._elements)


def as_model(model: Element) -> Model:
    """Return `model` as a sum, so that one element alone needs no special case."""
    if isinstance(model, Model):
        return model
    if not isinstance(model, Element):
        raise ModelError(f"expected a model such as Dahl() + Mass(0.3), got {type(model).__name__}")
    return Model(model)


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

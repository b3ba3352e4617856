"""Elements, and models: elements in parallel. Both also as plain data, for files of results."""

from __future__ import annotations

import inspect
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    broadcast_shape,
    finite_array,
    finite_number,
    non_negative_array,
    whole_number,
)
from dahl_ident.elements.facts import HistoryGradient, Path, Sine, StiffnessGradient, Values
from dahl_ident.elements.force_law import ForceLaw, required_history
from dahl_ident.elements.law_checks import check_declarations
from dahl_ident.elements.law_module import LawFile, file_of, module_of, source_path
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError, ValidationError, choices, spelled

Value = TypeVar("Value")

KINDS: dict[str, type[Element]] = {}
"""Every element class by its name in files and on the command line."""


class Alternative(NamedTuple):
    """Elements in place of one.

    Attributes
    ----------
    elements : tuple of Element
        In parallel.
    shows : {"shape", "asymmetry", "speed", "masing"}
        The evidence for them: the dependence of force on amplitude, and the odd harmonics; the
        mean force and the even harmonics; a force that falls with the speed; or parallel Jenkins
        elements, which would leave a much smaller misfit.
    """

    elements: tuple[Element, ...]
    shows: str = "shape"


class Element(ForceLaw):
    """Part of a mechanism, with the dynamic stiffness Z(A, omega) = F/X.

    Elements act in parallel: ``+`` adds their forces at one displacement. A parameter that is given
    a number is fixed; one left out is free, and is estimated. A subclass with a `kind` can be
    written to files under this name.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.__dict__.get("kind"):
            register(cls)

    def __reduce_ex__(self, protocol: Any) -> Any:
        file = file_of(type(self))
        if file is None:
            return super().__reduce_ex__(protocol)
        return empty_element, (file, type(self).__qualname__), self.__dict__

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
            If an argument is negative, NaN, infinite or complex.

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
            m; between samples it is taken to be monotone or, for an element that depends on the
            rate, a polynomial with the velocity (and acceleration) of both samples.
        initial_force : float, default 0
            Force at the first sample, N; for an element with memory.
        velocity, acceleration : array_like, shape (n,), optional
            m/s and m/s^2; needed where the element depends on them.
        time : array_like, shape (n,), optional
            s; a velocity or acceleration that is left out follows from it by central differences.
            Without it, even sampling is assumed if displacement and velocity are consistent with
            that.

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
            None if channel is None else np.atleast_1d(required_history(channel, name, x, self))
            for channel, name in ((velocity, "velocity"), (acceleration, "acceleration"))
        )
        t = None
        if time is not None and x.size > 1:
            t = required_history(time, "time", x, self)
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

    def alternatives(self, values: Sequence[float], smallest: float) -> dict[str, Alternative]:
        """Return alternatives to this element by a short description of each.

        They start from this element's `values`; `smallest` is the smallest amplitude measured, m.
        """
        return {}


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
            if not isinstance(element, Element):
                raise ModelError(
                    "expected a model such as Dahl() + Mass(0.3), got " + type(element).__name__
                )
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
                "give each a name, such as "
                + spelled("Dahl(name='pivot')", "--element 'dahl(name=pivot)'")
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
        """Return the friction's unknown; at most one element has memory if there is a force."""
        return sum(e.start_with(numbers, force) for e, numbers in self.of(values) if e.has_memory)

    @property
    def has_inertia(self) -> bool:
        """Whether a force determines the motion."""
        return any(element.has_inertia for element in self._elements)

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        with_memory = [(e, numbers) for e, numbers in self.of(values) if e.has_memory]
        if not with_memory:
            super()._check_start(values, initial_force)
        if initial_force and len(with_memory) > 1:
            raise ValidationError(
                f"initial_force is {initial_force!r} for {len(with_memory)} elements with memory; "
                "evaluate them one by one, or leave it out"
            )
        for element, numbers in with_memory:
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
        """Return the values of all elements, each limited to where it has an effect."""
        return [
            v for element, numbers in self.of(values) for v in element.resolved(numbers, amplitude)
        ]

    def physical_objections(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return the objections of all elements to their values."""
        return tuple(
            text
            for element, numbers in self.of(values)
            for text in element.physical_objections(numbers)
        )

    def coarser(self) -> Model:
        """Return a model of elements whose motion under a force costs less, or this model."""
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
            elements.append(element if same else element.copy_with(parameters))
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
        unknown = [str(name) for name in names if name not in known]
        if unknown:
            raise ModelError(
                f"the model has no parameter {', '.join(unknown)}; it has {', '.join(known)}"
            )
        return known

    def __repr__(self) -> str:
        return " + ".join(repr(element) for element in self._elements)


def as_model(model: Element) -> Model:
    """Return `model` as a sum, so that one element alone needs no special case."""
    return model if isinstance(model, Model) else Model(model)


def register(cls: type[Element]) -> None:
    """Enter a class under its kind; a file that is run again replaces its own classes."""
    other = KINDS.get(cls.kind)
    if other and _origin(other) != _origin(cls):
        raise ModelError(
            f"{cls.__name__} has the kind {cls.kind!r}, which {other.__module__}."
            f"{other.__qualname__} has already; choose another"
        )
    KINDS[cls.kind] = cls


def _origin(cls: type) -> tuple[str, str]:
    return source_path(cls) or cls.__module__, cls.__qualname__


def class_named(name: str) -> type[Element] | None:
    """Return the class with this kind, or else with this name; None if there is none."""
    named = [cls for cls in KINDS.values() if cls.__name__ == name]
    return KINDS.get(name) or (named[0] if len(named) == 1 else None)


def laws_of(file: LawFile) -> tuple[type[Element], ...]:
    """Return the laws that a file defines, registered; it is run unless this process has run it."""
    module = module_of(file)
    laws: tuple[Any, ...] = tuple(
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, Element)
        and value.__module__ == module.__name__
        and not inspect.isabstract(value)
    )
    if not laws:
        raise ModelError(
            f"{file.path} defines no law; expected a subclass of di.Friction with parameters and "
            "slope"
        )
    for law in laws:
        if not law.__dict__.get("kind"):
            law.kind = law.__name__
        check_declarations(law)
        register(law)
    return laws


def empty_element(file: LawFile, name: str) -> Any:
    """Return an element without attributes, of a class that a file defines, for pickle to fill."""
    if file.module not in sys.modules:
        laws_of(file)
    return object.__new__(attrgetter(name)(sys.modules[file.module]))


def describe_model(model: Element) -> list[dict[str, Any]]:
    """Return a model as a list of plain dicts, ready for JSON or TOML.

    A number is a fixed value, {"assumed": number} a default that the user did not give, "free" a
    parameter to estimate, a dict a free one with its start or bounds.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> describe_model(Dahl(sigma=30.0) + Mass(0.3))
    [{'kind': 'dahl', 'f_max': 'free', 'sigma': 30.0, 'alpha': {'assumed': 1.0}},
     {'kind': 'mass', 'mass': 0.3}]
    """
    return [_describe(element) for element in as_model(model).elements]


def model_from_description(description: Sequence[Mapping[str, Any]], where: str = "model") -> Model:
    """Return the model that :func:`describe_model` described; messages call the list `where`.

    Examples
    --------
    >>> model_from_description([{"kind": "spring", "stiffness": "free"}])
    Spring(stiffness=free)
    """
    if not isinstance(description, Iterable):
        raise ModelError(f"the model is {description!r}; expected a list of elements")
    elements = []
    for i, entry in enumerate(description):
        try:
            elements.append(_build(entry))
        except (ModelError, ValidationError) as exc:
            raise type(exc)(f"{where}[{i}]: {exc}") from exc
    return Model(*elements)


def _describe(element: Element) -> dict[str, Any]:
    if element.kind not in KINDS:
        raise ModelError(
            f"{element!r} cannot be written to a file; give its class a kind, such as "
            'kind = "my_law"'
        )
    return element.describe()


def _build(entry: Mapping[str, Any]) -> Element:
    if not isinstance(entry, Mapping):
        raise ModelError(f"the element is {entry!r}; expected its kind and values by name")
    content = dict(entry)
    kind = content.pop("kind", None)
    cls = class_named(str(kind))
    if cls is None:
        raise ModelError(
            f"the element {dict(entry)} has the kind {kind!r}; expected a law of your own, "
            "whose file was imported or given as laws (on the command line --laws), or one of "
            f"{choices(KINDS, str(kind))}"
        )
    name = content.pop("name", None)
    return cls.from_description(content, name)

"""Models: elements in parallel. Also models as plain data, for files of results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.elements.facts import HistoryGradient, Path, Sine, StiffnessGradient, Values
from dahl_ident.elements.law_files import KINDS, class_named
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError, ValidationError, choices

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


def model_from_description(description: list[Mapping[str, Any]]) -> Model:
    """Return the model that :func:`describe_model` described.

    Examples
    --------
    >>> model_from_description([{"kind": "spring", "stiffness": "free"}])
    Spring(stiffness=free)
    """
    return Model(*(_build(entry) for entry in description))


def _describe(element: Element) -> dict[str, Any]:
    if element.kind not in KINDS:
        raise ModelError(
            f"{element!r} cannot be written to a file; give its class a kind, such as "
            'kind = "my_law"'
        )
    return element.describe()


def _build(entry: Mapping[str, Any]) -> Element:
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

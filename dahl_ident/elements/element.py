"""What every element of a model provides: its dynamic stiffness, derivatives, force and facts."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    import casadi as ca

    from dahl_ident.elements.model import Model

Scalar = TypeVar("Scalar", bound=np.generic)

_STEP = 1e-3
_STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -2.0 / 3.0), (1.0, 2.0 / 3.0), (2.0, -1.0 / 12.0))
"""Central difference of fourth order: places and weights."""


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


class HistoryGradient(NamedTuple):
    """A force over time with its first derivatives; all of one shape.

    Attributes
    ----------
    value : ndarray
        Force, N.
    by_state : ndarray
        Derivative by the force at the first sample; zero without memory.
    by_parameter : tuple of ndarray
        Derivative by each parameter of the element, in the order of its `parameters`.
    """

    value: FloatArray
    by_state: FloatArray
    by_parameter: tuple[FloatArray, ...]


class Mechanics(NamedTuple):
    """An element's part in an equation of motion: numbers, arrays or casadi symbols.

    Attributes
    ----------
    inertia
        What multiplies the acceleration, kg.
    force
        The rest of the force, N.
    rate
        Its change over time, N/s, for an element with memory; 0 for others.
    """

    inertia: Any
    force: Any
    rate: Any


@dataclass(frozen=True)
class Asymptote:
    """A limit of an element in which some parameters run away and fewer numbers remain.

    Parameters
    ----------
    name : str
        Such as "gross_slip".
    meaning : str
        What the element is in this limit, a few words.
    pinned : mapping of str to float
        Values, by label, so far out that the element is its limit.
    follows : (str, str, float) or None
        ``label = factor * other``: a parameter that stays at a fixed ratio to another one.
    runs_away : mapping of str to float
        The parameters that the data no longer determine and where they go, 0 or inf.
    kept : tuple of (str, mapping of str to float)
        Combinations that stay determined: expression, and the power of each label in it.
    adds_to_spring : str or None
        A label whose value shows only in the sum with the stiffness of a free spring beside it;
        the limit exists only beside such a spring.
    """

    name: str
    meaning: str
    pinned: Mapping[str, float]
    follows: tuple[str, str, float] | None
    runs_away: Mapping[str, float]
    kept: tuple[tuple[str, Mapping[str, float]], ...] = ()
    adds_to_spring: str | None = None


class Combination(NamedTuple):
    """A product of powers of parameters that data may determine where single ones are lost."""

    expression: str
    powers: Mapping[str, float]
    meaning: str


class UniversalCurve(NamedTuple):
    """N over a stiffness as a function of beta alone, whatever the scale parameters.

    Parameters
    ----------
    stiffness : float
        What N is divided by, N/m.
    response : callable
        h(beta), for an array of beta.
    """

    stiffness: float
    response: Callable[[FloatArray], ComplexArray]


class Element(ABC):
    """Part of a mechanism: Z(A, omega) = F/X, its share of the dynamic stiffness.

    Elements act in parallel: ``+`` adds their forces at one displacement. A number given to an
    element fixes that parameter; one left out is free, to be estimated. A subclass with a `kind`
    of its own is known to files by it.

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
        True: beside a passive linear part the response to a sine force is unique, because
        A abs(L + N(A)) rises with A.
    parameters : tuple of Parameter
        In the order of the constructor: declarations on the class, with values on an element.
    linear_parameters : tuple of str
        Labels in each of which the force is proportional, the others held.
    scale_parameters : tuple of str
        Labels that scale the whole force when multiplied together by one factor.
    softens : bool
        True: Re N falls with the amplitude, whatever the values.
    holds_at_rest : bool
        True: a displacement held constant may take a force.
    """

    kind: ClassVar[str] = ""
    equation: str = ""
    is_linear: bool = False
    rate_independent: bool = True
    has_memory: bool = False
    unique_response: bool = False
    parameters: tuple[Parameter, ...] = ()
    linear_parameters: tuple[str, ...] = ()
    scale_parameters: tuple[str, ...] = ()
    softens: bool = False
    holds_at_rest: bool = True
    _name: str | None = None
    _in_parallel: ClassVar[type[Model]]  # set where Model is defined, which builds on this class

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.__dict__.get("kind"):
            _register(cls)

    def _bind(self, given: Mapping[str, float | None], name: str | None) -> None:
        """Give the declared parameters their full names and values."""
        self._name = name
        self.parameters = tuple(
            declared.bound(prefixed(name, declared.name), given.get(declared.name, declared.value))
            for declared in type(self).parameters
        )

    @property
    def name(self) -> str | None:
        """The element's name, which prefixes its parameters, or None."""
        return self._name

    def label(self, parameter: Parameter) -> str:
        """Return a parameter's name without the element's prefix."""
        return parameter.name.removeprefix(f"{self.name}_") if self.name else parameter.name

    @property
    def labels(self) -> tuple[str, ...]:
        """The parameters' names without the element's prefix."""
        return tuple(self.label(p) for p in self.parameters)

    def parameter(self, label: str) -> Parameter:
        """Return the parameter called `label` within this element."""
        if label not in self.labels:
            raise ModelError(f"{self!r} has no parameter {label}; it has {', '.join(self.labels)}")
        return self.parameters[self.labels.index(label)]

    def named(self, expression: str) -> str:
        """Return an expression of labels with the parameters' full names."""
        for label, parameter in zip(self.labels, self.parameters, strict=True):
            expression = re.sub(rf"\b{label}\b", parameter.name, expression)
        return expression

    @abstractmethod
    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1 at the parameter `values`, unchecked; all arguments broadcast.

        `harmonic` 0 is the mean force over the amplitude.
        """

    @abstractmethod
    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives by amplitude and by each parameter, unchecked."""

    def stiffness_slope(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return F/X of the fundamental and its derivative by amplitude, unchecked."""
        found = self.stiffness_gradient(values, amplitude, omega)
        return found.value, found.by_amplitude

    def normalised(
        self, values: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray, Sequence[FloatArray]]:
        """Return units of force and stiffness in which the law has fewer numbers, and those.

        ``N(A; values) = stiffness * N(A stiffness/force; numbers)``. One and the values
        themselves where a law has no such units.
        """
        return np.ones(()), np.ones(()), values

    @abstractmethod
    def force_history(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> FloatArray:
        """Return the force at every sample of one history, unchecked; `state` is the first."""

    def force_history_gradient(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, unchecked.

        By central differences of fourth order, where an element has nothing better.
        """
        at = [float(v) for v in values]

        def force(vector: Sequence[float], start: float) -> FloatArray:
            return self.force_history(
                vector, displacement, velocity, start, acceleration=acceleration
            )

        value = force(at, state)
        slopes = []
        for i, size in enumerate(at):
            step = _STEP * (abs(size) or 1.0)
            moved = [(w, [*at[:i], size + k * step, *at[i + 1 :]]) for k, w in _STENCIL]
            slopes.append(np.asarray(sum(w / step * force(v, state) for w, v in moved)))
        step = _STEP * float(np.max(np.abs(value), initial=0.0)) or 1.0
        by_state = np.zeros(value.shape)
        if self.has_memory:
            by_state = np.asarray(
                sum(w / step * force(at, state + k * step) for k, w in _STENCIL), dtype=np.float64
            )
        return HistoryGradient(value, by_state, tuple(slopes))

    def mechanics(
        self, values: Sequence[Any], displacement: Any, velocity: Any, direction: Any, force: Any
    ) -> Mechanics:
        """Return the part in an equation of motion, in plain arithmetic.

        `direction` is the sign of the velocity, `force` the present force of an element with
        memory.
        """
        raise ModelError(
            f"{self!r} has no equation of motion, so it cannot be driven by a force over time; "
            "give records with measured displacement and force"
        )

    def steady_force(
        self, values: Sequence[FloatArray], path: FloatArray, cycles: int
    ) -> FloatArray:
        """Return the force along closed paths of displacement, shape (..., n), unchecked.

        Every path is run through `cycles` times; the last time counts.
        """
        steps = path.shape[-1]
        every = np.broadcast_arrays(*(np.asarray(v) for v in values), path[..., 0])
        force = np.empty(path.shape)
        for i in np.ndindex(path.shape[:-1]):
            own = [float(v[i]) for v in every[:-1]]
            force[i] = self.force_history(own, np.tile(path[i], cycles))[-steps:]
        return force

    def rational_stiffness(self) -> tuple[FloatArray, FloatArray] | None:
        """Return numerator and denominator of Z(s), from the highest power of s down.

        None for an element that is not linear.

        Raises
        ------
        ModelError
            If a parameter has no value, or Z is no rational function of s.
        """
        return None

    def system_at(self, values: Sequence[float]) -> Any:
        """Return the python-control system that the element was made from, or None."""
        return None

    def branch(
        self, values: Sequence[float], start: FloatArray | float, path: FloatArray
    ) -> FloatArray | None:
        """Return the force on the way up from `start`, in closed form, and its slope, (2, n).

        `path` is the displacement since then, m, and may be below 0. A law whose two directions
        are alike answers; None from any other.
        """
        return None

    def force_bounds(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return what abs(N) and A abs(N) never exceed, over all amplitudes; inf where nothing."""
        return np.full((), np.inf), np.full((), np.inf)

    def knee(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return amplitudes between which N changes, m; NaN for a linear element."""
        return np.full((), np.nan), np.full((), np.nan)

    def answers(self, harmonic: int) -> bool:
        """Return whether a sine of displacement may give the force this harmonic, at any values.

        A linear element answers with the fundamental alone, a law that is the same in both
        directions with odd harmonics.
        """
        return harmonic == 1 if self.is_linear else harmonic % 2 == 1

    def transient_decay(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation from the steady loop shrinks in one cycle."""
        return np.zeros(np.broadcast_shapes(np.shape(amplitude), np.shape(omega)))

    def casadi_stiffness(
        self, values: Sequence[ca.SX], amplitude: ca.SX, omega: ca.SX, harmonic: int = 1
    ) -> tuple[ca.SX, ca.SX]:
        """Return real and imaginary part of F_k/X_1 as casadi expressions."""
        raise ModelError(
            f"{self!r} cannot be written as a casadi expression; use a method other than ipopt"
        )

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limits at infinity that this law declares, for amplitudes low to high, m."""
        return ()

    def combinations(self) -> tuple[Combination, ...]:
        """Return products of powers that data may determine where single parameters are lost."""
        return ()

    def alternatives(self) -> dict[str, tuple[Element, ...]]:
        """Return, by a few words, what is usually tried in place of this element."""
        return {}

    def universal_curve(self) -> UniversalCurve | None:
        """Return the curve that all values of the scale parameters follow, or None."""
        return None

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return what speaks against the values physically, in words; empty where nothing."""
        return ()

    def tabulated(self) -> Element:
        """Return this element, or a faster variant of it for very many evaluations."""
        return self

    def describe(self) -> dict[str, Any]:
        """Return kind, name and parameters as plain data."""
        name = {"name": self.name} if self.name else {}
        parameters = {self.label(p): p.describe() for p in self.parameters}
        return {"kind": self.kind, **name, **parameters}

    @classmethod
    def from_description(cls, rest: Mapping[str, Any], name: str | None) -> Element:
        """Return the element that :meth:`describe` described; `rest` has neither kind nor name."""
        element: Element = cls(name=name)  # type: ignore[call-arg]  # every element takes a name
        return element._described(rest)

    def _described(self, rest: Mapping[str, Any]) -> Self:
        """Return this element with the parameters that plain data describe, by label."""
        known = self.labels
        unknown = [label for label in rest if label not in known]
        if unknown:
            raise ModelError(
                f"the {self.kind} element has the keys {', '.join(unknown)}; expected "
                f"{', '.join(known)}"
            )
        return self.with_bound(
            tuple(
                p.described(rest[label]) if label in rest else p
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
            m; between samples the motion is taken as monotone.
        initial_force : float, default 0
            Force at the first sample, N; for an element with memory.
        velocity, acceleration : array_like, shape (n,), optional
            m/s and m/s^2; needed where the element depends on them.
        time : array_like, shape (n,), optional
            s; gives the velocity and acceleration that are left out, by central differences.

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
        if x.ndim > 1:
            raise ValidationError(
                f"displacement has shape {x.shape}; expected one history, shape (n,)"
            )
        values = [float(v) for v in self.known_values()]
        start = finite_number(initial_force, "initial_force")
        self._check_start(values, start)
        v, a = (
            None if given is None else np.atleast_1d(motion(given, name, x, self))
            for given, name in ((velocity, "velocity"), (acceleration, "acceleration"))
        )
        if time is not None and x.size > 1:
            t = motion(time, "time", x, self)
            if np.any(np.diff(t) <= 0.0):
                raise ValidationError("time does not rise from sample to sample")
            v = np.gradient(x, t) if v is None else v
            a = np.gradient(v, t) if a is None else a
        force = self.force_history(values, np.atleast_1d(x), v, start, acceleration=a)
        return force if x.ndim else force[0]

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        """Refuse an initial force that the element cannot have."""
        if initial_force and not self.has_memory:
            raise ValidationError(
                f"initial_force is {initial_force!r}, but {self!r} has no memory; leave it out"
            )

    def known_values(self) -> tuple[FloatArray, ...]:
        """Return the value of every parameter, or name those that have none."""
        missing = [p.name for p in self.parameters if p.value is None]
        if missing:
            raise ModelError(
                f"{self!r} has no value for {', '.join(missing)}; "
                "give a number to evaluate the model, or estimate it with fit"
            )
        return tuple(np.asarray(p.value) for p in self.parameters)

    def with_bound(self, parameters: tuple[Parameter, ...]) -> Self:
        """Return a copy of this element with other values, bounds or free flags."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__)
        copy.parameters = parameters
        return copy

    def __add__(self, other: Element) -> Model:
        """Put two elements, or sums of elements, in parallel."""
        if not isinstance(other, Element):
            return NotImplemented
        return self._in_parallel(self, other)

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


def central_differences(
    function: Callable[..., NDArray[Scalar]],
    arguments: Sequence[FloatArray],
    index: int,
    shape: tuple[int, ...],
) -> NDArray[Scalar]:
    """Return the derivative of a function of arrays by one of them, to fourth order."""
    size = np.asarray(arguments[index], dtype=np.float64)
    step = _STEP * np.where(size == 0.0, 1.0, np.abs(size))
    places = [place for place, _ in _STENCIL]
    ndim = len(shape)
    stacked = size.reshape((1,) * (ndim - size.ndim) + size.shape)
    by = np.asarray(places).reshape((-1,) + (1,) * ndim) * step.reshape(stacked.shape)
    moved = [*arguments[:index], stacked + by, *arguments[index + 1 :]]
    values = np.broadcast_to(function(*moved), (len(places), *shape))
    weights = np.asarray([weight for _, weight in _STENCIL])
    return np.asarray(np.tensordot(weights, values, axes=1) / step)


KINDS: dict[str, type[Element]] = {}
"""Every element class by the name that files and the command line know it by."""


def _register(cls: type[Element]) -> None:
    known = KINDS.get(cls.kind)
    if known is not None and (known.__module__, known.__qualname__) != (
        cls.__module__,
        cls.__qualname__,
    ):
        raise ModelError(
            f"{cls.__name__} has the kind {cls.kind!r}, which {known.__module__}."
            f"{known.__qualname__} has already; choose another"
        )
    KINDS[cls.kind] = cls


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

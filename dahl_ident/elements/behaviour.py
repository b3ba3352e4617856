"""What every element answers: stiffness, derivatives, force and facts, in plain numbers.

Nothing is checked here; :class:`dahl_ident.Element` adds names, files, sums and checked calls.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
)
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError

Scalar = TypeVar("Scalar", bound=np.generic)

STEP = 1e-3  # relative: truncation, its fourth power, and rounding are then both below 1e-12
STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -2.0 / 3.0), (1.0, 2.0 / 3.0), (2.0, -1.0 / 12.0))
"""Central difference of fourth order: places and weights."""

SOFTENED = 0.01  # share of the stiffness that is gone at the lower knee: seen in data of 1 % noise


def clipped(value: Any, limit: Any) -> Any:
    """Return a value between -limit and limit, in arithmetic that symbols have too."""
    return 0.5 * (np.fabs(value + limit) - np.fabs(value - limit))


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
        Derivative with respect to the force at the first sample; zero without memory.
    by_parameter : tuple of ndarray
        Derivative with respect to each parameter of the element, in the order of its `parameters`.
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
    rates
        Changes over time of the element's states, one each.
    """

    inertia: Any
    force: Any
    rates: Sequence[Any] = ()


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
        A label whose value shows only in the sum with the stiffness of a free spring in parallel;
        the limit exists only with such a spring.
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


class Behaviour(ABC):
    """The mathematics of an element, with defaults for what a law does not override."""

    kind: ClassVar[str] = ""
    equation: str = ""
    is_linear: bool = False
    rate_independent: bool = True
    has_memory: bool = False
    unique_response: bool = False
    parameters: tuple[Parameter, ...] = ()
    linear_parameters: tuple[str, ...] = ()
    scale_parameters: tuple[str, ...] = ()
    like_parts: tuple[tuple[str, ...], ...] = ()
    softens: bool = False
    holds_at_rest: bool = True
    start: tuple[str, str, str] = ("initial_force", "N", "friction at the first sample")
    """Name, unit and meaning of the unknown from which the states of a driven motion start."""
    _name: str | None = None

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
        """Return F/X of the fundamental and its derivative with respect to amplitude, unchecked."""
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
            step = STEP * (abs(size) or 1.0)
            moved = [(w, [*at[:i], size + k * step, *at[i + 1 :]]) for k, w in STENCIL]
            slopes.append(np.asarray(sum(w / step * force(v, state) for w, v in moved)))
        step = STEP * float(np.max(np.abs(value), initial=0.0)) or 1.0
        by_state = np.zeros(value.shape)
        if self.has_memory:
            by_state = np.asarray(
                sum(w / step * force(at, state + k * step) for k, w in STENCIL), dtype=np.float64
            )
        return HistoryGradient(value, by_state, tuple(slopes))

    def mechanics(
        self,
        values: Sequence[Any],
        displacement: Any,
        velocity: Any,
        direction: Any,
        states: Sequence[Any],
    ) -> Mechanics:
        """Return the part in an equation of motion, in plain arithmetic.

        `direction` is the sign of the velocity, `states` what :attr:`n_states` counts: the
        present force of an element with memory, where it needs no more.
        """
        raise ModelError(
            f"{self!r} has no equation of motion, so it cannot be driven by a force over time; "
            "give records with measured displacement and force"
        )

    @property
    def n_states(self) -> int:
        """States in an equation of motion."""
        return int(self.has_memory)

    @property
    def has_inertia(self) -> bool:
        """Whether a force determines the motion of the element."""
        return any(p.is_mass for p in self.parameters)

    def sampled(self, interval: float) -> Self:
        """Return this element for histories of one sampling interval, s."""
        return self

    def free_responses(self, samples: int) -> FloatArray:
        """Return the force from each state of a linear element at the first sample, (n, states)."""
        return np.zeros((samples, 0))

    def initial_states(self, values: Sequence[Any], start: Any) -> Sequence[Any]:
        """Return the states at the first sample, in plain arithmetic, from :attr:`start` there.

        The states of an element without memory are unknowns themselves.
        """
        return (start,) * self.n_states

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
            If a parameter has no value, or Z is not a rational function of s.
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

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limits at infinity that this law declares, for amplitudes low to high, m."""
        return ()

    def combinations(self) -> tuple[Combination, ...]:
        """Return products of powers that data may determine where single parameters are lost."""
        return ()

    def universal_curve(self) -> UniversalCurve | None:
        """Return the curve that all values of the scale parameters follow, or None."""
        return None

    def resembles(
        self, values: Sequence[float], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[str, float] | None:
        """Return a simpler law and how far its best N is from this one's at some levels, rms.

        None from a law that has no such relative.
        """
        return None

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return what speaks against the values physically, in words; empty where nothing."""
        return ()

    def known_values(self) -> tuple[FloatArray, ...]:
        """Return the value of every parameter, or name those that have none."""
        missing = [p.name for p in self.parameters if p.value is None]
        if missing:
            raise ModelError(
                f"{self!r} has no value for {', '.join(missing)}; "
                "give a number to evaluate the model, or estimate it with fit"
            )
        return tuple(np.asarray(p.value) for p in self.parameters)


def central_differences(
    function: Callable[..., NDArray[Scalar]],
    arguments: Sequence[FloatArray],
    index: int,
    shape: tuple[int, ...],
) -> NDArray[Scalar]:
    """Return the derivative of a function of arrays by one of them, to fourth order."""
    size = np.asarray(arguments[index], dtype=np.float64)
    step = STEP * np.where(size == 0.0, 1.0, np.abs(size))
    places = [place for place, _ in STENCIL]
    ndim = len(shape)
    stacked = size.reshape((1,) * (ndim - size.ndim) + size.shape)
    by = np.asarray(places).reshape((-1,) + (1,) * ndim) * step.reshape(stacked.shape)
    moved = [*arguments[:index], stacked + by, *arguments[index + 1 :]]
    values = np.broadcast_to(function(*moved), (len(places), *shape))
    weights = np.asarray([weight for _, weight in STENCIL])
    return np.asarray(np.tensordot(weights, values, axes=1) / step)

"""The mathematics of every element: stiffness, derivatives, force and facts, in plain numbers.

Nothing is checked here; :class:`dahl_ident.Element` adds names, files, sums and checked calls.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.facts import (
    Alternative,
    Asymptote,
    Combination,
    HistoryGradient,
    Mechanics,
    Orders,
    Path,
    Sine,
    StiffnessGradient,
    UniversalCurve,
    Values,
)
from dahl_ident.elements.parameter import Parameter
from dahl_ident.errors import ModelError


class Behaviour(ABC):
    """The mathematics of an element, with defaults for what a law does not override.

    A law defines :meth:`settled`; :meth:`history` and :meth:`mechanics` if it has a force over
    time; and facts.
    """

    kind: ClassVar[str] = ""
    equation: str = ""
    is_linear: bool = False
    rate_independent: bool = True
    has_memory: bool = False
    unique_response: bool = False
    parameters: tuple[Parameter, ...] = ()
    optional: ClassVar[tuple[Parameter, float] | None] = None
    linear_parameters: tuple[str, ...] = ()
    scale_parameters: tuple[str, ...] = ()
    like_parts: tuple[tuple[str, ...], ...] = ()
    softens: bool = False
    holds_at_rest: bool = True
    starts: tuple[tuple[str, str, str], ...] = (
        ("initial_force", "N", "friction at the first sample"),
    )
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

    def known_values(self) -> tuple[FloatArray, ...]:
        """Return the value of every parameter, or name those that have none."""
        missing = [p.name for p in self.parameters if p.value is None]
        if missing:
            raise ModelError(
                f"{self!r} has no value for {', '.join(missing)}; "
                "give a number to evaluate the model, or estimate it with fit"
            )
        return tuple(np.asarray(p.value) for p in self.parameters)

    @abstractmethod
    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 at the parameter `values`, unchecked; all arguments broadcast.

        With as many `derivatives` as are asked for: 0 none, 1 that with respect to the amplitude,
        2 those with respect to the parameters too.
        """

    def stiffness(
        self, values: Values, amplitude: FloatArray, omega: FloatArray, harmonic: Orders = 1
    ) -> ComplexArray:
        """Return F_k/X_1, unchecked; `harmonic` 0 is the mean force over the amplitude."""
        return self.settled(values, Sine(amplitude, omega, harmonic), 0).value

    def stiffness_gradient(
        self, values: Values, amplitude: FloatArray, omega: FloatArray, harmonic: Orders = 1
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, over amplitude and each parameter, unchecked."""
        return self.settled(values, Sine(amplitude, omega, harmonic), 2)

    def answers(self, harmonic: int) -> bool:
        """Return whether a sine of displacement may give the force this harmonic, at any values.

        A linear element answers with the fundamental alone, a law that is the same in both
        directions with odd harmonics.
        """
        return harmonic == 1 if self.is_linear else harmonic % 2 == 1

    def normalised(self, values: Values) -> tuple[FloatArray, FloatArray, Values]:
        """Return units of force and stiffness in which the law has fewer numbers, and those.

        ``N(A; values) = stiffness * N(A stiffness/force; numbers)``. One and the values
        themselves where a law has no such units.
        """
        return np.ones(()), np.ones(()), values

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, unchecked.

        `state` is the unknown at the first sample: the force there, in most laws. Without `slopes`
        the derivatives are not looked at.
        """
        raise ModelError(f"{self!r} has no force over time")

    def force_history(
        self,
        values: Sequence[Any],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
        time: FloatArray | None = None,
    ) -> FloatArray:
        """Return the force at every sample of one history, unchecked; `state` is the first."""
        path = Path(displacement, velocity, acceleration, time)
        return self.history(values, path, state, slopes=False).value

    def force_history_gradient(
        self,
        values: Sequence[Any],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
        time: FloatArray | None = None,
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, unchecked."""
        path = Path(displacement, velocity, acceleration, time)
        return self.history(values, path, state, slopes=True)

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the part in an equation of motion, in plain arithmetic.

        `x` is the displacement, `direction` the sign of the velocity, `states` what
        :attr:`n_states` counts: the present force of an element with memory, where it needs no
        more.
        """
        raise ModelError(
            f"{self!r} has no equation of motion, so it cannot be driven by a force over time; "
            "give records with measured displacement and force"
        )

    @property
    def inside(self) -> tuple[Any, ...]:
        """Elements of which this one is made, such as that behind a gap."""
        return ()

    @property
    def n_states(self) -> int:
        """States in an equation of motion."""
        return int(self.has_memory)

    @property
    def has_inertia(self) -> bool:
        """Whether a force determines the motion of the element."""
        return any(p.is_mass for p in self.parameters)

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the states at the first sample, in plain arithmetic, from the unknowns there.

        The states of an element without memory are unknowns themselves.
        """
        return starts

    def start_with(self, values: Sequence[Any], force: float) -> float:
        """Return the unknown at the first sample with which a history starts with a force."""
        return force

    def coarser(self) -> Self:
        """Return this element, or one whose motion under a force costs less and is nearly alike."""
        return self

    def free_responses(self, time: FloatArray) -> FloatArray:
        """Return the force from each state of a linear element at the first sample, (n, states)."""
        return np.zeros((time.size, 0))

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of abs(N) and A abs(N) over all amplitudes; inf if unbounded."""
        return np.full((), np.inf), np.full((), np.inf)

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return amplitudes between which N changes, m; NaN for a linear element."""
        return np.full((), np.nan), np.full((), np.nan)

    def transient_decay(
        self, values: Values, amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation from the steady loop shrinks in one cycle."""
        return np.zeros(np.broadcast_shapes(np.shape(amplitude), np.shape(omega)))

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limits at infinity that this law declares, for amplitudes low to high, m."""
        return ()

    def combinations(self) -> tuple[Combination, ...]:
        """Return products of powers that data may determine where single parameters are lost."""
        return ()

    def alternatives(self, values: Sequence[float], smallest: float) -> dict[str, Alternative]:
        """Return, by a few words, what is tried in place of this element; started at `values`.

        `smallest` is the smallest amplitude measured, m.
        """
        return {}

    def universal_curve(self) -> UniversalCurve | None:
        """Return the curve that all values of the scale parameters follow, or None."""
        return None

    def resembles(
        self, values: Sequence[float], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[str, float] | None:
        """Return a simpler law and how far its best N is from this one's at some levels, rms.

        None for a law without a simpler one.
        """
        return None

    def resolved(self, values: Values, amplitude: FloatArray) -> Values:
        """Return the values with those that no longer matter at an amplitude held where they do."""
        return values

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return the physical objections to the values, in words."""
        return ()

    def rational_stiffness(self) -> tuple[FloatArray, FloatArray] | None:
        """Return numerator and denominator of Z(s), from the highest power of s down.

        None for an element that is not linear.
        """
        return None

    def system_at(self, values: Sequence[float]) -> Any:
        """Return the python-control system that the element was made from, or None."""
        return None

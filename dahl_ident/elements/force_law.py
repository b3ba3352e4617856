"""The interface of every element. Its methods take plain numbers, and do not check them."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray, finite_array
from dahl_ident.elements.facts import (
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
from dahl_ident.errors import ModelError, ValidationError, choices


class ForceLaw(ABC):
    """The relation of a force to a displacement: its parameters, its facts and its mathematics.

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
        True: the force depends on the history of displacement.
    unique_response : bool
        True: in parallel with a passive linear part the response to a sine force is unique, because
        A abs(L + N(A)) rises with A.
    name : str or None
        The element's name, which prefixes those of its parameters.
    parameters : tuple of Parameter
        In the order of the constructor: declarations on the class, with values on an element.
    optional : (Parameter, float) or None
        A parameter that not every element has, and the argument that leaves it out.
    linear_parameters : tuple of str
        Labels of parameters in which the force is linear.
    scale_parameters : tuple of str
        Labels of parameters: if all are multiplied by one factor, so is the force.
    like_parts : tuple of tuple of str
        Labels of each of several interchangeable parts; estimates are ordered by the first label.
    softens : bool
        True: Re N falls with the amplitude, whatever the values.
    holds_at_rest : bool
        True: holding a constant displacement may take a force.
    starts : tuple of (str, str, str)
        Name, unit and meaning of each unknown that determines the states at the first sample.
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
    name: str | None = None

    def _bind(self, arguments: Mapping[str, float | None], name: str | None) -> None:
        """Give the declared parameters their full names and values."""
        self.name = name
        declared = type(self).parameters
        if self.optional and arguments[self.optional[0].name] != self.optional[1]:
            declared = (*declared, self.optional[0])
        self.parameters = tuple(
            p.bound(prefixed(name, p.name), arguments.get(p.name, p.value)) for p in declared
        )

    @property
    def has_optional(self) -> bool:
        """Whether the element has its optional parameter."""
        return self.optional is not None and self.optional[0].name in self.labels

    def copy_with(self, parameters: tuple[Parameter, ...]) -> Self:
        """Return a copy of this element with other values, bounds or free flags."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__)
        copy.parameters = parameters
        return copy

    def started_at(self, values: Sequence[float]) -> Self:
        """Return this element with start values for its free parameters."""
        return self.copy_with(
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
    def from_description(cls, description: Mapping[str, Any], name: str | None) -> Self:
        """Return the element that :meth:`describe` described, here without its kind and name."""
        options: dict[str, Any] = {"name": name}
        if cls.optional and cls.optional[0].name in description:
            options[cls.optional[0].name] = None
        return cls(**options)._described(description)

    def _described(self, description: Mapping[str, Any]) -> Self:
        """Return this element with the parameters that plain data describe, by label."""
        unknown = [label for label in description if label not in self.labels]
        if unknown:
            raise ModelError(
                f"the {self.kind} element has the keys {', '.join(unknown)}; expected "
                f"{choices(self.labels, *unknown)}"
            )
        return self.copy_with(
            tuple(
                p.described(description[label]) if label in description else p
                for label, p in zip(self.labels, self.parameters, strict=True)
            )
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._arguments())})"

    def _arguments(self) -> list[str]:
        """Return the arguments as they are shown in `repr`."""
        arguments = [self._argument(p) for p in self.parameters]
        return [*arguments, f"name={self.name!r}"] if self.name else arguments

    def _argument(self, parameter: Parameter) -> str:
        """Return a parameter as it is shown in `repr`."""
        value = "free" if parameter.value is None else f"{parameter.value:g}"
        if parameter.free and parameter.value is not None:
            value += " free"
        return f"{self.label(parameter)}={value}"

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

        `derivatives` is 0 for none, 1 for that with respect to the amplitude, 2 for those with
        respect to the parameters too.
        """

    def stiffness(
        self, values: Values, amplitude: FloatArray, omega: FloatArray, harmonic: Orders = 1
    ) -> ComplexArray:
        """Return F_k/X_1, unchecked; `harmonic` 0 is the mean force over the amplitude."""
        return self.settled(values, Sine(amplitude, omega, harmonic), 0).value

    def stiffness_gradient(
        self, values: Values, amplitude: FloatArray, omega: FloatArray, harmonic: Orders = 1
    ) -> StiffnessGradient:
        """Return F_k/X_1 with all its derivatives, unchecked."""
        return self.settled(values, Sine(amplitude, omega, harmonic), 2)

    def has_harmonic(self, harmonic: int) -> bool:
        """Return whether the force may have this harmonic under a sinusoidal displacement.

        The force of a linear element has only the fundamental, that of a law that is the same in
        both directions only odd harmonics.
        """
        return harmonic == 1 if self.is_linear else harmonic % 2 == 1

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, unchecked.

        `state` is the unknown at the first sample: in most laws, the force there. Without `slopes`
        the derivatives need not be right.
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
        """Return the force alone of :meth:`history`."""
        path = Path(displacement, velocity, acceleration, time)
        return self.history(values, path, state, slopes=False).value

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the element's part in an equation of motion, in plain arithmetic.

        `x` is the displacement, `direction` the sign of the velocity. There are :attr:`n_states`
        `states`: in most laws with memory one, the present force.
        """
        raise ModelError(
            f"{self!r} has no equation of motion",
            "it cannot be driven by a force over time: give records with measured displacement "
            "and force",
        )

    @property
    def inner_elements(self) -> tuple[Any, ...]:
        """Elements that this one contains, such as that behind a gap."""
        return ()

    @property
    def n_states(self) -> int:
        """Number of states in an equation of motion."""
        return int(self.has_memory)

    @property
    def has_inertia(self) -> bool:
        """Whether a force determines the motion of the element; a mass of 0 is none."""
        return any(p.is_mass and (p.free or p.value != 0.0) for p in self.parameters)

    def initial_states(self, values: Sequence[Any], starts: Sequence[Any]) -> Sequence[Any]:
        """Return the states at the first sample, given its unknowns, in plain arithmetic.

        The unknowns of a linear element are its states.
        """
        return starts

    def start_with(self, values: Sequence[Any], force: float) -> float:
        """Return the unknown at the first sample for which the force there is `force`."""
        return force

    def coarser(self) -> Self:
        """Return this element, or an approximation whose motion under a force is faster."""
        return self

    def free_responses(self, time: FloatArray) -> FloatArray:
        """Return a linear element's force due to a unit of each initial state, (n, states)."""
        return np.zeros((time.size, 0))

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of abs(N) and A abs(N) over all amplitudes; inf if unbounded."""
        return np.full((), np.inf), np.full((), np.inf)

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the amplitudes between which N changes, m; NaN for a linear element."""
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
        """Return products of powers that data may determine although their factors are not."""
        return ()

    def universal_curve(self) -> UniversalCurve | None:
        """Return the curve that N follows for all values of the scale parameters, or None."""
        return None

    def resembles(
        self, values: Sequence[float], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[str, float] | None:
        """Return a simpler law, if there is one, and the rms deviation of its best fit to this N.

        The deviation is relative, over levels of `amplitude` and `omega`.
        """
        return None

    def resolved(self, values: Values, amplitude: FloatArray) -> Values:
        """Return the values, each limited to the range in which it has an effect at `amplitude`."""
        return values

    def physical_objections(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return sentences that say why the values are physically impossible."""
        return ()

    def rational_stiffness(self) -> tuple[FloatArray, FloatArray] | None:
        """Return a linear element's numerator and denominator of Z(s), highest power first."""
        return None

    def system_at(self, values: Sequence[float]) -> Any:
        """Return the python-control system from which the element was made, or None."""
        return None


def prefixed(name: object, label: str) -> str:
    """Return the full name of the parameter `label` of an element called `name`."""
    if name is None:
        return label
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValidationError(
            f"name is {name!r}; expected letters, digits and underscores, such as 'pivot'"
        )
    return f"{name}_{label}"


def required_history(
    value: ArrayLike | None, name: str, displacement: FloatArray, element: ForceLaw
) -> FloatArray:
    """Return a history that an element needs, checked to be as long as `displacement`."""
    if value is None:
        raise ValidationError(f"{element!r} needs {name} to give its force; pass {name}=")
    history = finite_array(value, name)
    if history.shape != displacement.shape:
        raise ValidationError(
            f"{name} has shape {history.shape}; expected that of displacement, {displacement.shape}"
        )
    return history

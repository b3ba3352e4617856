"""Any linear system from python-control as an element: fixed, or with named free parameters.

A structure's linear part is often known as a transfer function, a state-space model or measured
frequency response data (FRD). Which of the six standard quantities its response R is has to be
stated; it is never guessed. FRD is interpolated, between its first and last frequency, by a cubic
spline of Z. This is exact for one mode; a spline of the receptance would overshoot the peak.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.columns import one_of
from dahl_ident.data.record import is_even
from dahl_ident.elements.element import Element
from dahl_ident.elements.facts import (
    STEP,
    HistoryGradient,
    Mechanics,
    Path,
    Sine,
    StiffnessGradient,
    Values,
    difference,
    each_harmonic,
)
from dahl_ident.elements.force_law import prefixed, required_history
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.rational import Rational, typical_rate
from dahl_ident.elements.recursion import matrix_recursion
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.units import DEFINITIONS, QUANTITIES, Quantity, converted

_VANISHES = 1e-12  # of the terms of a sum: below it the sum is 0 but for rounding
_UNSTABLE = 1e-9  # of the fastest pole: with a larger real part, a pole is unstable
_DESCRIPTIONS = (  # keys of a system as plain data
    ("omega", "real", "imag"),
    ("numerator", "denominator", "dt"),
    ("A", "B", "C", "D", "dt"),
)
_FORCE_OVER_MOTION = ("dynamic_stiffness", "mechanical_impedance", "apparent_mass")


class LinearSystem(Element):
    """Linear system in parallel with the other elements: Z(omega) from a python-control object.

    Parameters
    ----------
    system : control.TransferFunction, control.StateSpace, control.FRD or callable
        One input and one output; continuous, or discrete with a known sampling time. A
        callable takes the `parameters` by keyword and returns such a system.
    quantity : str
        The quantity that is the system's response: "receptance" (displacement over force),
        "mobility", "accelerance", "dynamic_stiffness" (force over displacement),
        "mechanical_impedance" or "apparent_mass".
    parameters : mapping of str to float, None or Parameter, optional
        Arguments of a callable `system`. A number fixes the argument; None leaves it free; a
        Parameter gives unit, bounds and search coordinate as well.
    name : str, optional
        Prefix of the parameters' names.

    Attributes
    ----------
    system : control.TransferFunction, control.StateSpace, control.FRD or callable
        As given.
    quantity : str
        As given.

    Raises
    ------
    ValidationError
        If `system` is none of these, has several inputs or outputs or no sampling time,
        `quantity` is unknown, or there are `parameters` without a callable, or the reverse.

    Notes
    -----
    A continuous system has an equation of motion: its Z(s) consists of a stiffness, a damper, a
    mass, and poles. So a receptance with inertia can be driven by a force without a `Mass`; an
    absorber needs one in parallel. In fits to records the states of its poles at the first sample
    are unknowns; if the force is fitted, the system's parameters must be fixed.

    Evaluating outside the frequencies of an FRD, above half a sampling rate, or where the response
    does not determine the stiffness, raises ValidationError. Derivatives with respect to the
    arguments of a callable are central differences of fourth order with steps of 1e-3 of the
    argument, accurate to about 1e-12 abs(Z/p) where Z is smooth; an argument of exactly 0 has no
    such step.

    Examples
    --------
    >>> import control
    >>> from dahl_ident import LinearSystem
    >>> plate = LinearSystem(control.tf([1], [0.3, 0.24, 0.3]), quantity="receptance")
    >>> complex(plate.dynamic_stiffness(1e-3, 10.0).round(10))
    (-29.7+2.4j)
    >>> def mode(mass, stiffness):
    ...     return control.tf([1], [mass, 0, stiffness])
    >>> LinearSystem(mode, quantity="receptance", parameters={"mass": 2, "stiffness": None})
    LinearSystem(receptance of mode, mass=2, stiffness=free)
    """

    kind = "linear_system"
    equation = "F = Z(j omega) X"
    is_linear = True
    rate_independent = False

    def __init__(
        self,
        system: Any,
        *,
        quantity: Quantity,
        parameters: Mapping[str, float | Parameter | None] | None = None,
        name: str | None = None,
    ) -> None:
        one_of(quantity, "quantity", QUANTITIES)
        arguments = dict(parameters or {})
        is_function = callable(system) and not _is_system(system)
        if is_function != bool(arguments):
            raise ValidationError(
                f"system is a {type(system).__name__} with the parameters {list(arguments)}; "
                "expected a python-control system without parameters, or a function of all of them"
            )
        self.name = name
        self.system = system
        self.quantity = quantity
        self.parameters = tuple(_parameter(prefixed(name, k), v) for k, v in arguments.items())
        self._last_curve: tuple[FloatArray, ComplexArray] | None = None
        self._last_equation: tuple[tuple[float, ...], Equation] | None = None
        if not is_function:
            check_system(system, "system")

    @each_harmonic
    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return Z(omega) with its derivatives; 0 for harmonics above the fundamental."""
        batch = np.broadcast_shapes(*(np.shape(v) for v in values))
        shape = np.broadcast_shapes(batch, np.shape(sine.omega))
        curves = self._curve_and_slopes if derivatives > 1 else self._curve
        table = np.zeros((1 + len(values) * (derivatives > 1), *shape), dtype=np.complex128)
        if sine.harmonic == 1:
            columns = [np.broadcast_to(v, batch).ravel() for v in values]
            vectors = np.reshape(columns, (len(values), math.prod(batch))).T
            which = np.broadcast_to(np.arange(len(vectors)).reshape(batch), shape)
            omega = np.broadcast_to(sine.omega, shape)
            for i, vector in enumerate(vectors.tolist()):
                rows = which == i
                finite = np.isfinite(vector).all()  # a search may try others
                table[:, rows] = curves(tuple(vector), omega[rows]) if finite else np.nan
        Z, *slopes = (row + 0.0 * sine.amplitude for row in table)
        return StiffnessGradient(Z, np.zeros_like(Z), tuple(slopes))

    def equation_at(self, values: Sequence[Any]) -> Equation:
        """Return the equation of motion at `values`, without poles and zeros that cancel."""
        vector = tuple(float(v) for v in values)
        if self._last_equation is None or self._last_equation[0] != vector:
            control = importlib.import_module("control")
            Z = self._rational(vector)
            minimal = control.tf(Z.numerator, Z.denominator).minreal()
            if minimal.den[0][0].size < Z.denominator.size:
                Z = Rational(minimal.num[0][0], minimal.den[0][0])
            rate = typical_rate(Z.denominator)
            equation = Equation(rate, Z.degrees[1], coefficients_of(Z, rate).tolist())
            self._last_equation = vector, equation
        return self._last_equation[1]

    @property
    def _equation(self) -> Equation:
        """The equation of motion of a fixed system."""
        if self._free_names:
            raise ModelError(
                f"{self!r} leaves {', '.join(self._free_names)} free, and only a fixed system has "
                "a force over time; fix it, fit the motion, or build what is unknown from Mass, "
                "Damper and Spring"
            )
        return self.equation_at(self.known_values())

    def _rational(self, values: Sequence[float]) -> Rational:
        """Return Z(s) without vanishing terms; refuse one that grows faster than a mass."""
        Z = Rational(*self.rational_stiffness(values)).without_common_zeros_at_0().trimmed()
        power = Z.degrees[0] - Z.degrees[1]
        if power > 2:
            raise ModelError(
                f"the dynamic stiffness of {self!r} grows as s^{power}",
                "an equation of motion allows s^2, a mass: give the system at its point of drive",
            )
        return Z

    def typical_stiffness(self) -> Rational:
        """Return Z(s) at values near those of the parameters, so that no term is 0 by chance."""
        shifts = np.random.default_rng(1).uniform(0.8, 1.2, len(self.parameters))
        near = [
            float(np.clip(shift * (1.0 if p.value is None else p.value), p.lower, p.upper))
            for p, shift in zip(self.parameters, shifts, strict=True)
        ]
        return self._rational(near)

    @property
    def _free_names(self) -> list[str]:
        return [p.name for p in self.parameters if p.free]

    @property
    def n_states(self) -> int:
        """Number of poles of the dynamic stiffness."""
        return self.typical_stiffness().degrees[1] if self._free_names else self._equation.order

    @property
    def has_inertia(self) -> bool:
        """Whether Z(s) grows as s^2."""
        if not self._free_names:
            return bool(self._equation.coefficients[2] != 0.0)
        above, below = self.typical_stiffness().degrees
        return above - below == 2

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return mass, the remaining force, and the rates of the states, in metres."""
        return self._equation.mechanics(x, velocity, states)

    def free_responses(self, time: FloatArray) -> FloatArray:
        """Return the force from a unit of each initial state, (n, states)."""
        equation = self._equation
        undriven = np.zeros((time.size - 1, 6))
        states = equation.states(self._step(time), undriven, np.eye(equation.order))
        return np.asarray(states @ equation.output)

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force, from rest; between samples the motion is a polynomial of degree 5.

        Its derivatives are 0: it has them only if all parameters are fixed.
        """
        equation = self._equation if slopes else self.equation_at(values)
        k, c, m = equation.coefficients[:3]
        x = path.displacement
        v = a = np.zeros(x.shape)
        if c or m or equation.order:
            v = required_history(path.velocity, "velocity", x, self)
        if m or equation.order:
            a = required_history(path.acceleration, "acceleration", x, self)
        force = np.asarray(k * x + c * v + m * a)
        if equation.order:
            poles = np.linalg.eigvals(equation.matrix)
            if np.any(poles.real > _UNSTABLE * np.abs(poles).max(initial=0.0)):
                raise ModelError(
                    f"under a prescribed displacement the force of {self!r} grows beyond all "
                    "bounds; give records in which a force drives a mass"
                )
            step = self._step(path.time)
            paths = Path(x, v, a).polynomials(np.full(x.size - 1, step)).T
            states = equation.states(step, paths, np.zeros((equation.order, 1)))
            force = np.asarray(force + states[:, 0] @ equation.output)
        zero = np.zeros(force.shape)
        return HistoryGradient(force, zero, (zero,) * len(self.parameters))

    def _step(self, time: FloatArray | None) -> float:
        """Return the sampling interval; refuse uneven times."""
        if time is None or not is_even(time):
            raise ValidationError(
                f"{self!r} needs evenly spaced times to give its force; pass time="
            )
        return float(time[-1] - time[0]) / (time.size - 1)

    def describe(self) -> dict[str, Any]:
        """Return quantity and system as plain data; refuse a function."""
        if self.parameters:
            raise ModelError(
                f"{self!r} is built by a function, which no file can hold; give it as a fixed "
                "python-control system"
            )
        control = importlib.import_module("control")
        system = self.system
        entry: dict[str, Any] = {"kind": self.kind, "quantity": self.quantity}
        if self.name:
            entry["name"] = self.name
        if isinstance(system, control.FRD):
            response = np.ravel(system(1j * np.asarray(system.omega)))
            return entry | {
                "omega": np.asarray(system.omega).tolist(),
                "real": response.real.tolist(),
                "imag": response.imag.tolist(),
            }
        entry["dt"] = system.dt or 0  # one without a time base is taken as continuous
        if isinstance(system, control.TransferFunction):
            numerator, denominator = system.num[0][0], system.den[0][0]
            return entry | {"numerator": numerator.tolist(), "denominator": denominator.tolist()}
        return entry | {key: np.asarray(getattr(system, key)).tolist() for key in "ABCD"}

    @classmethod
    def from_description(cls, description: Mapping[str, Any], name: str | None) -> LinearSystem:
        """Return the linear system that :meth:`describe` described."""
        control = importlib.import_module("control")
        keys = next((k for k in _DESCRIPTIONS if k[0] in description), _DESCRIPTIONS[-1])
        if description.keys() != {"quantity", *keys}:
            raise ModelError(
                f"the linear_system element has the keys {', '.join(description)}; expected "
                f"quantity with {', or with '.join(map(', '.join, _DESCRIPTIONS))}"
            )
        parts = [description[key] for key in keys]
        try:
            if "omega" in keys:
                omega, real, imag = map(np.asarray, parts)
                system = control.FRD(real + 1j * imag, omega)
            else:
                system = (control.StateSpace if "A" in keys else control.TransferFunction)(*parts)
        except Exception as exc:  # python-control raises errors of every kind
            raise ModelError(f"the linear_system element cannot be built: {exc}") from exc
        return cls(system, quantity=description["quantity"], name=name)

    def system_at(self, values: Sequence[float]) -> Any:
        """Return the python-control system at `values` of the parameters, in their order."""
        if not self.parameters:
            return self.system
        system = self.system(**dict(zip(self.labels, values, strict=True)))
        check_system(system, "system")
        return system

    def rational_stiffness(
        self, values: Sequence[float] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator of Z(s), highest power first.

        The parameters are at `values`, by default their own.
        """
        control = importlib.import_module("control")
        if values is None:
            values = [float(v) for v in self.known_values()]
        system = self.system_at(values)
        if isinstance(system, control.FRD) or not system.isctime():
            raise ModelError(
                f"{self!r} is not a rational function of s, and so has no equation of motion in "
                "continuous time",
                "give a continuous TransferFunction or StateSpace",
            )
        transfer = control.tf(system)
        numerator, denominator = (
            np.asarray(p[0][0], np.float64) for p in (transfer.num, transfer.den)
        )
        if isinstance(system, control.StateSpace):
            # its conversion leaves rounding errors in place of zeros
            numerator = numerator[max(0, numerator.size - _degree(system) - 1) :]
            sizes = np.abs(numerator) * typical_rate(denominator) ** np.arange(numerator.size)[::-1]
            numerator = np.where(sizes > _VANISHES * sizes.max(), numerator, 0.0)
        definition = DEFINITIONS[self.quantity]
        if definition.exponent < 0:
            numerator, denominator = denominator, numerator
        power = definition.power_in_stiffness
        return (
            np.append(numerator, np.zeros(max(power, 0))),
            np.append(denominator, np.zeros(max(-power, 0))),
        )

    def _curve(self, vector: tuple[float, ...], omega: FloatArray) -> ComplexArray:
        """Return Z at angular frequencies, shape (n,); for a fixed system, the last is kept."""
        if self.parameters:
            return dynamic_stiffness(self.system_at(vector), self.quantity, omega)
        if self._last_curve is None or not np.array_equal(self._last_curve[0], omega):
            self._last_curve = omega.copy(), dynamic_stiffness(self.system, self.quantity, omega)
        return self._last_curve[1]

    def _curve_and_slopes(self, vector: tuple[float, ...], omega: FloatArray) -> ComplexArray:
        slopes = differences(lambda moved: self._curve(moved, omega), vector, self.labels)
        return np.stack([self._curve(vector, omega), *slopes])

    def _arguments(self) -> list[str]:
        system = getattr(self.system, "__name__", type(self.system).__name__)
        return [f"{self.quantity} of {system}", *super()._arguments()]


class Equation(NamedTuple):
    """Z(s) = k + c s + m s^2 + (b_1 p^(n-1) + ... + b_n)/(p^n + a_1 p^(n-1) + ... + a_n).

    Here p = s/rate.

    Attributes
    ----------
    rate : float
        Typical rate of the poles, rad/s, so that the coefficients are of similar size.
    order : int
        n.
    coefficients : sequence
        k, c, m, a_1 to a_n, b_1 to b_n; numbers or symbols.
    """

    rate: float
    order: int
    coefficients: Sequence[Any]

    def mechanics(self, x: Any, velocity: Any, states: Sequence[Any]) -> Mechanics:
        """Return mass, the remaining force, and the rates of the states, in metres."""
        k, c, m, *others = self.coefficients
        a, b = others[: self.order], others[self.order :]
        rates = [x, *states][: self.order]
        if self.order:
            rates[0] = x - sum(p * z for p, z in zip(a, states, strict=True))
        force = k * x + c * velocity + sum(p * z for p, z in zip(b, states, strict=True))
        return Mechanics(m, force, [self.rate * z for z in rates])

    @property
    def matrix(self) -> FloatArray:
        """The matrix of the states' rates, (order, order), 1/s; coefficients are numbers."""
        matrix = np.diag(np.ones(max(self.order - 1, 0)), -1)[: self.order, : self.order]
        matrix[:1] = -np.asarray(self.coefficients[3 : 3 + self.order])
        return self.rate * matrix

    @property
    def output(self) -> FloatArray:
        """The force from a unit of each state; coefficients are numbers."""
        return np.asarray(self.coefficients[3 + self.order :])

    def states(self, step: float, paths: FloatArray, first: FloatArray) -> FloatArray:
        """Return the states at samples, (n, c, order), from `first`, (order, c).

        `paths` are the coefficients of the displacement as a polynomial of degree 5 in each `step`.
        """
        from scipy.linalg import expm

        n = self.order
        augmented = np.zeros((n + 6, n + 6))  # by the derivatives of the displacement
        augmented[:n, :n] = step * self.matrix
        augmented[:1, n] = step * self.rate
        augmented[np.arange(n, n + 5), np.arange(n + 1, n + 6)] = 1.0
        transition = expm(augmented)[:n]
        driven = paths @ (transition[:, n:] * [1.0, 1.0, 2.0, 6.0, 24.0, 120.0]).T
        term = np.broadcast_to(driven[:, :, None], (len(paths), *first.shape))
        keep = np.broadcast_to(transition[:, :n], (len(paths), n, n))
        return matrix_recursion(keep, term, first).transpose(0, 2, 1)


def coefficients_of(Z: Rational, rate: float) -> FloatArray:
    """Return the coefficients of :class:`Equation`, of a function that grows at most as s^2."""
    n = Z.degrees[1]
    polynomial, proper = Z.split()
    k, c, m = [*polynomial[::-1].tolist(), 0.0, 0.0][:3]
    powers = rate ** np.arange(1, n + 1)
    a, b = (
        f[f.size - n :] / Z.denominator[0] / powers
        for f in (Z.denominator, np.append(np.zeros(n), proper.numerator))
    )
    return np.concatenate([[k, c, m], a, b])


def dynamic_stiffness(system: Any, quantity: Quantity, omega: FloatArray) -> ComplexArray:
    """Return Z at angular frequencies, shape (n,), from a system whose response is `quantity`."""
    control = importlib.import_module("control")
    if not isinstance(system, control.FRD):
        return _to_stiffness(_evaluate(system, omega), quantity, omega)
    from scipy.interpolate import make_interp_spline

    frequencies = np.asarray(system.omega, dtype=np.float64)
    order = np.argsort(frequencies)
    nodes = frequencies[order]
    if np.any(np.diff(nodes) == 0.0):
        raise ValidationError("the FRD has a frequency twice; average its values there")
    outside = (omega < nodes[0] * (1.0 - 1e-12)) | (omega > nodes[-1] * (1.0 + 1e-12))
    if outside.any():
        raise ValidationError(
            f"the FRD reaches from {nodes[0]:g} to {nodes[-1]:g} rad/s and was asked for "
            f"{omega[outside][0]:g} rad/s; leave that frequency out, or give a wider FRD"
        )
    Z = _to_stiffness(np.ravel(system(1j * frequencies))[order], quantity, nodes)
    return np.asarray(make_interp_spline(nodes, Z, k=min(3, len(nodes) - 1))(omega))


def _evaluate(system: Any, omega: FloatArray) -> ComplexArray:
    """Return the response of a TransferFunction or StateSpace; not finite at a pole."""
    s = 1j * omega
    if system.isdtime(strict=True):
        limit = np.pi / system.dt
        if np.any(omega > limit):
            raise ValidationError(
                f"the discrete system ends at half its sampling rate, {limit:g} rad/s, and was "
                f"asked for {np.max(omega):g} rad/s"
            )
        s = np.exp(s * system.dt)
    with np.errstate(all="ignore"):
        return np.ravel(system(s, warn_infinite=False))


def _to_stiffness(R: ComplexArray, quantity: Quantity, omega: FloatArray) -> ComplexArray:
    """Return Z from the system's response, 0 at a pole of X/F; refuse other poles."""
    pole = np.isinf(R)
    bad = np.isnan(R) & ~pole | (pole & (quantity in _FORCE_OVER_MOTION))
    if bad.any():
        raise ValidationError(
            f"the {quantity} is {R[bad][0]:g} at {omega[bad][0]:g} rad/s; expected a finite "
            "number: check the system, or leave that frequency out"
        )
    Z, _ = converted(np.where(pole, 1.0, R), omega, quantity, "dynamic_stiffness")
    return np.where(pole, 0.0, Z)


def _degree(system: Any) -> int:
    """Return the degree in s of the numerator of a state-space system's response.

    It follows from the number of Markov parameters, D, C B, C A B, ..., that vanish.
    """
    A, B, row, D = (np.asarray(getattr(system, key), np.float64) for key in "ABCD")
    size, degree = np.abs(row), len(A)
    if D[0, 0]:
        return degree
    while degree > 0:
        degree -= 1
        if abs((row @ B)[0, 0]) > _VANISHES * (size @ np.abs(B))[0, 0]:
            break
        row, size = row @ A, size @ np.abs(A)
    return degree


def check_system(system: Any, name: str) -> None:
    """Refuse all but python-control systems with one input, one output and a sampling time."""
    if not _is_system(system):
        raise ValidationError(
            f"{name} is a {type(system).__name__}; expected a python-control TransferFunction, "
            "StateSpace or FRD"
        )
    if (system.ninputs, system.noutputs) != (1, 1):
        raise ValidationError(
            f"{name} has {system.ninputs} inputs and {system.noutputs} outputs; expected one of "
            "each, such as system[0, 0]"
        )
    if system.dt is True:
        raise ValidationError(f"{name} is discrete without a sampling time; set its dt, s")


def _is_system(system: Any) -> bool:
    control = importlib.import_module("control")
    return isinstance(system, (control.TransferFunction, control.StateSpace, control.FRD))


def _parameter(name: str, value: float | Parameter | None) -> Parameter:
    if isinstance(value, Parameter):
        return replace(value, name=name)
    return Parameter(name, "", "argument of a linear system", value)


def differences(
    function: Callable[[tuple[float, ...]], NDArray[Any]],
    vector: Sequence[float],
    labels: Sequence[str],
) -> Iterator[NDArray[Any]]:
    """Yield the derivative with respect to each of a vector's numbers, by central differences."""
    for i, (label, value) in enumerate(zip(labels, vector, strict=True)):
        if value == 0.0:
            raise ModelError(
                f"{label} is exactly 0, which gives its derivative no step; start it from a small "
                "number, or write the function with an offset"
            )

        def of_one(number: float, i: int = i) -> NDArray[Any]:
            return function((*vector[:i], number, *vector[i + 1 :]))

        yield difference(of_one, value, STEP * value)

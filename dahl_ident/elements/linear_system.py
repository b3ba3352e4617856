"""Any linear system from python-control as an element: fixed, or with named free parameters.

A structure's linear part is often known as a transfer function, a state-space model or measured
frequency response data (FRD). Its response R is one of the six standard quantities, which has to be
given and is never guessed. FRD is interpolated by a cubic spline of Z, which is exact for one mode,
where a spline of the receptance overshoots its peak; and only between its first and last frequency.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.columns import one_of
from dahl_ident.data.record import is_even
from dahl_ident.elements.element import Element, prefixed, required_history
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
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.rational import Rational, typical_rate
from dahl_ident.elements.recursion import matrix_recursion
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.units import DEFINITIONS, QUANTITIES, Quantity, converted

_VANISHES = 1e-12  # of its terms: a sum that is 0 but for rounding
_UNSTABLE = 1e-9  # of the fastest pole: a real part above grows
_FORCE_OVER_MOTION = ("dynamic_stiffness", "mechanical_impedance", "apparent_mass")


class LinearSystem(Element):
    """Linear system in parallel with the other elements: Z(omega) from a python-control object.

    Parameters
    ----------
    system : control.TransferFunction, control.StateSpace, control.FRD or callable
        One input and one output; continuous, or discrete with a known sampling time. A
        callable takes the `parameters` by keyword and returns such a system.
    quantity : str
        What the system's response is: "receptance" (displacement over force), "mobility",
        "accelerance", "dynamic_stiffness" (force over displacement), "mechanical_impedance" or
        "apparent_mass".
    parameters : mapping of str to float, None or Parameter, optional
        Arguments of a callable `system`. A number fixes the argument; None leaves it free; a
        Parameter gives unit, bounds and search coordinate as well.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If `system` is none of these, has several inputs or outputs or no sampling time,
        `quantity` is unknown, or `parameters` and a callable do not go together.

    Notes
    -----
    A continuous system has an equation of motion: its Z(s) is a stiffness, a damper, a mass, and
    poles. So a receptance with inertia is driven by a force without `Mass`; an absorber needs one
    in parallel. In records the states of its poles at the first sample are unknowns of the fit;
    where the force is fitted, only a system without free parameters has one over time.

    Evaluating outside the frequencies of an FRD, above half a sampling rate, or where the
    response determines no stiffness, raises ValidationError. Derivatives by the arguments
    of a callable are central differences of fourth order with steps of 1e-3 of the argument,
    good to about 1e-12 abs(Z/p) where Z is smooth; an argument of exactly 0 has no such step.

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
        self._name = name
        self._system = system
        self._quantity = quantity
        self._labels = tuple(arguments)
        self.parameters = tuple(_parameter(prefixed(name, k), v) for k, v in arguments.items())
        self._last: tuple[FloatArray, ComplexArray] | None = None
        self._known: tuple[tuple[float, ...], Equation] | None = None
        if not is_function:
            check_system(system, "system")

    @property
    def system(self) -> Any:
        """The python-control system, or the function that returns one."""
        return self._system

    @property
    def quantity(self) -> Quantity:
        """What the system's response is."""
        return self._quantity

    @each_harmonic
    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return Z(omega) with its derivatives; a sine answers no harmonic."""
        rows = 1 + len(self._labels) if derivatives > 1 else 1
        table = np.asarray(self._for_each_vector(values, sine, rows))
        Z, *slopes = (row + 0.0 * sine.amplitude for row in table)
        return StiffnessGradient(Z, np.zeros_like(Z), tuple(slopes))

    def equation_at(self, values: Sequence[Any]) -> Equation:
        """Return the equation of motion at values of the parameters, what cancels left out."""
        at = tuple(float(v) for v in values)
        if self._known is None or self._known[0] != at:
            control = importlib.import_module("control")
            Z = Rational(*self.rational_stiffness(at)).without_common_zeros_at_0().trimmed()
            lean = control.tf(Z.numerator, Z.denominator).minreal()
            if lean.den[0][0].size < Z.denominator.size:
                Z = Rational(lean.num[0][0], lean.den[0][0])
            self.check_growth(Z)
            rate = typical_rate(Z.denominator)
            self._known = at, Equation(rate, Z.degrees[1], coefficients_of(Z, rate).tolist())
        return self._known[1]

    @property
    def _equation(self) -> Equation:
        """The equation of motion of a fixed system."""
        free = [p.name for p in self.parameters if p.free]
        if free:
            raise ModelError(
                f"{self!r} leaves {', '.join(free)} free, and only a fixed system has a force over "
                "time; fix it, fit the motion, or build what is unknown from Mass, Damper and "
                "Spring"
            )
        return self.equation_at(self.known_values())

    def check_growth(self, Z: Rational) -> None:
        """Refuse a dynamic stiffness that grows faster than that of a mass."""
        power = Z.degrees[0] - Z.degrees[1]
        if power > 2:
            raise ModelError(
                f"the dynamic stiffness of {self!r} grows as s^{power}; an equation "
                "of motion allows s^2, a mass: give the system at its point of drive"
            )

    def stiffness_near(self) -> Rational:
        """Return Z(s) at values near the parameters' own, so that no term vanishes by chance."""
        shifts = np.random.default_rng(1).uniform(0.8, 1.2, len(self.parameters))
        near = [
            float(np.clip(shift * (1.0 if p.value is None else p.value), p.lower, p.upper))
            for p, shift in zip(self.parameters, shifts, strict=True)
        ]
        Z = Rational(*self.rational_stiffness(near)).without_common_zeros_at_0().trimmed()
        self.check_growth(Z)
        return Z

    @property
    def _has_free(self) -> bool:
        return any(p.free for p in self.parameters)

    @property
    def n_states(self) -> int:
        """Poles of the dynamic stiffness."""
        return self.stiffness_near().degrees[1] if self._has_free else self._equation.order

    @property
    def has_inertia(self) -> bool:
        """Whether Z(s) grows as s^2."""
        if not self._has_free:
            return bool(self._equation.coefficients[2] != 0.0)
        above, below = self.stiffness_near().degrees
        return above - below == 2

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return mass, the rest of the force, and the changes of the states, in metres."""
        return self._equation.mechanics(x, velocity, states)

    def free_responses(self, time: FloatArray) -> FloatArray:
        """Return the force from each state at the first sample, (n, states)."""
        equation = self._equation
        undriven = np.zeros((time.size - 1, 6))
        states = self._histories(equation, self._step(time), undriven, np.eye(equation.order))
        return np.asarray(states @ equation.output)

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force, from rest; between samples the motion is a polynomial of degree 5.

        Fixed parameters do not change it.
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
            at_rest = np.zeros((equation.order, 1))
            h = self._step(path.time)
            paths = Path(x, v, a).polynomials(np.full(x.size - 1, h)).T
            states = self._histories(equation, h, paths, at_rest)
            force = np.asarray(force + states[:, 0] @ equation.output)
        zero = np.zeros(force.shape)
        return HistoryGradient(force, zero, (zero,) * len(self.parameters))

    def _histories(
        self, equation: Equation, h: float, paths: FloatArray, first: FloatArray
    ) -> FloatArray:
        """Return the states, (n, c, order), driven by polynomials from `first`, (order, c)."""
        from scipy.linalg import expm

        order = equation.order
        chain = np.zeros((order + 6, order + 6))
        chain[:order, :order] = h * equation.matrix
        chain[:1, order] = h * equation.rate
        chain[np.arange(order, order + 5), np.arange(order + 1, order + 6)] = 1.0
        whole = expm(chain)[:order]
        moved = paths @ (whole[:, order:] * [1.0, 1.0, 2.0, 6.0, 24.0, 120.0]).T
        term = np.broadcast_to(moved[:, :, None], (len(paths), *first.shape))
        keep = np.broadcast_to(whole[:, :order], (len(paths), order, order))
        return matrix_recursion(keep, term, first).transpose(0, 2, 1)

    def _step(self, time: FloatArray | None) -> float:
        if time is None or not is_even(time):
            raise ValidationError(
                f"{self!r} needs evenly spaced times to give its force; pass time="
            )
        return float(time[-1] - time[0]) / (time.size - 1)

    def describe(self) -> dict[str, Any]:
        """Return quantity and system as plain data; a function cannot be written to a file."""
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
        entry["dt"] = system.dt
        if isinstance(system, control.TransferFunction):
            numerator, denominator = system.num[0][0], system.den[0][0]
            return entry | {"numerator": list(numerator), "denominator": list(denominator)}
        return entry | {key: np.asarray(getattr(system, key)).tolist() for key in "ABCD"}

    @classmethod
    def from_description(cls, rest: Mapping[str, Any], name: str | None) -> LinearSystem:
        """Return the linear system that :meth:`describe` described."""
        control = importlib.import_module("control")
        try:
            if "omega" in rest:
                response = np.asarray(rest["real"]) + 1j * np.asarray(rest["imag"])
                system = control.FRD(response, rest["omega"])
            elif "numerator" in rest:
                system = control.TransferFunction(
                    rest["numerator"], rest["denominator"], rest["dt"]
                )
            else:
                system = control.StateSpace(rest["A"], rest["B"], rest["C"], rest["D"], rest["dt"])
            return cls(system, quantity=rest["quantity"], name=name)
        except KeyError as exc:
            raise ModelError(
                f"the linear_system element has no {exc.args[0]}; expected quantity with omega, "
                "real and imag, with numerator, denominator and dt, or with A, B, C, D and dt"
            ) from None

    def _for_each_vector(self, values: Values, sine: Sine, size: int) -> ComplexArray:
        """Return Z for every parameter vector, and its slopes where `size` asks, (size, ...)."""
        batch = np.broadcast_shapes(*(np.shape(v) for v in values))
        shape = np.broadcast_shapes(batch, np.shape(sine.omega))
        result = np.zeros((size, *shape), dtype=np.complex128)
        if sine.harmonic != 1:
            return result
        vectors = np.stack([np.broadcast_to(v, batch).ravel() for v in (*values, np.zeros(batch))])
        which = np.broadcast_to(np.arange(vectors.shape[1]).reshape(batch), shape)
        frequencies = np.broadcast_to(sine.omega, shape)
        for i, vector in enumerate(vectors[:-1].T.tolist()):
            rows = which == i
            result[:, rows] = np.nan
            if np.isfinite(vector).all():  # a search may try others
                work = self._curve if size == 1 else self._curve_and_slopes
                result[:, rows] = work(tuple(vector), frequencies[rows])
        return result

    def system_at(self, values: Sequence[float]) -> Any:
        """Return the python-control system at `values` of the parameters, in their order."""
        if not self._labels:
            return self._system
        system = self._system(**dict(zip(self._labels, values, strict=True)))
        check_system(system, "system")
        return system

    def rational_stiffness(
        self, values: Sequence[float] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator of Z(s), from the highest power of s down.

        At the given `values` of the parameters, or those that they have.
        """
        control = importlib.import_module("control")
        if values is None:
            values = [float(v) for v in self.known_values()]
        system = self.system_at(values)
        if isinstance(system, control.FRD) or not system.isctime():
            raise ModelError(
                f"{self!r} is not a rational function of s, and so has no equation of motion in "
                "continuous time; give a continuous TransferFunction or StateSpace"
            )
        transfer = control.tf(system)
        numerator, denominator = (
            np.asarray(p[0][0], np.float64) for p in (transfer.num, transfer.den)
        )
        if isinstance(system, control.StateSpace):
            # its conversion leaves rounding errors where there is no coefficient
            numerator = numerator[max(0, numerator.size - _degree(system) - 1) :]
            sizes = np.abs(numerator) * typical_rate(denominator) ** np.arange(numerator.size)[::-1]
            numerator = np.where(sizes > _VANISHES * sizes.max(), numerator, 0.0)
        definition = DEFINITIONS[self.quantity]
        above, below = (numerator, denominator)[:: definition.exponent]
        power = definition.power_in_stiffness
        return (
            np.append(above, np.zeros(max(power, 0))),
            np.append(below, np.zeros(max(-power, 0))),
        )

    def _curve(self, vector: tuple[float, ...], omega: FloatArray) -> ComplexArray:
        """Return Z at angular frequencies, shape (n,); a fixed system remembers the last."""
        if self._labels:
            return dynamic_stiffness(self.system_at(vector), self._quantity, omega)
        if self._last is None or not np.array_equal(self._last[0], omega):
            self._last = omega.copy(), dynamic_stiffness(self._system, self._quantity, omega)
        return self._last[1]

    def _curve_and_slopes(self, vector: tuple[float, ...], omega: FloatArray) -> ComplexArray:
        slopes = differences(lambda at: self._curve(at, omega), vector, self._labels)
        return np.stack([self._curve(vector, omega), *slopes])

    def __repr__(self) -> str:
        what = getattr(self._system, "__name__", type(self._system).__name__)
        _, _, arguments = super().__repr__().partition("(")
        separator = "" if arguments == ")" else ", "
        return f"LinearSystem({self._quantity} of {what}{separator}{arguments}"


class Equation(NamedTuple):
    """Z(s) = k + c s + m s^2 + (b_1 p^(n-1) + ... + b_n)/(p^n + a_1 p^(n-1) + ... + a_n).

    Of p = s/rate.

    Attributes
    ----------
    rate : float
        rad/s: that of the poles, so that the coefficients are even.
    order : int
        n.
    coefficients : sequence
        k, c, m, a_1 to a_n, b_1 to b_n; numbers or symbols.
    """

    rate: float
    order: int
    coefficients: Sequence[Any]

    def mechanics(self, x: Any, velocity: Any, states: Sequence[Any]) -> Mechanics:
        """Return mass, the rest of the force, and the changes of the states, in metres."""
        k, c, m, *others = self.coefficients
        a, b = others[: self.order], others[self.order :]
        inputs = [x, *states][: self.order]
        if self.order:
            inputs[0] = x - sum(p * z for p, z in zip(a, states, strict=True))
        force = k * x + c * velocity + sum(p * z for p, z in zip(b, states, strict=True))
        return Mechanics(m, force, [self.rate * z for z in inputs])

    @property
    def matrix(self) -> FloatArray:
        """The states' own changes, (order, order), of an equation of numbers."""
        matrix = np.diag(np.ones(max(self.order - 1, 0)), -1)[: self.order, : self.order]
        matrix[:1] = -np.asarray(self.coefficients[3 : 3 + self.order])
        return self.rate * matrix

    @property
    def output(self) -> FloatArray:
        """The force of each state."""
        return np.asarray(self.coefficients[3 + self.order :])


def coefficients_of(Z: Rational, rate: float) -> FloatArray:
    """Return the coefficients of :class:`Equation` of a function that grows no faster than s^2."""
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

    known = np.asarray(system.omega, dtype=np.float64)
    nodes = known[np.argsort(known)]
    if np.any(np.diff(nodes) == 0.0):
        raise ValidationError("the FRD has a frequency twice; average its values there")
    outside = (omega < nodes[0] * (1.0 - 1e-12)) | (omega > nodes[-1] * (1.0 + 1e-12))
    if outside.any():
        raise ValidationError(
            f"the FRD reaches from {nodes[0]:g} to {nodes[-1]:g} rad/s and was asked for "
            f"{omega[outside][0]:g} rad/s; leave that frequency out, or give a wider FRD"
        )
    R = np.ravel(system(1j * known))[np.argsort(known)]
    Z = _to_stiffness(R, quantity, nodes)
    return np.asarray(make_interp_spline(nodes, Z, k=min(3, len(nodes) - 1))(omega))


def _evaluate(system: Any, omega: FloatArray) -> ComplexArray:
    """Return the response of a TransferFunction or StateSpace; not finite at a pole."""
    place = 1j * omega
    if system.isdtime(strict=True):
        limit = np.pi / system.dt
        if np.any(omega > limit):
            raise ValidationError(
                f"the discrete system ends at half its sampling rate, {limit:g} rad/s, and was "
                f"asked for {np.max(omega):g} rad/s"
            )
        place = np.exp(place * system.dt)
    with np.errstate(all="ignore"):
        return np.ravel(system(place, warn_infinite=False))


def _to_stiffness(R: ComplexArray, quantity: Quantity, omega: FloatArray) -> ComplexArray:
    """Return Z from the system's response, 0 at a pole of X/F, or say where there is none."""
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

    It follows from the response to an impulse, D, C B, C A B, ..., the first of which may vanish.
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
    """Refuse anything but a python-control system with one input, one output and a known time."""
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

        def moved(number: float, i: int = i) -> NDArray[Any]:
            return function((*vector[:i], number, *vector[i + 1 :]))

        yield difference(moved, value, STEP * value)

"""Any linear system from python-control as an element: fixed, or with named free parameters.

A structure's linear part is often known as a transfer function, a state-space model or measured
frequency response data (FRD). Its response R is one of the six standard quantities, which has to be
given and is never guessed. FRD is interpolated by a cubic spline of Z, which is exact for one mode,
where a spline of the receptance overshoots its peak; and only between its first and last frequency.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.columns import one_of
from dahl_ident.data.quantities import DEFINITIONS, converted
from dahl_ident.elements.behaviour import (
    STENCIL,
    STEP,
    HistoryGradient,
    Mechanics,
    StiffnessGradient,
)
from dahl_ident.elements.element import Element, motion, prefixed
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.rational import Rational, StateSpace, typical_rate
from dahl_ident.elements.recursion import matrix_recursion
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.units import QUANTITIES, Quantity

_VANISHES = 1e-12  # of its terms: a sum that is 0 but for rounding
_UNSTABLE = 1e-9  # of the fastest pole: a real part above grows
_NO_STEP = (
    "{} is exactly 0, which gives its derivative no step; start it from a small number, or write "
    "the function with an offset"
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
    _interval: float | None = None  # between the samples of a history, s

    def __init__(
        self,
        system: Any,
        *,
        quantity: Quantity,
        parameters: Mapping[str, float | Parameter | None] | None = None,
        name: str | None = None,
    ) -> None:
        one_of(quantity, "quantity", QUANTITIES)
        given = dict(parameters or {})
        is_function = callable(system) and not _is_system(system)
        if is_function != bool(given):
            raise ValidationError(
                f"system is a {type(system).__name__} with the parameters {list(given)}; expected "
                "a python-control system without parameters, or a function of all of them"
            )
        self._name = name
        self._system = system
        self._quantity = quantity
        self._labels = tuple(given)
        self.parameters = tuple(_parameter(prefixed(name, k), v) for k, v in given.items())
        self._last: tuple[FloatArray, ComplexArray] | None = None
        self._parts: (
            tuple[tuple[float, ...], tuple[tuple[float, float, float], StateSpace]] | None
        ) = None
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

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return Z(omega); the amplitude does not matter, and a sine answers no harmonic."""
        Z = self._for_each_vector(values, omega, harmonic, self._curve, size=1)[0]
        return np.asarray(Z + 0.0 * amplitude)

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return Z(omega) with its derivatives by the arguments of a callable system."""
        rows = 1 + len(self._labels)
        table = self._for_each_vector(values, omega, harmonic, self._curve_and_slopes, rows)
        Z, *slopes = (row + 0.0 * amplitude for row in table)
        return StiffnessGradient(Z, np.zeros_like(Z), tuple(slopes))

    @property
    def _over_time(self) -> tuple[tuple[float, float, float], StateSpace]:
        """Return stiffness, damping and mass, and the strictly proper rest of Z(s)."""
        free = [p.name for p in self.parameters if p.free]
        if free:
            raise ModelError(
                f"{self!r} leaves {', '.join(free)} free, and only a fixed system has a force over "
                "time; fix it, fit the motion, or build what is unknown from Mass, Damper and "
                "Spring"
            )
        return self._at_values(self.known_values())

    def _at_values(
        self, values: Sequence[FloatArray | float]
    ) -> tuple[tuple[float, float, float], StateSpace]:
        at = tuple(float(v) for v in values)
        if self._parts is None or self._parts[0] != at:
            self._parts = at, self._split(at)
        return self._parts[1]

    def _split(self, values: tuple[float, ...]) -> tuple[tuple[float, float, float], StateSpace]:
        control = importlib.import_module("control")
        Z = Rational(*self.rational_stiffness(values)).without_common_zeros_at_0().trimmed()
        lean = control.tf(Z.numerator, Z.denominator).minreal()
        if lean.den[0][0].size < Z.denominator.size:
            Z = Rational(lean.num[0][0], lean.den[0][0])
        self._check_growth(Z)
        polynomial, rest = Z.split()
        k, c, m = [*polynomial[::-1].tolist(), 0.0, 0.0][:3]
        return (k, c, m), rest.state_space()

    def _check_growth(self, Z: Rational) -> None:
        """Refuse a dynamic stiffness that grows faster than that of a mass."""
        power = Z.numerator.size - Z.denominator.size
        if power > 2:
            raise ModelError(
                f"the dynamic stiffness of {self!r} grows as s^{power}; an equation "
                "of motion allows s^2, a mass: give the system at its point of drive"
            )

    @property
    def n_states(self) -> int:
        """Poles of the dynamic stiffness."""
        equation = self._equation
        return self._over_time[1].order if equation is None else equation.n_states

    @property
    def has_inertia(self) -> bool:
        """Whether Z(s) grows as s^2."""
        equation = self._equation
        return self._over_time[0][2] != 0.0 if equation is None else equation.has_inertia

    @property
    def _equation(self) -> LinearEquation | None:
        return LinearEquation(self) if any(p.free for p in self.parameters) else None

    def mechanics(
        self,
        values: Sequence[Any],
        displacement: Any,
        velocity: Any,
        direction: Any,
        states: Sequence[Any],
    ) -> Mechanics:
        """Return mass, the rest of the force, and the changes of the states, in metres."""
        (k, c, m), rest = self._over_time
        rates = [
            b * displacement + sum(a * z for a, z in zip(row, states, strict=True) if a)
            for row, b in zip(rest.A.tolist(), rest.B.tolist(), strict=True)
        ]
        force = sum(a * z for a, z in zip(rest.C.tolist(), states, strict=True))
        return Mechanics(m, k * displacement + c * velocity + force, rates)

    def sampled(self, interval: float) -> Self:
        """Return this element for histories of one sampling interval, s."""
        copy = self.with_bound(self.parameters)
        copy._interval = interval
        return copy

    def free_responses(self, samples: int) -> FloatArray:
        """Return the force from each state at the first sample, (n, states)."""
        rest = self._over_time[1]
        return np.asarray(
            self._histories(rest, np.zeros((samples - 1, 6)), np.eye(rest.order)) @ rest.C
        )

    def state_histories(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
    ) -> Sequence[FloatArray]:
        """Return the states along a displacement, from rest; zero where they would grow."""
        rest = self._over_time[1]
        if self._grows(rest):
            return [np.zeros(displacement.shape)] * rest.order
        paths = self._paths(displacement, velocity, acceleration)
        return list(self._histories(rest, paths, np.zeros((rest.order, 1)))[:, 0].T)

    def force_history(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> FloatArray:
        """Return the force, from rest; between samples the motion is a polynomial of degree 5."""
        (k, c, m), rest = self._at_values(values)
        v, a = np.zeros((2, *displacement.shape))
        if c or m or rest.order:
            v = motion(velocity, "velocity", displacement, self)
        if m or rest.order:
            a = motion(acceleration, "acceleration", displacement, self)
        force = k * displacement + c * v + m * a
        if not rest.order:
            return np.asarray(force)
        if self._grows(rest):
            raise ModelError(
                f"under a prescribed displacement the force of {self!r} grows beyond all bounds; "
                "give records in which a force drives a mass"
            )
        states = self._histories(rest, self._paths(displacement, v, a), np.zeros((rest.order, 1)))
        return np.asarray(force + states[:, 0] @ rest.C)

    def force_history_gradient(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> HistoryGradient:
        """Return the force, which fixed parameters do not change."""
        _ = self._over_time
        force = self.force_history(values, displacement, velocity, acceleration=acceleration)
        zero = np.zeros(force.shape)
        return HistoryGradient(force, zero, (zero,) * len(self.parameters))

    @staticmethod
    def _grows(rest: StateSpace) -> bool:
        poles = np.linalg.eigvals(rest.A)
        return bool(np.any(poles.real > _UNSTABLE * np.abs(poles).max(initial=0.0)))

    def _paths(self, x: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the coefficients of x in the share of each interval, (n - 1, 6)."""
        h = self._step
        one, two = h * v, 0.5 * h**2 * a
        place = np.diff(x) - one[:-1] - two[:-1]
        speed = np.diff(one) - 2.0 * two[:-1]
        bend = np.diff(two)
        return np.column_stack(
            [
                x[:-1], one[:-1], two[:-1],
                10.0 * place - 4.0 * speed + bend,
                -15.0 * place + 7.0 * speed - 2.0 * bend,
                6.0 * place - 3.0 * speed + bend,
            ]
        )  # fmt: skip

    def _histories(self, rest: StateSpace, paths: FloatArray, first: FloatArray) -> FloatArray:
        """Return the states, (n, c, order), driven by polynomials from `first`, (order, c)."""
        from scipy.linalg import expm

        order, h = rest.order, self._step
        chain = np.zeros((order + 6, order + 6))
        chain[:order, :order], chain[:order, order] = h * rest.A, h * rest.B
        chain[np.arange(order, order + 5), np.arange(order + 1, order + 6)] = 1.0
        whole = expm(chain)[:order]
        moved = paths @ (whole[:, order:] * [1.0, 1.0, 2.0, 6.0, 24.0, 120.0]).T
        term = np.broadcast_to(moved[:, :, None], (len(paths), *first.shape))
        keep = np.broadcast_to(whole[:, :order], (len(paths), order, order))
        return matrix_recursion(keep, term, first).transpose(0, 2, 1)

    @property
    def _step(self) -> float:
        if self._interval is None:
            raise ValidationError(
                f"{self!r} needs evenly spaced times to give its force; pass time="
            )
        return self._interval

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

    def _for_each_vector(
        self,
        values: Sequence[FloatArray],
        omega: FloatArray,
        harmonic: int,
        work: Callable[[tuple[float, ...], FloatArray], ComplexArray],
        size: int,
    ) -> ComplexArray:
        """Return what `work` gives for every parameter vector, shape (size, *broadcast)."""
        batch = np.broadcast_shapes(*(np.shape(v) for v in values))
        shape = np.broadcast_shapes(batch, np.shape(omega))
        result = np.zeros((size, *shape), dtype=np.complex128)
        if harmonic != 1:
            return result
        vectors = np.stack([np.broadcast_to(v, batch).ravel() for v in (*values, np.zeros(batch))])
        which = np.broadcast_to(np.arange(vectors.shape[1]).reshape(batch), shape)
        frequencies = np.broadcast_to(omega, shape)
        for i, vector in enumerate(vectors[:-1].T.tolist()):
            finite = np.isfinite(vector).all()  # a search may try others
            rows = which == i
            result[:, rows] = work(tuple(vector), frequencies[rows]) if finite else np.nan
        return result

    def system_at(self, values: Sequence[float]) -> Any:
        """Return the python-control system at `values` of the parameters, in their order."""
        if not self._labels:
            return self._system
        system = self._system(**dict(zip(self._labels, values, strict=True)))
        check_system(system, "system")
        return system

    def polynomials(self, values: Sequence[float] | None = None) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator of the response, from the highest power of s down.

        Parameters
        ----------
        values : sequence of float, optional
            Of the parameters, in their order; left out, those that they have.

        Raises
        ------
        ModelError
            If a parameter has no value, or the system is discrete or an FRD.
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
        return numerator, denominator

    def rational_stiffness(
        self, values: Sequence[float] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator of Z(s), from the highest power of s down."""
        definition = DEFINITIONS[self.quantity]
        above, below = self.polynomials(values)[:: definition.exponent]
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
        rows = [self._curve(vector, omega)]
        for i, (label, value) in enumerate(zip(self._labels, vector, strict=True)):
            if value == 0.0:
                raise ModelError(_NO_STEP.format(label))
            step = STEP * value
            terms = [
                weight / step * self._curve(_moved(vector, i, place * step), omega)
                for place, weight in STENCIL
            ]
            rows.append(np.sum(terms, axis=0))
        return np.stack(rows)

    def __repr__(self) -> str:
        what = getattr(self._system, "__name__", type(self._system).__name__)
        _, _, rest = super().__repr__().partition("(")
        separator = "" if rest == ")" else ", "
        return f"LinearSystem({self._quantity} of {what}{separator}{rest}"


class LinearEquation(LinearSystem):
    """The equation of motion of a linear system with free parameters, in its coefficients.

    Z(s) = k + c s + m s^2 + (b_1 p^(n-1) + ... + b_n)/(p^n + a_1 p^(n-1) + ... + a_n), p = s/rate.
    The coefficients are its parameters; :meth:`coefficients` gives them from those of the system.

    Parameters
    ----------
    system : LinearSystem
        With free parameters. Its degree is that at values near their starts, or near 1.

    Raises
    ------
    ModelError
        If it is not rational in s, or Z grows faster than s^2.
    """

    def __init__(self, system: LinearSystem) -> None:
        self.__dict__.update(system.__dict__)
        self._origin = system
        shifts = np.random.default_rng(1).uniform(0.8, 1.2, len(system.parameters))
        near = [  # so that no term vanishes by chance
            float(np.clip(shift * (1.0 if p.value is None else p.value), p.lower, p.upper))
            for p, shift in zip(system.parameters, shifts, strict=True)
        ]
        Z = self._rational(near).trimmed()
        self._check_growth(Z)
        self._degrees = Z.numerator.size - 1, Z.denominator.size - 1
        self._rate = typical_rate(Z.denominator)
        self._has_mass = self._degrees[0] - self._degrees[1] == 2
        n = self._degrees[1]
        labels = ["k", "c", "m", *(f"a{i + 1}" for i in range(n)), *(f"b{i + 1}" for i in range(n))]
        first = system.parameters[0].name
        self.parameters = tuple(_parameter(f"{label} of {first}", None) for label in labels)

    @property
    def n_states(self) -> int:
        """Poles of the dynamic stiffness."""
        return self._degrees[1]

    @property
    def has_inertia(self) -> bool:
        """Whether Z(s) grows as s^2."""
        return self._has_mass

    def mechanics(
        self,
        values: Sequence[Any],
        displacement: Any,
        velocity: Any,
        direction: Any,
        states: Sequence[Any],
    ) -> Mechanics:
        """Return mass, the rest of the force, and the changes of the states, in metres."""
        n = self.n_states
        k, c, m, *others = values
        a, b = others[:n], others[n:]
        inputs = [displacement, *states][:n]
        if n:
            inputs[0] = displacement - sum(x * z for x, z in zip(a, states, strict=True))
        force = k * displacement + c * velocity
        force = force + sum(x * z for x, z in zip(b, states, strict=True))
        return Mechanics(m, force, [self._rate * x for x in inputs])

    def coefficients(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients at values of the system's parameters, and their derivatives.

        Parameters
        ----------
        values : ndarray, shape (rows, P)

        Returns
        -------
        coefficients : ndarray, shape (rows, Q)
            NaN where the values are not finite, or the system has another degree there.
        slopes : ndarray, shape (rows, Q, P)
            By central differences.
        """
        vectors, which = np.unique(values, axis=0, return_inverse=True)
        rows = np.array([self._with_slopes(vector) for vector in vectors.tolist()])
        rows = rows[which.ravel()]
        return rows[..., 0], rows[..., 1:]

    def _with_slopes(self, vector: list[float]) -> FloatArray:
        """Return coefficients and their derivatives with respect to each parameter, (Q, 1 + P)."""
        columns = [self._at(vector)]
        for i, (parameter, value) in enumerate(zip(self._origin.parameters, vector, strict=True)):
            if value == 0.0:
                raise ModelError(_NO_STEP.format(parameter.name))
            step = STEP * value
            terms = [
                weight / step * self._at(_moved(tuple(vector), i, place * step))
                for place, weight in STENCIL
            ]
            columns.append(np.sum(terms, axis=0))
        return np.stack(columns, axis=-1)

    def _at(self, vector: Sequence[float]) -> FloatArray:
        """Return the coefficients at one vector of the system's parameters."""
        above, below = self._degrees
        unknown = np.full(3 + 2 * below, np.nan)
        if not np.isfinite(vector).all():
            return unknown
        Z = self._rational(vector)
        numerator, denominator = _of_degree(Z.numerator, above), _of_degree(Z.denominator, below)
        if numerator is None or denominator is None or denominator[0] == 0.0:
            return unknown
        polynomial, rest = Rational(numerator, denominator).split()
        k, c, m = [*polynomial[::-1].tolist(), 0.0, 0.0][:3]
        powers = self._rate ** np.arange(1, below + 1)
        b = np.append(np.zeros(below - min(below, rest.numerator.size)), rest.numerator)
        b = b[b.size - below :] / denominator[0]
        return np.concatenate([[k, c, m], denominator[1:] / denominator[0] / powers, b / powers])

    def _rational(self, vector: Sequence[float]) -> Rational:
        return Rational(*self._origin.rational_stiffness(vector)).without_common_zeros_at_0()


def _of_degree(polynomial: FloatArray, degree: int) -> FloatArray | None:
    """Return a polynomial of a degree; None where it has a higher one."""
    size = degree + 1
    if np.any(polynomial[: max(0, polynomial.size - size)]):
        return None
    return np.append(np.zeros(max(0, size - polynomial.size)), polynomial[-size:])


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


def _parameter(name: str, given: float | Parameter | None) -> Parameter:
    if isinstance(given, Parameter):
        return replace(given, name=name)
    return Parameter(name, "", "argument of a linear system", given)


def _moved(vector: tuple[float, ...], index: int, by: float) -> tuple[float, ...]:
    return (*vector[:index], vector[index] + by, *vector[index + 1 :])

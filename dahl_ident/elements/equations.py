"""The equations of laws and plants, in symbols, for the engine.

    (m_1 + m_2 + ...) dv/dt = drive - sum of the elements' forces,    dx/dt = v,
    dF_i/dt = slope_i(F_i, sgn v, v) v    for every element with memory

Base motion: x is the displacement relative to the base, and the drive is -m times the base's
acceleration. The states are x, v and those of the elements: one force for most that have memory.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.facts import Mechanics
from dahl_ident.elements.law_checks import (
    SPREAD,
    TRIALS,
    explanation,
    is_of_package,
    short_repr,
    trial_values,
)
from dahl_ident.errors import ModelError, spelled

if TYPE_CHECKING:
    import casadi as ca

    from dahl_ident.engine import Equations

Excitation = Literal["force", "base"]
Channel = Literal["displacement", "velocity", "acceleration"]
_TOLERANCE = 1e-8  # relative difference of results with symbols and with numbers


@contextmanager
def numpy_names() -> Iterator[None]:
    """Allow numpy's names, which laws in plain arithmetic may use; casadi takes them, but warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        yield


def law_equations(element: Element) -> Equations:
    """Return the force of one element under a prescribed displacement."""
    import casadi as ca

    from dahl_ident.engine import Equations

    x, v, s, u, names, states, part = _symbols(as_model(element))
    rates = ca.vertcat(v, 0.0, *part.rates)
    return Equations([x, v, *states], u, s, names, rates, part.force, held=True)


def plant_equations(
    model: Model, excitation: Excitation = "force", channel: Channel = "displacement"
) -> Equations:
    """Return the equation of motion of a model, driven by a force or by its base's acceleration.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> len(plant_equations(Dahl() + Mass(1.0)).states)
    3
    """
    import casadi as ca

    from dahl_ident.engine import Equations

    x, v, s, u, names, states, part = _symbols(model)
    for element in model.elements:
        if excitation == "base" and element.is_linear and element.n_states:
            raise ModelError(
                f"{element!r} has inertia inside, and how the base moves it is not known; "
                "build it from Mass, Damper and Spring, or drive the plant by a force"
            )
    if not model.has_inertia:
        has, remedy = "no mass", f"add {spelled('Mass()', '--mass free')}"
        if any(p.is_mass for p in model.parameters):
            has, remedy = "a mass of 0", "give another, or leave it free"
        raise ModelError(
            f"{model!r} has {has}, so a force does not determine its motion; {remedy}, or predict "
            "the force of a measured displacement"
        )
    applied = u if excitation == "force" else -part.inertia * u
    acceleration = (applied - part.force) / part.inertia
    output = {"displacement": x, "velocity": v, "acceleration": acceleration}[channel]
    rates = ca.vertcat(v, acceleration, *part.rates)
    return Equations([x, v, *states], u, s, names, rates, output, held=False)


def _symbols(model: Model) -> tuple[Any, ...]:
    """Return x, v, direction, drive, parameters, states, and the sum of the elements' mechanics.

    A parameter that is fixed at 0 or 1 is a number in the equations, which shortens a law.
    """
    import casadi as ca

    x, v, s, u = (ca.SX.sym(name) for name in ("x", "v", "s", "u"))
    names = [ca.SX.sym(p.name) for p in model.parameters]
    values = [
        ca.SX(float(p.value)) if not p.free and p.value in (0.0, 1.0) else name
        for p, name in zip(model.parameters, names, strict=True)
    ]
    inertia, force = ca.SX(0.0), ca.SX(0.0)
    states: list[ca.SX] = []
    rates: list[ca.SX] = []
    with numpy_names():
        for element, numbers in model.of(values):
            element_states = [ca.SX.sym(f"y{len(states) + i}") for i in range(element.n_states)]
            states += element_states
            part = symbolic_mechanics(element, numbers, x, v, s, element_states)
            inertia, force = inertia + part.inertia, force + part.force
            rates += part.rates
    return x, v, s, u, names, states, Mechanics(inertia, force, rates)


class FirstState:
    """The first state of a driven plant, as a function of its unknowns and the parameters."""

    def __init__(self, model: Model) -> None:
        import casadi as ca

        values = [ca.SX.sym(p.name) for p in model.parameters]
        unknown = [ca.SX.sym("x"), ca.SX.sym("v")]
        states = list(unknown)
        with numpy_names():
            for element, numbers in model.of(values):
                count = len(element.starts) if element.has_memory else element.n_states
                element_starts = [ca.SX.sym(f"start{len(unknown) + i}") for i in range(count)]
                states += element.initial_states(numbers, element_starts)
                unknown += element_starts
        first, starts, parameters = (ca.vertcat(*group) for group in (states, unknown, values))
        slopes = [ca.densify(ca.jacobian(first, group)) for group in (starts, parameters)]
        self._function = ca.Function("first", [starts, parameters], [first, *slopes])

    def __call__(
        self, starts: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the first state and its derivatives with respect to starts and parameters."""
        first, by_start, by_value = (part.full() for part in self._function(starts, values))
        return first[:, 0], by_start, by_value


def symbolic_mechanics(
    element: Element, values: Sequence[Any], x: Any, v: Any, s: Any, states: Sequence[Any]
) -> Mechanics:
    """Return an element's part in an equation of motion, in symbols; check that of a user's law."""
    if is_of_package(type(element)):
        return element.mechanics(values, x, v, s, states)
    try:
        part = element.mechanics(values, x, v, s, states)
        _check_part(type(element).__name__, part, len(states))
        if getattr(element, "one_state", False):
            _check_symbols(element, values, v, s, states[0])
    except ModelError:
        raise
    except Exception as exc:  # whatever a user's code raises
        raise ModelError(
            f"{type(element).__name__} cannot be compiled: {explanation(exc)}, and on symbols"
        ) from exc
    return part


def _check_part(name: str, part: Any, n_states: int) -> None:
    """Refuse a part in an equation of motion that is not made of single numbers or symbols."""
    import casadi as ca

    if not isinstance(part, Mechanics) or len(part.rates) != n_states:
        raise ModelError(
            f"{name}.mechanics returned {short_repr(part)}; expected an inertia, a force, and as "
            f"many rates as the element has states, which is {n_states}"
        )
    for what, value in (
        ("force, or output,", part.force),
        *(("rate", rate) for rate in part.rates),
    ):
        try:
            is_scalar = ca.SX(value).is_scalar()
        except (NotImplementedError, TypeError):  # casadi's, for types that it does not accept
            is_scalar = False
        if not is_scalar:
            raise ModelError(
                f"the {what} of {name} is {short_repr(value)} for one force; expected one number, "
                "N: end the method with return, and use plain arithmetic"
            )


def _check_symbols(law: Any, values: Sequence[Any], v: Any, s: Any, force: Any) -> None:
    """Refuse results that differ between symbols and numbers, and steps without comparisons."""
    import casadi as ca

    rng = np.random.default_rng(1)
    numbers = [trial_values(p, rng, TRIALS) for p in law.parameters]
    free = [i for i, value in enumerate(values) if not value.is_constant()]
    slope = law.slope(force, s, v, values)
    output = law.output(force, slope, v, values)
    function = ca.Function("law", [force, s, v, *(values[i] for i in free)], [slope, output])
    codes = {function.instruction_id(i) for i in range(function.n_instructions())}
    if codes & {ca.OP_FLOOR, ca.OP_CEIL, ca.OP_FMOD, ca.OP_REMAINDER}:
        raise ModelError(
            f"{type(law).__name__} rounds, or takes a remainder (floor, ceil, round, trunc, mod, "
            "//, %), whose steps cannot be located; expected steps as comparisons, such as "
            "(y < 0.2) + (y < 0.4)"
        )
    forces, direction = rng.uniform(-0.5, 0.5, TRIALS), np.resize([1.0, -1.0], TRIALS)
    speed = direction * 10.0 ** rng.uniform(-SPREAD, SPREAD, TRIALS)
    with np.errstate(all="ignore"):
        slopes = law.slope(forces, direction, None if law.rate_independent else speed, numbers)
        expected = slopes, law.output(forces, slopes, speed, numbers)
        rows = zip(forces, direction, speed, *(numbers[i] for i in free), strict=True)
        computed = np.array([[float(number) for number in function(*row)] for row in rows]).T
    for method, result, by_numbers in zip(("slope", "output"), computed, expected, strict=True):
        name = f"{type(law).__name__}.{method}"
        if not np.allclose(result, by_numbers, rtol=_TOLERANCE, atol=0.0, equal_nan=True):
            raise ModelError(
                f"{name} cannot be compiled: with symbols in place of numbers it "
                "gives another result; expected plain arithmetic, comparisons and numpy's "
                "functions, without math.*, float(), new arrays that are filled, or random numbers"
            )
        if not np.isfinite(result).any():
            raise ModelError(
                f"{name} is {result[0]} at every force that was tried, such as {forces[0]:.3g} N; "
                "expected finite numbers, N"
            )

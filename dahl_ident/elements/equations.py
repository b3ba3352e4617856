"""The equations of laws and plants, in symbols, for the engine.

    (m_1 + m_2 + ...) dv/dt = drive - sum of the elements' forces,    dx/dt = v,
    dF_i/dt = slope_i(F_i, sgn v, v) v    for every element with memory

Base motion: x is the displacement relative to the base, and the drive is -m times the base's
acceleration. The states are x, v and those of the elements: one force for most that have memory.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element, Model
from dahl_ident.elements.law_checks import symbolic_mechanics
from dahl_ident.errors import ModelError

if TYPE_CHECKING:
    import casadi as ca

    from dahl_ident.elements.parameter import Parameter
    from dahl_ident.engine import Equations

Excitation = Literal["force", "base"]
Channel = Literal["displacement", "velocity", "acceleration"]


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

    x, v, s, u = (ca.SX.sym(name) for name in ("x", "v", "s", "u"))
    values = [_symbol(p) for p in element.parameters]
    states = [ca.SX.sym(f"y{i}") for i in range(element.n_states)]
    with numpy_names():
        part = symbolic_mechanics(element, values, x, v, s, states)
    rates = ca.vertcat(v, 0.0, *part.rates)
    names = [ca.SX.sym(p.name) if v.is_constant() else v for p, v in _pairs(element, values)]
    return Equations([x, v, *states], u, s, names, rates, ca.SX(part.force), held=True)


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

    x, v, s, u = (ca.SX.sym(name) for name in ("x", "v", "s", "u"))
    values = [_symbol(p) for p in model.parameters]
    inertia, total = ca.SX(0.0), ca.SX(0.0)
    states: list[ca.SX] = []
    rates: list[ca.SX] = []
    with numpy_names():
        for element, numbers in model.of(values):
            element_states = [ca.SX.sym(f"y{len(states) + i}") for i in range(element.n_states)]
            states += element_states
            part = symbolic_mechanics(element, numbers, x, v, s, element_states)
            if excitation == "base" and element.is_linear and element.n_states:
                raise ModelError(
                    f"{element!r} has inertia inside, and how the base moves it is not known; "
                    "build it from Mass, Damper and Spring, or drive the plant by a force"
                )
            inertia, total = inertia + part.inertia, total + part.force
            rates += part.rates
    if not model.has_inertia:
        raise ModelError(
            f"{model!r} has no mass, so a force does not determine its motion; add "
            "Mass(), or give records with measured displacement and force"
        )
    applied = u if excitation == "force" else -inertia * u
    acceleration = (applied - total) / inertia
    output = {"displacement": x, "velocity": v, "acceleration": acceleration}[channel]
    names = [ca.SX.sym(p.name) if v.is_constant() else v for p, v in _pairs(model, values)]
    return Equations(
        [x, v, *states], u, s, names, ca.vertcat(v, acceleration, *rates), output, held=False
    )


def _symbol(parameter: Parameter) -> ca.SX:
    """Return a parameter's symbol; a number where it is fixed at 0 or 1, which shortens a law."""
    import casadi as ca

    if not parameter.free and parameter.value in (0.0, 1.0):
        return ca.SX(float(parameter.value))
    return ca.SX.sym(parameter.name)


def _pairs(element: Element, values: list[ca.SX]) -> Iterator[tuple[Parameter, ca.SX]]:
    return zip(element.parameters, values, strict=True)


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

"""Linear elements: mass, viscous damper, spring, and any python-control system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.elements.facts import (
    HistoryGradient,
    Mechanics,
    Path,
    Sine,
    StiffnessGradient,
    Values,
)
from dahl_ident.elements.force_law import required_history
from dahl_ident.elements.parameter import Parameter
from dahl_ident.units import power_of_s


class Lumped(Element):
    """An element of one parameter p, with Z = p (j omega)^order."""

    order: ClassVar[int]
    is_linear = True

    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return p (j omega)^order with its derivatives; 0 for harmonics above the fundamental."""
        unit: ComplexArray = power_of_s(sine.omega, self.order) * np.equal(sine.harmonic, 1)
        value = np.asarray(values[0] * unit + 0.0 * sine.amplitude)
        slopes = (np.broadcast_to(unit, value.shape),) if derivatives > 1 else ()
        return StiffnessGradient(value, np.zeros_like(value), slopes)

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return p times the displacement, velocity or acceleration, and its derivatives."""
        name = Path._fields[self.order]
        history = required_history(path[self.order], name, path.displacement, self)
        force = np.asarray(values[0] * history)
        return HistoryGradient(force, np.zeros(force.shape), (history,))

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return p as the inertia, or p times the displacement or velocity as the force."""
        if self.order == 2:
            return Mechanics(values[0], 0.0)
        return Mechanics(0.0, values[0] * (x, velocity)[self.order])

    def rational_stiffness(self) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator of p s^order."""
        (value,) = self.known_values()
        return np.append(value, np.zeros(self.order)), np.ones(1)

    def physical_objections(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return an objection to a negative value."""
        (parameter,) = self.parameters
        return (f"{parameter.name} is negative",) if values[0] < 0.0 else ()


class Mass(Lumped):
    """Inertia: Z = -m omega^2 (Eqn. 53).

    Parameters
    ----------
    mass : float, optional
        m, kg (kg m^2 in rotation). Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameter's name, where a model has several masses.

    Raises
    ------
    ValidationError
        If `mass` is not a finite number.

    Examples
    --------
    >>> print(Mass(0.3).dynamic_stiffness(1e-3, 10.0))
    (-30+0j)
    """

    kind = "mass"
    equation = "F = m d2x/dt2"
    order = 2
    rate_independent = False
    holds_at_rest = False
    parameters = (Parameter("mass", "kg", "mass"),)
    linear_parameters = scale_parameters = ("mass",)

    def __init__(self, mass: float | None = None, *, name: str | None = None) -> None:
        self._bind({"mass": mass}, name)


class Damper(Lumped):
    """Viscous damping: Z = j omega c (Eqn. 53, where c is called b).

    Parameters
    ----------
    damping : float, optional
        c, N s/m (N m s/rad in rotation). Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameter's name, where a model has several dampers.

    Raises
    ------
    ValidationError
        If `damping` is not a finite number.

    Examples
    --------
    >>> print(Damper(0.24).dynamic_stiffness(1e-3, 10.0))
    2.4j
    """

    kind = "damper"
    equation = "F = c dx/dt"
    order = 1
    rate_independent = False
    holds_at_rest = False
    parameters = (Parameter("damping", "N s/m", "viscous damping"),)
    linear_parameters = scale_parameters = ("damping",)

    def __init__(self, damping: float | None = None, *, name: str | None = None) -> None:
        self._bind({"damping": damping}, name)


class Spring(Lumped):
    """Linear spring: Z = k (Eqn. 53).

    Parameters
    ----------
    stiffness : float, optional
        k, N/m (N m/rad in rotation). Given: fixed; left out: free.
    name : str, optional
        Prefix of the parameter's name, where a model has several springs.

    Raises
    ------
    ValidationError
        If `stiffness` is not a finite number.

    Examples
    --------
    >>> print(Spring(0.3).dynamic_stiffness(1e-3, 10.0))
    (0.3+0j)
    """

    kind = "spring"
    equation = "F = k x"
    order = 0
    parameters = (Parameter("stiffness", "N/m", "spring stiffness"),)
    linear_parameters = scale_parameters = ("stiffness",)

    def __init__(self, stiffness: float | None = None, *, name: str | None = None) -> None:
        self._bind({"stiffness": stiffness}, name)

"""A model taken apart for the time domain: its Dahl elements, and everything linear as one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.quantities import DEFINITIONS
from dahl_ident.elements import Dahl, Element, LinearSystem
from dahl_ident.elements.hysteresis import force_history, margin_change
from dahl_ident.elements.linear import Lumped
from dahl_ident.elements.model import as_model
from dahl_ident.errors import ModelError
from dahl_ident.synthetic.plant_motion import DahlValues, Progress, simulate_plant
from dahl_ident.synthetic.state_space import Rational
from dahl_ident.synthetic.waveform import Waveform

Signal = Callable[[FloatArray], FloatArray]
"""A channel's true value at any times, shape in and out (n,)."""


@dataclass(frozen=True)
class Mechanism:
    """Dahl elements in parallel with one linear dynamic stiffness Z(s) = n(s)/d(s)."""

    friction: tuple[DahlValues, ...]
    linear: Rational

    @classmethod
    def of(cls, plant: Element) -> Mechanism:
        """Return the parts of a model whose parameters all have values.

        Raises
        ------
        ModelError
            If a parameter has no value, or a linear system has no equation of motion.
        """
        plant.known_values()
        friction = []
        linear = Rational(np.zeros(1), np.ones(1))
        for element in as_model(plant).elements:
            values = [float(v) for v in element.known_values()]
            if isinstance(element, Dahl):
                friction.append(DahlValues(*values))
            elif isinstance(element, LinearSystem):
                linear = linear + _stiffness_of(element)
            elif isinstance(element, Lumped):
                linear = linear + Rational(np.array(values), np.ones(1)).times_s(element.order)
            else:
                raise ModelError(
                    f"{element!r} has no equation of motion; expected an element of dahl_ident"
                )
        return cls(tuple(friction), linear)

    def displacement_under(self, force: Waveform, progress: Progress | None = None) -> Signal:
        """Return x(t) for a force u(t), from rest.

        Raises
        ------
        ModelError
            If nothing linear bounds the motion, or it grows beyond all bounds.
        """
        if not np.any(self.linear.numerator):
            raise ModelError(
                "friction alone slides without bound under a force above f_max; give the plant a "
                "mass, a damper or a spring, or control its displacement"
            )
        receptance = self.linear.inverse().state_space()
        return simulate_plant(receptance, self.friction, force, progress)

    def force_under(self, displacement: Waveform, progress: Progress | None = None) -> Signal:
        """Return the force F(t) that a displacement x(t) takes, from rest.

        Raises
        ------
        ModelError
            If the linear part asks for more than the displacement's second derivative.
        """
        polynomial, rest = self.linear.split()
        if polynomial.size > 3:
            raise ModelError(
                f"the linear part's dynamic stiffness grows as s^{polynomial.size - 1}; under a "
                "prescribed displacement at most s^2, a mass, has a force"
            )
        q0, q1, q2 = [*polynomial[::-1].tolist(), 0.0, 0.0][:3]
        parts: list[Signal] = [DahlForce(values, displacement) for values in self.friction]
        if np.any(rest.numerator):
            parts.append(simulate_plant(rest.state_space(), (), displacement, progress))

        def force(time: FloatArray) -> FloatArray:
            motion = displacement.motion(time)
            total = q0 * motion.value + q1 * motion.velocity + q2 * motion.acceleration
            for part in parts:
                total = total + part(time)
            return np.asarray(total)

        return force


class DahlForce:
    """The exact force of one Dahl element under a prescribed displacement, at any times.

    The motion's turning points are found once; between them the force is Eqn. 3.
    """

    def __init__(self, values: DahlValues, displacement: Waveform) -> None:
        self._values = values
        self._displacement = displacement
        self._times = displacement.turning_times()
        self._x = displacement.value(self._times)
        self._force = force_history(self._x, *values, 0.0)
        heading = np.sign(np.diff(self._x, append=self._x[-1]))
        self._heading = np.where(heading == 0.0, 1.0, heading)

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the force at any times."""
        f_max, sigma, alpha = self._values
        before = np.clip(
            np.searchsorted(self._times, time, side="right") - 1, 0, self._times.size - 1
        )
        heading = self._heading[before]
        scaled = self._force[before] / f_max
        path = np.abs(self._displacement.value(time) - self._x[before]) * (sigma / f_max)
        change = margin_change(1.0 - heading * scaled, path, alpha)
        return np.asarray(f_max * (scaled - heading * change))


def _stiffness_of(element: LinearSystem) -> Rational:
    """Return the dynamic stiffness of a linear system as polynomials in s."""
    response = Rational(*element.polynomials()).trimmed()
    definition = DEFINITIONS[element.quantity]
    base = response if definition.exponent == 1 else response.inverse()
    return base.times_s(definition.power_in_stiffness)

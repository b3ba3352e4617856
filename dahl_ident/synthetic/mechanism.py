"""A model split for the time domain into its friction and one linear part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, Model
from dahl_ident.elements.element import as_model
from dahl_ident.elements.equations import plant_equations
from dahl_ident.elements.rational import Rational
from dahl_ident.engine import march, translate
from dahl_ident.errors import FitError, ModelError
from dahl_ident.synthetic.plant_motion import Progress, simulate_plant
from dahl_ident.synthetic.waveform import Waveform

_PER_PERIOD = 128  # samples between which cubics miss 1e-8 of a sine

Signal = Callable[[FloatArray], FloatArray]
"""A channel's true value at any times, (n,) -> (n,)."""


@dataclass(frozen=True)
class Mechanism:
    """Friction in parallel with one linear dynamic stiffness Z(s) = n(s)/d(s)."""

    friction: tuple[Element, ...]
    """Laws whose branches have a closed form."""
    linear: Rational
    others: tuple[Element, ...]
    """Laws whose motion under a force takes steps of integration."""
    plant: Model
    """The whole."""

    @classmethod
    def of(cls, plant: Element) -> Mechanism:
        """Return the parts of a model whose parameters all have values."""
        plant.known_values()
        plant = as_model(plant)
        friction, others = [], []
        linear = Rational(np.zeros(1), np.ones(1))
        for element in plant.elements:
            rational = element.rational_stiffness()
            if rational is not None:
                linear = linear + Rational(*rational).trimmed()
            elif element.branch(_values(element), 0.0, np.zeros(1)) is not None:
                friction.append(element)
            else:
                others.append(element)
        return cls(tuple(friction), linear, tuple(others), plant)

    def displacement_under(self, force: Waveform, progress: Progress | None = None) -> Signal:
        """Return x(t) for a force u(t), from rest."""
        if self.others:
            try:
                return self._integrated(force)
            except FitError as error:
                raise ModelError(
                    "the motion under a force grows beyond all bounds; control the displacement"
                ) from error
        if not np.any(self.linear.numerator):
            raise ModelError(
                "friction alone slides without bound under a force above f_max; give the plant a "
                "mass, a damper or a spring, or control its displacement"
            )
        receptance = self.linear.inverse().state_space()
        return simulate_plant(receptance, self.friction, force, progress)

    def _integrated(self, force: Waveform) -> Signal:
        """Return x(t) from even samples, between which it is interpolated by its derivatives."""
        from scipy.interpolate import CubicHermiteSpline

        steps = int(np.ceil(force.duration * force.highest_frequency_hz * _PER_PERIOD))
        time, length = np.linspace(0.0, force.duration, steps + 1, retstep=True)
        place = 0.5 - 0.5 * np.cos(np.pi * (np.arange(8) + 0.5) / 8)
        values = force.value((time[:-1, None] + length * place).ravel()).reshape(steps, 8)
        drive: FloatArray = np.linalg.inv(np.vander(place, increasing=True)) @ values.T
        system = translate(plant_equations(self.plant))
        values = np.array(self.plant.known_values(), dtype=np.float64)
        x, v = march(system, time, drive, time, np.zeros(system.order), values).states.T[:2]
        curve = CubicHermiteSpline(time, x, v)
        return lambda at: np.asarray(curve(at))

    def force_under(self, displacement: Waveform, progress: Progress | None = None) -> Signal:
        """Return the force F(t) for a displacement x(t), from rest."""
        polynomial, rest = self.linear.split()
        if polynomial.size > 3:
            raise ModelError(
                f"the linear part's dynamic stiffness grows as s^{polynomial.size - 1}; under a "
                "prescribed displacement at most s^2, a mass, has a force"
            )
        q0, q1, q2 = [*polynomial[::-1].tolist(), 0.0, 0.0][:3]
        parts: list[Signal] = [BranchForce(law, displacement) for law in self.friction]
        parts += [LawForce(element, displacement) for element in self.others]
        if np.any(rest.numerator):
            parts.append(simulate_plant(rest.state_space(), (), displacement, progress))

        def force(time: FloatArray) -> FloatArray:
            motion = displacement.motion(time)
            total = q0 * motion.value + q1 * motion.velocity + q2 * motion.acceleration
            for part in parts:
                total = total + part(time)
            return np.asarray(total)

        return force


class BranchForce:
    """The exact force of one law under a prescribed displacement, at any times.

    The motion's turning points are found once; between them the force has a closed form.
    """

    def __init__(self, element: Element, displacement: Waveform) -> None:
        self._element, self._values = element, _values(element)
        self._displacement = displacement
        self._times = displacement.turning_times()
        self._x = displacement.value(self._times)
        self._force = element.force_history(self._values, self._x)
        heading = np.sign(np.diff(self._x, append=self._x[-1]))
        self._heading = np.where(heading == 0.0, 1.0, heading)

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the force at any times."""
        before = np.clip(
            np.searchsorted(self._times, time, side="right") - 1, 0, self._times.size - 1
        )
        heading = self._heading[before]
        path = np.abs(self._displacement.value(time) - self._x[before])
        found = self._element.branch(self._values, heading * self._force[before], path)
        assert found is not None
        return np.asarray(heading * found[0])


class LawForce:
    """The force of any law under a prescribed displacement, at any times after its start."""

    def __init__(self, element: Element, displacement: Waveform) -> None:
        self._element = element
        self._displacement = displacement
        self._turns = displacement.turning_times()

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the force at any times."""
        every, back = np.unique(np.concatenate([self._turns, time]), return_inverse=True)
        motion = self._displacement.motion(every)
        force = self._element.force_history(_values(self._element), motion.value, motion.velocity)
        return np.asarray(force[back[self._turns.size :]])


def _values(element: Element) -> list[float]:
    return [float(v) for v in element.known_values()]

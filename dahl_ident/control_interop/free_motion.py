"""The exact free oscillation of a closed loop, by shooting from the describing function's estimate.

Without a drive, a periodic motion returns to its state after a period that is unknown as well:

    y(T; y_0) = y_0,    v(0) = 0.

These equations are solved for y_0 and T with the derivatives of the motion. If the system is the
same in both directions, half a period leads to -y_0. Of Floquet's multipliers, the eigenvalues of
the derivative of this map, one is 1 (the motion may be shifted in time); the largest of the others
gives the growth of a disturbance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.driven_motion import NEUTRAL
from dahl_ident.elements.element import Element, Model
from dahl_ident.elements.equations import law_equations, plant_equations
from dahl_ident.engine import System, march, settled, translate
from dahl_ident.errors import FitError

_STARTS = (1.0, 0.7, 1.4, 0.5, 0.35, 0.25)  # starts over the estimate, tried until one converges
_EVALUATIONS = 60  # at most from each start; usually ten are needed
_CLOSED_CYCLE = 1e-7  # largest difference of first and last state, relative to the states' sizes
_DIVERGED = 1e3  # the same for a motion that grows without bound
_ANOTHER_MOTION = np.log(5.0)  # largest log ratio of amplitude or period to the estimate
_SAMPLES = 256  # per period, for the harmonics
_HIGHEST = 9  # harmonic


class FreeMotion(NamedTuple):
    """A periodic motion without a drive."""

    amplitude: float  # of the fundamental of the displacement
    omega: float
    share: float  # root sum of squares of mean and harmonics 2 to 9, over the fundamental
    growth_rate: float  # of the least stable small disturbance, 1/s


def free_motion(plant: Model, amplitude: float, omega: float) -> FreeMotion | None:
    """Return the periodic motion near ``amplitude cos(omega t)``; None if there is none.

    The plant is the whole loop, friction included, with a mass and a value for every parameter.
    """
    loop = _Loop(plant)
    y = loop.start(amplitude, omega)
    period = loop.half_periods * np.pi / omega
    for scale in _STARTS:
        orbit = loop.closed(y * scale, period)
        if orbit is not None:
            return loop.described(*orbit, near=(amplitude, omega))
    return None


class _Loop:
    """The compiled equations of a loop, and the map of its state over a period."""

    def __init__(self, plant: Model) -> None:
        import casadi as ca

        equations = plant_equations(plant)
        self.system: System = translate(equations)
        self.half_periods = 1 if self.system.odd else 2  # covered by the map
        self._sign = -1.0 if self.system.odd else 1.0
        self._plant = plant
        self._values = np.array([float(v) for v in plant.known_values()])
        states, names = ca.vertcat(*equations.states), ca.vertcat(*equations.parameters)
        arguments = [states, equations.drive, equations.direction, names]
        self._rates = ca.Function("rates", arguments, [equations.rates])

    def start(self, amplitude: float, omega: float) -> FloatArray:
        """Return the state at the peak of a steady sinusoidal motion."""
        states = [_steady_states(e, amplitude, omega) for e in self._plant.elements if e.n_states]
        return np.concatenate([[amplitude, 0.0], *states])

    def closed(self, y: FloatArray, period: float) -> tuple[FloatArray, float, FloatArray] | None:
        """Return state, period and map derivative of the periodic motion found from a start."""
        size = np.maximum(np.abs(y), 1e-3 * np.abs(y).max())
        at_rest = np.arange(y.size) == 1
        last: list[FloatArray] = []

        def state(z: FloatArray) -> FloatArray:
            return np.asarray(np.insert(z[:-1], 1, 0.0) * size)

        def mismatch(z: FloatArray) -> FloatArray:
            try:
                end, slope, rates = self._after(state(z), float(z[-1]) * period)
            except FitError:
                last[:] = [np.zeros((y.size, y.size))]
                return np.full(y.size, _DIVERGED)
            columns = [((slope - np.eye(y.size)) * size)[:, ~at_rest], period * rates]
            last[:] = [np.column_stack(columns) / size[:, None], slope]
            return np.asarray((end - state(z)) / size)

        def jacobian(z: FloatArray) -> FloatArray:
            mismatch(z)
            return last[0]

        start = np.append((y / size)[~at_rest], 1.0)
        solution = least_squares(
            mismatch,
            start,
            jacobian,
            method="lm",
            xtol=1e-14,
            ftol=1e-14,
            max_nfev=_EVALUATIONS,
        )
        if not np.abs(solution.fun).max() < _CLOSED_CYCLE or solution.x[-1] <= 0.0:
            return None
        mismatch(solution.x)
        return state(solution.x), float(solution.x[-1]) * period, last[1]

    def _after(self, y: FloatArray, period: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return state, map derivative and rates after a period; after half of one, negated."""
        motion = march(
            self.system,
            np.array([0.0, period]),
            np.zeros((1, 1)),
            np.array([0.0, period]),
            y,
            self._values,
            derivatives=True,
        )
        end = motion.states[-1]
        rates = self._rates(end, 0.0, np.sign(end[1]) or -self._sign, self._values).full()[:, 0]
        return self._sign * end, self._sign * motion.map, self._sign * rates

    def described(
        self, y: FloatArray, period: float, slope: FloatArray, near: tuple[float, float]
    ) -> FreeMotion | None:
        """Return size, frequency and stability of a motion; None if it is far from `near`."""
        full_period = period * 2 / self.half_periods
        times = np.linspace(0.0, full_period, _SAMPLES + 1)
        x = march(self.system, times[[0, -1]], np.zeros((1, 1)), times, y, self._values).output
        X = 2.0 * np.fft.rfft(x[:-1])[: _HIGHEST + 1] / _SAMPLES
        amplitude, omega = abs(X[1]), 2.0 * np.pi / full_period
        distance = np.abs(np.log([max(amplitude, 1e-300) / near[0], omega / near[1]]))
        if distance.max() > _ANOTHER_MOTION:
            return None
        others = np.append(0.5 * X[0], X[2:])
        multipliers = np.linalg.eigvals(slope)
        multipliers = np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))
        largest = float(np.abs(multipliers).max())
        growth = 0.0 if abs(largest - 1.0) < NEUTRAL else np.log(largest) / period
        share = float(np.linalg.norm(others)) / amplitude
        return FreeMotion(float(amplitude), float(omega), share, float(growth))


def _steady_states(element: Element, amplitude: float, omega: float) -> FloatArray:
    """Return an element's states at the peak of a steady sinusoidal motion."""
    values = np.array([[float(v) for v in element.known_values()]])
    loop = settled(
        translate(law_equations(element)), np.array([amplitude]), np.array([omega]), values
    )
    return np.asarray(loop.starts[0, 2:])

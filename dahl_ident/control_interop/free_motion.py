"""The exact free oscillation of a closed loop, by shooting from the describing function's estimate.

Without a drive, a periodic motion returns to its state after a period that is not known either:

    y(T; y_0) = y_0,    v(0) = 0,

solved for y_0 and T with the derivatives of the motion. Where the equations are the same
in both directions, half a period leads to -y_0. Of Floquet's multipliers, the eigenvalues of the
map's derivative, one is 1 (the motion may be shifted in time); the largest of the others says how a
disturbance grows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.driven_motion import NEUTRAL
from dahl_ident.elements.element import Element
from dahl_ident.elements.equations import law_equations, plant_equations
from dahl_ident.elements.model import Model
from dahl_ident.engine import System, march, settled, translate
from dahl_ident.errors import FitError

_STARTS = (1.0, 0.7, 1.4, 0.5, 0.35, 0.25)  # times the estimate, as long as nothing is found
_EVALUATIONS = 60  # from each; ten are the rule
_CLOSED = 1e-7  # of the states' sizes: what a motion may miss its beginning by
_LOST = 1e3  # the same of a motion that grows beyond all bounds
_FARTHEST = np.log(5.0)  # from the estimate, of amplitude and period: farther is another motion
_SAMPLES = 256  # of a period, for its harmonics
_HIGHEST = 9  # harmonic that counts


class FreeMotion(NamedTuple):
    """A periodic motion without a drive."""

    amplitude: float  # of the displacement's fundamental
    omega: float
    share: float  # root sum of squares of the mean and the harmonics 2 to 9 over it
    growth_rate: float  # of the worst small disturbance, 1/s


def free_motion(plant: Model, amplitude: float, omega: float) -> FreeMotion | None:
    """Return the periodic motion near ``amplitude cos(omega t)``; None where there is none.

    The plant is the whole loop, friction included, with a mass and a value for every parameter.
    """
    loop = _Loop(plant)
    y = loop.start(amplitude, omega)
    period = loop.turns * np.pi / omega
    for scale in _STARTS:
        orbit = loop.closed(y * scale, period)
        if orbit is not None:
            return loop.described(*orbit, near=(amplitude, omega))
    return None


class _Loop:
    """The compiled equations of a loop, and its maps."""

    def __init__(self, plant: Model) -> None:
        import casadi as ca

        equations = plant_equations(plant)
        self.system: System = translate(equations)
        self.turns = 1 if self.system.odd else 2  # half periods of the map
        self._sign = -1.0 if self.system.odd else 1.0
        self._plant = plant
        self._values = np.array([float(v) for v in plant.known_values()])
        states, names = ca.vertcat(*equations.states), ca.vertcat(*equations.parameters)
        arguments = [states, equations.drive, equations.direction, names]
        self._rates = ca.Function("rates", arguments, [equations.rates])

    def start(self, amplitude: float, omega: float) -> FloatArray:
        """Return the state at the peak of a sine that every element has followed."""
        inside = [e for e in self._plant.elements if e.n_states]
        followed = [_followed(element, amplitude, omega) for element in inside]
        return np.concatenate([[amplitude, 0.0], *followed])

    def closed(self, y: FloatArray, period: float) -> tuple[FloatArray, float, FloatArray] | None:
        """Return the state, the period and the map of the periodic motion to which these lead."""
        size = np.maximum(np.abs(y), 1e-3 * np.abs(y).max())
        at_rest = np.arange(y.size) == 1
        last: list[FloatArray] = []

        def state(z: FloatArray) -> FloatArray:
            return np.asarray(np.insert(z[:-1], 1, 0.0) * size)

        def missing(z: FloatArray) -> FloatArray:
            try:
                end, slope, rates = self._after(state(z), float(z[-1]) * period)
            except FitError:
                last[:] = [np.zeros((y.size, y.size))]
                return np.full(y.size, _LOST)
            columns = [((slope - np.eye(y.size)) * size)[:, ~at_rest], period * rates]
            last[:] = [np.column_stack(columns) / size[:, None], slope]
            return np.asarray((end - state(z)) / size)

        def slopes(z: FloatArray) -> FloatArray:
            missing(z)
            return last[0]

        begin = np.append((y / size)[~at_rest], 1.0)
        solution = least_squares(
            missing, begin, slopes, method="lm",
            xtol=1e-14, ftol=1e-14, max_nfev=_EVALUATIONS,
        )  # fmt: skip
        if not np.abs(solution.fun).max() < _CLOSED or solution.x[-1] <= 0.0:
            return None
        missing(solution.x)
        return state(solution.x), float(solution.x[-1]) * period, last[1]

    def _after(self, y: FloatArray, period: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return state, map and rates after a period, or after half of one with its sign."""
        motion = march(
            self.system, np.array([0.0, period]), np.zeros((1, 1)), np.array([0.0, period]), y,
            self._values, derivatives=True,
        )  # fmt: skip
        end = motion.states[-1]
        rates = self._rates(end, 0.0, np.sign(end[1]) or -self._sign, self._values).full()[:, 0]
        return self._sign * end, self._sign * motion.map, self._sign * rates

    def described(
        self, y: FloatArray, period: float, slope: FloatArray, near: tuple[float, float]
    ) -> FreeMotion | None:
        """Return size, frequency and stability of a motion; None where it is far from `near`."""
        whole = period * 2 / self.turns
        times = np.linspace(0.0, whole, _SAMPLES + 1)
        x = march(self.system, times[[0, -1]], np.zeros((1, 1)), times, y, self._values).output
        X = 2.0 * np.fft.rfft(x[:-1])[: _HIGHEST + 1] / _SAMPLES
        amplitude, omega = abs(X[1]), 2.0 * np.pi / whole
        apart = np.abs(np.log([max(amplitude, 1e-300) / near[0], omega / near[1]]))
        if apart.max() > _FARTHEST:
            return None
        others = np.append(0.5 * X[0], X[2:])
        multipliers = np.linalg.eigvals(slope)
        multipliers = np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))
        largest = float(np.abs(multipliers).max())
        growth = 0.0 if abs(largest - 1.0) < NEUTRAL else np.log(largest) / period
        share = float(np.linalg.norm(others)) / amplitude
        return FreeMotion(float(amplitude), float(omega), share, float(growth))


def _followed(element: Element, amplitude: float, omega: float) -> FloatArray:
    """Return an element's states at the peak of a sine that it has followed."""
    values = np.array([[float(v) for v in element.known_values()]])
    loop = settled(
        translate(law_equations(element)), np.array([amplitude]), np.array([omega]), values
    )
    return np.asarray(loop.starts[0, 2:])

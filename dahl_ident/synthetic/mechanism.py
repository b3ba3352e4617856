"""Simulation of a mechanism in time: displacement under a force, or force under a displacement."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, LinearSystem, Model
from dahl_ident.elements.element import as_model
from dahl_ident.elements.equations import (
    law_equations,
    numpy_names,
    plant_equations,
    symbolic_mechanics,
)
from dahl_ident.elements.rational import Rational
from dahl_ident.engine import Equations, march, translate
from dahl_ident.errors import FitError, ModelError
from dahl_ident.synthetic.waveform import SineStep, Waveform

_PER_PERIOD, _POINTS = 24, 8  # polynomials in a period, and their points: errors of 1e-13
_FINER = 1e4  # times finer than for fits of records: motions err by about 1e-11

Signal = Callable[[FloatArray], FloatArray]
"""The true value of a channel at any times, (n,) -> (n,)."""

Progress = Callable[[float], None]
"""Called with the completed fraction of a simulation."""


def displacement_under(plant: Element, force: Waveform, progress: Progress | None = None) -> Signal:
    """Return x(t) of a plant with known parameters for a force u(t), from rest."""
    plant = as_model(plant)
    if not plant.has_inertia:
        return _without_mass(plant, force, progress)
    try:
        return EngineMotion(plant_equations(plant), _values(plant), force, progress)
    except FitError as error:
        raise ModelError(
            "the motion grows beyond all bounds; the plant has no steady state under this "
            "force: control the displacement"
        ) from error


def _without_mass(plant: Model, force: Waveform, progress: Progress | None) -> Signal:
    """Return x(t) of friction with a spring, a damper or both."""
    laws, linear = _parts(plant)
    polynomial, proper = linear.split()
    if not np.any(linear.numerator):
        raise ModelError(
            "friction alone slides without bound under a force above f_max; give the plant a "
            "mass, a damper or a spring, or control its displacement"
        )
    if np.any(proper.numerator) or not all(law.rate_independent for law in laws):
        raise ModelError(
            f"{plant!r} has no state-space form; give the plant a mass, or control its displacement"
        )
    stiffness, damping = [*polynomial[::-1].tolist(), 0.0][:2]
    equations = _massless(laws, stiffness, damping)
    return EngineMotion(equations, (), force, progress, damping=damping)


def force_under(plant: Element, displacement: Waveform, progress: Progress | None = None) -> Signal:
    """Return the force F(t) of a plant with known parameters for a displacement, from rest."""
    laws, linear = _parts(as_model(plant))
    polynomial, proper = linear.split()
    if polynomial.size > 3:
        raise ModelError(
            f"the linear part's dynamic stiffness grows as s^{polynomial.size - 1}; under a "
            "prescribed displacement at most s^2, a mass, has a force"
        )
    parts: list[Signal] = [_law_force(law, displacement) for law in laws]
    if np.any(proper.numerator):
        import control

        system = control.tf(proper.numerator, proper.denominator)
        element = LinearSystem(system, quantity="dynamic_stiffness")
        parts.append(EngineMotion(law_equations(element), (), displacement, progress))

    def force(time: FloatArray) -> FloatArray:
        motion = displacement.motion(time)
        terms = [q * part for q, part in zip(polynomial[::-1], motion, strict=False)]
        return np.asarray(sum(terms) + sum(part(time) for part in parts))

    return force


def _parts(plant: Model) -> tuple[list[Element], Rational]:
    """Return the elements that are not linear, and the linear part n(s)/d(s)."""
    laws, linear = [], Rational(np.zeros(1), np.ones(1))
    for element in plant.elements:
        rational = element.rational_stiffness()
        if rational is None:
            laws.append(element)
        else:
            linear = linear + Rational(*rational).trimmed()
    return laws, linear


def _massless(laws: Sequence[Element], stiffness: float, damping: float) -> Equations:
    """Return the motion of laws with a spring, a damper or both, without a mass.

    ``k v + c dv/dt + (rate of the laws' force) = du/dt``, driven by du/dt. Without a damper, the
    force u is prescribed in place of a displacement, because displacement and u reverse together.
    """
    import casadi as ca

    x, v, s, u = (ca.SX.sym(name) for name in ("x", "v", "s", "u"))
    states: list[ca.SX] = []
    slopes: list[ca.SX] = []
    tangent = ca.SX(stiffness)
    with numpy_names():
        for law in laws:
            law_states = [ca.SX.sym(f"y{len(states) + i}") for i in range(law.n_states)]
            part = symbolic_mechanics(law, _values(law), x, s, s, law_states)
            rates = ca.vertcat(*part.rates) * s  # derivatives with respect to displacement
            tangent += ca.mtimes(ca.jacobian(part.force, ca.vertcat(*law_states)), rates)
            states, slopes = [*states, *law_states], [*slopes, rates]
    if damping:
        rates = ca.vertcat(v, (u - tangent * v) / damping, *(slope * v for slope in slopes))
        return Equations([x, v, *states], u, s, [], rates, x, held=False)
    displacement = ca.SX.sym("displacement")  # here x and v are the force and its rate
    speed = v / tangent
    rates = ca.vertcat(v, 0.0, speed, *(slope * speed for slope in slopes))
    return Equations([x, v, displacement, *states], u, s, [], rates, displacement, held=True)


class EngineMotion:
    """The solution of equations of motion under a waveform, starting at rest, at any times."""

    def __init__(
        self,
        equations: Equations,
        values: Sequence[float],
        waveform: Waveform,
        progress: Progress | None,
        *,
        damping: float | None = None,
    ) -> None:
        self._system = translate(equations)
        self._damping = (
            damping  # of a plant without mass, in which a jump of the force acts at once
        )
        self._values = np.array(values, dtype=np.float64)
        self._waveform = waveform
        self._first = [np.zeros(self._system.order)]  # the states at the start of each segment
        for segment in waveform.segments:
            _, last = self._along(segment, self._first[-1], np.array([segment.stop]))
            self._first.append(last)
            if damping is not None and len(self._first) <= len(waveform.segments):
                self._jump(segment, waveform.segments[len(self._first) - 1], damping)
            if progress is not None:
                progress(segment.stop / waveform.duration)

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the output at any times; outside the waveform, that at its ends."""
        output = np.empty(np.shape(time))
        for i, inside, t in self._waveform.by_segment(time):
            output[inside], _ = self._along(self._waveform.segments[i], self._first[i], t)
        return output

    def _jump(self, before: SineStep, after: SineStep, damping: float) -> None:
        """Apply the jump of the force at the start of a segment to the states."""
        at = np.array([before.stop])
        value = before.motion(at).value
        jump = after.motion(at).value - value
        if damping:
            self._first[-1][1] += jump[0] / damping
        elif jump[0]:
            ends, signal = np.array([0.0, 1.0]), np.array([value, jump])
            first = np.append([signal[0, 0], 0.0], self._first[-1][2:])
            motion = march(self._system, ends, signal, ends, first, self._values, finer=_FINER)
            self._first[-1] = motion.states[-1]

    def _along(
        self, segment: SineStep, first: FloatArray, time: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the output at times within a segment, and the states at its end."""
        steps = int(np.ceil(segment.duration * max(segment.frequency_hz) * _PER_PERIOD)) + 1
        knots = np.linspace(segment.start, segment.stop, steps + 1)
        nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)  # Chebyshev
        at = knots[:-1, None] + np.diff(knots)[:, None] * nodes
        wave = segment.motion(at.ravel())
        values = (wave.velocity if self._damping else wave.value).reshape(at.shape)
        signal: FloatArray = np.linalg.inv(np.vander(nodes, increasing=True)) @ values.T
        samples, inverse = np.unique(np.concatenate([knots, time]), return_inverse=True)
        if self._system.held:
            first = np.array([signal[0, 0], 0.0, *first[2:]])
        motion = march(self._system, knots, signal, samples, first, self._values, finer=_FINER)
        return motion.output[inverse[knots.size :]], motion.states[-1]


def _law_force(element: Element, displacement: Waveform) -> Signal:
    """Return the force of a law under a prescribed displacement, at any times from its start."""
    turns = displacement.turning_times()

    def force(time: FloatArray) -> FloatArray:
        times, inverse = np.unique(np.concatenate([turns, time]), return_inverse=True)
        motion = displacement.motion(times)
        forces = element.force_history(_values(element), motion.value, motion.velocity)
        return np.asarray(forces[inverse[turns.size :]])

    return force


def _values(element: Element) -> list[float]:
    return [float(v) for v in element.known_values()]

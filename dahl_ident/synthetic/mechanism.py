"""The motion of a mechanism in time, by the engine: displacement under a force, or the reverse."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, LinearSystem, Model
from dahl_ident.elements.element import as_model
from dahl_ident.elements.equations import law_equations, plant_equations
from dahl_ident.elements.rational import Rational
from dahl_ident.engine import Equations, march, translate
from dahl_ident.errors import FitError, ModelError
from dahl_ident.synthetic.waveform import SineStep, Waveform

_PER_PERIOD, _POINTS = 24, 8  # polynomials, and their points: they miss 1e-13 of a sine
_FINER = 1e4  # than records are fitted: motions are right to about 1e-11
_DAMPED = 1e-9  # relative error of a motion without mass in a step
_HALVINGS = 60  # of a path; beyond, it is exact to rounding

Signal = Callable[[FloatArray], FloatArray]
"""A channel's true value at any times, (n,) -> (n,)."""

Progress = Callable[[float], None]
"""Called with the completed fraction of a simulation."""


@dataclass(frozen=True)
class Mechanism:
    """A model whose parameters all have values, and its linear part n(s)/d(s)."""

    plant: Model
    laws: tuple[Element, ...]
    """Those that are not linear."""
    linear: Rational

    @classmethod
    def of(cls, plant: Element) -> Mechanism:
        """Return the parts of a model."""
        plant.known_values()
        plant = as_model(plant)
        laws = []
        linear = Rational(np.zeros(1), np.ones(1))
        for element in plant.elements:
            rational = element.rational_stiffness()
            if rational is None:
                laws.append(element)
            else:
                linear = linear + Rational(*rational).trimmed()
        return cls(plant, tuple(laws), linear)

    def displacement_under(self, force: Waveform, progress: Progress | None = None) -> Signal:
        """Return x(t) for a force u(t), from rest."""
        if not self.plant.has_inertia:
            return self._without_mass(force, progress)
        try:
            equations = plant_equations(self.plant)
            return EngineMotion(equations, _values(self.plant), force, progress)
        except FitError as error:
            raise ModelError(
                "the motion grows beyond all bounds; the plant has no steady state under this "
                "force: control the displacement"
            ) from error

    def _without_mass(self, force: Waveform, progress: Progress | None) -> Signal:
        """Return x(t) of friction with a spring, a damper or both."""
        if not np.any(self.linear.numerator):
            raise ModelError(
                "friction alone slides without bound under a force above f_max; give the plant a "
                "mass, a damper or a spring, or control its displacement"
            )
        polynomial, proper = self.linear.split()
        if np.any(proper.numerator) or any(
            law.branch(_values(law), 0.0, np.zeros(1)) is None for law in self.laws
        ):
            raise ModelError(
                f"{self.plant!r} has no state-space form; give the plant a mass, or control its "
                "displacement"
            )
        stiffness, damping = [*polynomial[::-1].tolist(), 0.0][:2]
        if damping:
            return DampedMotion(self.laws, stiffness, damping, force, progress)
        return SpringMotion(self.laws, stiffness, force)

    def force_under(self, displacement: Waveform, progress: Progress | None = None) -> Signal:
        """Return the force F(t) for a displacement x(t), from rest."""
        polynomial, proper = self.linear.split()
        if polynomial.size > 3:
            raise ModelError(
                f"the linear part's dynamic stiffness grows as s^{polynomial.size - 1}; under a "
                "prescribed displacement at most s^2, a mass, has a force"
            )
        q0, q1, q2 = [*polynomial[::-1].tolist(), 0.0, 0.0][:3]
        parts: list[Signal] = [_law_force(law, displacement) for law in self.laws]
        if np.any(proper.numerator):
            import control

            system = control.tf(proper.numerator, proper.denominator)
            element = LinearSystem(system, quantity="dynamic_stiffness")
            parts.append(EngineMotion(law_equations(element), (), displacement, progress))

        def force(time: FloatArray) -> FloatArray:
            motion = displacement.motion(time)
            total = q0 * motion.value + q1 * motion.velocity + q2 * motion.acceleration
            for part in parts:
                total = total + part(time)
            return np.asarray(total)

        return force


class SpringMotion:
    """The displacement of laws in parallel with a spring under a force, k x + F(x) = u."""

    def __init__(self, laws: Sequence[Element], stiffness: float, force: Waveform) -> None:
        self._laws, self._stiffness, self._force = laws, stiffness, force
        self._times = force.turning_times()
        self._u = force.value(self._times)
        self._heading = np.sign(np.diff(self._u, append=self._u[-1]))
        self._x = np.zeros(self._times.size)
        self._at_turn = np.zeros((self._times.size, len(laws)))
        for i in range(self._times.size - 1):
            x, forces = self._on_stroke(i, self._u[i + 1 : i + 2])
            self._x[i + 1], self._at_turn[i + 1] = x[0], forces[:, 0]

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the displacement at any times; that of the ends outside."""
        which = np.searchsorted(self._times, time, side="right") - 1
        which = np.clip(which, 0, self._times.size - 1)
        u, x = self._force.value(time), np.empty(np.shape(time))
        for i in np.unique(which).tolist():
            x[which == i] = self._on_stroke(i, u[which == i])[0]
        return x

    def _on_stroke(self, i: int, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return displacements, and the laws' forces, where the force has some values."""
        heading, start = self._heading[i], self._at_turn[i]
        low, high = np.zeros(u.shape), np.abs(u - self._u[i]) / self._stiffness
        forces = np.zeros((len(self._laws), u.size))
        for _ in range(_HALVINGS):
            path = 0.5 * (low + high)
            x = self._x[i] + heading * path
            for j, law in enumerate(self._laws):
                branch = law.branch(_values(law), heading * start[j], path)
                assert branch is not None  # such laws alone come here
                forces[j] = heading * branch[0]
            beyond = heading * (self._stiffness * x + forces.sum(axis=0) - u) > 0.0
            low, high = np.where(beyond, low, path), np.where(beyond, path, high)
        return x, forces


class DampedMotion:
    """The displacement of laws in parallel with a damper, and perhaps a spring, under a force.

    Between two turning points the laws' force is known in closed form. There the equation
    c dx/dt = u - k x - F(x) is integrated.
    """

    def __init__(
        self,
        laws: Sequence[Element],
        stiffness: float,
        damping: float,
        force: Waveform,
        progress: Progress | None,
    ) -> None:
        from scipy.integrate import solve_ivp

        self._stop = force.duration
        self._starts: list[float] = []
        self._pieces: list[Signal] = []
        turned_at, at_turn = 0.0, [0.0] * len(laws)
        levels = [level for segment in force.segments for level in segment.amplitude]
        omega = 2.0 * np.pi * force.highest_frequency_hz
        error = _DAMPED * max(levels) / float(np.hypot(stiffness, damping * omega))
        soon = force.segments[0].start + 1e-3 * force.segments[0].duration
        heading = -1.0 if force.value(np.array([soon]))[0] < 0.0 else 1.0

        def friction(x: FloatArray) -> list[float]:
            path = heading * (x - turned_at)
            branches = (
                law.branch(_values(law), heading * start, path)
                for law, start in zip(laws, at_turn, strict=True)
            )
            return [heading * float(branch[0]) for branch in branches if branch is not None]

        def speed(t: float, x: FloatArray) -> float:
            spring = stiffness * float(x[0])
            u = float(segment.value(np.asarray(t)))
            return (u - spring - sum(friction(x[0]))) / damping

        def turning(t: float, x: FloatArray) -> float:
            return heading * speed(t, x)

        turning.terminal, turning.direction = True, -1.0  # type: ignore[attr-defined]
        x = np.zeros(1)
        for segment in force.segments:
            t = segment.start
            while t < segment.stop:
                run = solve_ivp(
                    speed, (t, segment.stop), x, "LSODA", dense_output=True, events=turning,
                    rtol=_DAMPED, atol=error, max_step=0.02 / max(segment.frequency_hz),
                )  # fmt: skip
                self._starts.append(t)
                assert run.sol is not None  # a dense output was asked for
                self._pieces.append(run.sol)
                t, x = float(run.t[-1]), run.y[:, -1]
                if run.status == 1:
                    at_turn, turned_at, heading = friction(x[0]), float(x[0]), -heading
            if progress is not None:
                progress(segment.stop / force.duration)

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the displacement at any times; that of the ends outside."""
        t = np.clip(time, 0.0, self._stop)
        which = np.searchsorted(self._starts, t, side="right") - 1
        x = np.empty(t.shape)
        for i in np.unique(which).tolist():
            x[which == i] = self._pieces[i](t[which == i])[0]
        return x


class EngineMotion:
    """What equations give along a waveform, from rest, at any times within it."""

    def __init__(
        self,
        equations: Equations,
        values: Sequence[float],
        waveform: Waveform,
        progress: Progress | None,
    ) -> None:
        self._system = translate(equations)
        self._values = np.array(values, dtype=np.float64)
        self._waveform = waveform
        self._first = [np.zeros(self._system.order)]  # the states at the start of each segment
        for segment in waveform.segments:
            _, last = self._along(segment, self._first[-1], np.array([segment.stop]))
            self._first.append(last)
            if progress is not None:
                progress(segment.stop / waveform.duration)

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the output at any times; that of the ends outside."""
        t = np.clip(time, 0.0, self._waveform.duration)
        starts = np.array([segment.start for segment in self._waveform.segments])
        which = np.searchsorted(starts, t, side="right") - 1
        output = np.empty(t.shape)
        for i in np.unique(which).tolist():
            here = which == i
            segment = self._waveform.segments[i]
            output[here], _ = self._along(segment, self._first[i], t[here])
        return output

    def _along(
        self, segment: SineStep, first: FloatArray, time: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the output at some times of a segment, and the states at its end."""
        steps = int(np.ceil(segment.duration * max(segment.frequency_hz) * _PER_PERIOD)) + 1
        knots = np.linspace(segment.start, segment.stop, steps + 1)
        place = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
        at = knots[:-1, None] + np.diff(knots)[:, None] * place
        values = segment.value(at.ravel()).reshape(at.shape)
        signal: FloatArray = np.linalg.inv(np.vander(place, increasing=True)) @ values.T
        samples, back = np.unique(np.concatenate([knots, time]), return_inverse=True)
        if self._system.held:
            first = np.array([signal[0, 0], 0.0, *first[2:]])
        motion = march(self._system, knots, signal, samples, first, self._values, finer=_FINER)
        return motion.output[back[knots.size :]], motion.states[-1]


def _law_force(element: Element, displacement: Waveform) -> Signal:
    """Return the force of any law under a prescribed displacement, at any times from its start."""
    turns = displacement.turning_times()

    def force(time: FloatArray) -> FloatArray:
        every, back = np.unique(np.concatenate([turns, time]), return_inverse=True)
        motion = displacement.motion(every)
        forces = element.force_history(_values(element), motion.value, motion.velocity)
        return np.asarray(forces[back[turns.size :]])

    return force


def _values(element: Element) -> list[float]:
    return [float(v) for v in element.known_values()]

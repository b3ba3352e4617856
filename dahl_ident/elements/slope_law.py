"""What follows from the slope dF/dx of a law: loops, harmonics, derivatives, force, limits.

Settled loops and forces along histories are the engine's (:mod:`dahl_ident.elements.held_motion`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import held_motion
from dahl_ident.elements.behaviour import (
    SOFTENED,
    HistoryGradient,
    Mechanics,
    StiffnessGradient,
)
from dahl_ident.elements.element import Element, motion
from dahl_ident.errors import ModelError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.engine import Loops

_SMALLEST = 1e-100  # m; smaller amplitudes are rest
_FARTHEST = 1e9  # m; a law that has not slipped fully there never does
_SECTIONS = 16  # of a bracket, when the force is sought at which the slope vanishes
_START = 60  # steps from rest to the start of a path: as fine as a cycle of 240


class SlopeLaw(Element):
    """The mathematics of a law that is known by its slope; see :class:`dahl_ident.Friction`."""

    has_memory = True
    one_state: bool = True
    """Whether the present force is the only state of the law."""

    @abstractmethod
    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx, N/m, in plain arithmetic.

        Parameters
        ----------
        force : array
            F, N.
        direction : array
            Sign of the velocity, +1 or -1.
        velocity : array or None
            dx/dt, m/s; None for a law that is declared rate-independent. A law that uses it
            declares ``rate_independent = False``; where only its quasi-static behaviour is asked
            for, the velocity is 0.
        values : sequence of array
            The parameters in their declared order.

        Returns
        -------
        array
            Of the shape to which the arguments broadcast.
        """

    def output(self, force: Any, slope: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return the whole force from the state `force`, its slope dF/dx and the velocity.

        The state itself, except in a velocity-dependent law that damps in addition.
        """
        return force

    def quasi_static_slope(self, force: Any, direction: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx at vanishing speed.

        Raises
        ------
        ModelError
            If the law uses the velocity without declaring it.
        """
        if not self.rate_independent:
            return self.slope(force, direction, 0.0, values)
        try:
            return self.slope(force, direction, None, values)
        except TypeError as error:
            raise ModelError(
                f"{type(self).__name__}.slope failed without a velocity ({error}); a law that "
                "uses the velocity must declare rate_independent = False"
            ) from error

    def mechanics(
        self,
        values: Sequence[Any],
        displacement: Any,
        velocity: Any,
        direction: Any,
        states: Sequence[Any],
    ) -> Mechanics:
        """Return the present force, and its change over time: slope times velocity."""
        (force,) = states
        slope = self.slope(force, direction, velocity, values)
        return Mechanics(0.0, self.output(force, slope, velocity, values), (slope * velocity,))

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1 of the settled loop, unchecked; NaN where nothing settles."""
        return self._settled_gradient(values, amplitude, omega, harmonic, ()).value

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives; 0 with respect to parameters that are fixed."""
        free = [i for i, p in enumerate(self.parameters) if p.free]
        return self._settled_gradient(values, amplitude, omega, harmonic, free)

    def stiffness_slope(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return F/X of the fundamental and its derivative with respect to amplitude, unchecked."""
        found = self._settled_gradient(values, amplitude, omega, 1, ())
        return found.value, found.by_amplitude

    def _settled_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int,
        chosen: Sequence[int],
    ) -> StiffnessGradient:
        """Return F_k/X_1 with the derivatives `chosen`, the others 0."""
        at, rows = _rows_of(values, amplitude, omega, rated=not self.rate_independent)
        loops = self._loops(at, harmonic, chosen)
        A = at[:, 0]
        value = loops.coefficients[:, 0] / A
        rests = A <= _SMALLEST
        if self.rate_independent and rests.any():
            own = [np.asarray(v) for v in at[rests, 2:].T]
            value[rests] = self.rest_stiffness(own) if harmonic == 1 else 0.0
        by = np.zeros((len(values), A.size), dtype=np.complex128)
        by[list(chosen)] = loops.by_parameter[:, 0].T / A
        by_amplitude = (loops.by_amplitude[:, 0] - value) / A
        return StiffnessGradient(value[rows], by_amplitude[rows], tuple(d[rows] for d in by))

    def _loops(self, at: FloatArray, harmonic: int = 1, chosen: Sequence[int] = ()) -> Loops:
        """Return settled loops at rows of amplitude, frequency and values."""
        return held_motion.loops_of(self, at, harmonic, chosen)

    def force_history(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> FloatArray:
        """Return the force at every sample, unchecked.

        A law that depends on the rate moves at the mean of two samples' velocities between them.
        """
        v = velocity if self.rate_independent else motion(velocity, "velocity", displacement, self)
        return held_motion.force_along(self, values, displacement, v, state).value

    def force_history_gradient(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives; 0 by parameters that are fixed."""
        if not self.rate_independent:
            return super().force_history_gradient(values, displacement, velocity, state)
        free = [i for i, p in enumerate(self.parameters) if p.free]
        return held_motion.force_along(self, values, displacement, velocity, state, free)

    def states_at(self, values: Sequence[float], force: float) -> Sequence[float]:
        """Return the states from which a held motion starts with a force."""
        return (force,)

    def states_by_parameter(self, force: float) -> dict[int, tuple[int, float]]:
        """Return, by parameter, the one of these states that changes with it, and its slope."""
        return {}

    def force_limits(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return the forces of full slip in both directions, N; inf if there is none."""
        columns = [np.asarray(v)[..., None] for v in values]
        start = np.asarray(self.rest_stiffness(values) * _FARTHEST)
        shape = np.broadcast_shapes(start.shape, *(np.shape(v) for v in values))
        start = np.broadcast_to(start, shape)

        def rising(force: FloatArray) -> FloatArray:
            return np.asarray(self.quasi_static_slope(force, 1.0, columns)) + 0.0 * force

        def falling(force: FloatArray) -> FloatArray:
            return np.asarray(self.quasi_static_slope(-force, -1.0, columns)) + 0.0 * force

        return force_limit(rising, start), force_limit(falling, start)

    def rest_stiffness(self, values: Sequence[FloatArray]) -> FloatArray:
        """Return dF/dx at zero force, which N tends to at small amplitudes, N/m."""
        return np.asarray(self.quasi_static_slope(np.zeros(()), 1.0, values), dtype=np.float64)

    def force_bounds(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return upper bounds of abs(N) and A abs(N), from the slopes and the forces of slip.

        The fundamental of a wave of height 1 is at most 4/pi, that of the square wave.
        """
        limits = self.force_limits(values)
        highest = np.maximum(*limits)
        force = np.where(np.isfinite(highest), highest, 0.0)[..., None] * np.linspace(-1, 1, 101)
        columns = [np.asarray(v)[..., None] for v in values]
        steepest = self.quasi_static_slope(force, 1.0, columns).max(axis=-1)
        steepest = np.maximum(steepest, self.quasi_static_slope(force, -1.0, columns).max(axis=-1))
        steepest = np.where(np.isfinite(highest), 1.02 * steepest, np.inf)
        return 4.0 / np.pi * steepest, 4.0 / np.pi * highest

    def knee(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return where N begins to change and where full slip sets in, m.

        Twice the force limit over the stiffness at zero force; for a law that never slips fully,
        where 1 % and all but 1 % of the stiffness are gone, as far as that happens.
        """
        ratio = np.asarray(np.maximum(*self.force_limits(values)) / self.rest_stiffness(values))
        if np.all(np.isfinite(ratio)):
            return ratio, ratio
        A = np.geomspace(1e-12, 1e6, 109)
        columns = [np.asarray(v)[..., None] for v in values]
        with np.errstate(all="ignore"):
            N = np.abs(self.stiffness(columns, A, np.zeros(())))
            lost = np.abs(N / N[..., :1] - 1.0)
        known = np.isfinite(lost) & (lost < 1.0)
        low = A[np.argmax(lost > SOFTENED, axis=-1)]
        high = A[known.shape[-1] - 1 - np.argmax(known[..., ::-1], axis=-1)]
        return np.asarray(low), np.asarray(high)

    def answers(self, harmonic: int) -> bool:
        """Return whether the force may have this harmonic: even ones where directions differ."""
        if harmonic % 2:
            return True
        values = [
            np.asarray((p.scan or (1.0,))[-1] if p.free or p.value is None else p.value)
            for p in self.parameters
        ]
        force = np.linspace(-0.93, 0.97, 9)
        with np.errstate(all="ignore"):
            rising = np.asarray(self.quasi_static_slope(force, 1.0, values))
            falling = np.asarray(self.quasi_static_slope(-force, -1.0, values))
        return not np.allclose(rising, falling, rtol=1e-12, atol=0.0, equal_nan=True)

    def transient_decay(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return the factor by which a deviation from the settled loop shrinks in one cycle."""
        at, rows = _rows_of(values, amplitude, omega, rated=not self.rate_independent)
        return np.asarray(np.abs(self._loops(at).decays)[rows])

    def steady_force(
        self, values: Sequence[FloatArray], path: FloatArray, cycles: int
    ) -> FloatArray:
        """Return the force along closed paths of displacement, (..., n), by small steps."""
        return stepped(partial(self._step, values), path, cycles)

    def _step(
        self, values: Sequence[FloatArray], force: FloatArray, step: FloatArray
    ) -> FloatArray:
        """Return the force after a small step of displacement, by the midpoint rule."""
        heading = np.where(step < 0.0, -1.0, 1.0)
        middle = force + 0.5 * step * self.quasi_static_slope(force, heading, values)
        return np.asarray(force + step * self.quasi_static_slope(middle, heading, values))

    def _check_start(self, values: Sequence[float], initial_force: float) -> None:
        up, down = (float(v) for v in self.force_limits([np.asarray(v) for v in values]))
        if not -down <= initial_force <= up:
            raise ValidationError(
                f"initial_force is {initial_force!r}; expected a force between those of full "
                f"slip, {-down:g} and {up:g}"
            )

    def _loop(self, values: Sequence[float], amplitude: float, theta: FloatArray) -> FloatArray:
        """Return the force on the settled loop at angles from 0 to 2 pi."""
        top = self._loops(np.array([[amplitude, 1.0, *values]])).tops[0]
        x = amplitude * np.cos(theta)
        return self.force_history(values, x, -amplitude * np.sin(theta), float(top))


def _rows_of(
    values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray, *, rated: bool
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return rows of amplitude, frequency and values without repetition, and each point's row.

    Amplitudes of the same parameters rise from row to row.
    """
    speed = np.maximum(omega, _SMALLEST) if rated else np.ones(())  # at rest: quasi-static
    columns = np.broadcast_arrays(*values, speed, np.maximum(amplitude, _SMALLEST), omega)[:-1]
    every = np.column_stack([column.ravel() for column in columns]).astype(np.float64)
    at, rows = np.unique(every, axis=0, return_inverse=True)
    n = len(values)
    return at[:, [n + 1, n, *range(n)]], rows.reshape(columns[0].shape)


def force_limit(rising: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """Return the least force above 0 at which the slope vanishes, inf if there is none below.

    `rising` takes forces of shape (..., n), `start` is of shape (...).
    """
    fractions = np.arange(1, _SECTIONS + 1) / _SECTIONS
    low, width = np.zeros(start.shape), start.copy()
    found: NDArray[np.bool_] = np.ones(start.shape, dtype=bool)
    for step in range(60):
        with np.errstate(all="ignore"):
            stuck = ~(rising(low[..., None] + width[..., None] * fractions) > 0.0)
        if step == 0:
            found = np.asarray(stuck.any(axis=-1))
        stuck[..., -1] = True
        width = width / _SECTIONS
        low = low + width * stuck.argmax(axis=-1)
        if np.all((width <= 1e-16 * low) | ~found):
            break
    return np.where(found, low, np.inf)


def stepped(
    step: Callable[[FloatArray, FloatArray], FloatArray], path: FloatArray, cycles: int
) -> FloatArray:
    """Return the force along closed paths of displacement, (..., n), from one step to the next."""
    steps = np.diff(path, append=path[..., :1], axis=-1)
    force, found = np.zeros(path.shape[:-1]), np.empty(path.shape)
    for _ in range(_START):
        force = step(force, path[..., 0] / _START)
    for _ in range(cycles):
        for i in range(path.shape[-1]):
            found[..., i] = force
            force = step(force, steps[..., i])
    return found

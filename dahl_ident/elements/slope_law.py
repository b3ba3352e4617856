"""What follows from the slope dF/dx of a law: loops, harmonics, derivatives, force, limits.

Settled loops by quadrature (:mod:`dahl_ident.elements.steady_loop`), forces along histories by the
engine (:mod:`dahl_ident.elements.held_motion`).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
)
from dahl_ident.elements import held_motion
from dahl_ident.elements.behaviour import (
    SOFTENED,
    STENCIL,
    STEP,
    HistoryGradient,
    Mechanics,
    StiffnessGradient,
    central_differences,
)
from dahl_ident.elements.element import Element, motion
from dahl_ident.elements.rated_loop import RatedLoop, rated_loop
from dahl_ident.elements.steady_loop import Loop, Rows, closed_loop, force_limit
from dahl_ident.errors import ModelError, ValidationError

_BLOCK = 200  # loops computed together: their scratch arrays stay in the processor's cache
_AT_REST = 1e-150  # smaller amplitudes are rest
_SMALLEST = 1e-30  # m; the same for a velocity-dependent law
_RATED_BLOCK = 64  # velocity-dependent loops computed together: each solves a small linear system
_FARTHEST = 1e9  # m; a law that has not slipped fully there never does
_START = 60  # steps from rest to the start of a path: as fine as a cycle of 240
_FORCE_UNIT, _LENGTH_UNIT = 32.0, 2.0**-7  # units in which a law should have the same form


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
        """Return F_k/X_1 of the steady loop, unchecked."""
        if not self.rate_independent:
            return self._rated_stiffness(values, amplitude, omega, harmonic)
        values, A, shape, owner = _flat(values, amplitude, omega)
        result = np.zeros(A.shape, dtype=np.complex128)
        moving = np.flatnonzero(A > _AT_REST)
        for start in range(0, moving.size, _BLOCK):
            rows = moving[start : start + _BLOCK]
            loops = self._loops(values, A, rows, owner)
            result[rows] = loops.coefficients(harmonic) / A[rows]
        if harmonic == 1 and moving.size < A.size:
            rows = np.flatnonzero(A <= _AT_REST)
            result[rows] = _at_rest(self.quasi_static_slope, values, rows)
        return result.reshape(shape)

    def _rated_stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int,
    ) -> ComplexArray:
        """Return F_k/X_1 of a velocity-dependent law, by collocation."""
        values, A, shape, _ = _flat(values, amplitude, omega)
        if not self.answers(harmonic):
            return np.zeros(shape, dtype=np.complex128)
        w = np.broadcast_to(omega, shape).ravel().astype(np.float64)
        values, A, w, which = _distinct(values, np.maximum(A, _SMALLEST), w)
        result = np.empty(A.shape, dtype=np.complex128)
        for start in range(0, A.size, _RATED_BLOCK):
            rows = np.arange(start, min(start + _RATED_BLOCK, A.size))
            loop, own = self._rated(values, A, w, rows)
            with np.errstate(invalid="ignore"):  # NaN where there is no settled loop
                force = self.output(loop.force, loop.slope, loop.velocity, own)
                result[rows] = loop.coefficients(np.asarray(force), harmonic) / A[rows]
        return result[which].reshape(shape)

    def _rated_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int,
        wanted: Sequence[int],
    ) -> StiffnessGradient:
        """Return F_k/X_1 with the derivatives `wanted` by parameters, P the amplitude; 0 others.

        The slope's and the force's own derivatives are central differences of fourth order.
        """
        values, A, shape, _ = _flat(values, amplitude, omega)
        w = np.broadcast_to(omega, shape).ravel().astype(np.float64)
        values, A, w, which = _distinct(values, np.maximum(A, _SMALLEST), w)
        P = len(values)
        found = np.zeros((P + 2, A.size), dtype=np.complex128)
        for start in range(0, A.size if self.answers(harmonic) else 0, _RATED_BLOCK):
            rows = np.arange(start, min(start + _RATED_BLOCK, A.size))
            loop, own = self._rated(values, A, w, rows)
            rates = np.zeros((rows.size, len(wanted), loop.theta.size))
            with np.errstate(invalid="ignore", over="ignore"):
                for column, i in enumerate(wanted):
                    for place, weight in STENCIL:
                        v, at, _ = _moved(loop, own, i, place * STEP)
                        rates[:, column] += weight * self.slope(loop.force, loop.direction, v, at)
                    rates[:, column] /= _moved(loop, own, i, STEP)[2]
                    rates[:, column] += loop.slope if i == P else 0.0
                changes = loop.changed(A[rows], rates)
                for column, i in enumerate(wanted):
                    change = np.zeros(loop.force.shape)
                    for place, weight in STENCIL:
                        v, at, step = _moved(loop, own, i, place * STEP)
                        force = loop.force + step * changes[:, column]
                        slope = self.slope(force, loop.direction, v, at)
                        change += weight * np.asarray(self.output(force, slope, v, at))
                    change /= _moved(loop, own, i, STEP)[2]
                    found[1 + i, rows] = loop.coefficients(change, harmonic) / A[rows]
                whole = self.output(loop.force, loop.slope, loop.velocity, own)
                found[0, rows] = loop.coefficients(np.asarray(whole), harmonic) / A[rows]
        found[P + 1] = (found[P + 1] - found[0]) / A  # of F_k/A
        value, *by = (part[which].reshape(shape) for part in found)
        return StiffnessGradient(value, by[P], tuple(by[:P]))

    def _rated(
        self, values: Sequence[FloatArray], A: FloatArray, w: FloatArray, rows: Rows
    ) -> tuple[RatedLoop, list[FloatArray]]:
        own = [v[rows, None] if v.ndim else v for v in values]
        flat = _rows(values, rows)
        start = np.minimum(
            np.maximum(*self.force_limits(flat)), self.rest_stiffness(flat) * A[rows]
        )
        loop = rated_loop(
            lambda force, direction, velocity: np.asarray(
                self.slope(force, direction, velocity, own)
            ),
            A[rows], w[rows], np.broadcast_to(start, rows.shape),
        )  # fmt: skip
        return loop, own

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, by central differences of fourth order.

        Those of a velocity-dependent law are from the variational equation. Else two parameters
        need none where the units of all agree with the law: N is then homogeneous in the unit of
        force and in that of displacement, and Euler's theorem gives the two from the others.
        Derivatives by parameters that are fixed may be left at zero, which no estimate looks at.
        """
        P = len(values)
        wanted = {P, *(i for i, p in enumerate(self.parameters) if p.free)}
        if not self.rate_independent:
            return self._rated_gradient(values, amplitude, omega, harmonic, sorted(wanted))
        value = self.stiffness(values, amplitude, omega, harmonic)
        arguments = [np.asarray(v) for v in values] + [np.asarray(amplitude)]
        powers, pair = self._scaled_pair(arguments)
        others = {i for i, row in enumerate(powers) if any(row)} - {*pair}
        fewer = (wanted | others) - {*pair}
        if len(fewer) < len(wanted):
            wanted = fewer
        else:
            pair = ()

        def at(*moved: FloatArray) -> ComplexArray:
            return self.stiffness(moved[:-1], moved[-1], omega, harmonic)

        slopes = {i: central_differences(at, arguments, i, value.shape) for i in wanted}
        if pair:
            # a_i p_i dN/dp_i sums up to N, and b_i p_i dN/dp_i with A dN/dA to -N
            rest = np.stack([value, -value - arguments[P] * slopes[P]])
            for i in others:
                rest = rest - np.multiply.outer(powers[i], arguments[i] * slopes[i])
            solved = np.tensordot(np.linalg.inv(np.transpose([powers[i] for i in pair])), rest, 1)
            slopes |= {i: s / arguments[i] for i, s in zip(pair, solved, strict=True)}
        nothing = np.zeros(value.shape, dtype=np.complex128)
        by_parameter = tuple(slopes.get(i, nothing) for i in range(P))
        return StiffnessGradient(value, slopes[P], by_parameter)

    def _scaled_pair(
        self, arguments: Sequence[FloatArray]
    ) -> tuple[list[tuple[int, int]], tuple[int, ...]]:
        """Return powers of force and displacement in all units, and two that are independent.

        Two positive parameters; none where the units do not agree with the law. They do where the
        slope is the same with force and displacement in other units, powers of two that change no
        digit.
        """
        powers = [p.dimension[:2] if p.is_mechanical else (0, 0) for p in self.parameters]
        positive = [i for i, p in enumerate(self.parameters) if p.positive]
        pairs = [
            (i, j)
            for i, j in combinations(positive, 2)
            if powers[i][0] * powers[j][1] != powers[i][1] * powers[j][0]
        ]
        if not (pairs and self.rate_independent and self.one_state):
            return powers, ()
        *one, A = (np.asarray(np.quantile(v, 0.5, method="nearest")) for v in arguments)
        force = float(self.rest_stiffness(one)) * A * np.linspace(-1.5, 1.5, 12)
        other = [
            v * _FORCE_UNIT ** float(a) * _LENGTH_UNIT ** float(b)
            for v, (a, b) in zip(one, powers, strict=True)
        ]
        same = True
        with np.errstate(all="ignore"):
            for direction in (1.0, -1.0):
                s = self.quasi_static_slope(force, direction, one)
                t = self.quasi_static_slope(force * _FORCE_UNIT, direction, other)
                expected = np.asarray(s) * (_FORCE_UNIT / _LENGTH_UNIT)
                same &= np.allclose(t, expected, rtol=1e-12, atol=0.0, equal_nan=True)
        return powers, (pairs[0] if same else ())

    def stiffness_slope(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return F/X of the fundamental and its derivative with respect to amplitude, unchecked."""
        if not self.rate_independent:
            found = self._rated_gradient(values, amplitude, omega, 1, [len(values)])
            return found.value, found.by_amplitude
        value = self.stiffness(values, amplitude, omega)

        def at(moved: FloatArray) -> ComplexArray:
            return self.stiffness(values, moved, omega)

        return value, central_differences(at, [amplitude], 0, value.shape)

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
        values, _, shape, _ = _flat(values, np.zeros(()), np.zeros(()))
        rows = np.arange(int(np.prod(shape)))
        limits = []
        for side in (self._rising, self._falling):
            slope = partial(side, values)
            stiffness = slope(np.zeros((rows.size, 1)), rows)[:, 0]
            limits.append(force_limit(slope, stiffness * _FARTHEST).reshape(shape))
        return limits[0], limits[1]

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
        """Return the factor by which a deviation from the steady loop shrinks in one cycle.

        Along one direction a deviation changes as the slope does: by its ratio at the two tips.
        """
        values, A, shape, owner = _flat(values, amplitude, omega)
        result = np.ones(A.shape)
        rows = np.flatnonzero(A > _AT_REST)
        if not self.rate_independent:
            w = np.broadcast_to(omega, shape).ravel().astype(np.float64)
            result[rows] = np.abs(self._rated(values, A, w, rows)[0].decay)
        elif rows.size:
            loop = self._loops(values, A, rows, owner)
            ends = np.stack([loop.top, loop.bottom], axis=1)
            up = self._rising(_rows(values, rows), ends, np.arange(rows.size))
            down = self._falling(_rows(values, rows), -ends, np.arange(rows.size))
            result[rows] = np.maximum(up[:, 0] / up[:, 1], 0.0)
            result[rows] *= np.maximum(down[:, 1] / down[:, 0], 0.0)
        return result.reshape(shape)

    def behind_gap(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        gap: FloatArray,
        harmonic: int,
        *,
        derivatives: bool = True,
    ) -> StiffnessGradient | None:
        """Return F_k/X_1 of this law behind a gap, if wanted with derivatives, the gap's last.

        None where the law has no closed form for it.
        """
        return None

    def history_behind_gap(
        self,
        values: Sequence[FloatArray | float],
        gap: float,
        displacement: FloatArray,
        state: float,
        *,
        derivatives: bool = True,
    ) -> HistoryGradient | None:
        """Return the force behind a gap over time, if wanted with derivatives, the gap's last.

        None where the law has no closed form for it.
        """
        return None

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

    def _loops(self, values: Sequence[FloatArray], A: FloatArray, rows: Rows, owner: Rows) -> Loop:
        own = _rows(values, rows)
        sides = partial(self._rising, own), partial(self._falling, own)
        return closed_loop(*sides, A[rows], owner[rows])

    def _rising(self, values: Sequence[FloatArray], force: FloatArray, rows: Rows) -> FloatArray:
        own = [v[rows, None] if v.ndim else v for v in values]
        return np.asarray(self.quasi_static_slope(force, 1.0, own)) + 0.0 * force

    def _falling(self, values: Sequence[FloatArray], force: FloatArray, rows: Rows) -> FloatArray:
        own = [v[rows, None] if v.ndim else v for v in values]
        return np.asarray(self.quasi_static_slope(-force, -1.0, own)) + 0.0 * force

    def _loop(self, values: Sequence[float], amplitude: float, theta: FloatArray) -> FloatArray:
        """Return the force on the closed loop at angles from 0 to 2 pi."""
        at = [np.asarray(v) for v in values]
        one = np.zeros(1, dtype=np.intp)
        top = self._loops(at, np.array([amplitude]), one, one).top[0]
        x = amplitude * np.cos(theta)
        return self.force_history(values, x, -amplitude * np.sin(theta), float(top))


def _flat(
    values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
) -> tuple[list[FloatArray], FloatArray, tuple[int, ...], Rows]:
    """Return values and amplitudes as rows, single numbers left alone, and the whole shape.

    And the same number for rows with the same values.
    """
    arrays = [np.asarray(v, dtype=np.float64) for v in values]
    shape = np.broadcast_shapes(*(v.shape for v in arrays), np.shape(amplitude), np.shape(omega))
    flat = [np.broadcast_to(v, shape).ravel() if v.size != 1 else v.reshape(()) for v in arrays]
    batch = np.broadcast_shapes(*(v.shape for v in arrays))
    owner = np.broadcast_to(np.arange(math.prod(batch)).reshape(batch), shape).ravel()
    return flat, np.broadcast_to(amplitude, shape).ravel().astype(np.float64), shape, owner


def _distinct(
    values: Sequence[FloatArray], A: FloatArray, omega: FloatArray
) -> tuple[list[FloatArray], FloatArray, FloatArray, Rows]:
    """Return values, amplitudes and frequencies without repeated rows, and every row's place."""
    columns = [A, omega, *(v for v in values if v.ndim)]
    _, first, which = np.unique(
        np.column_stack(columns), axis=0, return_index=True, return_inverse=True
    )
    return _rows(values, first), A[first], omega[first], which.ravel()


def _moved(
    loop: RatedLoop, values: list[FloatArray], i: int, share: float
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Return velocity and values with one greater by a share, and by how much; last the speed."""
    if i == len(values):
        return loop.velocity * (1.0 + share), values, np.asarray(share)
    step = share * np.where(values[i] == 0.0, 1.0, np.abs(values[i]))
    return loop.velocity, [*values[:i], values[i] + step, *values[i + 1 :]], step


def _rows(values: Sequence[FloatArray], rows: NDArray[Any]) -> list[FloatArray]:
    return [v[rows] if v.ndim else v for v in values]


def _at_rest(slope: Callable[..., Any], values: Sequence[FloatArray], rows: Rows) -> FloatArray:
    """Return dF/dx at zero force."""
    force = np.zeros(rows.size)
    return np.asarray(slope(force, 1.0, _rows(values, rows))) + force


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

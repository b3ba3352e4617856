r"""The plant of Eqn. 53 in the time domain: displacement for a force that varies with time.

With H the linear part's receptance as a state-space system and F the Dahl forces,

    z' = A z + B w,   x = C z + D w,   w(t) = u(t) - sum F(x)

Between two reversals every Dahl force is a smooth function of x alone, known in closed form
from the force at the last turning point, so friction needs no integrated state and cannot drift
from Eqn. 2. Each interval is solved by collocation at the 13 Chebyshev points (Newton's method in
x; the linear states are eliminated exactly), and is halved until the last Chebyshev coefficients
are negligible compared with the motion. The interval ends where the velocity's polynomial changes
sign: the reversal is located exactly, and the next interval starts on the new branch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element
from dahl_ident.elements.rational import StateSpace
from dahl_ident.errors import ModelError
from dahl_ident.synthetic.trajectory import (
    DERIVATIVE,
    FINE,
    FINE_DERIVATIVE,
    INTEGRATION,
    NODES,
    TO_COEFFICIENTS,
    Trajectory,
    row_at,
)
from dahl_ident.synthetic.waveform import Segment, Waveform

Progress = Callable[[float], None]

_TOLERANCE = 1e-11  # of the peak, in one interval: a thousand of them leave 1e-8
_SHORTEST = 2.0**-30  # of the longest interval: only a motion without bounds asks for less
_ROOM_TO_GROW = 2.0**-11  # the last coefficients go as the 11th power of the length
_NEWTON_STEPS = 12  # at most; then the interval is too long
_NOISE = 1e-13  # of the peak: speeds below are rounding
_BEYOND_BOUNDS = 1e100  # m: far beyond any plant, and its square is still a number


def simulate_plant(
    system: StateSpace,
    friction: Sequence[Element],
    force: Waveform,
    progress: Progress | None = None,
) -> Trajectory:
    """Return the displacement of a plant that starts at rest with zero friction force.

    Parameters
    ----------
    system : StateSpace
        Receptance of the linear part, displacement over force.
    friction : sequence of Element
        Laws in parallel to it, whose branches have a closed form; may be empty.
    force : Waveform
        u(t), N.
    progress : callable, optional
        Called from time to time with the completed fraction of the time.

    Returns
    -------
    Trajectory
        x(t), m, from 0 to the end of `force`.
    """
    run = _Run(system, _Friction(friction))
    with np.errstate(all="ignore"):
        for segment in force.segments:
            run.advance(segment)
            if progress is not None:
                progress(segment.stop / force.duration)
    return Trajectory(
        np.array(run.starts), np.array(run.lengths), np.array(run.coefficients), force.duration
    )


class _Friction:
    """Laws on one branch each: the force as a function of displacement alone."""

    def __init__(self, elements: Sequence[Element]) -> None:
        self._laws = [(e, [float(v) for v in e.known_values()]) for e in elements]
        self._at_turn = [0.0] * len(elements)
        self._x_turn = 0.0
        self.direction = 1.0

    def force_and_slope(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the force and dF/dx at displacements on this branch, or on its continuation."""
        force, slope = np.zeros_like(x), np.zeros_like(x)
        for own, by_x in self._branches(x):
            force += self.direction * own
            slope += by_x
        return force, slope

    def turn(self, x: float) -> None:
        """Continue from `x` in the other direction."""
        self._at_turn = [self.direction * float(own) for own, _ in self._branches(np.asarray(x))]
        self._x_turn = x
        self.direction = -self.direction

    def _branches(self, x: FloatArray) -> Iterator[FloatArray]:
        """Yield force and slope of each law, the force counted in the direction of motion."""
        path = self.direction * (x - self._x_turn)
        for (law, values), at_turn in zip(self._laws, self._at_turn, strict=True):
            found = law.branch(values, self.direction * at_turn, path)
            assert found is not None
            yield found


class _Operator(NamedTuple):
    """The linear part over one length: states and displacement at the nodes after the first."""

    states_free: FloatArray  # from the states at its start, (12, n, n)
    states_driven: FloatArray  # from w at all nodes, (12, n, 13)
    x_free: FloatArray  # (12, n)
    x_driven: FloatArray  # (12, 13)
    softness: float  # largest change of x by a force of 1 within the interval


class _Interval(NamedTuple):
    """A solved interval: displacement and w at all nodes; excess > 1: it was too long."""

    x: FloatArray
    w: FloatArray
    excess: float


class _Run:
    """The state of a simulation, interval by interval."""

    def __init__(self, system: StateSpace, friction: _Friction) -> None:
        self._system = system
        self._friction = friction
        self._operators: dict[float, _Operator] = {}
        self._states = np.zeros(system.order)
        self._x = self._peak = 0.0
        self._length = self._length_after_turn = np.inf
        self._just_turned = self._flipped = False
        self.starts: list[float] = []
        self.lengths: list[float] = []
        self.coefficients: list[FloatArray] = []

    def advance(self, segment: Segment) -> None:
        """Continue to the end of one segment of the force."""
        # powers of two, so that only few operators are built
        longest = 2.0 ** float(np.floor(np.log2(0.25 / min(segment.frequency_hz))))
        self._length = min(self._length, longest)
        t = segment.start
        while t < segment.stop:
            t = self._step(segment, t, longest)

    def _step(self, segment: Segment, t: float, longest: float) -> float:
        """Try one interval from `t` and return the time that is reached; `t` where it failed."""
        left = segment.stop - t
        length = left if left <= self._length * (1.0 + 1e-9) else self._length
        operator = self._operator(length)
        interval = self._solve(operator, segment.value(t + length * NODES), longest / length)
        at_shortest = length <= longest * _SHORTEST
        if interval is None and at_shortest:
            raise ModelError(
                f"the motion grows beyond all bounds at {t:g} s; the plant has no steady state "
                "under this force"
            )
        if interval is None or (interval.excess > 1.0 and not at_shortest):
            self._length = _length_below(length)
            return t
        turn = self._first_turn(interval.x)
        if turn == 0.0 and not self._flipped:
            self._friction.turn(self._x)
            self._flipped = True
            return t
        if turn == 0.0:  # at rest within rounding: the direction is undefined
            turn = 1.0
        self._keep(t, length, interval)
        self._move_on(operator, interval, turn)
        self._choose_length(interval, longest, turned=turn < 1.0)
        return segment.stop if turn == 1.0 and length == left else t + turn * length

    def _operator(self, length: float) -> _Operator:
        if length not in self._operators:
            self._operators[length] = _operator(self._system, length)
        return self._operators[length]

    def _solve(self, operator: _Operator, u: FloatArray, refinement: float) -> _Interval | None:
        """Return displacement and w = u - F at the nodes, or None where Newton's method fails."""
        x = np.full(NODES.size, self._x)
        force, slope = self._friction.force_and_slope(x)
        driven = operator.x_driven[:, 1:]
        known = operator.x_free @ self._states + operator.x_driven[:, 0] * (u[0] - force[0])
        for _ in range(_NEWTON_STEPS):
            residual = known + driven @ (u[1:] - force[1:]) - x[1:]
            jacobian = driven * slope[1:]
            jacobian.flat[:: NODES.size] += 1.0
            if not np.isfinite(jacobian).all():
                return None
            change = np.linalg.solve(jacobian, residual)
            x[1:] += change
            force, slope = self._friction.force_and_slope(x)
            size = np.max(np.abs(change))
            moved = np.max(np.abs(x - self._x))
            if size <= 1e-8 * moved + 1e-15 * self._peak:
                break
        else:
            return None
        peak = max(self._peak, float(np.max(np.abs(x))))
        if not (np.isfinite(force).all() and peak < _BEYOND_BOUNDS):
            return None
        tail = _tail(x) + operator.softness * refinement * _tail(force)
        return _Interval(x, u - force, tail / (_TOLERANCE * peak) if tail > 0.0 else 0.0)

    def _first_turn(self, x: FloatArray) -> float:
        """Return the position in [0, 1] of the reversal; 0 if at the start, 1 if there is none."""
        speed = self._friction.direction * (FINE_DERIVATIVE @ x)
        from scipy.optimize import brentq

        noise = _NOISE * max(self._peak, float(np.max(np.abs(x))))
        backwards = speed < -noise
        if not backwards.any():
            return 1.0
        first = int(np.argmax(backwards))
        forwards = np.flatnonzero(speed[:first] > 0.0)
        if forwards.size == 0:
            return 0.0
        slope = self._friction.direction * (DERIVATIVE @ x)

        def speed_at(tau: float) -> float:
            return float(chebyshev.chebval(2.0 * tau - 1.0, slope))

        low, high = float(FINE[forwards[-1]]), float(FINE[first])
        if speed_at(low) <= 0.0:  # forwards by rounding alone
            return low
        return float(brentq(speed_at, low, high, xtol=1e-15))

    def _keep(self, t: float, length: float, interval: _Interval) -> None:
        self.starts.append(t)
        self.lengths.append(length)
        self.coefficients.append(TO_COEFFICIENTS @ interval.x)

    def _move_on(self, operator: _Operator, interval: _Interval, turn: float) -> None:
        """Store states and displacement at the end of the interval, or at the reversal."""
        states = operator.states_free @ self._states + operator.states_driven @ interval.w
        if turn < 1.0:
            row = row_at(turn)
            self._states = row @ np.vstack([self._states, states])
            self._x = float(row @ interval.x)
            self._friction.turn(self._x)
        else:
            self._states = states[-1]
            self._x = float(interval.x[-1])
        self._flipped = turn < 1.0
        self._peak = max(0.9 * self._peak, float(np.max(np.abs(interval.x))))

    def _choose_length(self, interval: _Interval, longest: float, *, turned: bool) -> None:
        """Take twice the length where that is safe; after a turn, the one after the last turn."""
        if self._just_turned:
            self._length_after_turn = self._length
        self._just_turned = turned
        if turned:
            self._length = min(self._length, self._length_after_turn)
        elif interval.excess < _ROOM_TO_GROW:
            self._length = min(2.0 * self._length, longest)


def _operator(system: StateSpace, length: float) -> _Operator:
    """Return the collocation solution of z' = A z + B w, x = C z + D w over `length`."""
    n, later = system.order, NODES.size - 1
    weights = length * INTEGRATION[1:]
    matrix = np.eye(later * n) - np.kron(weights[:, 1:], system.A)
    free = np.tile(np.eye(n), (later, 1)) + np.kron(weights[:, :1], system.A)
    driven = np.kron(weights, system.B[:, None])
    solution = np.linalg.solve(matrix, np.hstack([free, driven]))
    states_free = solution[:, :n].reshape(later, n, n)
    states_driven = solution[:, n:].reshape(later, n, NODES.size)
    x_driven = np.einsum("i,jik->jk", system.C, states_driven)
    x_driven[:, 1:] += system.D * np.eye(later)
    softness = float(np.max(np.sum(np.abs(x_driven[:, 1:]), axis=1)))
    x_free = np.einsum("i,jik->jk", system.C, states_free)
    return _Operator(states_free, states_driven, x_free, x_driven, softness)


def _tail(values: FloatArray) -> float:
    """Return the size of the last two Chebyshev coefficients."""
    return float(np.max(np.abs(TO_COEFFICIENTS[-2:] @ values)))


def _length_below(length: float) -> float:
    """Return the next lower power of two."""
    return float(2.0 ** (np.ceil(np.log2(length)) - 1.0))

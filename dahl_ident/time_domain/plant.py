"""A model as an equation of motion, driven by a force or by the motion of its base.

    (m_1 + m_2 + ...) dv/dt = drive - sum of the elements' forces,    dx/dt = v,
    dF_i/dt = slope_i(F_i, sgn v, v) v    for every element with memory

Base motion: x is the displacement relative to the base, and the drive is -m times the base's
acceleration. The state is x, v and the elements' own: one force for most that have memory.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Model
from dahl_ident.errors import ModelError
from dahl_ident.time_domain.one_state import Inputs, OneState, one_state
from dahl_ident.time_domain.runge_kutta import step
from dahl_ident.time_domain.switches import on_one_branch
from dahl_ident.time_domain.vectorised import Evaluator, vectorised

Excitation = Literal["force", "base"]


@contextmanager
def _numpy_names() -> Iterator[None]:
    """Allow numpy's names, which laws in plain arithmetic may use; casadi answers, and warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        yield


class Plant:
    """The equation of motion of a model, and one step of its integration on whole arrays.

    Parameters
    ----------
    model : Model
        Elements in parallel, at least one of them a mass.
    excitation : {"force", "base"}
        What the drive is: a force, N, or the acceleration of the base, m/s^2.

    Raises
    ------
    ModelError
        If nothing has inertia, or an element has no equation of motion.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> Plant(Dahl() + Mass(1.0), "force").order
    3
    """

    def __init__(self, model: Model, excitation: Excitation) -> None:
        self.model = model
        self.excitation = excitation
        self.order = 2 + sum(e.n_states for e in model.elements)
        self._state = [ca.SX.sym(f"y{i}") for i in range(self.order)]
        # fixed values as numbers, so that what follows from them is worked out once
        self._values = [
            ca.SX.sym(p.name) if p.free else ca.SX(float(p.value or 0.0)) for p in model.parameters
        ]
        self.free = [p.name for p in model.parameters if p.free]
        self._free = [v for v, p in zip(self._values, model.parameters, strict=True) if p.free]
        self._drive, self._direction = ca.SX.sym("u"), ca.SX.sym("s")
        inputs = [*self._state, self._drive, self._direction, *self._free]
        with _numpy_names():
            rates = self._rates()
        self._held, self._switches, self._sides = on_one_branch(inputs, rates)
        self.n_switches = len(self._switches)
        """How many switching functions the laws have; see :mod:`~.switches`."""

    def _rates(self) -> ca.SX:
        x, v, *states = self._state
        inertia, total = ca.SX(0.0), ca.SX(0.0)
        slopes: list[ca.SX] = []
        has_inertia = False
        for element, values in self.model.of(self._values):
            own, states = states[: element.n_states], states[element.n_states :]
            part = element.mechanics(values, x, v, self._direction, own)
            has_inertia = has_inertia or element.has_inertia
            if self.excitation == "base" and element.is_linear and element.n_states:
                raise ModelError(
                    f"{element!r} has inertia inside, and how the base moves it is not known; "
                    "build it from Mass, Damper and Spring, or drive the plant by a force"
                )
            inertia, total = inertia + part.inertia, total + part.force
            slopes += part.rates
        if not has_inertia:
            raise ModelError(
                f"{self.model!r} has no mass, so a force does not determine its motion; add "
                "Mass(), or give records with measured displacement and force"
            )
        push = self._drive if self.excitation == "force" else -inertia * self._drive
        return ca.vertcat(v, (push - total) / inertia, *slopes)

    def _stepped(self, output: Callable[[ca.SX], ca.SX]) -> tuple[Inputs, ca.SX]:
        """Return an output of state, drives with length, direction with sides, free values.

        States that follow the displacement are not integrated, but the others with their sums.
        """
        drives = [ca.SX.sym(f"u{i}") for i in range(6)]
        length = ca.SX.sym("h")
        state = ca.vertcat(*self._state)
        constant = [self._direction, *self._sides, *self._free]
        rates = ca.Function("rates", [state, self._drive, *constant], [self._held])
        bound = self._bound
        rest = [i for i in range(self.order) if i not in bound]
        by_place = ca.jacobian(self._held[bound], self._state[1])
        by_bound = ca.jacobian(self._held[rest], state[bound])
        push, stiffness = by_bound @ state[bound], by_bound @ by_place

        def own_rates(at: ca.SX, drive: ca.SX) -> ca.SX:
            whole = ca.SX.zeros(self.order)
            whole[rest] = at
            found = rates(whole, drive, *constant)[rest]
            return found + push + stiffness * (at[0] - state[0])

        after = ca.SX.zeros(self.order)
        after[rest] = step(own_rates, state[rest], drives, length)
        after[bound] = state[bound] + by_place * (after[0] - state[0])
        signs = [self._direction, *self._sides]
        return (self._state, [*drives, length], signs, self._free), output(after)

    @cached_property
    def _bound(self) -> list[int]:
        """States that follow the displacement on a branch, and act in proportion to themselves.

        Such as the forces of Jenkins elements, of which a plant may have many.
        """
        moving = ca.vertcat(*self._state, self._drive)
        by = ca.jacobian(self._held, moving)
        found = []
        for i in range(2, self.order):
            at_rest = ca.substitute(self._held[i], self._state[1], ca.SX(0.0))
            if not ca.depends_on(ca.vertcat(at_rest, by[i, 1], by[:, i]), moving):
                found.append(i)
        return found

    def _at_all(self, after: ca.SX) -> ca.SX:
        at = ca.vertcat(*self._state, *self._free)
        return ca.vertcat(after, ca.vec(ca.jacobian(after, at)))

    @cached_property
    def advance(self) -> Evaluator:
        """The state after a step."""
        return _arrays(*self._stepped(lambda after: after))

    @cached_property
    def advance_by_state(self) -> Evaluator:
        """The state after a step, then its derivatives by the state, column by column."""
        state = ca.vertcat(*self._state)
        return _arrays(
            *self._stepped(lambda after: ca.vertcat(after, ca.vec(ca.jacobian(after, state))))
        )

    @cached_property
    def advance_by_all(self) -> Evaluator:
        """As :attr:`advance_by_state`, then the derivatives by the parameters."""
        return _arrays(*self._stepped(self._at_all))

    @cached_property
    def one_advance(self) -> OneState:
        """As :attr:`advance`, for one state."""
        return one_state(*self._stepped(lambda after: after))

    @cached_property
    def one_advance_by_all(self) -> OneState:
        """As :attr:`advance_by_all`, for one state."""
        return one_state(*self._stepped(self._at_all))

    @cached_property
    def _first(self) -> Evaluator:
        starts: list[ca.SX] = []
        states = list(self._state[:2])
        with _numpy_names():
            for element, values in self.model.of(self._values):
                count = 1 if element.has_memory else element.n_states
                own = [ca.SX.sym(f"f{len(starts) + i}") for i in range(count)]
                states += element.initial_states(values, own[0]) if element.has_memory else own
                starts += own
        inputs = [*self._state[:2], *starts, *self._free]
        first = ca.vertcat(*states)
        by = ca.jacobian(first, ca.vertcat(*inputs))
        return vectorised(inputs, ca.vertcat(first, ca.vec(by)))

    def first(self, own: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state at the first sample, and its derivatives.

        Parameters
        ----------
        own : ndarray, shape (m,)
            Displacement, velocity, the start of each element with memory and the states of those
            without.
        values : ndarray, shape (P,)
            Free parameters.

        Returns
        -------
        state : ndarray, shape (order,)
        by : ndarray, shape (order, m + P)
        """
        found = np.array(self._first(*own.tolist(), *values.tolist()), dtype=np.float64)
        return found[: self.order], found[self.order :].reshape(-1, self.order).T

    @cached_property
    def push(self) -> Evaluator:
        """The acceleration, of state, drive, direction, sides and free values."""
        return _arrays(*self._at_a_moment([self._held[1]]))

    @cached_property
    def one_push(self) -> OneState:
        """As :attr:`push`, for one state."""
        return one_state(*self._at_a_moment([self._held[1]]))

    @cached_property
    def switches(self) -> Evaluator:
        """The velocity and the switching functions, then their rates of change.

        Of state, drive, direction, sides and free values.
        """
        return _arrays(*self._at_a_moment(self._switching()))

    @cached_property
    def one_switches(self) -> OneState:
        """As :attr:`switches`, for one state."""
        return one_state(*self._at_a_moment(self._switching()))

    def _switching(self) -> list[ca.SX]:
        functions = ca.vertcat(self._state[1], *self._switches)
        return [functions, ca.jacobian(functions, ca.vertcat(*self._state)) @ self._held]

    @cached_property
    def passages(self) -> tuple[Evaluator, ...]:
        """What each switching function does to the state where it passes through zero.

        Of state, drive, direction, sides before the passage and free values. The state's change,
        which puts right what the place is off; then the derivatives by state and free parameters
        of the state after it: the rates may jump, and other values pass at another time.
        """
        return tuple(_arrays(*self._at_a_moment(found)) for found in self._passing())

    @cached_property
    def one_passages(self) -> tuple[OneState, ...]:
        """As :attr:`passages`, for one state."""
        return tuple(one_state(*self._at_a_moment(found)) for found in self._passing())

    def _passing(self) -> Iterator[list[ca.SX]]:
        at = ca.vertcat(*self._state, *self._free)
        for function, side in zip(self._switches, self._sides, strict=True):
            jump = ca.substitute(self._held, side, -side) - self._held
            speed = ca.jacobian(function, ca.vertcat(*self._state)) @ self._held
            late = ca.if_else(speed == 0.0, 0.0 * jump, jump / speed)
            by = ca.jacobian(ca.vertcat(*self._state), at) + late @ ca.jacobian(function, at)
            yield [late * function, ca.vec(by)]

    @cached_property
    def acceleration(self) -> Evaluator:
        """The acceleration, then its derivatives by the state and the free parameters.

        Of state, drive, direction, sides and free values.
        """
        at = ca.vertcat(*self._state, *self._free)
        found = [self._held[1], ca.vec(ca.jacobian(self._held[1], at))]
        return _arrays(*self._at_a_moment(found))

    def _at_a_moment(self, outputs: list[ca.SX]) -> tuple[Inputs, ca.SX]:
        signs = [self._direction, *self._sides]
        return (self._state, [self._drive], signs, self._free), ca.vertcat(*outputs)


def _arrays(inputs: Inputs, outputs: ca.SX) -> Evaluator:
    return vectorised([symbol for group in inputs for symbol in group], outputs)

"""Maxwell slip and backlash driven by a force: scipy with located events, slopes, recovery."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dahl_ident as di
from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Element, Model
from tests.motions import Driven, differences, slopes
from tests.test_forced_motion import RATE, multisine
from tests.test_record_laws import assert_recovered

SAMPLES = 64
LINEAR = di.Mass(2.0) + di.Damper(10.0) + di.Spring(3e4)
STIFFNESSES, SLIPS = [2e4, 1e4], [2e-4, 5e-4]
MANY = [1e4, 8e3, 6e3, 4e3, 3e3, 2e3], [3e-5, 8e-5, 2e-4, 4e-4, 6e-4, 1e-3]
F_MAX, SIGMA, GAP = 20.0, 4e4, 4e-4
PLACE = 1e-4  # at the first sample

Event = Callable[[float, FloatArray], float]


def by_events(
    start: Sequence[float],
    rates: Callable[[FloatArray, float, list[bool]], list[float]],
    guards: Callable[[FloatArray, float, list[bool]], list[float]],
    passed: Callable[[FloatArray, float, list[bool], int], None],
    flags: list[bool],
) -> FloatArray:
    """Return displacement and velocity by DOP853, stopped where it turns or a guard rises to 0.

    `passed` puts the state and the flags right after guard i; -1 is a turn.
    """
    _, drive = multisine(SAMPLES)
    times = np.arange(SAMPLES) / RATE
    out, place, now, y = np.empty((SAMPLES, 2)), 0, 0.0, np.array([PLACE, 0.0, *start])
    s = 1.0 if drive(0.0) - 3e4 * PLACE > 0.0 else -1.0
    while place < SAMPLES:

        def motion(t: float, y: FloatArray, s: float = s) -> list[float]:
            push = drive(t) - 10.0 * y[1] - 3e4 * y[0]
            force, *own = rates(y, s, flags)
            return [y[1], (push - force) / 2.0, *own]

        def turn(_: float, y: FloatArray) -> float:
            return float(y[1])

        turn.terminal, turn.direction = True, -s  # type: ignore[attr-defined]
        events: list[Event] = [turn]
        for i in range(len(guards(y, s, flags))):

            def guard(_: float, y: FloatArray, i: int = i, s: float = s) -> float:
                return guards(y, s, flags)[i]

            guard.terminal, guard.direction = True, 1.0  # type: ignore[attr-defined]
            events.append(guard)
        found = solve_ivp(
            motion, (now, times[-1] + 1e-9), y, method="DOP853", rtol=1e-11, atol=1e-13,
            max_step=0.3 / RATE, events=events, dense_output=True,
        )  # fmt: skip
        now, y = float(found.t[-1]), found.y[:, -1].copy()
        here = times[place:][times[place:] <= now]
        if here.size and found.sol is not None:
            out[place : place + here.size] = found.sol(here)[:2].T
            place += here.size
        for i, hits in enumerate(found.t_events or ()):
            if hits.size and i == 0:
                y[1] = 0.0
                passed(y, s, flags, -1)
                s = -s
            elif hits.size:
                passed(y, s, flags, i - 1)
    return out


def slipping(stiffnesses: list[float], places: list[float]) -> FloatArray:
    """Return the motion with Jenkins elements; a flag where one slips."""
    n = len(places)

    def rates(y: FloatArray, _: float, slips: list[bool]) -> list[float]:
        own = [0.0 if gone else k * y[1] for k, gone in zip(stiffnesses, slips, strict=True)]
        return [float(np.sum(y[2:])), *own]

    def guards(y: FloatArray, s: float, slips: list[bool]) -> list[float]:
        return [-1.0 if slips[i] else s * y[2 + i] - stiffnesses[i] * places[i] for i in range(n)]

    def passed(y: FloatArray, s: float, slips: list[bool], i: int) -> None:
        if i < 0:
            slips[:] = [False] * len(slips)
        else:
            slips[i], y[2 + i] = True, s * stiffnesses[i] * places[i]

    return by_events([0.0] * n, rates, guards, passed, [False] * n)


def crossing() -> FloatArray:
    """Return the motion with Dahl friction behind a gap; flags: in the gap, loading."""

    def rates(y: FloatArray, s: float, flags: list[bool]) -> list[float]:
        if flags[0]:
            return [y[2], 0.0, y[1]]
        return [y[2], SIGMA * (1.0 - s * y[2] / F_MAX) * y[1], 0.0]

    def guards(y: FloatArray, s: float, flags: list[bool]) -> list[float]:
        if flags[0]:
            return [s * y[3] - 0.5 * GAP]
        return [-1.0 if flags[1] else s * y[2]]

    def passed(y: FloatArray, s: float, flags: list[bool], i: int) -> None:
        if i < 0:
            flags[1] = not flags[1]
        elif flags[0]:
            flags[:], y[3] = [False, True], s * 0.5 * GAP
        else:
            flags[:], y[2] = [True, True], 0.0

    return by_events([0.0, 0.0], rates, guards, passed, [True, True])


LAWS: list[tuple[Element, list[float], Callable[[], FloatArray]]] = [
    (di.MaxwellSlip(2) + LINEAR, [*STIFFNESSES, *SLIPS], partial(slipping, STIFFNESSES, SLIPS)),
    (di.Backlash(di.Dahl()) + LINEAR, [F_MAX, SIGMA, GAP], crossing),
    (di.MaxwellSlip(6) + LINEAR, [*MANY[0], *MANY[1]], partial(slipping, *MANY)),
]


def plant(model: Element) -> Driven:
    return Driven(model, multisine(SAMPLES)[0], RATE)


@pytest.mark.parametrize(("law", "values", "expected"), LAWS)
def test_motion_against_scipy(
    law: Element, values: list[float], expected: Callable[[], FloatArray]
) -> None:
    driven = plant(law)
    first, *_ = driven.first(np.array([PLACE, 0.0, 0.0]), values)
    found = driven.motion(first, values).states
    reference = expected()
    error = np.abs(found[:, :2] - reference).max(axis=0) / np.abs(reference).max(axis=0)
    assert error.max() < 1e-8


@pytest.mark.parametrize(
    ("law", "values", "start"),
    [(*LAWS[0][:2], 3.0), (*LAWS[1][:2], 2.5e-4), (*LAWS[2][:2], 3.0)],
)
def test_slopes_are_derivatives(law: Element, values: list[float], start: float) -> None:
    driven, starts = plant(law), np.array([PLACE, 0.01, start])
    _, found = slopes(driven, starts, np.array(values))
    for i, expected in enumerate(differences(driven, starts, np.array(values), 1e-3)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 2e-6, i


def test_springs_start_where_the_backbone_has_the_force() -> None:
    law = di.MaxwellSlip(SLIPS, STIFFNESSES)
    values = [*STIFFNESSES, *SLIPS]
    for x in (-3e-4, 1e-4, 4e-4, 9e-4):
        force = float(
            np.sign(x) * law.backbone([np.asarray(v) for v in values], np.asarray(abs(x)))
        )
        expected = [k * np.clip(x, -d, d) for k, d in zip(STIFFNESSES, SLIPS, strict=True)]
        assert law.initial_states(values, force) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("law", "model"),
    [
        (di.MaxwellSlip(SLIPS, STIFFNESSES), di.MaxwellSlip(SLIPS)),
        (di.Backlash(di.Dahl(F_MAX, SIGMA), gap=GAP), di.Backlash(di.Dahl())),
    ],
)
def test_recovered(law: Element, model: Element) -> None:
    wave, _ = multisine(SAMPLES)
    wave = np.tile(wave, 3)
    whole = Model(law + LINEAR)
    driven = Driven(whole, wave, RATE)
    x = driven.motion(np.zeros(driven.order)).output
    x = x + 1e-3 * x.std() * np.random.default_rng(0).standard_normal(x.size)
    record = di.Record(np.arange(x.size) / RATE, displacement=x, force=wave)
    free = Model(model + di.Mass() + di.Damper() + di.Spring())
    names = [p.name for p in free.parameters if p.free]
    start = {p.name: 1.05 * float(p.value or 0.0) for p in whole.parameters if p.name in names}
    assert_recovered(di.fit(record, free, start=start), whole)

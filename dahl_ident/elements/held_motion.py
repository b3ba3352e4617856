"""The force of a law under a displacement that is held, by the engine.

Laws are compiled once, and moved along a history in one integration, with exact derivatives. A law
that does not depend on the rate is moved at unit speed: time is then the path, and a step may be as
long as the way between two turning points.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.behaviour import HistoryGradient
from dahl_ident.elements.element import Element
from dahl_ident.elements.equations import law_equations

if TYPE_CHECKING:
    from dahl_ident.elements.slope_law import SlopeLaw
    from dahl_ident.engine import Loops, Motion, System

_SYSTEMS: dict[Hashable, System] = {}
"""Compiled equations by law; not kept on the laws, which are sent to other processes."""

_SLOWEST = 1e-6  # of the largest speed
_FINER = 10.0  # than a driven motion, where a step is not that across a narrow gap


def system_of(
    law: Element, values: Sequence[FloatArray | float], chosen: Sequence[int] = ()
) -> System:
    """Return the compiled equations of a law, whose fixed parameters have their values or vary."""
    parameters = tuple(
        p.freed() if i in chosen or p.value is None or bool(np.any(np.asarray(v) != p.value)) else p
        for i, (p, v) in enumerate(zip(law.parameters, values, strict=True))
    )
    law = law.with_bound(parameters)
    form = _form(law)
    if form not in _SYSTEMS:
        from dahl_ident.engine import translate

        _SYSTEMS[form] = translate(law_equations(law))
    return _SYSTEMS[form]


def _form(law: Element) -> Hashable:
    """Return what the equations of a law depend on: its class, constants and other attributes."""
    constants = tuple(None if p.free else p.value for p in law.parameters)
    others = tuple(
        (name, _form(value) if isinstance(value, Element) else repr(value))
        for name, value in sorted(law.__dict__.items())
        if name not in ("parameters", "_name")
    )
    return (type(law), tuple(c if c in (0.0, 1.0) else None for c in constants), others)


def loops_of(
    law: Element,
    at: FloatArray,
    harmonic: int,
    chosen: Sequence[int],
    *,
    gap: bool = False,
) -> Loops:
    """Return the settled loops of a law at rows of amplitude, frequency and values.

    If `gap`, a gap in the link to the law follows its values.
    """
    from dahl_ident.engine import loops

    n = len(law.parameters)
    system = system_of(law, list(at[:, 2 : 2 + n].T), [i for i in chosen if i < n])
    return loops(
        system, at[:, 0], at[:, 1], at[:, 2:], chosen=chosen, harmonics=(harmonic,), gap=gap
    )


def force_along(
    law: SlopeLaw,
    values: Sequence[FloatArray | float],
    displacement: FloatArray,
    velocity: FloatArray | None,
    state: float,
    chosen: Sequence[int] | None = None,
) -> HistoryGradient:
    """Return the force at every sample of a displacement, with the derivatives `chosen`, others 0.

    Between samples the displacement is monotone, and its speed constant: the mean of the two
    samples where the law depends on it. `state` is the force at the first sample.
    """
    numbers = [float(v) for v in values]
    steps = np.diff(displacement)
    speed = np.ones(())
    if velocity is not None and not law.rate_independent:
        speed = 0.5 * np.abs(velocity[1:] + velocity[:-1])
        speed = np.maximum(speed, _SLOWEST * speed.max(initial=0.0))
    with np.errstate(all="ignore"):
        times = np.append(0.0, np.cumsum(np.where(steps == 0.0, 0.0, np.abs(steps) / speed)))
    moves = np.flatnonzero(steps)
    corners = moves
    if law.rate_independent:
        heading = np.sign(steps[moves])
        corners = moves[1:][heading[1:] != heading[:-1]]
        corners = np.append(0, corners)
    corners = np.append(corners, displacement.size - 1)
    by = np.zeros((len(values), displacement.size))
    force, by_state = np.full(displacement.shape, state), np.ones(displacement.shape)
    if moves.size:
        knots = displacement[corners], times[corners]
        found = _along(law, numbers, *knots, times, law.states_at(numbers, state), chosen)
        force = found.states[:, 2]
        if chosen is not None:
            by_state = found.by_first[:, 2]
            by[list(chosen)] = found.by_parameter.T
            for i, (place, slope) in law.states_by_parameter(state).items():
                if i in chosen:
                    by[i] += slope * found.by_first[:, 2 + place]
    if velocity is not None and not law.rate_independent:
        own = [np.asarray(v) for v in values]
        slope = law.slope(force, np.where(velocity < 0.0, -1.0, 1.0), velocity, own)
        force = np.asarray(law.output(force, slope, velocity, own)) + 0.0 * force
    return HistoryGradient(force, by_state, tuple(by))


def _along(
    law: SlopeLaw,
    values: Sequence[float],
    corners: FloatArray,
    knots: FloatArray,
    times: FloatArray,
    states: Sequence[float] | FloatArray,
    chosen: Sequence[int] | None = None,
) -> Motion:
    """Return the motion from corner to corner at constant speed; at the knots it is there."""
    from dahl_ident.engine import Motion, march

    samples, back = np.unique(np.append(0.0, times), return_inverse=True)
    found = march(
        system_of(law, values, chosen or ()), knots, np.stack([corners[:-1], np.diff(corners)]),
        samples, np.array([corners[0], 0.0, *states]), np.asarray(values, dtype=np.float64),
        chosen=chosen or (), derivatives=chosen is not None,
        finer=_FINER if law.n_states == 1 else 1.0,
    )  # fmt: skip
    rows = back[1:]
    output, by_first, by_parameter, states = (part[rows] for part in found[:-1])
    return Motion(output, by_first, by_parameter, states, found.map)

"""The force of a law under a displacement that is held, by the engine.

Laws are compiled once, and moved along a history in one integration, with exact derivatives. A law
that does not depend on the rate is moved at unit speed: time is then the path, and a step may be as
long as the way between two turning points.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element, as_model
from dahl_ident.elements.equations import FirstState, law_equations
from dahl_ident.elements.facts import HistoryGradient, Path

if TYPE_CHECKING:
    from dahl_ident.elements.friction import Friction
    from dahl_ident.engine import Loops, System

_SYSTEMS: dict[Hashable, System] = {}
"""Compiled equations by law; not kept on the laws, which are sent to other processes."""
_FIRST: dict[Hashable, FirstState] = {}
"""How first states follow from what is unknown there, by law."""

_SLOWEST = 1e-6  # of the largest speed
_FINER = 10.0  # than a driven motion, where a step is not that across a narrow gap


def system_of(law: Element, values: Sequence[Any], chosen: Sequence[int] = ()) -> System:
    """Return the compiled equations of a law, whose fixed parameters have their values or vary."""
    law = law.with_bound(
        tuple(
            p.freed() if i in chosen or p.value is None or bool(np.any(v != p.value)) else p
            for i, (p, v) in enumerate(zip(law.parameters, values, strict=True))
        )
    )
    form = form_of(law)
    if form not in _SYSTEMS:
        from dahl_ident.engine import translate

        _SYSTEMS[form] = translate(law_equations(law))
    return _SYSTEMS[form]


def _first_of(law: Element) -> FirstState:
    form = form_of(law)
    if form not in _FIRST:
        _FIRST[form] = FirstState(as_model(law))
    return _FIRST[form]


def form_of(law: Element) -> Hashable:
    """Return what the equations of a law depend on: its class, constants and other attributes."""
    constants = tuple(None if p.free else p.value for p in law.parameters)
    others = tuple(
        (name, form_of(value) if isinstance(value, Element) else repr(value))
        for name, value in sorted(law.__dict__.items())
        if name not in ("parameters", "_name")
    )
    return (type(law), tuple(c if c in (0.0, 1.0) else None for c in constants), others)


def loops_of(
    law: Element, at: FloatArray, orders: Sequence[int], chosen: Sequence[int], *, gap: bool = False
) -> Loops:
    """Return the settled loops of a law at rows of amplitude, frequency and values.

    If `gap`, a gap in the link to the law follows its values.
    """
    from dahl_ident.engine import loops

    n = len(law.parameters)
    system = system_of(law, list(at[:, 2 : 2 + n].T), [i for i in chosen if i < n])
    return loops(system, at[:, 0], at[:, 1], at[:, 2:], chosen=chosen, harmonics=orders, gap=gap)


def force_along(
    law: Friction,
    values: Sequence[Any],
    path: Path,
    state: float | FloatArray,
    chosen: Sequence[int] | None = None,
) -> HistoryGradient:
    """Return the force at every sample of a displacement, with the derivatives `chosen`, others 0.

    Between samples the displacement is monotone, and its speed constant: the mean of the two
    samples where the law depends on it. `state` is the unknown, or the unknowns, at the first.
    """
    from dahl_ident.engine import march

    x, numbers = path.displacement, np.array([float(v) for v in values])
    velocity = None if law.rate_independent else path.velocity
    steps, speed = np.diff(x), np.ones(())
    if velocity is not None:
        speed = 0.5 * np.abs(velocity[1:] + velocity[:-1])
        speed = np.maximum(speed, _SLOWEST * speed.max(initial=0.0))
    with np.errstate(all="ignore"):
        times = np.append(0.0, np.cumsum(np.where(steps == 0.0, 0.0, np.abs(steps) / speed)))
    corners = moves = np.flatnonzero(steps)
    if law.rate_independent:
        heading = np.sign(steps[moves])
        corners = np.append(0, moves[1:][heading[1:] != heading[:-1]])
    corners = np.append(corners, x.size - 1)
    starts = np.append([x[0], 0.0], state)
    first, by_start, by_value = _first_of(law)(starts, numbers)
    by, by_first = np.zeros((len(values), x.size)), np.zeros((x.size, first.size))
    if not moves.size:
        part = law.mechanics(values, x[0], 0.0, 1.0, first[2:].tolist())
        force = np.full(x.shape, first[2] if velocity is not None else part.force)
    else:
        samples, rows = np.unique(times, return_inverse=True)
        motion = march(
            system_of(law, values, chosen or ()), times[corners],
            np.stack([x[corners[:-1]], np.diff(x[corners])]), samples,
            np.append([x[corners[0]], 0.0], first[2:]), numbers, chosen=chosen or (),
            derivatives=chosen is not None, finer=_FINER if law.n_states == 1 else 1.0,
        )  # fmt: skip
        force = (motion.output if velocity is None else motion.states[:, 2])[rows]
        if chosen is not None:
            by_first, by[list(chosen)] = motion.by_first[rows], motion.by_parameter[rows].T
            by[list(chosen)] += (by_first @ by_value[:, list(chosen)]).T
    if velocity is not None:
        slopes = law.slope(force, np.where(velocity < 0.0, -1.0, 1.0), velocity, values)
        force = np.asarray(law.output(force, slopes, velocity, values)) + 0.0 * force
    return HistoryGradient(force, (by_first @ by_start[:, 2:]).squeeze(), tuple(by))

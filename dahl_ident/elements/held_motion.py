"""The force of a law under a prescribed displacement, by the engine.

Laws are compiled once, and integrated along a history with exact derivatives. A rate-independent
law is moved at unit speed: time is then the path, and a step may be as long as the path between two
turning points. Other laws move along polynomials in time.
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
    from dahl_ident.engine import Settled, System

_SYSTEMS: dict[Hashable, System] = {}
"""Compiled equations by law; not attributes of the laws, which are sent to other processes."""
_IS_ODD: dict[Hashable, bool] = {}
_FIRST_STATES: dict[Hashable, FirstState] = {}
"""The maps from the unknowns at the first sample to the states, by law."""

_EVEN_SAMPLING = 0.1  # its error, over a step of the displacement, up to which it is assumed
_FINER_FOR_ONE_STATE = 10.0  # times finer than a driven motion, for laws of one state


def system_of(law: Element, values: Sequence[Any], chosen: Sequence[int] = ()) -> System:
    """Return the compiled equations of a law; parameters `chosen`, or not at their values, vary."""
    law = law.copy_with(
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


def same_both_ways(law: Element) -> bool:
    """Return whether a law is the same in both directions, without compiling it."""
    form = form_of(law)
    if form not in _IS_ODD:
        from dahl_ident.engine.translate import is_odd

        _IS_ODD[form] = is_odd(law_equations(law))
    return _IS_ODD[form]


def _first_state_of(law: Element) -> FirstState:
    form = form_of(law)
    if form not in _FIRST_STATES:
        _FIRST_STATES[form] = FirstState(as_model(law))
    return _FIRST_STATES[form]


def form_of(law: Element) -> Hashable:
    """Return the key of a law's equations: its class, constants and other attributes."""
    constants = tuple(None if p.free else p.value for p in law.parameters)
    attributes = tuple(
        (name, form_of(value) if isinstance(value, Element) else repr(value))
        for name, value in sorted(law.__dict__.items())
        if name not in ("parameters", "name")
    )
    return (type(law), tuple(c if c in (0.0, 1.0) else None for c in constants), attributes)


def loops_of(
    law: Element,
    table: FloatArray,
    orders: Sequence[int],
    chosen: Sequence[int],
    *,
    gap: bool = False,
) -> Settled:
    """Return the settled loops of a law at rows of amplitude, frequency and values.

    With `gap`, the width of a gap in series follows the law's values.
    """
    from dahl_ident.engine import loops

    n = len(law.parameters)
    system = system_of(law, list(table[:, 2 : 2 + n].T), [i for i in chosen if i < n])
    A, omega, values = table[:, 0], table[:, 1], table[:, 2:]
    return loops(system, A, omega, values, chosen=chosen, harmonics=orders, gap=gap)


def force_along(
    law: Element,
    values: Sequence[Any],
    path: Path,
    state: float | FloatArray,
    chosen: Sequence[int] | None = None,
) -> HistoryGradient:
    """Return the force at every sample of a displacement, with the derivatives `chosen`, others 0.

    `state` is the unknown, or the unknowns, at the first sample.
    """
    from dahl_ident.engine import march

    x, numbers = path.displacement, np.array([float(v) for v in values])
    if law.rate_independent:
        times, knots, coefficients = _at_unit_speed(x)
    else:
        times, knots, coefficients = _in_time(path)
    first, by_start, by_value = _first_state_of(law)(np.append([x[0], 0.0], state), numbers)
    by, by_first = np.zeros((len(values), x.size)), np.zeros((x.size, first.size))
    if not coefficients.size:
        speed = 0.0 if law.rate_independent else float(np.asarray(path.velocity)[0])
        heading = -1.0 if speed < 0.0 else 1.0
        part = law.mechanics(values, x[0], speed, heading, first[2:].tolist())
        force = np.full(x.shape, part.force)
    else:
        samples, rows = np.unique(times, return_inverse=True)
        motion = march(
            system_of(law, values, chosen or ()),
            knots,
            coefficients,
            samples,
            np.append([coefficients[0, 0], 0.0], first[2:]),
            numbers,
            chosen=chosen or (),
            derivatives=chosen is not None,
            finer=_FINER_FOR_ONE_STATE if law.n_states == 1 else 1.0,
        )
        force = motion.output[rows]
        if chosen is not None:
            by_first, by[list(chosen)] = motion.by_first[rows], motion.by_parameter[rows].T
            by[list(chosen)] += (by_first @ by_value[:, list(chosen)]).T
    return HistoryGradient(force, (by_first @ by_start[:, 2:]).squeeze(), tuple(by))


def _at_unit_speed(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the path at every sample, the path at turning points, and the lines between these."""
    steps = np.diff(x)
    path = np.append(0.0, np.cumsum(np.abs(steps)))
    moves = np.flatnonzero(steps)
    heading = np.sign(steps[moves])
    turns = moves[1:][heading[1:] != heading[:-1]]
    corners = np.concatenate([[0], turns, [x.size - 1]]) if moves.size else moves
    return path, path[corners], np.stack([x[corners[:-1]], np.diff(x[corners])])


def _in_time(path: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the times of the samples, twice, and the polynomials of displacement between them.

    If the times are not known, they follow from displacement and velocity: for even sampling or, if
    that does not fit, for a constant acceleration between samples.
    """
    x, v = path.displacement, np.asarray(path.velocity)
    if path.time is not None or x.size < 2:
        times = np.zeros(x.size) if path.time is None else np.array(path.time)
        return times, times, path.polynomials(np.diff(times))
    from scipy.interpolate import CubicSpline

    steps = np.diff(x)
    integral = np.diff(CubicSpline(np.arange(x.size), v).antiderivative()(np.arange(x.size)))
    interval = float(steps @ integral) / (float(integral @ integral) or 1.0)
    even_steps = interval * integral
    size = np.abs(even_steps)
    intervals = np.full(steps.shape, interval)
    fits = np.all(np.abs(steps - even_steps) <= _EVEN_SAMPLING * (size + 0.1 * size.max()))
    if not (interval > 0.0 and fits):
        with np.errstate(all="ignore"):
            intervals = np.asarray(2.0 * steps / (v[1:] + v[:-1]))
        valid = (intervals > 0.0) & (intervals < np.inf)
        intervals[~valid] = np.median(intervals[valid]) if valid.any() else 1.0
    times = np.append(0.0, np.cumsum(intervals))
    return times, times, path.polynomials(np.diff(times))

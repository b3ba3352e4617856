"""The predicted samples of a record, with exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Friction
from dahl_ident.elements.facts import Path
from dahl_ident.problem.record_waves import RecordWaves


@dataclass(frozen=True)
class Predicted:
    """The predicted samples of a record, with derivatives."""

    output: FloatArray
    by: FloatArray
    """Derivatives with respect to the problem's values, (n, P); P = 0 if they are not wanted."""
    by_delay: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Derivative of a motion with respect to the delay."""


def force_of(
    problem: RecordWaves, values: FloatArray, number: int, *, derivatives: bool
) -> Predicted:
    """Return the force of a measured displacement at the samples of record `number`."""
    x, v, a = problem.motions[number]
    path = x if problem.paths is None else problem.paths[number]
    record = problem.records[number]
    of_record = problem.record_values(values, number)
    time = record.time - record.time[0]
    offset, drift = of_record[-2:].tolist()
    total = offset + drift * time
    by = np.zeros((x.size, len(problem.parameters) if derivatives else 0))
    start, column = 0, 0
    first = len(problem.free) + number * problem.per_record
    for element, at in problem.model.of(problem.full_values(values)):
        stop = start + (len(element.starts) if element.has_memory else element.n_states)
        states, moved = of_record[start:stop], x
        state: Any = 0.0  # an array for elements of several unknowns
        if isinstance(element, Friction):
            state, moved = states if states.size > 1 else float(states[0]), path
        history = element.history(at, Path(moved, v, a, time), state, slopes=derivatives)
        total = total + history.value
        if derivatives:
            for parameter, slope in zip(element.parameters, history.by_parameter, strict=True):
                if parameter.free:
                    by[:, column] = slope
                    column += 1
            if element.has_memory:
                by[:, first + start : first + stop] = history.by_state.reshape(x.size, -1)
        if element.n_states and not element.has_memory:
            free = element.free_responses(time)
            total = total + free @ states
            if derivatives:
                by[:, first + start : first + stop] = free
        start = stop
    if derivatives:
        by[:, first + start] = 1.0
        by[:, first + start + 1] = time
    return Predicted(total, by)


def motion_of(
    problem: RecordWaves, values: FloatArray, number: int, *, derivatives: bool
) -> Predicted:
    """Return the motion of a driven plant at the samples of record `number`."""
    from dahl_ident.engine import march

    of_record, free = problem.record_values(values, number), values[: len(problem.free)]
    starts = of_record.size - 1
    at, slopes = (part[0] for part in problem.coefficients(np.array([problem.full_values(values)])))
    slopes = slopes[:, [p.free for p in problem.model.parameters]]
    chosen = np.flatnonzero(slopes.any(axis=1)).tolist()
    first, by_start, by_value = problem.first(of_record[:starts], at)
    time, drive = problem.drives[number]
    motion = march(
        problem.system, time, drive, time, first, at, chosen=chosen, derivatives=derivatives
    )
    by = np.zeros((motion.output.size, len(problem.parameters) if derivatives else 0))
    if derivatives:
        column = free.size + number * problem.per_record
        by_number = motion.by_parameter + motion.by_first @ by_value[:, chosen]
        by[:, : free.size] = by_number @ slopes[chosen]
        by[:, column : column + starts] = motion.by_first @ by_start
        by[:, column + starts] = 1.0
    return Predicted(motion.output + of_record[starts], by, motion.by_delay)

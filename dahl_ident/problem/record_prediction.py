"""The predicted samples of a record, and the unknowns that records add to a model's parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.elements import Friction, Model, Parameter
from dahl_ident.elements.facts import Path
from dahl_ident.errors import ModelError

if TYPE_CHECKING:
    from dahl_ident.problem.record_problem import RecordProblem


@dataclass(frozen=True)
class Predicted:
    """The predicted samples of a record, with derivatives."""

    output: FloatArray
    by: FloatArray
    """Derivatives with respect to the problem's values, (n, P); P = 0 if they are not wanted."""
    by_delay: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Derivative of a motion with respect to the delay."""


def force_of(
    problem: RecordProblem, values: FloatArray, number: int, *, derivatives: bool
) -> Predicted:
    """Return the force of a measured displacement at the samples of record `number`."""
    x, v, a = problem.motions[number]
    path = x if problem.paths is None else problem.paths[number]
    record = problem.records[number]
    of_record = problem.own(values, number)
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
    problem: RecordProblem, values: FloatArray, number: int, *, derivatives: bool
) -> Predicted:
    """Return the motion of a driven plant at the samples of record `number`."""
    from dahl_ident.engine import march

    of_record, free = problem.own(values, number), values[: len(problem.free)]
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


_SMALL = 0.1  # rate times the size of the motion up to which the rate is searched as a number


def nuisance(model: Model, records: Sequence[Record], output: str) -> list[Parameter]:
    """Return the unknowns of each record: initial states, an offset and, of forces, a drift."""
    unknowns = []
    channel = records[0].motion_channel
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}[channel]
    for number in range(len(records)):
        tail = f"_{number + 1}" if len(records) > 1 else ""
        if output == "motion":
            unknowns.append(Parameter(f"initial_displacement{tail}", "m", "at the first sample"))
            unknowns.append(Parameter(f"initial_velocity{tail}", "m/s", "at the first sample"))
        for element in model.elements:
            name = f"{element.name}_" if element.name else ""
            if element.has_memory:
                unknowns += [
                    Parameter(f"{name}{start}{tail}", unit, meaning)
                    for start, unit, meaning in element.starts
                ]
            else:
                unknowns += [
                    Parameter(f"{name}state_{i + 1}{tail}", "m", "at the first sample")
                    for i in range(element.n_states)
                ]
        if output == "force":
            unknowns.append(Parameter(f"offset{tail}", "N", "constant in the measured force"))
            unknowns.append(Parameter(f"drift{tail}", "N/s", "slope of the measured force"))
        else:
            unknowns.append(Parameter(f"offset{tail}", unit, "constant in the measured motion"))
    occurrences = Counter(p.name for p in unknowns)
    name, count = occurrences.most_common(1)[0]
    if count > 1:
        raise ModelError(
            f"several elements have an unknown called {name} in a fit of records; give each a "
            "name, such as Dahl(name='pivot')"
        )
    for p in model.parameters:
        if p.name in occurrences:
            raise ModelError(
                f"{model!r} has a parameter called {p.name}, which is also an unknown of a fit of "
                "records; expected another name: change it in the law's declaration"
            )
    return unknowns


def bends(free: Sequence[Parameter], count: int, records: Sequence[Record]) -> FloatArray:
    """Return the size up to which a parameter is searched as a number, above as a logarithm.

    Rates such as those of Bouc-Wen may have either sign, but above a tenth of the motion's inverse
    size they vary in proportion to a stiffness. 0 for parameters searched in one way only.
    """
    time, length = 1.0, 1.0
    wave = np.concatenate([y - y.mean() for y in (r.motion_samples for r in records)])
    steps = float(np.std(np.diff(wave)))
    if steps > 0.0:
        time = float(np.std(wave)) / steps / records[0].sample_rate
        order = ("displacement", "velocity", "acceleration").index(records[0].motion_channel)
        length = float(np.std(wave)) * time**order
    sizes = np.zeros(count)
    for i, p in enumerate(free):
        if not p.positive and not np.isfinite([p.lower, p.upper]).any():
            force, by_length, by_time = p.dimension
            if not force and (by_length or by_time):
                sizes[i] = _SMALL * length**by_length * time**by_time
    return sizes

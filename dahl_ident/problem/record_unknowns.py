"""Unknowns that records add to those of a model, and how rates of a law are searched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.elements import Model, Parameter

_SMALL = 0.1  # of the motion's inverse size: rates below are searched as numbers


def nuisance(model: Model, records: Sequence[Record], output: str) -> list[Parameter]:
    """Return what each record adds: first states, an offset and, for forces, a drift."""
    found = []
    channel = records[0].motion_channel
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}[channel]
    for number in range(len(records)):
        tail = f"_{number + 1}" if len(records) > 1 else ""
        if output == "motion":
            found.append(Parameter(f"initial_displacement{tail}", "m", "at the first sample"))
            found.append(Parameter(f"initial_velocity{tail}", "m/s", "at the first sample"))
        for element in model.elements:
            name = f"{element.name}_" if element.name else ""
            if element.has_memory:
                found.append(Parameter(f"{name}{element.start[0]}{tail}", *element.start[1:]))
            else:
                found += [
                    Parameter(f"{name}state_{i + 1}{tail}", "m", "at the first sample")
                    for i in range(element.n_states)
                ]
        if output == "force":
            found.append(Parameter(f"offset{tail}", "N", "constant in the measured force"))
            found.append(Parameter(f"drift{tail}", "N/s", "slope of the measured force"))
        else:
            found.append(Parameter(f"offset{tail}", unit, "constant in the measured motion"))
    return found


def bends(free: Sequence[Parameter], count: int, records: Sequence[Record]) -> FloatArray:
    """Return below which size a parameter is searched as a number, and not as a logarithm.

    Rates such as those of Bouc-Wen may have either sign, but beyond a tenth of the motion's
    inverse size they go with a stiffness in proportion. 0 for those that are searched in one
    way alone.
    """
    time, length = 1.0, 1.0
    wave = np.concatenate([y - y.mean() for y in (r.motion_samples for r in records)])
    steps = float(np.std(np.diff(wave)))
    if steps > 0.0:
        time = float(np.std(wave)) / steps / records[0].sample_rate
        order = ("displacement", "velocity", "acceleration").index(records[0].motion_channel)
        length = float(np.std(wave)) * time**order
    found = np.zeros(count)
    for i, p in enumerate(free):
        if not p.positive and not np.isfinite([p.lower, p.upper]).any():
            force, by_length, by_time = p.dimension
            if not force and (by_length or by_time):
                found[i] = _SMALL * length**by_length * time**by_time
    return found

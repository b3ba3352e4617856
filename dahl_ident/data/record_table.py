"""From the columns of a table to a record of waveforms."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.binding import Binding, scaled
from dahl_ident.data.columns import RECORD_NAMES, ColumnMap
from dahl_ident.data.record import DriveUnit, Record
from dahl_ident.data.source import Channel, Source
from dahl_ident.data.summary import listed
from dahl_ident.errors import DataError, UnitError, ValidationError
from dahl_ident.units import DRIVE_KINDS, MOTION_KINDS, si_unit

_DRIVE_UNITS: dict[str, DriveUnit] = {"voltage": "V", "current": "A"}


def record_from(
    source: Source, columns: ColumnMap, missing: Literal["error", "drop"] = "error"
) -> Record:
    """Return the record that a source holds.

    Raises
    ------
    DataError, UnitError
        Naming file, row and column.
    """
    bound = Binding(source, columns, RECORD_NAMES)
    channels = _channels(bound)
    bound.same_length(channels)
    complete = np.ones(next(iter(channels.values())).values.size, dtype=bool)
    if missing == "drop":
        complete = np.all([np.isfinite(_numeric(c)) for c in channels.values()], axis=0)
        bound.source = source.rows(complete)
        channels = _channels(bound)
        if not complete.all():
            bound.notes.append(f"{np.sum(~complete)} samples with missing values left out")
    values: dict[str, Any] = {
        role: _samples(bound, role, channel) for role, channel in channels.items()
    }
    if "drive" in channels:
        values |= _drive(bound, channels["drive"])
    else:
        bound.refuse_idle_factor(None)
    if "time" not in values:
        values["time"] = _even_time(bound, complete.size)[complete]
    try:
        return Record(**values, motion=bound.motion(), provenance=bound.provenance())
    except ValidationError as exc:
        raise DataError(f"{source.name}: {exc}") from exc


def _channels(bound: Binding) -> dict[str, Channel]:
    """Return the channels of the roles that the record has, exactly one motion among them."""
    roles = bound.map.roles
    named = [kind for kind in MOTION_KINDS if kind in roles]
    motions = named or [kind for kind in MOTION_KINDS if bound.has(kind)]
    if len(motions) != 1:
        raise DataError(
            f"{bound.source.name}: {' and '.join(motions) or 'no motion'} found; expected one of "
            "displacement, velocity and acceleration. Name it, such as displacement='x'; there "
            f"are {listed([c.header for c in bound.source.channels], 20)}"
        )
    found = {role: bound.required(role) for role in motions}
    if bound.map.sample_rate is None:
        found["time"] = bound.required("time")
    for role in ("force", "drive"):
        channel = bound.channel(role)
        if channel is not None:
            found[role] = channel
    if not {"force", "drive"} & found.keys():
        bound.required("force")
    return found


def _numeric(channel: Channel) -> FloatArray:
    """Return the numbers of a channel for finding gaps; text counts as present."""
    if channel.values.dtype.kind in "fiu":
        return channel.values.astype(np.float64)
    return np.array([np.nan if not str(v).strip() else 0.0 for v in channel.values])


def _samples(bound: Binding, role: str, channel: Channel) -> FloatArray:
    """Return SI samples; for a drive in V or A, volts or amperes."""
    values = bound.numbers(role, channel)
    unit = bound.unit(role, channel)
    kinds = DRIVE_KINDS if role == "drive" else (role,)
    _, factor = bound.kind(role, unit, kinds)
    if role == "time":
        _require_increasing(bound.source, channel, values)
    if unit.marker in ("rms", "peak to peak") or unit.decibel:
        raise UnitError(
            f"{bound.source.name}: column {channel.name!r} has the unit [{unit.text}]; expected "
            "the samples of a waveform, not amplitudes"
        )
    return scaled(values, factor)


def _drive(bound: Binding, channel: Channel) -> dict[str, Any]:
    kind, _ = bound.kind("drive", bound.unit("drive", channel), DRIVE_KINDS)
    bound.refuse_idle_factor(kind)
    if kind == "force":
        return {"drive_unit": si_unit("force", bound.motions["drive"])}
    values: dict[str, Any] = {"drive_unit": _DRIVE_UNITS[kind]}
    if bound.map.drive_factor is not None:
        factor, uncertainty = bound.force_per(kind)
        values |= {"drive_factor": factor, "drive_factor_uncertainty": uncertainty}
    else:
        saved = ("drive_factor", "drive_factor_uncertainty")
        values |= {k: bound.source.metadata[k] for k in saved if k in bound.source.metadata}
    return values


def _even_time(bound: Binding, n: int) -> FloatArray:
    rate = bound.map.sample_rate
    assert rate is not None  # _channels has asked for a time column otherwise
    bound.notes.append(f"time counted from the sample rate of {rate:g} Hz")
    return np.arange(n) / rate


def _require_increasing(source: Source, channel: Channel, time: FloatArray) -> None:
    back = np.flatnonzero(~(time[1:] > time[:-1]))
    if back.size:
        i = int(back[0]) + 1
        raise DataError(
            f"{source.where(channel, i)}: time is {time[i]:.9g} after {time[i - 1]:.9g} "
            f"({back.size} such steps); expected it to increase with every row"
        )

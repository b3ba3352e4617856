"""Conversion of the columns of a table to a record of waveforms."""

from __future__ import annotations

import re
from typing import Any, Literal

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.column_map import Binding, ColumnMap, proposal, scaled
from dahl_ident.data.columns import RECORD_COLUMNS
from dahl_ident.data.plausibility import record_warnings
from dahl_ident.data.raw_columns import RawChannel, RawFile, missing_marks
from dahl_ident.data.record import Record, is_even
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError, UnitError, ValidationError
from dahl_ident.units import MOTION_KINDS, counted, si_unit

_STAMP = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:\d\d(?:[.,]\d{1,9})?(?:Z|[-+]\d\d:?\d\d)?"
)


def record_from(
    source: RawFile, columns: ColumnMap, missing: Literal["error", "drop"] = "error"
) -> Record:
    """Return the record in a source."""
    bound = Binding(source, columns, RECORD_COLUMNS)
    channels = _channels(bound)
    bound.same_length(channels)
    if source.runs:
        raise DataError(
            f"{source.name}, {source.row_name(source.runs[0])}: the header is repeated above this "
            f"line ({len(source.runs) + 1} records in one file); expected one record. Split it"
        )
    size = next(iter(channels.values())).size
    complete: Any = slice(None)
    if missing == "drop":
        complete = np.ones(size, dtype=bool)
        for channel in channels.values():
            numbers = channel.values
            if numbers.dtype.kind not in "fiu":  # text counts as present
                numbers = np.where(np.char.strip(numbers.astype(str)) == "", np.nan, 0.0)
            numbers = numbers.astype(np.float64)
            complete &= np.isfinite(numbers)
            for mark in missing_marks(numbers[np.isfinite(numbers)]):
                bound.warn(
                    f"{counted(np.sum(numbers == mark), 'sample')} left out: column "
                    f"{channel.name!r} is {mark:g} in them, a mark of a missing value"
                )
                complete &= numbers != mark
        bound.source = source.rows(complete)
        channels = _channels(bound)
        if not complete.all():
            bound.notes.append(
                f"{counted(np.sum(~complete), 'sample')} with missing values left out"
            )
    values: dict[str, Any] = {
        role: _samples(bound, role, channel) for role, channel in channels.items()
    }
    if "drive" in channels:
        values |= _drive(bound, channels["drive"])
    else:
        bound.refuse_idle_factor(None)
    if "time" not in values:
        rate = bound.map.sample_rate
        assert rate is not None  # otherwise _channels requires a time column
        bound.notes.append(f"time counted from the sample rate of {rate:g} Hz")
        values["time"] = (np.arange(size) / rate)[complete]
    force: FloatArray = values["force"] if "force" in values else values["drive"]
    motion = next(values[kind] for kind in MOTION_KINDS if kind in values)
    for samples, message in record_warnings(values["time"], motion, force):
        if samples.size:
            first = bound.source.row_name(int(samples[0]))
            bound.warn(message.format(f"{first} ({samples.size} such places)"))
    try:
        return Record(**values, motion=bound.motion(), provenance=bound.provenance())
    except ValidationError as exc:
        raise DataError(f"{source.name}: {exc}") from exc


_FEWEST_STAMPS = 16  # with fewer, times with gaps cannot be told from rounded ones
_PLANNED = {"step", "measured"}  # columns of a waveform written by a plan


def record_size(source: RawFile, columns: ColumnMap) -> int:
    """Return the number of samples of the record in a source; nothing is read."""
    return next(iter(_channels(Binding(source, columns, RECORD_COLUMNS)).values())).size


def _channels(bound: Binding) -> dict[str, RawChannel]:
    source = bound.source
    motions = [kind for kind in MOTION_KINDS if kind in bound.map.roles]
    if not motions:
        motions, *others = [[k] for k in MOTION_KINDS if bound.called(k)] or [[]]
        if others:
            unused = " or ".join(kind for (kind,) in others)
            bound.notes.append(f"{motions[0]} is used, and not {unused}")
    if len(motions) != 1:
        raise DataError(
            f"{source.name}: {' and '.join(motions) or 'no motion'} found; expected one of "
            f"displacement, velocity and acceleration. Name it, such as "
            f"{bound.naming('displacement', 'x')}; there are "
            f"{listed([c.header for c in source.channels], 20)}{proposal()}"
        )
    channels = {motions[0]: bound.required(motions[0])}
    if bound.map.sample_rate is None:
        channels["time"] = bound.required("time")
    forces = {role: bound.channel(role) for role in ("force", "drive")}
    channels |= {role: channel for role, channel in forces.items() if channel is not None}
    if not any(forces.values()):
        if {c.name for c in source.channels} >= _PLANNED:
            raise DataError(
                f"{source.name}: a waveform for the exciter, as a plan writes it, holds no "
                "measured force. Play it, record displacement and force, and read that record"
            )
        bound.required("force")
    return channels


def _samples(bound: Binding, role: str, channel: RawChannel) -> FloatArray:
    """Return SI samples; for a drive in V or A, volts or amperes."""
    if role == "time" and is_stamped(channel):
        seconds = _increasing(bound, channel, _seconds(bound, channel))
        first = str(channel.values.flat[0]).strip()
        bound.notes.append(f"time counted from the stamp {first}")
        return seconds
    values = bound.numbers(role, channel)
    unit = bound.unit(role, channel)
    _, factor = bound.kind(role, unit)
    if role == "time":
        values = _increasing(bound, channel, values)
    if unit.marker in ("rms", "peak to peak") or unit.decibel:
        raise UnitError(
            f"{bound.source.name}: column {channel.name!r} has the unit [{unit.text}]; expected "
            "the samples of a waveform, not amplitudes"
        )
    samples = scaled(values, factor)
    if samples is not channel.content:
        samples.setflags(write=False)  # a new array, which the record need not copy
    return samples


def is_stamped(channel: RawChannel) -> bool:
    """Return whether a channel holds time stamps, which need no unit."""
    return channel.kind == "U" and _STAMP.fullmatch(channel.values.flat[0].strip()) is not None


def _seconds(bound: Binding, channel: RawChannel) -> FloatArray:
    """Return the time since the first stamp: ISO 8601, or times of one day."""
    import pandas as pd

    cells = [cell.strip() for cell in channel.values.tolist()]
    matches = [_STAMP.fullmatch(cell) for cell in cells]
    days = ["" if m is None or m["date"] else "1970-01-01T" for m in matches]
    stamps = [d + m[0].replace(",", ".") if m else "" for d, m in zip(days, matches, strict=True)]
    moments = pd.to_datetime(stamps, format="ISO8601", utc=True, errors="coerce").as_unit("ns")
    for i in np.flatnonzero(moments.isna())[:1]:
        raise DataError(
            f"{bound.source.where(channel, i)}: {cells[i][:40]!r} is not a time stamp such as "
            "2024-03-31T12:00:00.5 or 12:00:00.5"
        )
    return np.asarray((moments.asi8 - moments.asi8[0]) * 1e-9)


def _increasing(bound: Binding, channel: RawChannel, time: FloatArray) -> FloatArray:
    """Return increasing times; evenly spaced ones if they differ from that only by rounding."""
    back = (np.flatnonzero(~(time[1:] > time[:-1])) + 1).tolist()
    if back:
        raise DataError(
            f"{bound.source.where(channel, back[0])}: time is {time[back[0]]:.9g} after "
            f"{time[back[0] - 1]:.9g} ({len(back)} such steps); expected it to increase with every "
            "row"
        )
    if time.size < _FEWEST_STAMPS or is_even(time):
        return time
    step = (time[-1] - time[0]) / (time.size - 1)
    ratios = (time * 10.0**d for d in range(12))
    digits = (d for d, r in enumerate(ratios) if np.abs(r - np.round(r)).max() < 1e-3)
    resolution = 10.0 ** -next(digits, 12)
    middle = np.arange(time.size) - 0.5 * (time.size - 1)
    grid = time.mean() + middle * float(middle @ time / (middle @ middle))
    if step < 1.25 * resolution or np.abs(time - grid).max() > 0.6 * resolution:
        return time  # with a coarser resolution a missing sample would not be noticed
    bound.notes.append(f"times are rounded to {resolution:g}, and taken as even")
    return np.asarray(grid)


def _drive(bound: Binding, channel: RawChannel) -> dict[str, Any]:
    kind, _ = bound.kind("drive", bound.unit("drive", channel))
    bound.refuse_idle_factor(kind)
    if kind == "force":
        return {"drive_unit": si_unit("force", bound.motions["drive"])}
    values: dict[str, Any] = {"drive_unit": si_unit(kind)}
    names = ("drive_factor", "drive_factor_uncertainty")
    if bound.map.drive_factor is not None:
        return values | dict(zip(names, bound.force_per(kind), strict=True))
    saved = bound.source.metadata
    return values | {name: saved[name] for name in names if name in saved}

"""The contents of a file: channels, sampling, gaps, and a proposed column map."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import indent

import numpy as np

from dahl_ident.data.columns import RECORD_COLUMNS, RESPONSE_COLUMNS, Column
from dahl_ident.data.raw_columns import RawChannel, RawFile, plain
from dahl_ident.data.record import gaps, is_even, sample_rate
from dahl_ident.data.record_table import is_stamped
from dahl_ident.data.tabular import as_html, as_text, extent, listed
from dahl_ident.errors import UnitError
from dahl_ident.units import MOTION_KINDS, parse_unit

_INTERVALS = ("ts", "dt", "sampling_interval", "sample_interval")  # names of an interval in s
_RATES = ("fs", "sample_rate", "sampling_rate", "sampling_frequency")  # names of a rate in Hz
_FEW_GAPS = 5  # gaps that are listed singly; otherwise their number, the longest and the first
# The proposed columns; those that all have the unit of the gain are not recognised by unit.
_RECORD = RECORD_COLUMNS | {"drive": replace(RECORD_COLUMNS["drive"], kinds=("voltage", "current"))}
_BY_UNIT = ("frequency", "amplitude", "drive", "gain", "phase")
_BY_NAME = ("response", "real", "imag", "gain_db", "level")
_RESPONSE = {role: RESPONSE_COLUMNS[role] for role in _BY_UNIT}
_RESPONSE |= {role: replace(RESPONSE_COLUMNS[role], kinds=()) for role in _BY_NAME}
_SHORT = {
    role: replace(RESPONSE_COLUMNS[role], names=(*RESPONSE_COLUMNS[role].names, *names))
    for role, names in (("frequency", ("f",)), ("amplitude", ("a", "amp")))
}  # names that have another meaning in a record


@dataclass(frozen=True)
class ChannelSummary:
    """One line for a channel: name or path, shape, type, unit and range."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str | None
    range: str


@dataclass(frozen=True, repr=False)
class FileContents:
    """The contents of a file, as returned by :func:`inspect`.

    `sampling` and `gaps` are empty if the file has no time channel; `column_map` is TOML
    text, to be checked and saved.
    """

    name: str
    format: str
    channels: tuple[ChannelSummary, ...]
    sampling: str
    gaps: tuple[str, ...]
    column_map: str
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        listing = as_text(f"{self.name}: {self.format}", self._lines())
        commented = indent(listing, "# ")  # so that the whole text is a column map
        return f"{commented}\n\n# proposed column map\n{self.column_map}"

    def _repr_html_(self) -> str:
        return as_html(f"{self.name}: {self.format}", self._lines())

    def _lines(self) -> list[tuple[str, str]]:
        lines = [
            (c.name, f"{c.shape} {c.dtype}  {c.range}  [{c.unit or 'no unit'}]")
            for c in self.channels
        ]
        lines += [("sampling", self.sampling)] if self.sampling else []
        return lines + [("gap", gap) for gap in self.gaps] + [("note", n) for n in self.notes]


def contents(source: RawFile) -> FileContents:
    """Summarise a source."""
    sampling, missing = _sampling(source)
    return FileContents(
        source.name,
        source.format,
        tuple(summary(c) for c in source.channels),
        sampling,
        missing,
        _proposal(source),
        source.notes,
    )


def summary(channel: RawChannel) -> ChannelSummary:
    """Summarise a channel."""
    values = np.atleast_1d(channel.values)
    if values.dtype.kind in "fiu":
        finite = values[np.isfinite(values)]
        text = extent(finite, "") if finite.size else "nothing finite"
        if finite.size < values.size:
            text += f", {values.size - finite.size} not finite"
    elif values.dtype.kind == "c":
        text = f"|.| {extent(np.abs(values), '')}"
    else:
        text = listed([repr(str(v)[:20]) for v in values], shown=2)
    unit = channel.unit
    return ChannelSummary(channel.name, channel.values.shape, str(values.dtype), unit, text)


def _sampling(source: RawFile) -> tuple[str, tuple[str, ...]]:
    """Describe the sampling of the first time channel, and its gaps or a summary of them."""
    column = RECORD_COLUMNS["time"]
    named = [c for c in source.channels if c.is_called(column)]
    for channel in named or (c for c in source.channels if column.accepts(c.unit, c.name)):
        if channel.values.dtype.kind not in "fiu" or channel.size < 2:
            continue
        try:
            time = channel.values * parse_unit(channel.unit or "s").factor
        except UnitError:
            continue
        if not np.isfinite(time).all():
            return "time is not finite everywhere", ()
        if time.ndim != 1 or not np.all(np.diff(time) > 0.0):
            return "time does not increase with every sample", ()
        text = (
            f"{sample_rate(time):.6g} Hz, {'even' if is_even(time) else 'uneven'}, {time.size} "
            f"samples in {time[-1] - time[0]:.6g} s"
        )
        start, stop = gaps(time).T
        lines = tuple(f"{a:.6g} to {b:.6g} s" for a, b in zip(start, stop, strict=True))
        lengths = stop - start
        if len(lines) <= _FEW_GAPS:
            return text, lines
        return text, (
            f"{len(lines)} gaps, {lengths.sum():.4g} s in all, median {np.median(lengths):.4g} s",
            f"the longest {lines[np.argmax(lengths)]}, the first {lines[0]}, the last {lines[-1]}",
        )
    return "", ()


def _proposal(source: RawFile) -> str:
    """Return a column map in TOML: roles by name, otherwise by unit."""
    groups = _vectors(patterns(source))
    response = _is_response(groups.values())
    every = RESPONSE_COLUMNS | _SHORT if response else RECORD_COLUMNS
    proposed = _RESPONSE | _SHORT if response else _RECORD
    roles: dict[str, str] = {}
    for role, column in proposed.items():
        free = {p: c for p, c in groups.items() if p not in roles.values()}
        by_name = (p for p, c in free.items() if c.is_called(column))
        by_unit = (
            p
            for p, c in free.items()
            if column.accepts(c.unit, c.name) and not any(map(c.is_called, every.values()))
        )
        best = next(by_name, None) or min(by_unit, key=_force_rank, default=None)
        if best is not None and not (role in MOTION_KINDS and set(MOTION_KINDS) & roles.keys()):
            roles[role] = best
    lines = [line for role, path in roles.items() for line in _entry(role, path, groups[path])]
    further = [column for role, column in every.items() if role not in roles]
    others: dict[bool, list[str]] = {True: [], False: []}
    for path, channel in groups.items():
        if path not in roles.values():
            others[any(map(channel.is_called, further))].append(path)
    for use, paths in (("read by their names", others[True]), ("not used", others[False])):
        lines += [f"# {use}: {listed(paths, 20)}"] if paths else []
    required = [("frequency",)] if response else [("time",), MOTION_KINDS, ("force", "drive")]
    missing = [options[0] for options in required if not roles.keys() & options]
    if missing:
        names = ", ".join(missing)
        lines.append(f"# not found: {names}. Fill in, and remove the comment signs:")
    lines += [f'# {role} = {{column = "", unit = ""}}' for role in missing]
    if "time" in missing:
        rate = _stated_rate(source)
        lines.append(f"{rate}, in place of the time; above all lines in brackets")
    return "\n".join(lines)


def _force_rank(path: str) -> int:
    """Return -1 for a friction force and 1 for a normal force, which a tribometer measures too."""
    name = path.casefold()
    normal = any(word in name for word in ("normal", "load", "vertical"))
    return normal - any(word in name for word in ("friction", "tangential", "lateral"))


def _stated_rate(source: RawFile) -> str:
    """Return a line with the sample rate, from a single number in the file if there is one."""
    for channel in source.channels:
        if channel.size != 1 or channel.kind not in "fiu":
            continue
        name, value = channel.short or channel.name, float(channel.values.flat[0])
        interval = plain(name) in _INTERVALS
        if value > 0.0 and (interval or plain(name) in _RATES):
            rate, source_of = (1.0 / value, f"1/{name}") if interval else (value, name)
            return f"# sample_rate = {rate:.10g}  # Hz, {source_of}"
    return "# sample_rate = 1000.0  # Hz"


def _is_response(channels: Collection[RawChannel]) -> bool:
    """Return whether channels form a table of responses; f is force only with time or motion."""

    def any_is(column: Column) -> bool:
        return any(c.is_called(column) or column.accepts(c.unit, c.name) for c in channels)

    sampled = any(any_is(_RECORD[role]) for role in ("time", *MOTION_KINDS))
    if any_is(RESPONSE_COLUMNS["frequency"]) or "phase" in [plain(c.name) for c in channels]:
        return True
    return not sampled and any_is(_SHORT["frequency"])


def _entry(role: str, path: str, channel: RawChannel) -> Iterator[str]:
    yield f"[{role}]"
    yield f"column = {json.dumps(path, ensure_ascii=False)}"
    if role == "level" or (role == "time" and is_stamped(channel)):
        return
    unit = channel.unit or channel.unit_in_name
    if unit is None:
        yield 'unit = ""  # the file does not say: fill in'
    else:
        yield f"unit = {json.dumps(unit, ensure_ascii=False)}"


def patterns(source: RawFile) -> dict[str, list[RawChannel]]:
    """Return channels by path; those of one name in struct arrays of tables by a path with ``*``.

    A record is read from one element, whose path has no ``*``.
    """
    by_short: dict[str, list[RawChannel]] = {}
    for channel in source.channels:
        by_short.setdefault(channel.short or channel.name, []).append(channel)
    out: dict[str, list[RawChannel]] = {}
    for channels in by_short.values():
        parts = [re.split(r"([.\[\]/])", c.name) for c in channels]
        if len(channels) > 1 and len({len(p) for p in parts}) == 1:
            columns = zip(*parts, strict=True)
            out["".join(c[0] if len(set(c)) == 1 else "*" for c in columns)] = channels
        else:
            out |= {c.name: [c] for c in channels}
    is_response = _is_response(_vectors(out).values())
    return out if is_response else {c.name: [c] for c in source.channels}


def _vectors(groups: Mapping[str, Sequence[RawChannel]]) -> dict[str, RawChannel]:
    """Return the first channel of each group; single numbers are settings if there are vectors."""
    first = {path: channels[0] for path, channels in groups.items()}
    return {path: channel for path, channel in first.items() if channel.size > 1} or first

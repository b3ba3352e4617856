"""The contents of a file: channels, sampling, gaps, and a column map to read it."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.columns import RECORD_COLUMNS, RESPONSE_COLUMNS, FileColumn
from dahl_ident.data.raw_columns import Channel, Source, plain
from dahl_ident.data.record import gaps, is_even, sample_rate
from dahl_ident.data.record_table import is_stamped
from dahl_ident.data.tabular import as_html, as_text, extent, listed
from dahl_ident.errors import UnitError
from dahl_ident.units import MOTION_KINDS, kind_of, parse_unit

# The roles that are proposed, those of a response without a unit that claims a channel among them.
_RECORD_ROLES = tuple(RECORD_COLUMNS)
_RESPONSE_ROLES = (
    "frequency", "amplitude", "drive", "response", "real", "imag", "gain", "gain_db", "phase",
    "level",
)  # fmt: skip
_BY_NAME_ONLY = ("response", "real", "imag", "gain_db")  # any of them has the gain's unit
_INTERVALS = ("ts", "dt", "sampling_interval", "sample_interval")  # s, of single numbers
_RATES = ("fs", "sample_rate", "sampling_rate", "sampling_frequency")  # Hz
_FEW_GAPS = 5  # that are listed; of more, number, longest and first say more
_FREQUENCY = RESPONSE_COLUMNS["frequency"]
_PROPOSED = RESPONSE_COLUMNS | {"frequency": replace(_FREQUENCY, names=(*_FREQUENCY.names, "f"))}
_RECORD = RECORD_COLUMNS | {"drive": replace(RECORD_COLUMNS["drive"], kinds=("voltage", "current"))}


@dataclass(frozen=True)
class ChannelSummary:
    """One channel in a line: name or path, shape, type, unit and range."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str | None
    range: str


@dataclass(frozen=True, repr=False)
class FileContents:
    """The contents of a file, as returned by :func:`inspect`.

    `sampling` and `gaps` are empty where the file has no time channel; `column_map` is TOML
    text, to be checked and kept.
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
        return f"{listing}\n\n# proposed column map\n{self.column_map}"

    def _repr_html_(self) -> str:
        return as_html(f"{self.name}: {self.format}", self._lines())

    def _lines(self) -> list[tuple[str, str]]:
        lines = [
            (c.name, f"{c.shape} {c.dtype}  {c.range}  [{c.unit or 'no unit'}]")
            for c in self.channels
        ]
        lines += [("sampling", self.sampling)] if self.sampling else []
        return lines + [("gap", gap) for gap in self.gaps] + [("note", n) for n in self.notes]


def contents(source: Source) -> FileContents:
    """Summarise a source."""
    sampling, missing = _sampling(source)
    return FileContents(
        source.name,
        source.format,
        tuple(_summary(c) for c in source.channels),
        sampling,
        missing,
        _proposal(source),
        source.notes,
    )


def _summary(channel: Channel) -> ChannelSummary:
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


def _sampling(source: Source) -> tuple[str, tuple[str, ...]]:
    """Describe the sampling of the first channel that is time, by its name or its unit."""
    by_name = [c for c in source.channels if _named(c, "time", _RECORD)]
    by_unit = [c for c in source.channels if _of_kind(c, "time", _RECORD)]
    for channel in by_name or by_unit:
        if channel.values.dtype.kind not in "fiu" or channel.size < 2:
            continue
        try:
            time = channel.values * parse_unit(channel.unit or "s").factor
        except UnitError:
            continue
        if not np.isfinite(time).all():
            return "time is not finite everywhere", ()
        if time.ndim == 1 and time.size > 1 and np.all(np.diff(time) > 0.0):
            evenness = "even" if is_even(time) else "uneven"
            text = (
                f"{sample_rate(time):.6g} Hz, {evenness}, {time.size} samples in "
                f"{time[-1] - time[0]:.6g} s"
            )
            return text, _gap_lines(gaps(time))
        return "time does not increase with every sample", ()
    return "", ()


def _gap_lines(found: FloatArray) -> tuple[str, ...]:
    """Return each gap where they are few; of many their number, the longest and the first."""
    lines = tuple(f"{a:.6g} to {b:.6g} s" for a, b in found)
    if len(lines) <= _FEW_GAPS:
        return lines
    lengths = found[:, 1] - found[:, 0]
    longest = int(np.argmax(lengths))
    return (
        f"{len(lines)} gaps, {lengths.sum():.4g} s in all, median {np.median(lengths):.4g} s",
        f"the longest {lines[longest]}, the first {lines[0]}, the last {lines[-1]}",
    )


def _named(channel: Channel, role: str, columns: Mapping[str, FileColumn]) -> bool:
    return channel.role == role or channel.is_called(columns[role])


def _proposal(source: Source) -> str:
    """Return a column map in TOML: roles by name first, by unit where no name claims them."""
    groups = _patterns(source)
    if any(channel.size > 1 for channel in groups.values()):  # single numbers are settings
        groups = {path: channel for path, channel in groups.items() if channel.size > 1}
    response = _is_response(groups.values())
    columns = _PROPOSED if response else _RECORD
    roles: dict[str, str] = {}
    for role in _RESPONSE_ROLES if response else _RECORD_ROLES:
        free = {p: c for p, c in groups.items() if p not in roles.values()}
        by_name = (p for p, c in free.items() if _named(c, role, columns))
        by_unit = (
            p
            for p, c in free.items()
            if _of_kind(c, role, columns) and not _has_name(c, columns, columns)
        )
        best = next(by_name, None) or min(by_unit, key=_likeness, default=None)
        if best is not None and not (role in MOTION_KINDS and set(MOTION_KINDS) & roles.keys()):
            roles[role] = best
    lines = [line for role, path in roles.items() for line in _entry(role, path, groups[path])]
    others = [path for path in groups if path not in roles.values()]
    found = [path for path in others if _has_name(groups[path], columns.keys() - roles, columns)]
    unused = [path for path in others if path not in found]
    for what, paths in (("read by their names", found), ("not used", unused)):
        lines += [f"# {what}: {listed(paths, 20)}"] if paths else []
    return "\n".join([*lines, *_to_fill_in(roles.keys(), response, _stated_rate(source))])


def _likeness(path: str) -> int:
    """Order channels of force: a tribometer measures the friction, and the load across it too."""
    name = path.casefold()
    across = any(word in name for word in ("normal", "load", "vertical"))
    return across - any(word in name for word in ("friction", "tangential", "lateral"))


def _stated_rate(source: Source) -> str:
    """Return a line with the sample rate that single numbers of the file state, if any do."""
    for channel in source.channels:
        if channel.size != 1 or channel.kind not in "fiu":
            continue
        name, value = channel.short or channel.name, float(channel.values.flat[0])
        interval = plain(name) in _INTERVALS
        if value > 0.0 and (interval or plain(name) in _RATES):
            rate, source_of = (1.0 / value, f"1/{name}") if interval else (value, name)
            return f"# sample_rate = {rate:.10g}  # Hz, {source_of}"
    return "# sample_rate = 1000.0  # Hz"


def _to_fill_in(found: Collection[str], response: bool, rate: str) -> Iterator[str]:
    """Yield comments that become the entries of required roles once they are filled in."""
    required = [("frequency",)] if response else [("time",), MOTION_KINDS, ("force", "drive")]
    missing = [roles[0] for roles in required if not set(roles) & set(found)]
    if missing:
        yield f"# not found: {', '.join(missing)}. Fill in, and remove the comment signs:"
    for role in missing:
        yield f'# {role} = {{column = "", unit = ""}}'
    if "time" in missing:
        yield f"{rate}, in place of the time; above all lines in brackets"


def _has_name(channel: Channel, roles: Iterable[str], columns: Mapping[str, FileColumn]) -> bool:
    return any(_named(channel, role, columns) for role in roles)


def _is_response(channels: Collection[Channel]) -> bool:
    """Return whether channels are a table of response; f is force only with time or motion."""

    def any_is(role: str, columns: Mapping[str, FileColumn]) -> bool:
        return any(_named(c, role, columns) or _of_kind(c, role, columns) for c in channels)

    if any_is("frequency", RESPONSE_COLUMNS):
        return True
    sampled = any(any_is(role, _RECORD) for role in ("time", *MOTION_KINDS))
    return not sampled and any_is("frequency", _PROPOSED)


def _of_kind(channel: Channel, role: str, columns: Mapping[str, FileColumn]) -> bool:
    kinds = columns[role].kinds
    if channel.unit is None or not kinds or role in _BY_NAME_ONLY:
        return False
    try:
        kind_of(parse_unit(channel.unit), kinds, channel.name)
    except UnitError:
        return False
    return True


def _entry(role: str, path: str, channel: Channel) -> Iterator[str]:
    yield f"[{role}]"
    yield f"column = {json.dumps(path, ensure_ascii=False)}"
    if role == "level" or (role == "time" and is_stamped(channel)):
        return
    unit = channel.unit or channel.unit_in_name
    if unit is None:
        yield 'unit = ""  # the file does not say: fill in'
    else:
        yield f"unit = {json.dumps(unit, ensure_ascii=False)}"


def _patterns(source: Source) -> dict[str, Channel]:
    """Return channels by path; those of one name in struct arrays by one path with ``*``."""
    by_short: dict[str, list[Channel]] = {}
    for channel in source.channels:
        by_short.setdefault(channel.short or channel.name, []).append(channel)
    out: dict[str, Channel] = {}
    for channels in by_short.values():
        parts = [re.split(r"([.\[\]/])", c.name) for c in channels]
        if len(channels) > 1 and len({len(p) for p in parts}) == 1:
            columns = zip(*parts, strict=True)
            out["".join(c[0] if len(set(c)) == 1 else "*" for c in columns)] = channels[0]
        else:
            out |= {c.name: c for c in channels}
    return out

"""Column maps: the columns of time, displacement, force and drive in a laboratory's files.

A laboratory describes its files once, in a small TOML file. Each role is given by the name of a
column, or by a table with the name, the unit if the header lacks it, a sign and a constant factor::

    drive_factor = "12.5 N/V"
    drive_factor_uncertainty = 0.01

    time = "t"
    [displacement]
    column = "LVDT 2"
    unit = "um"
    sign = -1
    [drive]
    column = "amplifier"
    unit = "V"

In files with paths (MATLAB, HDF5) a ``*`` matches any name or index, and every match becomes one
level: ``column = "FRdata.*[*].frequency"``. Indices start at 0.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray, non_negative_number, positive_number
from dahl_ident.data.columns import (
    CONTROLLED,
    FILE_COLUMNS,
    RECORD_COLUMNS,
    Column,
    one_of,
    set_checked,
)
from dahl_ident.data.entries import checked, expecting
from dahl_ident.data.raw_columns import RawChannel, RawFile, plain
from dahl_ident.data.storage import read_toml
from dahl_ident.data.tabular import listed
from dahl_ident.errors import (
    ANY,
    DataError,
    DataWarning,
    UnitError,
    ValidationError,
    argument,
    choices,
    spelled,
)
from dahl_ident.units import (
    MECHANICAL_KINDS,
    QUANTITIES,
    Motion,
    Quantity,
    Unit,
    factor_to,
    kind_of,
    parse_quantity,
    parse_unit,
    si_unit,
)

_SHOWN = 10  # most rows named in a warning


@dataclass(frozen=True)
class MappedColumn:
    """The column of a role, by default with its usual name; `unit` replaces that of the file."""

    column: str | None = expecting("a column's name", default=None)
    unit: str | None = None
    sign: int = 1
    factor: float = 1.0

    def __post_init__(self) -> None:
        if self.sign not in (1, -1):
            raise ValidationError(f"sign is {self.sign}; expected 1 or -1")
        set_checked(self, positive_number, "factor")
        if self.unit:
            parse_unit(self.unit)


@dataclass(frozen=True)
class ColumnMap:
    """Roles, and information that a file does not contain; see `read_frequency_response`."""

    roles: Mapping[str, MappedColumn] = field(default_factory=dict)
    quantity: Quantity | None = None
    controlled: str | dict[str, str] | None = expecting(
        "'displacement' or 'force', or a pattern of level labels for each of them", default=None
    )
    sweep: str | None = None
    sample_rate: float | None = None
    drive_factor: str | None = expecting("text such as '12.5 N/V'", default=None)
    drive_factor_uncertainty: float = 0.0

    def __post_init__(self) -> None:
        set_checked(self, partial(one_of, allowed=QUANTITIES), "quantity")
        words = [self.controlled] if isinstance(self.controlled, str) else self.controlled or ()
        for word in words:
            one_of(word, "controlled", CONTROLLED)
        set_checked(self, positive_number, "sample_rate")
        set_checked(self, non_negative_number, "drive_factor_uncertainty")


SETTINGS = tuple(name for name in ColumnMap.__dataclass_fields__ if name != "roles")
"""Entries of a column map that are not columns."""


def column_map_of(entries: Mapping[str, Any]) -> str:
    """Return, for messages, how the user gives a column map with these entries."""

    def toml(entry: Any) -> str:
        if isinstance(entry, Mapping):
            return f"{{{', '.join(f'{key} = {toml(part)}' for key, part in entry.items())}}}"
        return json.dumps(entry)

    lines = "; ".join(f"{role} = {toml(entry)}" for role, entry in entries.items())
    return spelled(
        f"columns={dict(entries)!r}",
        f"--columns columns.toml, a file with the line: {lines}",
        " and ".join(starmap(_meaning, entries.items())),
    )


def _meaning(role: str, entry: Any) -> str:
    """Return, for messages, what to choose for a column in a form."""
    name, unit = entry, None
    if isinstance(entry, Mapping):
        name, unit = entry["column"], entry["unit"]
    of = "" if name is ANY else f" of {name}"
    return f'the meaning "{role}"{of}' + (f" and its unit, {unit}" if unit else "")


def proposal() -> str:
    """Return, for messages, how the user gets a column map; a form shows one."""
    hint = " (inspect proposes a column map)"
    return spelled(hint, hint, "")


def column_map(
    value: Mapping[str, Any] | str | Path | None, name: str = "columns", **overrides: Any
) -> ColumnMap:
    """Read a column map from a mapping or a TOML file; `overrides` replace its entries.

    Messages call a mapping `name`.
    """
    entries = value or {}
    if not isinstance(entries, Mapping):
        name, entries = str(entries), read_toml(entries, "the column map")
    entries = {**entries, **{key: entry for key, entry in overrides.items() if entry is not None}}
    roles: dict[str, MappedColumn] = {}
    settings: dict[str, Any] = {}
    for key, entry in entries.items():
        mapped = key in FILE_COLUMNS and isinstance(entry, Mapping) and "column" in entry
        if key in SETTINGS and not mapped:
            settings[key] = entry
        elif key not in FILE_COLUMNS:
            known = choices(dict.fromkeys((*FILE_COLUMNS, *SETTINGS)), key)
            raise DataError(f"{name}: unknown entry {key!r}; expected one of {known}")
        elif not isinstance(entry, (str, Mapping)):
            raise DataError(
                f"{name}: {key} is {entry!r}; expected a column's name, or a table with column, "
                "unit, sign and factor"
            )
        else:
            column = {"column": entry} if isinstance(entry, str) else entry
            roles[key] = checked(MappedColumn, column, f"{name}: {key}")
    return replace(checked(ColumnMap, settings, name) if settings else ColumnMap(), roles=roles)


@dataclass
class Binding:
    """Roles looked up in one source, with the assumptions made (`notes`) and the warnings."""

    source: RawFile
    map: ColumnMap
    columns: Mapping[str, Column]
    motions: dict[str, Motion] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if self.source.headerless and not self.map.roles:
            raise DataError(
                f"{self.source.name}: the table has no header line; expected names and units "
                "above the numbers, such as 'frequency_hz, amplitude [um], gain [N/m], phase_deg', "
                f"or {self.naming('force', 'column 2 [N]')} and the like"
            )

    def naming(self, role: str, entry: Any = ANY) -> str:
        """Return, for messages, how the user names the column of a role."""
        if self.columns is not RECORD_COLUMNS:
            return column_map_of({role: entry})
        typed = f"{entry['column']} [{entry['unit']}]" if isinstance(entry, Mapping) else entry
        columns = {role: entry}
        return spelled(f"{columns=}", argument(role, typed), _meaning(role, entry))

    def mapped(self, role: str) -> MappedColumn:
        """Return the entry of a role in the column map."""
        return self.map.roles.get(role, MappedColumn())

    def called(self, role: str) -> list[RawChannel]:
        """Return the columns of a role according to their names or to the file format."""
        return [c for c in self.source.channels if c.is_called(self.columns[role])]

    def channel(self, role: str) -> RawChannel | None:
        """Return the channel of a role, or None if the file has none."""
        column = self.mapped(role).column
        channel = self._named(role) if column is None else self.source.find(column)
        if channel is not None:
            self.used.add(channel.name)
        return channel

    def _named(self, role: str) -> RawChannel | None:
        """Return the only column with a name of the role, None if there is none."""
        matches = self.called(role)
        names = self.columns[role].names
        if role not in self.map.roles:  # a column to which the map gives a role has no other role
            mapped = [c.column for c in self.map.roles.values() if c.column and "*" not in c.column]
            used = [self.source.find(column).content for column in mapped]
            matches = [c for c in matches if not any(c.content is content for content in used)]
        elif not matches:
            raise DataError(
                f"{self.source.name}: no column is called {' or '.join(names)}; name "
                f"the column of the {role} too"
            )
        if role == "run":  # a table may have file, day and test; the first name is used
            matches = sorted(matches, key=lambda c: names.index(plain(c.short or c.name)))[:1]
        if len(matches) > 1:
            distinct = len({c.name for c in matches}) == len(matches)
            choice = f"say which one with {self.naming(role, matches[0].name)}"
            raise DataError(
                f"{self.source.name}: {len(matches)} columns may be the {role}: "
                f"{listed([c.header for c in matches])}; "
                + (choice if distinct else "rename them in the file")
            )
        return matches[0] if matches else None

    def has(self, role: str) -> bool:
        """Return whether a role is present."""
        return self.channel(role) is not None

    def required(self, role: str) -> RawChannel:
        """Return the channel of a required role."""
        channel = self.channel(role)
        if channel is None:
            raise DataError(
                f"{self.source.name}: no column holds the {role}; there are "
                f"{listed([c.header for c in self.source.channels], 20)}. Name it with "
                f"{self.naming(role)}{proposal()}"
            )
        return channel

    def numbers(self, role: str, channel: RawChannel) -> FloatArray:
        """Return finite numbers in the file's unit, with the map's sign and factor."""
        mapped = self.mapped(role)
        return scaled(self.source.numbers(channel), mapped.sign * mapped.factor)

    def si(self, role: str, quantity: str = "dynamic_stiffness", *, least: bool = True) -> Any:
        """Return a column in SI units, amplitudes zero to peak; None if there is none.

        `quantity` is that of the table, for columns whose unit follows from it; with `least`,
        numbers below the column's `least` are refused.
        """
        channel, declared = self.channel(role), self.columns[role]
        if channel is None:
            return None
        values, unit = self.numbers(role, channel), self.unit(role, channel)
        if declared.expected and least:
            keep = spelled(
                "; frequency_hz=(low, high) keeps a range",
                "; --where 'low <= frequency_hz <= high' keeps a range",
                "",
            )
            hint = keep if role == "frequency" else ""
            self.source.require(values >= declared.least, channel, declared.expected + hint)
        if declared.kinds:
            _, factor = self.kind(role, unit)
        else:
            si = declared.unit_of(self.motion(), quantity)
            factor = factor_to(unit, si, f"{self.source.name}: column {channel.name!r}")
        return scaled(values, factor * unit.to_peak)

    def unit(self, role: str, channel: RawChannel) -> Unit:
        """Return the unit: the map's, the header's, the one in the name, or another column's."""
        declared = self.columns[role]
        text = self.mapped(role).unit or channel.unit
        if text is None and channel.is_called(declared):
            text = channel.unit_in_name
        if not text and (other := next(filter(self.has, declared.like), None)) is not None:
            inherited = self.unit(other, self.required(other))
            text = None if inherited.decibel else inherited.text
        elif not text and declared.unit == "1":
            text = "1"
        if not text:
            example = declared.unit.format(displacement="um", force="N", response="N/m")
            raise UnitError(
                f"{self.source.name}: column {channel.name!r} has no unit; write it in the "
                f"header, such as '{channel.name} [{example}]', or give "
                + self.naming(role, {"column": channel.name, "unit": example})
            )
        try:
            return parse_unit(text)
        except UnitError as exc:
            raise UnitError(f"{self.source.name}: column {channel.name!r}: {exc}") from exc

    def kind(self, role: str, unit: Unit) -> tuple[str, float]:
        """Return the kind of a role's unit, and the factor to SI units (Hz for frequencies)."""
        kind, motion, factor = kind_of(
            unit, self.columns[role].kinds, f"{self.source.name}: the {role}"
        )
        if kind in MECHANICAL_KINDS:
            self.motions[role] = motion
        return kind, factor / (2.0 * np.pi) if kind == "angular_frequency" else factor

    def force_per(self, kind: str) -> tuple[float, float]:
        """Return the force for one SI unit of a drive, and its relative uncertainty."""
        if kind == "force":
            return 1.0, 0.0
        text = self.map.drive_factor
        if text is None:
            raise UnitError(
                f"{self.source.name}: the drive is a {kind}; give the force for one unit of it, "
                f"such as {argument('drive_factor', f'12.5 N/{si_unit(kind)}')}"
            )
        value, _, motion = parse_quantity(text, (f"force_per_{kind}",), "drive_factor")
        self.motions["drive_factor"] = motion
        return positive_number(value, "drive_factor"), self.map.drive_factor_uncertainty

    def refuse_idle_factor(self, kind: str | None) -> None:
        """Refuse options for the factor of a drive of this kind if they have no effect."""
        names = ("drive_factor", "drive_factor_uncertainty")
        options = " and ".join(n for n in names if self.source.options.get(n) is not None)
        if not options:  # in a column map, which may serve other files too, they are allowed
            return
        if kind in (None, "force"):
            channel = self.channel("drive")
            why = f"the drive ({channel.name}) is a force already" if channel else ""
            why = why or "no column holds the drive"
            raise DataError(
                f"{self.source.name}: {options} is given, but {why}; expected a drive in V or A: "
                "leave the factor out, or name the column with "
                f"{self.naming('drive')}"
            )
        if self.map.drive_factor is None and "drive_factor" not in self.source.metadata:
            raise DataError(
                f"{self.source.name}: {options} is given without drive_factor; give both"
            )

    def motion(self) -> Motion:
        """Return translation or rotation; all units must agree."""
        kinds = set(self.motions.values())
        if len(kinds) > 1:
            stated = ", ".join(f"{role} is {motion}" for role, motion in self.motions.items())
            raise UnitError(f"{self.source.name}: units disagree: {stated}")
        return kinds.pop() if kinds else "translation"

    def provenance(self) -> dict[str, Any]:
        """Return the source of the data, the assumptions made and the warnings."""
        unused = [c.name for c in self.source.channels if c.name not in self.used]
        notes = list(dict.fromkeys([*self.source.notes, *self.notes]))
        if unused:
            notes.append(f"columns not used: {listed(unused, 5)}")
        facts = {
            "file": self.source.name,
            "format": self.source.format,
            "sha256": self.source.sha256,
            "options": dict(self.source.options),
            "notes": notes,
            "warnings": list(dict.fromkeys([*self.source.warnings, *self.warnings])),
            "origin": self.source.metadata.get("provenance"),
        }
        return {key: value for key, value in facts.items() if value}

    def warn(self, message: str) -> None:
        """Warn, and store the warning with the data, because verdict and report repeat it."""
        warnings.warn(f"{self.source.name}: {message}", DataWarning, stacklevel=3)
        self.warnings.append(message)

    def warn_rows(self, rows: BoolArray, message: str) -> None:
        """Warn about the marked rows, if there are any."""
        marked = np.flatnonzero(rows)
        if marked.size:
            names = ", ".join(self.source.row_name(int(i)) for i in marked[:_SHOWN])
            more = f" and {marked.size - _SHOWN} more" if marked.size > _SHOWN else ""
            self.warn(f"{message}: {names}{more}")

    def same_length(self, channels: Mapping[str, RawChannel]) -> None:
        """Refuse columns of different lengths."""
        if len({channel.size for channel in channels.values()}) > 1:
            sizes = ", ".join(f"{role} {channel.size}" for role, channel in channels.items())
            raise DataError(f"{self.source.name}: columns differ in length: {sizes}")


def scaled(values: FloatArray, factor: float) -> FloatArray:
    """Return values times factor; without a copy if the factor is 1."""
    return values if factor == 1.0 else values * factor


def by_level(source: RawFile, columns: ColumnMap) -> dict[str | None, ColumnMap]:
    """Resolve ``*`` in paths: one column map for each level, or the map itself."""
    starred = {r: c for r, c in columns.roles.items() if c.column and "*" in c.column}
    if not starred:
        return {None: columns}
    levels = {role: source.matching(str(mapped.column)) for role, mapped in starred.items()}
    first, *others = levels
    for role in others:
        if odd := levels[role].keys() ^ levels[first].keys():
            raise DataError(
                f"{source.name}: {starred[first].column!r} and {starred[role].column!r} do not "
                f"match the same levels; only one of them has {listed(sorted(odd))}"
            )
    maps: dict[str | None, ColumnMap] = {}
    for label in levels[first]:
        roles = {r: replace(c, column=levels[r][label].header) for r, c in starred.items()}
        maps[label] = replace(columns, roles={**columns.roles, **roles})
    return maps

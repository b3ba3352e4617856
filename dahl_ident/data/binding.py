"""A file's channels bound to the roles of a column map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, positive_number
from dahl_ident.data.columns import Column, ColumnMap
from dahl_ident.data.source import Channel, Source, plain
from dahl_ident.data.summary import listed
from dahl_ident.errors import DataError, UnitError
from dahl_ident.units import (
    MECHANICAL_KINDS,
    Motion,
    Unit,
    kind_of,
    parse_quantity,
    parse_unit,
    si_unit,
)

_EXAMPLES = {
    "time": "s",
    "frequency": "Hz",
    "drive": "N",
    "force": "N",
    "gain": "N/m",
    "gain_db": "N/m",
    "real": "N/m",
    "imag": "N/m",
    "response": "N/m",
    "phase": "deg",
    "velocity": "mm/s",
    "acceleration": "m/s^2",
}


@dataclass
class Binding:
    """Roles looked up in one source; what was found, and what had to be assumed.

    `names` are the column names under which each role is found without a map.
    """

    source: Source
    map: ColumnMap
    names: Mapping[str, tuple[str, ...]]
    motions: dict[str, Motion] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if self.source.headerless and not self.map.roles:
            raise DataError(
                f"{self.source.name}: the table has no header line; expected names and units "
                "above the numbers, such as 'frequency_hz, amplitude [um], gain [N/m], phase_deg'"
            )

    def channel(self, role: str) -> Channel | None:
        """Return the channel of a role, or None where the file has none.

        Raises
        ------
        DataError
            If the map names a column that is not there, or several columns fit the role.
        """
        channel = self._find(role)
        if channel is not None:
            self.used.add(channel.name)
        return channel

    def _find(self, role: str) -> Channel | None:
        spec = self.map.roles.get(role, Column())
        if spec.column is not None:
            return self.source.find(spec.column)
        found = [
            c
            for c in self.source.channels
            if c.role == role or (c.role is None and plain(c.short or c.name) in self.names[role])
        ]
        if len(found) > 1:
            distinct = len({c.name for c in found}) == len(found)
            way = f"say which one with columns={{{role!r}: {found[0].name!r}}}"
            raise DataError(
                f"{self.source.name}: {len(found)} columns may be the {role}: "
                f"{listed([c.header for c in found])}; "
                + (way if distinct else "rename them in the file")
            )
        if not found and role in self.map.roles:
            raise DataError(
                f"{self.source.name}: no column is called {' or '.join(self.names[role])}; name "
                f"the column of the {role} too"
            )
        return found[0] if found else None

    def has(self, role: str) -> bool:
        """Return whether a role is present."""
        return self.channel(role) is not None

    def required(self, role: str) -> Channel:
        """Return the channel of a role that must be there."""
        channel = self.channel(role)
        if channel is None:
            raise DataError(
                f"{self.source.name}: no column holds the {role}; there are "
                f"{listed([c.header for c in self.source.channels], 20)}. Name it with "
                f"columns={{{role!r}: ...}}"
            )
        return channel

    def numbers(self, role: str, channel: Channel) -> FloatArray:
        """Return finite numbers with the map's sign and factor, in the file's unit."""
        spec = self.map.roles.get(role, Column())
        return scaled(self.source.numbers(channel), spec.sign * spec.factor)

    def unit(self, role: str, channel: Channel, default: str | None = None) -> Unit:
        """Return the unit: the map's, the header's, the one in the name, or the default's.

        Raises
        ------
        UnitError
            If there is none, or it cannot be read.
        """
        text = self.map.roles.get(role, Column()).unit or channel.unit
        if text is None and plain(channel.short or channel.name) in self.names[role]:
            text = channel.unit_in_name
        text = text or default
        if text is None:
            example = _EXAMPLES.get(role, "um")
            raise UnitError(
                f"{self.source.name}: column {channel.name!r} has no unit; write it in the "
                f"header, such as '{channel.name} [{example}]', or give "
                f"columns={{{role!r}: {{'column': {channel.name!r}, 'unit': {example!r}}}}}"
            )
        try:
            return parse_unit(text)
        except UnitError as exc:
            raise UnitError(f"{self.source.name}: column {channel.name!r}: {exc}") from exc

    def kind(self, role: str, unit: Unit, kinds: tuple[str, ...]) -> tuple[str, float]:
        """Return which kind a unit is, and its factor; its motion is remembered."""
        kind, motion, factor = kind_of(unit, kinds, f"{self.source.name}: the {role}")
        if kind in MECHANICAL_KINDS:
            self.motions[role] = motion
        return kind, factor

    def force_per(self, kind: str) -> tuple[float, float]:
        """Return the force for one SI unit of a drive, and its relative uncertainty."""
        if kind == "force":
            return 1.0, 0.0
        text = self.map.drive_factor
        if text is None:
            raise UnitError(
                f"{self.source.name}: the drive is a {kind}; give drive_factor, such as "
                f"'12.5 N/{si_unit(kind)}'"
            )
        value, _, motion = parse_quantity(text, (f"force_per_{kind}",), "drive_factor")
        self.motions["drive_factor"] = motion
        return positive_number(value, "drive_factor"), self.map.drive_factor_uncertainty

    def refuse_idle_factor(self, kind: str | None) -> None:
        """Refuse keywords on the drive's factor where they would count for nothing.

        `kind` is that of the drive, None where there is none. A column map may serve other files
        too, and is not refused.
        """
        names = ("drive_factor", "drive_factor_uncertainty")
        given = [n for n in names if self.source.options.get(n) is not None]
        if not given:
            return
        what = " and ".join(given)
        if kind in (None, "force"):
            channel = self.channel("drive")
            column = "the drive" if channel is None else f"column {channel.header!r}"
            found = "no column holds the drive" if kind is None else f"{column} is a force already"
            raise DataError(
                f"{self.source.name}: {what} is given, but {found}; expected a drive in V or A: "
                "leave the factor out, or name the column with columns={'drive': ...}"
            )
        if self.map.drive_factor is None and "drive_factor" not in self.source.metadata:
            raise DataError(f"{self.source.name}: {what} is given without drive_factor; give both")

    def motion(self) -> Motion:
        """Return translation or rotation, on which all units must agree."""
        kinds = set(self.motions.values())
        if len(kinds) > 1:
            raise UnitError(
                f"{self.source.name}: units disagree: "
                + ", ".join(f"{role} is {motion}" for role, motion in self.motions.items())
            )
        return kinds.pop() if kinds else "translation"

    def provenance(self) -> dict[str, Any]:
        """Return where the data come from, and the assumptions made on the way."""
        unused = [c.name for c in self.source.channels if c.name not in self.used]
        notes = list(dict.fromkeys([*self.source.notes, *self.notes]))
        if unused:
            notes.append(f"columns not used: {listed(unused, 5)}")
        found = {
            "file": self.source.name,
            "format": self.source.format,
            "sha256": self.source.sha256,
            "options": dict(self.source.options),
            "notes": notes,
            "origin": self.source.metadata.get("provenance"),
        }
        return {key: value for key, value in found.items() if value}

    def note_peak(self, role: str, unit: Unit) -> None:
        """Note the assumption that an unmarked amplitude rests on; our own files need none."""
        if unit.marker is None and not self.source.metadata:
            self.notes.append(f"{role} [{unit.text}] taken as zero to peak: the table does not say")

    def same_length(self, roles: Mapping[str, Channel]) -> None:
        """Refuse columns of different lengths."""
        sizes = {role: channel.values.size for role, channel in roles.items()}
        if len(set(sizes.values())) > 1:
            raise DataError(
                f"{self.source.name}: columns differ in length: "
                + ", ".join(f"{role} {size}" for role, size in sizes.items())
            )


def scaled(values: FloatArray, factor: float) -> FloatArray:
    """Return values times factor; long records are not copied for a factor of 1."""
    return values if factor == 1.0 else values * factor


def by_level(source: Source, columns: ColumnMap) -> dict[str | None, ColumnMap]:
    """Resolve ``*`` in paths: one column map for each level, or the map itself.

    Raises
    ------
    DataError
        If the columns do not have the same levels.
    """
    starred = {r: c for r, c in columns.roles.items() if c.column and "*" in c.column}
    if not starred:
        return {None: columns}
    found = {role: source.matching(str(spec.column)) for role, spec in starred.items()}
    first = next(iter(found))
    for role, matches in found.items():
        if matches.keys() != found[first].keys():
            odd = sorted(matches.keys() ^ found[first].keys())
            raise DataError(
                f"{source.name}: {starred[first].column!r} and {starred[role].column!r} do not "
                f"match the same levels; only one of them has {listed(odd)}"
            )
    return {
        label: replace(
            columns,
            roles={
                **columns.roles,
                **{r: replace(starred[r], column=found[r][label].name) for r in starred},
            },
        )
        for label in found[first]
    }


def per_frequency(values: FloatArray, frequency_hz: FloatArray, kind: str) -> FloatArray:
    """Return the displacement amplitude of a motion amplitude of any kind."""
    power = {"displacement": 0, "velocity": 1, "acceleration": 2}[kind]
    return np.asarray(values / (2.0 * np.pi * frequency_hz) ** power)

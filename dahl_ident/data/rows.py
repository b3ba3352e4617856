"""Columns of tables for computation, names of rows for messages, and levels of tables and files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.data.columns import COLUMNS
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.data.record import Record
from dahl_ident.errors import DataError, UnitError, ValidationError
from dahl_ident.units import (
    DRIVE_KINDS,
    MOTION_KINDS,
    Quantity,
    counted,
    engineering,
    parse_quantity,
    shown_unit,
)

_SAME_LEVEL = 1.1  # ratio of drives or amplitudes up to which they are one level
_SAME_FREQUENCY = 1.001  # ratio; points next to each other at a sharp resonance differ by more
_NEARLY_ALL = 0.99  # share of a wave's samples; noise and spikes lie beyond
_NUMBER = r"(?P<value>[0-9]+(?:[.,][0-9]+)?(?:e[-+]?[0-9]+)?)"
_UNIT = r"[^\W\d_][^;,\t\])\"']{0,20}"
_LINE = re.compile(
    rf"[\W_]*(?P<key>[a-z][a-z _.-]{{2,40}}?)\s*(?:[\[(](?P<bracketed>{_UNIT})[\])]\s*)?[\"']?\s*"
    rf"(?:[:=;,\t]\s*|\s)[\"']?{_NUMBER}(?:[\"']?\s*[;,\t]?\s*[\[(\"']?(?P<unit>{_UNIT}))?",
    re.IGNORECASE,
)
_SUBJECT = re.compile(
    "drive|driving|excitation|source|force|control|target|reference|test|shaker|input|sine|load|"
    "torque|displacement|velocity|acceleration|response|nominal|level|amplitude"
)
_SIZES = {"level", "amplitude"}


@dataclass(frozen=True)
class Rows:
    """Columns of shape (n,), or (tables, n) where stacked tables differ; None for absent ones."""

    quantity: Quantity
    harmonic: NDArray[np.int64]
    forced: BoolArray
    omega: FloatArray
    response: ComplexArray
    amplitude: FloatArray | None
    drive: FloatArray | None
    covariance: FloatArray | None
    dof: FloatArray | None
    amplitude_std: FloatArray | None
    amplitude_covariance: FloatArray | None
    drive_std: FloatArray | None
    drive_covariance: FloatArray | None

    @property
    def n(self) -> int:
        """Number of rows of one table."""
        return int(self.response.shape[-1])

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """The harmonics that occur."""
        return tuple(np.unique(self.harmonic).tolist())

    @cached_property
    def fundamental(self) -> IntArray:
        """For each row, that of its fundamental in the same table (the first of several), or -1."""
        shape = self.response.shape
        absent = np.zeros(())
        drive, amplitude = (absent if c is None else c for c in (self.drive, self.amplitude))
        table = np.arange(self.response[..., 0].size).reshape(*shape[:-1], 1)
        size = np.where(self.forced, drive, amplitude)
        keys = [np.broadcast_to(k, shape).ravel() for k in (size, self.forced, self.omega, table)]
        order = np.lexsort(keys)
        changes = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
        point = np.empty(self.response.size, dtype=np.intp)
        point[order] = np.concatenate([[0], np.cumsum(changes)])
        fundamentals = np.flatnonzero(np.broadcast_to(self.harmonic == 1, shape))[::-1]
        first = np.full(point.size, -1)
        first[point[fundamentals]] = fundamentals
        row = np.where(first < 0, -1, first % self.n)[point].reshape(shape)
        first_table = row.reshape(-1, self.n)[0]
        return first_table if (row == first_table).all() else row

    def of_fundamental(self, values: FloatArray | ComplexArray) -> NDArray[Any]:
        """Return the values, (..., n), at the row of each row's fundamental."""
        row = np.broadcast_to(self.fundamental, values.shape)
        return np.take_along_axis(values, row, axis=-1)

    @property
    def of_displacement(self) -> BoolArray:
        """Which rows are harmonics of the displacement, under a sinusoidal force, (n,)."""
        return np.asarray(self.forced & (self.harmonic != 1))

    @classmethod
    def of(cls, data: FrequencyResponse) -> Rows:
        """Return the columns of one table."""
        return cls._with({name: getattr(data, name) for name in COLUMNS}, data.quantity)

    @classmethod
    def _with(cls, columns: dict[str, Any], quantity: Quantity) -> Rows:
        return cls(
            quantity=quantity,
            forced=columns["controlled"] == "force",
            omega=2.0 * np.pi * columns["frequency_hz"],
            **{field.name: columns[field.name] for field in fields(cls) if field.name in columns},
        )

    @classmethod
    def stack(cls, tables: Sequence[FrequencyResponse]) -> Rows:
        """Return the columns of many tables with the same rows; columns that are equal are (n,)."""
        first = tables[0]
        for index, table in enumerate(tables):
            if table.n != first.n or table.quantity != first.quantity:
                raise DataError(
                    f"table {index} has {counted(table.n, 'row')} of {table.quantity}, "
                    f"table 0 has {counted(first.n, 'row')} of {first.quantity}; "
                    "tables estimated together must agree"
                )
        columns = {n: _stacked(tables, n) for n in COLUMNS if n not in ("level", "run")}
        for name in ("controlled", "harmonic"):
            values: Any = columns[name]
            if values.ndim > 1:
                different = (values != values[0]).any(axis=1)
                raise DataError(
                    f"table {int(np.argmax(different))} differs from table 0 in {name!r}; "
                    "tables estimated together must agree in it"
                )
        columns["response"] = np.array([table.response for table in tables])
        return cls._with(columns, first.quantity)

    def take(self, tables: IntArray | slice | int) -> Rows:
        """Return one or some of the stacked tables; shared columns stay as they are."""
        taken: dict[str, Any] = {}
        for name in (field.name for field in fields(self)):
            column = getattr(self, name)
            shape = COLUMNS[name].shape if name in COLUMNS else ()
            if isinstance(column, np.ndarray) and column.ndim > 1 + len(shape):
                taken[name] = column[tables]
        return replace(self, **taken)


def _stacked(tables: Sequence[FrequencyResponse], name: str) -> NDArray[Any] | None:
    """Return the column of all tables, once if all are equal; None if no table has it."""
    columns = [getattr(table, name) for table in tables]
    present = [column is not None for column in columns]
    if not any(present):
        return None
    if not all(present):
        raise DataError(
            f"table {present.index(False)} has no {name}, table {present.index(True)} has; "
            "tables estimated together must agree in what they hold"
        )
    if all(column is columns[0] for column in columns):
        return np.asarray(columns[0])
    stacked = np.array(columns)
    return stacked[0] if (stacked == stacked[0]).all() else stacked


def row_names(data: FrequencyResponse, rows: Sequence[int]) -> list[str]:
    """Return the names of rows, such as "1 Hz, 0.67 mm, harmonic 3"; with numbers if alike.

    Examples
    --------
    >>> data = FrequencyResponse([1.0, 1.0, 2.0], [3.0, 2.0, 2.0], [6.7e-4, 6.7e-4, 2e-3])
    >>> row_names(data, [0, 2])
    ['1 Hz, 670 µm (row 0)', '2 Hz, 2 mm']
    """
    every = [_name(data, row) for row in range(data.n)] if len(rows) else []
    count = Counter(every)
    return [f"{every[r]} (row {r})" if count[every[r]] > 1 else every[r] for r in rows]


def _name(data: FrequencyResponse, row: int) -> str:
    driven = data.drive is not None and data.controlled[row] == "force"
    size = data.drive if driven or data.amplitude is None else data.amplitude
    unit = shown_unit("N" if size is data.drive else "m", data.motion)
    parts = [f"{data.frequency_hz[row]:.4g} Hz"]
    if size is not None:
        parts.append(engineering(float(size[row]), unit))
    harmonic = int(data.harmonic[row])
    if harmonic != 1:
        parts.append(f"harmonic {harmonic}" if harmonic else "mean force")
    if data.level is not None and data.level.dtype.kind == "U":
        parts.append(f"level {data.level[row]}")
    if data.run is not None and len(data.runs or ()) > 1:
        parts.append(f"run {data.run[row]}")
    return ", ".join(parts)


def labelled(parts: Sequence[FrequencyResponse], names: Sequence[str]) -> list[FrequencyResponse]:
    """Return the tables of several files with their names as levels, or else as runs.

    A level measured in a separate file is not a run: such files differ by their levels.
    """
    named = [(part, np.full(part.n, name)) for part, name in zip(parts, names, strict=True)]
    if any(part.run is not None for part in parts) or not _one_level_each(parts):
        return [part if part.runs else replace(part, run=label) for part, label in named]
    return [part if part.levels else replace(part, level=label) for part, label in named]


def _one_level_each(parts: Sequence[FrequencyResponse]) -> bool:
    """Return whether each table holds one level, and no two the same one at one frequency."""
    levels = [part.levels for part in parts]
    if all(levels):
        return max(map(len, levels)) == 1 and len(set().union(*levels)) == len(parts)
    if any(levels):
        return False
    bands = np.array([(p.frequency_hz.min(), p.frequency_hz.max()) for p in parts])
    for column in zip(*map(sizes, parts), strict=True):
        stated = [size for size in column if size is not None]
        one_each = all(size.max() < _SAME_LEVEL * size.min() for size in stated)
        medians = np.array([np.median(size) for size in stated])
        if one_each and len(stated) == len(parts) and _all_differ(medians, bands):
            return True
    return False


def one_run(records: Sequence[Record]) -> bool:
    """Return whether each record is a sine or a sweep at one level, and no two are alike."""
    for channel in ("force_samples", "motion_samples"):
        waves = [getattr(record, channel) - getattr(record, channel).mean() for record in records]
        largest = np.array([np.quantile(np.abs(wave), _NEARLY_ALL) for wave in waves])
        sizes = np.array([np.sqrt(2.0 * np.mean(wave**2)) for wave in waves])
        steady = (sizes < _SAME_LEVEL * largest) & (largest < _SAME_LEVEL * sizes)
        crossings = np.array([np.count_nonzero(np.diff(np.signbit(wave))) for wave in waves])
        rates = 0.5 * crossings / [record.time[-1] - record.time[0] for record in records]
        bands = rates[:, None] * [_SAME_LEVEL**-0.5, _SAME_LEVEL**0.5]
        if steady.all() and _all_differ(sizes, bands):
            return True
    return False


def _all_differ(sizes: FloatArray, bands: FloatArray) -> bool:
    """Return whether no two of `sizes`, (n,), agree where `bands` of frequency, (n, 2), overlap."""
    low, high = bands.T
    overlap = (low[:, None] < _SAME_FREQUENCY * high) & (low < _SAME_FREQUENCY * high[:, None])
    alike = (sizes[:, None] < _SAME_LEVEL * sizes) & (sizes < _SAME_LEVEL * sizes[:, None])
    return bool(np.count_nonzero(overlap & alike) == len(sizes))  # each with itself


def sizes(part: FrequencyResponse) -> tuple[FloatArray | None, FloatArray | None]:
    """Return the amplitudes of force and displacement of the fundamental, or of all rows."""
    first = part.select(rows=part.harmonic == 1) if (part.harmonic == 1).any() else part
    gain = first.to("dynamic_stiffness").gain
    drive, amplitude = first.drive, first.amplitude
    if drive is None and amplitude is not None:
        drive = amplitude * gain
    if amplitude is None and drive is not None:
        amplitude = drive / gain
    return drive, amplitude


def stated_levels(lines: Iterable[str]) -> dict[str, str]:
    """Return the drive and the amplitude that lines of a header state, if each states one only."""
    stated: dict[str, set[str]] = {}
    for line in lines:
        match = _LINE.match(line[:200])
        if match is None:
            continue
        words = set(re.split(r"[\s_.-]+", match["key"].casefold())) - {""}
        sized = words & _SIZES or words == {"drive"}
        if not sized or not all(map(_SUBJECT.fullmatch, words)):
            continue
        unit = match["bracketed"] or match["unit"] or ""
        text = f"{match['value'].replace(',', '.')} {unit.strip()}"
        try:
            _, kind, _ = parse_quantity(text, (*DRIVE_KINDS, *MOTION_KINDS), "level")
        except (UnitError, ValidationError):
            continue
        role = "drive" if kind in DRIVE_KINDS else "amplitude"
        stated.setdefault(role, set()).add(text)
    return {role: texts.pop() for role, texts in stated.items() if len(texts) == 1}

"""The raw content of a file: named channels with their units."""

from __future__ import annotations

import contextlib
import difflib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import LARGEST, BoolArray, ComplexArray, FloatArray
from dahl_ident.data.columns import Column
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DahlIdentError, DataError, UnitError
from dahl_ident.units import parse_unit

CELL = {
    mark: re.compile(
        r"\s*[-+]?(?:"
        + (rf"\d{{1,3}}(?:\{mark[1]}\d{{3}})+(?:\{mark[0]}\d*)?|" if mark[1:] else "")
        + rf"(?:\d+(?:\{mark[0]}\d*)?|\{mark[0]}\d+)(?:[eE][-+]?\d+)?|nan|inf(?:inity)?)\s*",
        re.IGNORECASE | re.ASCII,
    )
    for mark in (".", ",", ".,", ",.")
}
"""Patterns of a number in a cell, by decimal mark and, after it, thousands separator if any."""
_COUNTED = re.compile(r"column ([0-9]{1,4})")
_SUFFIXES = {"hz": "Hz", "deg": "deg", "rad": "rad", "s": "s"}
_SYMBOL = "(?:[numkM]?(?:Nm|N|m|rad|V|A|Hz|s)|s2|kg|lbf|(?i:hz|deg|rad|s))"
# no unit is split off a name of one letter
_UNIT_AT_END = re.compile(rf"(.*?[^\W_]{{2}})[\s._-]+({_SYMBOL}(?:_per_{_SYMBOL})*)")
_CODES = {10.0**n - 1.0 for n in (3, 4, 5, 6)} | {999.9, 9999.9, 999.99, 9999.99}
_CODES |= {limit for bits in (15, 31) for limit in (2.0**bits - 1.0, 2.0**bits)}  # of integers
"""Marks of missing values in files of data loggers, with either sign."""

_SMALLEST_OVERFLOW = 1e30  # instruments write 1e30, 9.9e37 and the like
_CODE_RATIO = 5.0  # a code for a missing value exceeds every measured number by this factor
_FEWEST_VALUES = 4  # with fewer, a value far from the others may be measured
_LONGEST_WORD = 200  # letters of a label, time stamp or number
_LONGEST_HEADER = 400  # letters of a cell with name and unit
_INDEX = re.compile(r"[\d:, *]+")
# F / N, according to ISO 80000, or F, N
_UNBRACKETED = re.compile(r"\s*(.*\S)(?:\s+(?:/|in)|,)\s+(\S.*)")
_CURVED = re.compile(r"\s*(.*?\S)\s*\((.*)\)\s*")
_PADDING = (1 << 26, 16)  # most memory of a column of text: bytes, or bytes per letter


@dataclass(frozen=True)
class Stored:
    """An array that is read from its file when needed; `what` names it in messages."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[slice], NDArray[Any]]
    what: str

    @cached_property
    def array(self) -> NDArray[Any]:
        """The whole array, read once."""
        return self[slice(None)]

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        try:
            return self.read(rows)
        except DahlIdentError:
            raise
        except Exception as exc:  # libraries raise errors of every kind on damaged files
            raise DataError(f"{self.what} cannot be read: {exc}") from exc


@dataclass(frozen=True)
class RawChannel:
    """One named array of a file.

    `role` is that of a column map, if the format defines it; `short` is the last part of a path, by
    which a role is found without a map.
    """

    name: str
    content: NDArray[Any] | Stored
    unit: str | None = None
    role: str | None = None
    short: str | None = None

    @property
    def values(self) -> NDArray[Any]:
        """The array, read from the file if necessary."""
        return self.content.array if isinstance(self.content, Stored) else self.content

    @property
    def size(self) -> int:
        """Number of values; nothing is read."""
        return math.prod(self.content.shape)

    @property
    def kind(self) -> str:
        """Kind of numbers, as in ``dtype.kind``; nothing is read."""
        return self.content.dtype.kind

    def part(self, rows: slice) -> RawChannel:
        """Return a channel of some of the values; no others are read."""
        return replace(self, content=self.content[rows])

    @property
    def unit_in_name(self) -> str | None:
        """Unit at the end of a name such as ``frequency_hz``, ``drive_N`` or ``re_m_per_N``."""
        match = _UNIT_AT_END.fullmatch(self.short or self.name)
        if match is None:
            return None
        return _SUFFIXES.get(match[2].casefold(), match[2].replace("_per_", "/"))

    def is_called(self, declared: Column) -> bool:
        """Return whether this is the declared column, by its role or else by its name."""
        name = self.short or self.name
        if self.role is not None:
            return self.role == declared.names[0]
        match = _UNIT_AT_END.fullmatch(name)
        stem = match is not None and plain(match[1]) in declared.names
        return plain(name) in declared.names or (
            stem and declared.accepts(self.unit_in_name, self.name)
        )

    @property
    def header(self) -> str:
        """Name and unit as in the header of a table."""
        return self.name if self.unit is None else f"{self.name} [{self.unit}]"


TRACE = "analyser's trace"
"""The format of pairs of numbers without a header, preceded by their count."""


@dataclass(frozen=True)
class RawFile:
    """All channels of one file.

    `row_name` describes the position of a value in the file, given its index. `decimal` is the
    decimal mark in columns of text. `metadata` is that of an earlier save, `options` are those of
    the user, `stated` holds drive and amplitude from the header. A repeated header starts another
    run at each row in `runs`. `notes` are the assumptions made.
    """

    name: str
    format: str
    channels: tuple[RawChannel, ...]
    sha256: str | None = None
    headerless: bool = False
    decimal: str = "."
    row_name: Callable[[int], str] = field(default=lambda i: f"row {i + 1}")
    metadata: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    runs: tuple[int, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    stated: Mapping[str, str] = field(default_factory=dict)

    def rows(self, keep: BoolArray) -> RawFile:
        """Return the file with only the rows to `keep` of channels of this length."""
        kept = np.flatnonzero(keep)
        channels = tuple(
            replace(c, content=c.values[keep]) if c.content.shape == keep.shape else c
            for c in self.channels
        )
        return replace(self, channels=channels, row_name=lambda i: self.row_name(int(kept[i])))

    def where(self, channel: RawChannel, index: int) -> str:
        """Return file, row and column of a value, for messages."""
        return f"{self.name}, {self.row_name(index)}, column {channel.name!r}"

    def find(self, text: str) -> RawChannel:
        """Return the only channel with this name, header, last part of a path, or number."""
        exact = [c for c in self.channels if text in (c.name, c.header)]
        matches = exact or [c for c in self.channels if plain(c.name) == plain(text)]
        if len(matches) > 1:
            raise DataError(
                f"{self.name}: {len(matches)} columns are called {text!r}; expected one. "
                "Rename them in the file, or count them: 'column 2'"
            )
        matches = matches or [c for c in self.channels if plain(c.short or "") == plain(text)]
        if len(matches) > 1:
            paths = listed([c.name for c in matches], 20)
            raise DataError(
                f"{self.name}: {len(matches)} columns are called {text!r}; write one of {paths}"
            )
        if matches:
            return matches[0]
        name, unit = split_header(text)
        if unit is not None:
            return replace(self.find(name), unit=unit)
        counted = _COUNTED.fullmatch(text)
        if counted and 0 < int(counted[1]) <= len(self.channels):
            return self.channels[int(counted[1]) - 1]
        names = [c.name for c in self.channels]
        close = difflib.get_close_matches(text, names, 3) or names
        raise DataError(f"{self.name}: no column is called {text!r}; there are {listed(close, 20)}")

    def matching(self, pattern: str) -> dict[str, RawChannel]:
        """Return the channels that a path with ``*`` matches, by the part that varies."""
        path, unit = split_header(pattern)
        if unit is not None and "*" in path:
            return {k: replace(c, unit=unit) for k, c in self.matching(path).items()}
        parts = re.fullmatch(r"(|.*?[./])([^./]*\*(?:.*\*)?[^.*/]*)([./][^*]*|)", pattern)
        assert parts is not None  # callers pass patterns with a star
        before, varying, after = (
            re.escape(p).replace(r"\*", r"[^.\[\]/]*") for p in parts.groups()
        )
        expression = re.compile(f"{before}({varying}){after}")
        channels = {m[1]: c for c in self.channels if (m := expression.fullmatch(c.name))}
        if not channels:
            names = listed([c.name for c in self.channels], 20)
            raise DataError(f"{self.name}: nothing matches {pattern!r}; there are {names}")
        return channels

    def numbers(self, channel: RawChannel, *, infinite: bool = False) -> FloatArray:
        """Return a channel's numbers; refuse other cells, and infinite ones unless allowed."""
        values = channel.values
        if values.dtype.kind == "c":
            raise DataError(
                f"{self.name}: column {channel.name!r} holds complex numbers; expected real ones"
            )
        if values.dtype.kind not in "fiu":
            values = self.from_text(channel)
        values = np.atleast_1d(values).astype(np.float64, copy=False)
        limit = np.inf if infinite else LARGEST
        if values.size and not (values.min() >= -limit and values.max() <= limit):
            bad = np.flatnonzero(~(np.abs(values) <= limit))
            i = int(bad[0])
            what = "empty or NaN" if np.isnan(values[i]) else f"{values[i]:g}"
            raise DataError(
                f"{self.where(channel, i)}: the cell is {what} ({bad.size} such cells); expected "
                "a measured number"
            )
        for code, others in ({} if infinite else missing_marks(values)).items():
            bad = np.flatnonzero(values == code)
            raise DataError(
                f"{self.where(channel, int(bad[0]))}: the cell is {code:g} ({bad.size} such "
                f"cells), and all others are below {others:.3g} in size: a mark of a "
                "missing value? Delete these rows, or leave the cells empty"
            )
        return values

    def complex_numbers(self, channel: RawChannel) -> ComplexArray:
        """Return a channel's complex numbers, also those written as text, such as ``5+1i``."""
        values = np.atleast_1d(channel.values)
        if values.dtype.kind == "U":
            numbers = np.empty(values.size, dtype=np.complex128)
            for i, text in enumerate(values.tolist()):
                try:
                    numbers[i] = complex(text.replace(" ", "").replace("i", "j"))
                except ValueError:
                    raise DataError(
                        f"{self.where(channel, i)}: {text[:40]!r} is not a complex number"
                    ) from None
            values = numbers
        if values.dtype.kind != "c":
            raise DataError(
                f"{self.name}: column {channel.name!r} holds no complex numbers; name the columns "
                "of real and imag, or of gain and phase"
            )
        self.require(np.abs(values) < LARGEST, channel, "finite numbers")
        return values.astype(np.complex128)

    def require(self, good: BoolArray, channel: RawChannel, expected: str) -> None:
        """Raise a DataError that names the first cell that is not `good`."""
        bad = np.flatnonzero(~good)
        if bad.size:
            i = int(bad[0])
            raise DataError(
                f"{self.where(channel, i)}: found {channel.values.flat[i]} ({bad.size} such "
                f"cells); expected {expected}"
            )

    def from_text(self, channel: RawChannel) -> FloatArray:
        """Return the numbers in cells of text, NaN for empty ones; refuse other text."""
        numbers = np.empty(channel.values.size)
        mark, thousands = self.decimal[0], self.decimal[1:]
        to_python = str.maketrans(mark, ".", thousands)
        for i, cell in enumerate(map(str, channel.values.flat)):
            if cell.strip() and not CELL[self.decimal].fullmatch(cell):
                comma = " with a decimal comma" if mark == "," else ""
                raise DataError(f"{self.where(channel, i)}: {cell[:40]!r} is not a number{comma}")
            numbers[i] = float(cell.translate(to_python)) if cell.strip() else np.nan
        return numbers


def cell_text(cell: Any) -> str:
    """Return a cell as text; empty for an empty cell or NaN."""
    return "" if cell is None or cell != cell else str(cell)


def column_of(cells: Sequence[Any]) -> NDArray[Any]:
    """Return numbers if every filled cell is one, otherwise text."""
    filled = [cell for cell in cells if cell_text(cell)]
    if all(isinstance(cell, (int, float)) and not isinstance(cell, bool) for cell in filled):
        with contextlib.suppress(OverflowError):  # integers too large for a float remain text
            return np.array([c if cell_text(c) else np.nan for c in cells], dtype=np.float64)
    return words(cells)


def words(cells: Iterable[Any]) -> NDArray[np.str_]:
    """Return cells as text; long ones are cut and marked, so that they cannot become numbers."""
    texts = map(cell_text, cells)
    short = [t if len(t) <= _LONGEST_WORD else f"{t[:_LONGEST_WORD]}..." for t in texts]
    lengths = [len(cell) for cell in short]
    if 4 * len(short) * max(lengths, default=0) > max(_PADDING[0], _PADDING[1] * sum(lengths)):
        raise MemoryError
    return np.array(short, dtype=np.str_)


def missing_marks(values: FloatArray) -> dict[float, float]:
    """Return marks of a missing value such as -9999, with the size of the largest other number."""
    marks = {}
    for code in {float(values.min()), float(values.max())} if values.size >= _FEWEST_VALUES else ():
        if abs(code) in _CODES or abs(code) >= _SMALLEST_OVERFLOW:
            others = np.abs(values[values != code])
            if others.size and others.max() < abs(code) / _CODE_RATIO:
                marks[code] = float(others.max())
    return marks


def plain(name: str) -> str:
    """Return a name in lower case, with each run of blanks, dots and hyphens as one _."""
    return re.sub(r"[\s._-]+", "_", name.strip().casefold())


def split_header(text: str) -> tuple[str, str | None]:
    """Split ``"force [kN]"``, ``"force (kN)"``, ``"F / kN"``, ``"force in kN"`` or ``"force, kN"``.

    Text in square brackets is the unit, unless it is an index.
    """
    if len(text) > _LONGEST_HEADER:
        return text.strip(), None
    square = re.fullmatch(r"\s*(.*?)(\s*)\[([^\[\]]*)\]\s*", text)
    unit = square[3].strip() if square else ""
    index = _INDEX.fullmatch(unit) and not (unit == "1" and square and square[2])
    if square and square[1] and unit and not index:
        return square[1], unit
    for match in filter(None, (p.fullmatch(text) for p in (_CURVED, _UNBRACKETED))):
        if match[2].strip() == "dB":
            return match[1], "dB"  # without a reference: an error if the column is used
        with contextlib.suppress(UnitError):
            return match[1], parse_unit(match[2]).text
    return text.strip(), None

"""Tables stored as cells, rows or columns: Excel, Parquet, pandas, JSON, SDyPy.

JSON may hold ``{"x [mm]": [...], ...}``; ``[{"name": "x", "values": [...], "unit": "mm"}, ...]``;
rows, ``[{"x [mm]": 1.0}, ...]`` or ``[["x [mm]"], [1.0], ...]``; ``{"columns": [...], "data":
[[...], ...]}`` and ``{"x [mm]": {"0": 1.0, ...}}`` as pandas writes them; or the time series of
SDyPy (its enhancement proposal 5). Units are part of the names, of each column, or given as
``"units"`` or ``"displacement units"``.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import (
    CELL,
    RawChannel,
    RawFile,
    Stored,
    cell_text,
    column_of,
    plain,
    split_header,
    words,
)
from dahl_ident.data.readers.file import File, in_child_process, refuse_many, utf8
from dahl_ident.data.rows import stated_levels
from dahl_ident.data.storage import library, read_metadata
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError, UnitError, argument
from dahl_ident.units import parse_unit

if TYPE_CHECKING:
    import pandas as pd

_HEAD_ROWS = 400  # converted to text, which is slow, to find the table
_BYTES, _SECONDS = 1 << 30, 15  # limits of reading, as a small archive can unpack to any size
_UNNAMED = "column {}"
_UNIT_OF = re.compile(r"(.+?)[ _]units?")  # "displacement units": "mm"
_VALUES, _UNITS = ("values", "data"), ("unit", "unit_str", "units")
_TABLES = ("channels", "signals", "columns", "data", "rows")
_NUMBERED = "x-axis"  # precedes the channel numbers in files of Keysight oscilloscopes


def read_workbook(file: File, sheet: str | None = None) -> RawFile:
    """Return the table on a sheet, by default on the only sheet with a table."""
    sheets = _cells(file)
    if sheet is not None:
        if sheet not in sheets:
            raise DataError(f"{file.name}: no sheet {sheet!r}; there are {listed(sheets)}")
        sheets = {sheet: sheets[sheet]}
    tables = {name: _table(file, name, rows) for name, rows in sheets.items()}
    with_table = {name: table for name, table in tables.items() if table is not None}
    if len(with_table) == 1:
        return next(iter(with_table.values()))
    if with_table:
        raise DataError(
            f"{file.name}: sheets {listed(with_table)} hold tables; name one with "
            f"{argument('sheet', next(iter(with_table)))}"
        )
    raise DataError(
        f"{file.name}: no table of numbers on {listed(tables)}; expected at least two columns "
        "of numbers under a header line"
    )


def _cells(file: File) -> dict[str, list[list[Any]]]:
    damaged = None
    with contextlib.suppress(Exception), zipfile.ZipFile(file.stream()) as archive:
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"the check sum of {damaged} differs")
    calamine = library("python_calamine", "excel")

    def read() -> dict[str, list[list[Any]]]:  # pragma: no cover
        with file.opened() as content:
            book = calamine.CalamineWorkbook.from_filelike(content)
            return {
                sheet.name: [
                    [c if isinstance(c, (float, int, str, bool)) else str(c) for c in row]  # dates
                    for row in book.get_sheet_by_name(sheet.name).to_python(skip_empty_area=False)
                ]
                for sheet in book.sheets_metadata
                if sheet.typ == calamine.SheetTypeEnum.WorkSheet
            }

    cells, error = in_child_process(read, seconds=_SECONDS, bytes_at_most=_BYTES)
    if error:
        raise DataError(f"{file.name}: the workbook is damaged, or too large: {error[:200]}")
    sheets: dict[str, list[list[Any]]] = cells
    return sheets


def _table(file: File, sheet: str, cells: list[list[Any]]) -> RawFile | None:
    texts = [[cell_text(cell) for cell in row] for row in cells[:_HEAD_ROWS]]
    rows = [row if any(row) else None for row in texts]
    run = best_run(rows, ".")
    if run is None:
        return None
    where = f"{file.name}, sheet {sheet!r}"
    refuse_second_header(rows, run.start, ".", lambda i: f"{where}, row {i + 1}")
    above = [row for row in rows[: run.start] if row is not None]
    named = header(above, run.width)
    filled = [i for i in range(run.start, len(cells)) if any(cell_text(c) for c in cells[i])]
    columns = [column_of([cells[i][k] for i in filled]) for k in range(run.width)]
    return file.source(
        "workbook",
        named_channels(columns, named, where),
        headerless=not named.names,
        row_name=lambda i: f"sheet {sheet!r}, row {filled[i] + 1}",
        stated=stated_levels(";".join(filter(None, row)) for row in above),
    )


def read_parquet(file: File) -> RawFile:
    """Return the columns of a Parquet file, each of which is read when used."""
    pa, pq = library("pyarrow", "parquet"), library("pyarrow.parquet")
    table = pq.ParquetFile(file.stream())
    schema, rows = table.schema_arrow, table.metadata.num_rows
    stored = schema.metadata or {}
    attributes = json.loads(stored.get(b"pandas", b"{}")).get("attributes")
    if not attributes:  # written by older releases of pyarrow and pandas
        attributes = json.loads(stored.get(b"PANDAS_ATTRS", b"{}"))
    saved = attributes.get("dahl_ident") if isinstance(attributes, dict) else None
    metadata = {} if saved is None else read_metadata(json.dumps(saved))
    if added := _added_bytes(file, table.metadata):
        raise ValueError(f"{added} bytes belong to no column; were some added?")
    refuse_many(file.name, len(schema.names), "columns")
    file.refuse_above_limit(8 * rows, "one column")
    if not rows:
        raise DataError(f"{file.name}: the table is empty")
    channels: list[RawChannel] = []
    for field in schema:
        if pa.types.is_nested(field.type) or schema.names.count(field.name) > 1:
            file.notes.append(f"{field.name} ({field.type}) is not used")
            continue
        name, unit = split_header(field.name)
        read = functools.partial(_parquet_values, table, field.name)
        what = f"{file.name}: column {field.name!r}"
        content: Any = Stored((rows,), np.dtype(np.float64), read, what)
        is_number = pa.types.is_floating(field.type) or pa.types.is_integer(field.type)
        channels.append(RawChannel(name, content if is_number else content.array, unit))
    if not channels:
        raise DataError(f"{file.name}: no column of numbers or text; {listed(file.notes, 3)}")
    return file.source("Parquet", channels, metadata=metadata)


def _added_bytes(file: File, metadata: Any) -> int:
    """Return the number of bytes between columns and footer, where Arrow writes only indices."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    parts = [g.column(k) for g in groups for k in range(g.num_columns)]
    # older releases repeat the description of a column after it, and state the offset
    described = any(
        p.has_offset_index or p.file_offset or getattr(p, "bloom_filter_offset", None)
        for p in parts
    )
    if "arrow" not in str(metadata.created_by) or described:
        return 0
    ends = [
        (p.dictionary_page_offset or p.data_page_offset) + p.total_compressed_size for p in parts
    ]
    return int(file.length - 8 - metadata.serialized_size - max(ends, default=4))


def _parquet_values(table: Any, name: str, rows: slice) -> NDArray[Any]:
    """Return some rows of a column, from the groups of rows that hold them."""
    metadata = table.metadata
    start, stop, _ = rows.indices(metadata.num_rows)
    sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    edges = np.cumsum([0, *sizes])
    first = int(np.searchsorted(edges, start, side="right")) - 1
    groups = list(range(first, int(np.searchsorted(edges, stop))))
    column = table.read_row_groups(groups, [name], use_pandas_metadata=False)[name]
    return _plain(column.slice(start - int(edges[first]), stop - start).to_pandas())


def frame_source(frame: pd.DataFrame) -> RawFile:
    """Return the columns of a pandas table, including a named index, with units from the names."""
    metadata = frame.attrs.get("dahl_ident", {})
    if any(level is not None for level in frame.index.names):
        frame = frame.reset_index()
    if not len(frame) or not len(frame.columns):
        raise DataError("the table is empty")
    headers = [split_header(str(label)) for label in frame.columns]
    channels = tuple(
        RawChannel(header, _plain(frame.iloc[:, i]), unit)
        for i, (header, unit) in enumerate(headers)
    )
    return RawFile("the table", "table", channels, metadata=metadata)


def _plain(series: pd.Series[Any]) -> NDArray[Any]:
    values = series.to_numpy()
    if values.dtype.kind in "fiubcU":
        return values
    from pandas.api.types import is_numeric_dtype

    if is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=np.float64, na_value=np.nan)  # pandas' nullable numbers
    return words(values)


def read_json(file: File) -> RawFile:
    """Return the columns of a JSON file."""
    try:
        text = utf8(file.lines(b"[{")).decode("utf-8", "replace")
        file.refuse_above_limit(8 * text.count(","), f"JSON of {text.count(',')} numbers")
        content = json.loads(text, object_pairs_hook=_json_object)
    except DataError:  # a ValueError too
        raise
    except (ValueError, RecursionError) as exc:
        raise DataError(f"{file.name}: not a JSON file: {exc}") from exc
    return dictionary_source(content, file.name, "JSON", file.sha256)


def _json_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON; refuse one that has a name twice, of which dict keeps the last."""
    content = dict(pairs)
    if len(content) < len(pairs):
        repeated = next(n for n, count in Counter(n for n, _ in pairs).items() if count > 1)
        raise ValueError(f"one object has the name {repeated[:60]!r} twice")
    return content


def dictionary_source(
    content: Any, name: str = "the list", kind: str = "channels", sha256: str | None = None
) -> RawFile:
    """Return the columns of a dictionary, of rows, or of a list of channels."""
    channels = tuple(_channels(content, name))
    if not channels:
        raise DataError(f"{name}: no columns; expected an object of columns, or a list of rows")
    refuse_many(name, len(channels), "columns")
    headerless = all(c.name == _UNNAMED.format(i + 1) for i, c in enumerate(channels))
    return RawFile(name, kind, channels, sha256, headerless=headerless)


def _channels(content: Any, name: str, units: Any = None) -> Iterator[RawChannel]:
    """Yield the columns; `units` are given by name, or in the order of a list of names."""
    if isinstance(content, dict):
        common = {m[1]: unit for key, unit in content.items() if (m := _UNIT_OF.fullmatch(key))}
        units = content.get("units", units or common)
        rows = [content[key] for key in ("data", "rows") if _is_list_of(list, content.get(key))]
        tables = [content.get(key) for key in _TABLES]
        nested = [t for t in tables if isinstance(t, dict) or _is_list_of((list, dict), t)]
        if "columns" in content and rows:
            columns = _transposed(content["columns"], rows[0], name)
            if isinstance(units, list) and len(units) == len(columns):
                units = dict(zip(columns, units, strict=True))
            yield from _columns(columns.items(), name, units)
        elif nested:
            yield from _channels(nested[0], name, units)
        else:
            yield from _columns(content.items(), name, units)
    elif _is_list_of(list, content):
        header = all(isinstance(cell, str) for cell in content[0])
        labels = content[0] if header else [_UNNAMED.format(i + 1) for i in range(len(content[0]))]
        yield from _columns(_transposed(labels, content[header:], name).items(), name, units)
    elif not _is_list_of(Mapping, content):
        raise DataError(
            f"{name}: found a {type(content).__name__}; expected an object of columns, a list of "
            "rows, or a list of channels"
        )
    elif all("name" in c and "data" in c for c in content) and any(
        "fs" in c or "time" in c for c in content
    ):
        yield from _sdypy(content, name)
    elif all("name" in c and any(isinstance(c.get(v), list) for v in _VALUES) for c in content):
        yield from _columns([(str(c["name"]), c) for c in content], name, units)
    else:
        keys = list(dict.fromkeys(key for row in content for key in row))
        refuse_many(name, len(keys), "columns")
        yield from _columns([(k, [row.get(k) for row in content]) for k in keys], name, units)


def _is_list_of(kind: type | tuple[type, ...], content: Any) -> bool:
    is_list = isinstance(content, Sequence) and not isinstance(content, str) and len(content) > 0
    return is_list and all(isinstance(one, kind) for one in content)


def _transposed(labels: Any, rows: list[Any], name: str) -> dict[str, Any]:
    if not isinstance(labels, list) or any(
        not isinstance(row, list) or len(row) != len(labels) for row in rows
    ):
        raise DataError(f"{name}: the rows of data differ in length from columns")
    if len({str(label) for label in labels}) < len(labels):
        raise DataError(f"{name}: several columns have one name in {listed(map(str, labels), 20)}")
    return {str(label): [row[i] for row in rows] for i, label in enumerate(labels)}


def _columns(content: Iterable[tuple[str, Any]], name: str, units: Any) -> Iterator[RawChannel]:
    stated = units if isinstance(units, dict) else {}
    known = {plain(str(key)): unit for key, unit in stated.items()}
    index: Any = None
    for key, value in content:
        unit = known.get(plain(key))
        if isinstance(value, Mapping) and any(v in value for v in _VALUES):
            unit = next((value[u] for u in _UNITS if u in value), unit)
            value = next(value[v] for v in _VALUES if v in value)
        elif isinstance(value, Mapping) and value and all(row.isdecimal() for row in value):
            index = index or value.keys()
            if value.keys() != index:
                raise DataError(f"{name}: column {key!r} has other rows than the columns before it")
            value = [value[row] for row in index]
        elif not isinstance(value, list):
            continue
        yield _channel(key, value, unit, name)


def _channel(key: Any, values: Any, unit: Any, name: str) -> RawChannel:
    label, in_label = split_header(str(key))
    text = unit if isinstance(unit, str) and unit.strip() else in_label
    return RawChannel(label, _array(values, f"{name}: column {label!r}"), text)


def _array(values: Any, what: str) -> NDArray[Any]:
    """Return numbers, or text if some cell is not a number; None is an empty cell."""
    if isinstance(values, np.ndarray):
        array: NDArray[Any] = values
        if np.ma.is_masked(values) and values.dtype.kind in "fiu":
            array = np.ma.filled(np.ma.asarray(values, np.float64), np.nan)
        if array.ndim != 1 or array.dtype.kind not in "fiubU":
            raise DataError(f"{what} has the shape {array.shape}; expected a list of numbers")
        return array
    if not isinstance(values, (list, tuple)) or any(isinstance(v, (list, dict)) for v in values):
        raise DataError(f"{what} is nested; expected a list of numbers")
    return column_of(values)


def _sdypy(channels: Sequence[Mapping[str, Any]], name: str) -> Iterator[RawChannel]:
    labels = Counter(str(c["name"]) for c in channels)
    repeated = [label for label, count in labels.items() if count > 1]
    if repeated:
        raise DataError(
            f"{name}: several channels are called {listed(repeated)}; expected one each"
        )
    times: list[NDArray[Any]] = []
    for channel, label in zip(channels, labels, strict=True):
        what = f"{name}: channel {label!r}"
        values = _array(channel["data"], what)
        yield _channel(label, values, channel.get("unit_str", channel.get("unit")), name)
        if channel.get("time") is not None:
            time = _array(channel["time"], f"{what}, its time")
            if time.size != values.size:
                raise DataError(
                    f"{what} has {values.size} values at {time.size} times; expected as many"
                )
        else:
            rate = channel.get("fs")
            if not isinstance(rate, (int, float, np.number)) or not 0.0 < float(rate) < np.inf:
                raise DataError(
                    f"{what} has fs = {rate!r} and no time; expected a sampling frequency, Hz"
                )
            time = np.arange(values.size) / float(rate)
        if not any(np.array_equal(time, known) for known in times):
            times.append(time)
    if len(times) > 1:
        raise DataError(f"{name}: the channels are sampled at different times; expected one time")
    if "time" not in labels:
        yield RawChannel("time", times[0], "s", "time")


class Run(NamedTuple):
    """Consecutive rows of one width with a number in each, and a score for the share of numbers."""

    start: int
    width: int
    score: int


@dataclass(frozen=True)
class Header:
    """Names and units of the columns; no names for a table without a header.

    `cells` is the number of columns in the header line. If it is `contradicted`, another line names
    the same columns differently.
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    cells: int
    contradicted: bool = False


def best_run(rows: Iterable[Sequence[str] | None], mark: str) -> Run | None:
    """Return the run with the highest score: twice the numbers, minus the cells of text.

    None stands for a blank line or a comment. A line of another width does not end a run.
    """
    is_number = CELL[mark].fullmatch
    best: Run | None = None
    start = width = score = 0
    for i, row in enumerate(rows):
        if row is None:
            continue
        numbers = len([cell for cell in row if is_number(cell)])
        if not numbers:
            width = 0
            continue
        if not width:
            start = i
            width = len(row)
            score = 0
        if len(row) == width > 1:
            filled = len(row) if numbers == len(row) else len([c for c in row if c.strip()])
            score += 3 * numbers - filled
        if best is None or score > best.score:
            best = Run(start, width, score)
    return best if best and best.score > 0 else None


def refuse_second_header(
    rows: Sequence[Sequence[str] | None], start: int, mark: str, where: Callable[[int], str]
) -> None:
    """Refuse rows above the header that look like those of the table: a second table."""

    def numeric(row: Sequence[str]) -> list[bool | None]:  # None for empty cells
        return [CELL[mark].fullmatch(c) is not None if c.strip() else None for c in row]

    first = numeric(rows[start] or [])
    for i, row in enumerate(rows[: start if first.count(True) > 1 else 0]):
        if row is not None and len(row) == len(first):
            same = zip(numeric(row), first, strict=True)
            if all(a is b or None in (a, b) for a, b in same):
                raise DataError(
                    f"{where(i)} is a row of numbers like those from {where(start)} on, and "
                    "between them are lines of words: the file has more than one header. Split "
                    "it there"
                )


def header(above: Sequence[Sequence[str]], width: int, filled: int | None = None) -> Header:
    """Return names and units from the lines directly above the numbers, in file order."""
    least = width - 1 if filled is None else min(filled, width - 1)
    lines: list[list[str]] = []
    for row in reversed(above):
        cells = _without_trailing(row)
        fits = least <= len(cells) <= width and len(row) == len(above[-1])
        numbered = bool(cells) and cells[0].casefold() == _NUMBERED
        holds_number = any(CELL["."].fullmatch(c) or CELL[","].fullmatch(c) for c in cells)
        if not cells or not fits or (holds_number and not numbered):
            break
        lines.insert(0, [*cells, *[""] * (width - len(cells))])
    if not lines:
        return Header((), (), 0)
    k = next((k for k in range(len(lines) - 1, 0, -1) if are_units(lines[k])), None)
    split = [[split_header(cell) for cell in line] for line in reversed(lines)]
    if k is None:
        named = max(split, key=lambda cells: sum(unit is not None for _, unit in cells))
    else:
        stated = split[len(lines) - k]
        split.append(
            [(name, _bare(cell)) for (name, _), cell in zip(stated, lines[k], strict=True)]
        )
        named = [
            (n, unit or below) for (n, unit), (_, below) in zip(stated, split[-1], strict=True)
        ]
    names, units = zip(*named, strict=True)
    contradicted = any(contradict(named, other) for other in split)
    if k is not None and k + 1 < len(lines):  # such as real and imaginary part, of one name
        parts = zip(names, lines[k + 1], strict=True)
        names = tuple(part if part and names.count(n) > 1 else n for n, part in parts)
    return Header(names, units, len(_without_trailing(names)), contradicted)


def contradict(
    first: Sequence[tuple[str, str | None]], second: Sequence[tuple[str, str | None]]
) -> bool:
    """Return whether two lines name the same columns in another order or with other units."""
    names = [plain(name) for name, _ in first]
    others = [plain(name) for name, _ in second]
    if sorted(filter(None, names)) != sorted(filter(None, others)) or len(set(names)) < 2:
        return False
    units = [(a, b) for (_, a), (_, b) in zip(first, second, strict=True) if a and b and a != b]
    return names != others or any(_differ(*pair) for pair in units)


def _differ(first: str, second: str) -> bool:
    try:
        return replace(parse_unit(first), text="") != replace(parse_unit(second), text="")
    except UnitError:
        return False


def _without_trailing(row: Sequence[str]) -> list[str]:
    cells = [cell.strip() for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _bare(cell: str) -> str | None:
    """Return the unit in a cell of a row of units; None for an empty one."""
    text = cell.strip()
    if text[:1] in ("[", "(") and text[-1] in "])":
        text = text[1:-1].strip()
    return "1" if text == "-" else text or None


def are_units(cells: Sequence[str]) -> bool:
    """Return whether each cell is empty or a unit, and at least one is a unit."""
    try:
        return bool([parse_unit(unit) for cell in cells if (unit := _bare(cell)) is not None])
    except UnitError:
        return False


def named_channels(
    columns: Sequence[NDArray[Any]], named: Header, file: str
) -> tuple[RawChannel, ...]:
    """Return the columns with their names and units, without blank columns that have no name."""
    if named.contradicted:
        raise DataError(
            f"{file}: several lines above the numbers name the columns, with different units or "
            "in different order; expected one header. Delete the wrong one"
        )
    channels = []
    for i, values in enumerate(columns):
        label, unit = (named.names[i], named.units[i]) if named.names else ("", None)
        blank = np.char.strip(values) == "" if values.dtype.kind == "U" else values != values
        if not label and np.all(blank):
            continue
        if named.names and i >= named.cells:
            raise DataError(
                f"{file}: the header names {named.cells} columns, the rows have {len(columns)}; "
                "expected a name for each"
            )
        channels.append(RawChannel(label or f"column {i + 1}", values, unit))
    return tuple(channels)

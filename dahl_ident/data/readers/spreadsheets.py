"""Tables that a library returns as cells or columns: Excel, Parquet, pandas."""

from __future__ import annotations

import contextlib
import functools
import json
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.levels import stated_levels
from dahl_ident.data.raw_columns import (
    RawChannel,
    RawFile,
    Stored,
    cell_text,
    column_of,
    split_header,
    words,
)
from dahl_ident.data.readers.file import ZIP_ERRORS, File, apart, refuse_many
from dahl_ident.data.readers.header import best_run, header, named_channels, refuse_second_header
from dahl_ident.data.storage import library, read_metadata
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError, argument

if TYPE_CHECKING:
    import pandas as pd

_HEAD_ROWS = 400  # looked at as text, which takes long, to find the table
_BYTES, _SECONDS = 1 << 30, 15  # that reading may take: a small archive can unpack to anything


def read_workbook(file: File, sheet: str | None = None) -> RawFile:
    """Return the table on a sheet; without a name, on the only sheet that has one."""
    sheets = _cells(file)
    if sheet is not None:
        if sheet not in sheets:
            raise DataError(f"{file.name}: no sheet {sheet!r}; there are {listed(sheets)}")
        sheets = {sheet: sheets[sheet]}
    tables = {name: _table(file, name, rows) for name, rows in sheets.items()}
    with_table = {name: table for name, table in tables.items() if table is not None}
    if not with_table:
        raise DataError(
            f"{file.name}: no table of numbers on {listed(tables)}; expected at least two columns "
            "of numbers under a header line"
        )
    if len(with_table) > 1:
        raise DataError(
            f"{file.name}: sheets {listed(with_table)} hold tables; name one with "
            f"{argument('sheet', next(iter(with_table)))}"
        )
    return next(iter(with_table.values()))


def _cells(file: File) -> dict[str, list[list[Any]]]:
    """Return the cells of every sheet, read in a process of its own."""
    broken = None
    with contextlib.suppress(*ZIP_ERRORS), zipfile.ZipFile(file.stream()) as archive:
        broken = archive.testzip()
    if broken is not None:
        raise ValueError(f"the check sum of {broken} differs")
    calamine = library("python_calamine", "excel")

    def read() -> dict[str, list[list[Any]]]:  # pragma: no cover
        with file.opened() as content:
            book = calamine.CalamineWorkbook.from_filelike(content)
            return {name: _rows(book, name) for name in book.sheet_names}

    cells, error = apart(read, seconds=_SECONDS, bytes_at_most=_BYTES)
    if error:
        raise DataError(f"{file.name}: the workbook is damaged, or too large: {error[:200]}")
    sheets: dict[str, list[list[Any]]] = cells
    return sheets


def _rows(book: Any, name: str) -> list[list[Any]]:  # pragma: no cover
    """Return the cells of a sheet; numbers, text and truth values as they are, dates as text."""
    try:
        rows = book.get_sheet_by_name(name).to_python(skip_empty_area=False)
    except Exception as exc:
        if "worksheet" in type(exc).__name__.lower() or "chart" in str(exc).lower():
            return []  # a sheet of diagrams
        raise
    plain = (float, int, str, bool)
    return [[cell if isinstance(cell, plain) else str(cell) for cell in row] for row in rows]


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
    """Return the columns of a Parquet file, each read when it is used."""
    pa, pq = library("pyarrow", "parquet"), library("pyarrow.parquet")
    table = pq.ParquetFile(file.stream())
    schema, rows = table.schema_arrow, table.metadata.num_rows
    stored = schema.metadata or {}
    attributes = json.loads(stored.get(b"pandas", b"{}")).get("attributes")
    if not attributes:  # where older releases of pyarrow and pandas put them
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
    notes: list[str] = []
    for field in schema:
        if pa.types.is_nested(field.type) or schema.names.count(field.name) > 1:
            notes.append(f"{field.name} ({field.type}) is not used")
            continue
        name, unit = split_header(field.name)
        read = functools.partial(_parquet_values, table, field.name)
        what = f"{file.name}: column {field.name!r}"
        content: Any = Stored((rows,), np.dtype(np.float64), read, what)
        number = pa.types.is_floating(field.type) or pa.types.is_integer(field.type)
        channels.append(RawChannel(name, content if number else content.array, unit))
    if not channels:
        raise DataError(f"{file.name}: no column of numbers or text; {listed(notes, 3)}")
    return file.source("Parquet", channels, metadata=metadata, notes=tuple(notes))


def _added_bytes(file: File, metadata: Any) -> int:
    """Return the bytes between the columns and the footer, where Arrow writes indices at most."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    parts = [g.column(k) for g in groups for k in range(g.num_columns)]
    # older releases repeat the description of a column behind it, and state where
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


def frame_source(
    frame: pd.DataFrame, name: str = "the table", kind: str = "table", sha256: str | None = None
) -> RawFile:
    """Return the columns of a pandas table, a named index among them, units out of their names."""
    metadata = frame.attrs.get("dahl_ident", {})
    if any(level is not None for level in frame.index.names):
        frame = frame.reset_index()
    if not len(frame) or not len(frame.columns):
        raise DataError(f"{name}: the table is empty")
    headers = [split_header(str(label)) for label in frame.columns]
    channels = tuple(
        RawChannel(header, _plain(frame.iloc[:, i]), unit)
        for i, (header, unit) in enumerate(headers)
    )
    return RawFile(name, kind, channels, sha256, metadata=metadata)


def _plain(series: pd.Series[Any]) -> NDArray[Any]:
    values = series.to_numpy()
    if values.dtype.kind in "fiubcU":
        return values
    from pandas.api.types import is_numeric_dtype

    if is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=np.float64, na_value=np.nan)  # pandas' nullable numbers
    return words(values)

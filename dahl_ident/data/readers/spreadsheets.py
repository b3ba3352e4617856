"""Tables that a library returns as cells or columns: Excel, Parquet, pandas."""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.levels import stated_levels
from dahl_ident.data.raw_columns import Channel, Source, Stored, split_header, words
from dahl_ident.data.readers.child_process import apart
from dahl_ident.data.readers.file import MOST_CHANNELS, ZIP_ERRORS, File
from dahl_ident.data.readers.header import best_run, header, named_channels, refuse_second_header
from dahl_ident.data.storage import library, read_metadata
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

_HEAD_ROWS = 400  # looked at as text, which takes long, to find the table
_BYTES, _SECONDS = 1 << 30, 15  # that reading may take: a small archive can unpack to anything


def read_workbook(file: File, sheet: str | None = None) -> Source:
    """Return the table on a sheet; without a name, on the only sheet that has one."""
    sheets = _cells(file)
    if sheet is not None:
        if sheet not in sheets:
            raise DataError(f"{file.name}: no sheet {sheet!r}; there are {listed(sheets)}")
        sheets = {sheet: sheets[sheet]}
    tables = {name: _table(file, name, rows) for name, rows in sheets.items()}
    found = {name: table for name, table in tables.items() if table is not None}
    if not found:
        raise DataError(
            f"{file.name}: no table of numbers on {listed(tables)}; expected at least two columns "
            "of numbers under a header line"
        )
    if len(found) > 1:
        raise DataError(
            f"{file.name}: sheets {listed(found)} hold tables; name one with "
            f"sheet={next(iter(found))!r}"
        )
    return next(iter(found.values()))


def _cells(file: File) -> dict[str, list[list[Any]]]:
    """Return the cells of every sheet, read in a process of its own."""
    broken = None
    with contextlib.suppress(*ZIP_ERRORS), zipfile.ZipFile(file.stream()) as archive:
        broken = archive.testzip()
    if broken is not None:
        raise DataError(f"{file.name}: the workbook is damaged: the check sum of {broken} differs")
    calamine = library("python_calamine", "excel")

    def read() -> dict[str, list[list[Any]]]:  # pragma: no cover
        stream = file.stream()
        with stream.open("rb") if isinstance(stream, Path) else stream as content:
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


def _table(file: File, sheet: str, cells: list[list[Any]]) -> Source | None:
    texts = [[_text(cell) for cell in row] for row in cells[:_HEAD_ROWS]]
    rows = [row if any(row) else None for row in texts]
    run = best_run(rows, ".")
    if run is None:
        return None
    where = f"{file.name}, sheet {sheet!r}"
    refuse_second_header(rows, run.start, ".", lambda i: f"{where}, row {i + 1}")
    above = [row for row in rows[: run.start] if row is not None]
    named = header(above, run.width)
    filled = [i for i in range(run.start, len(cells)) if any(_text(c) for c in cells[i])]
    columns = [_column([cells[i][k] for i in filled]) for k in range(run.width)]
    return Source(
        file.name,
        "workbook",
        named_channels(columns, named, where),
        file.sha256,
        headerless=not named.names,
        row_name=lambda i: f"sheet {sheet!r}, row {filled[i] + 1}",
        stated=stated_levels(";".join(filter(None, row)) for row in above),
    )


def _text(cell: Any) -> str:
    return "" if cell is None or cell != cell else str(cell)


def _column(cells: list[Any]) -> NDArray[Any]:
    """Return numbers where every filled cell is one, else text."""
    texts = [_text(cell) for cell in cells]
    numeric = [isinstance(c, (int, float)) and not isinstance(c, bool) for c in cells]
    if all(n or not t for n, t in zip(numeric, texts, strict=True)):
        with contextlib.suppress(OverflowError):  # whole numbers beyond all floats stay text
            return np.array(
                [c if t else np.nan for c, t in zip(cells, texts, strict=True)], dtype=float
            )
    return words(texts)


def read_parquet(file: File) -> Source:
    """Return the columns of a Parquet file, each read when it is used."""
    library("pyarrow", "parquet")
    pq = library("pyarrow.parquet")
    try:
        table = pq.ParquetFile(file.stream())
        schema, rows = table.schema_arrow, table.metadata.num_rows
        metadata = _saved(schema)
        added = _added_bytes(file, table.metadata)
    except Exception as exc:  # pyarrow raises errors of many kinds on damaged files
        raise DataError(f"{file.name}: the file is damaged: {exc}") from exc
    if added:
        raise DataError(
            f"{file.name}: the file is damaged: {added} bytes belong to no column; were some added?"
        )
    if len(schema.names) > MOST_CHANNELS:
        raise DataError(f"{file.name}: the file has more than {MOST_CHANNELS} columns")
    file.refuse_above_limit(8 * rows, "one column")
    if not rows:
        raise DataError(f"{file.name}: the table is empty")
    channels: list[Channel] = []
    notes: list[str] = []
    for field in schema:
        kind = _arrow_kind(field.type)
        if kind is None or schema.names.count(field.name) > 1:
            notes.append(f"{field.name} ({field.type}) is not used")
            continue
        name, unit = split_header(field.name)
        read = _parquet_column(file, table, field.name)
        content: Any = Stored((rows,), np.dtype(np.float64), read)
        channels.append(Channel(name, content if kind == "f" else read(slice(None)), unit))
    if not channels:
        raise DataError(f"{file.name}: no column of numbers or text; {listed(notes, 3)}")
    return Source(file.name, "Parquet", tuple(channels), file.sha256, metadata=metadata,
                  notes=tuple(notes))  # fmt: skip


def _added_bytes(file: File, metadata: Any) -> int:
    """Return the bytes between the columns and the footer, where Arrow writes none but indices.

    Its older releases repeat the description of a column behind it, and state where.
    """
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    parts = [g.column(k) for g in groups for k in range(g.num_columns)]
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


def _saved(schema: Any) -> dict[str, Any]:
    """Return what an earlier save of this package left in the file."""
    stored = schema.metadata or {}
    attributes = json.loads(stored.get(b"pandas", b"{}")).get("attributes")
    if not attributes:  # where older releases of pyarrow and pandas put them
        attributes = json.loads(stored.get(b"PANDAS_ATTRS", b"{}"))
    saved = attributes.get("dahl_ident") if isinstance(attributes, dict) else None
    return {} if saved is None else read_metadata(json.dumps(saved))


def _arrow_kind(kind: Any) -> str | None:
    """Return f for numbers, U for text and the like, None for what is nested."""
    pa = library("pyarrow", "parquet")
    if pa.types.is_floating(kind) or pa.types.is_integer(kind):
        return "f"
    return None if pa.types.is_nested(kind) else "U"


def _parquet_column(file: File, table: Any, name: str) -> Callable[[slice], NDArray[Any]]:
    def read(rows: slice) -> NDArray[Any]:
        try:
            groups, skipped = _row_groups(table.metadata, rows)
            column = table.read_row_groups(groups, [name], use_pandas_metadata=False)[name]
            start, stop, _ = rows.indices(table.metadata.num_rows)
            series = column.slice(start - skipped, stop - start).to_pandas()
        except Exception as exc:
            raise DataError(f"{file.name}: column {name!r} cannot be read: {exc}") from exc
        return _plain(series)

    return read


def _row_groups(metadata: Any, rows: slice) -> tuple[list[int], int]:
    """Return the parts of a Parquet file that hold some rows, and the rows before them."""
    start, stop, _ = rows.indices(metadata.num_rows)
    sizes = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    edges = np.cumsum([0, *sizes])
    first = int(np.searchsorted(edges, start, side="right")) - 1
    last = int(np.searchsorted(edges, stop))
    return list(range(first, last)), int(edges[first])


def frame_source(
    frame: pd.DataFrame, name: str = "the table", kind: str = "table", sha256: str | None = None
) -> Source:
    """Return the columns of a pandas table, a named index among them, units out of their names."""
    metadata = frame.attrs.get("dahl_ident", {})
    if any(level is not None for level in frame.index.names):
        frame = frame.reset_index()
    if not len(frame) or not len(frame.columns):
        raise DataError(f"{name}: the table is empty")
    headers = [split_header(str(label)) for label in frame.columns]
    channels = tuple(
        Channel(header, _plain(frame.iloc[:, i]), unit) for i, (header, unit) in enumerate(headers)
    )
    return Source(name, kind, channels, sha256, metadata=metadata)


def _plain(series: pd.Series[Any]) -> NDArray[Any]:
    values = series.to_numpy()
    if values.dtype.kind in "fiubcU":
        return values
    from pandas.api.types import is_numeric_dtype

    if is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=np.float64, na_value=np.nan)  # pandas' nullable numbers
    return words(map(_text, values))

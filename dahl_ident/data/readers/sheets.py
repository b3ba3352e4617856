"""Tables that a library hands over as cells or columns: Excel, Parquet, pandas."""

from __future__ import annotations

import io
import warnings
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.readers.file import File, library
from dahl_ident.data.readers.layout import best_run, header, named_channels
from dahl_ident.data.source import Channel, Source, split_header
from dahl_ident.data.summary import listed
from dahl_ident.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

_HEAD_ROWS = 400


def read_excel(file: File, sheet: str | None = None) -> Source:
    """Return the table on a sheet; without a name, on the only sheet that has one.

    Raises
    ------
    DataError
        If the workbook is damaged, or no sheet or several hold a table.
    """
    import pandas as pd

    library("openpyxl", "excel")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # openpyxl on styles it leaves out
            sheets = pd.read_excel(
                io.BytesIO(file.data), sheet_name=None, header=None, dtype=object, engine="openpyxl"
            )
    except Exception as exc:  # openpyxl raises errors of many kinds on damaged files
        raise DataError(f"{file.name}: the workbook is damaged: {exc}") from exc
    if sheet is not None:
        if sheet not in sheets:
            raise DataError(f"{file.name}: no sheet {sheet!r}; there are {listed(sheets)}")
        sheets = {sheet: sheets[sheet]}
    tables = {name: _table(file, str(name), frame) for name, frame in sheets.items()}
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


def _table(file: File, sheet: str, frame: pd.DataFrame) -> Source | None:
    cells = frame.to_numpy(dtype=object)
    texts = [[_text(cell) for cell in row] for row in cells[:_HEAD_ROWS]]
    rows = [row if any(row) else None for row in texts]
    run = best_run(rows, ".")
    if run is None:
        return None
    above = [row for row in rows[: run.start] if row is not None]
    named = header(above, run.width)
    filled = [i for i in range(run.start, len(cells)) if any(_text(c) for c in cells[i])]
    columns = [_column(cells[filled, k]) for k in range(run.width)]
    where = f"{file.name}, sheet {sheet!r}"
    return Source(
        file.name,
        "Excel",
        named_channels(columns, named, where),
        file.sha256,
        headerless=not named.names,
        row_name=lambda i: f"sheet {sheet!r}, row {filled[i] + 1}",
    )


def _text(cell: Any) -> str:
    return "" if cell is None or cell != cell else str(cell)


def _column(cells: NDArray[Any]) -> NDArray[Any]:
    """Return numbers where every filled cell is one, else text."""
    texts = [_text(cell) for cell in cells]
    numeric = [isinstance(c, (int, float)) and not isinstance(c, bool) for c in cells]
    if all(n or not t for n, t in zip(numeric, texts, strict=True)):
        return np.array(
            [c if t else np.nan for c, t in zip(cells, texts, strict=True)], dtype=float
        )
    return np.array(texts, dtype=np.str_)


def read_parquet(file: File) -> Source:
    """Return the columns of a Parquet file."""
    import pandas as pd

    library("pyarrow", "parquet")
    try:
        frame = pd.read_parquet(io.BytesIO(file.data), engine="pyarrow")
    except Exception as exc:  # pyarrow raises errors of many kinds on damaged files
        raise DataError(f"{file.name}: the file is damaged: {exc}") from exc
    return frame_source(frame, file.name, "Parquet", file.sha256)


def frame_source(
    frame: pd.DataFrame, name: str = "the table", kind: str = "table", sha256: str | None = None
) -> Source:
    """Return the columns of a pandas table, a named index among them, units out of their names."""
    metadata = frame.attrs.get("dahl_ident", {})
    if any(level is not None for level in frame.index.names):
        frame = frame.reset_index()
    if not len(frame) or not len(frame.columns):
        raise DataError(f"{name}: the table is empty")
    channels = tuple(
        Channel(*_named(label, _plain(frame.iloc[:, i]))) for i, label in enumerate(frame.columns)
    )
    return Source(name, kind, channels, sha256, metadata=metadata)


def _named(label: Hashable, values: NDArray[Any]) -> tuple[str, NDArray[Any], str | None]:
    name, unit = split_header(str(label))
    return name, values, unit


def _plain(series: pd.Series[Any]) -> NDArray[Any]:
    values = series.to_numpy()
    if values.dtype.kind in "fiubcU":
        return values
    from pandas.api.types import is_numeric_dtype

    if is_numeric_dtype(series.dtype):
        return series.to_numpy(dtype=np.float64, na_value=np.nan)  # pandas' nullable numbers
    return np.array([_text(cell) for cell in values], dtype=np.str_)

"""Journal of results: one line is appended for each fit; the table is made from the lines.

Only the last line can be incomplete, after a crash; it is dropped when the file is opened again.
Only keys and positions of lines are held in memory.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from dahl_ident.data.storage import inert, library, put_in_place
from dahl_ident.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

_ROWS_AT_ONCE = 2000
"""Rows of the table in memory; about 10 MB."""
_FIRST = ("device", "run", "status", "error", "statements")


class Journal:
    """The lines of one campaign.

    Attributes
    ----------
    places : dict of str to int
        Position of the line of each finished key.
    seconds : list of float
        How long the fits took that did not fail.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.places, self.seconds, end = finished(path)
        try:
            self._file: IO[bytes] = path.open("r+b" if path.exists() else "w+b")
            self._file.truncate(end)
            self._file.seek(end)
        except OSError as exc:
            raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """Append one result; it has been passed to the operating system when this returns."""
        line = json.dumps({"key": key, **row}, ensure_ascii=False).encode() + b"\n"
        self.places[key] = self._file.tell()
        self._file.write(line)
        self._file.flush()

    def rows(self, keys: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Yield results by key, in the order asked for."""
        with self._path.open("rb") as file:
            for key in keys:
                file.seek(self.places[key])
                yield json.loads(file.readline())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def finished(path: Path) -> tuple[dict[str, int], list[float], int]:
    """Return the position of each finished key's line, seconds, and the end of the last line.

    A fit whose failure may have another cause than its device is not finished: a process or a
    worker that died, files that a worker does not see, a limit of time or memory.
    """
    places: dict[str, int] = {}
    seconds: list[float] = []
    end = 0
    if not path.exists():
        return places, seconds, end
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            if not line.endswith(b"\n"):
                break
            try:
                row = json.loads(line)
                if not row.get("retry"):
                    places[row["key"]] = end
                if row["status"] != "failed":
                    seconds.append(float(row["seconds"]))
            except (ValueError, KeyError, AttributeError, TypeError):
                raise DataError(
                    f"{path}: line {number} is not a result of a campaign; move the file away to "
                    "start again"
                ) from None
            end += len(line)
    return places, seconds, end


def write_tables(rows: Callable[[], Iterator[dict[str, Any]]], folder: Path) -> dict[str, int]:
    """Write ``results.csv`` and, where pyarrow is installed, ``results.parquet``, atomically.

    `rows` is called once for the columns and once for each file.

    Returns
    -------
    dict of str to int
        How many rows there are of each status.
    """
    columns: dict[str, type] = {}
    statuses: dict[str, int] = {}
    for row in rows():
        statuses[row["status"]] = statuses.get(row["status"], 0) + 1
        for name, value in _flat(row).items():
            if value is not None:
                columns[name] = str if columns.get(name, type(value)) is str else type(value)
    rest = [c for c in columns if c not in _FIRST]
    order = [*(c for c in _FIRST if c in columns), *sorted(rest)]
    writers = {"results.csv": _csv}
    if find_spec("pyarrow") is not None:
        writers["results.parquet"] = _parquet
    for name, write in writers.items():
        path, frames = folder / name, _frames(rows, order, columns)
        try:
            put_in_place(path, partial(write, frames))
        except OSError as exc:
            raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
    return statuses


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return one row of the table: numbers and texts alone."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, list):
            flat[name] = " | ".join(map(str, value))
        elif isinstance(value, int) and not isinstance(value, bool):
            flat[name] = float(value)
        else:
            flat[name] = value
    return flat


def _frames(
    rows: Callable[[], Iterator[dict[str, Any]]],
    order: Sequence[str],
    columns: Mapping[str, type],
) -> Iterator[pd.DataFrame]:
    import pandas as pd

    def frame(block: list[dict[str, Any]]) -> pd.DataFrame:
        table = pd.DataFrame.from_records(block, columns=list(order))
        kinds = {c: "string" if columns[c] is str else "float64" for c in order}
        return table.astype(kinds)

    block: list[dict[str, Any]] = []
    for row in rows():
        block.append(_flat(row))
        if len(block) == _ROWS_AT_ONCE:
            yield frame(block)
            block = []
    yield frame(block)


def _csv(frames: Iterator[pd.DataFrame], path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        for number, frame in enumerate(frames):
            inert(frame).to_csv(file, index=False, header=number == 0, lineterminator="\n")


def _parquet(frames: Iterator[pd.DataFrame], path: Path) -> None:
    pyarrow, parquet = library("pyarrow"), library("pyarrow.parquet")
    writer = None
    for frame in frames:
        table = pyarrow.Table.from_pandas(frame, preserve_index=False)
        writer = writer or parquet.ParquetWriter(path, table.schema)
        writer.write_table(table)
    if writer is not None:
        writer.close()

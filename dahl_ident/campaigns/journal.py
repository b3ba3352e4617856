"""Journal of results: one line is appended for each fit; the table is made from the lines.

Only the last line can be incomplete, after a crash; it is dropped when the file is opened again.
Only keys and positions of lines are held in memory.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import IO, Any

from dahl_ident.data.storage import inert, put_in_place
from dahl_ident.errors import DataError

_ROWS_AT_ONCE = 2000
"""Rows that are in memory as dictionaries, which are ten times as large as in a table."""
_FIRST = ("device", "run", "status", "error", "statements")


class Journal:
    """The lines of one campaign: where that of each finished key is, and how long fits took."""

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


def write_tables(rows: Iterable[Mapping[str, Any]], folder: Path) -> dict[str, int]:
    """Write ``results.csv`` and, with pyarrow, ``results.parquet``; return counts of statuses."""
    import pandas as pd

    flat = map(_flat, rows)
    blocks = iter(lambda: list(islice(flat, _ROWS_AT_ONCE)), [])
    table = pd.concat([pd.DataFrame(), *map(pd.DataFrame, blocks)], ignore_index=True)
    first = [name for name in _FIRST if name in table]
    table = table[[*first, *sorted(map(str, set(table) - set(first)))]]
    is_number = pd.api.types.is_numeric_dtype
    table = table.astype({c: "float64" if is_number(table[c]) else "string" for c in table})
    writers: dict[str, Callable[[Path], object]] = {
        "results.csv": partial(inert(table).to_csv, index=False, lineterminator="\n")
    }
    if find_spec("pyarrow") is not None:
        writers["results.parquet"] = partial(table.to_parquet, engine="pyarrow", index=False)
    for name, write in writers.items():
        path = folder / name
        try:
            put_in_place(path, write)
        except OSError as exc:
            raise DataError(f"{path}: cannot be written: {exc.strerror or exc}") from exc
    return dict(Counter(table["status"].tolist())) if len(table) else {}


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

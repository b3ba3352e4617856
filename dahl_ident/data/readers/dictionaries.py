"""Columns by name: JSON, and the time series of SDyPy (its enhancement proposal 5).

JSON may hold ``{"x [mm]": [...], ...}``; ``[{"name": "x", "values": [...], "unit": "mm"}, ...]``;
rows, ``[{"x [mm]": 1.0}, ...]`` or ``[["x [mm]"], [1.0], ...]``; ``{"columns": [...], "data":
[[...], ...]}`` and ``{"x [mm]": {"0": 1.0, ...}}`` as pandas writes them; or SDyPy's channels.
Units stand in the names, in each column, or under ``"units"`` or ``"displacement units"``.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile, column_of, plain, split_header
from dahl_ident.data.readers.file import File, refuse_many, utf8
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_UNNAMED = "column {}"
_UNIT_OF = re.compile(r"(.+?)[ _]units?")  # "displacement units": "mm"
_VALUES, _UNITS = ("values", "data"), ("unit", "unit_str", "units")
_TABLES = ("channels", "signals", "columns", "data", "rows")


def read_json(file: File) -> RawFile:
    """Return the columns of a JSON file."""
    try:
        text = utf8(file.lines(b"[{")).decode("utf-8", "replace")
        file.refuse_above_limit(8 * text.count(","), f"JSON of {text.count(',')} numbers")
        content = json.loads(text, object_pairs_hook=_object)
    except DataError:  # a ValueError too
        raise
    except (ValueError, RecursionError) as exc:
        raise DataError(f"{file.name}: not a JSON file: {exc}") from exc
    return dictionary_source(content, file.name, "JSON", file.sha256)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    repeated = next((name for name, n in Counter(name for name, _ in pairs).items() if n > 1), None)
    if repeated is not None:
        raise ValueError(f"one object has the name {repeated[:60]!r} twice")
    return dict(pairs)


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
    """Yield the columns; `units` are by their names, or in the order of a list of names."""
    of_names = _is_list_of(Mapping, content) and all("name" in c for c in content)
    if (
        of_names
        and all("data" in c for c in content)
        and any({"fs", "time"} & {*c} for c in content)
    ):
        yield from _sdypy(content, name)
    elif of_names and all(any(isinstance(c.get(v), list) for v in _VALUES) for c in content):
        for column in content:
            yield from _columns({str(column["name"]): column}, name, units)
    elif _is_list_of(dict, content):
        keys = list(dict.fromkeys(key for row in content for key in row))
        refuse_many(name, len(keys), "columns")
        columns = {key: [row.get(key) for row in content] for key in keys}
        yield from _columns(columns, name, units)
    elif _is_list_of(list, content):
        named = all(isinstance(cell, str) for cell in content[0])
        labels = content[0] if named else [_UNNAMED.format(i + 1) for i in range(len(content[0]))]
        yield from _columns(_upright(labels, content[named:], name), name, units)
    elif isinstance(content, dict):
        yield from _tables(content, name, units)
    else:
        raise DataError(
            f"{name}: found a {type(content).__name__}; expected an object of columns, a list of "
            "rows, or a list of channels"
        )


def _is_list_of(kind: type, content: Any) -> bool:
    is_list = isinstance(content, Sequence) and not isinstance(content, str) and len(content) > 0
    return is_list and all(isinstance(one, kind) for one in content)


def _upright(labels: Any, rows: list[Any], name: str) -> dict[str, Any]:
    """Return the columns of a list of rows."""
    if not isinstance(labels, list) or any(
        not isinstance(row, list) or len(row) != len(labels) for row in rows
    ):
        raise DataError(f"{name}: the rows of data differ in length from columns")
    if len({str(label) for label in labels}) < len(labels):
        raise DataError(f"{name}: several columns have one name in {listed(map(str, labels), 20)}")
    return {str(label): [row[i] for row in rows] for i, label in enumerate(labels)}


def _tables(content: dict[str, Any], name: str, units: Any) -> Iterator[RawChannel]:
    """Yield the columns of an object, or of the table in it."""
    common = {m[1]: unit for key, unit in content.items() if (m := _UNIT_OF.fullmatch(key))}
    units = content.get("units", units or common)
    rows = next(
        (content[key] for key in ("data", "rows") if _is_list_of(list, content.get(key))), None
    )
    if "columns" in content and rows is not None:
        columns = _upright(content["columns"], rows, name)
        if isinstance(units, list) and len(units) == len(columns):
            units = dict(zip(columns, units, strict=True))
        yield from _columns(columns, name, units)
        return
    for key in _TABLES:
        table = content.get(key)
        nested = isinstance(table, list) and any(isinstance(v, (list, dict)) for v in table)
        if nested or isinstance(table, dict):
            yield from _channels(table, name, units)
            return
    yield from _columns(content, name, units)


def _columns(content: dict[str, Any], name: str, units: Any) -> Iterator[RawChannel]:
    stated = units if isinstance(units, dict) else {}
    known = {plain(str(key)): unit for key, unit in stated.items()}
    index: Any = None
    for key, value in content.items():
        if isinstance(value, dict) and any(v in value for v in _VALUES):
            values = next(value[v] for v in _VALUES if v in value)
            unit = next((value[u] for u in _UNITS if u in value), known.get(plain(key)))
            yield _channel(key, values, unit, name)
        elif isinstance(value, dict) and value and all(row.isdecimal() for row in value):
            index = index or value.keys()
            if value.keys() != index:
                raise DataError(f"{name}: column {key!r} has other rows than the columns before it")
            yield _channel(key, [value[row] for row in index], known.get(plain(key)), name)
        elif isinstance(value, list):
            yield _channel(key, value, known.get(plain(key)), name)


def _channel(key: Any, values: Any, unit: Any, name: str) -> RawChannel:
    label, in_label = split_header(str(key))
    text = unit if isinstance(unit, str) and unit.strip() else in_label
    return RawChannel(label, _array(values, f"{name}: column {label!r}"), text)


def _array(values: Any, what: str) -> NDArray[Any]:
    """Return numbers, or text where some cell is none; None is an empty cell."""
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
    """Yield SDyPy's channels and the time that they share."""
    labels = [str(c["name"]) for c in channels]
    twice = [label for label in dict.fromkeys(labels) if labels.count(label) > 1]
    if twice:
        raise DataError(f"{name}: several channels are called {listed(twice)}; expected one each")
    times: list[NDArray[Any]] = []
    for channel, label in zip(channels, labels, strict=True):
        what = f"{name}: channel {label!r}"
        values = _array(channel["data"], what)
        yield _channel(label, values, channel.get("unit_str", channel.get("unit")), name)
        time = _time(channel, values.size, what)
        if not any(np.array_equal(time, known) for known in times):
            times.append(time)
    if len(times) > 1:
        raise DataError(f"{name}: the channels are sampled at different times; expected one time")
    if "time" not in labels:
        yield RawChannel("time", times[0], "s", "time")


def _time(channel: Mapping[str, Any], count: int, what: str) -> NDArray[Any]:
    if channel.get("time") is not None:
        time = _array(channel["time"], f"{what}, its time")
        if time.size != count:
            raise DataError(f"{what} has {count} values at {time.size} times; expected as many")
        return time
    rate = channel.get("fs")
    if not isinstance(rate, (int, float, np.number)) or not 0.0 < float(rate) < np.inf:
        raise DataError(f"{what} has fs = {rate!r} and no time; expected a sampling frequency, Hz")
    return np.asarray(np.arange(count) / float(rate))

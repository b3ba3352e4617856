"""Columns by name: JSON, and the time series of SDyPy (its enhancement proposal 5).

JSON may hold an object of columns, ``{"time [s]": [...], "x [mm]": [...]}``, whose units may
stand beside them under ``"units"`` or in ``{"values": [...], "unit": "mm"}``; a list of rows,
``[{"time [s]": 0.0, "x [mm]": 1.0}, ...]``; ``{"columns": [...], "data": [[...], ...]}`` as
pandas writes it; or a list of channels with ``name``, ``data``, ``unit_str`` and either ``fs`` or
``time``, as SDyPy has them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.column_names import split_header
from dahl_ident.data.raw_columns import Channel, Source
from dahl_ident.data.readers.file import MOST_CHANNELS, File, utf8
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_VALUES, _UNITS = ("values", "data"), ("unit", "unit_str", "units")


def read_json(file: File) -> Source:
    """Return the columns of a JSON file.

    Raises
    ------
    DataError
        If it is no JSON, or holds neither columns nor rows nor channels.
    """
    try:
        content = json.loads(utf8(file.data).decode("utf-8", "replace"))
    except (ValueError, RecursionError) as exc:
        raise DataError(f"{file.name}: not a JSON file: {exc}") from exc
    return dictionary_source(content, file.name, "JSON", file.sha256)


def dictionary_source(
    content: Any, name: str = "the list", kind: str = "channels", sha256: str | None = None
) -> Source:
    """Return the columns of a dictionary, of rows, or of a list of channels."""
    channels = tuple(_channels(content, name))
    if not channels:
        raise DataError(f"{name}: no columns; expected an object of columns, or a list of rows")
    if len(channels) > MOST_CHANNELS:
        raise DataError(f"{name}: {len(channels)} columns; at most {MOST_CHANNELS} are read")
    return Source(name, kind, channels, sha256)


def is_channels(content: Any) -> bool:
    """Return whether this is a list of SDyPy's channels."""
    return (
        isinstance(content, Sequence)
        and not isinstance(content, str)
        and len(content) > 0
        and all(isinstance(c, Mapping) and {"name", "data"} <= c.keys() for c in content)
    )


def _channels(content: Any, name: str) -> Iterator[Channel]:
    if is_channels(content):
        yield from _sdypy(content, name)
    elif isinstance(content, list) and content and all(isinstance(r, dict) for r in content):
        keys = list(dict.fromkeys(key for row in content for key in row))
        if len(keys) > MOST_CHANNELS:
            raise DataError(f"{name}: {len(keys)} columns; at most {MOST_CHANNELS} are read")
        for key in keys:
            yield _channel(key, [row.get(key) for row in content], None, name)
    elif isinstance(content, dict):
        yield from _columns(content, name)
    else:
        raise DataError(
            f"{name}: found a {type(content).__name__}; expected an object of columns, a list of "
            "rows, or a list of channels"
        )


def _columns(content: dict[str, Any], name: str) -> Iterator[Channel]:
    if "columns" in content and isinstance(content.get("data"), list):
        labels, rows = content["columns"], content["data"]
        if not isinstance(labels, list) or any(
            not isinstance(row, list) or len(row) != len(labels) for row in rows
        ):
            raise DataError(f"{name}: the rows of data differ in length from columns")
        content = {str(k): [row[i] for row in rows] for i, k in enumerate(labels)} | {
            "units": content.get("units", {})
        }
    for key in ("channels", "signals", "data"):
        if isinstance(content.get(key), (list, dict)) and not _is_flat(content[key]):
            yield from _channels(content[key], name)
            return
    given = content.get("units")
    units = given if isinstance(given, dict) else {}
    for key, value in content.items():
        if isinstance(value, dict) and any(v in value for v in _VALUES):
            values = next(value[v] for v in _VALUES if v in value)
            unit = next((value[u] for u in _UNITS if u in value), None)
            yield _channel(key, values, unit, name)
        elif isinstance(value, list):
            yield _channel(key, value, units.get(key), name)


def _is_flat(value: Any) -> bool:
    """Return whether this is one column, and not a table."""
    return isinstance(value, list) and not any(isinstance(v, (list, dict)) for v in value)


def _channel(key: Any, values: Any, unit: Any, name: str) -> Channel:
    label, in_label = split_header(str(key))
    text = unit if isinstance(unit, str) and unit.strip() else in_label
    return Channel(label, _array(values, f"{name}: column {label!r}"), text)


def _array(values: Any, what: str) -> NDArray[Any]:
    """Return numbers, or text where some cell is none; None is an empty cell."""
    if isinstance(values, np.ndarray):
        array: NDArray[Any] = np.ma.filled(values, np.nan) if np.ma.isMA(values) else values
        if array.ndim != 1 or array.dtype.kind not in "fiubU":
            raise DataError(f"{what} has the shape {array.shape}; expected a list of numbers")
        return array
    if not isinstance(values, (list, tuple)) or any(isinstance(v, (list, dict)) for v in values):
        raise DataError(f"{what} is nested; expected a list of numbers")
    try:
        if all(v is None or (isinstance(v, (int, float)) and v is not True and v is not False)
               for v in values):  # fmt: skip
            return np.array([np.nan if v is None else float(v) for v in values], dtype=np.float64)
    except OverflowError:
        pass  # whole numbers beyond all floats are refused as text
    return np.array(["" if v is None else str(v)[:60] for v in values], dtype=np.str_)


def _sdypy(channels: Sequence[Mapping[str, Any]], name: str) -> Iterator[Channel]:
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
        yield Channel("time", times[0], "s", "time")


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

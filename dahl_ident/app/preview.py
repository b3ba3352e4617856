"""Contents of files as data for a page: channels, errors, and pictures of points or loops.

It runs in a child process, ``python -m dahl_ident.app.preview``, because an uploaded file may have
any size and content. It reads the content of a ``work.json`` from standard input and prints JSON.
"""

from __future__ import annotations

import json
import sys
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.app.commands import COMMON_OPTIONS, FIELDS, TABLE_OPTIONS
from dahl_ident.data import read_frequency_response, read_record
from dahl_ident.data.readers import open_source
from dahl_ident.data.readers.inspection import contents, patterns, summary
from dahl_ident.data.response_table import WaveformsError
from dahl_ident.errors import DahlIdentError, arguments_as_options
from dahl_ident.reporting.document import Picture
from dahl_ident.units import parse_quantity

EMPTY_PREVIEW: Mapping[str, Any] = {
    "channels": [],
    "notes": [],
    "pictures": [],
    "error": "",
    "kind": "",
    "summary": "",
    "format": "",
    "sampling": "",
}
_CURVE_POINTS = 300  # of a channel's curve, at most
_MOST_PICTURES = 6  # records that are drawn, at most


def preview(state: dict[str, Any]) -> dict[str, Any]:
    """Return the channels of the first file, a summary of all data, and errors and warnings."""
    result: dict[str, Any] = {**EMPTY_PREVIEW, "channels": [], "notes": []}
    files = [str(file["stored"]) for file in state["files"]]
    with warnings.catch_warnings(record=True) as caught, arguments_as_options(FIELDS):
        warnings.simplefilter("always")
        try:
            columns = _add_channels(files[0], result)
            _add_data(files, columns, state["reading"], result)
        except (DahlIdentError, ValueError, OSError) as exc:
            result["error"] = str(exc)
    result["notes"] += list(dict.fromkeys(str(warning.message) for warning in caught))
    return result


def _add_channels(file: str, result: dict[str, Any]) -> dict[str, Any]:
    """Add the channels of a file, and return its column map: the saved one, or a proposal.

    Channels of one name in an array of structs count as one channel, as in a column map.
    """
    source = open_source(file)
    found = contents(source)
    path = Path("columns.toml")
    text = path.read_text("utf-8") if path.exists() else found.column_map
    roles: dict[str, Any] = tomllib.loads(text)
    by_column = {
        entry["column"]: (role, entry) for role, entry in roles.items() if isinstance(entry, dict)
    }
    result["format"], result["sampling"] = found.format, found.sampling
    result["notes"] += [*found.gaps, *found.notes]
    for name, (channel, *others) in patterns(source).items():
        if others:
            values = np.concatenate([np.atleast_1d(c.values) for c in (channel, *others)])
            channel = replace(channel, name=name, content=values)
        role, entry = by_column.get(name, ("", {}))
        curve = _thumbnail(channel.values) if channel.kind in "fiu" else []
        result["channels"].append(
            {
                **asdict(summary(channel)),
                "role": role,
                "curve": curve,
                "sign": entry.get("sign", 1),
                "unit": entry.get("unit") or channel.unit or "",
            }
        )
    return roles


def _add_data(
    files: Sequence[str], columns: dict[str, Any], reading: dict[str, str], result: dict[str, Any]
) -> None:
    """Read the files as the commands do, and add a summary and pictures."""
    common: dict[str, Any] = {"columns": columns}
    common |= {n: reading[n] for n in COMMON_OPTIONS if reading.get(n)}
    kind = reading.get("kind", "")
    if kind in ("", "table"):
        options: dict[str, Any] = {n: reading[n] for n in TABLE_OPTIONS if reading.get(n)}
        if "frequency" in options:
            options["frequency"] = _hertz(options["frequency"], "frequency")
        try:
            table = read_frequency_response(list(files), **common, **options)
        except WaveformsError:
            if kind == "table":
                raise
        else:
            result |= {"kind": "table", "summary": repr(table), "pictures": [_picture(table.plot)]}
            return
    if reading.get("sample_rate"):
        common["sample_rate"] = _hertz(reading["sample_rate"], "sample_rate")
    records = [read_record(file, **common) for file in files]
    result |= {"kind": kind or "record", "summary": "\n".join(map(repr, records))}
    loops = (partial(record.plot, "loops") for record in records[:_MOST_PICTURES])
    result["pictures"] = [_picture(loop) for loop in loops]


def _picture(draw: Callable[[], Any]) -> str:
    """Return a plot as the data URL of a PNG image."""
    return Picture("", "", "", draw).address("png")


def _hertz(text: str, what: str) -> float:
    """Return a frequency in Hz; a number without a unit is in Hz."""
    try:
        return float(text)
    except ValueError:
        return parse_quantity(text, ("frequency",), what)[0]


def _thumbnail(values: Any) -> list[list[float]]:
    """Return a curve in the unit square; many samples are reduced to the extremes of groups."""
    y = np.asarray(values, dtype=np.float64).ravel()
    y = y[np.isfinite(y)]
    if y.size < 2:
        return []
    if y.size > _CURVE_POINTS:
        parts = np.array_split(y, _CURVE_POINTS // 2)
        y = np.array([v for part in parts for v in (part.min(), part.max())])
    height = (y - y.min()) / (np.ptp(y) or 1.0)
    points: list[list[float]] = np.column_stack([np.linspace(0.0, 1.0, y.size), height]).tolist()
    return points


if __name__ == "__main__":
    sys.stdout.write(json.dumps(preview(json.load(sys.stdin))))

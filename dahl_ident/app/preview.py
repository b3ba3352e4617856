"""What files hold, as numbers for a page: channels, problems, points or loops.

Run in a child process, ``python -m dahl_ident.app.preview``, because a file of another may be of
any size and form: it reads the state of a work on standard input and prints JSON.
"""

from __future__ import annotations

import json
import sys
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.app.commands import OF_BOTH, OF_TABLES
from dahl_ident.data import read_frequency_response, read_record
from dahl_ident.data.readers import open_source
from dahl_ident.data.readers.inspection import contents
from dahl_ident.data.response_table import WaveformsError
from dahl_ident.errors import DahlIdentError
from dahl_ident.reporting.document import Picture
from dahl_ident.units import parse_quantity

NOTHING_FOUND: Mapping[str, Any] = {
    "channels": [], "notes": [], "pictures": [],
    "error": "", "kind": "", "summary": "", "format": "", "sampling": "",
}  # fmt: skip
_SHOWN = 300  # points in a channel's picture
_DRAWN = 6  # records that are drawn


def preview(state: dict[str, Any]) -> dict[str, Any]:
    """Return channels of the first file, what could be read, and what could not."""
    shown: dict[str, Any] = dict(NOTHING_FOUND, channels=[], notes=[])
    files = [str(file["stored"]) for file in state["files"]]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            _describe(files[0], shown)
            _read(files, state["reading"], shown)
        except (DahlIdentError, ValueError, OSError) as exc:
            shown["error"] = str(exc)
    shown["notes"] += list(dict.fromkeys(str(one.message) for one in caught))
    return shown


def _describe(file: str, shown: dict[str, Any]) -> None:
    source = open_source(file)
    summary = contents(source)
    place = Path("columns.toml")
    text = place.read_text("utf-8") if place.exists() else summary.column_map
    roles: dict[str, Any] = tomllib.loads(text)
    by_column = {e["column"]: (r, e) for r, e in roles.items() if isinstance(e, dict)}
    shown["format"], shown["sampling"] = summary.format, summary.sampling
    shown["notes"] += [*summary.gaps, *summary.notes]
    for channel, line in zip(source.channels, summary.channels, strict=True):
        role, entry = by_column.get(channel.name, ("", {}))
        curve = _thumbnail(channel.values) if channel.kind in "fiu" else []
        shown["channels"].append(
            {**asdict(line), "role": role, "curve": curve, "sign": entry.get("sign", 1),
             "unit": entry.get("unit") or channel.unit or ""}
        )  # fmt: skip


def _read(files: Sequence[str], reading: dict[str, str], shown: dict[str, Any]) -> None:
    """Read the files as the commands will, and add what they show."""
    how: dict[str, Any] = {n: reading[n] for n in OF_BOTH if reading.get(n)}
    if Path("columns.toml").exists():
        how["columns"] = "columns.toml"
    kind = reading.get("kind", "")
    if kind in ("", "table"):
        options: dict[str, Any] = {n: reading[n] for n in OF_TABLES if reading.get(n)}
        if "frequency" in options:
            options["frequency"] = _hertz(options["frequency"], "frequency")
        try:
            table = read_frequency_response(list(files), **how, **options)
        except WaveformsError:
            if kind == "table":
                raise
        else:
            shown |= {"kind": "table", "summary": repr(table), "pictures": [_drawn(table.plot)]}
            return
    if reading.get("sample_rate"):
        how["sample_rate"] = _hertz(reading["sample_rate"], "sample_rate")
    records = [read_record(file, **how) for file in files]
    shown |= {"kind": kind or "record", "summary": "\n".join(map(repr, records))}
    shown["pictures"] = [_drawn(partial(record.plot, "loops")) for record in records[:_DRAWN]]


def _drawn(draw: Callable[[], Any]) -> str:
    return Picture("", "", "", draw).address("png")


def _hertz(text: str, what: str) -> float:
    try:
        return float(text)
    except ValueError:
        return parse_quantity(text, ("frequency",), what)[0]


def _thumbnail(values: Any) -> list[list[float]]:
    """Return a channel in the unit square; lowest and highest of many samples at each place."""
    y = np.asarray(values, dtype=np.float64).ravel()
    y = y[np.isfinite(y)]
    if y.size < 2:
        return []
    if y.size > _SHOWN:
        parts = np.array_split(y, _SHOWN // 2)
        y = np.array([v for part in parts for v in (part.min(), part.max())])
    height = (y - y.min()) / (np.ptp(y) or 1.0)
    points: list[list[float]] = np.column_stack([np.linspace(0.0, 1.0, y.size), height]).tolist()
    return points


if __name__ == "__main__":
    sys.stdout.write(json.dumps(preview(json.load(sys.stdin))))

"""LabVIEW measurement files: text with a header for the file and one for each segment.

Every line of a segment must have the fields of its column labels, and a segment the number of
samples that its header says; a lost line would move all later samples in time.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import Channel, Source, words
from dahl_ident.data.readers.file import MOST_CHANNELS, File, utf8
from dahl_ident.data.readers.instruments import evenly_timed, labelled_channel
from dahl_ident.errors import DataError

_END = "***End_of_Header***"
_SPECIAL = ("***Start_Special***", "***End_Special***")
_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";"}
_SAME_STEP = 0.01  # relative: more than what is rounded in times and in the header
_MOST_SEGMENTS = 1000  # the time to read grows with their square
Lines = list[tuple[int, str]]


def read_lvm(file: File) -> Source:
    """Return the channels of all segments of a LabVIEW measurement file."""
    text = utf8(file.lines()).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    lines = [(i + 1, line) for i, line in enumerate(text.split("\n"))]
    plain, inside = [], False
    for number, line in lines:
        mark = line.strip()
        inside = (inside or mark.startswith(_SPECIAL[0])) and not mark.startswith(_SPECIAL[1])
        if not inside and not mark.startswith(_SPECIAL[1]):
            plain.append((number, line))
    head, rest = _up_to_end(file, plain)
    separator = next(
        (
            _SEPARATORS.get(line[10:].strip().casefold(), line[9])
            for _, line in head
            if line.startswith("Separator") and len(line) > 9
        ),
        "\t",
    )
    settings = dict(_entry(line, separator) for _, line in head)
    mark = (settings.get("Decimal_Separator") or ["."])[0]
    columns = (settings.get("X_Columns") or ["One"])[0].strip().casefold()
    single = (settings.get("Multi_Headings") or ["Yes"])[0].strip().casefold() == "no"
    segments: list[dict[str, Any]] = []
    while any(line.strip() for _, line in rest):
        segment, rest = _segment(file, rest, separator, mark, columns, single)
        segments.append(segment)
        if len(segments) > _MOST_SEGMENTS:
            raise DataError(f"{file.name}: the file has more than {_MOST_SEGMENTS} segments")
    if not segments:
        raise DataError(f"{file.name}: the LVM file is damaged: it holds no segment")
    channels = [
        channel
        for i, segment in enumerate(segments)
        for channel in _channels(segment, f"segment {i}/" if len(segments) > 1 else "", columns)
    ]
    doubts = [doubt for segment in segments for doubt in _contradictions(segment)]
    return file.source("LVM", channels, row_name=lambda i: f"sample {i}", doubts=tuple(doubts))


def _up_to_end(file: File, lines: Lines) -> tuple[Lines, Lines]:
    """Return the lines of a header, and those behind it."""
    for i, (_, line) in enumerate(lines):
        if line.strip() == _END:
            return [pair for pair in lines[:i] if pair[1].strip()], lines[i + 1 :]
    raise DataError(f"{file.name}: the LVM file is damaged: a header without {_END}")


def _entry(line: str, separator: str) -> tuple[str, list[str]]:
    key, *values = line.split(separator)
    return key.strip(), values


def _segment(
    file: File, lines: Lines, separator: str, mark: str, columns: str, single: bool
) -> tuple[dict[str, Any], Lines]:
    """Return header and numbers of a segment, and the lines behind it: none of a single one."""
    head, rest = _up_to_end(file, lines)
    segment: dict[str, Any] = dict(_entry(line, separator) for _, line in head)
    while rest and not rest[0][1].strip():
        rest = rest[1:]
    if not rest:
        raise DataError(f"{file.name}: the LVM file is damaged: a segment without column labels")
    labels = [label.strip() for label in rest[0][1].split(separator)]
    if len(labels) > MOST_CHANNELS:
        raise DataError(f"{file.name}: a segment has more than {MOST_CHANNELS} channels")
    blank = (i for i in range(1, len(rest)) if not rest[i][1].strip())
    stop = len(rest) if single else next(blank, len(rest))
    rows, rest = [row for row in rest[1:stop] if row[1].strip()], rest[stop:]
    while labels and not labels[-1]:
        labels.pop()
    width = len(labels) - (labels[-1:] == ["Comment"])
    first = 1 if columns == "no" else 0
    table = [line.split(separator) for _, line in rows]
    for (number, _), cells in zip(rows, table, strict=True):
        extra = [cell for cell in cells[len(labels) :] if cell.strip()]
        if len(cells) < width or extra:
            raise DataError(
                f"{file.name}, line {number}: {len(cells)} fields; expected the {width} of the "
                "column labels"
            )
    numbers = Source(file.name, "", (), decimal=mark, row_name=lambda i: f"line {rows[i][0]}")
    segment["labels"], segment["data"] = labels[first:width], np.empty((len(rows), width - first))
    for k, label in enumerate(segment["labels"]):
        column = words(cells[first + k] for cells in table)
        segment["data"][:, k] = numbers.from_text(Channel(label, column))
    _check_samples(file, segment, len(rows), single)
    following = next((line for _, line in rest if line.strip()), "")
    if following and "_" not in following and not following[0].isalpha():
        number = next(n for n, line in rest if line.strip())
        raise DataError(
            f"{file.name}, line {number}: numbers behind a blank line, where a segment has ended; "
            "expected its samples without blank lines between them"
        )
    return segment, rest


def _check_samples(file: File, segment: dict[str, Any], rows: int, single: bool) -> None:
    """Refuse a segment with fewer or more samples than its header says."""
    stated = [value.strip() for value in segment.get("Samples", []) if value.strip()]
    unread = [value for value in stated if not re.fullmatch("[0-9]{1,18}", value)]
    if unread:
        raise DataError(
            f"{file.name}: the LVM file is damaged: {unread[0][:40]!r} is not a number of samples"
        )
    most = max(map(int, stated), default=rows)
    timed = "X_Value" in segment["labels"]
    if most != rows and not (single and rows > most > 0 and (timed or rows % most == 0)):
        raise DataError(
            f"{file.name}: a segment has {rows} samples where its header says {most}; the file "
            f"{'looks cut off' if rows < most else 'is damaged'}"
        )


def _channels(segment: dict[str, Any], prefix: str, columns: str) -> Iterator[Channel]:
    """Yield the channels of a segment, and time: its x columns, or counted from their step."""
    data, labels = segment["data"], segment["labels"]
    table = list(zip(labels, data.T, strict=True))
    channels = [pair for pair in table if pair[0] != "X_Value"]
    for i, (name, values) in enumerate(channels):
        units = _of_channels(segment.get("Y_Unit_Label", []), len(channels), columns)
        unit = units[i].strip() if i < len(units) else ""
        yield labelled_channel(prefix, name, values, unit)
    if {word.strip() for word in segment.get("X_Dimension", [])} - {"Time", ""}:
        return
    times: list[NDArray[Any]] = [values for name, values in table if name == "X_Value"]
    if not times:
        starts, steps = (_floats(segment.get(key, [])) for key in ("X0", "Delta_X"))
        times = [a + d * np.arange(len(data)) for a, d in zip(starts, steps, strict=False) if d > 0]
    yield from evenly_timed(times, prefix)


def _contradictions(segment: dict[str, Any]) -> Iterator[str]:
    """Yield what the header says of the sampling, and the column of times does not."""
    times = segment["data"][:, [label == "X_Value" for label in segment["labels"]]]
    if len(times) < 2:
        return
    for time, stated in zip(times.T, _floats(segment.get("Delta_X", [])), strict=False):
        step = float(np.median(np.diff(time)))
        if stated > 0.0 and abs(step - stated) > _SAME_STEP * stated:
            yield (
                f"X_Value goes in steps of {step:.6g}, and the header says Delta_X = {stated:.6g}; "
                "X_Value is used"
            )


def _of_channels(values: list[str], count: int, columns: str) -> list[str]:
    """Return the values of the channels; with many x columns those between are blank."""
    if columns == "multi" and len(values) > count and not any(v.strip() for v in values[1::2]):
        return values[0::2]
    return values


def _floats(values: list[str]) -> list[float]:
    found = []
    for value in values:
        with contextlib.suppress(ValueError):
            if "_" not in value:
                found.append(float(value.strip().replace(",", ".")))
    return found

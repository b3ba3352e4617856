"""Files of National Instruments: TDMS and LabVIEW measurement files (LVM)."""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import os
import re
import struct
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile, Stored, split_header, words
from dahl_ident.data.readers.file import File, refuse_many, utf8
from dahl_ident.data.storage import library
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError

_LEAD_IN = struct.Struct("<4sIIQQ")  # of a TDMS segment: tag, contents, version, and two sizes
_LONGEST_METADATA = 1 << 24  # bytes of a segment's metadata that are read
_LONGEST_SEGMENT = 1 << 48  # bytes; more means that the segment was never closed
_END = "***End_of_Header***"
_SPECIAL = ("***Start_Special***", "***End_Special***")
_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";"}
_SAME_STEP = 0.01  # relative difference of steps; rounding of times and header is less
_MOST_SEGMENTS = 1000  # the time to read grows with their square
Lines = list[tuple[int, str]]


def read_tdms(file: File) -> RawFile:
    """Return the channels of a TDMS file; evenly sampled ones get a time channel."""
    nptdms = library("nptdms", "tdms")
    stream: Any = file.stream()
    if isinstance(stream, Path):
        stream = _Bounded(io.FileIO(stream))
    with _messages_as_errors():
        content = nptdms.TdmsFile.open(stream)
        weakref.finalize(content, stream.close)  # channels are read later
        groups = content.groups()
        starts = [t for g in groups for c in g.channels() if (t := _start(c)) is not None]
        first = min(starts, default=None)
        channels = [c for group in groups for c in _tdms_channels(file, content, group, first)]
        restarts = _restarts(file)
    if sum(c.role == "time" for c in channels) > 1 and len(set(starts)) > 1:
        late = (max(starts) - min(starts)) / np.timedelta64(1, "s")
        file.warnings.append(
            f"the channels start at different times, up to {late:.4g} s apart (wf_start_time); "
            "each has a time of its own"
        )
    if restarts:
        file.warnings.append(
            f"segments {listed(map(str, restarts), 5)} of the file state wf_increment again, "
            "as a file that was appended does; time goes on as if no pause were between them. "
            "Split the file where it holds several runs"
        )
    return file.source("TDMS", channels, row_name="sample {}".format)


class _Bounded(io.BufferedReader):
    """A file that is never read beyond its end, so that a damaged size allocates no memory."""

    def read(self, size: int | None = -1, /) -> bytes:
        remaining = os.fstat(self.fileno()).st_size - self.tell()
        return super().read(remaining if size is None or size < 0 else min(size, remaining))


def _restarts(file: File) -> list[int]:
    """Return the numbers of later segments that state the sampling of a waveform again."""
    restarts, number = [], 0
    with file.opened() as stream:
        while lead := stream.read(_LEAD_IN.size):
            if len(lead) < _LEAD_IN.size or not lead.startswith(b"TDSm"):
                raise ValueError(
                    f"bytes behind segment {number}, from byte {stream.tell() - len(lead)} on, "
                    "belong to none; were some added?"
                )
            *_, following, metadata = _LEAD_IN.unpack(lead)
            number += 1
            if following > _LONGEST_SEGMENT:
                break
            start = stream.tell()
            if number > 1 and b"wf_increment" in stream.read(min(metadata, _LONGEST_METADATA)):
                restarts.append(number)
            stream.seek(start + following)
    return restarts


@contextlib.contextmanager
def _messages_as_errors() -> Iterator[None]:
    """Raise messages that the library would print on the terminal as errors."""
    printer, printed = library("nptdms.log").log_manager.console_handler, io.StringIO()
    terminal = printer.setStream(printed)
    try:
        yield
    finally:
        printer.setStream(terminal)
    if printed.getvalue():
        raise ValueError(printed.getvalue().splitlines()[0].partition("] ")[2])


def _start(channel: Any) -> Any:
    """Return the start time of a waveform; None if the file does not state it."""
    if float(channel.properties.get("wf_increment", 0.0)) <= 0.0:
        return None
    start = channel.properties.get("wf_start_time")
    return None if start is None else np.datetime64(start, "ns")


def _tdms_channels(file: File, content: Any, group: Any, first: Any) -> Iterator[RawChannel]:
    times: dict[tuple[float, float, int], Stored] = {}
    for channel in group.channels():
        properties = channel.properties
        unit = properties.get("unit_string") or properties.get("NI_UnitDescription")
        count = len(channel)
        what = f"{file.name}: {channel.path}"
        file.refuse_above_limit(8 * count, channel.path)
        read = functools.partial(_tdms_values, content, channel)
        values: Any = Stored((count,), np.dtype(channel.dtype), read, what)
        if values.dtype.kind not in "fiubc":
            values = words(map(str, values.array))
        yield _labelled(f"{group.name}/", channel.name, values, unit)
        step = float(properties.get("wf_increment", 0.0))
        if step > 0.0:
            start, clock = float(properties.get("wf_start_offset", 0.0)), _start(channel)
            if clock is not None:  # to a hundredth of a step: clocks of modules differ by less
                start += step * round(float((clock - first) / np.timedelta64(1, "s")) / step, 2)
            even = functools.partial(_even_times, start, step, count)
            times[start, step, count] = Stored((count,), np.dtype(np.float64), even, what)
    yield from _time_channels(list(times.values()), f"{group.name}/")


def _tdms_values(content: Any, channel: Any, rows: slice) -> NDArray[Any]:
    """Return some values of a channel, whose file is open as long as `content` exists."""
    assert content is not None
    with _messages_as_errors():
        values = np.asarray(channel[rows])
    if values.size != len(range(*rows.indices(len(channel)))):
        raise ValueError("it ends before its last sample")
    return values


def _even_times(start: float, step: float, count: int, rows: slice) -> NDArray[Any]:
    return np.asarray(start + step * np.arange(count)[rows])


def _labelled(prefix: str, label: str, values: Any, unit: str | None) -> RawChannel:
    """Return a channel; many data loggers write its unit into the label: ``Force (N)``."""
    name, in_label = (label, unit) if unit else split_header(label)
    return RawChannel(prefix + name, values, in_label, short=name)


def _time_channels(axes: Sequence[Any], prefix: str) -> Iterator[RawChannel]:
    for i, time in enumerate(axes):
        name = "time" if len(axes) == 1 else f"time {i + 1}"
        yield RawChannel(prefix + name, time, "s", "time", name)


def read_lvm(file: File) -> RawFile:
    """Return the channels of all segments of a LabVIEW measurement file."""
    text = utf8(file.lines()).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    lines, inside = [], False
    for i, line in enumerate(text.split("\n")):
        mark = line.strip()
        ends = mark.startswith(_SPECIAL[1])
        inside = (inside or mark.startswith(_SPECIAL[0])) and not ends
        if not inside and not ends:
            lines.append((i + 1, line))
    content = _Lvm(file, lines)
    segments: list[_LvmBlock] = []
    while any(line.strip() for _, line in content.lines):
        segments.append(content.segment())
        if len(segments) > _MOST_SEGMENTS:
            raise DataError(f"{file.name}: the file has more than {_MOST_SEGMENTS} segments")
    channels: list[RawChannel] = []
    for i, segment in enumerate(segments):
        channels += segment.channels(f"segment {i}/" if len(segments) > 1 else "")
        file.warnings.extend(segment.contradictions())
    return file.source("LVM", channels, row_name="sample {}".format)


class _Lvm:
    """The unread lines of a file, and the settings in its header."""

    def __init__(self, file: File, lines: Lines) -> None:
        self.file, self.lines, self.separator = file, lines, "\t"
        head = self.header()
        for _, line in reversed(head):
            if line.startswith("Separator") and len(line) > 9:
                self.separator = _SEPARATORS.get(line[10:].strip().casefold(), line[9])
        settings = self.entries(head)
        self.mark = (settings.get("Decimal_Separator") or ["."])[0]
        self.columns = (settings.get("X_Columns") or ["One"])[0].strip().casefold()
        self.single = (settings.get("Multi_Headings") or ["Yes"])[0].strip().casefold() == "no"

    def header(self) -> Lines:
        for i, (_, line) in enumerate(self.lines):
            if line.strip() == _END:
                head, self.lines = self.lines[:i], self.lines[i + 1 :]
                return [pair for pair in head if pair[1].strip()]
        raise ValueError(f"a header without {_END}")

    def entries(self, head: Lines) -> dict[str, list[str]]:
        cells = (line.split(self.separator) for _, line in head)
        return {key.strip(): values for key, *values in cells}

    def segment(self) -> _LvmBlock:
        header = self.entries(self.header())
        lines = list(itertools.dropwhile(lambda pair: not pair[1].strip(), self.lines))
        if not lines:
            raise ValueError("a segment without column labels")
        labels = [label.strip() for label in lines[0][1].split(self.separator)]
        refuse_many(self.file.name, len(labels), "channels")
        blank = (i for i in range(1, len(lines)) if not lines[i][1].strip())
        stop = len(lines) if self.single else next(blank, len(lines))
        rows, self.lines = [row for row in lines[1:stop] if row[1].strip()], lines[stop:]
        while labels and not labels[-1]:
            labels.pop()
        width = len(labels) - (labels[-1:] == ["Comment"])
        first = 1 if self.columns == "no" else 0
        table = [line.split(self.separator) for _, line in rows]
        for (number, _), cells in zip(rows, table, strict=True):
            if len(cells) < width or any(cell.strip() for cell in cells[len(labels) :]):
                raise DataError(
                    f"{self.file.name}, line {number}: {len(cells)} fields; expected the {width} "
                    "of the column labels"
                )
        numbers = RawFile(
            self.file.name, "", (), decimal=self.mark, row_name=lambda i: f"line {rows[i][0]}"
        )
        data = np.empty((len(rows), width - first))
        for k, label in enumerate(labels[first:width]):
            column = words(cells[first + k] for cells in table)
            data[:, k] = numbers.from_text(RawChannel(label, column))
        segment = _LvmBlock(header, labels[first:width], data, self.columns == "multi")
        self.check_samples(segment)
        number, following = next((pair for pair in self.lines if pair[1].strip()), (0, ""))
        if following and "_" not in following and not following[0].isalpha():
            raise DataError(
                f"{self.file.name}, line {number}: numbers behind a blank line, where a segment "
                "has ended; expected its samples without blank lines between them"
            )
        return segment

    def check_samples(self, segment: _LvmBlock) -> None:
        rows = len(segment.data)
        stated = [value.strip() for value in segment.header.get("Samples", []) if value.strip()]
        for value in stated:
            if not re.fullmatch("[0-9]{1,18}", value):
                raise ValueError(f"{value[:40]!r} is not a number of samples")
        expected = max(map(int, stated), default=rows)
        # a single header belongs to the first samples written, and more may follow
        timed = "X_Value" in segment.labels
        appended = self.single and rows > expected > 0 and (timed or rows % expected == 0)
        if expected != rows and not appended:
            raise DataError(
                f"{self.file.name}: a segment has {rows} samples where its header says {expected}; "
                f"the file {'looks cut off' if rows < expected else 'is damaged'}"
            )


class _LvmBlock(NamedTuple):
    """Header and numbers of a segment; with `multi`, each channel has its own x column."""

    header: dict[str, list[str]]
    labels: list[str]
    data: NDArray[Any]
    multi: bool

    def channels(self, prefix: str) -> Iterator[RawChannel]:
        table = list(zip(self.labels, self.data.T, strict=True))
        named = [pair for pair in table if pair[0] != "X_Value"]
        units = self.header.get("Y_Unit_Label", [])
        if self.multi and len(units) > len(named) and not any(u.strip() for u in units[1::2]):
            units = units[0::2]
        for (name, values), unit in zip(named, [*units, *[""] * len(named)], strict=False):
            yield _labelled(prefix, name, values, unit.strip())
        if {word.strip() for word in self.header.get("X_Dimension", [])} - {"Time", ""}:
            return
        times: list[NDArray[Any]] = [values for name, values in table if name == "X_Value"]
        if not times:
            n = np.arange(len(self.data))
            both = zip(self.floats("X0"), self.floats("Delta_X"), strict=False)
            times = [start + step * n for start, step in both if step > 0]
        yield from _time_channels(list({time.tobytes(): time for time in times}.values()), prefix)

    def contradictions(self) -> Iterator[str]:
        """Yield contradictions between the sampling in the header and the column of times."""
        times = self.data[:, [label == "X_Value" for label in self.labels]]
        if len(times) < 2:
            return
        for time, stated in zip(times.T, self.floats("Delta_X"), strict=False):
            step = float(np.median(np.diff(time)))
            if stated > 0.0 and abs(step - stated) > _SAME_STEP * stated:
                yield (
                    f"X_Value goes in steps of {step:.6g}, and the header says Delta_X = "
                    f"{stated:.6g}; X_Value is used"
                )

    def floats(self, key: str) -> list[float]:
        numbers = []
        for value in self.header.get(key, []):
            with contextlib.suppress(ValueError):
                if "_" not in value:
                    numbers.append(float(value.strip().replace(",", ".")))
        return numbers

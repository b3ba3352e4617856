"""LabVIEW measurement files: text with a header for the file and one for each segment.

Every line of a segment must have the fields of its column labels, and a segment the number of
samples that its header says; a lost line would move all later samples in time.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile, words
from dahl_ident.data.readers.file import MOST_CHANNELS, File, utf8
from dahl_ident.data.readers.instruments import evenly_timed, labelled_channel
from dahl_ident.errors import DataError

_END = "***End_of_Header***"
_SPECIAL = ("***Start_Special***", "***End_Special***")
_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";"}
_SAME_STEP = 0.01  # relative: more than what is rounded in times and in the header
_MOST_SEGMENTS = 1000  # the time to read grows with their square
Lines = list[tuple[int, str]]


def read_lvm(file: File) -> RawFile:
    """Return the channels of all segments of a LabVIEW measurement file."""
    text = utf8(file.lines()).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    lines, inside = [], False
    for i, line in enumerate(text.split("\n")):
        mark = line.strip()
        inside = (inside or mark.startswith(_SPECIAL[0])) and not mark.startswith(_SPECIAL[1])
        if not inside and not mark.startswith(_SPECIAL[1]):
            lines.append((i + 1, line))
    content = _Lvm(file, lines)
    segments: list[_LvmBlock] = []
    while any(line.strip() for _, line in content.lines):
        segments.append(content.segment())
        if len(segments) > _MOST_SEGMENTS:
            raise DataError(f"{file.name}: the file has more than {_MOST_SEGMENTS} segments")
    if not segments:
        raise DataError(f"{file.name}: the LVM file is damaged: it holds no segment")
    channels = [
        channel
        for i, segment in enumerate(segments)
        for channel in segment.channels(f"segment {i}/" if len(segments) > 1 else "")
    ]
    doubts = tuple(doubt for segment in segments for doubt in segment.contradictions())
    return file.source("LVM", channels, row_name=lambda i: f"sample {i}", doubts=doubts)


class _Lvm:
    """The lines of a file that are still to be read, and the settings in its header."""

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
        """Take the lines of a header."""
        for i, (_, line) in enumerate(self.lines):
            if line.strip() == _END:
                head, self.lines = self.lines[:i], self.lines[i + 1 :]
                return [pair for pair in head if pair[1].strip()]
        raise self.damage(f"a header without {_END}")

    def entries(self, head: Lines) -> dict[str, list[str]]:
        """Return the values of a header by their keys."""
        cells = (line.split(self.separator) for _, line in head)
        return {key.strip(): values for key, *values in cells}

    def damage(self, why: str) -> DataError:
        return DataError(f"{self.file.name}: the LVM file is damaged: {why}")

    def segment(self) -> _LvmBlock:
        """Take the lines of a segment: its header, labels and numbers; all of a single one."""
        header = self.entries(self.header())
        lines = list(itertools.dropwhile(lambda pair: not pair[1].strip(), self.lines))
        if not lines:
            raise self.damage("a segment without column labels")
        labels = [label.strip() for label in lines[0][1].split(self.separator)]
        if len(labels) > MOST_CHANNELS:
            raise DataError(f"{self.file.name}: a segment has more than {MOST_CHANNELS} channels")
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
        following = next((pair for pair in self.lines if pair[1].strip()), (0, ""))
        if following[1] and "_" not in following[1] and not following[1][0].isalpha():
            raise DataError(
                f"{self.file.name}, line {following[0]}: numbers behind a blank line, where a "
                "segment has ended; expected its samples without blank lines between them"
            )
        return segment

    def check_samples(self, segment: _LvmBlock) -> None:
        """Refuse a segment with fewer or more samples than its header says."""
        rows = len(segment.data)
        stated = [value.strip() for value in segment.header.get("Samples", []) if value.strip()]
        for value in stated:
            if not re.fullmatch("[0-9]{1,18}", value):
                raise self.damage(f"{value[:40]!r} is not a number of samples")
        most = max(map(int, stated), default=rows)
        # a single header is that of the first samples written, which more may follow
        timed = "X_Value" in segment.labels
        goes_on = self.single and rows > most > 0 and (timed or rows % most == 0)
        if most != rows and not goes_on:
            raise DataError(
                f"{self.file.name}: a segment has {rows} samples where its header says {most}; "
                f"the file {'looks cut off' if rows < most else 'is damaged'}"
            )


class _LvmBlock(NamedTuple):
    """Header and numbers of a segment; with `multi`, each channel has its own x column."""

    header: dict[str, list[str]]
    labels: list[str]
    data: NDArray[Any]
    multi: bool

    def channels(self, prefix: str) -> Iterator[RawChannel]:
        """Yield the channels, and time: the x columns, or counted from their step."""
        table = list(zip(self.labels, self.data.T, strict=True))
        named = [pair for pair in table if pair[0] != "X_Value"]
        units = self.header.get("Y_Unit_Label", [])
        if self.multi and len(units) > len(named) and not any(u.strip() for u in units[1::2]):
            units = units[0::2]
        for i, (name, values) in enumerate(named):
            unit = units[i].strip() if i < len(units) else ""
            yield labelled_channel(prefix, name, values, unit)
        if {word.strip() for word in self.header.get("X_Dimension", [])} - {"Time", ""}:
            return
        times: list[NDArray[Any]] = [values for name, values in table if name == "X_Value"]
        if not times:
            n = np.arange(len(self.data))
            both = zip(self.floats("X0"), self.floats("Delta_X"), strict=False)
            times = [start + step * n for start, step in both if step > 0]
        yield from evenly_timed(times, prefix)

    def contradictions(self) -> Iterator[str]:
        """Yield what the header says of the sampling, and the column of times does not."""
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
        """Return the numbers in an entry of the header."""
        numbers = []
        for value in self.header.get(key, []):
            with contextlib.suppress(ValueError):
                if "_" not in value:
                    numbers.append(float(value.strip().replace(",", ".")))
        return numbers

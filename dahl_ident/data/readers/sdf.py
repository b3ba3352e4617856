"""HP and Keysight analysers' Standard Data Format, as the 35665A and 35670A write it.

Records of big-endian numbers without padding: a file header with the places of all others, a header
of the measurement, and for each result a header with its axis and units; then the vectors, the
channels and the numbers. (Standard Data Format Utilities User's Guide, Agilent 5963-1715)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile
from dahl_ident.data.readers.file import MOST_CHANNELS, File
from dahl_ident.data.readers.instruments import merged_axes

_FILE, _MEASUREMENT, _DATA, _VECTOR, _CHANNEL, _X, _Y = 10, 11, 12, 13, 14, 16, 17  # records
_FREQUENCY, _TIME = 0, 1  # domains
_RESPONSE, _COHERENCE = 4, 8  # types of data
_LOGARITHMIC, _COMMON, _OF_RESULT, _OF_VECTOR = 1, 2, 3, 4  # axes; 0 is linear
_NUMBERS = {1: ">i2", 2: ">i4", 3: ">f4", 4: ">f8"}
_POWER = 48  # of a channel that is in a result once
_UNITS = {"hz": "Hz", "g's": "g_n", "g": "g_n", "sec": "s", "eu": ""}  # others than their labels


@dataclass(frozen=True)
class _ResultHeader:
    """Header of one result: what its numbers are."""

    title: str
    domain: int
    kind: int
    points: int
    spacing: int
    x_number: int
    y_number: int
    complex: bool
    valid: bool
    vectors: tuple[int, int]
    x_unit: str
    unit: str | None
    first: float
    step: float

    @property
    def size(self) -> int:
        """Numbers of one vector."""
        return self.points * (1 + self.complex)


def read_sdf(file: File) -> RawFile:
    """Return the results of an analyser's file with their axes.

    A frequency response is in the engineering units of its channels. Where its coherence is in the
    file too, the standard deviation follows from it.
    """
    return _Sdf(file).source()


class _Sdf:
    def __init__(self, file: File) -> None:
        self.file = file
        self.data = file.data
        head = self.record(2, _FILE)
        self.counts = dict(
            zip((_DATA, _VECTOR, _CHANNEL), struct.unpack_from(">3h", head, 24), strict=True)
        )
        self.places = dict(
            zip((_DATA, _VECTOR, _CHANNEL), struct.unpack_from(">3i", head, 36), strict=True)
        )
        self.x_place, self.y_place = struct.unpack_from(">2i", head, 56)
        measurement = self.record(2 + len(head), _MEASUREMENT)
        self.averages = max(1, struct.unpack_from(">i", measurement, 30)[0])

    def record(self, at: int, kind: int) -> bytes:
        """Return a record, once its kind and size agree with the file."""
        stored, size = struct.unpack_from(">hi", self.data, at) if at >= 0 else (None, 0)
        if stored != kind or not 6 <= size <= len(self.data) - at:
            raise ValueError(
                f"at byte {at} is not a whole record of type {kind}; is the file cut off?"
            )
        return self.data[at : at + size]

    def records(self, kind: int) -> Iterator[bytes]:
        """Yield all records of a kind."""
        if not 0 <= self.counts[kind] <= MOST_CHANNELS:
            raise ValueError(f"{self.counts[kind]} records of type {kind}")
        at = self.places[kind]
        for _ in range(self.counts[kind]):
            record = self.record(at, kind)
            at += len(record)
            yield record

    def source(self) -> RawFile:
        results = [self.result(record) for record in self.records(_DATA)]
        vectors = [struct.unpack_from(">4h", record, 10) for record in self.records(_VECTOR)]
        channels = list(self.records(_CHANNEL))
        numbers = self.record(self.y_place, _Y)[6:]
        expected = [
            r.vectors[1] * r.size * np.dtype(_NUMBERS[r.y_number]).itemsize for r in results
        ]
        if sum(expected) != len(numbers):
            raise ValueError(
                f"its results take {sum(expected)} bytes, and {len(numbers)} are there (results "
                "of several scans are not read)"
            )
        read: list[RawChannel] = []
        doubts: list[str] = []
        notes: list[str] = []
        at = 0
        for result, size in zip(results, expected, strict=True):
            whole = np.frombuffer(numbers, _NUMBERS[result.y_number], offset=at, count=-1)
            with np.errstate(invalid="ignore"):  # of a NaN that signals
                whole = whole[: result.vectors[1] * result.size].astype(np.float64)
            at += size
            axis = self.axis(result)
            if not result.valid:
                doubts.append(f"the analyser says that {result.title!r} is not valid")
            for k, part in enumerate(whole.reshape(result.vectors[1], result.size)):
                values: NDArray[Any] = part[0::2] + 1j * part[1::2] if result.complex else part
                number = result.vectors[0] + k
                powers = vectors[number] if 0 <= number < len(vectors) else (-1, -1, 0, 0)
                factor, unit = self.scale(powers, channels, doubts)
                if result.unit is not None:
                    factor, unit = 1.0, result.unit
                is_response = result.kind == _RESPONSE
                name = result.title + (f" {k + 1}" if result.vectors[1] > 1 else "")
                read.append(axis)
                role = "response" if is_response else None
                read.append(RawChannel(name, factor * values, unit if is_response else None, role))
        read += self.deviations(results, read, notes)
        return self.file.source(
            "SDF", merged_axes(read), row_name=lambda i: f"sample {i}",
            notes=tuple(notes), doubts=tuple(doubts),
        )  # fmt: skip

    def result(self, record: bytes) -> _ResultHeader:
        """Read the header of a result."""
        title, domain, kind, points = struct.unpack_from(">16s3h", record, 10)
        spacing, x_number, _, y_number, values, is_complex, _, _, valid = struct.unpack_from(
            ">9h", record, 42
        )
        first, rows, columns = struct.unpack_from(">i2h", record, 60)
        start, step = struct.unpack_from(">2f", record, 34)
        if len(record) >= 130:  # from the second revision on, with more digits
            start, step = struct.unpack_from(">2d", record, 114)
        if len(record) >= 150:
            points, passes = struct.unpack_from(">i6xh", record, 134)
            values = values if passes == 0 else 2
        if y_number not in _NUMBERS or values != 1 or points < 1 or min(rows, columns) < 1:
            raise ValueError(
                f"the result {_text(title)!r} has {points} points of {values} values of type "
                f"{y_number}; expected some points of one value"
            )
        return _ResultHeader(
            _text(title) or "result", domain, kind, points, spacing, x_number, y_number,
            is_complex == 1, valid != 0, (first, rows * columns), _unit(record[68:78]) or "",
            _unit(record[92:102]) if struct.unpack_from(">h", record, 90)[0] else None, start, step,
        )  # fmt: skip

    def axis(self, result: _ResultHeader) -> RawChannel:
        """Return the frequencies or times of a result."""
        names = {_FREQUENCY: "frequency", _TIME: "time"}
        name = names.get(result.domain, "x")
        self.file.refuse_above_limit(8 * result.points, "one axis")
        n = np.arange(result.points)
        values: NDArray[Any]
        if result.spacing == _LOGARITHMIC:
            with np.errstate(over="ignore", invalid="ignore"):
                values = result.first * result.step**n
        elif result.spacing in (_COMMON, _OF_RESULT, _OF_VECTOR):
            stored = self.record(self.x_place, _X)[6:]
            if result.x_number not in _NUMBERS:
                raise ValueError(f"an axis of numbers of type {result.x_number}")
            dtype = np.dtype(_NUMBERS[result.x_number])
            if len(stored) != result.points * dtype.itemsize:
                raise ValueError(
                    f"an axis of {result.points} points in {len(stored)} bytes; several axes in "
                    "one file are not read"
                )
            values = np.frombuffer(stored, dtype).astype(np.float64)
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                values = result.first + result.step * n
        if not np.isfinite(values).all():
            raise ValueError("an axis that is not finite")
        role = name if name in ("frequency", "time") else None
        return RawChannel(f"{name} of {result.title}", values, result.x_unit or None, role)

    def scale(
        self, powers: tuple[int, ...], channels: list[bytes], doubts: list[str]
    ) -> tuple[float, str | None]:
        """Return the factor from internal to engineering units, and the unit."""
        factor, units = 1.0, ["", ""]
        for number, power in zip(powers[:2], powers[2:], strict=True):
            if not 0 <= number < len(channels) or power == 0:
                continue
            channel = channels[number]
            if struct.unpack_from(">h", channel, 104)[0] == 1:
                doubts.append(f"channel {number + 1} was overloaded")
            sensitivity = struct.unpack_from(">f", channel, 138)[0]
            if not 0.0 < abs(sensitivity) < np.inf or abs(power) not in (_POWER, 2 * _POWER):
                raise ValueError(f"channel {number + 1} has the sensitivity {sensitivity:g}")
            factor *= sensitivity ** (-power / _POWER)
            units[power < 0] = _unit(channel[116:126]) or "V"
        return factor, f"({units[0]})/({units[1]})" if all(units) else units[0] or None

    def deviations(
        self, results: list[_ResultHeader], channels: list[RawChannel], notes: list[str]
    ) -> Iterator[RawChannel]:
        """Yield the standard deviation that the coherence of averages gives a response."""
        responses = [c for c in channels if c.role == "response"]
        kinds = [r.kind for r in results for _ in range(r.vectors[1])]
        coherences = [
            c for c, kind in zip(channels[1::2], kinds, strict=True) if kind == _COHERENCE
        ]
        if len(responses) != 1 or len(coherences) != 1 or self.averages < 2:
            return
        coherence = np.asarray(coherences[0].values, dtype=np.float64)
        if coherence.size != responses[0].size or not ((coherence > 0) & (coherence <= 1)).all():
            return
        notes.append(f"standard deviations from the coherence of {self.averages} averages")
        share = np.sqrt((1.0 - coherence) / (2.0 * self.averages * coherence))
        std = np.maximum(share, np.finfo(np.float32).eps) * np.abs(responses[0].values)
        yield RawChannel("std", std, responses[0].unit, "std")


def _text(letters: bytes) -> str:
    return letters.split(b"\0")[0].decode("latin-1").strip()


def _unit(letters: bytes) -> str | None:
    """Return the label of a unit as others write it."""
    label = _text(letters)
    return _UNITS.get(label.casefold(), label) or None

"""Universal files 58 and 58b, and the Standard Data Format (SDF) of HP and Keysight.

An SDF file consists of records of big-endian numbers without padding (Standard Data Format
Utilities User's Guide, Agilent 5963-1715).
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.raw_columns import RawChannel, RawFile
from dahl_ident.data.readers.file import MOST_CHANNELS, File, utf8
from dahl_ident.data.rows import stated_levels
from dahl_ident.data.storage import library
from dahl_ident.errors import DataError
from dahl_ident.units import parse_unit

_TIME_RESPONSE, _FRF = 1, 4  # function types of data set 58
_FORTRAN = re.compile(rb"(\d)[dD]([-+]\d\d)")  # 1.0D+00
# Universal file 164, units code: length and force.
_SYSTEMS = {
    1: ("m", "N"),
    2: ("ft", "lbf"),
    3: ("m", "kgf"),
    4: ("ft", "poundal"),
    5: ("mm", "mN"),
    6: ("cm", "cN"),
    7: ("in", "lbf"),
    8: ("mm", "kgf"),
}
_AXES = ("", "X", "Y", "Z", "RX", "RY", "RZ")
# Universal file 58, specific data type: role in a record, and its unit.
_DATA_TYPES: dict[int, tuple[str, str]] = {
    8: ("displacement", "motion"),
    11: ("velocity", "motion/s"),
    12: ("acceleration", "motion/s^2"),
    9: ("force", "load"),
    13: ("force", "load"),
}
_FILE, _MEASUREMENT, _DATA, _VECTOR, _CHANNEL, _X, _Y = 10, 11, 12, 13, 14, 16, 17  # records
# Fields read from the records: type and position.
_FIELDS: dict[int, dict[str, tuple[str, int]]] = {
    _FILE: {
        "counts": ("(3,)>i2", 24),
        "places": ("(3,)>i4", 36),
        "x": (">i4", 56),
        "y": (">i4", 60),
    },
    _MEASUREMENT: {"averages": (">i4", 30)},
    _DATA: {
        "title": ("S16", 10),
        "domain": (">i2", 26),
        "kind": (">i2", 28),
        "points": (">i2", 30),
        "start": (">f4", 34),
        "step": (">f4", 38),
        "spacing": (">i2", 42),
        "x_number": (">i2", 44),
        "y_number": (">i2", 48),
        "values": (">i2", 50),
        "complex": (">i2", 52),
        "valid": (">i2", 58),
        "vector": (">i4", 60),
        "rows": (">i2", 64),
        "columns": (">i2", 66),
        "x_unit": ("S10", 68),
        "has_unit": (">i2", 90),
        "unit": ("S10", 92),
    },
    _VECTOR: {"channels": ("(2,)>i2", 10), "powers": ("(2,)>i2", 14)},
    _CHANNEL: {"overloaded": (">i2", 104), "unit": ("S10", 116), "sensitivity": (">f4", 138)},
}
_FREQUENCY, _TIME = 0, 1  # domains
_RESPONSE, _COHERENCE = 4, 8  # types of data
_LOGARITHMIC, _STORED = 1, (2, 3, 4)  # axes; 0 is linear
_NUMBERS = {1: ">i2", 2: ">i4", 3: ">f4", 4: ">f8"}
_FACTOR = 48  # stored exponent of a channel that enters a result as a factor
_UNITS = {"hz": "Hz", "g's": "g_n", "g": "g_n", "sec": "s", "eu": ""}  # units by label


def read_uff(file: File) -> RawFile:
    """Return the frequency responses and time records of a universal file.

    Units are the axis labels of the data set, or those of data set 164.
    """
    sets = _uff_sets(file, library("pyuff", "uff"))
    units = _uff_system(file, next((s for s in sets if s.get("type") == 164), None))
    functions = [s for s in sets if s.get("type") == 58]
    wanted = [s for s in functions if s.get("func_type") in (_TIME_RESPONSE, _FRF)]
    if not wanted:
        others = sorted({int(s["func_type"]) for s in functions})
        raise DataError(
            f"{file.name}: no frequency response or time record (data set 58, function type 4 or "
            f"1); the file holds data sets {sorted({int(s.get('type', 0)) for s in sets})}"
            + (f" with function types {others}" if others else "")
        )
    channels = [c for function in wanted for c in _uff_channels(file, function, units)]
    texts = [str(function.get(f"id{i}", "")) for function in wanted for i in range(1, 6)]
    return file.source(
        "universal file",
        merged_axes(channels),
        row_name="sample {}".format,
        stated=stated_levels(texts),
    )


def _uff_sets(file: File, pyuff: Any) -> list[dict[str, Any]]:
    sets: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        # pyuff reads only files with a name, which standard input lacks, and prints groups
        path = Path(folder) / "data.uff"
        # binary data sets count bytes, so only pure text can be converted to UTF-8
        path.write_bytes(file.data if b"58b" in file.data else _uff_text(utf8(file.lines())))
        content = pyuff.UFF(str(path))
        types = content.get_set_types()
        for i, kind in enumerate(types):
            try:
                sets.append(content.read_sets(i))
            except Exception as exc:
                raise DataError(
                    f"{file.name}: data set {i + 1} of {len(types)} (type {int(kind)}) of the "
                    f"universal file is damaged: {exc.__context__ or exc}"
                ) from exc
    return sets


def _uff_text(text: bytes) -> bytes:
    """Return data sets 58 and 164 in the strict form that the library expects."""
    kept: list[bytes] = []
    block: list[bytes] | None = None
    for line in [*text.splitlines(), b"-1"]:
        if line.strip() != b"-1":
            if block is not None:
                block.append(line)
        elif block is None:
            block = []
        else:
            number = block[0].strip() if block else b""
            if number in (b"58", b"164"):
                rows = [_FORTRAN.sub(rb"\1E\2", row) for row in block[1:]]
                kept += [b"    -1", number.rjust(6), *rows, b"    -1"]
            block = None
    return b"\n".join(kept) + b"\n" if b"    58" in kept else text


def _uff_channels(
    file: File, function: dict[str, Any], units: tuple[str, str] | None
) -> Iterator[RawChannel]:
    """Yield the axis and the values of a data set 58, positive in its directions."""
    direction = {side: int(function[f"{side}_dir"]) for side in ("rsp", "ref")}
    point = {}  # node and direction, such as 1:+Z or 3:-RX
    for side, d in direction.items():
        axis = _AXES[abs(d)] if abs(d) < len(_AXES) else "?"
        point[side] = f"{function[f'{side}_node']}:{'-' if d < 0 else '+'}{axis}"
    values, count = np.asarray(function["data"]), int(function["num_pts"])
    if len(values) != count:
        raise DataError(
            f"{file.name}: data set 58 ({point['rsp']}) holds {len(values)} values where its "
            f"header says {count}; the file looks cut off"
        )

    def unit_of(axis: str, side: str) -> str | None:
        """Return the unit in the axis label, or that of its data type in the system of units."""
        label = str(function.get(f"{axis}_axis_units_lab", "")).strip()
        if label and label.upper() != "NONE":
            return label
        kind = int(function.get(f"{axis}_spec_data_type", 0))
        if units is None or kind not in _DATA_TYPES:
            return None
        length, force = units
        rotation = abs(direction[side]) > 3
        motion, load = ("rad", f"{force}*{length}") if rotation else (length, force)
        return _DATA_TYPES[kind][1].replace("motion", motion).replace("load", load)

    role, _ = _DATA_TYPES.get(int(function.get("ordinate_spec_data_type", 0)), (None, ""))
    unit, inverted = unit_of("ordinate", "rsp"), direction["rsp"] < 0
    points, abscissa, x_unit = point["rsp"], "time", "s"
    name = f"{role or 'channel'} {points}"
    if function["func_type"] == _FRF:
        points = f"{point['rsp']}/{point['ref']}"
        name, abscissa, x_unit, role = f"FRF {points}", "frequency", "Hz", "response"
        denominator, inverted = unit_of("orddenom", "ref"), inverted != (direction["ref"] < 0)
        unit = f"({unit})/({denominator})" if unit and denominator else unit
    x = np.asarray(function["x"], dtype=float)
    yield RawChannel(f"{abscissa} {points}", x, x_unit, abscissa)
    if inverted:
        file.notes.append(f"{name}: sign turned, as its directions say")
    yield RawChannel(name, -values if inverted else values, unit, role)


def _uff_system(file: File, units: dict[str, Any] | None) -> tuple[str, str] | None:
    """Return length and force units of data set 164; its code and factors must agree."""
    if units is None or (system := _SYSTEMS.get(int(units["units_code"]))) is None:
        return None
    for name, unit in zip(("length", "force"), system, strict=True):
        stated, expected = float(units[name]), 1.0 / parse_unit(unit).factor
        if not 0.999 < stated / expected < 1.001:
            raise DataError(
                f"{file.name}: data set 164 contradicts itself: units code "
                f"{int(units['units_code'])} means {unit}, a {name} factor of {expected:.6g}, but "
                f"the file says {stated:.6g}"
            )
    return system


def merged_axes(channels: list[RawChannel]) -> list[RawChannel]:
    """Merge the axes of all functions into one if they are equal."""
    axes = [c for c in channels if c.role in ("time", "frequency")]
    first = axes[0] if axes else None
    if first is None or any(
        c.role != first.role or not np.array_equal(c.values, first.values) for c in axes
    ):
        return channels
    others = [c for c in channels if c.role not in ("time", "frequency")]
    return [RawChannel(str(first.role), first.values, first.unit, first.role), *others]


def read_sdf(file: File) -> RawFile:
    """Return the results of an analyser's file with their axes, in engineering units."""
    return _Sdf(file).source()


class _Sdf:
    def __init__(self, file: File) -> None:
        self.file, self.data = file, file.data
        self.head = self.fields(self.record(2, _FILE), _FILE)
        at = 2 + len(self.record(2, _FILE))
        measurement = self.fields(self.record(at, _MEASUREMENT), _MEASUREMENT)
        self.averages = max(1, measurement.averages)

    def record(self, at: int, kind: int) -> bytes:
        """Return a record; its kind and size must agree with the file."""
        stored, size = struct.unpack_from(">hi", self.data, at) if at >= 0 else (None, 0)
        if stored != kind or not 6 <= size <= len(self.data) - at:
            raise ValueError(
                f"at byte {at} is not a whole record of type {kind}; is the file cut off?"
            )
        return self.data[at : at + size]

    def fields(self, record: bytes, kind: int) -> SimpleNamespace:
        fields = _FIELDS[kind].items()
        values = {n: np.ndarray((), f, record, at).tolist() for n, (f, at) in fields}
        return SimpleNamespace(**values)

    def records(self, kind: int) -> Iterator[bytes]:
        i = (_DATA, _VECTOR, _CHANNEL).index(kind)
        count, at = self.head.counts[i], self.head.places[i]
        if not 0 <= count <= MOST_CHANNELS:
            raise ValueError(f"{count} records of type {kind}")
        for _ in range(count):
            record = self.record(at, kind)
            at += len(record)
            yield record

    def source(self) -> RawFile:
        results = [self.result(record) for record in self.records(_DATA)]
        vectors = [self.fields(record, _VECTOR) for record in self.records(_VECTOR)]
        channels = [self.fields(record, _CHANNEL) for record in self.records(_CHANNEL)]
        numbers = self.record(self.head.y, _Y)[6:]
        expected = [r.count * r.size * np.dtype(_NUMBERS[r.y_number]).itemsize for r in results]
        if sum(expected) != len(numbers):
            raise ValueError(
                f"its results take {sum(expected)} bytes, and {len(numbers)} are there (results "
                "of several scans are not read)"
            )
        read: list[RawChannel] = []
        at = 0
        for result, size in zip(results, expected, strict=True):
            axis = self.axis(result)
            if not result.valid:
                self.file.warnings.append(f"the analyser says that {result.title!r} is not valid")
            stored = np.frombuffer(numbers[at : at + size], _NUMBERS[result.y_number])
            at += size
            with np.errstate(invalid="ignore"):  # signalling NaN
                parts = stored.astype(np.float64).reshape(result.count, result.size)
            for k, part in enumerate(parts):
                values: NDArray[Any] = part[0::2] + 1j * part[1::2] if result.complex == 1 else part
                number = result.vector + k
                vector = vectors[number] if 0 <= number < len(vectors) else None
                factor, unit = self.scale(vector, channels)
                if result.unit is not None:
                    factor, unit = 1.0, result.unit
                name = result.title + (f" {k + 1}" if result.count > 1 else "")
                role, unit = ("response", unit) if result.kind == _RESPONSE else (None, None)
                read += [axis, RawChannel(name, factor * values, unit, role)]
        read += self.deviations(results, read)
        return self.file.source("SDF", merged_axes(read), row_name="sample {}".format)

    def result(self, record: bytes) -> SimpleNamespace:
        """Return the header of a result, whose numbers are `count` vectors of `size`."""
        result = self.fields(record, _DATA)
        if len(record) >= 130:  # since the second revision, with more digits
            result.start, result.step = struct.unpack_from(">2d", record, 114)
        if len(record) >= 150:
            result.points, passes = struct.unpack_from(">i6xh", record, 134)
            result.values = result.values if passes == 0 else 2
        result.title = _text(result.title) or "result"
        least = min(result.points, result.rows, result.columns)
        if result.y_number not in _NUMBERS or result.values != 1 or least < 1:
            raise ValueError(
                f"the result {result.title!r} has {result.points} points of {result.values} values "
                f"of type {result.y_number}; expected some points of one value"
            )
        result.count = result.rows * result.columns
        result.size = result.points * (1 + (result.complex == 1))
        result.x_unit = _unit(result.x_unit)
        result.unit = _unit(result.unit) if result.has_unit else None
        return result

    def axis(self, result: SimpleNamespace) -> RawChannel:
        role = {_FREQUENCY: "frequency", _TIME: "time"}.get(result.domain)
        self.file.refuse_above_limit(8 * result.points, "one axis")
        n = np.arange(result.points)
        if result.spacing in _STORED:
            stored = self.record(self.head.x, _X)[6:]
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
            start, step = result.start, result.step
            with np.errstate(over="ignore", invalid="ignore"):
                values = start * step**n if result.spacing == _LOGARITHMIC else start + step * n
        if not np.isfinite(values).all():
            raise ValueError("an axis that is not finite")
        return RawChannel(f"{role or 'x'} of {result.title}", values, result.x_unit, role)

    def scale(
        self, vector: SimpleNamespace | None, channels: list[SimpleNamespace]
    ) -> tuple[float, str | None]:
        """Return the factor from internal to engineering units, and the unit."""
        factor, units = 1.0, ["", ""]
        for number, power in zip(vector.channels, vector.powers, strict=True) if vector else ():
            if not 0 <= number < len(channels) or power == 0:
                continue
            channel = channels[number]
            if channel.overloaded == 1:
                self.file.warnings.append(f"channel {number + 1} was overloaded")
            sensitivity = channel.sensitivity
            if not 0.0 < abs(sensitivity) < np.inf or abs(power) not in (_FACTOR, 2 * _FACTOR):
                raise ValueError(f"channel {number + 1} has the sensitivity {sensitivity:g}")
            factor *= sensitivity ** (-power / _FACTOR)
            units[power < 0] = _unit(channel.unit) or "V"
        return factor, f"({units[0]})/({units[1]})" if all(units) else units[0] or None

    def deviations(
        self, results: list[SimpleNamespace], channels: list[RawChannel]
    ) -> Iterator[RawChannel]:
        """Yield the standard deviation of a response from the coherence of averages."""
        responses = [c for c in channels if c.role == "response"]
        kinds = [r.kind for r in results for _ in range(r.count)]
        coherences = [
            c for c, kind in zip(channels[1::2], kinds, strict=True) if kind == _COHERENCE
        ]
        if len(responses) != 1 or len(coherences) != 1 or self.averages < 2:
            return
        coherence = np.asarray(coherences[0].values, dtype=np.float64)
        if coherence.size != responses[0].size or not ((coherence > 0) & (coherence <= 1)).all():
            return
        self.file.notes.append(
            f"standard deviations from the coherence of {self.averages} averages"
        )
        relative = np.sqrt((1.0 - coherence) / (2.0 * self.averages * coherence))
        std = np.maximum(relative, np.finfo(np.float32).eps) * np.abs(responses[0].values)
        yield RawChannel("std", std, responses[0].unit, "std")


def _text(letters: bytes) -> str:
    return letters.split(b"\0")[0].decode("latin-1").strip()


def _unit(letters: bytes) -> str | None:
    label = _text(letters)
    return _UNITS.get(label.casefold(), label) or None

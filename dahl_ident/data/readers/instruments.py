"""Files of analysers and loggers: universal files 58 and 58b, NI TDMS."""

from __future__ import annotations

import contextlib
import functools
import io
import logging
import logging.handlers
import os
import re
import struct
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.levels import stated_levels
from dahl_ident.data.raw_columns import RawChannel, RawFile, Stored, split_header, words
from dahl_ident.data.readers.file import File, utf8
from dahl_ident.data.storage import library
from dahl_ident.data.tabular import listed
from dahl_ident.errors import DataError
from dahl_ident.units import parse_unit

_TIME_RESPONSE, _FRF = 1, 4  # function types of data set 58
_FORTRAN = re.compile(rb"(\d)[dD]([-+]\d\d)")  # 1.0D+00
_LEAD_IN = struct.Struct("<4sIIQQ")  # of a TDMS segment: tag, contents, version, and two sizes
_LONGEST_METADATA = 1 << 24  # bytes of a segment that are looked at
_LONGEST_SEGMENT = 1 << 48  # bytes; more means that the segment was never closed
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


def read_uff(file: File) -> RawFile:
    """Return the frequency responses and time records of a universal file.

    A negative direction of response or reference turns the sign. Units are the axis labels of
    the data set; without them those of data set 164, which gives factors to SI.
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
    channels: list[RawChannel] = []
    notes: list[str] = []
    for function in wanted:
        channels += _uff_channels(file, function, units, notes)
    texts = [str(function.get(f"id{i}", "")) for function in wanted for i in range(1, 6)]
    return file.source(
        "universal file",
        merged_axes(channels),
        row_name=lambda i: f"sample {i}",
        notes=tuple(notes),
        stated=stated_levels(texts),
    )


def _uff_sets(file: File, pyuff: Any) -> list[dict[str, Any]]:
    """Return the data sets of a file, or name the damaged one."""
    sets: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        # pyuff reads by name only, and prints groups; standard input has no name
        path = Path(folder) / "data.uff"
        # binary data sets count bytes, so that only pure text can be brought to UTF-8
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
    """Return data sets 58 and 164, as the library expects them; others write them more freely."""
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
    file: File, function: dict[str, Any], units: tuple[str, str] | None, notes: list[str]
) -> Iterator[RawChannel]:
    """Yield the axis and the values of a data set 58, positive in its directions."""
    direction = {side: int(function[f"{side}_dir"]) for side in ("rsp", "ref")}
    place = {}  # node and direction, such as 1:+Z or 3:-RX
    for side, d in direction.items():
        axis = _AXES[abs(d)] if abs(d) < len(_AXES) else "?"
        place[side] = f"{function[f'{side}_node']}:{'-' if d < 0 else '+'}{axis}"
    values, count = np.asarray(function["data"]), int(function["num_pts"])
    if len(values) != count:
        raise DataError(
            f"{file.name}: data set 58 ({place['rsp']}) holds {len(values)} values where its "
            f"header says {count}; the file looks cut off"
        )

    def unit_of(axis: str, side: str) -> str | None:
        """Return the unit of the axis label, or that of the system of units for its type."""
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
    unit, turned = unit_of("ordinate", "rsp"), direction["rsp"] < 0
    name, abscissa, step = f"{role or 'channel'} {place['rsp']}", "time", "s"
    where = place["rsp"]
    if function["func_type"] == _FRF:
        where = f"{place['rsp']}/{place['ref']}"
        name, abscissa, step, role = f"FRF {where}", "frequency", "Hz", "response"
        denominator, turned = unit_of("orddenom", "ref"), turned != (direction["ref"] < 0)
        unit = f"({unit})/({denominator})" if unit and denominator else unit
    yield RawChannel(f"{abscissa} {where}", np.asarray(function["x"], dtype=float), step, abscissa)
    if turned:
        notes.append(f"{name}: sign turned, as its directions say")
    yield RawChannel(name, -values if turned else values, unit, role)


def _uff_system(file: File, units: dict[str, Any] | None) -> tuple[str, str] | None:
    """Return length and force units of data set 164, once its code and factors agree."""
    system = None if units is None else _SYSTEMS.get(int(units["units_code"]))
    for name, unit in zip(("length", "force"), system or (), strict=False):
        assert units is not None  # it has told the system
        stated, expected = float(units[name]), 1.0 / parse_unit(unit).factor
        if not 0.999 < stated / expected < 1.001:
            raise DataError(
                f"{file.name}: data set 164 contradicts itself: units code "
                f"{int(units['units_code'])} means {unit}, a {name} factor of {expected:.6g}, but "
                f"the file says {stated:.6g}"
            )
    return system


def merged_axes(channels: list[RawChannel]) -> list[RawChannel]:
    """Merge the axes of all functions into one where they are the same."""
    axes = [c for c in channels if c.role in ("time", "frequency")]
    if not axes:
        return channels
    first = axes[0]
    if any(c.role != first.role or not np.array_equal(c.values, first.values) for c in axes):
        return channels
    others = [c for c in channels if c.role not in ("time", "frequency")]
    return [RawChannel(str(first.role), first.values, first.unit, first.role), *others]


def read_tdms(file: File) -> RawFile:
    """Return the channels of a TDMS file; evenly sampled ones get a time channel."""
    nptdms = library("nptdms", "tdms")
    stream: Any = io.BytesIO(file.content) if file.content is not None else None
    if stream is None:
        assert file.path is not None  # either the bytes or their place is known
        stream = _Bounded(io.FileIO(file.path))
    with _damage_named(file):
        content = nptdms.TdmsFile.open(stream)
        weakref.finalize(content, stream.close)  # open as long as a channel waits to be read
        starts = [t for g in content.groups() for c in g.channels() if (t := _start(c)) is not None]
        first = min(starts, default=None)
        channels = [
            c for group in content.groups() for c in _tdms_channels(file, content, group, first)
        ]
        begun = _begun_again(file)
    doubts = []
    if sum(c.role == "time" for c in channels) > 1 and len(set(starts)) > 1:
        late = (max(starts) - min(starts)) / np.timedelta64(1, "s")
        doubts.append(
            f"the channels start at different times, up to {late:.4g} s apart (wf_start_time); "
            "each has a time of its own"
        )
    if begun:
        doubts.append(
            f"segments {listed([str(i) for i in begun], 5)} of the file state wf_increment again, "
            "as a file that was appended does; time goes on as if no pause were between them. "
            "Split the file where it holds several runs"
        )
    return file.source("TDMS", channels, row_name=lambda i: f"sample {i}", doubts=tuple(doubts))


class _Bounded(io.BufferedReader):
    """A file of which no more is read than there is, for which memory would be set aside."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = os.fstat(self.fileno()).st_size - self.tell()
        return super().read(left if size is None or size < 0 else min(size, left))


def _begun_again(file: File) -> list[int]:
    """Return the numbers of later segments that state the sampling of a waveform again."""
    again, number = [], 0
    with file.opened() as stream:
        while lead := stream.read(_LEAD_IN.size):
            if len(lead) < _LEAD_IN.size or not lead.startswith(b"TDSm"):
                raise DataError(
                    f"{file.name}: the TDMS file is damaged: bytes behind segment {number}, from "
                    f"byte {stream.tell() - len(lead)} on, belong to none; were some added?"
                )
            _, _, _, following, metadata = _LEAD_IN.unpack(lead)
            number += 1
            if following > _LONGEST_SEGMENT:
                break
            start = stream.tell()
            if number > 1 and b"wf_increment" in stream.read(min(metadata, _LONGEST_METADATA)):
                again.append(number)
            stream.seek(start + following)
    return again


@contextlib.contextmanager
def _damage_named(file: File) -> Iterator[None]:
    """Turn the warnings in the library's log into errors of this package."""
    log, said = logging.getLogger("nptdms"), logging.handlers.BufferingHandler(1 << 20)
    said.setLevel(logging.WARNING)
    names = [n for n in logging.root.manager.loggerDict if n.startswith("nptdms.")]
    parts = [logging.getLogger(n) for n in names]
    kept = [part.handlers for part in parts]
    for part in parts:
        part.handlers = []  # each writes to the terminal on its own
    log.handlers, log.propagate = [said], False
    try:
        yield
    finally:
        log.handlers, log.propagate = [], True
        for part, handlers in zip(parts, kept, strict=True):
            part.handlers = handlers
    if said.buffer:
        raise DataError(f"{file.name}: the TDMS file is damaged: {said.buffer[0].getMessage()}")


def _start(channel: Any) -> Any:
    """Return when a waveform began; None where the file does not say."""
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
        file.refuse_above_limit(8 * count, channel.path)
        read = functools.partial(_tdms_values, file, content, channel)
        what = f"{file.name}: {channel.path}"
        values: Any = Stored((count,), np.dtype(channel.dtype), read, what)
        if values.dtype.kind not in "fiubc":
            values = words(map(str, values.array))
        yield labelled_channel(f"{group.name}/", channel.name, values, unit)
        step = float(properties.get("wf_increment", 0.0))
        if step > 0.0:
            start, begun = float(properties.get("wf_start_offset", 0.0)), _start(channel)
            if begun is not None:  # to a hundredth of a step: clocks of modules differ by less
                start += step * round(float((begun - first) / np.timedelta64(1, "s")) / step, 2)
            even = functools.partial(_even_times, start, step, count)
            times[start, step, count] = Stored((count,), np.dtype(np.float64), even, what)
    for i, time in enumerate(times.values()):
        name = "time" if len(times) == 1 else f"time {i + 1}"
        yield RawChannel(f"{group.name}/{name}", time, "s", "time", name)


def _tdms_values(file: File, content: Any, channel: Any, rows: slice) -> NDArray[Any]:
    """Return some values of a channel, whose file is open as long as `content` lives."""
    assert content is not None
    with _damage_named(file):
        values = np.asarray(channel[rows])
    if values.size != len(range(*rows.indices(len(channel)))):
        raise DataError(f"{file.name}: {channel.path} ends before its last sample")
    return values


def _even_times(start: float, step: float, count: int, rows: slice) -> NDArray[Any]:
    first, stop, stride = rows.indices(count)
    return np.asarray(start + step * np.arange(first, stop, stride))


def labelled_channel(prefix: str, label: str, values: Any, unit: str | None) -> RawChannel:
    """Return a channel; many loggers write its unit into the label, as in ``Force (N)``."""
    name, in_label = (label, unit) if unit else split_header(label)
    return RawChannel(prefix + name, values, in_label, short=name)


def evenly_timed(times: Sequence[NDArray[Any]], prefix: str) -> Iterator[RawChannel]:
    """Yield the time axes of a group, equal ones once."""
    unique: list[NDArray[Any]] = []
    for time in times:
        if not any(np.array_equal(time, known) for known in unique):
            unique.append(time)
    for i, time in enumerate(unique):
        name = "time" if len(unique) == 1 else f"time {i + 1}"
        yield RawChannel(prefix + name, time, "s", "time", name)

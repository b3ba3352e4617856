"""Files of analysers and loggers: universal files 58 and 58b, NI TDMS, LabVIEW LVM."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.data.readers.file import File, library, utf8
from dahl_ident.data.source import Channel, Source, split_header
from dahl_ident.errors import DataError
from dahl_ident.units import parse_unit

_TIME_RESPONSE, _FRF = 1, 4
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
# Universal file 58, specific data type: role in a record, and its unit.
_DATA_TYPES: dict[int, tuple[str, str]] = {
    8: ("displacement", "motion"),
    11: ("velocity", "motion/s"),
    12: ("acceleration", "motion/s^2"),
    9: ("force", "load"),
    13: ("force", "load"),
}


def read_uff(file: File) -> Source:
    """Return the frequency responses and time records of a universal file.

    A negative direction of response or reference turns the sign. Units are the axis labels of
    the data set; without them those of data set 164, which gives factors to SI.
    """
    pyuff = library("pyuff", "uff")
    sets = _uff_sets(file, pyuff)
    units = _uff_system(file, next((s for s in sets if s.get("type") == 164), None))
    wanted = (_TIME_RESPONSE, _FRF)
    functions = [s for s in sets if s.get("type") == 58 and s.get("func_type") in wanted]
    if not functions:
        others = sorted({int(s["func_type"]) for s in sets if s.get("type") == 58})
        raise DataError(
            f"{file.name}: no frequency response or time record (data set 58, function type 4 or "
            f"1); the file holds data sets {sorted({int(s.get('type', 0)) for s in sets})}"
            + (f" with function types {others}" if others else "")
        )
    channels: list[Channel] = []
    notes: list[str] = []
    for function in functions:
        _check_length(file, function)
        channels += _uff_channels(function, units, notes)
    return _instrument(file, "universal file", _one_axis(channels), notes)


def _uff_sets(file: File, pyuff: Any) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        # pyuff reads by name only, and standard input has none
        path = Path(folder) / "data.uff"
        # binary data sets count bytes, so that only pure text can be brought to UTF-8
        path.write_bytes(file.data if b"58b" in file.data else utf8(file.data))
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # pyuff prints groups
                sets = pyuff.UFF(str(path)).read_sets()
        except Exception as exc:  # pyuff raises bare Exception
            raise DataError(f"{file.name}: the universal file is damaged: {exc}") from exc
    return sets if isinstance(sets, list) else [sets]


def _check_length(file: File, function: dict[str, Any]) -> None:
    found, said = len(function["data"]), int(function["num_pts"])
    if found != said:
        raise DataError(
            f"{file.name}: data set 58 ({_dof(function, 'rsp')}) holds {found} values where its "
            f"header says {said}; the file looks cut off"
        )


def _uff_channels(
    function: dict[str, Any], units: tuple[str, str] | None, notes: list[str]
) -> Iterator[Channel]:
    response, reference = _dof(function, "rsp"), _dof(function, "ref")
    values = np.asarray(function["data"])
    axis = np.asarray(function["x"], dtype=float)
    if function["func_type"] == _FRF:
        name = f"FRF {response}/{reference}"
        sign = _sign(function, "rsp") * _sign(function, "ref")
        numerator = _uff_unit(function, "ordinate", "rsp", units)
        denominator = _uff_unit(function, "orddenom", "ref", units)
        unit = f"({numerator})/({denominator})" if numerator and denominator else numerator
        yield Channel(f"frequency {response}/{reference}", axis, "Hz", "frequency")
        role: str | None = "response"
    else:
        role, _ = _DATA_TYPES.get(int(function["ordinate_spec_data_type"]), (None, ""))
        name = f"{role or 'channel'} {response}"
        sign = _sign(function, "rsp")
        unit = _uff_unit(function, "ordinate", "rsp", units)
        yield Channel(f"time {response}", axis, "s", "time")
    if sign < 0:
        notes.append(f"{name}: sign turned, as its directions say")
    yield Channel(name, sign * values, unit, role)


def _dof(function: dict[str, Any], side: str) -> str:
    """Return node and direction, such as ``1:+Z`` or ``3:-RX``."""
    direction = int(function[f"{side}_dir"])
    axes = ("", "X", "Y", "Z", "RX", "RY", "RZ")
    axis = axes[abs(direction)] if abs(direction) < len(axes) else "?"
    return f"{function[f'{side}_node']}:{'-' if direction < 0 else '+'}{axis}"


def _sign(function: dict[str, Any], side: str) -> int:
    return -1 if int(function[f"{side}_dir"]) < 0 else 1


def _uff_unit(
    function: dict[str, Any], axis: str, side: str, units: tuple[str, str] | None
) -> str | None:
    label = str(function.get(f"{axis}_axis_units_lab", "")).strip()
    if label and label.upper() != "NONE":
        return label
    kind = int(function.get(f"{axis}_spec_data_type", 0))
    if units is None or kind not in _DATA_TYPES:
        return None
    rotation = abs(int(function[f"{side}_dir"])) > 3
    length, force = units
    motion = "rad" if rotation else length
    load = f"{force}*{length}" if rotation else force
    return _DATA_TYPES[kind][1].replace("motion", motion).replace("load", load)


def _uff_system(file: File, units: dict[str, Any] | None) -> tuple[str, str] | None:
    """Return length and force units of data set 164, once its code and factors agree."""
    if units is None or int(units["units_code"]) not in _SYSTEMS:
        return None
    code = int(units["units_code"])
    system = _SYSTEMS[code]
    for name, unit in zip(("length", "force"), system, strict=True):
        stated, expected = float(units[name]), 1.0 / parse_unit(unit).factor
        if not 0.999 < stated / expected < 1.001:
            raise DataError(
                f"{file.name}: data set 164 contradicts itself: units code {code} means {unit}, "
                f"a {name} factor of {expected:.6g}, but the file says {stated:.6g}"
            )
    return system


def _one_axis(channels: list[Channel]) -> list[Channel]:
    """Merge the axes of all functions into one where they are the same."""
    axes = [c for c in channels if c.role in ("time", "frequency")]
    first = axes[0]
    if any(c.role != first.role or not np.array_equal(c.values, first.values) for c in axes):
        return channels
    others = [c for c in channels if c.role not in ("time", "frequency")]
    return [Channel(str(first.role), first.values, first.unit, first.role), *others]


def read_tdms(file: File) -> Source:
    """Return the channels of a TDMS file; evenly sampled ones get a time channel."""
    nptdms = library("nptdms", "tdms")
    try:
        content = nptdms.TdmsFile.read(io.BytesIO(file.data))
        channels = [c for group in content.groups() for c in _tdms_channels(group)]
    except Exception as exc:  # npTDMS raises errors of many kinds on damaged files
        raise DataError(f"{file.name}: the TDMS file is damaged: {exc}") from exc
    return _instrument(file, "TDMS", channels)


def _tdms_channels(group: Any) -> Iterator[Channel]:
    times = []
    for channel in group.channels():
        values = np.asarray(channel[:])
        properties = channel.properties
        unit = properties.get("unit_string") or properties.get("NI_UnitDescription")
        if values.dtype.kind not in "fiubc":
            values = values.astype(np.str_)
        yield _named(f"{group.name}/", channel.name, values, unit)
        step = float(properties.get("wf_increment", 0.0))
        if step > 0.0:
            start = float(properties.get("wf_start_offset", 0.0))
            times.append(start + step * np.arange(values.size))
    yield from _times(times, f"{group.name}/")


def _named(prefix: str, label: str, values: NDArray[Any], unit: str | None) -> Channel:
    """Return a channel; many loggers write its unit into the label, as in ``Force (N)``."""
    name, in_label = (label, unit) if unit else split_header(label)
    return Channel(prefix + name, values, in_label, short=name)


def _times(times: Sequence[NDArray[Any]], prefix: str) -> Iterator[Channel]:
    """Yield the time axes of a group, equal ones once."""
    unique: list[NDArray[Any]] = []
    for time in times:
        if not any(np.array_equal(time, known) for known in unique):
            unique.append(time)
    for i, time in enumerate(unique):
        name = "time" if len(unique) == 1 else f"time {i + 1}"
        yield Channel(prefix + name, time, "s", "time", name)


def read_lvm(file: File) -> Source:
    """Return the channels of all segments of a LabVIEW measurement file."""
    lvm_read = library("lvm_read", "lvm")
    try:
        content = lvm_read.read_str(utf8(file.data).decode("utf-8"))
        segments = [content[i] for i in range(content["Segments"])]
        channels = [
            c
            for i, segment in enumerate(segments)
            for c in _lvm_channels(segment, f"segment {i}/" if len(segments) > 1 else "")
        ]
    except Exception as exc:  # lvm_read raises errors of many kinds on damaged files
        raise DataError(f"{file.name}: the LVM file is damaged: {exc!r}") from exc
    return _instrument(file, "LVM", channels)


def _lvm_channels(segment: dict[str, Any], prefix: str) -> Iterator[Channel]:
    """Yield the channels of a segment, and time: its x columns, or counted from their step."""
    data = np.asarray(segment["data"], dtype=float)
    labels = [str(name).strip() for name in segment["Channel names"]]
    table = [pair for pair in zip(labels, data.T, strict=False) if pair[0] != "Comment"]
    channels = [pair for pair in table if pair[0] != "X_Value"]
    for i, (name, values) in enumerate(channels):
        units = segment.get("Y_Unit_Label", [])
        unit = str(units[i]).strip() if i < len(units) else ""
        yield _named(prefix, name, values, unit)
    if set(segment.get("X_Dimension", [])) - {"Time", ""}:
        return
    times = [values for name, values in table if name == "X_Value"]
    if not times:
        starts, steps = segment.get("X0", []), segment.get("Delta_X", [])
        times = [a + d * np.arange(len(data)) for a, d in zip(starts, steps, strict=False) if d > 0]
    yield from _times(times, prefix)


def _instrument(
    file: File, kind: str, channels: list[Channel], notes: list[str] | None = None
) -> Source:
    if not channels:
        raise DataError(f"{file.name}: the file holds no channels")
    return Source(
        file.name,
        kind,
        tuple(channels),
        file.sha256,
        row_name=lambda i: f"sample {i}",
        notes=tuple(notes or ()),
    )

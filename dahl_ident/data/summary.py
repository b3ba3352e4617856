"""Short descriptions of data, as text and as HTML, from the same lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.units import si_unit

if TYPE_CHECKING:
    from dahl_ident.data.frequency_response import FrequencyResponse
    from dahl_ident.data.record import Record

Lines = Sequence[tuple[str, str]]
_SHOWN = 8


def as_text(title: str, lines: Lines) -> str:
    """Return a title with one indented line for each fact."""
    width = max((len(name) for name, _ in lines), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {value}" for name, value in lines)])


def as_html(title: str, lines: Lines) -> str:
    """Return the same as a small table."""
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in lines
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def extent(values: FloatArray, unit: str) -> str:
    """Return "smallest to largest unit", or the one value."""
    low, high = float(values.min()), float(values.max())
    numbers = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    return f"{numbers} {unit}".rstrip()


def listed(items: Iterable[Any], shown: int = _SHOWN) -> str:
    """Return items separated by commas; of many, the first few and their count."""
    words = [f"{item:.6g}" if isinstance(item, float) else str(item) for item in items]
    if len(words) <= shown:
        return ", ".join(words)
    return f"{', '.join(words[:shown])}, ... ({len(words)} in all)"


def distinct(values: NDArray[Any]) -> list[Any]:
    """Return the distinct values in order of appearance, as Python objects."""
    _, first = np.unique(values, return_index=True)
    return [values[i].item() for i in np.sort(first)]


def noted(provenance: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the file, or the number of files, and what had to be assumed on reading."""
    if provenance is None:
        return []
    parts = provenance.get("parts", [provenance])
    files = distinct(np.array([str(part["file"]) for part in parts if "file" in part]))
    notes = dict.fromkeys(note for part in parts for note in part.get("notes", []))
    lines = [("from", listed(files, shown=3))] if files else []
    return lines + [("note", note) for note in notes]


def response_lines(data: FrequencyResponse) -> tuple[str, Lines]:
    """Return a title, and levels, ranges and units."""
    name = data.quantity.replace("_", " ")
    lines = [("frequency", extent(data.frequency_hz, "Hz"))]
    if data.levels:
        lines.append((f"{len(data.levels)} levels", listed(data.levels)))
    for field, kind in (("amplitude", "displacement"), ("drive", "force")):
        values = getattr(data, field)
        if values is not None:
            unit = si_unit(kind, data.motion)
            lines.append((field, f"{extent(values, unit)}, zero to peak"))
    lines += [
        ("gain", extent(data.gain, data.unit)),
        ("phase", extent(np.degrees(data.phase), "deg")),
        ("controlled", listed(distinct(data.controlled))),
    ]
    if (data.harmonic > 1).any():
        lines.append(("harmonics", listed(distinct(data.harmonic))))
    if data.covariance is None:
        lines.append(("covariance", "unknown"))
    else:
        dof = "" if data.dof is None else f", {extent(data.dof, 'degrees of freedom')}"
        lines.append(("covariance", f"known{dof}"))
    if data.quality:
        lines.append(("quality", listed(data.quality)))
    lines += noted(data.provenance)
    return f"FrequencyResponse: {data.n} points of {name}, {data.motion}", lines


def record_lines(record: Record) -> tuple[str, Lines]:
    """Return a title, and sampling, ranges and units."""
    kind = record.motion_channel
    spacing = "even" if record.uniform else "uneven"
    lines = [
        ("sampling", f"{record.sample_rate:.6g} Hz, {spacing}, {record.duration:.6g} s"),
        (kind, extent(record.motion_samples, si_unit(kind, record.motion))),
    ]
    if len(record.gaps):
        lines.insert(1, ("gaps", str(len(record.gaps))))
    if record.force is not None:
        lines.append(("force", extent(record.force, si_unit("force", record.motion))))
    if record.drive is not None:
        lines.append(("drive", extent(record.drive, record.drive_unit)))
    if record.drive_unit in ("V", "A") and record.drive_factor is not None:
        unit = f"{si_unit('force', record.motion)}/{record.drive_unit}"
        uncertain = f" within {record.drive_factor_uncertainty:.2%}"
        lines.append(("drive factor", f"{record.drive_factor:.6g} {unit}{uncertain}"))
    lines += noted(record.provenance)
    return f"Record: {record.n} samples of {kind} in {record.motion}", lines

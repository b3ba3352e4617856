"""Short descriptions of data, as text and as HTML, from the same lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray

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

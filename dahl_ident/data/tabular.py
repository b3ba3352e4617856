"""The common base of frequency responses and records: tables that print and save."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray

if TYPE_CHECKING:
    import pandas as pd

Lines = Sequence[tuple[str, str]]
ASSUMED = "assumed"
"""The note in the provenance of a table that does not state its frequency."""
_SHOWN = 8  # items that fit into a line of a message


def as_text(title: str, lines: Lines) -> str:
    """Return a title with one indented line for each fact."""
    width = max((len(name) for name, _ in lines), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {value}" for name, value in lines)])


def as_html(title: str, lines: Lines) -> str:
    """Return the same as a small table."""
    left = 'style="text-align:left"'
    rows = "".join(
        f"<tr><th {left}>{escape(name)}</th><td {left}>{escape(value)}</td></tr>"
        for name, value in lines
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def extent(values: FloatArray, unit: str) -> str:
    """Return "smallest to largest unit", or the value if all are equal."""
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
    """Return lines with the files, the warnings, and the assumptions made when reading."""
    if provenance is None:
        return []
    parts = provenance.get("parts", [provenance])
    files = list(dict.fromkeys(str(part["file"]) for part in parts if "file" in part))
    notes = dict.fromkeys(note for part in parts for note in part.get("notes", []))
    lines = [("from", listed(files, shown=3))] if files else []
    lines += [("warning", text) for text in warnings_in(provenance)]
    return lines + [("note", note) for note in notes]


def warnings_in(provenance: Mapping[str, Any] | None) -> list[str]:
    """Return the warnings shown when the data, or their sources, were read."""
    warnings: list[str] = []
    for part in _origins(provenance):
        file = f"{part['file']}: " if "file" in part else ""
        warnings += [f"{file}{text}" for text in part.get("warnings", ())]
    return list(dict.fromkeys(warnings))


def assumes_frequency(provenance: Mapping[str, Any] | None) -> bool:
    """Return whether a table, or one of its sources, does not state its frequency."""
    return any(part.get("frequency") == ASSUMED for part in _origins(provenance))


def _origins(provenance: Mapping[str, Any] | None) -> Iterator[Mapping[str, Any]]:
    """Yield the provenance of data, and of all their sources, breadth first."""
    waiting = [provenance or {}]
    while waiting:
        part = waiting.pop(0)
        yield part
        sources = (*part.get("parts", ()), part.get("origin"))
        waiting += [source for source in sources if isinstance(source, Mapping)]


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Tabular(ABC):
    """Columns of equal length that print, pickle and save themselves."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def _summary(self) -> tuple[str, Lines]:
        """Return a title and the facts beneath it."""

    @abstractmethod
    def to_frame(self) -> pd.DataFrame:
        """Return a pandas table with units in its headers."""

    @property
    def n(self) -> int:
        """Number of rows: points or samples."""
        return len(self)

    def __repr__(self) -> str:
        return as_text(*self._summary())

    def _repr_html_(self) -> str:
        return as_html(*self._summary())

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in ("quality", "provenance"):  # mapping proxies cannot be pickled
            if arguments.get(name) is not None:
                arguments[name] = dict(arguments[name])
        return partial(type(self), **arguments), ()

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write a file that the package can read again without loss.

        :func:`~dahl_ident.read_frequency_response` reads points,
        :func:`~dahl_ident.read_record` samples.

        Parameters
        ----------
        path : path
            Ending in ``.csv``, ``.csv.gz``, ``.tsv``, ``.parquet``, ``.h5`` or ``.hdf5``.
        overwrite : bool, default False
            Replace an existing file.

        Returns
        -------
        Path
            The file, complete; an interrupted run leaves none.

        Raises
        ------
        ValidationError
            If the path has another ending.
        DataError
            If the file exists, or cannot be written.

        Examples
        --------
        >>> from tempfile import mkdtemp
        >>> from dahl_ident.data import Record
        >>> record = Record([0.0, 0.1], displacement=[0.0, 1.0], force=[0.0, 2.0])
        >>> record.save(Path(mkdtemp()) / "run.parquet").name
        'run.parquet'
        """
        from dahl_ident.data.storage import save_frame

        return save_frame(self.to_frame(), path, overwrite=overwrite)

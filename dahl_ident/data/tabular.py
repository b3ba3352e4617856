"""What a frequency response and a record have in common: both are tables that can be kept."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dahl_ident.data.fields import thawed
from dahl_ident.data.summary import Lines, as_html, as_text

if TYPE_CHECKING:
    import pandas as pd


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
        arguments = thawed((f.name, getattr(self, f.name)) for f in fields(self))
        return _rebuild, (type(self), arguments)

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write a file that the package reads again, with nothing lost.

        :func:`~dahl_ident.read_frequency_response` reads points,
        :func:`~dahl_ident.read_record` samples.

        Parameters
        ----------
        path : path
            Ending in ``.csv``, ``.csv.gz``, ``.tsv``, ``.parquet``, ``.h5`` or ``.hdf5``.
        overwrite : bool, default False
            Replace a file that is there already.

        Returns
        -------
        Path
            The file, complete; an interrupted run leaves none.

        Raises
        ------
        ValidationError
            If the ending is another one.
        DataError
            If a file is there already, or the place cannot be written to.

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


def _rebuild(kind: type[Tabular], arguments: dict[str, Any]) -> Tabular:
    return kind(**arguments)

"""Rows of tables: bare columns for computation, of many tables stacked, and names for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.columns import COLUMNS
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.errors import DataError
from dahl_ident.units import Quantity, engineering, shown_unit


@dataclass(frozen=True)
class Rows:
    """Columns of shape (n,), or (tables, n) where tables are stacked; None where not given."""

    quantity: Quantity
    harmonic: NDArray[np.int64]
    forced: NDArray[np.bool_]
    omega: FloatArray
    response: ComplexArray
    amplitude: FloatArray | None
    drive: FloatArray | None
    covariance: FloatArray | None
    dof: FloatArray | None
    amplitude_std: FloatArray | None
    amplitude_covariance: FloatArray | None
    drive_std: FloatArray | None
    drive_covariance: FloatArray | None

    @property
    def n(self) -> int:
        """Number of rows of one table."""
        return int(self.response.shape[-1])

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """The harmonics that occur."""
        return tuple(np.unique(self.harmonic).tolist())

    @cached_property
    def fundamental(self) -> NDArray[np.intp]:
        """The row of each row's fundamental in its table, of several the first; -1 for none."""
        shape = self.response.shape
        none = np.zeros(())
        drive, amplitude = (none if c is None else c for c in (self.drive, self.amplitude))
        table = np.arange(self.response[..., 0].size).reshape(*shape[:-1], 1)
        held = np.where(self.forced, drive, amplitude)
        keys = [np.broadcast_to(k, shape).ravel() for k in (held, self.forced, self.omega, table)]
        order = np.lexsort(keys)
        other = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
        point = np.empty(self.response.size, dtype=np.intp)
        point[order] = np.concatenate([[0], np.cumsum(other)])
        fundamentals = np.flatnonzero(np.broadcast_to(self.harmonic == 1, shape))[::-1]
        first = np.full(point.size, -1)
        first[point[fundamentals]] = fundamentals
        row = np.where(first < 0, -1, first % self.n)[point].reshape(shape)
        first_table = row.reshape(-1, self.n)[0]
        return first_table if (row == first_table).all() else row

    def of_fundamental(self, values: FloatArray | ComplexArray) -> NDArray[Any]:
        """Return the values, (..., n), at the row of each row's fundamental."""
        row = np.broadcast_to(self.fundamental, values.shape)
        return np.take_along_axis(values, row, axis=-1)

    @property
    def of_displacement(self) -> NDArray[np.bool_]:
        """Which rows are harmonics of the displacement, under a force that is a sine, (n,)."""
        return np.asarray(self.forced & (self.harmonic != 1))

    @classmethod
    def of(cls, data: FrequencyResponse) -> Rows:
        """Return the columns of one table."""
        return cls._with({name: getattr(data, name) for name in COLUMNS}, data.quantity)

    @classmethod
    def _with(cls, columns: dict[str, Any], quantity: Quantity) -> Rows:
        return cls(
            quantity=quantity,
            forced=columns["controlled"] == "force",
            omega=2.0 * np.pi * columns["frequency_hz"],
            **{one.name: columns[one.name] for one in fields(cls) if one.name in columns},
        )

    @classmethod
    def stack(cls, tables: Sequence[FrequencyResponse]) -> Rows:
        """Return the columns of many tables of one kind of rows; shared ones have the shape (n,)."""
        first = tables[0]
        for index, table in enumerate(tables):
            if table.n != first.n or table.quantity != first.quantity:
                raise DataError(
                    f"table {index} has {table.n} rows of {table.quantity}, table 0 has "
                    f"{first.n} rows of {first.quantity}; tables estimated together must agree"
                )
        columns = {n: _stacked(tables, n) for n in COLUMNS if n not in ("level", "run")}
        for name in ("controlled", "harmonic"):
            values: Any = columns[name]
            if values.ndim > 1:
                different = (values != values[0]).any(axis=1)
                raise DataError(
                    f"table {int(np.argmax(different))} differs from table 0 in {name!r}; "
                    "tables estimated together must agree in it"
                )
        columns["response"] = np.array([table.response for table in tables])
        return cls._with(columns, first.quantity)

    def take(self, tables: NDArray[np.intp] | slice) -> Rows:
        """Return some of the stacked tables; columns that all share stay as they are."""
        return replace(self, **{name: column[tables] for name, column in self._stacked()})

    def table(self, index: int) -> Rows:
        """Return one of the stacked tables."""
        return replace(self, **{name: column[index] for name, column in self._stacked()})

    def _stacked(self) -> Iterator[tuple[str, Any]]:
        """Yield the columns in which the stacked tables differ."""
        for one in fields(self):
            column = getattr(self, one.name)
            row = COLUMNS[one.name].shape if one.name in COLUMNS else ()
            if isinstance(column, np.ndarray) and column.ndim > 1 + len(row):
                yield one.name, column

    def with_responses(self, responses: ComplexArray) -> Rows:
        """Return these rows with one set of responses for each of many tables."""
        return replace(self, response=responses)


def _stacked(tables: Sequence[FrequencyResponse], name: str) -> NDArray[Any] | None:
    """Return the column of all tables, or the one that they share; None where none has it."""
    columns = [getattr(table, name) for table in tables]
    present = [column is not None for column in columns]
    if not any(present):
        return None
    if not all(present):
        raise DataError(
            f"table {present.index(False)} has no {name}, table {present.index(True)} has; "
            "tables estimated together must agree in what they hold"
        )
    if all(column is columns[0] for column in columns):
        return np.asarray(columns[0])
    stacked = np.array(columns)
    return stacked[0] if (stacked == stacked[0]).all() else stacked


def row_names(data: FrequencyResponse, rows: Sequence[int]) -> list[str]:
    """Return the names of rows, such as "1 Hz, 0.67 mm, harmonic 3".

    Rows of one name have their number behind it.

    Examples
    --------
    >>> data = FrequencyResponse([1.0, 1.0, 2.0], [3.0, 2.0, 2.0], [6.7e-4, 6.7e-4, 2e-3])
    >>> row_names(data, [0, 2])
    ['1 Hz, 670 µm (row 0)', '2 Hz, 2 mm']
    """
    if not len(rows):
        return []
    every = [_name(data, row) for row in range(data.n)]
    count = Counter(every)
    return [f"{every[r]} (row {r})" if count[every[r]] > 1 else every[r] for r in rows]


def _name(data: FrequencyResponse, row: int) -> str:
    driven = data.drive is not None and data.controlled[row] == "force"
    size = data.drive if driven or data.amplitude is None else data.amplitude
    unit = shown_unit("N" if size is data.drive else "m", data.motion)
    parts = [f"{data.frequency_hz[row]:.4g} Hz"]
    if size is not None:
        parts.append(engineering(float(size[row]), unit))
    harmonic = int(data.harmonic[row])
    if harmonic != 1:
        parts.append(f"harmonic {harmonic}" if harmonic else "mean force")
    if data.level is not None and data.level.dtype.kind == "U":
        parts.append(f"level {data.level[row]}")
    if data.run is not None and len(data.runs or ()) > 1:
        parts.append(f"run {data.run[row]}")
    return ", ".join(parts)

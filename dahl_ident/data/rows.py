"""The bare columns of one table, or of many tables of one shape stacked, for computation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.frequency_response import FrequencyResponse
from dahl_ident.errors import DataError
from dahl_ident.units import Quantity

_OPTIONAL = (
    "amplitude", "drive", "covariance", "dof", "amplitude_std", "amplitude_covariance",
    "drive_std", "drive_covariance",
)  # fmt: skip
# of one table's column, else 1
_DIMENSIONS = {
    "covariance": 3,
    "amplitude_covariance": 2,
    "drive_covariance": 2,
}


@dataclass(frozen=True)
class Rows:
    """Columns of shape (n,), or (tables, n) where tables are stacked; None where not given.

    `harmonic` and `forced` (force-controlled) have shape (n,): stacked tables agree in them.
    """

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

    @classmethod
    def of(cls, data: FrequencyResponse) -> Rows:
        """Return the columns of one table."""
        return cls(
            quantity=data.quantity,
            harmonic=data.harmonic,
            forced=data.controlled == "force",
            omega=data.omega,
            response=data.response,
            **{name: getattr(data, name) for name in _OPTIONAL},
        )

    @classmethod
    def stack(cls, tables: Sequence[FrequencyResponse]) -> Rows:
        """Return the columns of many tables that have the same shape and kind of rows.

        A column in which all tables agree keeps the shape (n,), which saves work later.
        """
        first = tables[0]
        for index, table in enumerate(tables):
            if table.n != first.n or table.quantity != first.quantity:
                raise DataError(
                    f"table {index} has {table.n} rows of {table.quantity}, table 0 has "
                    f"{first.n} rows of {first.quantity}; tables estimated together must agree"
                )
        columns: dict[str, Any] = {}
        for name in ("controlled", "harmonic"):
            columns[name] = _stacked(tables, name)
            if columns[name].ndim > 1:
                different = (columns[name] != columns[name][0]).any(axis=1)
                raise DataError(
                    f"table {int(np.argmax(different))} differs from table 0 in {name!r}; "
                    "tables estimated together must agree in it"
                )
        frequency = _stacked(tables, "frequency_hz")
        return cls(
            quantity=first.quantity,
            harmonic=columns["harmonic"],
            forced=columns["controlled"] == "force",
            omega=2.0 * np.pi * frequency,
            response=np.array([table.response for table in tables]),
            **{name: _optional(tables, name) for name in _OPTIONAL},
        )

    def take(self, tables: NDArray[np.intp] | slice) -> Rows:
        """Return some of the stacked tables; columns that all share stay as they are."""
        columns = {name: getattr(self, name) for name in ("omega", "response", *_OPTIONAL)}
        stacked = {
            name: column[tables]
            for name, column in columns.items()
            if column is not None and column.ndim > _DIMENSIONS.get(name, 1)
        }
        return replace(self, **stacked)

    def table(self, index: int) -> Rows:
        """Return one of the stacked tables."""
        one = self.take(np.array([index]))
        columns = {name: getattr(one, name) for name in ("omega", "response", *_OPTIONAL)}
        first = {
            name: column[0]
            for name, column in columns.items()
            if column is not None and column.ndim > _DIMENSIONS.get(name, 1)
        }
        return replace(one, **first)

    def with_responses(self, responses: ComplexArray) -> Rows:
        """Return these rows with one set of responses for each of many tables."""
        return replace(self, response=responses)


def _optional(tables: Sequence[FrequencyResponse], name: str) -> NDArray[Any] | None:
    given = [getattr(table, name) is not None for table in tables]
    if not any(given):
        return None
    if not all(given):
        raise DataError(
            f"table {given.index(False)} has no {name}, table {given.index(True)} has; "
            "tables estimated together must agree in what they hold"
        )
    return _stacked(tables, name)


def _stacked(tables: Sequence[FrequencyResponse], name: str) -> NDArray[Any]:
    """Return the column of all tables, or the one that they share."""
    first = getattr(tables[0], name)
    columns = [getattr(table, name) for table in tables]
    if all(column is first for column in columns):
        return np.asarray(first)
    stacked = np.array(columns)
    return stacked[0] if (stacked == stacked[0]).all() else stacked

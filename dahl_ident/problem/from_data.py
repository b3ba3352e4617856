"""Problems from data of all kinds: a table, records, many tables of one shape."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray, IntArray
from dahl_ident.data import FrequencyResponse, Record, read_frequency_response
from dahl_ident.data.readers import is_frame
from dahl_ident.data.rows import Rows
from dahl_ident.elements import Element
from dahl_ident.elements.driven_motion import Steady
from dahl_ident.elements.element import as_model
from dahl_ident.errors import DataError, ValidationError, argument
from dahl_ident.problem.base import Problem
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.problem.space import with_changes
from dahl_ident.problem.stiffness import checked_table
from dahl_ident.problem.table_problem import TableProblem
from dahl_ident.sensors import EXACT, Sensors

if TYPE_CHECKING:
    from dahl_ident.elements.equations import Excitation
    from dahl_ident.problem.record_waves import Output


def problem_class(data: object) -> type[TableProblem] | type[RecordProblem]:
    """Return the class of the problem for some data."""
    is_table = isinstance(data, FrequencyResponse) or is_frame(data)
    return TableProblem if is_table else RecordProblem


def refuse_options(
    problem: type[Problem], options: Mapping[str, Any], function: Callable[..., Any]
) -> None:
    """Refuse options that do not apply to such data, unless they have their defaults."""
    for name in changed_options(problem.refused_options, options, function):
        raise ValidationError(
            f"{argument(name).rstrip('=')} is given with {problem.kind_in_words}: "
            f"{problem.refused_options[name]}; leave it out"
        )


def changed_options(
    names: Iterable[str], options: Mapping[str, Any], function: Callable[..., Any]
) -> list[str]:
    """Return which of the names are options with a value other than the function's default."""
    default = {name: p.default for name, p in signature(function).parameters.items()}
    return [n for n in names if n in options and not np.array_equal(options[n], default[n])]


def problem_of(
    data: Any,
    model: Element,
    *,
    free: Iterable[str] = (),
    fixed: Mapping[str, float] | None = None,
    sensors: Sensors | None = None,
    noise: str | None = None,
    steady: Steady = "exact",
    output: Output | None = None,
    excitation: Excitation = "force",
) -> Any:
    """Return the problem of a table, also as a pandas DataFrame, of one record or of several."""
    if problem_class(data) is TableProblem:
        table = data if isinstance(data, FrequencyResponse) else read_frequency_response(data)
        problem = TableProblem(
            without_copies(table),
            model,
            noise=noise,
            sensors=sensors,
            free=free,
            fixed=fixed,
            steady=steady,
        )
        if not (table.harmonic == 1).any():
            orders = ", ".join(map(str, np.unique(table.harmonic)))
            raise DataError(
                f"the table has rows of harmonic {orders} alone; expected rows of the fundamental, "
                "harmonic 1, too, with which the others are weighted: extract or add them"
            )
        return problem
    changed, sensors = with_changes(as_model(model), sensors or EXACT, free, fixed or {})
    is_one = isinstance(data, Record) or not isinstance(data, Iterable)
    return RecordProblem(
        [data] if is_one else without_copied_records(list(data)),
        changed,
        output=output,
        excitation=excitation,
        calibration=sensors.stated_uncertainties(),
    )


def without_copies(data: FrequencyResponse) -> FrequencyResponse:
    """Return a table without exact copies of other rows, which add no information.

    Its provenance states the number of copies.

    Examples
    --------
    >>> once = without_copies(FrequencyResponse([1, 1, 1], [2 + 1j, 2 + 1j, 2 + 2j], [3, 3, 3]))
    >>> once.n, once.provenance["warnings"]
    (2, ['1 of 3 rows is a copy of another, identical to the digit: copies are left out'])
    """
    run = np.zeros(data.n) if data.run is None else np.unique(data.run, return_inverse=True)[1]
    numbers = (data.frequency_hz, data.response.real, data.response.imag, data.harmonic, run)
    levels = (column for column in (data.amplitude, data.drive) if column is not None)
    first = np.unique(np.column_stack([*numbers, *levels]), axis=0, return_index=True)[1]
    if len(first) == data.n:
        return data
    is_first = np.isin(np.arange(data.n), first)
    provenance = _with_copies(data.provenance, data.n - len(first), f"{data.n} rows")
    return replace(data.select(rows=is_first), provenance=provenance)


def without_copied_records(records: list[Record]) -> list[Record]:
    """Return records without exact copies of other records, see :func:`without_copies`.

    Examples
    --------
    >>> record = Record([0.0, 0.1], displacement=[0.0, 1.0], force=[0.0, 2.0])
    >>> [once] = without_copied_records([record, record])
    >>> once.provenance["warnings"]
    ['1 of 2 records is a copy of another, identical to the digit: copies are left out']
    """
    kept: dict[Any, Record] = {}
    for record in records:
        if not isinstance(record, Record):
            return records  # the problem refuses them
        waves = record.time, record.motion_samples, record.force_samples
        kind = record.motion, record.motion_channel
        kept.setdefault((*kind, *(w.tobytes() for w in waves)), record)
    first = list(kept.values())
    if copies := len(records) - len(first):
        provenance = _with_copies(first[0].provenance, copies, f"{len(records)} records")
        first[0] = replace(first[0], provenance=provenance)
    return first


def _with_copies(provenance: Mapping[str, Any] | None, copies: int, of_all: str) -> dict[str, Any]:
    """Return a provenance that states the number of copies."""
    verb = "is a copy of another" if copies == 1 else "are copies of others"
    text = f"{copies} of {of_all} {verb}, identical to the digit: copies are left out"
    return {**(provenance or {}), "warnings": [*(provenance or {}).get("warnings", ()), text]}


class ProblemBatch(TableProblem):
    """The same estimate for S tables.

    Every method of :class:`TableProblem` takes theta of shape (S, P) and applies row s to table s.
    The tables have the same number of rows, quantity, harmonics and controlled variable.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> A = np.array([1e-4, 1e-3, 1e-2])
    >>> tables = [
    ...     FrequencyResponse(np.ones(3), Dahl(f, 30.0).describing_function(A), A)
    ...     for f in (0.1, 0.2)
    ... ]
    >>> batch = ProblemBatch(tables, Dahl())
    >>> theta = batch.to_search([[0.1, 30.0], [0.2, 30.0]])
    >>> bool(np.all(np.abs(batch.residuals(theta)) < 1e-14))
    True
    """

    def _checked(self, data: Any) -> list[FrequencyResponse]:
        if isinstance(data, FrequencyResponse):
            raise DataError("data is one table; expected a sequence of at least one table")
        if not isinstance(data, Sequence) or not data:
            fault = "empty" if isinstance(data, Sequence) else repr(data)
            raise DataError(f"data is {fault}; expected a sequence of at least one table")
        return [checked_table(table) for table in data]

    def _rows_of(self, tables: list[FrequencyResponse]) -> Rows:
        self.tables = tuple(tables)
        self._orbits = {}
        return Rows.stack(tables)

    @classmethod
    def replicates(cls, problem: TableProblem, responses: ComplexArray) -> ProblemBatch:
        """Return `problem` with each of S sets of responses, shape (S, n), as the data.

        Everything else, including the covariance, stays the same.
        """
        n = problem.n_residuals // 2
        if responses.ndim != 2 or responses.shape[1] != n:
            raise DataError(
                f"responses have shape {responses.shape}; expected (replicates, {n}), one number "
                "for each row of the data"
            )
        return problem._with_rows(cls, replace(problem._rows, response=responses))

    def take(self, tables: IntArray | slice) -> ProblemBatch:
        """Return the batch of some of the tables."""
        return self._with_rows(ProblemBatch, self._rows.take(tables))

    def table(self, index: int) -> TableProblem:
        """Return the problem of one table."""
        problem = self._with_rows(TableProblem, self._rows.take(index))
        if "tables" in self.__dict__:  # replicates have responses only
            problem.data = self.tables[index]
        return problem

    @property
    def n_tables(self) -> int:
        """The number S of tables."""
        return len(self._rows.response)

    def _shape(self, theta: FloatArray) -> tuple[int, ...]:
        return np.broadcast_shapes((*theta.shape[:-1], 1), self._rows.response.shape)

"""Many tables of one shape as one problem: fits and bootstrap replicates by the thousand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.rows import Rows
from dahl_ident.elements import Element
from dahl_ident.errors import DataError
from dahl_ident.problem.stiffness import as_response, checked_table
from dahl_ident.problem.table_problem import TableProblem
from dahl_ident.sensors import Sensors
from dahl_ident.steady_state import Steady


class ProblemBatch(TableProblem):
    """The same estimate for S tables: theta has shape (S, P), one row for each table.

    Every method of :class:`TableProblem` takes theta of shape (S, P) and applies row s to table s.

    Parameters
    ----------
    data : sequence of FrequencyResponse
        Tables with the same number of rows, quantity, harmonics and controlled variable.
    model, noise, sensors, free, fixed, steady
        As for :class:`TableProblem`.

    Raises
    ------
    DataError
        If the tables do not agree in shape, or there is none.

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

    def __init__(
        self,
        data: Sequence[FrequencyResponse],
        model: Element,
        *,
        noise: str | None = None,
        sensors: Sensors | None = None,
        free: Iterable[str] = (),
        fixed: Mapping[str, float] | None = None,
        steady: Steady = "exact",
    ) -> None:
        self.steady = steady
        if isinstance(data, FrequencyResponse) or not len(data):
            shown = "one table" if isinstance(data, FrequencyResponse) else "empty"
            raise DataError(f"data is {shown}; expected a sequence of at least one")
        tables = [checked_table(table) for table in data]
        self._set_model(model, sensors, free, fixed, tables[0].motion)
        tables = [as_response(table, self.model) for table in tables]
        self._set_rows(Rows.stack(tables), noise)
        self._check_harmonics()
        self.tables = tuple(tables)

    @classmethod
    def replicates(cls, problem: TableProblem, responses: ComplexArray) -> ProblemBatch:
        """Return `problem` with each of S sets of responses, shape (S, n), in place of its own.

        Everything else, covariance included, stays as it is.
        """
        n = problem.n_residuals // 2
        if responses.ndim != 2 or responses.shape[1] != n:
            raise DataError(
                f"responses have shape {responses.shape}; expected (replicates, {n}), one number "
                "for each row of the data"
            )
        return problem._with_rows(cls, problem._rows.with_responses(responses))

    def take(self, tables: NDArray[np.intp] | slice) -> ProblemBatch:
        """Return the batch of some of the tables."""
        return self._with_rows(ProblemBatch, self._rows.take(tables))

    def table(self, index: int) -> TableProblem:
        """Return the problem of one table."""
        problem = self._with_rows(TableProblem, self._rows.table(index))
        if "tables" in self.__dict__:  # replicates are responses alone
            problem.data = self.tables[index]
        return problem

    @property
    def n_tables(self) -> int:
        """The number S of tables."""
        return len(self._rows.response)

    def _shape(self, theta: FloatArray) -> tuple[int, ...]:
        return np.broadcast_shapes((*theta.shape[:-1], 1), self._rows.response.shape)

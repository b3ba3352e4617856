"""Fits of many tables at once: arrays of estimates, and the full result of each table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.fitting import OptimumBatch
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.result import part


@dataclass(frozen=True)
class FitBatch(Sequence[FitResult]):
    """One model fitted to each of S tables; made by :func:`dahl_ident.fit_many`.

    A sequence: ``batch[i]`` is the full result of table i.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> A = np.geomspace(1e-4, 1e-2, 9)
    >>> table = di.FrequencyResponse(np.ones(9), di.Dahl(0.1, 30.0).describing_function(A), A)
    >>> batch = di.fit_many([table, table], di.Dahl())
    >>> len(batch), batch.var_names
    (2, ['f_max', 'sigma'])
    """

    tables: tuple[FrequencyResponse, ...]
    optima: OptimumBatch

    def __len__(self) -> int:
        return len(self.tables)

    @overload
    def __getitem__(self, index: int) -> FitResult: ...

    @overload
    def __getitem__(self, index: slice) -> list[FitResult]: ...

    def __getitem__(self, index: int | slice) -> FitResult | list[FitResult]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return FitResult(self.optima[index])

    @property
    def var_names(self) -> list[str]:
        """Names of the P free parameters."""
        return list(self.optima.names)

    scale = part("optima.scale", "Standard deviation of the residuals, shape (S,).")
    status = part("optima.status", "How each search ended.")
    success = part("optima.success", "Whether each table has a finite optimum, shape (S,).")

    @cached_property
    def _params(self) -> FloatArray:
        """Value, combined uncertainty, and that from noise alone, shape (S, P, 3)."""
        return np.array(
            [
                [(f.params[n].value, f.params[n].stderr, f.stderr_noise[n]) for n in self.var_names]
                for f in self
            ],
            dtype=np.float64,
        )

    @property
    def values(self) -> FloatArray:
        """Estimates, shape (S, P): those of ``batch[i].params``.

        The error model of each table takes some 10 ms and is computed once.
        ``batch.optima.values`` are the optima of the search alone.
        """
        return np.asarray(self._params[..., 0])

    @property
    def stderr(self) -> FloatArray:
        """Combined standard uncertainties of `values`, shape (S, P).

        They are from noise alone if a table does not allow an estimate of other errors.
        """
        return np.asarray(self._params[..., 1])

    @property
    def stderr_noise(self) -> FloatArray:
        """Standard errors of `values` from noise alone, first order, shape (S, P)."""
        return np.asarray(self._params[..., 2])

    def to_frame(self) -> Any:
        """Return a pandas table: for each table a row of values and uncertainties.

        Returns
        -------
        pandas.DataFrame
        """
        import pandas as pd

        columns: dict[str, Any] = {}
        for i, name in enumerate(self.var_names):
            columns[name] = self.values[:, i]
            columns[f"{name}_stderr"] = self.stderr[:, i]
            columns[f"{name}_stderr_noise"] = self.stderr_noise[:, i]
        columns["scale"] = self.scale
        columns["status"] = [status.name for status in self.status]
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        counts = Counter(status.name.lower() for status in self.status)
        outcomes = ", ".join(f"{count} {name}" for name, count in counts.items())
        return f"<FitBatch: {len(self)} tables, free {', '.join(self.var_names)}; {outcomes}>"

"""Fits of many tables or records: arrays of estimates, and the full result of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import Status
from dahl_ident.results.fit_result import FitResult


@dataclass(frozen=True)
class FitBatch(Sequence[FitResult]):
    """One model fitted to each of S tables or records; made by :func:`dahl_ident.fit_many`.

    A sequence: ``batch[i]`` is the full result of table or record i.

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

    optima: Sequence[Optimum]
    """Those of the searches alone."""

    def __len__(self) -> int:
        return len(self.optima)

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
        return list(self.optima[0].names)

    @property
    def scale(self) -> FloatArray:
        """Standard deviation of the residuals, shape (S,)."""
        return np.array([optimum.scale for optimum in self.optima])

    @property
    def status(self) -> tuple[Status, ...]:
        """How each search ended."""
        return tuple(optimum.status for optimum in self.optima)

    @property
    def success(self) -> BoolArray:
        """Whether each has a finite optimum, shape (S,)."""
        return np.array([optimum.success for optimum in self.optima])

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
        """
        return np.asarray(self._params[..., 0])

    @property
    def stderr(self) -> FloatArray:
        """Combined standard uncertainties of `values`, shape (S, P).

        They are from noise alone where the data do not allow an estimate of other errors.
        """
        return np.asarray(self._params[..., 1])

    @property
    def stderr_noise(self) -> FloatArray:
        """Standard errors of `values` from noise alone, first order, shape (S, P)."""
        return np.asarray(self._params[..., 2])

    def to_frame(self) -> Any:
        """Return a pandas table: for each fit a row of values and uncertainties.

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
        return f"<FitBatch: {len(self)} fits, free {', '.join(self.var_names)}; {outcomes}>"

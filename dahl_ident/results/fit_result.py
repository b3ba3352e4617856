"""The results of least-squares fits, of tables and of records alike, under lmfit's names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, overload

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray
from dahl_ident.data.storage import read_text
from dahl_ident.diagnostics.confidence_levels import LEVELS
from dahl_ident.diagnostics.intervals import ConfidenceIntervals, Method
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import Status
from dahl_ident.results import fit_report, fit_storage
from dahl_ident.results.fitted_model import FittedModel

if TYPE_CHECKING:
    from dahl_ident.plots import Axes


class FitResult(FittedModel):
    """The result of a fit: estimates, their errors, and whether to trust them.

    Made by :func:`dahl_ident.fit`, from a table or from records. Names are those of lmfit's
    ``ModelResult`` for the same quantities; the covariance is never rescaled silently: `scale` is 1
    if the noise is known, otherwise it is estimated and reported. For records, the parameters of
    each record follow those of the model: states at its first sample, offset and drift.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    >>> fit.trusted, round(fit.params["f_max"].value, 3)
    (True, 0.1)
    >>> x = 1e-3 * np.cumsum(np.random.default_rng(0).standard_normal(500))
    >>> force = di.Dahl(0.1, 30.0).force(x) + 1e-3 * np.random.default_rng(1).standard_normal(500)
    >>> fit = di.fit(di.Record(np.arange(500) / 100.0, displacement=x, force=force), di.Dahl())
    >>> fit.trusted, round(fit.params["f_max"].value, 2)
    (True, 0.1)
    """

    _called = "a fit"

    def __reduce__(self) -> tuple[Any, ...]:
        text = fit_storage.to_json(self.optimum, self.first_order)
        return type(self).from_json, (text,)  # a plant's functions cannot be copied

    def fit_report(
        self, method: Method = "combined", level: float = LEVELS[1], *, details: bool = True
    ) -> str:
        """Return the report as text, the verdict first.

        Parameters
        ----------
        method : {"combined", "profile", "wald", "bootstrap"}, default "combined"
            Method of the intervals.
        level : float, default 0.9545
            Their confidence level.
        details : bool, default True
            False: verdict and the device's parameters only, in at most 15 lines.

        Returns
        -------
        str
        """
        return fit_report.fit_report(self, self._reported(method, level), details=details)

    def _repr_html_(self) -> str:
        return fit_report.as_html(self, self._reported("combined", LEVELS[1]))

    def _reported(self, method: Method, level: float) -> ConfidenceIntervals:
        if level in LEVELS:
            return self.conf_interval(method).only(level)
        return self.conf_interval(method, (level,))

    def plot(self, kind: str | None = None, ax: Any = None, *, record: int = 0) -> Any:
        """Plot the fit.

        Parameters
        ----------
        kind : str, optional
            "fit" (the default), see :meth:`plot_fit`; "residuals", see :meth:`plot_residuals`;
            "budget": shares of the uncertainty as bars; of records also "loop": force over
            displacement.
        ax : matplotlib Axes, or two of them for the "fit" of a table, optional
            Created if left out.
        record : int, default 0
            Index of the record.

        Returns
        -------
        Axes, or a tuple of Axes
        """
        from dahl_ident.results.fit_plots import draw

        return draw(self, kind, ax, record)

    def plot_fit(self, ax: Any = None, *, record: int = 0) -> Any:
        """Plot data and fit: gain and phase over amplitude or frequency, or a record over time.

        Parameters
        ----------
        ax : matplotlib Axes, or two of them for a table, optional
            Created if left out.
        record : int, default 0
            Index of the record.

        Returns
        -------
        Axes, or two of them for a table
        """
        return self.plot("fit", ax, record=record)

    def plot_residuals(
        self,
        ax: Axes | None = None,
        *,
        against: Literal["amplitude", "frequency", "velocity", "time", "displacement"]
        | None = None,
        record: int = 0,
    ) -> Axes:
        """Plot the residuals: of every row, with circles around suspicious points, or every sample.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Created if left out.
        against : str, optional
            Horizontal axis. For a table: the "amplitude" of displacement, the "frequency", or the
            amplitude of "velocity"; default: amplitude or frequency, as suits the table. For
            records: "time", the default, or "displacement".
        record : int, default 0
            Index of the record.

        Returns
        -------
        Axes
        """
        from dahl_ident.results.fit_plots import draw_residuals

        return draw_residuals(self, against, ax, record)

    # Storage

    def to_json(self) -> str:
        """Return the fit as JSON: table or records, model, noise, sensors, optimum, estimates.

        The optimum is the end of the search, with assumed exponents fixed; the estimates are
        `params`.
        """
        estimates = {
            name: {"value": p.value, "stderr": p.stderr, "unit": p.unit}
            for name, p in self.params.items()
        }
        return fit_storage.to_json(self.optimum, self.first_order, estimates)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the fit that :meth:`to_json` wrote.

        Raises
        ------
        DataError
            If the text is not such a fit, has another version of the schema, or was changed.
        ModelError
            If a law of the model is unknown.
        """
        return cls(**fit_storage.from_json(text))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the fit that :meth:`save` wrote.

        Raises
        ------
        DataError
            If the file cannot be read, is not such a fit, has another version of the schema, or was
            changed.
        ModelError
            If a law of the model is unknown.
        """
        return cls(**fit_storage.from_json(read_text(path), str(path)))

    def __str__(self) -> str:
        return self.fit_report()

    def __repr__(self) -> str:
        names = self.var_names[: self.problem.n_reported]
        estimates = ", ".join(str(self.params[name]) for name in names)
        return f"<FitResult: {estimates}; {self.optimum.status.name.lower()}>"


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

"""What fits of tables and of records have in common, under lmfit's names."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.bootstrap import bootstrap_intervals
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.confidence_levels import LEVELS, checked_levels
from dahl_ident.diagnostics.goodness import Goodness
from dahl_ident.diagnostics.intervals import (
    METHODS,
    ConfidenceIntervals,
    IntervalComparison,
    Method,
    compare,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.record_checks import RecordGoodness
from dahl_ident.diagnostics.verdicts import Verdict
from dahl_ident.elements import Model
from dahl_ident.errors import FitError, ValidationError, choices
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.results import fit_storage
from dahl_ident.results.result import Parameters, Result, part

if TYPE_CHECKING:
    import pandas as pd


class Fit(Result):
    """An optimum, its intervals and its uncertainty budget."""

    _called = "a fit"
    _schema: ClassVar[str | None] = None

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        self.optimum = optimum  #: The solver's plain result.
        #: Whether errors are of first order alone: with constraints.
        self.first_order = first_order
        self._intervals: dict[tuple[Any, ...], ConfidenceIntervals] = {}

    method: str = part("optimum.method", "The solver.")
    message: str = part("optimum.message", "How the search ended, in words.")
    scale_known: bool = part("optimum.scale_known", "Whether the noise's scale was known.")
    ndata: int = part("problem.n_numbers", "Real numbers: two a row, one that of a mean force.")
    nfree: int = part("optimum.dof", "Degrees of freedom.")
    nfev: int = part("optimum.nfev", "Evaluations of the residuals.")

    @property
    def success(self) -> bool:
        """Whether a finite optimum was found."""
        return self.optimum.success

    @property
    @abstractmethod
    def params(self) -> Parameters:
        """Every parameter by name, with combined uncertainties."""

    @property
    @abstractmethod
    def covar(self) -> FloatArray:
        """Combined covariance of the free values, by every source of error, first order."""

    @property
    @abstractmethod
    def assumed(self) -> tuple[str, ...]:
        """Names of parameters that were not given; the uncertainty counts their ranges."""

    @property
    @abstractmethod
    def model(self) -> Model:
        """The model with the estimates put in."""

    @abstractmethod
    def verdict_on(self, name: str) -> tuple[Verdict, str]:
        """Return whether the data determine a parameter, and what they say of it."""

    @property
    @abstractmethod
    def goodness(self) -> Goodness | RecordGoodness:
        """Statistics of the residuals."""

    @property
    def _estimate(self) -> Optimum:
        """The estimate, as an optimum."""
        return self.optimum

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters."""
        return list(self.optimum.problem.names)

    @cached_property
    def correl(self) -> Mapping[str, Mapping[str, float]]:
        """Correlation of each pair of free parameters, by both names."""
        std = np.sqrt(np.diagonal(self.covar))
        with np.errstate(invalid="ignore", divide="ignore"):
            matrix = self.covar / np.outer(std, std)
        names = self.var_names
        return {
            a: {b: float(matrix[i, j]) for j, b in enumerate(names) if j != i}
            for i, a in enumerate(names)
        }

    @property
    def residual(self) -> FloatArray:
        """Whitened residuals at the estimate."""
        return self._estimate.residuals

    @property
    def chisqr(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def redchi(self) -> float:
        """`chisqr` over `nfree`; the squared scale where that was estimated."""
        return self.chisqr / self.nfree if self.nfree > 0 else math.nan

    @property
    def scale(self) -> float:
        """Standard deviation of the residuals: 1 where known beforehand."""
        return self._estimate.scale

    @property
    def nvarys(self) -> int:
        """Number of free parameters."""
        return len(self.optimum.names)

    # Intervals

    def conf_interval(
        self,
        method: Method = "combined",
        levels: Sequence[float] | float = LEVELS,
        *,
        replicates: int | None = None,
        seed: int = 0,
    ) -> ConfidenceIntervals:
        """Return confidence intervals of every free parameter.

        Parameters
        ----------
        method : {"combined", "profile", "wald", "bootstrap"}, default "combined"
            "combined" counts every source of the budget, the others noise alone; see
            :mod:`dahl_ident.diagnostics.intervals`, which says what to use when.
        levels : float or sequence of float, default 0.6827, 0.9545, 0.9973
            Confidence levels.
        replicates, seed : int
            Of the bootstrap; fewer replicates of records, each of which is a search.

        Returns
        -------
        ConfidenceIntervals
            A mapping from the parameter's name to its intervals; a side on which the data set no
            limit is open. Profiles never raise, however badly a parameter is determined. Where
            the fit had constraints, "combined" gives Wald's, and says so.

        Raises
        ------
        ValidationError
            If `method` is unknown, a level is not between 0 and 1, or repetitions of a fit with
            a robust loss, or profiles or repetitions of one with constraints, are wanted.
        FitError
            If there is no optimum to repeat.
        """
        if method not in METHODS:
            raise ValidationError(
                f"method is {method!r}; expected one of {choices(METHODS, method)}"
            )
        levels = tuple(checked_levels(levels).tolist())
        key = (method, levels, replicates, seed)
        if key not in self._intervals:
            new = self._new_intervals(method, levels, replicates, seed)
            units = tuple(self.params[name].unit for name in new.names)
            self._intervals[key] = replace(new, units=units)
        return self._intervals[key]

    def intervals_run(self, level: float) -> list[ConfidenceIntervals]:
        """Return the intervals at a level of every method that has been asked for until now."""
        matching = (one for one in self._intervals.values() if np.isclose(one.levels, level).any())
        return list({one.method: one for one in matching}.values())

    def _new_intervals(
        self, method: Method, levels: Sequence[float], replicates: int | None, seed: int
    ) -> ConfidenceIntervals:
        if self.first_order:
            if method in ("profile", "bootstrap"):
                raise ValidationError(
                    f"method is {method!r}, but the fit had constraints, which profiles and "
                    "repetitions do not keep; use method='wald', whose covariance is that on the "
                    "constraints"
                )
            note = "first order, noise alone: the fit had constraints"
            return wald_intervals(self._by_noise, levels).noted(note)
        if method == "combined":
            return self._combined_intervals(levels)
        if method == "bootstrap":
            return bootstrap_intervals(self._by_noise, levels, replicates, seed)
        quick = wald_intervals if method == "wald" else profile_intervals
        return quick(self._by_noise, levels)

    @property
    def _by_noise(self) -> Optimum:
        """The optimum with the covariance of noise alone."""
        return self.optimum

    @abstractmethod
    def _combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        """Return intervals that count every source of error."""

    def compare_intervals(
        self,
        methods: Sequence[Method] = ("wald", "bootstrap", "profile"),
        levels: Sequence[float] | float = LEVELS,
    ) -> IntervalComparison:
        """Return the intervals of several methods side by side, and where they disagree.

        Parameters
        ----------
        methods : sequence of str, default ("wald", "bootstrap", "profile")
            The last is the most trusted; each of the others is compared with it.
        levels : float or sequence of float, default 0.6827, 0.9545, 0.9973
            Confidence levels.

        Returns
        -------
        IntervalComparison
            Printed, a table with the disagreements.

        Raises
        ------
        ValidationError
            If there are fewer than two methods, one is unknown, or a level is impossible.
        """
        return compare(self._by_noise, [self.conf_interval(method, levels) for method in methods])

    @cached_property
    def stated_budget(self) -> Budget | None:
        """The uncertainty budget; None where there is nothing to state."""
        try:
            return self.budget()
        except FitError:
            return None

    def summary(self) -> pd.DataFrame:
        """Return a table, one row a parameter, with its combined 95.45 % interval.

        Returns
        -------
        pandas.DataFrame
            Columns ``value, stderr, lower, upper, unit, vary, description, init_value, min, max``.
        """
        import pandas as pd

        limits = self.conf_interval().at(LEVELS[1])
        rows = {}
        for name, p in self.params.items():
            known = {"lower": limits[name].lower, "upper": limits[name].upper} if p.vary else {}
            rows[name] = {**asdict(p), **known}
        frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")
        columns = ["value", "stderr", "lower", "upper", "unit", "vary", "description"]
        return frame.reindex(columns=[*columns, "init_value", "min", "max"])

    def _reported(self, method: Method, level: float) -> ConfidenceIntervals:
        if level in LEVELS:
            return self.conf_interval(method).only(level)
        return self.conf_interval(method, (level,))

    @abstractmethod
    def fit_report(self) -> str:
        """Return the report as text, the verdict first."""

    # Storage

    def to_json(self) -> str:
        """Return the fit as JSON: table or records, model, noise, sensors and optimum."""
        return fit_storage.to_json(self.optimum, self.first_order)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the fit that :meth:`to_json` wrote.

        Raises
        ------
        DataError
            If the text holds no such fit, one of another version's schema, or was changed.
        ModelError
            If a law of the model is not known here.
        """
        optimum, first_order = fit_storage.from_json(text, cls._schema)
        return cls(optimum, first_order=first_order)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the fit that :meth:`save` wrote.

        Raises
        ------
        DataError
            If the file cannot be read, holds no such fit, one of another version's schema, or was
            changed.
        ModelError
            If a law of the model is not known here.
        """
        optimum, first_order = fit_storage.load(path, cls._schema)
        return cls(optimum, first_order=first_order)

    def __str__(self) -> str:
        return self.fit_report()

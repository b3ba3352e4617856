"""What a fit states, of which each kind of data has its way: errors, values, bands, judgement."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dahl_ident.diagnostics.bootstrap import bootstrap_intervals
from dahl_ident.diagnostics.confidence_levels import checked_levels
from dahl_ident.diagnostics.intervals import (
    METHODS,
    ConfidenceIntervals,
    Method,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.errors import ValidationError, choices
from dahl_ident.fitting import Optimum
from dahl_ident.units import shown_unit

_OF_ONE_KIND = {
    "cross_validation": "held-out tests",
    "errors_of_combinations": "errors of combinations",
    "predict_record": "prediction of a record",
    "record_at_draws": "prediction of a record",
    "residuals": "residuals sample by sample",
}
"""What one kind of data alone has, in words."""


class Assessment(ABC):
    """An optimum with what its data tell of it; a :class:`FitResult` hands all of it on.

    Attributes
    ----------
    optimum : Optimum
        The solver's result.
    first_order : bool
        Whether errors are of first order alone: with constraints.
    """

    problem: Any
    quick_methods: tuple[Method, ...] = ("wald",)
    """Of intervals: those that a report has time for, in addition to the combined ones."""
    instead: str
    """What to do where this kind of data has no answer."""

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        self.optimum, self.first_order = optimum, first_order
        self.problem = optimum.problem
        self._intervals: dict[tuple[Any, ...], ConfidenceIntervals] = {}

    def __getattr__(self, name: str) -> Any:
        if name in _OF_ONE_KIND:
            raise ValidationError(
                f"a fit of {self.problem.called} has no {_OF_ONE_KIND[name]}; {self.instead}"
            )
        raise AttributeError(name)

    @property
    def facts(self) -> dict[str, Any]:
        """What is stated for machines, apart from parameters, verdict and budget."""
        optimum = self.optimum
        return {
            "search": optimum.status.name.lower().replace("_", " "),
            "scale": self.estimate.scale,
            "scale_known": optimum.scale_known,
            "rms_misfit": self.goodness.rms_misfit,
            "aic": optimum.aic,
            "bic": optimum.bic,
        }

    @property
    def chi_square(self) -> tuple[float, int]:
        """Sum of squared residuals, and its degrees of freedom."""
        residuals = self.estimate.residuals
        return float(residuals @ residuals), self.optimum.dof

    @property
    def redchi(self) -> float:
        """Sum of squared residuals over degrees of freedom, NaN where there are none."""
        value, dof = self.chi_square
        return value / dof if dof > 0 else math.nan

    @property
    @abstractmethod
    def goodness(self) -> Any:
        """Statistics and tests of the residuals."""

    @property
    @abstractmethod
    def estimate(self) -> Optimum:
        """The estimate, as an optimum."""

    @property
    @abstractmethod
    def by_noise(self) -> Optimum:
        """The optimum with the covariance of noise alone."""

    @abstractmethod
    def combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        """Return intervals that count every source of error."""

    def intervals(
        self, method: Method, levels: Sequence[float] | float, replicates: int | None, seed: int
    ) -> ConfidenceIntervals:
        """Return confidence intervals, each kind of them made once."""
        if method not in METHODS:
            raise ValidationError(
                f"method is {method!r}; expected one of {choices(METHODS, method)}"
            )
        levels = tuple(checked_levels(levels).tolist())
        key = (method, levels, replicates, seed)
        if key not in self._intervals:
            made, problem = self._new_intervals(method, levels, replicates, seed), self.problem
            units = {p.name: shown_unit(p.unit, problem.motion) for p in problem.every_parameter}
            self._intervals[key] = replace(made, units=tuple(units[n] for n in made.names))
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
            return wald_intervals(self.by_noise, levels).noted(note)
        if method == "combined":
            return self.combined_intervals(levels)
        if method == "bootstrap":
            return bootstrap_intervals(self.by_noise, levels, replicates, seed)
        quick = wald_intervals if method == "wald" else profile_intervals
        return quick(self.by_noise, levels)

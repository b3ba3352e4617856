"""How far to trust the numbers of a fit: intervals, verdict, budget, and what follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.bands import (
    DerivedQuantity,
    ResponseBand,
    derived,
    describing_function_band,
    predicted_backbone,
    response_band,
)
from dahl_ident.diagnostics.bootstrap import REPLICATES, bootstrap_intervals
from dahl_ident.diagnostics.budget import Budget, ParameterBudget, budget
from dahl_ident.diagnostics.checks import judgement
from dahl_ident.diagnostics.confidence_levels import LEVELS, checked_levels
from dahl_ident.diagnostics.cross_validation import CrossValidation, cross_validation
from dahl_ident.diagnostics.goodness import Goodness, goodness
from dahl_ident.diagnostics.intervals import (
    METHODS,
    ConfidenceIntervals,
    IntervalComparison,
    Method,
    combined_intervals,
    compare,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.judgement import Judgement
from dahl_ident.diagnostics.verdicts import Identifiability, judged
from dahl_ident.errors import FitError, ValidationError, choices
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.results.fit_numbers import FitNumbers
from dahl_ident.units import Quantity


class JudgedFit(FitNumbers):
    """A fit's numbers with their judgement; see :class:`dahl_ident.FitResult`."""

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        super().__init__(optimum)
        self._first_order = first_order
        self._intervals: dict[tuple[Any, ...], ConfidenceIntervals] = {}

    # Judging

    def conf_interval(
        self,
        method: Method = "combined",
        levels: Sequence[float] | float = LEVELS,
        *,
        replicates: int = REPLICATES,
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
            Of the bootstrap.

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
            self._intervals[key] = self._new_intervals(method, levels, replicates, seed)
        return self._intervals[key]

    def intervals_run(self, level: float) -> list[ConfidenceIntervals]:
        """Return the intervals at a level of every method that has been asked for until now."""
        found = (one for one in self._intervals.values() if np.isclose(one.levels, level).any())
        return list({one.method: one for one in found}.values())

    def _new_intervals(
        self, method: Method, levels: Sequence[float], replicates: int, seed: int
    ) -> ConfidenceIntervals:
        if self._first_order:
            if method in ("profile", "bootstrap"):
                raise ValidationError(
                    f"method is {method!r}, but the fit had constraints, which profiles and "
                    "repetitions do not keep; use method='wald', whose covariance is that on the "
                    "constraints"
                )
            note = "first order, noise alone: the fit had constraints"
            return wald_intervals(self._optimum, levels).noted(note)
        if method == "combined":
            errors = self.errors_of_combinations
            if errors is None:
                return replace(self.conf_interval("profile", levels), method="combined")
            return combined_intervals(
                self._optimum, errors, levels, lambda: self.conf_interval("profile", levels)
            )
        if method == "bootstrap":
            return bootstrap_intervals(self._optimum, levels, replicates, seed)
        quick = wald_intervals if method == "wald" else profile_intervals
        return quick(self._optimum, levels)

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
        return compare(self._optimum, [self.conf_interval(method, levels) for method in methods])

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters, or which combinations of them, the data determine."""
        profile = None if self._first_order else lambda: self.conf_interval("profile")
        found = judged(self._optimum, profile, self.errors, self.conf_interval())
        sources: Mapping[str, ParameterBudget] = self.stated_budget or {}
        combinations = tuple(
            replace(c, value=sources[c.expression].value, stderr=sources[c.expression].u)
            if c.expression in sources
            else c
            for c in found.combinations
        )
        return replace(found, combinations=combinations)

    @cached_property
    def goodness(self) -> Goodness:
        """Whether the residuals are noise, and the estimates physically possible."""
        return goodness(self._optimum, self.errors_of_combinations)

    @cached_property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out tests against their bands; None without tests to hold out."""
        errors = self.errors_of_combinations
        return None if errors is None else cross_validation(errors)

    @cached_property
    def judgement(self) -> Judgement:
        """Every finding about the fit, and the status that follows from them."""
        return judgement(self)

    @cached_property
    def _budget(self) -> Budget:
        if self._first_order:
            raise FitError(
                "no uncertainty budget: the fit had constraints, which its sources do not keep; "
                "its standard errors are from noise alone"
            )
        return budget(self._optimum, self.errors_of_combinations)

    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded.

        Returns
        -------
        Budget
            Printed, a table: source, type A or B, standard uncertainty, degrees of freedom and
            share; then the combined and the expanded uncertainty.
        """
        return self._budget

    @cached_property
    def stated_budget(self) -> Budget | None:
        """The uncertainty budget; None where there is nothing to state."""
        try:
            return self._budget
        except FitError:
            return None

    # What follows from the estimate

    def predict(
        self,
        frequency_hz: ArrayLike,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
        noise: bool = True,
    ) -> ResponseBand:
        """Return the response that the estimate predicts, with its bands.

        Bands count every source of the budget, and what the device departs from the model.

        Parameters
        ----------
        frequency_hz : array_like, shape (n,)
            Hz.
        amplitude : array_like, shape (n,), optional
            Displacement amplitude, m or rad, where that is controlled.
        drive : array_like, shape (n,), optional
            Force amplitude, N or N m, where that is controlled. Give one of the two.
        quantity : str, optional
            One of the six standard quantities; left out, that of the data.
        noise : bool, default True
            The band holds what one more test would measure, its noise and scatter included;
            False: the device's response itself.

        Returns
        -------
        ResponseBand
            Sensors included: what would be measured. NaN where a drive has no steady amplitude.

        Raises
        ------
        ValidationError
            If both or neither of amplitude and drive are given, a value is not above zero, or
            the shapes do not go together.
        """
        errors = self.errors_of_combinations
        return response_band(
            self._optimum, frequency_hz, amplitude, drive, quantity, errors, of_a_test=noise
        )

    def backbone(self, amplitude: ArrayLike) -> FrequencyResponse:
        """Return natural frequency and damping ratio of the estimate against amplitude.

        Parameters
        ----------
        amplitude : array_like, shape (n,)
            Displacement amplitude, m or rad.

        Returns
        -------
        FrequencyResponse
            Of the quantity "backbone"; its standard deviations are those of the device's.

        Raises
        ------
        ModelError
            If the model has no mass, or no natural frequency at an amplitude.
        """
        return predicted_backbone(self._optimum, self.model, amplitude, self.errors)

    def describing_function(self, amplitude: ArrayLike) -> ResponseBand:
        """Return N(A) of the friction alone, with bands that hold the device's.

        Parameters
        ----------
        amplitude : array_like
            Displacement amplitude, m or rad.

        Returns
        -------
        ResponseBand

        Raises
        ------
        ModelError
            If the model has no friction law.
        """
        return describing_function_band(self._optimum, amplitude, self.errors)

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping, with their errors.

        Parameters
        ----------
        amplitudes : sequence of float, optional
            Where energy, stiffness and damping are wanted, m or rad.
        frequency_hz : float, optional
            For the equivalent damping; left out, there is none.

        Returns
        -------
        tuple of DerivedQuantity
        """
        return tuple(derived(self._optimum, amplitudes, frequency_hz, self.errors))

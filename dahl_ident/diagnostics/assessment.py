"""The assessment of a fit: errors, values, intervals, bands."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.bands import DerivedQuantity, derived
from dahl_ident.diagnostics.budget import Budget, ParameterBudget, budget, taken_as_exact
from dahl_ident.diagnostics.confidence_levels import LEVELS, checked_levels
from dahl_ident.diagnostics.contributions import NOISE
from dahl_ident.diagnostics.error_model import ErrorModel, error_model
from dahl_ident.diagnostics.error_sources import is_monotonic
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.goodness import Goodness, goodness
from dahl_ident.diagnostics.held_out import CrossValidation, cross_validation
from dahl_ident.diagnostics.intervals import (
    METHODS,
    ConfidenceIntervals,
    Method,
    bootstrap_intervals,
    combined_intervals,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.misfit_explanations import rms_misfit_of
from dahl_ident.diagnostics.profile import Profiler
from dahl_ident.diagnostics.record_sources import ContradictedExponent
from dahl_ident.diagnostics.verdicts import Identifiability, judged
from dahl_ident.elements import Element, Model
from dahl_ident.errors import DahlIdentError, FitError, ValidationError, choices
from dahl_ident.fitting import solve
from dahl_ident.fitting.optimum import ConstraintCost, Optimum
from dahl_ident.problem import TableProblem
from dahl_ident.units import counted, shown_unit

_SPECIFIC = {
    "cross_validation": "held-out tests",
    "effective_samples": "effective samples",
    "errors_of_combinations": "errors of combinations",
    "predict_record": "prediction of a record",
    "record_at_draws": "prediction of a record",
    "residuals": "residuals sample by sample",
}
"""Attributes that fits of one kind of data only have, in words."""
_OUTSIDE_RANGE = 2.0  # standard uncertainties beyond the end of a range
_NOISE = {
    "measured": "measured: the data's covariance, scale known",
    "relative": "relative: constant variance of (ln gain, phase)",
    "absolute": "absolute: constant variance of (real, imaginary part)",
}


class Assessment(ABC):
    """An optimum, judged with its data; the attributes are those of a ``FitResult`` as well."""

    problem: Any
    quick_methods: tuple[Method, ...] = ("wald",)  # of intervals, for reports
    alternative: str  # what to do instead of what this kind of data does not offer

    def __init__(self, optimum: Optimum, *, first_order: bool = False) -> None:
        self.optimum, self.first_order = optimum, first_order
        self.problem = optimum.problem
        self._intervals: dict[tuple[Any, ...], ConfidenceIntervals] = {}

    def __getattr__(self, name: str) -> Any:
        if name in _SPECIFIC:
            data = self.problem.kind_in_words
            raise ValidationError(f"a fit of {data} has no {_SPECIFIC[name]}; {self.alternative}")
        raise AttributeError(name)

    @property
    def facts(self) -> dict[str, Any]:
        """Plain data for JSON, apart from parameters, verdict and budget."""
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
    def constraint_cost(self) -> ConstraintCost | None:
        """The cost of constraints."""
        return self.optimum.constraint_cost

    @property
    @abstractmethod
    def goodness(self) -> Any:
        """Statistics and tests of the residuals."""

    @property
    @abstractmethod
    def estimate(self) -> Optimum:
        """The estimate, as an optimum."""

    @property
    def counts_sources(self) -> bool:
        """Whether the uncertainty counts every source of error, not noise alone."""
        return True

    @property
    @abstractmethod
    def by_noise(self) -> Optimum:
        """The optimum with the covariance of noise alone."""

    @cached_property
    def profiler(self) -> Profiler:
        """The profiles, from noise alone."""
        return Profiler(self.by_noise)

    @abstractmethod
    def combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        """Return intervals that count every source of error."""

    @property
    @abstractmethod
    def _budget(self) -> Budget:
        """The uncertainty budget of a fit without constraints."""

    def budget(self) -> Budget:
        """Return the uncertainty budget."""
        if self.first_order:
            raise FitError(
                "no uncertainty budget: the fit had constraints, which its sources do not keep; "
                "its standard errors are from noise alone"
            )
        return self._budget

    @abstractmethod
    def _hold_out(self, parts: int | None) -> Any:
        """Return the held-out tests of a fit without constraints."""

    def hold_out(self, parts: int | None) -> Any:
        """Return how well parts of the data are predicted by fits to the others."""
        if self.first_order:
            raise FitError(
                "nothing is held out: the fit had constraints, which fits to the other data would "
                "not keep; fit without constraints, or fit a part and predict the rest"
            )
        return self._hold_out(parts)

    def intervals(
        self,
        method: Method,
        levels: Sequence[float] | float = LEVELS,
        replicates: int | None = None,
        seed: int = 0,
    ) -> ConfidenceIntervals:
        """Return confidence intervals, which are computed once for the same arguments."""
        if method not in METHODS:
            raise ValidationError(
                f"method is {method!r}; expected one of {choices(METHODS, method)}"
            )
        levels = tuple(checked_levels(levels).tolist())
        key = (method, levels, replicates, seed)
        if key not in self._intervals:
            intervals = self._new_intervals(method, levels, replicates, seed)
            units = tuple(shown_unit(unit, self.problem.motion) for unit in intervals.units)
            self._intervals[key] = replace(intervals, units=units)
        return self._intervals[key]

    def computed_intervals(self, level: float) -> list[ConfidenceIntervals]:
        """Return the intervals at a level that have been computed until now, one of each method."""
        matching = (i for i in self._intervals.values() if np.isclose(i.levels, level).any())
        return list({intervals.method: intervals for intervals in matching}.values())

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
            return replace(wald_intervals(self.by_noise, levels), note=note)
        if method == "combined":
            return self.combined_intervals(levels)
        if method == "bootstrap":
            return bootstrap_intervals(self.by_noise, levels, replicates, seed)
        if method == "wald":
            return wald_intervals(self.by_noise, levels)
        return profile_intervals(self.profiler, levels)


class TableAssessment(Assessment):
    """A fit of a table, with its error model."""

    problem: TableProblem
    quick_methods = ("wald", "profile")
    alternative = "extract the table from the waveforms, or fit the record itself"

    @cached_property
    def errors(self) -> ErrorModel | None:
        """The sources of error; None where there is nothing to estimate them from."""
        return None if self.first_order else error_model(self.optimum)

    @cached_property
    def errors_of_combinations(self) -> ErrorModel | None:
        """The errors of parameters, or of combinations where only these are determined."""
        if self.first_order:
            return None
        return self.errors or error_model(self.optimum, of_combinations=True)

    @property
    def counts_sources(self) -> bool:
        """Whether the sources of error could be estimated."""
        return self.errors_of_combinations is not None

    @property
    def _errors_of_model(self) -> ErrorModel | None:
        """The errors of combinations; None if the optimum lies at infinity."""
        return None if self.optimum.status.at_infinity else self.errors_of_combinations

    @property
    def device(self) -> tuple[Optimum, ErrorModel | None, ErrorModel | None]:
        """The optimum and its errors, of parameters and of combinations, from which to predict."""
        return self.optimum, self.errors, self.errors_of_combinations

    @property
    def known(self) -> tuple[Mapping[str, float], Mapping[str, float]]:
        """Estimates and combined standard uncertainties by name, assumed parameters included."""
        optimum, errors = self.optimum, self.errors_of_combinations
        values = dict(zip(optimum.names, optimum.values.tolist(), strict=True))
        stderr = dict(optimum.stderr)
        if errors is not None:
            values |= {name: errors.estimates[name] for name in (*values, *errors.assumed)}
            lost = [name for name in values if not errors.holds(name)]
            stderr |= dict(errors.stderr) | {name: stderr.get(name, math.inf) for name in lost}
        return values, stderr

    @cached_property
    def stderr_noise(self) -> Mapping[str, float]:
        """Standard errors of the estimate from noise alone, by name."""
        stderr = dict(self.optimum.stderr)
        errors = self.errors_of_combinations
        if errors is not None:
            held = [name for name in stderr if errors.holds(name)]
            variances = np.diagonal(errors.values_covariance(held, NOISE))
            stderr |= dict(zip(held, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True))
        return stderr

    @cached_property
    def covar(self) -> FloatArray:
        """Combined covariance of the free values, first order."""
        errors = self.errors
        if errors is None:
            return self.optimum.values_covariance
        return errors.values_covariance(self.optimum.names)

    @property
    def estimate(self) -> Optimum:
        """The estimate, as an optimum; that of the search without an error model."""
        errors = self.errors_of_combinations
        return self.optimum if errors is None else errors.at_estimate

    @property
    def by_noise(self) -> Optimum:
        """The estimate as an optimum whose covariance is that of noise alone."""
        errors = self.errors_of_combinations
        return self.optimum if errors is None else errors.by_noise

    @property
    def success(self) -> bool:
        """Whether a finite optimum was found."""
        return self.optimum.success

    @cached_property
    def model(self) -> Model:
        """The model with the estimates put in; parameters stay free or fixed as they were."""
        model, optimum = self.problem.model, self.optimum
        values = self.problem.to_values(optimum.theta).tolist()
        estimates = dict(zip(optimum.names, values, strict=True))
        if self._errors_of_model is not None:
            estimates = dict(self._errors_of_model.values)
        known = (p for p in model.parameters if p.name in estimates)
        return model.with_values({p.name: p.nearest(estimates[p.name]) for p in known})

    def combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        """Return intervals that count every source of error."""
        errors = self.errors_of_combinations
        if errors is None:
            return replace(self.intervals("profile", levels), method="combined")
        return combined_intervals(
            self.optimum,
            errors,
            levels,
            lambda doubtful: profile_intervals(self.profiler, levels, doubtful),
        )

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters, or which combinations of them, the data determine."""
        profile = None if self.first_order else lambda: self.intervals("profile")
        try:
            sources: Mapping[str, ParameterBudget] = self.budget()
        except FitError:
            sources = {}
        return judged(self.by_noise, profile, self.errors, self.intervals("combined"), sources)

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of parameters that were not given; the uncertainty counts their ranges."""
        errors = self.errors_of_combinations
        return () if errors is None else errors.assumed

    @cached_property
    def goodness(self) -> Goodness:
        """Tests whether residuals are consistent with noise, and estimates physically possible."""
        return goodness(self.optimum, self.errors_of_combinations)

    @property
    def chi_square(self) -> tuple[float, int]:
        """Chi-square of the goodness of fit where it applies, else the sum of squares."""
        known = [test.values for test in self.goodness.of("chi-square")]
        return (known[0]["value"], known[0]["dof"]) if known else super().chi_square

    @cached_property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out tests against their bands; None without tests to hold out."""
        errors = self.errors_of_combinations
        return None if errors is None else cross_validation(errors.left_out)

    def _hold_out(self, parts: int | None) -> CrossValidation:
        check = self.cross_validation
        if check is None:
            raise FitError("the table has too few tests to leave one out; measure more levels")
        return check

    @cached_property
    def reduced(self) -> TableAssessment | None:
        """The fit to the fundamentals alone, or without a stated covariance that they contradict.

        None where neither applies.
        """
        problem = self.problem
        first = problem.data.harmonic == 1
        if self.first_order or not first.any():
            return None
        try:
            if not first.all():
                problem = problem.like(data=problem.data.select(rows=first))
            elif problem.scale_known and self.goodness.objections:
                problem = problem.like(noise="relative")
            else:
                return None
            return TableAssessment(solve(problem, loss=self.optimum.loss))
        except DahlIdentError:
            return None

    @cached_property
    def is_determined(self) -> bool:
        """Whether the data determine every parameter and can test the model."""
        optimum, goodness = self.optimum, self.goodness
        tested = optimum.success and optimum.dof > 0 and goodness.judged and not goodness.sign
        return tested and self.identifiability.complete

    @property
    def contradicted_exponents(self) -> Iterator[ContradictedExponent]:
        """The assumed exponents whose estimates are outside their range."""
        errors = self.errors
        parameters = () if errors is None else errors.problem.parameters
        for p in parameters:
            if errors is None or p.name not in errors.problem.ranges:
                continue
            low, high = p.prior or (0.0, np.inf)
            value, u = errors.values[p.name], errors.stderr[p.name]
            if max(low - value, value - high) > _OUTSIDE_RANGE * u:
                yield ContradictedExponent(p.name, value, value, u, (low, high))

    @property
    def significant_misfit(self) -> tuple[float, float] | None:
        """The rms misfit within runs, and in all; None where it is consistent with noise."""
        rows = self.problem.stiffness_data.harmonic == 1
        if not (self.goodness.objections and self.is_determined and rows.any()):
            return None
        misfit = within = self.goodness.rms_misfit
        if self.errors is not None:  # differences between runs are not part of the misfit
            within = min(misfit, rms_misfit_of(self.errors.problem, self.errors.within_runs))
        return within, misfit

    def force_share(self, element: Element, value: float) -> float:
        """Return the rms stiffness of an element of one parameter over that of the whole."""
        view = self.problem.stiffness_data
        rows = view.harmonic == 1
        part = view.stiffness_of(element, [np.asarray(value)])[rows] / view.stiffness[rows]
        return float(np.sqrt(np.mean(np.abs(part) ** 2)))

    @property
    def runs(self) -> int:
        """Number of runs; passes over the levels are runs where they scatter."""
        errors = self.errors_of_combinations
        return len((self.problem if errors is None else errors.problem).data.runs or ())

    def design(self, *, counted: bool) -> dict[str, Any]:
        """Return the assumptions about runs and drift, with all sources of error or noise alone."""
        data = self.problem.data
        runs = self.runs if counted else len(data.runs or ())
        passes = runs * (data.run is None)
        return {"single_run": runs < 2, "passes": passes, "no_drift": is_monotonic(data)}

    @cached_property
    def _budget(self) -> Budget:
        return budget(self.optimum, self.errors_of_combinations)

    def derived(
        self, amplitudes: Sequence[float], frequency_hz: float | None
    ) -> Iterator[DerivedQuantity]:
        """Yield x_c, energy per cycle, equivalent stiffness and damping."""
        return derived(self.optimum, amplitudes, frequency_hz, self._errors_of_model)

    @property
    def facts(self) -> dict[str, Any]:
        """Plain data for JSON, see ``Assessment``."""
        suspicious = [str(point) for point in self.goodness.suspicious]
        return super().facts | {
            "noise": self.problem.noise,
            "suspicious": suspicious,
            "redchi": self.redchi,
        }

    @property
    def exact(self) -> tuple[str, ...]:
        """Calibrations without a stated uncertainty."""
        return taken_as_exact(self.optimum)

    @property
    def noise_in_words(self) -> list[str]:
        """How residuals were weighted."""
        optimum, problem, dof = self.optimum, self.problem, self.optimum.dof
        lines = [_NOISE[problem.noise]]
        if not optimum.scale_known:
            scale = self.estimate.scale
            error = scale / math.sqrt(2.0 * dof) if dof > 0 else None
            size = with_unit(scale, error, problem.data.unit * (problem.noise == "absolute"))
            source = f"estimated with {counted(dof, 'degree of freedom')}"
            if optimum.is_exact:
                source = "the limit of rounding; the residuals are smaller"
            lines.append(f"scale {size}, {source}")
        for name, prior in problem.priors.items():
            lines.append(f"prior of {name}: {float(prior.mean()):g} ± {float(prior.std()):g}")
        return lines

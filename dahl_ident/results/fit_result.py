"""The result of a least-squares fit to a frequency response, under lmfit's names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.bands import (
    DerivedQuantity,
    ResponseBand,
    derived,
    describing_function_band,
    predicted_backbone,
    response_band,
)
from dahl_ident.diagnostics.budget import Budget, ParameterBudget, budget
from dahl_ident.diagnostics.checks import judgement
from dahl_ident.diagnostics.confidence_levels import LEVELS
from dahl_ident.diagnostics.error_model import ErrorModel, error_model
from dahl_ident.diagnostics.error_sources import NOISE
from dahl_ident.diagnostics.goodness import Goodness, goodness
from dahl_ident.diagnostics.held_out import CrossValidation, cross_validation
from dahl_ident.diagnostics.intervals import (
    ConfidenceIntervals,
    Method,
    combined_intervals,
)
from dahl_ident.diagnostics.judgement import Judgement
from dahl_ident.diagnostics.verdicts import Identifiability, Verdict, judged
from dahl_ident.elements import Model
from dahl_ident.errors import DahlIdentError, FitError, ValidationError
from dahl_ident.fitting import solve
from dahl_ident.fitting.optimum import DeterminedCombination, Optimum, propagated
from dahl_ident.problem import Problem
from dahl_ident.results import fit_report
from dahl_ident.results.fit_base import Fit
from dahl_ident.results.fit_storage import TABLE
from dahl_ident.results.result import Parameters, part
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    from dahl_ident.plots import Axes


class FitResult(Fit):
    """The result of a fit: estimates, their errors, and whether to trust them.

    Made by :func:`dahl_ident.fit`. Names follow lmfit's ``ModelResult`` where both have the same
    thing; the covariance is never rescaled silently: `scale` is 1 where the noise is known, else
    estimated and reported.

    Examples
    --------
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    >>> fit.trusted, round(fit.params["f_max"].value, 3)
    (True, 0.1)
    """

    _schema = TABLE
    problem: Problem = part("optimum.problem", "Data, model, noise, sensors as fitted.")
    data: FrequencyResponse = part("problem.data", "The data that were fitted.")
    noise: str = part("problem.noise", "The noise model.")
    combinations: tuple[DeterminedCombination, ...] = part(
        "optimum.combinations", "What the data determine where single parameters run away."
    )
    log_likelihood: float = part(
        "optimum.log_likelihood",
        "Log-density of the data at the optimum, at the likeliest scale where unknown; with a "
        "robust loss rho, that of the density proportional to exp(-rho/2).",
    )
    aic: float = part(
        "optimum.aic",
        "Akaike's criterion, -2 ln L + 2 k; k counts an estimated noise scale, and no parameter "
        "whose optimum lies at infinity.",
    )
    bic: float = part("optimum.bic", "Schwarz's criterion, -2 ln L + k ln(ndata); k as for `aic`.")

    @cached_property
    def errors(self) -> ErrorModel | None:
        """The sources of error; None where there is nothing to estimate them from."""
        return None if self.first_order else error_model(self.optimum)

    @cached_property
    def errors_of_combinations(self) -> ErrorModel | None:
        """The same; also where only combinations of parameters are determined, for these alone."""
        if self.first_order:
            return None
        return self.errors or error_model(self.optimum, of_combinations=True)

    @cached_property
    def params(self) -> Parameters:
        """Every parameter of model and sensors, by name, with combined uncertainties.

        Assumed exponents have their estimates, so that all of them together are a model.
        """
        values = dict(zip(self.var_names, self.optimum.values.tolist(), strict=True))
        stderr = dict(self.optimum.stderr)
        errors = self.errors_of_combinations
        if errors is not None:
            known = [name for name in (*values, *errors.assumed) if errors.holds(name)]
            values |= {name: errors.values[name] for name in known}
            stderr |= {name: errors.stderr[name] for name in known}
        return Parameters.of(self.problem, values, stderr)

    @cached_property
    def stderr_noise(self) -> Mapping[str, float]:
        """Standard errors of the estimate from noise alone, by name."""
        stderr = dict(self.optimum.stderr)
        errors = self.errors_of_combinations
        if errors is not None:
            size = np.abs(errors.problem.value_slopes(errors.theta))
            noise = size * np.sqrt(np.maximum(np.diagonal(errors.contributions[NOISE]), 0.0))
            by_name = dict(zip(errors.names, noise.tolist(), strict=True))
            stderr |= {name: by_name[name] for name in stderr if errors.holds(name)}
        return stderr

    @cached_property
    def covar(self) -> FloatArray:
        """Combined covariance of the free values, by every source of error, first order."""
        errors = self.errors
        if errors is None:
            return self.optimum.values_covariance
        free = [errors.names.index(name) for name in self.var_names]
        slopes = errors.problem.value_slopes(errors.theta)
        whole = propagated(errors.covariance, slopes)
        return np.asarray(whole[np.ix_(free, free)])

    @cached_property
    def _estimate(self) -> Optimum:
        """The estimate, as an optimum; the search's where nothing else is estimated."""
        errors = self.errors_of_combinations
        return self.optimum if errors is None else errors.at_estimate

    @cached_property
    def best_fit(self) -> ComplexArray:
        """Predicted response at the estimate, shape (n,)."""
        predicted: ComplexArray = self._estimate.problem.predict(self._estimate.theta)
        return predicted

    @cached_property
    def model(self) -> Model:
        """The model with the estimates put in; parameters stay free or fixed as they were."""
        model = self.problem.model
        names = {p.name for p in model.parameters}
        values = self.problem.to_values(self.optimum.theta).tolist()
        estimates = dict(zip(self.var_names, values, strict=True))
        if self.errors is not None:
            estimates = dict(self.errors.values)
        return model.with_values({name: v for name, v in estimates.items() if name in names})

    # Judging

    def _combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        errors = self.errors_of_combinations
        if errors is None:
            return replace(self.conf_interval("profile", levels), method="combined")
        return combined_intervals(
            self.optimum, errors, levels, lambda: self.conf_interval("profile", levels)
        )

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters, or which combinations of them, the data determine."""
        profile = None if self.first_order else lambda: self.conf_interval("profile")
        verdicts = judged(self.optimum, profile, self.errors, self.conf_interval())
        sources: Mapping[str, ParameterBudget] = self.stated_budget or {}
        combinations = tuple(
            replace(c, value=sources[c.expression].value, stderr=sources[c.expression].u)
            if c.expression in sources
            else c
            for c in verdicts.combinations
        )
        return replace(verdicts, combinations=combinations)

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of parameters that were not given; the uncertainty counts their ranges."""
        return () if self.errors is None else tuple(self.errors.assumed)

    def verdict_on(self, name: str) -> tuple[Verdict, str]:
        """Return whether the data determine a parameter, and what they say of it."""
        known = self.identifiability.parameters[name]
        return known.verdict, known.reason

    @property
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where the table comes from."""
        return (self.data.provenance,)

    @cached_property
    def goodness(self) -> Goodness:
        """Whether the residuals are noise, and the estimates physically possible."""
        return goodness(self.optimum, self.errors_of_combinations)

    @cached_property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out tests against their bands; None without tests to hold out."""
        errors = self.errors_of_combinations
        return None if errors is None else cross_validation(errors.left_out)

    @cached_property
    def fundamentals(self) -> FitResult | None:
        """The same fit to the fundamentals alone; None where there are no other harmonics."""
        first = self.data.harmonic == 1
        if first.all() or not first.any() or self.first_order:
            return None
        try:
            problem = self.problem.like(data=self.data.select(rows=first))
            return FitResult(solve(problem, loss=self.optimum.loss))
        except DahlIdentError:
            return None

    @cached_property
    def judgement(self) -> Judgement:
        """Every finding about the fit, and the status that follows from them."""
        return judgement(self)

    @cached_property
    def _budget(self) -> Budget:
        if self.first_order:
            raise FitError(
                "no uncertainty budget: the fit had constraints, which its sources do not keep; "
                "its standard errors are from noise alone"
            )
        return budget(self.optimum, self.errors_of_combinations)

    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded.

        Returns
        -------
        Budget
            Printed, a table: source, type A or B, standard uncertainty, degrees of freedom and
            share; then the combined and the expanded uncertainty.
        """
        return self._budget

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
            self.optimum, frequency_hz, amplitude, drive, quantity, errors, of_a_test=noise
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
        return predicted_backbone(self.optimum, self.model, amplitude, self.errors)

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
        return describing_function_band(self.optimum, amplitude, self.errors)

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
        return tuple(derived(self.optimum, amplitudes, frequency_hz, self.errors))

    def fit_report(
        self, method: Method = "combined", level: float = 0.9545, *, details: bool = True
    ) -> str:
        """Return the report as text, the verdict first.

        Parameters
        ----------
        method : {"combined", "profile", "wald", "bootstrap"}, default "combined"
            How the intervals are made.
        level : float, default 0.9545
            Their confidence level.
        details : bool, default True
            False: verdict and parameters alone, on at most 15 lines.

        Returns
        -------
        str
        """
        return fit_report.fit_report(self, self._reported(method, level), details=details)

    def _repr_html_(self) -> str:
        return fit_report.as_html(self, self._reported("combined", LEVELS[1]))

    def plot(self, kind: str | None = None, ax: Any = None) -> Any:
        """Draw the fit.

        Parameters
        ----------
        kind : {"fit", "residuals", "budget"}, optional
            "fit" (the default): data and fit, see :meth:`plot_fit`. "residuals": see
            :meth:`plot_residuals`. "budget": shares of the uncertainty as bars.
        ax : matplotlib Axes, or two of them for "fit", optional
            New ones where left out.

        Returns
        -------
        Axes, or a tuple of Axes
        """
        if kind in (None, "fit"):
            return self.plot_fit(ax)
        if kind == "residuals":
            return self.plot_residuals(ax)
        if kind == "budget":
            from dahl_ident.plots import plot_budget

            table = self.budget()
            shares = [(name, row.source, row.share) for name in table for row in table[name].rows]
            return plot_budget(shares, ax=ax)
        raise ValidationError(f"kind is {kind!r}; expected fit, residuals or budget")

    def plot_fit(self, ax: Sequence[Axes] | None = None) -> tuple[Axes, Axes]:
        """Draw data and fit, gain above phase, over amplitude or frequency.

        Parameters
        ----------
        ax : sequence of two matplotlib Axes, optional
            New ones where left out.

        Returns
        -------
        tuple of Axes
        """
        from dahl_ident.results.fit_plots import draw_fit

        return draw_fit(self, ax)

    def plot_residuals(
        self,
        ax: Axes | None = None,
        *,
        against: Literal["amplitude", "frequency", "velocity"] | None = None,
    ) -> Axes:
        """Draw the residuals of every row, suspicious points ringed.

        Parameters
        ----------
        against : {"amplitude", "frequency", "velocity"}, optional
            What to draw them over: the amplitude of displacement, the frequency, or the amplitude
            of velocity. By default amplitude or frequency, as suits the table.
        ax : matplotlib Axes, optional
            New where left out.

        Returns
        -------
        Axes
        """
        from dahl_ident.results.fit_plots import draw_residuals

        return draw_residuals(self, against, ax)

    def __repr__(self) -> str:
        estimates = ", ".join(str(self.params[name]) for name in self.var_names)
        return f"<FitResult: {estimates}; {self.optimum.status.name.lower()}>"

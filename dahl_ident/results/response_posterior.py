"""What posteriors of settled sines by chain and by importance points have in common."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import SCALE, Density
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.bands import DerivedQuantity, problem_at
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.checks import assumptions
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.errors import FitError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.posterior_base import RULE_DRAWS, Posterior
from dahl_ident.results.posterior_prediction import PredictiveBand, derived_at_draws
from dahl_ident.results.predictive_checks import PredictiveCheck, predictive_checks
from dahl_ident.results.result import Estimate, Parameters
from dahl_ident.units import Quantity

_CHECK_DRAWS = 1000  # a share of 1 % has an error of 0.3 %


class ResponsePosterior(Posterior):
    """The posterior of a frequency response."""

    _density: Density
    _fit: FitResult | None
    _uncertainty: str

    @property
    def problem(self) -> Problem:
        """Data, model, noise and sensors."""
        return self._density.problem

    @property
    def asked(self) -> Problem:
        """The problem as it was given, before exponents that were not given became parameters."""
        return self.problem if self._fit is None else self._fit.problem

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        own = [p.unit for p in self.problem.parameters]
        return (*own, *([""] * (len(self.names) - len(own))))

    @cached_property
    def checks(self) -> tuple[PredictiveCheck, ...]:
        """Posterior predictive checks of the residuals, with noise alone.

        None where the prior was sampled, or where rows share errors; the fit's tests count there.
        """
        if self.likelihood == "none" or self._counted_fit is not None:
            return ()
        draws = self._draws(_CHECK_DRAWS, 0)
        return predictive_checks(self._density, draws, np.random.default_rng(0))

    @property
    def _provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        return (self.data.provenance,)

    @property
    def _misfits(self) -> tuple[Finding, ...]:
        fit = self._counted_fit
        if fit is None:
            lost = Question.DESCRIBED, VerdictStatus.NOT_DESCRIBED
            failed = (check for check in self.checks if not check.passed)
            return tuple(Finding(*lost, "predictive_check", {"text": str(c)}) for c in failed)
        if fit.status is VerdictStatus.NOT_DETERMINED and fit.goodness.objections:
            return tuple(fit.goodness.findings())
        return super()._misfits

    @property
    def uncertainty(self) -> str:
        """What is counted: every source of the fit's budget, "combined", or "noise" alone."""
        return self._uncertainty

    @property
    def _counted_fit(self) -> FitResult | None:
        return self._fit if self._uncertainty == "combined" else None

    @property
    def _notes(self) -> tuple[Finding, ...]:
        fit, note = self._fit, (Question.ASSUMED, VerdictStatus.TRUSTED)
        if fit is None or self.likelihood == "none":
            return ()
        if self._counted_fit is not None:
            shared = self._density.errors
            names = ["noise"] if shared is None else list(shared.counted)
            free = [n for n in self.problem.names if n not in fit.problem.names]
            ranges = (f"{name} as a parameter, which was not given" for name in free)
            counted = Finding(*note, "counted", {"sources": (*names, *ranges)})
            return (counted, *assumptions(fit.optimum, fit.errors))
        if fit.errors is None:
            return tuple(assumptions(fit.optimum, None))
        std = dict(zip(self.names, self.std().tolist(), strict=True))
        u = [f"{fit.params[n].stderr:.2g} instead of {std[n]:.2g} for {n}" for n in fit.var_names]
        compared = Finding(*note, "noise_alone", {"compared": tuple(u)})
        return (compared, *assumptions(fit.optimum, None))

    @cached_property
    def params(self) -> Parameters:
        """Every parameter by name, posterior mean and standard deviation; fixed ones included."""
        values = dict(zip(self.names, self.mean().tolist(), strict=True))
        stderr = dict(zip(self.names, self.std().tolist(), strict=True))
        found = dict(Parameters.of(self.problem, values, stderr))
        if self._density.has_scale:
            at = values[SCALE], stderr[SCALE]
            found[SCALE] = Estimate(SCALE, "", "noise scale", *at, None, 0.0, math.inf, True)
        return Parameters(found)

    @property
    def data(self) -> FrequencyResponse:
        """The data."""
        return self.problem.data

    @property
    def optimum(self) -> Optimum | None:
        """The least-squares optimum from which the search started; None with too few data."""
        return None if self._fit is None else self._fit.optimum

    def budget(self) -> Budget:
        """Return the uncertainty budget of the least-squares fit to the same data and model.

        Raises
        ------
        FitError
            If there are too few data for one.
        """
        if self._fit is None:
            raise FitError("there are too few data for a least-squares fit, so there is no budget")
        return self._fit.budget()

    def predict(
        self,
        frequency_hz: ArrayLike,
        *,
        amplitude: ArrayLike | None = None,
        drive: ArrayLike | None = None,
        quantity: Quantity | None = None,
        size: int = 1000,
        seed: int = 0,
    ) -> PredictiveBand:
        """Return the response at draws from the posterior, with its bands.

        Parameters
        ----------
        frequency_hz, amplitude, drive, quantity
            As for :meth:`dahl_ident.FitResult.predict`.
        size, seed : int, default 1000 and 0
            Of the draws.

        Returns
        -------
        PredictiveBand
        """
        there = problem_at(self.problem, frequency_hz, amplitude, drive, quantity)
        return PredictiveBand(there.predict(self._theta(size, seed)))

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping: means and deviations.

        Parameters
        ----------
        amplitudes, frequency_hz
            As for :meth:`dahl_ident.FitResult.derived`.

        Returns
        -------
        tuple of DerivedQuantity
        """
        theta = self._theta(RULE_DRAWS, 0)
        return tuple(derived_at_draws(self.problem, theta, amplitudes, frequency_hz))

    def _theta(self, size: int, seed: int) -> FloatArray:
        """Return draws of the model's search coordinates, (size, P)."""
        return self._density.split(self._draws(size, seed))[0]

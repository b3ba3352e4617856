"""What posteriors of settled sines by chain and by quadrature have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import Density
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.bands import DerivedQuantity, problem_at
from dahl_ident.diagnostics.budget import Budget, budget
from dahl_ident.errors import FitError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem
from dahl_ident.results.fit_numbers import estimates
from dahl_ident.results.posterior_base import RULE_DRAWS, Posterior
from dahl_ident.results.posterior_prediction import PredictiveBand, derived_at_draws
from dahl_ident.results.predictive_checks import PredictiveCheck, predictive_checks
from dahl_ident.results.result import Estimate
from dahl_ident.units import Quantity

_CHECK_DRAWS = 1000  # a share of 1 % has an error of 0.3 %


class ResponsePosterior(Posterior):
    """The posterior of a frequency response."""

    _density: Density
    _optimum: Optimum | None

    @property
    def problem(self) -> Problem:
        """Data, model, noise and sensors."""
        return self._density.problem

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        own = [p.unit for p in self.problem.parameters]
        return (*own, *([""] * (len(self.names) - len(own))))

    @cached_property
    def checks(self) -> tuple[PredictiveCheck, ...]:
        """Posterior predictive checks of the residuals; none where the prior was sampled."""
        if self.likelihood == "none":
            return ()
        draws = self._draws(_CHECK_DRAWS, 0)
        return predictive_checks(self._density, draws, np.random.default_rng(0))

    @property
    def _provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        return (self.data.provenance,)

    @property
    def _misfits(self) -> tuple[str, ...]:
        return tuple(str(check) for check in self.checks if not check.passed)

    @cached_property
    def params(self) -> Mapping[str, Estimate]:
        """Every parameter by name, posterior mean and standard deviation; fixed ones included."""
        own = len(self.problem.names)
        values = dict(zip(self.names, self.mean().tolist(), strict=True))
        stderr = dict(zip(self.names, self.std().tolist(), strict=True))
        found = estimates(self.problem, values, stderr)
        scale = {name: Estimate.of_scale(values[name], stderr[name]) for name in self.names[own:]}
        return MappingProxyType(found | scale)

    @property
    def data(self) -> FrequencyResponse:
        """The data."""
        return self.problem.data

    @property
    def optimum(self) -> Optimum | None:
        """The least-squares optimum from which the search started; None with too few data."""
        return self._optimum

    def budget(self) -> Budget:
        """Return the uncertainty budget of the least-squares fit to the same data and model.

        Raises
        ------
        FitError
            If there are too few data for one.
        """
        if self._optimum is None:
            raise FitError("there are too few data for a least-squares fit, so there is no budget")
        return budget(self._optimum)

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

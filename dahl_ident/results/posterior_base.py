"""What posteriors by chain and by quadrature have in common."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from importlib.metadata import version
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.priors import PriorLike
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.storage import plain_data
from dahl_ident.diagnostics.bands import DerivedQuantity, problem_at
from dahl_ident.diagnostics.budget import Budget, budget
from dahl_ident.diagnostics.verdict_status import VerdictStatus
from dahl_ident.errors import FitError, ValidationError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem
from dahl_ident.results.fit_numbers import Estimate, estimates
from dahl_ident.results.posterior_prediction import PredictiveBand, derived_at_draws
from dahl_ident.results.predictive_checks import PredictiveCheck, predictive_checks
from dahl_ident.results.prior_influence import PriorInfluence, prior_influences
from dahl_ident.results.result import Result
from dahl_ident.units import Quantity

if TYPE_CHECKING:
    import pandas as pd


SCHEMA = "dahl_ident.posterior"

_RULE_DRAWS = 4000
_CHECK_DRAWS = 1000
_HOW = ("seed", "steps", "warm_up", "log_evidence", "error", "evaluations")
QUANTILES = {"2.5%": 0.025, "16%": 0.16, "median": 0.5, "84%": 0.84, "97.5%": 0.975}


class Posterior(Result):
    """Parameters, priors and draws of one posterior density."""

    _called = "a posterior"
    _density: Density
    _optimum: Optimum | None

    @property
    def problem(self) -> Problem:
        """Data, model, noise and sensors."""
        return self._density.problem

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, the model's first, an unknown noise scale last."""
        return self._density.names

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        own = [p.unit for p in self.problem.parameters]
        return (*own, *([""] * (len(self.names) - len(own))))

    @property
    def likelihood(self) -> str:
        """How rows count: "gaussian", "student_t" or "none"."""
        return self._density.likelihood

    @property
    def priors(self) -> Mapping[str, str]:
        """Every prior in words."""
        return self._density.priors

    @property
    def given_priors(self) -> Mapping[str, PriorLike]:
        """The priors that were given, as they were given; the others follow the data's size."""
        parts = self._density.prior.priors
        return {part.parameter.name: part.given for part in parts if part.source == "given"}

    @property
    @abstractmethod
    def converged(self) -> bool:
        """Whether the numbers can be used."""

    @property
    @abstractmethod
    def message(self) -> str:
        """Whether the numbers can be used, and what is missing if not."""

    @cached_property
    def prior_influences(self) -> tuple[PriorInfluence, ...]:
        """The parameters that the prior determines rather than the data, or against them."""
        if self.likelihood == "none":
            return ()
        return prior_influences(self._density.prior, self._draws(_RULE_DRAWS, 0))

    @cached_property
    def checks(self) -> tuple[PredictiveCheck, ...]:
        """Posterior predictive checks of the residuals; none where the prior was sampled."""
        if self.likelihood == "none":
            return ()
        draws = self._draws(_CHECK_DRAWS, 0)
        return predictive_checks(self._density, draws, np.random.default_rng(0))

    @property
    def statements(self) -> tuple[str, ...]:
        """The verdict sentence by sentence: the first says whether to trust, the others why."""
        if not self._objections:
            return (f"Trusted. {self.message}",)
        first, *others = self._objections
        return (f"{self.status.capitalize()}. {first}", *others)

    @property
    def status(self) -> VerdictStatus:
        """Not determined where it has not converged; not described where data or prior object."""
        if not self.converged:
            return VerdictStatus.NOT_DETERMINED
        return VerdictStatus.NOT_DESCRIBED if self._objections else VerdictStatus.TRUSTED

    @property
    def _objections(self) -> tuple[str, ...]:
        unfinished = () if self.converged else (self.message,)
        against = (str(rule) for rule in self.prior_influences if rule.contradicted)
        return (*unfinished, *against, *self._misfits)

    @property
    def findings(self) -> tuple[str, ...]:
        """What the prior determines, and what does not fit."""
        return (*map(str, self.prior_influences), *self._misfits)

    @property
    def _misfits(self) -> tuple[str, ...]:
        return tuple(str(check) for check in self.checks if not check.passed)

    def draws(self, size: int, seed: int = 0) -> FloatArray:
        """Return values drawn from the posterior, shape (size, number of parameters)."""
        return self._density.to_values(self._draws(whole_number(size, "size", 1), seed))

    @abstractmethod
    def _draws(self, size: int, seed: int) -> FloatArray:
        """Return the coordinates of draws."""

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
    def var_names(self) -> list[str]:
        """Names of the free parameters, an unknown noise scale last."""
        return list(self.names)

    @abstractmethod
    def mean(self) -> FloatArray:
        """Return the means of the parameters, in the order of `names`."""

    @abstractmethod
    def std(self) -> FloatArray:
        """Return the standard deviations of the parameters, in the order of `names`."""

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
        theta = self._theta(_RULE_DRAWS, 0)
        return tuple(derived_at_draws(self.problem, theta, amplitudes, frequency_hz))

    def function(self, of: Callable[..., Any], name: str = "function") -> Mapping[str, float]:
        """Return mean, std and quantiles of a function of the parameters.

        Parameters
        ----------
        of : callable
            Takes arrays of values by parameter name, such as
            ``lambda f_max, sigma, **_: f_max / sigma``.
        name : str, default "function"
            For messages.

        Returns
        -------
        dict of str to float
            ``mean, std, 2.5%, 16%, median, 84%, 97.5%``.
        """
        values, weights = self._weighted()
        found = np.asarray(of(**dict(zip(self.names, values.T, strict=False))))
        if found.shape != weights.shape:
            raise ValidationError(
                f"{name} has shape {found.shape}; expected one number a draw, {weights.shape}"
            )
        mean = float(weights @ found)
        moments = {"mean": mean, "std": float(np.sqrt(weights @ (found - mean) ** 2))}
        order = np.argsort(found)
        below = np.cumsum(weights[order]) - 0.5 * weights[order]
        quantiles = np.interp(list(QUANTILES.values()), below, found[order]).tolist()
        return moments | dict(zip(QUANTILES, quantiles, strict=True))

    @abstractmethod
    def _weighted(self) -> tuple[FloatArray, FloatArray]:
        """Return values, (N, at most D), and weights, (N,), which sum to 1."""

    def _theta(self, size: int, seed: int) -> FloatArray:
        """Return draws of the model's search coordinates, (size, P)."""
        return self._density.split(self._draws(size, seed))[0]

    _PLOTS: ClassVar[tuple[str, ...]] = ("corner",)

    def plot(self, kind: str | None = None, ax: Any = None) -> Any:
        """Draw the posterior.

        Parameters
        ----------
        kind : {"corner", "trace"}, optional
            "corner" (the default): the density of each parameter and of each pair. "trace": the
            walkers' paths, for a chain.
        ax : axes, optional
            As the function of this name in :mod:`dahl_ident.plots` takes them.

        Returns
        -------
        ndarray of Axes
        """
        kind = self._PLOTS[0] if kind is None else kind
        if kind not in self._PLOTS:
            raise ValidationError(f"kind is {kind!r}; expected one of {', '.join(self._PLOTS)}")
        return getattr(self, f"plot_{kind}")(ax=ax)

    def plot_corner(self, **options: Any) -> NDArray[Any]:
        """Draw marginals and pairs; options as :func:`dahl_ident.plots.plot_corner`."""
        from dahl_ident.plots import plot_corner

        draws = self.draws(_RULE_DRAWS)
        return plot_corner(self._labels, draws, log=self._density.logarithmic, **options)

    @property
    def _labels(self) -> list[str]:
        pairs = zip(self.names, self.units, strict=True)
        return [f"{name} ({unit})" if unit else name for name, unit in pairs]

    def to_dict(self) -> dict[str, Any]:
        """Return verdict, numbers and priors as plain data; draws are not included."""
        found = {
            "schema": SCHEMA,
            "schema_version": 1,
            "dahl_ident_version": version("dahl_ident"),
            "status": str(self.status),
            "trusted": self.trusted,
            "statements": list(self.statements),
            "converged": self.converged,
            "message": self.message,
            "likelihood": self.likelihood,
            "priors": dict(self.priors),
            "set_by_prior": [rule.name for rule in self.prior_influences],
            "findings": list(self.findings),
            "summary": self.summary().to_dict(orient="index"),
        }
        return found | {name: getattr(self, name) for name in _HOW if hasattr(self, name)}

    def to_json(self) -> str:
        """Return :meth:`to_dict` as JSON text."""
        return json.dumps(plain_data(self.to_dict(), not_finite=str), allow_nan=False, indent=1)

    @abstractmethod
    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: moments and quantiles."""

    def __str__(self) -> str:
        table = self.summary().to_string(float_format=lambda v: f"{v:.5g}")
        priors = [f"  {name}: {text}" for name, text in self.priors.items()]
        serious = [text for text in self._objections if text != self.message]
        others = [text for text in self.findings if text not in serious]
        return "\n".join([self.message, *serious, "", table, *others, "", "Priors:", *priors])

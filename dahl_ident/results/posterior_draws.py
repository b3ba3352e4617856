"""The draws of a posterior: moments, quantiles, densities, and the Markov chain."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    FloatArray,
    array_between,
    finite_array,
    positive_array,
    whole_number,
)
from dahl_ident.bayes.chain import Convergence
from dahl_ident.bayes.density import SCALE, LogDensity
from dahl_ident.bayes.importance import WeightedDraws
from dahl_ident.bayes.priors import PriorLike
from dahl_ident.bayes.sample import ChainSample, PointSample, Sample
from dahl_ident.data import FrequencyResponse
from dahl_ident.errors import ModelError, ValidationError, choices
from dahl_ident.fitting import Optimum
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.result import Estimate, Parameters, Result, part

if TYPE_CHECKING:
    import pandas as pd

_TAIL_END = 1e-6  # probability beyond which there are too few draws for a quantile
_QUANTILES = {"2.3%": 0.02275, "16%": 0.16, "median": 0.5, "84%": 0.84, "97.7%": 0.97725}
_LEVELS = np.array(list(_QUANTILES.values()))


class PosteriorDraws(Result):
    """Weighted draws of a posterior density, and the numbers that follow from them."""

    def __init__(
        self,
        density: LogDensity,
        sample: Sample,
        fit: FitResult | None = None,
        uncertainty: str = "noise",
    ) -> None:
        self._density = density
        self.sample = sample  #: The weighted draws, search coordinates.
        #: The least-squares fit from which the search started; None with too few data.
        self.fit = fit
        #: What is counted: every source of the fit's budget, "combined", or "noise" alone.
        self.uncertainty = uncertainty

    problem: Any = part("_density.problem", "Data, model, noise and sensors.")
    data: FrequencyResponse = part("problem.data", "The table.")
    names: tuple[str, ...] = part(
        "_density.names", "Names of the parameters, the model's first, an unknown noise scale last."
    )
    likelihood: str = part(
        "_density.likelihood", 'How rows count: "gaussian", "student_t" or "none".'
    )
    priors: Mapping[str, str] = part("_density.priors", "Every prior in words.")
    counted: tuple[str, ...] = part("_density.counted", "The sources of error that are counted.")
    normalised: bool = part("_density.normalised", "Whether there is an evidence: not of records.")
    converged: bool = part("sample.converged", "Whether the numbers can be used.")
    message: str = part(
        "sample.message", "Whether the numbers can be used, and what is missing if not."
    )

    @property
    def var_names(self) -> list[str]:
        """Names of the free parameters, an unknown noise scale last."""
        return list(self.names)

    @property
    def given_problem(self) -> Any:
        """The problem without assumed exponents as parameters."""
        return (self.fit or self).problem

    @property
    def optimum(self) -> Optimum | None:
        """The least-squares optimum from which the search started; None with too few data."""
        return None if self.fit is None else self.fit.optimum

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        return tuple(self.params[name].unit for name in self.names)

    @property
    def default_priors(self) -> tuple[str, ...]:
        """Names of parameters whose prior follows the data's size."""
        parts = self._density.prior.priors
        return tuple(part.parameter.name for part in parts if part.source == "default")

    @property
    def given_priors(self) -> Mapping[str, PriorLike]:
        """The priors that were given, as they were given; the others follow the data's size."""
        parts = self._density.prior.priors
        return {part.parameter.name: part.prior for part in parts if part.source == "given"}

    # Numbers

    @cached_property
    def params(self) -> Parameters:
        """Every parameter by name, posterior mean and standard deviation; fixed ones included."""
        values = dict(zip(self.names, self.mean().tolist(), strict=True))
        stderr = dict(zip(self.names, self.std().tolist(), strict=True))
        every = Parameters.of(self.problem, values, stderr)
        shown = {name: every[name] for name in self.problem.device_parameters}
        if SCALE in values:
            at = values[SCALE], stderr[SCALE]
            shown[SCALE] = Estimate(SCALE, "", "noise scale", *at, None, 0.0, math.inf, True)
        return Parameters(shown)

    @cached_property
    def values(self) -> FloatArray:
        """Values of all draws that count, shape (N, D), SI units."""
        return self._density.to_values(self.sample.draws.theta)

    weights: FloatArray = part(
        "sample.draws.weights", "Probabilities of the draws, shape (N,), which sum to 1."
    )

    @property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """Weights, shape (N,), and search coordinates, (N, D), of all draws."""
        return self.weights, self.sample.draws.theta

    def mean(self) -> FloatArray:
        """Return the means of the parameters, in the order of `names`."""
        return np.asarray(self.weights @ self.values)

    def std(self) -> FloatArray:
        """Return the standard deviations of the parameters, in the order of `names`."""
        return np.asarray(np.sqrt(self.weights @ (self.values - self.mean()) ** 2))

    def quantile(self, name: str, probabilities: ArrayLike) -> FloatArray:
        """Return quantiles of one parameter.

        Parameters
        ----------
        name : str
            One of `names`.
        probabilities : float or array_like, shape (Q,)
            From 1e-6 to 1 - 1e-6.

        Returns
        -------
        ndarray, shape () or (Q,)
            In SI units.
        """
        axis = self._axis(name)
        q = np.atleast_1d(array_between(probabilities, "probabilities", _TAIL_END, 1.0 - _TAIL_END))
        theta = self.sample.draws.quantiles(axis, q)
        values = np.exp(theta) if self._density.logarithmic[axis] else theta
        return values.reshape(np.shape(probabilities))

    def marginal(self, name: str, values: ArrayLike) -> FloatArray:
        """Return the posterior density of one parameter.

        Parameters
        ----------
        name : str
            One of `names`.
        values : array_like, shape (Q,)
            In SI units; those of a positive parameter above zero.

        Returns
        -------
        ndarray, shape (Q,)
            Probability per SI unit.
        """
        axis = self._axis(name)
        logarithmic = self._density.logarithmic[axis]
        x = (positive_array if logarithmic else finite_array)(values, name)
        theta = np.log(x) if logarithmic else x
        return self.sample.draws.density(axis, theta) / (x if logarithmic else 1.0)

    def _axis(self, name: str) -> int:
        if name not in self.names:
            raise ModelError(f"there is no {name!r}; expected one of {choices(self.names, name)}")
        return self.names.index(name)

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
            ``mean, std, 2.3%, 16%, median, 84%, 97.7%``.
        """
        weights = self.weights
        values = dict(zip(self.names, self.values.T, strict=True))
        if not self.is_chain:  # in which the noise scale is integrated out
            values.pop(SCALE, None)
        x = np.asarray(of(**values))
        if x.shape != weights.shape:
            raise ValidationError(
                f"{name} has shape {x.shape}; expected one number a draw, {weights.shape}"
            )
        mean = float(weights @ x)
        quantiles = WeightedDraws(x[:, None], weights).quantiles(0, _LEVELS).tolist()
        of_levels = dict(zip(_QUANTILES, quantiles, strict=True))
        return {"mean": mean, "std": float(np.sqrt(weights @ (x - mean) ** 2)), **of_levels}

    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: moments, quantiles, and the errors of a chain.

        Returns
        -------
        pandas.DataFrame
            Columns ``mean, std, 2.3%, 16%, median, 84%, 97.7%``; of a chain ``mcse``, the Monte
            Carlo standard error of the mean, ``ess``, the effective number of draws, and
            ``r_hat``; ``unit``. ``ess`` and ``mcse`` are NaN where the chain has not converged.
        """
        import pandas as pd

        columns: dict[str, Any] = {"mean": self.mean(), "std": self.std()}
        quantiles = np.stack([self.quantile(name, _LEVELS) for name in self.names])
        columns |= dict(zip(_QUANTILES, quantiles.T, strict=True))
        columns |= self.sample.columns(columns["std"])
        columns["unit"] = list(self.units)
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    def draws(self, size: int, seed: int = 0) -> FloatArray:
        """Return values drawn from the posterior, shape (size, number of parameters)."""
        return self._density.to_values(self._drawn(size, seed))

    def _drawn(self, size: int, seed: int) -> FloatArray:
        """Return the coordinates of draws."""
        return self.sample.draws.drawn(whole_number(size, "size", 1), seed)

    def to_frame(self) -> pd.DataFrame:
        """Return all draws, with a column for each parameter; for a grid also ``weight``."""
        import pandas as pd

        frame = pd.DataFrame(self.values, columns=list(self.names))
        return frame if self.is_chain else frame.assign(weight=self.weights)

    # Importance points

    @property
    def _points(self) -> PointSample:
        if not isinstance(self.sample, PointSample):
            raise ValidationError("a chain has no evidence; use method='grid'")
        return self.sample

    log_evidence: float = part(
        "_points.log_evidence",
        "Logarithm of the data's density under model and prior; differences between models of the "
        "same data are logarithms of Bayes factors, in which the scale's prior 1/s cancels.",
    )
    error: float = part(
        "_points.integral.error",
        "Relative error of the evidence, and error of any probability, with 95 % confidence.",
    )
    evaluations: int = part(
        "_points.integral.evaluations", "Points at which the likelihood was computed."
    )

    # The chain

    @property
    def is_chain(self) -> bool:
        """Whether the draws are those of a Markov chain."""
        return isinstance(self.sample, ChainSample)

    @property
    def chain(self) -> ChainSample:
        """The Markov chain with its convergence and settings."""
        if not isinstance(self.sample, ChainSample):
            raise ValidationError("method='grid' runs no chain; use method='mcmc'")
        return self.sample

    convergence: Convergence = part("chain.convergence", "The verdict on the chain's length.")
    seed: int = part("chain.chain.seed", "With which the same chain comes out again.")
    steps: int = part("chain.chain.steps", "Total number of steps, warm-up included.")
    warm_up: int = part("convergence.discard", "Steps that numbers and pictures leave out.")

    def get_chain(self, discard: int = 0, thin: int = 1, flat: bool = False) -> FloatArray:
        """Return parameter values along the chain, in SI units.

        Parameters
        ----------
        discard : int, default 0
            Steps to leave out at the beginning; `warm_up` is the number that `summary` takes.
        thin : int, default 1
            Keep every thin-th step.
        flat : bool, default False
            Join steps and walkers.

        Returns
        -------
        ndarray, shape (steps, walkers, D) or (steps * walkers, D)
            Walkers are ordered by ensemble.
        """
        points = self.chain.chain.points
        return self._density.to_values(_thinned(points, discard, thin, flat))

    def get_log_prob(self, discard: int = 0, thin: int = 1, flat: bool = False) -> FloatArray:
        """Return the log-posterior, per unit of search coordinate, along the chain."""
        return _thinned(self.chain.chain.log_density, discard, thin, flat)

    def get_autocorr_time(self) -> FloatArray:
        """Return the integrated autocorrelation time of each parameter, in steps."""
        return self.convergence.tau


def _thinned(array: FloatArray, discard: int, thin: int, flat: bool) -> FloatArray:
    kept = array[whole_number(discard, "discard", 0) :: whole_number(thin, "thin", 1)]
    return kept.reshape(-1, *kept.shape[2:]) if flat else kept

"""The posterior of up to three parameters by weighted points, as returned to users."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray, array_between, finite_array, positive_array
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.importance import WeightedPoints
from dahl_ident.bayes.noise_scale import with_scale
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus
from dahl_ident.errors import ModelError, choices
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.posterior_base import QUANTILES
from dahl_ident.results.response_posterior import ResponsePosterior

if TYPE_CHECKING:
    import pandas as pd

_END = 1e-6  # of the probability, beyond which points are few


class GridPosterior(ResponsePosterior):
    """The posterior by importance points: the same answer at every call, with its error.

    Made by :func:`dahl_ident.posterior` with ``method="grid"``. An unknown scale of the noise
    is integrated out and shown as ``noise_scale`` all the same.

    Examples
    --------
    >>> import dahl_ident as di
    >>> grid = di.posterior(di.load_dataset("noisy"), di.Dahl(alpha=1.0), method="grid")
    >>> print(grid.message)
    Converged: error 0.0006 of the probability, 56448 points.
    >>> low, high = grid.quantile("f_max", [0.025, 0.975])
    >>> print(f"f_max from {low:.4f} to {high:.4f} N")
    f_max from 0.0993 to 0.1004 N
    """

    def __init__(
        self,
        density: Density,
        grid: WeightedPoints,
        tolerance: float,
        fit: FitResult | None = None,
        uncertainty: str = "noise",
    ) -> None:
        self._density, self._grid, self._tolerance = density, grid, tolerance
        self._fit, self._uncertainty = fit, uncertainty

    @property
    def log_evidence(self) -> float:
        """Logarithm of the data's density under model and prior.

        Differences between models of the same data are logarithms of Bayes factors; the scale's
        prior 1/s cancels there.
        """
        return self._grid.log_evidence

    @property
    def error(self) -> float:
        """Relative error of the evidence, and error of any probability, with 95 % confidence."""
        return self._grid.error

    @property
    def evaluations(self) -> int:
        """Points at which the likelihood was computed."""
        return self._grid.evaluations

    @property
    def converged(self) -> bool:
        """Whether `error` is as small as was asked for."""
        return self.error <= self._tolerance

    @property
    def message(self) -> str:
        """The error of the integral, and whether it is small enough."""
        text = f"error {self.error:.1g} of the probability, {self.evaluations} points"
        if self.converged:
            return f"Converged: {text}."
        return (
            f"NOT CONVERGED: {text}, expected {self._tolerance:.1g}. The numbers are provisional: "
            "use method='mcmc', or give narrower priors."
        )

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
        q = np.atleast_1d(array_between(probabilities, "probabilities", _END, 1.0 - _END))
        found = self._points.quantiles(axis, q)
        found = np.exp(found) if self._density.logarithmic[axis] else found
        return found.reshape(np.shape(probabilities))

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
        return self._points.density(axis, theta) / (x if logarithmic else 1.0)

    def _axis(self, name: str) -> int:
        if name not in self.names:
            raise ModelError(f"there is no {name!r}; expected one of {choices(self.names, name)}")
        return self.names.index(name)

    @cached_property
    def _points(self) -> WeightedPoints:
        """The points, an unknown noise scale included."""
        if not self._density.has_scale:
            return self._grid
        return replace(self._grid, theta=with_scale(self._density, self._grid))

    @cached_property
    def _values(self) -> FloatArray:
        return self._density.to_values(self._points.theta)

    @property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """Weights, shape (N,), which sum to 1, and search coordinates, (N, D), of all points."""
        return self._points.weights, self._points.theta

    def mean(self) -> FloatArray:
        """Return the means of the parameters, in the order of `names`."""
        return np.asarray(self._points.weights @ self._values)

    def std(self) -> FloatArray:
        """Return the standard deviations of the parameters, in the order of `names`."""
        return np.asarray(np.sqrt(self._points.weights @ (self._values - self.mean()) ** 2))

    def _weighted(self) -> tuple[FloatArray, FloatArray]:
        return self._values[:, : len(self.problem.names)], self._points.weights

    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: ``mean, std, 2.5%, 16%, median, 84%, 97.5%, unit``."""
        import pandas as pd

        levels = np.array(list(QUANTILES.values()))
        quantiles = np.stack([self.quantile(name, levels) for name in self.names])
        columns: dict[str, Any] = {"mean": self.mean(), "std": self.std()}
        columns |= dict(zip(QUANTILES, quantiles.T, strict=True))
        columns["unit"] = list(self.units)
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    def _draws(self, size: int, seed: int) -> FloatArray:
        random = np.random.default_rng(seed)
        return random.choice(self._points.theta, size=size, p=self._points.weights)

    @property
    def _notes(self) -> tuple[Finding, ...]:
        values = {"ln": self.log_evidence}
        evidence = Finding(Question.DESCRIBED, VerdictStatus.TRUSTED, "evidence", values)
        return (*super()._notes, evidence)

    def __repr__(self) -> str:
        return f"<GridPosterior: {', '.join(self.names)}; error {self.error:.1g}>"

"""Posteriors by Markov chain: the draws, and whether they can be trusted."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.bayes.chain import Chain, Settings
from dahl_ident.bayes.convergence import Convergence
from dahl_ident.bayes.density import Density
from dahl_ident.errors import SamplingError
from dahl_ident.results.arviz_export import to_arviz
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.posterior_base import QUANTILES, Posterior
from dahl_ident.results.response_posterior import ResponsePosterior

if TYPE_CHECKING:
    import pandas as pd


class ChainDraws(Posterior):
    """Draws from a posterior by Markov chain; names follow emcee where both have a thing."""

    convergence: Convergence
    _chain: Chain
    _settings: Settings

    @property
    def seed(self) -> int:
        """With which the same chain comes out again."""
        return self._settings.seed

    # The chain

    @property
    def steps(self) -> int:
        """Total number of steps, warm-up included."""
        return self._chain.steps

    @property
    def warm_up(self) -> int:
        """Steps that `summary`, draws and pictures leave out."""
        return self.convergence.discard

    @property
    def converged(self) -> bool:
        """Whether the chain is long enough to be used."""
        return self.convergence.reached

    @property
    def message(self) -> str:
        """Whether the chain has converged, and what is missing if not."""
        kept = f"{self.steps - self.warm_up} steps of {self._settings.walkers} walkers"
        if self.converged:
            return f"Converged: {kept} after {self.warm_up} of warm-up."
        return (
            f"NOT CONVERGED after {self.steps} steps: {'; '.join(self.convergence.lacks)}. The "
            "numbers are provisional: run more steps, or give narrower priors."
        )

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
        return self._density.to_values(self._thinned(self._chain.points, discard, thin, flat))

    def get_log_prob(self, discard: int = 0, thin: int = 1, flat: bool = False) -> FloatArray:
        """Return the log-posterior, per unit of search coordinate, along the chain."""
        return self._thinned(self._chain.log_density, discard, thin, flat)

    @staticmethod
    def _thinned(array: FloatArray, discard: int, thin: int, flat: bool) -> FloatArray:
        discard = whole_number(discard, "discard", 0)
        kept = array[discard :: whole_number(thin, "thin", 1)]
        return kept.reshape(-1, *kept.shape[2:]) if flat else kept

    def get_autocorr_time(self) -> FloatArray:
        """Return the integrated autocorrelation time of each parameter, in steps."""
        return self.convergence.tau

    @cached_property
    def _points(self) -> FloatArray:
        """All coordinates after warm-up, flat."""
        return self._thinned(self._chain.points, self.warm_up, 1, True)

    def _draws(self, size: int, seed: int) -> FloatArray:
        random = np.random.default_rng(seed)
        return self._points[random.integers(len(self._points), size=size)]

    # What it says

    @cached_property
    def values(self) -> FloatArray:
        """All values after warm-up, flat, shape (draws, D)."""
        return self._density.to_values(self._points)

    def summary(self) -> pd.DataFrame:
        """Return one row a parameter: median, intervals, Monte Carlo errors.

        Returns
        -------
        pandas.DataFrame
            Columns ``mean, std, 2.5%, 16%, median, 84%, 97.5%``; ``mcse``, the Monte Carlo
            standard error of the mean; ``ess``, the effective number of draws; ``r_hat``;
            ``unit``. ``ess`` and ``mcse`` are NaN where the chain has not converged.
        """
        import pandas as pd

        values = self.values
        columns: dict[str, Any] = {"mean": self.mean(), "std": self.std()}
        quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
        columns |= dict(zip(QUANTILES, quantiles, strict=True))
        ess = self.convergence.ess if self.converged else np.full(len(self.names), np.nan)
        columns |= {
            "mcse": columns["std"] / np.sqrt(ess),
            "ess": ess,
            "r_hat": self.convergence.r_hat,
            "unit": list(self.units),
        }
        return pd.DataFrame(columns, index=pd.Index(self.names, name="parameter"))

    def mean(self) -> FloatArray:
        """Return the means of the parameters, in the order of `names`."""
        return np.asarray(self.values.mean(axis=0))

    def std(self) -> FloatArray:
        """Return the standard deviations of the parameters, in the order of `names`."""
        return np.asarray(self.values.std(axis=0, ddof=1))

    def _weighted(self) -> tuple[FloatArray, FloatArray]:
        return self.values, np.full(len(self.values), 1.0 / len(self.values))

    def __repr__(self) -> str:
        verdict = "converged" if self.converged else "NOT CONVERGED"
        return f"<Posterior: {', '.join(self.names)}; {verdict}, {self.steps} steps>"

    def to_frame(self) -> pd.DataFrame:
        """Return every draw after warm-up, one column a parameter, one row a draw."""
        import pandas as pd

        return pd.DataFrame(self.values, columns=list(self.names))

    _PLOTS = ("corner", "trace")

    def plot_trace(self, **options: Any) -> NDArray[Any]:
        """Draw the walkers' paths; options as :func:`dahl_ident.plots.plot_trace`."""
        from dahl_ident.plots import plot_trace

        return plot_trace(
            self._labels,
            self.get_chain(),
            discard=self.warm_up,
            log=self._density.logarithmic,
            **options,
        )


class ChainPosterior(ChainDraws, ResponsePosterior):
    """Draws from the posterior, with the verdict on whether they can be trusted.

    Made by :func:`dahl_ident.posterior`. Names follow emcee where both have the same thing. The
    unknown scale of the noise is a parameter of its own, ``noise_scale``.

    Examples
    --------
    >>> import dahl_ident as di
    >>> chain = di.posterior(di.load_dataset("noisy"), di.Dahl(), seed=1, steps=60)
    >>> chain.names, chain.steps, chain.converged
    (('f_max', 'sigma', 'alpha'), 60, False)
    """

    def __init__(
        self,
        density: Density,
        chain: Chain,
        convergence: Convergence,
        settings: Settings,
        fit: FitResult | None = None,
        uncertainty: str = "noise",
    ) -> None:
        self._density, self._chain = density, chain
        self.convergence = convergence
        self._settings, self._fit = settings, fit
        self._uncertainty = uncertainty

    def to_arviz(self, seed: int = 0) -> Any:
        """Return the posterior for ArviZ: InferenceData below version 1.0, DataTree from there.

        Groups ``posterior``, ``prior``, ``log_likelihood``, ``observed_data`` and
        ``posterior_predictive``. Its chains are the ensembles, thinned by the autocorrelation
        time, because walkers of one ensemble are not independent.

        Parameters
        ----------
        seed : int, default 0
            Of the draws from the prior and of the replicated noise.

        Returns
        -------
        arviz.InferenceData or xarray.DataTree
            Responses are held as whitened residuals, real and imaginary part.

        Raises
        ------
        MissingDependencyError
            If ArviZ is not installed.
        """
        return to_arviz(self._density, self._chain.points, self._settings, self.convergence, seed)


Draws = TypeVar("Draws", bound=ChainDraws)


def refuse_unusable(posterior: Draws) -> Draws:
    """Return the posterior, or raise where tau is unusable; the error carries the chain."""
    if posterior.convergence.usable:
        return posterior
    stuck = [
        name
        for name, tau in zip(posterior.names, posterior.convergence.tau, strict=True)
        if not np.isfinite(tau)
    ]
    raise SamplingError(
        f"some walkers never moved in {', '.join(stuck)} over {posterior.steps} steps, so that "
        "nothing is known about the chain; it is in this error's `posterior`. Run more steps, or "
        "look for a prior or data that leave next to no room",
        posterior,
    )

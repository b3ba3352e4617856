"""The posterior from a Markov chain, as returned to users."""

from __future__ import annotations

from typing import Any

from dahl_ident.bayes.chain import Chain, Settings
from dahl_ident.bayes.convergence import Convergence
from dahl_ident.bayes.density import Density
from dahl_ident.results.arviz_export import to_arviz
from dahl_ident.results.chain_draws import ChainDraws
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.response_posterior import ResponsePosterior


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

"""A posterior in the form that ArviZ takes, for its own summaries, plots and comparisons."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.sample import ChainSample
from dahl_ident.data.storage import library
from dahl_ident.results.posterior_checks import pointwise_log_likelihood, replicated_noise

_PRIOR_DRAWS = 1000  # probabilities to 1.6 %


def to_arviz(density: Density, sample: ChainSample, seed: int) -> Any:
    """Return InferenceData or a DataTree, whichever the installed ArviZ has.

    A row's observed value is its whitened residual at the posterior mean; replicates are the
    same plus noise of the likelihood, less what parameters differ from the mean.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # ArviZ 0.23 announces 1.0 at import
        arviz = library("arviz", "arviz")
    random = np.random.default_rng(seed)
    kept = _thinned(sample)
    groups: dict[str, dict[str, Any]] = {
        "posterior": _by_name(density, density.to_values(kept)),
        "prior": _by_name(density, _prior(density, random)),
    }
    if density.likelihood != "none":
        flat = kept.reshape(-1, kept.shape[-1])
        observed, replicated = _residuals(density, flat, random)
        shape = (*kept.shape[:2], -1)
        rows = pointwise_log_likelihood(density, flat).reshape(shape)
        groups["log_likelihood"] = {"row": rows}
        groups["observed_data"] = {"real": observed.real, "imag": observed.imag}
        groups["posterior_predictive"] = {
            "real": replicated.real.reshape(shape),
            "imag": replicated.imag.reshape(shape),
        }
    if int(arviz.__version__.split(".")[0]) >= 1:
        return arviz.from_dict(groups)
    return arviz.from_dict(**groups)


def _thinned(sample: ChainSample) -> FloatArray:
    """Return coordinates by ensemble, (ensembles, draws, D), about independent."""
    ensembles, convergence = sample.settings.ensembles, sample.convergence
    thin = max(1, int(np.ceil(convergence.tau.max())))
    kept = sample.chain.points[convergence.discard :: thin]
    steps, walkers, D = kept.shape
    by_ensemble = kept.reshape(steps, ensembles, walkers // ensembles, D)
    return by_ensemble.transpose(1, 0, 2, 3).reshape(ensembles, -1, D)


def _by_name(density: Density, values: FloatArray) -> dict[str, FloatArray]:
    names = density.names[: values.shape[-1]]
    return {name: values[..., i] for i, name in enumerate(names)}


def _prior(density: Density, random: np.random.Generator) -> FloatArray:
    """Return values drawn from the prior, (1, draws, P); the scale's prior cannot be drawn."""
    theta = density.prior.draw(random, _PRIOR_DRAWS)
    return density.problem.to_values(density.problem.in_order(theta))[None]


def _residuals(
    density: Density, points: FloatArray, random: np.random.Generator
) -> tuple[ComplexArray, ComplexArray]:
    """Return whitened residuals at the posterior mean, and replicated ones at each point."""
    theta, scale = density.split(points)
    whitened = density.problem.whitened
    observed, _ = whitened(theta.mean(axis=0)[None], derivatives=False)
    at_point, _ = whitened(theta, derivatives=False)
    noise = scale[:, None] * replicated_noise(density, at_point.shape, random)
    return observed[0], observed - at_point + noise

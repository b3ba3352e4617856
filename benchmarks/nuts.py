"""An independent sampler on the same posterior: NUTS of numpyro, the model written anew in JAX.

Needs the extra ``nuts``: ``pip install 'dahl_ident[nuts]'``, then ``python -m benchmarks.nuts``.
Prints means and standard deviations of ln f_max, ln sigma and ln s beside those of
``dahl_ident.sample``, and their difference in Monte Carlo standard errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import dahl_ident as di
from benchmarks.bayes import table
from dahl_ident.arrays import FloatArray
from dahl_ident.data.readers.file import library

_BOUNDS = {"f_max": (1e-3, 10.0), "sigma": (1.0, 1000.0)}
_SCALE = (1e-6, 10.0)  # numpyro needs a proper prior; the walls are far from any probability


def nuts(data: di.FrequencyResponse, draws: int = 4000) -> tuple[FloatArray, FloatArray]:
    """Return draws of ln f_max, ln sigma, ln s, and effective numbers."""
    jax, numpyro = library("jax", "nuts"), library("numpyro", "nuts")
    uniform = library("numpyro.distributions", "nuts").Uniform
    inference, diagnostics = library("numpyro.infer"), library("numpyro.diagnostics")
    bessel = library("jax.scipy.special")
    jax.config.update("jax_enable_x64", True)
    jnp = library("jax.numpy")
    assert data.amplitude is not None
    amplitude, response = jnp.asarray(data.amplitude), jnp.asarray(data.response)

    def model() -> None:
        bounds = [*_BOUNDS.values(), _SCALE]
        x = [
            numpyro.sample(name, uniform(np.log(low), np.log(high)))
            for name, (low, high) in zip(("f", "k", "s"), bounds, strict=True)
        ]
        beta = jnp.exp(x[1] - x[0]) * amplitude
        real = 2.0 * bessel.i1e(beta) * (1.0 + jnp.tanh(beta)) / beta
        imag = 4.0 / jnp.pi * (1.0 - jnp.tanh(beta) / beta) / beta
        N = jnp.exp(x[1]) * (real + 1j * imag)
        square = jnp.sum(jnp.abs(jnp.log(response / N)) ** 2)
        likelihood = -2.0 * len(amplitude) * x[2] - 0.5 * square * jnp.exp(-2.0 * x[2])
        numpyro.factor("likelihood", likelihood)

    start = inference.init_to_value(values={"f": np.log(0.1), "k": np.log(30.0), "s": np.log(0.01)})
    kernel = inference.NUTS(model, init_strategy=start)
    mcmc = inference.MCMC(kernel, num_warmup=1000, num_samples=draws, progress_bar=False)
    mcmc.run(jax.random.PRNGKey(1))
    found = mcmc.get_samples(group_by_chain=True)
    chains = [np.asarray(found[name]) for name in ("f", "k", "s")]
    ess = np.array([float(diagnostics.effective_sample_size(chain)) for chain in chains])
    return np.stack([chain.ravel() for chain in chains], axis=1), ess


def main() -> None:
    """Print the comparison."""
    data = table()
    priors: dict[str, Any] = dict(_BOUNDS)
    posterior = di.sample(data, di.Dahl(), priors=priors, seed=1, ess=10000.0)
    ours, theirs = np.log(posterior.values), nuts(data)
    print("| | ours | NUTS | difference, Monte Carlo errors |\n|---|---|---|---|")
    rows = (("mean", np.mean, 1.0), ("std", np.std, np.sqrt(0.5)))
    for i, name in enumerate(posterior.names):
        errors = [
            ours[:, i].std() / np.sqrt(n) for n in (posterior.convergence.ess[i], theirs[1][i])
        ]
        for label, moment, factor in rows:
            a, b = moment(ours[:, i]), moment(theirs[0][:, i])
            apart = (a - b) / (factor * np.hypot(*errors))
            print(f"| {label} of ln {name} | {a:.6f} | {b:.6f} | {apart:+.1f} |")


if __name__ == "__main__":
    main()

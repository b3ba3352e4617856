"""An independent sampler on the same posterior: NUTS of numpyro, the model written anew in JAX.

Needs the extra ``nuts``. ``make nuts`` compares means and standard deviations of ln f_max, ln sigma
and ln s with those of ``dahl_ident.posterior``, in Monte Carlo standard errors, and writes
docs/validation/nuts.md.
"""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import dahl_ident as di
from benchmarks.bayes import table
from dahl_ident.arrays import FloatArray
from dahl_ident.data.storage import library

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


def compare(draws: int, ess: float) -> list[tuple[str, float, float, float]]:
    """Return moments: what, ours, theirs, and their difference in Monte Carlo errors."""
    data = table()
    priors: dict[str, Any] = dict(_BOUNDS)
    posterior = di.posterior(data, di.Dahl(), priors=priors, seed=1, ess=ess, uncertainty="noise")
    ours, (theirs, their_ess) = np.log(posterior.values), nuts(data, draws)
    rows = []
    for i, name in enumerate(posterior.names):
        numbers = posterior.convergence.ess[i], their_ess[i]
        error = np.hypot(*(ours[:, i].std() / np.sqrt(n) for n in numbers))
        for label, moment, factor in (("mean", np.mean, 1.0), ("std", np.std, np.sqrt(0.5))):
            a, b = float(moment(ours[:, i])), float(moment(theirs[:, i]))
            rows.append((f"{label} of ln {name}", a, b, float((a - b) / (factor * error))))
    return rows


def main() -> None:
    """Write the comparison."""
    lines = [
        "# An independent sampler",
        "",
        f"Made by `make nuts`, with numpyro {version('numpyro')}: the model written again in JAX",
        "and sampled by NUTS, on 30 points with 1 % noise of unknown scale. Differences are in "
        "units",
        "of the combined Monte Carlo standard error; beyond 4 the posteriors would differ.",
        "",
        "| | dahl_ident.posterior | NUTS | difference |",
        "|---|---|---|---|",
    ]
    for what, a, b, apart in compare(draws=4000, ess=10000.0):
        lines.append(f"| {what} | {a:.6f} | {b:.6f} | {apart:+.1f} |")
    text = "\n".join([*lines, ""])
    Path("docs/validation/nuts.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()

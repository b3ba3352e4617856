"""Sampling against lmfit's emcee on one 30-point problem; integration against its time limit.

Run with ``python -m benchmarks.bayes``. Both samplers see the same data, likelihood and bounds;
the effective number of draws of the slowest parameter, by the same estimate of the
autocorrelation time after the same rule for the warm-up, is divided by the time of the whole
call. Ours writes its checkpoint to disk. lmfit runs as it comes: emcee's stretch move, 100
walkers, one process.
"""

from __future__ import annotations

import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import lmfit
import numpy as np

import dahl_ident as di
from benchmarks.harness import Row, print_table, seconds
from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.chain import judge
from dahl_ident.elements import linear_dahl

TITLE = "Bayesian estimation"

_BOUNDS = {"f_max": (1e-4, 1e2), "sigma": (1e-2, 1e4)}
_LMFIT_STEPS = 600


def table(rows: int = 30, noise: float = 0.01) -> di.FrequencyResponse:
    """Return describing-function data over one decade of beta."""
    amplitude = np.geomspace(1e-3, 1e-2, rows)
    random = np.random.default_rng(0)
    error = noise * (random.normal(size=rows) + 1j * random.normal(size=rows))
    exact = di.Dahl(f_max=0.1, sigma=30.0).describing_function(amplitude)
    return di.FrequencyResponse(np.ones(rows), exact * np.exp(error), amplitude)


def with_spring() -> di.FrequencyResponse:
    """Return the same data with a spring of 30 N/m in parallel with the friction."""
    data = table()
    return replace(data, response=data.response + 30.0)


def ours(data: di.FrequencyResponse, folder: Path, seed: int, steps: int) -> float:
    """Return seconds for one effective draw, checkpoint included."""
    priors: dict[str, Any] = dict(_BOUNDS)
    began = time.perf_counter()
    posterior = di.posterior(
        data,
        di.Dahl(),
        priors=priors,
        seed=seed,
        steps=steps,
        resume=folder / f"{seed}.h5",
        uncertainty="noise",
    )
    took = time.perf_counter() - began
    return took / float(posterior.convergence.ess.min())


def lmfit_emcee(data: di.FrequencyResponse, seed: int) -> float:
    """Return seconds for one effective draw of lmfit.Minimizer.emcee."""
    amplitude = data.amplitude
    assert amplitude is not None

    # the same kernel as ours, without any object around it
    def residual(params: Any) -> FloatArray:
        values = params.valuesdict()
        sigma, per_newton = np.exp(values["ln_sigma"]), amplitude / np.exp(values["ln_f_max"])
        N = sigma * linear_dahl.describing_function(sigma * per_newton)
        return np.asarray(np.log(data.response / N).view(np.float64))

    params = lmfit.Parameters()
    for name, start in (("f_max", 0.1), ("sigma", 30.0)):
        low, high = np.log(_BOUNDS[name])
        params.add(f"ln_{name}", value=np.log(start), min=low, max=high)
    params.add("__lnsigma", value=np.log(0.01), min=np.log(1e-6), max=np.log(10.0))
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = lmfit.Minimizer(residual, params).emcee(
            steps=_LMFIT_STEPS, burn=0, nwalkers=100, is_weighted=False, progress=False, seed=seed
        )
    took = time.perf_counter() - began
    return took / float(judge(result.chain, 4, 1.0).ess.min())


def _median(once: Callable[[int], float], repeats: int) -> float:
    return statistics.median(once(seed) for seed in range(repeats))


def run() -> list[Row]:
    """Return the comparisons."""
    data = table()
    priors: dict[str, Any] = dict(_BOUNDS)
    heavy = table(rows=3, noise=0.5)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ours(data, folder, 99, 400)
        draw = _median(lambda seed: ours(data, folder, seed, 2000), 3)
        folder = folder / "short"
        folder.mkdir()
        short = _median(lambda seed: ours(data, folder, seed, 400), 5)
    peer = _median(lambda seed: lmfit_emcee(data, seed), 2)
    problems: tuple[tuple[di.FrequencyResponse, di.Element], ...] = (
        (data, di.Dahl()),
        (heavy, di.Dahl()),
        (with_spring(), di.Dahl() + di.Spring()),
        (data, di.Dahl(alpha=None)),
    )
    grids = []
    for which, model in problems:
        work = partial(
            di.posterior, which, model, priors=priors, method="grid", uncertainty="noise"
        )
        grids.append(statistics.median(seconds(work) for _ in range(9)))
    name = "lmfit.Minimizer.emcee"
    return [
        Row("one effective draw, 2,000 steps", draw, peer, name, 25.0, faster=True),
        Row("one effective draw, 400 steps", short, peer, name, 25.0, faster=True),
        Row("grid of f_max, sigma, unknown scale", grids[0], 0.5, "the limit", 1.0),
        Row("the same, 3 points, 50 % noise", grids[1], 0.5, "the limit", 1.0),
        Row("grid of f_max, sigma, stiffness, unknown scale", grids[2], 1.0, "the limit", 1.0),
        Row("grid of f_max, sigma, alpha, unknown scale", grids[3], 1.0, "the limit", 1.0),
    ]


if __name__ == "__main__":
    print_table(TITLE, run())

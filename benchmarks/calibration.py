"""Simulation-based calibration: whether posteriors are as wide as they should be.

Parameters are drawn from the prior, data from the model with them, and the posterior is sampled
from the data. The rank of the true value among 99 independent draws of the posterior must then
be uniform (Talts et al., arXiv:1804.06788). The ranks of all tables form an empirical
distribution, judged by its simultaneous confidence band (Saeilynoja et al., Statistics and
Computing 32, 2022): with the probability stated, an exact sampler stays inside it everywhere,
for every parameter.

Run with ``python -m benchmarks.calibration``; it writes docs/validation/calibration.md and the
rank plot next to it. The tests run the same on fewer tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import dahl_ident as di
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.storage import library
from dahl_ident.problem import TableProblem

RANKS = 100
LEVEL = 0.01
_DRAWS = RANKS - 1
_SIMULATED = 4000
_OUT = Path("docs/validation")
_ALT = (
    "Empirical minus uniform distribution of the ranks against rank, one line for each parameter "
    "of the {} data, with the band of an exact sampler"
)


@dataclass(frozen=True)
class Scenario:
    """Priors, a model, and the data that a truth would give, noise not included."""

    name: str
    priors: dict[str, Any]
    model: Callable[..., Any]
    table: Callable[[ComplexArray | None], di.FrequencyResponse]
    noise: float
    """Standard deviation of real and of imaginary part, in the data's unit."""


def friction() -> Scenario:
    """Describing-function data: 12 amplitudes from 0.3 to 3 times a typical x_c."""
    amplitude = np.geomspace(1e-3, 1e-2, 12)
    covariance = np.broadcast_to(0.6**2 * np.eye(2), (12, 2, 2))

    def table(response: ComplexArray | None) -> di.FrequencyResponse:
        values = np.ones(12, dtype=complex) if response is None else response
        return di.FrequencyResponse(np.ones(12), values, amplitude, covariance=covariance)

    priors = {"f_max": stats.lognorm(0.5, scale=0.1), "sigma": stats.lognorm(0.5, scale=30.0)}
    return Scenario("friction", priors, di.Dahl, table, 0.6)


def plant() -> Scenario:
    """Receptance of a driven plant: 4 drives at 2 frequencies."""
    drive, frequency = (x.ravel() for x in np.meshgrid([0.03, 0.1, 0.3, 1.0], [1.0, 2.0]))
    n, noise = len(drive), 0.002
    covariance = np.broadcast_to(noise**2 * np.eye(2), (n, 2, 2))

    def table(response: ComplexArray | None) -> di.FrequencyResponse:
        values = np.ones(n, dtype=complex) if response is None else response
        return di.FrequencyResponse(
            frequency, values, drive=drive, covariance=covariance, quantity="receptance",
            controlled="force",
        )  # fmt: skip

    def model() -> Any:
        return di.Dahl() + di.Mass(0.3) + di.Damper(0.24) + di.Spring()

    priors = {
        "f_max": stats.lognorm(0.3, scale=0.1),
        "sigma": stats.lognorm(0.3, scale=30.0),
        "stiffness": stats.norm(3.0, 0.5),
    }
    return Scenario("plant", priors, model, table, noise)


SCENARIOS = {"friction": friction, "plant": plant}


def ranks(scenario: Scenario, tables: int, seed: int = 0) -> tuple[FloatArray, int]:
    """Return the rank of each truth, shape (tables, P), and how many chains did not converge."""
    shape = TableProblem(scenario.table(None), scenario.model())
    found = np.empty((tables, len(shape.names)))
    failed = 0
    for index in range(tables):
        random = np.random.default_rng([seed, index])
        truth = np.array([scenario.priors[n].rvs(random_state=random) for n in shape.names])
        exact = shape.predict(shape.to_search(truth))
        error = random.normal(size=exact.shape) + 1j * random.normal(size=exact.shape)
        data = scenario.table(exact + scenario.noise * error)
        posterior = di.posterior(
            data, scenario.model(), priors=scenario.priors, seed=index, ess=1000.0, walkers=64,
            ensembles=2, uncertainty="noise"
        )  # fmt: skip
        failed += not posterior.converged
        thin = int(np.ceil(posterior.get_autocorr_time().max()))
        draws = posterior.get_chain(posterior.warm_up, thin, flat=True)
        chosen = random.choice(len(draws), size=_DRAWS, replace=False)
        found[index] = np.sum(draws[chosen] < truth, axis=0)
    return found, failed


def extremity(ranks_: FloatArray) -> float:
    """Return the smallest two-sided probability of the ranks' ECDF, over all ranks."""
    return float(_extremities(ranks_[None])[0])


def critical(tables: int, parameters: int) -> float:
    """Return the extremity that ranks of an exact sampler fall below with probability LEVEL.

    LEVEL is for all parameters together.
    """
    simulated = np.random.default_rng(0).integers(RANKS, size=(_SIMULATED, tables))
    return float(np.quantile(_extremities(simulated.astype(float)), LEVEL / parameters))


def _extremities(sets: FloatArray) -> FloatArray:
    """Return the extremity of each of many sets of ranks, (S, N) -> (S,)."""
    N = sets.shape[1]
    thresholds = np.arange(1, RANKS)
    possible = np.arange(N + 1)[:, None]
    below = stats.binom.cdf(possible, N, thresholds / RANKS)
    above = stats.binom.sf(possible - 1, N, thresholds / RANKS)
    probability = 2.0 * np.minimum(below, above)
    counts = np.stack([np.sum(sets < k, axis=1) for k in thresholds], axis=1)
    return np.asarray(probability[counts, thresholds - 1].min(axis=1))


def band(tables: int, gamma: float) -> tuple[FloatArray, FloatArray]:
    """Return the band's lower and upper edge in ECDF less uniform, at ranks 1 to 99."""
    p = np.arange(1, RANKS) / RANKS
    low = stats.binom.ppf(0.5 * gamma, tables, p) / tables - p
    return low, stats.binom.isf(0.5 * gamma, tables, p) / tables - p


def report(results: dict[str, tuple[FloatArray, int]], folder: Path) -> str:
    """Return the table as Markdown, and draw the ranks next to it."""
    lines = [
        "# Calibration of posteriors",
        "",
        "Made by `python -m benchmarks.calibration`. For each parameter, the ranks of the true",
        "value among draws of the posterior must be uniform. For an exact sampler their empirical",
        f"distribution is inside the band for all parameters with probability {1.0 - LEVEL:.0%}.",
        "The plant of the tables and of the posterior is predicted by its exact steady motion.",
        "",
        "| data | tables | not converged | parameter | extremity | critical | inside |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (found, failed) in results.items():
        scenario = SCENARIOS[name]()
        limit = critical(len(found), found.shape[1])
        names = TableProblem(scenario.table(None), scenario.model()).names
        for parameter, column in zip(names, found.T, strict=True):
            value = extremity(column)
            lines.append(
                f"| {name} | {len(found)} | {failed} | {parameter} | {value:.2g} | {limit:.2g} "
                f"| {'yes' if value >= limit else 'NO'} |"
            )
        _draw(name, names, found, limit, folder)
    pictures = [f"![{_ALT.format(name)}](calibration_{name}.svg)" for name in results]
    return "\n".join([*lines, "", *pictures, ""])


def _draw(name: str, names: tuple[str, ...], found: FloatArray, limit: float, folder: Path) -> None:
    plt = library("matplotlib.pyplot")
    figure, axes = plt.subplots(layout="constrained", figsize=(5.0, 3.0))
    p = np.arange(1, RANKS) / RANKS
    low, high = band(len(found), limit)
    axes.fill_between(p, low, high, color="0.85", label=f"{1.0 - LEVEL:.0%} band")
    for parameter, column in zip(names, found.T, strict=True):
        ecdf = np.mean(column[:, None] < np.arange(1, RANKS), axis=0)
        axes.plot(p, ecdf - p, label=parameter)
    axes.set_xlabel("rank of the truth / 100")
    axes.set_ylabel("ECDF - uniform")
    axes.legend(fontsize="small")
    figure.savefig(folder / f"calibration_{name}.svg", metadata={"Date": None})
    plt.close(figure)


def main() -> None:
    """Run all scenarios and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", type=int, default=500)
    parser.add_argument("--out", type=Path, default=_OUT)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = {}
    for name, make in SCENARIOS.items():
        results[name] = ranks(make(), arguments.tables)
        text = report(results, arguments.out)
        (arguments.out / "calibration.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()

"""What a report says about a posterior."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.diagnostics.formatting import rounded
from dahl_ident.reporting.document import (
    Block,
    Bullets,
    Cell,
    Paragraph,
    Picture,
    Section,
    Table,
    number,
)
from dahl_ident.results.bayesian import QUANTILES, BayesianResult
from dahl_ident.results.posterior import Posterior

if TYPE_CHECKING:
    import pandas as pd


def sections(posterior: Posterior) -> Iterator[Section]:
    """Yield numbers and pictures of a posterior."""
    yield Section("Posterior", tuple(_numbers(posterior)))
    yield Section("Pictures of the posterior", (_corner(posterior), _trace(posterior)))


def verdict(posterior: Posterior) -> list[str]:
    """Return whether to use it, what the prior decides, and what does not fit."""
    return [f"Posterior: {posterior.message}", *posterior.findings]


def facts(posterior: BayesianResult) -> dict[str, Any]:
    """Return a posterior for machines."""
    told = {
        "converged": posterior.converged,
        "trusted": posterior.trusted,
        "message": posterior.message,
        "likelihood": posterior.likelihood,
        "priors": dict(posterior.priors),
        "set_by_prior": [rule.name for rule in posterior.prior_rules],
        "findings": list(posterior.findings),
        "summary": posterior.summary().to_dict(orient="index"),
    }
    how = ("seed", "steps", "warm_up", "log_evidence", "error", "evaluations")
    return told | {name: getattr(posterior, name) for name in how if hasattr(posterior, name)}


def _numbers(posterior: Posterior) -> Iterator[Block]:
    yield Paragraph(posterior.message)
    table = posterior.summary()
    columns = ["mean", "std", *QUANTILES, "mcse", "ess", "r_hat"]
    rows = tuple(
        (Cell(str(name)), Cell(str(row["unit"]) or "-"), *_row(row))
        for name, row in table.iterrows()
    )
    yield Table("Posterior of each parameter", ("parameter", "unit", *columns), rows)
    yield Paragraph(
        "mcse is the Monte Carlo standard error of the mean, ess the effective number of draws, "
        "r_hat compares independent ensembles and is 1 where they agree."
    )
    yield Paragraph(f"Priors (likelihood: {posterior.likelihood.replace('_', ' ')}):")
    yield Bullets(tuple(f"{name}: {text}" for name, text in posterior.priors.items()))
    if posterior.findings:
        yield Bullets(posterior.findings)
    yield Paragraph(f"Seed {posterior.seed}; the same seed gives the same chain.")


def _row(row: pd.Series[Any]) -> Iterator[Cell]:
    """Yield the numbers of one parameter, no finer than its standard deviation."""
    std = float(row["std"])
    for name in ("mean", *QUANTILES):
        value, error = rounded(float(row[name]), std)
        yield Cell(value, float(row[name]))
        if name == "mean":
            yield Cell(error, std)
    for name, digits in (("mcse", 2), ("ess", 4), ("r_hat", 5)):
        yield number(row[name], digits) if np.isfinite(row[name]) else Cell("-")


def _corner(posterior: Posterior) -> Picture:
    correlation = np.corrcoef(posterior.values.T).reshape(len(posterior.names), -1)
    i, j = np.unravel_index(np.argmax(np.abs(np.triu(correlation, 1))), correlation.shape)
    finding = (
        f"The strongest correlation is {correlation[i, j]:.2f}, between {posterior.names[i]} and "
        f"{posterior.names[j]}."
        if len(posterior.names) > 1
        else f"One parameter, {posterior.names[0]}."
    )
    return Picture(
        "corner",
        "Posterior density of each parameter (dashed: 16, 50 and 84 %) and of each pair.",
        finding,
        lambda: posterior.plot_corner()[0, 0].figure,
    )


def _trace(posterior: Posterior) -> Picture:
    return Picture(
        "trace",
        "Paths of the walkers; the shaded warm-up is left out of every number.",
        f"{posterior.steps} steps, of which the first {posterior.warm_up} are warm-up. "
        f"{'The chain has converged' if posterior.converged else 'The chain has NOT converged'}.",
        lambda: posterior.plot_trace()[0].figure,
    )

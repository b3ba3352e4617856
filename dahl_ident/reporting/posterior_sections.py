"""The sections of a report on a posterior."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
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
    TextTable,
    number,
)
from dahl_ident.results import Posterior
from dahl_ident.results.posterior_result import QUANTILES

if TYPE_CHECKING:
    import pandas as pd


def sections(posterior: Posterior) -> Iterator[Section]:
    """Yield numbers and pictures of a posterior."""
    yield Section("Posterior", tuple(_numbers(posterior)), details=True)
    pictures = (_corner(posterior), *([_trace(posterior)] if posterior.is_chain else []))
    yield Section("Pictures of the posterior", pictures, details=True)


def verdict(posterior: Posterior) -> list[str]:
    """Return whether it can be used, which parameters the prior determines, and misfits."""
    return [f"Posterior: {posterior.findings[0]}", *map(str, posterior.findings[1:])]


def answer(posterior: Posterior) -> Iterator[Block]:
    """Yield the summary of a posterior and its priors; the numbers are struck if not trusted."""
    yield _summary(posterior)
    yield Bullets(tuple(f"Prior of {name}: {text}" for name, text in posterior.priors.items()))


def _summary(posterior: Posterior) -> TextTable:
    summary = posterior.summary()
    columns = [name for name in summary.columns if name != "unit"]
    rows = tuple(
        (Cell(str(name)), Cell(str(row["unit"]) or "-"), *_row(row))
        for name, row in summary.iterrows()
    )
    if not posterior.trusted:
        rows = tuple((*row[:2], *(replace(cell, struck=True) for cell in row[2:])) for row in rows)
    return TextTable("Posterior of each parameter", ("parameter", "unit", *columns), rows)


def _numbers(posterior: Posterior) -> Iterator[Block]:
    yield Paragraph(posterior.message)
    yield _summary(posterior)
    if posterior.is_chain:
        yield Paragraph(
            "mcse is the Monte Carlo standard error of the mean, ess the effective number of "
            "draws, r_hat compares independent ensembles and is 1 if they agree."
        )
    yield Paragraph(f"Priors (likelihood: {posterior.likelihood.replace('_', ' ')}):")
    yield Bullets(tuple(f"{name}: {text}" for name, text in posterior.priors.items()))
    yield Bullets(tuple(map(str, posterior.findings)))
    if posterior.is_chain:
        yield Paragraph(f"Seed {posterior.seed}; the same seed gives the same chain.")


def _row(row: pd.Series[Any]) -> Iterator[Cell]:
    """Yield the numbers of one parameter, rounded by its standard deviation."""
    std = float(row["std"])
    for name in ("mean", *QUANTILES):
        value, error = rounded(float(row[name]), std)
        yield Cell(value, float(row[name]))
        if name == "mean":
            yield Cell(error, std)
    for name, digits in (("mcse", 2), ("ess", 4), ("r_hat", 5)):
        if name in row:
            yield number(row[name], digits) if np.isfinite(row[name]) else Cell("-")


def _corner(posterior: Posterior) -> Picture:
    covariance = np.atleast_2d(np.cov(posterior.values.T, aweights=posterior.weights))
    size = np.sqrt(covariance.diagonal())
    correlation = covariance / np.outer(size, size)
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
        "Paths of the walkers; the shaded warm-up is not used in any result.",
        f"{posterior.steps} steps, of which the first {posterior.warm_up} are warm-up. "
        f"{'The chain has converged' if posterior.converged else 'The chain has NOT converged'}.",
        lambda: posterior.plot_trace()[0].figure,
    )

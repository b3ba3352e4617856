"""Fits on different data side by side: curves overlaid, changes with their significance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident import plots
from dahl_ident.data.laboratory import Metadata
from dahl_ident.diagnostics.formatting import rounded
from dahl_ident.errors import ValidationError
from dahl_ident.reporting.comparison import changes_section, numbered
from dahl_ident.reporting.document import (
    Bullets,
    Cell,
    Document,
    Picture,
    Section,
    TextTable,
)
from dahl_ident.reporting.provenance import parts
from dahl_ident.reporting.sections import RANK, fit_facts, header, origin_facts, signed
from dahl_ident.results import FitResult, Posterior
from dahl_ident.results.changes import changes, headline, is_usable


def overlay(
    results: Sequence[FitResult | Posterior],
    *,
    title: str | None = None,
    command: str | None = None,
    metadata: Metadata | None = None,
) -> Document:
    """Return the comparison of fits on different data, each with the one before it."""
    fits = [result for result in results if isinstance(result, FitResult)]
    if len(fits) < len(results):
        raise ValidationError(
            "results on different data are compared only where all are fits; write a report for "
            "each"
        )
    units = {fit.data.unit for fit in fits}
    if len(units) > 1:
        raise ValidationError(f"the fits measure in different units: {', '.join(sorted(units))}")
    names = _names(fits)
    known = metadata or Metadata()
    changed = changes(dict(zip(names, fits, strict=True)))
    verdicts = tuple(f"{name}: {fit.verdict}" for name, fit in zip(names, fits, strict=True))
    sections = (
        Section("Parameters side by side", (_table(names, fits),)),
        changes_section(changed),
        Section("Pictures", (_picture(names, fits),), details=True),
        Section("Verdicts", (Bullets(verdicts),), details=True),
    )
    return Document(
        title=title or known.title or f"Comparison of {', '.join(names)}",
        status=max((str(fit.status) for fit in fits), key=RANK),
        verdict=tuple(headline(changed)),
        header=_header(fits, names, known),
        sections=sections,
        facts={
            "fits": [{"name": n} | fit_facts(fit) for n, fit in zip(names, fits, strict=True)],
            "posteriors": [],
            "changes": [change.to_dict() for change in changed],
            "metadata": known.facts(),
            **origin_facts(fits),
            "command": command,
        },
        **signed(known, fits[0]),
    )


def _names(fits: Sequence[FitResult]) -> list[str]:
    """Return a name for each fit: its file, with a number if several have the same name."""
    named = []
    for i, fit in enumerate(fits, 1):
        files = [Path(str(part["file"])).stem for part in parts(fit.provenances) if "file" in part]
        named.append(files[0] if len(files) == 1 else f"measurement {i}")
    return numbered(named)


def _header(
    fits: Sequence[FitResult], names: Sequence[str], metadata: Metadata
) -> tuple[tuple[str, tuple[str, ...]], ...]:
    rows = dict(header(fits[:1], metadata))
    headers = [dict(header([fit], metadata)) for fit in fits]
    rows["Model"] = tuple(dict.fromkeys(line for one in headers for line in one["Model"]))
    rows["Data"] = tuple(
        f"{name}: {'; '.join(one['Data'])}" for name, one in zip(names, headers, strict=True)
    )
    return tuple(rows.items())


def _table(names: Sequence[str], fits: Sequence[FitResult]) -> TextTable:
    every = list(dict.fromkeys(name for fit in fits for name in fit.params))
    rows = []
    for name in every:
        unit = next(fit.params[name].unit for fit in fits if name in fit.params)
        cells = [_estimate(fit, name) for fit in fits]
        rows.append((Cell(name), Cell(unit or "-"), *cells))
    status = (Cell("status"), Cell("-"), *(Cell(str(fit.status)) for fit in fits))
    return TextTable(
        "Estimates, each with its standard uncertainty",
        ("parameter", "unit", *names),
        (*rows, status),
    )


def _estimate(fit: FitResult, name: str) -> Cell:
    if name not in fit.params:
        return Cell("-")
    estimate = fit.params[name]
    if not estimate.vary:
        return Cell(f"{estimate.value:g} (fixed)", estimate.value)
    if not math.isfinite(estimate.value):
        return Cell("none finite")
    value, error = rounded(estimate.value, estimate.stderr)
    return Cell(f"{value} \u00b1 {error}", estimate.value, struck=not is_usable(fit, name))


def _picture(names: Sequence[str], fits: Sequence[FitResult]) -> Picture:
    def draw() -> Any:
        tables = [fit.data.select(harmonic=1) for fit in fits]
        over_frequency = any(np.ptp(t.frequency_hz) > 0.5 * t.frequency_hz.max() for t in tables)
        levels, fitted = [], []
        for name, fit, table in zip(names, fits, tables, strict=True):
            x = table.frequency_hz if over_frequency else _amplitude(fit)
            order = np.argsort(x, kind="stable")
            predicted = fit.best_fit[fit.data.harmonic == 1]
            levels.append((name, x, table.response))
            fitted.append(plots.Curve(x[order], predicted[order]))
        return plots.plot_frequency_response(
            levels,
            fitted=fitted if not over_frequency else (),
            gain_label=f"{tables[0].quantity.replace('_', ' ')} [{tables[0].unit}]",
            x_label="frequency [Hz]" if over_frequency else "displacement amplitude",
        )

    ranges = (
        f"{name}: gain from {fit.data.gain.min():.3g} to {fit.data.gain.max():.3g} {fit.data.unit}"
        for name, fit in zip(names, fits, strict=True)
    )
    return Picture(
        "overlay",
        "Data (points) and fits (lines) of every measurement.",
        "; ".join(ranges) + ".",
        draw,
    )


def _amplitude(fit: FitResult) -> Any:
    return fit.problem.stiffness_data.amplitude[fit.data.harmonic == 1]

"""Fits on different data side by side: curves overlaid, changes with their significance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from dahl_ident import plots
from dahl_ident.data.laboratory import Metadata
from dahl_ident.diagnostics.formatting import rounded
from dahl_ident.diagnostics.verdicts import Verdict
from dahl_ident.errors import ValidationError
from dahl_ident.reporting.document import (
    Bullets,
    Cell,
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    figure_of,
)
from dahl_ident.reporting.provenance import parts
from dahl_ident.reporting.sections import (
    Result,
    fit_facts,
    header,
    origin_facts,
    signed,
    worst_status,
)
from dahl_ident.results import FitResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGNIFICANT = 0.05  # two-sided probability below which a change is called significant


def overlay(
    results: Sequence[Result],
    *,
    title: str | None = None,
    command: str | None = None,
    metadata: Metadata | None = None,
) -> Document:
    """Return the comparison of fits on different data, each with the one before it.

    Raises
    ------
    ValidationError
        If a result is not a fit, or the fits measure different quantities.
    """
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
    given = metadata or Metadata()
    changes = [
        change
        for (a, b), (fit, later) in zip(pairwise(names), pairwise(fits), strict=True)
        for change in _changes(a, fit, b, later)
    ]
    found = [c for c in changes if c["significant"]]
    verdict = [
        f"{c['parameter']} changes from {c['from']} to {c['to']}: {_words(c)}." for c in found
    ]
    if not found:
        verdict = ["No parameter changes significantly between the measurements."]
    verdict += [f"{name}: {fit.verdict}" for name, fit in zip(names, fits, strict=True)]
    sections = (
        Section("Parameters side by side", (_table(names, fits),)),
        Section("Changes", (_change_table(changes), Paragraph(_HOW))),
        Section("Pictures", (_picture(names, fits),)),
        Section("Verdicts", (Bullets(tuple(verdict[len(found) or 1 :])),), details=True),
    )
    return Document(
        title=title or given.title or f"Comparison of {', '.join(names)}",
        status=worst_status(fits),
        verdict=tuple(verdict[: len(found) or 1]),
        header=_header(fits, names, given),
        sections=sections,
        facts={
            "fits": [{"name": n} | fit_facts(fit) for n, fit in zip(names, fits, strict=True)],
            "posteriors": [],
            "changes": changes,
            "metadata": given.facts(),
            **origin_facts(fits[0].data),
            "files": [file for fit in fits for file in origin_facts(fit.data)["files"]],
            "command": command,
        },
        **signed(given, fits[0].data),
    )


_HOW = (
    "A change is the difference of two estimates; its standard uncertainty is the root of the sum "
    "of both variances, so a calibration error that both share does not show in it. p is the "
    "two-sided probability of a change this large if there is no real change; below "
    f"{SIGNIFICANT:g} it is called significant."
)


def _names(fits: Sequence[FitResult]) -> list[str]:
    """Return a name for each fit: its file, with a number if several have the same name."""
    named = []
    for i, fit in enumerate(fits, 1):
        files = [Path(str(part["file"])).stem for part in parts(fit.data) if "file" in part]
        named.append(files[0] if len(files) == 1 else f"measurement {i}")
    return [n if named.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(named, 1)]


def _header(
    fits: Sequence[FitResult], names: Sequence[str], given: Metadata
) -> tuple[tuple[str, tuple[str, ...]], ...]:
    rows = dict(header(fits[0], given))
    own = [dict(header(fit, given)) for fit in fits]
    rows["Model"] = tuple(dict.fromkeys(line for one in own for line in one["Model"]))
    rows["Data"] = tuple(
        f"{name}: {'; '.join(one['Data'])}" for name, one in zip(names, own, strict=True)
    )
    return tuple(rows.items())


def _changes(a: str, fit: FitResult, b: str, later: FitResult) -> list[dict[str, Any]]:
    """Return the change of every parameter that both fits estimate."""
    found = []
    for name in fit.var_names:
        if name not in later.var_names:
            continue
        one, other = fit.params[name], later.params[name]
        change = other.value - one.value
        u = math.hypot(one.stderr or 0.0, other.stderr or 0.0)
        usable = all(_is_usable(f, name) for f in (fit, later)) and math.isfinite(u) and u > 0.0
        p = float(2.0 * special.ndtr(-abs(change) / u)) if usable else math.nan
        found.append(
            {
                "parameter": name, "unit": one.unit, "from": a, "to": b, "change": change,
                "relative": change / one.value if one.value else math.nan, "u": u,
                "p": p, "significant": bool(p < SIGNIFICANT),
            }
        )  # fmt: skip
    return found


def _is_usable(fit: FitResult, name: str) -> bool:
    """Return whether the uncertainty of a parameter is valid."""
    judged = fit.identifiability.parameters[name].verdict
    identified = judged in (Verdict.IDENTIFIED, Verdict.BY_PRIOR)
    return identified and str(fit.status) != "not described"


def _words(change: dict[str, Any]) -> str:
    value, error = rounded(change["change"], change["u"])
    unit = f" {change['unit']}" if change["unit"] else ""
    percents = 100.0 * change["relative"]
    return f"{value} \u00b1 {error}{unit} ({percents:+.2g} %, {_p(change['p'])})"


def _p(p: float) -> str:
    return "p < 0.0001" if p < 1e-4 else f"p = {p:.1g}"


def _table(names: Sequence[str], fits: Sequence[FitResult]) -> Table:
    every = list(dict.fromkeys(name for fit in fits for name in fit.params))
    rows = []
    for name in every:
        unit = next(fit.params[name].unit for fit in fits if name in fit.params)
        cells = [_estimate(fit, name) for fit in fits]
        rows.append((Cell(name), Cell(unit or "-"), *cells))
    status = (Cell("status"), Cell("-"), *(Cell(str(fit.status)) for fit in fits))
    return Table(
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
    return Cell(f"{value} \u00b1 {error}", estimate.value, struck=not _is_usable(fit, name))


def _change_table(changes: Sequence[dict[str, Any]]) -> Table:
    rows = []
    for c in changes:
        value, error = rounded(c["change"], c["u"])
        usable = math.isfinite(c["p"])
        rows.append(
            (
                Cell(c["parameter"]),
                Cell(f"{c['from']} to {c['to']}"),
                Cell(value, c["change"], struck=not usable),
                Cell(error, c["u"] if math.isfinite(c["u"]) else None, struck=not usable),
                Cell(c["unit"] or "-"),
                Cell(_p(c["p"]).removeprefix("p ").removeprefix("= "), c["p"])
                if usable
                else Cell("-"),
                Cell(_significance(c)),
            )
        )
    header = (
        "parameter",
        "between",
        "change",
        "standard uncertainty u",
        "unit",
        "p",
        "significance",
    )
    return Table("Changes from each measurement to the next", header, tuple(rows))


def _significance(change: dict[str, Any]) -> str:
    if not math.isfinite(change["p"]):
        return "cannot be stated: not both estimates can be used"
    return "significant" if change["significant"] else "not significant"


def _picture(names: Sequence[str], fits: Sequence[FitResult]) -> Picture:
    def draw() -> Figure:
        tables = [fit.data.select(harmonic=1) for fit in fits]
        over_frequency = any(np.ptp(t.frequency_hz) > 0.5 * t.frequency_hz.max() for t in tables)
        levels, fitted = [], []
        for name, fit, table in zip(names, fits, tables, strict=True):
            x = table.frequency_hz if over_frequency else _amplitude(fit)
            order = np.argsort(x, kind="stable")
            predicted = fit.best_fit[fit.data.harmonic == 1]
            levels.append((name, x, table.response))
            fitted.append(plots.Curve(x[order], predicted[order]))
        return figure_of(
            plots.plot_frequency_response(
                levels,
                fitted=fitted if not over_frequency else (),
                gain_label=f"{tables[0].quantity.replace('_', ' ')} [{tables[0].unit}]",
                x_label="frequency [Hz]" if over_frequency else "displacement amplitude",
            )
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

"""Parameters of several measurements side by side, and their changes or disagreements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident import plots
from dahl_ident.diagnostics.formatting import rounded, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.reporting.document import (
    Bullets,
    Cell,
    Paragraph,
    Picture,
    Row,
    Section,
    TextTable,
    estimated,
    words,
)
from dahl_ident.results import FitResult
from dahl_ident.results.changes import SIGNIFICANT, Change, changes, headline, is_usable

_ON_DIFFERENCES = (
    "The same parameters, estimated from the table and sample by sample from the waveforms. The "
    "standard uncertainty u of the difference combines both budgets as if they had no error in "
    "common; p is the two-sided probability of a difference this large if there is none. A "
    f"difference is called a disagreement if p times the number of rows is below {SIGNIFICANT}."
)
_ON_CHANGES = (
    "A change is the difference of two estimates. Its standard uncertainty u combines both "
    "budgets; for a fit of a single run, the scatter between runs that the other fit shows is "
    "added. p is the two-sided probability of a change this large if there is no real change; "
    f"below {SIGNIFICANT:g} it is called significant, unless no fit shows scatter between runs."
)
KINDS = {"table": "Table", "records": "Waveforms"}
"""Names of the kinds of data in reports."""


def of_kind(kind: str, results: Iterable[Any]) -> list[Any]:
    """Return the results on one kind of data."""
    return [result for result in results if result.problem.kind == kind]


@dataclass(frozen=True)
class Compared:
    """The part of a report that compares fits of different measurements."""

    status: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


def comparison_of(fits: Sequence[FitResult]) -> Compared:
    """Return what changed between fits of records, or between a table and its waveforms."""
    of_records = of_kind("records", fits)
    if 0 < len(of_records) < len(fits):
        return _of_both(fits)
    firsts = [fit.data[0] for fit in of_records]
    channels = ("time", "displacement", "velocity", "acceleration", "force", "drive")
    for a, b in pairwise(firsts):  # models of the same records are not changes
        if all(np.array_equal(getattr(a, name), getattr(b, name)) for name in channels):
            return Compared()
    named = [Path(str((r.provenance or {}).get("file", "measurement"))).stem for r in firsts]
    return changed_between(numbered(named), of_records)


def changed_between(names: Sequence[str], fits: Sequence[FitResult]) -> Compared:
    """Return what changed from each fit to the next; empty if they share no parameter."""
    changed = changes(dict(zip(names, fits, strict=True)))
    if not changed:
        return Compared()
    rows: list[Row] = [
        {
            "parameter": c.parameter,
            "between": f"{c.before} to {c.after}",
            **_sizes("change", c, c.p_number if math.isfinite(c.p) else "-"),
            "significance": c.significance,
        }
        for c in changed
    ]
    table = TextTable.of("Changes from each measurement to the next", rows)
    section = Section("Changes", (table, Paragraph(_ON_CHANGES)))
    facts = {"changes": [change.to_dict() for change in changed]}
    return Compared((), tuple(headline(changed)), (section,), facts)


def numbered(names: Sequence[str]) -> list[str]:
    """Return names, with numbers added to those that occur more than once."""
    return [n if names.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(names, 1)]


def _of_both(fits: Sequence[FitResult]) -> Compared:
    """Return the differences of the parameters that a table and waveforms both determine."""
    differences = [
        (change, [fit.params[change.parameter] for fit in (table, records)])
        for table, records in product(of_kind("table", fits), of_kind("records", fits))
        for change in changes({"table": table, "waveforms": records})
    ]
    comparable = sum(math.isfinite(change.p) for change, _ in differences)
    verdict, disagree = [], []
    rows: list[Row] = []
    for c, both in differences:
        finding = "agree" if math.isfinite(c.p) else "cannot be compared"
        if c.p * comparable < SIGNIFICANT:
            finding = "disagree"
            disagree.append(c.parameter)
            of_table, of_waveforms = (with_unit(e.value, e.stderr or 0.0, c.unit) for e in both)
            verdict.append(
                f"Table and waveforms disagree: {c.parameter} is {of_table} from the table and "
                f"{of_waveforms} from the waveforms ({c.p_text}). At least one has an error "
                "that its uncertainty does not include."
            )
        texts = (" \u00b1 ".join(rounded(e.value, e.stderr or 0.0)) for e in both)
        cells = [Cell(text, e.value) for text, e in zip(texts, both, strict=True)]
        rows.append(
            {
                "parameter": c.parameter,
                **dict(zip(("table", "waveforms"), cells, strict=True)),
                **_sizes("difference", c, c.p_text),
                "finding": finding,
            }
        )
    if not verdict:
        verdict = ["Table and waveforms agree within their uncertainties."]
        if not comparable:
            verdict = [
                "Table and waveforms cannot be compared: they have no usable estimate in common."
            ]
    # if they disagree, one model with its uncertainties does not describe both
    status = (str(VerdictStatus.NOT_DESCRIBED),) if disagree else ()
    sections: tuple[Section, ...] = ()
    if rows:
        caption = "Parameters from the table and from the waveforms, with standard uncertainties"
        blocks = (TextTable.of(caption, rows), Paragraph(_ON_DIFFERENCES))
        sections = (Section("Table and waveforms", blocks),)
    facts = {"changes": [change.to_dict() for change, _ in differences], "disagree": disagree}
    return Compared(status, tuple(verdict), sections, facts)


def _sizes(what: str, change: Change, p: str) -> Row:
    """Return a change, its uncertainty, their unit and p; struck through if not usable."""
    value, error = rounded(change.change, change.u)
    usable = math.isfinite(change.p)
    u = change.u if math.isfinite(change.u) else None
    return {
        what: Cell(value, change.change, struck=not usable),
        "standard uncertainty u": Cell(error, u, struck=not usable),
        "unit": change.unit or "-",
        "p": Cell(p, change.p if usable else None),
    }


def side_by_side(names: Sequence[str], fits: Sequence[FitResult]) -> Compared:
    """Return the estimates of fits of different tables, their changes, pictures and verdicts."""
    rows = []
    for name in dict.fromkeys(name for fit in fits for name in fit.params):
        unit = next(fit.params[name].unit for fit in fits if name in fit.params)
        rows.append((*words(name, unit or "-"), *(_estimate_of(fit, name) for fit in fits)))
    rows.append(words("status", "-", *(str(fit.status) for fit in fits)))
    header = ("parameter", "unit", *names)
    table = TextTable("Estimates, each with its standard uncertainty", header, tuple(rows))
    named = dict(zip(names, fits, strict=True))
    verdicts = tuple(f"{name}: {fit.verdict}" for name, fit in named.items())
    changed = changed_between(names, fits)
    sections = (
        Section("Parameters side by side", (table,)),
        *changed.sections,
        Section("Pictures", (_overlaid(named),), details=True),
        Section("Verdicts", (Bullets(verdicts),), details=True),
    )
    verdict = changed.verdict or tuple(headline([]))
    return Compared((), verdict, sections, {"changes": [], **changed.facts})


def _estimate_of(fit: FitResult, name: str) -> Cell:
    if name not in fit.params:
        return Cell("-")
    p = fit.params[name]
    if not p.vary:
        return Cell(f"{p.value:g} (fixed)", p.value)
    text = " \u00b1 ".join(rounded(p.value, p.stderr))
    return estimated(p.value, text, struck=not is_usable(fit, name))


def _overlaid(fits: Mapping[str, FitResult]) -> Picture:
    def draw() -> Any:
        measured = [fit.data.select(harmonic=1) for fit in fits.values()]
        over_frequency = any(np.ptp(t.frequency_hz) > 0.5 * t.frequency_hz.max() for t in measured)
        levels, fitted = [], []
        for (name, fit), table in zip(fits.items(), measured, strict=True):
            fundamental = fit.data.harmonic == 1
            x = fit.problem.stiffness_data.amplitude[fundamental]
            x = table.frequency_hz if over_frequency else x
            order = np.argsort(x, kind="stable")
            levels.append((name, x, table.response))
            fitted.append(plots.Curve(x[order], fit.best_fit[fundamental][order]))
        return plots.plot_frequency_response(
            levels,
            fitted=fitted if not over_frequency else (),
            gain_label=f"{measured[0].quantity.replace('_', ' ')} [{measured[0].unit}]",
            x_label="frequency [Hz]" if over_frequency else "displacement amplitude",
        )

    ranges = (
        f"{name}: gain from {fit.data.gain.min():.3g} to {fit.data.gain.max():.3g} {fit.data.unit}"
        for name, fit in fits.items()
    )
    return Picture(
        "overlay",
        "Data (points) and fits (lines) of every measurement.",
        "; ".join(ranges) + ".",
        draw,
    )

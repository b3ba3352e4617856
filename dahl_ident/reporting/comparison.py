"""Parameters of several measurements compared: changes, or a table with its waveforms."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.diagnostics.formatting import rounded, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.reporting.document import Cell, Paragraph, Section, TextTable
from dahl_ident.results import FitResult
from dahl_ident.results.changes import SIGNIFICANT, Change, changes, headline

_HOW_BOTH = (
    "The same parameters, estimated from the table and sample by sample from the waveforms. The "
    "standard uncertainty u of the difference combines both budgets as if they had no error in "
    "common; p is the two-sided probability of a difference this large if there is none. A "
    f"difference is called a disagreement where p times the number of rows is below {SIGNIFICANT}."
)


_HOW = (
    "A change is the difference of two estimates. Its standard uncertainty u combines both "
    "budgets; for a fit of a single run, the scatter between runs that the other fit shows is "
    "added. p is the two-sided probability of a change this large if there is no real change; "
    f"below {SIGNIFICANT:g} it is called significant, unless no fit shows scatter between runs."
)


KINDS = {"table": "Table", "records": "Waveforms"}
"""How reports call what was measured."""


def of_kind(kind: str, results: Iterable[Any]) -> list[Any]:
    """Return the results on one kind of data."""
    return [result for result in results if result.problem.kind == kind]


@dataclass(frozen=True)
class Compared:
    """What a report says of fits of different measurements, compared with each other."""

    status: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


def comparison_of(fits: Sequence[FitResult]) -> Compared:
    """Return what changed between fits of records, or between a table and its waveforms."""
    of_records = of_kind("records", fits)
    if 0 < len(of_records) < len(fits):
        return _of_both(fits)
    changed = _between_records(of_records)
    if not changed:
        return Compared()
    facts = {"changes": [change.to_dict() for change in changed]}
    return Compared((), tuple(headline(changed)), (changes_section(changed),), facts)


def _between_records(fits: Sequence[FitResult]) -> list[Change]:
    """Return the changes between fits to different records; none between models of the same."""
    firsts = [fit.data[0] for fit in fits]
    channels = ("time", "displacement", "velocity", "acceleration", "force", "drive")
    for a, b in pairwise(firsts):
        if all(np.array_equal(getattr(a, name), getattr(b, name)) for name in channels):
            return []
    named = [Path(str((r.provenance or {}).get("file", "measurement"))).stem for r in firsts]
    return changes(dict(zip(numbered(named), fits, strict=True)))


def numbered(names: Sequence[str]) -> list[str]:
    """Return names with a number where several are the same."""
    return [n if names.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(names, 1)]


def _of_both(fits: Sequence[FitResult]) -> Compared:
    differences = list(_differences(fits))
    disagree = [c.parameter for c, *_ in differences if _disagree(c, differences)]
    # one model, with its uncertainties, then does not describe both
    status = (str(VerdictStatus.NOT_DESCRIBED),) if disagree else ()
    return Compared(
        status,
        tuple(_comparison_in_words(differences)),
        (_comparison(differences),) if differences else (),
        {"changes": [change.to_dict() for change, *_ in differences], "disagree": disagree},
    )


_Difference = tuple[Change, FitResult, FitResult]


def _differences(results: Sequence[FitResult]) -> Iterator[_Difference]:
    """Yield the differences of the parameters that a table and waveforms both determine."""
    for fit, other in product(of_kind("table", results), of_kind("records", results)):
        for change in changes({"table": fit, "waveforms": other}):
            yield change, fit, other


def _disagree(change: Change, differences: Sequence[_Difference]) -> bool:
    return change.p * sum(math.isfinite(c.p) for c, _, _ in differences) < SIGNIFICANT


def disagreements(results: Sequence[FitResult]) -> list[str]:
    """Return a sentence for each parameter that a table and waveforms give differently."""
    return _disagreements(list(_differences(results)))


def _disagreements(differences: Sequence[_Difference]) -> list[str]:
    sentences = []
    for change, *fits in differences:
        if _disagree(change, differences):
            name = change.parameter
            estimates = (fit.params[name] for fit in fits)
            one, two = (with_unit(e.value, e.stderr or 0.0, change.unit) for e in estimates)
            sentences.append(
                f"Table and waveforms disagree: {name} is {one} from the table and {two} from the "
                f"waveforms ({change.p_text}). At least one has an error that its uncertainty does "
                "not hold."
            )
    return sentences


def _comparison_in_words(differences: Sequence[_Difference]) -> list[str]:
    if sentences := _disagreements(differences):
        return sentences
    if any(math.isfinite(change.p) for change, _, _ in differences):
        return ["Table and waveforms agree within their uncertainties."]
    return ["Table and waveforms cannot be compared: they have no usable estimate in common."]


def _comparison(differences: Sequence[_Difference]) -> Section:
    rows = []
    for change, *fits in differences:
        estimates = []
        for fit in fits:
            estimate = fit.params[change.parameter]
            value, error = rounded(estimate.value, estimate.stderr or 0.0)
            estimates.append(Cell(f"{value} \u00b1 {error}", estimate.value))
        says = "disagree" if _disagree(change, differences) else "agree"
        rows.append(
            (
                Cell(change.parameter),
                *estimates,
                *_sizes(change, change.p_text),
                Cell(says if math.isfinite(change.p) else "cannot be compared"),
            )
        )
    header = (
        "parameter", "table", "waveforms", "difference", "standard uncertainty u", "unit", "p",
        "finding",
    )  # fmt: skip
    caption = "Parameters from the table and from the waveforms, with standard uncertainties"
    table = TextTable(caption, header, tuple(rows))
    return Section("Table and waveforms", (table, Paragraph(_HOW_BOTH)))


def _sizes(change: Change, p: str) -> list[Cell]:
    """Return a change, its uncertainty, their unit and p as written; struck if not usable."""
    value, error = rounded(change.change, change.u)
    usable = math.isfinite(change.p)
    return [
        Cell(value, change.change, struck=not usable),
        Cell(error, change.u if math.isfinite(change.u) else None, struck=not usable),
        Cell(change.unit or "-"),
        Cell(p, change.p if usable else None),
    ]


def changes_section(changed: Sequence[Change]) -> Section:
    """Return the table of changes, and how it is made."""
    rows = []
    for c in changed:
        p = c.p_number if math.isfinite(c.p) else "-"
        between = Cell(f"{c.before} to {c.after}")
        rows.append((Cell(c.parameter), between, *_sizes(c, p), Cell(c.significance)))
    header = (
        "parameter", "between", "change", "standard uncertainty u", "unit", "p", "significance"
    )  # fmt: skip
    table = TextTable("Changes from each measurement to the next", header, tuple(rows))
    return Section("Changes", (table, Paragraph(_HOW)))

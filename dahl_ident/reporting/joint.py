"""A report on a table and on waveforms of the same test, with a comparison of parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

from dahl_ident.diagnostics.formatting import rounded, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.reporting.document import MARKS, Cell, Document, Paragraph, Section, Table
from dahl_ident.results import FitResult, RecordFit
from dahl_ident.results.changes import SIGNIFICANT, Change, changes

_HOW = (
    "The same parameters, estimated from the table and sample by sample from the waveforms. The "
    "standard uncertainty u of the difference combines both budgets as if they had no error in "
    "common; p is the two-sided probability of a difference this large if there is none. A "
    f"difference is called a disagreement where p times the number of rows is below {SIGNIFICANT}."
)


def joint(table: Document, waveforms: Document, results: Sequence[object]) -> Document:
    """Return both reports as one, which begins with the comparison of their parameters."""
    differences = list(_differences(results))
    sections = [
        *table.sections,
        *(replace(section, title=f"{section.title}: waveforms") for section in waveforms.sections),
    ]
    statuses = [table.status, waveforms.status]
    if disagreements(results):  # one model, with its uncertainties, does not describe both
        statuses.append(str(VerdictStatus.NOT_DESCRIBED))
    header = dict(table.header)
    header["Data"] = (*header["Data"], *dict(waveforms.header)["Data"])
    return replace(
        table,
        status=max(statuses, key=list(MARKS).index),
        verdict=(
            *_comparison_in_words(results),
            *(f"Table: {line}" for line in table.verdict),
            *(f"Waveforms: {line}" for line in waveforms.verdict),
        ),
        header=tuple(header.items()),
        sections=(
            *([_comparison(differences)] if differences else []),
            *(section for section in sections if not section.details),
            *(section for section in sections if section.details),
        ),
        facts={
            **table.facts,
            "posteriors": [*table.facts["posteriors"], *waveforms.facts["posteriors"]],
            "record_fits": waveforms.facts["record_fits"],
            "files": [*table.facts["files"], *waveforms.facts["files"]],
            "changes": [change.to_dict() for change, _, _ in differences],
            "disagree": [c.parameter for c, _, _ in differences if _disagree(c, differences)],
        },
    )


_Difference = tuple[Change, FitResult, RecordFit]


def _differences(results: Sequence[object]) -> Iterator[_Difference]:
    """Yield the differences of the parameters that a table and waveforms both determine."""
    tables = [one for one in results if isinstance(one, FitResult)]
    records = [one for one in results if isinstance(one, RecordFit)]
    for fit, other in product(tables, records):
        for change in changes({"table": fit, "waveforms": other}):
            yield change, fit, other


def _disagree(change: Change, differences: Sequence[_Difference]) -> bool:
    return change.p * sum(math.isfinite(c.p) for c, _, _ in differences) < SIGNIFICANT


def disagreements(results: Sequence[object]) -> list[str]:
    """Return a sentence for each parameter that a table and waveforms give differently."""
    differences = list(_differences(results))
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


def _comparison_in_words(results: Sequence[object]) -> list[str]:
    if sentences := disagreements(results):
        return sentences
    if any(math.isfinite(change.p) for change, _, _ in _differences(results)):
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
        value, error = rounded(change.change, change.u)
        usable = math.isfinite(change.p)
        says = "disagree" if _disagree(change, differences) else "agree"
        rows.append(
            (
                Cell(change.parameter),
                *estimates,
                Cell(value, change.change, struck=not usable),
                Cell(error, change.u if math.isfinite(change.u) else None, struck=not usable),
                Cell(change.unit or "-"),
                Cell(change.p_text, change.p if usable else None),
                Cell(says if usable else "cannot be compared"),
            )
        )
    header = (
        "parameter", "table", "waveforms", "difference", "standard uncertainty u", "unit", "p",
        "finding",
    )  # fmt: skip
    caption = "Parameters from the table and from the waveforms, with standard uncertainties"
    return Section("Table and waveforms", (Table(caption, header, tuple(rows)), Paragraph(_HOW)))

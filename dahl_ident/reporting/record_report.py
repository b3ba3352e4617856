"""Report on a fit to records: result, budget, assumptions, figures, goodness of fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.data.laboratory import Metadata
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE
from dahl_ident.diagnostics.confidence_levels import percent as of_level
from dahl_ident.diagnostics.formatting import interval, percent, rounded
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.reporting import posterior_sections, provenance, tables
from dahl_ident.reporting.document import (
    MARKS,
    Block,
    Bullets,
    Cell,
    Document,
    Listing,
    Paragraph,
    Picture,
    Section,
    Table,
    figure_of,
    words,
)
from dahl_ident.reporting.figures import budget_picture
from dahl_ident.reporting.overlay import changes_section
from dahl_ident.reporting.sections import COVERAGE, RELATES, identity, in_words, short
from dahl_ident.results import RecordFit, RecordPosterior
from dahl_ident.results.changes import Change, changes, headline
from dahl_ident.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OUTPUTS = {
    "force": "The force is computed from the measured displacement, sample by sample.",
    "motion": "The equation of motion is integrated under the measured drive.",
}


def record_document(
    results: Sequence[RecordFit | RecordPosterior],
    *,
    title: str | None = None,
    command: str | None = None,
    metadata: Metadata | None = None,
) -> Document:
    """Return the report on one or several fits to records, and posteriors around them."""
    drawn = [result for result in results if isinstance(result, RecordPosterior)]
    fits = list(dict.fromkeys(r.fit if isinstance(r, RecordPosterior) else r for r in results))
    given = metadata or Metadata()
    several = len(fits) > 1
    changed = _changes(fits)
    front: list[Section] = []
    details: list[Section] = []
    for number, fit in enumerate(fits):
        of = f": {fit.problem.model!r}" if several else ""
        front += [Section(f"Result{of}", (_answer(fit), Paragraph(RELATES)))]
        details.append(Section(f"Pictures{of}", tuple(_pictures(fit, number)), details=True))
        if fit.status is not VerdictStatus.NOT_DESCRIBED and np.isfinite(fit.covar).all():
            found = fit.budget()
            front.append(
                Section(
                    f"Expanded uncertainty{of}", (tables.uncertainty(found), Paragraph(COVERAGE))
                )
            )
            details.append(
                Section(
                    f"Sources of uncertainty{of}",
                    (tables.budget(found), budget_picture(found)),
                    details=True,
                )
            )
        front.append(Section(f"What was assumed{of}", (Bullets(tuple(_assumed(fit))),)))
        derived = fit.derived() if fit.status is not VerdictStatus.NOT_DESCRIBED else ()
        lines = (*fit.goodness.lines, *(f"Derived: {quantity}" for quantity in derived))
        details.append(Section(f"Goodness of fit{of}", (Bullets(lines),), details=True))
    for one in drawn:
        front.append(Section("Posterior", tuple(posterior_sections.answer(one))))
        details += posterior_sections.sections(one)
    first = fits[0]
    files = [
        {"file": str(p["file"]), "sha256": str(p.get("sha256", "")), "read": True}
        for p in (record.provenance or {} for record in first.records)
        if "file" in p
    ]
    named = [f"{file['file']}, SHA-256 {short(str(file['sha256']))}" for file in files]
    origin: list[Block] = [
        Paragraph(f"Made on {provenance.today()}."),
        *([Listing(command)] if command else []),
    ]
    count = f"{len(first.records)} record{'s' if len(first.records) > 1 else ''}"
    name = files[0]["file"] if files else count
    header = given.lines | {
        "Model": tuple(in_words(first.problem.model)),
        "Data": (f"{count}, {first.problem.n_samples} samples", *named),
        "Date of report": (provenance.today(),),
        "Software": (f"dahl_ident {__version__}",),
    }
    if files:
        rows = tuple(words(str(file["file"]), str(file["sha256"])) for file in files)
        origin.append(Table("Files", ("file", "SHA-256"), rows))
    origin.append(Paragraph(f"Versions: {provenance.listed_versions()}."))
    order = list(MARKS)
    return Document(
        title=title or given.title or f"Friction identified from {name}",
        status=max((str(r.status) for r in (*fits, *drawn)), key=order.index),
        verdict=tuple(headline(changed) if changed else ())
        + tuple(
            f"{fit.problem.model!r}: {line}" if several and i == 0 else line
            for fit in fits
            for i, line in enumerate(fit.statements if several else map(str, fit.judgement.told))
        )
        + tuple(line for one in drawn for line in posterior_sections.verdict(one)),
        header=tuple(header.items()),
        sections=(
            *([changes_section(changed)] if changed else []),
            *front,
            *details,
            Section("Origin", tuple(origin), details=True),
        ),
        facts={
            "fits": [],
            "posteriors": [one.to_dict() for one in drawn],
            "record_fits": [_facts(fit) for fit in fits],
            "changes": [change.to_dict() for change in changed],
            "files": files,
            "metadata": given.facts(),
            "versions": provenance.versions(),
            "date": provenance.today(),
            "command": command,
        },
        identity=identity(given, [(str(f["file"]), str(f["sha256"])) for f in files]),
        signatory=given.signatory,
    )


def _changes(fits: Sequence[RecordFit]) -> list[Change]:
    """Return the changes between fits to different records; none between models of the same."""
    firsts = [fit.records[0] for fit in fits]
    channels = ("time", "displacement", "velocity", "acceleration", "force", "drive")
    for a, b in pairwise(firsts):
        if all(np.array_equal(getattr(a, name), getattr(b, name)) for name in channels):
            return []
    named = [Path(str((r.provenance or {}).get("file", "measurement"))).stem for r in firsts]
    names = [n if named.count(n) == 1 else f"{n} ({i})" for i, n in enumerate(named, 1)]
    return changes(dict(zip(names, fits, strict=True)))


def _answer(fit: RecordFit) -> Table:
    limits = fit.conf_interval().at(CONFIDENCE)
    unusable = not fit.status.usable
    rows = []
    for parameter in fit.problem.free:
        found = fit.params[parameter.name]
        value, error = rounded(found.value, found.stderr)
        rows.append(
            (
                Cell(found.name),
                Cell(value, found.value, unusable),
                Cell(error, found.stderr, unusable),
                Cell(interval(*limits[found.name][1:], ""), struck=unusable),
                Cell(found.unit or "-"),
                Cell(found.description),
            )
        )
    header = (
        "parameter", "estimate", "standard uncertainty u", f"{of_level(CONFIDENCE)} interval",
        "unit", "description",
    )  # fmt: skip
    hint = ". Numbers that are crossed out must not be used" if unusable else ""
    return Table(f"Estimates with their standard uncertainties{hint}", header, tuple(rows))


def _assumed(fit: RecordFit) -> Iterator[str]:
    yield _OUTPUTS[fit.problem.output]
    assumed = {one.name for one in fit.errors.exponents}
    fixed = [
        f"{p.name} = {p.value:g} {p.unit}".rstrip()
        for p in fit.params.values()
        if not p.vary and p.name not in assumed
    ]
    if fixed:
        yield f"Held fixed: {', '.join(fixed)}."
    for one in fit.errors.exponents:
        yield f"Not given: {one}; its range counts in the uncertainty."
    yield f"Taken as exact: {', '.join(fit.errors.exact)}."
    if fit.weighted:
        yield "Residuals are weighted by their spectrum, because slow noise dominates them."


def _pictures(fit: RecordFit, number: int) -> Iterator[Picture]:
    worst = fit.goodness.worst_record - 1
    of = f" of record {worst + 1}, which is described worst" if len(fit.records) > 1 else ""
    share = percent(fit.goodness.share_left**0.5)
    left = f"the residuals are {share} rms of the measured signal"
    shown = [
        ("time", f"Measured and fitted {fit.problem.output}{of}"),
        ("residuals", f"Residuals over time{of}"),
    ]
    if fit.records[worst].displacement is not None:
        shown.append(("loop", f"Force over displacement{of}"))
        shown.append(("residuals_displacement", f"Residuals over displacement{of}"))
    for kind, caption in shown:
        yield Picture(
            f"record_{kind}_{number + 1}",
            f"{caption}.",
            f"{caption}: {left}.",
            partial(_drawn, fit, kind, worst),
        )


def _drawn(fit: RecordFit, kind: str, record: int) -> Figure:
    return figure_of(fit.plot(kind, record=record))


def _facts(fit: RecordFit) -> dict[str, Any]:
    limits = fit.conf_interval().at(CONFIDENCE)
    return {
        "model": repr(fit.problem.model),
        "equations": list(in_words(fit.problem.model)),
        "status": str(fit.status),
        "trusted": fit.trusted,
        "verdict": fit.verdict,
        "findings": [finding.to_dict() for finding in fit.findings],
        "records": len(fit.records),
        "samples": fit.problem.n_samples,
        "share_of_variance_left": fit.goodness.share_left,
        "parameters": {
            name: {
                "value": e.value,
                "stderr": e.stderr,
                "unit": e.unit,
                "fixed": not e.vary,
                "interval_95.45": list(limits[name][1:]) if e.vary else None,
            }
            for name, e in fit.params.items()
        },
        "budget": fit.budget().to_dict(),
    }

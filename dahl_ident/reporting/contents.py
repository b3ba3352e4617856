"""What a report says, from results: verdict first, then numbers, pictures, judgement, origin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.diagnostics.comparison import compare_models
from dahl_ident.diagnostics.formatting import listed
from dahl_ident.reporting import posteriors, provenance, tables
from dahl_ident.reporting.document import (
    Block,
    Bullets,
    Document,
    Listing,
    Paragraph,
    Section,
    Table,
    words,
)
from dahl_ident.reporting.figures import pictures_of_fit
from dahl_ident.reporting.repeat import repeating_command
from dahl_ident.reporting.settling import settling
from dahl_ident.results import FitResult
from dahl_ident.results.posterior import Posterior

Result = FitResult | Posterior

NOISE = {
    "measured": "The covariance of every point is known from the measurement; residuals are in "
    "its units.",
    "relative": "The noise has the same relative size at every point: constant variance of the "
    "logarithm of the gain and of the phase. Its size was estimated from the residuals.",
    "absolute": "The noise has the same size at every point: constant variance of real and "
    "imaginary part. Its size was estimated from the residuals.",
}


def document(
    results: Sequence[Result],
    *,
    title: str | None = None,
    command: str | None = None,
    record: Record | None = None,
) -> Document:
    """Return the report on fits and posteriors of the same data."""
    fits = [result for result in results if isinstance(result, FitResult)]
    drawn = [result for result in results if isinstance(result, Posterior)]
    data = results[0].data
    repeated = command or repeating_command(results)
    sections = [section for fit in fits for section in _sections(fit, drawn, len(fits) > 1)]
    sections += [section for posterior in drawn for section in posteriors.sections(posterior)]
    return Document(
        title=title or _title(data),
        trusted=all(fit.trusted for fit in fits) and all(p.trusted for p in drawn),
        verdict=(
            *(line for fit in fits for line in _verdict(fit, len(fits) > 1)),
            *(line for posterior in drawn for line in posteriors.verdict(posterior)),
        ),
        sections=(
            *sections,
            *_extraction(data, record),
            Section("Data", tuple(_data(data))),
            Section("Origin", tuple(_origin(data, repeated, typed=command is not None))),
        ),
        facts={
            "fits": [_fit_facts(fit) for fit in fits],
            "posteriors": [posteriors.facts(posterior) for posterior in drawn],
            "files": dict(provenance.sources(data)),
            "versions": provenance.versions(),
            "date": provenance.today(),
            "command": repeated,
        },
    )


def _title(data: FrequencyResponse) -> str:
    files = [str(part["file"]) for part in provenance.parts(data) if "file" in part]
    return (
        f"Friction identified from {Path(files[0]).name}"
        if len(files) == 1
        else "Friction identified"
    )


def _verdict(fit: FitResult, several: bool) -> list[str]:
    """Return a fit's statements; among others its model and whether to trust it go first."""
    warnings = [f"Warning: {text}" for text in fit.goodness.warnings]
    first, *others = fit.statements
    if several:
        first = f"{fit.problem.model!r}: {first}"
    else:
        first = first.removeprefix("NOT to be trusted. ").removeprefix("To be trusted. ")
    return [first, *others, *warnings]


def _sections(fit: FitResult, drawn: Sequence[Posterior], several: bool) -> Iterator[Section]:
    of = f": {fit.problem.model!r}" if several else ""
    yield Section(f"Parameters{of}", tuple(_parameters(fit, drawn)))
    yield Section(f"Pictures{of}", tuple(pictures_of_fit(fit)))
    known = fit.identifiability
    yield Section(
        f"What the data determine{of}",
        (
            Paragraph(known.headline),
            Bullets(tuple(p.text for p in known.parameters.values())),
            Bullets(tuple(f"Determined: {c}" for c in known.combinations)),
        ),
    )
    yield Section(f"Noise and goodness of fit{of}", tuple(_goodness(fit)))
    equivalent = tables.equivalents(fit)
    if equivalent is not None:
        yield Section(f"Equivalent stiffness and damping{of}", (equivalent,))


def _parameters(fit: FitResult, drawn: Sequence[Posterior]) -> Iterator[Block]:
    for method in ("wald", "profile"):
        fit.conf_interval(method)
    intervals = fit.intervals_run(tables.LEVEL)
    yield tables.parameters(fit, intervals, drawn)
    by_note: dict[str, list[str]] = {}
    for found in intervals:
        by_note.setdefault(found.note, []).append(tables.method_name(found))
    notes = [f"Intervals by {listed(names)}: {note}" for note, names in by_note.items()]
    yield Bullets((*notes, *(f"Derived: {quantity}" for quantity in fit.derived())))


def _goodness(fit: FitResult) -> Iterator[Block]:
    left = fit.goodness
    yield Paragraph(NOISE[fit.noise])
    yield Bullets(tuple(left.details))
    yield tables.goodness(fit)
    if not left.acceptable:
        compared = compare_models(fit)
        yield Paragraph(f"Other models, compared and not claimed. {compared.headline}")
        yield tables.comparison(compared)


def _extraction(data: FrequencyResponse, record: Record | None) -> Iterator[Section]:
    """Yield how the points were measured, where they come from waveforms."""
    seen = () if record is None else (settling(data, record),)
    if "num_periods" not in data.quality:
        return
    verdicts = data.select(harmonic=1).quality["verdict"]
    bad = int((verdicts != "good").sum())
    says = f"{bad} of them not good" if bad else "all good"
    yield Section(
        "Extraction",
        (
            Paragraph(
                f"Points measured from waveforms: {verdicts.size}, {says}. Cycles left out "
                "are leading ones, in which friction still remembered the step before; the bias "
                "is what it may remember in the cycles used."
            ),
            tables.extraction(data),
            *seen,
        ),
    )


def _data(data: FrequencyResponse) -> Iterator[Block]:
    assumed = provenance.notes(data)
    if assumed:
        yield Bullets(tuple(assumed))
    yield tables.measured(data)


def _origin(data: FrequencyResponse, command: str | None, *, typed: bool) -> Iterator[Block]:
    files = list(provenance.sources(data))
    if files:
        rows = tuple(words(name, digest) for name, digest in files)
        yield Table("Files", ("file", "SHA-256"), rows)
    made = provenance.options(data)
    if made:
        yield Table("Options", ("option", "value"), tuple(words(*pair) for pair in made))
    used = tuple(words(name, version) for name, version in provenance.versions().items())
    yield Table("Versions", ("package", "version"), used)
    when = f"Made on {provenance.today()}"
    if command is None:
        yield Paragraph(f"{when}, in Python; no command describes this model and these data.")
        return
    how = (
        ". This command repeats it:"
        if typed
        else ", in Python. With all rows of the files, this gives the same on the command line:"
    )
    yield Paragraph(when + how)
    yield Listing(command)


def _fit_facts(fit: FitResult) -> dict[str, Any]:
    known, left = fit.identifiability, fit.goodness
    intervals = fit.conf_interval().at(0.9545)
    return {
        "model": repr(fit.problem.model),
        "trusted": fit.trusted,
        "verdict": fit.verdict,
        "status": fit.status.name.lower(),
        "noise": fit.noise,
        "scale": fit.scale,
        "scale_known": fit.scale_known,
        "parameters": {
            name: {
                "value": e.value,
                "stderr": e.stderr,
                "unit": e.unit,
                "fixed": not e.vary,
                "interval_95.45": list(intervals[name][1:]) if e.vary else None,
                "verdict": known.parameters[name].verdict.value if e.vary else None,
            }
            for name, e in fit.params.items()
        },
        "determined": [str(c) for c in known.combinations],
        "suspicious": [str(point) for point in left.suspicious],
        "warnings": list(left.warnings),
        "rms_misfit": left.rms_misfit,
        "redchi": fit.redchi,
        "aic": fit.aic,
        "bic": fit.bic,
    }

"""What a report says, from results: verdict first, then numbers, pictures, judgement, origin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from dahl_ident.diagnostics.identifiability import judged
from dahl_ident.diagnostics.intervals import profile_intervals, wald_intervals
from dahl_ident.reporting import provenance, tables
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
from dahl_ident.results import FitResult

NOISE = {
    "measured": "The covariance of every point is known from the measurement; residuals are in "
    "its units.",
    "relative": "The noise has the same relative size at every point: constant variance of the "
    "logarithm of the gain and of the phase. Its size was estimated from the residuals.",
    "absolute": "The noise has the same size at every point: constant variance of real and "
    "imaginary part. Its size was estimated from the residuals.",
}


def document(
    results: Sequence[FitResult], *, title: str | None = None, command: str | None = None
) -> Document:
    """Return the report on fits of one or several models."""
    first = results[0]
    sections = [section for fit in results for section in _sections(fit, len(results) > 1)]
    return Document(
        title=title or _title(first),
        trusted=all(fit.success for fit in results),
        verdict=tuple(line for fit in results for line in _verdict(fit)),
        sections=(
            *sections,
            Section("Data", tuple(_data(first))),
            Section("Origin", tuple(_origin(first, command))),
        ),
        facts=_facts(results, command),
    )


def _title(fit: FitResult) -> str:
    files = [name for name, _ in provenance.sources(fit.data)]
    return f"Friction identified from {files[0]}" if len(files) == 1 else "Friction identified"


def _verdict(fit: FitResult) -> list[str]:
    determined = judged(fit.optimum, profile_intervals(fit.optimum))
    return [fit.message, determined.headline]


def _sections(fit: FitResult, several: bool) -> Iterator[Section]:
    of = f": {fit.problem.model!r}" if several else ""
    intervals = [wald_intervals(fit.optimum), profile_intervals(fit.optimum)]
    notes = tuple(f"{one.method} intervals: {one.note}" for one in intervals)
    yield Section(f"Parameters{of}", (tables.parameters(fit, intervals), Bullets(notes)))
    yield Section(f"Pictures{of}", tuple(pictures_of_fit(fit)))
    determined = judged(fit.optimum, intervals[1])
    yield Section(
        f"What the data determine{of}",
        (
            Paragraph(determined.headline),
            Bullets(tuple(p.text for p in determined.parameters.values())),
            Bullets(tuple(f"Determined: {c}" for c in determined.combinations)),
        ),
    )
    yield Section(
        f"Noise and goodness of fit{of}", (Paragraph(NOISE[fit.noise]), tables.goodness(fit))
    )
    equivalent = tables.equivalents(fit)
    if equivalent is not None:
        yield Section(f"Equivalent stiffness and damping{of}", (equivalent,))


def _data(fit: FitResult) -> Iterator[Block]:
    assumed = provenance.notes(fit.data)
    if assumed:
        yield Bullets(tuple(assumed))
    yield tables.measured(fit.data)


def _origin(fit: FitResult, command: str | None) -> Iterator[Block]:
    files = list(provenance.sources(fit.data))
    if files:
        rows = tuple(words(name, digest) for name, digest in files)
        yield Table("Files", ("file", "SHA-256"), rows)
    made = provenance.options(fit.data)
    if made:
        yield Table("Options", ("option", "value"), tuple(words(*pair) for pair in made))
    used = tuple(words(name, version) for name, version in provenance.versions().items())
    yield Table("Versions", ("package", "version"), used)
    yield Paragraph(f"Made on {provenance.today()}. This command repeats it:")
    yield Listing(command or provenance.fit_command(fit))


def _facts(results: Sequence[FitResult], command: str | None) -> dict[str, Any]:
    return {
        "fits": [_fit_facts(fit) for fit in results],
        "files": dict(provenance.sources(results[0].data)),
        "versions": provenance.versions(),
        "date": provenance.today(),
        "command": command or provenance.fit_command(results[0]),
    }


def _fit_facts(fit: FitResult) -> dict[str, Any]:
    intervals = profile_intervals(fit.optimum).at(0.9545)
    return {
        "model": repr(fit.problem.model),
        "status": fit.status.name.lower(),
        "message": fit.message,
        "noise": fit.noise,
        "parameters": {
            name: {
                "value": e.value,
                "stderr": e.stderr,
                "unit": e.unit,
                "fixed": not e.vary,
                "interval_95.45": list(intervals[name][1:]) if e.vary else None,
            }
            for name, e in fit.params.items()
        },
        "redchi": fit.redchi,
        "aic": fit.aic,
        "bic": fit.bic,
    }

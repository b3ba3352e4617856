"""What a report says, from results: verdict first, then numbers, pictures, judgement, origin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.intervals import profile_intervals, wald_intervals
from dahl_ident.diagnostics.verdicts import judged
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
    results: Sequence[Result], *, title: str | None = None, command: str | None = None
) -> Document:
    """Return the report on fits and posteriors of the same data."""
    fits = [result for result in results if isinstance(result, FitResult)]
    drawn = [result for result in results if isinstance(result, Posterior)]
    data = results[0].data
    told = command or _command(results)
    sections = [section for fit in fits for section in _sections(fit, drawn, len(fits) > 1)]
    sections += [section for posterior in drawn for section in posteriors.sections(posterior)]
    return Document(
        title=title or _title(data),
        trusted=all(trusted(result) for result in results),
        verdict=(
            *(line for fit in fits for line in _verdict(fit)),
            *(line for posterior in drawn for line in posteriors.verdict(posterior)),
        ),
        sections=(
            *sections,
            Section("Data", tuple(_data(data))),
            Section("Origin", tuple(_origin(data, told))),
        ),
        facts={
            "fits": [_fit_facts(fit) for fit in fits],
            "posteriors": [posteriors.facts(posterior) for posterior in drawn],
            "files": dict(provenance.sources(data)),
            "versions": provenance.versions(),
            "date": provenance.today(),
            "command": told,
        },
    )


def trusted(result: Result) -> bool:
    """Return whether a result can be used as it is."""
    return result.success if isinstance(result, FitResult) else result.converged


def _command(results: Sequence[Result]) -> str:
    fits = [result for result in results if isinstance(result, FitResult)]
    return provenance.fit_command(fits[0]) if fits else "dahl-ident sample DATA.csv"


def _title(data: FrequencyResponse) -> str:
    files = [name for name, _ in provenance.sources(data)]
    return (
        f"Friction identified from {Path(files[0]).name}"
        if len(files) == 1
        else "Friction identified"
    )


def _verdict(fit: FitResult) -> list[str]:
    determined = judged(fit.optimum, profile_intervals(fit.optimum))
    return [fit.message, determined.headline]


def _sections(fit: FitResult, drawn: Sequence[Posterior], several: bool) -> Iterator[Section]:
    of = f": {fit.problem.model!r}" if several else ""
    intervals = [wald_intervals(fit.optimum), profile_intervals(fit.optimum)]
    notes = tuple(f"{one.method} intervals: {one.note}" for one in intervals)
    yield Section(f"Parameters{of}", (tables.parameters(fit, intervals, drawn), Bullets(notes)))
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


def _data(data: FrequencyResponse) -> Iterator[Block]:
    assumed = provenance.notes(data)
    if assumed:
        yield Bullets(tuple(assumed))
    yield tables.measured(data)


def _origin(data: FrequencyResponse, command: str) -> Iterator[Block]:
    files = list(provenance.sources(data))
    if files:
        rows = tuple(words(name, digest) for name, digest in files)
        yield Table("Files", ("file", "SHA-256"), rows)
    made = provenance.options(data)
    if made:
        yield Table("Options", ("option", "value"), tuple(words(*pair) for pair in made))
    used = tuple(words(name, version) for name, version in provenance.versions().items())
    yield Table("Versions", ("package", "version"), used)
    yield Paragraph(f"Made on {provenance.today()}. This command repeats it:")
    yield Listing(command)


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

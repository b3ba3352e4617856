"""Sections of a report, in this order: result, budget, assumptions, figures, details.

Fits of different data are shown side by side, with the significance of their changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.laboratory import Metadata
from dahl_ident.diagnostics.budget import Budget
from dahl_ident.diagnostics.comparison import compare_models, is_compared
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, level_text
from dahl_ident.diagnostics.formatting import listed, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.elements import Element
from dahl_ident.elements.element import as_model
from dahl_ident.errors import ValidationError
from dahl_ident.reporting import provenance, tables
from dahl_ident.reporting.comparison import KINDS, comparison_of, numbered, of_kind, side_by_side
from dahl_ident.reporting.document import (
    MARKS,
    Block,
    Bullets,
    Document,
    Listing,
    Paragraph,
    Section,
    TextTable,
    words,
)
from dahl_ident.reporting.figures import budget_picture, corner, pictures_of, settling, trace
from dahl_ident.results import FitResult, Posterior
from dahl_ident.results.fit_report import facts
from dahl_ident.version import __version__

Result = FitResult | Posterior

RELATES = "The results relate only to the item that was measured."
COVERAGE = (
    "The expanded uncertainty U is the combined standard uncertainty u times the coverage factor "
    f"k, for a coverage of about {level_text(CONFIDENCE)}."
)
_OF_CHAIN = (
    "mcse is the Monte Carlo standard error of the mean, ess the effective number of draws, r_hat "
    "compares independent ensembles and is 1 if they agree."
)
_MOST_FILES = 4  # most lines of files before the signature
_FACTS = {"table": "fits", "records": "record_fits"}  # names of fits in JSON, by kind of data
_FRONT = ("response", "residuals", "record")  # beginnings of names of the first pictures
_RANK = list(MARKS).index
"""Rank of a status, from good to bad."""


def document(
    results: Sequence[Result],
    *,
    title: str | None = None,
    command: str | None = None,
    record: Record | None = None,
    metadata: Metadata | None = None,
    apart: bool = False,
) -> Document:
    """Return the report on fits and posteriors of one table, of records, or of both.

    With `apart`, the results are fits of several tables, which are only compared.
    """
    known = metadata or Metadata()
    tables_first = sorted(results, key=lambda result: result.problem.response is None)
    if apart:
        content = _of_several_tables(results, known)
    else:
        content = _of_one_table(tables_first, known, record)
        typed = command is not None
        command = command or provenance.equivalent_command(results)
        origin = tuple(_origin(tables_first, command, typed=typed))
        sections = (*content.sections, Section("Origin", origin, details=True))
        content = replace(content, sections=sections)
    files = _files(tables_first)
    identity = [f"Report {known.number}"] if known.number else []
    sources = provenance.sources(tables_first[0].provenances)
    if read := [source for source in sources if source.read and source.sha256]:
        more = f" and {len(read) - 1} more" if len(read) > 1 else ""
        identity.append(f"{Path(read[0].file).name}, SHA-256 {_short(read[0].sha256)}{more}")
    return replace(
        content,
        title=title or known.title or content.title,
        identity=" \u00b7 ".join(identity),
        signatory=known.signatory,
        facts={
            **content.facts,
            "metadata": known.facts(),
            "files": [vars(source) for source in files],
            "versions": provenance.versions(),
            "date": provenance.today(),
            "command": command,
        },
    )


def _of_one_table(results: Sequence[Result], known: Metadata, record: Record | None) -> Document:
    """Return the report on fits and posteriors of one table, of records, or of both."""
    posteriors = [result for result in results if isinstance(result, Posterior)]
    around = [p.fit for p in posteriors if p.fit is not None and p.problem.around_optimum]
    fits = list(dict.fromkeys([*(r for r in results if isinstance(r, FitResult)), *around]))
    compared = comparison_of(fits)
    front = list(compared.sections)
    details = list[Section]()
    for fit in fits:
        suffix = _suffix(fit, fits)
        determined = tuple(f"Determined: {c}" for c in fit.identifiability.combinations)
        answer = (tables.answer(fit), Bullets(determined), Paragraph(RELATES))
        front.append(Section(f"Result{suffix}", answer))
        if (stated := _stated(fit)) is not None:
            combined = (tables.uncertainty(stated), Paragraph(COVERAGE))
            front.append(Section(f"Expanded uncertainty{suffix}", combined))
        front.append(Section(f"What was assumed{suffix}", (Bullets(tuple(_assumed(fit))),)))
        details += _details(fit, posteriors, suffix)
    for posterior in posteriors:
        if not fits or posterior.problem.around_optimum:
            priors = tuple(f"Prior of {name}: {text}" for name, text in posterior.priors.items())
            summary = tables.posterior_summary(posterior)
            front.append(Section("Posterior", (summary, Bullets(priors))))
        details += _posterior_details(posterior)
    if (data := results[0].problem.response) is not None:
        details += _extraction(data, record)
        details.append(Section("Data", (tables.measured(data),), details=True))
    verdict = [*compared.verdict, *(line for fit in fits for line in _verdict(fit, fits))]
    for posterior in posteriors:
        verdict += [f"Posterior: {finding}" for finding in posterior.findings]
    parts = provenance.parts(results[0].provenances)
    files = [Path(str(part["file"])).name for part in parts if "file" in part]
    return Document(
        title=f"Friction identified{f' from {files[0]}' if len(files) == 1 else ''}",
        status=max((*(str(r.status) for r in (*fits, *posteriors)), *compared.status), key=_RANK),
        verdict=tuple(dict.fromkeys(verdict)),
        header=_header(results, known),
        sections=tuple(section for section in (*front, *details) if section.blocks),
        facts={
            **{name: list(map(_fit_facts, of_kind(kind, fits))) for kind, name in _FACTS.items()},
            "posteriors": [posterior.to_dict() for posterior in posteriors],
            **compared.facts,
        },
    )


def _of_several_tables(results: Sequence[Result], known: Metadata) -> Document:
    """Return the comparison of fits of different tables, each with the one before it."""
    fits = [result for result in results if isinstance(result, FitResult)]
    if len(fits) < len(results):
        raise ValidationError(
            "results on different data are compared only where all are fits; write a report for "
            "each"
        )
    units = {fit.data.unit for fit in fits}
    if len(units) > 1:
        raise ValidationError(f"the fits measure in different units: {', '.join(sorted(units))}")
    named = []
    for i, fit in enumerate(fits, 1):
        parts = provenance.parts(fit.provenances)
        files = [Path(str(part["file"])).stem for part in parts if "file" in part]
        named.append(files[0] if len(files) == 1 else f"measurement {i}")
    names = numbered(named)
    headers = [dict(_header([fit], known)) for fit in fits]
    rows = dict(headers[0])
    rows["Model"] = tuple(dict.fromkeys(line for header in headers for line in header["Model"]))
    rows["Data"] = tuple(
        f"{name}: {'; '.join(header['Data'])}" for name, header in zip(names, headers, strict=True)
    )
    compared = side_by_side(names, fits)
    return Document(
        title=f"Comparison of {', '.join(names)}",
        status=max((str(fit.status) for fit in fits), key=_RANK),
        verdict=compared.verdict,
        header=tuple(rows.items()),
        sections=compared.sections,
        facts={
            "fits": [{"name": n} | _fit_facts(fit) for n, fit in zip(names, fits, strict=True)],
            "posteriors": [],
            **compared.facts,
        },
    )


def _suffix(fit: FitResult, fits: Sequence[FitResult]) -> str:
    """Return the end of headings that distinguishes a fit from the others of a report."""
    alike = of_kind(fit.problem.kind, fits)
    parts = [repr(fit.problem.model)] if len(alike) > 1 else []
    if len(alike) < len(fits):
        parts.append(KINDS[fit.problem.kind].lower())
    return f": {', '.join(parts)}" if parts else ""


def _short(sha256: str) -> str:
    """Return the beginning of a hash, which the section on the origin shows in full."""
    return f"{sha256[:12]}..." if sha256 else "unknown"


def _files(results: Sequence[Result]) -> list[provenance.SourceFile]:
    """Return every file once, in the order of the results."""
    files = (source for r in results for source in provenance.sources(r.provenances))
    return list(dict.fromkeys(files))


def _header(
    results: Sequence[Result], metadata: Metadata
) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return specimen, model, data, instruments, operator, dates and software."""
    stated = metadata.lines
    first = [name for name in ("Laboratory", "Customer", "Specimen") if name in stated]
    files = []
    for source in _files(results):
        before = "" if source.read else "made from "
        files.append(f"{before}{source.file}, SHA-256 {_short(source.sha256)}")
    if len(files) > _MOST_FILES:
        more = len(files) - _MOST_FILES + 1
        files[_MOST_FILES - 1 :] = [f"and {more} more files, listed under Origin"]
    rows = {name: stated.pop(name) for name in first} | {
        "Model": tuple(in_words(results[0].problem.model)),
        "Data": (*dict.fromkeys(result.problem.extent for result in results), *files),
        **stated,
        "Date of report": (provenance.today(),),
        "Software": (f"dahl_ident {__version__}",),
    }
    return tuple(rows.items())


def in_words(model: Element) -> Iterator[str]:
    """Yield the names of the model's elements, then their equations."""
    elements = as_model(model).elements
    kinds = [element.kind.replace("_", " ") or type(element).__name__ for element in elements]
    names = [
        f"{kind[0].upper()}{kind[1:]} friction" if element.has_memory else kind
        for kind, element in zip(kinds, elements, strict=True)
    ]
    if len(elements) > 1 or not elements[0].equation:
        yield " + ".join(names)
    for name, element in zip(names, elements, strict=True):
        if element.equation:
            yield f"{name}: {element.equation}"


def _verdict(fit: FitResult, fits: Sequence[FitResult]) -> Iterator[str]:
    """Yield a fit's statements; with several fits, model and status come first."""
    alike = len(of_kind(fit.problem.kind, fits))
    before = "" if alike == len(fits) else f"{KINDS[fit.problem.kind]}: "
    if alike > 1:
        first, *others = fit.statements
        lines = [f"{fit.problem.model!r}: {first}", *others]
    else:
        lines = [*map(str, fit.judgement.shown)]
    warnings = (f"Warning: {text}" for text in fit.goodness.warnings)
    yield from (f"{before}{line}" for line in (*lines, *warnings))


def _stated(fit: FitResult) -> Budget | None:
    """Return the uncertainty budget; None where no uncertainty can be stated."""
    return None if fit.status is VerdictStatus.NOT_DESCRIBED else fit.stated_budget


def _assumed(fit: FitResult) -> Iterator[str]:
    """Yield the assumptions of the result that these data do not test."""
    sensors = [p.name for p in fit.problem.sensors.parameters]
    held = [p for p in fit.params.values() if not p.vary and p.name not in (*fit.assumed, *sensors)]
    fixed = [f"{p.name} = {p.value:g} {p.unit}".rstrip() for p in held]
    if fixed:
        yield f"Held fixed: {listed(fixed)}."
    for p in (fit.params[name] for name in fit.assumed):
        value = with_unit(p.value, p.stderr, p.unit)
        yield f"Not given, so that the uncertainty counts it: {p.name}, here {value}."
    if exact := fit.assessment.exact:
        yield f"Taken as exact: {listed(exact)}."
    yield from (f"Prior of {name}: {text}." for name, text in tables.priors_in_words(fit))
    yield f"Noise: {fit.assessment.noise_in_words[0]}."
    for note in provenance.notes(fit.provenances):
        yield f"{note[0].upper()}{note[1:]}."
    yield f"Search: {fit.method}, loss {fit.optimum.loss}."


def _details(fit: FitResult, posteriors: Sequence[Posterior], suffix: str) -> Iterator[Section]:
    """Yield the sections after the signature."""

    def section(title: str, *blocks: Block) -> Section:
        return Section(f"{title}{suffix}", blocks, details=True)

    pictures = list(pictures_of(fit))
    yield section("Pictures", *(p for p in pictures if p.name.startswith(_FRONT)))
    if (stated := _stated(fit)) is not None:
        yield section("Sources of uncertainty", tables.budget(stated), budget_picture(stated))
    yield section("Parameters", *_parameters(fit, posteriors))
    known = fit.identifiability
    texts = Bullets(tuple(p.text for p in known.parameters.values()))
    yield section("What the data determine", Paragraph(known.headline), texts)
    yield section("Noise and goodness of fit", *_goodness(fit))
    if (linearization := tables.linearization(fit)) is not None:
        yield section("Stiffness and damping over amplitude", linearization)
    yield section("More pictures", *(p for p in pictures if not p.name.startswith(_FRONT)))


def _parameters(fit: FitResult, posteriors: Sequence[Posterior]) -> Iterator[Block]:
    for method in ("wald",) if fit.first_order else fit.assessment.quick_methods:
        fit.conf_interval(method)
    intervals = fit.assessment.computed_intervals(CONFIDENCE)
    alike = of_kind(fit.problem.kind, posteriors)
    yield tables.parameters(fit, intervals, alike)
    by_note: dict[str, list[str]] = {}
    for of_method in intervals:
        by_note.setdefault(of_method.note, []).append(tables.method_name(of_method))
    notes = [f"Intervals by {listed(names)}: {note}" for note, names in by_note.items()]
    derived = fit.derived() if fit.status is not VerdictStatus.NOT_DESCRIBED else ()
    yield Bullets((*notes, *(f"Derived: {quantity}" for quantity in derived)))


def _goodness(fit: FitResult) -> Iterator[Block]:
    yield Bullets((*map(str, fit.judgement.supporting), *fit.goodness.details))
    yield tables.goodness(fit)
    if is_compared(fit):
        compared = compare_models(fit)
        yield Paragraph(f"Other models, for comparison. {compared.headline}")
        yield from tables.comparison(compared)


def _posterior_details(posterior: Posterior) -> Iterator[Section]:
    """Yield numbers, convergence and pictures."""
    priors = tuple(f"{name}: {text}" for name, text in posterior.priors.items())
    numbers: list[Block] = [
        tables.posterior_summary(posterior),
        Paragraph(f"Priors (likelihood: {posterior.likelihood.replace('_', ' ')}):"),
        Bullets(priors),
        Bullets(tuple(map(str, posterior.findings))),
    ]
    pictures = [corner(posterior)]
    if posterior.is_chain:
        numbers.insert(1, Paragraph(_OF_CHAIN))
        numbers.append(Paragraph(f"Seed {posterior.seed}; the same seed gives the same chain."))
        pictures.append(trace(posterior))
    yield Section("Posterior", tuple(numbers), details=True)
    yield Section("Pictures of the posterior", tuple(pictures), details=True)


def _extraction(data: FrequencyResponse, record: Record | None) -> Iterator[Section]:
    """Yield how the points were measured, if they were extracted from waveforms."""
    pictures = () if record is None else (settling(data, record),)  # checks the record
    if "num_periods" not in data.quality:
        return
    verdicts = data.select(harmonic=1).quality["verdict"]
    bad = int((verdicts != "good").sum())
    quality = f"{bad} of them not good" if bad else "all good"
    yield Section(
        "Extraction",
        (
            Paragraph(
                f"Points measured from waveforms: {verdicts.size}, {quality}. Leading cycles are "
                "left out if friction had not yet settled after the previous step; the bias is an "
                "upper bound for the remaining transient in the cycles used."
            ),
            tables.extraction(data),
            *pictures,
        ),
        details=True,
    )


def _origin(results: Sequence[Result], command: str | None, *, typed: bool) -> Iterator[Block]:
    if files := _files(results):
        rows = tuple(
            words(s.file, "read" if s.read else "origin of the file above", s.sha256) for s in files
        )
        yield TextTable("Files", ("file", "what it is", "SHA-256"), rows)
    options = dict(pair for r in results for pair in provenance.options(r.provenances))
    if options:
        rows = tuple(words(*pair) for pair in options.items())
        yield TextTable("Options", ("option", "value"), rows)
    versions = ", ".join(f"{name} {version}" for name, version in provenance.versions().items())
    yield Paragraph(f"Versions: {versions}.")
    when = f"Made on {provenance.today()}"
    if command is None:
        yield Paragraph(f"{when}, in Python; no command describes this model and these data.")
        return
    if typed:
        yield Paragraph(f"{when}. This command reproduces it:")
    else:
        how = "With all rows of the files, this command gives the same result:"
        yield Paragraph(f"{when}, in Python. {how}")
    yield Listing(command)


def _fit_facts(fit: FitResult) -> dict[str, Any]:
    """Return a fit as plain data for JSON."""
    intervals, judged = fit.conf_interval().at(CONFIDENCE), fit.identifiability.parameters
    return {
        "model": repr(fit.problem.model),
        "equations": list(in_words(fit.problem.model)),
        **facts(fit),
        "parameters": {
            name: {
                "value": e.value,
                "stderr": e.stderr,
                "unit": e.unit,
                "fixed": not e.vary and name not in fit.assumed,
                "assumed": name in fit.assumed,
                "interval_95.45": list(intervals[name][1:]) if name in intervals else None,
                "verdict": judged[name].verdict.value if name in judged else None,
            }
            for name, e in fit.params.items()
        },
        "priors": {n: tables.prior_text(prior) for n, prior in fit.problem.priors.items()},
    }

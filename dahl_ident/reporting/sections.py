"""Sections of a report, in this order: result, budget, assumptions, figures, details."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.laboratory import Metadata
from dahl_ident.diagnostics.budget import taken_as_exact
from dahl_ident.diagnostics.comparison import compare_models
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, percent
from dahl_ident.diagnostics.formatting import listed, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.elements import Element
from dahl_ident.elements.element import as_model
from dahl_ident.reporting import posterior_sections, provenance, tables
from dahl_ident.reporting.document import (
    MARKS,
    Block,
    Bullets,
    Document,
    Listing,
    Paragraph,
    Picture,
    Section,
    Table,
    words,
)
from dahl_ident.reporting.equivalent_command import equivalent_command
from dahl_ident.reporting.figures import budget_picture, pictures_of_fit
from dahl_ident.reporting.settling import settling
from dahl_ident.results import FitResult, Posterior
from dahl_ident.version import __version__

Result = FitResult | Posterior

NOISE = {
    "measured": "The covariance of every point is known from the measurement; residuals are in "
    "its units.",
    "relative": "The noise has the same relative size at every point: constant variance of the "
    "logarithm of the gain and of the phase. Its size was estimated from the residuals.",
    "absolute": "The noise has the same size at every point: constant variance of real and "
    "imaginary part. Its size was estimated from the residuals.",
}
RELATES = "The results relate only to the item that was measured."
COVERAGE = (
    "The expanded uncertainty U is the combined standard uncertainty u times the coverage factor "
    f"k, for a coverage of about {percent(CONFIDENCE)}."
)
_MOST_FILES = 4  # lines of them before the signature
_FRONT = ("response", "residuals")  # pictures before the details


def document(
    results: Sequence[Result],
    *,
    title: str | None = None,
    command: str | None = None,
    record: Record | None = None,
    metadata: Metadata | None = None,
) -> Document:
    """Return the report on fits and posteriors of the same data."""
    fits = [result for result in results if isinstance(result, FitResult)]
    drawn = [result for result in results if isinstance(result, Posterior)]
    data = results[0].data
    given = metadata or Metadata()
    repeated = command or equivalent_command(results)
    front, details = [], []
    for fit in fits:
        of = f": {fit.problem.model!r}" if len(fits) > 1 else ""
        pictures = list(pictures_of_fit(fit))
        front += list(_answer(fit, of))
        front.append(Section(f"Expanded uncertainty{of}", tuple(_budget(fit))))
        front.append(Section(f"What was assumed{of}", tuple(_assumed(fit))))
        shown = tuple(picture for picture in pictures if picture.name in _FRONT)
        details.append(Section(f"Pictures{of}", shown, details=True))
        details += list(_details(fit, drawn, pictures, of))
    if not fits:
        front += [Section("Result", tuple(posterior_sections.answer(one))) for one in drawn]
    details += [section for one in drawn for section in posterior_sections.sections(one)]
    return Document(
        title=title or given.title or title_of(data),
        status=worst_status(results),
        verdict=(
            *(line for fit in fits for line in _verdict(fit, len(fits) > 1)),
            *(line for one in drawn for line in posterior_sections.verdict(one)),
        ),
        header=header(results[0], given),
        sections=(
            *(section for section in front if section.blocks),
            *(section for section in details if section.blocks),
            *_extraction(data, record),
            Section("Data", tuple(_data(data)), details=True),
            Section(
                "Origin", tuple(_origin(data, repeated, typed=command is not None)), details=True
            ),
        ),
        facts={
            "fits": [fit_facts(fit) for fit in fits],
            "posteriors": [one.to_dict() for one in drawn],
            "metadata": given.facts(),
            **origin_facts(data),
            "command": repeated,
        },
        **signed(given, data),
    )


def signed(given: Metadata, data: FrequencyResponse | None) -> dict[str, Any]:
    """Return what identifies the report on every page, and who signs it."""
    files = [] if data is None else [s for s in provenance.sources(data) if s.read and s.sha256]
    return {
        "identity": identity(given, [(source.file, source.sha256) for source in files]),
        "signatory": given.signatory,
    }


def identity(given: Metadata, files: Sequence[tuple[str, str]]) -> str:
    """Return the number of a report and the hash of its first file, for every page."""
    parts = [f"Report {given.number}"] if given.number else []
    if files:
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        name, sha256 = files[0]
        parts.append(f"{Path(name).name}, SHA-256 {short(sha256)}{more}")
    return " \u00b7 ".join(parts)


def short(sha256: str) -> str:
    """Return the beginning of a hash; the whole one stands under the origin."""
    return f"{sha256[:12]}..." if sha256 else "unknown"


def origin_facts(data: FrequencyResponse) -> dict[str, Any]:
    """Return files, versions and date for machines."""
    return {
        "files": [vars(source) for source in provenance.sources(data)],
        "versions": provenance.versions(),
        "date": provenance.today(),
    }


def title_of(data: FrequencyResponse) -> str:
    """Return a title that names the file, where there is one."""
    files = [str(part["file"]) for part in provenance.parts(data) if "file" in part]
    return (
        f"Friction identified from {Path(files[0]).name}"
        if len(files) == 1
        else "Friction identified"
    )


def worst_status(results: Sequence[Result]) -> str:
    """Return the worst status of the results."""
    order = list(MARKS)
    return max((str(result.status) for result in results), key=order.index)


def header(result: Result, given: Metadata) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return specimen, model, data, instruments, operator, dates and software."""
    data = result.data
    of_laboratory = given.lines
    specimen = {"Specimen": of_laboratory.pop("Specimen")}
    first = {
        name: of_laboratory.pop(name)
        for name in ("Laboratory", "Customer")
        if name in of_laboratory
    }
    files = []
    for source in provenance.sources(data):
        before = "" if source.read else "made from "
        files.append(f"{before}{source.file}, SHA-256 {short(source.sha256)}")
    if len(files) > _MOST_FILES:
        more = len(files) - _MOST_FILES + 1
        files[_MOST_FILES - 1 :] = [f"and {more} more files, listed under Origin"]
    made_of = {
        "Model": tuple(in_words(result.problem.model)),
        "Data": (f"{data.n} rows", *files),
    }
    software = {
        "Date of report": (provenance.today(),),
        "Software": (f"dahl_ident {__version__}",),
    }
    return tuple((first | specimen | made_of | of_laboratory | software).items())


def in_words(model: Element) -> Iterator[str]:
    """Yield the model in words, then an equation for each of its elements."""
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


def _verdict(fit: FitResult, several: bool) -> list[str]:
    """Return a fit's statements; if there are several fits, model and status come first."""
    warnings = [f"Warning: {text}" for text in fit.goodness.warnings]
    if not several:
        return [*map(str, fit.judgement.told), *warnings]
    first, *others = fit.statements
    return [f"{fit.problem.model!r}: {first}", *others, *warnings]


def _answer(fit: FitResult, of: str) -> Iterator[Section]:
    known = fit.identifiability
    described = fit.status.usable or fit.goodness.acceptable
    determined = tuple(f"Determined: {c}" for c in known.combinations)
    yield Section(
        f"Result{of}",
        (
            tables.answer(fit, described=described),
            Bullets(determined),
            Paragraph(RELATES),
        ),
    )


def _budget(fit: FitResult) -> Iterator[Block]:
    """Yield the combined uncertainties; nothing if none can be stated."""
    stated = fit.stated_budget
    if fit.status != VerdictStatus.NOT_DESCRIBED and stated is not None:
        yield tables.uncertainty(stated)
        yield Paragraph(COVERAGE)


def _sources(fit: FitResult) -> Iterator[Block]:
    """Yield every source of uncertainty of every parameter."""
    stated = fit.stated_budget
    if fit.status != VerdictStatus.NOT_DESCRIBED and stated is not None:
        yield tables.budget(stated)
        yield budget_picture(stated)


def _assumed(fit: FitResult) -> Iterator[Block]:
    """Yield the assumptions of the result that these data do not test."""
    errors = fit.errors
    counted = () if errors is None else errors.assumed
    sensors = [p.name for p in fit.problem.sensors.parameters]
    held = [p for p in fit.params.values() if not p.vary and p.name not in (*counted, *sensors)]
    fixed = [_value(p.name, p.value, p.unit) for p in held]
    exact = taken_as_exact(fit.optimum)
    lines = [f"Held fixed: {listed(fixed)}."] if fixed else []
    if errors is not None:
        lines += [
            f"Not given, so that the uncertainty counts it: {name}, here "
            f"{with_unit(errors.values[name], errors.stderr[name], fit.params[name].unit)}."
            for name in counted
        ]
    if exact:
        lines.append(f"Taken as exact: {listed(exact)}.")
    lines += [f"Prior of {name}: {given}." for name, given in tables.priors_in_words(fit)]
    lines.append(NOISE[fit.noise])
    lines += [f"{note[0].upper()}{note[1:]}." for note in provenance.notes(fit.data)]
    lines.append(f"Search: {fit.method}, loss {fit.optimum.loss}.")
    yield Bullets(tuple(lines))


def _value(name: str, value: float, unit: str) -> str:
    return f"{name} = {value:g} {unit}".rstrip()


def _details(
    fit: FitResult, drawn: Sequence[Posterior], pictures: Sequence[Picture], of: str
) -> Iterator[Section]:
    if sources := tuple(_sources(fit)):
        yield Section(f"Sources of uncertainty{of}", sources, details=True)
    yield Section(f"Parameters{of}", tuple(_parameters(fit, drawn)), details=True)
    known = fit.identifiability
    yield Section(
        f"What the data determine{of}",
        (Paragraph(known.headline), Bullets(tuple(p.text for p in known.parameters.values()))),
        details=True,
    )
    yield Section(f"Noise and goodness of fit{of}", tuple(_goodness(fit)), details=True)
    linearization = tables.linearization(fit)
    if linearization is not None:
        yield Section(f"Stiffness and damping over amplitude{of}", (linearization,), details=True)
    others = tuple(picture for picture in pictures if picture.name not in _FRONT)
    yield Section(f"More pictures{of}", others, details=True)


def _parameters(fit: FitResult, drawn: Sequence[Posterior]) -> Iterator[Block]:
    fit.conf_interval("wald")
    if not fit.first_order:
        fit.conf_interval("profile")
    intervals = fit.intervals_run(CONFIDENCE)
    yield tables.parameters(fit, intervals, drawn)
    by_note: dict[str, list[str]] = {}
    for one in intervals:
        by_note.setdefault(one.note, []).append(tables.method_name(one))
    notes = [f"Intervals by {listed(names)}: {note}" for note, names in by_note.items()]
    derived = fit.derived() if fit.status is not VerdictStatus.NOT_DESCRIBED else ()
    yield Bullets((*notes, *(f"Derived: {quantity}" for quantity in derived)))


def _goodness(fit: FitResult) -> Iterator[Block]:
    left = fit.goodness
    yield Bullets(tuple(left.details))
    yield tables.goodness(fit)
    if not left.acceptable:
        compared = compare_models(fit)
        yield Paragraph(f"Other models, for comparison. {compared.headline}")
        yield tables.comparison(compared)
        yield tables.meanings(compared)


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
                f"Points measured from waveforms: {verdicts.size}, {says}. Leading cycles are left "
                "out if friction had not yet settled after the previous step; the bias is an "
                "upper bound for the remaining transient in the cycles used."
            ),
            tables.extraction(data),
            *seen,
        ),
        details=True,
    )


def _data(data: FrequencyResponse) -> Iterator[Block]:
    yield tables.measured(data)


def _origin(data: FrequencyResponse, command: str | None, *, typed: bool) -> Iterator[Block]:
    files = list(provenance.sources(data))
    if files:
        rows = tuple(
            words(s.file, "read" if s.read else "origin of the file above", s.sha256) for s in files
        )
        yield Table("Files", ("file", "what it is", "SHA-256"), rows)
    made = provenance.options(data)
    if made:
        yield Table("Options", ("option", "value"), tuple(words(*pair) for pair in made))
    yield Paragraph(f"Versions: {provenance.listed_versions()}.")
    when = f"Made on {provenance.today()}"
    if command is None:
        yield Paragraph(f"{when}, in Python; no command describes this model and these data.")
        return
    how = (
        ". This command reproduces it:"
        if typed
        else ", in Python. With all rows of the files, this command gives the same result:"
    )
    yield Paragraph(when + how)
    yield Listing(command)


def fit_facts(fit: FitResult) -> dict[str, Any]:
    """Return a fit for machines."""
    known, left = fit.identifiability, fit.goodness
    intervals = fit.conf_interval().at(CONFIDENCE)
    return {
        "model": repr(fit.problem.model),
        "equations": list(in_words(fit.problem.model)),
        "status": str(fit.status),
        "trusted": fit.trusted,
        "verdict": fit.verdict,
        "findings": [finding.to_dict() for finding in fit.findings],
        "search": fit.optimum.status.name.lower().replace("_", " "),
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
        "budget": None if fit.stated_budget is None else fit.stated_budget.to_dict(),
        "priors": tables.priors(fit),
        "determined": [str(c) for c in known.combinations],
        "suspicious": [str(point) for point in left.suspicious],
        "warnings": list(left.warnings),
        "rms_misfit": left.rms_misfit,
        "redchi": fit.redchi,
        "aic": fit.aic,
        "bic": fit.bic,
    }

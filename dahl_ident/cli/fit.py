"""``dahl-ident fit``: from tables to estimates with their verdict."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.distributions import values
from dahl_ident.cli.files import written
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import STANDARD, Files, General, Reading, Writing, one_of
from dahl_ident.errors import FitInterrupted

if TYPE_CHECKING:
    from dahl_ident.data import Record
    from dahl_ident.results import ChainPosterior, FitResult, RecordFit, RecordPosterior
    from dahl_ident.results.result import Result

_ESTIMATING = "Estimating"
TAKEN = ("model", "free", "fixed", "start")  # by a fit of records
ReportPlace = Annotated[
    str | None,
    typer.Option(help="Report to write: .html, .pdf, .md or .json; - is HTML on standard output."),
]

AsRecords = Annotated[
    bool, typer.Option("--record", help="The files are records of any motion; each is a run.")
]


@dataclass(frozen=True)
class Estimating:
    """Estimation; the options of ``fit``."""

    method: Annotated[
        str,
        typer.Option(
            help="lm, scipy (least_squares) or ipopt (exact second derivatives).",
            callback=one_of("lm", "scipy", "ipopt"),
            rich_help_panel=_ESTIMATING,
        ),
    ] = "lm"
    noise: Annotated[
        str | None,
        typer.Option(
            help="measured, relative or absolute; by default measured if a covariance is known.",
            rich_help_panel=_ESTIMATING,
        ),
    ] = None
    loss: Annotated[
        str,
        typer.Option(
            help="linear, huber, soft_l1 or student_t; all but the first down-weight outliers.",
            rich_help_panel=_ESTIMATING,
        ),
    ] = "linear"
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Additional initial value for the search, f_max=0.1; once for each parameter.",
            rich_help_panel=_ESTIMATING,
        ),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``fit``."""
        start = values("start", self.start) if self.start else None
        return {**vars(self), "start": start}


@with_option_groups
def fit(
    files: Files,
    general: General,
    reading: Reading,
    model: ModelOptions,
    estimating: Estimating,
    writing: Writing,
    report: ReportPlace = None,
    save: Annotated[
        Path | None, typer.Option(help="JSON file for the fit, which report and Python can load.")
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print all sections, not only the first two.")
    ] = False,
    compare: Annotated[
        bool, typer.Option("--compare", help="Compare with other models of the friction.")
    ] = False,
    record: AsRecords = False,
) -> None:
    """Estimate a model's parameters, and state whether the data determine them.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    from dahl_ident.data.storage import place_of
    from dahl_ident.diagnostics.comparison import compare_models
    from dahl_ident.results.result import FORMATS

    writing.check([report, save], files, json=general.json)
    check_reports(report)
    if save is not None:
        place_of(save, "a fit", FORMATS)
    if record:
        _fit_records(files, general, model, estimating, writing, report, save)
        return
    result = fitted(files, reading, model, estimating)
    if save is not None:
        result.save(save, overwrite=writing.overwrite)
    if general.json:
        console.write_json(as_json(result))
    elif report != STANDARD:
        console.write_wrapped(result.fit_report(details=verbose))
        if compare:
            console.write(str(compare_models(result)))
        if not verbose:
            console.write("-v prints tests of the residuals, other models and the solver's numbers")
    if report is not None:
        write_report_beside([result], report, writing)
    finish(result)


def read_records(files: list[str]) -> list[Record]:
    """Return the records of the files, each a run."""
    from dahl_ident.data import read_record

    return [read_record(name) for name in files]


def _fit_records(
    files: list[str],
    general: General,
    model: ModelOptions,
    estimating: Estimating,
    writing: Writing,
    report: str | None,
    save: Path | None,
) -> None:
    """Fit records of any motion sample by sample."""
    from dahl_ident.results import fit as fit_data

    how = {k: v for k, v in {**model.keywords(), **estimating.keywords()}.items() if k in TAKEN}
    try:
        result = fit_data(read_records(files), throw=False, progress=sys.stderr.isatty(), **how)
    except FitInterrupted as stop:
        console.write(stop.result.fit_report())
        raise
    if save is not None:
        result.save(save, overwrite=writing.overwrite)
    if general.json:
        console.write_json(
            {
                "status": str(result.status),
                "verdict": result.verdict,
                "params": {name: vars(p) for name, p in result.params.items()},
            }
        )
    elif report != STANDARD:
        console.write(result.fit_report())
    if report is not None:
        write_report_beside([result], report, writing)
    console.finish(result.status.usable, result.statements[0].partition(". ")[2])


def fitted(
    files: list[str], reading: Reading, model: ModelOptions, estimating: Estimating
) -> FitResult:
    """Return the fit of the model to the files."""
    from dahl_ident.results import fit as fit_data

    how = {**model.keywords(), **estimating.keywords()}
    return fit_data(reading.read(files), throw=False, **how)


def check_reports(*places: str | None) -> None:
    """Refuse reports of an unknown kind before any work is done."""
    from dahl_ident.data.storage import place_of

    for place in places:
        if place is not None and place != STANDARD:
            from dahl_ident.reporting.publish import FORMATS

            place_of(place, "a report", FORMATS)


def write_report(
    results: Sequence[FitResult | ChainPosterior | RecordFit | RecordPosterior],
    place: str,
    writing: Writing,
    **how: Any,
) -> str:
    """Write a report, as HTML where that is standard output, and return where it is.

    `how` are further arguments of ``report``.
    """
    from functools import partial

    from dahl_ident.reporting import report

    options = {**how, "command": console.typed_command(), "overwrite": writing.overwrite}
    write = partial(report, list(results), **options)
    return written(write, place, ".html")


def write_report_beside(
    results: Sequence[FitResult | ChainPosterior | RecordFit | RecordPosterior],
    place: str,
    writing: Writing,
) -> None:
    """Write a report in addition to other output, and print its path."""
    written_to = write_report(results, place, writing)
    if written_to != STANDARD:
        console.write_error(f"report: {written_to}")


def as_json(result: FitResult) -> dict[str, Any]:
    """Return a fit as plain data."""
    from dahl_ident.diagnostics.confidence_levels import CONFIDENCE

    limits = result.conf_interval().at(CONFIDENCE)
    return {
        "status": str(result.status),
        "trusted": result.trusted,
        "verdict": result.verdict,
        "success": result.success,
        "message": result.message,
        "params": {
            name: {**vars(estimate), "interval": limits[name] if estimate.vary else None}
            for name, estimate in result.params.items()
        },
        "determined": [str(c) for c in result.identifiability.combinations],
        "warnings": list(result.goodness.warnings),
        "suspicious": [str(point) for point in result.goodness.suspicious],
        "noise": result.noise,
        "scale": result.scale,
        "redchi": result.redchi,
    }


def finish(result: Result) -> None:
    """End with status 3 if the result cannot be used."""
    console.finish(result.status.usable, result.statements[0].partition(". ")[2])

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
from dahl_ident.cli.options import (
    STANDARD,
    Channels,
    Files,
    General,
    Laws,
    Reading,
    Writing,
    in_panel,
    noise_option,
    one_of,
    steady_option,
)
from dahl_ident.errors import DataError, FitInterrupted, ValidationError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record
    from dahl_ident.results import ChainPosterior, FitResult, RecordFit, RecordPosterior
    from dahl_ident.results.result import Result

_ESTIMATING = "Estimating"
_estimating = in_panel(_ESTIMATING)
TAKEN = ("model", "free", "fixed", "start")  # by a fit or posterior of records
_OF_RECORDS = ("columns", "drive", "drive_factor", "drive_factor_uncertainty", "sheet")
ReportPlace = Annotated[
    str | None,
    typer.Option(help="Report to write: .html, .pdf, .md or .json; - is HTML on standard output."),
]

AsRecords = Annotated[
    bool,
    typer.Option(
        "--record",
        help="The files are records of any motion; each is a run, or a level if each holds a sweep "
        "at one level that no other holds. Files that plainly hold waveforms need no --record.",
    ),
]
Predicted = Annotated[
    str | None,
    one_of(
        "With --record: force or motion is predicted from the other; by default motion where "
        "the model has a mass.",
        None,
        "force|motion",
    ),
]


@dataclass(frozen=True)
class Estimating:
    """Estimation; the options of ``fit``."""

    method: Annotated[
        str,
        one_of(
            "lm, scipy (least_squares) or ipopt (interior point).", _ESTIMATING, "lm|scipy|ipopt"
        ),
    ] = "lm"
    noise: Annotated[str | None, noise_option(_ESTIMATING)] = None
    loss: Annotated[
        str,
        one_of(
            "linear, huber, soft_l1 or student_t; all but the first down-weight outliers.",
            _ESTIMATING,
            "linear|huber|soft_l1|student_t",
        ),
    ] = "linear"
    steady: Annotated[str, steady_option(_ESTIMATING)] = "exact"
    start: Annotated[
        list[str] | None,
        _estimating("Additional initial value for the search, f_max=0.1; once for each parameter."),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``fit``."""
        start = values("start", self.start) if self.start else None
        return {**vars(self), "start": start}


@with_option_groups
def fit(
    files: Files,
    general: General,
    laws: Laws,
    reading: Reading,
    channels: Channels,
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
    predicted: Predicted = None,
) -> None:
    """Estimate a model's parameters, and state whether the data determine them.

    Of several saved fits, such as monday.json friday.json, it says what changed.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    from dahl_ident.data.storage import place_of
    from dahl_ident.diagnostics.comparison import compare_models
    from dahl_ident.results.result import FORMATS

    laws.run()
    if len(files) > 1 and all(map(is_saved, files)):
        if (reading, channels, model, estimating) != (
            Reading(), Channels(), ModelOptions(metadata=model.metadata), Estimating()
        ) or save is not None:  # fmt: skip
            raise ValidationError("saved fits are compared as they are; give no other options")
        _compare_saved(files, general, writing, report, model)
        return
    writing.check([report, save], files, json=general.json)
    check_reports(report)
    if save is not None:
        place_of(save, "a fit", FORMATS)
    if predicted is not None and not record:
        raise ValidationError("--predicted is given without --record; give both, or neither")
    table = None if record else table_or_none(files, reading, channels)
    if table is None:
        if compare:
            raise ValidationError(
                "--compare is given together with --record, but compares models of tables alone; "
                "leave it out, and fit each model to the records (hold_out() in Python)"
            )
        how = refuse_for_tables(
            "fit",
            {**model.keywords(), **estimating.keywords()},
            Estimating().keywords(),
            (*TAKEN, "sensors"),
        )
        of_records = _fit_records(
            read_records(files, reading, channels), {**how, "output": predicted}
        )
        if save is not None:
            of_records.save(save, overwrite=writing.overwrite)
        _tell_records(of_records, general, report, verbose=verbose)
        if report is not None:
            write_fit_report([of_records], report, writing, model)
        finish(of_records)
        return
    result = fitted(table, model, estimating)
    if save is not None:
        result.save(save, overwrite=writing.overwrite)
    if general.json:
        console.write_json(as_json(result))
    elif report != STANDARD:
        console.write_wrapped(result.fit_report(details=verbose))
        if compare and (result.goodness.acceptable or not verbose):  # else it is there already
            console.write(str(compare_models(result)))
        if not verbose:
            console.write("-v prints tests of the residuals, other models and the solver's numbers")
    if report is not None:
        write_fit_report([result], report, writing, model)
    finish(result)


def _compare_saved(
    files: list[str], general: General, writing: Writing, report: str | None, model: ModelOptions
) -> None:
    """Print what changed from one saved fit to the next."""
    from dahl_ident.results.changes import changes, headline

    writing.check([report], files, json=general.json)
    check_reports(report)
    fits = [saved_fit(file) for file in files]
    found = changes(dict(zip((Path(file).stem for file in files), fits, strict=True)))
    if general.json:
        console.write_json([change.to_dict() for change in found])
    elif report != STANDARD:
        told = [f"{change}." for change in found]
        told += [line for line in headline(found) if line not in told]
        console.write_wrapped("\n".join(told))
    if report is not None:
        write_fit_report(fits, report, writing, model)
    finish(next((fit for fit in fits if not fit.status.usable), fits[0]))


def is_saved(file: str) -> bool:
    """Return whether a file holds a saved fit."""
    from dahl_ident.data.storage import read_text

    return file.endswith(".json") and '"schema": "dahl_ident.' in read_text(Path(file))


def saved_fit(file: str) -> FitResult | RecordFit:
    """Return the fit of a table or of records that a file holds."""
    from dahl_ident.results import FitResult, RecordFit
    from dahl_ident.results.record_fit import SCHEMA

    try:
        return FitResult.load(file)
    except DataError as exc:
        if repr(SCHEMA) not in str(exc):
            raise
        return RecordFit.load(file)


def table_or_none(
    files: list[str], reading: Reading, channels: Channels
) -> FrequencyResponse | None:
    """Return the table in the files; None, and a line that says so, where they hold waveforms."""
    from dahl_ident.data.response_table import WaveformsError

    try:
        data = reading.read(files)
    except WaveformsError:
        if STANDARD in files:  # has been read, and cannot be read again
            raise
        console.note("the files hold waveforms: fitted sample by sample, as with --record")
        return None
    except DataError:
        refuse_channels(channels)
        raise
    refuse_channels(channels)
    return data


def read_records(files: list[str], reading: Reading, channels: Channels) -> list[Record]:
    """Return the records of the files, each a run; options of tables alone are refused."""
    from dahl_ident.data import read_record

    given, usual = vars(reading), vars(Reading())
    idle = [name for name in given if given[name] != usual[name] and name not in _OF_RECORDS]
    if idle:
        raise ValidationError(
            f"{', '.join(option(name) for name in idle)} is given together with --record; of the "
            f"options of reading, records take {', '.join(map(option, _OF_RECORDS))} and the names "
            "of channels, such as --displacement (dahl-ident inspect proposes a column map)"
        )
    how = vars(channels) | {name: given[name] for name in _OF_RECORDS}
    return [read_record(name, **how) for name in files]


def refuse_channels(channels: Channels) -> None:
    """Refuse the options of records where tables are read."""
    idle = [name for name, value in vars(channels).items() if value != vars(Channels())[name]]
    if idle:
        raise ValidationError(
            f"{', '.join(map(option, idle))} is given without --record; leave it out, or name the "
            "columns of a table in a column map (--columns)"
        )


def refuse_for_tables(
    what: str, given: dict[str, Any], usual: dict[str, Any], taken: tuple[str, ...] = TAKEN
) -> dict[str, Any]:
    """Return the options that an estimation from records takes; others given are refused."""
    refused = [
        option(name)
        for name, value in given.items()
        if name in usual and name not in taken and value != usual[name]
    ]
    if refused:
        raise ValidationError(
            f"{', '.join(refused)} is given together with --record; a {what} of records takes "
            "none of them"
        )
    return {name: value for name, value in given.items() if name in taken}


def option(name: str) -> str:
    """Return how an argument is written on the command line."""
    return f"--{name.replace('_', '-')}"


def _fit_records(records: list[Record], how: dict[str, Any]) -> RecordFit:
    """Fit records of any motion sample by sample."""
    from dahl_ident.results import fit as fit_data

    try:
        return fit_data(records, throw=False, progress=sys.stderr.isatty(), **how)
    except FitInterrupted as stop:
        console.write(stop.result.fit_report())
        raise


def _tell_records(
    result: RecordFit, general: General, report: str | None, *, verbose: bool
) -> None:
    """Print a fit of records."""
    if general.json:
        limits = result.conf_interval()
        console.write_json(
            {
                "status": str(result.status),
                "trusted": result.trusted,
                "verdict": result.verdict,
                "success": result.success,
                "message": result.message,
                "params": {
                    name: {**vars(p), "interval": limits.get(name)}
                    for name, p in result.params.items()
                },
                "effective_samples": result.effective_samples,
                "share_left": result.goodness.share_left,
            }
        )
    elif report != STANDARD:
        console.write_wrapped(result.fit_report(details=verbose))
        if not verbose:
            console.write("-v prints the budget, the records' own values and the residuals")


def fitted(data: FrequencyResponse, model: ModelOptions, estimating: Estimating) -> FitResult:
    """Return the fit of the model to a table, with its verdict."""
    from dahl_ident.results import fit as fit_data

    how = {**model.keywords(), **estimating.keywords()}
    with console.busy("fitting"):
        result = fit_data(data, throw=False, **how)
        _ = result.statements  # computed when first asked for
    return result


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
    with console.busy("writing the report") as progress:
        write = partial(report, list(results), progress=progress, **options)
        return written(write, place, ".html")


def write_fit_report(
    results: Sequence[FitResult | ChainPosterior | RecordFit | RecordPosterior],
    place: str,
    writing: Writing,
    model: ModelOptions,
) -> None:
    """Write a report in addition to other output, and print its path."""
    written_to = write_report(results, place, writing, metadata=model.metadata)
    if written_to != STANDARD:
        console.note(f"report: {written_to}")


def as_json(result: FitResult) -> dict[str, Any]:
    """Return a fit as plain data."""
    from dahl_ident.diagnostics.confidence_levels import CONFIDENCE

    limits = result.conf_interval().at(CONFIDENCE)
    stated, errors = result.stated_budget, result.errors
    return {
        "status": str(result.status),
        "trusted": result.trusted,
        "verdict": result.verdict,
        "findings": [finding.to_dict() for finding in result.findings],
        "success": result.success,
        "message": result.message,
        "params": {
            name: {**vars(estimate), "interval": limits[name] if estimate.vary else None}
            for name, estimate in result.params.items()
        },
        "assumed": {}
        if errors is None
        else {
            name: {"value": errors.values[name], "stderr": errors.stderr[name]}
            for name in errors.assumed
        },
        "budget": None if stated is None else stated.to_dict(),
        "determined": [str(c) for c in result.identifiability.combinations],
        "warnings": list(result.goodness.warnings),
        "suspicious": [str(point) for point in result.goodness.suspicious],
        "noise": result.noise,
        "scale": result.scale,
        "redchi": result.redchi,
    }


def finish(result: Result) -> None:
    """End with status 3 if the result cannot be used."""
    console.finish(result.status.usable, str(result.findings[0]))

"""``dahl-ident fit`` and ``dahl-ident report``: from tables or waveforms to estimates."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed
from dahl_ident.cli.distributions import values
from dahl_ident.cli.estimation import (
    AsRecords,
    ReportPlace,
    as_json,
    check_reports,
    finish,
    is_saved,
    noise_option,
    report_also,
    saved_fit,
    worst,
    write_report,
)
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import (
    General,
    Laws,
    Seed,
    Writing,
    in_panel,
    one_of,
    steady_option,
    with_option_groups,
)
from dahl_ident.cli.reading import Channels, Files, Reading
from dahl_ident.errors import FitInterrupted, ValidationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dahl_ident.cli.estimation import Reported
    from dahl_ident.data import FrequencyResponse, Record
    from dahl_ident.results import FitResult

_ESTIMATING = "Estimating"
_estimating = in_panel(_ESTIMATING)
Predicted = Annotated[
    str | None,
    one_of(
        "Of records: force or motion is predicted from the other; by default motion where "
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


def fitted(
    data: FrequencyResponse | list[Record],
    model: ModelOptions,
    estimating: Estimating,
    predicted: str | None = None,
) -> Any:
    """Return the fit of the model to a table or to records, with its verdict."""
    from dahl_ident.results import fit as estimate

    how = {**model.keywords(), **estimating.keywords()}
    if isinstance(data, list):
        how |= {"output": predicted, "progress": sys.stderr.isatty()}
        try:
            return estimate(data, throw=False, **how)
        except FitInterrupted as stop:
            console.write(stop.result.fit_report())
            raise
    with console.busy("fitting"):
        result = estimate(data, throw=False, **how)
        _ = result.statements  # computed when first asked for
    return result


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
    from dahl_ident.results.result import FORMATS

    laws.run()
    saved = len(files) > 1 and all(map(is_saved, files))
    unsaid = {*changed(reading, channels, model, estimating)} - {"metadata"}
    if saved and (unsaid or save is not None):
        raise ValidationError("saved fits are compared as they are; give no other options")
    writing.check([report, save], files, json=general.json)
    check_reports(report)
    if saved:
        _compare_saved(files, general, writing, report, model)
        return
    if save is not None:
        place_of(save, "a fit", FORMATS)
    data = reading.read_any(files, channels, record=record)
    if predicted is not None and not isinstance(data, list):
        raise ValidationError(
            "--predicted is given for a table, which has no motion in time; leave it out"
        )
    result = fitted(data, model, estimating, predicted)
    if save is not None:
        result.save(save, overwrite=writing.overwrite)
    if general.json:
        console.write_json(as_json(result))
    elif report != STANDARD:
        _print(result, verbose=verbose, compare=compare, of_records=isinstance(data, list))
    report_also([result], report, writing, model.metadata)
    finish(result)


def _print(result: Any, *, verbose: bool, compare: bool, of_records: bool) -> None:
    from dahl_ident.diagnostics.comparison import compare_models

    console.write_wrapped(result.fit_report(details=verbose))
    if compare and (result.goodness.acceptable or not verbose):  # else it is there already
        console.write(str(compare_models(result)))
    if not verbose:
        more = "further findings, tests of the residuals, other models and the solver's numbers"
        if of_records:
            more = "the budget, the records' own values and the residuals"
        console.write(f"-v prints {more}")


def _compare_saved(
    files: list[str], general: General, writing: Writing, report: str | None, model: ModelOptions
) -> None:
    """Print what changed from one saved fit to the next."""
    from dahl_ident.results.changes import changes, headline

    fits = [saved_fit(file) for file in files]
    changed_values = changes(dict(zip((Path(file).stem for file in files), fits, strict=True)))
    if general.json:
        console.write_json([change.to_dict() for change in changed_values])
    elif report != STANDARD:
        lines = [f"{change}." for change in changed_values]
        lines += [line for line in headline(changed_values) if line not in lines]
        console.write_wrapped("\n".join(lines))
    report_also(fits, report, writing, model.metadata)
    finish(worst(fits))


@with_option_groups
def report(
    files: Files,
    general: General,
    laws: Laws,
    reading: Reading,
    model: ModelOptions,
    estimating: Estimating,
    writing: Writing,
    output: Annotated[
        list[str],
        typer.Option(
            "--output",
            "-o",
            help="Report: .html, .pdf, .md, .json; or several. - is HTML on standard output.",
        ),
    ] = ["report.html"],  # noqa: B006 - typer takes lists as lists
    waveforms: Annotated[
        Path | None, typer.Option(help="Waveforms of the table; the report shows how they settled.")
    ] = None,
    waveforms_columns: Annotated[
        Path | None, typer.Option(help="Column map of these waveforms, a TOML file.")
    ] = None,
    title: Annotated[str | None, typer.Option(help="Title of the report.")] = None,
    bootstrap: Annotated[
        bool, typer.Option("--bootstrap", help="Add bootstrap intervals.")
    ] = False,
    posterior: Annotated[
        bool, typer.Option("--posterior", help="Add a sampled posterior.")
    ] = False,
    seed: Seed = 1,
) -> None:
    """Fit and write a report; or write a report on fits saved by fit --save.

    Several saved fits are overlaid, and the changes from each to the next are listed. A fit of a
    table and one of its waveforms are compared; the exit status is 3 if they disagree.

    Example: dahl-ident datasets noisy -o - | dahl-ident report - -o report.html
    """
    from dahl_ident.data import read_record

    laws.run()
    writing.check(output, files, json=general.json)
    check_reports(*output)
    if waveforms_columns is not None and waveforms is None:
        raise ValidationError(
            "--waveforms-columns is given without --waveforms; give both, or neither"
        )
    saved = all(map(is_saved, files))
    chosen = {*changed(reading, model, estimating)} - {"metadata"}
    if (saved and chosen) or (not saved and any(map(is_saved, files))):
        raise ValidationError(
            "saved fits are reported unchanged: give no tables together with them, and no options "
            "of reading, model or estimate"
        )
    if len(files) > 1 and saved and (posterior or waveforms is not None):
        raise ValidationError("--posterior and --waveforms go with one fit; give one file")
    record = None if waveforms is None else read_record(waveforms, columns=waveforms_columns)
    fits: Sequence[FitResult] = (
        [saved_fit(file) for file in files]
        if saved
        else [fitted(reading.read_any(files), model, estimating)]
    )
    results: list[Reported] = [*fits]
    for fit in fits if bootstrap else ():
        fit.conf_interval("bootstrap", seed=seed)
    if posterior:
        from dahl_ident.results import posterior as estimate_posterior

        results.append(estimate_posterior(fits[0], seed=seed, progress=sys.stderr.isatty()))
    how = {"title": title, "record": record, "metadata": model.metadata}
    places = [write_report(results, place, writing, **how) for place in output]
    if general.json:
        console.write_json(places)
    elif STANDARD not in places:
        console.write("\n".join(places))
    from dahl_ident.reporting.comparison import comparison_of

    compared = comparison_of(fits)
    console.finish(not compared.status, " ".join(compared.verdict))
    finish(worst(fits))

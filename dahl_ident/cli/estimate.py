"""``dahl-ident fit``, ``report`` and ``sample``: from tables or waveforms to estimates."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed, write_output
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import (
    General,
    Laws,
    Seed,
    Writing,
    option,
    setting,
    steady_setting,
    with_option_groups,
)
from dahl_ident.cli.reading import Files, Reading, Records
from dahl_ident.cli.values import prior, values
from dahl_ident.errors import FitInterrupted, ValidationError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record
    from dahl_ident.results import FitResult, Posterior
    from dahl_ident.results.result import Result

    Reported = FitResult | Posterior


ReportPlace = Annotated[
    str | None,
    option("Report to write: .html, .pdf, .md or .json; - is HTML on standard output."),
]


def _noise_setting() -> Any:
    return setting(
        "measured, relative or absolute; by default measured if a covariance is known.",
        one_of="measured|relative|absolute",
    )


def is_saved(file: str) -> bool:
    """Return whether a file holds a saved fit."""
    from dahl_ident.data.storage import read_text

    return file.endswith(".json") and '"schema": "dahl_ident.' in read_text(Path(file))


def saved_fit(file: str) -> FitResult:
    """Return the fit of a table or of records that a file holds."""
    from dahl_ident.results import FitResult

    return FitResult.load(file)


def check_reports(*places: str | None) -> None:
    """Refuse reports of an unknown kind before any work is done."""
    from dahl_ident.data.storage import place_of

    for place in places:
        if place not in (None, STANDARD):
            from dahl_ident.reporting.publish import FORMATS

            place_of(str(place), "a report", FORMATS)


def write_report(results: Sequence[Reported], place: str, writing: Writing, **options: Any) -> str:
    """Write a report (HTML to standard output) and return its place.

    `options` are further arguments of ``report``.
    """
    from dahl_ident.reporting import report

    options |= {"command": console.typed_command(), "overwrite": writing.overwrite}
    with console.busy("writing the report") as progress:
        return write_output(partial(report, results, progress=progress, **options), place, ".html")


def report_also(
    results: Sequence[Reported], place: str | None, writing: Writing, metadata: Path | None
) -> None:
    """Write a report in addition to other output, if a place is given."""
    if place is None:
        return
    written_to = write_report(results, place, writing, metadata=metadata)
    if written_to != STANDARD:
        console.note(f"report: {written_to}")


def as_json(result: FitResult) -> dict[str, Any]:
    """Return a fit as plain data."""
    from dahl_ident.diagnostics.confidence_levels import CONFIDENCE
    from dahl_ident.results.fit_report import facts

    assumed = (result.params[name] for name in result.assumed)
    limits = result.conf_interval().at(CONFIDENCE)
    return {
        **facts(result),
        "success": result.success,
        "message": result.message,
        "assumed": {p.name: {"value": p.value, "stderr": p.stderr} for p in assumed},
        "params": {
            name: {**vars(estimate), "interval": limits[name][1:] if name in limits else None}
            for name, estimate in result.params.items()
        },
    }


def worst(results: Sequence[Any]) -> Any:
    """Return the first result that cannot be used, or the first one."""
    return next((one for one in results if not one.status.usable), results[0])


def finish(result: Result) -> None:
    """End with status 3 if the result cannot be used."""
    console.finish(result.status.usable, str(result.findings[0]))


@dataclass(frozen=True)
class Estimating:
    """Estimation; the options of ``fit``."""

    panel: ClassVar[str] = "Estimating"
    method: str = setting(
        "lm, scipy (least_squares) or ipopt (interior point).", "lm", one_of="lm|scipy|ipopt"
    )
    noise: str | None = _noise_setting()
    loss: str = setting(
        "linear, huber, soft_l1 or student_t; all but the first down-weight outliers.",
        "linear",
        one_of="linear|huber|soft_l1|student_t",
    )
    steady: str = steady_setting()
    start: list[str] | None = setting(
        "Additional initial value for the search, f_max=0.1; once for each parameter."
    )

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

    keywords = {**model.keywords(), **estimating.keywords()}
    if isinstance(data, list):
        keywords |= {"output": predicted, "progress": sys.stderr.isatty()}
        try:
            return estimate(data, throw=False, **keywords)
        except FitInterrupted as stop:
            console.write(stop.result.fit_report())
            raise
    with console.busy("fitting"):
        result = estimate(data, throw=False, **keywords)
        _ = result.statements  # computed now, while the progress is shown
    return result


@with_option_groups
def fit(
    files: Files,
    general: General,
    laws: Laws,
    reading: Reading,
    records: Records,
    model: ModelOptions,
    estimating: Estimating,
    writing: Writing,
    report: ReportPlace = None,
    save: Annotated[
        Path | None, option("JSON file for the fit, which report and Python can load.")
    ] = None,
    verbose: Annotated[
        bool, option("Print all sections, not only the first two.", "--verbose", "-v")
    ] = False,
    compare: Annotated[
        bool, option("Compare with other models of the friction.", "--compare")
    ] = False,
) -> None:
    """Estimate a model's parameters, and state whether the data determine them.

    With several saved fits, such as monday.json friday.json, print what changed between them.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    from dahl_ident.data.storage import place_of
    from dahl_ident.results.result import FORMATS

    laws.run()
    saved = len(files) > 1 and all(map(is_saved, files))
    chosen = {*changed(reading, records, model, estimating)} - {"metadata"}
    if saved and (chosen or save is not None):
        raise ValidationError("saved fits are compared as they are; give no other options")
    writing.check([report, save], files, json=general.json)
    check_reports(report)
    if saved:
        _compare_saved(files, general, writing, report, model)
        return
    if save is not None:
        place_of(save, "a fit", FORMATS)
    data = reading.read_any(files, records)
    result = fitted(data, model, estimating, records.predicted)
    if save is not None:
        result.save(save, overwrite=writing.overwrite)
    if general.json:
        console.write_json(as_json(result))
    elif report != STANDARD:
        _print(result, verbose=verbose, compare=compare, of_records=isinstance(data, list))
    report_also([result], report, writing, model.metadata)
    finish(result)


def _print(result: Any, *, verbose: bool, compare: bool, of_records: bool) -> None:
    from dahl_ident.diagnostics.comparison import compare_models, is_compared

    console.write_wrapped(result.fit_report(details=verbose), result.status)
    if compare and not (verbose and is_compared(result)):  # else already printed
        console.write(str(compare_models(result)))
    if not verbose:
        details = "further findings, tests of the residuals, other models and the solver's numbers"
        if of_records:
            details = "the budget, the values of each record and the residuals"
        console.write(f"-v prints {details}")


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
    records: Records,
    model: ModelOptions,
    estimating: Estimating,
    writing: Writing,
    output: Annotated[
        list[str],
        option(
            "Report: .html, .pdf, .md, .json; or several. - is HTML on standard output.",
            "--output",
            "-o",
        ),
    ] = ["report.html"],  # noqa: B006 - typer takes lists as lists
    waveforms: Annotated[
        Path | None, option("Waveforms of the table; the report shows how they settled.")
    ] = None,
    waveforms_columns: Annotated[
        Path | None, option("Column map of these waveforms, a TOML file.")
    ] = None,
    title: Annotated[str | None, option("Title of the report.")] = None,
    bootstrap: Annotated[bool, option("Add bootstrap intervals.", "--bootstrap")] = False,
    posterior: Annotated[bool, option("Add a sampled posterior.", "--posterior")] = False,
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
    chosen = {*changed(reading, records, model, estimating)} - {"metadata"}
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
        else [fitted(reading.read_any(files, records), model, estimating, records.predicted)]
    )
    results: list[Reported] = [*fits]
    for fit in fits if bootstrap else ():
        fit.conf_interval("bootstrap", seed=seed)
    if posterior:
        from dahl_ident.results import posterior as estimate_posterior

        results.append(estimate_posterior(fits[0], seed=seed, progress=sys.stderr.isatty()))
    options = {"title": title, "record": record, "metadata": model.metadata}
    places = [write_report(results, place, writing, **options) for place in output]
    if general.json:
        console.write_json(places)
    elif STANDARD not in places:
        console.write("\n".join(places))
    from dahl_ident.reporting.comparison import comparison_of

    compared = comparison_of(fits)
    console.finish(not compared.status, " ".join(compared.verdict))
    finish(worst(fits))


@dataclass(frozen=True)
class Sampling:
    """Sampling; the options of ``posterior``."""

    panel: ClassVar[str] = "Sampling"
    method: str = setting(
        "mcmc, or grid: integration over up to three parameters, without a chain.",
        "mcmc",
        one_of="mcmc|grid",
    )
    prior: list[str] | None = setting(
        "Bounds of a parameter, f_max=0.01:1, or a distribution of scipy.stats, "
        "'mass=norm(0.3, 0.001)'; once for each."
    )
    noise: str | None = _noise_setting()
    steady: str = steady_setting()
    likelihood: str = setting(
        "gaussian, student_t or none.", "gaussian", one_of="gaussian|student_t|none"
    )
    uncertainty: str = setting(
        "combined: every source of the fit's budget; noise: independent noise alone.",
        "combined",
        one_of="combined|noise",
    )
    seed: int | None = setting(
        "Seed of the random numbers; by default that of the chain in --resume, or 1."
    )
    steps: int | None = setting("Total steps; by default until converged.")
    max_steps: int = setting("Maximum steps, converged or not.", 20000)
    ess: float = setting("Target effective sample size.", 2000.0)
    walkers: int | None = setting("Walkers in all ensembles together.")
    ensembles: int = setting("Independent groups of walkers.", 4)
    resume: Path | None = setting(
        "HDF5 file that keeps the chain; a stopped run continues from it."
    )

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``posterior``."""
        keywords = dict(vars(self))
        keywords["priors"] = dict(prior(text) for text in keywords.pop("prior") or [])
        if self.seed is None and (self.resume is None or not self.resume.exists()):
            keywords["seed"] = 1
        steady = None if self.steady == "exact" else self.steady
        return {**keywords, "steady": steady, "progress": sys.stderr.isatty()}


@with_option_groups
def sample(
    files: Files,
    general: General,
    laws: Laws,
    reading: Reading,
    records: Records,
    model: ModelOptions,
    sampling: Sampling,
    writing: Writing,
    report: ReportPlace = None,
) -> None:
    """Sample the posterior of the parameters, or of those of a fit saved by fit --save.

    Example: dahl-ident datasets noisy -o - | dahl-ident sample - --prior f_max=0.01:1
    """
    from dahl_ident.results import posterior as estimate_posterior

    laws.run()
    writing.check([report], files, json=general.json)
    check_reports(report)
    data: Any
    if len(files) == 1 and is_saved(files[0]):
        if {*changed(reading, records, model)} - {"metadata"}:
            raise ValidationError("a saved fit has its data and model; give no options of these")
        data, keywords = saved_fit(files[0]), {}
    else:
        data, keywords = reading.read_any(files, records), model.keywords()
        if records.predicted is not None:
            data, keywords = fitted(data, model, Estimating(), records.predicted), {}
    try:
        posterior = estimate_posterior(data, **keywords, **sampling.keywords())
    except KeyboardInterrupt:
        console.write_error(_how_to_resume(sampling.resume))
        raise
    if general.json:
        console.write_json(posterior.to_dict())
    elif report != STANDARD:
        console.write_wrapped(str(posterior))
    report_also([posterior], report, writing, model.metadata)
    finish(posterior)


def _how_to_resume(chain: Path | None) -> str:
    """Return a message on whether and how a stopped chain can be continued."""
    if chain is None:
        return "the chain is not kept; with --resume chain.h5 a stopped chain can be continued"
    if not chain.exists():
        return f"{chain}: the chain had not begun"
    return f"{chain} holds the chain so far; the same command continues from there"

"""``dahl-ident fit``: from tables to estimates with their judgement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.distributions import values
from dahl_ident.cli.files import written
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import STANDARD, Files, General, Reading, Writing

if TYPE_CHECKING:
    from dahl_ident.results import FitResult, Posterior

_ESTIMATING = "Estimating"
_LEVEL = 0.9545
ReportPlace = Annotated[
    str | None,
    typer.Option(help="Report to write: .html, .pdf, .md or .json; - is HTML on standard output."),
]


@dataclass(frozen=True)
class Estimating:
    """How the estimate is made; the words of ``fit``."""

    method: Annotated[
        str,
        typer.Option(
            help="scipy, or ipopt with exact second derivatives.", rich_help_panel=_ESTIMATING
        ),
    ] = "scipy"
    noise: Annotated[
        str | None,
        typer.Option(
            help="measured, relative or absolute; by default measured where a covariance is known.",
            rich_help_panel=_ESTIMATING,
        ),
    ] = None
    loss: Annotated[
        str,
        typer.Option(
            help="linear, huber, soft_l1 or student_t; all but the first make outliers count less.",
            rich_help_panel=_ESTIMATING,
        ),
    ] = "linear"
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="One more start for the search, f_max=0.1; once for each parameter.",
            rich_help_panel=_ESTIMATING,
        ),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``fit``."""
        start = values("start", self.start) if self.start else None
        return {**vars(self), "start": start}


@grouped
def fit(
    files: Files,
    general: General,
    reading: Reading,
    model: ModelOptions,
    estimating: Estimating,
    writing: Writing,
    report: ReportPlace = None,
    save: Annotated[
        Path | None, typer.Option(help="Fit to write, as JSON that report and Python load.")
    ] = None,
) -> None:
    """Estimate f_max and sigma, and say whether the data determine them.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    from dahl_ident.data.storage import place_of
    from dahl_ident.results.storage import FORMATS

    writing.check([report, save], files, json=general.json)
    check_reports(report)
    if save is not None:
        place_of(save, "a fit", FORMATS)
    result = fitted(files, reading, model, estimating)
    if save is not None:
        result.save(save, overwrite=writing.overwrite)
    if general.json:
        telling.say_json(as_json(result))
    elif report != STANDARD:
        telling.say(result.fit_report())
    if report is not None:
        tell_report([result], report, writing)
    finish(result)


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
    from dahl_ident.reporting.publish import FORMATS

    for place in places:
        if place is not None and place != STANDARD:
            place_of(place, "a report", FORMATS)


def write_report(
    results: Sequence[FitResult | Posterior],
    place: str,
    writing: Writing,
    **how: Any,
) -> str:
    """Write a report, as HTML where that is standard output, and return where it is.

    `how` are further arguments of ``report``.
    """
    from functools import partial

    from dahl_ident.reporting import report

    told = {**how, "command": telling.typed_command(), "overwrite": writing.overwrite}
    write = partial(report, list(results), **told)
    return written(write, place, ".html")


def tell_report(results: Sequence[FitResult | Posterior], place: str, writing: Writing) -> None:
    """Write a report beside other output, and say where it is."""
    told = write_report(results, place, writing)
    if told != STANDARD:
        telling.doubt(f"report: {told}")


def as_json(result: FitResult) -> dict[str, Any]:
    """Return a fit as plain data."""
    limits = result.conf_interval().at(_LEVEL)
    return {
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


def finish(result: FitResult) -> None:
    """End with status 3 where the fit is not to be trusted."""
    telling.finish(result.trusted, objection(result))


def objection(result: FitResult) -> str:
    """Return the gravest statement on a fit that is not to be trusted."""
    return result.statements[0].removeprefix("NOT to be trusted. ")

"""What the commands that estimate share: saved fits, reports, JSON, exit status."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, written
from dahl_ident.cli.options import Writing, one_of

if TYPE_CHECKING:
    from dahl_ident.results import FitResult, Posterior
    from dahl_ident.results.result import Result

    Reported = FitResult | Posterior

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


def noise_option(panel: str) -> Any:
    """Return the option of the noise of the rows."""
    return one_of(
        "measured, relative or absolute; by default measured if a covariance is known.",
        panel,
        "measured|relative|absolute",
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
        if place is not None and place != STANDARD:
            from dahl_ident.reporting.publish import FORMATS

            place_of(place, "a report", FORMATS)


def write_report(results: Sequence[Reported], place: str, writing: Writing, **how: Any) -> str:
    """Write a report, as HTML where that is standard output, and return where it is.

    `how` are further arguments of ``report``.
    """
    from dahl_ident.reporting import report

    options = {**how, "command": console.typed_command(), "overwrite": writing.overwrite}
    with console.busy("writing the report") as progress:
        return written(partial(report, results, progress=progress, **options), place, ".html")


def report_also(
    results: Sequence[Reported], place: str | None, writing: Writing, metadata: Path | None
) -> None:
    """Write a report in addition to other output, where there is a place for it."""
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
            name: {**vars(estimate), "interval": limits[name][1:] if estimate.vary else None}
            for name, estimate in result.params.items()
        },
    }


def worst(results: Sequence[Any]) -> Any:
    """Return the first result that cannot be used, or the first one."""
    return next((one for one in results if not one.status.usable), results[0])


def finish(result: Result) -> None:
    """End with status 3 if the result cannot be used."""
    console.finish(result.status.usable, str(result.findings[0]))

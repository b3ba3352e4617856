"""``dahl-ident report``: from tables to a report that can be handed on."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.fit import Estimating, check_reports, finish, fitted, write_report
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import STANDARD, Files, General, Reading, Seed, Writing
from dahl_ident.errors import ValidationError


@grouped
def report(
    files: Files,
    general: General,
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
    record: Annotated[
        Path | None,
        typer.Option(help="Waveforms that the table is from: the report shows how they settled."),
    ] = None,
    record_columns: Annotated[
        Path | None, typer.Option(help="Column map of these waveforms, a TOML file.")
    ] = None,
    title: Annotated[str | None, typer.Option(help="First line of the report.")] = None,
    bootstrap: Annotated[
        bool, typer.Option("--bootstrap", help="Bootstrap intervals as well, beside the others.")
    ] = False,
    posterior: Annotated[
        bool, typer.Option("--posterior", help="Sample the posterior as well, beside the fit.")
    ] = False,
    seed: Seed = 1,
) -> None:
    """Fit, judge and write a report; or report on a fit that fit --save has written.

    Example: dahl-ident datasets noisy -o - | dahl-ident report - -o report.html
    """
    from dahl_ident.data import read_record
    from dahl_ident.results import FitResult, Posterior, sample

    writing.check(output, files, json=general.json)
    check_reports(*output)
    if record_columns is not None and record is None:
        raise ValidationError("--record-columns is given without --record; give both, or neither")
    saved = any(file.endswith(".json") for file in files)
    chosen = (reading, model, estimating) != (Reading(), ModelOptions(), Estimating())
    if saved and (len(files) > 1 or chosen):
        raise ValidationError(
            "a saved fit is reported as it is: give one file, and no options of reading, model or "
            "estimate beside it"
        )
    waveforms = None if record is None else read_record(record, columns=record_columns)
    result = FitResult.load(files[0]) if saved else fitted(files, reading, model, estimating)
    told: list[FitResult | Posterior] = [result]
    if bootstrap:
        result.conf_interval("bootstrap", seed=seed)
    if posterior:
        told.append(sample(result, seed=seed, progress=sys.stderr.isatty()))
    how = {"title": title, "record": waveforms}
    places = [write_report(told, place, writing, **how) for place in output]
    if general.json:
        telling.say_json(places)
    elif STANDARD not in places:
        telling.say("\n".join(places))
    finish(result)

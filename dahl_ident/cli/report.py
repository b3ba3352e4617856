"""``dahl-ident report``: from tables to a report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dahl_ident.cli import console
from dahl_ident.cli.fit import (
    Estimating,
    check_reports,
    finish,
    fitted,
    is_saved,
    saved_fit,
    write_report,
)
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.option_groups import with_option_groups
from dahl_ident.cli.options import STANDARD, Files, General, Laws, Reading, Seed, Writing
from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    from dahl_ident.results import ChainPosterior, FitResult, RecordFit, RecordPosterior


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

    Several saved fits are overlaid, and the changes from each to the next are listed.

    Example: dahl-ident datasets noisy -o - | dahl-ident report - -o report.html
    """
    from dahl_ident.data import read_record
    from dahl_ident.results import RecordFit

    laws.run()
    writing.check(output, files, json=general.json)
    check_reports(*output)
    if waveforms_columns is not None and waveforms is None:
        raise ValidationError(
            "--waveforms-columns is given without --waveforms; give both, or neither"
        )
    saved = all(map(is_saved, files))
    unset = (Reading(), ModelOptions(metadata=model.metadata), Estimating())
    chosen = (reading, model, estimating) != unset
    if (saved and chosen) or (not saved and any(map(is_saved, files))):
        raise ValidationError(
            "saved fits are reported unchanged: give no tables together with them, and no options "
            "of reading, model or estimate"
        )
    if len(files) > 1 and saved and (posterior or waveforms is not None):
        raise ValidationError("--posterior and --waveforms go with one fit; give one file")
    record = None if waveforms is None else read_record(waveforms, columns=waveforms_columns)
    fits: Sequence[FitResult | RecordFit] = (
        [saved_fit(file) for file in files]
        if saved
        else [fitted(reading.read(files), model, estimating)]
    )
    results: list[FitResult | ChainPosterior | RecordFit | RecordPosterior] = [*fits]
    result = fits[0]
    for fit in fits if bootstrap else ():
        if isinstance(fit, RecordFit):
            raise ValidationError("--bootstrap is given with a fit of records; leave it out")
        fit.conf_interval("bootstrap", seed=seed)
    if posterior:
        from dahl_ident.results.bayesian_estimate import posterior as estimate_posterior

        chain = estimate_posterior(result, seed=seed, progress=sys.stderr.isatty())
        results.append(chain)
    how = {"title": title, "record": record, "metadata": model.metadata}
    places = [write_report(results, place, writing, **how) for place in output]
    if general.json:
        console.write_json(places)
    elif STANDARD not in places:
        console.write("\n".join(places))
    finish(next((fit for fit in fits if not fit.status.usable), result))

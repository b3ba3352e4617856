"""``dahl-ident report``: from tables to a report that can be handed on."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.files import refuse_inputs
from dahl_ident.cli.fit import Estimating, finish, fitted, typed_command
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.options import Files, General, ModelOptions, Reading, Seed


@grouped
def report(
    files: Files,
    general: General,
    reading: Reading,
    model: ModelOptions,
    estimating: Estimating,
    output: Annotated[
        list[str],
        typer.Option("--output", "-o", help="Report: .html, .pdf, .md, .json; or several."),
    ] = ["report.html"],  # noqa: B006 - typer takes lists as lists
    title: Annotated[str | None, typer.Option(help="First line of the report.")] = None,
    posterior: Annotated[
        bool, typer.Option("--posterior", help="Sample the posterior as well, beside the fit.")
    ] = False,
    seed: Seed = 1,
) -> None:
    """Fit, judge and write a report; or report on a fit that fit --save has written.

    Example: dahl-ident datasets noisy -o - | dahl-ident report - -o report.html
    """
    from dahl_ident.reporting import report as write_report
    from dahl_ident.results import FitResult, Posterior, sample

    refuse_inputs(files, *output)
    saved = len(files) == 1 and files[0].endswith(".json")
    result = FitResult.load(files[0]) if saved else fitted(files, reading, model, estimating)
    told: list[FitResult | Posterior] = [result]
    if posterior:
        told.append(sample(result, seed=seed, progress=sys.stderr.isatty()))
    written = [
        str(write_report(told, place, title=title, command=typed_command())) for place in output
    ]
    if general.json:
        telling.say_json(written)
    else:
        telling.say("\n".join(written))
    finish(result)

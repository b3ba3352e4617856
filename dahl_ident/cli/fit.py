"""``dahl-ident fit``: from tables to estimates with their judgement."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.files import refuse_inputs, write_text
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.options import Files, General, ModelOptions, Reading

if TYPE_CHECKING:
    from dahl_ident.results import FitResult

_ESTIMATING = "Estimating"
_LEVEL = 0.9545


@dataclass(frozen=True)
class Estimating:
    """How the estimate is made; the words of ``fit``."""

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


@grouped
def fit(
    files: Files,
    general: General,
    reading: Reading,
    model: ModelOptions,
    estimating: Estimating,
    report: Annotated[
        str | None, typer.Option(help="Report to write: .html, .pdf, .md or .json.")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Fit to write, as JSON that report and Python load.")
    ] = None,
) -> None:
    """Estimate f_max and sigma, and say whether the data determine them.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    refuse_inputs(files, save, report)
    result = fitted(files, reading, model, estimating)
    if save is not None:
        write_text(result.to_json(), str(save))
    if report is not None:
        from dahl_ident.reporting import report as write_report

        telling.doubt(f"report: {write_report(result, report, command=typed_command())}")
    if general.json:
        telling.say_json(as_json(result))
    else:
        telling.say(result.fit_report())
    finish(result)


def fitted(
    files: list[str], reading: Reading, model: ModelOptions, estimating: Estimating
) -> FitResult:
    """Return the fit of the model to the files."""
    from dahl_ident.results import fit as fit_data

    elements, free = model.build()
    return fit_data(reading.read(files), elements, free=free, throw=False, **vars(estimating))


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
    telling.finish(result.trusted, result.verdict.removeprefix("NOT to be trusted. "))


def typed_command() -> str:
    """Return the command line of this process, as it would be typed again."""
    return shlex.join(["dahl-ident", *sys.argv[1:]])

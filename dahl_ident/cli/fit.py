"""``dahl-ident fit``: from tables to estimates with their judgement."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.options import Files, General, ModelOptions, Reading

if TYPE_CHECKING:
    from dahl_ident.reporting import Judgement
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
) -> None:
    """Estimate f_max and sigma, and say whether the data determine them.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    from dahl_ident.reporting import judgement

    result = fitted(files, reading, model, estimating)
    judged = judgement(result)
    show(judged, json=general.json)
    if report is not None:
        from dahl_ident.reporting import report as write_report

        telling.doubt(f"report: {write_report(result, report)}")
    finish(judged)


def fitted(
    files: list[str], reading: Reading, model: ModelOptions, estimating: Estimating
) -> FitResult:
    """Return the fit of the model to the files."""
    from dahl_ident.results import fit as fit_data

    elements, free = model.build()
    return fit_data(reading.read(files), elements, free=free, throw=False, **vars(estimating))


def show(judged: Judgement, *, json: bool = False) -> None:
    """Print a fit for people or for machines, the verdict first."""
    if json:
        telling.say_json(as_json(judged))
        return
    from dahl_ident.diagnostics.formatting import interval, rounded
    from dahl_ident.diagnostics.levels import percent

    fit, limits = judged.fit, judged.profile.at(_LEVEL)
    for line in judged.headlines:
        telling.say(line)
    rows = []
    for name, estimate in fit.params.items():
        value, error = rounded(estimate.value, estimate.stderr)
        if not math.isfinite(estimate.value):
            value = "none finite"
        found = limits.get(name)
        between = interval(found.lower, found.upper, "") if found else "-"
        rows.append((name, value, error if estimate.vary else "fixed", between, estimate.unit))
    header = ("parameter", "estimate", "standard error", f"{percent(_LEVEL)} (profile)", "unit")
    telling.table(repr(fit.problem.model), header, rows)
    noise = "known" if fit.scale_known else f"estimated as {fit.scale:.3g}"
    telling.say(f"noise: {fit.noise}, its scale {noise}; reduced chi-square {fit.redchi:.3g}")
    for text in (p.text for p in judged.identifiability.parameters.values()):
        telling.say(f"- {text}")
    for combination in judged.identifiability.combinations:
        telling.say(f"- determined: {combination}")
    for point in judged.goodness.suspicious:
        telling.say(f"- suspicious: {point}")


def as_json(judged: Judgement) -> dict[str, Any]:
    """Return a fit as plain data."""
    fit, limits = judged.fit, judged.profile.at(_LEVEL)
    return {
        "trusted": judged.trusted,
        "objections": list(judged.objections),
        "success": fit.success,
        "message": fit.message,
        "params": {
            name: {**vars(estimate), "interval": limits[name] if estimate.vary else None}
            for name, estimate in fit.params.items()
        },
        "determined": [str(c) for c in judged.identifiability.combinations],
        "noise": fit.noise,
        "scale": fit.scale,
        "redchi": fit.redchi,
    }


def finish(judged: Judgement) -> None:
    """End with status 3 where the fit is not to be trusted."""
    telling.finish(judged.trusted, " ".join(judged.objections))

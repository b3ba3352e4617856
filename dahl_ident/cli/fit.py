"""``dahl-ident fit``: from tables to estimates with their judgement."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.options import Files, General, ModelOptions, Reading

if TYPE_CHECKING:
    from dahl_ident.results import FitResult


@grouped
def fit(
    files: Files,
    general: General,
    reading: Reading,
    model: ModelOptions,
    noise: Annotated[
        str | None, typer.Option(help="measured, relative or absolute; by default what fits.")
    ] = None,
    loss: Annotated[
        str, typer.Option(help="linear, huber, soft_l1 or student_t; the latter mind outliers.")
    ] = "linear",
) -> None:
    """Estimate f_max and sigma, and say whether the data determine them.

    Example: dahl-ident datasets noisy -o - | dahl-ident fit -
    """
    from dahl_ident.results import fit as fit_data

    elements, free = model.build()
    result = fit_data(reading.read(files), elements, free=free, noise=noise, loss=loss, throw=False)
    show(result, json=general.json)
    telling.finish(result.success, result.message)


def show(result: FitResult, *, json: bool) -> None:
    """Print a fit for people or for machines."""
    if json:
        telling.say_json(as_json(result))
        return
    telling.say(result.message)
    for estimate in result.params.values():
        telling.say(f"  {estimate}")


def as_json(result: FitResult) -> dict[str, Any]:
    """Return a fit as plain data."""
    return {
        "success": result.success,
        "message": result.message,
        "params": {name: vars(estimate) for name, estimate in result.params.items()},
    }

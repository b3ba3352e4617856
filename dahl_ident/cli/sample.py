"""``dahl-ident sample``: the posterior of the parameters, with a verdict on its convergence."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import telling
from dahl_ident.cli.distributions import prior
from dahl_ident.cli.fit import ReportPlace, check_reports, tell_report
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import STANDARD, Files, General, Reading, Seed, Writing

if TYPE_CHECKING:
    from dahl_ident.results.posterior import Posterior

_SAMPLING = "Sampling"


@dataclass(frozen=True)
class Sampling:
    """How the chain is run; the words of ``sample``."""

    prior: Annotated[
        list[str] | None,
        typer.Option(
            help="Bounds of a parameter, f_max=0.01:1, or a distribution of scipy.stats, "
            "'mass=norm(0.3, 0.001)'; once for each.",
            rich_help_panel=_SAMPLING,
        ),
    ] = None
    noise: Annotated[
        str | None,
        typer.Option(help="measured, relative or absolute.", rich_help_panel=_SAMPLING),
    ] = None
    likelihood: Annotated[
        str,
        typer.Option(help="gaussian, student_t or none.", rich_help_panel=_SAMPLING),
    ] = "gaussian"
    seed: Seed = 1
    steps: Annotated[
        int | None,
        typer.Option(help="Total steps; by default until converged.", rich_help_panel=_SAMPLING),
    ] = None
    max_steps: Annotated[
        int, typer.Option(help="Where to stop all the same.", rich_help_panel=_SAMPLING)
    ] = 20000
    ess: Annotated[
        float, typer.Option(help="Effective draws wanted.", rich_help_panel=_SAMPLING)
    ] = 2000.0
    walkers: Annotated[
        int | None,
        typer.Option(help="In all ensembles together.", rich_help_panel=_SAMPLING),
    ] = None
    ensembles: Annotated[
        int, typer.Option(help="Independent groups of walkers.", rich_help_panel=_SAMPLING)
    ] = 4
    resume: Annotated[
        Path | None,
        typer.Option(
            help="HDF5 file that keeps the chain; a run that was stopped goes on from it.",
            rich_help_panel=_SAMPLING,
        ),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``sample``."""
        given = dict(vars(self))
        priors = dict(prior(text) for text in given.pop("prior") or [])
        return {**given, "priors": priors, "progress": sys.stderr.isatty()}


@grouped
def sample(
    files: Files,
    general: General,
    reading: Reading,
    model: ModelOptions,
    sampling: Sampling,
    writing: Writing,
    report: ReportPlace = None,
) -> None:
    """Sample the posterior of the parameters.

    Example: dahl-ident datasets noisy -o - | dahl-ident sample - --prior f_max=0.01:1
    """
    from dahl_ident.results import sample as sample_data

    writing.check([report], files, json=general.json)
    check_reports(report)
    how = {**model.keywords(), **sampling.keywords()}
    posterior = sample_data(reading.read(files), **how)
    if general.json:
        from dahl_ident.reporting.posteriors import facts

        telling.say_json(facts(posterior))
    elif report != STANDARD:
        telling.say(posterior.report())
    if report is not None:
        tell_report([posterior], report, writing)
    finish(posterior)


def finish(posterior: Posterior) -> None:
    """End with status 3 where the chain has not converged."""
    telling.finish(posterior.converged, posterior.message)

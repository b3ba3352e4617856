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
from dahl_ident.cli.options import STANDARD, Files, General, Reading, Writing
from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    from dahl_ident.results.bayesian import BayesianResult

_SAMPLING = "Sampling"
_CHAIN = ("seed", "steps", "max_steps", "ess", "walkers", "ensembles", "resume")


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
    seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the random numbers; by default that of the chain in --resume, or 1.",
            rich_help_panel=_SAMPLING,
        ),
    ] = None
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

    grid: Annotated[
        bool,
        typer.Option(
            "--grid",
            help="Integrate instead, at once and without a chain: up to three parameters.",
            rich_help_panel=_SAMPLING,
        ),
    ] = False

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``sample``, or those of ``posterior_grid``."""
        priors = dict(prior(text) for text in self.prior or [])
        what = {"priors": priors, "noise": self.noise, "likelihood": self.likelihood}
        if self.grid:
            return what
        how = {name: getattr(self, name) for name in _CHAIN}
        if self.seed is None and (self.resume is None or not self.resume.exists()):
            how["seed"] = 1
        return {**what, **how, "progress": sys.stderr.isatty()}

    def check(self, report: str | None) -> None:
        """Refuse with --grid what only a chain has."""
        chain = Sampling()
        given = [n for n in _CHAIN if n != "seed" and getattr(self, n) != getattr(chain, n)]
        given += ["report"] if report is not None else []
        if self.grid and given:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise ValidationError(
                f"{options} is given beside --grid, which runs no chain; leave one of them out"
            )


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
    from dahl_ident.results import Posterior, posterior_grid
    from dahl_ident.results import sample as sample_data

    writing.check([report], files, json=general.json)
    check_reports(report)
    sampling.check(report)
    estimate = posterior_grid if sampling.grid else sample_data
    data, plant, how = reading.read(files), model.keywords(), sampling.keywords()
    try:
        posterior = estimate(data, **plant, **how)
    except KeyboardInterrupt:
        telling.doubt(_kept(sampling.resume))
        raise
    if general.json:
        from dahl_ident.reporting.posteriors import facts

        telling.say_json(facts(posterior))
    elif report != STANDARD:
        telling.say(posterior.report())
    if report is not None and isinstance(posterior, Posterior):
        tell_report([posterior], report, writing)
    finish(posterior)


def finish(posterior: BayesianResult) -> None:
    """End with status 3 where the posterior is not to be trusted."""
    telling.finish(posterior.trusted, "; ".join(posterior.objections))


def _kept(chain: Path | None) -> str:
    """Return what is left of a chain that was stopped."""
    if chain is None:
        return "the chain is not kept; with --resume chain.h5 one that is stopped can go on"
    if not chain.exists():
        return f"{chain}: the chain had not begun"
    return f"{chain} keeps the chain so far; the same command goes on from there"

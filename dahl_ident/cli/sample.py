"""``dahl-ident sample``: the posterior of the parameters, with a verdict on its convergence."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed, refuse
from dahl_ident.cli.distributions import prior
from dahl_ident.cli.estimation import (
    AsRecords,
    ReportPlace,
    check_reports,
    finish,
    noise_option,
    report_also,
)
from dahl_ident.cli.model import ModelOptions
from dahl_ident.cli.options import (
    General,
    Laws,
    Writing,
    in_panel,
    one_of,
    steady_option,
    with_option_groups,
)
from dahl_ident.cli.reading import Channels, Files, Reading

_SAMPLING = "Sampling"
_sampling = in_panel(_SAMPLING)
_CHAIN = ("seed", "steps", "max_steps", "ess", "walkers", "ensembles", "resume")


@dataclass(frozen=True)
class Sampling:
    """Sampling; the options of ``posterior``."""

    method: Annotated[
        str,
        one_of(
            "mcmc, or grid: integration over up to three parameters, without a chain.",
            _SAMPLING,
            "mcmc|grid",
        ),
    ] = "mcmc"
    prior: Annotated[
        list[str] | None,
        _sampling(
            "Bounds of a parameter, f_max=0.01:1, or a distribution of scipy.stats, "
            "'mass=norm(0.3, 0.001)'; once for each."
        ),
    ] = None
    noise: Annotated[str | None, noise_option(_SAMPLING)] = None
    steady: Annotated[str, steady_option(_SAMPLING)] = "exact"
    likelihood: Annotated[
        str, one_of("gaussian, student_t or none.", _SAMPLING, "gaussian|student_t|none")
    ] = "gaussian"
    uncertainty: Annotated[
        str,
        one_of(
            "combined: every source of the fit's budget; noise: independent noise alone.",
            _SAMPLING,
            "combined|noise",
        ),
    ] = "combined"
    seed: Annotated[
        int | None,
        _sampling("Seed of the random numbers; by default that of the chain in --resume, or 1."),
    ] = None
    steps: Annotated[int | None, _sampling("Total steps; by default until converged.")] = None
    max_steps: Annotated[int, _sampling("Maximum steps, converged or not.")] = 20000
    ess: Annotated[float, _sampling("Effective draws wanted.")] = 2000.0
    walkers: Annotated[int | None, _sampling("Walkers in all ensembles together.")] = None
    ensembles: Annotated[int, _sampling("Independent groups of walkers.")] = 4
    resume: Annotated[
        Path | None, _sampling("HDF5 file that keeps the chain; a stopped run continues from it.")
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``posterior``."""
        how = dict(vars(self))
        how["priors"] = dict(prior(text) for text in how.pop("prior") or [])
        if self.seed is None and (self.resume is None or not self.resume.exists()):
            how["seed"] = 1
        steady = None if self.steady == "exact" else self.steady
        return {**how, "steady": steady, "progress": sys.stderr.isatty()}

    def check(self) -> None:
        """Refuse options of a chain with --method grid."""
        of_chain = [name for name in changed(self) if name in _CHAIN and name != "seed"]
        if self.method == "grid":
            refuse(of_chain, "together with --method grid, which runs no chain; leave one out")


@with_option_groups
def sample(
    files: Files,
    general: General,
    laws: Laws,
    reading: Reading,
    channels: Channels,
    model: ModelOptions,
    sampling: Sampling,
    writing: Writing,
    report: ReportPlace = None,
    record: AsRecords = False,
) -> None:
    """Sample the posterior of the parameters.

    Example: dahl-ident datasets noisy -o - | dahl-ident sample - --prior f_max=0.01:1
    """
    from dahl_ident.results import posterior as estimate_posterior

    laws.run()
    writing.check([report], files, json=general.json)
    check_reports(report)
    sampling.check()
    how = {**model.keywords(), **sampling.keywords()}
    data = reading.read_any(files, channels, record=record)
    try:
        posterior = estimate_posterior(data, **how)
    except KeyboardInterrupt:
        console.write_error(_kept(sampling.resume))
        raise
    if general.json:
        console.write_json(posterior.to_dict())
    elif report != STANDARD:
        console.write_wrapped(str(posterior))
    report_also([posterior], report, writing, model.metadata)
    finish(posterior)


def _kept(chain: Path | None) -> str:
    """Return a message on where a stopped chain is kept."""
    if chain is None:
        return "the chain is not kept; with --resume chain.h5 a stopped chain can be continued"
    if not chain.exists():
        return f"{chain}: the chain had not begun"
    return f"{chain} holds the chain so far; the same command continues from there"

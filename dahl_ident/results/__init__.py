"""Results for users: estimates with their verdicts, from one call."""

from dahl_ident.results.bayesian_estimate import posterior
from dahl_ident.results.chain_posterior import ChainPosterior
from dahl_ident.results.estimate import fit, fit_many
from dahl_ident.results.fit_batch import FitBatch
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.grid_posterior import GridPosterior
from dahl_ident.results.posterior_base import Posterior
from dahl_ident.results.record_fit import RecordFit
from dahl_ident.results.record_posterior import RecordPosterior
from dahl_ident.results.result import Estimate

__all__ = [
    "ChainPosterior",
    "Estimate",
    "FitBatch",
    "FitResult",
    "GridPosterior",
    "Posterior",
    "RecordFit",
    "RecordPosterior",
    "fit",
    "fit_many",
    "posterior",
]

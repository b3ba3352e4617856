"""What users hold: estimates with their judgement, from one call."""

from dahl_ident.results.estimate import fit, fit_many
from dahl_ident.results.fit_batch import FitBatch
from dahl_ident.results.fit_numbers import Estimate
from dahl_ident.results.fit_result import FitResult
from dahl_ident.results.grid_posterior import GridPosterior
from dahl_ident.results.posterior import Posterior
from dahl_ident.results.sampling import posterior_grid, sample

__all__ = [
    "Estimate",
    "FitBatch",
    "FitResult",
    "GridPosterior",
    "Posterior",
    "fit",
    "fit_many",
    "posterior_grid",
    "sample",
]

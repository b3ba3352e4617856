"""Results for users: estimates with their verdicts, from one call."""

from dahl_ident.results.estimate import fit, fit_many, posterior
from dahl_ident.results.fit_result import FitBatch, FitResult
from dahl_ident.results.posterior_result import Posterior
from dahl_ident.results.result import Estimate

__all__ = [
    "Estimate",
    "FitBatch",
    "FitResult",
    "Posterior",
    "fit",
    "fit_many",
    "posterior",
]

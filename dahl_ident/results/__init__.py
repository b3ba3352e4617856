"""What users hold: estimates with their judgement, from one call."""

from dahl_ident.results.estimate import fit
from dahl_ident.results.fit_result import Estimate, FitResult

__all__ = ["Estimate", "FitResult", "fit"]

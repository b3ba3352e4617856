"""Least squares: from a problem to its optimum, or the reason why there is none."""

from dahl_ident.fitting.optimum import DeterminedCombination, Optimum, OptimumBatch, Status
from dahl_ident.fitting.search import solve, solve_many

__all__ = ["DeterminedCombination", "Optimum", "OptimumBatch", "Status", "solve", "solve_many"]

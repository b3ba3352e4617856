"""Least squares: from a problem to its optimum, or the reason why there is none."""

from dahl_ident.fitting.optimum import DeterminedCombination, Optimum, OptimumBatch
from dahl_ident.fitting.search import solve, solve_many
from dahl_ident.fitting.status import Status

__all__ = ["DeterminedCombination", "Optimum", "OptimumBatch", "Status", "solve", "solve_many"]

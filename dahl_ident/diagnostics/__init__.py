"""Judging an estimate: how far to trust its numbers, and what the data cannot say."""

from dahl_ident.diagnostics.comparison import ModelComparison, compare_models
from dahl_ident.diagnostics.goodness import Goodness
from dahl_ident.diagnostics.intervals import ConfidenceIntervals, Interval, IntervalComparison
from dahl_ident.diagnostics.verdicts import Identifiability, Verdict, identifiability

__all__ = [
    "ConfidenceIntervals",
    "Goodness",
    "Identifiability",
    "Interval",
    "IntervalComparison",
    "ModelComparison",
    "Verdict",
    "compare_models",
    "identifiability",
]

"""Diagnostics of an estimate: whether it can be used, and what the data do not determine."""

from dahl_ident.diagnostics.budget import Budget, budget
from dahl_ident.diagnostics.comparison import ModelComparison, compare_models
from dahl_ident.diagnostics.error_model import ErrorModel, error_model
from dahl_ident.diagnostics.goodness import Goodness
from dahl_ident.diagnostics.intervals import ConfidenceIntervals, Interval, IntervalComparison
from dahl_ident.diagnostics.judgement import Finding, Judgement, Question, VerdictStatus
from dahl_ident.diagnostics.verdicts import Identifiability, Verdict, identifiability

__all__ = [
    "Budget",
    "ConfidenceIntervals",
    "ErrorModel",
    "Finding",
    "Goodness",
    "Identifiability",
    "Interval",
    "IntervalComparison",
    "Judgement",
    "ModelComparison",
    "Question",
    "Verdict",
    "VerdictStatus",
    "budget",
    "compare_models",
    "error_model",
    "identifiability",
]

"""The estimation problem: data, model, noise and sensors, and what follows from them.

A :class:`Problem` is the one source of predictions, residuals, derivatives and likelihood;
every solver and sampler uses only this, so they all estimate the same quantities. It is a
:class:`TableProblem` for a table, a :class:`ProblemBatch` for many tables of one shape at once,
and a :class:`RecordProblem` for records of any motion.

All work in **search coordinates** theta: the logarithm of positive parameters, the number itself
for most others. Residuals are whitened by the noise model (see :mod:`dahl_ident.noise`), so that
the sum of their squares is -2 ln L up to a constant: exactly where the scale of the noise is
known, after division by scale^2 where it is not.
"""

from dahl_ident.problem.base import EXPLICIT, Problem, Quadratic
from dahl_ident.problem.from_data import (
    ProblemBatch,
    changed_options,
    problem_class,
    problem_of,
    refuse_options,
)
from dahl_ident.problem.prediction import Prediction
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.problem.table_problem import TableProblem

__all__ = [
    "EXPLICIT",
    "Prediction",
    "Problem",
    "ProblemBatch",
    "Quadratic",
    "RecordProblem",
    "TableProblem",
    "changed_options",
    "problem_class",
    "problem_of",
    "refuse_options",
]

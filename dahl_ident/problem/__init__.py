"""The estimation problem: data, model, noise and sensors, and what follows from them.

A :class:`Problem` is the one source of predictions, residuals, derivatives and likelihood; every
solver and sampler uses only this, so they all estimate the same quantities. A :class:`ProblemBatch`
is the same for many tables of one shape at once.

Both work in **search coordinates** theta: the logarithm of positive parameters, the number itself
for the others. Residuals are whitened by the noise model (see :mod:`dahl_ident.noise`), so that
the sum of their squares is -2 ln L up to a constant: exactly where the scale of the noise is
known, after division by scale^2 where it is not.
"""

from dahl_ident.problem.batch import ProblemBatch
from dahl_ident.problem.prediction import Prediction
from dahl_ident.problem.problem import EXPLICIT, Problem, Quadratic

__all__ = ["EXPLICIT", "Prediction", "Problem", "ProblemBatch", "Quadratic"]

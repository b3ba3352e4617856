r"""The noise's scale at weighted points of the parameters.

At fixed parameters with sum of squares S over n rows, s^2 follows the inverse gamma distribution
with shape n and scale S/2. Each point gets one quantile of it. Points in order of S take the
probabilities of a sequence that fills the square evenly together with that order, so that the
mixture over the points is followed far more closely than by random draws.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammainccinv

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.importance import WeightedPoints, in_blocks


def with_scale(density: Density, points: WeightedPoints) -> FloatArray:
    """Return theta of the points with ln s as their last coordinate, (N, P + 1)."""
    from scipy.stats import qmc

    sums = in_blocks(density.sums, points.theta)
    uniform = qmc.Halton(2, scramble=False).random(len(sums) + 1)[1:]  # the first is zero
    uniform = uniform[np.argsort(np.argsort(np.log(sums).mean(axis=1)))]
    below = np.cumsum(density.probabilities(sums), axis=1)
    size = np.sum(uniform[:, 1:] * below[:, -1:] > below, axis=1, keepdims=True)
    squares = np.take_along_axis(sums, size, axis=1)[:, 0]
    rows = density.problem.n_residuals // 2
    ln_s = 0.5 * np.log(0.5 * squares / gammainccinv(rows, uniform[:, 0]))
    return np.column_stack([points.theta, ln_s])

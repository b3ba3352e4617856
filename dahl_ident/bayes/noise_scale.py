r"""The posterior of the noise's scale, given that of the parameters.

At fixed parameters with sum of squares S over n rows, s^2 follows the inverse gamma distribution
with shape n and scale S/2; the posterior is the mixture of those over the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaincc, gammainccinv, gammaln

from dahl_ident.arrays import FloatArray

_ATOMS = 256  # groups of similar S that represent all points in quantiles
BISECTIONS = 50  # to rounding: 2^-50 of a bracket


def ln_scale_draws(squares: FloatArray, rows: int, random: np.random.Generator) -> FloatArray:
    """Return a draw of ln s for each sum of squares, (N,)."""
    return np.asarray(0.5 * np.log(0.5 * squares / random.gamma(rows, size=squares.shape)))


@dataclass(frozen=True)
class ScalePosterior:
    """A mixture over points with sums of squares and probabilities, both of shape (N,)."""

    squares: FloatArray
    weights: FloatArray
    rows: int

    def mean(self) -> float:
        """Return the mean of s; infinite for a single row."""
        ratio = np.exp(gammaln(self.rows - 0.5) - gammaln(self.rows))
        return float(ratio * (self.weights @ np.sqrt(0.5 * self.squares)))

    def std(self) -> float:
        """Return the standard deviation of s; infinite for a single row."""
        if self.rows < 2:
            return float("inf")
        square = self.weights @ self.squares / (2.0 * (self.rows - 1))
        return float(np.sqrt(square - self.mean() ** 2))

    def density(self, s: FloatArray) -> FloatArray:
        """Return the density of s at points of shape (Q,)."""
        squares, weights = self._atoms
        z = 0.5 * squares * s[:, None] ** -2.0
        n = self.rows
        return np.asarray(2.0 / s * (np.exp(n * np.log(z) - z - gammaln(n)) @ weights))

    def quantiles(self, probabilities: FloatArray) -> FloatArray:
        """Return quantiles of s."""
        squares, weights = self._atoms
        # a quantile of the mixture lies between the same of the parts of least and largest S
        alone = -0.5 * np.log(gammainccinv(self.rows, probabilities))
        low, high = (alone + 0.5 * np.log(0.5 * S) for S in (squares.min(), squares.max()))
        for _ in range(BISECTIONS):
            ln_s = 0.5 * (low + high)
            below = gammaincc(self.rows, 0.5 * squares * np.exp(-2.0 * ln_s)[:, None]) @ weights
            under = below < probabilities
            low, high = np.where(under, ln_s, low), np.where(under, high, ln_s)
        return np.asarray(np.exp(0.5 * (low + high)))

    @cached_property
    def _atoms(self) -> tuple[FloatArray, FloatArray]:
        """Return groups of points with nearly equal S."""
        order = np.argsort(self.squares)
        weights, squares = self.weights[order], self.squares[order]
        group = np.minimum(np.cumsum(weights) * _ATOMS, _ATOMS - 1).astype(np.intp)
        total = np.bincount(group, weights, _ATOMS)
        log_squares = np.bincount(group, weights * np.log(squares), _ATOMS)
        filled = total > 0.0
        return np.exp(log_squares[filled] / total[filled]), total[filled] / total.sum()

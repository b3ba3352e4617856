r"""Likelihood of a table with every source of error, around the weighted least-squares estimate.

The sum S of squares of the weighted residuals y has its minimum at the estimate t. Rows share
errors, so the curvature of S overstates the information, for some parameters more than for others.
S is therefore evaluated at theta* = t + A (theta - t), with A such that the curvature at t is the
inverse of the covariance of all sources (curvature adjustment of a composite likelihood: Ribatet,
Cooley and Davison, Statistica Sinica 22 (2012) 813-845).

Let J be the derivatives of y, Q an orthonormal basis of their columns, and z = Q'J (theta - t) the
change of y due to the parameters. In these coordinates the errors have the covariance

    V = kappa V_n + lambda V_c,

V_n of the noise and V_c of the errors that rows share. At kappa = lambda = 1, z* = V^(-1/2) z, and
S(theta*) is z' V^-1 z times a factor, which is 1 for a linear model. The same factor is used for
other kappa and lambda. In the coordinates W z, V_n is the unit matrix and V_c is diagonal with the
elements mu.

kappa and lambda are unknown, because the sizes of V_c and, where the data do not state it, of V_n
are estimates. They take M equally probable pairs of values. kappa is distributed as n/chi^2_n, with
the n degrees of freedom of the noise. lambda is such that the parameter which V_c affects most has
Student's t distribution with the nu effective degrees of freedom of its budget: with p the share of
V_c in its squared uncertainty, p lambda + 1 - p is distributed as nu/chi^2_nu. The likelihood is
the mean over the pairs, where each term is divided by its integral over the parameters (by
Laplace's approximation).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from dahl_ident.arrays import TINY, FloatArray

_SIZES = 32  # pairs of sizes: the 95 % limits of Student's t with 2 dof then err by 2 %
_NEARLY_NORMAL = 200.0  # degrees of freedom from which its 95 % limits are normal to 1 %


@dataclass(frozen=True)
class RowErrors:
    """Errors of a table's m residuals, in the directions in which parameters change them."""

    counted: tuple[str, ...]  # sources of error
    factors: FloatArray  # (n, 2, 2): from a row's residuals to the weighted ones, y
    scale: float  # of the noise; 1 where the data state it
    centre: FloatArray  # (P,) t
    least: float  # S at t
    adjustment: FloatArray  # (P, P) A
    moves: FloatArray  # (r, P): W z = moves (theta - t)
    shared: FloatArray  # (r,) mu
    offset: FloatArray  # (r,) W Q'y at t; not zero if priors pull the estimate
    pull: FloatArray  # (r,) y'Q z* at t is pull . W z
    outside: float  # square of the part of y at t that is orthogonal to Q
    log_volume: float  # ln of the determinants of W and of the factors
    # (R, P) derivatives of W Q'y and of the residuals of priors with respect to the parameters
    jacobian: FloatArray
    at_estimate: FloatArray  # (R,) these residuals at t
    dof: float  # nu
    share: float  # p
    noise_dof: float  # n, infinite where the data state the noise

    @cached_property
    def sizes(self) -> FloatArray:
        """Values of kappa and lambda, (2, M), equally probable."""
        from scipy.stats import qmc

        by_share, by_noise = (qmc.Halton(2, scramble=False).random(_SIZES) + 0.5 / _SIZES).T
        of_noise, of_shared = np.ones(_SIZES), np.ones(_SIZES)
        if self.noise_dof < _NEARLY_NORMAL:
            of_noise = self.noise_dof / chdtri(self.noise_dof, by_noise)
        if self.dof < _NEARLY_NORMAL and self.share > 0.0:
            of_shared += (self.dof / chdtri(self.dof, by_share) - 1.0) / self.share
        pairs: FloatArray = np.unique([of_noise, np.maximum(of_shared, 0.0)], axis=1)
        return pairs

    @cached_property
    def variances(self) -> FloatArray:
        """Variances of the errors of W z, (r, 1 + M): for kappa = lambda = 1, then each pair."""
        each = self.sizes[0] + self.shared[:, None] * self.sizes[1]
        return np.column_stack([1.0 + self.shared, each])

    @cached_property
    def log_weights(self) -> FloatArray:
        """Ln of each pair's weight, (M,), which makes its integral that for kappa = lambda = 1."""
        estimated, *each = map(self._log_integral, self.variances.T)
        volume = self.log_volume - 0.5 * float(np.log1p(self.shared).sum())
        return np.asarray(volume + estimated - np.array(each) - np.log(len(each)))

    def _log_integral(self, variances: FloatArray) -> float:
        """Return ln of the likelihood's integral over the parameters, less constants."""
        root = np.ones(len(self.jacobian))
        root[: len(variances)] = np.sqrt(variances)
        Q, R = np.linalg.qr(self.jacobian / root[:, None])
        z = self.at_estimate / root
        squares = float(z @ z - np.sum((Q.T @ z) ** 2))
        return -float(np.log(np.abs(np.diagonal(R))).sum()) - 0.5 * squares

    @property
    def information(self) -> FloatArray:
        """The inverse of the covariance of all sources, (P, P), without priors."""
        return np.asarray(self.moves.T @ (self.moves / self.variances[:, :1]))

    def adjusted(self, theta: FloatArray) -> FloatArray:
        """Return theta*, (S, P)."""
        return np.asarray(self.centre + (theta - self.centre) @ self.adjustment.T)

    def weighted(self, y: FloatArray) -> FloatArray:
        """Return the weighted residuals, (S, m), for residuals of the same shape."""
        pairs = y.reshape(len(y), -1, 1, 2)
        return np.asarray(np.sum(pairs * self.factors, axis=-1).reshape(y.shape))

    def squares(self, theta: FloatArray, sums: FloatArray) -> FloatArray:
        """Return -2 ln L for each pair of sizes, (S, M), from the sums S(theta*), (S,)."""
        Wz = (theta - self.centre) @ self.moves.T
        square, *each = (Wz**2 @ (1.0 / self.variances)).T
        nonlinear = sums - self.least - 2.0 * Wz @ self.pull - square
        linear = (Wz + self.offset) ** 2 @ (1.0 / self.variances[:, 1:]) + self.outside
        factors = np.transpose(each) / np.maximum(square, TINY)[:, None]
        return np.asarray(linear + nonlinear[:, None] * factors)

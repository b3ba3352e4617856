r"""Likelihood of a table with every source of error, around the weighted least-squares estimate.

The sum S of squares of weighted residuals y has its minimum at the estimate t. Rows share errors,
so S has too much information, more on some parameters than on others. It is therefore evaluated at
theta* = t + A (theta - t), with A such that its curvature at t is the inverse of the covariance of
all sources (curvature adjustment of a composite likelihood: Ribatet, Cooley and Davison, Statistica
Sinica 22 (2012) 813-845). With Q an orthonormal basis of the derivatives J, z = Q'J (theta - t) are
the directions in which parameters move y. There the errors have the covariance

    V = kappa V_n + lambda V_c

of noise V_n and of errors V_c that rows share. At kappa = lambda = 1, z* = V^(-1/2) z, and
S(theta*) is z' V^-1 z times a factor, which is 1 where all is linear; with other sizes V is
another, and the factor the same. In coordinates W z in which V_n is the unit matrix, V_c is
diagonal, mu.

The sizes of V_n, where the data do not state it, and of V_c were estimated, so kappa and lambda are
unknown. They take M equally probable values: kappa follows n/chi^2_n with the n degrees of freedom
of the noise; lambda is such that the parameter which V_c affects most follows Student's t with the
nu effective degrees of freedom of its budget: with p the share of V_c in its squared uncertainty,
p lambda + 1 - p follows nu/chi^2_nu. The likelihood is the mean of the likelihoods with each size,
each divided by its integral over the parameters (Laplace's).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from dahl_ident.arrays import TINY, FloatArray

_SIZES = 32  # values of lambda: limits of Student's t with 2 dof then err by 2 % at 95 %
_NEARLY_NORMAL = 200.0  # degrees of freedom from which Student's t is normal to 1 % at 95 %


@dataclass(frozen=True)
class RowErrors:
    """Covariance of what a table's m residuals say about the parameters, and its sources."""

    counted: tuple[str, ...]
    factors: FloatArray  # (n, 2, 2): from a row's residuals to the weighted ones, y
    scale: float  # of the noise, where the data do not state it
    centre: FloatArray  # (P,) t
    least: float  # S at t
    adjustment: FloatArray  # (P, P) A
    moves: FloatArray  # (r, P): W z = moves (theta - t)
    shared: FloatArray  # (r,) mu
    offset: FloatArray  # (r,) W Q'y at t: the data's pull against priors
    pull: FloatArray  # (r,) its product with z* is pull . W z
    outside: float  # square of y at t outside Q
    log_volume: float  # ln of the determinant of W and the factors
    # (R, P) of W Q'y and of the residuals of priors, with respect to what these determine
    jacobian: FloatArray
    at_estimate: FloatArray  # (R,) these residuals at the estimate
    dof: float  # nu
    share: float  # p
    noise_dof: float  # n, infinite where the data state the noise

    @cached_property
    def sizes(self) -> FloatArray:
        """Values of kappa and lambda, (2, M), equally probable."""
        from scipy.stats import qmc

        by_share, by_noise = (qmc.Halton(2, scramble=False).random(_SIZES) + 0.5 / _SIZES).T
        noise, whole = np.ones(_SIZES), np.ones(_SIZES)
        if self.noise_dof < _NEARLY_NORMAL:
            noise = self.noise_dof / chdtri(self.noise_dof, by_noise)
        if self.dof < _NEARLY_NORMAL and self.share > 0.0:
            whole += (self.dof / chdtri(self.dof, by_share) - 1.0) / self.share
        pairs: FloatArray = np.unique([noise, np.maximum(whole, 0.0)], axis=1)
        return pairs

    @cached_property
    def variances(self) -> FloatArray:
        """Variances of the errors of W z, (r, 1 + M): of the estimated sizes, then of each."""
        each = self.sizes[0] + self.shared[:, None] * self.sizes[1]
        return np.column_stack([1.0 + self.shared, each])

    @cached_property
    def log_weights(self) -> FloatArray:
        """Ln of each likelihood's weight, (M,): all integrals become that of estimated sizes."""
        whole, *each = map(self._log_integral, self.variances.T)
        volume = self.log_volume - 0.5 * float(np.log1p(self.shared).sum())
        return np.asarray(volume + whole - np.array(each) - np.log(len(each)))

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
        """Return weighted residuals of residuals, (S, m)."""
        return np.asarray(np.sum(y.reshape(len(y), -1, 1, 2) * self.factors, axis=-1)).reshape(
            y.shape
        )

    def squares(self, theta: FloatArray, sums: FloatArray) -> FloatArray:
        """Return -2 ln L for each size, (S, M), of the sums S(theta*), (S,)."""
        Wz = (theta - self.centre) @ self.moves.T
        square, *each = (Wz**2 @ (1.0 / self.variances)).T
        nonlinear = sums - self.least - 2.0 * Wz @ self.pull - square
        linear = (Wz + self.offset) ** 2 @ (1.0 / self.variances[:, 1:]) + self.outside
        factors = np.transpose(each) / np.maximum(square, TINY)[:, None]
        return np.asarray(linear + nonlinear[:, None] * factors)

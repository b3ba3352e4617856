r"""Errors that the rows of a table share in addition to independent noise, in a likelihood.

Residuals y have the covariance s^2 (V_n + lambda V_c): noise V_n and shared errors V_c
(scatter between runs and levels, a smooth model error), both relative to the noise's scale s. In
coordinates W y in which V_n is the unit matrix and V_c is diagonal, mu,

    -2 ln L = sum of (W y)^2/(1 + lambda mu)/s^2 + constants.

The size of V_c was estimated, so lambda is unknown. It takes M equally probable values, such that
the parameter which V_c affects most follows Student's t with the nu effective degrees of freedom of
its budget: with p the share of V_c in its squared uncertainty, p lambda + 1 - p follows
nu/chi^2_nu. The likelihood is the mean of the likelihoods with each lambda, each divided by its
integral over the parameters (Laplace's).

Where a parameter differs from run to run, V_c includes the effect on the residuals to first order,
so the residuals are linear in that parameter, which is the mean over runs. What leaving out tests
adds to the covariance of the estimate, C, is J C J' in V_c, with J the derivatives of y: it adds C
to the covariance of the parameters and does not move them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from dahl_ident.arrays import FloatArray

_SIZES = 32  # values of lambda: limits of Student's t with 2 dof then err by 2 % at 95 %
_NEARLY_NORMAL = 200.0  # degrees of freedom from which Student's t is normal to 1 % at 95 %


@dataclass(frozen=True)
class RowErrors:
    """Covariance of a table's m residuals, and the sources that it counts."""

    counted: tuple[str, ...]
    turn: FloatArray  # (k, m) W: to k coordinates in which residuals are independent
    shared: FloatArray  # (k,) mu: variance of what rows share there; that of noise is 1
    log_volume: float  # ln of the determinant of W
    factors: FloatArray  # (n, 2, 2): from a row's residuals to those with noise of unit variance
    dof: float  # nu
    share: float  # p
    # (M, P) of weighted residuals, those of priors last, with respect to what these determine
    jacobian: FloatArray
    residuals: FloatArray  # (M,) weighted, at the estimate
    scale_known: bool  # whether s is 1
    # (P,) estimates of parameters that differ from run to run, search coordinates; NaN for others
    centre: FloatArray
    slopes: FloatArray  # (m, P) derivatives of the residuals with respect to them, 0 for others
    # (m, k) orthonormal directions beyond which rows share nothing, where rows are many
    inside: FloatArray | None = None

    @cached_property
    def sizes(self) -> FloatArray:
        """Values of lambda, (M,), equally probable."""
        if self.dof > _NEARLY_NORMAL or not self.share > 0.0:
            return np.ones(1)
        whole = self.dof / chdtri(self.dof, (np.arange(_SIZES) + 0.5) / _SIZES)
        return np.asarray(np.maximum(1.0 + (whole - 1.0) / self.share, 0.0))

    @cached_property
    def _variances(self) -> FloatArray:
        """Variance of each coordinate for each lambda, (k, M)."""
        return 1.0 + self.shared[:, None] * self.sizes

    @cached_property
    def log_weights(self) -> FloatArray:
        """Ln of each likelihood's weight, (M,): all integrals become that of lambda = 1."""
        every = np.column_stack([1.0 + self.shared, self._variances])
        at_one, *each = [self._log_integral(variances) for variances in every.T]
        volume = self.log_volume - 0.5 * float(np.log1p(self.shared).sum())
        return np.asarray(volume + at_one - np.array(each) - np.log(len(self.sizes)))

    def _log_integral(self, variances: FloatArray) -> float:
        """Return ln of the likelihood's integral over parameters and scale, less constants."""
        root, m = np.sqrt(variances), self.turn.shape[1]
        J, y = self.jacobian, self.residuals
        Q, R = np.linalg.qr(np.vstack([self.turn @ J[:m] / root[:, None], J[m:]]))
        z = np.append(self.turn @ y[:m] / root, y[m:])
        squares = float(z @ z - np.sum((Q.T @ z) ** 2))
        if self.inside is not None:  # where rows share nothing
            squares += max(float(y[:m] @ y[:m] - np.sum((y[:m] @ self.inside) ** 2)), 0.0)
        size = -float(np.log(np.abs(np.diagonal(R))).sum())
        if self.scale_known:
            return size - 0.5 * squares
        return size - 0.5 * (len(y) - len(R)) * float(np.log(squares))

    def at_centre(self, theta: FloatArray) -> FloatArray:
        """Return theta, (S, P), with parameters that differ from run to run at their centre."""
        return np.where(np.isnan(self.centre), theta, self.centre)

    def change(self, theta: FloatArray) -> FloatArray:
        """Return the change of the residuals with these parameters from their centre, (S, m)."""
        return np.asarray((theta - self.at_centre(theta)) @ self.slopes.T)

    def uncorrelated(self, y: FloatArray) -> FloatArray:
        """Return uncorrelated residuals, (..., m) -> (..., K), the last not shared by rows."""
        y = np.sum(y.reshape(*y.shape[:-1], -1, 1, 2) * self.factors, axis=-1).reshape(y.shape)
        turned = y @ self.turn.T
        if self.inside is None:
            return np.asarray(turned)
        return np.concatenate([turned, y - (y @ self.inside) @ self.inside.T], axis=-1)

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the squares of uncorrelated residuals, for each lambda, (K, M)."""
        alone = 0 if self.inside is None else len(self.inside)
        return np.concatenate([1.0 / self._variances, np.ones((alone, len(self.sizes)))])

    def independent(self, y: FloatArray) -> FloatArray:
        """Return independent residuals, (..., m) -> (..., K), whose squares have equal weight.

        Their sum of squares is that of lambda = 1.
        """
        y = self.uncorrelated(y)
        y[..., : len(self.shared)] /= np.sqrt(1.0 + self.shared)
        return y

r"""Variances of several sources of error from one set of residuals (REML).

Residuals y = J delta + e with the covariance V = F + sum_k s_k Z_k Z_k', F known and s_k >= 0
unknown. Restricted maximum likelihood takes what the parameters explain out of y first, so that
the variances are not too small by the degrees of freedom used. Fisher scoring, projected on
s_k >= 0: with P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1,

    gradient_k = (|Z_k' P y|^2 - tr Z_k' P Z_k)/2,    information_kl = |Z_k' P Z_l|^2/2.

Source: Patterson and Thompson, Biometrika 58 (1971) 545; Searle, Casella and McCulloch,
*Variance Components*, 1992, chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from dahl_ident.arrays import FloatArray

_STEPS = 40
_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.02)  # of a scoring step, until the likelihood rises
_CLOSE = 1e-4  # rise of the log-likelihood that no longer matters
_LEAST = 1e-10  # variance over the largest, below which it is none


@dataclass(frozen=True)
class LinearModel:
    """Residuals, what parameters explain of them, and the columns of each source of error.

    Attributes
    ----------
    y : ndarray, shape (m,)
        Residuals.
    J : ndarray, shape (m, P)
        Their derivatives by the parameters, of full rank.
    known : ndarray, shape (m,)
        Variances that are known, 0 elsewhere.
    Z : sequence of ndarray, shape (m, q) or (m,)
        Columns of each source; one dimension stands for a diagonal matrix.
    outside : (float, int)
        Sum of squares and number of further residuals, of the first row's known variance plus
        the first source's, which neither parameters nor other sources can change.
    rotation : ndarray, shape (M, m - priors) or None
        Orthonormal directions to which M rows of data were compressed; None where they were not.
    """

    y: FloatArray
    J: FloatArray
    known: FloatArray
    Z: Sequence[FloatArray]
    outside: tuple[float, int] = (0.0, 0)
    rotation: FloatArray | None = None

    def compressed(self, rows: int) -> LinearModel:
        """Return the same likelihood of fewer residuals, where only the first source is diagonal.

        The first `rows` residuals, of one known variance and one size of the first source, are
        projected on what parameters and other sources can change.
        """
        inside, _ = np.linalg.qr(np.column_stack([self.J[:rows], *(z[:rows] for z in self.Z[1:])]))

        def turned(part: FloatArray) -> FloatArray:
            return np.concatenate([inside.T @ part[:rows], part[rows:]])

        y = turned(self.y)
        r = inside.shape[1]
        left = float(self.y[:rows] @ self.y[:rows] - y[:r] @ y[:r])
        return LinearModel(
            y,
            turned(self.J),
            np.concatenate([self.known[:r], self.known[rows:]]),
            [np.concatenate([self.Z[0][:r], self.Z[0][rows:]]), *map(turned, self.Z[1:])],
            (max(left, 0.0), rows - r),
            inside,
        )

    def outside_variance(self, variances: FloatArray) -> float:
        """Return the variance of the residuals outside."""
        return float(self.known[0] + variances[0])

    def covariance(self, variances: FloatArray) -> FloatArray:
        """Return V, shape (m, m)."""
        V = np.diag(self.known)
        for part, variance in zip(self.Z, variances.tolist(), strict=True):
            if variance <= 0.0:
                continue
            if part.ndim == 1:
                V[np.diag_indices_from(V)] += variance * part**2
            else:
                V += variance * (part @ part.T)
        return V


@dataclass(frozen=True)
class VarianceComponents:
    """Variances of the sources, and how well they are known.

    Attributes
    ----------
    variances : ndarray, shape (K,)
        One a source, 0 where the residuals ask for none.
    covariance : ndarray, shape (K, K)
        Of the variances; zero for those at 0.
    log_likelihood : float
        Restricted, up to a constant.
    """

    variances: FloatArray
    covariance: FloatArray
    log_likelihood: float


class Projection:
    """V^-1 and the projection P of a linear model at given variances."""

    def __init__(self, model: LinearModel, variances: FloatArray) -> None:
        L = np.linalg.cholesky(model.covariance(variances))
        self.inverse_factor = linalg.lapack.dtrtri(L, lower=1)[0]
        white = self.inverse_factor @ np.column_stack([model.J, model.y])
        Q, self.R = np.linalg.qr(white[:, :-1])
        left = white[:, -1] - Q @ (Q.T @ white[:, -1])
        self.explained = Q.T @ self.inverse_factor
        self.P = self.inverse_factor.T @ self.inverse_factor - self.explained.T @ self.explained
        self.Py = self.inverse_factor.T @ left
        log_det = np.log(np.diagonal(L)).sum() + np.log(np.abs(np.diagonal(self.R))).sum()
        self.log_likelihood = float(-log_det - 0.5 * left @ left)
        rest, count = model.outside
        if count:
            variance = model.outside_variance(variances)
            self.log_likelihood -= 0.5 * (count * float(np.log(variance)) + rest / variance)

    def generalised_inverse(self) -> FloatArray:
        """Return G = (J' V^-1 J)^-1 J' V^-1, shape (P, m)."""
        return np.asarray(linalg.solve_triangular(self.R, self.explained))


def variance_components(
    model: LinearModel, start: FloatArray, upper: FloatArray | float = np.inf
) -> VarianceComponents:
    """Return the restricted maximum-likelihood variances of the sources.

    Parameters
    ----------
    model : LinearModel
        Residuals and sources.
    start : ndarray, shape (K,)
        Variances to start from; those at 0 join where the likelihood rises with them.
    upper : ndarray, shape (K,), optional
        Largest variances.

    Returns
    -------
    VarianceComponents

    Raises
    ------
    numpy.linalg.LinAlgError
        If V is singular at the start.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> day = np.repeat(np.eye(200), 5, axis=0)
    >>> y = 3.0 * day @ rng.standard_normal(200) + rng.standard_normal(1000)
    >>> model = LinearModel(y, np.ones((1000, 1)), np.zeros(1000), [np.ones(1000), day])
    >>> (variance_components(model, np.array([1.0, 0.0])).variances ** 0.5).round(1).tolist()
    [1.0, 2.8]
    """
    s = np.array(start, dtype=np.float64)
    state = Projection(model, s)
    gradient, information = _scores(state, model, s)
    for _ in range(_STEPS):
        step = _projected(s, gradient, information, s >= upper)
        found, rise = _along(model, state, s, step, upper)
        if found is None:
            break
        s, state = found
        gradient, information = _scores(state, model, s)
        if rise < _CLOSE:
            break
    covariance = np.zeros_like(information)
    inside = np.flatnonzero(s > 0.0)
    part = np.ix_(inside, inside)
    scaled, size = _scaled(information[part])
    covariance[part] = np.linalg.pinv(scaled) * np.outer(size, size)
    return VarianceComponents(s, covariance, state.log_likelihood)


def _projected(
    s: FloatArray, gradient: FloatArray, information: FloatArray, largest: NDArray[np.bool_]
) -> FloatArray:
    """Return the scoring step of the variances that are not held at zero or at their largest."""
    active = ((s > 0.0) | (gradient > 0.0)) & ~(largest & (gradient > 0.0))
    step = np.zeros(len(s))
    while active.any():
        part = np.ix_(active, active)
        step[:] = 0.0
        scaled, size = _scaled(information[part])
        step[active] = size * np.linalg.lstsq(scaled, size * gradient[active], rcond=None)[0]
        leaving = active & (((s == 0.0) & (step <= 0.0)) | (largest & (step > 0.0)))
        if not leaving.any():
            break
        active &= ~leaving
    return step


def _scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the information of variances in units of their own size, and these units.

    Variances of runs and of noise may lie many decades apart.
    """
    size = 1.0 / np.sqrt(np.maximum(np.diagonal(information), np.finfo(float).tiny))
    return information * np.outer(size, size), size


def _along(
    model: LinearModel,
    state: Projection,
    s: FloatArray,
    step: FloatArray,
    upper: FloatArray | float,
) -> tuple[tuple[FloatArray, Projection] | None, float]:
    """Return the first point along the step at which the likelihood is higher, and by how much."""
    for length in _LENGTHS:
        trial = np.clip(s + length * step, 0.0, upper)
        trial[trial < _LEAST * trial.max(initial=0.0)] = 0.0
        if not trial.any():
            continue
        try:
            other = Projection(model, trial)
        except np.linalg.LinAlgError:
            continue
        rise = other.log_likelihood - state.log_likelihood
        if rise > 0.0:
            return (trial, other), rise
    return None, 0.0


def _scores(
    state: Projection, model: LinearModel, variances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gradient of the restricted likelihood and its expected information."""
    Z, K = model.Z, len(model.Z)
    gradient, information = np.empty(K), np.empty((K, K))
    projected = [state.P * part if part.ndim == 1 else state.P @ part for part in Z]
    for k, own in enumerate(Z):
        score = own * state.Py if own.ndim == 1 else own.T @ state.Py
        for j in range(k, K):
            cross = own[:, None] * projected[j] if own.ndim == 1 else own.T @ projected[j]
            information[k, j] = information[j, k] = 0.5 * float(np.sum(cross**2))
            if j == k:
                gradient[k] = 0.5 * float(score @ score - np.trace(cross))
    rest, count = model.outside
    if count:
        variance = model.outside_variance(variances)
        gradient[0] += 0.5 * (rest / variance - count) / variance
        information[0, 0] += 0.5 * count / variance**2
    return gradient, information

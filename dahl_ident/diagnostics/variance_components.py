r"""Variances of several sources of error from one set of residuals (REML).

Residuals y = J delta + e with the covariance V = F + sum_k s_k Z_k Z_k', F known and s_k >= 0
unknown. Restricted maximum likelihood takes what the parameters explain out of y first, so that
the variances are not too small by the degrees of freedom used: with orthonormal contrasts K,
K'J = 0, it is the likelihood of K'y, whose covariance is W = K'VK. Fisher scoring, projected on
s_k >= 0: with W_k = K'Z_k Z_k'K and r = W^-1 K'y,

    gradient_k = (r' W_k r - tr W^-1 W_k)/2,    information_kl = tr(W^-1 W_k W^-1 W_l)/2.

Source: Patterson and Thompson, Biometrika 58 (1971) 545; Searle, Casella and McCulloch,
*Variance Components*, 1992, chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from dahl_ident.arrays import TINY, FloatArray

_STEPS = 40  # at most; the likelihood rises in each, so the last is the best
_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.02)  # of a scoring step, until the likelihood rises
CLOSE = 1e-3  # rise of the log-likelihood that no longer matters
_SETTLED = 1e-5  # twice the rise that a step promises, below which it is not made
_ALIKE = 1e-10  # added to correlations of one: sources that do the same share a variance
_LEAST = 1e-10  # variance over the largest, below which it is none


@dataclass(frozen=True)
class LinearModel:
    """Residuals, what parameters explain of them, and the columns of each source of error.

    Attributes
    ----------
    y : ndarray, shape (m,)
        Residuals.
    J : ndarray, shape (m, P)
        Their derivatives with respect to the parameters, of full rank.
    known : ndarray, shape (m,)
        Variances that are known, 0 elsewhere.
    Z : sequence of ndarray, shape (m, q) or (m,)
        Columns of each source; one dimension stands for a diagonal matrix.
    lever : ndarray, shape (P, m), or None
        What the estimate makes of the residuals, where that is not generalised least squares.
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
    lever: FloatArray | None = None
    outside: tuple[float, int] = (0.0, 0)
    rotation: FloatArray | None = None

    def compressed(self, rows: int) -> LinearModel:
        """Return the same likelihood of fewer residuals, where only the first source is diagonal.

        The first `rows` residuals, of one known variance and one size of the first source, are
        projected on what parameters and other sources can change.
        """
        lever = np.zeros((0, len(self.y))) if self.lever is None else self.lever
        changed = [self.J[:rows], lever[:, :rows].T, *(z[:rows] for z in self.Z[1:])]
        inside, _ = np.linalg.qr(np.column_stack(changed))

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
            None if self.lever is None else turned(lever.T).T,
            (max(left, 0.0), rows - r),
            inside,
        )

    def turned(self, lever: FloatArray) -> FloatArray:
        """Return what a lever of all residuals, (P, M), makes of these, (P, m)."""
        if self.rotation is None:
            return lever
        rows = len(self.rotation)
        return np.hstack([lever[:, :rows] @ self.rotation, lever[:, rows:]])

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
    information : ndarray, shape (K, K)
        Expected information on the variances.
    log_likelihood : float
        Restricted, up to a constant.
    largest : ndarray, shape (K,)
        Bounds of the variances.
    """

    variances: FloatArray
    information: FloatArray
    log_likelihood: float
    largest: FloatArray

    def only(self, kept: Sequence[int]) -> VarianceComponents:
        """Return those of some sources, of which the others have none."""
        part = np.array(kept)
        return replace(
            self,
            variances=self.variances[part],
            information=self.information[np.ix_(part, part)],
            largest=self.largest[part],
        )

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the variances, shape (K, K); zero for those at 0.

        No number between 0 and its bound has a standard deviation above half the bound (Popoviciu).
        """
        found = np.zeros_like(self.information)
        part = np.ix_(*[np.flatnonzero(self.variances > 0.0)] * 2)
        scaled, size = _scaled(self.information[part])
        found[part] = np.linalg.pinv(scaled) * np.outer(size, size)
        std = np.sqrt(np.diagonal(found))
        known = np.divide(0.5 * self.largest, std, out=np.ones(len(std)), where=std > 0.0)
        known = np.minimum(known, 1.0)
        return np.asarray(found * np.outer(known, known))


class Projection:
    """V^-1 and the projection P of a linear model at given variances."""

    def __init__(self, model: LinearModel, variances: FloatArray) -> None:
        self._model, self._variances = model, variances
        L = np.linalg.cholesky(model.covariance(variances))
        inverse_factor = linalg.lapack.dtrtri(L, lower=1)[0]
        Q, R = np.linalg.qr(inverse_factor @ model.J)
        self._root, singular = linalg.lapack.dtrtri(R)
        if singular:
            raise np.linalg.LinAlgError("a parameter has no effect on the residuals")
        self._explained = Q.T @ inverse_factor
        self.P = inverse_factor.T @ inverse_factor - self._explained.T @ self._explained

    def effects(self) -> list[FloatArray]:
        """Return the best linear prediction of each source's numbers: s_k Z_k' P y."""
        weighted = self.P @ self._model.y
        return [
            s * (part * weighted if part.ndim == 1 else weighted @ part)
            for s, part in zip(self._variances.tolist(), self._model.Z, strict=True)
        ]

    def generalised_inverse(self) -> FloatArray:
        """Return G = (J' V^-1 J)^-1 J' V^-1, shape (P, m)."""
        return np.asarray(self._root @ self._explained)

    def covariance(self) -> FloatArray:
        """Return (J' V^-1 J)^-1 = G V G', shape (P, P)."""
        return np.asarray(self._root @ self._root.T)


class RowProjection:
    """P of a linear model between some residuals of the data, all of them if compressed."""

    def __init__(
        self, model: LinearModel, projection: Projection, variances: FloatArray, y: FloatArray
    ) -> None:
        P, self._rotation = projection.P, model.rotation
        m = len(y)
        self._outside, self._size = 0.0, 0.0
        if self._rotation is not None:
            m = self._rotation.shape[1]
            if model.outside[1]:
                self._outside = 1.0 / model.outside_variance(variances)
                self._size = float(model.Z[0][0])
        self._P = P[:m, :m]
        self._sources = [P[:m] * z if z.ndim == 1 else P[:m] @ z for z in model.Z]
        weighted = P[:m] @ model.y
        if self._rotation is not None:
            outside = y - self._rotation @ model.y[:m]
            weighted = self._outside * outside + self._rotation @ weighted
        self.weighted = weighted
        """P y, (m,)."""

    def block(self, rows: NDArray[np.intp]) -> FloatArray:
        """Return P of some residuals, (r, r)."""
        if self._rotation is None:
            return np.asarray(self._P[np.ix_(rows, rows)])
        own = self._rotation[rows]
        return np.asarray(self._outside * self._complement(own) + own @ self._P @ own.T)

    def falls(self, rows: NDArray[np.intp]) -> FloatArray:
        """Return by how much that block falls with each variance, P V_k P, (K, r, r)."""
        own = None if self._rotation is None else self._rotation[rows]
        found = []
        for part in self._sources:
            turned = part[rows] if own is None else own @ part
            found.append(turned @ turned.T)
        if own is not None:
            found[0] = found[0] + (self._outside * self._size) ** 2 * self._complement(own)
        return np.array(found)

    @staticmethod
    def _complement(own: FloatArray) -> FloatArray:
        return np.asarray(np.eye(len(own)) - own @ own.T)


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """Return the matrix (n i, n j) of blocks (n, i, j)."""
    n, i, j = blocks.shape
    found = np.zeros((n, i, n, j))
    found[np.arange(n), :, np.arange(n)] = blocks
    return found.reshape(n * i, n * j)


class State(NamedTuple):
    """The restricted likelihood at some variances."""

    log_likelihood: float
    gradient: FloatArray
    information: FloatArray


class Likelihood:
    """The restricted likelihood: of residuals that no parameter can change."""

    def __init__(self, model: LinearModel) -> None:
        n = model.J.shape[1]
        K = np.linalg.qr(model.J, mode="complete")[0][:, n:].T
        self._y = K @ model.y
        self._known = (K * model.known) @ K.T
        parts = [K * part if part.ndim == 1 else K @ part for part in model.Z]
        self._parts, self._covariances = parts, np.stack([part @ part.T for part in parts])
        self._model = model

    def only(self, kept: NDArray[np.intp]) -> Likelihood:
        """Return the likelihood of some of the sources, the first among them."""
        other = copy(self)
        other._parts = [self._parts[k] for k in kept]
        other._covariances = self._covariances[kept]
        return other

    @cached_property
    def _by_columns(self) -> tuple[NDArray[np.bool_], FloatArray, NDArray[np.intp]]:
        """Which sources have few columns, all these columns, and where each source's begin."""
        sizes = np.array([part.shape[1] for part in self._parts])
        few = 2 * sizes < len(self._y)
        chosen = [part for part, is_few in zip(self._parts, few, strict=True) if is_few]
        columns = np.column_stack([np.zeros((len(self._y), 0)), *chosen])
        return few, columns, np.concatenate([[0], np.cumsum(sizes[few])[:-1]]).astype(np.intp)

    def at(self, variances: FloatArray) -> State:
        """Return likelihood, gradient and expected information."""
        K, r = len(variances), len(self._y)
        W = self._known + (variances @ self._covariances.reshape(K, -1)).reshape(r, r)
        L, singular = linalg.lapack.dpotrf(W, lower=1)
        if singular:
            raise np.linalg.LinAlgError("the covariance of the residuals is singular")
        inverse = linalg.lapack.dpotri(L, lower=1)[0]
        inverse = inverse + inverse.T  # the other triangle is zero
        inverse[np.diag_indices(r)] *= 0.5
        weighted = inverse @ self._y
        likelihood = -np.log(np.diagonal(L)).sum() - 0.5 * self._y @ weighted
        few, columns, starts = self._by_columns
        many = ~few
        traces, information = np.empty(K), np.empty((K, K))
        products = inverse @ self._covariances[many]
        flat = products.reshape(len(products), r * r)
        traces[many] = flat[:, :: r + 1].sum(axis=1)
        information[np.ix_(many, many)] = 0.5 * flat @ products.swapaxes(1, 2).reshape(flat.shape).T
        if few.any():
            moved = inverse @ columns
            traces[few] = np.add.reduceat((columns * moved).sum(axis=0), starts)
            both = np.add.reduceat((columns.T @ moved) ** 2, starts, axis=0)
            information[np.ix_(few, few)] = 0.5 * np.add.reduceat(both, starts, axis=1)
            mixed = (columns * (products @ moved)).sum(axis=1).reshape(len(products), -1)
            mixed = 0.5 * np.add.reduceat(mixed, starts, axis=1)
            information[np.ix_(many, few)], information[np.ix_(few, many)] = mixed, mixed.T
        gradient = 0.5 * (weighted @ self._covariances @ weighted - traces)
        rest, count = self._model.outside
        if count:
            variance = self._model.outside_variance(variances)
            if not variance > 0.0:
                raise np.linalg.LinAlgError("the residuals outside the space have no variance")
            likelihood -= 0.5 * (count * np.log(variance) + rest / variance)
            gradient[0] += 0.5 * (rest / variance - count) / variance
            information[0, 0] += 0.5 * count / variance**2
        return State(float(likelihood), gradient, information)


def variance_components(
    model: LinearModel | Likelihood, start: FloatArray, upper: FloatArray | float = np.inf
) -> VarianceComponents:
    """Return the restricted maximum-likelihood variances of the sources.

    Parameters
    ----------
    model : LinearModel or Likelihood
        Residuals and sources, or their likelihood where that is known.
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
    whole = Likelihood(model) if isinstance(model, LinearModel) else model
    bounds = np.broadcast_to(np.asarray(upper, dtype=np.float64), np.shape(start))
    kept = np.flatnonzero((bounds > 0.0) | (np.arange(bounds.size) == 0))
    contrasts, upper = whole.only(kept), bounds[kept]
    s = np.array(start, dtype=np.float64)[kept]
    state = contrasts.at(s)
    for _ in range(_STEPS):
        step = _projected(s, state.gradient, state.information, s >= upper)
        if state.gradient @ step < _SETTLED:
            break
        found = _along(contrasts, state, s, step, upper)
        if found is None:
            break
        rise = found[1].log_likelihood - state.log_likelihood
        s, state = found
        if rise < CLOSE:
            break
    variances, information = np.zeros(bounds.size), np.zeros((bounds.size, bounds.size))
    variances[kept], information[np.ix_(kept, kept)] = s, state.information
    return VarianceComponents(variances, information, state.log_likelihood, bounds)


def _projected(
    s: FloatArray, gradient: FloatArray, information: FloatArray, largest: NDArray[np.bool_]
) -> FloatArray:
    """Return the scoring step of the variances that are not held at zero or at their largest."""
    rising = gradient > 0.0
    active = ((s > 0.0) | rising) & ~(largest & rising)
    step = np.zeros(len(s))
    scaled, size = _scaled(information)
    scaled.flat[:: len(s) + 1] += _ALIKE
    rise = size * gradient
    while active.any():
        part = np.flatnonzero(active)
        step[:] = 0.0
        step[part] = size[part] * linalg.lapack.dgesv(scaled[np.ix_(part, part)], rise[part])[2]
        leaving = active & (((s == 0.0) & (step <= 0.0)) | (largest & (step > 0.0)))
        if not leaving.any():
            break
        active &= ~leaving
    return step


def _scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the information of variances in units of their own size, and these units.

    Variances of runs and of noise may lie many decades apart. Where rounding leaves no information
    on one, its unit is 0.
    """
    own = information.diagonal()
    known = own > TINY
    size = known / np.sqrt(np.where(known, own, 1.0))
    scaled = information * size * size[:, None]
    return np.minimum(np.maximum(scaled, -1.0), 1.0), size


def _along(
    contrasts: Likelihood,
    state: State,
    s: FloatArray,
    step: FloatArray,
    upper: FloatArray,
) -> tuple[FloatArray, State] | None:
    """Return the first point along the step at which the likelihood is higher."""
    for length in _LENGTHS:
        trial = np.minimum(np.maximum(s + length * step, 0.0), upper)
        trial[trial < _LEAST * trial.max(initial=0.0)] = 0.0
        if not trial.any():
            continue
        try:
            other = contrasts.at(trial)
        except np.linalg.LinAlgError:
            continue
        if other.log_likelihood > state.log_likelihood:
            return trial, other
    return None

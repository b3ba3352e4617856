r"""Linear mixed models: variances of several sources of error, and what follows from them.

The residuals are y = J delta + sum_k Z_k u_k + e, with parameters delta, independent numbers u_k of
variance s_k for each source k, and noise e whose variance in each group of rows is the sum of a
known and an estimated part. The variances maximise the restricted likelihood (REML), which follows
from Henderson's equations,

    K = (U' D^-1 U + diag(0, 1/s))^-1,    U = [J Z],    P = D^-1 - D^-1 U K U' D^-1,

with D the variance of e. K is the covariance of the errors of delta by generalised least squares
and of the predicted u. Only the cross-products of U in each group are needed, so the cost does not
grow with the number of rows. With V_k = Z_k Z_k',

    gradient_k = (y'P V_k P y - tr P V_k)/2,    information_kl = tr(P V_k P V_l)/2,

and a scoring step solves information s = gradient + information s_last for s >= 0. Source:
Henderson, Biometrics 31 (1975) 423; Searle, Casella and McCulloch, *Variance Components*, 1992.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
from scipy import linalg, special

from dahl_ident.arrays import TINY, BoolArray, FloatArray, IntArray

_SCORING_STEPS = 40  # at most; the likelihood rises in each, so the last is the best
_STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.02)  # shares of a scoring step, until the likelihood rises
_LIKELIHOOD_SETTLED = 1e-3  # rise of the log-likelihood that no longer matters
_LEAST_NOISE = 1e-6  # of the mean square of the residuals: less is lost in rounding
_UNSEEN = 1e-100  # root of the information on a variance about which nothing is known
_DRAWS = 5000  # of noise alone: a level of 1 % over ten tests is known to within a half
_RATIOS = (0.1, 1e4, 21)  # largest variance of a source over the noise: from, to, number
_RIDGE = 1e-9  # least eigenvalue of correlations: sources with the same effect share a variance


class MixedModel:
    """Residuals y, and the columns of parameters (J) and of sources (Z).

    `group` is the group of each row, and `known` the known variance of each group. The noise of the
    first `groups` groups has an estimated part as well. `most` are the largest variances of the
    sources.
    """

    def __init__(
        self,
        y: FloatArray,
        J: FloatArray,
        Z: Sequence[FloatArray],
        group: IntArray,
        known: FloatArray,
        groups: int,
        most: FloatArray,
    ) -> None:
        self.most = np.concatenate([np.full(groups, np.inf), most])
        self.y, self.U, self.group, self.known = y, np.hstack([J, *Z]), group, known
        self.parameters, self.noises = J.shape[1], groups
        sizes = [z.shape[1] for z in Z]
        self.starts = (self.parameters + np.cumsum([0, *sizes]))[:-1].astype(np.intp)
        self.source = np.repeat(np.arange(len(Z)), sizes)
        self.counts = np.bincount(group, minlength=len(known)).astype(np.float64)
        every = np.column_stack([self.U, y])
        rows = [every[group == g] for g in range(len(known))]
        self.grams = np.array([part.T @ part for part in rows])

    @property
    def count(self) -> int:
        """Number of variances: of G noises, then of K sources."""
        return self.noises + len(self.starts)

    def columns(self, k: int) -> slice:
        """Return the columns of source k in U."""
        ends = [*self.starts.tolist(), self.U.shape[1]]
        return slice(ends[k], ends[k + 1])

    def with_sources(self, kept: Iterable[int]) -> MixedModel:
        """Return the model with some of its sources."""
        return self.with_residuals(self.y, self.U[:, : self.parameters], kept)

    def with_residuals(
        self, y: FloatArray, J: FloatArray, kept: Iterable[int] | None = None, *more: FloatArray
    ) -> MixedModel:
        """Return the model of other residuals and derivatives, with sources `kept` and `more`."""
        chosen = list(range(len(self.starts)) if kept is None else kept)
        Z = [*(self.U[:, self.columns(k)] for k in chosen), *more]
        most = np.append(self.most[self.noises :][chosen], np.full(len(more), np.inf))
        return MixedModel(y, J, Z, self.group, self.known, self.noises, most)

    def at(self, variances: FloatArray) -> MixedState:
        """Return the model at these variances."""
        return MixedState(self, variances)

    def reml(self, chance: FloatArray) -> MixedState:
        """Return the state of the highest restricted likelihood.

        A source with a `chance` below 1 is counted only if noise alone would make it as likely with
        at most that probability.
        """
        G = self.noises
        free = np.where(np.concatenate([np.ones(G), chance]) < 1.0, 0.0, self.most)
        total = max(float(self.y @ self.y) / max(len(self.y) - self.parameters, 1), TINY)
        start = np.zeros(self.count)
        start[:G] = total
        least = np.zeros(self.count)
        least[:G] = _LEAST_NOISE * total
        state = self._highest(start, least, free, np.zeros(self.count))
        doubtful = np.flatnonzero(np.concatenate([np.zeros(G), chance < 1.0]))
        if not len(doubtful):
            return state
        F, sure = state.information, np.flatnonzero(state.variances > 0.0)
        shared = np.linalg.lstsq(F[np.ix_(sure, sure)], F[np.ix_(sure, doubtful)], rcond=1e-12)[0]
        unshared = np.diagonal(F)[doubtful] - np.sum(F[np.ix_(sure, doubtful)] * shared, axis=0)
        penalty = np.zeros(self.count)
        q = state.degrees[doubtful - G]  # the gradient is distributed nearly as chi-square of q
        limit = (special.chdtri(q, chance[doubtful - G]) - q) / np.sqrt(2.0 * q)
        penalty[doubtful] = limit * np.sqrt(np.maximum(unshared, 0.0))
        if (state.gradient[doubtful] <= penalty[doubtful]).all():
            return state  # no doubtful source is significant
        free = self.most.copy()
        penalised = self._highest(state.variances, least, free, penalty)
        free[doubtful] = np.where(penalised.variances[doubtful] > 0.0, free[doubtful], 0.0)
        return self._highest(penalised.variances, least, free, np.zeros(self.count))

    def _highest(
        self, s: FloatArray, least: FloatArray, most: FloatArray, penalty: FloatArray
    ) -> MixedState:
        """Return the state that maximises the log-likelihood less penalty . s, starting at s."""
        state = self.at(s)
        for _ in range(_SCORING_STEPS):
            before = state.log_likelihood - penalty @ s
            target = np.clip(state.scored(penalty, most > least), least, most)
            if (state.gradient - penalty) @ (target - s) < _LIKELIHOOD_SETTLED:
                break
            for length in _STEP_LENGTHS:
                try:
                    trial = self.at(s + length * (target - s))
                except np.linalg.LinAlgError:  # sources are far larger than the noise
                    continue
                rise = trial.log_likelihood - penalty @ trial.variances - before
                if rise > 0.0:
                    break
            else:
                break
            s, state = trial.variances, trial
            if rise < _LIKELIHOOD_SETTLED:
                break
        return state


class MixedState:
    """A mixed model at given variances."""

    def __init__(self, model: MixedModel, variances: FloatArray) -> None:
        self.model, G = model, model.noises
        self.variances = variances
        noise = model.known.copy()
        noise[:G] += self.variances[:G]
        self.weights = 1.0 / noise
        M = np.tensordot(self.weights, model.grams, 1)
        P, c = model.parameters, len(M) - 1
        units = np.ones(c)
        units[:P] = 1.0 / np.sqrt(np.maximum(np.diagonal(M)[:P], TINY))
        units[P:] = np.sqrt(self.variances[G:])[model.source]
        C = units[:, None] * M[:c, :c] * units
        C[range(P, c), range(P, c)] += 1.0
        L, singular = linalg.lapack.dpotrf(C, lower=1)
        if singular or not np.isfinite(C).all():
            raise np.linalg.LinAlgError("a parameter has no effect on the residuals")
        inverse = linalg.lapack.dpotri(L, lower=1)[0]
        inverse = inverse + inverse.T  # the other triangle is zero
        inverse[range(c), range(c)] *= 0.5
        self.K = units[:, None] * inverse * units
        """Covariance of the errors of delta by generalised least squares, and of u, (c, c)."""
        self._left = np.eye(c + 1)
        self._left[:c] -= self.K @ M[:c]
        self._left[:, :P] = 0.0  # exact: P J is zero, and I - K M is K diag(0, 1/s)
        shown = P + np.flatnonzero(units[P:] > 0.0)
        self._left[:c, shown] = self.K[:, shown] / units[shown] ** 2
        self._Q = M @ self._left  # [U y]' P [U y]
        self.log_likelihood = 0.5 * float(
            model.counts @ np.log(self.weights) - self._Q[-1, -1]
        ) - float(np.log(np.diagonal(L)).sum() - np.log(units[:P]).sum())

    @property
    def sizes(self) -> FloatArray:
        """Variances of noises, their known parts included, and of sources."""
        G = self.model.noises
        return np.append(1.0 / self.weights[:G], self.variances[G:])

    @cached_property
    def _by_noise(self) -> list[tuple[FloatArray, FloatArray]]:
        """For each noise, K A and the diagonal of [U y]' P P [U y] over its rows."""
        products = []
        for A in self.model.grams[: self.model.noises]:
            AE = A @ self._left
            products.append((self.K @ A[:-1, :-1], np.sum(self._left * AE, axis=0)))
        return products

    @cached_property
    def gradient(self) -> FloatArray:
        """Derivatives of the log-likelihood."""
        model, w = self.model, self.weights
        noise = [
            w[g] ** 2 * (square[-1] + np.trace(KA)) - w[g] * model.counts[g]
            for g, (KA, square) in enumerate(self._by_noise)
        ]
        part = self._Q[-1, model.parameters : -1] ** 2 - np.diagonal(self._Q)[model.parameters : -1]
        return 0.5 * np.concatenate([noise, self._sums(part)])

    @cached_property
    def information(self) -> FloatArray:
        """Expected information on the variances."""
        model, w, P = self.model, self.weights, self.model.parameters
        G = model.noises
        sums = np.zeros((model.count, model.count))
        sums[G:, G:] = self._sums(self._sums(self._Q[P:-1, P:-1] ** 2).T)
        for g, (KA, square) in enumerate(self._by_noise):
            sums[g, G:] = sums[G:, g] = w[g] ** 2 * self._sums(square[P:-1])
            for h, (KA_h, _) in enumerate(self._by_noise):
                sums[g, h] = (w[g] * w[h]) ** 2 * float(np.sum(KA * KA_h.T))
            sums[g, g] += w[g] ** 2 * model.counts[g] - 2.0 * w[g] ** 3 * float(np.trace(KA))
        return 0.5 * sums

    def chance_of(self, k: int, *, known: bool) -> float:
        """Return the probability that noise alone makes a source as likely as it is here.

        It follows from the ratio of restricted likelihoods, whose distribution has no simple form
        for few rows and is simulated. If the scale is not `known`, rows of a known variance, such
        as priors, say nothing about it: their degrees of freedom are not counted. Source:
        Crainiceanu and Ruppert, J. Royal Statistical Society B 66 (2004) 165.
        """
        columns = self.model.columns(k)
        model = self.model
        rank = float(len(model.y) - model.parameters)
        if not known:
            stated = np.flatnonzero(model.group >= model.noises)
            rank -= float(
                np.sum(np.diagonal(self.block(stated)) / self.weights[model.group[stated]])
            )
        values, vectors = np.linalg.eigh(self._Q[columns, columns])
        kept = np.flatnonzero(values > _RIDGE * values[-1])[-max(int(rank), 1) :]
        if not kept.size:  # the parameters explain all of it
            return 1.0
        values = values[kept]
        seen = (vectors[:, kept].T @ self._Q[-1, columns]) ** 2 / values
        unexplained = max(float(self._Q[-1, -1] - seen.sum()), 0.0)
        rng = np.random.default_rng(0)
        drawn = rng.chisquare(1.0, (_DRAWS, len(kept)))
        others = rng.chisquare(max(rank - len(kept), TINY), _DRAWS)
        squares = np.vstack([seen, drawn])
        other_squares = np.append(unexplained, others)
        best = np.zeros(1 + _DRAWS)
        for ratio in np.geomspace(*_RATIOS) / values[-1]:
            growth = 1.0 + ratio * values
            within = squares @ (1.0 / growth)
            total = squares.sum(axis=1)
            rise = total - within
            if not known:
                after = np.maximum(within + other_squares, TINY)
                rise = rank * np.log((total + other_squares) / after)
            best = np.maximum(best, rise - np.log(growth).sum())
        return float((best[1:] >= best[0]).sum() + 1) / (1 + _DRAWS)

    @property
    def degrees(self) -> FloatArray:
        """Effective number of independent columns of each source, (tr P V)^2/tr P V P V."""
        P, G = self.model.parameters, self.model.noises
        traces = self._sums(np.diagonal(self._Q)[P:-1])
        return np.maximum(
            traces**2 / np.maximum(2.0 * np.diagonal(self.information)[G:], TINY), 1.0
        )

    def _sums(self, columns: FloatArray) -> FloatArray:
        """Return sums over each source's columns, along the first axis."""
        first = self.model.starts - self.model.parameters
        return np.add.reduceat(columns, first, axis=0) if len(first) else columns[:0]

    def scored(self, penalty: FloatArray, free: BoolArray) -> FloatArray:
        """Return the variances >= 0 after a scoring step of the `free` ones."""
        from scipy.optimize import nnls

        F = self.information
        size = np.sqrt(np.maximum(np.diagonal(F), 0.0))
        part = np.flatnonzero(free & (size > TINY))
        if not part.size:  # scipy's nnls aborts the process
            return self.variances
        units, s = 1.0 / size[part], self.variances.copy()
        scaled = units[:, None] * F[np.ix_(part, part)] * units
        values, vectors = np.linalg.eigh(scaled)
        root = np.sqrt(np.maximum(values, _RIDGE))  # rounding may leave some below zero
        R = root[:, None] * vectors.T
        gradient = units * (self.gradient - penalty)[part]
        target = R @ (s[part] / units) + (vectors.T @ gradient) / root
        s[part] = units * nnls(R, target)[0]
        return s

    @cached_property
    def variances_covariance(self) -> FloatArray:
        """Covariance of the variances, zero for those at zero.

        The standard deviation of a source's variance is at most that variance: a positive quantity
        of which only the best estimate is known has an exponential distribution (JCGM 101:2008,
        6.4.10). For a source of one column it is at most sqrt(2) times as large (chi-square with
        one degree of freedom). It is also at most half the bound of the variance (Popoviciu).
        """
        covariance = np.zeros_like(self.information)
        every = np.sqrt(np.maximum(np.diagonal(self.information), 0.0))
        kept = np.flatnonzero((self.variances > 0.0) & (every > _UNSEEN))
        part, size = np.ix_(kept, kept), every[kept]
        units = np.outer(size, size)
        inverse = np.linalg.pinv(self.information[part] / units, hermitian=True) / units
        std = np.sqrt(np.maximum(np.diagonal(inverse), TINY))
        most, G = 0.5 * self.model.most, self.model.noises
        std_alone = self.variances[G:] * np.sqrt(2.0 / np.minimum(self.degrees, 2.0))
        most[G:] = np.minimum(most[G:], std_alone)
        factor = np.minimum(1.0, most[kept] / std)
        covariance[part] = inverse * np.outer(factor, factor)
        return covariance

    @cached_property
    def predicted(self) -> FloatArray:
        """Delta by generalised least squares, and the best linear predictions of u, (c,)."""
        return np.asarray(self.K @ np.tensordot(self.weights, self.model.grams[:, :-1, -1], 1))

    @cached_property
    def weighted(self) -> FloatArray:
        """P y, (m,)."""
        rows = self.weights[self.model.group]
        return np.asarray(rows * (self.model.y - self.model.U @ self.predicted))

    def block(self, rows: IntArray) -> FloatArray:
        """Return the block of P of some rows, (r, r)."""
        w, U = self.weights[self.model.group[rows]], self.model.U[rows]
        return np.asarray(np.diag(w) - (w[:, None] * U) @ self.K @ (U.T * w))

    def block_slopes(self, rows: IntArray) -> FloatArray:
        """Return minus the derivatives of `block` with respect to each variance, (count, r, r)."""
        model, group = self.model, self.model.group[rows]
        w, slopes = self.weights[group], []
        WU = w[:, None] * model.U[rows]
        H = WU @ self.K @ WU.T
        for g, weight in enumerate(self.weights[: model.noises].tolist()):
            same, UK = weight * (group == g), weight * WU @ self.K
            inner = UK @ model.grams[g][:-1, :-1] @ UK.T
            slopes.append(np.diag(same**2) - same[:, None] * H - H * same + inner)
        PU = WU @ self._left[:-1, :-1]
        parts = (PU[:, model.columns(k)] for k in range(len(model.starts)))
        return np.array([*slopes, *(part @ part.T for part in parts)])

    def prediction_variance(self, X: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariance of the errors of X [delta, u], and its derivatives.

        For X (n, r, c): (n, r, r), and the derivatives of its diagonal with respect to each
        variance, (count, n, r).
        """
        model, XK = self.model, X @ self.K
        slopes = np.zeros((model.count, *X.shape[:2]))
        for g in range(model.noises):
            A = model.grams[g][:-1, :-1]
            slopes[g] = self.weights[g] ** 2 * np.sum((XK @ A) * XK, axis=2)
        for k, s in enumerate(self.variances[model.noises :].tolist()):
            if s > 0.0:
                slopes[model.noises + k] = np.sum(XK[..., model.columns(k)] ** 2, 2) / s**2
        return XK @ X.swapaxes(1, 2), slopes

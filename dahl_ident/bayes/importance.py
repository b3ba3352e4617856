r"""Posteriors of up to three parameters by importance points: no chain, and the evidence.

Points are drawn from a mixture q of heavy-tailed distributions that resembles the density p, and
weighted by p/q; the mean of the weights is the evidence (Owen, Monte Carlo theory, methods and
examples, 2013, chapters 9 and 17). The mixture is fitted in rounds. All points so far, weighted by
the mean of the mixtures that they were drawn from (Cornuet et al., Scandinavian Journal of
Statistics 39, 2012), are split again and again where they spread most, and each part becomes one
component, so that curved ridges are followed. One component is the prior: it finds modes apart from
the centre, and bounds the weights where the data leave a parameter open.

The result comes from independent randomizations of one Sobol sequence, with the mixture fixed.
Their scatter is the error: of the evidence, and of the probabilities below the limits of intervals.

Where a density is not far from normal, its residuals are replaced by polynomials, because they are
smooth functions of the parameters: nearly linear, or of second, third or fourth degree over a wider
range. The coefficients follow by least squares from exact residuals at points of a
heavy-tailed distribution around the optimum, weighted by the posterior there. At other points the
density p with exact residuals is compared with q, that with interpolated ones: the error of the
evidence and of every probability is at most Int |p - q| / Int p. Points drawn from the prior find
modes elsewhere; they are not drawn for a density that is by definition around a known centre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import comb
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.polynomial.hermite_e import hermevander
from scipy.special import gammaln, logsumexp, ndtr, stdtrit

from dahl_ident.arrays import FloatArray, IntArray, cholesky_root
from dahl_ident.bayes.density import LogDensity, added
from dahl_ident.bayes.moves import STRAIGHT, Decorrelation
from dahl_ident.bayes.priors import JointPrior

if TYPE_CHECKING:
    from scipy.stats import qmc

Function = Callable[[FloatArray], FloatArray]
Rows = IntArray

# degrees of freedom of the components' Student's t: tails heavier than a posterior's, yet few
# points are wasted there
_DOF = 4.0
_OVERLAP = 1.5  # covariance of a component over that of its points, so that components overlap
_MOST_COMPONENTS = 16  # most components
_FEWEST_POINTS = 40  # effective points of a component, at least
_ROUND = 1024  # points drawn before the mixture is fitted again
_ROUNDS = 12  # most fits; two or three are usual
_GOOD = 0.5  # effective points, over the points of a round, at which the mixture is good enough
# independent randomizations, whose scatter is the error: the fewer, the more even each one's points
_RANDOMIZATIONS = 6
_FIRST_POINTS = 128  # points drawn from each component at first; their number then doubles
_MOST_POINTS = 2**18  # evaluations of a density
_COVERAGE = 2.6  # standard errors in an error: 95 % of Student's t, six repeats' 5 dof
_LIMITS = ndtr(np.linspace(-2.0, 2.0, 9))  # probabilities whose error counts
_BATCH = 256  # points in one call of the density: its arrays stay in the processor's cache
_KNOTS = ndtr(np.linspace(-4.5, 4.5, 46))  # probabilities between which a density is smoothed


@dataclass(frozen=True)
class WeightedDraws:
    """A posterior as draws theta, (N, D), and their probabilities, (N,), which sum to 1."""

    theta: FloatArray
    weights: FloatArray

    @classmethod
    def alike(cls, theta: FloatArray) -> WeightedDraws:
        """Return draws of equal weight."""
        return cls(theta, np.full(len(theta), 1.0 / len(theta)))

    def drawn(self, size: int, seed: int) -> FloatArray:
        """Return a random selection of the draws, (size, D)."""
        shares = None if np.ptp(self.weights) == 0.0 else self.weights
        return np.random.default_rng(seed).choice(self.theta, size=size, p=shares)

    def quantiles(self, axis: int, probabilities: FloatArray) -> FloatArray:
        """Return quantiles of one theta."""
        theta, below = self._distribution[axis]
        return np.interp(probabilities, below, theta)

    def density(self, axis: int, theta: FloatArray) -> FloatArray:
        """Return the density of one theta at given values, smoothed as far as the points allow."""
        from scipy.interpolate import PchipInterpolator

        ends = self._distribution[axis][0][[0, -1]]
        knots = np.array([ends[0], *self.quantiles(axis, _KNOTS), ends[1]])
        solid = np.append(True, np.diff(knots) > 0.0)
        below = np.array([0.0, *_KNOTS, 1.0])[solid]
        slope = PchipInterpolator(knots[solid], below, extrapolate=False).derivative()
        return np.nan_to_num(slope(theta))

    @cached_property
    def _distribution(self) -> list[tuple[FloatArray, FloatArray]]:
        """For every axis: sorted theta, and the probability below; with equal weights as NumPy."""
        if np.ptp(self.weights) == 0.0:
            below = np.linspace(0.0, 1.0, len(self.theta))
            return [(x, below) for x in np.sort(self.theta, axis=0).T]
        orders = np.argsort(self.theta, axis=0).T
        return [
            (x[order], np.cumsum(self.weights[order]) - 0.5 * self.weights[order])
            for x, order in zip(self.theta.T, orders, strict=True)
        ]


@dataclass(frozen=True)
class WeightedPoints(WeightedDraws):
    """Importance points.

    `log_evidence` has the relative error `error`, and so has every probability; `evaluations`
    counts the points at which the density was computed.
    """

    log_evidence: float
    error: float
    evaluations: int


def integrate(
    log_density: Function,
    prior: JointPrior,
    centre: FloatArray,
    covariance: FloatArray,
    decorrelation: Decorrelation = STRAIGHT,
    *,
    tolerance: float = 1e-3,
) -> WeightedPoints:
    """Return a density as weighted points, with its integral."""
    target = _Integrand(log_density, prior, decorrelation)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        mixture = _fitted(target, centre, covariance)
        return _repeated(target, mixture, tolerance)


def in_blocks(function: Function, theta: FloatArray) -> FloatArray:
    """Return the values of a function at points (S, D), computed in blocks, which is faster."""
    return np.concatenate([function(theta[i : i + _BATCH]) for i in range(0, len(theta), _BATCH)])


class _Batch(NamedTuple):
    """Points phi, (S, D), with theta, the log-density, and that of the prior."""

    phi: FloatArray
    theta: FloatArray
    log_density: FloatArray
    log_prior: FloatArray


@dataclass
class _Integrand:
    """The density over phi, in which volumes are those of theta."""

    log_density: Function
    prior: JointPrior
    decorrelation: Decorrelation
    evaluations: int = 0

    def at(self, phi: FloatArray) -> _Batch:
        self.evaluations += len(phi)
        theta = self.decorrelation.original(phi)
        log_density = in_blocks(self.log_density, theta)
        log_density = np.where(np.isnan(log_density), -np.inf, log_density)
        return _Batch(phi, theta, log_density, self.prior.log_density(theta))


@dataclass(frozen=True)
class _Mixture:
    """Components of equal shares: with means (K, D) and roots (K, D, D), and the prior.

    A component's coordinates along the columns of its root are independent Student's t.
    """

    means: FloatArray
    roots: FloatArray

    def sequences(self, seed: int) -> list[qmc.Sobol]:
        """Return a randomized sequence for each component."""
        from scipy.stats import qmc

        count, D = self.means.shape
        return [qmc.Sobol(D, seed=np.random.default_rng([seed, k])) for k in range(count + 1)]

    def draw(self, target: _Integrand, sequences: list[qmc.Sobol], size: int) -> _Batch:
        """Return `size` more points of each component."""
        *uniform, of_prior = (sequence.random(size) for sequence in sequences)
        t = stdtrit(_DOF, np.array(uniform))
        phi = self.means[:, None] + t @ self.roots.swapaxes(1, 2)
        prior = target.decorrelation.decorrelated(target.prior.quantiles(of_prior))
        return target.at(np.concatenate([*phi, prior]))

    def log_density(self, batch: _Batch) -> FloatArray:
        """Return the log-density of the mixture, (S,)."""
        count, D = self.means.shape
        half = 0.5 * (_DOF + 1.0)
        constant = D * (gammaln(half) - gammaln(0.5 * _DOF) - 0.5 * np.log(_DOF * np.pi))
        total = batch.log_prior
        for mean, root in zip(self.means, self.roots, strict=True):
            t = np.linalg.solve(root, (batch.phi - mean).T)
            log_t = constant - half * np.log(np.prod(1.0 + t**2 / _DOF, axis=0))
            total = np.logaddexp(total, log_t - np.linalg.slogdet(root)[1])
        return np.asarray(total - np.log(count + 1))


def _fitted(target: _Integrand, centre: FloatArray, covariance: FloatArray) -> _Mixture:
    """Return a mixture that resembles the density."""
    root = cholesky_root(covariance)
    step = 1e-3 * root.T  # small, so that a straight line in theta is one in phi
    decorrelated = target.decorrelation.decorrelated
    ahead = decorrelated(centre + step)
    behind = decorrelated(centre - step)
    phi = decorrelated(centre[None])
    mixtures = [_Mixture(phi, (ahead - behind).T[None] / 2e-3)]
    seen: _Batch | None = None
    for number in range(_ROUNDS):
        mixture = mixtures[-1]
        size = _ROUND // len(mixture.means)
        new = mixture.draw(target, mixture.sequences(number), size)
        seen = new if seen is None else _Batch(*map(np.concatenate, zip(seen, new, strict=True)))
        drawn = logsumexp([m.log_density(seen) for m in mixtures], axis=0)
        mixtures.append(_split(seen.phi, _normalised(seen.log_density - drawn)))
        weights = _normalised(new.log_density - mixture.log_density(new))
        if number > 1 and _effective(weights) > _GOOD * len(weights):
            break
    return mixtures[-1]


def _split(phi: FloatArray, weights: FloatArray) -> _Mixture:
    """Return components of weighted points, halved along their longest axes."""
    root = _root(phi, weights)
    x = np.linalg.solve(root, phi.T).T.astype(np.float64)  # so that axes can be compared
    parts = [np.flatnonzero(weights)]
    while 2 * len(parts) * _FEWEST_POINTS <= _effective(weights) and len(parts) < _MOST_COMPONENTS:
        parts = [half for part in parts for half in _halves(part, x, weights)]
    means = np.array([np.average(x[part], axis=0, weights=weights[part]) for part in parts])
    roots = [np.sqrt(_OVERLAP) * _root(x[part], weights[part]) for part in parts]
    return _Mixture(means @ root.T, root @ np.array(roots))


def _halves(part: Rows, x: FloatArray, weights: FloatArray) -> tuple[Rows, Rows]:
    """Return the points on both sides of the median along the longest axis."""
    part_weights = weights[part]
    covariance = np.atleast_2d(np.cov(x[part], rowvar=False, aweights=part_weights, ddof=0))
    order = part[np.argsort(x[part] @ np.linalg.eigh(covariance)[1][:, -1])]
    below = np.cumsum(weights[order])
    middle = int(np.clip(np.searchsorted(below, 0.5 * below[-1]), 1, len(part) - 1))
    return order[:middle], order[middle:]


def _root(x: FloatArray, weights: FloatArray) -> FloatArray:
    """Return a root of the covariance of weighted points."""
    covariance = np.atleast_2d(np.cov(x, rowvar=False, aweights=weights, ddof=0))
    std = np.sqrt(np.diagonal(covariance)) + 1e-9
    correlation = covariance / np.outer(std, std)
    return np.asarray(std[:, None] * np.linalg.cholesky(correlation + 1e-9 * np.eye(len(std))))


def _repeated(target: _Integrand, mixture: _Mixture, tolerance: float) -> WeightedPoints:
    """Return points from one mixture, doubled in number until their error is small enough."""
    D = mixture.means.shape[1]
    sequences = [mixture.sequences(_ROUNDS + number) for number in range(_RANDOMIZATIONS)]
    theta, log_weights = np.empty((_RANDOMIZATIONS, 0, D)), np.empty((_RANDOMIZATIONS, 0))
    size = _FIRST_POINTS
    while True:
        new = [mixture.draw(target, sequence, size) for sequence in sequences]
        theta = np.concatenate([theta, [b.theta for b in new]], axis=1)
        latest = [b.log_density - mixture.log_density(b) for b in new]
        log_weights = np.concatenate([log_weights, latest], axis=1)
        weights = _normalised(log_weights)
        points = WeightedPoints(
            theta[weights > 0.0],
            weights[weights > 0.0],
            float(logsumexp(log_weights) - np.log(log_weights.size)),
            _error(theta, weights),
            target.evaluations,
        )
        if points.error <= tolerance or target.evaluations + log_weights.size > _MOST_POINTS:
            return points
        size = theta.shape[1] // len(sequences[0])


def _error(theta: FloatArray, weights: FloatArray) -> float:
    """Return the error of evidence and probabilities from repeats, (R, N, D) and (R, N)."""
    R = len(theta)
    evidence = R * weights.sum(axis=1)
    errors = [evidence.var(ddof=1)]
    pooled = WeightedDraws(theta.reshape(-1, theta.shape[-1]), weights.ravel())
    for axis in range(theta.shape[-1]):
        limits = pooled.quantiles(axis, _LIMITS)
        below = theta[..., axis] < limits[:, None, None]
        shares = R * np.sum(below * weights, axis=-1) - _LIMITS[:, None] * evidence
        errors.append(shares.var(axis=1, ddof=1).mean())
    return _COVERAGE * float(np.sqrt(np.max(errors) / R))


def _normalised(log_weights: FloatArray) -> FloatArray:
    return np.asarray(np.exp(log_weights - logsumexp(log_weights)))


def _effective(weights: FloatArray) -> float:
    """Return the effective number of points."""
    return float(weights.sum() ** 2 / (weights @ weights))


_DEGREES = 2, 3, 4
_POINTS = 8  # fewest exact points for each coefficient; their number doubles with the degree
# degrees of freedom of the Student's t whose points give the coefficients, and the checks, which
# have to see far tails
_TAILS = 4.0, 1.0


@dataclass(frozen=True)
class Interpolation:
    """Sums of squares of interpolated residuals; made by :func:`interpolated`."""

    centre: FloatArray  # (P,) and (P, P): theta = centre + root u
    root: FloatArray
    degree: int  # of the residuals' polynomials
    factor: FloatArray  # (T, T): from the T terms to numbers whose squares are summed
    error: float  # largest error of a probability

    def __call__(self, theta: FloatArray) -> FloatArray:
        """Return sums of squares at theta, (S, P): (S,)."""
        u = np.asarray(np.linalg.solve(self.root, (theta - self.centre).T).T)
        return np.asarray(np.sum((_terms(u, self.degree) @ self.factor.T) ** 2, axis=1))


def interpolated(
    density: LogDensity,
    residuals_of: Function,
    centre: FloatArray,
    covariance: FloatArray,
    tolerance: float,
) -> Interpolation | None:
    """Return interpolated sums of squares; None if probabilities err by more than `tolerance`.

    `residuals_of` computes the exact residuals.
    """
    from scipy.stats import qmc, t

    D = len(centre)
    root = cholesky_root(covariance)
    wide = density.around is None
    for_terms, for_checks, of_prior = (qmc.Sobol(D, seed=seed) for seed in range(3))
    seen: list[list[FloatArray]] = []

    def log_drawn(theta: FloatArray, dof: float) -> FloatArray:
        u = np.linalg.solve(root, (theta - centre).T).T
        return np.asarray(t(dof).logpdf(u).sum(axis=1) - np.linalg.slogdet(root)[1])

    for degree in _DEGREES:
        count = 2 ** int(np.ceil(np.log2(_POINTS * comb(D + degree, degree))))
        count = for_terms.num_generated or count
        near = centre + stdtrit(_TAILS[0], for_terms.random(count)) @ root.T
        far = centre + stdtrit(_TAILS[1], for_checks.random(count)) @ root.T
        if wide:
            far = np.concatenate([far, density.prior.quantiles(of_prior.random(count))])
        near = near[density.log_prior(near) > -np.inf]
        far = far[density.log_prior(far) > -np.inf]
        if not (len(near) and len(far)):
            return None
        exact = in_blocks(lambda x: added(residuals_of(x)), far)
        seen.append([near, in_blocks(residuals_of, near), far, exact])
        theta, rows, far, exact = map(np.concatenate, zip(*seen, strict=True))
        log_p = density.marginal(theta, _constant(added(rows)))
        log_p -= log_drawn(theta, _TAILS[0])
        chosen = np.isfinite(rows).all(axis=1) & (log_p > -np.inf)
        roots = np.exp(0.5 * (log_p[chosen, None] - log_p.max()))
        terms = _terms(np.linalg.solve(root, (theta[chosen] - centre).T).T, degree)
        coefficients = np.linalg.lstsq(roots * terms, roots * rows[chosen], rcond=None)[0]
        factor = np.asarray(np.linalg.qr(coefficients.T, mode="r"))
        result = Interpolation(centre, root, degree, factor, 0.0)
        drawn = log_drawn(far, _TAILS[1])
        if wide:
            drawn = np.logaddexp(drawn, density.prior.log_density(far))
        log_p = density.marginal(far, _constant(exact)) - drawn
        log_q = density.marginal(far, result) - drawn
        with np.errstate(over="ignore", invalid="ignore"):  # where q is far too high
            p, q = np.exp([log_p, log_q] - log_p.max())
            error = float(np.abs(p - q).sum() / p.sum())
        if error <= tolerance:
            return replace(result, error=error)
    return None


def _constant(sums: FloatArray) -> Function:
    """Return a function with these values at any points."""
    return lambda _: sums


def _terms(u: FloatArray, degree: int) -> FloatArray:
    """Return all products of Hermite polynomials up to a degree, (S, P) -> (S, T)."""
    powers = [n for n in product(range(degree + 1), repeat=u.shape[1]) if sum(n) <= degree]
    each = hermevander(u, degree)
    return np.asarray(np.prod([each[:, i, n] for i, n in enumerate(np.transpose(powers))], axis=0))

r"""Residuals by polynomials, where a density is not far from normal.

The residuals are smooth functions of the parameters: nearly linear ones, and in a wider range those
of second, third or higher degree. The coefficients follow by least squares from exact residuals at
points of a heavy-tailed distribution around the optimum, weighted by the posterior there. At other
points the density p with exact residuals is compared with q, that with interpolated ones: no
probability, and not the evidence, errs by more than Int |p - q| / Int p. Points of the prior find
modes elsewhere, unless the density is one around a known centre by definition.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import comb

import numpy as np
from numpy.polynomial.hermite_e import hermevander
from scipy.special import stdtrit

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import LogDensity
from dahl_ident.bayes.importance import Function, in_blocks

_DEGREES = 2, 3, 4
_POINTS = 8  # at least, for each coefficient; their number doubles with the degree
_DOF = 4.0, 1.0  # of Student's t for the coefficients, and for the checks, which see far tails


@dataclass(frozen=True)
class Interpolation:
    """Sums of squares of interpolated residuals; made by :func:`interpolated`.

    Attributes
    ----------
    centre, root : ndarray, shapes (P,) and (P, P)
        theta = centre + root u.
    degree : int
        Of the residuals' polynomials.
    factors : ndarray, shape (M, T, T)
        From the T terms to M sets of numbers, of which the squares are added.
    error : float
        Largest error of a probability.
    """

    centre: FloatArray
    root: FloatArray
    degree: int
    factors: FloatArray
    error: float

    def __call__(self, theta: FloatArray) -> FloatArray:
        """Return sums of squares at theta, (S, P): (S, M)."""
        u = np.asarray(np.linalg.solve(self.root, (theta - self.centre).T).T)
        terms = _terms(u, self.degree)
        return np.stack([np.sum((terms @ one.T) ** 2, axis=1) for one in self.factors], axis=1)


def interpolated(
    density: LogDensity,
    residuals_of: Function,
    centre: FloatArray,
    covariance: FloatArray,
    tolerance: float,
) -> Interpolation | None:
    """Return interpolated sums of squares; None where probabilities would err by more.

    `residuals_of` computes the exact residuals.
    """
    from scipy.stats import qmc, t

    D = len(centre)
    size = np.sqrt(covariance.diagonal())
    root = size[:, None] * np.linalg.cholesky(covariance / np.outer(size, size))
    wide = density.around is None
    for_terms, for_checks, of_prior = (qmc.Sobol(D, seed=seed) for seed in range(3))
    fitted: list[FloatArray] = []
    checked: list[FloatArray] = []
    residuals: list[FloatArray] = []
    exact: list[FloatArray] = []

    def log_drawn(theta: FloatArray, dof: float) -> FloatArray:
        u = np.linalg.solve(root, (theta - centre).T).T
        return np.asarray(t(dof).logpdf(u).sum(axis=1) - np.linalg.slogdet(root)[1])

    for degree in _DEGREES:
        count = 2 ** int(np.ceil(np.log2(_POINTS * comb(D + degree, degree))))
        count = for_terms.num_generated or count
        near = centre + stdtrit(_DOF[0], for_terms.random(count)) @ root.T
        far = centre + stdtrit(_DOF[1], for_checks.random(count)) @ root.T
        if wide:
            far = np.concatenate([far, density.prior.quantiles(of_prior.random(count))])
        near, far = (x[density.log_prior(x) > -np.inf] for x in (near, far))
        if not (len(near) and len(far)):
            return None
        fitted.append(near)
        checked.append(far)
        residuals.append(in_blocks(residuals_of, near))
        exact.append(in_blocks(lambda x: density.added(residuals_of(x)), far))
        theta, rows = np.concatenate(fitted), np.concatenate(residuals)
        log_p = density.marginal(theta, _returning(density.added(rows)))
        log_p -= log_drawn(theta, _DOF[0])
        chosen = np.isfinite(rows).all(axis=1) & (log_p > -np.inf)
        roots = np.exp(0.5 * (log_p[chosen, None] - log_p.max()))
        terms = _terms(np.linalg.solve(root, (theta[chosen] - centre).T).T, degree)
        coefficients = np.linalg.lstsq(roots * terms, roots * rows[chosen], rcond=None)[0]
        factors = [
            np.linalg.qr((coefficients * np.sqrt(counted)).T, mode="r")
            for counted in density.weights.T
        ]
        result = Interpolation(centre, root, degree, np.array(factors), 0.0)
        theta = np.concatenate(checked)
        drawn = log_drawn(theta, _DOF[1])
        if wide:
            drawn = np.logaddexp(drawn, density.prior.log_density(theta))
        log_p = density.marginal(theta, _returning(np.concatenate(exact))) - drawn
        log_q = density.marginal(theta, result) - drawn
        with np.errstate(over="ignore", invalid="ignore"):  # where q is far too high
            p, q = np.exp([log_p, log_q] - log_p.max())
            error = float(np.abs(p - q).sum() / p.sum())
        if error <= tolerance:
            return replace(result, error=error)
    return None


def _returning(sums: FloatArray) -> Function:
    return lambda _: sums


def _terms(u: FloatArray, degree: int) -> FloatArray:
    """Return all products of Hermite polynomials up to a degree, (S, P) -> (S, T)."""
    powers = [n for n in product(range(degree + 1), repeat=u.shape[1]) if sum(n) <= degree]
    each = hermevander(u, degree)
    return np.asarray(np.prod([each[:, i, n] for i, n in enumerate(np.transpose(powers))], axis=0))

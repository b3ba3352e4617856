"""Covariance of an estimate from a record, whose residuals are correlated from sample to sample.

Least squares is unbiased with such residuals, but (J'J)^-1 times their variance is not its
covariance, often ten times too small. The residuals' spectrum is estimated by an autoregressive
model, its order by Akaike's criterion, and their covariance matrix R used in

    covariance = (J'J)^-1 J'R J (J'J)^-1
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft
from scipy.linalg import solve_toeplitz, toeplitz

from dahl_ident.arrays import FloatArray, unit_diagonal
from dahl_ident.problem.record_noise import HIGHEST_ORDER, SAMPLES_PER_ORDER

_SINGULAR = 1e-13  # eigenvalue of J'J, with unit diagonal, that is rounding
_INVOLVED = 1e-6  # squared component of a parameter in undetermined directions that matters
_SLIGHT_CHANGE = 1e-3  # change of autocovariances over the variance that does not matter
_TRANSFORM = 2**15  # samples: enough unless the noise is very slow
_VANISHED = 1e-9  # autocovariance over the variance that is rounding
_CORRECTIONS = 4  # most iterations of the correction, which converges fast


def sandwich(
    jacobians: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    noise: Sequence[FloatArray] | None = None,
) -> tuple[FloatArray, float]:
    """Return the covariance of a least-squares estimate, and the effective number of samples.

    Parameters
    ----------
    jacobians : sequence of ndarray, shape (n_i, P)
        Derivatives of each record's prediction with respect to the P parameters.
    residuals : sequence of ndarray, shape (n_i,)
        Measured minus predicted.
    noise : sequence of ndarray, optional
        Autocovariances of each record's noise, estimated if left out.

    Returns
    -------
    covariance : ndarray, shape (P, P)
        Infinite variances where a parameter has no effect, or none of its own.
    effective : float
        Samples, divided by the mean ratio of a parameter's variance to what it would be if the
        residuals were not correlated; at most all of them.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> J = np.column_stack([np.ones(1000), np.arange(1000.0)])
    >>> covariance, effective = sandwich([J], [rng.standard_normal(1000)])
    >>> bool(500 < effective <= 1000)
    True
    """
    P = jacobians[0].shape[1]
    samples = sum(e.size for e in residuals)
    total = sum(float(e @ e) for e in residuals)
    variance = total / max(samples - P, 1)
    normal = np.asarray(sum(J.T @ J for J in jacobians))
    middle = np.zeros((P, P))
    if noise is None:
        noise = noise_in(jacobians, residuals)
    for J, known in zip(jacobians, noise, strict=True):
        # the states and offsets of other records have zero columns
        columns = np.flatnonzero((J != 0.0).any(axis=0))
        nonzero = J if columns.size == P else J[:, columns]
        middle[np.ix_(columns, columns)] += nonzero.T @ correlated(nonzero, known)
    normal, size = unit_diagonal(normal)
    middle = middle / np.outer(size, size)
    covariance_of_theta = np.diag(np.full(P, np.inf))
    seen = np.flatnonzero(normal.diagonal() > 0.0)
    part = np.ix_(seen, seen)
    values, vectors = np.linalg.eigh(normal[part])
    shown = values > _SINGULAR
    inverse = (vectors[:, shown] / values[shown]) @ vectors[:, shown].T
    white = inverse * variance
    covariance = inverse @ middle[part] @ inverse
    ratio = float(np.mean(covariance.diagonal() / white.diagonal())) if variance > 0.0 else 1.0
    covariance_of_theta[part] = covariance / np.outer(size[seen], size[seen])
    lost = seen[(vectors[:, ~shown] ** 2).sum(axis=1) > _INVOLVED]
    covariance_of_theta[lost], covariance_of_theta[:, lost] = 0.0, 0.0
    covariance_of_theta[lost, lost] = np.inf
    return covariance_of_theta, samples / max(ratio, 1.0)


def inverse_normal(jacobians: Sequence[FloatArray]) -> FloatArray:
    """Return the inverse of the normal matrix J'J of all records, pseudo where it is singular."""
    normal, size = unit_diagonal(np.asarray(sum(J.T @ J for J in jacobians)))
    return np.asarray(np.linalg.pinv(normal, hermitian=True) / np.outer(size, size))


def autoregression(
    residual: FloatArray, jacobian: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Return the coefficients of an autoregressive model and its innovations' variance.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Of mean zero, nearly.
    jacobian : ndarray, shape (n, P), optional
        Of the fit with these residuals. A fit explains a part of the noise, most of slow noise;
        the autocovariances are corrected for that part.

    Returns
    -------
    coefficients : ndarray, shape (order,)
        a_k in e_t = sum a_k e_(t-k) + innovation; the order has the lowest Akaike criterion.
    variance : float
    """
    n = residual.size
    highest = int(min(HIGHEST_ORDER, n // SAMPLES_PER_ORDER))
    spectrum = np.abs(fft.rfft(residual, 2 * n)) ** 2
    observed = fft.irfft(spectrum)[: highest + 1] / n
    model = _chosen(observed, n)
    if jacobian is None or observed[0] <= 0.0:
        return model
    peak = float(np.max(spectrum_of(model, fft.next_fast_len(2 * n, real=True))))
    if 3.0 * jacobian.shape[1] * peak < _SLIGHT_CHANGE * n * observed[0]:  # bound of the part
        return model
    basis = np.linalg.qr(jacobian)[0]
    explained: FloatArray = np.zeros(highest + 1)
    for _ in range(_CORRECTIONS):
        before, explained = explained, _explained_by_fit(basis, model, highest)
        if np.max(np.abs(explained - before)) < _SLIGHT_CHANGE * observed[0]:
            break
        corrected = observed + explained
        if np.linalg.eigvalsh(toeplitz(corrected))[0] <= 0.0:
            break
        model = _chosen(corrected, n)
    return model


def _chosen(covariance: FloatArray, n: int) -> tuple[FloatArray, float]:
    """Return the autoregressive model of the order that Akaike's criterion prefers."""
    best, chosen = np.inf, (np.zeros(0), float(covariance[0]))
    if covariance[0] <= 0.0:
        return chosen
    for order in range(covariance.size):
        following = covariance[1 : order + 1]
        a = solve_toeplitz(covariance[:order], following) if order else np.zeros(0)
        variance = max(float(covariance[0] - a @ following), 1e-300)
        criterion = n * np.log(variance) + 2.0 * order
        if criterion < best:
            best, chosen = criterion, (a, variance)
    return chosen


def _explained_by_fit(
    basis: FloatArray, model: tuple[FloatArray, float], highest: int
) -> FloatArray:
    """Return the fall of the mean autocovariances of such noise by a projection.

    With Q an orthonormal basis of what was fitted, R the noise's covariance matrix and S_k the
    shift by k: (2 tr(Q' R S_k Q) - tr(Q' S_k Q Q' R Q))/n, with the symmetric part of S_k; for all
    shifts at once by Fourier transforms.
    """
    n = basis.shape[0]
    m = fft.next_fast_len(2 * n, real=True)
    waves = fft.rfft(basis, m, axis=0)
    filtered = fft.irfft(waves * spectrum_of(model, m)[:, None], m, axis=0)[:n]
    inner = basis.T @ filtered
    crossed = 2.0 * fft.rfft(filtered, m, axis=0) - waves @ inner
    total = fft.irfft(np.sum((crossed * waves.conj()).real, axis=1), m)
    return np.asarray(total[: highest + 1] / n)


def spectrum_of(model: tuple[FloatArray, float], m: int) -> FloatArray:
    """Return the spectrum of an autoregressive model at the frequencies of m samples."""
    a, variance = model
    return np.asarray(variance / np.abs(fft.rfft(np.concatenate([[1.0], -a]), m)) ** 2)


def autocovariances(residual: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return the significant autocovariances of the noise in residuals of a fit.

    From the autoregressive model; see :func:`autoregression`.
    """
    model = autoregression(residual, jacobian)
    whole = fft.next_fast_len(2 * residual.size, real=True)
    for m in (min(_TRANSFORM, whole), whole):
        covariance = np.asarray(fft.irfft(spectrum_of(model, m), m)[: m // 2])
        matters = np.abs(covariance) > _VANISHED * covariance[0]
        if not matters[m // 4 :].any():
            break
    return covariance[: int(np.flatnonzero(matters).max(initial=0)) + 1][: residual.size]


def noise_in(jacobians: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the autocovariances of the noise in the residuals of each record."""
    pairs = zip(jacobians, residuals, strict=True)
    return [autocovariances(e, J[:, (J != 0.0).any(axis=0)]) for J, e in pairs]


def correlated(waves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return R times waves, (n, k), with the matrix R of these autocovariances."""
    if covariance.size == 1:
        return waves * covariance
    from scipy.signal import oaconvolve  # slow to import, and only for records

    kernel = np.concatenate([covariance[:0:-1], covariance])[:, None]
    full = oaconvolve(waves, kernel, axes=0)
    return np.asarray(full[covariance.size - 1 : covariance.size - 1 + len(waves)])

"""Errors that rows share, from the error model of a fit, for the likelihood of a posterior."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import TINY
from dahl_ident.bayes.row_errors import RowErrors
from dahl_ident.diagnostics.contributions import NOISE, RUNS
from dahl_ident.diagnostics.error_model import ErrorModel

_AS_STATED = 1e-6  # relative rise of the noise's variance up to which it is as stated


def row_errors(errors: ErrorModel) -> RowErrors | None:
    """Return the residuals' covariance from all sources; None if rows are independent."""
    problem, estimate, m = errors.problem, errors.estimate, errors.problem.n_residuals
    as_stated = not estimate.problem.has_misfit and (errors.noises < 1.0 + _AS_STATED).all()
    if not errors.sources and (as_stated or not problem.scale_known):
        return None
    counted = tuple(dict.fromkeys((NOISE, *(s.name for s in errors.sources))))
    # residuals in units of the noise of each single row, or of an unknown scale
    unit, size = (1.0, 1.0) if problem.scale_known else (errors.noises[0], estimate.scale)
    root = np.sqrt(unit * errors.state.weights[errors.state.model.group[:m]])
    jacobian = size * root[:, None] * estimate.columns[:m]
    columns = [
        v**0.5 * root[:, None] * s.columns[:m]
        for v, s in zip(errors.variances.tolist(), errors.sources, strict=True)
    ]
    basis = None  # of the directions in which rows share errors, where these are few
    stacked = np.hstack([jacobian, *columns])
    if m > 2 * stacked.shape[1]:
        basis, _ = np.linalg.qr(stacked)
        columns = [basis.T @ one for one in columns]
    r = m if basis is None else basis.shape[1]
    noise, shared = np.eye(r), np.zeros((r, r))
    for source, part in zip(errors.sources, columns, strict=True):
        target = noise if source.name == NOISE else shared
        target += part @ part.T / unit
    L = np.linalg.cholesky(noise)
    # shared over noise is diagonal in the coordinates W y; see RowErrors
    ratios, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, shared).T))
    W = (np.linalg.solve(L, np.eye(r)).T @ vectors).T
    W = W if basis is None else W @ basis.T
    volume = -float(np.log(np.diagonal(L)).sum())
    of_runs = {s.per_test for s in errors.sources if s.name == RUNS}
    scatters = np.array([name in of_runs for name in errors.names])
    factors = size * root.reshape(-1, 2, 1) * estimate.factors(problem)
    volume += float(np.log(np.abs(np.linalg.det(factors))).sum())
    _, slopes = problem.residuals_and_jacobian(errors.theta, tails=False)
    return RowErrors(
        counted,
        W,
        np.maximum(ratios, 0.0),
        volume,
        factors,
        *_dof_and_share(errors),
        jacobian,
        size * root * estimate.y[:m],
        problem.scale_known,
        np.where(scatters, errors.theta, np.nan),
        np.where(scatters, slopes[:m], 0.0),
        basis,
    )


def _dof_and_share(errors: ErrorModel) -> tuple[float, float]:
    """Return effective degrees of freedom, and the fraction of variance due to shared errors.

    Both are those of the parameter for which that fraction is largest.
    """
    names = {s.name for s in errors.sources if s.name != NOISE}
    shared = sum((np.diagonal(errors.contributions[n]) for n in names), np.zeros(len(errors.names)))
    shares = shared / np.maximum(np.diagonal(errors.covariance), TINY)
    shares[[errors.names.index(name) for name in errors.assumed]] = 0.0
    largest = int(np.argmax(shares))
    return errors.dof(np.eye(len(shares))[largest]), float(shares[largest])

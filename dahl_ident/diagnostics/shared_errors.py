"""Errors that rows share, from the error model of a fit, for a posterior's likelihood."""

from __future__ import annotations

import numpy as np

from dahl_ident.bayes.row_errors import RowErrors
from dahl_ident.diagnostics.contributions import NOISE, RUNS
from dahl_ident.diagnostics.error_model import ErrorModel

_SAME = 1e-6  # of the noise's variance: as stated


def row_errors(errors: ErrorModel) -> RowErrors | None:
    """Return the covariance of the residuals by all sources; None where they are independent."""
    problem, estimate, m = errors.problem, errors.estimate, errors.problem.n_residuals
    as_stated = not estimate.problem.has_misfit and (errors.noises < 1.0 + _SAME).all()
    if not errors.sources and (as_stated or not problem.scale_known):
        return None
    counted = tuple(dict.fromkeys((NOISE, *(s.name for s in errors.sources))))
    # residuals in units of the noise of each single row, or of an unknown scale
    known = problem.scale_known
    unit, size = (1.0, 1.0) if known else (errors.noises[0], estimate.scale)
    root = np.sqrt(unit * errors.state.weights[errors.state.model.group[:m]])
    jacobian = size * root[:, None] * estimate.columns[:m]
    columns = [
        v**0.5 * root[:, None] * s.columns[:m]
        for v, s in zip(errors.variances.tolist(), errors.sources, strict=True)
    ]
    inside = None
    every = np.hstack([jacobian, *columns])
    if m > 2 * every.shape[1]:
        inside, _ = np.linalg.qr(every)
        columns = [inside.T @ one for one in columns]
    r = m if inside is None else inside.shape[1]
    noise, shared = np.eye(r), np.zeros((r, r))
    for source, part in zip(errors.sources, columns, strict=True):
        target = noise if source.name == NOISE else shared
        target += part @ part.T / unit
    L = np.linalg.cholesky(noise)
    half = np.linalg.solve(L, shared)
    ratios, vectors = np.linalg.eigh(np.linalg.solve(L, half.T))
    turn = np.linalg.solve(L, np.eye(r)).T @ vectors
    turn = turn.T if inside is None else turn.T @ inside.T
    volume = -float(np.log(np.diagonal(L)).sum())
    differing = {s.per_test for s in errors.sources if s.name == RUNS}
    scatters = np.array([name in differing for name in errors.names])
    factors = size * root.reshape(-1, 2, 1) * estimate.factors(problem)
    volume += float(np.log(np.abs(np.linalg.det(factors))).sum())
    _, slopes = problem.residuals_and_jacobian(errors.theta, tails=False)
    return RowErrors(
        counted, turn, np.maximum(ratios, 0.0), volume, factors, *_dof_and_share(errors), jacobian,
        size * root * estimate.y[:m], known, np.where(scatters, errors.theta, np.nan),
        np.where(scatters, slopes[:m], 0.0), inside,
    )  # fmt: skip


def _dof_and_share(errors: ErrorModel) -> tuple[float, float]:
    """Return effective degrees of freedom, and the share of what rows share in the variance.

    Both are those of the parameter in which that share is the largest.
    """
    names = {s.name for s in errors.sources if s.name != NOISE}
    part = sum((np.diagonal(errors.contributions[n]) for n in names), np.zeros(len(errors.names)))
    shares = part / np.maximum(np.diagonal(errors.covariance), np.finfo(float).tiny)
    shares[[errors.names.index(name) for name in errors.assumed]] = 0.0
    most = int(np.argmax(shares))
    return errors.dof(np.eye(len(shares))[most]), float(shares[most])

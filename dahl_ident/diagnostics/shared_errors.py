"""What rows share of their errors, from the error model of a fit, for a posterior's likelihood."""

from __future__ import annotations

import numpy as np

from dahl_ident.bayes.row_errors import RowErrors
from dahl_ident.diagnostics.error_model import ErrorModel, row_weights
from dahl_ident.diagnostics.error_sources import NOISE, RUNS

_LEAST_NOISE = 1e-8  # of the mean variance: what is shared may explain all that residuals show


def row_errors(errors: ErrorModel) -> RowErrors | None:
    """Return the covariance of the residuals by all sources; None where they are independent.

    Parameters
    ----------
    errors : ErrorModel
        Its assumed parameters are free in the posterior, so they are not a source here.

    Returns
    -------
    RowErrors or None
        None where noise of one scale is the only source.
    """
    problem, linear = errors.problem, errors.linear
    counted = tuple(dict.fromkeys((NOISE, *(s.name for s in errors.sources))))
    sizes = errors.variances.tolist()
    given = [k for k, variance in enumerate(sizes) if variance > 0.0]
    plain = all(errors.sources[k].columns.ndim == 1 for k in given)
    alike = plain and len(given) == 1 and np.ptp(errors.sources[given[0]].columns) == 0.0
    if alike != problem.scale_known and len(given) == int(alike):
        return None
    m, rotation = problem.n_residuals, linear.rotation
    r = m if rotation is None else rotation.shape[1]
    noise, shared = np.diag(linear.known[:r]), np.zeros((r, r))
    for k in given:
        part = linear.Z[k][:r]
        own = np.diag(part**2) if part.ndim == 1 else part @ part.T
        target = noise if errors.sources[k].name == NOISE else shared
        target += sizes[k] * own
    whole = float(np.diagonal(noise + shared).mean())
    noise[np.diag_indices(r)] += _LEAST_NOISE * whole
    unit = 1.0 if problem.scale_known else float(np.diagonal(noise).mean())
    L = np.linalg.cholesky(noise / unit)
    half = np.linalg.solve(L, shared / unit)
    ratios, vectors = np.linalg.eigh(np.linalg.solve(L, half.T))
    turn = np.linalg.solve(L, np.eye(r)).T @ vectors
    turn = turn.T if rotation is None else turn.T @ rotation.T
    outside = linear.outside_variance(errors.variances) / unit if linear.outside[1] else 1.0
    volume = -float(np.log(np.diagonal(L)).sum()) - 0.5 * linear.outside[1] * np.log(outside)
    weight = row_weights(problem)
    differing = {errors.sources[k].own for k in given if errors.sources[k].name == RUNS}
    scatters = np.array([name in differing for name in errors.names])
    plain_y, _ = problem.residuals_and_jacobian(errors.theta, tails=False)
    jacobian = errors.jacobian[:m]
    return RowErrors(
        counted,
        turn,
        np.maximum(ratios, 0.0),
        volume,
        weight * (errors.near.y - plain_y[:m]),
        weight,
        *_dof_and_share(errors),
        jacobian if errors.basis is None else jacobian @ errors.basis.matrix,
        weight * errors.near.y,
        problem.scale_known,
        np.where(scatters, errors.theta, np.nan),
        np.where(scatters, errors.near.J, 0.0),
        rotation if linear.outside[1] else None,
        outside,
    )


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

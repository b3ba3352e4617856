r"""Error of a prediction of a measurement: parameters, model error, scatter, noise.

At an operating point where the model's relative slopes by the parameters are j, ln gain and phase
of the device are j delta + sum_k C_k u_k in addition to the model's, u_k the sources of
:mod:`dahl_ident.diagnostics.error_model` and C_k what they do at that point. Their best linear
prediction from the residuals y is lambda' y,

    lambda' = c' P - j G,    c' = sum_k s_k C_k Z_k',

and misses by sum_k (lambda' Z_k - C_k) u_k: the model error goes on smoothly from the measured
points, another test has a scatter and a noise of its own. The prediction lambda' y is how far the
device is expected to depart from the model there. Source: universal kriging, see
Rasmussen and Williams, *Gaussian Processes*, 2006, section 2.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.error_model import ErrorModel, relative_units, row_weights
from dahl_ident.diagnostics.error_sources import APART, NOISE, TESTS, Source, places
from dahl_ident.problem import Problem

_LEAST_DOF = 1.0  # with fewer, quantiles of Student's t are beyond all use


class PredictionError(NamedTuple):
    """Of ln gain and phase at n points: departure, (n, 2), covariance, (n, 2, 2), dof, (n,)."""

    departure: FloatArray
    covariance: FloatArray
    dof: FloatArray


def prediction_error(
    errors: ErrorModel,
    slopes: ComplexArray,
    amplitude: FloatArray,
    omega: FloatArray,
    stiffness: ComplexArray | None,
    *,
    of_a_test: bool,
) -> PredictionError:
    """Return the error of a predicted fundamental.

    Parameters
    ----------
    errors : ErrorModel
        Of the fit.
    slopes : ndarray of complex, shape (n, Q)
        Derivatives of the logarithm of what is predicted by theta.
    amplitude, omega : ndarray, shape (n,)
        Where.
    stiffness : ndarray of complex, shape (n,) or None
        Dynamic stiffness there; None leaves out forces in parallel with the model.
    of_a_test : bool
        With the scatter and noise of one more test; else of the device itself.

    Returns
    -------
    PredictionError
    """
    n = len(slopes)
    where = places(amplitude, omega)
    here: list[FloatArray | None] = []
    c = np.zeros((n, 2, len(errors.linear.y)))
    for source, part, variance in zip(
        errors.sources, errors.linear.Z, errors.variances.tolist(), strict=True
    ):
        changes = changes_there(source, errors.names, slopes, where, stiffness)
        here.append(changes)
        if changes is not None:
            c += variance * changes @ part.T
    lever = c @ errors.projection.P - _parts(slopes) @ errors.generalised  # (n, 2, m)
    covariance = (lever * errors.linear.known) @ lever.swapaxes(1, 2)
    squares = np.zeros((len(errors.sources), n))
    for k, (source, part, changed) in enumerate(
        zip(errors.sources, errors.linear.Z, here, strict=True)
    ):
        moved = lever * part if part.ndim == 1 else lever @ part
        if changed is not None:
            moved = moved - changed
        own = moved @ moved.swapaxes(1, 2)
        if of_a_test and source.own:
            own = own + _own(source, errors, slopes)
        squares[k] = np.trace(own, axis1=1, axis2=2)
        covariance += errors.variances[k] * own
    if TESTS in errors.contributions:
        parts = _parts(slopes)
        covariance += parts @ errors.contributions[TESTS] @ parts.swapaxes(1, 2)
    total = np.trace(covariance, axis1=1, axis2=2)
    if of_a_test:
        near = _nearest(errors.problem, amplitude, omega)
        first = errors.problem.data.harmonic == 1
        for k, source in enumerate(errors.sources):
            if source.name in (NOISE, APART):
                own = _noise(errors, source)
                # a gross error may befall any test, once in as many as there are fundamentals
                own = own[near] if source.name == NOISE else own[first].mean(axis=0)[None]
                squares[k] += np.trace(own, axis1=1, axis2=2)
                covariance += errors.variances[k] * own
        if errors.problem.scale_known:
            covariance += noise_near(errors.problem, errors.theta, amplitude, omega)
        total = np.trace(covariance, axis1=1, axis2=2)
    spread = np.einsum("kn,kl,ln->n", squares, errors.components.covariance, squares)
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = np.where(spread > 0.0, 2.0 * total**2 / spread, np.inf)
    if errors.basis is not None:
        covariance[~errors.basis.holds(_parts(slopes)).all(axis=1)] = np.inf
    return PredictionError(lever @ errors.linear.y, covariance, np.maximum(dof, _LEAST_DOF))


def changes_there(
    source: Source,
    names: Sequence[str],
    slopes: ComplexArray,
    where: FloatArray,
    stiffness: ComplexArray | None,
) -> FloatArray | None:
    """Return ln gain and phase that a source makes at other places, (n, 2, q), if it does."""
    shapes, n = source.shapes, len(slopes)
    if source.rate_of is not None:
        name, centre = source.rate_of
        away = (where.sum(axis=1) - centre)[:, None, None]
        return np.asarray(_parts(slopes[:, [names.index(name)]]) * away)
    if shapes is None or (shapes.parallel and stiffness is None):
        return None
    ratio = np.ones(n, dtype=np.complex128) if stiffness is None else stiffness
    changes = _parts(shapes.changes(where, ratio).T)
    return changes if source.absorbed is None else changes - _parts(slopes) @ source.absorbed


def _parts(relative: ComplexArray) -> FloatArray:
    """Return ln gain and phase of relative changes (n, q), shape (n, 2, q)."""
    return np.stack([relative.real, relative.imag], axis=1)


def _own(source: Source, errors: ErrorModel, slopes: ComplexArray) -> FloatArray:
    """Return the covariance that a test's own draw of a scatter has at unit variance."""
    if source.own in errors.names:
        part = _parts(slopes[:, [errors.names.index(source.own)]])
        return np.asarray(part @ part.swapaxes(1, 2))
    return np.diag([float(source.own != "phase"), float(source.own != "gain")])


def _noise(errors: ErrorModel, source: Source) -> FloatArray:
    """Return the covariance of ln gain and phase of each row by a noise of unit variance."""
    n, units = errors.problem.n_residuals // 2, errors.relative_units()
    if source.columns.ndim == 1:
        columns = source.columns / row_weights(errors.problem)  # of weighted residuals
        units = units * columns.reshape(n, 1, 2)
    else:
        units = units @ source.columns.reshape(n, 2, -1)
    return np.asarray(units @ units.swapaxes(1, 2))


def noise_near(
    problem: Problem, theta: FloatArray, amplitude: FloatArray, omega: FloatArray
) -> FloatArray:
    """Return the covariance of ln gain and phase that residuals of unit variance are, (n, 2, 2).

    That of the row which was measured nearest to each point.
    """
    units = relative_units(problem, theta) / row_weights(problem)[::2, None, None]
    units = units[_nearest(problem, amplitude, omega)]
    return np.asarray(units @ units.swapaxes(1, 2))


def _nearest(problem: Problem, amplitude: FloatArray, omega: FloatArray) -> NDArray[np.intp]:
    """Return the fundamental's row nearest to each point, in ln A and ln omega."""
    view = problem.stiffness_data
    rows = np.flatnonzero(view.harmonic == 1)
    there = places(view.amplitude, view.omega)[rows]
    apart = np.sum((places(amplitude, omega)[:, None] - there) ** 2, axis=-1)
    return np.asarray(rows[np.argmin(apart, axis=1)])

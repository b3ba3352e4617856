r"""The model error of a fit as further parameters of measurements to come.

The model error of :mod:`dahl_ident.diagnostics.error_model` is a Gaussian process, C u with
independent u of unit variance. Rows j delta + C u + e at any places, earlier and later ones, then
are those of a linear model with the parameters delta and u, of which u has a prior: information
adds up row by row although the errors are correlated, and the inverse of the sum holds the
covariance of delta by generalised least squares, and that of the device's response.
Source: Searle, Casella and McCulloch, *Variance Components*, 1992, section 7.6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.diagnostics.error_model import ErrorModel, linear_model
from dahl_ident.diagnostics.error_sources import (
    MODEL_ERROR,
    NOISE,
    RUNS,
    Source,
    StructuredSources,
    places,
    unit_noise,
)
from dahl_ident.diagnostics.prediction_error import changes_there

_NEGLIGIBLE = 0.1  # variance of the shapes left out over that of a row's noise


class Departures(NamedTuple):
    """Model error at places to come, and what earlier data say of it.

    Attributes
    ----------
    columns : ndarray, shape (K, 2, W)
        Changes of ln gain and phase at each place, at unit variance.
    information : ndarray, shape (Q + W, Q + W)
        Of theta and of the departures: earlier data, their priors, and the unit variances.
    assumed : bool
        Whether its variance is assumed, because residuals are too few to tell it from noise.
    """

    columns: FloatArray
    information: FloatArray
    assumed: bool


def departures(
    errors: ErrorModel,
    slopes: ComplexArray,
    amplitude: FloatArray,
    omega: FloatArray,
    stiffness: ComplexArray,
) -> Departures | None:
    """Return the model error of a fit at other places; None where it has none.

    Where residuals are too few to tell it from noise, it is taken to be as large as the noise.

    Parameters
    ----------
    errors : ErrorModel
        Of the fit.
    slopes : ndarray of complex, shape (K, Q)
        Derivatives of ln R by theta at the places.
    amplitude, omega : ndarray, shape (K,)
        The places.
    stiffness : ndarray of complex, shape (K,)
        Dynamic stiffness there.

    Returns
    -------
    Departures or None
    """
    problem, m = errors.problem, errors.problem.n_residuals
    found = {
        _kind(source): variance
        for source, variance in zip(errors.sources, errors.variances.tolist(), strict=True)
        if source.name == MODEL_ERROR
    }
    assumed = not errors.distinguishes_noise
    if assumed:
        found = {_SMOOTH: noise_of_rows(errors) ** 2}
    if not any(found.values()):
        return None
    where = places(amplitude, omega)
    every_source = StructuredSources(problem, errors.theta, where)
    sources = [
        source
        for source in every_source.at(errors.theta, errors.near)
        if source.name == MODEL_ERROR and found.get(_kind(source))
    ]
    size = [np.sqrt(found[_kind(source)]) for source in sources]
    here = [changes_there(s, errors.names, slopes, where, stiffness) for s in sources]
    there = np.concatenate(
        [c * s for c, s in zip(here, size, strict=True) if c is not None], axis=-1
    )
    missed = np.concatenate([s.columns * v for s, v in zip(sources, size, strict=True)], axis=-1)
    rows = errors.relative_units() @ missed.reshape(m // 2, 2, -1)
    every = np.concatenate([rows, there]).reshape(-1, there.shape[-1])
    _, singular, turned = np.linalg.svd(every, full_matrices=False)
    noise = noise_of_rows(errors) ** 2 + problem.scale_known * unit_noise(problem)
    left = np.cumsum(singular[::-1] ** 2)[::-1] / len(every)
    turned = turned[left > _NEGLIGIBLE * noise].T
    return Departures(there @ turned, _information(errors, missed @ turned), assumed)


_SMOOTH = (False, "")


def _kind(source: Source) -> tuple[bool, str]:
    parallel = source.shapes is not None and source.shapes.parallel
    return parallel, "" if source.rate_of is None else source.rate_of[0]


def _information(errors: ErrorModel, columns: FloatArray) -> FloatArray:
    """Return the information of the earlier data on theta and departures of unit variance."""
    rest = [k for k, source in enumerate(errors.sources) if source.name != MODEL_ERROR]
    sources = (*(errors.sources[k] for k in rest), Source(MODEL_ERROR, columns, 0.0))
    J = errors.jacobian
    linear, _ = linear_model(errors.problem, np.zeros(len(J)), J, sources)
    V = linear.covariance(np.append(errors.variances[rest], 0.0))
    X = np.hstack([-linear.J, linear.Z[-1]])  # residuals fall where a prediction rises
    Q, W = J.shape[1], columns.shape[1]
    return np.asarray(X.T @ np.linalg.solve(V, X) + np.diag(np.repeat([0.0, 1.0], [Q, W])))


def noise_of_rows(errors: ErrorModel) -> float:
    """Return the noise of an earlier row beyond a stated one: ln gain and phase, rms."""
    return _rms(errors, [s.name == NOISE for s in errors.sources])


def scatter_of_runs(errors: ErrorModel) -> float:
    """Return the scatter of ln gain and phase between runs, rms."""
    return _rms(errors, [s.name == RUNS and s.own in ("gain", "phase") for s in errors.sources])


def _rms(errors: ErrorModel, counted: list[bool]) -> float:
    squares = np.array([source.mean_square for source in errors.sources])
    return float(np.sqrt(errors.variances[counted] @ squares[counted]))

r"""Error of a prediction of a measurement: parameters, model error, scatter, noise.

At an operating point points the model's relative slopes with respect to the parameters are j, ln
gain and phase of the device exceed those of the model by -j delta + sum_k C_k u_k, with delta and
u_k as in :mod:`dahl_ident.diagnostics.mixed_model` and C_k the effect of a source at that point.
Their best linear prediction is the expected departure of the device from the model there. With
x = [-j, C_1, ...] its error has the covariance x K x'. A new test adds its scatter and its noise.
Source: universal kriging, see Rasmussen and Williams, *Gaussian Processes*, 2006, section 2.7.

Earlier data also determine the model error of later ones: for planned measurements, the u of C u,
independent and of unit variance, are additional parameters, and K^-1 is the information of the
earlier data on all parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray, IntArray
from dahl_ident.diagnostics.contributions import MODEL_ERROR, NOISE, TESTS, satterthwaite
from dahl_ident.diagnostics.error_model import ErrorModel, no_narrower
from dahl_ident.diagnostics.error_sources import error_sources, log_points, parts
from dahl_ident.diagnostics.estimate import relative_units
from dahl_ident.problem import TableProblem

_NEGLIGIBLE_SHAPES = 0.1  # variance of neglected shapes over that of a row's noise


class PredictionError(NamedTuple):
    """Departure, (n, 2), its covariance, (n, 2, 2), and dof, (n, 2), of ln gain and phase."""

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
    """Return the error of a predicted fundamental."""
    state, names = errors.state, errors.names
    model, basis = state.model, errors.estimate.basis
    points = log_points(amplitude, omega)
    by_theta = parts(slopes)
    X = np.zeros((len(slopes), 2, model.U.shape[1]))
    X[..., : model.parameters] = -by_theta @ basis.matrix
    for k, source in enumerate(errors.sources):
        changes = source.changes(names, slopes, points, stiffness)
        if changes is not None:
            X[..., model.columns(k)] = changes
    covariance, by_variance = state.prediction_variance(X)
    if TESTS in errors.contributions:
        covariance = covariance + by_theta @ errors.contributions[TESTS] @ by_theta.swapaxes(1, 2)
    if of_a_test:
        near = _nearest(errors.problem, amplitude, omega)
        units = errors.estimate.relative_units[near]
        scatter = [units, *[None] * (model.noises - 1)]
        scatter += [source.drawn(names, slopes, near, units) for source in errors.sources]
        for k, columns in enumerate(scatter):
            if columns is not None:
                square = np.broadcast_to(columns @ columns.swapaxes(-1, -2), covariance.shape)
                covariance = covariance + state.sizes[k] * square
                by_variance[k] += _diagonal(square)
    total = _diagonal(covariance)
    spread = np.einsum("kni,kl,lni->ni", by_variance, state.variances_covariance, by_variance)
    dof = satterthwaite(total, spread)
    if errors.by_runs is not None:  # a new run scatters about the mean of the runs
        mean = _diagonal(by_theta @ errors.by_runs.covariance @ by_theta.swapaxes(1, 2))
        runs = errors.by_runs.runs
        dof = no_narrower(dof, total, (1 + runs * of_a_test) * mean, runs)
    covariance[~basis.holds(by_theta).all(axis=1)] = np.inf
    return PredictionError(X @ state.predicted, covariance, dof)


def _diagonal(covariance: FloatArray) -> FloatArray:
    return np.diagonal(covariance, axis1=1, axis2=2)


def stated_noise(
    problem: TableProblem, theta: FloatArray, amplitude: FloatArray, omega: FloatArray
) -> FloatArray:
    """Return the covariance of ln gain and phase of residuals of unit variance, (n, 2, 2).

    At each point it is that of the nearest measured row.
    """
    problem = problem.widened(np.zeros(problem.data.n))
    units = relative_units(problem, theta, problem.predict(theta))
    units = units[_nearest(problem, amplitude, omega)]
    return np.asarray(units @ units.swapaxes(1, 2))


def _nearest(problem: TableProblem, amplitude: FloatArray, omega: FloatArray) -> IntArray:
    """Return the fundamental's row nearest to each point, in ln A and ln omega."""
    view = problem.stiffness_data
    rows = np.flatnonzero(view.harmonic == 1)
    measured = log_points(view.amplitude, view.omega)[rows]
    distance = np.sum((log_points(amplitude, omega)[:, None] - measured) ** 2, axis=-1)
    return np.asarray(rows[np.argmin(distance, axis=1)])


class Departures(NamedTuple):
    """Model error at future operating points, and the information of earlier data on it."""

    columns: FloatArray  # (K, 2, W): changes of ln gain and phase at each point, at unit variance
    # (Q + W, Q + W): on theta and the departures, by earlier data, priors and unit variances
    information: FloatArray
    # whether its variance is assumed, because too few residuals distinguish it from noise
    assumed: bool


def departures(
    errors: ErrorModel,
    slopes: ComplexArray,
    amplitude: FloatArray,
    omega: FloatArray,
    stiffness: ComplexArray,
) -> Departures | None:
    """Return the model error of a fit at other points; None without any.

    If there are too few residuals to distinguish it from noise, it is assumed equal to the noise.
    """
    variances = zip(errors.sources, errors.variances.tolist(), strict=True)
    sized = {source.kind: size for source, size in variances if source.name == MODEL_ERROR}
    assumed = not errors.distinguishes_noise
    if assumed:
        sized = {(False, ""): errors.rms(NOISE) ** 2}
    if not any(sized.values()):
        return None
    points, estimate = log_points(amplitude, omega), errors.estimate
    sources = [s for s in error_sources(estimate, points) if s.name == MODEL_ERROR]
    pairs = [(source, sized.get(source.kind, 0.0) ** 0.5) for source in sources]
    pairs = [(source, std) for source, std in pairs if std]
    changes = [(s.changes(errors.names, slopes, points, stiffness), std) for s, std in pairs]
    at_points = np.concatenate([std * c for c, std in changes if c is not None], axis=-1)
    columns = np.concatenate([std * source.columns for source, std in pairs], axis=-1)
    n = errors.problem.n_residuals // 2
    at_rows = estimate.relative_units @ columns[: 2 * n].reshape(n, 2, -1)
    every = np.concatenate([at_rows, at_points]).reshape(-1, at_points.shape[-1])
    _, singular, directions = np.linalg.svd(every, full_matrices=False)
    noise = float(errors.noises[0]) * errors.noise_square
    remaining = np.cumsum(singular[::-1] ** 2)[::-1] / len(every)
    directions = directions[remaining > _NEGLIGIBLE_SHAPES * noise].T
    others = [k for k, source in enumerate(errors.sources) if source.name != MODEL_ERROR]
    state, noises = errors.state, errors.state.model.noises
    # residuals fall as a prediction rises
    joint = state.model.elsewhere(estimate.y, -estimate.jacobian, others, columns @ directions)
    sizes = [*state.variances[[*range(noises), *(noises + k for k in others)]], 1.0]
    K, Q, W = joint.at(np.array(sizes)).K, len(errors.names), directions.shape[1]
    kept = [*range(Q), *range(len(K) - W, len(K))]
    return Departures(at_points @ directions, np.linalg.inv(K[np.ix_(kept, kept)]), assumed)

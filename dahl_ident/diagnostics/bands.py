r"""Bands of a predicted response, and quantities derived from the estimate.

First order: with d = dR/dtheta at the estimate and C its covariance, Re R and Im R have the
covariance Re(d) C Re(d)', Re(d) C Im(d)', Im(d) C Im(d)', and d(ln R) = dR/R gives ln gain and
phase together. Real and imaginary part are always treated together. Where the sources of error are
known (:mod:`dahl_ident.diagnostics.error_model`) all of them are included, around the estimate that
accounts for them; else noise alone.

At an operating point where the model's relative slopes with respect to the parameters are j, ln
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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    SMALLEST,
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    positive_array,
)
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.confidence_levels import checked_levels
from dahl_ident.diagnostics.contributions import MODEL_ERROR, NOISE, TESTS, satterthwaite
from dahl_ident.diagnostics.error_model import ErrorModel, no_narrower
from dahl_ident.diagnostics.error_sources import error_sources, log_points, parts
from dahl_ident.diagnostics.estimate import relative_units
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.held_out import band_factor
from dahl_ident.diagnostics.information import Information, values_at
from dahl_ident.elements import Model
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem, TableProblem
from dahl_ident.units import shown_unit

_NEGLIGIBLE_SHAPES = 0.1  # variance of neglected shapes over that of a row's noise
ENERGY = "energy lost in a cycle"  # name of a derived quantity
_STEP = 1e-5  # relative step of a finite difference
_RESONANT = 1e-12  # relative tolerance of a natural frequency
_PASSES = 50  # most iterations; one suffices unless the stiffness depends on the frequency


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
        mean = _diagonal(by_theta @ errors.by_runs @ by_theta.swapaxes(1, 2))
        runs = len(errors.problem.data.runs)
        dof = no_narrower(dof, total, (1 + runs * of_a_test) * mean, runs)
    covariance[~basis.holds(by_theta).all(axis=1)] = np.inf
    return PredictionError(X @ state.predicted, covariance, dof)


def _diagonal(covariance: FloatArray) -> FloatArray:
    return np.diagonal(covariance, axis1=1, axis2=2)


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
    joint = state.model.with_residuals(estimate.y, -estimate.jacobian, others, columns @ directions)
    sizes = [*state.variances[[*range(noises), *(noises + k for k in others)]], 1.0]
    K, Q, W = joint.at(np.array(sizes)).K, len(errors.names), directions.shape[1]
    kept = [*range(Q), *range(len(K) - W, len(K))]
    return Departures(at_points @ directions, np.linalg.inv(K[np.ix_(kept, kept)]), assumed)


@dataclass(frozen=True)
class ResponseBand:
    """A predicted response with its standard deviations and bands, at n points."""

    response: ComplexArray  # at the estimate
    # middle of the bands: the response and the departure of the device from the model that the
    # residuals predict
    centre: ComplexArray
    real_std: FloatArray  # in the response's unit
    imag_std: FloatArray
    log_gain_std: FloatArray  # of ln gain
    phase_std: FloatArray  # rad
    # (2, n): degrees of freedom of the standard deviations of ln gain and phase, for Student's t;
    # the smaller of the two is that of real and imaginary part
    dof: FloatArray
    # (k,): deviations of tests from predictions without them, over their standard deviations; if
    # more of them are large than Student's t predicts, bands of one more test are wider
    scores: FloatArray = field(default_factory=lambda: np.empty(0))

    def gain(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the gain at each point."""
        size = np.abs(self.centre)
        lower, upper = self._around(0.0 * size, level, self.dof[0], self.log_gain_std)
        return size * np.exp(lower), size * np.exp(upper)

    def phase(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the phase at each point, rad."""
        return self._around(np.angle(self.centre), level, self.dof[1], self.phase_std)

    def real(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the real part at each point."""
        return self._around(self.centre.real, level, self.dof.min(axis=0), self.real_std)

    def imag(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the imaginary part at each point."""
        return self._around(self.centre.imag, level, self.dof.min(axis=0), self.imag_std)

    def _around(
        self, centre: FloatArray, level: float, dof: FloatArray, std: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        width = band_factor(self.scores, dof, float(checked_levels([level])[0])) * std
        return centre - width, centre + width


@dataclass(frozen=True)
class DerivedQuantity:
    """A number that follows from the estimate, with its propagated standard error."""

    name: str
    unit: str
    amplitude: float | None
    value: float
    stderr: float

    def __str__(self) -> str:
        where = "" if self.amplitude is None else f" at amplitude {self.amplitude:.3g}"
        return f"{self.name}{where} = {with_unit(self.value, self.stderr, self.unit)}"


def response_band(
    optimum: Optimum,
    frequency_hz: ArrayLike,
    amplitude: ArrayLike | None,
    drive: ArrayLike | None,
    quantity: Any,
    errors: ErrorModel | None = None,
    *,
    of_a_test: bool = True,
) -> ResponseBand:
    """Return the response that the estimate predicts, sensors included.

    With `errors` the band is that of one more test, or of the device itself.
    """
    problem, theta = _estimate(optimum, errors)
    new = problem_at(problem, frequency_hz, amplitude, drive, quantity)
    R, by = new.predict(theta), new.prediction_jacobian(theta)
    known = np.isfinite(R) & (R != 0.0)
    if not known.any():
        real, imag = gain, phase = nothing = np.full((2, R.size), np.nan)
        return ResponseBand(R, R, real, imag, gain, phase, nothing)
    predicted = replace(new.data.select(rows=known), response=R[known])
    view = new.like(data=predicted, noise="absolute").stiffness_data  # as if measured
    if errors is None:
        noise = np.zeros((R.size, 2, 2))
        if of_a_test:  # with the noise of the nearest measured row
            stated = problem.widened(np.zeros(problem.data.n))
            units = optimum.scale * relative_units(stated, theta, stated.predict(theta))
            units = units[_nearest(stated, view.amplitude, view.omega)]
            noise[known] = units @ units.swapaxes(1, 2)
        return _noise_band(optimum, R, by, noise)
    return _combined_band(
        errors, R, by, known, view.amplitude, view.omega, view.stiffness, of_a_test
    )


def predicted_backbone(
    optimum: Optimum, model: Model, amplitude: ArrayLike, errors: ErrorModel | None = None
) -> FrequencyResponse:
    """Return natural frequencies and damping ratios of the model with the estimates put in."""
    A = np.atleast_1d(positive_array(amplitude, "amplitude"))
    mass = sum(float(p.value or 0.0) for p in model.parameters if p.is_mass)
    if mass == 0.0:
        raise ModelError(f"{model!r} has no mass, and so no natural frequency; add Mass(value)")
    omega = np.ones(A.shape)
    for _ in range(_PASSES):
        Z = model.dynamic_stiffness(A, omega)
        square = omega**2 + Z.real / mass
        if not (square > 0.0).all():
            raise ModelError(
                f"at the amplitude {A[np.argmin(square)]:.3g} no frequency makes the restoring "
                "force balance the inertia; add Spring(), or give other amplitudes"
            )
        last, omega = omega, np.sqrt(square)
        if (np.abs(omega - last) <= _RESONANT * omega).all():
            break
    f = omega / (2.0 * np.pi)
    above, below = (model.dynamic_stiffness(A, omega * (1.0 + h)) for h in (_STEP, -_STEP))
    slope = np.abs((above - below).real) / (2.0 * _STEP)
    band = response_band(optimum, f, A, None, "dynamic_stiffness", errors, of_a_test=False)
    critical = 2.0 * mass * omega**2
    return FrequencyResponse.backbone(
        A,
        f,
        model.dynamic_stiffness(A, omega).imag / critical,
        frequency_std=np.maximum(f * band.real_std / slope, SMALLEST),
        damping_ratio_std=np.maximum(band.imag_std / critical, SMALLEST),
        motion=optimum.problem.data.motion,
    )


def _estimate(optimum: Optimum, errors: ErrorModel | None) -> tuple[TableProblem, FloatArray]:
    """Return the problem and theta of the combined estimate, or of the optimum without errors."""
    return (optimum.problem, optimum.theta) if errors is None else (errors.problem, errors.theta)


def problem_at(
    problem: Problem,
    frequency_hz: ArrayLike,
    amplitude: ArrayLike | None,
    drive: ArrayLike | None,
    quantity: Any,
) -> TableProblem:
    """Return the same problem at other operating points, for predictions."""
    level = drive if amplitude is None else amplitude
    if level is None or (amplitude is not None and drive is not None):
        raise ValidationError("give either amplitude (displacement controlled) or drive (force)")
    name = "drive" if amplitude is None else "amplitude"
    f = np.atleast_1d(positive_array(frequency_hz, "frequency_hz"))
    at_points = np.atleast_1d(positive_array(level, name))
    try:
        f, at_points = np.broadcast_arrays(f, at_points)
    except ValueError:
        raise ValidationError(
            f"frequency_hz has shape {f.shape} and {name} {at_points.shape}; expected one "
            "shape, or one number for all"
        ) from None
    levels: dict[str, Any] = {name: at_points}
    default = "dynamic_stiffness" if problem.response is None else problem.response.quantity
    grid = FrequencyResponse(
        f,
        np.ones(f.shape),
        **levels,
        controlled="displacement" if drive is None else "force",
        quantity=quantity or default,
        motion=problem.motion,
    )
    moved: TableProblem = problem.for_table(grid)
    return moved


def describing_function_band(
    optimum: Optimum, amplitude: ArrayLike, errors: ErrorModel | None = None
) -> ResponseBand:
    """Return N(A) of all friction laws together, without the other elements."""
    A = positive_array(amplitude, "amplitude")
    N, by = friction_and_slopes(*_estimate(optimum, errors), A)
    if errors is None:
        return _noise_band(optimum, N, by)
    omega = np.exp(np.log(errors.problem.stiffness_data.omega).mean())  # mean frequency
    columns = by.reshape(-1, by.shape[-1])
    band = _combined_band(errors, N.ravel(), columns, np.isfinite(N.ravel()), A.ravel(), omega)
    parts = {
        k: v.reshape((*v.shape[:-1], *A.shape)) for k, v in vars(band).items() if k != "scores"
    }
    return ResponseBand(**parts)


def friction_and_slopes(
    problem: TableProblem, theta: FloatArray, A: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return N(A) of the friction, and its derivatives with respect to theta in a last axis."""
    names = problem.names
    values = values_at(problem, theta)
    slopes = dict(zip(names, problem.value_slopes(theta), strict=True))
    N = np.zeros(A.shape, dtype=np.complex128)
    by = np.zeros((*A.shape, len(names)), dtype=np.complex128)
    elements = [e for e in problem.model.elements if e.has_memory]
    if not elements:
        raise ModelError("the model has no friction law, so there is no friction to describe")
    for element in elements:
        law_values = [np.asarray(values[p.name]) for p in element.parameters]
        part = element.stiffness_gradient(law_values, A, np.zeros(()), 1)
        N += part.value
        for parameter, slope in zip(element.parameters, part.by_parameter, strict=True):
            if parameter.free:
                by[..., names.index(parameter.name)] += slope * slopes[parameter.name]
    return N, by


def quantities(
    problem: Problem,
    by_name: Mapping[str, FloatArray],
    amplitudes: Sequence[float],
    frequency_hz: float | None,
) -> Iterator[tuple[str, str, float | None, FloatArray]]:
    """Yield name, unit, amplitude and values of the derived quantities.

    These are x_c of each law that has one, then loss, stiffness and damping at each amplitude, for
    (n,) values of each free parameter, by name.
    """
    motion, size = problem.motion, len(next(iter(by_name.values())))
    friction = [
        (e, [by_name.get(p.name, np.asarray(p.value)) for p in e.parameters])
        for e in problem.model.elements
        if e.has_memory
    ]
    for element, values in friction:
        low, high = (np.broadcast_to(k, size) for k in element.knee(values))
        if np.array_equal(low, high):  # a law with a range of knees has no single x_c
            label = "x_c" if element.name is None else f"{element.name}_x_c"
            yield label, shown_unit("m", motion), None, low
    omega = 2.0 * np.pi * float(positive_array(1.0 if frequency_hz is None else frequency_hz, "f"))
    responses = []
    for A in positive_array(amplitudes, "amplitudes").ravel().tolist():
        parts = (e.stiffness(v, np.full(size, A), np.full(size, omega)) for e, v in friction)
        responses.append((A, sum(parts, np.zeros(size, np.complex128))))
    for A, N in responses:
        yield ENERGY, "J", A, np.pi * A**2 * N.imag
    for A, N in responses:
        yield "equivalent stiffness", shown_unit("N/m", motion), A, N.real
    for A, N in responses if frequency_hz is not None else ():
        yield "equivalent damping", shown_unit("N s/m", motion), A, N.imag / omega


def quantities_and_slopes(
    problem: Problem, values: FloatArray, amplitudes: Sequence[float], frequency_hz: float | None
) -> Iterator[tuple[str, str, float | None, float, FloatArray]]:
    """Yield them at the values of an estimate, (P,), with their derivatives, (P,)."""
    steps, count = _STEP * np.maximum(np.abs(values), SMALLEST), values.size
    points = np.vstack([values, values + np.diag(steps), values - np.diag(steps)])
    by_name = dict(zip(problem.names, points.T, strict=False))
    for name, unit, A, results in quantities(problem, by_name, amplitudes, frequency_hz):
        slopes = (results[1 : count + 1] - results[count + 1 :]) / (2.0 * steps)
        yield name, unit, A, float(results[0]), slopes


def derived(
    optimum: Optimum,
    amplitudes: Sequence[float],
    frequency_hz: float | None,
    errors: ErrorModel | None = None,
) -> Iterator[DerivedQuantity]:
    """Yield x_c of each law that has one, then loss, stiffness and damping at each amplitude."""
    problem, theta = _estimate(optimum, errors)
    values = dict(zip(optimum.names, optimum.values.tolist(), strict=True))
    infinite = np.array([not np.isfinite(values.get(name, 1.0)) for name in problem.names])
    by_search = problem.value_slopes(theta)
    std = (errors or Information(optimum)).std
    A, stds = np.asarray(amplitudes, dtype=np.float64).ravel(), iter(())
    if A.size:
        band = describing_function_band(optimum, A, errors)
        damping = band.imag_std / (2.0 * np.pi * (frequency_hz or 1.0))
        stds = iter([*np.pi * A**2 * band.imag_std, *band.real_std, *damping])
    for name, unit, amplitude, value, slopes in quantities_and_slopes(
        problem, problem.to_values(theta), amplitudes, frequency_hz
    ):
        if amplitude is None and (slopes[infinite] != 0.0).any():
            continue
        error = std(slopes * by_search) if amplitude is None else next(stds)
        yield DerivedQuantity(name, unit, amplitude, value, float(error))


def _noise_band(
    optimum: Optimum, R: ComplexArray, by: ComplexArray, noise: FloatArray | None = None
) -> ResponseBand:
    """Return the band from noise alone, `noise` the covariance of a test's ln gain and phase."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = by / R[..., None]
    dof = np.inf if optimum.scale_known else (optimum.dof if optimum.dof > 0 else np.nan)
    parts = Information(optimum).std(np.array([by.real, by.imag, relative.real, relative.imag]))
    if noise is not None:
        parts = np.hypot(parts, _parts_std(R, noise))
    real, imag, gain, phase = parts
    return ResponseBand(R, R, real, imag, gain, phase, np.full((2, *R.shape), dof))


def _parts_std(R: ComplexArray, covariance: FloatArray) -> FloatArray:
    """Return standard deviations of real and imaginary part, ln gain and phase of (n,) responses.

    `covariance`, (n, 2, 2), is that of ln gain and phase.
    """
    slopes = np.stack([R, 1j * R], axis=-1)  # with respect to ln gain and phase
    gain, phase = (np.tile(axis, (R.size, 1)) for axis in np.eye(2))
    rows = np.array([slopes.real, slopes.imag, gain, phase])
    squares = np.einsum("kni,nij,knj->kn", rows, covariance, rows)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


def _combined_band(
    errors: ErrorModel,
    R: ComplexArray,
    by: ComplexArray,
    known: BoolArray,
    amplitude: FloatArray,
    omega: FloatArray,
    stiffness: ComplexArray | None = None,
    of_a_test: bool = False,
) -> ResponseBand:
    """Return the band of responses (n,); NaN where a response is not `known`."""
    R_known = R[known]
    parts, dof = np.full((4, R.size), np.nan), np.full((2, R.size), np.nan)
    error = prediction_error(
        errors, by[known] / R_known[:, None], amplitude, omega, stiffness, of_a_test=of_a_test
    )
    parts[:, known] = _parts_std(R_known, error.covariance)
    dof[:, known] = error.dof.T
    centre = R.copy()
    centre[known] *= np.exp(error.departure @ np.array([1.0, 1.0j]))
    left_out = errors.left_out if of_a_test else None
    scores = np.empty(0) if left_out is None else left_out.scores
    real, imag, gain, phase = parts
    return ResponseBand(R, centre, real, imag, gain, phase, dof, scores)

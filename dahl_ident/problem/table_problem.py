"""Data, model, noise and sensors of one estimate, used by every solver and sampler."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, Self, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray, interleaved
from dahl_ident.data import FrequencyResponse
from dahl_ident.data.columns import one_of
from dahl_ident.data.frequency_response import fundamental_alone
from dahl_ident.data.rows import Rows, row_names
from dahl_ident.data.tabular import assumes_frequency
from dahl_ident.elements import Element
from dahl_ident.elements.driven_motion import ACCURACY, STEADY, Shooting, Steady, obstacle
from dahl_ident.elements.element import as_model
from dahl_ident.elements.parameter import Dimension
from dahl_ident.errors import DataError, ModelError, argument
from dahl_ident.noise import (
    ROUNDING,
    Measured,
    Noise,
    Student,
    bend,
    correct_amplitude,
    noise_for,
    squares_of,
    weighted,
)
from dahl_ident.problem.base import EXPLICIT, Problem
from dahl_ident.problem.prediction import NearbyPredictor, Prediction, Predictor
from dahl_ident.problem.space import Interchangeable, Space, with_changes
from dahl_ident.problem.stiffness import StiffnessData, as_response, checked_table
from dahl_ident.sensors import EXACT, Prior, Sensors, measured_stiffness_factor
from dahl_ident.units import counted, shown_unit

_ORBITS: WeakKeyDictionary[FrequencyResponse, dict[int, FloatArray]] = WeakKeyDictionary()
"""The last orbits of shooting, by table and number of states, shared by the problems of one fit."""

_Kind = TypeVar("_Kind", bound="TableProblem")

_LOST = 2e-6
"""Noise of the data's mean over that of a calibration, below which the calibration's share of the
information (its square) is near rounding."""


class TableProblem(Problem):
    """Data, model, noise and sensors: residuals, Jacobian and likelihood of one estimate.

    Displacement-controlled rows need an amplitude, force-controlled rows a drive. `noise` is by
    default "measured" if the data have a covariance, otherwise "relative". Without `sensors` the
    channels are exact. `free` names parameters with values that are estimated nevertheless, from
    there; `fixed` holds parameters. `steady` is how force-controlled rows are predicted.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.data import FrequencyResponse
    >>> A = np.array([1e-4, 1e-3, 1e-2])
    >>> N = Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> problem = TableProblem(FrequencyResponse(np.ones(3), N, A), Dahl())
    >>> problem.names
    ('f_max', 'sigma')
    >>> theta = problem.to_search([0.1, 30.0])
    >>> bool(np.all(np.abs(problem.residuals(theta)) < 1e-14))
    True
    """

    arguments = ("data", "model", "noise", "sensors", "steady")
    kind, kind_in_words = "table", "a table"
    refused_options: ClassVar[Mapping[str, str]] = {
        "output": "it follows from the quantity that was controlled in each row",
        "excitation": "rows are responses to a force",
        "parts": "its tests are left out one at a time",
    }
    output_in_words = "the fundamental"
    _orbits: dict[int, FloatArray]
    _coarse = False  # whether measured amplitudes are taken as exact

    def __init__(
        self,
        data: Any,
        model: Element,
        *,
        noise: str | None = None,
        sensors: Sensors | None = None,
        free: Iterable[str] = (),
        fixed: Mapping[str, float] | None = None,
        steady: Steady = "exact",
    ) -> None:
        one_of(steady, "steady", STEADY)
        self.steady = steady
        tables = self._checked(data)
        model, sensors = with_changes(as_model(model), sensors or EXACT, free, fixed or {})
        self.model = model
        self.sensors = sensors
        self.motion = tables[0].motion
        parameters = [p for p in (*model.parameters, *sensors.parameters) if p.free]
        if self.motion == "rotation":
            parameters = [replace(p, unit=shown_unit(p.unit, self.motion)) for p in parameters]
        if not parameters:
            raise ModelError(
                f"{model!r} has no free parameter; leave one out, or name it in {argument('free')}"
            )
        self.space = Space(parameters)
        self._misfit: FloatArray | None = None
        self._alike = Interchangeable(model, self.names)
        self.priors: dict[str, Prior] = sensors.priors
        self.ranges: dict[str, tuple[float, float]] = {}
        self._set_rows(self._rows_of([as_response(table, model) for table in tables]), noise)
        if self._rows.of_displacement.any() and not self.is_exact:
            raise DataError(
                "the rows hold harmonics of the displacement, which the describing function takes "
                f"for a sine ({self.obstacle_to_exact or 'as asked for'}): leave them out with "
                f"{fundamental_alone()}"
            )

    def _checked(self, data: Any) -> list[FrequencyResponse]:
        """Return `data` as a list of one table, checked."""
        return [checked_table(data)]

    def _rows_of(self, tables: list[FrequencyResponse]) -> Rows:
        """Keep the tables, and return the rows of all."""
        (self.data,) = tables
        rates = [type(e).__name__ for e in self.model.elements if not e.rate_independent]
        if rates and assumes_frequency(self.data.provenance):
            raise DataError(
                f"the table states no frequency, on which the force of {', '.join(rates)} depends; "
                f"give it when the table is read: {argument('frequency', 1.0)} (Hz)"
            )
        self.runs = tuple(self.data.runs or ())
        self._orbits = _ORBITS.setdefault(self.data, {})
        return Rows.of(self.data)

    def _set_rows(self, rows: Rows, noise: str | None) -> None:
        self._rows = rows
        self._predictor: Predictor | NearbyPredictor = self._predicting(exact=self.is_exact)
        self._latest: tuple[bytes, Prediction] | None = None
        self._set_noise(noise_for(rows, noise))
        self.n_residuals = 2 * rows.n
        self.n_nonzero = self.n_residuals - int(np.count_nonzero(rows.harmonic == 0))

    def _set_noise(self, noise: Noise) -> None:
        if self._misfit is not None and isinstance(noise, Measured) and noise.scale_known:
            noise = noise.widened(self._misfit)
        self._noise = noise
        self.noise = noise.name
        self.scale_known = noise.scale_known
        self.tail: Student | None = noise.tail

    def widened(self, misfit: FloatArray) -> TableProblem:
        """Return the problem with the variance of a misfit, (n,), added to stated covariances.

        Its rows are Gaussian; see ``Measured.widened`` in noise.py.
        """
        has_misfit = bool(misfit.any())
        widened = self.altered("stiffness_data", _misfit=misfit, has_misfit=has_misfit)
        widened._set_noise(noise_for(self._rows, self.noise))
        return widened

    def part(self, rows: BoolArray, response: ComplexArray) -> TableProblem:
        """Return the problem of some rows, with other responses in place of the data's."""
        data = replace(self.data.select(rows=rows), response=response)
        part = self.like(data=data)
        part.ranges = self.ranges
        return part if self._misfit is None else part.widened(self._misfit[rows])

    def _with_rows(self, kind: type[_Kind], rows: Rows) -> _Kind:
        """Return this problem, or batch, with other rows."""
        problem = object.__new__(kind)
        problem.__dict__.update(self.__dict__)
        for stale in ("stiffness_data", "data", "tables"):
            problem.__dict__.pop(stale, None)
        problem._set_rows(rows, self.noise)
        return problem

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__}: {counted(self._rows.n, 'row')} of {self._rows.quantity}, "
            f"{self.noise} noise, free {', '.join(self.names)}>"
        )

    @property
    def response(self) -> FrequencyResponse:
        """The table."""
        return self.data

    def for_table(self, table: FrequencyResponse) -> TableProblem:
        """Return the problem of the same model and sensors for another table."""
        return self.like(data=table, noise="absolute")

    def why_not_finite(self, residuals: FloatArray) -> str:
        """Return why residuals are not finite, and what to do; empty if they are."""
        lost = np.flatnonzero(~np.isfinite(residuals))
        if not lost.size:
            return ""
        (name,) = row_names(self.data, [int(lost[0]) // 2])
        cause = "the model has no finite response there; give a start, or another model"
        if (self.data.controlled == "force").any():
            cause = (
                "the drive moves the model without bound; add the mass, damper or spring that "
                "friction is in parallel, or give a start"
            )
        return f"No parameters that were tried predict {name}: {cause}"

    # Steady motion

    @cached_property
    def obstacle_to_exact(self) -> str:
        """Why the model has no exact steady motion under a force; empty if it has one."""
        return obstacle(self.model)

    @cached_property
    def _shooting(self) -> Shooting:
        return Shooting(self.model)

    @property
    def extent(self) -> str:
        """How much was measured, in words."""
        return counted(self._rows.n, "row")

    @property
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where the table comes from."""
        return (self.data.provenance,)

    @property
    def is_exact(self) -> bool:
        """Whether rows are predicted by the exact steady motion."""
        return (
            self.steady == "exact" and bool(self._rows.forced.any()) and not self.obstacle_to_exact
        )

    def unstable_rows(self, theta: ArrayLike) -> list[int]:
        """Return the rows for which no stable steady motion exists, so an unstable one is used."""
        if not isinstance(self._predictor, Predictor):
            return []
        with np.errstate(all="ignore"):
            return self._predictor.unstable_rows(self.space.checked(theta))

    def with_steady(self, steady: Steady) -> Self:
        """Return the same problem, or batch, with another way to predict driven rows."""
        problem = self.altered("stiffness_data", steady=steady)
        problem._set_rows(self._rows, self.noise)
        return problem

    def coarser(self) -> Self:
        """Return a cheaper problem with nearly the same optimum; itself if there is none.

        Measured amplitudes are taken as exact in predictions; their noise counts to first order.
        """
        model = self.model.coarser() if self.is_exact else self.model
        if model is self.model and self._noise.amplitude is None:
            return self
        coarse = self.altered("stiffness_data", "obstacle_to_exact", "_shooting", model=model)
        coarse._coarse = True
        coarse._set_rows(self._rows, self.noise)
        return coarse

    def takes_energy(self, theta: FloatArray) -> bool:
        """Return whether all rows take energy from the drive, by the describing function.

        A plant that gives energy at the measured amplitude has no steady motion there.
        """
        sine = self.with_steady("describing function")
        Z = sine.predicted_stiffness(theta)
        first = Z.harmonic == 1
        return bool(np.all((Z.stiffness * self.sensor_factor(theta)).imag[first] > 0.0))

    def near(self, theta: FloatArray) -> TableProblem:
        """Return a problem that predicts nearly the same near theta, (P,), and much faster.

        Exact steady motions are computed to second order in the distance from theta; see
        ``NearbyPredictor`` in problem/prediction.py. Returns the problem itself if it has no exact
        steady motions.
        """
        if not self.is_exact or isinstance(self._predictor, NearbyPredictor):
            return self
        nearby = self.with_steady(self.steady)
        with np.errstate(all="ignore"):
            nearby._predictor = NearbyPredictor(
                self._predicting(exact=True), self._predicting(exact=False), theta
            )
        return nearby

    def _predicting(self, *, exact: bool) -> Predictor:
        shooting = self._shooting if exact else None
        return Predictor(self.model, self.sensors, self.space, self._rows, shooting, self._orbits)

    def assuming(self, spread: Mapping[str, float]) -> TableProblem:
        """Return the problem with parameters free, of which ln has the standard deviation `spread`.

        They scatter about their values.
        """
        freed = self.like(free=spread)
        values = {p.name: p.value or 1.0 for p in freed.parameters}
        freed.ranges = {n: (float(np.log(values[n])), std) for n, std in spread.items()}
        return freed

    # Coordinates

    @cached_property
    def friction_columns(self) -> IntArray:
        """Indices of the parameters of elements that depend on the amplitude."""
        names = {p.name for e in self.model.elements if not e.is_linear for p in e.parameters}
        return np.flatnonzero([name in names for name in self.names])

    def in_order(self, theta: ArrayLike) -> FloatArray:
        """Return theta with interchangeable elements in order of their knees, for Dahl x_c.

        Elements are interchangeable if they follow one law, with the same parameters free and the
        others equal; without an order their labels could switch.
        """
        return self._alike.in_order(self.space.checked(theta), self.space)

    # Predictions

    def predict(self, theta: ArrayLike) -> ComplexArray:
        """Return the predicted response, in the data's quantity, (n,) or (S, n).

        It includes the sensors; NaN where a driven plant has no steady amplitude.
        """
        theta = self.space.checked(theta)
        prediction = self._prediction(theta)
        return np.array(np.broadcast_to(prediction.value, self._shape(theta)))

    fitted = predict

    def level_slope(self, theta: FloatArray) -> ComplexArray:
        """Return dR/d ln of the amplitude, or of the drive in force-controlled rows, (n,)."""
        slope = self._prediction(theta, 2).by_ln_amplitude
        return np.array(np.broadcast_to(slope, self._shape(theta)))

    def _prediction(self, theta: FloatArray, derivatives: int = 0) -> Prediction:
        """Return the prediction; the last one is cached, because many checks use the same theta."""
        if theta.ndim > 1:
            return self._predictor(theta, derivatives=derivatives)
        key, latest = theta.tobytes(), self._latest
        if latest is None or latest[0] != key or (derivatives and not latest[1].by_theta):
            latest = self._latest = key, self._predictor(theta, derivatives=derivatives)
        return latest[1]

    def prediction_jacobian(self, theta: ArrayLike) -> ComplexArray:
        """Return dR/dtheta, shape (n, P) or (S, n, P)."""
        return self.prediction_and_jacobian(theta)[1]

    def prediction_and_jacobian(self, theta: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return R, shape (n,) or (S, n), and dR/dtheta, (n, P) or (S, n, P)."""
        theta = self.space.checked(theta)
        prediction, shape = self._prediction(theta, 2), self._shape(theta)
        changes = [np.broadcast_to(d, shape) for d in prediction.by_theta]
        return np.array(np.broadcast_to(prediction.value, shape)), np.stack(changes, axis=-1)

    def unit_sizes(self, dimension: Dimension) -> FloatArray:
        """Return the size in each row of a unit of such powers of force, displacement and time."""
        view, (force, displacement, time) = self.stiffness_data, dimension
        size = (np.abs(view.stiffness) * view.amplitude) ** force * view.amplitude**displacement
        return np.asarray(size / view.omega**time)

    @cached_property
    def stiffness_data(self) -> StiffnessData:
        """The data as dynamic stiffness at known amplitudes, sensors at their starts."""
        return self._predictor.as_stiffness(self._noise.weights)

    def predicted_stiffness(self, theta: ArrayLike) -> StiffnessData:
        """Return what the model predicts as dynamic stiffness, without the data's noise."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._predictor.as_stiffness(self._noise.weights, self.predict(theta))

    def sensor_factor(self, theta: FloatArray) -> ComplexArray:
        """Return the dynamic stiffness by the sensors at theta over that by their starts."""
        if self.sensors.are_exact:
            return np.ones(1, dtype=np.complex128)
        view = self.stiffness_data
        values = dict(zip(self.names, self.to_values(theta), strict=True))
        start = [np.asarray(p.value) for p in self.sensors.parameters]
        at_theta = [np.asarray(values.get(p.name, p.value)) for p in self.sensors.parameters]
        before, after = (
            measured_stiffness_factor(sensors, view.omega, view.harmonic)
            for sensors in (start, at_theta)
        )
        return before / after

    @property
    def rounding(self) -> FloatArray:
        """Size of residuals that may be mere rounding errors; no estimated scale is smaller.

        It is also large enough that rounding does not lose the calibrations' information on gains.
        """
        widths = [float(p.std()) for name, p in self.priors.items() if name.endswith("_gain")]
        calibrated = _LOST * max(widths, default=0.0) * self.n_residuals**0.5 / ROUNDING
        return np.asarray(self._noise.rounding * max(1.0, self.accuracy / EXPLICIT, calibrated))

    @property
    def log_area(self) -> Any:
        """Return the sum of ln abs(dy/dR), which changes residuals into units of Re R and Im R."""
        return self._noise.log_area

    @property
    def accuracy(self) -> float:
        """Relative error of predictions: rounding, or that of shooting and of true amplitudes."""
        return EXPLICIT if self._noise.amplitude is None and not self.is_exact else ACCURACY

    # Residuals

    def data_rows(
        self, theta: FloatArray, *, derivatives: bool = True, tails: bool = True
    ) -> FloatArray:
        """Return the data's residuals and their derivatives, two for each row; see ``Problem``.

        With noise in the amplitude the residuals are defined up to a rotation of each pair. The
        derivatives omit that rotation; J' r is still the exact gradient of half the sum of squares.
        """
        noise = self._noise

        def value_and_slope(error: FloatArray) -> tuple[ComplexArray, ComplexArray]:
            value, _, slope = self._predictor(theta, derivatives=1, amplitude_error=error)
            return value, slope

        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            if noise.amplitude is None:
                predicted, by, _ = self._prediction(theta, 2 * derivatives)
                y = noise.residual(predicted)
                changes = [noise.change(predicted, d) for d in by]
            elif self._coarse:
                predicted, by, slope = self._prediction(theta, 1 + derivatives)
                whiten = noise.amplitude.whitening(noise.covariance, slope)
                y = whiten(noise.response - predicted)
                changes = [-whiten(d) for d in by]
            else:
                y, whiten, error = correct_amplitude(noise, value_and_slope)
                by = self._predictor(theta, amplitude_error=error).by_theta if derivatives else []
                changes = [-whiten(d) for d in by]
            pairs = np.empty((*self._shape(theta)[:-1], len(changes) + 1, self._rows.n), complex)
            for index, column in enumerate((y, *changes)):
                pairs[..., index, :] = column
            rows = pairs.view(np.float64)
            return bend(rows, self.n_residuals, self.tail) if tails and self.tail else rows

    def residual_change(self, theta: FloatArray, change: ComplexArray) -> FloatArray:
        """Return the change of the data's residuals, (..., 2 n), for one of predictions, (..., n).

        A covariance of few degrees of freedom is taken as known.
        """
        noise = self._noise
        with np.errstate(divide="ignore", invalid="ignore"):
            if noise.amplitude is not None:
                slope = self._prediction(theta, 2).by_ln_amplitude
                by = -noise.amplitude.whitening(noise.covariance, slope)(change)
            else:
                by = noise.change(self.predict(theta), change)
        return interleaved(by)

    def draw(
        self, theta: ArrayLike, scale: float, size: int, rng: np.random.Generator
    ) -> ComplexArray:
        """Return `size` simulated repetitions of the responses, (size, n), from the likelihood.

        Errors of the measured amplitudes appear, to first order, in the responses, so that the
        amplitudes do not change.
        """
        theta = self.space.checked(theta)
        shape, noise = (size, self._rows.n), self._noise
        pairs = rng.standard_normal((2, *shape))
        pairs[1][..., self._rows.harmonic == 0] = 0.0  # a mean force is real
        y = np.asarray(scale * (pairs[0] + 1j * pairs[1]), dtype=np.complex128)
        if self.tail is not None:
            dof = self.tail.dof
            y = y * np.sqrt(dof / rng.chisquare(dof + 1.0 - self.tail.parts, shape))
        if noise.amplitude is None:
            return noise.replicate(self.predict(theta), y)
        value, _, slope = self._predictor(theta)
        spread: ComplexArray = noise.amplitude.whitening(noise.covariance, slope).inverse(y)
        return np.asarray(value + spread)

    def information(
        self, theta: ArrayLike, scale: ArrayLike = 1.0, chart: FloatArray | None = None
    ) -> FloatArray:
        """Return the Fisher information; for an estimated covariance see noise.py."""
        theta = self.space.checked(theta)
        if self.tail is None:
            return super().information(theta, scale, chart)
        rows = self.rows(theta, scale, tails=False)
        m = self.n_residuals
        counted = weighted(rows, m, *self.tail.information(squares_of(rows[..., 0, :m])))
        J, counted = rows[..., 1:, :], counted[..., 1:, :]
        if chart is not None:
            J, counted = chart.T @ J, chart.T @ counted
        return counted @ J.swapaxes(-1, -2)

    def _shape(self, theta: FloatArray) -> tuple[int, ...]:
        """Return the shape of one number for each row and each theta."""
        return (*theta.shape[:-1], self._rows.n)

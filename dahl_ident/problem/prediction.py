"""From parameters to the response in a table, with exact derivatives.

The model gives the dynamic stiffness Z_k(A, omega) = F_k/X_1. From it follow, with the sensors'
factor g (see :mod:`dahl_ident.sensors`), all six quantities:

    R = (j omega)^p (g Z)^q,    q = 1 or -1,  p from -2 to 2.

For rows whose displacement was controlled, A is the measured amplitude. For rows whose force was
controlled, A is the solution of A |Z(A, omega)| = u_0 with the measured drive u_0; its derivatives
follow from the implicit function theorem,

    d ln A = (d ln u_0 - Re(dZ/Z)) / (1 + Re(A Z_A/Z)).

The measured amplitude of such a row is only used to choose among several solutions.

That balance assumes a sinusoidal displacement. If the model has an equation of motion, rows whose
force was controlled are predicted by the exact steady motion instead
(:mod:`dahl_ident.problem.steady_rows`), unless the describing function was requested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from dahl_ident.control_interop.force_balance import solve
from dahl_ident.data.rows import Rows
from dahl_ident.elements import Model
from dahl_ident.elements.driven_motion import Shooting
from dahl_ident.elements.facts import Sine, StiffnessGradient
from dahl_ident.errors import DataError, argument
from dahl_ident.problem.space import Space
from dahl_ident.problem.steady_rows import SteadyRows
from dahl_ident.problem.stiffness import StiffnessData
from dahl_ident.sensors import Sensors, measured_stiffness_factor
from dahl_ident.units import DEFINITIONS, power_of_s

_NONE: ComplexArray = np.zeros((), dtype=np.complex128)


class Prediction(NamedTuple):
    """The response R, and its derivatives with respect to theta and to ln A or ln u_0."""

    value: ComplexArray
    by_theta: list[ComplexArray]
    by_ln_amplitude: ComplexArray

    @property
    def arrays(self) -> list[ComplexArray]:
        """The response, and its derivatives with respect to ln A and to theta."""
        return [self.value, self.by_ln_amplitude, *self.by_theta]

    @classmethod
    def of(cls, arrays: list[ComplexArray]) -> Prediction:
        """Return the prediction with these `arrays`."""
        return cls(arrays[0], arrays[2:], arrays[1])


class NearbyPredictor:
    """The prediction near a point: the describing function, corrected to the exact motion.

    The correction, the logarithm of the exact over the approximate response, is linearized in the
    search coordinates and in the logarithm of the drive. The error is of second order in the
    distance, and small, because the describing function itself is not linearized. A prediction
    costs as much as the describing function. Harmonics of the displacement, which the describing
    function does not have, are linearized themselves.
    """

    def __init__(self, exact: Predictor, approximate: Predictor, theta: FloatArray) -> None:
        self._approximate, self._theta = approximate, theta
        a, b = exact(theta), approximate(theta)
        self._linear = linear = exact.rows.of_displacement  # rows that are linearized themselves
        self._correction = np.where(linear, a.value, np.log(a.value / b.value))
        self._slopes = [
            np.where(linear, da, da / a.value - db / b.value)
            for da, db in zip(a.by_theta, b.by_theta, strict=True)
        ]
        slope = a.by_ln_amplitude / a.value - b.by_ln_amplitude / b.value
        slope = np.where(linear, a.by_ln_amplitude, slope)
        self._drive_slope = np.where(exact.rows.forced, slope, 0.0)

    def __call__(
        self,
        theta: FloatArray,
        *,
        derivatives: int = 2,
        amplitude_error: FloatArray | None = None,
    ) -> Prediction:
        """Return the prediction, as a predictor does."""
        sine = self._approximate(theta, derivatives=derivatives, amplitude_error=amplitude_error)
        linear, correction = self._linear, self._correction
        for i, slope in enumerate(self._slopes):
            correction = correction + slope * (theta[..., i, None] - self._theta[i])
        if amplitude_error is not None:
            correction = correction - self._drive_slope * amplitude_error
        with np.errstate(over="ignore", invalid="ignore"):
            factor = np.exp(correction)
            value = np.where(linear, correction, sine.value * factor)
            scale = np.where(linear, 1.0, value)
            by_theta = [
                np.where(linear, 0.0, d * factor) + scale * slope
                for d, slope in zip(sine.by_theta, self._slopes, strict=False)
            ]
            by_level = sine.by_ln_amplitude
            if derivatives:
                by_level = np.where(linear, 0.0, by_level * factor) + scale * self._drive_slope
        return Prediction(value, by_theta, by_level)

    def as_stiffness(
        self, weights: FloatArray, predicted: ComplexArray | None = None
    ) -> StiffnessData:
        """Return the data as dynamic stiffness."""
        return self._approximate.as_stiffness(weights, predicted)


@dataclass(frozen=True)
class _Group:
    """Rows that are computed together; `operator` is (j omega)^p."""

    rows: slice | IntArray
    harmonic: NDArray[np.int64]
    forced: bool
    omega: FloatArray
    operator: ComplexArray
    amplitude: FloatArray
    drive: FloatArray | None
    steady: SteadyRows | None
    """Steady motions of the rows, if the rows are predicted by them."""

    @cached_property
    def orders(self) -> int | NDArray[np.int64]:
        """The harmonic of each row, or one number if they have the same."""
        first = int(self.harmonic[0])
        return first if (self.harmonic == first).all() else self.harmonic


class Predictor:
    """Prediction of a model with its sensors for the operating points of `rows`.

    `shooting` solves for the exact steady motion of rows whose force was controlled; without it
    they are predicted by the describing function. It starts from `orbits`, which it updates.
    """

    def __init__(
        self,
        model: Model,
        sensors: Sensors,
        space: Space,
        rows: Rows,
        shooting: Shooting | None = None,
        orbits: dict[int, FloatArray] | None = None,
    ) -> None:
        self._model, self._sensors, self._space = model, sensors, space
        self._shooting = shooting
        self._orbits = {} if orbits is None else orbits
        self._exact_sensors = sensors.are_exact
        names = space.names
        self._slots = [  # the source of each value: an index into theta, or a constant
            (names.index(p.name), np.empty(0)) if p.free else (None, np.asarray(p.value))
            for p in (*model.parameters, *sensors.parameters)
        ]
        self.rows = rows
        _check(rows, self._model)
        power, self._exponent = DEFINITIONS[rows.quantity]
        self._operator = power_of_s(rows.omega, power)
        self._measured = _measured_amplitude(rows, self._operator, self._exponent)
        self._groups = [
            _Group(
                part,
                rows.harmonic[part],
                forced,
                rows.omega[..., part],
                self._operator[..., part],
                self._measured[..., part],
                None if rows.drive is None else rows.drive[..., part],
                self._steady_rows(part) if forced else None,
            )
            for part, forced in _rows_by_control(rows)
        ]

    def unstable_rows(self, theta: FloatArray) -> list[int]:
        """Return the rows whose predicted steady motion is not stable, at theta of shape (P,)."""
        unstable: list[int] = []
        values = self._values(theta)
        for group in self._groups:
            if group.steady is not None and not group.steady.is_linear(values[:-3]).any():
                drive = self._true_drive(group, values[-3:], None)
                stable = group.steady.at(values[:-3], drive, []).stable
                unstable += np.arange(self.rows.n)[group.rows][~stable].tolist()
        return unstable

    def _steady_rows(self, part: slice | IntArray) -> SteadyRows | None:
        rows = self.rows
        if self._shooting is None or rows.drive is None:
            return None
        ratio = _fundamental(rows, rows.response) / self._operator
        with np.errstate(divide="ignore", invalid="ignore"):
            measured = rows.drive * (ratio if self._exponent == -1 else 1.0 / ratio)
        drive, omega = np.broadcast_arrays(rows.drive, rows.omega)
        indices = np.arange(rows.n)
        fundamental = np.atleast_2d(np.where(rows.of_displacement, rows.fundamental, indices))[0]
        return SteadyRows(
            self._model,
            self._shooting,
            drive[..., part],
            omega[..., part],
            measured[..., part],
            rows.harmonic[part],
            np.searchsorted(indices[part], fundamental[part]),
            self._orbits,
        )

    def as_stiffness(
        self, weights: FloatArray, predicted: ComplexArray | None = None
    ) -> StiffnessData:
        """Return the data as dynamic stiffness; `weights` are those of the response.

        With `predicted` responses in place of the measured ones, amplitudes of force-controlled
        rows are predicted too. A harmonic of the displacement is replaced by its fundamental, with
        a weight of zero.
        """
        rows = self.rows
        response = _fundamental(rows, rows.response if predicted is None else predicted)
        harmonic = np.where(rows.of_displacement, 1, rows.harmonic)
        weights = np.where(rows.of_displacement, 0.0, weights)
        ratio = response / self._operator
        Z = ratio if self._exponent == 1 else 1.0 / ratio
        amplitude = self._measured
        if predicted is not None and rows.drive is not None:
            amplitude = np.where(rows.forced, rows.drive / np.abs(Z), amplitude)
        if not self._exact_sensors:
            sensor_values = [np.asarray(p.value) for p in self._sensors.parameters]
            Z = Z / measured_stiffness_factor(sensor_values, rows.omega, harmonic)
            amplitude = amplitude / sensor_values[1]
        if rows.quantity != "dynamic_stiffness":
            weights = weights * np.abs(response / Z)
        return StiffnessData(Z, amplitude, rows.omega, harmonic, weights)

    def __call__(
        self,
        theta: FloatArray,
        *,
        derivatives: int = 2,
        amplitude_error: FloatArray | None = None,
    ) -> Prediction:
        """Return the response and its derivatives at search coordinates, (P,) or (S, P).

        `derivatives` is 0 for none, 1 for that with respect to ln A, 2 for all. `amplitude_error`
        is the error of ln A, or of ln u_0 in force-controlled rows: the true value is the measured
        one over its exponential.
        """
        values = self._values(theta)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            parts = [
                self._predict(group, values, derivatives, amplitude_error) for group in self._groups
            ]
        if len(parts) == 1:
            return parts[0]
        shape = np.broadcast_shapes((*theta.shape[:-1], 1), self.rows.response.shape)
        arrays = [np.empty(shape, dtype=np.complex128) for _ in parts[0].arrays]
        for group, part in zip(self._groups, parts, strict=True):
            for array, values_of_part in zip(arrays, part.arrays, strict=True):
                array[..., group.rows] = values_of_part
        return Prediction.of(arrays)

    def _values(self, theta: FloatArray) -> list[FloatArray]:
        """Return the values of all parameters, those of the three sensor parameters last."""
        columns = self._space.to_values(theta)[..., None]
        return [constant if i is None else columns[..., i, :] for i, constant in self._slots]

    def _predict(
        self,
        group: _Group,
        values: list[FloatArray],
        derivatives: int,
        error: FloatArray | None,
    ) -> Prediction:
        if group.steady is None:
            return self._response(group, values, derivatives, error)
        linear = group.steady.is_linear(values[:-3])[..., None]
        if linear.all():
            return self._response(group, values, derivatives, error)
        if not linear.any():
            return self._response(group, values, derivatives, error, group.steady)
        # no motions are computed for values that are NaN
        nonlinear = [*(np.where(linear, np.nan, v) for v in values[:-3]), *values[-3:]]
        exact = self._response(group, nonlinear, derivatives, error, group.steady)
        sine = self._response(group, values, derivatives, error)
        pairs = zip(sine.arrays, exact.arrays, strict=True)
        return Prediction.of([np.where(linear, a, b) for a, b in pairs])

    def _response(
        self,
        group: _Group,
        values: list[FloatArray],
        derivatives: int,
        error: FloatArray | None,
        steady: SteadyRows | None = None,
    ) -> Prediction:
        """Return R = (j omega)^p (g Y)^q, with Y = Z, or u_0/X_k of the steady motion."""
        model_values, sensor_values = values[:-3], values[-3:]
        factor, power = group.operator, self._exponent
        if not self._exact_sensors:
            sensor = measured_stiffness_factor(sensor_values, group.omega, group.harmonic)
            factor = factor * sensor**power
        free = [i for i, (index, _) in enumerate(self._slots[:-3]) if index is not None]
        if steady is None:
            Y, by_level, by = self._stiffness(
                group, model_values, sensor_values, derivatives, error
            )
            factor = factor * (group.harmonic == 1) if group.forced else factor
            by = tuple(by[i] for i in free) if derivatives > 1 else ()
        else:  # X_k may be zero
            drive, power = self._true_drive(group, sensor_values, error), -power
            motion = steady.at(model_values, drive, free if derivatives > 1 else [])
            Y, by_level = motion.displacement / drive, motion.by_drive
            by_level = by_level - Y
            by = tuple(np.moveaxis(motion.by_parameter, -1, 0) / drive)
        response = factor * Y if power == 1 else factor / Y
        if not derivatives:
            return Prediction(response, [], _NONE)
        slope = factor if power == 1 else -response / Y  # dR/dY
        by_level, by_theta = slope * by_level, []
        for i, change in zip(free, by, strict=False):
            positive = self._space.positive[self._slots[i][0]]
            by_theta.append(slope * (change * model_values[i] if positive else change))
        if not self._exact_sensors and derivatives > 1:
            by_theta += self._by_sensors(group, response, by_level)
        return Prediction(response, by_theta, by_level)

    def _stiffness(
        self,
        group: _Group,
        model_values: list[FloatArray],
        sensor_values: list[FloatArray],
        derivatives: int,
        error: FloatArray | None,
    ) -> StiffnessGradient:
        """Return Z by the describing function, and its derivatives.

        They are with respect to ln A, or ln u_0 for force-controlled rows, and to the values.
        """
        forced, exists, drive = group.forced, np.ones((), dtype=np.bool_), None
        amplitude = group.amplitude if self._exact_sensors else group.amplitude / sensor_values[1]
        if forced:
            drive = self._true_drive(group, sensor_values, error)
            amplitude = solve(self._model, model_values, group.omega, drive, amplitude)
            exists = np.isfinite(amplitude)
            amplitude = np.where(exists, amplitude, 1.0)
        elif error is not None:
            amplitude = amplitude * np.exp(-error[..., group.rows])
        sine = Sine(amplitude, group.omega, 1 if forced else group.orders)
        Z, by_amplitude, by = self._model.settled(model_values, sine, derivatives)
        Z = Z if exists.all() else np.where(exists, Z, np.nan)
        if not derivatives:
            return StiffnessGradient(Z, by_amplitude, by)
        by_level = amplitude * by_amplitude
        if forced:
            by_ln_drive = 1.0 / (1.0 + (by_level / Z).real)  # d ln A / d ln u_0
            by = tuple(d - by_level * ((d / Z).real * by_ln_drive) for d in by)
            by_level = by_level * by_ln_drive
        return StiffnessGradient(Z, by_level, by)

    def _true_drive(
        self, group: _Group, sensor_values: Sequence[FloatArray], error: FloatArray | None
    ) -> FloatArray:
        """Return the true drive of force-controlled rows."""
        assert group.drive is not None
        drive = group.drive / sensor_values[0]
        return drive if error is None else np.asarray(drive * np.exp(-error[..., group.rows]))

    def _by_sensors(
        self, group: _Group, response: ComplexArray, by_level: ComplexArray
    ) -> list[ComplexArray]:
        """Return dR/d(free sensor parameters); `by_level` is dR/dln A or dR/dln u_0."""
        by_gain = self._exponent * response
        by_sensor = (
            by_gain - by_level if group.forced else by_gain,
            -by_gain if group.forced else -by_gain - by_level,
            1j * group.harmonic * group.omega * by_gain,
        )
        slots = self._slots[-3:]
        return [d for d, (index, _) in zip(by_sensor, slots, strict=True) if index is not None]


def _check(rows: Rows, model: Model) -> None:
    """Check that every row can be predicted, and that some of them depend on the model."""
    if rows.amplitude is None:
        _require(~rows.forced, "displacement", "amplitude")
    if rows.drive is None:
        _require(rows.forced, "force", "drive")
    if not any(element.has_harmonic(k) for element in model.elements for k in rows.orders):
        raise DataError(
            f"the rows hold the harmonics {', '.join(map(str, rows.orders))}, and no element of "
            f"{model!r} has any of them; give odd ones as well, or use a law that is asymmetric"
        )
    higher = rows.of_displacement
    if higher.any() and rows.quantity != "receptance":
        row = int(np.argmax(higher))
        raise DataError(
            f"row {row} is force-controlled and holds harmonic {rows.harmonic[row]} of the force, "
            "which is a sine there: give harmonics of the displacement, X_k/F_1, in a table of "
            f"receptance, leave such rows out, or say {argument('controlled', 'displacement')} if "
            "the measured amplitude is to be used"
        )
    without_fundamental = higher & (np.atleast_2d(rows.fundamental) < 0).any(axis=0)
    if without_fundamental.any():
        row = int(np.argmax(without_fundamental))
        raise DataError(
            f"row {row} is harmonic {rows.harmonic[row]} of the displacement, but no row holds the "
            "fundamental of the same frequency and drive; add it"
        )


def _fundamental(rows: Rows, response: ComplexArray) -> ComplexArray:
    """Return the responses, those of the fundamental for higher harmonics of the displacement."""
    if not rows.of_displacement.any():
        return response
    return np.where(rows.of_displacement, rows.of_fundamental(response), response)


def _rows_by_control(rows: Rows) -> Iterator[tuple[slice | IntArray, bool]]:
    """Yield the displacement-controlled and the force-controlled rows, each with their kind."""
    kinds = np.unique(rows.forced).tolist()
    for forced in kinds:
        yield slice(None) if len(kinds) == 1 else np.flatnonzero(rows.forced == forced), forced


def _require(rows: BoolArray, controlled: str, name: str) -> None:
    if rows.any():
        uncontrolled = {"displacement": "force", "force": "displacement"}[controlled]
        raise DataError(
            f"row {int(np.argmax(rows))} is {controlled}-controlled, but the data have no {name}; "
            f"give it, or say {argument('controlled', uncontrolled)} if the laboratory held the "
            f"{uncontrolled}"
        )


def _measured_amplitude(rows: Rows, operator: ComplexArray, exponent: int) -> FloatArray:
    if rows.amplitude is not None:
        return rows.amplitude
    assert rows.drive is not None
    with np.errstate(divide="ignore"):
        response = _fundamental(rows, rows.response)
        return np.asarray(rows.drive / np.abs(response / operator) ** exponent)

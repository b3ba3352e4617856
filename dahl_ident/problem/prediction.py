"""From parameters to the response that a table holds, with exact derivatives.

The model gives the dynamic stiffness Z_k(A, omega) = F_k/X_1. From it follow, with the sensors'
factor g (see :mod:`dahl_ident.sensors`), all six quantities:

    R = (j omega)^p (g Z)^q,    q = 1 or -1,  p from -2 to 2.

Rows whose displacement was controlled take the measured amplitude as A: an explicit model. Rows
whose force was controlled take the measured drive u_0, and A solves A |Z(A, omega)| = u_0; its
derivatives come from the implicit function theorem,

    d ln A = (d ln u_0 - Re(dZ/Z)) / (1 + Re(A Z_A/Z)).

The measured amplitude of such a row serves only to choose among several solutions.

That balance assumes a sinusoidal displacement. Where the model has an equation of motion, and
unless the describing function was asked for, rows whose force was controlled are predicted by the
exact steady motion instead (:mod:`dahl_ident.problem.steady_rows`).
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
from dahl_ident.elements import Model, Parameter
from dahl_ident.elements.driven_motion import Shooting
from dahl_ident.elements.facts import Sine
from dahl_ident.errors import DataError, argument
from dahl_ident.problem.space import Space
from dahl_ident.problem.steady_rows import SteadyRows
from dahl_ident.problem.stiffness import StiffnessData
from dahl_ident.sensors import Sensors, measured_stiffness_factor
from dahl_ident.units import DEFINITIONS, power_of_s

_NONE: ComplexArray = np.zeros((), dtype=np.complex128)


class Prediction(NamedTuple):
    """The response R, its derivatives with respect to theta, and to ln A (explicit rows)."""

    value: ComplexArray
    changes: list[ComplexArray]
    by_ln_amplitude: ComplexArray

    @property
    def arrays(self) -> list[ComplexArray]:
        """The response, and its derivatives with respect to ln A and to theta."""
        return [self.value, self.by_ln_amplitude, *self.changes]

    @classmethod
    def of(cls, arrays: list[ComplexArray]) -> Prediction:
        """Return the prediction with these `arrays`."""
        return cls(arrays[0], arrays[2:], arrays[1])


class Nearby:
    """The prediction near a point: that of the describing function, corrected to the exact one.

    The logarithm of the ratio of both is taken as linear in the search coordinates and in the
    logarithm of the drive. The error is of second order in the distance, and small, because only
    the correction is linearized. It costs as much as the describing function. Harmonics of the
    displacement, which the describing function does not have, are taken as linear.
    """

    def __init__(self, exact: Predictor, approximate: Predictor, theta: FloatArray) -> None:
        self._approximate, self._theta = approximate, theta
        at, near = exact(theta), approximate(theta)
        self._alone = alone = exact.rows.of_displacement
        self._correction = np.where(alone, at.value, np.log(at.value / near.value))
        self._slopes = [
            np.where(alone, a, a / at.value - b / near.value)
            for a, b in zip(at.changes, near.changes, strict=True)
        ]
        level = at.by_ln_amplitude / at.value - near.by_ln_amplitude / near.value
        level = np.where(alone, at.by_ln_amplitude, level)
        self._by_level = np.where(exact.rows.forced, level, 0.0)

    def __call__(
        self,
        theta: FloatArray,
        *,
        derivatives: int = 2,
        amplitude_error: FloatArray | None = None,
    ) -> Prediction:
        """Return the prediction, as a predictor does."""
        near = self._approximate(theta, derivatives=derivatives, amplitude_error=amplitude_error)
        alone, change = self._alone, self._correction
        for place, slope in enumerate(self._slopes):
            change = change + slope * (theta[..., place, None] - self._theta[place])
        if amplitude_error is not None:
            change = change - self._by_level * amplitude_error
        with np.errstate(over="ignore", invalid="ignore"):
            factor = np.exp(change)
            value = np.where(alone, change, near.value * factor)
            size = np.where(alone, 1.0, value)
            changes = [
                np.where(alone, 0.0, d * factor) + size * slope
                for d, slope in zip(near.changes, self._slopes, strict=False)
            ]
            level = near.by_ln_amplitude
            if derivatives:
                level = np.where(alone, 0.0, level * factor) + size * self._by_level
        return Prediction(value, changes, level)

    def as_stiffness(
        self, weights: FloatArray, predicted: ComplexArray | None = None
    ) -> StiffnessData:
        """Return the data as dynamic stiffness."""
        return self._approximate.as_stiffness(weights, predicted)


@dataclass(frozen=True)
class _Group:
    """Rows that are computed together, with all their harmonics; `operator` is (j omega)^p."""

    rows: slice | IntArray
    harmonic: NDArray[np.int64]
    forced: bool
    omega: FloatArray
    operator: ComplexArray
    amplitude: FloatArray
    drive: FloatArray | None
    steady: SteadyRows | None
    """Steady motions of rows that are predicted by these."""

    @cached_property
    def orders(self) -> int | NDArray[np.int64]:
        """The harmonic of each row, or that of all."""
        first = int(self.harmonic[0])
        return first if (self.harmonic == first).all() else self.harmonic


class Predictor:
    """Prediction of a model with its sensors for the operating points of `rows`.

    `shooting` solves for the exact steady motion of rows whose force was controlled; without it
    the describing function does. It starts from `orbits`, which are kept up to date.
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
        self._neutral = sensors.are_exact
        names = space.names
        self._slots = [_slot(p, names) for p in (*model.parameters, *sensors.parameters)]
        self.rows = rows
        _check(rows, self._model)
        power, self._exponent = DEFINITIONS[rows.quantity]
        self._operator = power_of_s(rows.omega, power)
        self._guess = _measured_amplitude(rows, self._operator, self._exponent)
        self._groups = [
            _Group(
                part,
                rows.harmonic[part],
                forced,
                rows.omega[..., part],
                self._operator[..., part],
                self._guess[..., part],
                None if rows.drive is None else rows.drive[..., part],
                self._steady_rows(part) if forced else None,
            )
            for part, forced in _parts(rows)
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
        every = np.arange(rows.n)
        first = np.atleast_2d(np.where(rows.of_displacement, rows.fundamental, every))[0]
        return SteadyRows(
            self._model, self._shooting, drive[..., part], omega[..., part], measured[..., part],
            rows.harmonic[part], np.searchsorted(every[part], first[part]), self._orbits,
        )  # fmt: skip

    def as_stiffness(
        self, weights: FloatArray, predicted: ComplexArray | None = None
    ) -> StiffnessData:
        """Return the data as dynamic stiffness; `weights` are those of the response.

        With `predicted` responses in place of the measured ones, driven amplitudes are theirs too.
        A harmonic of the displacement stands for its fundamental, without a weight.
        """
        rows = self.rows
        response = _fundamental(rows, rows.response if predicted is None else predicted)
        harmonic = np.where(rows.of_displacement, 1, rows.harmonic)
        weights = np.where(rows.of_displacement, 0.0, weights)
        ratio = response / self._operator
        Z = ratio if self._exponent == 1 else 1.0 / ratio
        amplitude = self._guess
        if predicted is not None and rows.drive is not None:
            amplitude = np.where(rows.forced, rows.drive / np.abs(Z), amplitude)
        if not self._neutral:
            starts = [np.asarray(p.value) for p in self._sensors.parameters]
            Z = Z / measured_stiffness_factor(starts, rows.omega, harmonic)
            amplitude = amplitude / starts[1]
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

        With as many `derivatives` as are asked for: 0 none, 1 that with respect to ln A, 2 all.
        `amplitude_error` is the error of ln A, or of ln of the drive where that is controlled:
        the true one is the measured one over its exponential.
        """
        values = self._values(theta)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            parts = [
                self._predict(group, values, derivatives, amplitude_error) for group in self._groups
            ]
        if len(parts) == 1:
            return parts[0]
        shape = np.broadcast_shapes((*theta.shape[:-1], 1), self.rows.response.shape)
        whole = [np.empty(shape, dtype=np.complex128) for _ in parts[0].arrays]
        for group, part in zip(self._groups, parts, strict=True):
            for target, piece in zip(whole, part.arrays, strict=True):
                target[..., group.rows] = piece
        return Prediction.of(whole)

    def _values(self, theta: FloatArray) -> list[FloatArray]:
        """Return the value of every parameter, those of the three of the sensors last."""
        columns = self._space.to_values(theta)[..., None]
        return [constant if i is None else columns[..., i, :] for i, constant in self._slots]

    def _predict(
        self,
        group: _Group,
        values: list[FloatArray],
        derivatives: int,
        amplitude_error: FloatArray | None,
    ) -> Prediction:
        if group.steady is None:
            return self._predict_sine(group, values, derivatives, amplitude_error)
        linear = group.steady.is_linear(values[:-3])[..., None]
        if linear.all():
            return self._predict_sine(group, values, derivatives, amplitude_error)
        if not linear.any():
            return self._predict_steady(group, group.steady, values, derivatives, amplitude_error)
        moving = [*(np.where(linear, np.nan, v) for v in values[:-3]), *values[-3:]]
        exact = self._predict_steady(group, group.steady, moving, derivatives, amplitude_error)
        sine = self._predict_sine(group, values, derivatives, amplitude_error)
        pairs = zip(sine.arrays, exact.arrays, strict=True)
        return Prediction.of([np.where(linear, a, b) for a, b in pairs])

    def _predict_sine(
        self,
        group: _Group,
        values: list[FloatArray],
        derivatives: int,
        amplitude_error: FloatArray | None,
    ) -> Prediction:
        """Return the response by the describing function; it has no harmonics of the motion."""
        of_model, sensed = values[:-3], values[-3:]
        amplitude, exists = self._amplitude(group, of_model, sensed, amplitude_error)
        harmonic = 1 if group.forced else group.orders
        factor = group.operator * (group.harmonic == harmonic)
        if not self._neutral:
            sensor = measured_stiffness_factor(sensed, group.omega, group.harmonic)
            factor = factor * sensor**self._exponent
        if not derivatives:
            Z = self._model.stiffness(of_model, amplitude, group.omega, harmonic)
            return Prediction(factor * _where(exists, Z) ** self._exponent, [], _NONE)
        sine = Sine(amplitude, group.omega, harmonic)
        Z, by_amplitude, by_parameter = self._model.settled(of_model, sine, derivatives)
        Z = _where(exists, Z)
        by_ln_amplitude = amplitude * by_amplitude
        response = factor * Z if self._exponent == 1 else factor / Z
        slope = factor if self._exponent == 1 else -response / Z
        stretch = 1.0 / (1.0 + (by_ln_amplitude / Z).real) if group.forced else None
        changes = []
        for (index, _), value, d in zip(self._slots, of_model, by_parameter, strict=False):
            if index is None or derivatives < 2:
                continue
            change = d * value if self._space.positive[index] else d
            if stretch is not None:
                change = change - by_ln_amplitude * ((change / Z).real * stretch)
            changes.append(slope * change)
        by_level = slope * by_ln_amplitude * (1.0 if stretch is None else stretch)
        if not self._neutral and derivatives > 1:
            changes += self._sensor_changes(group, response, by_level)
        return Prediction(response, changes, by_level)

    def _predict_steady(
        self,
        group: _Group,
        rows: SteadyRows,
        values: list[FloatArray],
        derivatives: int,
        error: FloatArray | None,
    ) -> Prediction:
        """Return the response of the exact steady motion: R = (j omega)^p (g u_0/X_k)^q."""
        of_model, sensed = values[:-3], values[-3:]
        factor, drive = group.operator, self._true_drive(group, sensed, error)
        if not self._neutral:
            sensor = measured_stiffness_factor(sensed, group.omega, group.harmonic)
            factor = factor * sensor**self._exponent
        free = [i for i, (index, _) in enumerate(self._slots[:-3]) if index is not None]
        motion = rows.at(of_model, drive, free if derivatives > 1 else [])
        response = factor * (motion.displacement / drive) ** -self._exponent
        if not derivatives:
            return Prediction(response, [], _NONE)
        slope = factor / drive if self._exponent == -1 else -response / motion.displacement
        changes = []
        for place, i in enumerate(free if derivatives > 1 else []):
            positive = self._space.positive[self._slots[i][0]]
            change = motion.by_parameter[..., place]
            changes.append(slope * (change * of_model[i] if positive else change))
        by_level = slope * drive * motion.by_drive + self._exponent * response
        if not self._neutral and derivatives > 1:
            changes += self._sensor_changes(group, response, by_level)
        return Prediction(response, changes, by_level)

    def _true_drive(
        self, group: _Group, sensed: Sequence[FloatArray], error: FloatArray | None
    ) -> FloatArray:
        """Return the true drive of force-controlled rows."""
        assert group.drive is not None
        drive = group.drive / sensed[0]
        return drive if error is None else np.asarray(drive * np.exp(-error[..., group.rows]))

    def _sensor_changes(
        self, group: _Group, response: ComplexArray, direct: ComplexArray
    ) -> list[ComplexArray]:
        """Return dR/d(free sensor parameters); `direct` is dR/dln A or dR/dln u_0."""
        by_gain = self._exponent * response
        by_sensor = (
            by_gain - direct if group.forced else by_gain,
            -by_gain if group.forced else -by_gain - direct,
            1j * group.harmonic * group.omega * by_gain,
        )
        slots = self._slots[-3:]
        return [d for d, (index, _) in zip(by_sensor, slots, strict=True) if index is not None]

    def _amplitude(
        self,
        group: _Group,
        of_model: Sequence[FloatArray],
        sensed: Sequence[FloatArray],
        error: FloatArray | None,
    ) -> tuple[FloatArray, BoolArray | None]:
        """Return the true amplitude of each row, and where it exists; None if everywhere."""
        amplitude = group.amplitude if self._neutral else group.amplitude / sensed[1]
        if not group.forced:
            return amplitude if error is None else amplitude * np.exp(-error[..., group.rows]), None
        drive = self._true_drive(group, sensed, error)
        amplitude = solve(self._model, of_model, group.omega, drive, amplitude)
        exists = np.isfinite(amplitude)
        return (amplitude, None) if exists.all() else (np.where(exists, amplitude, 1.0), exists)


def _where(exists: BoolArray | None, Z: ComplexArray) -> ComplexArray:
    return Z if exists is None else np.where(exists, Z, np.nan)


def _slot(parameter: Parameter, names: tuple[str, ...]) -> tuple[int | None, FloatArray]:
    """Return where a parameter's value comes from: an index into theta, or a constant."""
    if parameter.free:
        return names.index(parameter.name), np.empty(0)
    return None, np.asarray(parameter.value)


def _check(rows: Rows, model: Model) -> None:
    """Check that every row can be predicted, and that some depend on the model."""
    if rows.amplitude is None:
        _require(~rows.forced, "displacement", "amplitude")
    if rows.drive is None:
        _require(rows.forced, "force", "drive")
    if not any(element.has_harmonic(k) for element in model.elements for k in rows.orders):
        raise DataError(
            f"the rows hold the harmonics {', '.join(map(str, rows.orders))}, and no element of "
            f"{model!r} has any of them; give odd ones as well, or use a law that is asymmetric"
        )
    bad = rows.of_displacement
    if bad.any() and rows.quantity != "receptance":
        row = int(np.argmax(bad))
        raise DataError(
            f"row {row} is force-controlled and holds harmonic {rows.harmonic[row]} of the force, "
            "which is a sine there: give harmonics of the displacement, X_k/F_1, in a table of "
            f"receptance, leave such rows out, or say {argument('controlled', 'displacement')} if "
            "the measured amplitude is to be used"
        )
    lost = bad & (np.atleast_2d(rows.fundamental) < 0).any(axis=0)
    if lost.any():
        row = int(np.argmax(lost))
        raise DataError(
            f"row {row} is harmonic {rows.harmonic[row]} of the displacement, but no row holds the "
            "fundamental of the same frequency and drive; add it"
        )


def _fundamental(rows: Rows, response: ComplexArray) -> ComplexArray:
    """Return the responses; rows of other harmonics of the displacement have the fundamental's."""
    if not rows.of_displacement.any():
        return response
    return np.where(rows.of_displacement, rows.of_fundamental(response), response)


def _parts(rows: Rows) -> Iterator[tuple[slice | IntArray, bool]]:
    """Yield rows, and whether force-controlled, for each kind of row."""
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

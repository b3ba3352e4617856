"""From parameters to the response that a table holds, with exact derivatives.

The model gives the dynamic stiffness Z_k(A, omega) = F_k/X_1. From it follow, with the sensors'
factor g (see :mod:`dahl_ident.sensors`), all six quantities:

    R = (j omega)^p (g Z)^q,    q = 1 or -1,  p from -2 to 2.

Rows whose displacement was controlled take the measured amplitude as A: an explicit model. Rows
whose force was controlled take the measured drive u_0, and A solves A |Z(A, omega)| = u_0; its
derivatives come from the implicit function theorem,

    d ln A = (d ln u_0 - Re(dZ/Z)) / (1 + Re(A Z_A/Z)).

The measured amplitude of such a row serves only to choose among several solutions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident import steady_state
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.quantities import DEFINITIONS, power_of_s
from dahl_ident.data.rows import Rows
from dahl_ident.elements import Model, Parameter
from dahl_ident.errors import DataError
from dahl_ident.problem.coordinates import Coordinates
from dahl_ident.problem.stiffness import StiffnessData
from dahl_ident.sensors import Sensors, measured_stiffness_factor

_NONE: ComplexArray = np.zeros((), dtype=np.complex128)


class Prediction(NamedTuple):
    """The response R with its derivatives by search coordinate and by ln A (explicit rows)."""

    value: ComplexArray
    changes: list[ComplexArray]
    by_ln_amplitude: ComplexArray


@dataclass(frozen=True)
class _Group:
    """Rows that are computed together; `operator` is (j omega)^p."""

    rows: slice | NDArray[np.intp]
    harmonic: int
    forced: bool
    omega: FloatArray
    operator: ComplexArray
    amplitude: FloatArray
    drive: FloatArray | None


class Predictor:
    """Prediction of a model with its sensors for the operating points of `rows`."""

    def __init__(
        self, model: Model, sensors: Sensors, coordinates: Coordinates, rows: Rows
    ) -> None:
        self._model, self._sensors, self._coordinates = model, sensors, coordinates
        self._neutral = sensors.are_exact
        names = coordinates.names
        self._slots = [_slot(p, names) for p in (*model.parameters, *sensors.parameters)]
        self._set_rows(rows)

    def _set_rows(self, rows: Rows) -> None:
        self._rows = rows
        _check(rows, self._model)
        power, self._exponent = DEFINITIONS[rows.quantity]
        self._operator = power_of_s(rows.omega, power)
        self._guess = _measured_amplitude(rows, self._operator, self._exponent)
        self._groups = [
            _Group(
                part,
                harmonic,
                forced,
                rows.omega[..., part],
                self._operator[..., part],
                self._guess[..., part],
                None if rows.drive is None else rows.drive[..., part],
            )
            for part, harmonic, forced in _parts(rows)
        ]

    def as_stiffness(
        self, weights: FloatArray, predicted: ComplexArray | None = None
    ) -> StiffnessData:
        """Return the data as dynamic stiffness; `weights` are those of the response.

        With `predicted` responses in place of the measured ones, driven amplitudes are theirs too.
        """
        rows = self._rows
        response = rows.response if predicted is None else predicted
        ratio = response / self._operator
        Z = ratio if self._exponent == 1 else 1.0 / ratio
        amplitude = self._guess
        if predicted is not None and rows.drive is not None:
            amplitude = np.where(rows.forced, rows.drive / np.abs(Z), amplitude)
        if not self._neutral:
            starts = [np.asarray(p.value) for p in self._sensors.parameters]
            Z = Z / measured_stiffness_factor(starts, rows.omega, rows.harmonic)
            amplitude = amplitude / starts[1]
        if rows.quantity != "dynamic_stiffness":
            weights = weights * np.abs(response / Z)
        return StiffnessData(Z, amplitude, rows.omega, rows.harmonic, rows.orders, weights)

    def __call__(
        self,
        theta: FloatArray,
        *,
        derivatives: bool = True,
        amplitude_error: FloatArray | None = None,
    ) -> Prediction:
        """Return the response and its derivatives at search coordinates, (P,) or (S, P).

        `amplitude_error` is the error of ln A, or of ln of the drive where that is controlled:
        the true one is the measured one over its exponential.
        """
        columns = self._coordinates.to_values(theta)[..., None]
        values = [
            constant if index is None else columns[..., index, :] for index, constant in self._slots
        ]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
            parts = [
                self._predict(group, values, derivatives, amplitude_error) for group in self._groups
            ]
        return parts[0] if len(parts) == 1 else self._merge(parts, theta)

    def _merge(self, parts: list[Prediction], theta: FloatArray) -> Prediction:
        shape = np.broadcast_shapes((*theta.shape[:-1], 1), self._rows.response.shape)
        whole = [np.empty(shape, dtype=np.complex128) for _ in range(2 + len(parts[0].changes))]
        for group, part in zip(self._groups, parts, strict=True):
            pieces = (part.value, part.by_ln_amplitude, *part.changes)
            for target, piece in zip(whole, pieces, strict=True):
                target[..., group.rows] = piece
        return Prediction(whole[0], whole[2:], whole[1])

    def _predict(
        self,
        group: _Group,
        values: list[FloatArray],
        derivatives: bool,
        amplitude_error: FloatArray | None,
    ) -> Prediction:
        own, sensed = values[:-3], values[-3:]
        amplitude, found = self._amplitude(group, own, sensed, amplitude_error)
        factor = group.operator
        if not self._neutral:
            sensor = measured_stiffness_factor(sensed, group.omega, group.harmonic)
            factor = factor * sensor**self._exponent
        if not derivatives:
            Z = self._model.stiffness(own, amplitude, group.omega, group.harmonic)
            return Prediction(factor * _where(found, Z) ** self._exponent, [], _NONE)
        Z, by_amplitude, by_parameter = self._model.stiffness_gradient(
            own, amplitude, group.omega, group.harmonic
        )
        Z = _where(found, Z)
        by_ln_amplitude = amplitude * by_amplitude
        response = factor * Z if self._exponent == 1 else factor / Z
        slope = factor if self._exponent == 1 else -response / Z
        stretch = 1.0 / (1.0 + (by_ln_amplitude / Z).real) if group.forced else None
        changes = []
        for (index, _), value, d in zip(self._slots, own, by_parameter, strict=False):
            if index is None:
                continue
            change = d * value if self._coordinates.positive[index] else d
            if stretch is not None:
                change = change - by_ln_amplitude * ((change / Z).real * stretch)
            changes.append(slope * change)
        by_level = slope * by_ln_amplitude * (1.0 if stretch is None else stretch)
        if not self._neutral:
            changes += self._sensor_changes(group, response, by_level)
        return Prediction(response, changes, by_level)

    def _sensor_changes(
        self, group: _Group, response: ComplexArray, direct: ComplexArray
    ) -> list[ComplexArray]:
        """Return dR by the free sensor parameters; `direct` is dR/dln A or dR/dln u_0."""
        own = self._exponent * response
        by_sensor = (
            own - direct if group.forced else own,
            -own if group.forced else -own - direct,
            1j * group.harmonic * group.omega * own,
        )
        slots = self._slots[-3:]
        return [d for d, (index, _) in zip(by_sensor, slots, strict=True) if index is not None]

    def _amplitude(
        self,
        group: _Group,
        own: Sequence[FloatArray],
        sensed: Sequence[FloatArray],
        error: FloatArray | None,
    ) -> tuple[FloatArray, NDArray[np.bool_] | None]:
        """Return the true amplitude of each row, and where there is one unless everywhere."""
        amplitude = group.amplitude if self._neutral else group.amplitude / sensed[1]
        if not group.forced:
            return amplitude if error is None else amplitude * np.exp(-error[..., group.rows]), None
        assert group.drive is not None
        drive = group.drive / sensed[0]
        if error is not None:
            drive = drive * np.exp(-error[..., group.rows])
        amplitude = steady_state.solve(self._model, own, group.omega, drive, amplitude)
        found = np.isfinite(amplitude)
        return (amplitude, None) if found.all() else (np.where(found, amplitude, 1.0), found)


def _where(found: NDArray[np.bool_] | None, Z: ComplexArray) -> ComplexArray:
    return Z if found is None else np.where(found, Z, np.nan)


def _slot(parameter: Parameter, names: tuple[str, ...]) -> tuple[int | None, FloatArray]:
    """Return where a parameter's value comes from: an index into theta, or a constant."""
    if parameter.free:
        return names.index(parameter.name), np.empty(0)
    return None, np.asarray(parameter.value)


def _check(rows: Rows, model: Model) -> None:
    """Check that every row can be predicted, and that some say something about the model."""
    if rows.amplitude is None:
        _require(~rows.forced, "displacement", "amplitude")
    if rows.drive is None:
        _require(rows.forced, "force", "drive")
    if not any(element.answers(k) for element in model.elements for k in rows.orders):
        raise DataError(
            f"the rows hold the harmonics {', '.join(map(str, rows.orders))}, and no element of "
            f"{model!r} has any of them; give odd ones as well, or use a law that is asymmetric"
        )
    bad = rows.forced & (rows.harmonic != 1)
    if rows.orders != (1,) and bad.any():
        row = int(np.argmax(bad))
        raise DataError(
            f"row {row} is force-controlled and holds harmonic {rows.harmonic[row]}; the steady "
            "state of a driven plant is solved for its fundamental only: leave such rows out, or "
            "say controlled='displacement' if the measured amplitude is to be used"
        )


def _parts(rows: Rows) -> Iterator[tuple[slice | NDArray[np.intp], int, bool]]:
    """Yield rows, harmonic and whether force-controlled for each kind of row."""
    forced = int(rows.forced.sum())
    if len(rows.orders) == 1 and forced in (0, rows.n):
        yield slice(None), rows.orders[0], forced > 0
        return
    for k, force in sorted({*zip(rows.harmonic.tolist(), rows.forced.tolist(), strict=True)}):
        yield np.flatnonzero((rows.harmonic == k) & (rows.forced == force)), k, force


def _require(rows: NDArray[np.bool_], controlled: str, name: str) -> None:
    if rows.any():
        other = {"displacement": "force", "force": "displacement"}[controlled]
        raise DataError(
            f"row {int(np.argmax(rows))} is {controlled}-controlled, but the data have no {name}; "
            f"give it, or say controlled={other!r} if the laboratory held the {other}"
        )


def _measured_amplitude(rows: Rows, operator: ComplexArray, exponent: int) -> FloatArray:
    if rows.amplitude is not None:
        return rows.amplitude
    assert rows.drive is not None
    with np.errstate(divide="ignore"):
        return np.asarray(rows.drive / np.abs(rows.response / operator) ** exponent)

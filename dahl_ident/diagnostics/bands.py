"""How far a fitted curve is known: bands of a predicted response, and quantities derived from it.

First order: with d = dR/dtheta at the estimate and C its covariance, Re R and Im R have the
covariance Re(d) C Re(d)', Re(d) C Im(d)', Im(d) C Im(d)', and d(ln R) = dR/R gives ln gain and
phase together. No half of a complex number is taken for the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import ComplexArray, FloatArray, positive_array
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.information import Information
from dahl_ident.diagnostics.levels import checked_levels, thresholds
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.elements import Dahl
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.fitting import Optimum
from dahl_ident.problem import Problem
from dahl_ident.units import shown_unit


@dataclass(frozen=True)
class ResponseBand:
    """A predicted response with its standard deviations and bands.

    Attributes
    ----------
    response : ndarray of complex, shape (n,)
        At the estimate.
    real_std, imag_std : ndarray, shape (n,)
        Standard deviations of real and imaginary part, in the response's unit.
    log_gain_std, phase_std : ndarray, shape (n,)
        Standard deviations of ln gain and of the phase, rad.
    """

    response: ComplexArray
    real_std: FloatArray
    imag_std: FloatArray
    log_gain_std: FloatArray
    phase_std: FloatArray
    _optimum: Optimum

    def gain(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the gain at each point."""
        factor = np.exp(self._threshold(level) * self.log_gain_std)
        size = np.abs(self.response)
        return size / factor, size * factor

    def phase(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the phase at each point, rad."""
        width = self._threshold(level) * self.phase_std
        centre = np.angle(self.response)
        return centre - width, centre + width

    def real(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the real part at each point."""
        width = self._threshold(level) * self.real_std
        return self.response.real - width, self.response.real + width

    def imag(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the imaginary part at each point."""
        width = self._threshold(level) * self.imag_std
        return self.response.imag - width, self.response.imag + width

    def _threshold(self, level: float) -> float:
        return float(thresholds(self._optimum, checked_levels([level]))[0])


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
) -> ResponseBand:
    """Return the measured response that the estimate predicts, sensors included."""
    held = drive if amplitude is None else amplitude
    if held is None or (amplitude is not None and drive is not None):
        raise ValidationError("give either amplitude (displacement controlled) or drive (force)")
    name = "drive" if amplitude is None else "amplitude"
    f = np.atleast_1d(positive_array(frequency_hz, "frequency_hz"))
    given = np.atleast_1d(positive_array(held, name))
    try:
        f, given = np.broadcast_arrays(f, given)
    except ValueError:
        raise ValidationError(
            f"frequency_hz has shape {f.shape} and {name} {given.shape}; expected one shape, or "
            "one number for all"
        ) from None
    problem = optimum.problem
    grid = FrequencyResponse(
        f,
        np.ones(f.shape),
        None if amplitude is None else given,
        None if drive is None else given,
        controlled="displacement" if drive is None else "force",
        quantity=problem.data.quantity if quantity is None else quantity,
        motion=problem.data.motion,
    )
    there = Problem(grid, problem.model, noise="absolute", sensors=problem.sensors)
    theta = optimum.theta
    return _band(optimum, there.predict(theta), there.prediction_jacobian(theta))


def describing_function_band(optimum: Optimum, amplitude: ArrayLike) -> ResponseBand:
    """Return N(A) of all Dahl elements together, whatever stands beside them."""
    A = positive_array(amplitude, "amplitude")
    return _band(optimum, *friction_and_slopes(optimum, A))


def friction_and_slopes(optimum: Optimum, A: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return N(A) of the friction, and its derivatives by theta in a last axis."""
    values, names = parameter_values(optimum), optimum.names
    slopes = dict(zip(names, optimum.problem.value_slopes(optimum.theta), strict=True))
    N = np.zeros(A.shape, dtype=np.complex128)
    by = np.zeros((*A.shape, len(names)), dtype=np.complex128)
    elements = [e for e in optimum.problem.model.elements if isinstance(e, Dahl)]
    if not elements:
        raise ModelError("the model has no Dahl element, so there is no friction to describe")
    for element in elements:
        own = [np.asarray(values[p.name]) for p in element.parameters]
        part = element.stiffness_gradient(own, A, np.zeros(()), 1)
        N += part.value
        for parameter, slope in zip(element.parameters, part.by_parameter, strict=True):
            if parameter.free:
                by[..., names.index(parameter.name)] += slope * slopes[parameter.name]
    return N, by


def derived(
    optimum: Optimum, amplitudes: Sequence[float], frequency_hz: float | None
) -> Iterator[DerivedQuantity]:
    """Yield x_c of each Dahl element, and at each amplitude stiffness, loss and damping."""
    information, motion = Information(optimum), optimum.problem.data.motion
    yield from _characteristic_displacements(optimum, information)
    A = positive_array(amplitudes, "amplitudes").ravel()
    if not A.size:
        return
    N, by = friction_and_slopes(optimum, A)
    loss = np.pi * A**2
    rows = [
        ("energy lost in a cycle", "J", loss * N.imag, loss[:, None] * by.imag),
        ("equivalent stiffness", shown_unit("N/m", motion), N.real, by.real),
    ]
    if frequency_hz is not None:
        omega = 2.0 * np.pi * float(positive_array(frequency_hz, "frequency_hz"))
        unit = shown_unit("N s/m", motion)
        rows.append(("equivalent damping", unit, N.imag / omega, by.imag / omega))
    for name, unit, value, slope in rows:
        error = information.std(slope)
        for a, v, e in zip(A.tolist(), value.tolist(), error.tolist(), strict=True):
            yield DerivedQuantity(name, unit, a, v, e)


def _characteristic_displacements(
    optimum: Optimum, information: Information
) -> Iterator[DerivedQuantity]:
    values, names = parameter_values(optimum), optimum.names
    for element in optimum.problem.model.elements:
        if not isinstance(element, Dahl):
            continue
        f, s = element.parameters[:2]
        direction = np.zeros(len(names))
        for parameter, sign in ((f, 1.0), (s, -1.0)):
            if parameter.free:
                direction[names.index(parameter.name)] = sign
        x_c = values[f.name] / values[s.name]
        error = x_c * float(information.std(direction))
        if optimum.status.at_infinity and {f.name, s.name} & set(names):
            ends = dict(zip(names, optimum.values.tolist(), strict=True))
            if not all(np.isfinite(ends.get(p.name, 1.0)) for p in (f, s)):
                continue
        label = "x_c" if element.name is None else f"{element.name}_x_c"
        unit = shown_unit("m", optimum.problem.data.motion)
        yield DerivedQuantity(label, unit, None, x_c, error)


def _band(optimum: Optimum, R: ComplexArray, by: ComplexArray) -> ResponseBand:
    information = Information(optimum)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = by / R[..., None]
    return ResponseBand(
        R,
        information.std(by.real),
        information.std(by.imag),
        information.std(relative.real),
        information.std(relative.imag),
        optimum,
    )

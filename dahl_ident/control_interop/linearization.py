"""The equivalent linear plant of a plant with friction at one amplitude, and its margins.

At the amplitude A and angular frequency omega_0 friction acts as a spring Re N(A) in parallel with
a damper Im N(A)/omega_0. The damper is exact only at omega_0, because friction dissipates the same
energy per cycle at every frequency. Margins need no such approximation: they follow from the
frequency response at constant amplitude, where the loop gain is C(j omega)/(L(omega) + N(A)).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    array_between,
    finite_array,
    non_negative_array,
    positive_array,
    positive_number,
)
from dahl_ident.control_interop.linear_part import controller_response, rational_stiffness, split
from dahl_ident.elements.element import Element, as_model
from dahl_ident.elements.rational import Rational
from dahl_ident.errors import ValidationError


def equivalent_plant(plant: Element, amplitude: float, frequency_hz: float) -> Any:
    """Return X/F = 1/(L(s) + Re N(A) + s Im N(A)/omega_0), a plant without friction.

    Parameters
    ----------
    plant : Element
        Friction and linear elements, with a value for every parameter.
    amplitude : float
        Zero-to-peak displacement A > 0, m.
    frequency_hz : float
        Frequency at which the equivalent damper is exact, Hz, > 0; for example the crossover of the
        loop.

    Returns
    -------
    control.TransferFunction
        Receptance, m/N; ``control.ss`` turns it into a StateSpace.

    Raises
    ------
    ModelError
        If a parameter has no value, the plant lacks friction or linear elements, or a linear
        system is discrete or an FRD.
    ValidationError
        If `amplitude` or `frequency_hz` is not one number above zero.

    Examples
    --------
    >>> from dahl_ident import Dahl, Mass
    >>> from dahl_ident.control_interop import equivalent_plant
    >>> P = equivalent_plant(Dahl(f_max=1.0, sigma=1.0) + Mass(2.0), 1.0, 0.5)
    >>> P.den[0][0].round(4).tolist()
    [2.0, 0.0966, 0.7325]
    """
    friction, linear = split(plant)
    A = positive_number(amplitude, "amplitude")
    omega = 2.0 * np.pi * positive_number(frequency_hz, "frequency_hz")
    N = complex(friction.dynamic_stiffness(A, omega))
    Z = rational_stiffness(linear) + Rational(np.array([N.imag / omega, N.real]), np.ones(1))
    return control.tf(Z.denominator, Z.numerator)


@dataclass(frozen=True)
class LoopMargins:
    """Margins of a loop against the amplitude of its displacement.

    Attributes
    ----------
    amplitude : ndarray, shape (m,)
        Zero-to-peak displacement, m.
    gain_margin : ndarray, shape (..., m)
        Factor nearest to 1 by which the loop gain reaches -1; infinite if there is none.
    phase_margin_deg : ndarray, shape (..., m)
        Rotation nearest to 0 by which it reaches -1, degrees; infinite if there is none.
    modulus_margin : ndarray, shape (..., m)
        Smallest distance of the loop gain from -1, the inverse of the peak sensitivity.
    """

    amplitude: FloatArray
    gain_margin: FloatArray
    phase_margin_deg: FloatArray
    modulus_margin: FloatArray

    def band(self, name: str, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Return the central interval of a margin over the draws, at every amplitude.

        `name` is that of an attribute. Returns the lower and the upper quantile, each (m,);
        raises ValidationError if the margins hold no draws.

        Examples
        --------
        >>> one = np.ones((5, 3))
        >>> low, high = LoopMargins(np.ones(3), one, one, one).band("gain_margin")
        >>> low.tolist()
        [1.0, 1.0, 1.0]
        """
        values: FloatArray = getattr(self, name)
        if values.ndim < 2:
            raise ValidationError(f"{name} holds no draws; give draws= to loop_margins")
        tail = 0.5 * (1.0 - float(array_between(probability, "probability", 0.0, 1.0)))
        flat = values.reshape(-1, self.amplitude.size)
        # inverted_cdf returns one of the values, infinite ones included
        low, high = np.quantile(flat, [tail, 1.0 - tail], axis=0, method="inverted_cdf")
        return low, high

    def plot(self, ax: Any = None) -> tuple[Any, Any]:
        """Draw gain and phase margin against amplitude, with bands where there are draws.

        `ax` is a pair of Axes, for gain and phase, new ones by default; it is returned.
        """
        from dahl_ident.plots import plot_margins

        if self.gain_margin.ndim == 1:
            return plot_margins(self.amplitude, self.gain_margin, self.phase_margin_deg, ax=ax)
        (gain, _), (phase, _) = self.band("gain_margin", 0.0), self.band("phase_margin_deg", 0.0)
        bands = {"gain_band": self.band("gain_margin"), "phase_band": self.band("phase_margin_deg")}
        return plot_margins(self.amplitude, gain, phase, ax=ax, **bands)


def loop_margins(
    plant: Element,
    controller: Any,
    amplitude: ArrayLike,
    *,
    frequency_hz: ArrayLike,
    draws: Mapping[str, ArrayLike] | None = None,
) -> LoopMargins:
    """Return the margins of C(j omega)/Z(A, omega) against the displacement amplitude.

    Parameters
    ----------
    plant : Element
        Friction and linear elements.
    controller : control.TransferFunction, control.StateSpace or control.FRD
        C, force over displacement error, in negative feedback.
    amplitude : array_like, shape (m,)
        Zero-to-peak displacements A >= 0, m.
    frequency_hz : array_like, shape (n,)
        Rising frequencies, Hz, dense enough to follow the loop gain; between them its logarithm
        is interpolated linearly.
    draws : mapping of str to array_like, shape (S,), optional
        Parameter vectors, by parameter name: columns of a posterior.

    Returns
    -------
    LoopMargins
        Shape (m,), or (S, m) with draws.

    Raises
    ------
    ModelError
        If a parameter has no value, or a name in `draws` is unknown.
    ValidationError
        If an amplitude is negative, frequencies do not rise, or draws differ in length.

    Notes
    -----
    A margin is the distance of the loop gain from -1 at one amplitude. It does not show whether the
    loop is stable; :func:`limit_cycles` finds the amplitudes at which the loop oscillates.

    Examples
    --------
    >>> import control
    >>> from dahl_ident import Dahl, Mass
    >>> from dahl_ident.control_interop import loop_margins
    >>> pd = control.tf([20.0, 100.0], [1.0])
    >>> f = np.geomspace(0.1, 100.0, 2000)
    >>> plant = Dahl(f_max=1.0, sigma=1e3) + Mass(1.0)
    >>> loop_margins(plant, pd, [1e-4, 1.0], frequency_hz=f).phase_margin_deg.round(1).tolist()
    [86.2, 76.5]
    """
    A = np.atleast_1d(non_negative_array(amplitude, "amplitude"))
    f = positive_array(frequency_hz, "frequency_hz")
    if A.ndim != 1 or f.ndim != 1 or np.any(np.diff(f) <= 0.0):
        raise ValidationError(
            f"amplitude has shape {A.shape} and frequency_hz {f.shape}; expected one dimension "
            "each, frequencies rising"
        )
    omega = 2.0 * np.pi * f
    C = controller_response(controller, omega)
    model, values = _with_draws(plant, draws)
    Z = model.stiffness(values, A[:, None], omega)
    shape = np.broadcast_shapes(Z.shape, (A.size, f.size))
    gain, phase, modulus = _margins(np.broadcast_to(C / Z, shape))
    return LoopMargins(A, gain, phase, modulus)


def _with_draws(
    plant: Element, draws: Mapping[str, ArrayLike] | None
) -> tuple[Element, list[FloatArray]]:
    """Return the model and its parameter values, those in `draws` with shape (S, 1, 1)."""
    model = as_model(plant)
    if draws is None:
        return model, list(model.known_values())
    if not len(draws):
        raise ValidationError("draws is empty; expected samples of at least one parameter")
    columns = {name: finite_array(draws[name], name) for name in draws}
    if len({c.shape for c in columns.values()}) != 1 or next(iter(columns.values())).ndim != 1:
        shapes = ", ".join(f"{name} {c.shape}" for name, c in columns.items())
        raise ValidationError(f"draws have the shapes {shapes}; expected one length for all")
    model = model.with_values({name: float(c[0]) for name, c in columns.items()})
    values = [
        columns[p.name][:, None, None] if p.name in columns else value
        for p, value in zip(model.parameters, model.known_values(), strict=True)
    ]
    return model, values


def _margins(loop: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return gain margin, phase margin in degrees and modulus margin along the last axis."""
    size, angle = np.log(np.abs(loop)), np.angle(-loop)
    turn = np.angle(loop[..., 1:] / loop[..., :-1])
    no_wrap = np.abs(np.diff(angle)) < np.pi
    log_gain_at_180 = _at_zeros(angle, -size, -np.diff(size), no_wrap)
    angle_at_one = _at_zeros(size, angle, turn, np.ones_like(no_wrap))
    crosses = np.isfinite(angle_at_one)
    angle_at_one[crosses] = np.angle(np.exp(1j * angle_at_one[crosses]))
    gain = np.exp(_nearest_to_zero(log_gain_at_180))
    phase = np.degrees(_nearest_to_zero(angle_at_one))
    return gain, phase, np.min(np.abs(1.0 + loop), axis=-1)


def _at_zeros(
    curve: FloatArray, value: FloatArray, step: FloatArray, valid: BoolArray
) -> FloatArray:
    """Return `value` where `curve` crosses zero within an interval, infinity elsewhere."""
    before, after = curve[..., :-1], curve[..., 1:]
    crosses = valid & ((before < 0.0) != (after < 0.0))
    fraction = before / np.where(crosses, before - after, 1.0)
    return np.where(crosses, value[..., :-1] + fraction * step, np.inf)


def _nearest_to_zero(values: FloatArray) -> FloatArray:
    nearest = np.argmin(np.abs(values), axis=-1)
    return np.asarray(np.take_along_axis(values, nearest[..., None], axis=-1)[..., 0])

"""Plants with friction in python-control: linear at one amplitude, or with a nonlinearity.

At the amplitude A and angular frequency omega_0 friction acts as a spring Re N(A) in parallel with
a damper Im N(A)/omega_0. The damper is exact only at omega_0, because friction dissipates the same
energy per cycle at every frequency. Margins need no such approximation: they follow from the
frequency response at constant amplitude, where the loop gain is C(j omega)/(L(omega) + N(A)).

With F = C (r - x) a closed loop obeys (Z(A) + C) X = C R. It is therefore equivalent to the plant
with the controller as an additional parallel element, ``LinearSystem(C,
quantity="dynamic_stiffness")``, driven by the force C R, and can be identified like any other
force-driven plant. Dividing the response by the controller instead would give data in which neither
the force nor the displacement amplitude was controlled.
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
    broadcast_shape,
    finite_array,
    finite_number,
    non_negative_array,
    positive_array,
    positive_number,
)
from dahl_ident.data import FrequencyResponse
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.elements.facts import Sine
from dahl_ident.elements.linear_system import LinearSystem, check_system
from dahl_ident.elements.rational import Rational
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.units import jacobian

_QUASI_STATIC = np.zeros(())  # frequency of friction that does not depend on it


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
        """Draw gain and phase margin against amplitude, with bands if there are draws.

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


def closed_loop_response(
    frequency_hz: ArrayLike,
    reference: ArrayLike,
    response: ArrayLike,
    controller: Any,
    *,
    covariance: ArrayLike | None = None,
) -> FrequencyResponse:
    """Return X/(C R) over the drive abs(C) r_0, from the closed loop's X/R.

    Parameters
    ----------
    frequency_hz : array_like, shape (n,)
        Hz, > 0.
    reference : array_like, shape (n,) or one number
        Zero-to-peak reference r_0 > 0, m.
    response : array_like of complex, shape (n,)
        X/R, displacement over reference.
    controller : control.TransferFunction, control.StateSpace or control.FRD
        C in F = C (r - x), N/m.
    covariance : array_like, shape (n, 2, 2), optional
        Covariance of the real and imaginary part of `response`.

    Returns
    -------
    FrequencyResponse
        Receptance with controlled force, one level for each reference. Fit a model that
        holds the controller: ``plant + LinearSystem(controller, quantity="dynamic_stiffness")``.

    Raises
    ------
    ValidationError
        If a frequency or reference is not above zero, shapes do not go together, or the
        controller is zero at a frequency.

    Examples
    --------
    >>> import control
    >>> from dahl_ident.control_interop import closed_loop_response
    >>> pd = control.tf([2.0, 100.0], [1.0])
    >>> data = closed_loop_response([1.0, 2.0], 1e-3, [0.9 - 0.1j, 0.8 - 0.3j], pd)
    >>> data.quantity, data.drive.round(4).tolist()
    ('receptance', [0.1008, 0.1031])
    """
    f = positive_array(frequency_hz, "frequency_hz")
    r = positive_array(reference, "reference")
    X_over_R = np.asarray(response, dtype=np.complex128)
    broadcast_shape(frequency_hz=f, reference=r, response=X_over_R)
    omega = 2.0 * np.pi * f
    C = controller_response(controller, omega)
    if np.any(C == 0.0):
        raise ValidationError(
            f"the controller is 0 at {f[C == 0.0][0]:g} Hz, where nothing drives the plant; "
            "leave that frequency out"
        )
    converted = None
    if covariance is not None:
        J = jacobian(1.0 / C)
        converted = J @ finite_array(covariance, "covariance") @ np.swapaxes(J, -1, -2)
    return FrequencyResponse(
        f,
        X_over_R / C,
        drive=np.abs(C) * r,
        covariance=converted,
        level=np.broadcast_to(r, f.shape),
        controlled="force",
        quantity="receptance",
    )


def split(plant: Element) -> tuple[Model, Model]:
    """Return the friction and the linear part of a plant that has both, with their values."""
    elements = as_model(plant).elements
    plant.known_values()
    friction = [element for element in elements if not element.is_linear]
    linear = [element for element in elements if element.is_linear]
    for part, name, example in ((friction, "friction", "Dahl"), (linear, "linear part", "Mass")):
        if not part:
            raise ModelError(f"{plant!r} has no {name}; add one, such as {example}(...)")
    return Model(*friction), Model(*linear)


def rational_stiffness(model: Element) -> Rational:
    """Return the sum Z(s) of linear elements; common factors are not cancelled."""
    total = Rational(np.zeros(1), np.ones(1))
    for element in as_model(model).elements:
        rational = element.rational_stiffness()
        if rational is None:  # a discrete system or an FRD
            raise ModelError(f"{element!r} has no transfer function; expected a linear element")
        total = total + Rational(*rational)
    return total


def controller_response(controller: Any, omega: FloatArray) -> ComplexArray:
    """Return C(j omega) of a python-control system: force over displacement error."""
    check_system(controller, "controller")
    return LinearSystem(controller, quantity="dynamic_stiffness").dynamic_stiffness(0.0, omega)


def has_polynomials(model: Element) -> bool:
    """Return whether every linear system of the model is continuous and not an FRD."""
    return all(not isinstance(s, control.FRD) and s.isctime() for s in _systems(model))


def known_range(model: Element) -> tuple[float, float]:
    """Return the range of angular frequency in which every linear system is known, rad/s."""
    low, high = 0.0, np.inf
    for system in _systems(model):
        if isinstance(system, control.FRD):
            low, high = max(low, np.min(system.omega)), min(high, np.max(system.omega))
        elif system.isdtime(strict=True):
            high = min(high, np.pi / system.dt)
    return float(low), float(high)


def _systems(model: Element) -> list[Any]:
    """Return the python-control systems of a model at the values of their parameters."""
    systems = [e.system_at([float(v) for v in e.known_values()]) for e in as_model(model).elements]
    return [system for system in systems if system is not None]


class FrictionNonlinearity(control.DescribingFunctionNonlinearity):
    """Friction F(x) with N(A) = (a_1 - j b_1)/A, for python-control's describing functions.

    Parameters
    ----------
    friction : Element
        A rate-independent friction element, such as `Dahl`, or a sum of them, with a value for
        every parameter.

    Raises
    ------
    ModelError
        If an element is linear or depends on the rate, or a parameter has no value.

    Notes
    -----
    Signs. python-control drives a nonlinearity with A sin(theta) and writes its fundamental as
    A abs(N) sin(theta + arg N); this package drives with A cos(theta). Both measure the phase
    of the output against the input in time, so N is the same number: friction leads its
    displacement, Im N > 0, where python-control's relay with hysteresis lags, Im N < 0. In a
    loop, python-control solves H(j omega) N(A) = -1: H is displacement over a force in the
    direction of the drive, and friction acts in the opposite direction.

    Called with successive displacements, it returns the law's force and stores the history of the
    motion, like python-control's nonlinearities with memory. Use ``describing_function``, which is
    exact, rather than python-control's numerical one, whose warm-up is only a single cycle.

    Examples
    --------
    >>> import control
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.control_interop import FrictionNonlinearity
    >>> friction = FrictionNonlinearity(Dahl(f_max=1.0, sigma=1.0))
    >>> control.describing_function(friction, [0.0, 1.0]).round(4)
    array([1.    +0.j    , 0.7325+0.3035j])
    >>> print(f"{friction(1.0):.4f} {friction(0.5):.4f}")
    0.6321 -0.0101
    """

    def __init__(self, friction: Element) -> None:
        super().__init__()
        self._model = friction_alone(friction)
        self._values = self._model.known_values()
        self._turns = [0.0]

    @property
    def friction(self) -> Element:
        """The friction as a model of this package."""
        return self._model

    def describing_function(self, A: float) -> complex:
        """Return N(A), N/m, at one amplitude A >= 0, m; its limit at A = 0.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> print(FrictionNonlinearity(Dahl(f_max=1.0, sigma=3.0)).describing_function(0.0))
        (3+0j)
        """
        amplitude = non_negative_array(A, "A")
        return complex(self._model.stiffness(self._values, amplitude, _QUASI_STATIC))

    def __call__(self, A: float) -> float:
        """Return the force, N, after a monotonic move to the displacement `A`, m."""
        x = finite_number(np.squeeze(A), "displacement")
        if len(self._turns) > 1 and (x - self._turns[-1]) * (self._turns[-1] - self._turns[-2]) > 0:
            self._turns[-1] = x  # the force depends only on the turning points
        else:
            self._turns.append(x)
        return float(self._model.force(self._turns)[-1])

    def reset(self) -> None:
        """Reset the history: displacement and force are zero.

        Examples
        --------
        >>> from dahl_ident import Dahl
        >>> friction = FrictionNonlinearity(Dahl(f_max=1.0, sigma=1.0))
        >>> first = friction(1.0)
        >>> friction.reset()
        >>> friction(1.0) == first
        True
        """
        self._turns = [0.0]

    def _isstatic(self) -> bool:
        return False


def friction_alone(friction: Element) -> Model:
    """Return a model of rate-independent friction; raise an error if it has any other element."""
    model = as_model(friction)
    for element in model.elements:
        if element.is_linear:
            raise ModelError(
                f"friction holds {element!r}; expected friction alone, such as Dahl: put "
                "the linear elements into the loop"
            )
        if not element.rate_independent:
            raise ModelError(
                f"{element!r} depends on the rate, so its describing function is not a function of "
                "the amplitude alone; expected rate-independent friction, such as Dahl"
            )
    model.known_values()
    return model


def friction_and_slope(
    friction: Element, amplitude: FloatArray, omega: FloatArray = _QUASI_STATIC
) -> tuple[ComplexArray, ComplexArray]:
    """Return N(A) and A dN/dA."""
    values = friction.known_values()
    N, by_amplitude, _ = friction.settled(values, Sine(amplitude, omega), 1)
    return N, amplitude * by_amplitude

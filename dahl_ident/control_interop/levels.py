r"""Responses of a plant with friction at several levels (Fig. 7); all branches with stability.

The logarithm of a disturbance of an exact steady motion grows by ln of the largest of Floquet's
multipliers each cycle. Near a steady motion of the describing function, to first order in its rate
of change, a disturbance xi of the displacement phasor, relative to the direction of X, obeys

    L'(s) dxi/dt = -(Z xi + A N'(A) Re xi),    Z = L + N,

two real equations: a branch on which A |Z| falls is unstable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import control
import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, positive_array
from dahl_ident.control_interop.cycles import stiffness_of, stiffness_slope
from dahl_ident.control_interop.linearization import friction_and_slope, split
from dahl_ident.control_interop.steady_response import SteadyResponse, response
from dahl_ident.data.columns import CONTROLLED, one_of
from dahl_ident.elements.driven_motion import NEUTRAL, Steady
from dahl_ident.elements.element import Element, Model
from dahl_ident.errors import ValidationError
from dahl_ident.units import QUANTITIES, Quantity, converted, si_unit

Kind = Literal["bode", "nyquist", "nichols"]


@dataclass(frozen=True)
class LevelResponses:
    """Complex responses over frequency, one row per level.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n,)
        Hz.
    levels : ndarray, shape (m,)
        Drive, N, or displacement amplitude, m; zero-to-peak.
    controlled : {"force", "displacement"}
        The amplitude that is constant along a row.
    quantity : str
        The quantity of the response.
    response : ndarray of complex, shape (m, n)
        NaN where the plant has no steady amplitude.
    """

    frequency_hz: FloatArray
    levels: FloatArray
    controlled: Literal["force", "displacement"]
    quantity: Quantity
    response: ComplexArray

    def to_control(self) -> dict[float, Any]:
        """Return a control.FrequencyResponseData for each level, without points that hold NaN.

        Examples
        --------
        >>> from dahl_ident import Dahl, Mass
        >>> from dahl_ident.control_interop import level_responses
        >>> plant = Dahl(f_max=1.0, sigma=1.0) + Mass(1.0)
        >>> list(level_responses(plant, [1.0, 2.0], [0.1, 1.0]).to_control())
        [0.1, 1.0]
        """
        omega = 2.0 * np.pi * self.frequency_hz
        return {
            level: control.frd(row[np.isfinite(row)], omega[np.isfinite(row)])
            for level, row in zip(self.levels.tolist(), self.response, strict=True)
        }

    def plot(self, kind: Kind = "bode", ax: Any = None) -> Any:
        """Draw all levels in one picture.

        Parameters
        ----------
        kind : {"bode", "nyquist", "nichols"}
            Gain and phase over frequency, imaginary over real part, or gain over phase.
        ax : Axes, or a sequence of two for "bode", optional
            New by default; they are returned.
        """
        from dahl_ident.plots import plot_frequency_response, plot_nichols, plot_nyquist

        unit = "N" if self.controlled == "force" else "m"
        label = f"{self.quantity.replace('_', ' ')} [{si_unit(self.quantity)}]"
        rows = [
            (f"{level:.3g} {unit}", self.frequency_hz, row)
            for level, row in zip(self.levels.tolist(), self.response, strict=True)
        ]
        if kind == "bode":
            return plot_frequency_response(rows, gain_label=label, ax=ax)
        curves = [(name, row) for name, _, row in rows]
        if kind == "nyquist":
            return plot_nyquist(curves, label=label, ax=ax)
        if kind == "nichols":
            return plot_nichols(curves, gain_label=label, ax=ax)
        raise ValidationError(f"kind is {kind!r}; expected 'bode', 'nyquist' or 'nichols'")


def level_responses(
    plant: Element,
    frequency_hz: ArrayLike,
    levels: ArrayLike,
    *,
    controlled: Literal["force", "displacement"] = "force",
    quantity: Quantity = "receptance",
    steady: Steady = "exact",
) -> LevelResponses:
    """Return the plant's response over frequency at several levels, as in Fig. 7.

    Parameters
    ----------
    plant : Element
        With a value for every parameter.
    frequency_hz : array_like, shape (n,)
        Hz, > 0.
    levels : array_like, shape (m,)
        Zero-to-peak drives, N, or displacement amplitudes, m; > 0.
    controlled : {"force", "displacement"}, default "force"
        Which of the two is constant over frequency at each level.
    quantity : str, default "receptance"
        One of the six standard quantities.
    steady : {"exact", "describing function"}, default "exact"
        Method for the response to a force, see :func:`dahl_ident.response`.

    Returns
    -------
    LevelResponses
        With `to_control()` and `plot()`.

    Raises
    ------
    ModelError
        If a parameter has no value.
    ValidationError
        If a frequency or level is not above zero, or a choice is unknown.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> from dahl_ident.control_interop import level_responses
    >>> plant = Dahl(f_max=0.1, sigma=30) + Mass(0.3) + Damper(0.24) + Spring(0.3)
    >>> f, u0 = np.geomspace(0.01, 10.0, 400), np.geomspace(1e-4, 1e1, 51)
    >>> fig_7 = level_responses(plant, f, u0, steady="describing function")  # as in the paper
    >>> top, bottom = fig_7.plot()
    """
    f = np.atleast_1d(positive_array(frequency_hz, "frequency_hz"))
    sizes = np.atleast_1d(positive_array(levels, "levels"))
    if f.ndim != 1 or sizes.ndim != 1:
        raise ValidationError(
            f"frequency_hz has shape {f.shape} and levels {sizes.shape}; expected one dimension "
            "each"
        )
    one_of(quantity, "quantity", QUANTITIES)
    one_of(controlled, "controlled", CONTROLLED)
    omega = 2.0 * np.pi * f
    if controlled == "force":
        R = np.asarray(response(plant, f, sizes[:, None], steady=steady).receptance)
    else:
        R = 1.0 / np.asarray(plant.dynamic_stiffness(sizes[:, None], omega))
    with np.errstate(invalid="ignore"):  # NaN without a steady amplitude
        R, _ = converted(R, omega, "receptance", quantity)
    return LevelResponses(f, sizes, controlled, quantity, R)


@dataclass(frozen=True)
class Branches:
    """All steady responses at every point, along the last axis, by rising amplitude.

    Attributes
    ----------
    steady : SteadyResponse
        Amplitudes, phases, receptances; NaN where a point has fewer than the largest number.
    growth_rate : ndarray
        Growth rate of the least stable small disturbance, 1/s; negative on stable branches.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> from dahl_ident.control_interop import response_branches
    >>> plant = Dahl(f_max=0.1, sigma=30) + Mass(0.3) + Damper(-0.03) + Spring(3.0)
    >>> response_branches(plant, 0.525, 0.114).stable.tolist()
    [True, False, True]
    """

    steady: SteadyResponse
    growth_rate: FloatArray

    @property
    def stable(self) -> BoolArray:
        """Whether motions near each response approach it; False if there is none."""
        return np.asarray(self.growth_rate <= 0.0)


def response_branches(
    plant: Element,
    frequency_hz: ArrayLike,
    drive: ArrayLike,
    *,
    steady: Steady = "exact",
) -> Branches:
    """Return every steady response, and whether each is stable.

    Parameters
    ----------
    plant : Element
        Friction and linear elements, with a value for every parameter.
    frequency_hz : array_like
        Hz, > 0.
    drive : array_like
        Zero-to-peak force u_0 > 0, N; broadcast with `frequency_hz`.
    steady : {"exact", "describing function"}, default "exact"
        See :func:`dahl_ident.response`. Exact branches start from those of the describing function
        and are followed from point to point, in the order of the points.

    Returns
    -------
    Branches
        Shape of the arguments with one more axis, the branches.

    Raises
    ------
    ModelError
        If a parameter has no value, or the plant has no friction or nothing else.
    ValidationError
        If a frequency or drive is not above zero, or shapes do not go together.

    Notes
    -----
    The stability found with the describing function is that of slow changes of one sine; another
    mode may still start to oscillate, see :func:`limit_cycles`. Near the end of a branch the
    amplitude depends so steeply on the drive that harmonics of a few per cent shift it by tens of
    per cent, which the describing function does not include.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring
    >>> from dahl_ident.control_interop import response_branches
    >>> plant = Dahl(f_max=0.1, sigma=30) + Mass(0.3) + Damper(-0.03) + Spring(3.0)
    >>> branches = response_branches(plant, 0.525, 0.114)
    >>> branches.steady.amplitude.round(3).tolist()
    [0.009, 0.114, 0.258]
    >>> branches.stable.tolist()
    [True, False, True]
    """
    friction, linear = split(plant)
    f = positive_array(frequency_hz, "frequency_hz")
    steady_motion = response(plant, f, drive, all_roots=True, steady=steady)
    if steady_motion.steady == "exact":
        with np.errstate(divide="ignore", invalid="ignore"):
            growth = np.log(steady_motion.multiplier) * steady_motion.frequency_hz
        # motions without a definite mean position
        neutral = np.abs(steady_motion.multiplier - 1.0) < NEUTRAL
        return Branches(steady_motion, np.where(neutral, 0.0, growth))
    return Branches(steady_motion, _slow_growth(friction, linear, steady_motion))


def _slow_growth(friction: Model, linear: Model, steady: SteadyResponse) -> FloatArray:
    """Return the growth rate of slow changes of one sine, 1/s."""
    omega = 2.0 * np.pi * np.asarray(steady.frequency_hz)
    exists = np.asarray(steady.found)
    N, slope = friction_and_slope(friction, np.where(exists, steady.amplitude, 1.0), omega)
    w = omega.ravel()
    Z = stiffness_of(linear, w).reshape(omega.shape) + N
    by_s = -1j * stiffness_slope(linear, w).reshape(omega.shape)
    # the larger real part of the eigenvalues of -(Z xi + slope Re xi)/by_s
    radial, turning = (Z + slope) / by_s, Z / by_s
    half_trace = -0.5 * (radial + turning).real
    determinant = (radial * turning.conj()).real
    root = np.sqrt((half_trace**2 - determinant).astype(np.complex128))
    return np.where(exists, half_trace + root.real, np.nan)

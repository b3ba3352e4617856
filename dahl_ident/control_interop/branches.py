r"""Every steady response of a driven plant, with its stability.

Of an exact steady motion Floquet's multipliers are known, and a disturbance grows by ln of the
largest one each cycle. For the describing function an average over a cycle says as much: near a
steady motion, to first order in its rate of change, the displacement phasor X obeys
L'(s) dX/dt + (L + N(|X|)) X = u_0. A disturbance xi of X, seen along X, obeys

    L'(s) dxi/dt = -(Z xi + A N'(A) Re xi),    Z = L + N,

two real equations. Their determinant is |Z|^2/|L'|^2 times d ln(A |Z|)/d ln A: a branch on which
A |Z| falls is unstable. Their trace is -Re((2 Z + A N')/L'): it shows whether the motion is
oscillatorily unstable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import ComplexArray, FloatArray, positive_array
from dahl_ident.control_interop.limit_cycles import stiffness_of, stiffness_slope
from dahl_ident.control_interop.linear_part import split
from dahl_ident.control_interop.nonlinearity import friction_and_slope
from dahl_ident.elements.element import Element, Model
from dahl_ident.steady_state import Steady, SteadyResponse, response
from dahl_ident.steady_state.shooting import NEUTRAL


@dataclass(frozen=True)
class Branches:
    """All steady responses at every point, along the last axis, by rising amplitude.

    Attributes
    ----------
    steady : SteadyResponse
        Amplitudes, phases, receptances; NaN where a point has fewer than the most.
    growth_rate : ndarray
        Rate at which the worst small disturbance grows, 1/s; negative on stable branches.

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
    def stable(self) -> NDArray[np.bool_]:
        """Whether a motion near each response approaches it; False where there is none."""
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
    The describing function's stability is that of slow changes of one sine; another mode may still
    start to oscillate, see :func:`limit_cycles`. Passive plants with Dahl friction have one branch;
    negative damping and laws such as Backlash give several. Near the end of a branch the amplitude
    depends so steeply on the drive that harmonics of a few per cent shift it by tens of per cent,
    which the describing function does not see.

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
        # a motion that may lie anywhere
        neutral = np.abs(steady_motion.multiplier - 1.0) < NEUTRAL
        return Branches(steady_motion, np.where(neutral, 0.0, growth))
    return Branches(steady_motion, _slow_growth(friction, linear, steady_motion))


def _slow_growth(friction: Model, linear: Model, steady: SteadyResponse) -> FloatArray:
    """Return the rate at which slow changes of one sine grow, 1/s."""
    omega = 2.0 * np.pi * np.asarray(steady.frequency_hz)
    exists = np.asarray(steady.found)
    N, slope = friction_and_slope(friction, np.where(exists, steady.amplitude, 1.0), omega)
    w = omega.ravel()
    Z = stiffness_of(linear, w).reshape(omega.shape) + N
    by_s = -1j * stiffness_slope(linear, w).reshape(omega.shape)
    rate = _largest_rate(Z, slope, by_s)
    return np.where(exists, rate, np.nan)


def _largest_rate(Z: ComplexArray, slope: ComplexArray, by_s: ComplexArray) -> FloatArray:
    """Return the largest real part of the two eigenvalues of -(Z xi + slope Re xi)/by_s."""
    radial, turning = (Z + slope) / by_s, Z / by_s
    half_trace = -0.5 * (radial + turning).real
    determinant = (radial * turning.conj()).real
    root = np.sqrt((half_trace**2 - determinant).astype(np.complex128))
    return np.asarray(half_trace + root.real)

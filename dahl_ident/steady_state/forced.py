"""The public function for the steady response of a known plant, with checked arguments.

All motions are first those of the describing function. Where the plant has an equation of motion
each is then made exact.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    broadcast_shape,
    non_negative_array,
    positive_array,
)
from dahl_ident.data.columns import one_of
from dahl_ident.elements.element import Element, as_model
from dahl_ident.errors import MultipleSolutionsWarning, ValidationError
from dahl_ident.steady_state.exact_response import exact_motions
from dahl_ident.steady_state.plant import BoolArray, IntArray, flatten
from dahl_ident.steady_state.roots import find_roots
from dahl_ident.steady_state.shooting import LINEAR, NEUTRAL, STEADY, Steady, obstacle

_Scalar = TypeVar("_Scalar", bound=np.generic)
_REACH = (1e-290, 1e290)  # numbers end at 1e-308 and 1e308; squares of ratios stay inside


@dataclass(frozen=True)
class SteadyResponse:
    """Displacement X for a drive u_0 cos(omega t): x(t) = A cos(omega t + phase).

    All arrays have the broadcast shape of frequency and drive, with one more axis, the
    amplitudes in rising order, if all were requested. Scalars for scalar arguments.

    Attributes
    ----------
    frequency_hz : ndarray
        Hz.
    drive : ndarray
        Zero-to-peak force u_0, N (N m in rotation).
    amplitude : ndarray
        Zero-to-peak fundamental A of the displacement, m (rad); NaN where there is none.
    displacement : ndarray of complex
        Phasor X = A exp(j phase) of the fundamental, the drive's phase being zero.
    found : ndarray of bool
        Whether the entry is an amplitude.
    number_of_solutions : ndarray of int
        How many amplitudes the point has; shape of frequency and drive.
    message : str
        Empty where every point has exactly one amplitude, and it is stable; else which have none,
        several, or none that is stable, and why.
    harmonic_share : ndarray
        Mean displacement and harmonics 2 to 9, root sum of squares, over the fundamental; zero for
        the describing function, which has none.
    multiplier : ndarray
        Largest modulus of Floquet's multipliers: a small change of the motion grows by this factor
        each cycle. NaN for the describing function.
    steady : str
        "exact" or "describing function": what the motions are.

    Examples
    --------
    >>> from dahl_ident import Dahl, Damper, Mass, Spring, response
    >>> plant = Dahl(f_max=0.1, sigma=30) + Mass(0.3) + Damper(0.24) + Spring(0.3)
    >>> steady = response(plant, frequency_hz=1.0, drive=[0.05, 0.2])
    >>> steady.amplitude.round(5).tolist(), steady.number_of_solutions.tolist()
    ([0.00328, 0.01811], [1, 1])
    """

    frequency_hz: FloatArray
    drive: FloatArray
    amplitude: FloatArray
    displacement: ComplexArray
    found: BoolArray
    number_of_solutions: IntArray
    message: str
    harmonic_share: FloatArray
    multiplier: FloatArray
    steady: str

    @property
    def stable(self) -> BoolArray:
        """Whether a motion nearby comes back; False where there is none, or it is not known."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.multiplier < 1.0 + NEUTRAL)[()]

    @property
    def phase(self) -> FloatArray:
        """Phase of the displacement against the drive, rad; negative where it lags."""
        return np.angle(self.displacement)[()]

    @property
    def receptance(self) -> ComplexArray:
        """X/u_0, m/N; NaN where there is no amplitude."""
        return (self.displacement / self.drive)[()]

    @property
    def dynamic_stiffness(self) -> ComplexArray:
        """u_0/X, N/m; NaN where there is no amplitude."""
        with np.errstate(invalid="ignore"):
            return (self.drive / self.displacement)[()]


def response(
    plant: Element,
    frequency_hz: ArrayLike,
    drive: ArrayLike,
    *,
    all_roots: bool = False,
    steady: Steady = "exact",
) -> SteadyResponse:
    """Return the steady displacement for a sine force.

    Parameters
    ----------
    plant : Element
        Element or sum with every parameter known, such as
        ``Dahl(0.1, 30) + Mass(0.3) + Damper(0.24) + Spring(0.3)``.
    frequency_hz : array_like
        Hz, >= 0; broadcast with `drive`.
    drive : array_like
        Zero-to-peak force u_0, N, > 0; for levels against frequencies give it the shape
        (levels, 1).
    all_roots : bool, default False
        Return every amplitude of each point along a last axis, rising, filled up with NaN.
        Otherwise the smallest alone, a stable one if there is any. Only plants with negative
        damping, or with laws such as Backlash, have several.
    steady : {"exact", "describing function"}, default "exact"
        "exact" is the periodic solution of Eqn. 2 with all harmonics, its fundamental given. The
        describing function takes the displacement for a sine, A abs(Z(A, omega)) = u_0 (Eqn. 53);
        it also stands for plants without a mass, and at 0 Hz, where the `message` says so.

    Returns
    -------
    SteadyResponse
        Amplitude, phase, phasor, receptance, dynamic stiffness, and what was found. Where no
        amplitude is steady it holds NaN, and its `message` says why.

    Warns
    -----
    MultipleSolutionsWarning
        If a point has several amplitudes and `all_roots` is off.

    Raises
    ------
    ModelError
        If a parameter has no value.
    ValidationError
        If a frequency is negative or a drive not positive, either is NaN, infinite or complex,
        or their shapes do not go together.

    Notes
    -----
    Exact motions are known to 1e-8. They start from those of the describing function, and each is
    followed through the neighbouring points, in their order, as far as it goes: give the points of
    a sweep in the order of the sweep. For the describing function

    ``A |Z| = u_0`` holds within 1e-12 max(1, kappa/4), kappa = (abs(L) + abs(N))/abs(Z): near a
    sharp resonance L and N nearly cancel. Two of several amplitudes may be missed where A abs(Z)
    turns twice within 1.8 % of amplitude.

    Examples
    --------
    The static gain of Fig. 7 jumps where the drive overcomes friction:

    >>> from dahl_ident import Dahl, Damper, Mass, Spring, response
    >>> plant = Dahl(f_max=0.1, sigma=30) + Mass(0.3) + Damper(0.24) + Spring(0.3)
    >>> static = response(plant, 0.0, [0.1, 0.2], steady="describing function")
    >>> abs(static.receptance).round(4).tolist()
    [0.0515, 2.36]
    """
    one_of(steady, "steady", STEADY)
    f = non_negative_array(frequency_hz, "frequency_hz")
    u0 = positive_array(drive, "drive")
    shape = broadcast_shape(frequency_hz=f, drive=u0)
    plant = as_model(plant)
    with np.errstate(over="ignore"):
        points, _ = flatten(plant, plant.known_values(), 2.0 * np.pi * f, u0)
        _check_reach(np.minimum(points.bounds()[0], 1.0))  # infinite without any stiffness
        roots, force = find_roots(points)
        _check_reach(roots)
        amplitude = roots * points.unit[:, None]
        _check_reach(amplitude)
    with np.errstate(invalid="ignore"):  # NaN where there is no amplitude
        X = amplitude * (force.conj() / np.abs(force))
    share, multiplier = np.zeros(X.shape), np.full(X.shape, np.nan)
    why = "" if steady == "describing function" else obstacle(plant)
    moving = np.broadcast_to(f, shape).ravel() > 0.0
    exact = moving if steady == "exact" and not why else np.zeros(moving.shape, dtype=np.bool_)
    if exact.any():
        omega, u = (np.broadcast_to(v, shape).ravel()[exact] for v in (2.0 * np.pi * f, u0))
        unique = points.friction.unique & (points.linear.imag[exact] >= 0.0)
        motions = exact_motions(plant, omega, u, X[exact], unique, every=all_roots)
        more = ((0, 0), (0, motions.displacement.shape[1] - X.shape[1]))
        X, share, multiplier = (
            np.pad(v, more, constant_values=np.nan) for v in (X, share, multiplier)
        )
        X[exact], share[exact], multiplier[exact] = motions
        amplitude = np.abs(X)
    found = ~np.isnan(amplitude)
    count = found.sum(axis=1).reshape(shape)
    with np.errstate(invalid="ignore"):
        unstable = exact & found.any(axis=1) & ~(multiplier < 1.0 + NEUTRAL).any(axis=1)
    active = points.linear.imag < 0.0
    message = _message(
        count, active.reshape(shape), unstable.reshape(shape), np.broadcast_to(f, shape),
        np.broadcast_to(u0, shape),
    )  # fmt: skip
    if steady == "exact" and not exact.all() and why != LINEAR:
        taken = f"the describing function stands for the exact motion ({why or 'at 0 Hz'})"
        message = "; ".join(filter(None, (message, taken)))
    if all_roots:
        f, u0, shape = f[..., None], u0[..., None], (*shape, X.shape[1])
    else:
        if np.any(count > 1):
            text = f"{message}; the smallest is returned, all of them with all_roots=True"
            warnings.warn(text, MultipleSolutionsWarning, stacklevel=2)
        amplitude, X, found = amplitude[:, :1], X[:, :1], found[:, :1]
        share, multiplier = share[:, :1], multiplier[:, :1]
    return SteadyResponse(
        frequency_hz=_read_only(np.broadcast_to(f, shape)),
        drive=_read_only(np.broadcast_to(u0, shape)),
        amplitude=_read_only(amplitude.reshape(shape)),
        displacement=_read_only(X.reshape(shape)),
        found=_read_only(found.reshape(shape)),
        number_of_solutions=_read_only(count),
        message=message,
        harmonic_share=_read_only(np.where(found, share, np.nan).reshape(shape)),
        multiplier=_read_only(multiplier.reshape(shape)),
        steady="exact" if exact.any() else "describing function",
    )


def _check_reach(amplitude: FloatArray) -> None:
    """Refuse an amplitude that is too large or too small for floating-point numbers."""
    least, most = _REACH
    lost = (amplitude < least) | (amplitude > most)
    if lost.any():
        row = int(np.argwhere(lost)[0, 0])
        raise ValidationError(
            f"point {row} ({lost.sum()} such points) has an amplitude of about "
            f"{amplitude[lost][0]:g}, outside the range of numbers, {least:g} to {most:g}; "
            "check the units"
        )


def _read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Return the array, read-only, or its scalar."""
    array.flags.writeable = False
    return array[()]


def _message(
    count: IntArray,
    active: BoolArray,
    unstable: BoolArray,
    frequency_hz: FloatArray,
    drive: FloatArray,
) -> str:
    """Return which points have no amplitude, several, or none that is stable, and why.

    Empty where all have one that is; `active` says where the linear part feeds energy in.
    """
    verdicts = (
        (
            count == 0,
            "no steady amplitude (an undamped resonance, or rest without a spring, driven with at "
            "least 4/pi times the friction limit; add damping or a spring, or lower the drive)",
        ),
        (
            (count > 1) & active,
            "several steady amplitudes (the linear part has negative damping there)",
        ),
        (
            (count > 1) & ~active,
            "several steady amplitudes (the law allows them, as a gap does)",
        ),
        (
            unstable,
            "no stable motion of the drive's period (a device moves otherwise there; leave such "
            "points out of a fit)",
        ),
    )
    parts = []
    for where, verdict in verdicts:
        if not where.any():
            continue
        first = tuple(np.argwhere(where)[0])
        parts.append(
            f"{where.sum()} of {where.size} points: {verdict}; the first at "
            f"{frequency_hz[first]:g} Hz, drive {drive[first]:g}"
        )
    return "; ".join(parts)

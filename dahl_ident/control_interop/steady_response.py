"""The steady response of a known plant to a sinusoidal force: displacement from drive.

Under a force u_0 cos(omega t) a plant with friction moves with a displacement amplitude A that is
not proportional to u_0, because its dynamic stiffness depends on A (Eqn. 53):

    A |Z(A, omega)| = u_0,    Z = L(omega) + N(A),    L = k - m omega^2 + j omega c + ...

The motions first follow from this balance of fundamentals. If the plant has an equation of motion,
each is then made exact. If L is passive (Im L >= 0) and the laws allow it, the amplitude is unique.
An undamped resonance (L = 0) driven with 4 f_max/pi or more has no steady amplitude.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dahl_ident.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    broadcast_shape,
    non_negative_array,
    positive_array,
)
from dahl_ident.control_interop.exact_response import HARMONICS, exact_motions
from dahl_ident.control_interop.force_balance import balance_of, find_roots
from dahl_ident.data.columns import one_of
from dahl_ident.elements.driven_motion import LINEAR, NEUTRAL, STEADY, Shooting, Steady, obstacle
from dahl_ident.elements.element import Element, Model, as_model
from dahl_ident.errors import MultipleSolutionsWarning, NoSteadyMotionWarning, ValidationError
from dahl_ident.units import percent

_Scalar = TypeVar("_Scalar", bound=np.generic)
_DISTORTED = 0.02  # third harmonic over fundamental with an error like that of a measurement
_MOST_CHECKED = 1000  # points, evenly spread, because neighbours hardly differ
_AMPLITUDES = (1e-290, 1e290)  # of amplitudes; floating-point numbers end at 1e-308 and 1e308


@dataclass(frozen=True)
class SteadyResponse:
    """Displacement X for a drive u_0 cos(omega t): x(t) = A cos(omega t + phase).

    All arrays have the broadcast shape of frequency and drive, with one more axis for the
    amplitudes in rising order if all were requested. Scalars for scalar arguments.

    Attributes
    ----------
    frequency_hz : ndarray
        Hz.
    drive : ndarray
        Zero-to-peak force u_0, N (N m in rotation).
    amplitude : ndarray
        Zero-to-peak fundamental A of the displacement, m (rad); NaN if there is none.
    displacement : ndarray of complex
        Phasor X = A exp(j phase) of the fundamental, relative to the phase of the drive.
    found : ndarray of bool
        Whether the entry is an amplitude.
    number_of_solutions : ndarray of int
        Number of amplitudes of the point; shape of frequency and drive.
    message : str
        Empty if every point has exactly one amplitude, and it is stable. Otherwise it says which
        points have none, several, or none that is stable, and why; with the describing function,
        also where the motion is not nearly a sine.
    harmonics : ndarray of complex
        X_k of the mean displacement, the fundamental and the harmonics 2 to 9, along one more axis;
        x(t) is the sum of Re X_k exp(j k omega t). The describing function has only the
        fundamental.
    multiplier : ndarray
        Largest modulus of Floquet's multipliers: a small change of the motion grows by this factor
        each cycle. NaN for the describing function.
    steady : str
        "exact" or "describing function": the method of the motions.

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
    harmonics: ComplexArray = field(repr=False)
    multiplier: FloatArray
    steady: str

    @property
    def stable(self) -> BoolArray:
        """Whether nearby motions return to this one; False if there is none, or it is unknown."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.multiplier < 1.0 + NEUTRAL)[()]

    @property
    def harmonic_share(self) -> FloatArray:
        """Mean displacement and harmonics 2 to 9, root sum of squares, over the fundamental."""
        size = np.abs(self.harmonics)
        others = np.concatenate([size[..., :1], size[..., 2:]], axis=-1)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.linalg.norm(others, axis=-1) / size[..., 1])[()]

    @property
    def phase(self) -> FloatArray:
        """Phase of the displacement relative to the drive, rad; negative if it lags."""
        return np.angle(self.displacement)[()]

    @property
    def receptance(self) -> ComplexArray:
        """X/u_0, m/N; NaN if there is no amplitude."""
        return (self.displacement / self.drive)[()]

    @property
    def dynamic_stiffness(self) -> ComplexArray:
        """u_0/X, N/m; NaN if there is no amplitude."""
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
        Return all amplitudes of each point, stable or not, along a last axis in rising order,
        followed by NaN. By default one: that of the stable motion that a sweep through the points
        in their order follows, up to where it jumps; with the describing function the smallest.
        Only plants with negative damping, or with laws such as Backlash, have several.
    steady : {"exact", "describing function"}, default "exact"
        "exact" is the periodic solution of Eqn. 2 with all harmonics. The describing function
        assumes a sinusoidal displacement, A abs(Z(A, omega)) = u_0 (Eqn. 53); it is also used for
        plants without a mass and at 0 Hz, as the `message` then says.

    Returns
    -------
    SteadyResponse
        Amplitude, phase, phasor, receptance, dynamic stiffness, and the number of solutions. If
        there is no steady amplitude it holds NaN, and its `message` says why.

    Warns
    -----
    MultipleSolutionsWarning
        If a point has several amplitudes and `all_roots` is False.
    NoSteadyMotionWarning
        If a point has no steady motion, or none that is stable, and `all_roots` is False.

    Raises
    ------
    ModelError
        If a parameter has no value.
    ValidationError
        If a frequency is negative or a drive not positive, either is NaN, infinite or complex,
        or their shapes do not go together.

    Notes
    -----
    Exact motions are accurate to 1e-8. They start from those of the describing function, and each
    is followed through the neighbouring points, in their order, as long as it exists: give the
    points of a sweep in the order of the sweep. A sweep begins with the smallest stable motion, and
    so does every point more than 20 % in frequency and drive from the previous one.

    With the describing function ``A |Z| = u_0`` holds within 1e-12 max(1, kappa/4), kappa = (abs(L)
    + abs(N))/abs(Z): near a sharp resonance L and N nearly cancel. Two of several amplitudes may be
    missed if A abs(Z) has two extrema within 1.8 % of amplitude.

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
        points, _ = balance_of(plant, plant.known_values(), 2.0 * np.pi * f, u0)
        _check_range(np.minimum(points.bounds()[0], 1.0))  # infinite without any stiffness
        amplitude = find_roots(points)
        _check_range(amplitude)
    exists = np.isfinite(amplitude)
    force = points.at(np.nonzero(exists)[0]).force(amplitude[exists])
    X: ComplexArray = np.full(amplitude.shape, np.nan, dtype=np.complex128)
    with np.errstate(invalid="ignore"):  # the law may have no settled loop
        X[exists] = amplitude[exists] * (force.conj() / np.abs(force))
    harmonics = np.where(np.array(HARMONICS) == 1, X[..., None], 0.0)
    multiplier = np.full(X.shape, np.nan)
    chosen = np.zeros(X.shape[0], dtype=np.intp)
    why = "" if steady == "describing function" else obstacle(plant)
    f, u0 = np.broadcast_arrays(f, u0)
    omega, u = 2.0 * np.pi * f.ravel(), u0.ravel()
    moving = omega > 0.0
    exact = moving if steady == "exact" and not why else np.zeros(moving.shape, dtype=np.bool_)
    if exact.any():
        unique = points.unique & (points.linear.imag[exact] >= 0.0)
        orbits, moduli, followed = exact_motions(plant, omega[exact], u[exact], X[exact], unique)
        padding = ((0, 0), (0, moduli.shape[1] - X.shape[1]))
        multiplier = np.pad(multiplier, padding, constant_values=np.nan)
        harmonics = np.pad(harmonics, (*padding, (0, 0)), constant_values=np.nan)
        harmonics[exact], multiplier[exact], chosen[exact] = orbits, moduli, followed
    exists = np.isfinite(harmonics[..., 1])
    count = exists.sum(axis=1).reshape(shape)
    active = (points.linear.imag < 0.0).reshape(shape)
    unstable = ((chosen < 0) & exists.any(axis=1)).reshape(shape)
    values = np.array([float(v) for v in plant.known_values()])
    drifts = bool(np.any(exact & (count.ravel() == 0))) and Shooting(plant).drifts(values)
    message = _message(count, drifts, active, unstable, f, u0)
    if steady == "exact" and not exact.all() and why != LINEAR:
        replaced = f"the describing function replaces the exact motion ({why or 'at 0 Hz'})"
        message = "; ".join(filter(None, (message, replaced)))
    if steady == "describing function" and not obstacle(plant):
        at = np.flatnonzero(moving & (count.ravel() == 1))
        at = at[:: 1 + at.size // _MOST_CHECKED]
        distortion = _not_a_sine(plant, omega[at], u[at], amplitude[at, 0])
        message = "; ".join(filter(None, (message, distortion)))
    if all_roots:
        f, u0, shape = f[..., None], u0[..., None], (*shape, exists.shape[1])
    else:
        if np.any(count > 1):
            one = "the one that a sweep in their order follows" if exact.any() else "the smallest"
            text = f"{message}; {one} is returned, all of them with all_roots=True"
            warnings.warn(text, MultipleSolutionsWarning, stacklevel=2)
        rows = np.arange(chosen.size)
        harmonics, multiplier = harmonics[rows, chosen], multiplier[rows, chosen]
        harmonics[chosen < 0], multiplier[chosen < 0] = np.nan, np.nan
        lost = np.isnan(harmonics[:, 1]).sum()
        if lost:
            text = f"{lost} of {chosen.size} points have no steady motion and hold NaN: {message}"
            warnings.warn(text, NoSteadyMotionWarning, stacklevel=2)
    harmonics = harmonics.reshape(*shape, len(HARMONICS))
    X = harmonics[..., 1]
    return SteadyResponse(
        frequency_hz=_read_only(np.broadcast_to(f, shape)),
        drive=_read_only(np.broadcast_to(u0, shape)),
        amplitude=_read_only(np.abs(X)),
        displacement=_read_only(X),
        found=_read_only(np.isfinite(X)),
        number_of_solutions=_read_only(count),
        message=message,
        harmonics=_read_only(harmonics),
        multiplier=_read_only(multiplier.reshape(shape)),
        steady="exact" if exact.any() else "describing function",
    )


def _not_a_sine(plant: Model, omega: FloatArray, drive: FloatArray, A: FloatArray) -> str:
    """Return a message if the motion is not nearly a sine, from its approximate third harmonic."""
    values = plant.known_values()
    with np.errstate(all="ignore"):
        third = np.abs(
            plant.stiffness(values, A, omega, 3) / plant.stiffness(values, A, 3.0 * omega)
        )
    if not (third > _DISTORTED).any():
        return ""
    row = int(np.nanargmax(third))
    return (
        "the motion is not a sine, as the describing function assumes: the third harmonic is about "
        f"{percent(third[row])} at {omega[row] / (2.0 * np.pi):g} Hz, drive "
        f"{drive[row]:g}, and the fundamental may be off by several times as much; steady='exact' "
        "has no such error"
    )


def _check_range(amplitude: FloatArray) -> None:
    """Refuse amplitudes too large or too small for floating-point arithmetic."""
    least, most = _AMPLITUDES
    outside = (amplitude < least) | (amplitude > most)
    if outside.any():
        row = int(np.argwhere(outside)[0, 0])
        raise ValidationError(
            f"point {row} ({outside.sum()} such points) has an amplitude of about "
            f"{amplitude[outside][0]:g}, outside the range of numbers, {least:g} to {most:g}; "
            "check the units"
        )


def _read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Return the array, made read-only, or its scalar."""
    array = np.asarray(array)
    array.flags.writeable = False
    return array[()]


def _message(
    count: IntArray,
    drifts: bool,
    active: BoolArray,
    unstable: BoolArray,
    frequency_hz: FloatArray,
    drive: FloatArray,
) -> str:
    """Return which points have no amplitude, several, or none that is stable, and why.

    Empty if every point has one amplitude, and it is stable. At `active` points the linear part
    supplies energy.
    """
    why = (
        "friction differs between the directions, and no spring brings the motion back: it goes "
        "further in each cycle; add a spring"
        if drifts
        else "an undamped resonance, or rest without a spring, driven with at "
        "least 4/pi times the friction limit; add damping or a spring, or lower the drive"
    )
    verdicts = (
        (count == 0, f"no steady amplitude ({why})"),
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
            "no stable motion of the drive's period (there the device moves in another way; leave "
            "such points out of a fit)",
        ),
    )
    parts = []
    for points, verdict in verdicts:
        if not points.any():
            continue
        first = tuple(np.argwhere(points)[0])
        parts.append(
            f"{points.sum()} of {points.size} points: {verdict}; the first at "
            f"{frequency_hz[first]:g} Hz, drive {drive[first]:g}"
        )
    return "; ".join(parts)

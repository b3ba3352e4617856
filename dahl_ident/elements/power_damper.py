r"""A damper whose force is a power of the speed.

    F = c |v/v_0|^p sgn v

Under x = A cos(omega t), with s = A omega/v_0,

    N_k = j (c/A) s^p (2/pi) I_k(p),   I_k = pi sin(k pi/2) Gamma(p + 1)
                                             / (2^p Gamma((p + k)/2 + 1) Gamma((p - k)/2 + 1))

for odd k; even harmonics vanish. p = 1 is the viscous damper of c/v_0, and as p goes to 0 the
force becomes Coulomb's, 4 c/pi of fundamental.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import gamma, rgamma

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.behaviour import (
    HistoryGradient,
    Mechanics,
    StiffnessGradient,
    central_differences,
)
from dahl_ident.elements.element import Element, motion
from dahl_ident.elements.parameter import Parameter

_AT_REST = 1e-12  # square of the speed, over the reference speed, that counts as rest


class PowerDamper(Element):
    """Damper with a power law: F = coefficient abs(v/reference_speed)^exponent sgn v.

    Parameters
    ----------
    coefficient : float, optional
        Force at the reference speed, N (N m in rotation), > 0. Given: fixed; left out: free.
    exponent : float, optional
        From above 0 (Coulomb's friction) over 1 (viscous) to 3. Given: fixed; left out: free.
    reference_speed : float, default 1
        m/s (rad/s): where the force is the coefficient. At 1 the coefficient is the number that
        other texts give in N (s/m)^exponent.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If a number is not above zero, or the exponent above 3.

    Examples
    --------
    >>> from dahl_ident import PowerDamper
    >>> damper = PowerDamper(coefficient=2.0, exponent=0.5)
    >>> print(f"{damper.dynamic_stiffness(0.1, 10.0):.4f}")
    0.0000+22.2567j
    >>> damper.force([0.0, 0.0], velocity=[0.25, -4.0]).tolist()
    [1.0, -4.0]
    """

    kind = "power_damper"
    equation = "F = c |v/v_0|^p sgn v"
    rate_independent = False
    holds_at_rest = False
    linear_parameters = scale_parameters = ("coefficient",)
    parameters = (
        Parameter("coefficient", "N", "force at the reference speed", lower=0.0, transform="log"),
        Parameter(
            "exponent",
            "",
            "exponent of the speed",
            lower=0.0,
            upper=3.0,
            transform="log",
            scan=(0.25, 0.5, 1.0, 2.0),
            prior=(0.1, 3.0),
        ),
        Parameter("reference_speed", "m/s", "reference speed", 1.0, lower=0.0, transform="log"),
    )

    def __init__(
        self,
        coefficient: float | None = None,
        exponent: float | None = None,
        *,
        reference_speed: float = 1.0,
        name: str | None = None,
    ) -> None:
        given = {"coefficient": coefficient, "exponent": exponent}
        self._bind({**given, "reference_speed": reference_speed}, name)

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1, unchecked; infinite at rest for an exponent below 1."""
        c, p, speed = values
        shape = np.broadcast_shapes(*(np.shape(v) for v in (*values, amplitude, omega)))
        if harmonic % 2 == 0:
            return np.zeros(shape, dtype=np.complex128)
        with np.errstate(all="ignore"):
            # A^(p - 1) on its own, so that p = 1 needs no amplitude
            size = c * (omega / speed) ** p * np.asarray(amplitude, np.float64) ** (p - 1.0)
            size = np.where(np.asarray(omega) > 0.0, size, 0.0)
        return np.broadcast_to(1j * size * _share(p, harmonic), shape).copy()

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, unchecked."""
        c, p, speed = (np.asarray(v) for v in values)
        N = self.stiffness(values, amplitude, omega, harmonic)
        with np.errstate(all="ignore"):
            unit = self.stiffness((np.ones(()), p, speed), amplitude, omega, harmonic)
            by_amplitude = np.where(amplitude > 0.0, (p - 1.0) * N / amplitude, 0.0)
            logarithm = np.log(np.asarray(amplitude) * omega / speed)
            steps = unit / _share(p, harmonic)
        share = central_differences(lambda q: _share(q, harmonic), [p], 0, p.shape)
        grow = np.where(np.isfinite(logarithm), logarithm * N, 0.0)
        by_p = grow + c * np.where(np.isfinite(steps), steps, 0.0) * share
        if not np.all(np.isfinite(steps)):  # a harmonic that vanishes at this exponent
            fundamental = self.stiffness(values, amplitude, omega) / _share(p, 1)
            by_p = np.where(np.isfinite(steps), by_p, fundamental * share)
        return StiffnessGradient(
            N, by_amplitude, (unit, np.asarray(by_p, np.complex128), -p / speed * N)
        )

    def stiffness_slope(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return F/X of the fundamental and its derivative with respect to amplitude, unchecked."""
        N = self.stiffness(values, amplitude, omega)
        with np.errstate(all="ignore"):
            slope = np.where(amplitude > 0.0, (values[1] - 1.0) * N / amplitude, 0.0)
        return N, np.asarray(slope, dtype=np.complex128)

    def force_history(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> FloatArray:
        """Return the force for the velocity at every sample, unchecked."""
        c, p, speed = values
        v = motion(velocity, "velocity", displacement, self) / speed
        return np.asarray(c * np.sign(v) * np.abs(v) ** p)

    def force_history_gradient(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> HistoryGradient:
        """Return the force with its derivatives, exactly."""
        c, p, speed = values
        v = motion(velocity, "velocity", displacement, self) / speed
        unit = np.asarray(np.sign(v) * np.abs(v) ** p)
        with np.errstate(divide="ignore"):
            logarithm = np.where(v == 0.0, 0.0, np.log(np.abs(v)))
        by = (unit, c * unit * logarithm, -c * p / speed * unit)
        return HistoryGradient(np.asarray(c * unit), np.zeros(unit.shape), by)

    def mechanics(
        self,
        values: Sequence[Any],
        displacement: Any,
        velocity: Any,
        direction: Any,
        states: Sequence[Any],
    ) -> Mechanics:
        """Return the force; within 1e-6 of the reference speed from rest it is smooth."""
        c, p, speed = values
        ratio = velocity / speed
        return Mechanics(0.0, c * ratio * (ratio * ratio + _AT_REST) ** (0.5 * (p - 1.0)))


def _share(p: FloatArray, k: int) -> FloatArray:
    """Return 2 I_k(p)/pi, the harmonic of sin^p over its height."""
    p = np.asarray(p)
    if p.size > 1 and np.all(p == p.flat[0]):  # of one parameter vector at many points
        return np.broadcast_to(_share(p.ravel()[:1], k), p.shape)
    sign = (-1.0) ** ((k - 1) // 2)
    upper, lower = rgamma((p + k) / 2.0 + 1.0), rgamma((p - k) / 2.0 + 1.0)
    return np.asarray(2.0 * sign * gamma(p + 1.0) * 2.0**-p * upper * lower)

r"""A damper whose force is a power of the speed.

    F = c |v/v_0|^p sgn v

Under x = A cos(omega t), with s = A omega/v_0,

    N_k = j (c/A) s^p (2/pi) I_k(p),   I_k = pi sin(k pi/2) Gamma(p + 1)
                                             / (2^p Gamma((p + k)/2 + 1) Gamma((p - k)/2 + 1))

for odd k; even harmonics vanish. p = 1 is a viscous damper of c/v_0; as p tends to 0, the force
becomes that of Coulomb friction, whose fundamental is 4 c/pi.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import gamma, rgamma

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.element import Element
from dahl_ident.elements.facts import (
    STEP,
    HistoryGradient,
    Mechanics,
    Path,
    Sine,
    StiffnessGradient,
    Values,
    difference,
    each_harmonic,
)
from dahl_ident.elements.force_law import required_history
from dahl_ident.elements.parameter import Parameter

_SMOOTHED = 1e-12  # square of the speed over the reference speed, below which the force is smooth


class PowerDamper(Element):
    """Damper with a power law: F = coefficient abs(v/reference_speed)^exponent sgn v.

    Parameters
    ----------
    coefficient : float, optional
        Force at the reference speed, N (N m in rotation), > 0. Given: fixed; left out: free.
    exponent : float, optional
        Above 0, up to 3: near 0 it is Coulomb friction, at 1 viscous damping. Given: fixed; left
        out: free.
    reference_speed : float, default 1
        The speed at which the force is the coefficient, m/s (rad/s). With 1, the coefficient is
        the number that other texts state in N (s/m)^exponent.
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
        numbers = {"coefficient": coefficient, "exponent": exponent}
        self._bind({**numbers, "reference_speed": reference_speed}, name)

    @each_harmonic
    def settled(self, values: Values, sine: Sine, derivatives: int) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, unchecked; infinite at rest for exponents below 1.

        The derivative with respect to the exponent uses differences of the harmonic of sin^p.
        """
        c, p, speed = (np.asarray(v, dtype=np.float64) for v in values)
        A, omega = (np.asarray(v, dtype=np.float64) for v in sine[:2])
        shape = np.broadcast_shapes(*(v.shape for v in (c, p, speed, A, omega)))
        k = int(sine.harmonic)
        with np.errstate(all="ignore"):
            # A^(p - 1) alone, so that p = 1 needs no amplitude
            size = np.where(omega > 0.0, (omega / speed) ** p * A ** (p - 1.0), 0.0)
            unit = np.broadcast_to(1j * size * _harmonic(p, k) if k % 2 else 0j, shape).copy()
            N = c * unit
            by_amplitude = np.where(A > 0.0, (p - 1.0) * N / A, 0.0)
            if derivatives < 2:
                return StiffnessGradient(N, by_amplitude, ())
            logarithm = np.log(A * omega / speed)
            by_p = np.where(np.isfinite(logarithm), logarithm * N, 0.0)
        if k % 2:
            slope = difference(lambda q: _harmonic(q, k), p, STEP * p)
            by_p = by_p + 1j * np.where(np.isfinite(size), c * size * slope, 0.0)
        return StiffnessGradient(N, by_amplitude, (unit, by_p, -p / speed * N))

    def history(
        self, values: Sequence[Any], path: Path, state: float, *, slopes: bool
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, unchecked."""
        c, p, speed = values
        v = required_history(path.velocity, "velocity", path.displacement, self) / speed
        unit = np.asarray(np.sign(v) * np.abs(v) ** p)
        force = np.asarray(c * unit)
        if not slopes:
            return HistoryGradient(force, force, ())
        with np.errstate(divide="ignore"):
            logarithm = np.where(v == 0.0, 0.0, np.log(np.abs(v)))
        by_parameter = (unit, force * logarithm, -p / speed * force)
        return HistoryGradient(force, np.zeros(unit.shape), by_parameter)

    def mechanics(
        self, values: Sequence[Any], x: Any, velocity: Any, direction: Any, states: Sequence[Any]
    ) -> Mechanics:
        """Return the force, smooth below 1e-6 of the reference speed."""
        c, p, speed = values
        ratio = velocity / speed
        return Mechanics(0.0, c * ratio * (ratio * ratio + _SMOOTHED) ** (0.5 * (p - 1.0)))


def _harmonic(p: FloatArray, k: int) -> FloatArray:
    """Return 2 I_k(p)/pi, the k-th harmonic of sin^p."""
    if p.size > 1 and np.all(p == p.flat[0]):  # one parameter vector at many points
        return np.broadcast_to(_harmonic(p.ravel()[:1], k), p.shape)
    sign = (-1.0) ** ((k - 1) // 2)
    upper, lower = rgamma((p + k) / 2.0 + 1.0), rgamma((p - k) / 2.0 + 1.0)
    return np.asarray(2.0 * sign * gamma(p + 1.0) * 2.0**-p * upper * lower)

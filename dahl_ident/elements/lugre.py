"""LuGre friction: bristles with a sliding force that depends on the speed.

The state is the bristles' force f = sigma z, with df/dx = sigma (1 - s f/g(v)): the linear Dahl law
with a limit that depends on the speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.facts import Asymptote, Values
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.parameter import Parameter

_SPEED_RANGE = 1e12  # factor: exp(-(v/stribeck_speed)^2) is 0 or 1 to every digit


class LuGre(Friction):
    """LuGre friction: linear Dahl with a limit that depends on the speed, and damping.

    Parameters
    ----------
    f_max : float, optional
        Coulomb force at high speed, N (N m in rotation), > 0. Given: fixed; left out: free.
    sigma : float, optional
        Stiffness of the bristles, N/m (N m/rad), > 0.
    static_ratio : float, optional
        Static force over `f_max`, from 1 to 100.
    stribeck_speed : float, optional
        Speed at which the static force's excess over `f_max` has fallen to 1/e, m/s (rad/s), > 0.
    micro_damping : float, default 0
        Damping of the bristles, N s/m, >= 0. None: free.
    viscous : float, default 0
        Viscous damping, N s/m, >= 0. None: free.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If a value is outside its range.

    Notes
    -----
    C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, A new model for control of systems
    with friction, IEEE Trans. Autom. Control 40 (1995) 419-425. N depends on the frequency. Where
    all peak speeds are far above or far below `stribeck_speed`, or `static_ratio` is near 1,
    settled sines cannot distinguish it from linear Dahl with a damper: see `distance_from_dahl`.
    The initial force of a history is that of the bristles.

    Examples
    --------
    >>> law = LuGre(f_max=1.0, sigma=100.0, static_ratio=1.5, stribeck_speed=0.01)
    >>> slow, fast = abs(law.dynamic_stiffness(0.1, [0.001, 10.0]))
    >>> print(f"{slow:.2f} {fast:.2f} N/m")
    18.43 12.44 N/m
    """

    kind = "lugre"
    equation = (
        "dz/dt = v - |v| sigma z/g(v), F = sigma z + micro_damping dz/dt + viscous v, "
        "g = f_max (1 + (static_ratio - 1) exp(-(v/stribeck_speed)^2))"
    )
    rate_independent = False
    linear_parameters = ("micro_damping", "viscous")
    scale_parameters = ("f_max", "sigma", "micro_damping", "viscous")
    parameters = (
        Parameter("f_max", "N", "Coulomb force", lower=0.0, transform="log"),
        Parameter("sigma", "N/m", "stiffness of the bristles", lower=0.0, transform="log"),
        Parameter(
            "static_ratio",
            "",
            "static over Coulomb force",
            lower=1.0,
            upper=100.0,
            transform="log",
            scan=(1.1, 1.5, 2.5),
            prior=(1.0, 4.0),
        ),
        Parameter("stribeck_speed", "m/s", "Stribeck speed", lower=0.0, transform="log"),
        Parameter("micro_damping", "N s/m", "damping of the bristles", 0.0, lower=0.0),
        Parameter("viscous", "N s/m", "viscous damping", 0.0, lower=0.0),
    )

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return df/dx of the bristles' force."""
        f_max, sigma, ratio, speed, *_ = values
        limit = f_max * (1.0 + (ratio - 1.0) * np.exp(-((velocity / speed) ** 2)))
        return sigma * (1.0 - direction * force / limit)

    def output(self, force: Any, slope: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return the total force from that of the bristles and its slope."""
        _, sigma, *_, micro_damping, viscous = values
        return force + (micro_damping / sigma * slope + viscous) * velocity

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the static force, for both directions."""
        limit = np.asarray(values[0] * values[2])
        return limit, limit

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the bounds; inf with damping, whose force grows with the frequency."""
        f_max, sigma, ratio, _, micro_damping, viscous = values
        damped = np.asarray(micro_damping + viscous) > 0.0
        steepest = np.where(damped, np.inf, 8.0 / np.pi * np.asarray(sigma))
        return steepest, np.where(damped, np.inf, 4.0 / np.pi * np.asarray(f_max * ratio))

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the Coulomb and the static force over the stiffness."""
        f_max, sigma, ratio, *_ = values
        return np.asarray(f_max / sigma), np.asarray(f_max * ratio / sigma)

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limits 0 and inf of the Stribeck speed, in which the law is linear Dahl."""
        fast = {"stribeck_speed": low / _SPEED_RANGE}
        slow = {"stribeck_speed": high * _SPEED_RANGE}
        static = (("f_max*static_ratio", {"f_max": 1.0, "static_ratio": 1.0}),)
        return (
            Asymptote(
                "sliding", "all speeds above Stribeck's", fast, None, {"stribeck_speed": 0.0}
            ),
            Asymptote(
                "creeping",
                "all speeds below Stribeck's",
                slow,
                None,
                {"stribeck_speed": np.inf},
                static,
            ),
        )

    def resembles(
        self, values: Sequence[float], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[str, float] | None:
        """Return linear Dahl with a damper, and the distance from it."""
        if not np.all(np.isfinite(values)):
            return None
        pairs = zip(self.parameters, values, strict=True)
        law = LuGre(*(p.nearest(value) for p, value in pairs), name=self.name)
        return "linear Dahl with a damper", law.distance_from_dahl(amplitude, omega)

    def distance_from_dahl(self, amplitude: FloatArray, omega: FloatArray) -> float:
        """Return the misfit to this law's N of the linear Dahl law with a damper that fits best.

        Parameters
        ----------
        amplitude, omega : ndarray
            The levels, m and rad/s; broadcast.

        Returns
        -------
        float
            Root mean square of abs(N_Dahl/N - 1). Settled sines with more noise than this cannot
            distinguish the two laws.

        Examples
        --------
        >>> law = LuGre(1.0, 100.0, 1.5, 0.01)
        >>> A = np.geomspace(1e-3, 1e-1, 9)
        >>> print(f"{law.distance_from_dahl(A, np.asarray(100.0)):.2f}")
        0.00
        """
        from scipy.optimize import least_squares

        from dahl_ident.elements.linear_dahl import describing_function

        A, w = (np.asarray(v, dtype=np.float64) for v in np.broadcast_arrays(amplitude, omega))
        values = self.known_values()
        N = self.stiffness(values, A, w)

        def deviation(p: FloatArray) -> FloatArray:
            f_max, sigma, damping = np.exp(p)
            dahl = sigma * describing_function(sigma * A / f_max) + 1j * w * damping
            relative = (dahl / N - 1.0).ravel()
            return np.asarray(np.concatenate([relative.real, relative.imag]) / np.sqrt(A.size))

        f_max, sigma, ratio = (float(v) for v in values[:3])
        damping = max(float(values[5]), 1e-9 * f_max / float(np.max(A * w) or 1.0))
        starts = [np.log([f, sigma, damping]) for f in (f_max, f_max * ratio)]
        return min(float(np.linalg.norm(least_squares(deviation, s).fun)) for s in starts)

"""Bouc-Wen hysteresis of exponent 1.

    dz/dx = sigma - q |z|   while z and the motion have one sign (loading)
    dz/dx = sigma + p |z|   while they have opposite signs (unloading)

In the usual letters dz/dt = a v - beta |v| z - gamma v |z|: sigma = a, q = beta + gamma and
p = beta - gamma. q = p = sigma/f_max is the linear Dahl model; q > 0 saturates at sigma/q, q <= 0
never saturates; p = 0 unloads along a straight line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.parameter import Parameter


class BoucWen(Friction):
    """Bouc-Wen of exponent 1: dF/dx = sigma - q abs(F) loading, sigma + p abs(F) unloading.

    Loading is where the force and the motion have one sign. In the usual letters
    dz/dt = a v - beta abs(v) z - gamma v abs(z): sigma = a, q = beta + gamma and
    p = beta - gamma, so beta = (q + p)/2 and gamma = (q - p)/2.

    Parameters
    ----------
    sigma : float, optional
        Contact stiffness at zero force, a in the usual letters, N/m, > 0. Given: fixed; left
        out: free.
    q : float, optional
        Rate of softening while loading, beta + gamma, 1/m. Above 0 the force saturates at
        sigma/q; at 0 or below it never does.
    p : float, optional
        Rate of stiffening while unloading, beta - gamma, 1/m; at 0 the law unloads along a
        straight line. Friction that loses energy has q + p > 0.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If sigma is not a number from 1e-90 to 1e90, or q or p is not finite.

    Notes
    -----
    q = p = sigma/f_max is the linear Dahl model. Y.-K. Wen, Method for random vibration of
    hysteretic systems, J. Eng. Mech. Div. 102 (1976) 249-263.

    Examples
    --------
    >>> law = BoucWen(sigma=3.0, q=1.3, p=0.5)
    >>> print(law.dynamic_stiffness(2.0).round(6))
    (0.998062+0.843296j)
    """

    kind = "bouc_wen"
    equation = "dF/dx = sigma - q |F| (F and motion of one sign), sigma + p |F| (opposite signs)"
    parameters = (
        Parameter(
            "sigma", "N/m", "contact stiffness at zero force (a)", lower=0.0, transform="log"
        ),
        Parameter("q", "1/m", "rate of softening while loading (beta + gamma)"),
        Parameter("p", "1/m", "rate of stiffening while unloading (beta - gamma)"),
    )
    linear_parameters = scale_parameters = ("sigma",)

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx."""
        sigma, q, p = values
        ahead = direction * force
        return sigma - 0.5 * ((q + p) * ahead + (q - p) * np.fabs(ahead))

    def force_limits(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return sigma/q for both directions where the force saturates, inf where it does not."""
        sigma, q, _ = np.broadcast_arrays(*values)
        limit = np.full(np.shape(q), np.inf)
        limit = np.asarray(np.divide(sigma, q, out=limit, where=q > 0.0))
        return limit, limit

    def force_bounds(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return 8 sigma/pi and 4/pi sigma/q where the force saturates, inf where it does not.

        A tip's force is loaded over at most 2 A; a fundamental is at most 4/pi of it.
        """
        sigma, q, _ = values
        steepest = np.where(np.asarray(q) >= 0.0, 8.0 / np.pi * np.asarray(sigma), np.inf)
        return steepest, 4.0 / np.pi * self.force_limits(values)[0]

    def knee(self, values: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return the inverse of the larger and of the smaller rate."""
        _, q, p = values
        rates = np.sort(np.abs(np.array(np.broadcast_arrays(q, p), dtype=np.float64)), axis=0)
        low = 1.0 / np.maximum(rates[1], 1e-300)
        return low, np.minimum(1.0 / np.maximum(rates[0], 1e-300), 1e3 * low)

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return an objection to a loop that gains energy."""
        q, p = self.parameters[1:]
        if values[1] + values[2] <= 0.0:
            return (f"{q.name} + {p.name} is not above 0: the loop would gain energy",)
        return ()

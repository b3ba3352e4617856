"""Bouc-Wen hysteresis, with an exponent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.elements.facts import Asymptote, Values
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.parameter import Parameter

if TYPE_CHECKING:
    from dahl_ident.engine import Settled

_P = 4  # column of p in rows of amplitude, frequency and values
_AT_ONCE = 1e4, 1e8  # p times amplitude above which N changes by less than 2e-4
_STEEPEST = 1e16  # slope over sigma up to which friction that hardly slips is resolved in time
_WITH_EXPONENT = (
    "dF/dx = sigma (1 - sgn(q) |q F/sigma|^n) (F and motion of one sign), "
    "sigma (1 + sgn(p) |p F/sigma|^n) (opposite signs), n = exponent"
)


class BoucWen(Friction):
    """Bouc-Wen: dF/dx = sigma - q abs(F) loading, sigma + p abs(F) unloading, or their powers n.

    Loading is where the force and the motion have one sign. In the usual letters
    dz/dt = a v - beta abs(v) abs(z)^(n-1) z - gamma v abs(z)^n: sigma = a, and for n = 1
    q = beta + gamma and p = beta - gamma, so beta = (q + p)/2 and gamma = (q - p)/2.

    Parameters
    ----------
    sigma : float, optional
        Contact stiffness at zero force, a in the usual letters, N/m, > 0. A number fixes a
        parameter; one left out is free.
    q : float, optional
        Rate of softening while loading, 1/m. Above 0 the force saturates at sigma/q. At 0 or
        below there is no such limit, and for n > 1 a force with q < 0 becomes infinite within a
        finite displacement, beyond which the law has no value.
    p : float, optional
        Rate of stiffening while unloading, 1/m; at 0 the law unloads along a straight line.
        Friction that loses energy has q + p > 0.
    exponent : float or None, default 1
        n, from 0.05 to 100: how abruptly the force saturates. None: free. At exactly 1 it is not
        a parameter of the element.
    name : str, optional
        Prefix of the parameters' names.

    Raises
    ------
    ValidationError
        If sigma is not a number from 1e-90 to 1e90, q or p is not finite, or the exponent is
        outside its range.

    Notes
    -----
    With an exponent, dF/dx = sigma (1 - sgn(q) abs(q F/sigma)^n) loading and
    sigma (1 + sgn(p) abs(p F/sigma)^n) unloading, so that q and p keep their unit and the limit is
    sigma/q for every n: beta + gamma = sgn(q) abs(q)^n sigma^(1-n), and beta - gamma likewise with
    p. q = p = sigma/f_max with n = 1 is the linear Dahl model.

    In settled sines p is limited to 1e8 over the displacement amplitude: there the loop differs
    from that of instant unloading by at most 2e-4 of N, so data cannot determine a larger p. In a
    driven plant the amplitude is that of the plant with stuck friction, and for n > 2 the limit is
    lower, down to 1e4 at n = 4; slopes steeper than 1e16 sigma then have no steady motion.

    Source: Y.-K. Wen, Method for random vibration of hysteretic systems, J. Eng. Mech. Div. 102
    (1976) 249-263.

    Examples
    --------
    >>> law = BoucWen(sigma=3.0, q=1.3, p=0.5)
    >>> print(law.dynamic_stiffness(2.0).round(6))
    (0.998062+0.843296j)
    >>> BoucWen(sigma=3.0, q=1.3, p=0.5, exponent=2.0)
    BoucWen(sigma=3, q=1.3, p=0.5, exponent=2)
    """

    kind = "bouc_wen"
    equation = "dF/dx = sigma - q |F| (F and motion of one sign), sigma + p |F| (opposite signs)"
    parameters: tuple[Parameter, ...] = (
        Parameter(
            "sigma", "N/m", "contact stiffness at zero force (a)", lower=0.0, transform="log"
        ),
        Parameter("q", "1/m", "rate of softening while loading (beta + gamma)"),
        Parameter("p", "1/m", "rate of stiffening while unloading (beta - gamma)"),
    )
    optional = (
        Parameter(
            "exponent",
            "",
            "exponent of the force",
            lower=0.05,
            upper=100.0,
            transform="log",
            scan=(0.7, 1.5, 3.0),
            prior=(0.5, 5.0),
        ),
        1.0,
    )
    scale_parameters = ("sigma",)

    def __init__(
        self,
        sigma: float | None = None,
        q: float | None = None,
        p: float | None = None,
        *,
        exponent: float | None = 1.0,
        name: str | None = None,
    ) -> None:
        self._bind({"sigma": sigma, "q": q, "p": p, "exponent": exponent}, name)
        if self.has_optional:
            self.equation = _WITH_EXPONENT

    def slope(self, force: Any, direction: Any, velocity: Any, values: Sequence[Any]) -> Any:
        """Return dF/dx."""
        sigma, q, p, *exponent = values
        ahead = direction * force
        if not exponent:
            size = np.fabs(ahead)  # ahead + size and ahead - size are exact: p does not hide q
            return sigma - 0.5 * (q * (ahead + size) + p * (ahead - size))
        (n,) = exponent
        side = np.sign(ahead)
        rate = 0.5 * (np.fabs(q) * (1.0 + side) + np.fabs(p) * (1.0 - side))
        sign = 0.5 * (np.sign(q) * (1.0 + side) - np.sign(p) * (1.0 - side))
        return sigma * (1.0 - sign * (rate * np.fabs(force / sigma)) ** n)

    def resolved(self, values: Values, amplitude: FloatArray) -> Values:
        """Return the values with p limited to that of instant unloading; NaN if it is too steep.

        Friction that hardly slips shakes the mass at each turning point, the faster the steeper its
        slope; an integration in time does not resolve slopes beyond a limit.
        """
        sigma, q, p, *exponent = values
        steepest = np.asarray(_STEEPEST ** (1.0 / exponent[0]) if exponent else _STEEPEST)
        p = np.minimum(p, np.clip(steepest, *_AT_ONCE) / amplitude)
        slipping = np.minimum(amplitude, 1.0 / np.maximum(q, 1e-300))
        return sigma, q, np.where(p * slipping > steepest * (1.0 + 1e-9), np.nan, p), *exponent

    def _loops(
        self, table: FloatArray, orders: Sequence[int] = (1,), chosen: Sequence[int] = ()
    ) -> Settled:
        """Return settled loops, with p limited to that of instant unloading.

        Data in gross slip do not bound p, so searches may let it grow without end.
        """
        resolved = table.copy()
        resolved[:, _P] = np.minimum(table[:, _P], _AT_ONCE[1] / table[:, 0])
        loops = super()._loops(resolved, orders, chosen)
        if _P - 2 in chosen:
            loops.by_parameter[resolved[:, _P] < table[:, _P], :, chosen.index(_P - 2)] = 0.0
        return loops

    def asymptotes(self, low: float, high: float) -> tuple[Asymptote, ...]:
        """Return the limit of gross slip, in which friction unloads instantly."""
        pinned = {"p": _AT_ONCE[1] / low}
        return (Asymptote("runs_away", "one that unloads at once", pinned, None, {"p": np.inf}),)

    def force_limits(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return sigma/q for both directions if the force saturates, inf if it does not."""
        sigma, q, *_ = np.broadcast_arrays(*values)
        limit = np.full(np.shape(q), np.inf)
        limit = np.asarray(np.divide(sigma, q, out=limit, where=q > 0.0))
        return limit, limit

    def force_bounds(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return 8 sigma/pi and 4/pi sigma/q if the force saturates, inf if it does not.

        The peak force is loaded over at most 2 A, and a fundamental is at most 4/pi of the peak.
        """
        sigma, q, *_ = values
        steepest = np.where(np.asarray(q) >= 0.0, 8.0 / np.pi * np.asarray(sigma), np.inf)
        return steepest, 4.0 / np.pi * self.force_limits(values)[0]

    def knee(self, values: Values) -> tuple[FloatArray, FloatArray]:
        """Return the inverse of the larger and of the smaller rate."""
        _, q, p, *_ = values
        rates = np.sort(np.abs(np.array(np.broadcast_arrays(q, p), dtype=np.float64)), axis=0)
        low = 1.0 / np.maximum(rates[1], 1e-300)
        return low, np.minimum(1.0 / np.maximum(rates[0], 1e-300), 1e3 * low)

    def physical_objections(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return an objection to a loop that gains energy."""
        _, q, p, *_ = self.parameters
        if values[1] + values[2] <= 0.0:
            return (f"{q.name} + {p.name} is not above 0: the loop would gain energy",)
        return ()

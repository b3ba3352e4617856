r"""Bouc-Wen hysteresis of exponent 1: steady loop, harmonics and force, piecewise exponential.

    dz/dx = sigma - q |z|   while z and the motion have one sign (loading)
    dz/dx = sigma + p |z|   while they have opposite signs (unloading)

In the usual letters dz/dt = a v - beta |v| z - gamma v |z|: sigma = a, q = beta + gamma and
p = beta - gamma. q = p = sigma/f_max is the linear Dahl model; q > 0 saturates at sigma/q, q <= 0
never saturates; p = 0 unloads along a straight line.

Along a path l in one direction both parts are exponentials. After a reversal at the force u the
force falls to zero over the path l0 = ln(1 + p u/sigma)/p, then grows from zero the other way.
The loop of x = A cos(theta) closes where expm1(p l0)/p = (1 - exp(-q (2 A - l0)))/q, one equation
for l0. With E = exp(p (l0 - l)) for l < l0 and exp(-q (l - l0)) beyond, l = A (1 - cos theta),

    N_k = F_k/A = (2 j sigma/(pi k)) * integral from 0 to pi of E sin(theta) exp(-j k theta)

for odd k; even k vanish.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import exp, expm1, inf, log1p
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.behaviour import HistoryGradient, StiffnessGradient
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.recursion import linear_recursion, stretches

_FADED = 42.0  # exp(-42) is below rounding
_NEWTON = 60  # at most; bisection alone takes 53 to rounding
_SERIES = 0.02  # where the closed forms have lost 1e-12 to rounding; the next terms are 2e-14


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
    hysteretic systems, J. Eng. Mech. Div. 102 (1976) 249-263. The steady loop, its harmonics and
    the force for any history are exact: exponentials piece by piece.

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

    def stiffness(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> ComplexArray:
        """Return F_k/X_1 in closed form up to one quadrature; `omega` does not matter."""
        return self.stiffness_gradient(values, amplitude, omega, harmonic).value

    def stiffness_gradient(
        self,
        values: Sequence[FloatArray],
        amplitude: FloatArray,
        omega: FloatArray,
        harmonic: int = 1,
    ) -> StiffnessGradient:
        """Return F_k/X_1 with its derivatives, exactly."""
        sigma, q, p = values
        h, by_A, by_q, by_p = stiffness_over_sigma(amplitude, q, p, harmonic)
        h = h + 0.0 * sigma
        return StiffnessGradient(sigma * h, sigma * by_A, (h, sigma * by_q, sigma * by_p))

    def force_history(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> FloatArray:
        """Return the force at every sample, exactly, unchecked."""
        sigma, q, p = (float(v) for v in values)
        return force_history(displacement, sigma, q, p, state)

    def force_history_gradient(
        self,
        values: Sequence[FloatArray | float],
        displacement: FloatArray,
        velocity: FloatArray | None = None,
        state: float = 0.0,
        *,
        acceleration: FloatArray | None = None,
    ) -> HistoryGradient:
        """Return the force at every sample with its derivatives, exactly, unchecked."""
        sigma, q, p = (float(v) for v in values)
        force, by_state, by = force_history_gradient(displacement, sigma, q, p, state)
        return HistoryGradient(force, by_state, tuple(by.T))

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

    def transient_decay(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> FloatArray:
        """Return exp(-2 (p l0 + q (2 A - l0))), l0 the path from a tip to zero force."""
        _, q, p = values
        path = zero_path(amplitude, q, p)
        return np.asarray(np.exp(-2.0 * (p * path + q * (2.0 * amplitude - path))) + 0.0 * omega)

    def physics(self, values: Sequence[float]) -> tuple[str, ...]:
        """Return an objection to a loop that gains energy."""
        q, p = self.parameters[1:]
        if values[1] + values[2] <= 0.0:
            return (f"{q.name} + {p.name} is not above 0: the loop would gain energy",)
        return ()


def zero_path(amplitude: FloatArray, q: FloatArray, p: FloatArray) -> FloatArray:
    """Return l0, the path from a turning point of the steady loop to zero force, m."""
    shape = np.broadcast_shapes(np.shape(amplitude), np.shape(q), np.shape(p))
    span, q, p = (np.broadcast_to(v, shape).astype(np.float64) for v in (2.0 * amplitude, q, p))
    low, high = np.zeros(shape), span.copy()
    path = 0.5 * span
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON):
            rest = span - path
            # ln(expm1(p l)/p) - ln((1 - exp(-q m))/q), rising in l
            excess = np.log(path / rest) + _log_growth(-p * path) - _log_growth(q * rest)
            slope = 1.0 / (path * _mean_growth(p * path)) + 1.0 / (rest * _mean_growth(-q * rest))
            low, high = np.where(excess < 0.0, path, low), np.where(excess < 0.0, high, path)
            step = excess / slope
            trial = path - step
            inside = (trial >= low) & (trial <= high) & (trial > 0.0) & (trial < span)
            path = np.where(span > 0.0, np.where(inside, trial, 0.5 * (low + high)), 0.0)
            if np.all((np.abs(step) <= 4e-15 * path) | (span == 0.0)):
                break
    return path


def stiffness_over_sigma(
    amplitude: FloatArray, q: FloatArray, p: FloatArray, harmonic: int
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Return N_k/sigma and its derivatives by amplitude, q and p.

    Parameters
    ----------
    amplitude : ndarray
        A >= 0, m.
    q, p : ndarray
        1/m; broadcast with `amplitude`.
    harmonic : int
        k >= 0; even harmonics are zero.

    Returns
    -------
    tuple of four ndarray of complex
    """
    shape = np.broadcast_shapes(np.shape(amplitude), np.shape(q), np.shape(p))
    if harmonic % 2 == 0:
        zero = np.zeros(shape, dtype=np.complex128)
        return zero, zero, zero, zero
    A, q, p = (np.broadcast_to(v, shape)[..., None] for v in (amplitude, q, p))
    path = zero_path(A, q, p)
    by_A, by_q, by_p = _zero_path_gradient(A, q, p, path)
    safe = np.where(A > 0.0, A, 1.0)
    turn = 2.0 * np.arcsin(np.sqrt(np.clip(np.where(A > 0.0, path / (2.0 * safe), 0.5), 0.0, 1.0)))
    with np.errstate(all="ignore"):
        last = (path + _FADED / np.abs(q)) / (2.0 * safe)
    end = np.where((q > 0.0) & (last < 1.0), 2.0 * np.arcsin(np.sqrt(np.minimum(last, 1.0))), np.pi)
    # E is 1 in microslip; beside the 1, only E - 1 is integrated, to keep its digits
    beside = np.where(end == np.pi, 1.0, 0.0)
    total = [np.zeros(shape, dtype=np.complex128) for _ in range(4)]
    nodes, weights = _rule(harmonic)
    for start, stop, rate in ((np.zeros_like(turn), turn, p), (turn, end, q)):
        half = 0.5 * (stop - start)
        theta = start + half * (1.0 + nodes)
        gone = 2.0 * A * np.sin(0.5 * theta) ** 2
        kernel = half * weights * np.sin(theta) * np.exp(-1j * harmonic * theta)
        growth = rate * (path - gone)
        total[0] += (kernel * np.where(beside > 0.0, np.expm1(growth), np.exp(growth))).sum(-1)
        wave = kernel * np.exp(growth)
        unloading = rate is p
        moves = (
            rate * (by_A - 2.0 * np.sin(0.5 * theta) ** 2),
            rate * by_q + (0.0 if unloading else path - gone),
            rate * by_p + (path - gone if unloading else 0.0),
        )
        for sum_, move in zip(total[1:], moves, strict=True):
            sum_ += (wave * move).sum(-1)
    factor = 2j / (np.pi * harmonic)
    value, along_A, along_q, along_p = (factor * t for t in total)
    if harmonic == 1:
        value += beside[..., 0]
    return value, along_A, along_q, along_p


def loop_force(theta: FloatArray, A: float, sigma: float, q: float, p: float) -> FloatArray:
    """Return the force of the steady loop at x = A cos(theta), 0 <= theta <= 2 pi, N."""
    path = float(zero_path(np.asarray(A), np.asarray(q), np.asarray(p)))
    tip = sigma * path * float(_mean_growth(np.asarray(-p * path)))
    back = theta <= np.pi
    gone = 2.0 * A * np.where(back, np.sin(theta / 2.0), np.cos(theta / 2.0)) ** 2
    after = leg(np.full(theta.shape, -tip), gone, sigma, q, p)
    return np.where(back, -after, after)


def leg(start: FloatArray, path: FloatArray, sigma: float, q: float, p: float) -> FloatArray:
    """Return w = s z after a path >= 0 in the direction s that began at w = `start`."""
    return _leg(start, path, sigma, q, p)[0]


def force_history(
    displacement: FloatArray, sigma: float, q: float, p: float, initial_force: float
) -> FloatArray:
    """Return the force at every sample of a displacement, unchecked; exact between samples.

    Parameters
    ----------
    displacement : ndarray, shape (n,)
        m; the motion between two samples is a straight line.
    sigma, q, p : float
        N/m, 1/m, 1/m.
    initial_force : float
        Force at the first sample, N.

    Returns
    -------
    ndarray, shape (n,)
        N.

    Examples
    --------
    >>> force_history(np.array([0.0, 1.0, 1.0, 0.0]), 1.0, 1.0, 1.0, 0.0).round(6)
    array([ 0.      ,  0.632121,  0.632121, -0.399576])
    """
    legs = stretches(displacement)
    at_turns = _turning_forces(legs.heading, legs.length, sigma, q, p, initial_force)
    w = legs.spread(legs.heading * at_turns)
    force = legs.spread(legs.heading) * leg(w, legs.path, sigma, q, p)
    force[0] = initial_force
    return force


def force_history_gradient(
    displacement: FloatArray, sigma: float, q: float, p: float, initial_force: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the force, its derivative by the initial force (n,) and by sigma, q, p (n, 3)."""
    legs = stretches(displacement)
    s, length = legs.heading, legs.length
    at_turns = _turning_forces(s, length, sigma, q, p, initial_force)
    _, keep, by = _leg(s[:-1] * at_turns[:-1], length, sigma, q, p)
    terms = np.zeros((length.size, 4))
    terms[:, 1:] = s[:-1, None] * by
    first = np.array([1.0, 0.0, 0.0, 0.0])
    turning = linear_recursion(keep, terms, first)
    w, keep, by = _leg(legs.spread(s * at_turns), legs.path, sigma, q, p)
    heading = legs.spread(s)
    gradient = keep[:, None] * legs.spread(turning)
    gradient[:, 1:] += heading[:, None] * by
    force = heading * w
    force[0] = initial_force
    return force, gradient[:, 0], gradient[:, 1:]


def _turning_forces(
    heading: FloatArray, length: FloatArray, sigma: float, q: float, p: float, start: float
) -> FloatArray:
    """Return the force at the start of every stretch: one leg after the other."""
    z, forces = start, [start]
    append = forces.append
    for s, gone in zip(heading.tolist(), length.tolist(), strict=False):
        w = s * z
        if w < 0.0:
            ratio = -p * w / sigma
            zero = (-w / sigma if ratio == 0.0 else log1p(ratio) / p) if ratio > -1.0 else inf
            if gone < zero:
                w = w * exp(-p * gone) - (sigma * expm1(-p * gone) / p if p else -sigma * gone)
                z = s * w
                append(z)
                continue
            gone, w = gone - zero, 0.0
        z = s * (w * exp(-q * gone) - (sigma * expm1(-q * gone) / q if q else -sigma * gone))
        append(z)
    return np.asarray(forces)


def _leg(
    start: FloatArray, path: FloatArray, sigma: float, q: float, p: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return w after a path, its derivative by `start`, and by sigma, q, p (n, 3)."""
    unloads = start < 0.0
    u = np.where(unloads, -start, 0.0)
    with np.errstate(all="ignore"):
        ratio = p * u / sigma
        zero = np.where(ratio > -1.0, u / sigma * _mean_logarithm(ratio), np.inf)
        crosses = unloads & (path >= zero)
        short = unloads & ~crosses
        rest = np.where(crosses, path - zero, path)
        rate = np.where(short, p, q)
        y = rate * rest
        fade = np.exp(-y)
        growth = rest * _mean_growth(y)
        w0 = np.where(crosses, 0.0, start)
        w = w0 * fade + sigma * growth
        by_rate = -rest * w0 * fade + sigma * rest**2 * _mean_growth_slope(y)
        left = sigma + p * u
        keep = np.where(crosses, sigma * fade / left, fade)
        # the path to zero force moves with the start, sigma and p
        moved = np.where(crosses, -sigma * fade, 0.0)
        zero_by_p = np.where(crosses, u / sigma, 0.0) ** 2
        zero_by_p = zero_by_p * _logarithm_slope(np.where(crosses, ratio, 0.0))
        zero_by_sigma = np.where(crosses, -u / (sigma * left), 0.0)
    by = np.empty((*np.shape(w), 3))
    by[..., 0] = growth + moved * zero_by_sigma
    by[..., 1] = np.where(short, 0.0, by_rate)
    by[..., 2] = np.where(short, by_rate, moved * zero_by_p)
    return w, keep, by


@lru_cache(maxsize=64)
def _rule(harmonic: int) -> tuple[FloatArray, FloatArray]:
    """Return Gauss points for each part of a branch; with fewer the harmonic loses digits."""
    return np.polynomial.legendre.leggauss(32 + harmonic)


def _mean_growth(y: FloatArray) -> FloatArray:
    """Return (1 - exp(-y))/y, 1 at 0."""
    y = np.asarray(y, dtype=np.float64)
    mean = np.divide(np.expm1(-y), y, out=np.full(np.shape(y), -1.0), where=y != 0.0)
    return np.asarray(-mean)


def _mean_growth_slope(y: FloatArray) -> FloatArray:
    """Return d/dy of (1 - exp(-y))/y, -1/2 at 0."""
    near = np.abs(y) < _SERIES
    far = np.where(near, 1.0, y)
    series = -1 / 2 + y * (1 / 3 + y * (-1 / 8 + y * (1 / 30 + y * (-1 / 144 + y / 840))))
    return np.where(near, series, (np.exp(-far) * (1.0 + far) - 1.0) / far**2)


def _log_growth(y: FloatArray) -> FloatArray:
    """Return the logarithm of (1 - exp(-y))/y, also where that overflows."""
    near = np.maximum(y, -_FADED)
    return np.where(y < -_FADED, -y - np.log(np.abs(y)), np.log(_mean_growth(near)))


def _log_growth_slope(y: FloatArray) -> FloatArray:
    """Return the derivative of :func:`_log_growth`."""
    near = np.maximum(y, -_FADED)
    slope = _mean_growth_slope(near) / _mean_growth(near)
    return np.where(y < -_FADED, -1.0 - 1.0 / np.minimum(y, -1.0), slope)


def _mean_logarithm(r: FloatArray) -> FloatArray:
    """Return ln(1 + r)/r, 1 at 0."""
    return np.divide(np.log1p(r), r, out=np.ones(np.shape(r)), where=r != 0.0)


def _logarithm_slope(r: FloatArray) -> FloatArray:
    """Return (r/(1 + r) - ln(1 + r))/r^2, -1/2 at 0."""
    near = np.abs(r) < _SERIES
    far = np.where(near, 1.0, r)
    series = np.zeros_like(r)
    for n in range(9, 1, -1):  # sum of (-1)^(n-1) (n-1)/n r^(n-2)
        series = series * r + (-1.0) ** (n - 1) * (n - 1) / n
    return np.where(near, series, (far / (1.0 + far) - np.log1p(far)) / far**2)


def _zero_path_gradient(
    A: FloatArray, q: FloatArray, p: FloatArray, path: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the derivatives of l0 by amplitude, q and p, from the equation of the closed loop."""
    rest = 2.0 * A - path
    with np.errstate(all="ignore"):
        # in G = ln(l g(-p l)) - ln(m g(q m)), g(y) = (1 - exp(-y))/y
        slope_path = np.where(A > 0.0, 1.0 / (path * _mean_growth(p * path)), 1.0)
        slope_rest = np.where(A > 0.0, 1.0 / (rest * _mean_growth(-q * rest)), 1.0)
        by_p = -path * _log_growth_slope(-p * path)
        by_q = -rest * _log_growth_slope(q * rest)
    both = slope_path + slope_rest
    return 2.0 * slope_rest / both, -by_q / both, -by_p / both

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
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.behaviour import HistoryGradient, StiffnessGradient
from dahl_ident.elements.friction import Friction
from dahl_ident.elements.half_cycle import angles, multiple, place, transform
from dahl_ident.elements.parameter import Parameter
from dahl_ident.elements.recursion import linear_recursion, stretches

_BLOCK = 384  # amplitudes in one pass: their arrays, 100 kB, stay in the processor's cache
_REST = 1e-150  # stands for an amplitude or an exponent of zero
_FADED = 42.0  # exp(-42) is below rounding
_NEAR = 0.1  # exponent below which E - 1 is integrated: beyond, E leaves the loss 14 digits
_PATHS = 2048  # solved together: their arrays stay in the processor's cache
_EQUAL = 4e-16  # width of a bracket, over l0, that is rounding
_LAST_STEP = 3e-9  # of l0: Newton's next step would be its square
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
        sigma, q, p = values
        h, *_ = stiffness_over_sigma(amplitude, q, p, harmonic, derivatives=False)
        return np.asarray(sigma * h)

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

    def stiffness_slope(
        self, values: Sequence[FloatArray], amplitude: FloatArray, omega: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return F/X of the fundamental and its derivative with respect to amplitude, unchecked."""
        found = self.stiffness_gradient(values, amplitude, omega)
        return found.value, found.by_amplitude

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
    arrays = np.broadcast_arrays(2.0 * np.asarray(amplitude, dtype=np.float64), q, p)
    span, q, p = (v.ravel() for v in arrays)
    found = np.zeros(span.shape)
    for start in range(0, span.size, _PATHS):
        rows = start + np.flatnonzero(span[start : start + _PATHS] > 0.0)
        found[rows] = _zero_path(span[rows], q[rows], p[rows])
    return found.reshape(arrays[0].shape)


def _zero_path(span: FloatArray, q: FloatArray, p: FloatArray) -> FloatArray:
    """Return l0 for the paths `span` > 0 between the turning points, (n,)."""
    found, going = np.empty(span.shape), np.arange(span.size)
    with np.errstate(all="ignore"):
        # exact for q = p: there the tip's force is sigma tanh(q A)/q
        half = np.where(q == 0.0, _REST, 0.5 * q * span)
        tip = 0.5 * span * np.tanh(half) / half
        path = tip * _mean_logarithm(np.maximum(p * tip, -0.9))
        path = np.where((path > 0.0) & (path < span), path, 0.5 * span)
        low, high = np.zeros(span.shape), span
        for _ in range(_NEWTON):
            rest = span - path
            up, down = p * path, q * rest
            one, other = path * _mean_growth(np.abs(up)), rest * _mean_growth(np.abs(down))
            # ln(expm1(p l)/p) - ln((1 - exp(-q m))/q), rising in l
            excess = np.log(one / other) + np.maximum(up, 0.0) + np.minimum(down, 0.0)
            slope = np.exp(np.minimum(up, 0.0)) / one + np.exp(-np.maximum(down, 0.0)) / other
            below = excess < 0.0
            low, high = np.where(below, path, low), np.where(below, high, path)
            step = excess / slope
            trial = path - step
            inside = (trial >= low) & (trial <= high) & (trial > 0.0) & (trial < span)
            settled = (inside & (np.abs(step) <= _LAST_STEP * path)) | (high - low <= _EQUAL * high)
            path = np.where(inside, trial, 0.5 * (low + high))
            found[going] = path
            if settled.all():
                break
            if 2 * np.count_nonzero(settled) > settled.size:
                kept = np.flatnonzero(~settled)
                going = going[kept]
                span, q, p, path, low, high = (v[kept] for v in (span, q, p, path, low, high))
    return found


def stiffness_over_sigma(
    amplitude: FloatArray,
    q: FloatArray,
    p: FloatArray,
    harmonic: int,
    *,
    derivatives: bool = True,
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Return N_k/sigma and, if wanted, its derivatives with respect to amplitude, q and p.

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
    arrays = np.broadcast_arrays(amplitude, q, p)
    shape = arrays[0].shape
    if harmonic % 2 == 0:
        zero = np.zeros(shape, dtype=np.complex128)
        return zero, zero, zero, zero
    A, q, p = (a.astype(np.float64).ravel() for a in arrays)
    path = zero_path(A, q, p)
    span = 2.0 * np.maximum(A, _REST)
    with np.errstate(divide="ignore"):
        last = np.where(q > 0.0, (path + _FADED / np.abs(q)) / span, 1.0)
    edges = place(np.stack([np.zeros_like(A), np.where(A > 0.0, path / span, 0.5), last]))
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * (edges[1:] - edges[:-1])
    # in microslip E is near 1, and only E - 1 is integrated, to keep its digits
    near = np.maximum(np.abs(p) * path, np.abs(q) * (2.0 * A - path)) < _NEAR
    total = np.zeros((3, 2, A.size), dtype=np.complex128)
    for start in range(0, A.size, _BLOCK):
        rows = slice(start, start + _BLOCK)
        for part, rate in enumerate((p, q)):
            total[:, part, rows] = _integrals(
                middle[part, rows],
                half[part, rows],
                rate[rows] * path[rows],
                2.0 * rate[rows] * A[rows],
                near[rows],
                harmonic,
                derivatives=derivatives,
            )
    total *= 2j / (np.pi * harmonic)
    value = total[0].sum(axis=0)
    if harmonic == 1:
        value += near
    by_A, by_q, by_p = np.zeros((3, A.size), dtype=np.complex128)
    if derivatives:
        _, first, second = total
        moves = _zero_path_gradient(A, q, p, path)
        along_A, along_q, along_p = (move * (p * first[0] + q * first[1]) for move in moves)
        held = path * first - 2.0 * A * second  # by the rate, the path held
        by_A = along_A - 2.0 * (p * second[0] + q * second[1])
        by_q, by_p = along_q + held[1], along_p + held[0]
    return value.reshape(shape), by_A.reshape(shape), by_q.reshape(shape), by_p.reshape(shape)


def _integrals(
    middle: FloatArray,
    half: FloatArray,
    at_tip: FloatArray,
    falls: FloatArray,
    near: NDArray[np.bool_],
    k: int,
    *,
    derivatives: bool,
) -> ComplexArray:
    """Return Int E sin(theta) exp(-j k theta) dtheta over one part of a branch, (3, n).

    E = exp(at_tip - falls u), u = sin^2(theta/2). First with E - 1 in place of E in rows that are
    `near`, then with E and with E u, if derivatives are wanted.
    """
    nodes, weights = _rule(k)
    versed, sine, width = angles(middle + half * nodes)  # (nodes, n)
    real, imag = multiple(versed, sine, k)
    growth = at_tip - falls * versed
    kernel = sine * width
    kernel *= half * weights
    weight = kernel * np.exp(growth)
    found = np.zeros((3, half.size), dtype=np.complex128)
    found[:2] = transform(weight, real, imag)
    if near.any():
        kernel = kernel[:, near] * np.expm1(growth[:, near])
        found[0, near] = transform(kernel, real[:, near], imag[:, near])
    if derivatives:
        weight *= versed
        found[2] = transform(weight, real, imag)
    return found


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
    force = legs.spread(legs.heading) * _leg(w, legs.path, sigma, q, p)[0]
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
    """Return w after a path, its derivative with respect to `start`, and by sigma, q, p (n, 3)."""
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
    nodes, weights = np.polynomial.legendre.leggauss(32 + harmonic)
    return nodes[:, None], weights[:, None]


def _mean_growth(y: FloatArray) -> FloatArray:
    """Return (1 - exp(-y))/y, 1 at 0."""
    y = np.where(np.asarray(y) == 0.0, _REST, y)
    return np.asarray(np.expm1(-y) / -y)


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

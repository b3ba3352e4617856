r"""Dahl friction with any exponent, in normalised variables: the loop and its harmonics.

While the direction of motion s is constant, Eqn. 2 reads ``dz/dd = -z^alpha``: z = 1 - s F/f_max is
the distance to full slip, d = sigma path / f_max the path. Everything here depends on
``beta = sigma A / f_max`` and ``alpha`` only. With ``p = 1 - alpha`` and
``z = z_0 exp(-l)``,

    d = z_0^p E(l),    E(l) = (1 - exp(-p l)) / p        (E(l) = l for alpha = 1).

**The loop closes** where the path 2 beta takes ``z_0 = 1 + f_0`` to ``z_1 = 1 - f_0``. With
``L = ln(z_0/z_1)``, that is ``f_0 = tanh(L/2)``, this is

    ln E(L) = ln(2 beta) + p ln((1 + exp(-L)) / 2).

Newton's method solves it for ln E in about four steps from any start, because the slope lies
between 1/2 and 2. For alpha < 1 and ``beta >= 2^-alpha / (1 - alpha)`` friction slips fully before
the motion turns, and L is infinite.

**Harmonics.** On the half cycle in which ``x = A cos(theta)`` falls, ``sin^2(theta/2) = d / 2 beta
= E(l)/E(L)``, and integration by parts of Eqns. 13 and 14 gives, for odd k,
``c_k = (a_k - j b_k)/f_max = (2j / pi k) Int exp(-j k theta) dz``. At small beta nearly all of dz
is that of a spring, whose integral cancels to rounding errors; with it taken out, and
``C = z_1^alpha``,

    c_k = C beta [k = 1] + (2j / pi k) Int_0^L exp(-j k theta) z (1 - exp(-alpha (L - l))) dl.

**Derivatives** are taken under the integral at constant z, where only theta changes. With
``w = 1 / (1 + exp(alpha L))`` and ``R(l) = ln z_0 + d ln E(l) / dp``,

    dc_k                         = (2 / pi) Int exp(-j k theta) dtheta dz,
    beta sin(theta) dtheta/dbeta = 2 (w - sin^2(theta/2)),
    sin(theta) dtheta/dalpha     = 2 (w R(L) - sin^2(theta/2) R(l)).

**Nodes** are ``l = L sin^2(phi/2)`` at equidistant phi, which resolves the square roots at both
turning points. Integrals over sin(k theta) take the midpoint rule, those over cos(k theta) Fejer's
weights; both converge geometrically.

**Accuracy**, for alpha from 0.25 to 4 and beta from 1e-6 to 1e6: N and the harmonics up to the
15th to 1e-12, derivatives to 1e-10 (``python -m benchmarks.general_dahl_accuracy``). The exception
is beta within 1e-12 of ``beta_s = 2^-alpha / (1 - alpha)``, where full slip sets in: for alpha
below 1/3 derivatives there change by up to 1e-5 with the last digit of beta.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray
from dahl_ident.elements.facts import Orders

_LEAST_BETA = 1e-200
"""Smaller loops are computed as one of this size, whose curvature underflows to zero."""

_DEEPEST = 44.0
"""Integrals over l end here: exp(-44) is negligible, even near a root where slip sets in."""

COUNTS = 1, 2, 4
"""Number of arrays that are returned for `derivatives` of 0, 1 and 2."""

_NODES_PER_BLOCK = 8192
"""Nodes computed at once, so that the scratch arrays fit in the cache."""


def stiffness(
    beta: FloatArray, alpha: FloatArray, k: Orders = 1, derivatives: int = 0
) -> tuple[ComplexArray, ...]:
    """Return h_k = N_k/sigma = c_k/beta (Eqns. 51 and 52, for any exponent), and derivatives.

    With `derivatives` of 1 also dN_k/d ln f_max = -beta dh/dbeta, over sigma; with 2 also
    dN_k/d ln sigma = h + beta dh/dbeta and dN_k/dalpha = dh/dalpha. All are 0 for even k. Loops are
    computed in blocks, with the nodes for the highest harmonic of the block.

    Examples
    --------
    >>> h, by_f_max, by_sigma, by_alpha = stiffness(np.array(1.0), np.array(2.0), 1, 2)
    >>> h.round(6)
    np.complex128(0.544039+0.354193j)
    >>> bool(abs(by_f_max + by_sigma - h) < 1e-15)  # N is homogeneous in f_max, sigma at fixed A
    True
    """
    shape = np.broadcast_shapes(beta.shape, alpha.shape, np.shape(k))
    b, a = (np.broadcast_to(v, shape).reshape(-1, 1) for v in (beta, alpha))
    order = np.broadcast_to(np.asarray(k), shape).reshape(-1, 1)
    odd = np.flatnonzero(order % 2)
    odd = odd[np.argsort(order[odd, 0], kind="stable")]
    rows = max(1, _NODES_PER_BLOCK // quadrature_rule(int(order.max(initial=1))).rise.size)
    results = [np.zeros(b.size, dtype=np.complex128) for _ in range(COUNTS[derivatives])]
    for i in range(0, odd.size, rows):
        block = odd[i : i + rows]
        pieces = _stiffness(b[block], a[block], order[block], derivatives)
        for target, piece in zip(results, pieces, strict=True):
            target[block] = piece[:, 0]
    return tuple(target.reshape(shape) for target in results)


def turning_force(beta: FloatArray, alpha: FloatArray) -> FloatArray:
    """Return f_0 = F/f_max at the displacement's maximum; tanh(beta) for alpha = 1 (Eqn. 8).

    Examples
    --------
    >>> turning_force(np.array([0.0, 1.5]), np.array(0.5))  # slips fully from beta = sqrt(2) on
    array([0., 1.])
    """
    closure = _close_loop(np.maximum(beta, _LEAST_BETA), alpha)
    return np.where(beta < _LEAST_BETA, beta, np.tanh(closure.length / 2.0))


class _Closure(NamedTuple):
    """Steady loops: p = 1 - alpha (never zero), E(L) = 2 beta / z_0^p, and L = ln(z_0/z_1)."""

    p: FloatArray
    path: FloatArray
    length: FloatArray


def _close_loop(beta: FloatArray, alpha: FloatArray) -> _Closure:
    """Solve ln E(L) = ln(2 beta) + p ln((1 + exp(-L))/2); full slip gives E = 2 beta / 2^p."""
    p = 1.0 - alpha
    p = np.where(p == 0.0, -1e-20, p)  # far below rounding; avoids every limit p -> 0
    path = 2.0 * beta * np.exp2(-np.maximum(p, 0.0))
    slips = p * path >= 1.0
    for _ in range(30):
        length = _length(p, path, slips)
        back = np.exp(-length)
        residual = np.log(path / (2.0 * beta)) - p * np.log((1.0 + back) / 2.0)
        slope = 1.0 + np.exp(-alpha * length) * p * path / (1.0 + back)
        step = np.where(slips, 0.0, residual / slope)
        path = path * np.exp(-step)
        if np.max(np.abs(step), initial=0.0) < 1e-8:  # the next one would be about its square
            break
    return _Closure(p, path, _length(p, path, slips))


def _length(p: FloatArray, path: FloatArray, slips: BoolArray) -> FloatArray:
    """Return L from E(L) = (1 - exp(-p L))/p, infinite for full slip."""
    full = slips | (p * path >= 1.0)
    return np.where(full, np.inf, -np.log1p(-np.where(full, 0.0, p * path)) / p)


class Rule(NamedTuple):
    """Quadrature over l = L sin^2(phi/2): integrals are L/2 times a weighted sum."""

    rise: FloatArray  # sin^2(phi/2)
    fall: FloatArray  # cos^2(phi/2)
    midpoint: FloatArray  # for integrands odd in phi, such as sin(theta)
    fejer: FloatArray  # for integrands even in phi, such as cos(theta)


@lru_cache
def quadrature_rule(k: int) -> Rule:
    """Return nodes and weights that resolve harmonic k; the number of nodes is empirical."""
    nodes = 48 + 8 * k
    phi = (np.arange(nodes) + 0.5) * np.pi / nodes
    order = np.arange(1, nodes // 2 + 1)
    series = np.cos(2.0 * np.outer(phi, order)) @ (1.0 / (4.0 * order**2 - 1.0))
    return Rule(
        rise=np.sin(phi / 2.0) ** 2,
        fall=np.cos(phi / 2.0) ** 2,
        midpoint=np.pi / nodes * np.sin(phi),
        fejer=2.0 / nodes * (1.0 - 2.0 * series),
    )


def _stiffness(
    beta: FloatArray, alpha: FloatArray, k: NDArray[np.int64], derivatives: int
) -> tuple[ComplexArray, ...]:
    """Return h_k of loops, (loops, 1), and its `derivatives` as :func:`stiffness` does."""
    beta = np.maximum(beta, _LEAST_BETA)
    p, path, length = _close_loop(beta, alpha)
    log_z0 = np.log1p(np.tanh(length / 2.0))
    line = np.exp(alpha * (log_z0 - length))  # C
    rule = quadrature_rule(int(k.max(initial=1)))
    reach = np.minimum(length, _DEEPEST)
    depth = reach * rule.rise  # l
    remaining = (length - reach) + reach * rule.fall
    scaled = p * path  # p E(L)
    sin2 = -np.expm1(-p * depth) / scaled  # of theta/2, as cos2
    slipped = 1.0 - 1.0 / np.maximum(scaled, 1.0)
    cos2 = np.exp(-p * depth) * -np.expm1(-p * remaining) / scaled + slipped
    z = np.exp(log_z0 - depth)
    curved = z * -np.expm1(-alpha * remaining)
    sin = 2.0 * np.sqrt(sin2 * cos2)
    sin_k, cos_k = sin, 1.0 - 2.0 * sin2
    if (k > 1).any():
        theta = 2.0 * np.arctan2(np.sqrt(sin2), np.sqrt(cos2))
        sin_k, cos_k = np.sin(k * theta), np.cos(k * theta)
    scale = reach / np.pi

    def integral(odd: FloatArray, even: FloatArray) -> ComplexArray:
        """Return Int (odd + j even) dl/pi over beta; 0 where it underflows, as at rest."""
        total = odd @ rule.midpoint[:, None] + 1j * (even @ rule.fejer[:, None])
        return np.asarray(scale * total / beta)

    curvature = integral(sin_k * curved, cos_k * curved) / k
    spring: ComplexArray = np.where(k == 1, line, 0.0) + 0j
    if not derivatives:
        return (spring + curvature,)

    def change(shift: FloatArray) -> ComplexArray:
        """Return (2/pi) Int exp(-j k theta) 2 shift/sin(theta) dl over beta."""
        shift = shift / sin
        return np.asarray(2.0 * np.conj(integral(cos_k * shift, sin_k * shift)))

    decay = np.exp(-alpha * length)
    w = decay / (1.0 + decay)
    # of c_k without C beta; the integral of exp(-j k theta) dtheta is -2j/k
    tilt = 4j / (np.pi * k) * (line * beta * np.tanh(alpha * length / 2.0) / beta)
    by_ln_beta = change((w - sin2) * curved) + tilt
    if derivatives == 1:
        return spring + curvature, curvature - by_ln_beta
    finite = np.where(np.isinf(length), 0.0, length)
    at_end = w * (log_z0 + finite * _log_slope(p * finite))
    by_alpha = change((at_end - sin2 * (log_z0 + depth * _log_slope(p * depth))) * z)
    # the derivative of C cancels
    return spring + curvature, curvature - by_ln_beta, spring + by_ln_beta, by_alpha


def _log_slope(u: FloatArray) -> FloatArray:
    """Return 1/expm1(u) - 1/u, which is (d ln E(l)/dp)/l at u = p l."""
    small = np.abs(u) < 0.5
    large = np.where(small, 1.0, u)
    v = np.where(small, u * u, 0.0)
    series = 1.0 - v / 60.0 * (1.0 - v / 42.0 * (1.0 - v / 40.0 * (1.0 - v / 39.6)))
    return np.where(small, u / 12.0 * series - 0.5, 1.0 / np.expm1(large) - 1.0 / large)

r"""Dahl friction with any exponent, in normalised variables: the loop, its harmonics, a table.

Eqn. 2 on a stretch of one direction is ``dz/dd = -z^alpha`` for the distance to full slip
``z = 1 - s F/f_max`` (s the direction of motion) over the path ``d = sigma path / f_max``.
Everything here depends on ``beta = sigma A / f_max`` and ``alpha`` alone. With
``p = 1 - alpha`` and ``z = z_0 exp(-l)`` the path is

    d = z_0^p E(l),    E(l) = (1 - exp(-p l)) / p        (E(l) = l for alpha = 1).

**The loop closes** where the path 2 beta takes ``z_0 = 1 + f_0`` to ``z_1 = 1 - f_0``. With
``L = ln(z_0 / z_1)``, that is ``f_0 = tanh(L/2)``,

    ln E(L) = ln(2 beta) + p ln((1 + exp(-L)) / 2),

which Newton's method solves in ``ln E`` in a few steps: the slope lies between 1/2 and 2. For
alpha < 1 and ``beta >= 2^(p-1) / p`` the friction slips fully before it turns: L is infinite.

**Harmonics.** Half a cycle is ``x = A cos(theta)``, ``sin^2(theta/2) = E(l) / E(L)``. Parts
integrate to ``c_k = (a_k - j b_k)/f_max = (2j / pi k) Int exp(-j k theta) dz`` for odd k. What
cancels at small beta is taken out exactly, with ``C = z_1^alpha``:

    c_k = C beta [k = 1] + (2j / pi k) Int_0^L exp(-j k theta) z (1 - exp(-alpha (L - l))) dl.

**Derivatives** follow under the integral at constant z, where only theta moves. With
``w = 1 / (1 + exp(alpha L))`` and ``R(l) = d ln E(l) / dp + ln z_0``,

    beta sin(theta) dtheta/dbeta  = 2 (w - sin^2(theta/2)),
    sin(theta) dtheta/dalpha      = 2 (w R(L) - sin^2(theta/2) R(l)),
    dc_k = (2/pi) Int exp(-j k theta) dtheta dz.

**Nodes** are ``l = L sin^2(phi/2)`` at equidistant phi, which resolves the square roots at both
turning points: the midpoint rule for integrals of ``sin(k theta)``, Fejer's weights for those
of ``cos(k theta)``. Both converge geometrically. Beyond l = 36 nothing is left of z.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray

_LEAST_BETA = 1e-200
"""Below this the loop is its own limit, a line: c_k = beta for k = 1, zero otherwise."""

_DEEPEST = 36.0
"""exp(-36) is below the resolution of a double."""

_NODES_PER_BLOCK = 4096
"""Nodes of quadrature in work at once: the scratch arrays stay in cache, and small."""


def describing_function(beta: FloatArray, alpha: FloatArray) -> ComplexArray:
    """Return h = N/sigma (Eqns. 51 and 52 for any exponent).

    Parameters
    ----------
    beta : ndarray
        sigma A / f_max >= 0; unchecked, broadcast with `alpha`.
    alpha : ndarray
        Exponent of Eqn. 2, > 0.

    Returns
    -------
    ndarray of complex

    Examples
    --------
    >>> describing_function(np.array([0.0, 1.0]), np.array(2.0)).round(6)
    array([1.      +0.j      , 0.544039+0.354193j])
    """
    return _by_blocks(_h, beta, alpha, 1)[0]


def describing_function_gradient(
    beta: FloatArray, alpha: FloatArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Return h = N/sigma and N's derivatives by ln f_max, ln sigma and alpha, over sigma.

    They are h, ``-beta dh/dbeta``, ``h + beta dh/dbeta`` and ``dh/dalpha``; the parameters are
    those of `describing_function`.

    Examples
    --------
    >>> h, by_f_max, by_sigma, by_alpha = describing_function_gradient(np.array(1.0), np.array(2.0))
    >>> bool(abs(by_f_max + by_sigma - h) < 1e-15)  # N is homogeneous in f_max, sigma at fixed A
    True
    """
    h, by_ln_f_max, by_ln_sigma, by_alpha = _by_blocks(_h_gradient, beta, alpha, 1)
    return h, by_ln_f_max, by_ln_sigma, by_alpha


def harmonic(beta: FloatArray, alpha: FloatArray, k: int) -> ComplexArray:
    """Return c_k = (a_k - j b_k)/f_max of Eqns. 13 and 14; exactly zero for even k.

    Parameters
    ----------
    beta, alpha : ndarray
        As in `describing_function`.
    k : int
        Harmonic, >= 1; c_1 is ``beta N/sigma``.

    Returns
    -------
    ndarray of complex

    Examples
    --------
    >>> print(f"{harmonic(np.array(1e6), np.array(2.0), 3).imag:.3f}")  # square wave: 4/(3 pi)
    0.424
    """
    if k % 2 == 0:
        return np.zeros(np.broadcast_shapes(beta.shape, alpha.shape), dtype=np.complex128)
    return _by_blocks(_c, beta, alpha, k)[0]


def harmonic_gradient(
    beta: FloatArray, alpha: FloatArray, k: int
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return c_k with ``beta dc_k/dbeta`` and ``dc_k/dalpha``; parameters as in `harmonic`.

    Examples
    --------
    >>> c, by_ln_beta, by_alpha = harmonic_gradient(np.array(1.0), np.array(2.0), 3)
    >>> by_ln_beta.shape
    ()
    """
    if k % 2 == 0:
        zero = harmonic(beta, alpha, k)
        return zero, zero.copy(), zero.copy()
    c, by_ln_beta, by_alpha = _by_blocks(_c_gradient, beta, alpha, k)
    return c, by_ln_beta, by_alpha


def turning_force(beta: FloatArray, alpha: FloatArray) -> FloatArray:
    """Return f_0 = F/f_max at the displacement's maximum; tanh(beta) for alpha = 1 (Eqn. 8).

    Parameters as in `describing_function`; a real array comes back.

    Examples
    --------
    >>> turning_force(np.array([0.0, 2.0]), np.array(0.5))  # slips fully from beta = sqrt(2) on
    array([0., 1.])
    """
    beta, alpha = np.broadcast_arrays(beta, alpha)
    length = _close_loop(np.maximum(beta, _LEAST_BETA), alpha).length
    return np.where(beta < _LEAST_BETA, beta, np.tanh(length / 2.0))


class _Closure(NamedTuple):
    """Steady loops: p = 1 - alpha (never zero), path E over z_0^p, length L = ln(z_0/z_1)."""

    p: FloatArray
    path: FloatArray
    length: FloatArray


def _close_loop(beta: FloatArray, alpha: FloatArray) -> _Closure:
    """Solve ln E(L) = ln(2 beta) + p ln((1 + exp(-L))/2) for E and L, by Newton's method."""
    p = 1.0 - alpha
    p = np.where(p == 0.0, -1e-20, p)  # far below rounding, and spares the limits p -> 0
    path = 2.0 * beta * np.minimum(1.0, np.exp2(-p))
    slips = p * path >= 1.0
    for _ in range(30):
        length = _length(p, path, slips)
        residual = np.log(path / (2.0 * beta)) - p * np.log((1.0 + np.exp(-length)) / 2.0)
        slope = 1.0 + np.exp(-alpha * length) * p * path / (1.0 + np.exp(-length))
        step = np.where(slips, 0.0, residual / slope)
        path = path * np.exp(-step)
        if np.max(np.abs(step), initial=0.0) < 1e-9:  # the next step would be its square
            break
    return _Closure(p, path, _length(p, path, slips))


def _length(p: FloatArray, path: FloatArray, slips: NDArray[np.bool_]) -> FloatArray:
    """Return L from E(L) = (1 - exp(-p L))/p; infinite where the friction slips fully."""
    full = slips | (p * path >= 1.0)
    return np.where(full, np.inf, -np.log1p(-np.where(full, 0.0, p * path)) / p)


class _Rule(NamedTuple):
    """Quadrature over phi in (0, pi); integrals over l are half their length times a sum."""

    rise: FloatArray  # sin^2(phi/2)
    fall: FloatArray  # cos^2(phi/2)
    midpoint: FloatArray  # weights for an odd function of phi, such as sin(theta)
    fejer: FloatArray  # weights for an even function of phi, such as cos(theta)


@lru_cache
def _rule(nodes: int) -> _Rule:
    phi = (np.arange(nodes) + 0.5) * np.pi / nodes
    order = np.arange(1, nodes // 2 + 1)
    series = np.cos(2.0 * np.outer(phi, order)) @ (1.0 / (4.0 * order**2 - 1.0))
    return _Rule(
        rise=np.sin(phi / 2.0) ** 2,
        fall=np.cos(phi / 2.0) ** 2,
        midpoint=np.pi / nodes * np.sin(phi),
        fejer=2.0 / nodes * (1.0 - 2.0 * series),
    )


def _number_of_nodes(k: int) -> int:
    return 64 + 8 * (k - 1)


class _Branch:
    """The descending half of steady loops at the nodes; arrays are (loops, nodes)."""

    def __init__(self, beta: FloatArray, alpha: FloatArray, k: int) -> None:
        self.k, self.beta = k, np.maximum(beta, _LEAST_BETA)
        rule = _rule(_number_of_nodes(k))
        self.p, path, self.length = _close_loop(self.beta, alpha)
        self.alpha = alpha
        length = self.length[:, None]
        reach = np.minimum(length, _DEEPEST)
        p, E = self.p[:, None], path[:, None]

        self.log_z0 = np.log1p(np.tanh(self.length / 2.0))
        self.l = reach * rule.rise
        rest = (length - np.where(np.isinf(length), 0.0, reach)) + reach * rule.fall
        fallen = -np.expm1(-p * self.l) / p
        self.s = fallen / E
        beyond = np.maximum(0.0, 1.0 - 1.0 / np.maximum(p * E, 1.0))
        remaining = (1.0 - p * fallen) * (-np.expm1(-p * rest) / p) / E + beyond
        self.sin = 2.0 * np.sqrt(self.s * remaining)
        self.cos = 1.0 - 2.0 * self.s
        self.z = np.exp(self.log_z0[:, None] - self.l)
        self.excess = -self.z * np.expm1(-alpha[:, None] * rest)
        self.line = np.exp(alpha * (self.log_z0 - self.length))  # C
        self.line_force = beta * self.line if k == 1 else np.zeros(beta.shape)
        self.half = np.where(beta < _LEAST_BETA, 0.0, reach[:, 0] / 2.0)
        self.rule = rule
        if k == 1:
            self.cos_k, self.sin_k = self.cos, self.sin
        else:
            theta = 2.0 * np.arctan2(np.sqrt(self.s), np.sqrt(remaining))
            self.cos_k, self.sin_k = np.cos(k * theta), np.sin(k * theta)

    def c_k(self) -> ComplexArray:
        """Return c_k - C beta [k = 1]."""
        real = self.half * ((self.sin_k * self.excess) @ self.rule.midpoint)
        imag = self.half * ((self.cos_k * self.excess) @ self.rule.fejer)
        return np.asarray(2.0 / (np.pi * self.k) * (real + 1j * imag))

    def _moved(self, shift: FloatArray) -> ComplexArray:
        """Return (2/pi) Int exp(-j k theta) shift/sin(theta) dl."""
        per_sin = shift / self.sin
        real = self.half * ((self.cos_k * per_sin) @ self.rule.midpoint)
        imag = self.half * ((self.sin_k * per_sin) @ self.rule.fejer)
        return np.asarray(2.0 / np.pi * (real - 1j * imag))

    def by_ln_beta(self) -> ComplexArray:
        """Return beta dc_k/dbeta - C beta [k = 1]."""
        decay = np.exp(-self.alpha * self.length)
        w = decay / (1.0 + decay)
        moved = self._moved(2.0 * (w[:, None] - self.s) * self.excess)
        T = (1.0 - decay) / (1.0 + decay)
        return moved + (4j / (np.pi * self.k)) * (self.line * self.beta * T)

    def by_alpha(self) -> ComplexArray:
        decay = np.exp(-self.alpha * self.length)
        finite = np.where(np.isinf(self.length), 0.0, self.length)
        w = decay / (1.0 + decay)
        whole = w * (self.log_z0 + finite * _log_slope(self.p * finite))
        here = self.log_z0[:, None] + self.l * _log_slope(self.p[:, None] * self.l)
        return self._moved(2.0 * (whole[:, None] - self.s * here) * self.z)


def _log_slope(u: FloatArray) -> FloatArray:
    """Return 1/expm1(u) - 1/u, which is (d ln E(l)/dp)/l at u = p l."""
    small = np.abs(u) < 0.5
    safe = np.where(small, 1.0, u)
    v = np.where(small, u, 0.0)
    v2 = v * v
    series = -0.5 + v / 12.0 * (
        1.0 - v2 / 60.0 * (1.0 - v2 / 42.0 * (1.0 - v2 / 40.0 * (1.0 - v2 * 10.0 / 396.0)))
    )
    return np.where(small, series, 1.0 / np.expm1(safe) - 1.0 / safe)


def _h(branch: _Branch) -> tuple[ComplexArray, ...]:
    return (branch.line + branch.c_k() / branch.beta,)


def _h_gradient(branch: _Branch) -> tuple[ComplexArray, ...]:
    curved, moved = branch.c_k() / branch.beta, branch.by_ln_beta() / branch.beta
    return (
        branch.line + curved,
        curved - moved,  # the line has gone: it cancels
        branch.line + moved,
        branch.by_alpha() / branch.beta,
    )


def _c(branch: _Branch) -> tuple[ComplexArray, ...]:
    return (branch.c_k() + branch.line_force,)


def _c_gradient(branch: _Branch) -> tuple[ComplexArray, ...]:
    line = branch.line_force
    return branch.c_k() + line, branch.by_ln_beta() + line, branch.by_alpha()


def _by_blocks(
    part: Callable[[_Branch], tuple[ComplexArray, ...]], beta: FloatArray, alpha: FloatArray, k: int
) -> list[ComplexArray]:
    """Return the outputs of `part` over all loops, few loops at a time."""
    beta, alpha = np.broadcast_arrays(beta, alpha)
    b, a = beta.ravel(), alpha.ravel()
    rows = max(1, _NODES_PER_BLOCK // _number_of_nodes(k))
    blocks = [
        part(_Branch(b[i : i + rows], a[i : i + rows], k)) for i in range(0, max(b.size, 1), rows)
    ]
    return [np.concatenate(pieces).reshape(beta.shape) for pieces in zip(*blocks, strict=True)]

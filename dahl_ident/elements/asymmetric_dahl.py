r"""Linear Dahl friction with two limits: +f_p while the motion rises, -f_m while it falls.

On the half cycles of x = A cos(theta), with b_p = sigma A/f_p and b_m = sigma A/f_m,

    rising    F = F_min + (f_p - F_min) (1 - exp(-b_p (1 - cos psi))),    psi = theta - pi
    falling   F = F_max - (f_m + F_max) (1 - exp(-b_m (1 - cos theta)))

and the tips solve ``F_max - F_min = (f_p - F_min) (1 - exp(-2 b_p))`` and
``F_max - F_min = (f_m + F_max) (1 - exp(-2 b_m))``, two linear equations. With
``D_k(b) = (1/pi) Int_0^pi (1 - exp(-b (1 - cos psi))) exp(-j k psi) dpsi`` every harmonic, even
ones and the mean included, is a sum of two of them.

Re D_k is a Bessel function, ``[k = 0] - exp(-b) I_k(b)``. Im D_k is an integral of an exponential
times a polynomial of cos psi: for k = 1, ``-(2/pi) (1 - (1 - exp(-2 b))/(2 b))``; for others
Gauss-Legendre points serve at small b, Gauss-Laguerre's at large b.
"""

from __future__ import annotations

import numpy as np
from scipy.special import i0e, i1e, ive

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.behaviour import StiffnessGradient

_LARGE = 30.0  # b beyond which exp(-2 b) is nothing
HIGHEST = 48  # harmonic that both rules resolve
_NODES = 2 * HIGHEST  # with one node a harmonic the highest errs by 1e-5
_BLOCK = 256  # amplitudes in one pass: their arrays stay in the processor's cache
_NEAR = 1.0  # b below which 1 - (1 - exp(-2 b))/(2 b) takes Gauss points
_FEW = np.polynomial.legendre.leggauss(8)  # to rounding; of 7 points the error is 1e-15
_LEGENDRE = np.polynomial.legendre.leggauss(_NODES)
_LAGUERRE = np.polynomial.laguerre.laggauss(HIGHEST // 2 + 1)  # exact to degree 49


def stiffness(
    amplitude: FloatArray,
    f_max: FloatArray,
    sigma: FloatArray,
    asymmetry: FloatArray,
    harmonic: int,
) -> ComplexArray:
    """Return F_k/X_1, for k = 0 the mean force over the amplitude.

    Parameters
    ----------
    amplitude : ndarray
        A > 0, m.
    f_max, sigma : ndarray
        Mean of both limits, N, and contact stiffness, N/m; broadcast with `amplitude`.
    asymmetry : ndarray
        Between -1 and 1: the limits are f_max (1 + asymmetry) and f_max (1 - asymmetry).
    harmonic : int
        k, from 0 to 48.

    Returns
    -------
    ndarray of complex
        N/m.

    Examples
    --------
    >>> one = np.ones(())
    >>> complex(stiffness(1e-3 * one, one, 2000.0 * one, 0.2 * one, 2).round(4))
    (38.9112+47.5316j)
    """
    at = _Loop(amplitude, f_max, sigma, asymmetry)
    up, down = (_integral(b, harmonic)[0] for b in at.b)
    return np.asarray(at.force(up, down, harmonic) / amplitude)


def gradient(
    amplitude: FloatArray,
    f_max: FloatArray,
    sigma: FloatArray,
    asymmetry: FloatArray,
    harmonic: int,
) -> StiffnessGradient:
    """Return F_k/X_1 with its derivatives by f_max, sigma and asymmetry; see :func:`stiffness`."""
    at = _Loop(amplitude, f_max, sigma, asymmetry)
    up, down = (_integral(b, harmonic) for b in at.b)
    force = at.force(up[0], down[0], harmonic)
    by_up, by_down = at.slopes(up, down, harmonic)
    b_up, b_down = at.b
    both = by_up * b_up + by_down * b_down  # by ln A at constant limits
    by_asymmetry = by_down * b_down / (1.0 - asymmetry) - by_up * b_up / (1.0 + asymmetry)
    if harmonic == 0:
        by_asymmetry = by_asymmetry + f_max
    by = ((force - both) / f_max, both / sigma, by_asymmetry)
    value = force / amplitude
    return StiffnessGradient(
        value, (both - force) / amplitude**2, tuple(np.asarray(d / amplitude) for d in by)
    )


class _Loop:
    """Both branches: b of each, and u = f_p - F_min, v = f_m + F_max, with u p = v m."""

    def __init__(
        self, A: FloatArray, f_max: FloatArray, sigma: FloatArray, asymmetry: FloatArray
    ) -> None:
        up, down = f_max * (1.0 + asymmetry), f_max * (1.0 - asymmetry)
        self.b = np.asarray(sigma * A / up), np.asarray(sigma * A / down)
        self._limits = up, down
        self._p, self._m = (-np.expm1(-2.0 * b) for b in self.b)
        self._either = -np.expm1(-2.0 * (self.b[0] + self.b[1]))  # m + p - p m
        # u + v - u p = f_p + f_m
        self._u = (up + down) * self._m / self._either
        self._v = (up + down) * self._p / self._either

    def force(self, D_up: ComplexArray, D_down: ComplexArray, k: int) -> ComplexArray:
        """Return c_k (for k = 0 the mean force) from the integrals of both branches."""
        u, v = self._u, self._v
        if k == 0:
            up, down = self._limits
            mean = 0.5 * (v - down + up - u)  # of both tips
            return np.asarray(mean + 0.5 * (u * D_up - v * D_down))
        total = (-1) ** k * u * D_up - v * D_down
        return np.asarray(total - 2j / (np.pi * k) * (u * self._p) if k % 2 else total)

    def slopes(
        self, up: tuple[ComplexArray, ComplexArray], down: tuple[ComplexArray, ComplexArray], k: int
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the derivatives of :meth:`force` by b of each branch, limits held."""
        p, m, u, v = self._p, self._m, self._u, self._v
        p1, m1 = 2.0 * (1.0 - p), 2.0 * (1.0 - m)
        share = (self._limits[0] + self._limits[1]) / self._either**2
        u_by, v_by = (-share * m * (1.0 - m) * p1, share * p * m1), (
            share * m * p1, -share * p * (1.0 - p) * m1,
        )  # fmt: skip
        results = []
        for i, (du, dv) in enumerate(zip(u_by, v_by, strict=True)):
            one, other = (up[1], 0.0) if i == 0 else (0.0, down[1])
            if k == 0:
                total = 0.5 * (dv - du + du * up[0] + u * one - dv * down[0] - v * other)
            else:
                total = (-1) ** k * (du * up[0] + u * one) - dv * down[0] - v * other
            if k % 2:
                swing = du * p + (u * p1 if i == 0 else 0.0)
                total = total - 2j / (np.pi * k) * swing
            results.append(np.asarray(total))
        return results[0], results[1]


def _integral(b: FloatArray, k: int) -> tuple[ComplexArray, ComplexArray]:
    """Return D_k(b) and its derivative with respect to b."""
    flat = b.reshape(-1)
    if k == 1:
        one, other = _fundamental(flat)
        return one.reshape(b.shape), other.reshape(b.shape)
    both = np.empty((2, flat.size), dtype=np.complex128)
    for start in range(0, flat.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        both[:, block] = _quadrature(flat[block], k)
    return both[0].reshape(b.shape), both[1].reshape(b.shape)


def _fundamental(b: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return D_1 and its derivative, in closed form."""
    zeroth, first = i0e(b), i1e(b)
    D, by_b = (np.empty(b.shape, dtype=np.complex128) for _ in range(2))
    D.real = -first
    by_b.real = first + first / b - zeroth
    y = 2.0 * np.maximum(b, 0.5 * _NEAR)
    fade = np.exp(-y)
    loss = 1.0 - (1.0 - fade) / y
    slope = 2.0 * ((1.0 - fade) / y - fade) / y
    near = b < _NEAR
    if near.any():
        s, weights = 0.5 * (1.0 + _FEW[0]), 0.5 * _FEW[1]
        small = 2.0 * b[near][:, None] * s
        loss[near] = -np.expm1(-small) @ weights
        slope[near] = np.exp(-small) @ (2.0 * s * weights)
    D.imag, by_b.imag = (-2.0 / np.pi) * loss, (-2.0 / np.pi) * slope
    return D, by_b


def _quadrature(b: FloatArray, k: int) -> tuple[ComplexArray, ComplexArray]:
    nodes, weights = _LEGENDRE
    psi = 0.5 * np.pi * (1.0 + nodes)
    versed = 2.0 * np.sin(0.5 * psi) ** 2
    kernel = 0.5 * weights * np.exp(-1j * k * psi)
    gone = np.expm1(-np.minimum(b, _LARGE)[..., None] * versed)
    near, near_slope = -gone @ kernel, (1.0 + gone) @ (versed * kernel)
    large = np.maximum(b, _LARGE)
    s, share = _LAGUERRE
    angle = np.arccos(1.0 - np.minimum(s / large[..., None], 2.0))
    sine = np.sin(k * angle) / np.where(angle > 0.0, np.sin(angle), 1.0)
    loss = (sine @ share) / (np.pi * large) - (1 - (-1) ** k) / (np.pi * max(k, 1))
    far = float(k == 0) - ive(k, large) + 1j * loss
    between = 0.5 * (ive(abs(k - 1), large) + ive(k + 1, large)) - ive(k, large)
    far_slope = -between - 1j * ((s * sine) @ share) / (np.pi * large**2)
    return np.where(b < _LARGE, near, far), np.where(b < _LARGE, near_slope, far_slope)

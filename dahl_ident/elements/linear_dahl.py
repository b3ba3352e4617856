"""The linear Dahl model (alpha = 1) in closed form.

All variables are normalised: the amplitude is `beta = sigma A / f_max`, forces are divided by
`f_max`, the describing function by `sigma`. The formulas are those of the page "Theory"; for odd
`k`, with `c_k = (a_k - j b_k) / f_max` and `h = N/sigma = c_1/beta`,

    Re c_k = 2 I_k(beta) / cosh(beta)
    Im c_k = (2/pi) Int_-1^1 U_(k-1)(t) D(t) dt,       D(t) = 1 - cosh(beta t) / cosh(beta)

**Derivatives.** With `q = 1 - tanh(beta)/beta`, `v = tanh(beta)/beta - sech(beta)^2` and the decay
`p = -d ln(Re h) / d ln(beta)`, which rises from 0 to 3/2,

    Re(-beta h') = p Re h              Im(-beta h') = (4/pi) (q - v) / beta
    Re(h + beta h') = (1 - p) Re h     Im(h + beta h') = (4/pi) v / beta
    p = 2 - beta (I_0/I_1 - tanh beta) = beta (tanh beta - I_2/I_1)

`q`, `v` and `p` are computed so that they keep all digits:

- below `beta` of 0.2 from the continued fractions of `beta coth(beta)` and of `I_2/I_1`, whose
  terms are all positive, and from `v = tanh(beta)^2 - q`;
- above 300, `p` from the asymptotic series of `beta (I_0/I_1 - 1)` in `1/beta`;
- in between, from the formulas above, with exponentially scaled Bessel functions,
  `I_1/cosh(beta) = (1 + tanh beta) I_1 exp(-beta)`.

**Harmonics.** Up to `beta` of 75 (or `k^2/3`, if larger) `Re c_k` is a scaled Bessel function and
`Im c_k` a Fejer quadrature over equally spaced angles, with the product

    D(t) = (1 + tanh beta)/2 expm1(-beta (1 - t)) expm1(-beta (1 + t))

Above, `Re c_k` follows from the asymptotic series of `I_k`, and `Im c_k` from repeated integration
by parts, which ends because `U` is a polynomial.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy import fft, special

from dahl_ident.arrays import BoolArray, ComplexArray, FloatArray, IntArray

_AMPLITUDES_AT_ONCE = 8192
"""Amplitudes computed together, so that intermediate arrays stay in the processor's cache."""

_BLOCK_NODES = 65536
"""The same for harmonics: number of amplitudes times that of nodes of the quadrature."""

_SMALL, _LARGE = 0.2, 300.0
"""Below and above these beta the formulas lose digits."""

_SMALLEST_BETA = 1e-200
"""Replaces beta = 0 in quotients, which then give their limits."""

_COTH_DENOMINATORS = (3.0, 5.0, 7.0, 9.0, 11.0)  # below _SMALL the next, 13, changes 2e-16
_BESSEL_DENOMINATORS = (4.0, 6.0, 8.0, 10.0, 12.0)  # below _SMALL the next, 14, changes 5e-17
_BESSEL_ASYMPTOTICS = (1 / 2, 3 / 8, 3 / 8, 63 / 128, 27 / 32, 1899 / 1024)  # error 7e-15 at _LARGE
_FOUR_BY_PI = 4.0 / math.pi  # the fundamental of a square wave


def describing_function(beta: FloatArray) -> ComplexArray:
    """Return h(beta) = N/sigma, the universal curve of the linear Dahl model.

    1 at ``beta = 0``; real and imaginary part each within 1e-13 relative, for any shape of beta.

    Examples
    --------
    >>> describing_function(np.array([0.0, 1.0])).round(6)
    array([1.      +0.j      , 0.732508+0.303548j])
    """
    flat, h = beta.reshape(-1), np.empty(beta.size, np.complex128)
    for block in _blocks(beta.size, _AMPLITUDES_AT_ONCE):
        b = flat[block]
        tanh, inverse, _, h.real[block] = _bessel_part(b)
        h.imag[block] = _loss(b, _indices(b < _SMALL), inverse, tanh * inverse)
    return h.reshape(beta.shape)


def describing_function_gradient(
    beta: FloatArray,
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return h, -beta h' and h + beta h': N, dN/d ln f_max and dN/d ln sigma, over sigma.

    Real and imaginary parts are computed without cancellation: each is accurate except near a
    change of its sign.

    Examples
    --------
    >>> h, by_ln_f_max, by_ln_sigma = describing_function_gradient(np.array(1e6))
    >>> print(f"{by_ln_f_max:.6g} {by_ln_sigma:.6g}")
    2.39365e-09+1.27324e-06j -7.97884e-10+1.27324e-12j
    """
    # one allocation, because three smaller ones may cost fresh pages at every call
    flat, result = beta.reshape(-1), np.empty((3, beta.size), np.complex128)
    real, imag = result.real, result.imag
    for block in _blocks(beta.size, _AMPLITUDES_AT_ONCE):
        b = flat[block]
        small = _indices(b < _SMALL)
        tanh, inverse, i1e, stiffness = _bessel_part(b)
        softening = _decay(b, small, inverse, tanh, i1e) * stiffness
        real[0, block], real[1, block] = stiffness, softening
        real[2, block] = stiffness - softening
        ratio = tanh * inverse
        loss = _loss(b, small, inverse, ratio)
        loss_by_ln_sigma = _loss_by_ln_sigma(small, inverse, tanh, ratio, loss)
        imag[0, block], imag[2, block] = loss, loss_by_ln_sigma
        imag[1, block] = loss - loss_by_ln_sigma
    h, by_ln_f_max, by_ln_sigma = result.reshape(3, *beta.shape)
    return h, by_ln_f_max, by_ln_sigma


def _blocks(size: int, length: int) -> list[slice]:
    return [slice(start, start + length) for start in range(0, size, length)]


def _indices(condition: BoolArray) -> IntArray:
    """Return the indices where `condition` holds, which are faster to use than a mask."""
    return condition.nonzero()[0]


def _bessel_part(b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return tanh(beta), 1/beta, I_1 exp(-beta) and Re h."""
    positive = np.maximum(b, _SMALLEST_BETA)
    tanh = np.tanh(b)
    inverse = 1.0 / positive
    i1e = special.i1e(positive)
    stiffness = 2.0 * (1.0 + tanh) * (i1e * inverse)
    # rounding must not raise it above its value at rest
    return tanh, inverse, i1e, np.minimum(stiffness, 1.0)


def _loss(b: FloatArray, small: IntArray, inverse: FloatArray, ratio: FloatArray) -> FloatArray:
    """Return Im h = (4/pi) q/beta, given 1/beta and tanh(beta)/beta."""
    loss = _FOUR_BY_PI * (1.0 - ratio) * inverse
    if small.size:
        s = b[small]
        t = s * s
        # beta coth(beta) - 1 = t/f, hence q = t/(t + f)
        loss[small] = _FOUR_BY_PI * s / (t + _continued_fraction(t, _COTH_DENOMINATORS))
    return loss


def _loss_by_ln_sigma(
    small: IntArray,
    inverse: FloatArray,
    tanh: FloatArray,
    ratio: FloatArray,
    loss: FloatArray,
) -> FloatArray:
    """Return Im(h + beta h') = (4/pi) v/beta."""
    result = _FOUR_BY_PI * (ratio - (1.0 - tanh) * (1.0 + tanh)) * inverse
    if small.size:
        result[small] = _FOUR_BY_PI * tanh[small] * ratio[small] - loss[small]
    return result


def _decay(
    b: FloatArray, small: IntArray, inverse: FloatArray, tanh: FloatArray, i1e: FloatArray
) -> FloatArray:
    """Return p = -d ln(Re h) / d ln(beta)."""
    decay = 2.0 - b * (special.i0e(b) / i1e - tanh)
    if small.size:
        s = b[small]
        bessel_ratio = s / _continued_fraction(s * s, _BESSEL_DENOMINATORS)
        decay[small] = s * (tanh[small] - bessel_ratio)
    large = _indices(b > _LARGE)
    if large.size:
        decay[large] = 2.0 - polyval(inverse[large], _BESSEL_ASYMPTOTICS)
    return decay


def _continued_fraction(t: FloatArray, denominators: tuple[float, ...]) -> FloatArray:
    """Return d_0 + t/(d_1 + t/(d_2 + ...))."""
    *others, last = denominators
    value = others.pop() + t / last
    for d in reversed(others):
        value = d + t / value
    return value


def harmonic_gradient(beta: FloatArray, k: int) -> tuple[ComplexArray, ComplexArray]:
    """Return c_k = (a_k - j b_k)/f_max, the k-th Fourier coefficient, and beta dc_k/dbeta.

    Exactly 0 for even `k`; ``beta h(beta)`` for ``k = 1``; otherwise the error is within 1e-12 of
    the larger part up to ``k = 15``, and 1e-9 at 101. The derivatives of ``f_max c_k`` with respect
    to ln sigma and ln f_max are ``f_max beta dc_k/dbeta`` and ``f_max (c_k - beta dc_k/dbeta)``.

    Examples
    --------
    >>> harmonic_gradient(np.array([0.5, 50.0]), 3)[0].round(6)
    array([0.004691-0.01893j , 0.206589+0.352012j])
    """
    if k == 1:
        h, _, by_ln_sigma = describing_function_gradient(beta)
        return beta * h, beta * by_ln_sigma
    flat, c, slope = beta.reshape(-1), *np.zeros((2, beta.size), np.complex128)
    if k % 2:
        for block in _blocks(beta.size, 1 + _BLOCK_NODES // _node_count(k)):
            b = flat[block]
            large = b > _harmonic_limit(k)
            for part, compute in ((_indices(~large), _quadrature), (_indices(large), _asymptotics)):
                if part.size:
                    c[block][part], slope[block][part] = compute(b[part], k)
    return c.reshape(beta.shape), slope.reshape(beta.shape)


def _harmonic_limit(k: int) -> float:
    return max(75.0, k * k / 3.0)


def _node_count(k: int) -> int:
    """Return the number of nodes in a quarter period that resolve exp(beta cos) at the limit."""
    return int(math.sqrt(20.0 * _harmonic_limit(k))) + 8


@lru_cache(maxsize=64)
def _chebyshev_rule(k: int) -> tuple[FloatArray, FloatArray]:
    """Return angles in (0, pi/2) and weights of (2/pi) Int_-1^1 U_(k-1)(cos) f(cos) d cos, f even.

    With f as a sum of cos(m angle), even m, over equally spaced angles (Fejer), each term gives
    Int_0^pi sin(k angle) cos(m angle) = 2 k / (k^2 - m^2).
    """
    half = _node_count(k)
    angle = (math.pi / (2 * half)) * np.arange(0.5, half)
    m = np.arange(0, 2 * half, 2)
    moments = 2.0 * k / (k * k - m * m)
    return angle, (2.0 / (math.pi * half)) * fft.dct(moments, type=3)


def _quadrature(b: FloatArray, k: int) -> tuple[ComplexArray, ComplexArray]:
    angle, weight = _chebyshev_rule(k)
    tanh = np.tanh(b)
    scale = 1.0 + tanh
    bessel = 2.0 * scale * special.ive(k, b)
    bessel_slope = (k - b * tanh) * bessel + 2.0 * b * scale * special.ive(k + 1, b)

    near = np.expm1(np.outer(b, -2.0 * np.sin(angle / 2.0) ** 2))
    far = np.expm1(np.outer(b, -2.0 * np.cos(angle / 2.0) ** 2))
    loss = 0.5 * scale * ((near * far) @ weight)
    # beta dD/dbeta = beta (tanh(beta) cosh(beta t) - t sinh(beta t)) / cosh(beta)
    loss_slope = (0.5 * b * scale) * (
        tanh * ((2.0 + near + far) @ weight) - (near - far) @ (np.cos(angle) * weight)
    )
    return bessel + 1j * loss, bessel_slope + 1j * loss_slope


def _asymptotics(b: FloatArray, k: int) -> tuple[ComplexArray, ComplexArray]:
    bessel, bessel_slope = _asymptotic_sum(
        b, 0.5, [-(4 * k * k - (2 * m - 1) ** 2) / (8 * m) for m in range(1, 24)]
    )
    edge, edge_slope = _asymptotic_sum(
        b, 1.0, [-(k * k - m * m) / (2 * m + 1) for m in range(1, min(k, 24))]
    )
    a, e = 4.0 / math.sqrt(2.0 * math.pi), 4.0 * k / math.pi
    c = a * bessel + 1j * (4.0 / (math.pi * k) - e * edge)
    return c, a * bessel_slope - 1j * e * edge_slope


def _asymptotic_sum(
    b: FloatArray, power: float, ratios: list[float]
) -> tuple[FloatArray, FloatArray]:
    """Return S = beta^-power (1 + r_1/beta (1 + r_2/beta (1 + ...))) and beta dS/dbeta."""
    term: FloatArray = np.power(b, -power)
    total: FloatArray = term.copy()
    slope: FloatArray = -power * term
    for m, ratio in enumerate(ratios, start=1):
        term = term * (ratio / b)
        total += term
        slope -= (power + m) * term
    return total, slope

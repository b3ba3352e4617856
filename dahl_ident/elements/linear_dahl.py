"""The linear Dahl model (alpha = 1) in closed form.

All variables are normalised: the amplitude is `beta = sigma A / f_max`, forces are divided by
`f_max`, the describing function by `sigma`. The formulas are those of the page "Theory",

    Re h = 2 I_1(beta) / (beta cosh(beta)),    Im h = (4/pi) (1 - tanh(beta)/beta) / beta.

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
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy import special

from dahl_ident.arrays import ComplexArray, FloatArray

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
    return describing_function_gradient(beta)[0]


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
    b = np.maximum(beta, _SMALLEST_BETA).reshape(-1)
    tanh, i1e = np.tanh(b), special.i1e(b)
    ratio = tanh / b
    # rounding must not raise it above its value at rest
    stiffness = np.minimum(2.0 * (1.0 + tanh) * (i1e / b), 1.0)
    decay = 2.0 - b * (special.i0e(b) / i1e - tanh)  # p
    loss = _FOUR_BY_PI * (1.0 - ratio) / b
    loss_by_ln_sigma = _FOUR_BY_PI * (ratio - (1.0 - tanh) * (1.0 + tanh)) / b
    small, large = b < _SMALL, b > _LARGE
    if small.any():
        s, th = b[small], tanh[small]
        t = s * s
        # beta coth(beta) - 1 = t/f, hence q = t/(t + f)
        loss[small] = _FOUR_BY_PI * s / (t + _continued_fraction(t, _COTH_DENOMINATORS))
        loss_by_ln_sigma[small] = _FOUR_BY_PI * th * ratio[small] - loss[small]
        decay[small] = s * (th - s / _continued_fraction(t, _BESSEL_DENOMINATORS))
    if large.any():
        decay[large] = 2.0 - polyval(1.0 / b[large], _BESSEL_ASYMPTOTICS)
    h = stiffness + 1j * loss
    by_ln_f_max = decay * stiffness + 1j * (loss - loss_by_ln_sigma)
    by_ln_sigma = stiffness - decay * stiffness + 1j * loss_by_ln_sigma
    shape = beta.shape
    return h.reshape(shape), by_ln_f_max.reshape(shape), by_ln_sigma.reshape(shape)


def _continued_fraction(t: FloatArray, denominators: tuple[float, ...]) -> FloatArray:
    """Return d_0 + t/(d_1 + t/(d_2 + ...))."""
    *others, last = denominators
    value = others.pop() + t / last
    for d in reversed(others):
        value = d + t / value
    return value

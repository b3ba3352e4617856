r"""Linear Dahl friction behind a gap, as integrals of one exponential.

In units of f_max and x_c, with beta = A/x_c and eta = gap/(2 x_c), the element moves through
2 (beta - eta) between its turning points, at which its force is f0 = tanh(beta - eta). With y the
element's path since the last turning point, dF/dy = -(1 + f0) exp(-y), and the force is zero at
y1 = ln(1 + f0), where the gap is crossed. So (partial integration, odd k)

    N_k/sigma = (2 j/(pi k beta)) (1 + f0) Int_0^(2 (beta - eta)) exp(-y - j k theta) dy,

with beta (1 - cos theta) = y before the gap and y + 2 eta beyond it. Both parts are integrated by
Gauss points over tan(theta/4), where exp(-y) spans few decades: the first part ends at
exp(-y) >= 1/2, the second where exp(-y) is below rounding.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.half_cycle import angles, multiple, place, transform

_BLOCK = 512  # amplitudes in one pass: their arrays stay in the processor's cache
_RULES = tuple(np.array(np.polynomial.legendre.leggauss(n))[..., None] for n in (16, 28))
"""Gauss points before and behind the gap; with 10 before it, derivatives err by 1e-5."""

_FADED = 42.0  # exp(-42) is below rounding
_SMALLEST = 1e-12  # beta - eta that counts as contact
HIGHEST = 9  # harmonic that the Gauss points resolve


def curve(
    beta: FloatArray, eta: FloatArray, harmonic: int, *, derivatives: bool = True
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return N_k/sigma and, if wanted, its derivatives by beta and eta; 0 where beta <= eta.

    Parameters
    ----------
    beta, eta : ndarray, shape (n,)
        A/x_c > 0 and gap/(2 x_c) > 0.
    harmonic : int
        k, from 0 to 9; even harmonics vanish.

    Returns
    -------
    tuple of three ndarray of complex, shape (n,)

    Examples
    --------
    >>> value, _, _ = curve(np.array([6.0]), np.array([1.2]), 1)
    >>> print((3.0 * value).round(7))
    [0.3901538+0.4032069j]
    """
    found = np.zeros((3, beta.size), dtype=np.complex128)
    moving = np.flatnonzero(beta - eta > _SMALLEST * beta)
    if harmonic % 2:
        for start in range(0, moving.size, _BLOCK):
            rows = moving[start : start + _BLOCK]
            found[:, rows] = _integrals(beta[rows], eta[rows], harmonic, derivatives)
    return found[0], found[1], found[2]


def _integrals(
    beta: FloatArray, eta: FloatArray, k: int, derivatives: bool
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    span = 2.0 * (beta - eta)
    f0 = np.tanh(0.5 * span)
    y1 = np.log1p(f0)
    ends = np.minimum(span, y1 + _FADED)
    # sin^2(theta/2) where each part begins and ends
    versed = 0.5 * np.stack([np.zeros_like(y1), y1, y1 + 2.0 * eta, ends + 2.0 * eta]) / beta
    edges = place(versed)
    total, moved, beyond = (np.zeros(beta.shape, dtype=np.complex128) for _ in range(3))
    for (nodes, weights), begin, stop, gap in zip(
        _RULES, edges[::2], edges[1::2], (0.0 * eta, 2.0 * eta), strict=True
    ):
        half = 0.5 * (stop - begin)
        versed, sine, width = angles(begin + half * (1.0 + nodes))  # (nodes, n)
        fade = np.exp(gap - 2.0 * beta * versed)
        fade *= half * weights * width
        real, imag = multiple(versed, sine, k)
        # Int exp(-y - j k theta) times sin theta, 1 and 1 - cos theta
        total += beta * transform(fade * sine, real, imag)
        if not derivatives:
            continue
        moved += 2.0 * transform(fade * versed, real, imag)
        beyond = transform(fade, real, imag)  # in the end that of the second part
    factor = 2j / (np.pi * k * beta)
    value = factor * (1.0 + f0) * total
    if not derivatives:
        return value, moved, beyond
    grown = (1.0 + f0) * (1.0 - f0)  # of f0 by beta - eta
    last = 2.0 * np.exp(-span) * (-1.0) ** k
    versed, sine, _ = angles(edges[1:3])
    real, imag = multiple(versed, sine, k)
    jump = np.exp(-y1) * (real[0] - real[1] - 1j * (imag[0] - imag[1])) * (1.0 - f0)
    common = grown * total + (1.0 + f0) * (last + jump)  # by beta - eta, theta held
    by_beta = factor * (common + (1.0 + f0) * 1j * k * moved) - value / beta
    by_eta = factor * (-common - (1.0 + f0) * 2j * k * beyond)
    return value, by_beta, by_eta

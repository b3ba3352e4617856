r"""Dahl friction at many amplitudes and exponents at once: series in place of quadratures.

Posteriors ask for h = N/sigma at millions of pairs (beta, alpha). Chebyshev series in both, panel
by panel, give it for a small part of what :mod:`dahl_ident.elements.general_dahl` takes, whose
symbols are used here. A panel is computed when a pair first falls into it. Which one that is
depends on the pair alone, so that h does not depend on what was asked before.

**Coordinates** are those in which h is smooth. For alpha above 0.9 they are ln alpha and ln beta.
Below, h has a singular point of order 1/p at ``beta_s = 2^-alpha / p``, where full slip sets in;
panels lie over ln p and ``b = ln(beta/beta_s)``, and where |b| < 1 over ln |b|.

**Accuracy**: 1e-10 of ``1/(1 + beta)``, about the modulus of h, for alpha from 1e-9 to 1000.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import general_dahl

_NODES = 15  # of a panel, each way: h errs by 1e-13, with 11 by 3e-11
_WALLS = np.array(
    [*(1.0 - 0.1 ** np.linspace(0.0, 1.0, 6)), 1.0, 1.15, 1.4, 1.8, *(3.5 * 2.0 ** np.arange(10))]
)
"""Of the panels over alpha; up to the sixth, 0.9, the onset of slip shows."""
_ONSET_SHOWS = 5  # panels below the sixth wall

_WIDTH = 0.5  # of panels over b or ln beta, and over ln |b|
_LEAST, _MOST = -40.0, 70.0  # ln beta at which h is its limit, to every digit
_NEAREST = 1e-11  # |b| that counts as the onset itself
_BELOW, _ABOVE = 10_000, 20_000  # numbers of panels over ln |b| start here
_VALUES_PER_BLOCK = 8192  # complex, 128 kB: their arrays stay in the processor's cache


def stiffness(
    beta: FloatArray, alpha: FloatArray, *, slope: bool = False
) -> tuple[ComplexArray, ComplexArray]:
    """Return h = N/sigma, and its derivative with respect to ln beta if asked for, else zeros.

    The derivative errs by 1e-9 of ``1/(1 + beta)``. Parameters as in
    :func:`general_dahl.stiffness`.

    Examples
    --------
    >>> stiffness(np.array([1e-9, 1.0]), np.array(2.0))[0].round(6)
    array([1.      +0.j      , 0.544039+0.354193j])
    """
    shape = np.broadcast_shapes(beta.shape, alpha.shape)
    pairs = np.broadcast_to(beta, shape).ravel()
    exponents, owner = np.unique(alpha, return_inverse=True)
    owner = np.broadcast_to(owner.reshape(alpha.shape), shape).ravel()
    strip = (np.searchsorted(_WALLS, exponents, side="right") - 1)[owner]
    result = np.zeros((2, pairs.size), dtype=np.complex128)
    for index in np.unique(strip).tolist():
        chosen = np.flatnonzero(strip == index)
        for first in range(0, chosen.size, _VALUES_PER_BLOCK):
            part = chosen[first : first + _VALUES_PER_BLOCK]
            used, which = np.unique(owner[part], return_inverse=True)
            if 0 <= index < len(_WALLS) - 1:
                result[0, part], result[1, part] = _on_strip(
                    index, pairs[part], exponents[used], which, slope=slope
                )
            elif slope:
                h, by_ln_f_max, *_ = general_dahl.stiffness_gradient(
                    pairs[part], exponents[used[which]]
                )
                result[0, part], result[1, part] = h, -by_ln_f_max
            else:
                result[0, part] = general_dahl.stiffness(pairs[part], exponents[used[which]])
    return result[0].reshape(shape), result[1].reshape(shape)


def _on_strip(
    strip: int, beta: FloatArray, exponents: FloatArray, owner: NDArray[np.intp], *, slope: bool
) -> tuple[ComplexArray, ComplexArray | float]:
    """Return h at beta, (N,), for exponents between two walls, and its slope, or 0.

    `owner` are the places in `exponents`, (S,), of each pair's alpha.
    """
    panel, place, stretch = _panels(strip, beta, exponents, owner)
    first = panel.min()
    present = np.flatnonzero(np.bincount(panel - first))
    slot = np.zeros(present[-1] + 1, dtype=np.intp)
    slot[present] = np.arange(present.size)
    low, high = _over_alpha(strip, _WALLS[strip : strip + 2])
    across = (2.0 * _over_alpha(strip, exponents) - low - high) / (high - low)
    tables = np.stack([_series(strip, int(first + k)) for k in present], axis=2)
    along = chebyshev.chebvander(across, _NODES - 1) @ tables.view(np.float64)
    terms = along.view(np.complex128).reshape(_NODES, -1)
    which = slot[panel - first] + present.size * owner
    # the Chebyshev polynomials one after the other, never all of them at once
    before, now = np.ones(place.shape), place
    total = terms[0].take(which)
    rise, rose, rises = np.zeros_like(total), np.zeros(place.shape), np.ones(place.shape)
    for term in terms[1:]:
        coefficient = term.take(which)
        total += now * coefficient
        if slope:
            rise += rises * coefficient
            rose, rises = rises, 2.0 * (now + place * rises) - rose
        before, now = now, 2.0 * place * now - before
    h = total / (1.0 + beta)
    if not slope:
        return h, 0.0
    return h, rise * stretch / (1.0 + beta) - h * (beta / (1.0 + beta))


def _over_alpha(strip: int, alpha: FloatArray) -> FloatArray:
    return np.asarray(np.log1p(-alpha) if strip < _ONSET_SHOWS else np.log(alpha))


def _panels(
    strip: int, beta: FloatArray, exponents: FloatArray, owner: NDArray[np.intp]
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return the number of each pair's panel, where in it the pair is, from -1 to 1, and slopes.

    The slopes are those of the place with respect to ln beta.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ln_beta = np.log(beta)
    b = np.fmin(np.fmax(ln_beta, _LEAST), _MOST)
    stretch = np.where(b == ln_beta, 2.0 / _WIDTH, 0.0)
    start: FloatArray | int = 0
    if strip < _ONSET_SHOWS:
        b = b - _onset(exponents)[owner]
        near, size = np.abs(b) < 1.0, np.maximum(np.abs(b), _NEAREST)
        start = np.where(near, np.where(b < 0.0, _BELOW, _ABOVE), 0)
        stretch = np.where(near, stretch / np.copysign(size, b), stretch)
        b = np.where(near, np.log(size), b)
    whole = np.floor(b / _WIDTH)
    place = 2.0 * (b / _WIDTH - whole) - 1.0
    return np.asarray(whole + start, dtype=np.intp), place, stretch


def _onset(alpha: FloatArray) -> FloatArray:
    """Return ln beta_s."""
    return np.asarray(-alpha * np.log(2.0) - np.log1p(-alpha))


@lru_cache(maxsize=4096)
def _series(strip: int, panel: int) -> ComplexArray:
    """Return the coefficients of (1 + beta) h, by amplitude and by exponent."""
    nodes, to_series = _rule()
    low, high = _over_alpha(strip, _WALLS[strip : strip + 2])
    over_alpha = 0.5 * (low + high + (high - low) * nodes)
    start = max((s for s in (_BELOW, _ABOVE) if panel > s - 1000), default=0)
    b = _WIDTH * (panel - start + 0.5 * (1.0 + nodes[:, None]))
    if strip < _ONSET_SHOWS:
        alpha = -np.expm1(over_alpha)
        b = {0: b, _BELOW: -np.exp(b), _ABOVE: np.exp(b)}[start] + _onset(alpha)
    else:
        alpha = np.exp(over_alpha)
    beta = np.exp(b)
    scaled = (1.0 + beta) * general_dahl.stiffness(beta, alpha)
    return np.asarray(to_series @ scaled @ to_series.T)


@lru_cache(maxsize=1)
def _rule() -> tuple[FloatArray, FloatArray]:
    """Return Chebyshev's nodes on (-1, 1), and the matrix from values there to a series."""
    nodes = -np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    return nodes, np.linalg.inv(chebyshev.chebvander(nodes, _NODES - 1)).astype(np.float64)

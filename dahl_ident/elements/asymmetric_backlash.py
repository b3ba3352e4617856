r"""Linear Dahl friction with two limits behind a gap, as integrals of exponentials.

Behind the gap the element moves with the amplitude D = A - gap/2. On a branch with the limit f and
kappa = sigma/f the force moves away from its tip as g (1 - exp(-kappa y)), y the element's path
and g the distance between the tip and the limit that the branch tends to. The force is zero at
y1 = ln(g/f)/kappa, where the gap is crossed. Partial integration gives (k > 0)

    c_k = ((-1)^k S_rising - S_falling)/(j k pi),
    S = Int_0^(2D) g kappa exp(-kappa y) exp(-j k theta) dy,

with A (1 - cos theta) = y before the gap and y + gap beyond it; both parts are integrated by Gauss
points over theta, as in :mod:`dahl_ident.elements.dahl_backlash`. For k = 0, theta stands in
place of exp(-j k theta). The tips are those of :mod:`dahl_ident.elements.asymmetric_dahl`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements.behaviour import StiffnessGradient

_RULES = tuple(np.polynomial.legendre.leggauss(n) for n in (16, 32))
"""Gauss points before and behind the gap; with 10 and 28 the ninth harmonic errs by 1e-8."""

_FADED = 42.0  # exp(-42) is below rounding
_SMALLEST = 1e-12  # D/A that counts as contact
_BLOCK = 128  # amplitudes in one pass: their arrays stay in the processor's cache
HIGHEST = 9  # harmonic that the Gauss points resolve
_F_MAX, _SIGMA, _ASYMMETRY, _GAP, _AMPLITUDE = range(5)  # rows of the arguments


def stiffness_gradient(
    amplitude: FloatArray,
    f_max: FloatArray,
    sigma: FloatArray,
    asymmetry: FloatArray,
    gap: FloatArray,
    harmonic: int,
) -> StiffnessGradient:
    """Return F_k/X_1 and its derivatives with respect to f_max, sigma, asymmetry and gap.

    Parameters
    ----------
    amplitude : ndarray
        A > 0, m.
    f_max, sigma, asymmetry, gap : ndarray
        Mean limit, N, stiffness, N/m, difference of the limits over their sum, and play, m;
        broadcast with `amplitude`.
    harmonic : int
        k, from 0 to 9.

    Returns
    -------
    StiffnessGradient
        Zero at amplitudes up to half the gap.

    Examples
    --------
    >>> one = np.ones(())
    >>> found = stiffness_gradient(2.0 * one, one, 3.0 * one, 0.0 * one, 0.8 * one, 1)
    >>> complex(found.value.round(7))
    (0.3901538+0.4032069j)
    """
    arrays = np.broadcast_arrays(f_max, sigma, asymmetry, gap, amplitude)
    shape = arrays[0].shape
    flat = np.array([a.ravel() for a in arrays])
    found = np.zeros((6, flat.shape[1]), dtype=np.complex128)
    A = flat[_AMPLITUDE]
    moving = np.flatnonzero(A - 0.5 * flat[_GAP] > _SMALLEST * A)
    for start in range(0, moving.size, _BLOCK):
        rows = moving[start : start + _BLOCK]
        found[:, rows] = _harmonic(flat[:, rows], harmonic)
    value, *by = (part.reshape(shape) for part in found)
    return StiffnessGradient(value, by[_AMPLITUDE], tuple(by[:_AMPLITUDE]))


@dataclass(frozen=True)
class _Dual:
    """Numbers with their derivatives by f_max, sigma, asymmetry, gap and amplitude, (5, n)."""

    value: FloatArray
    by: FloatArray

    def __add__(self, other: _Dual) -> _Dual:
        return _Dual(self.value + other.value, self.by + other.by)

    def __sub__(self, other: _Dual) -> _Dual:
        return _Dual(self.value - other.value, self.by - other.by)

    def __mul__(self, other: _Dual) -> _Dual:
        return _Dual(self.value * other.value, self.by * other.value + other.by * self.value)

    def __truediv__(self, other: _Dual) -> _Dual:
        ratio = self.value / other.value
        return _Dual(ratio, (self.by - ratio * other.by) / other.value)

    def times(self, factor: float) -> _Dual:
        return _Dual(factor * self.value, factor * self.by)

    def gone(self) -> _Dual:
        """Return 1 - exp(-2 self)."""
        return _Dual(-np.expm1(-2.0 * self.value), 2.0 * np.exp(-2.0 * self.value) * self.by)

    def log(self) -> _Dual:
        return _Dual(np.log(self.value), self.by / self.value)


def _harmonic(at: FloatArray, k: int) -> ComplexArray:
    """Return F_k/X_1 and its derivatives, (6, n), for the five arguments, (5, n)."""
    n = at.shape[1]
    f, sigma, a, gap, A = (
        _Dual(value, np.eye(5)[i][:, None] * np.ones(n)) for i, value in enumerate(at)
    )
    one = _Dual(np.ones(n), np.zeros((5, n)))
    D = A - gap.times(0.5)
    up, down = f * (one + a), f * (one - a)
    kappas = [sigma / limit for limit in (up, down)]
    p, m = ((kappa * D).gone() for kappa in kappas)
    both = f.times(2.0) / (p + m - p * m)
    tips = both * m, both * p  # f_p - F_min and f_m + F_max
    total, by = np.zeros(n, dtype=np.complex128), np.zeros((5, n), dtype=np.complex128)
    crossings = [
        (t / f).log() / kappa for t, f, kappa in zip(tips, (up, down), kappas, strict=True)
    ]
    parts = _branch(
        np.concatenate([kappa.value for kappa in kappas]),
        np.concatenate([crossing.value for crossing in crossings]),
        np.tile(gap.value, 2), np.tile(A.value, 2), k,
    )  # fmt: skip
    for i, (tip, kappa, crossing, sign) in enumerate(
        zip(tips, kappas, crossings, ((-1) ** k, -1), strict=True)
    ):
        S, by_kappa, by_crossing, by_gap, by_A = (part[i * n : i * n + n] for part in parts)
        slope = by_kappa * kappa.by + by_crossing * crossing.by + by_gap * gap.by + by_A * A.by
        total += sign * tip.value * S
        by += sign * (tip.by * S + tip.value * slope)
    if k:
        total, by = total / (1j * np.pi * k), by / (1j * np.pi * k)
    else:
        # half the sum of the tips, less the mean of theta over the force
        middle = (up - tips[0] + tips[1] - down).times(0.5)
        total = middle.value - 0.5 / np.pi * total
        by = middle.by - 0.5 / np.pi * by
    value = total / A.value
    by = by / A.value
    by[_AMPLITUDE] -= value / A.value
    return np.concatenate([value[None], by])


def _branch(
    kappa: FloatArray, crossing: FloatArray, gap: FloatArray, A: FloatArray, k: int
) -> tuple[ComplexArray, ...]:
    """Return S/g and its derivatives by kappa, the crossing, the gap and the amplitude."""
    length = 2.0 * A - gap
    crossing = np.minimum(crossing, length)
    ends = np.minimum(length, crossing + _FADED / kappa)
    S, by_kappa, by_gap, by_A = (np.zeros(A.shape, dtype=np.complex128) for _ in range(4))
    pieces = ((0.0 * gap, 0.0 * gap, crossing), (gap, crossing, ends))
    edges = []
    for (nodes, weights), (shift, first, last) in zip(_RULES, pieces, strict=True):
        # sin^2(theta/2), where the piece begins and ends
        begin, stop = (
            2.0 * np.arcsin(np.sqrt(np.minimum(0.5 * (y + shift) / A, 1.0))) for y in (first, last)
        )
        edges += [begin, stop]
        half = 0.5 * (stop - begin)
        theta = begin[:, None] + half[:, None] * (1.0 + nodes)
        versed, sine = 2.0 * np.sin(0.5 * theta) ** 2, np.sin(theta)
        y = A[:, None] * versed - shift[:, None]
        weight = np.exp(-kappa[:, None] * y) * (half[:, None] * weights)  # of d theta
        if k:
            wave = np.exp(-1j * k * theta)
            turned = -1j * k * wave
        else:
            wave, turned = theta, np.ones(theta.shape)
        along = A[:, None] * sine * weight  # of dy
        S += kappa * _sum(along, wave)
        by_kappa += _sum(along * (1.0 - kappa[:, None] * y), wave)
        by_A -= kappa * _sum(weight * versed, turned)
        if shift is gap:
            by_gap += kappa * _sum(weight, turned)
    before, beyond = edges[1], edges[2]
    end = np.exp(-kappa * length) * ((-1.0) ** k if k else np.pi)
    jump = (np.exp(-1j * k * before) - np.exp(-1j * k * beyond)) if k else before - beyond
    by_crossing = kappa * np.exp(-kappa * crossing) * jump
    by_gap, by_A = by_gap - kappa * end, by_A + 2.0 * kappa * end
    return S, by_kappa, np.asarray(by_crossing, dtype=np.complex128), by_gap, by_A


def _sum(weight: FloatArray, wave: ComplexArray | FloatArray) -> ComplexArray:
    return np.asarray(np.einsum("rn,rn->r", weight, wave), dtype=np.complex128)

"""Settled loops of any amplitude in closed form, and their harmonics by Gauss's quadrature.

A loop under x = A cos(theta) has a way down from its top and a way up from its bottom. Each is in
closed form over the path since its beginning; top and bottom follow from each other, in sixty
digits where a loop is asymmetric. So amplitudes may be any number of characteristic displacements,
where an integrator in small steps would not come to an end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mpmath
import numpy as np
from scipy.optimize import brentq

from benchmarks.motion_oracles import BoucWenByHand, DahlByHand, JenkinsByHand
from dahl_ident.arrays import ComplexArray, FloatArray

_DIGITS = 60
_NARROWEST = 1e-13  # of a half cycle, rad: the first panel
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


class Way(NamedTuple):
    """Half a loop: the force over the path from its beginning, and where it has kinks."""

    force: Callable[[FloatArray], FloatArray]
    kinks: Sequence[float]


def harmonics_of(ways: Sequence[Way], amplitude: float, orders: Sequence[int]) -> ComplexArray:
    """Return c_k of F = sum of Re c_k exp(j k theta) from the ways down and up."""
    k = np.array(orders)
    total = np.zeros(k.size, dtype=np.complex128)
    for way, begin in zip(ways, (0.0, np.pi), strict=True):
        psi, weights = _panels([2.0 * np.arcsin(np.sqrt(min(p / (2.0 * amplitude), 1.0)))
                                for p in way.kinks])  # fmt: skip
        force = way.force(2.0 * amplitude * np.sin(0.5 * psi) ** 2)
        total += np.exp(-1j * np.outer(k, psi + begin)) @ (weights * force)
    return np.asarray(np.where(k == 0, 0.5, 1.0) / np.pi * total)


def _panels(kinks: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights on (0, pi) in panels that shrink towards the turn and the kinks."""
    near = np.pi * 2.0 ** -np.arange(0.0, 45.0)
    ends = [0.0, np.pi, *near]
    for kink in kinks:
        ends += [kink, *(kink - near[near < kink]), *(kink + near[near < np.pi - kink])]
    edges = np.unique(np.array(ends))
    edges = edges[np.append(True, np.diff(edges) > _NARROWEST)]
    half = 0.5 * np.diff(edges)[:, None]
    psi = edges[:-1, None] + half * (1.0 + _NODES)
    return psi.ravel(), (half * _WEIGHTS).ravel()


def dahl(law: DahlByHand, amplitude: float) -> list[Way]:
    """Return the ways of Dahl's law with any exponent and two limits, or behind a gap."""
    up, down = (law.f_max * (1.0 + s * law.asymmetry) for s in (1.0, -1.0))
    travel = 2.0 * amplitude - (law.gap or 0.0)
    with mpmath.workdps(_DIGITS):
        alpha, sigma = mpmath.mpf(law.alpha), mpmath.mpf(law.sigma)

        def end(force: mpmath.mpf, limit: mpmath.mpf) -> mpmath.mpf:
            margin, span = 1 - force / limit, sigma * mpmath.mpf(travel) / limit
            if alpha == 1:
                return limit * (1 - margin * mpmath.exp(-span))
            left = margin ** (1 - alpha) - (1 - alpha) * span
            return limit * (1 - left ** (1 / (1 - alpha))) if left > 0 else limit

        def excess(bottom: mpmath.mpf) -> mpmath.mpf:
            return -end(-end(bottom, mpmath.mpf(up)), mpmath.mpf(down)) - bottom

        low, high = -mpmath.mpf(down), mpmath.mpf(0)
        high = high if law.asymmetry == 0.0 else mpmath.mpf(up)
        for _ in range(3 * _DIGITS):  # excess falls along the bracket
            middle = (low + high) / 2
            low, high = (middle, high) if excess(middle) > 0 else (low, middle)
        bottom = (low + high) / 2
        top = end(bottom, mpmath.mpf(up))
    return [_dahl_way(law, -1.0, down, -float(top)), _dahl_way(law, 1.0, up, float(bottom))]


def _dahl_way(law: DahlByHand, heading: float, limit: float, start: float) -> Way:
    """Return a way; `start` is the force along the motion where it begins, below zero."""
    margin, alpha, gap = 1.0 - start / limit, law.alpha, law.gap or 0.0
    log = np.log1p(-start / limit)
    to_zero = log if alpha == 1.0 else np.expm1((1.0 - alpha) * log) / (1.0 - alpha)
    to_zero *= limit / law.sigma
    kinks = [to_zero, to_zero + gap] if gap else []
    if alpha < 1.0:
        kinks.append(margin ** (1.0 - alpha) / (1.0 - alpha) * limit / law.sigma)

    def force(path: FloatArray) -> FloatArray:
        moved = np.minimum(path, to_zero) + np.maximum(path - to_zero - gap, 0.0)
        span = law.sigma / limit * (moved if gap else path)
        with np.errstate(divide="ignore"):
            if alpha == 1.0:
                log = -span
            else:
                left = -(1.0 - alpha) * margin ** (alpha - 1.0) * span
                log = np.log1p(np.maximum(left, -1.0)) / (1.0 - alpha)
        return np.asarray(heading * (start - limit * margin * np.expm1(log)))

    return Way(force, kinks)


def bouc_wen(law: BoucWenByHand, amplitude: float) -> list[Way]:
    """Return the ways of Bouc-Wen's law with exponent 1: exponentials to zero force and beyond."""
    sigma, q, p = law.sigma, law.q, law.p

    def top(loaded: float) -> float:
        return float(-sigma / q * np.expm1(-q * loaded))

    def to_zero(force: float) -> float:
        return float(np.log1p(p * force / sigma) / p)

    loaded = brentq(
        lambda y: y + to_zero(top(y)) - 2.0 * amplitude, 0.0, 2.0 * amplitude, xtol=1e-300,
        rtol=1e-15,
    )  # fmt: skip
    start, zero = top(loaded), to_zero(top(loaded))

    def force(path: FloatArray) -> FloatArray:
        unloading = np.minimum(path, zero)
        falling = start * np.exp(-p * unloading) + sigma / p * np.expm1(-p * unloading)
        beyond = sigma / q * np.expm1(-q * np.maximum(path - zero, 0.0))
        return np.asarray(np.where(path < zero, falling, beyond))

    return [Way(force, [zero]), Way(lambda path: -force(path), [zero])]


def jenkins(law: JenkinsByHand, amplitude: float) -> list[Way]:
    """Return the ways of Jenkins elements: each sticks over twice its own amplitude."""
    reach = [min(amplitude, d) for d in law.slips]

    def force(path: FloatArray) -> FloatArray:
        parts = zip(law.stiffnesses, reach, strict=True)
        return np.asarray(sum(k * (d - np.minimum(path, 2.0 * d)) for k, d in parts))

    kinks = [2.0 * d for d in reach if d < amplitude]
    return [Way(force, kinks), Way(lambda path: -force(path), kinks)]

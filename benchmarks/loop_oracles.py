"""Settled loops of any amplitude in closed form, and their harmonics by Gauss quadrature.

A loop under x = A cos(theta) has a branch down from its top and a branch up from its bottom. The
force on each is a closed-form function of the path since the turning point; the forces at top and
bottom follow from each other, with sixty digits because they may differ by less than rounding. The
amplitude may be any number of characteristic displacements, which an integrator with small steps
could not cover.
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
_NARROWEST = 1e-13  # rad: width of the narrowest panel
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


class Branch(NamedTuple):
    """Half a loop: the force as a function of the path from the turning point, and its kinks."""

    force: Callable[[FloatArray], FloatArray]
    kinks: Sequence[float]  # paths


def harmonics_of(
    branches: Sequence[Branch], amplitude: float, orders: Sequence[int]
) -> ComplexArray:
    """Return c_k of F = sum of Re c_k exp(j k theta) from the branches down and up."""
    k = np.array(orders)
    total = np.zeros(k.size, dtype=np.complex128)
    for branch, start in zip(branches, (0.0, np.pi), strict=True):
        shares = np.minimum(np.array(branch.kinks) / (2.0 * amplitude), 1.0)
        psi, weights = _panels(2.0 * np.arcsin(np.sqrt(shares)))
        force = branch.force(2.0 * amplitude * np.sin(0.5 * psi) ** 2)
        total += np.exp(-1j * np.outer(k, psi + start)) @ (weights * force)
    return np.asarray(np.where(k == 0, 0.5, 1.0) / np.pi * total)


def _panels(kinks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights on (0, pi), in panels that narrow towards 0 and towards kinks."""
    near = np.pi * 2.0 ** -np.arange(0.0, 45.0)
    ends = [0.0, np.pi, *near]
    for kink in kinks:
        ends += [kink, *(kink - near[near < kink]), *(kink + near[near < np.pi - kink])]
    edges = np.unique(np.array(ends))
    edges = edges[np.append(True, np.diff(edges) > _NARROWEST)]
    half = 0.5 * np.diff(edges)[:, None]
    psi = edges[:-1, None] + half * (1.0 + _NODES)
    return psi.ravel(), (half * _WEIGHTS).ravel()


def dahl(law: DahlByHand, amplitude: float) -> list[Branch]:
    """Return the branches of Dahl's law with any exponent and two limits, or behind a gap."""
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
    return [_dahl_branch(law, -1.0, down, -float(top)), _dahl_branch(law, 1.0, up, float(bottom))]


def _dahl_branch(law: DahlByHand, direction: float, limit: float, start: float) -> Branch:
    """Return a branch; `start` < 0 is its first force, counted along the motion."""
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
        return np.asarray(direction * (start - limit * margin * np.expm1(log)))

    return Branch(force, kinks)


def bouc_wen(law: BoucWenByHand, amplitude: float) -> list[Branch]:
    """Return the branches of Bouc-Wen's law with exponent 1: an exponential on each side of 0 N."""
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

    return [Branch(force, [zero]), Branch(lambda path: -force(path), [zero])]


def jenkins(law: JenkinsByHand, amplitude: float) -> list[Branch]:
    """Return the branches of Jenkins elements: each sticks over twice its largest extension."""
    extensions = [min(amplitude, d) for d in law.slips]

    def force(path: FloatArray) -> FloatArray:
        parts = zip(law.stiffnesses, extensions, strict=True)
        return np.asarray(sum(k * (d - np.minimum(path, 2.0 * d)) for k, d in parts))

    kinks = [2.0 * d for d in extensions if d < amplitude]
    return [Branch(force, kinks), Branch(lambda path: -force(path), kinks)]

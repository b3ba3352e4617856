"""Aliasing of harmonics above half the sampling rate onto the measured ones.

With r samples a cycle the harmonics r - k and r + k are sampled as harmonic k, alike in every
cycle, so that no scatter shows them. A waveform with kinks, such as friction's force, has
harmonics that fall as a power of their order, between 1/k (steps) and 1/k^3 (reversals of Dahl
friction). The power is taken from the harmonics that stand out of the noise, and extended to the
first two that alias. Where r is not a whole number the alias lies next to the harmonic, and drops
out of it the more cycles there are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.sine_fit import SineFit

_CLEAR = 9.0  # power over that of noise, of a harmonic that is seen
_SEEN_FROM = 1.0 / 3.0  # of the fitted orders: the powers of low ones differ
_FLATTEST, _STEEPEST = 1.0, 3.0  # powers of the order: jumps of the force, and of its curvature
_FIRST = 3  # harmonic of friction after the fundamental
_STAYS = 0.01  # of an alias, that matters


def alias_error(fit: SineFit, harmonic: int, cycles: int) -> FloatArray:
    """Return the size of the aliases on a harmonic of motion and force, shape (2,).

    In a sweep no alias stays in one place for long.
    """
    per_cycle = 2.0 * np.pi / fit.segment.sample_phase
    whole = round(per_cycle)
    if fit.trending or whole - harmonic <= fit.orders:
        return np.zeros(2)
    seen = np.arange(1, fit.orders + 1)
    seen = seen[(seen >= _SEEN_FROM * fit.orders) & ((whole - harmonic - seen) % 2 == 0)]
    size = np.array([np.abs(fit.phasors(k)) for k in seen.tolist()]).reshape(-1, 2)
    variance = np.array([fit.phasor_variance(k) for k in seen.tolist()])
    clear = size**2 > _CLEAR * np.outer(variance, fit.residual_variance)
    aliased = np.array([whole - harmonic, whole + harmonic])
    both = [_extended(seen[c], s[c], aliased) for c, s in zip(clear.T, size.T, strict=True)]
    if fit.segment.block > 1:  # of which block means pass little
        passed = fit.segment.passed(int(aliased[1]))
        assert passed is not None
        both = [size * np.abs(passed[aliased - 1]) for size in both]
    return np.asarray(_kept(per_cycle, cycles) * np.hypot.reduce(both, axis=1))


def aliases_unseen(fit: SineFit, cycles: int) -> bool:
    """Return whether harmonics alias onto the fundamental of which not even the first is seen."""
    per_cycle = 2.0 * np.pi / fit.segment.sample_phase
    return not fit.trending and fit.orders < _FIRST and _kept(per_cycle, cycles) > _STAYS


def _kept(per_cycle: float, cycles: int) -> float:
    """Return the share of an alias that stays on the harmonic next to it."""
    return float(abs(np.sinc(cycles * (per_cycle - round(per_cycle)))))


def _extended(seen: NDArray[np.intp], size: FloatArray, orders: NDArray[np.intp]) -> FloatArray:
    """Return sizes at other orders by the power law through those seen; 0 for a pure sine."""
    if not (seen > 1).any():
        return np.zeros(orders.size)
    place, level = np.log(seen), np.log(size)
    fall = -np.polyfit(place, level, 1)[0] if seen.size > 1 else _FLATTEST
    fall = np.clip(fall, _FLATTEST, _STEEPEST)
    return np.asarray(np.exp(level[-1] + fall * (place[-1] - np.log(orders))))

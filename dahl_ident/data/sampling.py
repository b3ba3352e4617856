"""How time was sampled: rate, evenness, gaps."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray

_GAP = 1.5  # a step of more than this many median steps misses a sample
_EVEN = 0.01  # of a step


def sample_rate(time: FloatArray) -> float:
    """Return the mean number of samples per second outside the gaps."""
    steps = np.diff(time)
    kept = steps[steps <= _GAP * np.median(steps)]
    return float(kept.size / kept.sum())


def is_even(time: FloatArray) -> bool:
    """Return whether every sample lies within 1 % of a step of an even grid."""
    grid = np.linspace(time[0], time[-1], time.size)
    step = (time[-1] - time[0]) / (time.size - 1)
    return bool(np.abs(time - grid).max() <= _EVEN * step)


def gaps(time: FloatArray) -> FloatArray:
    """Return start and end of every step above 1.5 times the median step, (m, 2)."""
    steps = np.diff(time)
    before = np.flatnonzero(steps > _GAP * np.median(steps))
    return np.column_stack([time[before], time[before + 1]])

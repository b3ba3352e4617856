"""Noise of a measured displacement, which a friction law would take for travel.

A law with memory counts every movement. At rest a noisy displacement moves to and fro, so the
friction computed from it dies away where the real one stays. Movements within a dead band of some
standard deviations are therefore not counted, where the residuals confirm that they are noise.
"""

from __future__ import annotations

import numpy as np
from scipy.special import comb

from dahl_ident.arrays import FloatArray

_ORDER = 4  # of the differences, which leave little of any motion
_BLOCKS = 50  # some of which see little of the motion
_QUIET = 0.25  # quantile of the blocks
_MEDIAN = 0.6745  # of a normal variable's absolute value, in standard deviations
_HALF_BAND = 4.0  # standard deviations to either side
LEADS = (1.0, 2.0, 3.0)
"""Least, middle and largest place of the true displacement ahead of the band's middle."""


def noise_of(displacement: FloatArray) -> float:
    """Return the standard deviation of a displacement's white noise, m.

    From fourth differences in the quieter parts of the record: an upper bound where the motion is
    rough everywhere.

    Parameters
    ----------
    displacement : ndarray, shape (n,)
        m.

    Returns
    -------
    float

    Examples
    --------
    >>> t = np.arange(2000) / 500.0
    >>> x = 1e-3 * np.sin(6.0 * t) + 1e-6 * np.random.default_rng(0).standard_normal(2000)
    >>> bool(0.8e-6 < noise_of(x) < 1.1e-6)
    True
    """
    steps = np.abs(np.diff(displacement, _ORDER)) / np.sqrt(comb(2 * _ORDER, _ORDER))
    blocks = np.array_split(steps, min(_BLOCKS, max(1, steps.size // 20)))
    return float(np.quantile([np.median(block) for block in blocks], _QUIET)) / _MEDIAN


def travelled(displacement: FloatArray, noise: float, lead: float = LEADS[1]) -> FloatArray:
    """Return a displacement that moves only where the measured one leaves a dead band.

    Parameters
    ----------
    displacement : ndarray, shape (n,)
        m.
    noise : float
        Its noise's standard deviation, m; the dead band is four of it to either side.
    lead : float, default 2
        How far ahead of the band's middle, in the direction of motion, the true displacement is
        taken to be, in standard deviations.

    Returns
    -------
    ndarray, shape (n,)

    Examples
    --------
    >>> travelled(np.array([0.0, 1.0, -1.0, 9.0, 10.0, 9.0]), 1.0).tolist()
    [0.0, 0.0, 0.0, 7.0, 8.0, 8.0]
    """
    half, ahead = _HALF_BAND * noise, lead * noise
    middle, place, found = float(displacement[0]), float(displacement[0]), []
    for x in displacement.tolist():
        if x > middle + half:
            middle = x - half
            place = middle + ahead
        elif x < middle - half:
            middle = x + half
            place = middle - ahead
        found.append(place)
    return np.array(found)

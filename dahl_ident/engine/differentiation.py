"""Velocity and acceleration from a sampled displacement, by a Savitzky-Golay filter."""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray

_DEGREE = 4  # of the polynomials; that of the acceleration is 2
_POWER_SHARE = 0.9999  # share of the velocity's power in the band of the signal
_MARGIN = 4.0  # pass band of the filter over that band: at 2 a mass has an error of 2 %
ABOVE_NOISE = 20.0
"""Power over the median of noise, which noise exceeds in one frequency of a million."""


def differentiated(
    samples: FloatArray, interval: float, stretch: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return the first and second derivative of evenly sampled values.

    A polynomial of degree 4 is fitted to a moving window (Savitzky and Golay, Anal. Chem. 36
    (1964) 1627-1639). The window is the longest odd number of samples, at least 5, whose pass
    band, about (degree + 1)/(3.2 half-width - 4.6) of half the sampling rate, is four times as wide
    as the band with 99.99 % of the velocity's power, or, if that is narrower, in which it exceeds
    the displacement's white noise. `stretch` is a factor on its length.

    Examples
    --------
    >>> t = np.arange(400) / 100.0
    >>> v, a = differentiated(np.sin(2.0 * np.pi * t), 0.01)
    >>> bool(abs(a[200] + (2.0 * np.pi) ** 2 * np.sin(2.0 * np.pi * t[200])) < 0.05)
    True
    """
    from scipy.signal import savgol_filter  # slow to import, and rarely needed

    half = max(2, round(stretch * (filter_window(samples) // 2)))
    window = min(2 * half + 1, samples.size - 1 + samples.size % 2)
    degree = min(_DEGREE, window - 1)
    first, second = (
        savgol_filter(samples, window, degree, deriv=order, delta=interval) for order in (1, 2)
    )
    return np.asarray(first), np.asarray(second)


def filter_window(samples: FloatArray) -> int:
    """Return the number of samples in the moving window for these values."""
    steps = np.diff(samples)
    # the window prevents leakage
    power = np.abs(np.fft.rfft(np.hanning(steps.size) * (steps - steps.mean()))) ** 2
    total = power.sum()
    if total == 0.0:
        return 5
    noise = 4.0 * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, power.size)) ** 2
    upper = power.size // 2
    noise *= np.median(power[upper:] / noise[upper:])
    above = np.flatnonzero(power > ABOVE_NOISE * noise)
    highest = min(np.searchsorted(np.cumsum(power) / total, _POWER_SHARE), above.max(initial=0))
    band = float(highest + 1) / power.size
    half = int(((_DEGREE + 1.0) / min(1.0, _MARGIN * band) + 4.6) / 3.2)
    return 2 * max(2, min(half, samples.size // 4)) + 1

"""Sampled waves: derivatives of a displacement, and polynomials between the samples of a drive."""

from __future__ import annotations

import numpy as np
from scipy import fft

from dahl_ident.arrays import FloatArray

_DEGREE = 4  # of the polynomials; that of the acceleration is 2
_POWER_SHARE = 0.9999  # share of the velocity's power in the band of the signal
_MARGIN = 4.0  # pass band of the filter over that band: at 2 a mass has an error of 2 %
ABOVE_NOISE = 20.0
"""Power over the median of noise, which noise exceeds in one frequency of a million."""
_DERIVATIVES = 4  # of a sine with five samples a period the polynomials miss 1e-9
_SMOOTH = 0.8  # fraction of half the sampling rate above which a smooth extension has little power


def differentiated(
    samples: FloatArray, interval: float, window: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the first and second derivative of evenly sampled values.

    A polynomial of degree 4 is fitted to a moving window (Savitzky and Golay, Anal. Chem. 36
    (1964) 1627-1639). The window is the longest odd number of samples, at least 5, whose pass
    band, about (degree + 1)/(3.2 half-width - 4.6) of half the sampling rate, is four times as wide
    as the band with 99.99 % of the velocity's power, or, if that is narrower, in which it exceeds
    the displacement's white noise. A `window` of so many samples takes its place.

    Examples
    --------
    >>> t = np.arange(400) / 100.0
    >>> v, a = differentiated(np.sin(2.0 * np.pi * t), 0.01)
    >>> bool(abs(a[200] + (2.0 * np.pi) ** 2 * np.sin(2.0 * np.pi * t[200])) < 0.05)
    True
    """
    window = window or filter_window(samples)
    return _filtered(samples, window, 1, interval), _filtered(samples, window, 2, interval)


def smoothed(samples: FloatArray, window: int | None = None) -> FloatArray:
    """Return evenly sampled values, smoothed in the window in which they are differentiated.

    Examples
    --------
    >>> t = np.arange(4000) / 1000.0
    >>> noise = 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    >>> bool(np.std(smoothed(np.sin(t) + noise) - np.sin(t)) < 2e-4)
    True
    """
    return _filtered(samples, window or filter_window(samples), 0, 1.0)


def noise_left(window: int) -> float:
    """Return the standard deviation of white noise after smoothing, over that before.

    Examples
    --------
    >>> round(noise_left(5), 3), round(noise_left(101), 3)
    (1.0, 0.187)
    """
    from scipy.signal import savgol_coeffs  # slow to import, and rarely needed

    return float(np.linalg.norm(savgol_coeffs(window, _DEGREE)))


def _filtered(samples: FloatArray, window: int, order: int, interval: float) -> FloatArray:
    from scipy.signal import savgol_filter  # slow to import, and rarely needed

    window = min(window, samples.size - 1 + samples.size % 2)
    degree = min(_DEGREE, window - 1)
    return np.asarray(savgol_filter(samples, window, degree, deriv=order, delta=interval))


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


def band_limited(samples: FloatArray, interval: float) -> FloatArray:
    """Return polynomials of degree 9 between samples.

    The record is extended beyond its ends and differentiated four times by Fourier transform; each
    polynomial has the derivatives of both its ends (Hermite). The extension is periodic, as for
    whole periods of a multisine, or mirrored at the ends, whichever leaves less power above the
    band.

    Examples
    --------
    >>> t = np.arange(32) / 32.0
    >>> c = band_limited(np.sin(2.0 * np.pi * t), 1.0 / 32.0)
    >>> bool(abs(np.polyval(c[::-1, 4], 0.5) - np.sin(2.0 * np.pi * 4.5 / 32.0)) < 1e-8)
    True
    """
    n = samples.size
    line = np.linspace(samples[0], samples[-1], n)
    deviation = samples - line
    extensions = [samples, np.concatenate([deviation, -deviation[-2:0:-1]])]
    spectra = [fft.rfft(wave) for wave in extensions]
    beyond_band = [
        float(np.sum(np.abs(spectrum[int(_SMOOTH * spectrum.size) :]) ** 2)) / wave.size**2
        for spectrum, wave in zip(spectra, extensions, strict=True)
    ]
    periodic = beyond_band[0] <= beyond_band[1]
    choice = 0 if periodic else 1
    spectrum, m = spectra[choice], extensions[choice].size
    omega = 2.0 * np.pi * np.arange(spectrum.size) / (m * interval)
    derivatives = [
        fft.irfft(spectrum * (1j * omega) ** order, m)[:n] for order in range(_DERIVATIVES + 1)
    ]
    if not periodic:
        derivatives[0] = derivatives[0] + line
        derivatives[1] = derivatives[1] + (samples[-1] - samples[0]) / ((n - 1) * interval)
    return hermite(np.array(derivatives), np.full(n - 1, interval))


def hermite(derivatives: FloatArray, intervals: FloatArray) -> FloatArray:
    """Return polynomials between samples that have the derivatives of both their ends.

    Rows of `derivatives` are the samples and their derivatives, (d + 1, n); those of the result are
    the coefficients of powers of the fraction of an interval, (2 d + 2, n - 1).

    Examples
    --------
    >>> hermite(np.array([[0.0, 1.0], [1.0, 1.0]]), np.ones(1)).ravel().round(12).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    count = len(derivatives)
    powers, rows, factor = np.arange(2 * count), [], np.ones(2 * count)
    for order in range(count):
        rows += [factor * (powers == order), factor]
        factor = factor * (powers - order)
    scale = intervals ** np.arange(count)[:, None]
    first, last = derivatives[:, :-1] * scale, derivatives[:, 1:] * scale
    value = first[0].copy()
    first[0], last[0] = 0.0, last[0] - value  # changes keep their digits
    coefficients = np.linalg.inv(np.array(rows[::2] + rows[1::2])) @ np.vstack([first, last])
    coefficients[0] = value
    return np.asarray(coefficients)

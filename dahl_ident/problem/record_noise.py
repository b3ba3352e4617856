"""Noise in records, and their motion within the drive's band.

A law with memory counts every movement as travel. At rest a noisy displacement moves to and fro, so
the friction computed from it dies away where the real one stays. The displacement is therefore
smoothed, or movements within a dead band of some standard deviations are not counted, where the
residuals confirm that they are noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import comb

from dahl_ident.arrays import NORMAL_MEDIAN, BoolArray, FloatArray
from dahl_ident.data import Record

HIGHEST_ORDER = (
    60  # most coefficients of an autoregression, to limit time; Akaike's criterion chooses
)
SAMPLES_PER_ORDER = 20  # samples for each coefficient: with fewer, it follows the noise
_POWER_BAND = 1e-4  # power over the drive's largest, below which a frequency is outside its band
_FORGETS = 3.0  # samples times the cut, over half the rate, after which a high pass forgets
_NEIGHBOURS = 16  # fewest frequencies whose mean power is compared: chance halves the least mean
_FREQUENCY_BANDS = 64  # of the frequencies, whose mean powers are compared
_OUTSIDE_BAND = 0.1  # share of frequencies outside the band from which noise is estimated


def prediction_error_filter(residuals: Sequence[FloatArray]) -> FloatArray:
    """Return a filter, (order + 1,), that makes correlated residuals white, or [1] where none does.

    An autoregressive model e_t = sum a_k e_(t-k) + innovation is fitted by least squares to the
    residuals of all records, which also holds where slow noise is a thousand times larger than
    fast; the order has the least criterion of Akaike.

    Examples
    --------
    >>> from scipy.signal import lfilter
    >>> e = lfilter([1.0], [1.0, -0.9], np.random.default_rng(0).standard_normal(20_000))
    >>> bool(abs(prediction_error_filter([e])[1] + 0.9) < 0.02)
    True
    """
    shortest = min(e.size for e in residuals)
    highest = min(HIGHEST_ORDER, shortest // SAMPLES_PER_ORDER)
    lags = [np.lib.stride_tricks.sliding_window_view(e, highest + 1)[:, ::-1] for e in residuals]
    n = sum(len(rows) for rows in lags)
    products = np.zeros((highest + 1, highest + 1))
    for rows in lags:
        products += rows.T @ rows
    try:
        lower = np.linalg.cholesky(products[1:, 1:])
    except np.linalg.LinAlgError:
        return np.ones(1)
    explained = np.linalg.solve(lower, products[1:, 0]) ** 2
    variance = (products[0, 0] - np.concatenate([[0.0], np.cumsum(explained)])) / n
    if not variance[-1] > 0.0:
        return np.ones(1)
    order = int(np.argmin(n * np.log(variance) + 2.0 * np.arange(highest + 1)))
    inner = products[1 : order + 1, 1 : order + 1]
    return np.concatenate([[1.0], -np.linalg.solve(inner, products[1 : order + 1, 0])])


def share_in_band(
    drives: Sequence[FloatArray], outputs: Sequence[FloatArray], residuals: Sequence[FloatArray]
) -> float:
    """Return the residuals' power over the output's, at frequencies where the drive has power."""
    above, below = 0.0, 0.0
    for drive, output, residual in zip(drives, outputs, residuals, strict=True):
        band = excited(drive)
        above += float(_power(residual)[band].sum()) / residual.size
        below += float(_power(output)[band].sum()) / output.size
    return above / below if below > 0.0 else 0.0


def drive_noise(drives: Sequence[FloatArray]) -> list[float] | None:
    """Return the standard deviation of the white noise of each measured drive.

    Its power is the median outside the drive's band. None where less than a tenth of the
    frequencies lie outside, so that it cannot be estimated.
    """
    medians = [_median(_power(drive), ~excited(drive)) for drive in drives]
    known = [median for median in medians if median is not None]
    if len(known) < len(drives):
        return None
    windows = (float((np.hanning(drive.size) ** 2).sum()) for drive in drives)
    return [(m / np.log(2.0) / w) ** 0.5 for m, w in zip(known, windows, strict=True)]


def excited(drive: FloatArray) -> BoolArray:
    """Return at which frequencies of its Fourier transform a drive has power; all if none."""
    power = _power(drive)
    if not power.any():
        return np.ones(power.size, dtype=np.bool_)
    return np.asarray(power >= _POWER_BAND * power.max())


def in_band(record: Record, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return displacement, velocity and acceleration of a record's motion `y`, in the drive's band.

    Differentiated by Fourier transform of the record, its linear trend removed and mirrored at its
    ends; integrated by the trapezoidal rule, and then freed of what is slower than the drive, or
    than the motion that exceeds the record's noise.
    """
    from dahl_ident.engine.sampled import ABOVE_NOISE  # the engine is slow to import

    n = len(record)
    drive = record.force_samples
    line = np.linspace(y[0], y[-1], n)
    detrended = y - line
    spectrum = np.fft.rfft(np.concatenate([detrended, -detrended[-2:0:-1]]))
    m = 2 * n - 2
    s = 2j * np.pi * np.fft.rfftfreq(m, 1.0 / record.sample_rate)
    # in a free decay the motion gives the band
    bins = np.flatnonzero(excited(drive if _power(drive).any() else y))
    response = _power(y)
    highest = 1.25 * bins[-1] / response.size  # of half the sampling rate
    noise = _median(response, np.arange(response.size) > bins[-1]) or _least(response)
    shown = bins[response[bins] > ABOVE_NOISE * noise]
    lowest = 0.5 * (shown if shown.size else bins)[0] / response.size
    fraction = np.arange(spectrum.size) / spectrum.size
    spectrum[fraction > highest] = 0.0
    order = ("displacement", "velocity", "acceleration").index(record.motion_channel)
    waves = []
    for derivative in range(order, 3):
        factor = s ** (derivative - order)
        wave = np.fft.irfft(spectrum * factor, m)[:n]
        if derivative == order:
            wave = wave + line
        elif derivative == order + 1:
            wave = wave + (y[-1] - y[0]) / record.duration
        waves.append(wave)
    if order:
        from scipy.integrate import cumulative_trapezoid
        from scipy.signal import butter, detrend, sosfiltfilt

        cut = min(max(lowest, 1.0 / n), 0.5)
        highpass = butter(4, cut, "highpass", output="sos")
        padding = min(n - 1, int(_FORGETS / cut))
        for _ in range(order):
            wave = cumulative_trapezoid(waves[0], dx=1.0 / record.sample_rate, initial=0)
            waves.insert(0, np.asarray(sosfiltfilt(highpass, detrend(wave), padlen=padding)))
    return waves[0], waves[1], waves[2]


def _median(power: FloatArray, outside: BoolArray) -> float | None:
    """Return the median power outside a band, that of noise; None if too little is outside."""
    return float(np.median(power[outside])) if np.mean(outside) >= _OUTSIDE_BAND else None


def _least(power: FloatArray) -> float:
    """Return the least mean power of neighbouring frequencies: noise is not larger."""
    width = max(_NEIGHBOURS, power.size // _FREQUENCY_BANDS)
    return float(np.convolve(power, np.full(width, 1.0 / width), "valid").min())


def _power(wave: FloatArray) -> FloatArray:
    window = np.hanning(wave.size)
    mean = np.average(wave, weights=window)  # the plain mean contains parts of all frequencies
    return np.asarray(np.abs(np.fft.rfft(window * (wave - mean))) ** 2)


_ORDER = 4  # order of differences: they contain little of any motion
_BLOCKS = 50  # parts of a record, in some of which there is little motion
_QUIET = 0.25  # quantile of the parts, by their noise, that counts as quiet
_HALF_BAND = 4.0  # standard deviations of noise to either side that are no movement
LEADS = (1.0, 2.0, 3.0)
"""Least, middle and largest lead of the true displacement over the band's middle."""


def noise_of(displacement: FloatArray) -> float:
    """Return the standard deviation of a displacement's white noise, m.

    From fourth differences in the quieter parts of the record: an upper bound where the motion is
    rough everywhere.

    Examples
    --------
    >>> t = np.arange(2000) / 500.0
    >>> x = 1e-3 * np.sin(6.0 * t) + 1e-6 * np.random.default_rng(0).standard_normal(2000)
    >>> bool(0.8e-6 < noise_of(x) < 1.1e-6)
    True
    """
    steps = np.abs(np.diff(displacement, _ORDER)) / np.sqrt(comb(2 * _ORDER, _ORDER))
    blocks = np.array_split(steps, min(_BLOCKS, max(1, steps.size // 20)))
    return float(np.quantile([np.median(block) for block in blocks], _QUIET)) / NORMAL_MEDIAN


def travelled(displacement: FloatArray, noise: float, lead: float = LEADS[1]) -> FloatArray:
    """Return a displacement that moves only where the measured one leaves a dead band.

    The band is four standard deviations of the `noise` to either side. The true displacement is
    taken to be `lead` of them ahead of the band's middle, in the direction of motion.

    Examples
    --------
    >>> travelled(np.array([0.0, 1.0, -1.0, 4.5, 9.0, 10.0, 9.0]), 1.0).tolist()
    [0.0, 0.0, 0.0, 2.5, 7.0, 8.0, 8.0]
    """
    half, ahead = _HALF_BAND * noise, lead * noise
    middle, place, path = float(displacement[0]), float(displacement[0]), []
    for x in displacement.tolist():
        if x > middle + half:
            middle = x - half
            place = middle + ahead
        elif x < middle - half:
            middle = x + half
            place = middle - ahead
        path.append(place)
    return np.array(path)

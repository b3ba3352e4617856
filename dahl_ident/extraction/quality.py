"""What a stretch of samples shows about its own quality: steps, clipping, share of the sine.

The describing function assumes a displacement that is one sine, seen by a sensor that is finer
than the amplitude and wide enough for it. Each of these is measured here, for each stretch.
"""

from __future__ import annotations

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.sine_fit import HARMONICS, SineFit, Stretch

_LOOKED_AT = 5_000  # samples from which the sensor's step is found
_SAME = 1e-9  # of the range: values nearer than this are equal but for rounding
_RAIL_RUN = 5  # samples in a row at an extreme value
_CORNER = 3  # samples within which a clipped waveform is ...
_AWAY = 1e-4  # ... this much of its span away from the rail


def sensor_step(samples: FloatArray) -> float:
    """Return the sensor's step, 0 where the values are not multiples of any."""
    stride = max(1, samples.size // _LOOKED_AT)
    values = np.sort(samples[::stride])
    gaps = np.diff(values)
    gaps = gaps[gaps > _SAME * (values[-1] - values[0])]
    if gaps.size == 0:
        return 0.0
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    few = gaps[gaps < 5.5 * step] / step
    return step if np.abs(few - np.round(few)).max() < 0.05 else 0.0


def clipped_share(samples: FloatArray, step: float, noise: float, crest: float) -> float:
    """Return the share of samples that stand still at the highest or the lowest value.

    They do so in runs that the waveform enters and leaves at a corner; one that saturates does
    not enter so. Where the noise does not reach the sensor's step, a crest of `crest` samples
    stands still as well.
    """
    span = float(np.ptp(samples))
    tolerance = max(0.5 * step, _SAME * span)
    longest = max(_RAIL_RUN, 1.5 * crest) if noise < 0.5 * step else _RAIL_RUN
    stuck = 0
    for rail in (samples.max(), samples.min()):
        at_rail = np.abs(samples - rail) < tolerance
        edges = np.flatnonzero(np.diff(at_rail, prepend=False, append=False))
        starts, stops = edges[::2], edges[1::2]
        before = samples[np.maximum(starts - _CORNER, 0)]
        after = samples[np.minimum(stops + _CORNER - 1, samples.size - 1)]
        corner = np.minimum(np.abs(before - rail), np.abs(after - rail)) > _AWAY * span
        runs = (stops - starts)[corner]
        stuck += int(runs[runs > longest].sum())
    return stuck / samples.size


def crest_samples(amplitude: float, step: float, sample_phase: float) -> float:
    """Return how many samples of a sine lie within one sensor step of its crest."""
    below = min(max(step / amplitude, _SAME), 2.0)
    return float(2.0 * np.arccos(1.0 - below) / sample_phase) + 1.0


def fundamental_share(fit: SineFit, stretch: Stretch) -> FloatArray:
    """Return the fundamental's share of the power of each channel, offset and drift apart.

    `fit` may be one of block means; the power is that of the samples themselves.
    """
    drift = fit.coefficients[1] ** 2 / 3.0
    power = np.var(stretch.channels, axis=1) - drift
    power = np.maximum(power, 0.5 * np.abs(fit.phasors(1)) ** 2)
    return np.asarray(0.5 * np.abs(fit.phasors(1)) ** 2 / power)


def distortion(fit: SineFit, integrations: int) -> float:
    """Return the displacement's harmonics 2 to 9 over its fundamental, root of summed squares.

    What the noise adds to their power is subtracted.
    """
    orders = np.arange(1, min(HARMONICS, fit.orders) + 1)
    noise = float(np.mean(fit.residual[0] ** 2))
    power = np.array(
        [abs(fit.phasors(k)[0]) ** 2 - noise * fit.phasor_variance(k) for k in orders.tolist()]
    )
    power /= orders.astype(np.float64) ** (2 * integrations)
    return float(np.sqrt(max(power[1:].sum(), 0.0) / power[0]))

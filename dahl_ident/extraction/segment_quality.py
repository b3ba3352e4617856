"""Quality of a segment of samples: sensor steps, clipping, share of the sine, asymmetry, aliases.

A loop that is the same in both directions has only odd harmonics. Even ones appear if friction,
clearance or a spring differ between the directions, and if the displacement itself has even
harmonics: a mass turns X_k/X_1 into k^2 X_k/X_1 of the force, and a symmetric nonlinear element
spreads X_2 over all even orders. Without asymmetry abs(F_k)^2 over its variance follows F(2,
dof_k).

With r samples per cycle the harmonics r - k and r + k alias onto harmonic k, equally in every
cycle. The harmonics of a waveform with kinks decrease as a power of their order, between 1/k
(steps) and 1/k^3 (reversals of Dahl friction). The power is estimated from those above the noise.
If r is not a whole number, the alias separates from the harmonic as the number of cycles grows.
"""

from __future__ import annotations

import numpy as np
from scipy.special import comb, fdtri

from dahl_ident.arrays import NORMAL_MEDIAN, TINY, ComplexArray, FloatArray, IntArray
from dahl_ident.extraction.cycles import scattered
from dahl_ident.extraction.sine_fit import HARMONICS, Segment, SineFit

_UNROUNDED = 0.05  # residual in steps of the sensor; with less, nothing was rounded
_DITHERED = np.sqrt(0.25 + 1.0 / 12.0)  # residual, in steps, of half a step of noise
_STEP_SAMPLES = 20_000  # samples at most from which the sensor's step is estimated
_LONG_GAP = 30.5  # steps; a longer gap between values is not tested for whole steps
_ON_GRID = 0.1  # largest deviation of the other gaps from whole steps
_MOSTLY = 0.9  # least fraction of such gaps; with less, the step is too fine to matter
_SAME_VALUE = 1e-9  # fraction of the range; values closer together differ only by rounding
_RAIL_RUN = 5  # samples in a row at an extreme value that may be clipped
_CORNER = 3  # samples within which a clipped waveform leaves the rail
_DEPARTURE = 1e-4  # fraction of the span by which it is then away from the rail
_SEEN, _VISIBLE = 0.75, 1e-6  # steps, and fraction of the span: noise that constant values lack
_BEYOND_CHANCE = 3.0  # standard deviations by which a count of samples exceeds another
_ORDERS = 3, 6  # of differences, whose sizes agree for white noise, but not for a motion
_AGREE = 1.5  # largest ratio of these sizes
_NORMAL_QUARTILE = 0.3186  # of a normal variable's absolute value, in standard deviations
_FEWEST_DIFFERENCES = 100  # by which the noise is judged
EVEN = (2, 4, 6, 8)  # the lowest harmonics, which are the largest
BY_CHANCE = 1e-4  # largest fraction of symmetric points that are called asymmetric
_LEAST_HARMONIC = 1e-3  # fraction of the fundamental; smaller even harmonics do not matter
_CLEAR = 9.0  # least ratio of power to noise of a harmonic used to extrapolate
_LOWEST_USED = 1.0 / 3.0  # fraction of the fitted orders; lower ones follow other powers
_FLATTEST, _STEEPEST = 1.0, 3.0  # powers of the order for jumps of the force and its curvature
_FIRST_HARMONIC = 3  # order of the first harmonic of friction after the fundamental
_LEAST_LEAKAGE = 0.01  # least fraction of an alias in the fundamental that matters
_FITTED = 5  # fitted parameters: offset, drift, a sine (two) and its frequency


def sensor_step(samples: FloatArray) -> float:
    """Return the sensor's step; 0 if the values do not lie on a grid."""
    values = np.sort(scattered(samples, _STEP_SAMPLES))
    gaps = np.diff(values)
    gaps = gaps[gaps > _SAME_VALUE * (values[-1] - values[0])]
    if gaps.size == 0:
        return 0.0
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    in_steps = gaps / step
    short = in_steps < _LONG_GAP
    on_grid = np.abs(in_steps - np.round(in_steps)) < _ON_GRID
    return step if short.mean() > _MOSTLY and on_grid[short].all() else 0.0


def quantisation_errors(
    amplitude: FloatArray, step: FloatArray, residual: FloatArray, samples_a_cycle: float
) -> FloatArray:
    """Return the root mean square error of a phasor due to rounding, for each channel.

    Noise of more than half a step acts as dither. Without it every cycle may be rounded in the same
    way: only the samples of one cycle, step/sqrt(12) each, average out; and rounding itself adds up
    to (2 step/pi) |J_1(2 pi A/step)|, at most about 0.2 step sqrt(step/A).
    """
    sampled = step**2 / 12.0 * 4.0 / samples_a_cycle
    largest = np.maximum(np.maximum(amplitude, step), TINY)
    rounded = (residual > _UNROUNDED * step) & (residual <= _DITHERED * step)
    error = np.sqrt(sampled + 0.04 * step**2 * step / largest)
    return np.asarray(np.where(rounded, error, 0.0))


def white_noise(samples: FloatArray) -> float:
    """Return the standard deviation of white noise, extreme samples left out; 0 if it is not seen.

    Median and quartile of differences of two orders have to agree on it: those of a waveform with
    kinks, or with coarse samples, do not.
    """
    used = (samples > samples.min()) & (samples < samples.max())
    sizes: list[float] = []
    for order in _ORDERS:
        whole = np.convolve(used, np.ones(order + 1), "valid") > order + 0.5
        steps = np.abs(np.diff(samples, order))[whole] / np.sqrt(comb(2 * order, order))
        if steps.size < _FEWEST_DIFFERENCES:
            return 0.0
        sizes += (np.quantile(steps, [0.5, 0.25]) / [NORMAL_MEDIAN, _NORMAL_QUARTILE]).tolist()
    return min(sizes) if max(sizes) < _AGREE * min(sizes) else 0.0


def clipped_share(samples: FloatArray, step: float, crest: float = np.inf) -> float:
    """Return the fraction of samples that are clipped.

    Where noise is seen, its extreme values are rare: more samples at the extreme value than one
    step below are clipped. Where it is not, runs of constant extreme values that end in a corner
    are. A force in slip is as constant then, so only runs longer than the `crest` of a sine count.
    """
    highest, lowest = float(samples.max()), float(samples.min())
    span = highest - lowest
    tolerance = max(0.5 * step, _SAME_VALUE * span)
    noise_is_seen = white_noise(samples) > max(_SEEN * step, _VISIBLE * span)
    stuck = 0
    for depth in (highest - samples, samples - lowest):
        at_rail = depth < tolerance
        if noise_is_seen:
            at, below = int(at_rail.sum()), int(((depth < step + tolerance) & ~at_rail).sum())
            stuck += at if at - below > _BEYOND_CHANCE * np.sqrt(at + below) else 0
            continue
        edges = np.flatnonzero(np.diff(at_rail, prepend=False, append=False))
        starts, stops = edges[::2], edges[1::2]
        before = depth[np.maximum(starts - _CORNER, 0)]
        after = depth[np.minimum(stops + _CORNER - 1, samples.size - 1)]
        runs = (stops - starts)[np.minimum(before, after) > _DEPARTURE * span]
        stuck += int(runs[runs > max(_RAIL_RUN, 1.5 * crest)].sum())
    return stuck / samples.size


def crest_samples(amplitude: float, step: float, sample_phase: float) -> float:
    """Return how many samples of a sine lie within one sensor step of its crest."""
    below = min(max(step / amplitude, _SAME_VALUE), 2.0)
    return float(2.0 * np.arccos(1.0 - below) / sample_phase) + 1.0


def fundamental_share(fit: SineFit, segment: Segment, lost: FloatArray) -> FloatArray:
    """Return the fundamental's share of the power of each channel without offset and drift.

    `fit` may be one of block means; `lost` is the variance that the segment's block means lack.
    """
    sine = 0.5 * np.abs(fit.phasors(1)) ** 2
    drift = fit.coefficients[1] ** 2 / 3.0
    others = np.maximum(np.var(segment.channels, axis=1) + lost - drift - sine, 0.0)
    n = segment.time.size * segment.block
    others *= n / max(n - _FITTED, 1)
    return np.asarray(sine / (sine + others))


def distortion(fit: SineFit, channel: int, integrations: int = 0) -> float:
    """Return a channel's harmonics 2 to 9 over its fundamental, corrected for noise."""
    orders = np.arange(1, min(HARMONICS, fit.orders) + 1)
    noise = float(fit.residual_variance[channel])
    sizes = np.array([abs(fit.phasors(k)[channel]) for k in orders.tolist()])
    power = sizes**2 - noise * np.array([fit.phasor_variance(k) for k in orders.tolist()])
    power /= orders.astype(np.float64) ** (2 * integrations)
    return float(np.sqrt(max(power[1:].sum(), 0.0)) / sizes[0])


def asymmetry(
    orders: FloatArray,
    force: ComplexArray,
    variance: FloatArray,
    dof: FloatArray,
    displacement: FloatArray,
) -> float:
    """Return the force's even harmonics over its fundamental; 0 if they are not significant.

    Force and displacement are relative to their fundamentals; `variance` is E abs(error)^2 of the
    former.
    """
    if orders.size == 0:
        return 0.0
    distorted = float(np.sqrt(np.sum(displacement**2)))
    explained = np.maximum(orders**2 * displacement + distorted, _LEAST_HARMONIC)
    excess = np.maximum(np.abs(force) - explained, 0.0) ** 2 / np.maximum(variance, TINY)
    if np.mean(excess) <= fdtri(2 * orders.size, float(np.min(dof)), 1.0 - BY_CHANCE):
        return 0.0
    return float(np.sqrt(np.maximum(np.sum(np.abs(force) ** 2 - variance), 0.0)))


def alias_error(fit: SineFit, harmonic: int, cycles: int) -> FloatArray:
    """Return the size of the aliases on a harmonic of motion and force, (2,); 0 in a sweep."""
    per_cycle = 2.0 * np.pi / fit.segment.sample_phase
    whole = round(per_cycle)
    if fit.trending or whole - harmonic <= fit.orders:
        return np.zeros(2)
    fitted = np.arange(1, fit.orders + 1)
    fitted = fitted[(fitted >= _LOWEST_USED * fit.orders) & ((whole - harmonic - fitted) % 2 == 0)]
    size = np.array([np.abs(fit.phasors(k)) for k in fitted.tolist()]).reshape(-1, 2)
    variance = np.array([fit.phasor_variance(k) for k in fitted.tolist()])
    clear = size**2 > _CLEAR * np.outer(variance, fit.residual_variance)
    aliased = np.array([whole - harmonic, whole + harmonic])
    both = [_extrapolated(fitted[c], s[c], aliased) for c, s in zip(clear.T, size.T, strict=True)]
    factors = fit.segment.attenuation(int(aliased[1]))
    if factors is not None:
        both = [size * np.abs(factors[aliased - 1]) for size in both]
    return np.asarray(_leakage(per_cycle, cycles) * np.hypot.reduce(both, axis=1))


def has_unmeasured_aliases(fit: SineFit, cycles: int) -> bool:
    """Return whether harmonics alias onto the fundamental while no higher one is fitted."""
    per_cycle = 2.0 * np.pi / fit.segment.sample_phase
    leakage = _leakage(per_cycle, cycles)
    return not fit.trending and fit.orders < _FIRST_HARMONIC and leakage > _LEAST_LEAKAGE


def _leakage(per_cycle: float, cycles: int) -> float:
    """Return the fraction of an alias that falls on the harmonic next to it."""
    return float(abs(np.sinc(cycles * (per_cycle - round(per_cycle)))))


def _extrapolated(known: IntArray, size: FloatArray, orders: IntArray) -> FloatArray:
    """Return sizes at other orders by a power law through the known ones; 0 for a pure sine."""
    if not (known > 1).any():
        return np.zeros(orders.size)
    log_order, log_size = np.log(known), np.log(size)
    power = -np.polyfit(log_order, log_size, 1)[0] if known.size > 1 else _FLATTEST
    power = np.clip(power, _FLATTEST, _STEEPEST)
    return np.asarray(np.exp(log_size[-1] + power * (log_order[-1] - np.log(orders))))

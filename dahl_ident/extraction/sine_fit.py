"""Sine fit: the phasors of motion and force in one segment of sine excitation.

Both channels are fitted with the same columns by linear least squares,

    y(t) = offset + drift tau + sum_k c_k cos(k theta) + s_k sin(k theta),   k = 1 ... K

so that no fitted component leaks into the fundamental, and jitter and missing samples need no
resampling. A phasor is ``Y_k = c_k - j s_k``. The phase ``theta`` is a polynomial of ``tau``, time
from -1 to 1 over the segment, known or estimated jointly from both channels, the four-parameter fit
of IEEE Std 1057. In a sweep each harmonic may change linearly with time.

If there are many samples per cycle, they are replaced by means of blocks, 256 per cycle. In the
mean of m samples, spaced by the phase p, harmonic k is reduced by the factor
D_k = sin(m k p/2) / (m sin(k p/2)); the columns of the fit are reduced by the same factor.

Noise of the phasors: over P whole cycles, everything periodic lies on the harmonics. The content of
the lines between them, at ``f = (k + m/P) f_0``, is noise near the frequency of interest. With Z_i
the content of line i in both channels, the cross-spectral matrix at the harmonic is

    C = sum_i f_i Z_i Z_i^H / sum_i f_i

The lines are symmetric about the harmonic, so the expectation is right for every noise spectrum
``a + b/f``. With P >= 4, lines within half a harmonic are used, otherwise all lines up to the next
harmonics. The noise is assumed to be circular: n lines of equal weight give 2 n degrees of freedom.
The noise of the mean (k = 0) is estimated from the lowest lines, and assumed to be white below.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial

from dahl_ident.arrays import TINY, ComplexArray, FloatArray, IntArray
from dahl_ident.data.record import is_even
from dahl_ident.errors import ExtractionError, argument

FEWEST_CYCLES = 2  # needed to fit offset and drift as well
HARMONICS = 9  # least number of fitted harmonics, if the sampling can separate them
_MOST_HARMONICS = 40  # largest number; they reduce leakage if a cycle is no whole number of samples
_AFFORDABLE = 4e5  # samples times harmonics; with more samples there is less leakage
_NYQUIST_MARGIN = 0.45  # frequency of the highest harmonic over the sampling rate
_SAMPLES_AT_ONCE = 16384  # samples computed at once, so that their columns stay in the cache
_KEPT = 2_000_000  # entries of the columns up to which they are stored, not computed twice
_BLOCKS_PER_CYCLE = 64  # averages over such blocks lose 4e-4 of the fundamental
_MEANS_PER_CYCLE = 256  # averages lose 3e-5 of the fundamental and 0.2 % of the ninth harmonic
_FEWEST_SAMPLES = 2  # a phase difference needs two samples
_LARGEST_CONDITION = 1e8  # condition number of normal matrices
_LEAST_WEIGHT = 1e-6  # least weight of a cycle, as a fraction of the largest
_MAX_STEPS = 20  # iterations; without convergence by then the start was wrong
_TRACKED = 0.1  # rad of phase error, which the four-parameter fit then removes
_STEP_TOLERANCE = 1e-4  # rad of phase at the ends of the segment; the remaining error is its square
CYCLES_FOR_SCATTER = 4  # with fewer, lines next to the harmonic are few and distant
_MOST_LINES = 10  # on either side: 40 degrees of freedom; more hardly narrow an interval
_MEAN_LINES = 4  # lowest spectral lines, from which the noise of the mean is estimated
_INDEPENDENT = 0.05  # of the largest eigenvalue; smaller ones are of lines that depend on others
_NOISE_BLOCKS_PER_CYCLE = 128  # averages lose 1 % of slow noise at the ninth harmonic


@dataclass(frozen=True)
class Segment:
    """Samples of motion (row 0) and force (row 1), or means of blocks of them, and their phase."""

    time: FloatArray
    channels: FloatArray
    phase: Polynomial  # of tau, rad
    block: int = 1  # samples per block

    @property
    def centre(self) -> float:
        """Middle of the segment, s."""
        return 0.5 * float(self.time[0] + self.time[-1])

    @property
    def half_width(self) -> float:
        """Half the duration, s."""
        return 0.5 * float(self.time[-1] - self.time[0])

    @cached_property
    def tau(self) -> FloatArray:
        """Time scaled to -1 ... 1."""
        return (self.time - self.centre) / self.half_width

    @cached_property
    def theta(self) -> FloatArray:
        """Phase at every sample, rad."""
        return np.asarray(self.phase(self.tau))

    @cached_property
    def omega(self) -> float:
        """Angular frequency in the middle, rad/s."""
        return float(self.phase.deriv()(0.0)) / self.half_width

    @cached_property
    def sample_phase(self) -> float:
        """Phase from one sample to the next, rad."""
        return self.omega * float(np.median(np.diff(self.time)))

    def attenuation(self, orders: int) -> FloatArray | None:
        """Return the factors D_k of harmonics 1, 2, ... in block means; None for single samples."""
        if self.block == 1:
            return None
        half = 0.5 * np.arange(1, orders + 1) * self.sample_phase
        return np.asarray(np.sin(half) / (self.block * np.sin(half / self.block)))

    def with_samples(self, time: FloatArray, channels: FloatArray, block: int = 1) -> Segment:
        """Return a segment of other samples with the same phase as a function of time."""
        if time.size < _FEWEST_SAMPLES:
            raise ExtractionError(
                f"{time.size} samples near t = {self.centre:.6g} s for cycles of "
                f"{2.0 * np.pi / self.omega:.4g} s; expected at least 3 a cycle and 2 cycles: "
                f"sample faster, record longer, or check {argument('frequency')}"
            )
        new = Segment(time, channels, self.phase, block)
        inner = Polynomial(
            [(new.centre - self.centre) / self.half_width, new.half_width / self.half_width]
        )
        return replace(new, phase=self.phase(inner))

    def part(self, keep: slice) -> Segment:
        """Return some of the samples with their phase."""
        return self.with_samples(self.time[keep], self.channels[:, keep], self.block)

    def first_cycles(self, cycles: int) -> Segment:
        """Return the first `cycles`, or all if there are fewer."""
        end = self.theta[0] - 0.5 * self.sample_phase + 2.0 * np.pi * cycles
        return self.part(slice(0, int(np.searchsorted(self.theta, end))))

    def last_cycles(self, cycles: int) -> Segment:
        """Return the last `cycles`; a partial one at the start is left out."""
        first = self.theta[-1] + 0.5 * self.sample_phase - 2.0 * np.pi * cycles
        return self.part(slice(int(np.searchsorted(self.theta, first)), None))

    @property
    def whole_cycles(self) -> int:
        """Number of whole cycles, of which half a sample, or one block, may be missing."""
        missing = 0.5 if self.block == 1 else 1.0
        turned = float(self.theta[-1] - self.theta[0]) + (1.0 + missing) * self.sample_phase
        return int(turned / (2.0 * np.pi))

    def thinned(self) -> Segment:
        """Return block means, about 64 per cycle, if there are at least twice as many samples."""
        if self.sample_phase > np.pi / _BLOCKS_PER_CYCLE:
            return self
        starts, counts = _phase_blocks(self.theta, _BLOCKS_PER_CYCLE)
        means = np.add.reduceat(self.channels, starts, axis=1) / counts
        return self.with_samples(np.add.reduceat(self.time, starts) / counts, means)


@dataclass(frozen=True)
class Samples:
    """Waveforms as they were recorded: times, and motion and force as rows of `channels`."""

    time: FloatArray
    channels: FloatArray

    @property
    def step(self) -> float:
        """Mean time from one sample to the next, s."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    def block_size(self, highest_hz: float) -> int:
        """Return the number of samples per block; 1 if they are few per cycle, or uneven."""
        size = int(1.0 / (highest_hz * self.step * _MEANS_PER_CYCLE))
        return size if size > 1 and is_even(self.time) else 1

    def means(self, size: int) -> Samples:
        """Return means of blocks; samples after the last whole block are left out."""
        if size == 1:
            return self
        whole = self.time.size // size * size
        blocks = self.channels[:, :whole].reshape(2, -1, size)
        return Samples(self.time[:whole].reshape(-1, size).mean(axis=1), blocks.mean(axis=2))

    def of(self, segment: Segment) -> Samples:
        """Return the samples from which the block means of a segment are formed."""
        half_block = (0.5 * segment.block - 0.25) * self.step if segment.block > 1 else 0.0
        first = int(np.searchsorted(self.time, segment.time[0] - half_block))
        last = int(np.searchsorted(self.time, segment.time[-1] + half_block, side="right"))
        return Samples(self.time[first:last], self.channels[:, first:last])

    def lost_variance(self, segment: Segment) -> FloatArray:
        """Return the variance of both channels that the block means of a segment lack."""
        if segment.block == 1:
            return np.zeros(2)
        recorded = np.var(self.of(segment).channels, axis=1)
        return np.asarray(recorded - np.var(segment.channels, axis=1))


def steady_segment(time: FloatArray, channels: FloatArray, omega: float, block: int = 1) -> Segment:
    """Return a segment of constant angular frequency, rad/s."""
    half_width = 0.5 * float(time[-1] - time[0])
    return Segment(time, channels, Polynomial([0.0, omega * half_width]), block)


@dataclass(frozen=True)
class SineFit:
    """Least-squares fit of both channels; coefficients in the order of the columns."""

    segment: Segment
    orders: int
    trending: int  # harmonics 1 to this one may change linearly
    coefficients: FloatArray  # (columns, 2)
    inverse: FloatArray  # inverse of the normal matrix
    residual: FloatArray  # (2, n)

    @cached_property
    def residual_variance(self) -> FloatArray:
        """Mean square residual of motion and force, shape (2,)."""
        power = np.einsum("ij,ij->i", self.residual, self.residual)
        return np.asarray(power / self.residual.shape[1], dtype=np.float64)

    def phasors(self, harmonic: int) -> ComplexArray:
        """Return the phasors of motion and force at one harmonic, shape (2,); their means at 0."""
        return self._pair(2 * harmonic, harmonic)

    def slopes(self, harmonic: int) -> ComplexArray:
        """Return the derivatives of the phasors with respect to tau, shape (2,), with a trend."""
        return self._pair(2 * (self.orders + harmonic) if harmonic else 1, harmonic)

    def _pair(self, i: int, harmonic: int) -> ComplexArray:
        cos = self.coefficients[i].astype(np.complex128)
        return np.asarray(cos - 1j * self.coefficients[i + 1] if harmonic else cos)

    def phasors_of(self, waveforms: FloatArray) -> ComplexArray:
        """Return phasors 0, 1, ... of each waveform by the same fit; 0 after its last sample."""
        size = waveforms.shape[1]
        theta, tau = self.segment.theta[:size], self.segment.tau[:size]
        right = np.zeros((self.inverse.shape[0], len(waveforms)))
        factors = self.segment.attenuation(self.orders)
        for part, block in column_blocks(theta, tau, self.orders, self.trending, factors):
            right += block @ waveforms[:, part].T
        fitted = (self.inverse @ right)[: 2 * self.orders + 2].T
        phasors = fitted[:, ::2] - 1j * fitted[:, 1::2]
        phasors[:, 0] = fitted[:, 0]
        return np.asarray(phasors)

    def phasor_variance(self, harmonic: int) -> float:
        """Return E abs(phasor error)^2 for white noise of unit variance."""
        if harmonic == 0:
            return float(self.inverse[0, 0])
        i = 2 * harmonic
        return float(self.inverse[i, i] + self.inverse[i + 1, i + 1])


def resolvable_orders(segment: Segment) -> int:
    """Return how many harmonics are fitted: not more than the sampling can separate."""
    per_cycle = 2.0 * np.pi / segment.sample_phase
    affordable = np.clip(_AFFORDABLE / segment.time.size, HARMONICS, _MOST_HARMONICS)
    orders = int(min(affordable, _NYQUIST_MARGIN * per_cycle))
    if orders < 1 or segment.time.size < 2 * orders + 4:
        raise ExtractionError(
            f"{segment.time.size} samples at {per_cycle:.3g} samples a cycle near "
            f"t = {segment.centre:.6g} s; expected at least 3 a cycle and 2 cycles: "
            "sample faster or record longer"
        )
    return orders


def sine_fit(segment: Segment, *, trend: bool = False, most: int = _MOST_HARMONICS) -> SineFit:
    """Fit harmonics, offset and drift to both channels; with `trend` harmonics change linearly."""
    orders = min(resolvable_orders(segment), most)
    trending = orders if trend else 0
    theta, tau, factors = segment.theta, segment.tau, segment.attenuation(orders)

    def blocks() -> Iterable[tuple[slice, FloatArray]]:
        return column_blocks(theta, tau, orders, trending, factors)

    width = 2 * (orders + trending) + 2
    stored = tuple(blocks()) if width * theta.size <= _KEPT else ()
    normal, right = normal_equations(segment.channels, width, stored or blocks())
    inverse = checked_inverse(normal, segment)
    coefficients = inverse @ right
    residual = segment.channels.copy()
    for part, block in stored or blocks():
        residual[:, part] -= coefficients.T @ block
    return SineFit(segment, orders, trending, coefficients, inverse, residual)


def estimate_frequency(segment: Segment) -> Segment:
    """Return the segment with the frequency that fits both channels best.

    Gauss-Newton method; the phase at the ends moves by at most half a cycle. The channels are
    weighted by their residuals.
    """
    thinned = segment.thinned()
    change = 0.0
    for _ in range(_MAX_STEPS):
        step = _frequency_step(thinned)
        change += step
        if abs(change) > np.pi:
            break
        thinned = replace(thinned, phase=thinned.phase + Polynomial([0.0, step]))
        if abs(step) < _STEP_TOLERANCE:
            change *= segment.half_width / thinned.half_width
            return replace(segment, phase=segment.phase + Polynomial([0.0, change]))
    raise ExtractionError(
        f"no steady frequency near {segment.omega / (2.0 * np.pi):.6g} Hz around t = "
        f"{segment.centre:.6g} s: the fit diverges; expected one sine of constant frequency: "
        f"give {argument('frequency')}, or {argument('mode', 'sweep')}"
    )


def track_phase(segment: Segment, degree: int) -> Segment:
    """Return the segment with its phase fitted to that of the motion, cycle by cycle."""
    for _ in range(_MAX_STEPS):
        error = _phase_error(segment.thinned(), degree)
        segment = replace(segment, phase=segment.phase + error)
        if np.abs(error.coef).sum() < _TRACKED:
            break
    return segment


def _phase_error(segment: Segment, degree: int) -> Polynomial:
    """Return the deviation of the motion's phase as a polynomial of tau that is 0 at tau = 0."""
    theta = segment.theta
    motion = segment.channels[0] - segment.channels[0].mean()
    turns = (theta - theta[0]) / (2.0 * np.pi)
    starts = np.searchsorted(turns, np.arange(int(turns[-1] + 0.25)))
    starts = np.unique(starts[starts < theta.size])
    if starts.size <= degree:
        return Polynomial([0.0])
    counts = np.diff(starts, append=theta.size)
    sums = np.add.reduceat(motion * np.exp(-1j * theta), starts)
    tau = np.add.reduceat(segment.tau, starts) / counts
    weights = np.abs(sums) + _LEAST_WEIGHT * np.abs(sums).max() + TINY
    error = Polynomial.fit(tau, np.unwrap(np.angle(sums)), degree, w=weights).convert()
    return error - error(0.0)


def _frequency_step(segment: Segment) -> float:
    """Return one Gauss-Newton step of the phase at tau = 1, rad."""
    orders = min(HARMONICS, resolvable_orders(segment))
    y, n = segment.channels, 2 * orders + 2
    blocks = column_blocks(segment.theta, segment.tau, orders, 1)
    normal, right = normal_equations(y, n + 2, blocks)
    inverse = checked_inverse(normal[:n, :n], segment)
    curvature = gradient = 0.0
    for channel in range(len(y)):
        coefficients = inverse @ right[:n, channel]
        total = float(y[channel] @ y[channel])
        if total == 0.0:
            continue
        cos, sin = coefficients[2:4]
        derivative = np.zeros(n + 2)  # tau (-cos sin(theta) + sin cos(theta))
        derivative[n:] = sin, -cos
        cross = normal[:n] @ derivative
        residual_power = total - float(right[:n, channel] @ coefficients)
        weight = 1.0 / max(residual_power, 1e-24 * total)
        curvature += weight * float(derivative @ normal @ derivative - cross @ inverse @ cross)
        gradient += weight * float(derivative @ right[:, channel] - cross @ coefficients)
    return gradient / curvature if curvature else 0.0


def columns(
    theta: FloatArray,
    tau: FloatArray,
    orders: int,
    trending: int = 0,
    factors: FloatArray | None = None,
) -> FloatArray:
    """Return 1, tau, cos theta, sin theta, cos 2 theta, ...; then `trending` pairs times tau."""
    width = 2 * orders + 2
    out = np.empty((width + 2 * trending, theta.size))
    out[0] = 1.0
    out[1] = tau
    np.cos(theta, out=out[2])
    np.sin(theta, out=out[3])
    twice = 2.0 * out[2]
    for i in range(4, width):  # cos k = 2 cos 1 cos(k - 1) - cos(k - 2), likewise for sin
        np.multiply(twice, out[i - 2], out=out[i])
        if i != 5:
            out[i] -= out[i - 4] if i > 5 else 1.0
    if factors is not None:
        out[2:width] *= np.repeat(factors, 2)[:, None]
    np.multiply(out[2 : 2 + 2 * trending], tau, out=out[width:])
    return out


def column_blocks(
    theta: FloatArray,
    tau: FloatArray,
    orders: int,
    trending: int,
    factors: FloatArray | None = None,
) -> Iterator[tuple[slice, FloatArray]]:
    """Yield slices of the samples with their columns."""
    for start in range(0, theta.size, _SAMPLES_AT_ONCE):
        part = slice(start, start + _SAMPLES_AT_ONCE)
        yield part, columns(theta[part], tau[part], orders, trending, factors)


def normal_equations(
    channels: FloatArray, width: int, blocks: Iterable[tuple[slice, FloatArray]]
) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix and the right-hand sides of a fit with `width` columns."""
    normal = np.zeros((width, width))
    right = np.zeros((width, len(channels)))
    for part, block in blocks:
        normal += block @ block.T
        right += block @ channels[:, part].T
    return normal, right


def checked_inverse(normal: FloatArray, segment: Segment) -> FloatArray:
    """Return the inverse of a normal matrix, or raise an error if it is ill-conditioned."""
    if not np.linalg.cond(normal) < _LARGEST_CONDITION:
        raise ExtractionError(
            f"the samples around t = {segment.centre:.6g} s do not separate the harmonics of "
            f"{segment.omega / (2.0 * np.pi):.6g} Hz apart; expected samples spread over whole "
            f"cycles: check {argument('frequency')} and the sampling"
        )
    return np.asarray(np.linalg.inv(normal))


@dataclass(frozen=True)
class LineNoise:
    """Noise near one harmonic: scaled spectral lines, (2, lines); `matrix` sums their products."""

    lines: ComplexArray
    dof: float

    @property
    def matrix(self) -> ComplexArray:
        """``E[e e^H]`` of the errors e of one sample (motion, force), Hermitian."""
        return self.lines @ self.lines.conj().T


def line_noise(
    fit: SineFit, harmonics: Sequence[int], cycles: int, residual: FloatArray
) -> list[LineNoise]:
    """Return the noise near each harmonic of a fit over two or more whole cycles."""
    reach = cycles // 2 if cycles >= CYCLES_FOR_SCATTER else cycles - 1
    side = min(reach, _MOST_LINES)
    content, window = _line_content(fit, harmonics, cycles, side, residual)
    lines = np.concatenate([np.arange(-side, 0), np.arange(1, side + 1)])
    whitening, freedom = _whitening(window, lines)
    noise = []
    for harmonic, sums in zip(harmonics, content, strict=True):
        frequency = harmonic + lines / cycles
        if harmonic:
            weights, sides = frequency, 1
        else:
            weights = (np.abs(lines) <= _MEAN_LINES).astype(np.float64)
            sides = 2
        weights = weights / (weights @ freedom)
        # the fitted straight line takes 6/(pi p)^2 of the power of a sine with p periods in the
        # record and none of the cosine, except for the part in the harmonics, about 1/P^2
        drift = 3.0 / (np.pi * frequency * cycles) ** 2 / (1.0 - 1.0 / cycles**2)
        weighted = np.sqrt(weights / (1.0 - drift)) * (sums @ whitening.T)
        noise.append(LineNoise(weighted, 2.0 / sides / float(weights**2 @ freedom)))
    return noise


def _line_content(
    fit: SineFit, harmonics: Sequence[int], cycles: int, side: int, residual: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return ``sum r exp(-j (k + m/P) theta)`` and the window's ``sum exp(-j q theta/P)``."""
    theta, residual, counts = _block_sums(fit.segment.theta, residual)
    products = np.zeros((2, len(harmonics), 2, 2, side))
    window = np.zeros(2 * side + 1, dtype=np.complex128)
    for start in range(0, theta.size, _SAMPLES_AT_ONCE):
        part = slice(start, start + _SAMPLES_AT_ONCE)
        tones = powers(np.exp(-1j / cycles * theta[part]), side)
        window[: side + 1] += tones @ counts[part]
        window[side + 1 :] += tones[1:] @ (counts[part] * tones[side])
        turned = powers(np.exp(-1j * theta[part]), max(harmonics))[list(harmonics), None]
        turned = turned * residual[:, part]
        left = np.stack([turned.real, turned.imag])
        right = np.concatenate([tones[1:].real, tones[1:].imag])
        products += np.tensordot(left, right, axes=(-1, -1)).reshape(products.shape)
    (re_re, re_im), (im_re, im_im) = np.moveaxis(products, 3, 1)
    above = re_re - im_im + 1j * (re_im + im_re)
    below = re_re + im_im + 1j * (im_re - re_im)
    return np.concatenate([below[..., ::-1], above], axis=-1), window


def _block_sums(
    theta: FloatArray, residual: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return phase, sum of the residual and number of samples of about 128 blocks per cycle."""
    starts, counts = _phase_blocks(theta, _NOISE_BLOCKS_PER_CYCLE)
    if 2 * starts.size > theta.size:
        return theta, residual, np.ones(theta.size)
    middle = np.add.reduceat(theta, starts) / counts
    return middle, np.add.reduceat(residual, starts, axis=1), counts


def _phase_blocks(theta: FloatArray, per_cycle: int) -> tuple[IntArray, FloatArray]:
    """Return the first sample and the number of samples of blocks of equal phase."""
    block = np.floor((theta - theta[0]) * (per_cycle / (2.0 * np.pi)))
    starts = np.flatnonzero(np.diff(block, prepend=-1.0))
    return starts, np.diff(starts, append=theta.size).astype(np.float64)


def powers(rotor: ComplexArray, highest: int) -> ComplexArray:
    """Return the powers 0 to `highest`, one per row."""
    powers = np.ones((highest + 1, rotor.size), dtype=np.complex128)
    for k in range(1, highest + 1):
        np.multiply(powers[k - 1], rotor, out=powers[k])
    return powers


def _whitening(window: ComplexArray, lines: IntArray) -> tuple[ComplexArray, FloatArray]:
    """Return the matrix that makes lines of white noise independent, and the freedom of each."""

    def spectrum(line: IntArray) -> ComplexArray:
        return np.where(line >= 0, window[np.abs(line)], window[np.abs(line)].conj())

    at_lines = spectrum(lines)
    gram = spectrum(lines[:, None] - lines) - np.outer(at_lines, at_lines.conj()) / window[0]
    values, vectors = np.linalg.eigh(gram)
    kept = vectors[:, values > _INDEPENDENT * values[-1]]
    whitening = (kept / np.sqrt(values[-kept.shape[1] :])) @ kept.conj().T
    return whitening, np.sum(np.abs(kept) ** 2, axis=1)

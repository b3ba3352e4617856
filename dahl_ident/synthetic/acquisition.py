"""Sensors and recorder, which turn the true motion into stored numbers, and errors of tables.

A channel stores, at its nominal sampling times t,

    clip(quantise(gain y(t + jitter - delay) + offset + drift t + hum + white + 1/f noise))

where y is the true signal after a first-order anti-alias filter. Jitter is common to the channels,
because one clock samples both; noise is not.

Every effect has its own stream of random numbers, which depends only on the seed and the purpose,
so that adding an effect does not change the others. The bits come from PCG64, and normal numbers
from the inverse of their distribution: no draw is ever rejected, so platform differences in the
last digit cannot shift a stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtri

from dahl_ident.arrays import (
    ComplexArray,
    FloatArray,
    finite_number,
    non_negative_number,
    positive_number,
    whole_number,
)
from dahl_ident.data.columns import one_of, set_checked
from dahl_ident.elements.driven_motion import STEADY, Steady
from dahl_ident.errors import ValidationError
from dahl_ident.synthetic.mechanism import Signal

_FILTER_OVERSAMPLING = 16  # points per sample; the signal is linear between them
_WAVEFORM_FAULTS = (
    "noise_std",
    "flicker_std",
    "hum_amplitude",
    "offset",
    "drift",
    "resolution",
    "limit",
)


@dataclass(frozen=True)
class Channel:
    """One sensor, by default ideal.

    Parameters
    ----------
    gain : float, default 1
        Measured over true value, > 0.
    delay : float, default 0
        Time by which the channel lags, s.
    antialias_hz : float, optional
        Corner frequency of a first-order low-pass filter, Hz.
    noise_std : float, default 0
        Standard deviation of white noise, in the channel's unit.
    flicker_std : float, default 0
        Standard deviation over the record of 1/f noise, in the channel's unit.
    hum_amplitude : float, default 0
        Amplitude of mains hum, in the channel's unit; its phase is random.
    hum_hz : float, default 50
        Mains frequency, Hz.
    offset : float, default 0
        Added constant, in the channel's unit.
    drift : float, default 0
        Added slope, in the channel's unit per second.
    resolution : float, default 0
        Step of the quantiser, in the channel's unit; 0 for none.
    limit : float, optional
        Values above this or below minus this are clipped.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> Channel(noise_std=1e-6, resolution=5e-6).gain
    1.0
    """

    gain: float = 1.0
    delay: float = 0.0
    antialias_hz: float | None = None
    noise_std: float = 0.0
    flicker_std: float = 0.0
    hum_amplitude: float = 0.0
    hum_hz: float = 50.0
    offset: float = 0.0
    drift: float = 0.0
    resolution: float = 0.0
    limit: float | None = None

    def __post_init__(self) -> None:
        set_checked(self, positive_number, "gain", "hum_hz", "antialias_hz", "limit")
        set_checked(self, finite_number, "delay", "offset", "drift")
        not_negative = ("noise_std", "flicker_std", "hum_amplitude", "resolution")
        set_checked(self, non_negative_number, *not_negative)

    def response(self, omega: FloatArray) -> ComplexArray:
        """Return measured over true phasor at angular frequencies: gain, filter and delay."""
        response = self.gain * np.exp(-1j * omega * self.delay)
        if self.antialias_hz is not None:
            response = response / (1.0 + 1j * omega / (2.0 * np.pi * self.antialias_hz))
        return np.asarray(response)

    def measure(
        self, signal: Signal, time: FloatArray, jitter: FloatArray, draws: Draws, name: str
    ) -> FloatArray:
        """Return the values that the channel `name` stores at its nominal sampling times."""
        filtered = self._filtered(signal, time[0], time[-1], time[1] - time[0])
        y = self.gain * filtered(time + jitter - self.delay) + self.offset + self.drift * time
        if self.hum_amplitude > 0.0:
            cycle = draws.uniform(f"{name} hum", 1)
            y = y + self.hum_amplitude * np.sin(2.0 * np.pi * (self.hum_hz * time + cycle))
        if self.noise_std > 0.0:
            y = y + self.noise_std * draws.normal(f"{name} noise", time.size)
        if self.flicker_std > 0.0:
            y = y + self.flicker_std * draws.flicker(f"{name} flicker", time.size)
        if self.resolution > 0.0:
            y = self.resolution * np.round(y / self.resolution)
        return y if self.limit is None else np.clip(y, -self.limit, self.limit)

    def _filtered(self, signal: Signal, start: float, stop: float, step: float) -> Signal:
        """Return the signal after the anti-alias filter, which is in steady state at `start`."""
        from scipy.interpolate import CubicSpline
        from scipy.signal import lfilter

        if self.antialias_hz is None:
            return signal
        first = start - abs(self.delay) - step
        span = stop + abs(self.delay) - first
        whole_number(int(_FILTER_OVERSAMPLING * span / step), "the number of filtered samples", 1)
        grid = np.arange(first, stop + abs(self.delay) + 2.0 * step, step / _FILTER_OVERSAMPLING)
        y = signal(grid)
        d = 2.0 * np.pi * self.antialias_hz * (grid[1] - grid[0])
        pole = np.exp(-d)
        weight = 1.0 + np.expm1(-d) / d  # of the newer sample, first-order hold
        taps = [weight, 1.0 - pole - weight]
        filtered, _ = lfilter(taps, [1.0, -pole], y, zi=[y[0] * (1.0 - weight)])
        return CubicSpline(grid, filtered)


@dataclass(frozen=True)
class Acquisition:
    """The recorder with its two channels.

    Parameters
    ----------
    sample_rate_hz : float, optional
        Samples per second; by default 64 per shortest period of the excitation.
    displacement, force : Channel
        The sensors, with units m (rad) and N (N m).
    jitter_std : float, default 0
        Standard deviation of the sampling instants from the stored times, s.
    dropped_fraction : float, default 0
        Fraction of the samples, chosen at random, that are missing from the record.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> Acquisition(sample_rate_hz=1000.0, force=Channel(noise_std=1e-3)).displacement.noise_std
    0.0
    """

    sample_rate_hz: float | None = None
    displacement: Channel = field(default_factory=Channel)
    force: Channel = field(default_factory=Channel)
    jitter_std: float = 0.0
    dropped_fraction: float = 0.0

    def __post_init__(self) -> None:
        set_checked(self, positive_number, "sample_rate_hz")
        set_checked(self, non_negative_number, "jitter_std", "dropped_fraction")
        if self.dropped_fraction > 0.9:
            raise ValidationError(
                f"dropped_fraction is {self.dropped_fraction!r}; expected a share from 0 to 0.9"
            )

    def faults_of_records(self) -> list[str]:
        """Return the names of the settings that only affect waveforms."""
        no_fault = Channel()
        faults = [
            f"{name} {fault}"
            for name in ("displacement", "force")
            for fault in _WAVEFORM_FAULTS
            if getattr(getattr(self, name), fault) != getattr(no_fault, fault)
        ]
        return faults + [f for f in ("jitter_std", "dropped_fraction") if getattr(self, f) > 0.0]

    def sampling_times(self, duration: float, highest_hz: float) -> FloatArray:
        """Return the nominal sampling times over a run.

        Raises
        ------
        ValidationError
            If the rate is not above two samples per period, or there are too many samples.
        """
        rate = self.sample_rate_hz if self.sample_rate_hz is not None else 64.0 * highest_hz
        if rate <= 2.0 * highest_hz:
            raise ValidationError(
                f"sample_rate_hz is {rate:g}; expected more than {2.0 * highest_hz:g}, two samples "
                "in the shortest period"
            )
        last = int(np.floor(duration * rate * (1.0 + 1e-12)))
        return np.arange(whole_number(last + 1, "the number of samples", 1)) / rate

    def record(
        self, displacement: Signal, force: Signal, time: FloatArray, draws: Draws
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the stored time, displacement and force."""
        jitter = np.zeros_like(time)
        if self.jitter_std > 0.0:
            jitter = self.jitter_std * draws.normal("jitter", time.size)
        x = self.displacement.measure(displacement, time, jitter, draws, "displacement")
        F = self.force.measure(force, time, jitter, draws, "force")
        if self.dropped_fraction == 0.0:
            return time, x, F
        kept = draws.uniform("dropped samples", time.size) >= self.dropped_fraction
        kept[[0, -1]] = True
        return time[kept], x[kept], F[kept]


@dataclass(frozen=True)
class Table:
    """Request for a table of responses with given errors.

    Parameters
    ----------
    displacement_std, force_std : float, default 0
        Standard deviation of the real and of the imaginary part of each phasor, relative to the
        size of its fundamental.
    harmonics : sequence of int, default (1,)
        Harmonics that get a row: of the force if the displacement is controlled; of the
        displacement, up to 9, if the force is controlled.
    outlier_fraction : float, default 0
        Fraction of the rows, chosen at random, with a gross error.
    outlier_size : float, default 0.5
        That error relative to the response, in a random direction of the complex plane.
    steady : {"exact", "describing function"}, default "exact"
        If the force is controlled: the exact motion of the plant, or the approximation by the
        paper's describing function.

    Raises
    ------
    ValidationError
        If a value is not as said here.

    Examples
    --------
    >>> Table(force_std=0.01).harmonics
    (1,)
    """

    displacement_std: float = 0.0
    force_std: float = 0.0
    harmonics: Sequence[int] = (1,)
    outlier_fraction: float = 0.0
    outlier_size: float = 0.5
    steady: Steady = "exact"

    def __post_init__(self) -> None:
        names = ("displacement_std", "force_std", "outlier_fraction", "outlier_size")
        set_checked(self, non_negative_number, *names)
        one_of(self.steady, "steady", STEADY)
        if self.outlier_fraction > 1.0:
            raise ValidationError(
                f"outlier_fraction is {self.outlier_fraction!r}; expected a share from 0 to 1"
            )
        harmonics = tuple(whole_number(k, "harmonics", 1) for k in self.harmonics)
        if not harmonics:
            raise ValidationError("harmonics is empty; expected at least the fundamental, (1,)")
        object.__setattr__(self, "harmonics", harmonics)

    def outlier_rows(self, rows: int, draws: Draws) -> list[int]:
        """Return the rows that get a gross error, in increasing order."""
        count = round(self.outlier_fraction * rows)
        return sorted(draws.permutation("outlier rows", rows)[:count])


class Draws:
    """The random streams of one seed, a whole number >= 0, each identified by its purpose."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def uniform(self, purpose: str, n: int) -> FloatArray:
        """Return `n` numbers between 0 and 1, excluding both."""
        key = np.random.SeedSequence(self._seed, spawn_key=tuple(purpose.encode()))
        bits = np.random.PCG64(key).random_raw(n)
        return np.asarray(((bits >> np.uint64(11)) + 0.5) * 2.0**-53)

    def normal(self, purpose: str, n: int) -> FloatArray:
        """Return `n` standard normal numbers."""
        return np.asarray(ndtri(self.uniform(purpose, n)))

    def complex_normal(self, purpose: str, n: int) -> ComplexArray:
        """Return `n` complex numbers with standard normal real and imaginary parts."""
        parts = (self.normal(f"{purpose}, {part}", n) for part in ("real", "imaginary"))
        return np.asarray(next(parts) + 1j * next(parts))

    def flicker(self, purpose: str, n: int) -> FloatArray:
        """Return `n` numbers of noise with a power of 1/f, mean 0 and expected variance 1."""
        spectrum = np.fft.rfft(self.normal(purpose, n))
        weight = np.zeros(spectrum.size)
        weight[1:] = np.arange(1, spectrum.size) ** -0.5
        lines = np.full(spectrum.size, 2.0)
        if n % 2 == 0:
            lines[-1] = 1.0
        # white noise has a power of n in each line; the inverse transform divides by n
        scale = np.sqrt(n / np.sum(lines * weight**2))
        return np.asarray(scale * np.fft.irfft(spectrum * weight, n))

    def permutation(self, purpose: str, n: int) -> list[int]:
        """Return the whole numbers below `n` in random order."""
        return [int(i) for i in np.argsort(self.uniform(purpose, n), kind="stable")]

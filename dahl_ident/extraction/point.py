r"""One measured point: dynamic stiffness at one amplitude and frequency, with its errors.

With the phasors X of displacement and F of force and their errors e_X, e_F,

    X_1 = A exp(j phi)                dA + j A dphi = e_X exp(-j phi)
    N   = F_1/X_1                     dN  = (e_F - N e_X)/X_1
    N_k = F_k exp(-j k phi)/A         dN_k = e_Fk exp(-j k phi)/A - N_k (dA/A + j k dphi)
    N_0 = F_0/A                       dN_0 = e_F0/A - N_0 dA/A,   real

so the response shares the displacement's error with the amplitude. A velocity or an acceleration
is integrated at the fitted frequency: its phasor at harmonic k is divided by ``j k omega`` once
or twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import fdtri

from dahl_ident.arrays import TINY, ComplexArray, FloatArray
from dahl_ident.data.plausibility import creates_energy
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.aliasing import alias_error, aliases_unseen
from dahl_ident.extraction.asymmetry import BY_CHANCE, EVEN, asymmetry
from dahl_ident.extraction.block_means import Samples
from dahl_ident.extraction.cycles import scattered
from dahl_ident.extraction.line_noise import CYCLES_FOR_SCATTER, LineNoise, line_noise
from dahl_ident.extraction.segment_quality import (
    clipped_share,
    crest_samples,
    distortion,
    fundamental_share,
    quantisation_errors,
    sensor_step,
)
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    HARMONICS,
    Segment,
    SineFit,
    columns,
    first_cycles,
    last_cycles,
    sine_fit,
    thinned,
    whole_cycles,
)
from dahl_ident.extraction.transient import (
    MOST_CYCLES,
    SIGNIFICANT,
    Transient,
    estimate_transient,
)

TOO_FAST = "swept too fast"
_NEGLIGIBLE = 0.2  # bias over standard error to which settling cycles are left out
_TOLERATED = 1.0  # bias over standard error above which a point has not settled
_DISTORTED = 0.02  # from which the fundamental alone misses percents of the loss
_MOVING_MEAN = 0.02  # of the amplitude, over the segment, where the force is controlled
_BEYOND_NOISE = 5.0  # standard errors of a drift in white noise
_ROUNDING = 1e-9  # of the response
_ALIASED = 0.01  # of the fundamental, above which aliases are reported
_LOOKED_AT = 10_000  # samples from which their residual is taken
_FEW_STEPS = 10.0  # amplitude over sensor step below which the step matters


@dataclass(frozen=True)
class Settings:
    """How segments are turned into points; see :func:`dahl_ident.extraction.extract`."""

    harmonics: tuple[int, ...]
    num_periods: int | None
    settling_periods: int | None
    min_share: float
    motion_channel: str
    controlled: str

    @property
    def integrations(self) -> int:
        """How often the motion channel has to be integrated."""
        return ("displacement", "velocity", "acceleration").index(self.motion_channel)

    @property
    def transient_channel(self) -> int:
        """Where the transient shows: in the force, or in a displacement that is free."""
        free = self.controlled == "force" and self.motion_channel == "displacement"
        return 0 if free else 1


@dataclass(frozen=True)
class Point:
    """One amplitude and frequency: responses of the fundamental and the harmonics.

    `joint` is the covariance of amplitude, real and imaginary part of each response, (rows, 3, 3);
    `repeating` is the part of it that is alike in every cycle.
    """

    frequency_hz: float
    amplitude: float
    drive: float
    harmonic: list[int]
    response: ComplexArray
    joint: FloatArray
    repeating: FloatArray
    dof: FloatArray
    sweep: bool
    quality: dict[str, Any]

    @property
    def amplitude_std(self) -> float:
        """Standard deviation of the amplitude."""
        return float(np.sqrt(self.joint[0, 0, 0]))

    @property
    def amplitude_covariance(self) -> FloatArray:
        """Covariance of the amplitude with real and imaginary parts, (rows, 2)."""
        return np.asarray(self.joint[:, 0, 1:])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of real and imaginary parts, (rows, 2, 2)."""
        return np.asarray(self.joint[:, 1:, 1:])


@dataclass(frozen=True)
class _Phasors:
    """Displacement and force of one segment with their noise.

    `fit` is without the transient where that is significant; `transient_phasors` is what the
    transient adds to the phasors of its channel, and belongs to the response.
    """

    fit: SineFit
    cycles: int
    settings: Settings
    noise_orders: tuple[int, ...]
    noise: tuple[LineNoise, ...]
    transient: Transient
    transient_phasors: ComplexArray
    steps: FloatArray
    """Of the two sensors, 0 where they have none."""
    samples: Samples
    """Those that the segment's block means are made of."""

    @property
    def harmonics(self) -> list[int]:
        return [k for k in self.settings.harmonics if k <= self.fit.orders]

    @cached_property
    def integrator(self) -> complex:
        """Displacement over the motion channel at the fundamental."""
        return complex((1j * self.fit.segment.omega) ** -self.settings.integrations)

    def phasors(self, harmonic: int) -> ComplexArray:
        """Return the phasors of the motion channel and the force, shape (2,)."""
        both = self.fit.phasors(harmonic)
        if self.transient.significant and harmonic:  # the mean is that of the steady loop
            both[self.settings.transient_channel] += self.transient_phasors[harmonic]
        return both

    @cached_property
    def displacement(self) -> complex:
        return complex(self.phasors(1)[0] * self.integrator)

    @cached_property
    def rounding(self) -> FloatArray:
        """Root mean square error of a phasor of the motion channel and the force by rounding."""
        if not self.steps.any():
            return np.zeros(2)
        return quantisation_errors(
            np.abs(self.fit.phasors(1)),
            self.steps,
            self._sample_residual,
            self.samples.time.size / self.cycles,
        )

    @property
    def _sample_residual(self) -> FloatArray:
        """Root mean square of what the fit leaves of single samples of both channels."""
        fit, segment = self.fit, self.fit.segment
        if segment.block == 1:
            return np.asarray(np.sqrt(fit.residual_variance))
        time, motion, force = (
            scattered(v, _LOOKED_AT)
            for v in (self.samples.time, self.samples.motion, self.samples.force)
        )
        own = segment.with_samples(time, np.stack([motion, force]))
        tau = (time - segment.centre) / segment.half_width
        sine = fit.coefficients.T @ columns(own.theta, tau, fit.orders, fit.trending)
        left = _without(self.transient, own, self.settings).channels - sine
        return np.asarray(np.sqrt(np.mean(left**2, axis=1)))

    @cached_property
    def _alias_errors(self) -> dict[int, FloatArray]:
        return {k: alias_error(self.fit, k, self.cycles) for k in self.noise_orders}

    def repeating_errors(self, harmonic: int) -> FloatArray:
        """Return the errors of the phasors of both channels that are alike in every cycle."""
        return np.hypot(self.rounding, self._alias_errors[harmonic])

    @cached_property
    def errors(self) -> ComplexArray:
        """Errors of the fundamental phasors of displacement and force; their products sum up."""
        scale = np.array([[self.integrator], [1.0]])
        noise = self.noise[0].lines * np.sqrt(self.fit.phasor_variance(1))
        return np.asarray(scale * np.hstack([noise, np.diag(self.repeating_errors(1))]))

    def noise_of(self, harmonic: int) -> LineNoise:
        return self.noise[self.noise_orders.index(harmonic)]

    def variance(self, harmonic: int) -> FloatArray:
        """Return E abs(error)^2 of the phasors of the motion channel and the force, shape (2,)."""
        noise = np.diagonal(self.noise_of(harmonic).matrix).real
        repeating = self.repeating_errors(harmonic)
        return np.asarray(noise * self.fit.phasor_variance(harmonic) + repeating**2)

    @cached_property
    def distorted(self) -> float:
        """Return the displacement's harmonics beyond its noise over its fundamental.

        To a harmonic of the force each adds about the stiffness times its own size: all of it in
        a linear device, and of harmonics other than its own in friction.
        """
        power = 0.0
        for k in (k for k in self.noise_orders if k > 1):
            size, variance = abs(self.fit.phasors(k)[0]), float(self.variance(k)[0])
            if size**2 > fdtri(2, self.noise_of(k).dof, 1.0 - BY_CHANCE) * variance:
                power += (size**2 - variance) / k ** (2 * self.settings.integrations)
        return float(np.sqrt(power) / abs(self.fit.phasors(1)[0]))

    def forgotten(self, harmonic: int) -> float:
        """Return the standard deviation that the transient's size leaves in a force phasor."""
        if self.settings.transient_channel == 0 or self.transient.departure == 0.0:
            return 0.0
        added = complex(self.transient_phasors[harmonic])
        size = abs(added) if harmonic else abs(added.real)
        return size * self.transient.departure_std / abs(self.transient.departure)

    @property
    def amplitude_variance(self) -> float:
        return 0.5 * float(np.sum(np.abs(self.errors[0]) ** 2))

    def referred(self, force: complex, harmonic: int) -> complex:
        """Return a force phasor over the displacement's amplitude, turned by k times its phase."""
        X = self.displacement
        return complex(force * (abs(X) / X) ** harmonic / abs(X))

    def response(self, harmonic: int) -> complex:
        return self.referred(complex(self.phasors(harmonic)[1]), harmonic)

    def changed(self, motion: complex, force: ComplexArray) -> ComplexArray:
        """Return how the responses change where the motion's and the force's phasors do."""
        relative = motion / self.phasors(1)[0]
        changes = [
            self.referred(complex(f), k)
            - self.response(k) * complex(relative.real, k * relative.imag)
            for k, f in zip(self.harmonics, force, strict=True)
        ]
        return np.array(changes)


def measure(
    segment: Segment, settings: Settings, samples: Samples, *, sweep: bool = False
) -> Point:
    """Turn a segment of known phase, and the record's samples, into a point.

    In a sweep amplitude and response may change linearly, and no cycles are left out.
    """
    found = whole_cycles(segment)
    if found < FEWEST_CYCLES:
        raise ExtractionError(
            f"{found} whole cycles {_where(segment)}; expected at least {FEWEST_CYCLES}: record "
            "longer, or check frequency="
        )
    cycles = min(found, settings.num_periods or found)
    if not sweep and cycles - (settings.settling_periods or 0) < FEWEST_CYCLES:
        raise ExtractionError(
            f"{cycles} cycles {_where(segment)}, {settings.settling_periods} of them for "
            f"settling; expected {FEWEST_CYCLES} more than for settling: record longer, or lower "
            "settling_periods="
        )
    whole = last_cycles(segment, cycles)
    own = samples.of(whole)
    steps = np.array([sensor_step(channel) for channel in (own.motion, own.force)])
    first = first_cycles(whole, MOST_CYCLES)
    rough = sine_fit(thinned(first), trend=sweep, most=HARMONICS)
    _check_motion(rough, steps, settings)
    transient = _transient(rough, settings)
    steady = _without(transient, first, settings)
    _check_share(rough, steady, settings, samples.within_blocks(first))
    if sweep:
        dropped = 0
    elif settings.settling_periods is not None:
        dropped = settings.settling_periods
    else:
        dropped = _settling_periods(rough.segment, transient, cycles, settings, steps, own)
    used = last_cycles(whole, cycles - dropped)
    phasors = _phasors(
        used, transient, cycles - dropped, settings, steps, samples.of(used), sweep=sweep
    )
    _check_share(phasors.fit, phasors.fit.segment, settings, samples.within_blocks(used))
    return _point(phasors, cycles, dropped, steps)


def _check_motion(fit: SineFit, steps: FloatArray, settings: Settings) -> None:
    """Refuse what moves less than its sensor resolves."""
    amplitudes = np.abs(fit.phasors(1))
    for name, amplitude, step in zip(_names(settings), amplitudes, steps, strict=True):
        if amplitude <= step or amplitude == 0.0:
            raise ExtractionError(
                f"{name} {_where(fit.segment)}: amplitude {amplitude:.4g} is "
                f"{amplitude / (step or 1.0):.3g} sensor steps (of {step:.4g}); expected more "
                "than one step: use a larger amplitude or a finer range"
            )


def _check_share(fit: SineFit, segment: Segment, settings: Settings, within: FloatArray) -> None:
    """Refuse what is not one sine."""
    shares = fundamental_share(fit, segment, within)
    for name, share in zip(_names(settings), shares, strict=True):
        if share < settings.min_share:
            raise ExtractionError(
                f"{name} {_where(segment)}: the fundamental has {100.0 * share:.3g} % of the "
                f"power; expected at least {100.0 * settings.min_share:.3g} %, one dominant sine: "
                "check the channel and frequency=, or lower min_share= if it is noise"
            )


def _names(settings: Settings) -> tuple[str, str]:
    return settings.motion_channel, "force"


def _where(segment: Segment) -> str:
    return f"around t = {segment.centre:.6g} s, {segment.omega / (2.0 * np.pi):.6g} Hz"


def _transient(fit: SineFit, settings: Settings) -> Transient:
    X = complex(fit.phasors(1)[0] * (1j * fit.segment.omega) ** -settings.integrations)
    response = complex(fit.phasors(1)[1]) / X
    return estimate_transient(fit, settings.transient_channel, float(np.angle(X)), response)


def _without(transient: Transient, segment: Segment, settings: Settings) -> Segment:
    """Return the segment without its transient, where that stands out of the noise."""
    if not transient.significant:
        return segment
    channels = segment.channels.copy()
    part = transient.lasting(segment.theta)
    channels[settings.transient_channel, part] -= transient.waveform(segment.part(part))
    return replace(segment, channels=channels)


def _phasors(
    segment: Segment,
    transient: Transient,
    cycles: int,
    settings: Settings,
    steps: FloatArray,
    samples: Samples,
    *,
    sweep: bool,
) -> _Phasors:
    """Fit a segment without its transient, which is not noise, and join the phasors' noise."""
    fit = sine_fit(_without(transient, segment, settings), trend=sweep)
    orders = (1, *sorted({*settings.harmonics, *EVEN} - {1}))
    orders = tuple(k for k in orders if k <= fit.orders)
    noise = tuple(line_noise(fit, orders, cycles, fit.residual))
    added = transient.phasors(fit)
    return _Phasors(fit, cycles, settings, orders, noise, transient, added, steps, samples)


def _bias(phasors: _Phasors) -> ComplexArray:
    """Return what the transient adds to the response of each harmonic."""
    added = phasors.transient_phasors
    if phasors.settings.transient_channel == 0:
        return phasors.changed(complex(added[1]), np.zeros(len(phasors.harmonics), complex))
    return phasors.changed(0.0, np.where(phasors.harmonics, added[phasors.harmonics], 0.0))


def _lag(phasors: _Phasors) -> ComplexArray:
    """Return half of what the response of each harmonic changes in a cycle of a sweep.

    The force lags the amplitude by less than half a cycle, whatever beta is.
    """
    fit = phasors.fit
    force = np.array([fit.slopes(k)[1] for k in phasors.harmonics])
    return phasors.changed(complex(fit.slopes(1)[0]), force) / phasors.cycles


def _mean_moves(phasors: _Phasors) -> bool:
    """Return whether the mean of a free displacement is still on its way to its place.

    Where a soft spring alone centres it, it may go much farther than the amplitude, and its
    approach is not an exponential.
    """
    fit, channel = phasors.fit, phasors.settings.transient_channel
    moved = 2.0 * float(fit.coefficients[1, channel])
    if phasors.transient.significant:
        first, last = phasors.transient.waveform(fit.segment)[[0, -1]]
        moved += float(last - first)
    by_noise = 2.0 * np.sqrt(fit.inverse[1, 1] * fit.residual_variance[channel])
    least = max(
        _MOVING_MEAN * abs(phasors.phasors(1)[0]),
        _BEYOND_NOISE * float(by_noise),
        SIGNIFICANT * phasors.transient.departure_std,
    )
    return channel == 0 and abs(moved) > least


def _settling_periods(
    segment: Segment,
    transient: Transient,
    cycles: int,
    settings: Settings,
    steps: FloatArray,
    samples: Samples,
) -> int:
    """Return how many leading cycles to leave out.

    As few as bring the bias below a fifth of the standard error; where none do, those with the
    least mean squared error.
    """
    if not transient.significant or cycles <= FEWEST_CYCLES:
        return 0
    looked_at = min(cycles, MOST_CYCLES)
    only_first = replace(settings, harmonics=(1,))
    phasors = _phasors(segment, transient, looked_at, only_first, steps, samples, sweep=False)
    q = np.arange(cycles - FEWEST_CYCLES + 1)
    kept = looked_at / (cycles - q)
    bias = abs(_bias(phasors)[0]) * np.exp(-transient.rate * q) * kept
    error = np.sqrt(_fundamental(phasors)[1][0, 0] * kept)
    good = bias <= _NEGLIGIBLE * error
    return int(np.argmax(good) if good.any() else np.argmin(bias**2 + 2.0 * error**2))


def _fundamental(phasors: _Phasors) -> tuple[complex, FloatArray, FloatArray, float]:
    """Return N, its covariance, the amplitude's covariance with it, and its dof."""
    X, N = phasors.displacement, phasors.response(1)
    e_X, e_F = phasors.errors
    e_N = (e_F - N * e_X) / X
    variance = float(np.sum(np.abs(e_N) ** 2))
    with_amplitude = 0.5 * complex(e_N @ e_X.conj()) * X / abs(X)
    return (
        N,
        0.5 * variance * np.eye(2),
        np.array([with_amplitude.real, with_amplitude.imag]),
        phasors.noise[0].dof,
    )


def _harmonic(
    phasors: _Phasors, k: int, distorted: float
) -> tuple[complex, FloatArray, FloatArray, float]:
    """Return N_k, its covariance, the amplitude's covariance with it, and its dof."""
    noise = phasors.noise_of(k)
    A, N = abs(phasors.displacement), phasors.response(k)
    along = np.array([N.real, N.imag])
    across = np.array([-N.imag, N.real])
    relative = phasors.amplitude_variance / A**2
    force = float(phasors.variance(k)[1]) / A**2
    if k == 0:
        force += (phasors.forgotten(0) / A) ** 2
    force += (distorted * abs(phasors.response(1))) ** 2
    own_part = 0.5 * force * np.eye(2) if k else np.diag([force, 0.0])
    covariance = own_part + relative * (np.outer(along, along) + k**2 * np.outer(across, across))
    referred = relative * (1.0 + k**2) * abs(N) ** 2
    own = force / max(force + referred, TINY)
    dof = 1.0 / (own**2 / noise.dof + (1.0 - own) ** 2 / phasors.noise[0].dof)
    return N, covariance, -along * relative * A, dof


def _errors(phasors: _Phasors, distorted: float) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return the responses, their joint covariance with the amplitude, and dof."""
    rows = [
        _fundamental(phasors) if k == 1 else _harmonic(phasors, k, distorted)
        for k in phasors.harmonics
    ]
    response, covariance, cross, dof = (np.array(column) for column in zip(*rows, strict=True))
    joint = np.empty((len(rows), 3, 3))
    joint[:, 0, 0] = phasors.amplitude_variance
    joint[:, 0, 1:] = joint[:, 1:, 0] = cross
    joint[:, 1:, 1:] = covariance
    return response, joint, dof


def _point(phasors: _Phasors, cycles: int, dropped: int, steps: FloatArray) -> Point:
    distorted = phasors.distorted
    response, joint, dof = _errors(phasors, distorted)
    covariance = joint[:, 1:, 1:]
    silent = tuple(LineNoise(np.zeros_like(n.lines), n.dof) for n in phasors.noise)
    repeating = _errors(replace(phasors, noise=silent), distorted)[1]
    segment, recorded = phasors.fit.segment, phasors.samples.time
    transient, bias = phasors.transient, _bias(phasors)
    lagging = _lag(phasors) if phasors.fit.trending else np.zeros(len(response))
    only_mean = np.where(np.equal(phasors.harmonics, 0), 2.0, 1.0)  # whose variance is one number
    error = np.maximum(np.sqrt(0.5 * only_mean * np.trace(covariance, axis1=1, axis2=2)), TINY)
    excess = np.abs(bias) / (_TOLERATED * error)
    forgotten = (excess <= 1.0) | (not transient.significant)
    missing = np.where(forgotten, 0.0, np.ceil(np.log(np.maximum(excess, 1.0)) / transient.rate))
    if _mean_moves(phasors):
        forgotten, missing = np.zeros_like(forgotten), np.maximum(missing, cycles)
    quality = {
        "settled": forgotten & (np.abs(lagging) <= _TOLERATED * error),
        "bias_real": (bias + lagging).real,
        "bias_imag": (bias + lagging).imag,
        "more_periods": missing.astype(np.int64),
        "num_periods": cycles,
        "settling_periods": dropped,
        "covariance_from": "cycles" if phasors.cycles >= CYCLES_FOR_SCATTER else "spectrum",
        "start_time": recorded[0],
        "end_time": recorded[-1],
        **_channel_quality(phasors, steps),
    }
    settled = dict(zip(phasors.harmonics, quality["settled"], strict=True))
    first_settled = bool(settled.get(1, all(settled.values())))
    biased = np.abs(bias + lagging) / np.abs(response).max()
    quality["verdict"] = _verdicts(quality, biased, _objections(phasors, first_settled))
    return Point(
        frequency_hz=segment.omega / (2.0 * np.pi),
        amplitude=abs(phasors.displacement),
        drive=float(abs(phasors.phasors(1)[1])),
        harmonic=phasors.harmonics,
        response=response,
        joint=joint,
        repeating=repeating,
        dof=dof,
        sweep=bool(phasors.fit.trending),
        quality=quality,
    )


def _channel_quality(phasors: _Phasors, steps: FloatArray) -> dict[str, Any]:
    """Return the columns that judge the two waveforms."""
    fit = phasors.fit
    shares = fundamental_share(fit, fit.segment, phasors.samples.within_blocks(fit.segment))
    amplitudes, block = np.abs(fit.phasors(1)), fit.segment.block
    noise = np.sqrt(np.diagonal(phasors.noise[0].matrix).real * block)
    crest = crest_samples(amplitudes[0], steps[0], fit.segment.sample_phase / block)
    motion, force = phasors.samples.motion, phasors.samples.force
    with np.errstate(divide="ignore"):
        in_steps = amplitudes / steps
    return {
        "displacement_share": shares[0],
        "force_share": shares[1],
        "displacement_distortion": distortion(fit, 0, phasors.settings.integrations),
        "force_distortion": distortion(fit, 1),
        "asymmetry": _asymmetry(phasors),
        "displacement_steps": in_steps[0],
        "force_steps": in_steps[1],
        "displacement_clipped": clipped_share(motion, steps[0], noise[0], crest),
        "force_clipped": clipped_share(force, steps[1], noise[1], np.inf),
    }


def _asymmetry(phasors: _Phasors) -> float:
    """Return the force's even harmonics over its fundamental where they are significant.

    The transient has even harmonics of its own: what its error leaves of them is noise.
    """
    fit = phasors.fit
    if fit.trending or phasors.settings.controlled == "force":
        return 0.0
    even = [k for k in EVEN if k <= fit.orders]
    motion, force = np.array([fit.phasors(k) for k in [1, *even]]).T
    variance = [float(phasors.variance(k)[1]) + phasors.forgotten(k) ** 2 for k in even]
    orders = np.array(even, dtype=np.float64)
    return asymmetry(
        orders,
        force[1:] / force[0],
        np.array(variance) / abs(force[0]) ** 2,
        np.array([phasors.noise_of(k).dof for k in even]),
        np.abs(motion[1:] / motion[0]) / orders**phasors.settings.integrations,
    )


def _objections(phasors: _Phasors, settled: bool) -> list[str]:
    """Return what speaks against the fundamental itself."""
    objections = []
    N, covariance, _, dof = _fundamental(phasors)
    std = np.hypot(np.sqrt(covariance[1, 1]), _ROUNDING * abs(N))
    if settled and creates_energy(np.asarray(N.imag), std, np.asarray(dof)):
        objections.append("creates energy: a sign is reversed")
    fit = phasors.fit
    aliased = alias_error(fit, 1, phasors.cycles) > _ALIASED * np.abs(fit.phasors(1))
    if aliased.any() or aliases_unseen(fit, phasors.cycles):
        samples = 2.0 * np.pi / fit.segment.sample_phase * fit.segment.block
        objections.append(f"harmonics alias at {samples:.3g} samples a cycle")
    return objections


def _verdicts(quality: dict[str, Any], biased: FloatArray, objections: list[str]) -> list[str]:
    """Return, for each row, "good" or what speaks against it.

    `biased` is the bias of each row, as a share of the largest response.
    """
    shared = objections.copy()
    if quality["displacement_distortion"] > _DISTORTED:
        shared.append(f"displacement distorted {100 * quality['displacement_distortion']:.2g} %")
    for name in ("displacement", "force"):
        if quality[f"{name}_steps"] < _FEW_STEPS:
            shared.append(f"{name} only {quality[f'{name}_steps']:.2g} sensor steps")
        if quality[f"{name}_clipped"]:
            shared.append(f"{name} clipped in {100 * quality[f'{name}_clipped']:.2g} % of samples")
    return [
        "; ".join(([] if settled else [_unsettled(int(more), share)]) + shared) or "good"
        for settled, more, share in zip(
            quality["settled"], quality["more_periods"], biased.tolist(), strict=True
        )
    ]


def _unsettled(more: int, share: float) -> str:
    if more:
        return f"not settled, {more} more periods"
    return f"{TOO_FAST} to settle, biased by about {100.0 * share:.2g} %"

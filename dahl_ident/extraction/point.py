r"""One measured point: dynamic stiffness at one amplitude and frequency, with its errors.

With the phasors X of displacement and F of force and their errors e_X, e_F,

    X_1 = A exp(j phi)                dA + j A dphi = e_X exp(-j phi)
    N   = F_1/X_1                     dN  = (e_F - N e_X)/X_1
    N_k = F_k exp(-j k phi)/A         dN_k = e_Fk exp(-j k phi)/A - N_k (dA/A + j k dphi)

so the response shares the displacement's error with the amplitude. A velocity or an acceleration
is integrated at the fitted frequency: its phasor at harmonic k is divided by ``j k omega`` once
or twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.memory import Memory, estimate_memory
from dahl_ident.extraction.noise import CYCLES_FOR_SCATTER, LineNoise, line_noise
from dahl_ident.extraction.quality import (
    clipped_share,
    crest_samples,
    distortion,
    fundamental_share,
    sensor_step,
)
from dahl_ident.extraction.sine_fit import (
    SineFit,
    Stretch,
    last_cycles,
    remainder,
    sine_fit,
    whole_cycles,
)

FEWEST_CYCLES = 2
_NEGLIGIBLE = 0.2  # bias over standard error to which settling cycles are left out
_TOLERATED = 1.0  # bias over standard error above which a point has not settled
_DISTORTED = 0.02  # from which the fundamental alone misses percents of the loss
_FEW_STEPS = 10.0  # amplitude over sensor step below which the step matters


@dataclass(frozen=True)
class Settings:
    """How stretches are turned into points; see :func:`dahl_ident.extraction.extract`."""

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
    def memory_channel(self) -> int:
        """Where friction's memory shows: in the force, or in a displacement that is free."""
        free = self.controlled == "force" and self.motion_channel == "displacement"
        return 0 if free else 1


@dataclass(frozen=True)
class Point:
    """One amplitude and frequency: responses of the fundamental and the harmonics."""

    frequency_hz: float
    amplitude: float
    amplitude_std: float
    drive: float
    harmonic: list[int]
    response: ComplexArray
    covariance: FloatArray
    dof: FloatArray
    amplitude_covariance: FloatArray
    quality: dict[str, Any]


@dataclass(frozen=True)
class _Phasors:
    """Displacement and force of one stretch, noise included."""

    fit: SineFit
    harmonics: tuple[int, ...]
    integrator: complex
    noise: tuple[LineNoise, ...]

    @property
    def displacement(self) -> complex:
        return complex(self.fit.phasors(1)[0] * self.integrator)

    @property
    def errors(self) -> ComplexArray:
        """E[e e^H] of the fundamental phasors of displacement and force."""
        scale = np.array([self.integrator, 1.0])
        matrix = self.noise[0].matrix * self.fit.phasor_variance(1)
        return np.asarray(scale[:, None] * matrix * scale.conj())

    def referred(self, force: complex, harmonic: int) -> complex:
        """Return a force phasor over the displacement's amplitude, turned by k times its phase."""
        X = self.displacement
        return complex(force * (abs(X) / X) ** harmonic / abs(X))

    def response(self, harmonic: int) -> complex:
        return self.referred(complex(self.fit.phasors(harmonic)[1]), harmonic)


def measure(stretch: Stretch, settings: Settings, *, sweep: bool = False) -> Point:
    """Turn a stretch of known phase into a point.

    In a sweep amplitude and response may change linearly, and no cycles are left out.

    Raises
    ------
    ExtractionError
        If it is shorter than two cycles, or motion or force is not dominated by one sine.
    """
    found = whole_cycles(stretch)
    if found < FEWEST_CYCLES:
        raise ExtractionError(
            f"{found} whole cycles of {stretch.omega / (2.0 * np.pi):.6g} Hz around t = "
            f"{stretch.centre:.6g} s; expected at least {FEWEST_CYCLES}: record longer, or check "
            "frequency="
        )
    cycles = min(found, settings.num_periods or found)
    if not sweep and cycles - (settings.settling_periods or 0) < FEWEST_CYCLES:
        raise ExtractionError(
            f"{cycles} cycles of {stretch.omega / (2.0 * np.pi):.6g} Hz around t = "
            f"{stretch.centre:.6g} s, {settings.settling_periods} of them for settling; expected "
            f"{FEWEST_CYCLES} more than for settling: record longer, or lower settling_periods="
        )
    whole = last_cycles(stretch, cycles)
    fit = sine_fit(whole, trend=sweep)
    steps = np.array([sensor_step(channel) for channel in whole.channels])
    _check_sine(fit, steps, settings)
    before = _phasors(fit, None, cycles, settings)
    memory = estimate_memory(
        fit, settings.memory_channel, np.angle(before.displacement), before.response(1)
    )
    if memory.significant:
        before = _phasors(fit, memory, cycles, settings)
    if sweep:
        dropped = 0
    elif settings.settling_periods is not None:
        dropped = settings.settling_periods
    else:
        dropped = _settling_periods(before, memory, cycles, settings)
    after = before
    if dropped:
        fit = sine_fit(last_cycles(whole, cycles - dropped))
        after = _phasors(fit, memory, cycles - dropped, settings)
    return _point(after, memory, cycles, dropped, steps, settings)


def _check_sine(fit: SineFit, steps: FloatArray, settings: Settings) -> None:
    """Refuse what moves less than its sensor resolves, or is not one sine."""
    where = f"around t = {fit.stretch.centre:.6g} s, {fit.stretch.omega / (2.0 * np.pi):.6g} Hz"
    amplitudes = np.abs(fit.phasors(1))
    shares = fundamental_share(fit)
    names = (settings.motion_channel, "force")
    for name, amplitude, step, share in zip(names, amplitudes, steps, shares, strict=True):
        if amplitude <= step or amplitude == 0.0:
            raise ExtractionError(
                f"{name} {where}: amplitude {amplitude:.4g} is {amplitude / (step or 1.0):.3g} "
                f"sensor steps (of {step:.4g}); expected more than one step: use a larger "
                "amplitude or a finer range"
            )
        if share < settings.min_share:
            raise ExtractionError(
                f"{name} {where}: the fundamental has {100.0 * share:.3g} % of the power; "
                f"expected at least {100.0 * settings.min_share:.3g} %, one dominant sine: "
                "check the channel and frequency=, or lower min_share= if it is noise"
            )


def _phasors(fit: SineFit, memory: Memory | None, cycles: int, settings: Settings) -> _Phasors:
    """Join a fit with the noise of its phasors, which the memory is not part of."""
    residual = fit.residual
    if memory is not None:
        residual = residual.copy()
        residual[settings.memory_channel] -= remainder(fit, memory.waveform(fit.stretch))
    harmonics = tuple(k for k in settings.harmonics if k <= fit.orders)
    noise = line_noise(fit, (1, *harmonics), cycles, residual)
    integrator = (1j * fit.stretch.omega) ** -settings.integrations
    return _Phasors(fit, harmonics, integrator, tuple(noise))


def _bias(phasors: _Phasors, memory: Memory, settings: Settings) -> ComplexArray:
    """Return what the memory adds to the response of each harmonic."""
    added = memory.phasors(phasors.fit.stretch)
    if settings.memory_channel == 1:
        return np.array([phasors.referred(added[k], k) for k in phasors.harmonics])
    relative = added[1] / phasors.displacement
    responses = np.array([phasors.response(k) for k in phasors.harmonics])
    k = np.array(phasors.harmonics)
    return np.asarray(-responses * (relative.real + 1j * k * relative.imag))


def _settling_periods(phasors: _Phasors, memory: Memory, cycles: int, settings: Settings) -> int:
    """Return how many leading cycles to leave out.

    As few as bring the bias below a fifth of the standard error; where none do, those with the
    least mean squared error.
    """
    if not memory.significant or cycles <= FEWEST_CYCLES:
        return 0
    q = np.arange(cycles - FEWEST_CYCLES + 1)
    kept = cycles / (cycles - q)
    response, covariance, _, _ = _fundamental(phasors)
    added = complex(memory.phasors(phasors.fit.stretch)[1])
    if settings.memory_channel == 0:
        added *= -response
    bias = abs(added / phasors.displacement) * np.exp(-memory.rate * q) * kept
    error = np.sqrt(covariance[0, 0] * kept)
    good = bias <= _NEGLIGIBLE * error
    return int(np.argmax(good) if good.any() else np.argmin(bias**2 + 2.0 * error**2))


def _fundamental(phasors: _Phasors) -> tuple[complex, FloatArray, FloatArray, float]:
    """Return N, its covariance, the amplitude's covariance with it, and its dof."""
    X, N = phasors.displacement, phasors.response(1)
    gradient = np.array([-N / X, 1.0 / X])
    shared = gradient @ phasors.errors
    variance = float((shared @ gradient.conj()).real)
    with_amplitude = 0.5 * shared[0] * X / abs(X)
    return (
        N,
        0.5 * variance * np.eye(2),
        np.array([with_amplitude.real, with_amplitude.imag]),
        phasors.noise[0].dof,
    )


def _harmonic(phasors: _Phasors, k: int) -> tuple[complex, FloatArray, FloatArray, float]:
    """Return N_k, its covariance, the amplitude's covariance with it, and its dof."""
    noise = phasors.noise[1 + phasors.harmonics.index(k)]
    A, N = abs(phasors.displacement), phasors.response(k)
    along = np.array([N.real, N.imag])
    across = np.array([-N.imag, N.real])
    relative = float(phasors.errors[0, 0].real) / (2.0 * A**2)
    force = float(noise.matrix[1, 1].real) * phasors.fit.phasor_variance(k) / A**2
    covariance = 0.5 * force * np.eye(2) + relative * (
        np.outer(along, along) + k**2 * np.outer(across, across)
    )
    referred = relative * (1.0 + k**2) * abs(N) ** 2
    dof = (force + referred) ** 2 / (force**2 / noise.dof + referred**2 / phasors.noise[0].dof)
    return N, covariance, -along * relative * A, dof


def _point(
    phasors: _Phasors,
    memory: Memory,
    cycles: int,
    dropped: int,
    steps: FloatArray,
    settings: Settings,
) -> Point:
    rows = [_fundamental(phasors) if k == 1 else _harmonic(phasors, k) for k in phasors.harmonics]
    response, covariance, amplitude_covariance, dof = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    stretch = phasors.fit.stretch
    bias = _bias(phasors, memory, settings)
    error = np.sqrt(0.5 * np.trace(covariance, axis1=1, axis2=2))
    excess = np.abs(bias) / (_TOLERATED * error)
    settled = (excess <= 1.0) | (not memory.significant)
    missing = np.where(settled, 0.0, np.ceil(np.log(np.maximum(excess, 1.0)) / memory.rate))
    quality = {
        "settled": settled,
        "bias_real": bias.real,
        "bias_imag": bias.imag,
        "more_periods": missing.astype(np.int64),
        "num_periods": cycles,
        "settling_periods": dropped,
        "covariance_from": "cycles" if cycles - dropped >= CYCLES_FOR_SCATTER else "spectrum",
        "start_time": stretch.time[0],
        "end_time": stretch.time[-1],
        **_channel_quality(phasors, steps, settings),
    }
    quality["verdict"] = _verdicts(quality)
    return Point(
        frequency_hz=stretch.omega / (2.0 * np.pi),
        amplitude=abs(phasors.displacement),
        amplitude_std=float(np.sqrt(0.5 * phasors.errors[0, 0].real)),
        drive=float(abs(phasors.fit.phasors(1)[1])),
        harmonic=list(phasors.harmonics),
        response=response,
        covariance=covariance,
        dof=dof,
        amplitude_covariance=amplitude_covariance,
        quality=quality,
    )


def _channel_quality(phasors: _Phasors, steps: FloatArray, settings: Settings) -> dict[str, Any]:
    """Return the columns that judge the two waveforms."""
    fit = phasors.fit
    shares = fundamental_share(fit)
    amplitudes = np.abs(fit.phasors(1))
    noise = np.sqrt(np.diagonal(phasors.noise[0].matrix).real)
    crest = crest_samples(amplitudes[0], steps[0], fit.stretch.sample_phase)
    motion, force = fit.stretch.channels
    with np.errstate(divide="ignore"):
        in_steps = amplitudes / steps
    return {
        "displacement_share": shares[0],
        "force_share": shares[1],
        "displacement_distortion": distortion(fit, settings.integrations),
        "displacement_steps": in_steps[0],
        "force_steps": in_steps[1],
        "displacement_clipped": clipped_share(motion, steps[0], noise[0], crest),
        "force_clipped": clipped_share(force, steps[1], noise[1], np.inf),
    }


def _verdicts(quality: dict[str, Any]) -> list[str]:
    """Return, for each row, "good" or what speaks against it."""
    shared = []
    if quality["displacement_distortion"] > _DISTORTED:
        shared.append(f"displacement distorted {100 * quality['displacement_distortion']:.2g} %")
    for name in ("displacement", "force"):
        if quality[f"{name}_steps"] < _FEW_STEPS:
            shared.append(f"{name} only {quality[f'{name}_steps']:.2g} sensor steps")
        if quality[f"{name}_clipped"]:
            shared.append(f"{name} clipped in {100 * quality[f'{name}_clipped']:.2g} % of samples")
    return [
        "; ".join(([] if settled else [f"not settled, {more} more periods"]) + shared) or "good"
        for settled, more in zip(quality["settled"], quality["more_periods"], strict=True)
    ]

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

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.suspicion import creates_energy
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.folding import folded_error, folds_unseen
from dahl_ident.extraction.memory import (
    MOST_CYCLES,
    SIGNIFICANT,
    Memory,
    estimate_memory,
)
from dahl_ident.extraction.noise import CYCLES_FOR_SCATTER, LineNoise, line_noise
from dahl_ident.extraction.quality import (
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
    SineFit,
    Stretch,
    first_cycles,
    last_cycles,
    sine_fit,
    thinned,
    whole_cycles,
)

_NEGLIGIBLE = 0.2  # bias over standard error to which settling cycles are left out
_TOLERATED = 1.0  # bias over standard error above which a point has not settled
_DISTORTED = 0.02  # from which the fundamental alone misses percents of the loss
_MOVING_MEAN = 0.02  # of the amplitude, over the stretch, where the force is controlled
_BEYOND_NOISE = 5.0  # standard errors of a drift in white noise
_TINY = np.finfo(np.float64).tiny
_ROUNDING = 1e-9  # of the response
_FOLDED = 0.01  # of the fundamental, above which folded harmonics are told
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
    """Displacement and force of one stretch with their noise.

    `fit` is without the memory where that is significant; `remembered` is what the memory adds
    to the phasors of its channel, and belongs to the response.
    """

    fit: SineFit
    cycles: int
    settings: Settings
    noise: tuple[LineNoise, ...]
    memory: Memory
    remembered: ComplexArray
    steps: FloatArray
    """Of the two sensors, 0 where they have none."""

    @property
    def harmonics(self) -> list[int]:
        return [k for k in self.settings.harmonics if k <= self.fit.orders]

    @cached_property
    def integrator(self) -> complex:
        """Displacement over the motion channel at the fundamental."""
        return complex((1j * self.fit.stretch.omega) ** -self.settings.integrations)

    def phasors(self, harmonic: int) -> ComplexArray:
        """Return the phasors of the motion channel and the force, shape (2,)."""
        both = self.fit.phasors(harmonic)
        if self.memory.significant:
            both[self.settings.memory_channel] += self.remembered[harmonic]
        return both

    @cached_property
    def displacement(self) -> complex:
        return complex(self.phasors(1)[0] * self.integrator)

    @cached_property
    def rounding(self) -> FloatArray:
        """Root mean square error of a phasor of the motion channel and the force by rounding."""
        return quantisation_errors(
            np.abs(self.fit.phasors(1)),
            self.steps,
            np.sqrt(np.mean(self.fit.residual**2, axis=1)),
            self.fit.stretch.time.size / self.cycles,
        )

    def repeating_errors(self, harmonic: int) -> FloatArray:
        """Return the errors of the phasors of both channels that are alike in every cycle."""
        return np.hypot(self.rounding, folded_error(self.fit, harmonic, self.cycles))

    @cached_property
    def errors(self) -> ComplexArray:
        """Errors of the fundamental phasors of displacement and force; their products sum up."""
        scale = np.array([[self.integrator], [1.0]])
        noise = self.noise[0].lines * np.sqrt(self.fit.phasor_variance(1))
        return np.asarray(scale * np.hstack([noise, np.diag(self.repeating_errors(1))]))

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
            f"{found} whole cycles {_where(stretch)}; expected at least {FEWEST_CYCLES}: record "
            "longer, or check frequency="
        )
    cycles = min(found, settings.num_periods or found)
    if not sweep and cycles - (settings.settling_periods or 0) < FEWEST_CYCLES:
        raise ExtractionError(
            f"{cycles} cycles {_where(stretch)}, {settings.settling_periods} of them for "
            f"settling; expected {FEWEST_CYCLES} more than for settling: record longer, or lower "
            "settling_periods="
        )
    whole = last_cycles(stretch, cycles)
    steps = np.array([sensor_step(channel) for channel in whole.channels])
    first = first_cycles(whole, MOST_CYCLES)
    rough = sine_fit(thinned(first), trend=sweep, most=HARMONICS)
    _check_motion(rough, steps, settings)
    memory = _memory(rough, settings)
    _check_share(rough, _without(memory, first, settings), settings)
    if sweep:
        dropped = 0
    elif settings.settling_periods is not None:
        dropped = settings.settling_periods
    else:
        dropped = _settling_periods(rough.stretch, memory, cycles, settings, steps)
    used = last_cycles(whole, cycles - dropped)
    phasors = _phasors(used, memory, cycles - dropped, settings, steps, sweep=sweep)
    _check_share(phasors.fit, phasors.fit.stretch, settings)
    return _point(phasors, cycles, dropped, steps)


def _check_motion(fit: SineFit, steps: FloatArray, settings: Settings) -> None:
    """Refuse what moves less than its sensor resolves."""
    amplitudes = np.abs(fit.phasors(1))
    for name, amplitude, step in zip(_names(settings), amplitudes, steps, strict=True):
        if amplitude <= step or amplitude == 0.0:
            raise ExtractionError(
                f"{name} {_where(fit.stretch)}: amplitude {amplitude:.4g} is "
                f"{amplitude / (step or 1.0):.3g} sensor steps (of {step:.4g}); expected more "
                "than one step: use a larger amplitude or a finer range"
            )


def _check_share(fit: SineFit, stretch: Stretch, settings: Settings) -> None:
    """Refuse what is not one sine."""
    shares = fundamental_share(fit, stretch)
    for name, share in zip(_names(settings), shares, strict=True):
        if share < settings.min_share:
            raise ExtractionError(
                f"{name} {_where(stretch)}: the fundamental has {100.0 * share:.3g} % of the "
                f"power; expected at least {100.0 * settings.min_share:.3g} %, one dominant sine: "
                "check the channel and frequency=, or lower min_share= if it is noise"
            )


def _names(settings: Settings) -> tuple[str, str]:
    return settings.motion_channel, "force"


def _where(stretch: Stretch) -> str:
    return f"around t = {stretch.centre:.6g} s, {stretch.omega / (2.0 * np.pi):.6g} Hz"


def _memory(fit: SineFit, settings: Settings) -> Memory:
    X = complex(fit.phasors(1)[0] * (1j * fit.stretch.omega) ** -settings.integrations)
    response = complex(fit.phasors(1)[1]) / X
    return estimate_memory(fit, settings.memory_channel, float(np.angle(X)), response)


def _without(memory: Memory, stretch: Stretch, settings: Settings) -> Stretch:
    """Return the stretch without its memory, where that stands out of the noise."""
    if not memory.significant:
        return stretch
    channels = stretch.channels.copy()
    channels[settings.memory_channel] -= memory.waveform(stretch)
    return replace(stretch, channels=channels)


def _phasors(
    stretch: Stretch,
    memory: Memory,
    cycles: int,
    settings: Settings,
    steps: FloatArray,
    *,
    sweep: bool,
) -> _Phasors:
    """Fit a stretch without its memory, which is no noise, and join the phasors' noise."""
    fit = sine_fit(_without(memory, stretch, settings), trend=sweep)
    harmonics = [k for k in settings.harmonics if k <= fit.orders]
    noise = line_noise(fit, [1, *harmonics], cycles, fit.residual)
    return _Phasors(fit, cycles, settings, tuple(noise), memory, memory.phasors(fit), steps)


def _bias(phasors: _Phasors) -> ComplexArray:
    """Return what the memory adds to the response of each harmonic."""
    added = phasors.remembered
    if phasors.settings.memory_channel == 0:
        return phasors.changed(complex(added[1]), np.zeros(len(phasors.harmonics), complex))
    return phasors.changed(0.0, added[phasors.harmonics])


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
    approach is no exponential.
    """
    fit, channel = phasors.fit, phasors.settings.memory_channel
    moved = 2.0 * float(fit.coefficients[1, channel])
    if phasors.memory.significant:
        first, last = phasors.memory.waveform(fit.stretch)[[0, -1]]
        moved += float(last - first)
    by_noise = 2.0 * np.sqrt(fit.inverse[1, 1] * np.mean(fit.residual[channel] ** 2))
    least = max(
        _MOVING_MEAN * abs(phasors.phasors(1)[0]),
        _BEYOND_NOISE * float(by_noise),
        SIGNIFICANT * phasors.memory.departure_std,
    )
    return channel == 0 and abs(moved) > least


def _settling_periods(
    stretch: Stretch, memory: Memory, cycles: int, settings: Settings, steps: FloatArray
) -> int:
    """Return how many leading cycles to leave out.

    As few as bring the bias below a fifth of the standard error; where none do, those with the
    least mean squared error.
    """
    if not memory.significant or cycles <= FEWEST_CYCLES:
        return 0
    looked_at = min(cycles, MOST_CYCLES)
    only_first = replace(settings, harmonics=(1,))
    phasors = _phasors(stretch, memory, looked_at, only_first, steps, sweep=False)
    q = np.arange(cycles - FEWEST_CYCLES + 1)
    kept = looked_at / (cycles - q)
    bias = abs(_bias(phasors)[0]) * np.exp(-memory.rate * q) * kept
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


def _harmonic(phasors: _Phasors, k: int) -> tuple[complex, FloatArray, FloatArray, float]:
    """Return N_k, its covariance, the amplitude's covariance with it, and its dof."""
    noise = phasors.noise[1 + phasors.harmonics.index(k)]
    A, N = abs(phasors.displacement), phasors.response(k)
    along = np.array([N.real, N.imag])
    across = np.array([-N.imag, N.real])
    relative = phasors.amplitude_variance / A**2
    force = float(noise.matrix[1, 1].real) * phasors.fit.phasor_variance(k)
    force = (force + float(phasors.repeating_errors(k)[1]) ** 2) / A**2
    covariance = 0.5 * force * np.eye(2) + relative * (
        np.outer(along, along) + k**2 * np.outer(across, across)
    )
    referred = relative * (1.0 + k**2) * abs(N) ** 2
    own = force / max(force + referred, _TINY)
    dof = 1.0 / (own**2 / noise.dof + (1.0 - own) ** 2 / phasors.noise[0].dof)
    return N, covariance, -along * relative * A, dof


def _point(phasors: _Phasors, cycles: int, dropped: int, steps: FloatArray) -> Point:
    rows = [_fundamental(phasors) if k == 1 else _harmonic(phasors, k) for k in phasors.harmonics]
    response, covariance, amplitude_covariance, dof = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    stretch = phasors.fit.stretch
    memory, bias = phasors.memory, _bias(phasors)
    lagging = _lag(phasors) if phasors.fit.trending else np.zeros(len(rows))
    error = np.maximum(np.sqrt(0.5 * np.trace(covariance, axis1=1, axis2=2)), _TINY)
    excess = np.abs(bias) / (_TOLERATED * error)
    forgotten = (excess <= 1.0) | (not memory.significant)
    missing = np.where(forgotten, 0.0, np.ceil(np.log(np.maximum(excess, 1.0)) / memory.rate))
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
        "start_time": stretch.time[0],
        "end_time": stretch.time[-1],
        **_channel_quality(phasors, steps),
    }
    quality["verdict"] = _verdicts(quality, _doubts(phasors, all(quality["settled"])))
    return Point(
        frequency_hz=stretch.omega / (2.0 * np.pi),
        amplitude=abs(phasors.displacement),
        amplitude_std=float(np.sqrt(phasors.amplitude_variance)),
        drive=float(abs(phasors.phasors(1)[1])),
        harmonic=phasors.harmonics,
        response=response,
        covariance=covariance,
        dof=dof,
        amplitude_covariance=amplitude_covariance,
        quality=quality,
    )


def _channel_quality(phasors: _Phasors, steps: FloatArray) -> dict[str, Any]:
    """Return the columns that judge the two waveforms."""
    fit = phasors.fit
    shares = fundamental_share(fit, fit.stretch)
    amplitudes = np.abs(fit.phasors(1))
    noise = np.sqrt(np.diagonal(phasors.noise[0].matrix).real)
    crest = crest_samples(amplitudes[0], steps[0], fit.stretch.sample_phase)
    motion, force = fit.stretch.channels
    with np.errstate(divide="ignore"):
        in_steps = amplitudes / steps
    return {
        "displacement_share": shares[0],
        "force_share": shares[1],
        "displacement_distortion": distortion(fit, phasors.settings.integrations),
        "displacement_steps": in_steps[0],
        "force_steps": in_steps[1],
        "displacement_clipped": clipped_share(motion, steps[0], noise[0], crest),
        "force_clipped": clipped_share(force, steps[1], noise[1], np.inf),
    }


def _doubts(phasors: _Phasors, settled: bool) -> list[str]:
    """Return what speaks against the fundamental itself."""
    doubts = []
    N, covariance, _, dof = _fundamental(phasors)
    std = np.hypot(np.sqrt(covariance[1, 1]), _ROUNDING * abs(N))
    if settled and creates_energy(np.asarray(N.imag), std, np.asarray(dof)):
        doubts.append("creates energy, a sign is turned")
    fit = phasors.fit
    folded = folded_error(fit, 1, phasors.cycles) > _FOLDED * np.abs(fit.phasors(1))
    if folded.any() or folds_unseen(fit, phasors.cycles):
        samples = 2.0 * np.pi / fit.stretch.sample_phase
        doubts.append(f"harmonics fold at {samples:.3g} samples a cycle")
    return doubts


def _verdicts(quality: dict[str, Any], doubts: list[str]) -> list[str]:
    """Return, for each row, "good" or what speaks against it."""
    shared = doubts.copy()
    if quality["displacement_distortion"] > _DISTORTED:
        shared.append(f"displacement distorted {100 * quality['displacement_distortion']:.2g} %")
    for name in ("displacement", "force"):
        if quality[f"{name}_steps"] < _FEW_STEPS:
            shared.append(f"{name} only {quality[f'{name}_steps']:.2g} sensor steps")
        if quality[f"{name}_clipped"]:
            shared.append(f"{name} clipped in {100 * quality[f'{name}_clipped']:.2g} % of samples")
    return [
        "; ".join(([] if settled else [_unsettled(int(more))]) + shared) or "good"
        for settled, more in zip(quality["settled"], quality["more_periods"], strict=True)
    ]


def _unsettled(more: int) -> str:
    return f"not settled, {more} more periods" if more else "swept too fast to settle"

"""One measured point: the responses of a segment, what was left out, and what speaks against it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dahl_ident.arrays import TINY, ComplexArray, FloatArray
from dahl_ident.errors import ExtractionError, argument
from dahl_ident.extraction.line_noise import CYCLES_FOR_SCATTER, LineNoise
from dahl_ident.extraction.phasors import Phasors, Settings, without
from dahl_ident.extraction.segment_quality import fundamental_share, sensor_step
from dahl_ident.extraction.sine_fit import (
    FEWEST_CYCLES,
    HARMONICS,
    Samples,
    Segment,
    SineFit,
    first_cycles,
    last_cycles,
    sine_fit,
    thinned,
    whole_cycles,
)
from dahl_ident.extraction.transient import MOST_CYCLES, Transient, estimate_transient
from dahl_ident.units import percent

_NEGLIGIBLE = 0.2  # bias over standard error to which settling cycles are left out
_TOLERATED = 1.0  # bias over standard error above which a point has not settled


@dataclass(frozen=True)
class Point:
    """One amplitude and frequency: responses of the fundamental and the harmonics.

    `joint` is the covariance of what was held with each response, (rows, 3, 3); `repeating` is the
    part of it that is alike in every cycle.
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


def measure(
    segment: Segment, settings: Settings, samples: Samples, *, sweep: bool = False
) -> Point:
    """Turn a segment of known phase, and the record's samples, into a point."""
    if settings.of_displacement and settings.integrations and 0 in settings.harmonics:
        raise ExtractionError(
            f"the mean of a displacement is not known from its {settings.motion_channel}; leave 0 "
            f"out of {argument('harmonics')}"
        )
    available = whole_cycles(segment)
    if available < FEWEST_CYCLES:
        raise ExtractionError(
            f"{available} whole cycles {_where(segment)}; expected at least {FEWEST_CYCLES}: "
            f"record longer, or check {argument('frequency')}"
        )
    cycles = min(available, settings.num_periods or available)
    if not sweep and cycles - (settings.settling_periods or 0) < FEWEST_CYCLES:
        raise ExtractionError(
            f"{cycles} cycles {_where(segment)}, {settings.settling_periods} of them for "
            f"settling; expected {FEWEST_CYCLES} more than for settling: record longer, or lower "
            f"{argument('settling_periods')}"
        )
    whole = last_cycles(segment, cycles)
    recorded_samples = samples.of(whole)
    steps = np.array(
        [sensor_step(channel) for channel in (recorded_samples.motion, recorded_samples.force)]
    )
    first = first_cycles(whole, MOST_CYCLES)
    rough = sine_fit(thinned(first), trend=sweep, most=HARMONICS)
    amplitudes = np.abs(rough.phasors(1))
    names = (settings.motion_channel, "force")
    for name, amplitude, step in zip(names, amplitudes, steps, strict=True):
        if amplitude <= step or amplitude == 0.0:
            raise ExtractionError(
                f"{name} {_where(rough.segment)}: amplitude {amplitude:.4g} is "
                f"{amplitude / (step or 1.0):.3g} sensor steps (of {step:.4g}); expected more "
                "than one step: use a larger amplitude or a finer range"
            )
    X = complex(rough.phasors(1)[0] * (1j * rough.segment.omega) ** -settings.integrations)
    response = complex(rough.phasors(1)[1]) / X
    channel = settings.transient_channel
    transient = estimate_transient(rough, channel, float(np.angle(X)), response)
    steady = without(transient, first, settings)
    _check_share(rough, steady, settings, samples.within_blocks(first))
    if sweep:
        dropped = 0
    elif settings.settling_periods is not None:
        dropped = settings.settling_periods
    else:
        dropped = _settling_periods(
            rough.segment, transient, cycles, settings, steps, recorded_samples
        )
    used = last_cycles(whole, cycles - dropped)
    phasors = Phasors.of(
        used, transient, cycles - dropped, settings, steps, samples.of(used), sweep=sweep
    )
    _check_share(phasors.fit, phasors.fit.segment, settings, samples.within_blocks(used))
    return _point(phasors, cycles, dropped)


def _where(segment: Segment) -> str:
    return f"around t = {segment.centre:.6g} s, {segment.omega / (2.0 * np.pi):.6g} Hz"


def _check_share(fit: SineFit, segment: Segment, settings: Settings, within: FloatArray) -> None:
    """Refuse what is not one sine."""
    shares = fundamental_share(fit, segment, within)
    for name, share in zip((settings.motion_channel, "force"), shares, strict=True):
        if share < settings.min_share:
            raise ExtractionError(
                f"{name} {_where(segment)}: the fundamental has {percent(share, 3)} of the "
                f"power; expected at least {percent(settings.min_share, 3)}, one dominant sine: "
                f"check the channel and {argument('frequency')}, or lower "
                f"{argument('min_share')} if it is noise"
            )


def _settling_periods(
    segment: Segment,
    transient: Transient,
    cycles: int,
    settings: Settings,
    steps: FloatArray,
    samples: Samples,
) -> int:
    """Return how many leading cycles to leave out."""
    if not transient.significant or cycles <= FEWEST_CYCLES:
        return 0
    looked_at = min(cycles, MOST_CYCLES)
    only_first = replace(settings, harmonics=(1,))
    phasors = Phasors.of(segment, transient, looked_at, only_first, steps, samples, sweep=False)
    q = np.arange(cycles - FEWEST_CYCLES + 1)
    kept = looked_at / (cycles - q)
    bias = abs(phasors.bias[0]) * np.exp(-transient.rate * q) * kept
    error = np.sqrt(phasors.fundamental[1][0, 0] * kept)
    good = bias <= _NEGLIGIBLE * error  # or else the least mean squared error
    return int(np.argmax(good) if good.any() else np.argmin(bias**2 + 2.0 * error**2))


def _point(phasors: Phasors, cycles: int, dropped: int) -> Point:
    """Return the rows of a segment, and what speaks for and against them."""
    distorted = phasors.distorted
    response, joint, dof = phasors.rows(distorted)
    silent = {k: LineNoise(np.zeros_like(n.lines), n.dof) for k, n in phasors.noise.items()}
    segment, recorded = phasors.fit.segment, phasors.samples.time
    transient, bias, lag = phasors.transient, phasors.bias, phasors.lag
    only_mean = np.where(np.equal(phasors.harmonics, 0), 2.0, 1.0)  # whose variance is one number
    variance = 0.5 * only_mean * np.trace(joint[:, 1:, 1:], axis1=1, axis2=2)
    error = np.maximum(np.sqrt(variance), TINY)
    excess = np.abs(bias) / (_TOLERATED * error)
    forgotten = (excess <= 1.0) | (not transient.significant)
    missing = np.where(forgotten, 0.0, np.ceil(np.log(np.maximum(excess, 1.0)) / transient.rate))
    if phasors.mean_moves:
        forgotten, missing = np.zeros_like(forgotten), np.maximum(missing, cycles)
    settled = forgotten & (np.abs(lag) <= _TOLERATED * error)
    quality = {
        "settled": settled,
        "bias_real": (bias + lag).real,
        "bias_imag": (bias + lag).imag,
        "more_periods": missing.astype(np.int64),
        "num_periods": cycles,
        "settling_periods": dropped,
        "covariance_from": "cycles" if phasors.cycles >= CYCLES_FOR_SCATTER else "spectrum",
        "start_time": recorded[0],
        "end_time": recorded[-1],
        **phasors.channel_quality(),
    }
    by_harmonic = dict(zip(phasors.harmonics, settled.tolist(), strict=True))
    shared = phasors.objections(by_harmonic.get(1, all(settled)), quality)
    shares = np.abs(bias + lag) / np.abs(response).max()
    verdicts = []
    for good, more, share in zip(settled, missing.astype(int), shares, strict=True):
        too_fast = f"swept too fast to settle, biased by about {percent(share)}"
        unsettled = f"not settled, {more} more periods" if more else too_fast
        verdicts.append("; ".join([unsettled][: not good] + shared) or "good")
    return Point(
        frequency_hz=segment.omega / (2.0 * np.pi),
        amplitude=float(abs(phasors.fundamentals[0])),
        drive=float(abs(phasors.fundamentals[1])),
        harmonic=phasors.harmonics,
        response=response,
        joint=joint,
        repeating=replace(phasors, noise=silent).rows(distorted)[1],
        dof=dof,
        sweep=bool(phasors.fit.trending),
        quality=quality | {"verdict": verdicts},
    )

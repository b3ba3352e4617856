"""From a record to a frequency response: segments, sine fits, verdicts, one table.

A record may be read in pieces, which may end within a level. Each part of the level, with n_i
cycles, then gives a point, and these are combined with weights w_i = n_i / sum n:

    N = sum w_i N_i,      C = sum w_i^2 (C_i - R_i) + sum w_i R_i

R is the part of C due to rounding and aliasing, which is the same in every cycle. The cycles of a
part that has not settled count as settling periods of the next part.

A record that is not a sine measurement is refused. In a sine test almost every cycle, weighted by
energy, is like the one before it; in random motion only a few are, by chance.
"""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import TINY, ComplexArray, FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import ExtractionError, argument, spelled
from dahl_ident.extraction.cycles import (
    AMPLITUDE_TOLERANCE,
    FREQUENCY_TOLERANCE,
    Cycles,
    find_cycles,
)
from dahl_ident.extraction.phasors import Phasors, Settings, without
from dahl_ident.extraction.segment_quality import fundamental_share, sensor_step
from dahl_ident.extraction.segments import record_spans, segment_of
from dahl_ident.extraction.sine_fit import (
    CYCLES_FOR_SCATTER,
    FEWEST_CYCLES,
    HARMONICS,
    LineNoise,
    Samples,
    Segment,
    SineFit,
    sine_fit,
)
from dahl_ident.extraction.transient import MOST_CYCLES, estimate_transient
from dahl_ident.units import counted, percent

_NEGLIGIBLE_BIAS = 0.2  # bias over standard error down to which settling cycles are left out
_TOLERATED = 1.0  # bias over standard error above which a point has not settled

_WELL_COVERED = 0.8  # fraction of the moving time; points that cover more are not due to chance
_MISSING_CYCLES = 3.0  # largest number between two parts of one level
_PERIOD_CHANGE = 0.03  # largest change of log period between cycles of a sine (median by energy)
_AMPLITUDE_CHANGE = 0.1  # the same of log amplitude, which changes faster at a resonance
_SWEEP_RANGE = 0.2  # least change of log period over a sweep; less may be due to chance
_SWEEP_CYCLES = 6  # least number in a sweep: they give four second differences of the period
_FEWEST_PAIRS = 2  # neighbouring cycles needed to judge how similar cycles are
_NOISY = 0.03  # noise of the log amplitude from which cycles cannot be compared
# Least fraction of the power near the strongest line of a sine whose cycles differ:
_SINE_IN_NOISE = 0.3  # because of noise
_ONE_LINE = 0.8  # for another reason
_LEAKAGE = 2  # lines on either side into which the strongest line leaks
_SPECTRUM_SAMPLES = 2**20  # at most, from the middle of the record


@dataclass(frozen=True)
class Point:
    """One amplitude and frequency: responses of the fundamental and the harmonics.

    `joint` is the covariance of (controlled amplitude, real part, imaginary part) of each response,
    (rows, 3, 3); `repeating` is the part of it that is the same in every cycle.
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
    """Return the point of a segment of known phase; `samples` are those of the whole record."""
    if settings.of_displacement and settings.integrations and 0 in settings.harmonics:
        raise ExtractionError(
            f"the mean of a displacement is not known from its {settings.motion_channel}; leave 0 "
            f"out of {argument('harmonics')}"
        )
    available = segment.whole_cycles
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
    whole = segment.last_cycles(cycles)
    first = whole.first_cycles(MOST_CYCLES)
    recorded = samples.of(whole)
    steps = np.array([sensor_step(channel) for channel in recorded.channels])
    rough = sine_fit(first.thinned(), trend=sweep, most=HARMONICS)
    names = (settings.motion_channel, "force")
    for name, amplitude, step in zip(names, np.abs(rough.phasors(1)), steps, strict=True):
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
    settled = rough
    if steady is not first:
        settled = sine_fit(steady.thinned(), trend=sweep, most=HARMONICS)
    _check_share(settled, steady, settings, samples.lost_variance(first))
    dropped = 0 if sweep else settings.settling_periods or 0
    find_settling = settings.settling_periods is None and not sweep
    if find_settling and transient.significant and cycles > FEWEST_CYCLES:
        n, fundamental = min(cycles, MOST_CYCLES), replace(settings, harmonics=(1,))
        phasors = Phasors.of(rough.segment, transient, n, fundamental, steps, recorded)
        dropped = _settling_periods(phasors, cycles)
    used = whole.last_cycles(cycles - dropped)
    phasors = Phasors.of(
        used, transient, cycles - dropped, settings, steps, samples.of(used), sweep=sweep
    )
    _check_share(phasors.fit, phasors.fit.segment, settings, samples.lost_variance(used))
    return _point(phasors, cycles, dropped)


def _where(segment: Segment) -> str:
    return f"around t = {segment.centre:.6g} s, {segment.omega / (2.0 * np.pi):.6g} Hz"


def _check_share(fit: SineFit, segment: Segment, settings: Settings, lost: FloatArray) -> None:
    shares = fundamental_share(fit, segment, lost)
    for name, share in zip((settings.motion_channel, "force"), shares, strict=True):
        if share < settings.min_share:
            raise ExtractionError(
                f"{name} {_where(segment)}: the fundamental has {percent(share, 3)} of the "
                f"power; expected at least {percent(settings.min_share, 3)}, one dominant sine: "
                f"check the channel and {argument('frequency')}, or lower "
                f"{argument('min_share')} if it is noise"
            )


def _settling_periods(phasors: Phasors, cycles: int) -> int:
    """Return the number of leading cycles to leave out, found from the fundamental."""
    q = np.arange(cycles - FEWEST_CYCLES + 1)
    ratio = phasors.cycles / (cycles - q)
    bias = abs(phasors.bias[0]) * np.exp(-phasors.transient.rate * q) * ratio
    error = np.sqrt(phasors.fundamental[1][0, 0] * ratio)
    negligible = bias <= _NEGLIGIBLE_BIAS * error
    if negligible.any():
        return int(np.argmax(negligible))
    return int(np.argmin(bias**2 + 2.0 * error**2))  # the least mean square error


def _point(phasors: Phasors, cycles: int, dropped: int) -> Point:
    """Return the point of phasors, with its verdicts; `dropped` of `cycles` were left out."""
    distorted = phasors.distorted
    response, joint, dof = phasors.rows(distorted)
    no_noise = {k: LineNoise(np.zeros_like(n.lines), n.dof) for k, n in phasors.noise.items()}
    segment, recorded = phasors.fit.segment, phasors.samples.time
    transient, bias, lag = phasors.transient, phasors.bias, phasors.lag
    components = np.where(np.equal(phasors.harmonics, 0), 1.0, 2.0)  # a mean is a real number
    variance = np.trace(joint[:, 1:, 1:], axis1=1, axis2=2) / components
    error = np.maximum(np.sqrt(variance), TINY)
    excess = np.abs(bias) / (_TOLERATED * error)
    faded = (excess <= 1.0) | (not transient.significant)
    missing = np.where(faded, 0.0, np.ceil(np.log(np.maximum(excess, 1.0)) / transient.rate))
    if phasors.mean_moves:
        faded = np.zeros_like(faded)
        missing = np.maximum(missing, cycles)
    settled = faded & (np.abs(lag) <= _TOLERATED * error)
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
        unsettled = f"not settled, {counted(more, 'more period')}" if more else too_fast
        verdicts.append("; ".join([unsettled][: not good] + shared) or "good")
    return Point(
        frequency_hz=segment.omega / (2.0 * np.pi),
        amplitude=float(abs(phasors.fundamentals[0])),
        drive=float(abs(phasors.fundamentals[1])),
        harmonic=phasors.harmonics,
        response=response,
        joint=joint,
        repeating=replace(phasors, noise=no_noise).rows(distorted)[1],
        dof=dof,
        sweep=bool(phasors.fit.trending),
        quality=quality | {"verdict": verdicts},
    )


def record_response(
    pieces: Iterable[Record], settings: Settings, level: ArrayLike | None, run: str | None
) -> FrequencyResponse:
    """Return the points of a record in pieces; a level in two pieces becomes one point."""
    points: list[Point] = []
    refused: list[str] = []
    noted: dict[str, None] = {}  # warnings of the reader
    for record in pieces:
        noted |= dict.fromkeys((record.provenance or {}).get("warnings", ()))
        settings = replace(settings, motion_channel=record.motion_channel)
        try:
            next_points, reasons = _points(record, settings)
        except ExtractionError as exc:
            next_points, reasons = [], [str(exc)]
        points = joined(points, next_points)
        refused += reasons
    provenance = dict(record.provenance or {})
    file = f"{provenance['file']}: " if "file" in provenance else ""
    if not points:
        raise ExtractionError(f"{file}{_summary(refused)}")
    if refused:
        warnings.warn(f"{file}left out: {_summary(refused)}", stacklevel=3)
    names = ("frequency", "mode", "num_periods", "settling_periods", "harmonics", "min_share")
    options = {name: getattr(settings, name) for name in names}
    options |= {"harmonics": list(settings.harmonics), "refused": refused}
    provenance |= {"extraction": options} | ({"warnings": list(noted)} if noted else {})
    return _table(points, record, settings, {"level": level, "run": run}, provenance)


def _points(record: Record, settings: Settings) -> tuple[list[Point], list[str]]:
    """Return the points, at least one, and the reasons why other segments give none."""
    frequency, mode = settings.frequency, settings.mode
    time = record.time if record.time[0] == 0.0 else record.time - record.time[0]
    samples = Samples(time, np.stack([record.motion_samples, record.force_samples]))
    motion = samples.channels[0]
    runs = find_cycles(time, motion, frequency)
    points: list[Point] = []
    refused: list[str] = []
    try:
        spans = record_spans(time, motion, runs, frequency, mode, settings.num_periods)
    except ExtractionError as exc:
        spans, refused = [], [str(exc)]
    block = samples.block_size(max(s.frequency_hz for s in spans)) if spans else 1
    means = samples.means(block)
    for span in spans:
        try:
            segment = segment_of(means.time, means.channels, span, frequency, block)
            points.append(measure(segment, settings, samples, sweep=span.sweep))
        except ExtractionError as exc:
            refused.append(str(exc))
    if frequency is None:
        _refuse_other_motion(record, motion, runs, points)
    if not points:
        raise ExtractionError(_summary(refused))
    for point in points:
        for name in ("start_time", "end_time"):
            point.quality[name] += record.time[0]
    return points, refused


def _refuse_other_motion(
    record: Record, motion: FloatArray, runs: Sequence[Cycles], points: Sequence[Point]
) -> None:
    """Refuse a record that is not a sine measurement, even if chance gives some points."""
    moving = sum(float(np.sum(run.stop - run.start)) for run in runs)
    measured = sum(p.quality["end_time"] - p.quality["start_time"] for p in points)
    if measured > _WELL_COVERED * moving:
        return
    reason = _not_a_sine_test(motion, runs, covered=measured / moving if moving else 0.0)
    if reason and not _is_sweep(find_cycles(record.time, record.force_samples)):
        raise ExtractionError(
            f"{reason}; expected levels or a sweep of one sine; for any other motion fit the "
            f"waveform itself: {spelled('di.fit(record, model)', 'dahl-ident fit --record')}"
        )
    if reason:
        file = shlex.quote(str((record.provenance or {}).get("file", "FILE")))
        free = f"dahl-ident fit --record {file} --mass free --damping free --stiffness free"
        raise ExtractionError(
            f"{reason}; the force is a sweep of one sine, which the motion is too unsteady to "
            f"follow in a table; fit the waveforms: {spelled('di.fit(record, model)', free)}"
        )


def _not_a_sine_test(motion: FloatArray, runs: Sequence[Cycles], covered: float) -> str:
    """Return why the motion is not a sine measurement; empty if it may be one.

    `covered` is the fraction of the moving time that points cover.
    """
    noise, period, amplitude, pairs = _neighbour_changes(runs)
    similar = period <= _PERIOD_CHANGE and amplitude <= _AMPLITUDE_CHANGE
    if pairs >= _FEWEST_PAIRS and similar:
        return ""
    line, periods = _strongest_line(motion)
    in_noise = pairs >= _FEWEST_PAIRS and (covered > 0.0 or noise > _NOISY)
    if line > (_SINE_IN_NOISE if in_noise else _ONE_LINE) and periods > 1:
        return ""
    power = f"its strongest line has {percent(line)} of the power"
    if pairs < _FEWEST_PAIRS:
        short = ", or a record too short for one" if periods < _FEWEST_PAIRS else ""
        return f"not a sine test{short}: the motion has no two consecutive cycles, and {power}"
    return (
        f"not a sine test: neighbouring cycles of the motion differ by {percent(period)} in "
        f"period and {percent(amplitude)} in amplitude (median), and {power}"
    )


def _is_sweep(runs: Sequence[Cycles]) -> bool:
    """Return whether the drive is one sine whose period changes smoothly from cycle to cycle."""
    if not runs:
        return False
    run = max(runs, key=len)
    period = np.log(run.stop - run.start)
    if len(run) < _SWEEP_CYCLES or np.ptp(period) < _SWEEP_RANGE:
        return False
    energy = np.exp(2.0 * (run.log_amplitude - run.log_amplitude.max()) + period)[1:-1]
    period_change = _median(np.abs(np.diff(period, 2)), energy)
    amplitude_change = _median(np.abs(np.diff(run.log_amplitude))[1:], energy)
    return period_change <= _PERIOD_CHANGE and amplitude_change <= _AMPLITUDE_CHANGE


def _neighbour_changes(runs: Sequence[Cycles]) -> tuple[float, float, float, int]:
    """Return medians over pairs of neighbouring cycles, and the number of pairs.

    The medians, weighted by energy, are those of the noise, of the change of log period, and of the
    change of log amplitude.
    """
    pairs = [
        (
            np.maximum(run.noise[1:], run.noise[:-1]),
            np.abs(np.diff(np.log(run.stop - run.start))),
            np.abs(np.diff(run.log_amplitude)),
            2.0 * np.minimum(run.log_amplitude[1:], run.log_amplitude[:-1])
            + np.log(run.stop[1:] - run.start[:-1]),
        )
        for run in runs
        if len(run) > 1
    ]
    if not pairs:
        return np.inf, np.inf, np.inf, 0
    noise, period, amplitude, log_energy = (np.concatenate(c) for c in zip(*pairs, strict=True))
    energy = np.exp(log_energy - log_energy.max())
    return (
        _median(noise, energy),
        _median(period, energy),
        _median(amplitude, energy),
        energy.size,
    )


def _median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def _strongest_line(motion: FloatArray) -> tuple[float, int]:
    """Return the fraction of the power near the strongest spectral line, and its periods."""
    start = max(0, (motion.size - _SPECTRUM_SAMPLES) // 2)
    part = motion[start : start + _SPECTRUM_SAMPLES]
    power = np.abs(np.fft.rfft(part - part.mean())[1:]) ** 2
    total = float(power.sum())
    strongest = int(np.argmax(power))
    near = power[max(strongest - _LEAKAGE, 0) : strongest + _LEAKAGE + 1]
    return (float(near.sum()) / total, strongest + 1) if total else (1.0, motion.size)


def _summary(refused: Sequence[str]) -> str:
    """Return the first reason, and the number of unusable segments."""
    more = "" if len(refused) == 1 else f" ({len(refused)} segments in all are not usable)"
    return f"{refused[0]}{more}"


def _table(
    points: Sequence[Point],
    record: Record,
    settings: Settings,
    labels: dict[str, Any],
    provenance: dict[str, Any],
) -> FrequencyResponse:
    rows = [len(point.harmonic) for point in points]

    def per_row(name: str) -> Any:
        values = [getattr(p, name) if hasattr(p, name) else p.quality[name] for p in points]
        pairs = zip(values, rows, strict=True)
        return np.concatenate([v if np.ndim(v) else np.full(n, v) for v, n in pairs])

    names = ("frequency_hz", "response", "amplitude", "drive", "dof", "harmonic")
    joint, controlled = per_row("joint"), "drive" if settings.of_displacement else "amplitude"
    uncertainty = 0.0 if record.force is not None else record.drive_factor_uncertainty
    return FrequencyResponse(
        **{name: per_row(name) for name in names},
        covariance=joint[:, 1:, 1:],
        **{
            f"{controlled}_std": np.sqrt(joint[:, 0, 0]),
            f"{controlled}_covariance": joint[:, 0, 1:],
        },
        **labels,
        controlled=settings.controlled,
        quantity="receptance" if settings.of_displacement else "dynamic_stiffness",
        motion=record.motion,
        drive_factor_uncertainty=uncertainty,
        quality={name: per_row(name) for name in points[0].quality},
        provenance=provenance,
    )


def joined(points: list[Point], next_points: list[Point]) -> list[Point]:
    """Return the points of one piece and of the next; a level in both pieces is one point."""
    if not points or not next_points:
        return [*points, *next_points]
    a, b = points[-1], next_points[0]
    missing = (b.quality["start_time"] - a.quality["end_time"]) * a.frequency_hz
    one_level = (
        not (a.sweep or b.sweep)
        and a.harmonic == b.harmonic
        and missing < _MISSING_CYCLES + b.quality["settling_periods"]
        and abs(np.log(b.amplitude / a.amplitude)) < AMPLITUDE_TOLERANCE
        and abs(np.log(b.frequency_hz / a.frequency_hz)) < FREQUENCY_TOLERANCE
    )
    if not one_level:
        return [*points, *next_points]
    return [*points[:-1], _combined(a, b), *next_points[1:]]


def _combined(a: Point, b: Point) -> Point:
    """Return one point for two parts of a level."""
    periods = a.quality["num_periods"] + b.quality["num_periods"]
    settling = a.quality["settling_periods"] + b.quality["settling_periods"]
    if b.quality["settled"].all() and not a.quality["settled"].all():
        settling = a.quality["num_periods"] + b.quality["settling_periods"]
        counts = {"num_periods": periods, "settling_periods": settling}
        return replace(b, quality=b.quality | counts)
    used = [p.quality["num_periods"] - p.quality["settling_periods"] for p in (a, b)]
    weights = np.array(used, dtype=np.float64) / sum(used)

    def mean(of_a: Any, of_b: Any) -> Any:
        return weights[0] * of_a + weights[1] * of_b

    repeating = mean(a.repeating, b.repeating)
    separate = [w**2 * (p.joint - p.repeating) for w, p in zip(weights, (a, b), strict=True)]
    # degrees of freedom by the Welch-Satterthwaite formula
    traces = [np.trace(joint[:, 1:, 1:], axis1=1, axis2=2) + TINY for joint in separate]
    inverse_dof = sum((t / sum(traces)) ** 2 / p.dof for t, p in zip(traces, (a, b), strict=True))
    verdicts = []
    for both in zip(a.quality["verdict"], b.quality["verdict"], strict=True):
        objections = dict.fromkeys(part for text in both for part in text.split("; "))
        verdicts.append("; ".join(part for part in objections if part != "good") or "good")
    quality = {
        **a.quality,
        **{
            name: mean(value, b.quality[name])
            for name, value in a.quality.items()
            if np.asarray(value).dtype.kind == "f"
        },
        "settled": a.quality["settled"] & b.quality["settled"],
        "more_periods": np.maximum(a.quality["more_periods"], b.quality["more_periods"]),
        "num_periods": periods,
        "settling_periods": settling,
        "start_time": a.quality["start_time"],
        "end_time": b.quality["end_time"],
        "verdict": verdicts,
    }
    means = ("frequency_hz", "amplitude", "drive", "response")
    return replace(
        a,
        **{name: mean(getattr(a, name), getattr(b, name)) for name in means},
        joint=separate[0] + separate[1] + repeating,
        repeating=repeating,
        dof=np.asarray(1.0 / inverse_dof),
        quality=quality,
    )

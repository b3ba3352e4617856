"""From a record to a frequency response: segments, sine fits, verdicts, one table."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray, positive_number, whole_number
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import ExtractionError, ValidationError
from dahl_ident.extraction.point import Point, Settings, measure
from dahl_ident.extraction.segments import MODES, Mode
from dahl_ident.extraction.sine_fit import FEWEST_CYCLES, HARMONICS
from dahl_ident.extraction.stretches import record_segments, stretch_of


def extract(
    record: Record,
    *,
    frequency: float | None = None,
    mode: Mode = "auto",
    num_periods: int | None = None,
    settling_periods: int | None = None,
    harmonics: Sequence[int] | None = None,
    controlled: str = "displacement",
    level: ArrayLike | None = None,
    min_share: float = 0.6,
) -> FrequencyResponse:
    """Turn recorded waveforms into dynamic stiffness with covariance and verdicts.

    The record is split into stretches of constant amplitude and frequency; rests and ramps are
    left out. Each stretch gives one point: the fundamental of force over that of displacement,
    N = F_1/X_1, and a row for each further harmonic, F_k/X_1. Cycles in which friction still
    remembers the level before are left out as far as needed. A continuous sweep gives a series
    of points.

    Parameters
    ----------
    record : Record
        Waveforms of motion and force, sampled anyhow. Velocity and acceleration are integrated
        at the fitted frequency.
    frequency : float, optional
        Excitation frequency, Hz, where it is known; the whole record is then read at it. Left
        out: found, and estimated for each stretch together with the phasors.
    mode : {"auto", "steps", "sweep"}, default "auto"
        What the record holds: levels one after another, or a continuous sweep of amplitude or
        frequency. "auto" takes whichever there is more of.
    num_periods : int, optional
        Periods of each stretch that are used, settling ones among them: the last ones. In a
        sweep, those of a window. Default: all of a stretch.
    settling_periods : int, optional
        Leading periods of `num_periods` that are left out. Default: as many as the memory of
        friction needs, judged from the decaying mean of the force.
    harmonics : sequence of int, optional
        Which harmonics become rows, 1 to 9; fewer where the sampling cannot tell them apart.
        Default: 1, 3, 5, 7, 9, or 1 alone where the force was controlled, since the displacement
        then has harmonics of its own.
    controlled : {"displacement", "force"}, default "displacement"
        What the laboratory held constant. Where it is the force, memory is looked for in the
        displacement's mean.
    level : str or float, optional
        Nominal label of the record.
    min_share : float, default 0.6
        Share of the power, offset and drift apart, that the fundamental has at least, in motion
        and in force. Lower it for a sine buried in noise.

    Returns
    -------
    FrequencyResponse
        Dynamic stiffness with `covariance`, `dof`, `amplitude_std` and `amplitude_covariance`.
        The covariance is such that ``d' C^-1 d / 2`` follows F(2, dof). Its `quality` columns:

        ``settled``
            Whether the bias left by friction's memory is within a standard error.
        ``bias_real``, ``bias_imag``
            That bias as estimated, in the response's unit; it is not subtracted. In a sweep
            with half of what the response changes in a cycle, a bound of how far it lags.
        ``more_periods``
            Settling periods that are missing at least; 0 in a sweep that is too fast.
        ``num_periods``, ``settling_periods``
            Periods of the stretch, and how many leading ones were left out.
        ``covariance_from``
            "cycles", or "spectrum" with fewer than four: an estimate from farther beside the
            harmonics.
        ``start_time``, ``end_time``
            First and last sample used, s.
        ``displacement_share``, ``force_share``
            The fundamental's share of the power of the motion channel and of the force.
        ``displacement_distortion``
            Harmonics 2 to 9 of the displacement over its fundamental.
        ``displacement_steps``, ``force_steps``
            Amplitude in steps of the sensor; infinite where no steps show.
        ``displacement_clipped``, ``force_clipped``
            Share of samples that stand still at the highest or lowest value.
        ``verdict``
            "good", or what speaks against the point; a loss below zero among it.

    Raises
    ------
    ExtractionError
        If no stretch is usable: too short, motion or force not dominated by one sine, less
        motion than the sensor's step, or `frequency` not that of the motion, so that its phase
        drifts. Where only some are, a warning tells which and why.
    ValidationError
        If an argument is out of range, or the record has only a drive without a factor.

    Notes
    -----
    The sine fit is that of IEEE Std 1057 with harmonics. Its covariance is taken from what does
    not repeat between the harmonics, plus two errors that do: rounding to sensor steps where no
    noise dithers it, and harmonics above half the sampling rate, which fold onto lower ones (the
    size of those seen is extended to them; with a hundred samples a cycle it hardly counts, and
    with so few that none are seen the verdict tells). It holds for white and for 1/f noise. The
    uncertainty of a record's `drive_factor` is common to all points and not part of it. A hum
    during rests that is a clean sine in both channels is taken for a level; give `frequency`
    then.

    Examples
    --------
    >>> from dahl_ident.elements import Dahl
    >>> friction = Dahl(f_max=0.1, sigma=30.0)
    >>> t = np.arange(4000) / 200.0
    >>> x = 0.004 * np.sin(2.0 * np.pi * 1.25 * t)
    >>> rng = np.random.default_rng(0)
    >>> force = friction.force(x) + 1e-4 * rng.standard_normal(t.size)
    >>> data = extract(Record(t, displacement=x, force=force), harmonics=[1])
    >>> N, exact = data.response[0], friction.describing_function(data.amplitude[0])
    >>> f"{N:.2f}", f"{exact:.2f}", str(data.quality["verdict"][0])
    ('19.74+9.72j', '19.74+9.72j', 'good')
    """
    settings = _settings(record, num_periods, settling_periods, harmonics, controlled, min_share)
    if mode not in MODES:
        raise ValidationError(f"mode is {mode!r}; expected one of {', '.join(MODES)}")
    known = None if frequency is None else positive_number(frequency, "frequency")
    provenance = dict(record.provenance or {})
    file = f"{provenance['file']}: " if "file" in provenance else ""
    try:
        points, refused = _points(record, known, mode, settings)
    except ExtractionError as exc:
        raise ExtractionError(f"{file}{exc}") from exc
    if refused:
        warnings.warn(f"{file}left out: {_summary(refused)}", stacklevel=2)
    options = {
        "frequency": known,
        "mode": mode,
        "num_periods": num_periods,
        "settling_periods": settling_periods,
        "harmonics": list(settings.harmonics),
        "min_share": settings.min_share,
        "refused": refused,
    }
    return _table(points, record, settings, level, {**provenance, "extraction": options})


def _settings(
    record: Record,
    num_periods: int | None,
    settling_periods: int | None,
    harmonics: Sequence[int] | None,
    controlled: str,
    min_share: float,
) -> Settings:
    if num_periods is not None:
        num_periods = whole_number(num_periods, "num_periods", FEWEST_CYCLES)
    if settling_periods is not None:
        settling_periods = whole_number(settling_periods, "settling_periods", 0)
    if harmonics is None:
        harmonics = (1,) if controlled == "force" else range(1, HARMONICS + 1, 2)
    orders = tuple(whole_number(k, "harmonics", 1) for k in harmonics)
    if not orders or max(orders) > HARMONICS or len(set(orders)) < len(orders):
        raise ValidationError(
            f"harmonics is {list(harmonics)!r}; expected different numbers from 1 to {HARMONICS}"
        )
    if controlled not in ("displacement", "force"):
        raise ValidationError(f"controlled is {controlled!r}; expected 'displacement' or 'force'")
    if not 0.0 <= min_share < 1.0:
        raise ValidationError(f"min_share is {min_share!r}; expected a share from 0 to below 1")
    return Settings(
        orders, num_periods, settling_periods, min_share, record.motion_channel, controlled
    )


def _points(
    record: Record, frequency: float | None, mode: Mode, settings: Settings
) -> tuple[list[Point], list[str]]:
    """Return the points, and why other stretches give none; at least one does."""
    channels = np.stack([record.motion_samples, record.force_samples])
    points, refused = [], []
    for segment in record_segments(record.time, channels[0], frequency, mode, settings.num_periods):
        try:
            stretch = stretch_of(record.time, channels, segment, frequency)
            points.append(measure(stretch, settings, sweep=segment.sweep))
        except ExtractionError as exc:
            refused.append(str(exc))
    if not points:
        raise ExtractionError(_summary(refused))
    return points, refused


def _summary(refused: Sequence[str]) -> str:
    """Return the first reason, and how many stretches have one."""
    more = "" if len(refused) == 1 else f" ({len(refused)} stretches in all are not usable)"
    return f"{refused[0]}{more}"


def _table(
    points: Sequence[Point],
    record: Record,
    settings: Settings,
    level: ArrayLike | None,
    provenance: dict[str, Any],
) -> FrequencyResponse:
    """Return one row for each harmonic of each point."""
    rows = [len(point.harmonic) for point in points]

    def per_point(values: Sequence[float]) -> FloatArray:
        return np.repeat(np.asarray(values), rows)

    def per_row(arrays: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate(arrays)

    quality = {
        name: np.concatenate(
            [np.broadcast_to(p.quality[name], n) for p, n in zip(points, rows, strict=True)]
        )
        for name in points[0].quality
    }
    return FrequencyResponse(
        per_point([p.frequency_hz for p in points]),
        np.concatenate([p.response for p in points]),
        amplitude=per_point([p.amplitude for p in points]),
        drive=per_point([p.drive for p in points]),
        covariance=per_row([p.covariance for p in points]),
        dof=per_row([p.dof for p in points]),
        amplitude_std=per_point([p.amplitude_std for p in points]),
        amplitude_covariance=per_row([p.amplitude_covariance for p in points]),
        level=level,
        controlled=settings.controlled,
        harmonic=[k for p in points for k in p.harmonic],
        motion=record.motion,
        quality=quality,
        provenance=provenance,
    )

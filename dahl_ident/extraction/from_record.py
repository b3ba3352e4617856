"""From a record to a frequency response: segments, sine fits, verdicts, one table."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray, positive_number, whole_number
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.columns import one_of
from dahl_ident.errors import ExtractionError, ValidationError
from dahl_ident.extraction.block_means import Samples
from dahl_ident.extraction.cycles import Cycles
from dahl_ident.extraction.joined_points import joined
from dahl_ident.extraction.plateaus import MODES, Mode
from dahl_ident.extraction.point import Point, Settings, measure
from dahl_ident.extraction.segments import record_cycles, record_spans, segment_of
from dahl_ident.extraction.sine_fit import FEWEST_CYCLES, HARMONICS
from dahl_ident.extraction.sine_test import ROUTE, SWEEP_ROUTE, is_sweep, not_a_sine_test

_WELL_COVERED = 0.8  # of the moving time: points that cover more of it are none by chance


def record_response(
    pieces: Iterable[Record],
    *,
    frequency: float | None = None,
    mode: Mode = "auto",
    num_periods: int | None = None,
    settling_periods: int | None = None,
    harmonics: Sequence[int] | None = None,
    controlled: str = "displacement",
    level: ArrayLike | None = None,
    run: str | None = None,
    min_share: float = 0.6,
) -> FrequencyResponse:
    """Return the points of a record in pieces, with rows of all harmonics where none are named.

    A level that goes on from one piece to the next is one point. The other arguments are those of
    :func:`dahl_ident.extraction.extract`.
    """
    settings = _settings(num_periods, settling_periods, harmonics, controlled, min_share)
    one_of(mode, "mode", MODES)
    known = None if frequency is None else positive_number(frequency, "frequency")
    points: list[Point] = []
    refused: list[str] = []
    doubts: dict[str, None] = {}
    for record in pieces:
        doubts |= dict.fromkeys((record.provenance or {}).get("warnings", ()))
        settings = replace(settings, motion_channel=record.motion_channel)
        try:
            further, unusable = _points(record, known, mode, settings)
        except ExtractionError as exc:
            further, unusable = [], [str(exc)]
        points = joined(points, further)
        refused += unusable
    provenance = dict(record.provenance or {})
    file = f"{provenance['file']}: " if "file" in provenance else ""
    if not points:
        raise ExtractionError(f"{file}{_summary(refused)}")
    if refused:
        warnings.warn(f"{file}left out: {_summary(refused)}", stacklevel=3)
    options = {
        "frequency": known,
        "mode": mode,
        "num_periods": num_periods,
        "settling_periods": settling_periods,
        "harmonics": list(settings.harmonics),
        "min_share": settings.min_share,
        "refused": refused,
    }
    provenance |= {"extraction": options} | ({"warnings": list(doubts)} if doubts else {})
    return _table(points, record, settings, {"level": level, "run": run}, provenance)


def _settings(
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
        harmonics = (1,) if controlled == "force" else range(HARMONICS + 1)
    orders = tuple(whole_number(k, "harmonics", 0) for k in harmonics)
    if not orders or max(orders) > HARMONICS or len(set(orders)) < len(orders):
        raise ValidationError(
            f"harmonics is {list(harmonics)!r}; expected different numbers from 0 to {HARMONICS}"
        )
    if controlled not in ("displacement", "force"):
        raise ValidationError(f"controlled is {controlled!r}; expected 'displacement' or 'force'")
    if not 0.0 <= min_share < 1.0:
        raise ValidationError(f"min_share is {min_share!r}; expected a share from 0 to below 1")
    return Settings(orders, num_periods, settling_periods, min_share, "displacement", controlled)


def _points(
    record: Record, frequency: float | None, mode: Mode, settings: Settings
) -> tuple[list[Point], list[str]]:
    """Return the points, and why other segments give none; at least one does."""
    time = record.time if record.time[0] == 0.0 else record.time - record.time[0]
    samples = Samples(time, record.motion_samples, record.force_samples)
    runs = record_cycles(time, samples.motion, frequency)
    points: list[Point] = []
    refused: list[str] = []
    try:
        spans = record_spans(time, samples.motion, runs, frequency, mode, settings.num_periods)
    except ExtractionError as exc:
        spans, refused = [], [str(exc)]
    block = samples.block_size(max(s.frequency_hz for s in spans)) if spans else 1
    mean_time, channels = samples.means(block)
    for span in spans:
        try:
            segment = segment_of(mean_time, channels, span, frequency, block)
            points.append(measure(segment, settings, samples, sweep=span.sweep))
        except ExtractionError as exc:
            refused.append(str(exc))
    if frequency is None:
        _refuse_other_motion(record, samples.motion, runs, points)
    if not points:
        raise ExtractionError(_summary(refused))
    for point in points:
        for name in ("start_time", "end_time"):
            point.quality[name] += record.time[0]
    return points, refused


def _refuse_other_motion(
    record: Record, motion: FloatArray, runs: Sequence[Cycles], points: Sequence[Point]
) -> None:
    """Refuse a record that is not a sine measurement, even if some points occur by chance."""
    moving = sum(float(np.sum(run.stop - run.start)) for run in runs)
    measured = sum(p.quality["end_time"] - p.quality["start_time"] for p in points)
    if measured > _WELL_COVERED * moving:
        return
    reason = not_a_sine_test(motion, runs, covered=measured / moving if moving else 0.0)
    if reason:
        route = ROUTE
        if is_sweep(record_cycles(record.time, record.force_samples, None)):
            route = SWEEP_ROUTE.format(file=(record.provenance or {}).get("file", "FILE"))
        raise ExtractionError(f"{reason}; {route}")


def _summary(refused: Sequence[str]) -> str:
    """Return the first reason, and how many segments have one."""
    more = "" if len(refused) == 1 else f" ({len(refused)} segments in all are not usable)"
    return f"{refused[0]}{more}"


def _table(
    points: Sequence[Point],
    record: Record,
    settings: Settings,
    labels: dict[str, Any],
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
        **labels,
        controlled=settings.controlled,
        harmonic=[k for p in points for k in p.harmonic],
        motion=record.motion,
        drive_factor_uncertainty=0.0
        if record.force is not None
        else record.drive_factor_uncertainty,
        quality=quality,
        provenance=provenance,
    )

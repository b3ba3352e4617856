"""From a record to a frequency response: segments, sine fits, verdicts, one table."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.cycles import Cycles
from dahl_ident.extraction.joined_points import joined
from dahl_ident.extraction.point import Point, Settings, measure
from dahl_ident.extraction.segments import record_cycles, record_spans, segment_of
from dahl_ident.extraction.sine_fit import Samples
from dahl_ident.extraction.sine_test import ROUTE, SWEEP_ROUTE, is_sweep, not_a_sine_test

_WELL_COVERED = 0.8  # of the moving time: points that cover more of it are none by chance


def record_response(
    pieces: Iterable[Record], settings: Settings, level: ArrayLike | None, run: str | None
) -> FrequencyResponse:
    """Return the points of a record in pieces, with a row for each harmonic.

    A level that goes on from one piece to the next is one point.
    """
    points: list[Point] = []
    refused: list[str] = []
    doubts: dict[str, None] = {}
    for record in pieces:
        doubts |= dict.fromkeys((record.provenance or {}).get("warnings", ()))
        settings = replace(settings, motion_channel=record.motion_channel)
        try:
            further, unusable = _points(record, settings)
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
    names = ("frequency", "mode", "num_periods", "settling_periods", "harmonics", "min_share")
    options = {name: getattr(settings, name) for name in names}
    options |= {"harmonics": list(settings.harmonics), "refused": refused}
    provenance |= {"extraction": options} | ({"warnings": list(doubts)} if doubts else {})
    return _table(points, record, settings, {"level": level, "run": run}, provenance)


def _points(record: Record, settings: Settings) -> tuple[list[Point], list[str]]:
    """Return the points, and why other segments give none; at least one does."""
    frequency, mode = settings.frequency, settings.mode
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

    def per_row(name: str) -> Any:
        """Return a field or a verdict of the points, one for each row."""
        values = [getattr(p, name) if hasattr(p, name) else p.quality[name] for p in points]
        each = [
            np.asarray(v) if np.ndim(v) else np.full(n, v)
            for v, n in zip(values, rows, strict=True)
        ]
        return np.concatenate(each)

    joint, held = per_row("joint"), "drive" if settings.of_displacement else "amplitude"
    return FrequencyResponse(
        per_row("frequency_hz"),
        per_row("response"),
        amplitude=per_row("amplitude"),
        drive=per_row("drive"),
        covariance=joint[:, 1:, 1:],
        dof=per_row("dof"),
        **{f"{held}_std": np.sqrt(joint[:, 0, 0]), f"{held}_covariance": joint[:, 0, 1:]},
        **labels,
        controlled=settings.controlled,
        harmonic=per_row("harmonic"),
        quantity="receptance" if settings.of_displacement else "dynamic_stiffness",
        motion=record.motion,
        drive_factor_uncertainty=0.0
        if record.force is not None
        else record.drive_factor_uncertainty,
        quality={name: per_row(name) for name in points[0].quality},
        provenance=provenance,
    )

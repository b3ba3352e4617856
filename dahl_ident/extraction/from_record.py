"""From a record to a frequency response: segments, sine fits, verdicts, one table.

Pieces of a record may end within a level. Each part then has a point of its own, and with n_i
cycles they give, by weights w_i = n_i / sum n,

    N = sum w_i N_i,      C = sum w_i^2 (C_i - R_i) + sum w_i R_i

R being what rounding and aliasing leave alike in every cycle, which no averaging lowers. A part
that has not settled belongs to the settling periods of the one that has. At a cut the cycle that
it goes through is lost.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import TINY, FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import ExtractionError
from dahl_ident.extraction.cycles import Cycles
from dahl_ident.extraction.phasors import Settings
from dahl_ident.extraction.plateaus import AMPLITUDE_TOLERANCE, FREQUENCY_TOLERANCE
from dahl_ident.extraction.point import Point, measure
from dahl_ident.extraction.segments import record_cycles, record_spans, segment_of
from dahl_ident.extraction.sine_fit import Samples
from dahl_ident.extraction.sine_test import is_sweep, not_a_sine_test, route

_WELL_COVERED = 0.8  # of the moving time: points that cover more of it are none by chance
_APART = 3.0  # cycles that may be missing between two parts
_MEANS = (
    "bias_real", "bias_imag", "displacement_share", "force_share", "displacement_distortion",
    "force_distortion", "asymmetry", "displacement_steps", "force_steps", "displacement_clipped",
    "force_clipped",
)  # fmt: skip


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
        swept = is_sweep(record_cycles(record.time, record.force_samples, None))
        file = (record.provenance or {}).get("file", "FILE") if swept else None
        raise ExtractionError(f"{reason}; {route(file)}")


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


def joined(points: list[Point], further: list[Point]) -> list[Point]:
    """Return the points of one piece and of the next, a level across the cut as one point."""
    if not points or not further:
        return [*points, *further]
    a, b = points[-1], further[0]
    apart = (b.quality["start_time"] - a.quality["end_time"]) * a.frequency_hz
    one_level = (
        not (a.sweep or b.sweep)
        and a.harmonic == b.harmonic
        and apart < _APART + b.quality["settling_periods"]
        and abs(np.log(b.amplitude / a.amplitude)) < AMPLITUDE_TOLERANCE
        and abs(np.log(b.frequency_hz / a.frequency_hz)) < FREQUENCY_TOLERANCE
    )
    return [*points[:-1], _both(a, b), *further[1:]] if one_level else [*points, *further]


def _both(a: Point, b: Point) -> Point:
    """Return one point for two parts of a level."""
    periods = a.quality["num_periods"] + b.quality["num_periods"]
    if b.quality["settled"].all() and not a.quality["settled"].all():
        left_out = a.quality["num_periods"] + b.quality["settling_periods"]
        return replace(
            b, quality={**b.quality, "num_periods": periods, "settling_periods": left_out}
        )
    used = [p.quality["num_periods"] - p.quality["settling_periods"] for p in (a, b)]
    weights = np.array(used, dtype=np.float64) / sum(used)

    def mean(of_a: Any, of_b: Any) -> Any:
        return weights[0] * of_a + weights[1] * of_b

    repeating = mean(a.repeating, b.repeating)
    separate = [w**2 * (p.joint - p.repeating) for w, p in zip(weights, (a, b), strict=True)]
    # the degrees of freedom of a sum of variances, as Welch and Satterthwaite have them
    traces = [np.trace(joint[:, 1:, 1:], axis1=1, axis2=2) + TINY for joint in separate]
    spread = sum((s / sum(traces)) ** 2 / p.dof for s, p in zip(traces, (a, b), strict=True))
    verdicts = zip(a.quality["verdict"], b.quality["verdict"], strict=True)
    quality = {
        **a.quality,
        **{name: mean(a.quality[name], b.quality[name]) for name in _MEANS},
        "settled": a.quality["settled"] & b.quality["settled"],
        "more_periods": np.maximum(a.quality["more_periods"], b.quality["more_periods"]),
        "num_periods": periods,
        "settling_periods": a.quality["settling_periods"] + b.quality["settling_periods"],
        "end_time": b.quality["end_time"],
        "verdict": [_verdict(*both) for both in verdicts],
    }
    return replace(
        a,
        frequency_hz=mean(a.frequency_hz, b.frequency_hz),
        amplitude=mean(a.amplitude, b.amplitude),
        drive=mean(a.drive, b.drive),
        response=mean(a.response, b.response),
        joint=separate[0] + separate[1] + repeating,
        repeating=repeating,
        dof=np.asarray(1.0 / spread),
        quality=quality,
    )


def _verdict(first: str, second: str) -> str:
    parts = [part for text in (first, second) for part in text.split("; ") if part != "good"]
    return "; ".join(dict.fromkeys(parts)) or "good"

"""Joining of the points of one level that was split between pieces of a record.

A piece may end within a level. Each part then has a point of its own, and with n_i cycles they
give, by weights w_i = n_i / sum n,

    N = sum w_i N_i,      C = sum w_i^2 (C_i - R_i) + sum w_i R_i

R being what rounding and aliasing leave alike in every cycle, which no averaging lowers. A part
that has not settled belongs to the settling periods of the one that has. At a cut the cycle that
it goes through is lost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dahl_ident.arrays import TINY
from dahl_ident.extraction.plateaus import AMPLITUDE_TOLERANCE, FREQUENCY_TOLERANCE
from dahl_ident.extraction.point import Point

_APART = 3.0  # cycles that may be missing between two parts
_MEANS = (
    "bias_real", "bias_imag", "displacement_share", "force_share", "displacement_distortion",
    "force_distortion", "asymmetry", "displacement_steps", "force_steps", "displacement_clipped",
    "force_clipped",
)  # fmt: skip


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
    own = [w**2 * (p.joint - p.repeating) for w, p in zip(weights, (a, b), strict=True)]
    # the degrees of freedom of a sum of variances, as Welch and Satterthwaite have them
    traces = [np.trace(joint[:, 1:, 1:], axis1=1, axis2=2) + TINY for joint in own]
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
        joint=own[0] + own[1] + repeating,
        repeating=repeating,
        dof=np.asarray(1.0 / spread),
        quality=quality,
    )


def _verdict(first: str, second: str) -> str:
    parts = [part for text in (first, second) for part in text.split("; ") if part != "good"]
    return "; ".join(dict.fromkeys(parts)) or "good"

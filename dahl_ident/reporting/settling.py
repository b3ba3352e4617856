"""Settling of a point, cycle by cycle, from the waveforms from which it was extracted."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident import plots
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.errors import ValidationError
from dahl_ident.reporting.document import Picture, figure_of
from dahl_ident.reporting.provenance import parts, sources
from dahl_ident.units import percent, si_unit

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record

_INTEGRATIONS = {"displacement": 0, "velocity": 1, "acceleration": 2}


def settling(data: FrequencyResponse, record: Record) -> Picture:
    """Return the figure of the point with the largest ratio of bias to error."""
    _check_origin(data, record)
    points = data.select(harmonic=1)
    assert points.covariance is not None  # extraction gives it
    assert points.amplitude is not None
    error = np.sqrt(0.5 * np.trace(points.covariance, axis1=1, axis2=2))
    excess = np.hypot(points.quality["bias_real"], points.quality["bias_imag"]) / error
    i = int(np.argmax(excess))
    f, dropped = float(points.frequency_hz[i]), int(points.quality["settling_periods"][i])
    start, end = (float(points.quality[name][i]) for name in ("start_time", "end_time"))
    response, mean = cycle_by_cycle(record, f, start - dropped / f, end)
    one_cycle = float(error[i]) * np.sqrt(max(response.size - dropped, 1))
    used = response[dropped:]
    scatter = float(np.std(used) / np.abs(np.mean(used)))
    where = f"{f:.4g} Hz, {points.amplitude[i]:.3g} {si_unit('displacement', data.motion)}"
    return Picture(
        "cycles",
        f"Settling of the point at {where}, which has the largest ratio of bias to error: "
        f"{dropped} of {response.size} cycles are left out. The grey band is two standard "
        "deviations of one cycle.",
        f"The response of the {used.size} cycles used scatters by {percent(scatter)}; the bias is "
        f"{excess[i]:.2g} standard errors.",
        lambda: figure_of(
            plots.plot_cycles(response, mean, left_out=dropped, response_std=one_cycle)
        ),
    )


def cycle_by_cycle(
    record: Record, frequency_hz: float, start: float, end: float
) -> tuple[ComplexArray, FloatArray]:
    """Return dynamic stiffness and mean force of each whole cycle between two times."""
    omega = 2.0 * np.pi * frequency_hz
    edges = start + np.arange(np.floor((end - start) * frequency_hz + 0.5) + 1.0) / frequency_hz
    bounds = np.searchsorted(record.time, edges)
    channels = np.stack([record.motion_samples, record.force_samples], axis=-1)
    cycles = []
    for rows in itertools.starmap(slice, itertools.pairwise(bounds)):
        angle = omega * (record.time[rows] - start)
        design = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)
        offset, cosine, sine = np.linalg.lstsq(design, channels[rows], rcond=None)[0]
        motion, force = cosine - 1j * sine
        cycles.append((force / motion, offset[1]))
    ratio, mean = (np.array(column) for column in zip(*cycles, strict=True))
    return ratio * (1j * omega) ** _INTEGRATIONS[record.motion_channel], mean.real


def _check_origin(data: FrequencyResponse, record: Record) -> None:
    digest = dict(record.provenance or {}).get("sha256")
    known = [source.sha256 for source in sources([data.provenance]) if source.sha256]
    if (
        "start_time" not in data.quality
        or len(parts([data.provenance])) > 1
        or digest not in (*known, None)
    ):
        raise ValidationError(
            "the data were not extracted from this record alone; give the one that they were "
            "extracted from, or none"
        )

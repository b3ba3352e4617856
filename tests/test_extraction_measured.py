"""Measured hysteresis loops of a rotary friction damper; three steady cycles in each file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.extraction import extract
from dahl_ident.extraction.sine_fit import sine_fit, steady_stretch, whole_cycles

MEASURED = Path(os.environ.get("DAHL_IDENT_MEASURED_DATA", "absent")) / "brfd"
INCH, KIP = 0.0254, 4448.2216152605
STEADY_MM = {"0.5in": 12.8, "1in": 25.5, "1.5in": 38.3}
DISTORTED = "1Hz_1.5in"
FILES = [
    *(f"{f}Hz_{a}in" for f in ("0.25", "0.5", "1") for a in ("0.5", "1", "1.5")),
    "2Hz_0.5in",
]
needs_data = pytest.mark.skipif(
    not MEASURED.is_dir(), reason="DAHL_IDENT_MEASURED_DATA names no brfd folder"
)


def measured(name: str) -> Record:
    columns = np.loadtxt(
        MEASURED / f"band30lb_{name}.csv", delimiter=",", skiprows=1, usecols=(0, 1, 2)
    )
    return Record(columns[:, 0], displacement=INCH * columns[:, 1], force=KIP * columns[:, 2])


def loop_area(x: FloatArray, force: FloatArray) -> float:
    """Return the area inside closed loops, by the shoelace formula."""
    return float(0.5 * np.sum(force * (np.roll(x, -1) - np.roll(x, 1))))


@needs_data
@pytest.mark.parametrize("name", FILES)
def test_every_file_gives_its_amplitude_and_loop_area(name: str) -> None:
    record = measured(name)
    data = extract(record)
    quality = data.quality
    assert data.harmonic.tolist() == [1, 3, 5, 7, 9]
    assert data.amplitude is not None
    nominal_hz, level = name.split("Hz_")
    assert data.frequency_hz[0] == pytest.approx(float(nominal_hz), rel=2e-3)
    steady_mm = 31.5 if name == DISTORTED else STEADY_MM[level]
    assert 1e3 * data.amplitude[0] == pytest.approx(steady_mm, rel=0.01)
    assert quality["num_periods"][0] == 3

    used = slice(
        *np.searchsorted(
            record.time, [quality["start_time"][0] - 1e-9, quality["end_time"][0] + 1e-9]
        )
    )
    both = np.stack([record.motion_samples[used], record.force_samples[used]])
    stretch = steady_stretch(record.time[used], both, float(data.omega[0]))
    fit = sine_fit(stretch)
    by_harmonics = sum(
        np.pi * k * (fit.phasors(k)[1] * fit.phasors(k)[0].conj()).imag for k in range(1, 10)
    )
    area = loop_area(*both) / whole_cycles(stretch)
    assert by_harmonics == pytest.approx(area, rel=0.01)

    fundamental = np.pi * data.amplitude[0] ** 2 * data.response[0].imag
    distortion = quality["displacement_distortion"][0]
    if name == DISTORTED:
        assert distortion == pytest.approx(0.11, abs=0.01)
        assert set(quality["verdict"]) == {"displacement distorted 11 %"}
    else:
        assert distortion < 0.02
        assert fundamental == pytest.approx(area, rel=0.02)


@needs_data
def test_covariance_is_said_to_be_spectral_and_is_small() -> None:
    data = extract(measured("0.25Hz_1in"))
    assert set(data.quality["covariance_from"]) == {"spectrum"}
    assert data.covariance is not None
    std = np.sqrt(0.5 * np.trace(data.covariance[0]))
    assert 1e-4 < std / abs(data.response[0]) < 0.02
    assert (data.quality["displacement_steps"] > 1000).all()

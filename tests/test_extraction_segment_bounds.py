"""Ends of segments: cycles that depart go, by amplitude or phase; those of a level stay."""

from typing import Any

import numpy as np
import pytest

import dahl_ident as di
from benchmarks.extraction_validation import one_over_f, white
from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.extraction import extract

RATE = 100.0
HELD = (5.0, 25.0)  # s, at 1 Hz


def spring(phasor, phase, noise):
    """Extract a displacement of about 1 Hz, and a spring's force."""
    time = np.arange(phasor.size) / RATE
    x = phasor * np.cos(2.0 * np.pi * time + phase)
    record = Record(time, displacement=x + noise[0], force=3.0 * x + noise[1])
    return extract(record, harmonics=(1,))


def beyond_held():
    """Return the seconds from where the level was held, 0 in it."""
    time: FloatArray = np.arange(int(30.0 * RATE)) / np.float64(RATE)
    return np.maximum(HELD[0] - time, 0.0) + np.maximum(time - HELD[1], 0.0)


@pytest.mark.parametrize("phase_of_departure", [0.0, np.pi / 2.0, -2.0])
def test_cycles_that_depart_in_amplitude_or_phase_are_left_out(phase_of_departure):
    """By one percent in the first cycle, four in the second: less than a cycle of it stays."""
    departure = 1.0 + 0.01 * beyond_held() ** 2 * np.exp(1j * phase_of_departure)
    rng = np.random.default_rng(1)
    noise = 0.005 * rng.standard_normal((2, departure.size))
    data = spring(np.abs(departure), np.angle(departure), noise)
    assert data.n == 1
    assert HELD[0] - 1.0 < data.quality["start_time"][0] < HELD[0] + 2.1
    assert HELD[1] - 2.1 < data.quality["end_time"][0] < HELD[1] + 1.0


@pytest.mark.parametrize("noise", [white, one_over_f])
def test_a_level_in_noise_loses_nothing(noise):
    rng = np.random.default_rng(2)
    n = int(20.0 * RATE)
    short = 0
    for _ in range(30):
        size = 10.0 ** rng.uniform(-4.0, -1.5)
        both = size * np.stack([noise(rng, n), noise(rng, n)])
        data = spring(np.ones(n), np.full(n, rng.uniform(0.0, 6.0)), both)
        short += int(data.quality["num_periods"][0]) < 20
    assert short <= 1


def test_a_level_that_drifts_slowly_is_kept_whole():
    rng = np.random.default_rng(3)
    n = int(20.0 * RATE)
    drifting = 1.0 + 0.01 * np.linspace(-0.5, 0.5, n)
    data = spring(drifting, np.zeros(n), 1e-4 * rng.standard_normal((2, n)))
    assert data.quality["num_periods"].tolist() == [20]


def test_levels_of_a_plant_end_where_they_were_held():
    """Each is held for 30 periods; a ramp's first cycle and a half may hide in the noise."""
    record: Any = di.load_dataset("plant_recording")
    data = extract(record, controlled="force")
    windows = np.array(record.provenance["windows"])
    loud = windows[:, 0] >= 0.5
    frequency, held_until = windows[loud, 1], windows[loud, 3]
    assert data.n == windows.shape[0]
    early = (held_until - data.quality["start_time"][loud]) * frequency - 30.0
    late = (data.quality["end_time"][loud] - held_until) * frequency
    assert early.max() < 1.7
    assert late.max() < 1.5
    (loudest,) = np.flatnonzero((windows[loud, 0] == 2.0) & (frequency == 5.0))
    assert early[loudest] < 0.0


@pytest.mark.parametrize("size", [0.001, 0.003, 0.01])
def test_a_slow_drift_is_no_ramp(size):
    time = np.arange(int(100.0 * RATE)) / RATE
    drifting = 1.0 + size * np.exp(-time / 20.0)
    noise = 1e-4 * np.random.default_rng(2).standard_normal((2, time.size))
    data = spring(drifting, np.zeros(time.size), noise)
    assert data.quality["end_time"][0] - data.quality["start_time"][0] > 90.0


@pytest.mark.parametrize("size", [0.25, 0.5])
def test_a_phase_that_settles_is_no_wrong_frequency(size):
    time = np.arange(int(100.0 * RATE)) / RATE
    x = np.cos(2.0 * np.pi * time + size * np.exp(-time / 30.0))
    noise = 1e-4 * np.random.default_rng(3).standard_normal((2, time.size))
    record = Record(time, displacement=x + noise[0], force=3.0 * x + noise[1])
    data = extract(record, frequency=1.0, harmonics=(1,))
    assert data.response[0] == pytest.approx(3.0, abs=1e-3)

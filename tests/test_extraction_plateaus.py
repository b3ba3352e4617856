from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dahl_ident.arrays import FloatArray
from dahl_ident.extraction.cycles import cut_cycles, find_cycles
from dahl_ident.extraction.plateaus import Mode, Span, find_spans

RATE = 500.0


def pieces(*parts: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    """Return time and motion of parts (amplitude, frequency in Hz, cycles); 0 Hz: a rest in s."""
    motion = [np.empty(0)]
    for amplitude, frequency, length in parts:
        n = round(RATE * (length / frequency if frequency else length))
        motion.append(amplitude * np.sin(2.0 * np.pi * frequency / RATE * np.arange(n)))
    joined = np.concatenate(motion)
    return np.arange(joined.size) / RATE, joined


def spans(time: FloatArray, motion: FloatArray, mode: Mode = "auto", fewest: int = 3) -> list[Span]:
    return find_spans(find_cycles(time, motion), mode, fewest, None)


@given(
    ratios=st.lists(st.floats(0.1, 2.0), min_size=1, max_size=4),
    down=st.booleans(),
    frequency=st.floats(2.0, 20.0),
    offset=st.floats(-3.0, 3.0),
)
def test_levels_of_any_ratio_are_found(
    ratios: list[float], down: bool, frequency: float, offset: float
) -> None:
    levels = np.exp(np.cumsum([0.0, *ratios]))[:: -1 if down else 1]
    time, motion = pieces(*((float(a), frequency, 12) for a in levels))
    rng = np.random.default_rng(0)
    noisy = motion + offset + 1e-4 * rng.standard_normal(motion.size)
    found = spans(time, noisy, mode="steps")
    assert len(found) == levels.size
    length = 12.0 / frequency
    for i, span in enumerate(found):
        assert span.frequency_hz == pytest.approx(frequency, rel=2e-3)
        assert span.start > i * length - 0.1 / frequency
        assert span.stop < (i + 1) * length + 0.1 / frequency
        assert span.stop - span.start > length - 3.1 / frequency


def test_frequencies_one_after_another() -> None:
    frequencies = [1.0, 1.1, 3.0, 12.0, 40.0, 2.0]
    time, motion = pieces(*((1.0, f, 10) for f in frequencies))
    found = spans(time, motion)
    np.testing.assert_allclose([s.frequency_hz for s in found], frequencies, rtol=3e-3)
    bounds = np.cumsum([0.0] + [10.0 / f for f in frequencies])
    for span, start, stop, f in zip(found, bounds[:-1], bounds[1:], frequencies, strict=True):
        assert start - 0.1 / f <= span.start < start + 2.1 / f
        assert stop - 2.1 / f < span.stop <= stop + 0.1 / f


def test_rests_and_ramps_are_left_out() -> None:
    time, motion = pieces((0, 0, 2.0), (1.0, 5.0, 20), (0, 0, 1.0), (0.2, 5.0, 20), (0, 0, 3.0))
    ramp = np.minimum(1.0, np.abs(np.sin(np.pi * np.minimum(time - 2.0, 4.0) / 4.0)) * 3.0)
    motion = np.where((time > 2.0) & (time < 6.0), ramp, 1.0) * motion
    rng = np.random.default_rng(1)
    found = spans(time, motion + 1e-4 * rng.standard_normal(time.size))
    assert len(found) == 2
    first, second = found
    assert first.start > 2.35
    assert first.stop < 5.65
    assert second.start > 6.9
    assert second.stop < 11.1


@pytest.mark.parametrize("cycles_of_gap", [0.2, 1.0, 7.3])
def test_a_gap_in_the_sampling_does_not_end_a_stretch(cycles_of_gap: float) -> None:
    time, motion = pieces((1.0, 5.0, 40))
    kept = (time < 3.01) | (time > 3.01 + cycles_of_gap / 5.0)
    (span,) = spans(time[kept], motion[kept])
    assert span.stop - span.start > 7.5
    assert span.frequency_hz == pytest.approx(5.0, rel=1e-4)


def test_cycles_have_the_amplitude_and_frequency_of_a_sine_fit() -> None:
    time, motion = pieces((2.0, 3.7, 60))
    rng = np.random.default_rng(2)
    (run,) = find_cycles(time, 5.0 + motion + 0.1 * rng.standard_normal(time.size))
    per_cycle = RATE / 3.7
    expected = 0.05 * np.sqrt(2.0 / per_cycle)
    assert np.median(run.noise) == pytest.approx(expected, rel=0.1)
    assert np.std(run.log_amplitude) == pytest.approx(expected, rel=0.3)
    assert np.mean(run.log_amplitude) == pytest.approx(np.log(2.0), abs=0.003)
    assert np.std(run.log_frequency) == pytest.approx(
        np.sqrt(2.0) * expected / (2.0 * np.pi), rel=0.3
    )


def test_known_frequency_is_cut_through_noise_that_hides_the_crossings() -> None:
    time, motion = pieces((1.0, 5.0, 80))
    rng = np.random.default_rng(3)
    noisy = motion + 0.6 * rng.standard_normal(time.size)
    assert not spans(time, noisy, fewest=6)
    (span,) = find_spans(cut_cycles(time, noisy, 5.0), "auto", 3, None)
    assert span.stop - span.start > 15.0


def test_amplitude_sweep_is_cut_into_windows() -> None:
    time, motion = pieces((1.0, 10.0, 300))
    found = spans(time, motion * np.exp(-time / 8.0))
    assert len(found) > 20
    assert all(s.sweep for s in found)
    for span in found:
        assert (span.stop - span.start) / 8.0 <= 0.11


def test_frequency_sweep_is_cut_into_windows_of_the_wanted_length() -> None:
    time = np.arange(20_000) / RATE
    motion = np.sin(2.0 * np.pi * (2.0 * time + 0.1 * time**2))
    found = find_spans(find_cycles(time, motion), "auto", 3, 6)
    assert all(s.sweep for s in found)
    for span in found:
        middle = 0.5 * (span.start + span.stop)
        assert span.frequency_hz == pytest.approx(2.0 + 0.2 * middle, rel=0.01)
        assert (span.stop - span.start) * span.frequency_hz == pytest.approx(6, abs=0.3)


def test_mode_overrules_what_there_is_more_of() -> None:
    time, motion = pieces((1.0, 10.0, 300))
    swept = motion * np.exp(-time / 8.0)
    assert len(spans(time, swept, mode="steps")) <= 1
    steps = pieces((1.0, 10.0, 20), (0.9, 10.0, 20), (0.8, 10.0, 20))
    assert len(spans(*steps)) == 3
    assert all(s.sweep for s in spans(*steps, mode="sweep"))


@pytest.mark.parametrize("motion", [np.zeros(1000), np.ones(1000), np.arange(1000.0)])
def test_a_record_that_does_not_oscillate_has_no_spans(motion: FloatArray) -> None:
    assert spans(np.arange(1000) / RATE, motion) == []

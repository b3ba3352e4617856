import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dahl_ident.extraction.cycles import find_cycles, find_spans

RATE = 500.0


def pieces(*parts):
    """Return time and motion of parts (amplitude, frequency in Hz, cycles); 0 Hz: a rest in s."""
    motion = [np.empty(0)]
    for amplitude, frequency, length in parts:
        n = round(RATE * (length / frequency if frequency else length))
        motion.append(amplitude * np.sin(2.0 * np.pi * frequency / RATE * np.arange(n)))
    joined = np.concatenate(motion)
    return np.arange(joined.size) / RATE, joined


def spans(time, motion, mode="auto", fewest=3):
    return find_spans(find_cycles(time, motion), mode, fewest, None)


@given(
    ratios=st.lists(st.floats(0.1, 2.0), min_size=1, max_size=4),
    down=st.booleans(),
    frequency=st.floats(2.0, 20.0),
    offset=st.floats(-3.0, 3.0),
)
def test_levels_of_any_ratio_are_found(ratios, down, frequency, offset):
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


def test_frequencies_one_after_another():
    frequencies = [1.0, 1.1, 3.0, 12.0, 40.0, 2.0]
    time, motion = pieces(*((1.0, f, 10) for f in frequencies))
    found = spans(time, motion)
    np.testing.assert_allclose([s.frequency_hz for s in found], frequencies, rtol=3e-3)
    bounds = np.cumsum([0.0] + [10.0 / f for f in frequencies])
    for span, start, stop, f in zip(found, bounds[:-1], bounds[1:], frequencies, strict=True):
        assert start - 0.1 / f <= span.start < start + 2.1 / f
        assert stop - 2.1 / f < span.stop <= stop + 0.1 / f


def test_rests_and_ramps_are_left_out():
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
def test_a_gap_in_the_sampling_does_not_end_a_stretch(cycles_of_gap):
    time, motion = pieces((1.0, 5.0, 40))
    kept = (time < 3.01) | (time > 3.01 + cycles_of_gap / 5.0)
    (span,) = spans(time[kept], motion[kept])
    assert span.stop - span.start > 7.5
    assert span.frequency_hz == pytest.approx(5.0, rel=1e-4)


def test_mode_overrules_what_there_is_more_of():
    time, motion = pieces((1.0, 10.0, 300))
    swept = motion * np.exp(-time / 8.0)
    assert len(spans(time, swept, mode="steps")) <= 1
    steps = pieces((1.0, 10.0, 20), (0.9, 10.0, 20), (0.8, 10.0, 20))
    assert len(spans(*steps)) == 3
    time, motion = steps
    assert all(s.sweep for s in spans(time, motion, mode="sweep"))

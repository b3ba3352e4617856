"""Motion that is not a sine test is refused, and the route for any motion named; sines are not."""

import re

import numpy as np
import pytest

from dahl_ident.data import Record
from dahl_ident.elements import Dahl
from dahl_ident.errors import ExtractionError, arguments_as_options
from dahl_ident.extraction import extract

FRICTION = Dahl(f_max=20.0, sigma=2e4)
RATE = 200.0


def record(x, rate=RATE, start=0.0):
    time = start + np.arange(x.size) / rate
    noise = np.random.default_rng(0).standard_normal(x.size)
    return Record(time, displacement=x, force=FRICTION.force(x) + 0.1 * noise)


def random_motion(seed, low, high):
    n = 12_000
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(n))
    frequency = np.fft.rfftfreq(n, 1.0 / RATE)
    spectrum[(frequency < low) | (frequency > high)] = 0.0
    x = np.fft.irfft(spectrum, n)
    return np.asarray(1e-3 * x / x.std())


def strokes(seed):
    """Return point-to-point motion: trapezoids of velocity, of strokes that differ, with rests."""
    rng = np.random.default_rng(seed)
    velocity = [np.zeros(50)]
    for i in range(30):
        stroke, top, rise = rng.uniform(0.05, 0.25), rng.uniform(0.1, 0.3), 0.2
        length = round((stroke / top + rise) * RATE)
        t = np.arange(length) / RATE
        shape = np.clip(np.minimum(t, t[-1] - t) / rise, 0.0, 1.0)
        velocity += [(-1) ** i * top * shape, np.zeros(rng.integers(10, 60))]
    return np.cumsum(np.concatenate(velocity)) / RATE


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("kind", ["wide", "narrow", "strokes", "there and back"])
def test_any_other_motion_is_refused_and_the_route_named(kind, seed):
    x = {
        "wide": lambda: random_motion(seed, 1.0, 5.0),
        "narrow": lambda: random_motion(seed, 2.0, 3.0),
        "strokes": lambda: strokes(seed),
        "there and back": lambda: np.cumsum(np.clip(np.linspace(3, -3 - seed, 4000), -1, 1)) / RATE,
    }[kind]()
    with pytest.raises(ExtractionError, match=r"^not a sine test(: |, or a)") as refused:
        extract(record(x))
    assert str(refused.value).endswith("fit the waveform itself: di.fit(record, model)")
    assert "min_share" not in str(refused.value)


def test_a_swept_force_that_friction_cannot_follow_is_named_with_the_command():
    t = np.arange(4000) / 100.0
    force = 0.3 * np.sin(2.0 * np.pi * 4.0 * (np.exp(0.075 * t) - 1.0))  # 0.3 to 6 Hz
    x, v, friction = np.zeros(t.size), 0.0, 0.0
    for i in range(1, t.size):  # the plant of Fig. 7, in ten small steps a sample
        x[i] = x[i - 1]
        for push in np.linspace(force[i - 1], force[i], 10):
            v += 1e-3 * (push - friction - 0.24 * v - 0.3 * x[i]) / 0.3
            x[i] += 1e-3 * v
            friction += 1e-3 * v * 30.0 * (1.0 - np.sign(v) * friction / 0.1)
    swept = Record(t, displacement=x, force=force)
    with pytest.raises(ExtractionError, match=r"^not a sine test: ") as refused:
        extract(swept, controlled="force")
    assert "the force is a sweep of one sine" in str(refused.value)
    assert "di.fit(record, model)" in str(refused.value)
    with (
        arguments_as_options(),
        pytest.raises(ExtractionError, match="dahl-ident fit --record FILE"),
    ):
        extract(swept, controlled="force")


def test_levels_far_apart_sweeps_and_a_sine_in_noise_are_sine_tests():
    t = np.arange(12_000) / RATE
    rng = np.random.default_rng(1)
    levels = np.repeat(1e-3 * 0.5 ** np.arange(6), 2000) * np.sin(2.0 * np.pi * t)
    sweep = 1e-3 * np.sin(2.0 * np.pi * (0.5 + 0.02 * t) * t)
    hidden = 1e-3 * (np.sin(2.0 * np.pi * 1.7 * t) + 0.5 * rng.standard_normal(t.size))
    for x in (levels, sweep, hidden):
        force = 3e3 * x + 1e-3 * rng.standard_normal(t.size)
        assert extract(Record(t, displacement=x, force=force), harmonics=[1]).n >= 1
    with pytest.raises(ExtractionError, match=r"^force around .* the fundamental has"):
        extract(Record(t, displacement=hidden, force=rng.standard_normal(t.size)))


def test_times_in_messages_count_from_the_start_of_the_record():
    t = np.arange(4000) / RATE
    rest = 1e-6 * np.sin(2.0 * np.pi * 31.0 * t[:1000])
    x = np.concatenate([np.sin(2.0 * np.pi * t), rest, 0.5 * np.sin(2.0 * np.pi * t)])
    force = np.concatenate([3.0 * x[:5000], np.random.default_rng(0).standard_normal(4000)])
    with pytest.warns(UserWarning, match=r"left out: force around") as said:
        data = extract(Record(1.7e9 + np.arange(9000) / RATE, displacement=x, force=force))
    found = re.search(r"around t = ([0-9.]+) s", str(said[0].message))
    assert 30.0 < float(found[1]) < 40.0
    assert data.quality["start_time"][0] == pytest.approx(1.7e9, abs=2.0)

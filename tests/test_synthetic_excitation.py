"""Excitations: what they do at every instant, and in which order."""

from itertools import pairwise

import numpy as np
import pytest

from dahl_ident.errors import ValidationError
from dahl_ident.synthetic import AmplitudeRamp, FrequencySweep, SteppedSine
from dahl_ident.synthetic.acquisition import Draws

Excitation = AmplitudeRamp | FrequencySweep | SteppedSine
RUNS: list[Excitation] = [
    SteppedSine((1e-3, 2e-3), (2.0, 3.0), settling_periods=3, num_periods=2),
    SteppedSine((2e-3,), (2.0,), settling_periods=1, num_periods=2, rest=0.7),
    FrequencySweep(level=0.1, start_hz=1.0, stop_hz=10.0, duration=5.0),
    FrequencySweep(level=0.1, start_hz=4.0, stop_hz=1.0, duration=5.0, spacing="linear"),
    AmplitudeRamp(start_level=1e-3, stop_level=1.0, frequency_hz=2.0, duration=5.0),
    AmplitudeRamp(1.0, 0.1, frequency_hz=2.0, duration=5.0, spacing="linear"),
]


def interior(run, n, away):
    """Return times that stay away from the ends of the segments."""
    time = np.linspace(0.0, run.duration, n)
    ends = np.array([0.0, *(s.stop for s in run.segments)])
    return np.asarray(time[np.min(np.abs(time[:, None] - ends), axis=1) > away])


@pytest.mark.parametrize("excitation", RUNS, ids=lambda e: type(e).__name__)
def test_velocity_and_acceleration_are_the_derivatives(excitation):
    run = excitation.waveform(seed=0)
    h = 1e-4
    time = interior(run, 2001, 3.0 * h)
    motion = run.motion(time)
    around = [run.value(time + i * h) for i in (-2, -1, 0, 1, 2)]
    slope = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) @ around / (12.0 * h)
    curvature = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) @ around / (12.0 * h**2)
    assert np.max(np.abs(motion.velocity - slope)) < 1e-8 * np.max(np.abs(slope))
    assert np.max(np.abs(motion.acceleration - curvature)) < 1e-5 * np.max(np.abs(curvature))


@pytest.mark.parametrize("excitation", RUNS[:2], ids=["straight on", "with rests"])
def test_smooth_steps_have_no_jump_even_in_acceleration(excitation):
    run = excitation.waveform(seed=0)
    for before, after in pairwise(run.segments):
        end = np.array(before.motion(np.asarray(before.stop)))
        start = np.array(after.motion(np.asarray(after.start)))
        assert end == pytest.approx(start, abs=1e-9)


def test_rests_are_at_rest_and_windows_are_whole_periods_at_the_level():
    excitation = SteppedSine((1e-3, 3e-3), (2.0, 5.0), settling_periods=1, num_periods=4, rest=1.0)
    run = excitation.waveform(seed=0)
    assert [(w.level, w.frequency_hz) for w in run.windows] == excitation.grid(seed=0)
    for window in run.windows:
        assert (window.stop - window.start) * window.frequency_hz == pytest.approx(4.0)
        time = np.linspace(window.start, window.stop, 401)[:-1]
        phasor = 2.0 * np.mean(
            run.value(time) * np.exp(-2j * np.pi * window.frequency_hz * (time - window.start))
        )
        assert abs(phasor) == pytest.approx(window.level, rel=1e-12)
    at_rest = run.windows[0].stop + 2.0 / 2.0 + np.linspace(0.01, 0.99, 20)
    assert np.array_equal(run.value(at_rest), np.zeros(20))


def test_a_waveform_is_still_outside_its_time():
    run = RUNS[2].waveform(seed=0)
    motion = run.motion(np.array([-1.0, run.duration + 1.0]))
    assert motion.value == pytest.approx(run.value(np.array([0.0, run.duration])))
    assert np.array_equal(motion.velocity, np.zeros(2))


@pytest.mark.parametrize("spacing", ["log", "linear"])
def test_a_sweep_passes_its_frequencies_as_its_spacing_says(spacing):
    sweep = FrequencySweep(0.1, 1.0, 16.0, 40.0, spacing=spacing)
    run = sweep.waveform(seed=0)
    turns = run.turning_times()
    middle = 0.5 * (2.0 + run.duration)
    near = turns[np.argsort(np.abs(turns - middle))[:2]]
    expected = 4.0 if spacing == "log" else 8.5
    assert 0.5 / np.ptp(near) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("spacing", ["log", "linear"])
def test_a_ramp_passes_its_levels_as_its_spacing_says(spacing):
    ramp = AmplitudeRamp(0.01, 1.0, 2.0, 40.0, spacing=spacing)
    run = ramp.waveform(seed=0)
    middle = 1.0 + 20.0
    time = np.linspace(middle - 0.25, middle + 0.25, 4001)
    expected = 0.1 if spacing == "log" else 0.505
    assert np.ptp(run.value(time)) / 2.0 == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("excitation", RUNS, ids=lambda e: type(e).__name__)
def test_motion_is_monotone_between_turning_times(excitation):
    run = excitation.waveform(seed=0)
    turns = run.turning_times()
    for a, b in pairwise(turns):
        inside = run.value(np.linspace(a, b, 50))
        step = np.diff(inside)
        assert np.all(step >= -1e-14) or np.all(step <= 1e-14)


def test_orders():
    levels = (2.0, 1.0, 3.0)
    by_order = {
        order: [level for level, _ in SteppedSine(levels, order=order).grid(seed=1)]
        for order in ("given", "ascending", "descending")
    }
    assert by_order == {
        "given": [2.0, 1.0, 3.0],
        "ascending": [1.0, 2.0, 3.0],
        "descending": [3.0, 2.0, 1.0],
    }


def test_random_order_is_a_shuffle_of_the_grid_by_the_seed():
    steps = SteppedSine((1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 5.0), order="random")
    plain = SteppedSine((1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 5.0)).grid(seed=7)
    shuffled = steps.grid(seed=7)
    assert shuffled == steps.grid(seed=7)
    assert shuffled != plain
    assert shuffled != steps.grid(seed=8)
    assert sorted(shuffled) == sorted(plain)


def test_draws_depend_on_seed_and_purpose_alone():
    first = Draws(1).normal("noise", 1000)
    assert np.array_equal(first[:10], Draws(1).normal("noise", 10))
    assert not np.allclose(first[:10], Draws(2).normal("noise", 10))
    assert not np.allclose(first[:10], Draws(1).normal("hum", 10))
    assert np.mean(first) == pytest.approx(0.0, abs=0.1)
    assert np.std(first) == pytest.approx(1.0, abs=0.08)


def test_draws_are_the_same_on_every_platform():
    # PCG64's bits are fixed by its definition, the rest by the inverse normal distribution
    expected = [
        0.17162904768012333,
        -0.47296907662585386,
        -0.12420441106165048,
        -1.0140701443319222,
    ]
    assert Draws(20).normal("noise", 4) == pytest.approx(np.array(expected), rel=1e-12)


@pytest.mark.parametrize("n", [4096, 4095])
def test_flicker_noise_falls_as_one_over_f(n):
    noise = np.array([Draws(seed).flicker("flicker", n) for seed in range(200)])
    assert np.mean(noise**2) == pytest.approx(1.0, rel=0.03)
    power = np.mean(np.abs(np.fft.rfft(noise, axis=1)) ** 2, axis=0)
    lines = np.arange(power.size)
    low = power[8:16] @ lines[8:16] / 8.0
    high = power[1000:1400] @ lines[1000:1400] / 400.0
    assert high == pytest.approx(low, rel=0.1)
    assert power[0] == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"levels": ()}, r"levels: expected some numbers, got shape \(0,\)"),
        ({"levels": (1.0, -2.0)}, r"levels\[1\] is -2.0; expected numbers > 0"),
        ({"levels": (1.0,), "frequencies_hz": (0.0,)}, r"frequencies_hz\[0\] is 0.0"),
        ({"levels": (1.0,), "order": "up"}, "order is 'up'; expected one of given, ascending"),
        ({"levels": (1.0,), "controlled": "x"}, "controlled is 'x'; expected one of"),
        ({"levels": (1.0,), "num_periods": 0}, "num_periods is 0; expected a whole number >= 1"),
        ({"levels": (1.0,), "settling_periods": 1.5}, "settling_periods is 1.5"),
        ({"levels": (1.0,), "ramp_periods": -1.0}, "ramp_periods is -1.0; expected numbers >= 0"),
        ({"levels": (1.0,), "rest": float("nan")}, "rest is nan"),
    ],
)
def test_bad_steps_are_refused_by_name(arguments, message):
    with pytest.raises(ValidationError, match=message):
        SteppedSine(**arguments)


def test_bad_sweeps_and_ramps_are_refused_by_name():
    with pytest.raises(ValidationError, match="stop_hz is 0"):
        FrequencySweep(1.0, 1.0, 0.0, 10.0)
    with pytest.raises(ValidationError, match="spacing is 'cubic'; expected one of linear, log"):
        AmplitudeRamp(1.0, 2.0, 1.0, 10.0, spacing="cubic")  # type: ignore[arg-type]

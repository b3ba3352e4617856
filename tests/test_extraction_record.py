import re
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.extraction_validation import accuracy, one_over_f, steady, white
from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.elements import Dahl, Damper, Mass
from dahl_ident.errors import DahlIdentError, ExtractionError, ValidationError
from dahl_ident.extraction import extract
from dahl_ident.synthetic import Acquisition, Channel, Experiment, SteppedSine, Table, simulate

RATE = 200.0
FRICTION = Dahl(f_max=1.0, sigma=1.0)


@dataclass(frozen=True)
class Waves:
    """Steady waveforms of one level, with a little noise."""

    time: FloatArray
    displacement: FloatArray
    force: FloatArray

    def record(self):
        return Record(self.time, displacement=self.displacement, force=self.force)


def waves(beta=2.0, cycles=20.0, noise=1e-4, frequency=1.0):
    rng = np.random.default_rng(6)
    time = np.arange(round(cycles * RATE / frequency), dtype=np.float64) / RATE
    x, force = steady(beta, 0.4 + 2.0 * np.pi * frequency * time)
    return Waves(
        time,
        x + beta * noise * rng.standard_normal(time.size),
        force + noise * rng.standard_normal(time.size),
    )


def assert_near_truth(data, sigmas=4.0):
    """Check every row against the exact response at its amplitude."""
    for row in range(data.n):
        a, b = FRICTION.fourier_coefficients(data.amplitude[row], int(data.harmonic[row]))
        error = abs(data.response[row] - complex(a - 1j * b) / data.amplitude[row])
        assert error < sigmas * np.sqrt(np.trace(data.covariance[row])) + 1e-6


@pytest.mark.parametrize("noise", [white, one_over_f])
@pytest.mark.parametrize(
    "beta", [3.0, *(pytest.param(b, marks=pytest.mark.long) for b in (0.3, 30.0))]
)
def test_unbiased_and_as_accurate_as_stated(noise, beta):
    kind = white if noise is white else one_over_f
    result = accuracy(beta, kind, 40, seed=20, cycles=8)
    assert result.bias < 3.5
    assert result.coverage >= 0.88
    if noise is white:
        assert result.efficiency < 1.05 + 2.0 / (2.0 * np.sqrt(40))


def test_rows_for_harmonics_amplitude_and_drive():
    data = extract(waves().record())
    assert data.harmonic.tolist() == [1, 3, 5, 7, 9]
    assert data.quantity == "dynamic_stiffness"
    np.testing.assert_allclose(data.amplitude, 2.0, rtol=1e-4)
    np.testing.assert_allclose(data.drive, abs(data.response[0]) * data.amplitude, rtol=1e-12)
    np.testing.assert_allclose(data.frequency_hz, 1.0, rtol=1e-6)
    assert data.quality["verdict"].tolist() == ["good"] * 5
    assert_near_truth(data)


@given(
    shift=st.floats(-1e3, 1e3),
    force_scale=st.floats(1e-6, 1e6),
    displacement_scale=st.floats(1e-9, 1e3),
)
@settings(max_examples=15)
def test_units_and_the_clock_do_not_matter(shift, force_scale, displacement_scale):
    w = waves(cycles=6, noise=1e-3)
    once = extract(w.record(), harmonics=(1, 3))
    x, force = displacement_scale * w.displacement, force_scale * w.force
    again = extract(Record(w.time + shift, displacement=x, force=force), harmonics=(1, 3))
    scale = force_scale / displacement_scale
    np.testing.assert_allclose(again.response / scale, once.response, rtol=1e-6)
    np.testing.assert_allclose(again.covariance / scale**2, once.covariance, rtol=1e-3, atol=1e-14)


@pytest.mark.parametrize("channel", ["velocity", "acceleration"])
def test_velocity_and_acceleration_are_integrated(channel):
    w = waves(noise=0.0)
    omega = 2.0 * np.pi
    theta = 0.4 + omega * w.time
    rng = np.random.default_rng(1)
    motion = -2.0 * omega * np.sin(theta) if channel == "velocity" else -w.displacement * omega**2
    noisy: Any = {channel: motion + 1e-3 * rng.standard_normal(theta.size)}
    force = w.force + 1e-4 * rng.standard_normal(theta.size)
    data = extract(Record(w.time, force=force, **noisy))
    assert data.amplitude[0] == pytest.approx(2.0, rel=1e-4)
    assert_near_truth(data)


def test_shared_error_of_amplitude_and_response():
    rng = np.random.default_rng(12)
    w = waves(noise=0.0, cycles=10)
    amplitudes, responses, stated, stds = [], [], [], []
    for _ in range(100):
        x = w.displacement + 0.05 * rng.standard_normal(w.time.size)
        force = w.force + 0.001 * rng.standard_normal(w.time.size)
        data = extract(Record(w.time, displacement=x, force=force), harmonics=(1, 3))
        amplitudes.append(data.amplitude[0])
        responses.append(data.response)
        stds.append(data.amplitude_std[0])
        stated.append(data.amplitude_covariance)
    error = np.array(amplitudes) - np.mean(amplitudes)
    spread = np.std(error)
    assert spread == pytest.approx(np.mean(stds), rel=0.2)
    together = np.mean(error[:, None] * np.array(responses), axis=0)
    found = np.stack([together.real, together.imag], axis=1)
    np.testing.assert_allclose(found[0], np.mean(stated, axis=0)[0], rtol=0.4)
    assert np.abs(found[1] - np.mean(stated, axis=0)[1]).max() < 0.5 * np.abs(found[1]).max()


def test_an_ideal_spring_without_noise_is_extracted_exactly():
    time = np.arange(4000) / RATE
    x = np.sin(2.0 * np.pi * 1.1 * time)
    data = extract(Record(time, displacement=x, force=3.0 * x))
    np.testing.assert_allclose(data.response[0], 3.0, rtol=1e-12)
    np.testing.assert_allclose(data.response[1:], 0.0, atol=1e-9)


def test_jitter_gaps_and_missing_samples_are_taken_as_they_are():
    rng = np.random.default_rng(4)
    n = 4000
    time = np.arange(n) / RATE + rng.uniform(-0.002, 0.002, n)
    kept = (rng.random(n) > 0.15) & ((time < 7.2) | (time > 9.9))
    x, force = steady(2.0, 0.1 + 2.0 * np.pi * 1.03 * time)
    noisy = force + 1e-3 * rng.standard_normal(n)
    data = extract(Record(time[kept], displacement=x[kept], force=noisy[kept]))
    assert data.n == 5
    assert data.quality["num_periods"][0] == 20
    assert_near_truth(data)


def test_known_frequency_reads_a_sine_buried_in_noise():
    w = waves(cycles=200)
    rng = np.random.default_rng(5)
    x = w.displacement + 3.0 * rng.standard_normal(w.time.size)
    record = Record(w.time, displacement=x, force=w.force)
    with pytest.raises(ExtractionError, match="one dominant sine"):
        extract(record, frequency=1.0)
    data = extract(record, frequency=1.0, min_share=0.1, harmonics=(1,))
    assert data.frequency_hz.tolist() == pytest.approx([1.0], rel=1e-14)
    assert_near_truth(data)


@pytest.mark.parametrize(
    ("given", "cycles", "noise"), [(1.01, 20, 1e-4), (0.99, 40, 0.1), (1.002, 60, 1e-3)]
)
def test_a_given_frequency_that_is_wrong_is_refused_with_the_true_one(given, cycles, noise):
    record = waves(cycles=cycles, noise=noise).record()
    with pytest.raises(ExtractionError, match=rf"not the given {given:g} Hz: its phase") as caught:
        extract(record, frequency=given)
    advised = re.search(r"give frequency=([0-9.]+), or leave it out", str(caught.value))
    assert float(advised[1]) == pytest.approx(1.0, abs=0.03 / cycles)
    assert_near_truth(extract(record, frequency=float(advised[1]), harmonics=(1,)))


def test_drift_is_given_in_radians_over_the_cycles():
    """At 1.01 Hz a sine of 1 Hz falls back by 2 pi/1.01 a hundredth of a cycle each cycle."""
    with pytest.raises(ExtractionError, match=r"has (0\.99|1\.00)\d* Hz") as caught:
        extract(waves(cycles=50).record(), frequency=1.01)
    found = re.search(r"drifts by (-[0-9.]+) rad in (\d+) cycles", str(caught.value))
    expected = -2.0 * np.pi * 0.01 / 1.01 * int(found[2])
    assert float(found[1]) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("noise", [white, one_over_f])
def test_a_given_frequency_that_is_right_is_never_refused(noise):
    rng = np.random.default_rng(8)
    for _ in range(60):
        cycles = int(rng.integers(4, 40))
        n = cycles * 50
        x, force = steady(2.0, rng.uniform(0.0, 6.0) + 2.0 * np.pi / 50.0 * np.arange(float(n)))
        x = x + 10.0 ** rng.uniform(-3.0, 0.3) * noise(rng, n)
        record = Record(np.arange(n) / 50.0, displacement=x, force=force)
        assert extract(record, frequency=1.0, harmonics=(1,), min_share=0.0).n >= 1


def test_noise_that_hides_the_crossings_leaves_the_strongest_line():
    w = waves(cycles=60)
    rng = np.random.default_rng(5)
    x = w.displacement + 0.5 * rng.standard_normal(w.time.size)
    data = extract(Record(w.time, displacement=x, force=w.force), harmonics=(1,))
    assert data.n == 1
    assert data.quality["num_periods"][0] >= 55
    assert_near_truth(data)


def test_stepped_levels_and_a_sweep_give_a_series_of_points():
    time = np.arange(60_000) / 1000.0
    frequency = 1.0 + 0.1 * time
    theta = 2.0 * np.pi * (time + 0.05 * time**2)
    x, force = steady(2.0, theta)
    rng = np.random.default_rng(2)
    noisy = force + 1e-3 * rng.standard_normal(time.size)
    data = extract(Record(time, displacement=x, force=noisy), harmonics=(1,))
    assert data.n > 15
    middle = 0.5 * (data.quality["start_time"] + data.quality["end_time"])
    np.testing.assert_allclose(data.frequency_hz, np.interp(middle, time, frequency), rtol=2e-3)
    assert data.quality["settled"].mean() > 0.8
    assert_near_truth(data, sigmas=5.0)


def test_an_amplitude_sweep_that_is_too_fast_says_so():
    time = np.arange(16 * 20_000) / 16_000.0
    x = 3.0 * np.exp(-time / 10.0) * np.sin(2.0 * np.pi * 5.0 * time)
    force = FRICTION.force(x)
    rng = np.random.default_rng(2)
    noisy = force[::16] + 1e-3 * rng.standard_normal(20_000)
    data = extract(Record(time[::16], displacement=x[::16], force=noisy), harmonics=(1,))
    assert data.n > 10
    error = np.abs(data.response - FRICTION.describing_function(data.amplitude))
    assert (error < 0.01 * np.abs(data.response)).all()
    bias = np.hypot(data.quality["bias_real"], data.quality["bias_imag"])
    assert (error < bias).mean() > 0.9
    said = r"swept too fast to settle, biased by about ([0-9.]+) %"
    found = [re.fullmatch(said, verdict) for verdict in data.quality["verdict"].tolist()]
    stated = [match[1] for match in found if match is not None]
    assert len(stated) == data.n
    np.testing.assert_allclose(np.array(stated, float), 100 * bias / data.gain, rtol=0.06)


def test_num_periods_and_settling_periods():
    record = waves(cycles=20).record()
    data = extract(record, num_periods=12, settling_periods=4, harmonics=(1,))
    assert data.quality["num_periods"].tolist() == [12]
    assert data.quality["settling_periods"].tolist() == [4]
    assert data.quality["end_time"][0] == pytest.approx(20.0 - 1.0 / RATE)
    assert data.quality["start_time"][0] == pytest.approx(12.0, abs=1.5 / RATE)
    assert data.quality["covariance_from"].tolist() == ["cycles"]
    few = extract(record, num_periods=3, harmonics=(1,))
    assert few.quality["covariance_from"].tolist() == ["spectrum"]
    with pytest.raises(ExtractionError, match=r"5 cycles .* 4 of them for settling"):
        extract(record, num_periods=5, settling_periods=4)


def test_distortion_is_measured_and_said():
    w = waves()
    bent = w.displacement + 0.1 * np.sin(2.0 * (0.4 + 2.0 * np.pi * w.time))
    data = extract(Record(w.time, displacement=bent, force=w.force), harmonics=(1,))
    assert data.quality["displacement_distortion"][0] == pytest.approx(0.05, rel=1e-2)
    assert data.quality["verdict"].tolist() == ["displacement distorted 5 %"]
    clean = extract(w.record(), harmonics=(1,))
    assert clean.quality["displacement_distortion"][0] < 1e-4


@pytest.mark.parametrize("third", [0.0, 0.1])
def test_noise_is_not_taken_for_a_distortion_of_the_force(third):
    w, rng = waves(cycles=60.0), np.random.default_rng(2)
    phase = 2.0 * np.pi * w.time
    force = np.sin(phase) + third * np.sin(3.0 * phase) + 0.3 * rng.standard_normal(phase.size)
    record = Record(w.time, displacement=np.sin(phase - 0.3), force=force)
    data = extract(record, harmonics=(1,), controlled="force")
    assert data.quality["force_share"][0] < 0.93
    assert data.quality["force_distortion"][0] == pytest.approx(third, abs=0.02)


def test_harmonics_of_a_displacement_under_a_held_force_are_rows_of_receptance():
    plant = Dahl(0.1, 30.0) + Mass(0.3) + Damper(0.24)
    steps = SteppedSine((0.08, 0.4), controlled="force", settling_periods=30, num_periods=20)
    noisy = Acquisition(200.0, Channel(noise_std=2e-6), Channel(noise_std=2e-5))
    record: Any = simulate(Experiment(plant, steps, noisy), seed=2)
    data = extract(record, controlled="force", harmonics=(1, 3, 5))
    exact = simulate(Experiment(plant, steps, table=Table(harmonics=(1, 3, 5))), seed=2)
    assert (data.quantity, set(data.quality["verdict"])) == ("receptance", {"good"})
    assert data.harmonic.tolist() == exact.harmonic.tolist() == [1, 3, 5] * 2
    off = data.response - exact.response
    parts = np.stack([off.real, off.imag], -1)
    chi = np.einsum("ni,nij,nj->n", parts, np.linalg.inv(data.covariance), parts) / 2.0
    assert chi.max() < 8.0  # F(2, dof) is above it once in 2,000 rows
    assert 0.2 < chi.mean() < 2.5
    moving = np.gradient(record.motion_samples, record.time)
    by_velocity = Record(record.time, velocity=moving, force=record.force)
    with pytest.raises(ExtractionError, match="the mean of a displacement is not known from its v"):
        extract(by_velocity, controlled="force", harmonics=(0, 1))


def test_distortion_of_an_acceleration_is_that_of_the_displacement():
    w = waves()
    omega = 2.0 * np.pi
    acceleration = -(omega**2) * (w.displacement + 4.0 * 0.1 * np.sin(2.0 * omega * w.time))
    data = extract(Record(w.time, acceleration=acceleration, force=w.force), harmonics=(1,))
    assert data.quality["displacement_distortion"][0] == pytest.approx(0.05, rel=1e-2)


def test_a_turned_sign_creates_energy():
    w = waves(noise=1e-3)
    turned = extract(Record(w.time, displacement=w.displacement, force=-w.force))
    assert set(turned.quality["verdict"]) == {"creates energy: a sign is reversed"}
    theta = 2.0 * np.pi * w.time
    rng = np.random.default_rng(3)
    verdicts = []
    for _ in range(40):
        x, force = np.sin(theta) + 1e-3 * rng.standard_normal((2, theta.size))
        data = extract(Record(w.time, displacement=x, force=force), harmonics=(1,))
        verdicts += data.quality["verdict"].tolist()
    assert verdicts.count("good") >= 39


def test_quantisation_is_reported_in_steps_of_the_sensor():
    w = waves()
    x = np.round(w.displacement / 0.3) * 0.3
    force = np.round(w.force / 0.01) * 0.01
    data = extract(Record(w.time, displacement=x, force=force), harmonics=(1,))
    assert data.quality["displacement_steps"][0] == pytest.approx(2.0 / 0.3, rel=0.05)
    assert data.quality["force_steps"][0] == pytest.approx(data.drive[0] / 0.01, rel=0.05)
    assert "displacement only 6.7 sensor steps" in data.quality["verdict"][0]
    assert np.isinf(extract(w.record(), harmonics=(1,)).quality["force_steps"][0])


def test_clipping_is_reported():
    w = waves(noise=1e-3)
    clipped = Record(
        w.time, displacement=np.clip(w.displacement, -1.9, 9.0), force=np.clip(w.force, -9.0, 0.6)
    )
    quality = extract(clipped, harmonics=(1,)).quality
    assert quality["displacement_clipped"][0] == pytest.approx(np.arccos(0.95) / np.pi, abs=0.01)
    assert quality["force_clipped"][0] == pytest.approx(np.mean(w.force > 0.6), abs=0.03)
    assert "displacement clipped in 10 % of samples" in quality["verdict"][0]
    for good in (w, waves(beta=50.0, noise=0.0)):  # a force that saturates is not clipped
        clean = extract(good.record(), harmonics=(1,)).quality
        assert clean["displacement_clipped"][0] == clean["force_clipped"][0] == 0.0


def test_labels_and_origin_are_kept():
    w = waves()
    record = Record(
        w.time, displacement=w.displacement, drive=w.force / 2.0, drive_unit="V", drive_factor=2.0,
        motion="rotation", provenance={"file": "run07.csv"},
    )  # fmt: skip
    data = extract(record, level="2 mm", controlled="force", harmonics=(1,))
    assert data.motion == "rotation"
    assert data.level.tolist() == ["2 mm"]
    assert data.controlled.tolist() == ["force"]
    assert data.provenance["file"] == "run07.csv"
    assert data.provenance["extraction"]["harmonics"] == [1]
    assert_near_truth(data)


@pytest.mark.parametrize(("seed", "n"), [(10, 16626), (16, 3314), (28, 10796)])
def test_noise_is_no_sine_however_often_two_cycles_of_it_look_alike(seed, n):
    motion, force = np.random.default_rng(seed).standard_normal((2, n))
    with pytest.raises(ExtractionError, match=r"^not a sine test: "):
        extract(Record(np.arange(n) / 1000.0, displacement=motion, force=force))


TURN = 2.0 * np.pi * np.arange(4000) / RATE


@pytest.mark.parametrize(
    ("motion", "force", "message"),
    [
        (np.sin(TURN) + np.sin(2.6 * TURN), np.sin(TURN) + np.sin(2.6 * TURN),
         r"fundamental has \d+(\.\d)? % of the power"),
        (np.sin(TURN), np.random.default_rng(0).standard_normal(4000),
         r"force around t = .* has 0\.\d+ % of the power"),
        (1e-6 * np.round(0.51 * np.sin(TURN)), np.sin(TURN),
         r"displacement .* sensor steps \(of 1e-06\)"),
        (np.sin(TURN), np.zeros(4000), r"force around .*: amplitude 0 is 0 sensor steps"),
    ],
    ids=["two tones", "a force of noise", "less than a step", "a dead force"],
)  # fmt: skip
def test_what_is_no_sine_is_refused(motion, force, message):
    with pytest.raises(ExtractionError, match=message):
        extract(Record(np.arange(4000) / RATE, displacement=motion, force=force), frequency=1.0)


@pytest.mark.parametrize(
    ("motion", "mode", "message"),
    [
        (np.zeros(400), "auto", "no segment of constant amplitude and frequency in 1.995 s: 0"),
        (np.linspace(0.0, 1.0, 400), "auto", "not a sine test, or a record too short for one"),
        (np.sin(0.02 * np.arange(400)), "auto", "not a sine test, or a record too short for one"),
        (np.sin(0.1 * np.arange(400)), "sweep", "no segment of constant"),
    ],
)
def test_records_without_cycles_are_refused(motion, mode, message):
    record = Record(np.arange(400) / RATE, displacement=motion, force=motion)
    with pytest.raises(ExtractionError, match=message):
        extract(record, mode=mode)


def test_one_bad_stretch_is_left_out_with_a_warning():
    good = waves(cycles=15)
    rng = np.random.default_rng(1)
    x = np.concatenate([good.displacement, np.zeros(300), 0.5 * good.displacement])
    force = np.concatenate([good.force, np.zeros(300), rng.standard_normal(good.force.size)])
    record = Record(np.arange(x.size) / RATE, displacement=x, force=force)
    with pytest.warns(UserWarning, match="left out: force around t = "):
        data = extract(record, harmonics=(1,))
    assert data.n == 1
    assert len(data.provenance["extraction"]["refused"]) == 1


@given(
    seed=st.integers(0, 10**6),
    samples=st.integers(2, 600),
    steps=st.sampled_from(["even", "jitter", "gaps", "wild"]),
    motion=st.sampled_from(["sine", "noise", "walk", "chirp", "steps", "nothing"]),
    force=st.sampled_from(["cube", "other", "noise", "nothing", "tiny"]),
    frequency=st.one_of(st.none(), st.floats(1e-4, 1.0)),
    mode=st.sampled_from(["auto", "steps", "sweep"]),
    min_share=st.sampled_from([0.6, 0.0]),
)
@settings(max_examples=150)
def test_any_record_gives_points_or_a_named_error(
    seed, samples, steps, motion, force, frequency, mode, min_share
):
    rng = np.random.default_rng(seed)
    step = {
        "even": np.ones(samples),
        "jitter": rng.uniform(0.1, 2.0, samples),
        "gaps": np.where(rng.random(samples) < 0.02, 50.0, 1.0),
        "wild": 10.0 ** rng.uniform(-6.0, 3.0, samples),
    }[steps]
    time = np.cumsum(step)
    theta = 2.0 * np.pi * 10.0 ** rng.uniform(-3.0, -0.3) * time / np.median(step)
    x = {
        "sine": np.sin(theta),
        "noise": rng.standard_normal(samples),
        "walk": np.cumsum(rng.standard_normal(samples)),
        "chirp": np.sin(theta * np.arange(samples) / samples),
        "steps": np.round(1.5 * np.sin(theta)),
        "nothing": np.zeros(samples),
    }[motion]
    f = {
        "cube": x**3,
        "other": np.sin(0.7 * theta),
        "noise": rng.standard_normal(samples),
        "nothing": np.zeros(samples),
        "tiny": 1e-90 * x,
    }[force]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).*left out")
        try:
            data = extract(
                Record(time, displacement=x, force=f),
                frequency=frequency, mode=mode, min_share=min_share,
            )  # fmt: skip
        except DahlIdentError:
            return
    assert np.isfinite(data.covariance).all()
    assert (data.dof > 0.0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "chirp"}, "mode is 'chirp'; expected one of auto, steps, sweep"),
        ({"frequency": -1.0}, "frequency is -1.0; expected numbers > 0"),
        ({"frequency": 1e39}, r"the number of cycles is \d{39,}; expected a whole number <= "),
        ({"num_periods": 1}, "num_periods is 1"),
        ({"settling_periods": -1}, "settling_periods is -1"),
        ({"harmonics": (1, 11)}, r"harmonics is \[1, 11\]; expected different numbers from 0 to 9"),
        ({"harmonics": 3}, "harmonics is 3; expected several numbers"),
        ({"min_share": "0.5"}, "min_share: expected real numbers, got '0.5'"),
        ({"columns": {"time": "t"}}, "columns is given for a record; expected it where the file"),
        ({"harmonics": ()}, r"harmonics is \[\]; expected"),
        ({"harmonics": (3, 3)}, r"harmonics is \[3, 3\]; expected different"),
        ({"controlled": "velocity"}, "controlled is 'velocity'; expected"),
        ({"min_share": 1.0}, "min_share is 1.0; expected a share from 0 to below 1"),
    ],
)
def test_arguments_are_checked(options, message):
    with pytest.raises(ValidationError, match=message):
        extract(waves(cycles=4).record(), **options)


def test_a_drive_without_a_factor_is_no_force():
    w = waves(cycles=4)
    record = Record(w.time, displacement=w.displacement, drive=w.force)
    with pytest.raises(ValidationError, match="drive_factor"):
        extract(record)


def test_harmonics_by_default_are_those_that_the_control_leaves_to_friction():
    record = waves().record()
    held = extract(record)
    assert sorted(set(held.harmonic.tolist())) == [1, 3, 5, 7, 9]
    driven = extract(record, controlled="force")
    assert set(driven.harmonic.tolist()) == {1}


def test_a_mean_that_moves_beyond_its_error_is_not_settled():
    # the drift d of n samples with errors s has the standard deviation s sqrt(12/n)
    n, s = 1000, 0.05
    error = s * np.sqrt(12.0 / n)
    time = np.arange(n) / 50.0
    wave = np.sin(2.0 * np.pi * time - 0.5)

    def settled(drift, seed):
        noise = s * np.random.default_rng(seed).standard_normal(n)
        moved = wave + drift * (np.arange(n) / n - 0.5) + noise
        record = Record(time, displacement=1e-3 * moved, force=np.sin(2.0 * np.pi * time))
        return bool(extract(record, controlled="force").quality["settled"][0])

    assert all(settled(0.0, seed) for seed in range(12))
    assert not any(settled(sign * 20.0 * error, seed) for seed in range(3) for sign in (-1, 1))


@pytest.mark.parametrize("distortion", [0.01, 0.05])
def test_harmonics_state_what_those_of_the_displacement_add(distortion):
    """Against the harmonics of a sine: errors of the size that is stated, over phases and sizes."""
    law, t = Dahl(f_max=0.1, sigma=30.0), np.arange(12_000) / 1000.0
    ratios = []
    for amplitude in (2e-3, 1e-2, 1e-1):
        for phase in np.linspace(0.0, 2.0 * np.pi, 5, endpoint=False).tolist():
            third = distortion * np.cos(3.0 * 2.0 * np.pi * t + phase)
            x = amplitude * (np.cos(2.0 * np.pi * t) + third)
            data = extract(
                Record(t, displacement=x, force=law.force(x)), frequency=1.0, settling_periods=2
            )
            for row in np.flatnonzero(data.harmonic > 1).tolist():
                exact = law.dynamic_stiffness(amplitude, harmonic=int(data.harmonic[row]))
                stated = np.sqrt(np.trace(data.covariance[row]))
                ratios.append(abs(data.response[row] - exact) / stated)
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    assert max(ratios) < 3.0

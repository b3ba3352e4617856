"""Experiments: their description, their sensors, their tables, and that a seed fixes them."""

import json
from dataclasses import FrozenInstanceError, replace

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring, response
from dahl_ident.errors import DahlIdentError, DataError, ModelError, ValidationError
from dahl_ident.sensors import Sensors
from dahl_ident.synthetic import (
    Acquisition,
    AmplitudeRamp,
    Channel,
    Experiment,
    FrequencySweep,
    SteppedSine,
    Table,
    simulate,
)

FRICTION = Dahl(0.1, 30.0)
PLANT = FRICTION + Mass(0.3) + Damper(0.24) + Spring(0.3)
STEPS = SteppedSine((1e-3, 1e-2), (2.0,), settling_periods=2, num_periods=2)


TIME = np.arange(6_001) / 1000.0
TRUE = STEPS.waveform(0).value(TIME)


def made(*arguments, seed=1, **options):
    """Return what an experiment gives."""
    return simulate(Experiment(*arguments, **options), seed=seed)


def displacement(channel):
    """Return what one displacement channel adds to or takes from the true motion."""
    return made(FRICTION, STEPS, Acquisition(1000.0, displacement=channel)).displacement - TRUE


# --- the description


EXPERIMENTS = [
    Experiment(FRICTION, STEPS),
    Experiment(FRICTION, replace(STEPS, order="random"), table=Table(0.01, 0.02, (1, 3))),
    Experiment(
        PLANT,
        FrequencySweep(0.1, 1.0, 10.0, 20.0),
        Acquisition(200.0, Channel(antialias_hz=50.0, limit=2.0), Channel(gain=1.1), 1e-4, 0.01),
        motion="rotation",
    ),
    Experiment(
        Dahl(0.1, 30.0, 2.0, name="a") + Dahl(0.2, 3.0, name="b") + Spring(0.3),
        AmplitudeRamp(1e-3, 1e-1, 1.0, 20.0),
    ),
    Experiment(
        FRICTION + LinearSystem(control.tf([1.0], [0.3, 0.24, 0.3]), quantity="receptance"),
        replace(STEPS, controlled="force"),
    ),
]


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids=range(len(EXPERIMENTS)))
def test_a_description_survives_json_toml_and_files(experiment, tmp_path):
    assert Experiment.from_dict(experiment.to_dict()) == experiment
    assert Experiment.from_json(experiment.to_json()) == experiment
    assert Experiment.from_toml(str(experiment)) == experiment
    assert hash(Experiment.from_toml(str(experiment))) == hash(experiment)
    for name, text in (("a.json", experiment.to_json()), ("a.toml", experiment.to_toml())):
        (tmp_path / name).write_text(text)
        assert Experiment.read(tmp_path / name) == experiment


def test_experiments_differ_where_a_number_does():
    assert len(set(EXPERIMENTS)) == len(EXPERIMENTS)
    assert Experiment(Dahl(0.1, 30.0), STEPS) != Experiment(Dahl(0.1, 30.000001), STEPS)
    assert Experiment(FRICTION, STEPS) != "an experiment"


def test_a_description_is_frozen():
    with pytest.raises(FrozenInstanceError):
        EXPERIMENTS[0].motion = "rotation"  # type: ignore[misc]


def test_what_a_file_leaves_out_has_its_default():
    text = """
    [[plant]]
    kind = "dahl"
    f_max = 0.1
    sigma = 30.0

    [excitation]
    kind = "stepped_sine"
    levels = [1e-3, 1e-2]
    frequencies_hz = [2.0]
    settling_periods = 2
    num_periods = 2
    """
    assert Experiment.from_toml(text) == EXPERIMENTS[0]


def description(**changes):
    return EXPERIMENTS[0].to_dict() | changes


@pytest.mark.versions
@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"plant": []}, "the experiment has no excitation; expected plant, excitation"),
        (description(sensor=1), "the experiment: unknown entry 'sensor'; expected plant"),
        (description(excitation={"levels": [1.0]}), "the excitation has the kind None"),
        (
            description(excitation={"kind": "stepped_sine", "level": 1.0}),
            "the excitation: unknown entry 'level'; expected levels, .*did you mean 'levels'",
        ),
        (
            description(acquisition={"force": {"noise": 1.0}}),
            "acquisition.force: unknown entry 'noise'",
        ),
        (
            description(acquisition={"force": {"noise_std": -1.0}}),
            "acquisition.force: noise_std is -1.0; expected numbers >= 0",
        ),
        (description(acquisition=3), "acquisition is 3; expected a table of named values"),
        (description(table={"std": 0.1}), "table: unknown entry 'std'; expected displacement_std"),
    ],
)
def test_a_bad_description_names_the_key(data, message):
    with pytest.raises(DataError, match=message):
        Experiment.from_dict(data)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("none.toml", None, "the file cannot be read: No such file"),
        ("run.yaml", None, r"expected an experiment in \.toml or \.json"),
        ("a.toml", "plant = [", "the experiment is not TOML"),
        ("a.json", "{", "the experiment is not JSON"),
        ("d.json", "[" * 100_000, "the experiment is not JSON: maximum recursion depth"),
        (
            "e.json",
            json.dumps(description(table={"harmonics": [10**30]})),
            f"the experiment: table: harmonics is {10**30}; expected a whole number <= {2**53}",
        ),
        ("b.json", json.dumps(description(plant=[{"kind": "gear"}])), ".*kind 'gear'"),
        (
            "c.json",
            json.dumps(description(plant=[{"kind": "mass", "mass": 1}, {"kind": "mass", "m": 1}])),
            r"plant\[1\]: the mass element has the keys m; expected mass",
        ),
    ],
)
def test_unreadable_files_are_named(tmp_path, name, text, message):
    if text:
        (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=f"{name}: {message}"):
        Experiment.read(tmp_path / name)


@pytest.mark.parametrize("read", [Experiment.read, Experiment.from_json, Experiment.from_toml])
def test_what_is_not_a_path_or_a_text_is_refused(read):
    with pytest.raises(DahlIdentError, match=r"the experiment is (3; expected its path|not )"):
        read(3)


def test_more_samples_than_any_memory_holds_are_refused():
    for periods in (10**30, 10**400):
        with pytest.raises(ValidationError, match=f"settling_periods is {periods}; expected a wh"):
            replace(STEPS, settling_periods=periods)
    with pytest.raises(ValidationError, match="the number of samples is 64000"):
        made(FRICTION, FrequencySweep(0.1, 1.0, 10.0, 1e80, controlled="displacement"))
    late = Channel(delay=1e20, antialias_hz=50.0)
    with pytest.raises(ValidationError, match="the number of filtered samples is"):
        made(FRICTION, STEPS, Acquisition(1000.0, late))
    assert made(FRICTION, STEPS, seed=10**30).displacement.size  # a seed may be any whole number


def test_impossible_experiments_are_refused():
    with pytest.raises(ModelError, match="no value for sigma"):
        Experiment(Dahl(0.1), STEPS)
    with pytest.raises(ValidationError, match="a table was requested of a FrequencySweep"):
        Experiment(PLANT, FrequencySweep(1.0, 1.0, 2.0, 10.0), table=Table())
    with pytest.raises(ValidationError, match=r"harmonics is \(3,\) where force is controlled"):
        Experiment(PLANT, replace(STEPS, controlled="force"), table=Table(harmonics=(3,)))
    faults = Acquisition(force=Channel(noise_std=1.0, offset=1.0), jitter_std=1e-3)
    with pytest.raises(ValidationError, match="force offset, jitter_std cannot appear"):
        Experiment(PLANT, STEPS, faults, Table())
    with pytest.raises(ValidationError, match="motion is 'sideways'"):
        Experiment(PLANT, STEPS, motion="sideways")  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match="sample_rate_hz is 4; expected more than 4"):
        simulate(Experiment(FRICTION, STEPS, Acquisition(4.0)), seed=1)
    with pytest.raises(ValidationError, match="seed is -1; expected a whole number >= 0"):
        simulate(EXPERIMENTS[0], seed=-1)
    with pytest.raises(ValidationError, match="experiment is a str; expected a dahl_ident"):
        simulate("run.toml", seed=1)  # type: ignore[arg-type]
    stuck = Experiment(FRICTION, SteppedSine((1.0,), controlled="force"), table=Table())
    with pytest.raises(ModelError, match=r"."):
        simulate(stuck, seed=1)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        *((Channel, n, v) for n, v in (
            ("gain", 0.0), ("noise_std", -1.0), ("resolution", -1.0), ("antialias_hz", 0.0),
            ("limit", -1.0), ("delay", np.inf), ("hum_amplitude", np.nan))),
        *((Table, n, v) for n, v in (
            ("force_std", -1.0), ("harmonics", ()), ("harmonics", (0,)),
            ("outlier_fraction", 1.5))),
        (Acquisition, "dropped_fraction", 0.95), (Acquisition, "sample_rate_hz", 0.0),
    ],
)  # fmt: skip
def test_bad_numbers_are_refused_by_name(kind, name, value):
    with pytest.raises(ValidationError, match=f"{name}" if kind is Table else f"{name} is"):
        kind(**{name: value})


# --- seeds


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids=range(len(EXPERIMENTS)))
def test_a_seed_fixes_the_data(experiment):
    first, second = (simulate(experiment, seed=3) for _ in range(2))
    for name in ("time", "displacement", "force", "response", "amplitude"):
        if hasattr(first, name):
            assert np.array_equal(getattr(first, name), getattr(second, name))


def test_another_seed_gives_other_noise_and_nothing_else():
    noisy = Acquisition(100.0, force=Channel(noise_std=1e-3))
    a, b = (made(FRICTION, STEPS, noisy, seed=seed) for seed in (1, 2))
    assert np.array_equal(a.motion_samples, b.motion_samples)
    assert not np.array_equal(a.force_samples, b.force_samples)


def test_adding_one_fault_leaves_the_others_as_they_were():
    noise = displacement(Channel(noise_std=1e-3))
    both = displacement(Channel(noise_std=1e-3, hum_amplitude=1e-4))
    assert both - noise == pytest.approx(displacement(Channel(hum_amplitude=1e-4)), abs=1e-15)


def test_provenance_tells_how_it_was_made():
    run = Experiment(
        PLANT, replace(STEPS, controlled="force"), Acquisition(force=Channel(gain=1.1, delay=1e-3))
    )
    told = simulate(run, seed=5).provenance
    assert Experiment.from_dict(told["experiment"]) == run
    assert told["seed"] == 5
    assert told["truth"] == {
        "f_max": 0.1, "sigma": 30.0, "alpha": 1.0, "mass": 0.3, "damping": 0.24,
        "stiffness": 0.3, "force_gain": 1.1, "delay": -1e-3,
    }  # fmt: skip
    assert [window[0] for window in told["windows"]] == [1e-3, 1e-2]


# --- sensors


def test_an_ideal_sensor_shows_the_motion_itself():
    assert np.array_equal(displacement(Channel()), np.zeros(6_001))


def test_white_noise():
    noise = displacement(Channel(noise_std=1e-3))
    assert np.std(noise) == pytest.approx(1e-3, rel=0.03)
    neighbours = np.mean(noise[1:] * noise[:-1]) / 1e-6
    assert neighbours == pytest.approx(0.0, abs=0.04)


def test_flicker_noise_is_slow():
    noise = displacement(Channel(flicker_std=1e-3))
    assert np.mean(noise[1:] * noise[:-1]) / np.mean(noise**2) > 0.5
    assert np.std(noise) == pytest.approx(1e-3, rel=0.3)


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        (Channel(offset=1e-3, drift=2e-3), TRUE + 1e-3 + 2e-3 * TIME),
        (Channel(gain=1.25), 1.25 * TRUE),
        (Channel(delay=0.0123), STEPS.waveform(0).value(TIME - 0.0123)),
        (Channel(limit=4e-3), np.clip(TRUE, -4e-3, 4e-3)),
    ],
    ids=["offset and drift", "gain", "delay", "limit"],
)
def test_what_a_channel_shows(channel, expected):
    assert displacement(channel) + TRUE == pytest.approx(expected, abs=1e-15)


def test_hum_is_a_sine_at_the_mains_frequency():
    hum = displacement(Channel(hum_amplitude=1e-3, hum_hz=60.0))[:-1]
    spectrum = 2.0 * np.abs(np.fft.rfft(hum)) / hum.size
    assert spectrum[360] == pytest.approx(1e-3, rel=1e-9)
    assert np.sum(np.delete(spectrum, 360)) < 1e-12


def test_quantisation_rounds_to_steps():
    error = displacement(Channel(resolution=5e-4))
    shown = (error + TRUE) / 5e-4
    assert shown == pytest.approx(np.round(shown), abs=1e-9)
    assert np.max(np.abs(error)) <= 2.5e-4 * (1.0 + 1e-9)
    assert np.max(np.abs(error)) > 2.4e-4


def test_the_anti_alias_filter_is_of_first_order():
    steps = SteppedSine((1.0,), (2.0,), settling_periods=20)
    measured = made(Spring(1.0), steps, Acquisition(256.0, Channel(antialias_hz=3.0)))
    assert of_window(measured) == pytest.approx(1.0 / (1.0 + 2.0j / 3.0), rel=1e-5)


def of_window(measured):
    """Return motion over force at the frequency of the first window."""
    _, f, start, stop = measured.provenance["windows"][0]
    inside = (measured.time > start - 1e-9) & (measured.time < stop - 1e-9)
    turn = np.exp(-2j * np.pi * f * measured.time[inside])
    x, u = measured.motion_samples[inside], measured.force_samples[inside]
    return np.mean(x * turn) / np.mean(u * turn)


def test_the_filter_starts_at_rest_with_its_signal():
    shown = displacement(Channel(antialias_hz=3.0))
    assert shown[0] == pytest.approx(0.0, abs=1e-18)


def test_jitter_moves_both_channels_alike():
    steps = SteppedSine((1.0,), (2.0,))
    measured = made(Spring(3.0), steps, Acquisition(1000.0, jitter_std=1e-4))
    true = steps.waveform(0)
    assert measured.force_samples == pytest.approx(3.0 * measured.motion_samples)
    moved = measured.motion_samples - true.value(measured.time)
    speed = np.std(true.motion(measured.time).velocity)
    assert np.std(moved) == pytest.approx(1e-4 * speed, rel=0.05)
    assert np.diff(measured.time) == pytest.approx(1e-3)


def test_dropped_samples_leave_gaps():
    whole = made(FRICTION, STEPS, Acquisition(1000.0))
    holed = made(FRICTION, STEPS, Acquisition(1000.0, dropped_fraction=0.1))
    assert holed.n / whole.n == pytest.approx(0.9, abs=0.01)
    assert len(holed.gaps) > 400
    kept = np.searchsorted(whole.time, holed.time)
    assert np.array_equal(whole.force_samples[kept], holed.force_samples)


def test_a_forced_record_holds_the_drive_and_the_motion():
    steps = SteppedSine((0.2,), (2.0,), controlled="force", settling_periods=30)
    measured = made(PLANT, steps, motion="rotation")
    assert measured.motion == "rotation"
    assert measured.sample_rate == pytest.approx(128.0)
    expected = complex(response(PLANT, 2.0, 0.2).receptance)
    assert of_window(measured) == pytest.approx(expected, rel=3e-3)


# --- tables


def test_a_table_without_errors_is_the_describing_function():
    steps = SteppedSine((1e-3, 1e-2), (1.0, 5.0))
    data = made(PLANT, steps, table=Table(harmonics=(1, 3)))
    assert data.n == 8
    assert data.covariance is None
    assert data.harmonic.tolist() == [1, 3] * 4
    for k, A, omega, Z in zip(
        data.harmonic.tolist(), data.amplitude, data.omega, data.response, strict=True
    ):
        assert pytest.approx(complex(PLANT.dynamic_stiffness(A, omega, harmonic=k)), rel=1e-14) == Z


def test_a_forced_table_is_the_steady_response():
    steps = SteppedSine((0.05, 0.5), (1.0, 5.0), controlled="force")
    data = made(PLANT, steps, table=Table(), motion="rotation")
    assert data.quantity == "receptance"
    assert data.motion == "rotation"
    assert data.controlled.tolist() == ["force"] * 4
    expected = response(PLANT, data.frequency_hz, np.array([0.05, 0.5, 0.05, 0.5]))
    assert data.response == pytest.approx(np.asarray(expected.receptance), rel=1e-14)
    assert data.amplitude == pytest.approx(expected.amplitude)
    assert data.drive == pytest.approx([0.05, 0.5, 0.05, 0.5])


def test_a_tables_sensors_are_those_of_the_problem():
    acquisition = Acquisition(
        displacement=Channel(gain=0.9, delay=3e-3), force=Channel(gain=1.2, delay=1e-3)
    )
    steps = SteppedSine((1e-3, 1e-2), (1.0, 5.0))
    plain = made(FRICTION, steps, table=Table(harmonics=(1, 3)))
    seen = made(FRICTION, steps, acquisition, Table(harmonics=(1, 3)))
    assert seen.amplitude == pytest.approx(0.9 * np.asarray(plain.amplitude))
    turned = np.exp(1j * plain.harmonic * plain.omega * 2e-3) * 1.2 / 0.9
    assert seen.response == pytest.approx(turned * plain.response, rel=1e-13)
    sensors = {"force_gain": 1.2, "displacement_gain": 0.9, "delay": 2e-3}
    truth = {name: seen.provenance["truth"][name] for name in sensors}
    assert Sensors(**truth) == Sensors(**sensors)


def test_a_table_sees_the_anti_alias_filter():
    acquisition = Acquisition(displacement=Channel(antialias_hz=5.0))
    steps = SteppedSine((1e-3,), (5.0,))
    plain = made(FRICTION, steps, table=Table()).response
    seen = made(FRICTION, steps, acquisition, Table())
    assert seen.response == pytest.approx(plain * (1.0 + 1.0j), rel=1e-13)
    assert seen.amplitude == pytest.approx([1e-3 / np.sqrt(2.0)])


@pytest.mark.parametrize(("controlled", "harmonics"), [("displacement", (1, 3)), ("force", (1,))])
def test_covariances_are_those_of_repeated_tables(controlled, harmonics):
    level = 5e-3 if controlled == "displacement" else 0.1
    steps = SteppedSine((level,) * 5000, (1.0,), controlled=controlled)
    errors = Table(0.004, 0.006, harmonics, steady="describing function")
    data = made(PLANT, steps, table=errors)
    for k in harmonics:
        rows = data.harmonic == k
        R = data.response[rows]
        found = np.cov(np.array([data.amplitude[rows], R.real, R.imag]))
        stated = np.zeros((3, 3))
        stated[0, 0] = np.mean(data.amplitude_std[rows] ** 2)
        stated[0, 1:] = stated[1:, 0] = np.mean(data.amplitude_covariance[rows], axis=0)
        stated[1:, 1:] = np.mean(data.covariance[rows], axis=0)
        scale = np.sqrt(np.diag(stated))
        difference = (found - stated) / np.outer(scale, scale)
        assert difference == pytest.approx(np.zeros((3, 3)), abs=0.06)
        assert np.all(np.isinf(data.dof[rows]))


def test_outliers_are_few_large_and_known():
    steps = SteppedSine(tuple(np.geomspace(1e-4, 1e-1, 40)))
    plain = made(FRICTION, steps, table=Table(force_std=0.01))
    spoiled = made(FRICTION, steps, table=Table(force_std=0.01, outlier_fraction=0.1))
    moved = np.abs(spoiled.response / plain.response - 1.0)
    assert spoiled.provenance["outlier_rows"] == np.flatnonzero(moved > 1e-12).tolist()
    assert np.count_nonzero(moved > 1e-12) == 4
    assert moved[moved > 1e-12] == pytest.approx(0.5)


@given(seed=st.integers(0, 2**64), f_max=st.floats(1e-6, 1e6), x_c=st.floats(1e-9, 1e3))
def test_tables_scale_with_their_units(seed, f_max, x_c):
    def of_units(f, x):
        steps = SteppedSine((0.1 * x, 3.0 * x), order="random")
        return made(Dahl(f, f / x), steps, table=Table(0.01, 0.01), seed=seed)

    unit, scaled = of_units(1.0, 1.0), of_units(f_max, x_c)
    assert scaled.response == pytest.approx(unit.response * f_max / x_c, rel=1e-10)
    assert scaled.amplitude == pytest.approx(np.asarray(unit.amplitude) * x_c, rel=1e-10)


@pytest.mark.parametrize("excitation", [AmplitudeRamp(1e-3, 1e-2, 2.0, 3.0), STEPS])
def test_a_record_lasts_as_long_as_its_excitation(excitation):
    measured = made(FRICTION, excitation, Acquisition(100.0))
    assert measured.time[-1] == pytest.approx(excitation.waveform(0).duration, abs=0.01)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"plant": True}, "plant is True; expected a list"),
        ({"plant": [None]}, r"plant\[0\] is None; expected a table of named values"),
        ({"excitation": "sine"}, "excitation is 'sine'; expected a table of named values"),
        ({"table": {"harmonics": [1, 1.5]}}, r"table.harmonics\[1\] is 1.5; expected a whole"),
        ({"motion": "translatoin"}, "expected one of .*; did you mean 'translation'"),
        ({"excitation": {"kind": []}}, r"the excitation has the kind \[\]; expected one of"),
    ],
)
def test_an_experiment_of_other_values_is_refused(values, message):
    known = Experiment(Spring(1.0), STEPS).to_dict()
    with pytest.raises((DataError, ModelError), match=message):
        Experiment.from_dict({**known, **values})

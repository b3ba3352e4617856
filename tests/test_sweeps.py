"""Sweeps and stepped sines of a driven plant as waveforms: fitted at once, levels as one run."""

import re
from typing import Any

import numpy as np

import dahl_ident as di
from dahl_ident.synthetic import Acquisition, Channel, Experiment, FrequencySweep, SteppedSine
from tests.recovery import assert_near

PLANT = di.Dahl(0.1, 30.0) + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
MODEL = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
SENSORS = Acquisition(32.0, displacement=Channel(noise_std=1e-4), force=Channel(noise_std=5e-5))


def sweep(level, seed):
    return di.simulate(Experiment(PLANT, FrequencySweep(level, 0.4, 5.0, 60.0), SENSORS), seed=seed)


def assert_true(fit):
    truth = {"f_max": 0.1, "sigma": 30.0, "mass": 0.3, "damping": 0.24, "stiffness": 0.3}
    assert fit.trusted, fit.verdict
    assert_near(fit, truth, 4.0)


def test_the_shipped_sweeps_are_fitted_as_waveforms():
    assert_true(di.fit(di.load_dataset("sweep_plant"), MODEL))


def test_a_sweep_says_how_far_its_points_are_from_settled():
    data: Any = di.load_dataset("sweep_plant")
    points = di.extract(data, controlled="force")
    assert np.mean(["swept too fast" in v for v in points.quality["verdict"]]) > 0.8
    settled = points.drive / di.response(PLANT, points.frequency_hz, points.drive).displacement
    error = np.abs(points.response - settled)
    bias = np.hypot(points.quality["bias_real"], points.quality["bias_imag"])
    noise = np.sqrt(np.trace(points.covariance, axis1=1, axis2=2))
    assert np.mean(error < bias + 2.0 * noise) > 0.9
    assert np.median(bias / error) < 5.0  # a bound that says something


def test_sweeps_of_one_level_each_are_one_run(tmp_path, run):
    sweeps = [sweep(level, seed) for seed, level in enumerate((0.05, 0.2, 1.0))]
    for record, level in zip(sweeps, (50, 200, 1000), strict=True):
        record.save(tmp_path / f"sweep{level}mN.csv")
    free = ("--mass", "free", "--damping", "free", "--stiffness", "free")
    done = run("fit", str(tmp_path / "sweep*.csv"), *free)
    told = " ".join(done.out.split())
    assert done.status == 0
    assert "Trusted." in told
    assert "a single run" in told
    assert "runs differ" not in told


def test_extraction_of_a_sweep_says_its_bias_and_the_command_for_waveforms(tmp_path, run):
    sweep(0.3, 1).save(tmp_path / "sweep.csv")
    told = run("extract", str(tmp_path / "sweep.csv"), "--controlled", "force")
    text = " ".join((told.out + told.err).split())
    bias = re.findall(r"biased by about ([0-9.]+) % \(median\), at most ([0-9.]+) %", text)
    ((median, most),) = bias
    assert 0.1 < float(median) <= float(most) < 50.0
    assert f"dahl-ident fit --record {tmp_path / 'sweep.csv'} --mass free" in text


def test_a_table_of_stepped_sines_and_their_waveforms_agree():
    steps = SteppedSine(
        (0.08, 0.3, 1.0), (1.2, 2.0, 3.5), controlled="force", settling_periods=12,
        num_periods=12, ramp_periods=8.0,
    )  # fmt: skip
    record: Any = di.simulate(Experiment(PLANT, steps, SENSORS), seed=3)
    points = di.extract(record, controlled="force")
    table = di.fit(points, MODEL)
    waves = di.fit(record, MODEL)
    assert_true(waves)
    assert table.trusted, table.verdict
    for name in ("f_max", "sigma", "mass", "damping", "stiffness"):
        one, other = table.params[name], waves.params[name]
        assert abs(one.value - other.value) < 3.0 * np.hypot(one.stderr, other.stderr), name

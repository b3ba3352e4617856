import numpy as np
import pytest

from benchmarks.extraction_validation import (
    FRICTION,
    descending,
    one_over_f,
    settling,
    steady,
    white,
)
from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.extraction import extract
from dahl_ident.extraction.sine_fit import sine_fit, steady_segment
from dahl_ident.extraction.transient import estimate_transient

PER_CYCLE = 200


def departing(beta, cycles, start_force, noise=0.0):
    """Fit a segment that starts with some force, and return the exact response too."""
    theta: FloatArray = 1.1 + 2.0 * np.pi / PER_CYCLE * np.arange(cycles * PER_CYCLE, dtype=float)
    turns = np.pi * np.arange(1.0, np.ceil(theta[-1] / np.pi))
    order = np.argsort(np.concatenate([theta, turns]), kind="stable")
    x = beta * np.cos(np.concatenate([theta, turns])[order])
    force = np.empty(order.size)
    force[order] = FRICTION.force(x, start_force)
    rng = np.random.default_rng(1)
    measured = force[: theta.size] + noise * rng.standard_normal(theta.size)
    channels = np.stack([beta * np.cos(theta), measured])
    time = np.arange(theta.size) / PER_CYCLE
    return sine_fit(steady_segment(time, channels, 2.0 * np.pi)), complex(
        FRICTION.describing_function(beta)
    )


def estimated(fit):
    X, force = fit.phasors(1)
    transient = estimate_transient(fit, 1, float(np.angle(X)), complex(force / X))
    part = transient.departure * transient.phasor_derivatives(fit)[0, 1]
    return transient, complex(part / X)


@pytest.mark.parametrize("cycles", [3, 10, 40])
@pytest.mark.parametrize("beta", [0.02, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0])
def test_bias_of_the_response_is_predicted(beta, cycles):
    fit, exact = departing(beta, cycles, 0.9, noise=1e-6)
    X, force = fit.phasors(1)
    bias = force / X - exact
    _, predicted = estimated(fit)
    assert abs(bias) > 1e-4 * abs(exact)
    assert abs(predicted - bias) < 0.25 * abs(bias)


def test_a_settled_stretch_has_no_departure():
    rng = np.random.default_rng(3)
    found = 0
    for beta in (0.05, 0.3, 3.0, 30.0):
        for _ in range(25):
            n = 10 * PER_CYCLE
            x, force = steady(beta, 0.3 + 2.0 * np.pi / PER_CYCLE * np.arange(n, dtype=np.float64))
            channels = np.stack([x, force + 0.01 * rng.standard_normal(n)])
            fit = sine_fit(steady_segment(np.arange(n) / PER_CYCLE, channels, 2.0 * np.pi))
            found += estimated(fit)[0].significant
    assert found <= 4


def test_a_drifting_sensor_is_no_memory_where_friction_forgets_fast():
    n = 20 * PER_CYCLE
    time = np.arange(n, dtype=np.float64) / PER_CYCLE
    x, force = steady(3.0, 2.0 * np.pi * time)
    rng = np.random.default_rng(0)
    drifting = force + 0.005 * time + 1e-3 * rng.standard_normal(n)
    data = extract(Record(time, displacement=x, force=drifting), harmonics=(1,))
    assert data.quality["settled"].tolist() == [True]
    assert data.response[0] == pytest.approx(FRICTION.describing_function(3.0), rel=1e-3)


@pytest.mark.parametrize("beta", [0.03, 0.3])
def test_a_drifting_sensor_changes_neither_the_response_nor_its_verdict(beta):
    """From rest; a tenth of the force's amplitude over the level moves the mean by half of it."""
    n = 15 * PER_CYCLE
    time = np.arange(n, dtype=np.float64) / PER_CYCLE
    x = beta * np.sin(2.0 * np.pi * time)  # the reversals are samples
    force = FRICTION.force(x)
    size = np.max(np.abs(force))
    noisy = force + 0.002 * size * np.random.default_rng(4).standard_normal(n)
    drift = 0.1 * size / time[-1]
    still, drifting = (
        extract(Record(time, displacement=x, force=noisy + rate * time), harmonics=(0, 1))
        for rate in (0.0, drift)
    )
    assert drifting.quality["settled"].tolist() == still.quality["settled"].tolist()
    assert drifting.quality["settling_periods"][0] == still.quality["settling_periods"][0]
    fundamental, mean = drifting.harmonic == 1, drifting.harmonic == 0
    assert drifting.response[fundamental] == pytest.approx(still.response[fundamental], rel=1e-6)
    middle = 0.5 * (drifting.quality["start_time"] + drifting.quality["end_time"])[mean]
    error = drifting.response[mean].real - drift * middle / beta
    assert abs(error) < 3.0 * np.sqrt(drifting.covariance[mean, 0, 0])


@pytest.mark.parametrize(("noise", "fixed"), [(white, True), (one_over_f, False)])
def test_verdicts_on_descending_levels_with_too_few_cycles(noise, fixed):
    result = settling(8, seed=11, noise=noise, fixed=fixed)
    assert result.found > 0.95
    assert result.biased > 0
    assert result.caught >= 0.95
    assert result.flagged <= 0.05


def test_more_periods_is_what_was_missing():
    levels = np.array([1.0, 0.05])
    rng = np.random.default_rng(8)

    def extracted(cycles, left_out):
        t, x, force = descending(levels, cycles, 100)
        noisy = force + 1e-5 * rng.standard_normal(t.size)
        record = Record(t, displacement=x, force=noisy)
        return extract(record, harmonics=(1,), settling_periods=left_out)

    early = extracted(8, 1)
    more = int(early.quality["more_periods"][1])
    assert not early.quality["settled"][1]
    assert more > 5
    assert early.quality["verdict"][1] == f"not settled, {more} more periods"
    assert extracted(11 + more, 4 + more).quality["settled"][1]
    assert not extracted(8 + more // 2, 1 + more // 2).quality["settled"][1]


def test_settling_periods_are_left_out_by_themselves():
    t, x, force = descending(np.array([1.0, 0.3, 0.03]), 60, 100)
    rng = np.random.default_rng(2)
    noisy = force + 1e-4 * rng.standard_normal(t.size)
    data = extract(Record(t, displacement=x, force=noisy), harmonics=(1,))
    left_out = data.quality["settling_periods"]
    assert data.quality["settled"].all()
    assert left_out[2] > left_out[1] > 0
    errors = np.abs(data.response - FRICTION.describing_function(data.amplitude))
    assert (errors < 4.0 * np.sqrt(np.trace(data.covariance, axis1=1, axis2=2))).all()


def test_noise_over_two_cycles_is_not_taken_for_a_transient():
    """One spectral line below the fundamental may be small by chance; the residuals are not."""
    t = np.arange(80) / 40.0
    x = 3e-3 * np.sin(2.0 * np.pi * t)
    force = FRICTION.force(np.tile(x, 20))[-80:]
    exact, noise = complex(FRICTION.describing_function(3e-3)), 0.045 * np.abs(force).max()
    rng, errors = np.random.default_rng(5), []
    for _ in range(150):
        noisy = force + noise * rng.standard_normal(80)
        record = Record(t, displacement=x, force=noisy)
        found = extract(record, harmonics=[1], frequency=1.0, settling_periods=0)
        errors.append(found.response[0] - exact)
    rms = float(np.sqrt(np.mean(np.abs(errors) ** 2)))
    assert rms == pytest.approx(2.0 * noise / np.sqrt(80.0) / 3e-3, rel=0.25)

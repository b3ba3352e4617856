"""Sensors: what a gain error and a delay do to every quantity, amplitude and harmonic."""

import numpy as np
import pytest
from scipy import stats

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Sensors, Spring, fit
from dahl_ident.errors import ValidationError
from dahl_ident.problem import TableProblem

A = np.geomspace(1e-4, 1e-1, 7)
FREQUENCY = np.geomspace(0.2, 4.0, 7)
OMEGA = 2.0 * np.pi * FREQUENCY
PLANT = Dahl(0.1, 30.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)


def test_parameters_are_fixed_free_or_have_a_prior():
    prior = stats.norm(0.0, 20e-6)
    sensors = Sensors(force_gain=None, delay=prior)
    assert [p.name for p in sensors.parameters if p.free] == ["force_gain", "delay"]
    assert sensors.priors == {"delay": prior}
    assert not sensors.are_exact
    assert Sensors().are_exact


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"force_gain": -1.0}, "force_gain is -1.0; expected a number > 0"),
        ({"displacement_gain": 0.0}, "displacement_gain is 0.0; expected a number > 0"),
        ({"delay": np.nan}, "delay is nan"),
        ({"force_gain": stats.norm(-1.0, 0.1)}, "force_gain is -1.0; expected a number > 0"),
    ],
)
def test_impossible_values_are_refused(arguments, message):
    with pytest.raises(ValidationError, match=message):
        Sensors(**arguments)


@pytest.mark.parametrize("controlled", ["displacement", "force"])
@pytest.mark.parametrize(
    ("quantity", "power", "inverted"),
    [
        ("receptance", 0, True),
        ("mobility", 1, True),
        ("accelerance", 2, True),
        ("dynamic_stiffness", 0, False),
        ("mechanical_impedance", -1, False),
        ("apparent_mass", -2, False),
    ],
)
def test_each_quantity_sees_gains_and_delay(quantity, power, inverted, controlled):
    force_gain, displacement_gain, delay = 1.3, 0.8, 2e-3
    F = PLANT.dynamic_stiffness(A, OMEGA) * A  # the true phasors, X = A
    measured_force = force_gain * F
    measured_displacement = displacement_gain * A * np.exp(-1j * OMEGA * delay)
    motion = (1j * OMEGA) ** abs(power) * measured_displacement
    response = motion / measured_force if inverted else measured_force / motion
    data = FrequencyResponse(
        FREQUENCY,
        response,
        amplitude=np.abs(measured_displacement),
        drive=np.abs(measured_force),
        controlled=controlled,
        quantity=quantity,  # the table above holds all six
    )
    sensors = Sensors(force_gain=None, displacement_gain=None, delay=None)
    problem = TableProblem(data, PLANT, sensors=sensors, steady="describing function")
    theta = problem.to_search([force_gain, displacement_gain, delay])
    np.testing.assert_allclose(problem.predict(theta), response, rtol=1e-10)


def test_a_harmonic_sees_the_delay_k_times():
    pivot, delay, period = Dahl(0.1, 30.0), 0.02, 1.0
    t = np.arange(4096) / 4096 * period
    phase = 2.0 * np.pi * t / period
    x, force = pivot.loop(0.01, points=4097)
    assert x[0] == pytest.approx(0.01)
    spectrum = np.fft.fft(force[:-1])  # of F(t) for x = A cos(phase)
    late = np.fft.fft(0.01 * np.cos(phase - 2.0 * np.pi * delay / period))
    measured = [
        spectrum[k] / np.abs(late[1]) * np.exp(-1j * k * np.angle(late[1])) for k in (1, 3, 5)
    ]
    data = FrequencyResponse(np.ones(3), measured, amplitude=np.full(3, 0.01), harmonic=[1, 3, 5])
    problem = TableProblem(data, pivot, sensors=Sensors(delay=None), noise="absolute")
    np.testing.assert_allclose(problem.predict([delay]), measured, rtol=2e-5)


def test_an_unknown_gain_leaves_one_friction_parameter():
    N = Dahl(0.1, 30.0).describing_function(A)
    data = FrequencyResponse(np.ones(7), N, A)
    by_force = TableProblem(data, Dahl(), sensors=Sensors(force_gain=None))
    by_motion = TableProblem(data, Dahl(), sensors=Sensors(displacement_gain=None))
    for factor in (0.5, 3.0):
        only_x_c = by_force.to_search([0.1 * factor, 30.0 * factor, 1.0 / factor])
        only_f_max = by_motion.to_search([0.1, 30.0 * factor, factor])
        assert np.abs(by_force.residuals(only_x_c)).max() < 1e-13
        assert np.abs(by_motion.residuals(only_f_max)).max() < 1e-13


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-8])
def test_a_calibration_counts_however_small_the_noise(noise):
    A = np.geomspace(1e-4, 3e-2, 30)
    error = 1.0 + noise * np.random.default_rng(0).standard_normal(30)
    table = FrequencyResponse(np.ones(30), Dahl(0.1, 30.0).describing_function(A) * error, A)
    gains = {"force_gain": stats.norm(1, 0.0025), "displacement_gain": stats.norm(1, 0.001)}
    found = fit(table, Dahl(alpha=1.0), sensors=Sensors(**gains))
    assert found.trusted
    # F = g_F f_max h(g_x x): f_max has the force's error, sigma that of both
    assert found.params["f_max"].stderr == pytest.approx(0.1 * 0.0025, rel=1e-2)
    assert found.params["sigma"].stderr == pytest.approx(30.0 * np.hypot(0.0025, 0.001), rel=1e-2)


def test_what_an_unknown_gain_leaves_is_one_number_everywhere():
    """A ratio, with an exponent that was not given: params, model and x_c are of one estimate."""
    levels = np.geomspace(3e-4, 3e-2, 24)
    noise = 0.005 * np.random.default_rng(3).standard_normal((levels.size, 2)) @ [1.0, 1.0j]
    N = Dahl(0.1, 30.0, 1.4).describing_function(levels) * np.exp(noise)
    data = FrequencyResponse(np.ones(levels.size), N, levels)
    found = fit(data, Dahl(), sensors=Sensors(force_gain=None), throw=False)
    (ratio,) = found.budget().parameters
    assert ratio.name == "f_max/sigma"
    assert ratio.value == pytest.approx(0.1 / 30.0, abs=3.0 * ratio.u)
    (x_c,) = found.derived([])
    f_max, sigma, alpha = (found.params[name].value for name in ("f_max", "sigma", "alpha"))
    assert (x_c.value, x_c.stderr) == pytest.approx((ratio.value, ratio.u), rel=1e-6)
    assert f_max / sigma == pytest.approx(ratio.value, rel=1e-6)
    assert [p.value for p in found.model.parameters] == pytest.approx([f_max, sigma, alpha])
    assert "alpha = 1 exactly" not in str(found)
    assert f"(here {alpha:.1f}" in str(found)

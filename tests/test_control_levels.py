"""Fig. 7, equivalent plants and margins against python-control and the closed forms."""

from typing import Any

import control
import matplotlib.pyplot as plt
import numpy as np
import pytest

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring, response
from dahl_ident.control_interop import (
    LoopMargins,
    equivalent_plant,
    level_responses,
    limit_cycles,
    loop_margins,
)
from dahl_ident.errors import ModelError, NoSteadyMotionWarning, ValidationError
from dahl_ident.units import QUANTITIES

FIG_7 = Dahl(0.1, 30.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)
F = np.geomspace(0.01, 10.0, 300)
U0 = np.geomspace(1e-4, 10.0, 51)
s = control.tf("s")


def test_fig_7_in_one_call():
    fig_7 = level_responses(FIG_7, F, U0, steady="describing function")
    truth = response(FIG_7, F, U0[:, None], steady="describing function").receptance
    np.testing.assert_allclose(fig_7.response, truth, rtol=1e-13)
    systems = fig_7.to_control()
    assert list(systems) == U0.tolist()
    for system, row in zip(systems.values(), truth, strict=True):
        assert isinstance(system, control.FRD)
        np.testing.assert_allclose(np.ravel(system(1j * system.omega)), row, rtol=1e-12)
    static = [abs(complex(systems[u](1j * 2 * np.pi * F[0]))) for u in (U0[0], U0[-1])]
    assert static == pytest.approx([1.0 / 30.3, 1.0 / 0.3], rel=0.02)


def test_one_drive_that_slides_is_the_linear_plant_of_python_control():
    """Far below and far above friction the FRD is that of a plain transfer function."""
    low, high = level_responses(FIG_7, F, [1e-9, 1e7]).to_control().values()
    for frd, stiffness in ((low, 30.3), (high, 0.3)):
        plain = control.tf([1.0], [0.3, 0.24, stiffness])
        theirs = np.ravel(plain(1j * frd.omega))
        np.testing.assert_allclose(np.ravel(frd(1j * frd.omega)), theirs, rtol=2e-5)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_held_amplitude_gives_the_describing_function(quantity):
    A = np.array([1e-4, 1e-2])
    w = 2.0 * np.pi * F
    Z = 0.3 - 0.3 * w**2 + 0.24j * w + Dahl(0.1, 30.0).describing_function(A)[:, None]
    expected = {
        "receptance": 1 / Z, "mobility": 1j * w / Z, "accelerance": -(w**2) / Z,
        "dynamic_stiffness": Z, "mechanical_impedance": Z / (1j * w), "apparent_mass": -Z / w**2,
    }[quantity]  # fmt: skip
    ours = level_responses(FIG_7, F, A, controlled="displacement", quantity=quantity)
    np.testing.assert_allclose(ours.response, expected, rtol=1e-12)


def test_points_without_an_amplitude_are_left_out():
    undamped = Dahl(1.0, 1.0) + Mass(1.0) + Spring(1.0)
    f = np.array([0.5, 1.0, 2.0]) / (2.0 * np.pi)
    with pytest.warns(NoSteadyMotionWarning):
        result = level_responses(undamped, f, [3.0])
    assert np.isnan(result.response[0, 1])
    assert result.to_control()[3.0].omega.tolist() == pytest.approx([0.5, 2.0])


def test_pictures_of_levels():
    data = level_responses(FIG_7, F, U0, steady="describing function")
    _, pair = plt.subplots(2, 1)
    top, bottom = data.plot(ax=pair)
    assert top is pair[0]
    assert len(bottom.lines) == 51
    np.testing.assert_allclose(top.lines[7].get_ydata(), np.abs(data.response[7]))
    _, single = plt.subplots()
    assert data.plot("nyquist", ax=single) is single
    np.testing.assert_allclose(single.lines[50].get_ydata(), data.response[50].imag)
    nichols = data.plot("nichols")
    decibels = 20.0 * np.log10(np.abs(data.response[3]))
    np.testing.assert_allclose(nichols.lines[3].get_ydata(), decibels)
    phase = np.degrees(np.unwrap(np.angle(data.response[3])))
    np.testing.assert_allclose(nichols.lines[3].get_xdata(), phase)
    assert nichols.get_legend() is not None
    wrong: Any = "smith"
    with pytest.raises(ValidationError, match="kind is 'smith'; expected 'bode', 'nyquist'"):
        data.plot(wrong)


@pytest.mark.parametrize(
    ("arguments", "options", "text"),
    [
        (([0.0, 1.0], 1.0), {}, r"frequency_hz\[0\] is 0\.0; expected numbers > 0"),
        ((1.0, -1.0), {}, r"levels is -1\.0; expected numbers > 0"),
        ((np.ones((2, 2)), 1.0), {}, r"frequency_hz has shape \(2, 2\)"),
        ((1.0, 1.0), {"controlled": "power"}, "controlled is 'power'; expected one of"),
        ((1.0, 1.0), {"quantity": "gain"}, "quantity is 'gain'; expected one of receptance"),
    ],
)
def test_bad_levels_are_named(arguments, options, text):
    with pytest.raises(ValidationError, match=text):
        level_responses(FIG_7, *arguments, **options)


@pytest.mark.parametrize("amplitude", [1e-5, 3e-3, 0.5])
@pytest.mark.parametrize("frequency", [0.1, 2.0])
def test_equivalent_plant_is_exact_where_it_should_be(amplitude, frequency):
    ours = equivalent_plant(FIG_7, amplitude, frequency)
    omega = 2.0 * np.pi * frequency
    assert complex(ours(1j * omega)) == pytest.approx(
        1.0 / complex(FIG_7.dynamic_stiffness(amplitude, omega)), rel=1e-12
    )
    space = control.ss(ours)
    assert complex(space(1j * omega)) == pytest.approx(complex(ours(1j * omega)), rel=1e-9)
    friction = Dahl(0.1, 30.0)
    expected = [
        0.3,
        0.24 + friction.equivalent_damping(amplitude, omega),
        0.3 + friction.equivalent_stiffness(amplitude),
    ]
    den = ours.den[0][0] / ours.num[0][0][-1]
    assert den == pytest.approx(expected, rel=1e-12)


def test_equivalent_plant_around_python_control_systems():
    two_modes = 1 / (s**2 + 0.2 * s + 1) + 0.5 / (s**2 + 0.02 * s + 100)
    friction = Dahl(0.1, 30.0)
    for linear, power in (
        (LinearSystem(two_modes, quantity="receptance"), 0),
        (LinearSystem(control.ss(two_modes), quantity="mobility"), 1),
        (LinearSystem(two_modes, quantity="dynamic_stiffness", name="a"), 0),
    ):
        ours = equivalent_plant(friction + linear + Mass(0.1), 1e-3, 0.7)
        w = 2.0 * np.pi * 0.7
        H = complex(two_modes(1j * w)) / (1j * w) ** power
        Z = H if linear.quantity == "dynamic_stiffness" else 1.0 / H
        total = Z - 0.1 * w**2 + friction.describing_function(1e-3)
        assert complex(ours(1j * w)) == pytest.approx(1.0 / complex(total), rel=1e-9)

    def mode(mass, stiffness):
        return control.tf([1.0], [mass, 0.0, stiffness])

    named = LinearSystem(
        mode, quantity="receptance", parameters={"mass": 2.0, "stiffness": 8.0}, name="base"
    )
    ours = equivalent_plant(friction + named, 1e-3, 0.7)
    assert ours.poles().size == 2
    frd = LinearSystem(control.frd([1.0, 2.0], [1.0, 2.0]), quantity="receptance")
    with pytest.raises(ModelError, match="is not a rational function of s"):
        equivalent_plant(friction + frd, 1e-3, 0.2)
    with pytest.raises(ValidationError, match=r"amplitude is 0\.0; expected numbers > 0"):
        equivalent_plant(FIG_7, 0.0, 1.0)


SERVO = Dahl(1.0, 1e3) + Mass(1.0) + Damper(0.5)
LAGGING_PID = 100 + 150 / s + 20 * s / (0.02 * s + 1) ** 2
FINE = np.geomspace(0.02, 200.0, 6000)


def test_margins_are_those_of_python_control():
    A = np.geomspace(1e-5, 1.0, 5)
    ours = loop_margins(SERVO, LAGGING_PID, A, frequency_hz=FINE)
    omega = 2.0 * np.pi * FINE
    for i, amplitude in enumerate(A):
        loop = np.ravel(LAGGING_PID(1j * omega)) / SERVO.dynamic_stiffness(amplitude, omega)
        gains, phases, moduli, *_ = control.stability_margins(
            control.FRD(loop, omega, smooth=True), returnall=True
        )
        gain = gains[np.argmin(np.abs(np.log(gains)))]
        phase = phases[np.argmin(np.abs(phases))]
        assert ours.gain_margin[i] == pytest.approx(gain, rel=1e-4)
        assert ours.phase_margin_deg[i] == pytest.approx(phase, abs=1e-2)
        assert ours.modulus_margin[i] == pytest.approx(np.min(moduli), rel=1e-4)


def test_margins_at_the_equivalent_plants_crossover():
    """The TransferFunction has the same phase margin if its damper is exact at the crossover."""
    A = 0.1
    ours = loop_margins(SERVO, LAGGING_PID, [A], frequency_hz=FINE)
    crossover = 3.0
    for _ in range(20):
        loop = LAGGING_PID * equivalent_plant(SERVO, A, crossover)
        _, phase, _, _, at, _ = control.stability_margins(loop)
        crossover = at / (2.0 * np.pi)
    assert ours.phase_margin_deg[0] == pytest.approx(phase, abs=1e-2)


def test_margins_vanish_on_a_limit_cycle():
    friction, pid = Dahl(1.0, 1e4), 100 + 300 / s + 20 * s / (0.02 * s + 1) ** 2
    (cycle,) = limit_cycles(control.feedback(1 / s**2, pid), friction)
    margins = loop_margins(friction + Mass(1.0), pid, cycle.amplitude, frequency_hz=FINE)
    assert margins.gain_margin[0] == pytest.approx(1.0, abs=1e-3)
    assert margins.phase_margin_deg[0] == pytest.approx(0.0, abs=0.05)


def test_a_loop_without_crossings_has_infinite_margins():
    margins = loop_margins(Dahl(1.0, 1.0) + Spring(9.0), control.tf([0.1], [1.0]), 1.0,
                           frequency_hz=FINE)  # fmt: skip
    assert margins.gain_margin.tolist() == [np.inf]
    assert margins.phase_margin_deg.tolist() == [np.inf]
    assert margins.modulus_margin[0] > 1.0


def test_draws_give_a_band_that_moves_with_the_posterior():
    rng = np.random.default_rng(5)
    free = Dahl() + Mass(1.0) + Damper(0.5)
    A, f = np.geomspace(1e-5, 1.0, 5), np.geomspace(0.1, 100.0, 800)
    draws = {"f_max": rng.lognormal(0.0, 0.05, 40), "sigma": rng.lognormal(np.log(1e3), 0.05, 40)}
    many = loop_margins(free, LAGGING_PID, A, frequency_hz=f, draws=draws)
    assert many.gain_margin.shape == (40, 5)
    for i in (0, 17):
        one = Dahl(draws["f_max"][i], draws["sigma"][i]) + Mass(1.0) + Damper(0.5)
        alone = loop_margins(one, LAGGING_PID, A, frequency_hz=f)
        np.testing.assert_allclose(many.phase_margin_deg[i], alone.phase_margin_deg, rtol=1e-9)
        np.testing.assert_allclose(many.modulus_margin[i], alone.modulus_margin, rtol=1e-9)
    low, high = many.band("modulus_margin", 0.9)
    inside = (many.modulus_margin >= low) & (many.modulus_margin <= high)
    assert inside.mean() == pytest.approx(0.9, abs=0.06)
    wide = {
        name: np.exp(3.0 * np.log(v / np.median(v))) * np.median(v) for name, v in draws.items()
    }
    wider = loop_margins(free, LAGGING_PID, A, frequency_hz=f, draws=wide).band("modulus_margin")
    assert np.all(wider[1] - wider[0] > 1.5 * (high - low))
    top, bottom = many.plot()
    assert len(top.collections) == len(bottom.collections) == 1
    _, pair = plt.subplots(2, 1)
    alone = LoopMargins(A, *(v[0] for v in (many.gain_margin, many.phase_margin_deg, low[None])))
    assert alone.plot(ax=pair)[0] is pair[0]
    with pytest.raises(ValidationError, match="gain_margin holds no draws; give draws="):
        alone.band("gain_margin")


@pytest.mark.parametrize(
    ("draws", "error", "text"),
    [
        ({"f_max": [1.0, 2.0], "sigma": [1.0]}, ValidationError, r"f_max \(2,\), sigma \(1,\)"),
        ({"f_max": 1.0, "sigma": 2.0}, ValidationError, r"f_max \(\), sigma \(\)"),
        ({"f_max": [1.0]}, ModelError, "no value for sigma"),
        ({"f_max": [1.0], "sigma": [1.0], "k": [1.0]}, ModelError, "has no parameter k"),
        ({}, ValidationError, "draws is empty"),
    ],
)
def test_bad_draws_are_named(draws, error, text):
    with pytest.raises(error, match=text):
        loop_margins(Dahl() + Mass(1.0), LAGGING_PID, 1.0, frequency_hz=FINE, draws=draws)


def test_frequencies_must_rise():
    with pytest.raises(ValidationError, match="one dimension each, frequencies rising"):
        loop_margins(SERVO, LAGGING_PID, 1.0, frequency_hz=[2.0, 1.0])

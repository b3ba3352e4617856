"""Plants in the time domain: against an ODE solver, each other, and the describing function."""

import control
import numpy as np
import pytest

from dahl_ident import BoucWen, Dahl, Damper, LinearSystem, Mass, Model, Spring, response
from dahl_ident.errors import ModelError
from dahl_ident.synthetic import AmplitudeRamp, FrequencySweep, SteppedSine
from dahl_ident.synthetic.mechanism import displacement_under, force_under

FRICTION = (0.1, 30.0)
LINEAR = Mass(0.3) + Damper(0.24) + Spring(0.3)
PLANT = Dahl(*FRICTION) + LINEAR


@pytest.mark.parametrize("levels", [(0.02, 0.2), (0.5, 0.05)])
def test_motion_of_a_law_without_closed_form(levels):
    """Bouc-Wen's law with q = p = sigma/f_max is Dahl's."""
    steps = SteppedSine(levels, (0.7,), controlled="force", settling_periods=1, num_periods=1)
    force = steps.waveform(seed=0)
    time = np.linspace(0.0, force.duration, 997)
    exact = displacement_under(Dahl(0.1, 30.0) + LINEAR, force)(time)
    motion = displacement_under(BoucWen(30.0, 300.0, 300.0) + LINEAR, force)(time)
    assert np.max(np.abs(motion - exact)) < 1e-5 * np.max(np.abs(exact))


def phasor(signal, frequency_hz, start, periods, k=1):
    """Return the k-th harmonic over whole periods, from 512 points in each."""
    time = start + np.arange(512 * periods) / (512.0 * frequency_hz)
    return complex(2.0 * np.mean(signal(time) * np.exp(-2j * np.pi * k * frequency_hz * time)))


@pytest.mark.parametrize(
    "plant",
    [
        Dahl(*FRICTION) + Damper(0.5),
        Dahl(*FRICTION) + Spring(3.0),
        Dahl(*FRICTION) + Spring(3.0) + Damper(0.1),
        Dahl(*FRICTION) + Mass(0.3),
        Dahl(*FRICTION, 0.25) + LINEAR,
        Dahl(*FRICTION, 3.0) + LINEAR,
    ],
    ids=["damper", "spring", "spring and damper", "mass", "alpha 1/4", "alpha 3"],
)
@pytest.mark.parametrize("level", [0.05, 0.5])
def test_forces_balance_at_every_instant(plant, level):
    force = AmplitudeRamp(0.3 * level, level, 1.0, 3.0, controlled="force").waveform(seed=0)
    motion = displacement_under(plant, force)
    time = np.linspace(0.0, force.duration, 20_001)
    x = motion(time)
    v = np.gradient(x, time, edge_order=2)
    a = np.gradient(v, time, edge_order=2)
    total = Model(plant).force(x, velocity=v, acceleration=a)
    # second differences jump where friction's stiffness does, at reversals
    misfit = np.abs(total - force.value(time))[2:-2]
    assert np.quantile(misfit, 0.99) < 2e-4 * level
    assert np.max(misfit) < 5e-3 * level


@pytest.mark.parametrize("plant", [Spring(3.0), Spring(3.0) + Damper(0.1)])
@pytest.mark.parametrize("law", [Dahl(*FRICTION), BoucWen(30.0, 200.0, 100.0)])
def test_a_plant_without_mass_follows_a_jump_of_the_force(law, plant):
    sweep = FrequencySweep((0.05, 0.3), 1.0, 1.37, 2.3, ramp_periods=0.0)
    force = sweep.waveform(seed=0)
    time = np.linspace(0.0, force.duration, 20_001)
    x = displacement_under(law + plant, force)(time)
    total = (law + plant).force(x, velocity=np.gradient(x, time))
    assert np.quantile(np.abs(total - force.value(time)), 0.99) < 1e-4


@pytest.mark.parametrize("controlled", ["force", "displacement"])
@pytest.mark.parametrize(
    ("system", "quantity"),
    [
        (control.tf([1.0], [0.3, 0.24, 0.3]), "receptance"),
        (control.ss(control.tf([1.0], [0.3, 0.24, 0.3])), "receptance"),
        (control.tf([1.0, 0.0], [0.3, 0.24, 0.3]), "mobility"),
        (control.tf([1.0, 0.0, 0.0], [0.3, 0.24, 0.3]), "accelerance"),
        (control.tf([0.3, 0.24, 0.3], [1.0]), "dynamic_stiffness"),
        (control.tf([0.3, 0.24, 0.3], [1.0, 0.0]), "mechanical_impedance"),
        (control.tf([0.3, 0.24, 0.3], [1.0, 0.0, 0.0]), "apparent_mass"),
    ],
)
def test_a_linear_system_moves_as_its_elements_do(system, quantity, controlled):
    steps = SteppedSine((0.05,), controlled=controlled, settling_periods=1, num_periods=1)
    wave = steps.waveform(seed=0)
    time = np.linspace(0.0, wave.duration, 500)
    plants = [PLANT, Dahl(*FRICTION) + LinearSystem(system, quantity=quantity)]
    elements, lumped = (
        (displacement_under if controlled == "force" else force_under)(plant, wave)(time)
        for plant in plants
    )
    assert lumped == pytest.approx(elements, abs=1e-10 * np.max(np.abs(elements)))


def test_a_linear_system_with_poles_of_its_own_is_followed_under_either_control():
    # a tuned absorber in parallel with the plant: Z has a pole pair that no lumped element has
    absorber = LinearSystem(
        control.tf([0.05 * 1.0, 0.05 * 25.0, 0.0, 0.0], [1.0, 1.0, 25.0]),
        quantity="dynamic_stiffness",
    )
    plant = PLANT + absorber
    f = 0.9
    held = SteppedSine((0.01,), (f,), settling_periods=20).waveform(seed=0)
    start = held.windows[0].start
    stiffness = phasor(force_under(plant, held), f, start, 5) / phasor(held.value, f, start, 5)
    # 512 samples a period alias friction's corners a little
    assert stiffness == pytest.approx(plant.dynamic_stiffness(0.01, 2.0 * np.pi * f), rel=1e-6)
    driven = SteppedSine((0.02,), (4.0,), controlled="force", settling_periods=60).waveform(seed=0)
    start = driven.windows[0].start
    x = displacement_under(plant, driven)
    receptance = phasor(x, 4.0, start, 5) / phasor(driven.value, 4.0, start, 5)
    assert receptance == pytest.approx(complex(response(plant, 4.0, 0.02).receptance), rel=1e-3)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("amplitude", [1e-4, 1e-2, 1.0])
def test_friction_under_a_held_displacement_is_the_exact_force(alpha, amplitude):
    friction = Dahl(*FRICTION, alpha)
    wave = SteppedSine(
        (amplitude, 0.4 * amplitude), (2.0,), settling_periods=1, num_periods=2, rest=0.3
    ).waveform(seed=0)
    rng = np.random.Generator(np.random.PCG64(1))
    time = np.sort(rng.uniform(0.0, wave.duration, 300))
    force = force_under(friction, wave)(time)
    dense = np.unique(np.concatenate([time, wave.turning_times()]))
    expected = friction.force(wave.value(dense))[np.searchsorted(dense, time)]
    assert force == pytest.approx(expected, abs=1e-13 * 0.1)


def test_time_can_be_scaled():
    slow, fast = (
        Dahl(*FRICTION) + Mass(0.3 * s**2) + Damper(0.24 * s) + Spring(0.3) for s in (1.0, 1e-4)
    )
    time = np.linspace(0.0, 8.0, 301)
    runs = [FrequencySweep(0.08, 0.5 / s, 1.0 / s, 4.0 * s).waveform(seed=0) for s in (1.0, 1e-4)]
    x = displacement_under(slow, runs[0])(time)
    y = displacement_under(fast, runs[1])(time * 1e-4)
    assert y == pytest.approx(x, abs=1e-9 * np.max(np.abs(x)))


def test_progress_rises_to_one():
    seen: list[float] = []
    wave = SteppedSine((0.1, 0.2), controlled="force", settling_periods=1).waveform(seed=0)
    displacement_under(PLANT, wave, seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert len(seen) == len(wave.segments)


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        (Dahl(*FRICTION), "friction alone slides without bound"),
        (Dahl(0.1) + Mass(0.3), "no value for sigma"),
        (
            Dahl(*FRICTION) + LinearSystem(
                control.FRD([1.0, 0.5], [1.0, 2.0]), quantity="receptance"
            ),
            "no equation of motion in continuous time",
        ),
        (
            Dahl(*FRICTION) + LinearSystem(control.tf([1.0], [1.0, 1.0, 1.0, 1.0, 1.0]),
            quantity="dynamic_stiffness"),
            "has no state-space form; give the plant a mass",
        ),
    ],
    ids=["no linear part", "no value", "frequency response data", "improper"],
)  # fmt: skip
def test_a_plant_without_motion_says_why(plant, message):
    wave = SteppedSine((0.1,), controlled="force").waveform(seed=0)
    with pytest.raises(ModelError, match=message):
        displacement_under(plant, wave)


def test_an_unstable_plant_says_so():
    wave = SteppedSine((0.1,), controlled="force", settling_periods=2000).waveform(seed=0)
    with pytest.raises(ModelError, match="the motion grows beyond all bounds"):
        displacement_under(Dahl(*FRICTION) + Mass(0.3) + Damper(-5.0), wave)


def test_a_stiffness_beyond_a_mass_has_no_force_under_a_held_displacement():
    jerk = LinearSystem(control.tf([1.0], [1.0, 0.0, 0.0, 0.0]), quantity="receptance")
    wave = SteppedSine((0.1,)).waveform(seed=0)
    with pytest.raises(ModelError, match=r"grows as s\^3; under a prescribed displacement"):
        force_under(jerk, wave)

"""Branches of an active plant: up- and down-sweeps in the time domain land where predicted."""

import control
import numpy as np
import pytest

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring
from dahl_ident.control_interop import response_branches
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.synthetic.mechanism import Mechanism
from dahl_ident.synthetic.waveform import WaveformBuilder

s = control.tf("s")
LAGGING = LinearSystem(s * (1.2 - 2.172 / (0.1 * s + 1)), quantity="dynamic_stiffness")
"""A damper that feeds below 1.4 Hz and takes above, so that the held mass stays calm."""
ACTIVE = Dahl(0.1, 30.0) + Mass(0.3) + LAGGING + Spring(3.0)
FREQUENCY = 0.65


def staircase(plant, drives, frequency_hz, hold):
    """Return the displacement amplitude at the end of each step of drive, in the time domain."""
    builder = WaveformBuilder(frequency_hz)
    for drive in drives:
        builder.go_to(drive, frequency_hz, 8.0 / frequency_hz)
        builder.stay((hold - 4) / frequency_hz)
        builder.measure(4 / frequency_hz)
    force = builder.finish()
    x = Mechanism.of(plant).displacement_under(force)
    amplitudes = []
    for window in force.windows:
        time = window.start + np.arange(2048) / 2048.0 * (window.stop - window.start)
        turn = np.exp(-2j * np.pi * frequency_hz * time)
        amplitudes.append(2.0 * abs(np.mean(x(time) * turn)))
    return np.array(amplitudes)


def test_sweeps_up_and_down_land_on_the_two_stable_branches():
    """At drives far apart, between which branches begin and end."""
    up = np.array([0.05, 0.065, 0.0675, 0.0725])
    seen = staircase(ACTIVE, np.concatenate([up, up[::-1][1:]]), FREQUENCY, 60)
    rising, falling = seen[: up.size], seen[up.size - 1 :][::-1]
    branches = response_branches(ACTIVE, FREQUENCY, up)
    A, stable = branches.steady.amplitude, branches.stable
    assert stable.tolist() == [
        [True, False, False], [True, False, False], [True, False, True], [True, False, False],
    ]  # fmt: skip
    assert rising == pytest.approx(A[:, 0], rel=1e-4)
    assert falling[[0, 2, 3]] == pytest.approx([A[0, 0], A[2, 2], A[3, 0]], rel=1e-4)


def test_the_describing_function_places_branches_roughly():
    """The third harmonic, near the held mass's resonance, shifts the upper branch by a tenth."""
    exact, sine = (
        response_branches(ACTIVE, FREQUENCY, 0.0675, steady=steady).steady.amplitude
        for steady in ("exact", "describing function")
    )
    assert sine == pytest.approx(exact, rel=0.25)
    assert sine != pytest.approx(exact, rel=0.05)


def test_passive_plants_have_one_stable_branch():
    plant = Dahl(0.1, 30.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)
    frequency, drive = np.geomspace(0.05, 5.0, 16)[:, None], np.geomspace(1e-4, 10.0, 16)
    branches = response_branches(plant, frequency, drive)
    assert branches.stable.shape == (16, 16, 1)
    assert branches.stable.all()


def test_without_friction_the_rate_is_that_of_the_pole():
    mass, damping, stiffness = 0.3, 0.01, 3.0
    plant = Dahl(1e-9, 1e-9) + Mass(mass) + Damper(damping) + Spring(stiffness)
    f = np.sqrt(stiffness / mass) / (2.0 * np.pi)
    rate = response_branches(plant, f, 1.0).growth_rate
    pole = np.roots([mass, damping, stiffness])[0]
    assert rate == pytest.approx([pole.real], rel=1e-3)


def test_falling_branches_are_unstable():
    """Where A |Z| falls with A, at least one disturbance grows."""
    u = np.geomspace(0.03, 0.2, 60)
    f = np.linspace(0.5, 0.9, 15)[:, None]
    branches = response_branches(ACTIVE, f, u, steady="describing function")
    A = branches.steady.amplitude[branches.steady.found]
    omega = 2.0 * np.pi * branches.steady.frequency_hz[branches.steady.found]
    size = [step * A * np.abs(ACTIVE.dynamic_stiffness(step * A, omega)) for step in (0.999, 1.001)]
    falls = size[1] < size[0]
    assert falls.sum() > 20
    assert not branches.stable[branches.steady.found][falls].any()
    assert not branches.stable[~branches.steady.found].any()


def test_bad_arguments_are_named():
    with pytest.raises(ValidationError, match=r"frequency_hz is 0\.0; expected numbers > 0"):
        response_branches(ACTIVE, 0.0, 1.0)
    with pytest.raises(ModelError, match="has no friction; add one, such as Dahl"):
        response_branches(Mass(1.0) + Spring(1.0), 1.0, 1.0)
    with pytest.raises(ModelError, match="has no linear part; add one, such as Mass"):
        response_branches(Dahl(1.0, 1.0), 1.0, 1.0)

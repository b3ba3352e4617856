"""python-control: signs and memory of its nonlinearity, plants with its parts, branches."""

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring, fit
from dahl_ident.control_interop import (
    FrictionNonlinearity,
    closed_loop_response,
    level_responses,
    response_branches,
)
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.synthetic.mechanism import displacement_under
from dahl_ident.synthetic.waveform import WaveformBuilder

# FrictionNonlinearity inside python-control: signs, memory, intersections.

TWO = Dahl(0.1, 30.0, name="a") + Dahl(0.03, 90.0, 1.5, name="b")


@pytest.mark.versions
@pytest.mark.parametrize("friction", [Dahl(0.1, 30.0), Dahl(2.0, 5.0, 0.5), TWO])
def test_python_control_gets_the_exact_describing_function(friction):
    A = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 15)])
    theirs = control.describing_function(FrictionNonlinearity(friction), A)
    np.testing.assert_allclose(theirs, friction.dynamic_stiffness(A), rtol=1e-13)


@pytest.mark.versions
@pytest.mark.parametrize("friction", [Dahl(0.1, 30.0), Dahl(0.1, 30.0, 2.0), TWO])
def test_python_controls_own_quadrature_has_the_same_sign_and_value(friction):
    A = 0.03  # beta = 9: the memory of the first cycle is gone after one more
    numerical = control.describing_function(
        FrictionNonlinearity(friction), [A], num_points=2000, try_method=False
    )
    assert numerical[0] == pytest.approx(friction.dynamic_stiffness(A), rel=1e-5)
    assert numerical[0].imag > 0.0


@pytest.mark.versions
@pytest.mark.parametrize("friction", [Dahl(0.1, 30.0), Dahl(0.1, 30.0, 0.5), TWO])
def test_call_by_call_gives_the_force_of_the_whole_history(friction):
    x = np.cumsum(np.random.default_rng(1).normal(0.0, 2e-3, 200))
    nonlinearity = FrictionNonlinearity(friction)
    one_by_one = [nonlinearity(v) for v in x]
    np.testing.assert_allclose(
        one_by_one, friction.force(np.concatenate([[0.0], x]))[1:], atol=1e-13
    )
    nonlinearity.reset()
    assert nonlinearity(x[0]) == one_by_one[0]
    assert control.describing_function(nonlinearity, [1e-3]).shape == (1,)


@pytest.mark.versions
@pytest.mark.parametrize("amplitude", [-1.0, np.nan, np.inf])
def test_bad_amplitudes_are_refused(amplitude):
    with pytest.raises(ValidationError, match=r"A is .*; expected"):
        FrictionNonlinearity(Dahl(1.0, 1.0)).describing_function(amplitude)


@pytest.mark.versions
def test_what_is_no_friction_is_refused():
    with pytest.raises(
        ModelError, match=r"friction holds Mass\(mass=0\.3\); expected friction alone"
    ):
        FrictionNonlinearity(Dahl(1.0, 1.0) + Mass(0.3))
    with pytest.raises(ModelError, match="has no value for sigma"):
        FrictionNonlinearity(Dahl(1.0))
    linear = LinearSystem(control.tf([1], [1, 1]), quantity="receptance")
    for element in (Spring(1.0), Damper(1.0), linear):
        with pytest.raises(ModelError, match="the linear elements into the loop"):
            FrictionNonlinearity(element)


# Plants with python-control parts identified at several levels, also under feedback.

F_MAX, SIGMA = 0.1, 30.0
MASS, DAMPING, STIFFNESS = 0.3, 0.24, 0.3
s = control.tf("s")
LINEAR_PART = 1 / (MASS * s**2 + DAMPING * s + STIFFNESS)


def simulated(frequency_hz, drive, gains=(0.0, 0.0), cycles=12):
    """Return X over the drive's phasor and abs(X), driven by force, or by a reference under PD."""
    w = 2.0 * np.pi * frequency_hz
    stiff, damp = gains
    closed = any(gains)

    def slope(t, y):
        x, v, F = y
        if closed:
            u = stiff * (drive * np.cos(w * t) - x) - damp * (drive * w * np.sin(w * t) + v)
        else:
            u = drive * np.cos(w * t)
        a = (u - DAMPING * v - STIFFNESS * x - F) / MASS
        return [v, a, SIGMA * (v - abs(v) * F / F_MAX)]

    period = 1.0 / frequency_hz
    time = (cycles - 2) * period + 2.0 * period * np.arange(512) / 512.0
    run = solve_ivp(
        slope, (0.0, cycles * period), [0.0, 0.0, 0.0], t_eval=time, rtol=1e-8, atol=1e-12
    )
    X = complex(2.0 * np.mean(run.y[0] * np.exp(-1j * w * time)))
    return X / drive, abs(X)


def table(points, **options):
    rows = [simulated(f, u, **options) for f, u in points]
    return np.array([r for r, _ in rows]), np.array([A for _, A in rows])


def test_plant_measured_under_feedback_with_a_known_controller():
    stiff, damp = 12.0, 0.6
    controller = stiff + damp * s
    points = [(f, r) for r in (0.004, 0.012, 0.04, 0.12) for f in (1.0, 1.8, 2.6)]
    f, r = np.array(points).T
    X_over_R, amplitude = table(points, gains=(stiff, damp))
    data = closed_loop_response(f, r, X_over_R, controller)
    assert data.levels == [0.004, 0.012, 0.04, 0.12]
    inside = LinearSystem(controller, quantity="dynamic_stiffness", name="controller")
    linear = LinearSystem(LINEAR_PART, quantity="receptance")
    result = fit(data, Dahl() + linear + inside)
    assert result.params["f_max"].value == pytest.approx(F_MAX, rel=0.03)
    assert result.params["sigma"].value == pytest.approx(SIGMA, rel=0.03)
    truth = Dahl(F_MAX, SIGMA) + linear + inside
    for point, reference in enumerate(r):
        C = complex(controller(2j * np.pi * f[point]))
        row = level_responses(truth, f[point], abs(C) * reference).response
        assert complex(row[0, 0]) * C == pytest.approx(X_over_R[point], rel=0.06)
    assert amplitude.min() < 0.02 < amplitude.max()


def test_covariance_turns_with_the_controller():
    rng = np.random.default_rng(2)
    controller = control.tf([3.0, 50.0], [0.01, 1.0])
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]]) * 1e-6
    noise = rng.multivariate_normal([0.0, 0.0], covariance, 200_000) @ [1.0, 1.0j]
    C = complex(controller(2j * np.pi * 2.0))
    data = closed_loop_response([2.0], 0.1, [0.5], controller, covariance=covariance[None])
    parts = (noise / C).view(np.float64).reshape(-1, 2)
    sampled, size = np.cov(parts.T), float(np.var(parts))
    assert np.max(np.abs(data.covariance[0] - sampled)) < 0.02 * size
    assert data.response[0] == pytest.approx(0.5 / C)


def test_bad_closed_loop_data_are_named():
    with pytest.raises(ValidationError, match=r"reference is 0\.0; expected numbers > 0"):
        closed_loop_response([1.0], 0.0, [1.0], LINEAR_PART)
    notch = (s**2 + 4.0) / (s + 1) ** 2
    with pytest.raises(ValidationError, match=r"the controller is 0 at 0\.31831 Hz"):
        closed_loop_response([1.0 / np.pi], 1.0, [1.0], notch)
    with pytest.raises(ValidationError, match="shapes do not go together"):
        closed_loop_response([1.0, 2.0], [1.0, 1.0, 1.0], [1.0, 1.0], LINEAR_PART)


# Branches of an active plant: up- and down-sweeps in the time domain land where predicted.

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
    x = displacement_under(plant, force)
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

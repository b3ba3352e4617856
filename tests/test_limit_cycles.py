"""Limit cycles against the closed loop in the time domain, closed forms, Routh and Nyquist."""

import itertools
from functools import partial

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring
from dahl_ident.control_interop import FrictionNonlinearity, LimitCycle, limit_cycles
from dahl_ident.elements import Element
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.synthetic.mechanism import displacement_under
from dahl_ident.synthetic.waveform import WaveformBuilder

s = control.tf("s")
described = partial(limit_cycles, steady="describing function")
FRICTION = Dahl(1.0, 1e4)


def pid_loop(proportional, integral, derivative, lag=0.0):
    """Displacement over disturbance force of a free mass of 1 kg under PID control."""
    pid = proportional + integral / s + derivative * s / (lag * s + 1) ** 2
    return control.feedback(1 / s**2, pid)


def turning_points(loop, friction, kick, frequency_hz, duration):
    """Return times and displacements of the reversals of a loop that was kicked and left alone."""
    plant = friction + (
        loop if isinstance(loop, Element) else LinearSystem(loop, quantity="receptance")
    )
    builder = WaveformBuilder(frequency_hz)
    builder.go_to(kick, frequency_hz, 2.0 / frequency_hz)
    builder.go_to(0.0, frequency_hz, 2.0 / frequency_hz)
    builder.stay(duration)
    force = builder.finish()
    time = np.arange(0.0, force.duration, 1.0 / (200.0 * frequency_hz))
    x = displacement_under(plant, force)(time)
    turns = 1 + np.flatnonzero((x[1:-1] - x[:-2]) * (x[2:] - x[1:-1]) < 0.0)
    turns = turns[time[turns] > 4.0 / frequency_hz]
    return time[turns], x[turns]


def swing(x):
    """Return half the distance between consecutive reversals."""
    return np.asarray(np.abs(np.diff(x)) / 2.0)


HUNTING = pid_loop(100.0, 300.0, 20.0, 0.02)


@pytest.mark.parametrize("kick", [0.002, 0.3], ids=["from below", "from above"])
def test_hunting_of_a_pid_loop_in_the_time_domain(kick):
    assert np.all(HUNTING.poles().real < 1e-9)
    (cycle,) = limit_cycles(HUNTING, FRICTION)
    assert cycle.stable
    time, x = turning_points(HUNTING, FRICTION, kick, cycle.frequency_hz, 6.0)
    start, end = swing(x)[:4].mean(), swing(x)[-20:].mean()
    assert abs(np.log(start / cycle.amplitude)) > 0.5
    assert end == pytest.approx(cycle.amplitude, rel=0.02)
    assert 0.5 / np.diff(time)[-20:].mean() == pytest.approx(cycle.frequency_hz, rel=2e-3)


def test_no_hunting_where_none_is_predicted():
    """A Dahl contact alone has no falling friction: a sound PID loop comes to rest."""
    loop = pid_loop(100.0, 300.0, 20.0, 0.001)
    assert limit_cycles(loop, FRICTION) == ()
    stuck = 1.0 / (2.0 * np.pi) * np.sqrt(1e4 + 100.0)
    _, x = turning_points(loop, FRICTION, 0.5, stuck, 3.0)
    size = swing(x)
    assert size[-5:].max() < 1e-3 * size[:4].max()


ACTIVE = Mass(0.3) + Damper(-0.3) + Spring(0.3)
GRIP = Dahl(0.1, 30.0)


def test_disturbances_die_at_the_predicted_rate():
    cycle = described(ACTIVE, GRIP)[0]
    time, x = turning_points(ACTIVE, GRIP, 0.002, cycle.frequency_hz, 24.0)
    size, when = swing(x), time[1:]
    settled = size[-10:].mean()
    assert settled == pytest.approx(cycle.amplitude, rel=2e-3)
    near = (size > 0.9 * settled) & (size < 0.995 * settled)
    assert near.sum() > 10
    rate = np.polyfit(when[near], np.log(1.0 - size[near] / settled), 1)[0]
    assert rate == pytest.approx(cycle.growth_rate, rel=0.05)


@pytest.mark.parametrize(("kick", "grows"), [(0.65, False), (0.84, True), (1.09, True)])
def test_unstable_cycle_parts_rest_from_runaway(kick, grows):
    loop = Mass(0.3) + Damper(-0.03) + Spring(3.0)
    hold, part = limit_cycles(loop, GRIP)
    assert hold.stable
    assert not part.stable
    time, x = turning_points(loop, GRIP, kick, part.frequency_hz, 12.0)
    off = swing(x)[:6] / part.amplitude - 1.0
    assert np.all(off > 0.0) == grows
    assert np.all(np.diff(np.abs(off)) > 0.0)
    growth = np.polyfit(time[1:7], np.log(np.abs(off)), 1)[0]
    assert growth == pytest.approx(part.growth_rate, rel=0.1)


def swings(speed, duration):
    """Return times and displacements of the reversals of ACTIVE with GRIP, kicked from rest."""

    def rates(t, y):
        x, v, F = y
        return [v, (0.3 * v - 0.3 * x - F) / 0.3, 30.0 * v * (1.0 - np.sign(v) * F / 0.1)]

    def turns(t, y):
        return float(y[1])

    def far(t, y):
        return float(abs(y[0]) - 1.0)

    far.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(
        rates, (0.0, duration), [0.0, speed, 0.0], "DOP853", events=[turns, far], rtol=1e-8,
        atol=1e-10, max_step=0.2,
    )  # fmt: skip
    return found.t_events[0], found.y_events[0][:, 0]


class TestExactCycles:
    def test_the_unstable_one_parts_rest_from_runaway(self):
        """The describing function's is 10 % smaller and 5 % faster than the motion in between."""
        low, high = 0.1, 1.0
        for _ in range(16):
            kick = 0.5 * (low + high)
            runs_away = np.abs(swings(kick, 40.0)[1][-1]) > 0.5
            low, high = (low, kick) if runs_away else (kick, high)
        cycle = limit_cycles(ACTIVE, GRIP)[1]
        time, x = swings(low, 20.0)
        assert not cycle.stable
        assert 0.5 / np.diff(time)[1:4].mean() == pytest.approx(cycle.frequency_hz, rel=2e-3)
        assert swing(x)[1:4].mean() == pytest.approx(cycle.amplitude, rel=cycle.share)
        assert described(ACTIVE, GRIP)[1].amplitude < 0.92 * swing(x)[1:4].mean()

    def test_limits_that_differ_give_a_mean_and_even_harmonics(self):
        uneven = Dahl(0.1, 30.0, asymmetry=0.3)
        even = limit_cycles(ACTIVE, GRIP)[0]
        cycle = limit_cycles(ACTIVE, uneven)[0]
        assert cycle.stable
        assert cycle.share > 2.0 * even.share

    def test_loops_without_an_equation_of_motion_say_so(self):
        sampled = limit_cycles(control.c2d(control.ss(HUNTING), 1e-3, "tustin"), FRICTION)
        assert sampled.approximate.endswith("no equation of motion in continuous time")
        assert limit_cycles(HUNTING, FRICTION).approximate == ""


def test_negative_damping_against_the_closed_form():
    """m omega^2 = k + Re N(A) and c omega = Im N(A), one unknown after the other."""

    def loss(log_amplitude):
        N = complex(GRIP.describing_function(np.exp(log_amplitude)))
        return N.imag - 0.3 * float(np.sqrt((0.3 + N.real) / 0.3))

    roots = [np.exp(brentq(loss, *pair, xtol=1e-14)) for pair in ((-12.0, -5.0), (-5.0, 3.0))]
    cycles = described(ACTIVE, GRIP)
    assert [c.amplitude for c in cycles] == pytest.approx(roots, rel=1e-9)
    assert [c.stable for c in cycles] == [True, False]


@settings(max_examples=12)
@given(
    proportional=st.floats(1.0, 1e3),
    derivative=st.floats(0.1, 30.0),
    excess=st.floats(0.05, 20.0),
    stuck=st.floats(1.5, 1e3),
)
def test_pid_loops_follow_routh(proportional, derivative, excess, stuck):
    """s^3 + d s^2 + p s + i is stable up to i = d p, with the contact held up to i = d (p + sigma).

    Friction that turns a stable loop into an unstable one as it slips has one cycle, unstable;
    a loop that is stable without friction has none.
    """
    limit = derivative * proportional
    calm = pid_loop(proportional, limit / (1.0 + excess), derivative)
    sigma = stuck * excess * proportional
    friction = Dahl(1.0, sigma)
    assert described(calm, friction) == ()
    restless = pid_loop(proportional, limit * (1.0 + excess), derivative)
    (cycle,) = described(restless, friction)
    assert not cycle.stable
    value = complex(restless(1j * cycle.omega)) * complex(
        friction.dynamic_stiffness(cycle.amplitude)
    )
    assert value == pytest.approx(-1.0, rel=1e-7)


def crossings_of_the_roots(loop, friction):
    """Cycles from roots of d(s) + N(A) n(s) that pass the imaginary axis: a method of its own."""
    transfer = control.tf(loop)
    num, den = transfer.num[0][0], transfer.den[0][0]
    found = []
    amplitudes = np.geomspace(1e-9, 1e3, 1201)
    stiffness = friction.dynamic_stiffness(amplitudes)
    roots = [np.roots(np.polyadd(den, N * num)) for N in stiffness]
    for A, (first, second) in zip(amplitudes[:-1], itertools.pairwise(roots), strict=True):
        for root in first[first.imag > 1e-3]:
            moved = second[np.argmin(np.abs(second - root))]
            if root.real * moved.real < 0.0:
                found.append((float(A), float(root.imag), bool(moved.real < 0.0)))
    return found


TWO = Dahl(1.0, 1e3, name="bearing") + Dahl(0.05, 3e4, 1.6, name="seal")


@pytest.mark.parametrize(
    ("loop", "friction"),
    [
        (HUNTING, FRICTION),
        (HUNTING, TWO),
        (pid_loop(100.0, 3000.0, 20.0, 0.02), TWO),
        (pid_loop(400.0, 0.0, 9.0, 0.05), TWO),
        (control.tf([1.0], [0.3, -0.05, 0.3]), Dahl(0.1, 30.0, 0.5)),
        (1 / (s**2 - 0.2 * s + 1) + 0.5 / (s**2 + 0.02 * s + 100), Dahl(0.1, 30.0)),
    ],
    ids=["hunting", "two elements", "much integral", "no integral", "alpha 1/2", "two modes"],
)
def test_cycles_are_where_roots_pass_the_axis(loop, friction):
    cycles = limit_cycles(loop, friction)
    reference = crossings_of_the_roots(loop, friction)
    assert len(cycles) == len(reference) >= 1
    for cycle, (A, omega, stable) in zip(cycles, reference, strict=True):
        assert cycle.amplitude == pytest.approx(A, rel=0.03)
        assert cycle.omega == pytest.approx(omega, rel=0.03)
        assert cycle.stable == stable


def test_every_kind_of_system_has_the_same_cycle():
    (cycle,) = described(HUNTING, FRICTION)
    omega = np.geomspace(1.0, 1000.0, 900)
    for loop in (
        control.ss(HUNTING),
        control.frd(HUNTING, omega),
        LinearSystem(HUNTING * s, quantity="mobility"),
        LinearSystem(1 / HUNTING, quantity="dynamic_stiffness"),
    ):
        (same,) = described(loop, FRICTION)
        assert same.amplitude == pytest.approx(cycle.amplitude, rel=1e-4)
        assert same.frequency_hz == pytest.approx(cycle.frequency_hz, rel=1e-6)
        assert same.growth_rate == pytest.approx(cycle.growth_rate, rel=1e-3)
    assert described(HUNTING, FRICTION, frequency_range_hz=(20.0, 1e3)) == ()
    assert described(control.frd(HUNTING, omega[omega < 50.0]), FRICTION) == ()


def test_delay_brings_hunting_as_its_pade_approximation_says():
    """An FRD holds the delay itself; ten poles of Pade's approximation simulate it."""
    delay, pid = 0.02, 100 + 20 * s
    omega = np.geomspace(1.0, 2000.0, 3000)
    exact = 1.0 / (-(omega**2) + pid(1j * omega) * np.exp(-1j * omega * delay))
    (cycle,) = described(control.frd(exact, omega), FRICTION)
    pade = control.tf(*control.pade(delay, 5))
    (approximate,) = described(control.feedback(1 / s**2, pid * pade), FRICTION)
    assert cycle.stable
    assert approximate.amplitude == pytest.approx(cycle.amplitude, rel=1e-4)
    assert approximate.frequency_hz == pytest.approx(cycle.frequency_hz, rel=1e-6)


def test_discrete_loop_nears_its_continuous_origin():
    (cycle,) = described(HUNTING, FRICTION)
    (sampled,) = described(control.c2d(control.ss(HUNTING), 1e-3, "tustin"), FRICTION)
    assert sampled.amplitude == pytest.approx(cycle.amplitude, rel=1e-3)
    assert sampled.stable


def test_python_control_finds_the_same_crossings():
    cycles = described(ACTIVE, GRIP)
    theirs = control.describing_function_response(
        control.tf([1.0], [0.3, -0.3, 0.3]), FrictionNonlinearity(GRIP),
        np.geomspace(1e-4, 1.0, 200), np.geomspace(0.3, 30.0, 800), refine=False,
    )  # fmt: skip
    for cycle, (A, omega) in zip(cycles, sorted(theirs), strict=True):
        assert cycle.amplitude == pytest.approx(A, rel=0.02)
        assert cycle.omega == pytest.approx(omega, rel=0.02)


def test_loebs_criterion_is_the_sign_of_the_growth_rate():
    for cycle in described(ACTIVE, GRIP):
        slope = complex(GRIP.gradient(cycle.amplitude, ["amplitude"])["amplitude"])
        by_omega = -2.0 * 0.3 * cycle.omega - 0.3j
        loeb = slope.real * by_omega.imag - by_omega.real * slope.imag
        assert cycle.stable == (loeb > 0.0)


def test_bad_arguments_are_named():
    with pytest.raises(ModelError, match=r"loop holds Dahl\(.*pass it as friction"):
        limit_cycles(ACTIVE + GRIP, GRIP)
    with pytest.raises(ModelError, match=r"friction holds Mass"):
        limit_cycles(ACTIVE, GRIP + Mass(1.0))
    with pytest.raises(ModelError, match="no value for damping"):
        limit_cycles(Mass(1.0) + Damper(), GRIP)
    with pytest.raises(
        ValidationError, match=r"frequency_range_hz is \(2, 1\); expected two rising"
    ):
        limit_cycles(ACTIVE, GRIP, frequency_range_hz=(2, 1))
    with pytest.raises(ValidationError, match="loop is a float; expected a python-control"):
        limit_cycles(3.0, GRIP)
    with pytest.raises(ModelError, match="has no frequency of its own; give frequency_range_hz"):
        limit_cycles(Spring(-1.0), GRIP)
    assert LimitCycle(1.0, 0.5, -1.0).omega == pytest.approx(np.pi)


def test_an_empty_result_says_why():
    calm = limit_cycles(Mass(1.0) + Damper(1.0) + Spring(1.0), GRIP)
    assert calm == ()
    assert "at no amplitude" in repr(calm)


def test_a_loop_of_the_wrong_sign_is_refused():
    with pytest.raises(ModelError, match="loop has a negative mass, so its sign is wrong"):
        limit_cycles(-HUNTING, Dahl(f_max=1.0, sigma=1e4))

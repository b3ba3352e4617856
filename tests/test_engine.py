"""The engine against what is not the engine: DOP853 with events, quadrature, closed forms."""

import os
import subprocess
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.special import digamma, gamma

import dahl_ident as di
from benchmarks import engine_oracles as cases
from benchmarks import loop_oracles
from benchmarks.motion_oracles import (
    HARMONICS,
    DahlByHand,
    JenkinsByHand,
    Oracle,
    PiecewiseByHand,
    dahl_history,
    fixed_point,
    integrated,
)
from dahl_ident import Parameter
from dahl_ident.arrays import FloatArray
from dahl_ident.elements import law_equations, plant_equations
from dahl_ident.engine import (
    Equations,
    band_limited,
    differentiated,
    loops,
    march,
    settled,
    translate,
)
from dahl_ident.errors import FitError
from tests.derivatives import central_differences
from tests.motions import Driven

F_MAX = Parameter("f_max", "N", "limit", lower=0.0, transform="log")
STIFFNESS = Parameter("k", "N/m", "stiffness", lower=0.0, transform="log")


def seeded(*numbers):
    return np.random.default_rng([7, *numbers])


def in_plant(law):
    return translate(plant_equations(law + di.Mass() + di.Damper() + di.Spring()))


def at_one(system, amplitude, values, omega=1.0, **options):
    values = np.array([values], dtype=float)
    return settled(system, np.array([amplitude]), np.array([omega]), values, **options)


def loop_of(element, *arguments, **options):
    return at_one(translate(law_equations(element)), *arguments, **options)


def in_time(element, spline, samples, values, **options):
    """Return a law's motion along a spline from rest, where its other states are zero."""
    system, knots = translate(law_equations(element)), spline.x
    coefficients = spline.c[::-1] * (knots[1] - knots[0]) ** np.arange(4)[:, None]
    first = np.zeros(system.order)
    first[:2] = spline(0.0), spline(0.0, 1)
    return march(system, knots, coefficients, samples, first, values, **options)


def paper_plant(amplitude, omega, size):
    """Return the paper's plant under a sine, by an independent integrator."""
    drive = lambda t: (amplitude * np.cos(omega * t), 0.0)  # noqa: E731
    return Oracle([DahlByHand(0.1, 30.0)], drive, False, 0.3, 0.24, 0.3, size)


PAPER = cases.all_values(cases.Drawn(0, di.Dahl(), [0.1, 30.0], 1, 1), 0.3, 0.24, 0.3)


@pytest.mark.parametrize("law", list(cases.LAWS))
@pytest.mark.parametrize(
    ("kind", "limit"),
    [("settled loop", 1e-9), ("force history", 1e-9), ("settled motion of a plant", 1e-8),
     ("driven motion", 1e-8)],
)  # fmt: skip
def test_random_motions_are_those_of_an_independent_integrator(kind, limit, law):
    if law == "Iwan" and kind != "force history":
        pytest.skip("thirty events in each half cycle take the oracle half a minute")
    rng = seeded(list(cases.KINDS).index(kind), list(cases.LAWS).index(law))
    case = cases.KINDS[kind](law, rng)
    sharp = 2e-8 if law == "Power damper" else 1e-8
    assert case.error < (max(limit, sharp) if law in cases.KINKS else limit), case.note


@pytest.mark.parametrize("law", list(cases.BRANCHES))
def test_loops_of_any_amplitude_are_those_in_closed_form(law):
    rng = seeded(4, list(cases.LAWS).index(law))
    for _ in range(3):
        case = cases.any_amplitude(law, rng)
        assert case.error < 1e-8, case.note


@pytest.mark.parametrize("beta", [1e-8, 0.3, 1e8])
def test_dahl_loops_are_the_closed_forms(beta):
    law = di.Dahl(2.0, 500.0)
    A, values = beta * 2.0 / 500.0, [float(v) for v in law.known_values()]
    result = loop_of(di.Dahl(), A, values, harmonics=(1,), chosen=(0, 1))
    N = complex(law.describing_function(A))
    assert result.found[0]
    assert abs(result.harmonics[0, 0] / A - N) < 1e-9 * abs(N)
    slopes = law.gradient(A)
    for k, name in enumerate(("f_max", "sigma")):
        value = complex(slopes[name]) * (2.0, 500.0)[k]
        computed = result.by_parameter[0, 0, k] / A * (2.0, 500.0)[k]
        assert abs(computed - value) < 1e-6 * max(abs(value), 1e-3 * abs(N))
    by_A = N + A * complex(slopes["amplitude"])
    assert abs(result.by_amplitude[0, 0] - by_A) < 1e-6 * abs(N)


class Bilinear(di.Friction):
    """Slope k, a fifth of it from half the limit on, none from the limit on: by comparisons."""

    kind = "bilinear_of_tests"
    parameters = (STIFFNESS, F_MAX)

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        y = direction * force / f_max
        return k * ((y < 0.5) + 0.2 * (y >= 0.5)) * (y < 1.0)


class Returning(di.Friction):
    """Slope k up to the limit, and back from beyond: the force stays at the limit."""

    kind = "returning_of_tests"
    parameters = (STIFFNESS, F_MAX)

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        return k * np.sign(1.0 - direction * force / f_max)


class Pinched(di.Friction):
    """A slope with a dip of width 0.005."""

    kind = "pinched_of_tests"
    parameters = (STIFFNESS, F_MAX)

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        y = direction * force / f_max
        return k * (1.0 - 0.9 * (np.fabs(y - 0.3) < 0.0025)) * (y < 1.0)


class PinchedBySquares(Pinched):
    """The same dip by a function that touches zero within a step."""

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        y = direction * force / f_max
        return k * (1.0 - 0.9 * ((np.fabs(y) - 0.3) ** 2 < 0.0025**2) * (y > 0.0)) * (y < 1.0)


class Preloaded(di.Friction):
    """Half as stiff beyond 10 N in one direction."""

    kind = "preloaded_of_tests"
    parameters = (STIFFNESS, F_MAX)

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        return k * (1.0 - direction * force / f_max) * (0.75 - 0.25 * np.tanh(2.0 * (force - 10.0)))


class Stepped(Preloaded):
    """The same by a comparison."""

    kind = "stepped_of_tests"

    def slope(self, force, direction, velocity, values):
        k, f_max = values
        return k * (1.0 - direction * force / f_max) * (1.0 - 0.5 * (force > 10.0))


class Geared(di.Friction):
    """Half as stiff at a speed above v_0."""

    kind = "geared_of_tests"
    rate_independent = False
    loss = 0.5
    parameters = (STIFFNESS, F_MAX, Parameter("v_0", "m/s", "speed", lower=0.0, transform="log"))

    def slope(self, force, direction, velocity, values):
        k, f_max, v_0 = values
        share = 1.0 - self.loss * (np.fabs(velocity) > v_0)
        return k * (1.0 - direction * force / f_max) * share


class Reversing(Geared):
    """Back along its curve at a speed above v_0: both slopes have a mean of zero."""

    kind = "reversing_of_tests"
    loss = 2.0


class Sticky(di.Friction):
    """A limit that falls by f_s with the speed, without a number that is of parameters alone."""

    kind = "sticky_of_tests"
    rate_independent = False
    parameters = (
        STIFFNESS,
        F_MAX,
        Parameter("f_s", "N", "limit at rest, in addition", lower=0.0, transform="log"),
        Parameter("v_0", "m/s", "speed", lower=0.0, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        k, f_max, f_s, v_0 = values
        level = f_max + f_s * np.exp(-((velocity / v_0) ** 2))
        return k * (1.0 - direction * force / level)


class Drifting(di.Friction):
    """Depends on rate and direction: even harmonics."""

    kind = "drifting_of_tests"
    rate_independent = False
    parameters = (STIFFNESS, F_MAX, Parameter("bias", "", "of the limit", upper=0.9, lower=-0.9))

    def slope(self, force, direction, velocity, values):
        k, f_max, bias = values
        level = f_max * (1.0 + bias * direction) * (1.0 + 0.3 * np.exp(-(velocity**2)))
        return k * (1.0 - direction * force / level)


def by_oracle(hand, amplitude, result, odd, size):
    def displacement(t):
        return amplitude * np.cos(t), -amplitude * np.sin(t)

    oracle = Oracle([hand], displacement, True, sizes=np.full(hand.n, size))
    _, c, _ = fixed_point(oracle, result.starts[0, 2:], result.maps[0, 2:, 2:], 1.0, odd)
    return c


def harmonics_of(law, amplitude):
    """Return c_k of the law's settled loop at 1 rad/s, as users get them."""
    found = [law.dynamic_stiffness(amplitude, 1.0, harmonic=k) for k in HARMONICS]
    return amplitude * np.array(found)


def test_bilinear_slopes_by_comparisons():
    """The tip at A = 0.006 by hand: 1.2 F = 0.64. A table of half cycles gave 5.6 % less."""
    result = loop_of(Bilinear(), 0.006, [100.0, 1.0])
    assert abs(result.starts[0, 2] - 0.64 / 1.2) < 1e-9
    assert abs(result.harmonics[0, 0] / 0.006 - (93.271 + 12.182j)) < 1e-3
    for A in (0.002, 0.006, 0.03, 3.0):
        result = loop_of(Bilinear(), A, [100.0, 1.0], harmonics=HARMONICS)
        hand = PiecewiseByHand(1.0, [0.5, 1.0], [100.0, 20.0, 0.0])
        c = by_oracle(hand, A, result, True, 1.0)
        for found in (result.harmonics[0], harmonics_of(Bilinear(100.0, 1.0), A)):
            assert np.max(np.abs(found - c)) < 1e-8 * np.max(np.abs(c))


def test_a_force_stays_where_both_branches_lead():
    law, jenkins = Returning(100.0, 1.0), di.MaxwellSlip([0.01], [100.0])
    for A in (0.005, 0.012, 0.03, 3.0):
        assert harmonics_of(law, A) == pytest.approx(harmonics_of(jenkins, A), rel=1e-9, abs=1e-9)
    x = 0.03 * np.cos(np.linspace(0.0, 12.0, 400))
    assert law.force(x) == pytest.approx(jenkins.force(x), abs=1e-12)


@pytest.mark.parametrize("law", [Pinched, PinchedBySquares])
def test_pinched_slopes(law):
    for A in (0.002, 0.006, 0.03):
        result = loop_of(law(), A, [100.0, 1.0], harmonics=HARMONICS)
        hand = PiecewiseByHand(1.0, [0.2975, 0.3025, 1.0], [100.0, 10.0, 100.0, 0.0])
        c = by_oracle(hand, A, result, True, 1.0)
        for found in (result.harmonics[0], harmonics_of(law(100.0, 1.0), A)):
            assert np.max(np.abs(found - c)) < 1e-8 * np.max(np.abs(c))


def test_even_harmonics_of_a_rate_dependent_law():
    class ByHand(DahlByHand):
        def _slope(self, v, s, F):
            level = self.f_max * (1.0 + self.asymmetry * s) * (1.0 + 0.3 * np.exp(-(v**2)))
            return float(self.sigma * (1.0 - s * F / level))

    system = translate(law_equations(Drifting()))
    assert not system.odd
    result = loop_of(Drifting(), 2.0, [3.0, 1.0, 0.4], harmonics=HARMONICS)
    c = by_oracle(ByHand(1.0, 3.0, asymmetry=0.4), 2.0, result, False, 1.0)
    assert abs(c[2]) > 1e-2
    for found in (result.harmonics[0], harmonics_of(Drifting(3.0, 1.0, 0.4), 2.0)):
        assert np.max(np.abs(found - c)) < 1e-9 * np.max(np.abs(c))


def test_even_harmonics_where_directions_differ_at_large_forces_alone():
    class ByHand(DahlByHand):
        def _slope(self, v, s, F):
            softer = 0.75 - 0.25 * np.tanh(2.0 * (F - 10.0))
            return float(self.sigma * (1.0 - s * F / 30.0) * softer)

    law, amplitude = Preloaded(1e4, 30.0), 2.1e-3
    result = loop_of(law, amplitude, [1e4, 30.0], harmonics=HARMONICS)
    c = by_oracle(ByHand(30.0, 1e4), amplitude, result, False, 30.0)
    assert abs(c[2]) > 1.0
    for found in (result.harmonics[0], harmonics_of(law, amplitude)):
        assert np.max(np.abs(found - c)) < 1e-9 * np.max(np.abs(c))


def test_even_harmonics_of_a_comparison_of_the_force():
    """From a force F a stiffness k leads to s f - (s f - F) exp(-k p/f) after a path p."""
    k, f, A = 1e4, 30.0, 2.1e-3

    def branch(start, s):
        first, then = (k, 0.5 * k) if s > 0.0 else (0.5 * k, k)
        kink = f / first * np.log((s * f - start) / (s * f - 10.0))

        def force(p):
            early = s * f - (s * f - start) * np.exp(-first * p / f)
            late = s * f - (s * f - 10.0) * np.exp(-then * (p - kink) / f)
            return np.where(p < kink, early, late)

        return loop_oracles.Branch(force, [kink])

    top = 15.0
    for _ in range(100):
        bottom = float(branch(top, -1.0).force(2.0 * A))
        top = float(branch(bottom, 1.0).force(2.0 * A))
    assert top > 10.0 > bottom
    expected = loop_oracles.harmonics_of([branch(top, -1.0), branch(bottom, 1.0)], A, HARMONICS)
    assert abs(expected[2]) > 0.1
    found = (loop_of(Stepped(), A, [k, f], harmonics=HARMONICS).harmonics[0],
             harmonics_of(Stepped(k, f), A))  # fmt: skip
    for c in found:
        assert np.max(np.abs(c - expected)) < 1e-9 * np.max(np.abs(expected))


@pytest.mark.parametrize("law", [Geared, Reversing])
def test_derivatives_of_loops_with_a_kink_at_a_speed(law):
    values, A, omega, orders = np.array([1e4, 30.0, 0.36]), 0.01, 40.0, (1, 3)

    def expected(p, A):
        k, f, v_0 = p
        half = np.sqrt(A**2 - (v_0 / omega) ** 2)  # |x| where the speed is v_0

        def softened(path):
            return path - law.loss * np.clip(path - A + half, 0.0, 2.0 * half)

        share = np.exp(-k * softened(2.0 * A) / f)
        start = -f * (1.0 - share) / (1.0 + share)

        def along(path):
            return f - (f - start) * np.exp(-k * softened(path) / f)

        kinks = [A - half, A + half]
        branches = [
            loop_oracles.Branch(lambda path: -along(path), kinks),
            loop_oracles.Branch(along, kinks),
        ]
        return loop_oracles.harmonics_of(branches, A, orders)

    system = translate(law_equations(law()))
    arguments = (system, np.array([A]), np.array([omega]), values[None])
    size = np.max(np.abs(expected(values, A)))
    for kernel in (loops, settled):
        result = kernel(*arguments, chosen=range(3), harmonics=orders)
        assert np.max(np.abs(result.harmonics[0] - expected(values, A))) < 1e-9 * size
        slopes = central_differences(lambda f: expected(f[:3] * values, f[3] * A), np.ones(4), 1e-5)
        assert np.max(np.abs(result.by_parameter[0] * values - slopes[:3].T)) < 1e-6 * size
        assert np.max(np.abs(result.by_amplitude[0] * A - slopes[3])) < 1e-6 * size


def test_a_short_time_near_rest_is_not_passed_over():
    """Speeds are hundreds of times that at which the limit falls."""
    speed = 1e-3
    spline = CubicSpline(np.linspace(0.0, 1.0, 8), 0.02 * seeded(1).standard_normal(8))
    samples = np.linspace(0.0, 1.0, 60)
    motion = in_time(Sticky(), spline, samples, np.array([1e4, 30.0, 20.0, speed]))
    slow = [spline.derivative().solve(v, extrapolate=False)
            for v in speed * np.array([-6, -3, -1, 0, 1, 3, 6])]  # fmt: skip
    places = np.unique(np.concatenate([spline.x, *slow]))
    places = places[(places > 0.0) & (places < 1.0)]
    hand = DahlByHand(30.0, 1e4, static_ratio=5.0 / 3.0, speed=speed)
    oracle = Oracle([hand], lambda t: (float(spline(t)), float(spline(t, 1))), True,
                    sizes=np.array([30.0]))  # fmt: skip
    _, force, _ = integrated(oracle, np.zeros(1), 0.0, 1.0, samples, kinks=places.tolist())
    assert np.max(np.abs(motion.output - force)) < 1e-8 * np.max(np.abs(force))


def test_derivatives_of_settled_motions_are_differences_of_oracles():
    """A plant with a gap: harmonics by drive and every parameter, through moving kinks."""
    values = np.array([1.0, 300.0, 1.0, 0.002, 0.1, 0.5, 200.0])
    drive, omega, harmonics = 2.5, 40.0, (1, 3)
    result = at_one(in_plant(di.Backlash(di.Dahl(alpha=1.0))), drive, values, omega,
                    chosen=range(values.size), harmonics=harmonics)  # fmt: skip
    assert result.found[0]

    def oracle(p, U):
        hand = DahlByHand(p[0], p[1], p[2], gap=p[3])
        plant = Oracle([hand], lambda t: (U * np.cos(omega * t), 0.0), False, p[4], p[5], p[6],
                       np.array([1e-2, 0.4, 1.0, 1e-2]))  # fmt: skip
        return fixed_point(plant, result.starts[0], result.maps[0], omega, True, harmonics)[1]

    size = np.max(np.abs(result.harmonics[0]))
    slopes = central_differences(  # an exponent of 1 has a law of its own
        lambda f: oracle(np.insert(f[:6], 2, 1.0) * values, f[6] * drive), np.ones(7), 1e-4
    )
    exact = np.delete(result.by_parameter[0] * values, 2, axis=1)
    assert np.max(np.abs(exact - slopes[:6].T)) < 1e-6 * size
    assert np.max(np.abs(result.by_amplitude[0] * drive - slopes[6])) < 1e-6 * size


def test_the_closed_form_of_a_history_keeps_its_force_at_rest():
    x = np.cumsum(0.01 * seeded(51).standard_normal(12))
    law = DahlByHand(1.0, 300.0, gap=0.004)
    at_rest = np.repeat(dahl_history(law, x), 2)
    np.testing.assert_array_equal(dahl_history(law, np.repeat(x, 2)), at_rest)


def test_derivatives_along_a_history_jump_at_kinks():
    rng = seeded(50)
    spline = CubicSpline(np.linspace(0.0, 1.0, 12), 0.01 * rng.standard_normal(12))
    samples = np.sort(np.append(rng.uniform(0.0, 1.0, 60), [0.0, 1.0]))
    values, chosen = np.array([1.0, 300.0, 1.0, 0.004]), (0, 1, 3)
    law = di.Backlash(di.Dahl(alpha=1.0))
    motion = in_time(law, spline, samples, values, chosen=chosen, derivatives=True)
    times = np.union1d(samples, spline.derivative().roots(extrapolate=False))

    def force(p):
        history = dahl_history(DahlByHand(p[0], p[1], gap=p[3]), spline(times))
        return history[np.searchsorted(times, samples)]

    size = np.max(np.abs(motion.output))
    slopes = central_differences(lambda f: force(f * values), np.ones(4), 1e-6)[list(chosen)]
    assert np.max(np.abs(motion.by_parameter * values[list(chosen)] - slopes.T)) < 1e-6 * size


def test_derivatives_of_a_force_that_parameters_change_at_once():
    """A power of the speed, in closed form."""
    spline = CubicSpline(np.linspace(0.0, 1.0, 8), 0.1 * seeded(64).standard_normal(8))
    samples = np.linspace(0.0, 1.0, 50)
    c, p, v_0 = values = np.array([2.0, 0.7, 0.3])
    law = di.PowerDamper(reference_speed=0.3)
    motion = in_time(law, spline, samples, values, chosen=range(3), derivatives=True)
    ratio = spline(samples, 1) / v_0
    square = ratio**2 + 1e-12
    force = c * ratio * square ** (0.5 * (p - 1.0))
    by_ratio = force / ratio + force * (p - 1.0) * ratio / square
    expected = [force / c, 0.5 * force * np.log(square), -by_ratio * ratio / v_0]
    assert motion.output == pytest.approx(force, abs=1e-9)
    assert np.max(np.abs(motion.by_parameter - np.transpose(expected))) < 1e-8


def test_derivatives_of_harmonics_that_parameters_change_at_once():
    """The same law under a sine, by gamma functions."""
    c, p, v_0 = values = np.array([2.0, 0.7, 0.3])
    A, omega = 0.02, 40.0
    result = loop_of(di.PowerDamper(reference_speed=0.3), A, values, chosen=range(3), omega=omega)
    first = 2.0 / np.sqrt(np.pi) * gamma(0.5 * p + 1.0) / gamma(0.5 * p + 1.5)
    c_1 = 1j * c * first * (A * omega / v_0) ** p
    by_p = np.log(A * omega / v_0) + 0.5 * (digamma(0.5 * p + 1.0) - digamma(0.5 * p + 1.5))
    assert abs(result.harmonics[0, 0] - c_1) < 1e-7 * abs(c_1)
    assert abs(result.by_amplitude[0, 0] - p * c_1 / A) < 1e-6 * abs(c_1 / A)
    expected = c_1 * np.array([1.0 / c, by_p, -p / v_0])
    assert np.max(np.abs(result.by_parameter[0, 0] - expected) * values) < 1e-6 * abs(c_1)


def test_derivatives_of_driven_motions_are_differences_of_oracles():
    """Several Jenkins elements, by parameters and by the first state."""
    n, interval = 40, 0.01
    times: FloatArray = interval * np.arange(n, dtype=float)
    omega = 2.0 * np.pi * np.array([3.0, 5.0, 8.0]) / (n * interval)

    def drive(t):
        return float(np.sum(1.2 * np.cos(omega * t + np.array([0.3, 1.1, 2.0])))), 0.0

    sampled = np.array([drive(t)[0] for t in times])
    coefficients = band_limited(sampled, interval)
    values, first = np.array([30.0, 20.0, 0.02, 0.06, 0.5, 0.8, 40.0]), np.array([0.01, 0.05, 0, 0])
    motion = march(in_plant(di.MaxwellSlip(2)), times, coefficients, times, first, values,
                   chosen=range(7), derivatives=True)  # fmt: skip

    def oracle(p, y):
        hand = JenkinsByHand(p[:2], p[2:4])
        free = Oracle([hand], drive, False, p[4], p[5], p[6], np.array([0.1, 1.0, 1.0, 1.0]))
        return integrated(free, y, 0.0, times[-1], times)[1]

    size = np.max(np.abs(motion.output))
    assert np.max(np.abs(oracle(values, first) - motion.output)) < 1e-8 * size
    (slope,) = central_differences(  # by a limit; settled motions have all of them
        lambda f: oracle(values * np.insert(np.ones(6), 3, f), first), [1.0], 1e-5
    )
    assert np.max(np.abs(motion.by_parameter[:, 3] * values[3] - slope)) < 2e-6 * size
    step = np.array([0.0, 1e-6, 0.0, 0.0])
    difference = (oracle(values, first + step) - oracle(values, first - step)) / 2e-6
    assert np.max(np.abs(motion.by_first[:, 1] - difference)) < 1e-6


@pytest.mark.parametrize("alpha", [0.9, 0.97, 1.03])
def test_derivatives_of_a_motion_that_slips_far(alpha):
    """A hundred x_c of slip bring the force to its limit within rounding, and beyond it.

    Exponents near 1 come so close; outputs are compared with oracles elsewhere.
    """
    rate, rng = 500.0, seeded(62)
    t = np.arange(2000) / rate
    lines = np.arange(2, 60) / 4.0
    drive = np.sin(2.0 * np.pi * (lines[:, None] * t + rng.random((lines.size, 1)))).sum(axis=0)
    plant = di.Dahl(alpha=None) + di.Mass() + di.Damper() + di.Spring()
    driven = Driven(plant, 2.0 * drive / drive.std(), rate)
    values = np.array([0.5, 2e3, alpha, 0.3, 0.5, 400.0])
    by = driven.motion(np.zeros(3), values, derivatives=True).by_parameter
    slopes = central_differences(
        lambda moved: driven.motion(np.zeros(3), moved).output, values, 1e-5 * values
    )
    for exact, slope in zip(by.T, slopes, strict=True):
        assert np.linalg.norm(exact - slope) < 0.02 * np.linalg.norm(slope)


def test_friction_faster_than_the_sampling():
    """f_max 0.5, m 1, c 1, k 400 at 100 Hz: sigma 30,000 slips within a thousandth of a sample."""
    n, interval = 128, 0.01
    lines = 2.0 * np.pi * np.arange(1, 20) / (n * interval)
    phase = seeded(60).uniform(0.0, 2.0 * np.pi, lines.size)

    def drive(t):
        return float(np.sum(0.4 * np.cos(lines * t + phase))), 0.0

    times: FloatArray = interval * np.arange(n, dtype=float)
    sampled = np.array([drive(t)[0] for t in times])
    coefficients = band_limited(sampled, interval)
    system = in_plant(di.Dahl())
    for sigma in (300.0, 3_000.0, 30_000.0):
        values = cases.all_values(cases.Drawn(0, di.Dahl(), [0.5, sigma], 1, 1), 1.0, 1.0, 400.0)
        motion = march(system, times, coefficients, times, np.zeros(3), values)
        plant = Oracle([DahlByHand(0.5, sigma)], drive, False, 1.0, 1.0, 400.0,
                       np.array([1e-2, 0.1, 0.5]))  # fmt: skip
        _, expected, _ = integrated(plant, np.zeros(3), 0.0, times[-1], times)
        assert np.max(np.abs(expected - motion.output)) < 1e-8 * np.max(np.abs(expected))


@pytest.mark.parametrize("share", [1e-3, 0.3, 0.99, 1.01, 3.0])
def test_plants_near_stick_and_in_resonance(share):
    """The paper's plant, its drive from a thousandth of the friction limit on."""
    for omega in (2.0, np.sqrt(30.3 / 0.3)):
        result = at_one(in_plant(di.Dahl()), 0.1 * share, PAPER, omega, harmonics=HARMONICS)
        assert result.found[0]
        size = float(np.max(np.abs(result.harmonics[0])))
        sizes = np.array([size, size * omega, min(0.1, 30.0 * size)])
        plant = paper_plant(0.1 * share, omega, sizes)
        _, c, _ = fixed_point(plant, result.starts[0], result.maps[0], omega, True)
        assert np.max(np.abs(result.harmonics[0] - c)) < 1e-8 * size


@pytest.mark.parametrize("odd", [True, False])
def test_derivatives_of_a_plant_that_sticks_are_those_of_springs(odd):
    """Jenkins elements that never slip, in closed form; by whole cycles their offsets are free."""
    values = np.array([30.0, 20.0, 0.02, 0.06, 0.5, 0.8, 40.0])
    U, omega = 0.1, 9.0
    system = replace(in_plant(di.MaxwellSlip(2)), odd=odd)
    result = at_one(system, U, values, omega, chosen=range(7), harmonics=(0, 1))
    R = 1.0 / (90.0 - 0.5 * omega**2 + 0.8j * omega)
    assert U * abs(R) < 0.02
    expected = -U * R**2 * np.array([1.0, 1.0, 0.0, 0.0, -(omega**2), 1j * omega, 1.0])
    assert np.max(np.abs(result.harmonics[0] - [0.0, U * R])) < 1e-9 * abs(U * R)
    assert np.max(np.abs(result.by_amplitude[0] - [0.0, R])) < 1e-8 * abs(R)
    error = (result.by_parameter[0] - [np.zeros(7), expected]) * values
    assert np.max(np.abs(error)) < 1e-8 * abs(U * R)


def test_where_no_motion_settles_none_is_found():
    """Undamped, without friction, in resonance; and a plant that grows without bounds."""
    system = translate(plant_equations(di.Mass() + di.Damper() + di.Spring()))
    result = settled(system, np.ones(2), np.array([10.0, 10.0]),
                     np.array([[1.0, 0.0, 100.0], [1.0, 1e-3, 100.0]]))  # fmt: skip
    assert result.found.tolist() == [False, True]
    assert np.isnan(result.harmonics[0]).all()
    assert abs(result.harmonics[1, 0] - 1.0 / (1j * 10.0 * 1e-3)) < 1e-6 * 100.0
    knots = np.linspace(0.0, 100.0, 11)
    with pytest.raises(FitError, match="beyond all bounds"):
        march(system, knots, np.ones((1, 10)), knots, np.zeros(2), np.array([1.0, -200.0, 1.0]))


def test_derivatives_that_do_not_exist_are_not_made_up():
    """At rest hypot(F, v) has none; the motion itself is known."""
    x, v, F, u, s, k = (ca.SX.sym(name) for name in "xvFusk")
    rates = ca.vertcat(v, u - F, k * v * (1.0 - ca.hypot(F, v)))
    system = translate(Equations([x, v, F], u, s, [k], rates, x, False))
    times: FloatArray = 0.1 * np.arange(10.0)
    arguments = (system, times, np.zeros((1, 9)), times, np.zeros(3), np.ones(1))
    assert np.array_equal(march(*arguments).output, np.zeros(10))
    with pytest.raises(FitError):
        march(*arguments, derivatives=True)


def test_floquet_maps_are_those_of_an_independent_integrator():
    omega, sizes = 3.0, np.array([0.03, 0.1, 0.1])
    result = at_one(in_plant(di.Dahl()), 0.3, PAPER, omega)
    plant = paper_plant(0.3, omega, sizes)
    slopes = central_differences(
        lambda f: integrated(plant, result.starts[0] + f * sizes, 0.0, np.pi / omega)[0] / sizes,
        np.zeros(3), 1e-5,
    )  # fmt: skip
    assert np.max(np.abs(result.maps[0] * sizes / sizes[:, None] - slopes.T)) < 1e-6


@pytest.mark.parametrize("home", ["unwritable", "missing"])
def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, home):
    place = tmp_path / "file"
    place.write_text("")
    code = (
        "from dahl_ident.engine import motion\n"
        "import sys; sys.modules['dahl_ident.engine.march'] = sys\n"  # nothing is compiled
        "motion.kernels('march')\n"
    )
    environment = os.environ | {
        "XDG_CACHE_HOME": str(place if home == "unwritable" else place / "x")
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("installation", "said"), [("another", 1), ("this", 0)])
def test_compiling_is_announced_once_whatever_another_installation_has(
    tmp_path, installation, said
):
    code = (
        "from pathlib import Path; import sys; from dahl_ident.engine import motion\n"
        "names = ('cycle', 'samples', 'loop')\n"
        "sys.modules |= {f'dahl_ident.engine.{name}': sys for name in (*names, 'radau')}\n"
        "motion._say_that_it_compiles = lambda: None\n"
        "motion.kernels('radau')\n"  # makes the cache's folder
        "from importlib import reload; reload(motion)\n"
        "from numba.core.caching import _CacheLocator\n"
        "own = _CacheLocator.get_suitable_cache_subpath(motion.__file__)\n"
        f"folder = own if {installation == 'this'} else own[:-1] + 'x'\n"
        f"folder = next(Path({str(tmp_path)!r}).glob('dahl_ident/engine-*')) / folder\n"
        "folder.mkdir()\n"
        "for name in names:\n"
        "    (folder / f'{name}.kernel-1.py312.nbi').touch()\n"
        "    motion.kernels(name)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"XDG_CACHE_HOME": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    message = "compiling the engine, once (one to two minutes) ...\n"
    assert done.stderr == said * message


def test_derivatives_are_smoothed_as_far_as_the_motion_allows():
    """By five samples, the fewest, the velocity would have an error of 0.1 m/s."""
    t = np.arange(2000) / 1000.0
    noise = 1e-4 * np.random.default_rng(1).standard_normal(t.size)
    v, _ = differentiated(np.sin(2.0 * np.pi * t) + noise, 1e-3)
    assert np.std(v - 2.0 * np.pi * np.cos(2.0 * np.pi * t)) < 5e-3
    v, _ = differentiated(np.full(100, 0.3), 1e-3)
    assert np.abs(v).max() < 1e-9


def test_derivatives_of_motions_up_to_half_the_rate_are_central_differences():
    """Five samples and degree 4: the differences of order 4."""
    n, h = 200, 0.1
    t = np.arange(n)
    phase = seeded(63).uniform(0.0, 2.0 * np.pi, (69, 1))
    x = np.cos(2.0 * np.pi * np.arange(1, 70)[:, None] * t / n + phase).sum(axis=0)
    v, a = differentiated(x, h)
    first = (x[:-4] - 8.0 * x[1:-3] + 8.0 * x[3:-1] - x[4:]) / (12.0 * h)
    second = (16.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:] - 30.0 * x[2:-2]) / (12.0 * h**2)
    assert v[2:-2] == pytest.approx(first, abs=1e-10)
    assert a[2:-2] == pytest.approx(second, abs=1e-9)

"""The exact force for a displacement history, against integration and its own invariants."""

import tracemalloc
from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dahl_ident.elements import Dahl, hysteresis
from dahl_ident.elements.hysteresis import force_history, transient_decay
from tests.derivatives import central_differences
from tests.histories import integrated_force

F_MAX, SIGMA = 0.1, 30.0
X_C = F_MAX / SIGMA
ALPHAS = [0.25, 0.5, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.5, 2.0, 4.0]

histories = st.lists(
    st.floats(-20.0, 20.0).map(lambda v: round(v, 6) * X_C), min_size=2, max_size=30
).map(np.array)
alphas = st.one_of(st.just(1.0), st.floats(0.05, 8.0))
starts = st.floats(-1.0, 1.0).map(lambda v: v * F_MAX)


def generator(seed):
    return np.random.Generator(np.random.PCG64(seed))


def by_mpmath(x, alpha, initial_force):
    """The stretch-by-stretch solution with 40 digits."""
    with mp.workdps(40):
        F = mp.mpf(initial_force) / F_MAX
        p = 1 - mp.mpf(alpha)
        out = [F]
        for a, b in pairwise(x):
            s = mp.sign(mp.mpf(b) - mp.mpf(a))
            z = 1 - s * F
            d = abs(mp.mpf(b) - mp.mpf(a)) * SIGMA / F_MAX
            if s != 0:
                rest = z**p - p * d if z > 0 and p != 0 else None
                z = z * mp.exp(-d) if p == 0 else (rest ** (1 / p) if rest and rest > 0 else 0 * z)
                F = s * (1 - z)
            out.append(F)
        return np.array([float(F * F_MAX) for F in out])


@pytest.mark.parametrize("alpha", ALPHAS)
def test_force_agrees_with_multiple_precision_over_any_step(alpha):
    rng = generator(4)
    x = 10.0 ** rng.uniform(-15, 9, 400) * rng.choice([-1.0, 1.0], 400) * X_C
    x[50:250] = np.cumsum(10.0 ** rng.uniform(-15, 1, 200) * rng.choice([-1.0, 1.0], 200)) * X_C
    x[300:303] = x[300]  # a pause
    force = force_history(x, F_MAX, SIGMA, alpha, 0.3 * F_MAX)
    assert np.max(np.abs(force - by_mpmath(x, alpha, 0.3 * F_MAX))) < 1e-12 * F_MAX


@given(x=histories, alpha=alphas, initial_force=starts)
def test_force_is_bounded_odd_and_dissipates(x, alpha, initial_force):
    force = force_history(x, F_MAX, SIGMA, alpha, initial_force)
    assert np.max(np.abs(force)) <= F_MAX * (1.0 + 1e-15)
    turned = force_history(-x, F_MAX, SIGMA, alpha, -initial_force)
    assert turned == pytest.approx(-force, abs=1e-14 * F_MAX, rel=0.0)
    # the force never falls while the displacement rises
    assert np.all(np.diff(force) * np.sign(np.diff(x)) >= -1e-15 * F_MAX)


def test_no_motion_keeps_the_initial_force():
    for n in (0, 1, 2, 7):
        force = force_history(np.full(n, 3.0), F_MAX, SIGMA, 1.0, -0.05)
        assert np.array_equal(force, np.full(n, -0.05))


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_full_slip_is_left_and_kept_as_the_direction_says(alpha, direction):
    x = direction * np.array([0.0, 1e-9, 1.0, 1e3]) * X_C
    onward = force_history(x, F_MAX, SIGMA, alpha, direction * F_MAX)
    assert np.array_equal(onward, np.full(4, direction * F_MAX))
    back = force_history(-x, F_MAX, SIGMA, alpha, direction * F_MAX)
    assert back == pytest.approx(by_mpmath(-x, alpha, direction * F_MAX), rel=1e-13)


@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_memory_stays_small(alpha):
    x = generator(6).standard_normal(100_000) * X_C
    tracemalloc.start()
    force = force_history(x, F_MAX, SIGMA, alpha, 0.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * (x.nbytes + force.nbytes)


def loop(amplitude, alpha, points):
    return Dahl(F_MAX, SIGMA, alpha).loop(amplitude, points)


@pytest.mark.parametrize("alpha", [0.25, 0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("beta", [0.3, 1.0, 30.0])
@pytest.mark.parametrize("points", [4, 401])
def test_steady_loop_is_what_a_history_settles_into(alpha, beta, points):
    x, force = loop(beta * X_C, alpha, points)
    theta = np.linspace(0.0, 2.0 * np.pi, 1201)[:-1]
    assert x == pytest.approx(beta * X_C * np.cos(np.linspace(0.0, 2.0 * np.pi, points)))
    cycles = 120
    history = beta * X_C * np.tile(np.cos(theta), cycles)
    settled = force_history(history, F_MAX, SIGMA, alpha, 0.0)[-1200:]
    step = 1200 // (points - 1)
    assert force[:-1] == pytest.approx(settled[::step], abs=1e-12 * F_MAX)
    assert force[-1] == pytest.approx(force[0], rel=1e-12)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("beta", [0.02, 0.2, 0.6])
def test_transient_decay_is_the_ratio_of_deviations_a_cycle_apart(alpha, beta):
    x, force = loop(beta * X_C, alpha, 3)
    deviation = 1e-6 * F_MAX
    disturbed = force_history(x, F_MAX, SIGMA, alpha, force[0] + deviation)
    factor = transient_decay(np.array([beta]), alpha)[0]
    assert (disturbed[-1] - force[-1]) / deviation == pytest.approx(factor, rel=1e-5)


def test_linear_history_derivatives():
    rng = np.random.default_rng(5)
    x = np.cumsum(rng.standard_normal(400)) * 1e-3
    point = np.array([0.05, 0.2, 30.0])  # initial force, f_max, sigma

    def force(at):
        start, f_max, sigma = at.tolist()
        return force_history(x, f_max, sigma, 1.0, start)

    found, by_start, by = hysteresis.linear_history_gradient(x, 0.2, 30.0, 0.05)
    np.testing.assert_allclose(found, force(point), rtol=0.0, atol=1e-14)
    expected = central_differences(force, point, 1e-5 * point)
    for one, other in zip((by_start, *by), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-8 * np.abs(other).max())


@pytest.mark.parametrize("alpha", [0.7, 1.0, 1.5])
def test_a_start_at_the_limit_may_exceed_it_by_rounding(alpha):
    x = np.sin(np.linspace(0.0, 20.0, 200))
    above, at = (force_history(x, 1.0, 30.0, alpha, start) for start in (1.0 + 4e-16, 1.0))
    np.testing.assert_allclose(above, at, atol=1e-9)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 1.5])
def test_force_beyond_the_limit_relaxes_towards_it(alpha):
    """An estimate of the force at the first sample may exceed the limit."""
    x = 1e-3 * np.sin(np.linspace(0.0, 12.0, 2001))

    def slope(force, direction):
        margin = 1.0 - direction * force
        return float(1000.0 * np.abs(margin) ** alpha * np.sign(margin))

    expected = integrated_force(slope, x, 1.3, steps=4)
    np.testing.assert_allclose(force_history(x, 1.0, 1000.0, alpha, 1.3), expected, atol=1e-5)

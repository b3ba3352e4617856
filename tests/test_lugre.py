"""LuGre friction: settled sines, motion in time, and when it cannot be told from Dahl."""

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp

from dahl_ident import (
    Dahl,
    Damper,
    FrequencyResponse,
    Friction,
    LuGre,
    Mass,
    Parameter,
    Record,
    Spring,
    fit,
    response,
)
from dahl_ident.errors import ModelError, ValidationError
from tests.recovery import assert_near
from tests.test_generic_friction import SlopeOfLuGre

LAW = LuGre(1.0, 300.0, 1.6, 0.02, 0.4, 0.3)


def test_without_stribeck_effect_it_is_linear_dahl_with_a_damper():
    A, w = np.geomspace(1e-5, 10.0, 13)[:, None], np.array([0.1, 10.0])
    plain = LuGre(2.0, 50.0, 1.0, 0.1, 0.0, 0.7).dynamic_stiffness(A, w)
    dahl = (Dahl(2.0, 50.0) + Damper(0.7)).dynamic_stiffness(A, w)
    np.testing.assert_allclose(plain, dahl, rtol=1e-8)
    slow = LuGre(2.0, 50.0, 1.5, 1e9).dynamic_stiffness(A, w)
    np.testing.assert_allclose(slow, Dahl(3.0, 50.0).dynamic_stiffness(A, w), rtol=1e-8)
    three = LuGre(2.0, 50.0, 1.0, 0.1).dynamic_stiffness(A, w, harmonic=3)
    np.testing.assert_allclose(three, Dahl(2.0, 50.0).dynamic_stiffness(A, w, harmonic=3),
                               atol=1e-8 * np.abs(dahl).max())  # fmt: skip


def test_the_distance_from_dahl_says_when_sines_show_a_difference():
    A = np.geomspace(1e-3, 0.3, 10)
    law = LuGre(1.0, 300.0, 1.5, 0.02)
    assert law.distance_from_dahl(A, np.asarray(1e-4)) < 1e-4  # all speeds below Stribeck's
    assert law.distance_from_dahl(A, np.asarray(1e4)) < 1e-3  # all far above
    assert law.distance_from_dahl(A, np.asarray(1.0)) > 0.02


def test_facts_and_refusals():
    with pytest.raises(ModelError, match="depends on the rate"):
        LAW.describing_function(1.0)
    with pytest.raises(ModelError, match="depends on the rate"):
        LAW.loop(1.0)
    with pytest.raises(ValidationError, match="needs velocity"):
        LAW.force([0.0, 1.0])
    with pytest.raises(ValidationError, match="static_ratio"):
        LuGre(static_ratio=0.5)
    values = [np.asarray(v) for v in LAW.known_values()]
    assert [float(v) for v in LAW.force_limits(values)] == pytest.approx([1.6, 1.6])


def moved(t):
    """Return displacement, velocity and acceleration of two sines."""
    parts = [(0.03, 2.0 * np.pi, 0.0), (0.02, 4.6 * np.pi, 1.0)]
    x, v, a = (
        sum(A * w**n * np.sin(w * t + phase + 0.5 * n * np.pi) for A, w, phase in parts)
        for n in range(3)
    )
    return np.asarray(x), np.asarray(v), np.asarray(a)


def stiffness_by_quadrature(numbers, A, w, n=2000):
    """Return N of half a cycle in which the speed is positive, by Runge and Kutta's method.

    The bristles' equation is then linear in their force, so two of its solutions give the settled
    one, which ends at minus its beginning.
    """
    f_max, sigma, ratio, speed, micro, viscous = numbers

    def rate(psi, force):
        limit = f_max * (1.0 + (ratio - 1.0) * np.exp(-((A * w * np.sin(psi) / speed) ** 2)))
        return sigma * A * np.sin(psi) * (1.0 - force / limit)

    h, forces = np.pi / n, [np.stack([np.zeros(A.size), np.ones(A.size)])]
    for psi in h * np.arange(n):
        y = forces[-1]
        k1 = rate(psi, y)
        k2 = rate(psi + 0.5 * h, y + 0.5 * h * k1)
        k3 = rate(psi + 0.5 * h, y + 0.5 * h * k2)
        forces.append(y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(psi + h, y + h * k3)))
    zero, one = np.stack(forces, axis=1)
    force = zero - zero[-1] / (1.0 + one[-1] - zero[-1]) * (one - zero)
    psi = np.linspace(0.0, np.pi, n + 1)[:, None]
    whole = force + (micro / sigma * rate(psi, force) * w) + viscous * A * w * np.sin(psi)
    # the displacement is -A cos(psi): that of a cosine half a cycle later
    return -2.0 / np.pi * simpson(whole * np.exp(-1j * psi), psi, axis=0) / A


@pytest.mark.parametrize("uneven", [False, True])
def test_the_force_along_a_sampled_motion_is_that_of_the_motion(uneven):
    """Of 10 ms sampling, against DOP853 on the motion itself; the speed is continuous."""
    f_max, sigma, ratio, speed, micro, viscous = 1.0, 100.0, 1.5, 0.05, 0.5, 0.2
    t = np.arange(0.0, 3.0, 0.01)
    if uneven:
        t = t + 0.004 * np.random.default_rng(0).uniform(-1.0, 1.0, t.size)
    x, v, a = moved(t)

    def slope(t, force):
        v = moved(np.asarray(t))[1]
        limit = f_max * (1.0 + (ratio - 1.0) * np.exp(-((v / speed) ** 2)))
        return sigma * (v - np.abs(v) * force / limit)

    bristles = solve_ivp(
        slope, (t[0], t[-1]), [0.3], "DOP853", t, rtol=1e-11, atol=1e-12, max_step=2e-3
    ).y[0]
    own = SlopeOfLuGre(f_max, sigma, ratio, speed)
    assert np.abs(own.force(x, 0.3, velocity=v, time=t) - bristles).max() < 2e-5
    law = LuGre(f_max, sigma, ratio, speed, micro, viscous)
    rates = np.array([slope(*at) for at in zip(t, bristles, strict=True)])
    whole = bristles + micro / sigma * rates + viscous * v
    assert np.abs(law.force(x, 0.3, velocity=v, time=t) - whole).max() < 2e-5
    exact = law.force(x, 0.3, velocity=v, acceleration=a, time=t)
    assert np.abs(exact - whole).max() < (1e-7 if not uneven else 1e-6)
    if not uneven:
        assert np.abs(law.force(x, 0.3, velocity=v) - whole).max() < 2e-5


def test_a_record_of_it_is_fitted():
    t = np.arange(1000) / 100.0
    x = 0.01 * np.sin(2.0 * np.pi * 0.5 * t) * np.sin(2.0 * np.pi * 0.05 * t)
    law = LuGre(1.0, 300.0, 1.6, 0.02)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(1000)
    force = law.force(x, velocity=np.gradient(x, t)) + noise
    found = fit(Record(t, displacement=x, force=force), LuGre())
    for name, truth in (("f_max", 1.0), ("sigma", 300.0), ("static_ratio", 1.6)):
        assert found.params[name].value == pytest.approx(truth, rel=0.02)


def test_its_damping_may_be_far_larger_than_the_force_of_the_bristles():
    A, w = np.geomspace(3e-4, 0.1, 7), np.repeat(62.8, 7)
    numbers = (1.0, 300.0, 1.6, 0.02, 30.0, 0.3)
    assert LuGre(*numbers).dynamic_stiffness(A, w) == pytest.approx(
        stiffness_by_quadrature(numbers, A, w), rel=1e-6
    )


@pytest.mark.parametrize(
    ("numbers", "model"),
    [
        ((1.0, 300.0, 1.6, 0.02, 0.4, 0.3), LuGre(micro_damping=None, viscous=None)),
        ((5.0, 1e5, 1.3, 1e-3, 40.0, 0.5), LuGre(micro_damping=None, viscous=0.5)),
    ],
)
def test_its_damping_is_found_without_a_start(numbers, model):
    f, ratio = (a.ravel() for a in np.meshgrid([0.3, 10.0], np.geomspace(0.1, 30.0, 9)))
    A = ratio * numbers[0] / numbers[1]
    N = stiffness_by_quadrature(numbers, A, 2.0 * np.pi * f)
    noise = np.random.default_rng(1).standard_normal((2, A.size))
    found = fit(FrequencyResponse(f, N * np.exp(0.005 * (noise[0] + 1j * noise[1])), A), model)
    assert_near(found, LuGre(*numbers), 3.0, 0.15)


def test_a_motion_that_turns_just_before_a_sample_ends_there():
    x, v, a = [0.01094447, 0.0110331], [3.56285877e-02, -5.26156355e-07], [-7.13556111, -7.06570654]
    force = LuGre(1.0, 3000.0, 1.5, 0.016).force(x, velocity=v, acceleration=a, time=[0.285, 0.29])
    assert force[1] == pytest.approx(0.2374, abs=1e-4)


@pytest.mark.parametrize(
    ("divided", "whole"),
    [
        (lambda v, v_0: (np.abs(v) / v_0) ** 1.5, lambda v, v_0: np.abs(v / v_0) ** 1.5),
        (lambda v, v_0: np.sqrt(np.abs(v) / v_0), lambda v, v_0: np.sqrt(np.abs(v / v_0))),
    ],
)
def test_a_root_of_a_speed_may_be_divided_within_it(divided, whole):
    """At a turning point, rounding must not make the root's argument negative."""

    def law(power):
        class Falling(Friction):
            kind = "falling"
            rate_independent = False
            parameters = (
                Parameter("f_max", "N", "limit", lower=0.0, transform="log"),
                Parameter("sigma", "N/m", "stiffness", lower=0.0, transform="log"),
            )

            def slope(self, force, direction, velocity, values):
                f_max, sigma = values
                limit = f_max * (1.0 + 0.6 * np.exp(-power(velocity, 0.02)))
                return sigma * (1.0 - direction * force / limit)

        return Falling(1.0, 300.0)

    found = [
        response(law(power) + Mass(1.0) + Damper(0.5) + Spring(10.0), 1.0, 2.0).amplitude
        for power in (divided, whole)
    ]
    assert float(found[0]) == pytest.approx(float(found[1]), rel=1e-9)
    assert float(found[1]) == pytest.approx(0.0584, abs=1e-4)


def test_a_value_beyond_its_bound_by_rounding_is_at_the_bound():
    values = [0.1, 30.0, np.nextafter(100.0, 101.0), 0.1, 0.0, 0.0]
    assert LuGre().resembles(values, np.array([1e-3, 1e-2]), np.array([6.0, 6.0])) is not None

"""A law written in ten lines has everything that an element has, from its slope alone."""

import mpmath
import numpy as np
import pytest
from scipy.integrate import trapezoid

from dahl_ident import Backlash, Dahl, Friction, Model, Parameter
from dahl_ident.elements.facts import Path
from dahl_ident.errors import ModelError

pytestmark = pytest.mark.versions


class Jenkins(Friction):
    """An elastoplastic element: stiff up to its limit, then full slip."""

    kind = "jenkins"
    parameters = (
        Parameter("stiffness", "N/m", "elastic stiffness", lower=0.0, transform="log"),
        Parameter("slip", "m", "displacement at which it slips", lower=0.0, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        stiffness, slip = values
        return stiffness * (direction * force < stiffness * slip)


class SlopeOfDahl(Friction):
    """Dahl's law without its closed forms."""

    parameters = Dahl.parameters

    def slope(self, force, direction, velocity, values):
        f_max, sigma, alpha = values
        margin = 1.0 - direction * force / f_max
        return sigma * np.sign(margin) * np.abs(margin) ** alpha


def jenkins(k, slip, A):
    """Return the closed form of the describing function."""
    m = np.minimum(slip / A, 1.0)
    t = np.arccos(1.0 - 2.0 * m)
    slipping = k / np.pi * (t - np.sin(t) * np.cos(t)) + 4j * k / np.pi * m * (1.0 - m)
    return np.where(slip >= A, k + 0j, slipping)


def test_an_elastoplastic_law_has_its_closed_form():
    A = np.concatenate([np.geomspace(0.01, 0.999, 15), [1.0], 1.0 + np.geomspace(1e-8, 1e4, 40)])
    N = Jenkins(3.0, 1.0).describing_function(A)
    exact = jenkins(3.0, 1.0, A)
    assert np.max(np.abs(N - exact) / np.abs(exact)) < 1e-8
    assert complex(Jenkins(3.0, 1.0).describing_function(1.3)) == pytest.approx(
        2.4762675 + 0.6780566j, abs=1e-7
    )


@pytest.mark.parametrize(("alpha", "within"), [(1.0, 1e-9), (2.0, 1e-9), (0.5, 1e-5)])
def test_dahl_from_its_slope_agrees_with_its_closed_forms(alpha, within):
    values = [np.asarray(v) for v in (1.3, 7.0, alpha)]
    A = np.geomspace(1e-5, 1e4, 181) * 1.3 / 7.0
    at_rest = np.zeros(())
    size = np.abs(Dahl(1.3, 7.0, alpha).describing_function(A))
    for k in range(8):
        ours = SlopeOfDahl(1.3, 7.0, alpha).stiffness(values, A, at_rest, k)
        exact = Dahl(1.3, 7.0, alpha).stiffness(values, A, at_rest, k)
        assert np.max(np.abs(ours - exact) / size) < within * (1.0 if k < 4 else 3.0)


def test_batches_of_parameters_and_rest():
    law = SlopeOfDahl()
    values = [np.array([[1.0], [2.0]]), np.array([[3.0], [5.0]]), np.array(2.0)]
    A = np.array([0.0, 1e-6, 0.3, 4.0])
    ours = law.stiffness(values, A, np.zeros(()))
    np.testing.assert_allclose(ours, Dahl().stiffness(values, A, np.zeros(())), rtol=1e-9)
    assert ours[:, 0].tolist() == [3.0, 5.0]


def test_derivatives_agree_with_those_of_the_closed_forms():
    law = Model(SlopeOfDahl(1.3, 7.0, 2.0)).with_free(["f_max", "sigma", "alpha"])
    exact = Model(Dahl(1.3, 7.0, 2.0)).with_free(["f_max", "sigma", "alpha"])
    A = np.geomspace(1e-2, 1e2, 13)
    for k in (1, 3):
        ours = law.stiffness_gradient(law.known_values(), A, np.zeros(()), k)
        theirs = exact.stiffness_gradient(exact.known_values(), A, np.zeros(()), k)
        pairs = zip(
            (ours.by_amplitude * A, *ours.by_parameter),
            (theirs.by_amplitude * A, *theirs.by_parameter),
            strict=True,
        )
        for one, other in pairs:
            assert np.max(np.abs(one - other)) < 1e-8 * np.max(np.abs(other)) + 1e-9


@pytest.mark.parametrize(("alpha", "scale"), [(0.5, 1.0), (1.0, 1e-3), (2.0, 30.0)])
def test_the_force_over_time_agrees_with_the_exact_one(alpha, scale):
    t = np.linspace(0.0, 10.0, 1500)
    x = scale * (np.sin(3.0 * t) + 0.6 * np.sin(7.3 * t))
    ours = SlopeOfDahl(1.0, 1.0, alpha).force(x, 0.1 * min(scale, 1.0))
    exact = Dahl(1.0, 1.0, alpha).force(x, 0.1 * min(scale, 1.0))
    assert np.max(np.abs(ours - exact)) < 2e-7 * np.max(np.abs(exact))


def test_facts_follow_from_the_slope():
    values = [np.asarray(v) for v in (1.3, 7.0, 2.0)]
    law = SlopeOfDahl(1.3, 7.0, 2.0)
    assert [float(v) for v in law.knee(values)] == pytest.approx([1.3 / 7.0] * 2)
    A = np.geomspace(1e-3, 1e3, 25)
    steepest, largest = law.force_bounds(values)
    N = np.abs(law.describing_function(A))
    assert np.all(steepest >= N)
    assert np.all(largest >= A * N)
    ours = law.transient_decay(values, A, np.zeros(()))
    np.testing.assert_allclose(
        ours, Dahl().transient_decay(values, A, np.zeros(())), rtol=1e-7, atol=1e-12
    )
    for points in (4, 51):  # the turning point is none of four
        np.testing.assert_allclose(
            law.loop(0.4, points)[1], Dahl(1.3, 7.0, 2.0).loop(0.4, points)[1], atol=1e-8
        )
    x, force = law.loop(0.4)
    assert law.dissipated_energy(0.4) == pytest.approx(float(-trapezoid(x, force)), rel=1e-4)
    with mpmath.workdps(20):
        assert float(law.rest_stiffness(values)) == 7.0


class SlopeOfLuGre(Friction):
    """Dahl's law with a Stribeck limit, by its slope alone."""

    rate_independent = False
    parameters = tuple(Parameter(name, "", name) for name in ("f_max", "sigma", "ratio", "speed"))

    def slope(self, force, direction, velocity, values):
        f_max, sigma, ratio, speed = values
        level = f_max * (1.0 + (ratio - 1.0) * np.exp(-((velocity / speed) ** 2)))
        return sigma * (1.0 - direction * force / level)


def test_use_of_the_velocity_must_be_declared():
    class Forgot(SlopeOfLuGre):
        rate_independent = True

    with pytest.raises(ModelError, match="must declare rate_independent = False"):
        Forgot(1.0, 3.0, 1.5, 0.7).describing_function(1.0)
    with pytest.raises(ModelError, match="give the frequency"):
        SlopeOfLuGre(1.0, 3.0, 1.5, 0.7).describing_function(1.0)


class Offset(Friction):
    """Dahl's law over a length that no parameter holds: its units do not agree."""

    parameters = (
        Parameter("f_max", "N", "friction limit", lower=0.0, transform="log"),
        Parameter("sigma", "N/m", "contact stiffness", lower=0.0, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        f_max, sigma = values
        return (sigma + 0.5 * f_max) * (1.0 - direction * force / f_max)


def test_derivatives_of_a_law_whose_units_do_not_agree():
    f_max, sigma, A = 1.3, 7.0, np.geomspace(1e-2, 1e1, 7)
    values = [np.asarray(f_max), np.asarray(sigma)]
    ours = Offset().stiffness_gradient(values, A, np.zeros(()))
    stiff = Dahl(f_max, sigma + 0.5 * f_max)
    exact = stiff.stiffness_gradient(stiff.known_values(), A, np.zeros(()))
    by_f_max = exact.by_parameter[0] + 0.5 * exact.by_parameter[1]
    np.testing.assert_allclose(ours.by_parameter[0], by_f_max, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(ours.by_parameter[1], exact.by_parameter[1], rtol=1e-7, atol=1e-9)


def test_derivatives_of_the_force_over_time_are_those_of_the_closed_form():
    t = np.linspace(0.0, 10.0, 1500)
    x = 3.0 * (np.sin(3.0 * t) + 0.6 * np.sin(7.3 * t))
    exact = Dahl().history([1.0, 2.0, 1.0], Path(x), 0.3, slopes=True)
    ours = SlopeOfDahl(alpha=1.0).history([1.0, 2.0, 1.0], Path(x), 0.3, slopes=True)
    assert np.max(np.abs(ours.value - exact.value)) < 1e-9
    assert np.max(np.abs(ours.by_state - exact.by_state)) < 1e-8
    for one, other in zip(ours.by_parameter[:2], exact.by_parameter[:2], strict=True):
        assert np.max(np.abs(one - other)) < 1e-7 * np.max(np.abs(other))


@pytest.mark.parametrize("alpha", [0.3, 0.5, 0.9])
def test_a_force_that_reaches_its_limit_is_that_of_the_closed_form(alpha):
    """Where the slope's own slope is infinite."""
    for seed in range(25):
        x = np.cumsum(np.random.default_rng(seed).standard_normal(200))
        ours, exact = (
            law.force(x) for law in (SlopeOfDahl(1.0, 1.0, alpha), Dahl(1.0, 1.0, alpha))
        )
        assert np.max(np.abs(ours - exact)) < 1e-9


@pytest.mark.parametrize("gap", [1e-7, 1e-9, 1e-11])
def test_a_narrow_gap_hardly_changes_the_force_over_time(gap):
    x = 0.5 * np.sin(np.linspace(0.0, 40.0, 900))
    behind = Backlash(Dahl(1.0, 3.0, 2.0), gap).force(x)
    assert np.max(np.abs(behind - Dahl(1.0, 3.0, 2.0).force(x))) < 4.0 * gap + 2e-9


def test_scales_of_the_force_follow_from_units_that_agree_with_the_law():
    assert SlopeOfDahl().scale_parameters == ("f_max", "sigma")
    assert Jenkins().scale_parameters == ("stiffness",)
    assert SlopeOfLuGre(1.0, 3.0, 1.5, 0.7).scale_parameters == ()

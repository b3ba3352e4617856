"""The four-parameter Iwan law: high precision, sums of Jenkins elements, time, driven motions."""

import mpmath
import numpy as np
import pytest

import dahl_ident as di
from dahl_ident import Damper, Iwan, Mass, MaxwellSlip, response
from dahl_ident.errors import ValidationError
from dahl_ident.problem import TableProblem
from tests.friction_tables import driven
from tests.motions import Driven, differences, slopes
from tests.recovery import assert_near
from tests.test_forced_motion import RATE, multisine

# The four-parameter Iwan law against high precision, sums of Jenkins elements, and time.

AT_REST = np.zeros(())


def exact(law, A, k):
    """Return N_k by integration of the stiffness along the backbone curve, to 25 digits."""
    _, sigma, chi, ratio = (mpmath.mpf(float(v)) for v in law.known_values())
    r, g = mpmath.mpf(A) / mpmath.mpf(law.onset), chi + 1
    end = mpmath.acos(1 - 2 * min(1 / r, mpmath.mpf(1)))

    def integrand(t):
        stiff = 1 - (r * mpmath.sin(t / 2) ** 2) ** g / (1 + ratio)
        return stiff * mpmath.sin(t) * mpmath.expjpi(-k * t / mpmath.pi)

    places = [0, *(end * mpmath.mpf(10) ** -j for j in range(12, 0, -2)), end / 2, end]
    return complex(2j * sigma / (mpmath.pi * k) * mpmath.quad(integrand, places))


def random_laws(n, seed):
    rng = np.random.default_rng(seed)
    laws = [
        Iwan(*10.0 ** rng.uniform(-2.0, 3.0, 2), rng.uniform(-0.99, 1.0), 10 ** rng.uniform(-2, 2))
        for _ in range(n)
    ]
    return [(law, law.onset * 10.0 ** rng.uniform(-4.0, 2.0)) for law in laws]


def test_harmonics_to_high_precision():
    with mpmath.workdps(25):
        for i, (law, A) in enumerate(random_laws(24, 3)):
            k = (1, 3, 7, 61)[i % 4]
            size = abs(complex(law.dynamic_stiffness(A)))
            assert abs(complex(law.dynamic_stiffness(A, harmonic=k)) - exact(law, A, k)) < (
                1e-12 * size
            )
            assert law.dynamic_stiffness(A, harmonic=2) == 0.0


def test_derivatives_are_differences():
    places, weights = np.array([1.0, -1.0, 2.0, -2.0]), np.array([8.0, -8.0, -1.0, 1.0]) / 12e-4
    for i, (law, A) in enumerate(random_laws(200, 4)):
        k, at = (1, 3, 5)[i % 3], [*law.known_values(), np.asarray(A)]
        if abs(A / law.onset - 1.0) < 0.01:
            continue
        found = law.stiffness_gradient(at[:4], at[4], AT_REST, k)
        size = abs(complex(law.dynamic_stiffness(A)))
        for j, slope in enumerate((*found.by_parameter, found.by_amplitude)):
            unit = float(at[j]) + (1.0 if j == 2 else 0.0)  # 1 + chi
            moved = [*at[:j], at[j] + 1e-4 * unit * places, *at[j + 1 :]]
            difference = weights @ law.stiffness(moved[:4], moved[4], AT_REST, k)
            assert abs(complex(slope) * unit - difference) < 1e-8 * size


@pytest.mark.parametrize("chi", [-0.6, 0.0, 0.5])
def test_it_is_a_sum_of_many_jenkins_elements(chi):
    law, n = Iwan(2.0, 5.0, chi, 0.6), 3000
    edges = law.onset * np.linspace(0.0, 1.0, n + 1)
    slips = 0.5 * (edges[1:] + edges[:-1])
    shares = np.diff((edges / law.onset) ** (chi + 1.0))
    stiff = np.append(5.0 / 1.6 * shares, 5.0 * 0.6 / 1.6)
    total = MaxwellSlip(np.append(slips, law.onset), stiff)
    A = law.onset * np.array([0.1, 0.7, 1.0, 1.5, 20.0])
    for k in (1, 3):
        ours, theirs = (e.dynamic_stiffness(A, harmonic=k) for e in (law, total))
        np.testing.assert_allclose(ours, theirs, rtol=2e-3)
    x = law.onset * np.cumsum(np.random.default_rng(1).normal(size=200)) * 0.4
    np.testing.assert_allclose(law.force(x), total.force(x), atol=2e-4)


def test_microslip_is_a_power_law_and_macroslip_is_coulomb_friction():
    law = Iwan(100.0, 1e7, -0.4, 1.0)
    loss = law.dissipated_energy(law.onset * np.array([1e-4, 1e-3]))
    assert np.log10(loss[1] / loss[0]) == pytest.approx(2.6, abs=1e-9)
    far = complex(law.describing_function(1e6 * law.onset)) * 1e6 * law.onset
    assert far.imag == pytest.approx(400.0 / np.pi, rel=1e-5)
    assert law.force([0.0, 3.0 * law.onset])[1] == 100.0
    with pytest.raises(ValidationError, match="chi"):
        Iwan(chi=-1.5)


def test_a_step_beyond_the_exponents_range_has_no_response():
    """Searches may try it; other rows keep theirs."""
    model = Iwan(ratio=1.0) + Mass() + Damper()
    true = Iwan(10.0, 1e4, -0.5, 1.0) + Mass(1.0) + Damper(1.0)
    f, drive = np.array([10.0, 15.0]), np.array([1.0, 2.0])
    data = driven(f, response(true, f, drive).receptance, drive)
    problem = TableProblem(data, model)
    inside = problem.to_search([10.0, 1e4, -0.5, 1.0, 1.0])
    beyond = inside + np.array([0.0, 0.0, -1.3, 0.0, 0.0])
    found = problem.predict(np.array([inside, beyond]))
    np.testing.assert_allclose(found[0], data.response, rtol=1e-9)
    assert np.isnan(found[1]).all()


# Iwan's law driven by a force: its polygon of sliders, derivatives, and a fit.

M, C, K = 2.0, 10.0, 3e4
VALUES = [20.0, 4e4, -0.5, 1.0]


@pytest.mark.parametrize("values", [[2.0, 5.0, -0.9, 0.1], VALUES, [1.0, 1.0, 1.5, 0.3]])
def test_elements_are_a_polygon_in_the_backbone_curve(values):
    law = di.Iwan(*values)
    stiffnesses, places = law.sliders(values)
    slips = di.MaxwellSlip(places, stiffnesses)
    assert places[-1] == pytest.approx(law.onset)
    np.testing.assert_allclose(
        slips.force([0.0, *places]), law.force([0.0, *places]), rtol=1e-12, atol=1e-14
    )
    x = law.onset * np.linspace(0.0, 1.2, 3001)
    g, ratio = values[2] + 1.0, values[3]
    most = values[0] * g * (g + 1.0) / (2.0 * 30**2 * (ratio * (g + 1.0) + g))
    error = law.force(x) - slips.force(x)
    assert error.min() > -1e-12 * values[0]
    assert 0.9 * most < error.max() < 1.1 * most


def test_harmonics_have_the_error_that_is_stated():
    for chi in (-0.9, -0.5, 0.0):
        for ratio in (0.1, 1.0):
            law = di.Iwan(1.0, 1.0, chi, ratio)
            slips = di.MaxwellSlip(*law.sliders([1.0, 1.0, chi, ratio])[::-1])
            A = law.onset * np.geomspace(0.1, 10.0, 60)
            exact_one, other = (e.dynamic_stiffness(A) for e in (law, slips))
            assert np.abs(other / exact_one - 1.0).max() < 2e-3
            assert np.abs(other.imag / exact_one.imag - 1.0).max() < 0.02


@pytest.mark.long
def test_slopes_are_derivatives():
    plant = Driven(di.Iwan() + di.Mass() + di.Damper() + di.Spring(), multisine(64)[0], RATE)
    starts, values = np.array([1e-4, 0.01, 0.4]), np.array([*VALUES, M, C, K])
    _, found = slopes(plant, starts, values)
    for i, expected in enumerate(differences(plant, starts, values, 1e-4)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 2e-6, i


@pytest.mark.long
def test_a_short_record_from_rest_is_fitted():
    """Its three shape parameters lie in a long curved valley."""
    rng, t = np.random.default_rng(0), np.arange(384) / 100.0
    lines = 2.0 * np.pi * np.arange(1, 9) / t[-1]
    drive = np.cos(lines[:, None] * t + rng.uniform(0.0, 6.3, (8, 1))).sum(axis=0)
    drive *= 0.15 / drive.std()
    plant = di.Iwan(0.1, 30.0, -0.3, 0.5) + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
    driven = Driven(plant, drive, 100.0)
    x = driven.motion(np.zeros(driven.order)).output
    x = x + 1e-3 * x.std() * rng.standard_normal(t.size)
    record = di.Record(t, displacement=x, force=drive)
    fit = di.fit(record, di.Iwan() + di.Mass(0.3) + di.Damper() + di.Spring())
    truth = {"f_max": 0.1, "sigma": 30.0, "chi": -0.3, "ratio": 0.5}
    assert_near(fit, truth, 3.0)

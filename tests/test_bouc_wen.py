"""Bouc-Wen against Dahl, quadrature and integration; `test_engine` has its loops and histories."""

import time

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import dahl_ident as di
from dahl_ident import BoucWen, Dahl
from dahl_ident.elements.facts import Path
from tests.histories import integrated_force
from tests.recovery import assert_near

LAWS = [(3.0, 1.3, 0.5), (5e4, -300.0, 1900.0), (2.0, 0.7, 0.0), (1.0, 0.0, 2.0), (4.0, -0.5, -0.2)]


def stiffness(point, harmonic):
    """Return N_k/sigma and its derivatives at one amplitude, q and p."""
    A, q, p = (np.asarray(v) for v in point)
    at = (np.ones(()), q, p)
    found = BoucWen().stiffness_gradient(at, A, np.zeros(()), harmonic)
    return [complex(v) for v in (found.value, found.by_amplitude, *found.by_parameter[1:])]


def history(x, point):
    """Return the force at an initial force, sigma, q and p."""
    start, *law = point.tolist()
    return BoucWen().force_history(law, x, state=start)


def tip_force(A, law):
    """Return the force at the upper turning point of the settled loop."""
    return float(BoucWen(*law).loop(A)[1][0])


def test_check_values():
    law = BoucWen(3.0, 1.3, 0.5)
    assert tip_force(2.0, (3.0, 1.3, 0.5)) == pytest.approx(2.2782955, abs=5e-8)
    first, third = (2.0 * law.dynamic_stiffness(2.0, harmonic=k) for k in (1, 3))
    assert complex(first) == pytest.approx(1.9961234 + 1.6865922j, abs=1e-7)
    assert complex(third) == pytest.approx(0.3071339 - 0.3003915j, abs=1e-7)


@pytest.mark.parametrize("beta", [1e-9, 1e-3, 0.3, 3.0, 300.0, 1e5])
@pytest.mark.parametrize("harmonic", [1, 3, 101])
def test_equal_rates_are_linear_dahl(beta, harmonic):
    found = stiffness(np.array([beta, 1.0, 1.0]), harmonic)[0]
    expected = complex(Dahl(1.0, 1.0).dynamic_stiffness(beta, harmonic=harmonic))
    size = abs(Dahl(1.0, 1.0).describing_function(beta))
    assert abs(found - expected) <= 1e-9 * size


@pytest.mark.parametrize("law", LAWS)
def test_force_derivatives(law):
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.standard_normal(300)) * 0.3 / max(abs(law[1]), abs(law[2]))
    point = np.array([0.3 * law[0] / max(abs(law[1]), abs(law[2])), *law])
    gradient = BoucWen().history(law, Path(x), point[0], slopes=True)
    np.testing.assert_allclose(gradient.value, history(x, point), rtol=1e-12)
    found = np.column_stack([gradient.by_state, *gradient.by_parameter])
    for i in range(4):
        h = np.zeros(4)
        h[i] = 1e-5 * max(abs(point[i]), 0.1)
        expected = history(x, point + h) - history(x, point - h)
        expected /= 2.0 * h[i]
        np.testing.assert_allclose(
            found[:, i], expected, rtol=0.0, atol=1e-7 * np.abs(expected).max()
        )


@pytest.mark.parametrize("n", [0.6, 2.0, 7.0])
@pytest.mark.parametrize(("q", "p"), [(1.3, 0.5), (0.0, 2.0), (1.0, -0.4)])
def test_an_exponent_against_the_integrated_loop(n, q, p):
    sigma, A = 3.0, 1.1
    law = BoucWen(sigma, q, p, exponent=n)

    def slope(x, z, s):
        rate = q if s * z[0] > 0.0 else -p
        return np.asarray(s * sigma * (1.0 - np.sign(rate) * np.abs(rate * z / sigma) ** n))

    z = 0.0
    for s in [1.0] + 12 * [-1.0, 1.0]:
        path = A if s * z == 0.0 else 2.0 * A
        z = solve_ivp(slope, (0.0, path), [z], args=(s,), rtol=1e-11, atol=1e-13).y[0, -1]
    assert float(law.loop(A)[1][0]) == pytest.approx(z, rel=1e-7)
    described = law.describe()
    parameters = {key: value for key, value in described.items() if key != "kind"}
    assert BoucWen.from_description(parameters, None).describe() == described


def test_the_exponent_1_is_not_a_parameter():
    one, near = BoucWen(3.0, 1.3, 0.5), BoucWen(3.0, 1.3, 0.5, exponent=1.0 + 1e-9)
    assert one.labels == ("sigma", "q", "p") == BoucWen(exponent=1.0).labels
    assert near.labels == ("sigma", "q", "p", "exponent")
    found = near.dynamic_stiffness([0.3, 2.0])
    np.testing.assert_allclose(found, one.dynamic_stiffness([0.3, 2.0]), rtol=1e-8)


def test_an_exponent_is_estimated_and_handed_on():
    law = BoucWen(30.0, 300.0, 100.0, exponent=2.0)
    A = np.geomspace(1e-4, 3e-2, 9)
    noise = np.random.default_rng(1).normal(scale=2e-3, size=(2, 9))
    N = law.describing_function(A) * np.exp(noise[0] + 1j * noise[1])
    fit = di.fit(di.FrequencyResponse(np.ones(9), N, A), BoucWen(exponent=None))
    assert fit.trusted
    assert_near(fit, zip(law.labels, (30.0, 300.0, 100.0, 2.0), strict=True), 3.0)
    assert "abs(z1/sigma1)^exponent1" in str(fit.export("modelica"))
    with pytest.raises(di.errors.ModelError, match="exponent 1 alone"):
        fit.export("c")


def test_a_table_with_harmonics_takes_seconds():
    true = BoucWen(30.0, 200.0, 150.0) + di.Mass(0.02) + di.Damper(0.1)
    orders = np.tile([1, 3, 5], 15)
    A, f = np.repeat(np.geomspace(1e-4, 0.1, 15), 3), np.repeat(np.resize([0.5, 1.0, 2.0], 15), 3)
    Z = np.array(
        [
            true.dynamic_stiffness(a, w, harmonic=k)
            for a, w, k in zip(A, 2.0 * np.pi * f, orders.tolist(), strict=True)
        ]
    )
    size = np.abs(Z[orders == 1]).repeat(3)
    noise = np.random.default_rng(1).normal(scale=0.003, size=(2, 45))
    Z = Z + size * (noise[0] + 1j * noise[1])
    data = di.FrequencyResponse(f, Z, A, harmonic=orders, controlled="displacement")
    begin = time.process_time()
    fit = di.fit(data, BoucWen() + di.Mass() + di.Damper())
    assert time.process_time() - begin < 10.0  # one; a loop for each node, row and harmonic: 60
    assert_near(fit, true, 3.5)


@pytest.mark.parametrize("p", [1e12, 1e30])
def test_a_force_that_vanishes_at_once_on_reversal(p):
    """Each half cycle begins without a force: by quadrature."""
    sigma, q, A = 2e4, 400.0, 0.01

    def fourier(wave):  # x = A cos(theta) falls
        def part(theta):
            return float(sigma / q * np.expm1(-q * A * (1.0 - np.cos(theta))) * wave(theta))

        return 2.0 / np.pi * float(quad(part, 0.0, np.pi)[0])

    found = complex(BoucWen(sigma, q, p).describing_function(A))
    assert abs(found - (fourier(np.cos) - 1j * fourier(np.sin)) / A) < 2e-4 * abs(found)


def path_to(force, rate, n):
    """Return the path from zero force, for sigma = 1; a negative rate is for unloading."""
    u = mpmath.mpf(abs(rate)) * force
    return force * mpmath.hyp2f1(1.0, 1.0 / n, 1.0 + 1.0 / n, np.sign(rate) * u**n)


def test_a_record_of_a_law_with_an_exponent_below_1_is_identified():
    """At 0 N the derivatives of such a law are infinite."""
    true = {"sigma": 30.0, "q": 300.0, "p": 200.0, "exponent": 0.6}
    t = np.arange(0.0, 4.0, 0.02)
    x = 5e-3 * np.sin(np.pi * t) * (1.0 - 0.8 * np.exp(-t))
    noise = np.random.default_rng(1).normal(scale=5e-4, size=t.size)

    def slope(force, direction):
        rate = 300.0 if direction * force >= 0.0 else -200.0
        return 30.0 * (1.0 - np.sign(rate) * abs(rate * force / 30.0) ** 0.6)

    force = integrated_force(slope, x) + noise
    fit = di.fit(di.Record(t, displacement=x, force=force), BoucWen(exponent=None))
    assert fit.trusted
    assert_near(fit, true, 3.5)
    assert fit.params["exponent"].stderr < 0.02


class Root(di.Friction):
    """Bouc-Wen with q = p and the exponent 0.5, as users write it."""

    parameters = BoucWen.parameters[:2]

    def slope(self, force, direction, velocity, values):
        sigma, q = values
        root = np.sqrt(np.abs(q * force / sigma))
        return sigma * (1.0 - direction * np.sign(force) * root)


def fundamental(A, p, n):
    """Return N for sigma = q = 1 by its integral over the force."""
    with mpmath.workdps(20):
        A, low, high = mpmath.mpf(A), mpmath.mpf(0), mpmath.mpf(1)
        for _ in range(75):
            tip = (low + high) / 2
            beyond = path_to(tip, -p, n) + path_to(tip, 1.0, n) > 2 * A
            low, high = (low, tip) if beyond else (tip, high)

        def turned(force):
            moved = path_to(tip, -p, n) - (
                path_to(force, -p, n) if force > 0 else -path_to(-force, 1.0, n)
            )
            return mpmath.exp(-1j * mpmath.acos(max(-1, min(1, 1 - moved / A))))

        near = min(tip / 2, 10 / mpmath.mpf(p))
        whole = mpmath.quad(turned, [tip, tip / 2, near, 0, -tip / 2, -tip])
        return complex(2 / (mpmath.pi * 1j) * whole / A)


@pytest.mark.parametrize("A", [1e-3, 0.1, 2.0, 20.0])
def test_roots_of_the_force_bend_without_bounds_at_zero(A):
    """At 0 N, where a loop begins, the slope of a root has no finite derivative."""
    expected = fundamental(A, 1.0, 0.5)
    for law in (BoucWen(1.0, 1.0, 1.0, exponent=0.5), Root(1.0, 1.0)):
        assert abs(complex(law.describing_function(A)) - expected) < 1e-9 * abs(expected)

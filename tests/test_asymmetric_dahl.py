"""Dahl friction with two limits."""

import mpmath
import numpy as np
import pytest
from scipy.special import i1e

from dahl_ident import Dahl, Friction, Model
from dahl_ident.errors import ValidationError
from tests.derivatives import central_differences

AT_REST = np.zeros(())


def exactly(f_max, sigma, a, A, k):
    """Return F_k/X_1 from the loop's exponentials by quadrature with 30 digits."""
    with mpmath.workdps(30):
        f_max, sigma, a, A = (mpmath.mpf(v) for v in (f_max, sigma, a, A))
        up, down = f_max * (1 + a), f_max * (1 - a)
        b, c = sigma * A / up, sigma * A / down
        E, D = mpmath.exp(-2 * b), mpmath.exp(-2 * c)
        top = (up - up * E + E * (-down + down * D)) / (1 - E * D)
        bottom = -down + (down + top) * D

        def rising(t):
            force = up - (up - bottom) * mpmath.exp(-b * (1 - mpmath.cos(t)))
            return force * mpmath.expj(-k * (t + mpmath.pi))

        def falling(t):
            force = -down + (down + top) * mpmath.exp(-c * (1 - mpmath.cos(t)))
            return force * mpmath.expj(-k * t)

        stops = [0, mpmath.pi / 64, mpmath.pi / 8, mpmath.pi]
        total = (mpmath.quad(rising, stops) + mpmath.quad(falling, stops)) / mpmath.pi / A
        return complex(total / (2 if k == 0 else 1))


def test_the_check_values():
    law = Dahl(1.0, 2000.0, asymmetry=0.2)
    c = [1e-3 * complex(law.dynamic_stiffness(1e-3, harmonic=k)) for k in range(4)]
    assert 2.0 * c[0].real == pytest.approx(0.2361383317, abs=1e-10)
    real = [v.real for v in c[1:]]
    assert real == pytest.approx([0.8331869096, 0.0389112359, 0.1180527595], abs=1e-10)


def test_harmonics_against_high_precision():
    rng = np.random.default_rng(3)
    for _ in range(4):
        a, beta = rng.uniform(-0.8, 0.8), 10.0 ** rng.uniform(-3.0, 2.5)
        law = Dahl(2.0, 50.0, asymmetry=a)
        A = beta * 2.0 / 50.0
        size = abs(law.dynamic_stiffness(A))
        for k in (0, 1, 2, 5, 7):
            ours = complex(law.dynamic_stiffness(A, harmonic=k))
            # the mean is a small difference: it is known to rounding over beta
            assert abs(ours - exactly(2.0, 50.0, a, A, k)) < 1e-11 * size * (1.0 + 0.1 / beta)


def test_without_asymmetry_it_is_plain_dahl():
    A = np.geomspace(1e-6, 1e3, 50)
    near = Dahl(1.0, 3.0, asymmetry=1e-12)
    for k in (1, 3, 5):
        np.testing.assert_allclose(
            near.dynamic_stiffness(A, harmonic=k),
            Dahl(1.0, 3.0).dynamic_stiffness(A, harmonic=k),
            rtol=1e-7,
            atol=1e-12,
        )
    assert [p.name for p in Dahl(1.0, 3.0, asymmetry=0.0).parameters] == ["f_max", "sigma", "alpha"]


def test_refusals():
    assert isinstance(Dahl(asymmetry=0.1), Friction)
    with pytest.raises(ValidationError, match="asymmetry is"):
        Dahl(1.0, 1.0, asymmetry=1.5)


@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_derivatives_against_high_precision(k):
    rng = np.random.default_rng(k)
    law = Model(Dahl(1.0, 3.0, asymmetry=0.2)).with_free(["f_max", "sigma", "asymmetry"])
    beta = 10.0 ** rng.uniform(-2.0, 2.0)
    f_max, sigma, a = 2.0, 50.0, rng.uniform(-0.8, 0.8)
    A = beta / 25.0
    values = [np.asarray(v) for v in (f_max, sigma, 1.0, a)]
    found = law.stiffness_gradient(values, np.asarray(A), AT_REST, k)
    slopes = np.array([*found.by_parameter[:2], found.by_parameter[3], found.by_amplitude])
    point = np.array([f_max, sigma, a, A])
    expected = central_differences(
        lambda p: exactly(p[0], p[1], p[2], p[3], k), point, 1e-6 * np.abs(point)
    )
    size = abs(exactly(f_max, sigma, a, A, 1))
    assert np.all(np.abs(slopes - expected) * np.abs(point) < 1e-8 * size)


def in_full_slip(p):
    """Return N at (f_max, sigma, asymmetry, amplitude) for exp(-sigma A/f_max) = 0, alpha = 1."""
    f_max, sigma, a, A = p
    beta = sigma * A / f_max
    real = np.pi * (i1e(beta / (1.0 + a)) + i1e(beta / (1.0 - a)))
    return 2.0 * f_max / (np.pi * A) * (real + 2j * (1.0 - 1.0 / beta))


def test_derivatives_far_in_full_slip():
    law = Model(Dahl(1.0, 3.0, asymmetry=0.2)).with_free(["f_max", "sigma", "alpha", "asymmetry"])
    A = 0.1 / 30.0 * np.geomspace(1e3, 1e12, 28)
    values = [np.asarray(v) for v in (0.1, 30.0, 1.0, 0.2)]
    found = law.stiffness_gradient(values, A, AT_REST)
    slopes = np.array([*found.by_parameter[:2], found.by_parameter[3], found.by_amplitude])
    for i, amplitude in enumerate(A):
        point = np.array([0.1, 30.0, 0.2, amplitude])
        N = in_full_slip(point)
        assert abs(found.value[i] - N) < 1e-9 * abs(N)
        expected = central_differences(in_full_slip, point, 1e-5 * point)
        assert np.all(np.abs(slopes[:, i] - expected) * point < 1e-7 * abs(N))


@pytest.mark.parametrize("alpha", [0.8, 0.9, 0.99, 1.01, 1.1])
def test_full_slip_is_coulomb_friction_for_any_exponent(alpha):
    beta = np.geomspace(1e6, 1e12, 13)
    N = Dahl(1.0, 1.0, alpha, asymmetry=0.2).describing_function(beta)
    assert np.all(np.abs(beta * N - 4j / np.pi) < 4.0 / np.sqrt(beta))

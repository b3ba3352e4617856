"""A damper with a power of the speed."""

import mpmath
import numpy as np
import pytest

from dahl_ident import Damper, Mass, PowerDamper, Spring, response
from dahl_ident.errors import ValidationError


def exactly(c, p, A, omega, k):
    with mpmath.workdps(25):
        height = mpmath.mpf(c) * (mpmath.mpf(A) * omega) ** p
        share = mpmath.quad(
            lambda t: mpmath.sin(t) ** p * mpmath.sin(k * t), [0, mpmath.pi / 2, mpmath.pi]
        )
        return complex(1j * height / A * 2 / mpmath.pi * share)


@pytest.mark.parametrize("p", [0.1, 0.5, 1.0, 1.7, 2.0, 3.0])
def test_harmonics_against_quadrature(p):
    law = PowerDamper(2.0, p)
    for k in (1, 3, 5, 7):
        ours = complex(law.dynamic_stiffness(0.3, 7.0, harmonic=k))
        expected = exactly(2.0, p, 0.3, 7.0, k)
        size = abs(exactly(2.0, p, 0.3, 7.0, 1))
        assert abs(ours - expected) < 1e-11 * size
        assert complex(law.dynamic_stiffness(0.3, 7.0, harmonic=k - 1)) == 0.0


def test_its_special_cases():
    A, omega = np.array([0.01, 0.1, 1.0]), 3.0
    np.testing.assert_allclose(
        PowerDamper(2.0, 1.0).dynamic_stiffness(A, omega),
        Damper(2.0).dynamic_stiffness(A, omega),
        rtol=1e-13,
    )
    coulomb = PowerDamper(2.0, 1e-9).dynamic_stiffness(A, omega)
    np.testing.assert_allclose(A * coulomb, 8j / np.pi, rtol=1e-7)
    slow = PowerDamper(2.0, 0.5, reference_speed=0.01).dynamic_stiffness(A, omega)
    np.testing.assert_allclose(slow, 10.0 * PowerDamper(2.0, 0.5).dynamic_stiffness(A, omega))
    assert PowerDamper(2.0, 0.5).dynamic_stiffness(0.1, 0.0) == 0.0


def test_force_and_refusals():
    law = PowerDamper(2.0, 0.5, name="oil")
    assert law.force([0.0, 0.0], velocity=[0.25, -4.0]).tolist() == [1.0, -4.0]
    assert [p.dimension for p in law.parameters] == [(1, 0, 0), (0, 0, 0), (0, 1, -1)]
    with pytest.raises(ValidationError, match="needs velocity"):
        law.force([0.0, 1.0])
    with pytest.raises(ValidationError, match="exponent is"):
        PowerDamper(1.0, 3.5)


def test_a_driven_plant_at_several_frequencies_has_the_amplitudes_of_each_alone():
    plant = PowerDamper(1.0, 0.5) + Mass(0.05) + Spring(1.0)
    f, drive = np.array([0.1, 0.5, 1.5]), np.array([0.2, 1.0, 3.0])
    together = response(plant, f, drive, steady="describing function").amplitude
    alone = [
        response(plant, one, u, steady="describing function").amplitude
        for one, u in zip(f, drive, strict=True)
    ]
    np.testing.assert_allclose(together, np.ravel(alone), rtol=1e-9)

"""FrictionNonlinearity inside python-control: signs, memory, intersections."""

import control
import numpy as np
import pytest

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring
from dahl_ident.control_interop import FrictionNonlinearity
from dahl_ident.errors import ModelError, ValidationError

pytestmark = pytest.mark.versions

TWO = Dahl(0.1, 30.0, name="a") + Dahl(0.03, 90.0, 1.5, name="b")


@pytest.mark.parametrize("friction", [Dahl(0.1, 30.0), Dahl(2.0, 5.0, 0.5), TWO])
def test_python_control_gets_the_exact_describing_function(friction):
    A = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 15)])
    theirs = control.describing_function(FrictionNonlinearity(friction), A)
    np.testing.assert_allclose(theirs, friction.dynamic_stiffness(A), rtol=1e-13)


@pytest.mark.parametrize("friction", [Dahl(0.1, 30.0), Dahl(0.1, 30.0, 2.0), TWO])
def test_python_controls_own_quadrature_has_the_same_sign_and_value(friction):
    A = 0.03  # beta = 9: the memory of the first cycle is gone after one more
    numerical = control.describing_function(
        FrictionNonlinearity(friction), [A], num_points=2000, try_method=False
    )
    assert numerical[0] == pytest.approx(friction.dynamic_stiffness(A), rel=1e-5)
    assert numerical[0].imag > 0.0


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


@pytest.mark.parametrize("amplitude", [-1.0, np.nan, np.inf])
def test_bad_amplitudes_are_refused(amplitude):
    with pytest.raises(ValidationError, match=r"A is .*; expected"):
        FrictionNonlinearity(Dahl(1.0, 1.0)).describing_function(amplitude)


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

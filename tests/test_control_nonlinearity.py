"""FrictionNonlinearity inside python-control: signs, memory, intersections."""

import control
import matplotlib.pyplot as plt
import numpy as np
import pytest

from dahl_ident import Dahl, Damper, LinearSystem, Mass, Spring
from dahl_ident.control_interop import FrictionNonlinearity
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.synthetic import SteppedSine
from dahl_ident.synthetic.mechanism import Mechanism

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


def test_friction_leads_where_a_relay_lags():
    relay = control.relay_hysteresis_nonlinearity(0.1, 0.001)
    for nonlinearity, sign in ((relay, -1.0), (FrictionNonlinearity(Dahl(0.1, 30.0)), 1.0)):
        exact, numerical = (
            control.describing_function(nonlinearity, [0.03], num_points=4000, try_method=method)
            for method in (True, False)
        )
        assert np.sign(exact[0].imag) == sign
        assert numerical[0].imag == pytest.approx(exact[0].imag, rel=0.02)


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


def test_describing_function_response_and_its_plot_find_the_cycles():
    s = control.tf("s")
    H = 1 / (0.3 * s**2 - 0.3 * s + 0.3)
    friction = Dahl(0.1, 30.0)
    A, omega = np.geomspace(1e-4, 1.0, 80), np.geomspace(0.3, 30.0, 400)
    result = control.describing_function_response(
        H, FrictionNonlinearity(friction), A, omega, refine=False
    )
    assert len(result) == 2
    for amplitude, w in result:
        N = friction.describing_function(amplitude)
        assert complex(H(1j * w)) * N == pytest.approx(-1.0, rel=0.1)
    plot = control.describing_function_plot(
        H, FrictionNonlinearity(friction), A, omega, refine=False
    )
    assert plot is not None
    plt.close("all")


def test_a_sine_through_the_time_domain_has_python_controls_phase():
    """F(A sin wt) = A |N| sin(wt + arg N): the fundamental of a simulated force."""
    friction, A = Dahl(0.1, 30.0), 0.004
    motion = SteppedSine((A,), (1.0,), controlled="displacement", settling_periods=4, num_periods=2)
    wave = motion.waveform(seed=0)
    window = wave.windows[0]
    time = window.start + np.arange(8192) / 8192.0 * (window.stop - window.start)
    F, x = Mechanism.of(friction).force_under(wave)(time), wave.value(time)
    turn = np.exp(-2j * np.pi * time)
    ratio = complex(F @ turn) / complex(x @ turn)
    theirs = control.describing_function(FrictionNonlinearity(friction), [A])[0]
    assert ratio == pytest.approx(theirs, rel=1e-6)


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

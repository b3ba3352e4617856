"""LinearSystem against the lumped elements, scipy's polynomials and python-control itself."""

import importlib
from typing import Any

import numpy as np
import pytest

from dahl_ident.arrays import ComplexArray
from dahl_ident.elements import Dahl, Damper, LinearSystem, Mass, Parameter, Spring
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.units import QUANTITIES

control: Any = importlib.import_module("control")

M, C, K = 0.3, 0.24, 7.0
OMEGA = np.geomspace(0.05, 60.0, 41)
STIFFNESS: ComplexArray = K - M * OMEGA**2 + 1j * OMEGA * C
INVERSE = ("receptance", "mobility", "accelerance")


def transfer_function(quantity):
    s = control.tf("s")
    Z = M * s**2 + C * s + K
    return {
        "receptance": 1 / Z, "mobility": s / Z, "accelerance": s**2 / Z, "dynamic_stiffness": Z,
        "mechanical_impedance": Z / s, "apparent_mass": Z / s**2,
    }[quantity]  # fmt: skip


def relative_error(value, truth=STIFFNESS):
    return float(np.max(np.abs(value / truth - 1.0)))


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_every_quantity_of_one_mode_is_the_same_stiffness(quantity):
    element = LinearSystem(transfer_function(quantity), quantity=quantity)
    assert relative_error(element.dynamic_stiffness(1e-3, OMEGA)) < 1e-12
    frd = LinearSystem(control.frd(transfer_function(quantity), OMEGA), quantity=quantity)
    assert relative_error(frd.dynamic_stiffness(1e-3, OMEGA)) < 1e-12


@pytest.mark.parametrize("quantity", INVERSE)
def test_state_space_agrees_with_the_lumped_elements(quantity):
    element = LinearSystem(control.ss(transfer_function(quantity)), quantity=quantity)
    lumped = (Mass(M) + Damper(C) + Spring(K)).dynamic_stiffness(1e-3, OMEGA)
    assert relative_error(element.dynamic_stiffness(1e-3, OMEGA), lumped) < 1e-11


def two_modes(omega):
    first, second = (k - omega**2 + 1j * c * omega for k, c in ((4.0, 0.04), (100.0, 0.2)))
    return np.asarray(1.0 / first + 0.5 / second)


def test_frd_between_its_points_follows_two_modes_that_a_receptance_spline_misses():
    omega = np.linspace(0.5, 15.0, 400)
    between = np.linspace(0.52, 14.9, 2111)
    frd = control.frd(two_modes(omega), omega)
    ours = LinearSystem(frd, quantity="receptance").dynamic_stiffness(1e-3, between)
    assert relative_error(1.0 / ours, two_modes(between)) < 0.02
    interpolating = control.FrequencyResponseData(two_modes(omega), omega, smooth=True)
    theirs = interpolating(1j * between)
    peak = np.abs(between - 2.0) < 0.1
    truth = two_modes(between)
    assert relative_error(1.0 / ours[peak], truth[peak]) < 1e-5
    assert relative_error(theirs[peak], truth[peak]) > 1e-3


def test_frd_in_any_order_and_with_few_points():
    shuffled = np.array([3.0, 1.0, 2.0])
    Z = K - M * shuffled**2 + 1j * shuffled * C
    element = LinearSystem(control.frd(1.0 / Z, shuffled), quantity="receptance")
    w = np.array([1.3, 2.9])
    assert relative_error(element.dynamic_stiffness(0.0, w), K - M * w**2 + 1j * w * C) < 1e-13
    single = LinearSystem(control.frd([2.0 + 1.0j], [3.0]), quantity="dynamic_stiffness")
    assert single.dynamic_stiffness(0.0, 3.0) == 2.0 + 1.0j


def test_frd_is_not_extrapolated():
    element = LinearSystem(control.frd(1.0 / STIFFNESS, OMEGA), quantity="receptance")
    with pytest.raises(ValidationError, match=r"reaches from 0\.05 to 60 rad/s .* 61 rad/s"):
        element.dynamic_stiffness(1e-3, [1.0, 61.0])
    with pytest.raises(ValidationError, match=r"asked for 0\.049 rad/s"):
        element.dynamic_stiffness(1e-3, 0.049)


def test_discrete_system_is_evaluated_on_the_unit_circle_up_to_half_its_rate():
    rate = 50.0
    discrete = control.c2d(transfer_function("receptance"), 1.0 / rate)
    element = LinearSystem(discrete, quantity="receptance")
    w = np.array([0.5, 5.0, 100.0])
    z = np.exp(1j * w / rate)
    den, num = discrete.den[0][0].astype(complex), discrete.num[0][0].astype(complex)
    truth = np.asarray(np.polyval(den, z) / np.polyval(num, z), dtype=np.complex128)
    assert relative_error(element.dynamic_stiffness(1e-3, w), truth) < 1e-12
    with pytest.raises(ValidationError, match=r"half its sampling rate, 157\.08 rad/s.* 158"):
        element.dynamic_stiffness(1e-3, [1.0, 158.0])


def test_pole_of_the_receptance_is_zero_stiffness():
    s = control.tf("s")
    free_mass = LinearSystem(1 / (M * s**2), quantity="receptance")
    assert free_mass.dynamic_stiffness(1e-3, 0.0) == 0.0
    assert free_mass.dynamic_stiffness(1e-3, 2.0) == pytest.approx(-4.0 * M)


@pytest.mark.parametrize(
    ("quantity", "text"),
    [
        ("mobility", "a mobility of 0 has no dynamic_stiffness"),
        ("mechanical_impedance", "the mechanical_impedance is .*inf.* at 0 rad/s"),
    ],
)
def test_quantity_that_says_nothing_at_rest_is_refused_there(quantity, text):
    element = LinearSystem(transfer_function(quantity), quantity=quantity)
    with pytest.raises(ValidationError, match=text):
        element.dynamic_stiffness(1e-3, 0.0)


def test_nan_in_the_data_is_refused():
    element = LinearSystem(control.frd([1.0, np.nan, 2.0], [1.0, 2.0, 3.0]), quantity="mobility")
    with pytest.raises(ValidationError, match=r"the mobility is nan.* at 2 rad/s"):
        element.dynamic_stiffness(1e-3, 1.5)
    twice = LinearSystem(control.frd([1.0, 1.0], [1.0, 1.0]), quantity="receptance")
    with pytest.raises(ValidationError, match="a frequency twice"):
        twice.dynamic_stiffness(1e-3, 1.0)


@pytest.mark.parametrize(
    ("system", "parameters", "text"),
    [
        (3.0, None, "a float; expected a python-control TransferFunction"),
        (lambda: None, None, "a function with the parameters .*expected a python-control system"),
        (transfer_function("receptance"), {"m": 1.0}, "TransferFunction with the parameters"),
        (control.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]]), None, "2 inputs and 1 outputs"),
        (control.tf([1.0], [1.0, 0.5], True), None, "discrete without a sampling time"),
    ],
)
def test_what_is_no_system_is_refused(system, parameters, text):
    with pytest.raises(ValidationError, match=text):
        LinearSystem(system, quantity="receptance", parameters=parameters)


def test_quantity_has_to_be_said():
    wrong: Any = "X/F"
    with pytest.raises(ValidationError, match=r"quantity is 'X/F'; expected one of receptance"):
        LinearSystem(transfer_function("receptance"), quantity=wrong)


def mode(mass, damping, stiffness):
    return control.tf([1.0], [mass, damping, stiffness])


def test_function_of_parameters_has_the_lumped_elements_derivatives():
    element = LinearSystem(
        mode,
        quantity="receptance",
        parameters={"mass": None, "damping": C, "stiffness": Parameter("", "N/m", "k", lower=0.0)},
        name="base",
    )
    assert [p.name for p in element.parameters] == ["base_mass", "base_damping", "base_stiffness"]
    assert [p.free for p in element.parameters] == [True, False, True]
    assert element.parameters[2].unit == "N/m"
    lumped = Mass(M) + Damper(C) + Spring(K)
    batch = [np.array([[M], [2 * M]]), np.asarray(C), np.array([[K], [3 * K]])]
    A = np.array(1e-3)
    ours = element.stiffness_gradient(batch, A, OMEGA)
    truth = lumped.stiffness_gradient(batch, A, OMEGA)
    assert ours.value.shape == (2, OMEGA.size)
    assert relative_error(ours.value, truth.value) < 1e-12
    for value, derivative, exact in zip(batch, ours.by_parameter, truth.by_parameter, strict=True):
        assert np.max(np.abs((derivative - exact) * value / truth.value)) < 1e-11
    assert not ours.by_amplitude.any()
    np.testing.assert_array_equal(element.stiffness(batch, A, OMEGA), ours.value)


def test_argument_of_zero_has_no_step():
    element = LinearSystem(
        mode, quantity="receptance", parameters={"mass": M, "damping": 0.0, "stiffness": K}
    )
    with pytest.raises(ModelError, match="damping is exactly 0"):
        element.stiffness_gradient(element.known_values(), np.array(1.0), OMEGA)


def test_linear_system_with_friction_replaces_the_lumped_part():
    plant = Dahl(0.1, 30.0) + LinearSystem(transfer_function("receptance"), quantity="receptance")
    lumped = Dahl(0.1, 30.0) + Mass(M) + Damper(C) + Spring(K)
    A = np.geomspace(1e-5, 1.0, 7)[:, None]
    error = relative_error(plant.dynamic_stiffness(A, OMEGA), lumped.dynamic_stiffness(A, OMEGA))
    assert error < 1e-12
    third = plant.dynamic_stiffness(A, OMEGA, harmonic=3)
    np.testing.assert_array_equal(third, lumped.dynamic_stiffness(A, OMEGA, harmonic=3))


def test_measured_response_has_no_force_over_time():
    element = LinearSystem(control.frd(1.0 / STIFFNESS, OMEGA), quantity="receptance")
    with pytest.raises(ModelError, match=r"receptance of F.*not a rational function of s"):
        element.force([0.0, 1.0])

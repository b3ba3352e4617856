"""The public Dahl element: derived quantities, derivatives, limits, and what it refuses."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from dahl_ident import Dahl, Model
from dahl_ident.errors import ModelError, ValidationError

ALPHAS = (0.25, 0.5, 1.0, 2.0, 4.0)
DECADES = np.geomspace(1e-12, 1e12, 49)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_derived_quantities_agree_with_each_other(alpha):
    friction = Dahl(0.5, 30.0, alpha)
    A = np.geomspace(1e-4, 10.0, 31)
    N = friction.describing_function(A)
    a, b = friction.fourier_coefficients(A)
    np.testing.assert_allclose((a - 1j * b) / A, N, rtol=1e-12)
    np.testing.assert_allclose(friction.gain(A), np.abs(N), rtol=1e-14)
    np.testing.assert_allclose(friction.phase(A), np.angle(N), rtol=1e-14)
    np.testing.assert_array_equal(friction.equivalent_stiffness(A), N.real)
    damping = friction.equivalent_damping(A, [[2.0], [7.0]])
    assert damping.shape == (2, 31)
    np.testing.assert_allclose(damping, N.imag / np.array([[2.0], [7.0]]), rtol=1e-14)
    # a damper c loses pi c omega A^2 a cycle
    np.testing.assert_allclose(
        friction.dissipated_energy(A), np.pi * 7.0 * damping[1] * A**2, rtol=1e-12
    )
    assert np.all((friction.phase(A) > 0.0) & (friction.phase(A) < np.pi / 2.0))


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("beta", [0.05, 1.0, 30.0])
def test_dissipated_energy_is_the_area_of_the_loop(alpha, beta):
    friction = Dahl(0.5, 30.0, alpha)
    A = beta * friction.characteristic_displacement
    x, force = friction.loop(A, points=40001)
    assert x[0] == x[-1] == A
    assert friction.dissipated_energy(A) == pytest.approx(trapezoid(force, x), rel=1e-5)


# limits


@pytest.mark.parametrize("alpha", ALPHAS)
def test_at_rest_friction_is_a_spring(alpha):
    friction = Dahl(0.5, 30.0, alpha)
    assert friction.describing_function(0.0) == 30.0
    assert friction.equivalent_damping(0.0, 1.0) == 0.0
    assert friction.dissipated_energy(0.0) == 0.0
    assert [float(c) for c in friction.fourier_coefficients(0.0)] == [0.0, 0.0]
    assert friction.dynamic_stiffness(0.0, harmonic=3) == 0.0


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("k", [2, 4, 14, 100])
def test_even_harmonics_are_exactly_zero(alpha, k):
    model = Model(Dahl(0.5, 30.0, alpha)).with_free(["f_max", "sigma", "alpha"])
    A = np.array([0.0, 1e-12, 0.01, 1e3])
    found = model.stiffness_gradient(model.known_values(), A, np.zeros(()), k)
    for part in (found.value, found.by_amplitude, *found.by_parameter):
        np.testing.assert_array_equal(part, np.zeros(4))


@pytest.mark.parametrize("alpha", ALPHAS)
def test_gradient_at_rest_is_the_limit(alpha):
    friction = Dahl(0.5, 30.0, alpha)
    at_rest, near = friction.gradient(0.0), friction.gradient(1e-9)
    assert at_rest["sigma"] == 1.0
    assert at_rest["f_max"] == 0.0
    assert at_rest["alpha"] == 0.0
    rayleigh = 4.0j / (3.0 * np.pi) * alpha * 30.0**2 / 0.5
    assert complex(at_rest["amplitude"]) == pytest.approx(rayleigh, rel=1e-14)
    assert complex(near["amplitude"]) == pytest.approx(rayleigh, rel=1e-6)


@pytest.mark.parametrize("alpha", [1.0, 2.0])
@pytest.mark.parametrize("f_max", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("sigma", [1e-30, 1.0, 1e30])
def test_extreme_units_give_the_same_curve(alpha, f_max, sigma):
    """Any warning fails the test, as everywhere here."""
    friction, unit = Dahl(f_max, sigma, alpha), Dahl(1.0, 1.0, alpha)
    x_c = friction.characteristic_displacement
    beta = DECADES if alpha == 1.0 else DECADES[12:37]
    A = x_c * beta
    np.testing.assert_allclose(
        friction.describing_function(A) / sigma, unit.describing_function(beta), rtol=1e-12
    )
    ours, truth = friction.gradient(A), unit.gradient(beta)
    np.testing.assert_allclose(ours["sigma"], truth["sigma"], rtol=1e-9)
    np.testing.assert_allclose(ours["f_max"] * x_c, truth["f_max"], rtol=1e-9)
    a, b = friction.fourier_coefficients(A, harmonic=3)
    a1, b1 = unit.fourier_coefficients(beta, harmonic=3)
    np.testing.assert_allclose((a - 1j * b) / f_max, a1 - 1j * b1, rtol=1e-9)
    force = friction.force(x_c * np.array([0.0, 1.0, 0.5]))
    expected = unit.force([0.0, 1.0, 0.5])
    np.testing.assert_allclose(force / f_max, expected, rtol=1e-12)
    assert np.all(np.isfinite(friction.loop(float(A[-1]))[1]))


# scalars and shapes

CALLS: dict[str, Callable[[Dahl, Any], Any]] = {
    "describing_function": lambda d, A: d.describing_function(A),
    "gain": lambda d, A: d.gain(A),
    "phase": lambda d, A: d.phase(A),
    "equivalent_stiffness": lambda d, A: d.equivalent_stiffness(A),
    "equivalent_damping": lambda d, A: d.equivalent_damping(A, 2.0),
    "dissipated_energy": lambda d, A: d.dissipated_energy(A),
    "fourier_coefficients": lambda d, A: d.fourier_coefficients(A, harmonic=3)[0],
    "gradient": lambda d, A: d.gradient(A)["sigma"],
    "dynamic_stiffness": lambda d, A: d.dynamic_stiffness(A),
}
every_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())


@every_call
@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_scalars_stay_scalars_and_shapes_stay(call, alpha):
    friction = Dahl(0.5, 30.0, alpha)
    one = call(friction, 0.01)
    assert isinstance(one, float | complex)
    assert call(friction, 1).dtype == np.asarray(one).dtype  # whole numbers are numbers too
    grid = call(friction, [[0.01, 0.02], [0.0, 3.0]])
    assert isinstance(grid, np.ndarray)
    assert grid.shape == (2, 2)
    many = call(friction, np.append(np.geomspace(1e-4, 10.0, 500), 0.01))
    assert grid[0, 0] == pytest.approx(one, rel=1e-14)
    assert many[-1] == pytest.approx(one, rel=1e-13)
    assert call(friction, []).shape == (0,)


def test_arguments_are_not_changed():
    A = np.array([0.01, 0.02])
    kept = A.copy()
    for call in CALLS.values():
        call(Dahl(0.5, 30.0), A)
        call(Dahl(0.5, 30.0, 2.0), A)
    np.testing.assert_array_equal(A, kept)


@pytest.mark.parametrize("alpha", [1.0, 1e-9, 0.5, 2.0, 1e2])
@pytest.mark.parametrize("f_max", [1e-90, 1.0, 1e90])
@pytest.mark.parametrize("sigma", [1e-90, 1.0, 1e90])
def test_every_call_is_finite_to_the_edges_of_what_is_accepted(f_max, sigma, alpha):
    friction = Dahl(f_max, sigma, alpha)
    A = np.array([0.0, 5e-324, 1e-300, 1e-100, 1e-30, 1.0, 1e30, 1e90])
    N = friction.describing_function(A)
    assert np.all((N.real >= 0.0) & (N.imag >= 0.0) & (np.abs(N) <= sigma * (1.0 + 1e-15)))
    assert N[0] == sigma
    for values in friction.gradient(A).values():
        assert np.isfinite(values).all()
    for k in (1, 3, 15):
        a, b = friction.fourier_coefficients(A, k)
        assert np.all(np.abs(a + 1j * b) <= 4.0 / np.pi * f_max * (1.0 + 1e-12))
    x, F = friction.loop(1e90)
    assert np.all(np.abs(F) <= f_max * (1.0 + 1e-15))
    assert np.all(np.abs(friction.force([*x, *(1e-5 * x)])) <= f_max * (1.0 + 1e-15))


# what is refused


@pytest.mark.parametrize(
    ("amplitude", "text"),
    [
        (-1.0, r"^amplitude is -1\.0; expected numbers >= 0$"),
        ([1.0, -2.0, -3.0], r"^amplitude\[1\] is -2\.0 \(2 such values\); expected numbers >= 0$"),
        ([[1.0, np.nan]], r"^amplitude\[0, 1\] is nan; expected finite numbers$"),
        (np.inf, r"^amplitude is inf; expected finite numbers$"),
        ([1.0 + 0.0j], r"^amplitude: expected real numbers, got complex ones"),
        (["a"], r"^amplitude: expected real numbers, got dtype <U1$"),
        ([True], r"^amplitude: expected real numbers, got dtype bool$"),
        (1e101, r"^amplitude is 1e\+101; expected numbers of at most 1e\+90 in size; check the"),
        ([[1.0], [1.0, 2.0]], r"^amplitude: expected an array of real numbers"),
    ],
)
def test_bad_amplitudes_are_named(amplitude, text):
    for call in CALLS.values():
        with pytest.raises(ValidationError, match=text):
            call(Dahl(0.5, 30.0), amplitude)


@pytest.mark.parametrize("parameter", ["f_max", "sigma", "alpha"])
@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, r" is 0\.0; expected numbers > 0"),
        (-1.0, r" is -1\.0; expected numbers > 0"),
        (np.nan, r" is nan; expected finite"),
        (np.inf, r" is inf; expected finite"),
        (1j, r": expected real numbers, got complex"),
        ([1.0, 2.0], r": expected one number, got an array of shape \(2,\)"),
        ("0.1", r": expected real numbers, got '0.1'"),
        (True, r": expected real numbers, got True"),
        (1e-200, r" is 1e-200; expected numbers of at least 1e-90; check the unit"),
    ],
)
def test_bad_parameters_are_named(parameter, value, text):
    given_values: dict[str, Any] = {"f_max": 1.0, "sigma": 1.0, parameter: value}
    with pytest.raises(ValidationError, match=f"^pivot_{parameter}{text}"):
        Dahl(**given_values, name="pivot")


@pytest.mark.parametrize(
    ("displacement", "text"),
    [
        ([0.0, 1.0j], r"^displacement: expected real numbers, got complex"),
        ([0.0, np.nan], r"^displacement\[1\] is nan"),
        ([[0.0, 1.0]], r"^displacement has shape \(1, 2\); expected one history, shape \(n,\)"),
    ],
)
def test_bad_histories_are_named(displacement, text):
    with pytest.raises(ValidationError, match=text):
        Dahl(1.0, 1.0).force(displacement)


def test_other_bad_arguments_are_named():
    friction = Dahl(1.0, 1.0)
    with pytest.raises(ValidationError, match=r"initial_force is 1\.5; .* -1 and 1"):
        friction.force([0.0, 1.0], initial_force=1.5)
    with pytest.raises(ValidationError, match=r"initial_force is nan"):
        friction.force([0.0, 1.0], initial_force=np.nan)
    with pytest.raises(ValidationError, match=r"omega\[1\] is 0\.0; expected numbers > 0"):
        friction.equivalent_damping(1.0, [1.0, 0.0])
    with pytest.raises(ValidationError, match=r"amplitude \(2,\), omega \(3,\)"):
        friction.equivalent_damping([1.0, 2.0], [1.0, 2.0, 3.0])
    with pytest.raises(ValidationError, match="harmonic is 0"):
        friction.fourier_coefficients(1.0, harmonic=0)
    with pytest.raises(ValidationError, match="points is 2"):
        friction.loop(1.0, points=2)
    with pytest.raises(ValidationError, match=r"amplitude is 0\.0; expected numbers > 0"):
        friction.loop(0.0)
    with pytest.raises(ModelError, match=r"has no value for sigma"):
        _ = Dahl(1.0).characteristic_displacement
    with pytest.raises(
        ValidationError, match=r"^alpha is 1e-10; expected numbers from 1e-09 to 1000"
    ):
        Dahl(1.0, 1.0, 1e-10)

"""What every element promises, one contract over all of them and over sums."""

import importlib
from dataclasses import replace
from functools import lru_cache
from typing import Any

import mpmath
import numpy as np
import pytest
from mpmath import mpf

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Dahl, Damper, Element, LinearSystem, Mass, Model, Parameter, Spring
from dahl_ident.errors import ModelError, ValidationError

control: Any = importlib.import_module("control")


def mode(mass, damping, stiffness):
    return control.tf([1.0], [mass, damping, stiffness])


def base():
    """Return a linear system whose arguments declare their units."""
    return LinearSystem(
        mode,
        quantity="receptance",
        parameters={
            "mass": Parameter("", "kg", "mass", 0.3),
            "damping": Parameter("", "N s/m", "damping", 0.24),
            "stiffness": Parameter("", "N/m", "stiffness", 7.0),
        },
        name="base",
    )


FRICTION = {
    "linear Dahl": Dahl(0.5, 30.0),
    "Dahl, alpha 1/2": Dahl(0.5, 30.0, 0.5),
    "Dahl, alpha 2": Dahl(0.5, 30.0, 2.0),
}
LINEAR = {"mass": Mass(0.3), "damper": Damper(0.24), "spring": Spring(7.0)}
SUMS: dict[str, Element] = {
    "plant": Dahl(0.5, 30.0) + Mass(0.3) + Damper(0.24) + Spring(7.0),
    "two frictions": Dahl(0.5, 30.0, name="a") + Dahl(0.2, 40.0, 2.0, name="b") + Spring(1.0),
}
EVERY: dict[str, Element] = {
    **FRICTION,
    **LINEAR,
    **SUMS,
    "transfer function": LinearSystem(mode(0.3, 0.24, 7.0), quantity="receptance"),
    "function": base(),
    "plant with function": Dahl(0.5, 30.0) + base(),
}
AMPLITUDE = np.array([[0.004], [0.03], [0.5]])  # beta = 0.24, 1.8 and 30 for f_max, sigma above
OMEGA = np.array([0.7, 3.0, 11.0, 40.0])

every_element = pytest.mark.parametrize("element", EVERY.values(), ids=EVERY.keys())


def all_free(element):
    """Return the element with every parameter free, so that every derivative is computed."""
    return Model(element).with_free([p.name for p in element.parameters])


# shapes


@every_element
def test_scalars_give_scalars_and_arrays_broadcast(element):
    one = element.dynamic_stiffness(0.03, 3.0)
    assert isinstance(one, complex)
    grid = element.dynamic_stiffness(AMPLITUDE, OMEGA)
    assert grid.shape == (3, 4)
    assert grid[1, 1] == pytest.approx(one, rel=1e-14)
    assert element.dynamic_stiffness(np.zeros((0, 1)), OMEGA).shape == (0, 4)


@every_element
@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_batches_of_parameters_are_each_alone(element, harmonic):
    model = all_free(element)
    rng = np.random.default_rng(5)
    vectors = np.array([float(v) for v in model.known_values()]) * rng.uniform(
        0.7, 1.4, (5, len(model.parameters))
    )
    A, omega = AMPLITUDE.ravel(), OMEGA[:3]
    together = model.stiffness_gradient(list(vectors.T[:, :, None]), A, omega, harmonic)
    assert len(together.by_parameter) == len(model.parameters)
    value = model.stiffness(list(vectors.T[:, :, None]), A, omega, harmonic)
    np.testing.assert_allclose(together.value, value, rtol=1e-13)
    for s, vector in enumerate(vectors):
        alone = model.stiffness_gradient([np.asarray(v) for v in vector], A, omega, harmonic)
        pairs = zip(
            (together.value, together.by_amplitude, *together.by_parameter),
            (alone.value, alone.by_amplitude, *alone.by_parameter),
            strict=True,
        )
        for batch, single in pairs:
            np.testing.assert_allclose(np.broadcast_to(batch, (5, 3))[s], single, rtol=1e-10)


@every_element
def test_rows_of_several_harmonics_are_each_that_of_one(element):
    model = all_free(element)
    values = list(model.known_values())
    A, omega, orders = AMPLITUDE.ravel(), OMEGA[:3], np.array([3, 1, 2])
    together = model.stiffness_gradient(values, A, omega, orders)
    value = model.stiffness(values, A, omega, orders)
    for i, k in enumerate(orders.tolist()):
        alone = model.stiffness_gradient(values, A, omega, k)
        size = np.abs(model.stiffness(values, A, omega)).max()
        assert value[i] == pytest.approx(np.broadcast_to(alone.value, 3)[i], abs=1e-9 * size)
        for several, one in zip(together.by_parameter, alone.by_parameter, strict=True):
            expected = np.broadcast_to(one, 3)[i]
            assert np.broadcast_to(several, 3)[i] == pytest.approx(expected, rel=1e-6, abs=1e-9)


# values and derivatives


ORDER: dict[type[Element], int] = {Mass: 2, Damper: 1, Spring: 0}


@lru_cache
def friction_exactly(p, A, harmonic):
    """Return F_k/X_1 by quadrature over half of the closed loop of Eqn. 2."""
    f_max, sigma, alpha = p
    beta = sigma * A / f_max

    def margin(start, path):
        if alpha == 1:
            return start * mpmath.exp(-path)
        left = start ** (1 - alpha) - (1 - alpha) * path
        return left ** (1 / (1 - alpha)) if left > 0 else mpf(0)

    full_slip = alpha < 1 and 2 ** (1 - alpha) <= (1 - alpha) * 2 * beta
    f0 = mpf(1)
    if not full_slip:
        f0 = mpmath.findroot(
            lambda f: margin(1 + f, 2 * beta) - (1 - f), (mpf(0), mpf(1)), solver="anderson"
        )
    stops = [mpf(0), mpmath.pi / 2, mpmath.pi]
    if full_slip:
        path = 2 ** (1 - alpha) / (1 - alpha)
        stops = sorted([*stops, mpmath.acos(1 - path / beta)])

    def integrand(theta):
        force = margin(1 + f0, beta * (1 - mpmath.cos(theta))) - 1
        return force * mpmath.expj(-harmonic * theta)

    return f_max / A * 2 / mpmath.pi * mpmath.quad(integrand, stops)


def exactly(element, p, A, omega, harmonic):
    """Return F_k/X_1 of any element or sum, in mpmath."""
    total, first = mpmath.mpc(0), 0
    s = 1j * omega
    for part in Model(element).elements:
        own = p[first : first + len(part.parameters)]
        first += len(own)
        if isinstance(part, Dahl):
            total += friction_exactly(tuple(own), A, harmonic)
        elif harmonic != 1:
            continue
        elif isinstance(part, LinearSystem):
            mass, damping, stiffness = own or (mpf(0.3), mpf(0.24), mpf(7.0))
            total += mass * s**2 + damping * s + stiffness
        else:
            total += own[0] * s ** ORDER[type(part)]
    return total


@every_element
@pytest.mark.parametrize("harmonic", [1, 3])
def test_values_and_all_derivatives_against_30_digits(element, harmonic):
    model = all_free(element)
    values = model.known_values()
    A, w = float(AMPLITUDE[1, 0]), float(OMEGA[1])
    ours = model.stiffness_gradient(values, np.asarray(A), np.asarray(w), harmonic)
    with mpmath.workdps(30):
        p = [mpf(float(v)) for v in values]
        step = mpf(10) ** -9

        def at(change, index=None):
            q = [v + change if i == index else v for i, v in enumerate(p)]
            return exactly(element, q, mpf(A) + (change if index is None else 0), mpf(w), harmonic)

        def slope(size, index=None):
            change = step * mpf(size)
            return complex((at(change, index) - at(-change, index)) / (2 * change))

        value = complex(at(mpf(0)))
        assert complex(ours.value) == pytest.approx(value, rel=1e-11, abs=1e-300)
        assert complex(ours.by_amplitude) == pytest.approx(slope(A), rel=1e-9, abs=1e-300)
        for i, (derivative, size) in enumerate(zip(ours.by_parameter, values, strict=True)):
            # a function's derivatives are differences: good to 1e-11 of Z/p, not of themselves
            allowed = 1e-10 * abs(value / float(size))
            assert complex(derivative) == pytest.approx(
                slope(float(size), i), rel=1e-8, abs=allowed
            )


# units


DIMENSION = {"N": (1, 0), "N/m": (1, -1), "kg": (1, -1), "N s/m": (1, -1), "": (0, 0)}
"""Powers of the units of force and displacement in the unit of a parameter."""


@every_element
@pytest.mark.parametrize(("force", "displacement"), [(1e3, 1.0), (1.0, 1e-6), (4.448, 0.0254)])
def test_other_units_scale_parameters_as_their_units_say(element, force, displacement):
    if isinstance(element, LinearSystem) and not element.parameters:
        return  # a fixed system has no parameter to scale
    model = Model(element)
    scaled = model.with_parameters(
        {
            p.name: replace(
                p,
                value=float(p.value or 0.0)
                * force ** DIMENSION[p.unit][0]
                * displacement ** DIMENSION[p.unit][1],
            )
            for p in model.parameters
        }
    )
    for harmonic in (1, 3):
        ours = scaled.dynamic_stiffness(AMPLITUDE * displacement, OMEGA, harmonic=harmonic)
        expected = model.dynamic_stiffness(AMPLITUDE, OMEGA, harmonic=harmonic)
        np.testing.assert_allclose(ours, expected * force / displacement, rtol=1e-11)


# physics


@every_element
def test_no_element_gives_energy(element):
    A = np.geomspace(1e-9, 1e6, 61)[:, None]
    Z = element.dynamic_stiffness(A, OMEGA)
    assert np.all(Z.imag >= -1e-14 * np.abs(Z))
    assert np.max(Z.imag) > 0.0 or type(element) in (Mass, Spring)


# bookkeeping


@every_element
def test_amplitudes_and_frequencies_are_checked(element):
    cases: list[tuple[Any, str]] = [
        ([0.1, -1.0], r"amplitude\[1\] is -1\.0"),
        (np.nan, r"amplitude is nan"),
        (1j, r"amplitude: expected real numbers, got complex"),
    ]
    for wrong, text in cases:
        with pytest.raises(ValidationError, match=text):
            element.dynamic_stiffness(wrong, 1.0)
    with pytest.raises(ValidationError, match=r"omega\[0\] is -2\.0"):
        element.dynamic_stiffness(1.0, [-2.0])
    with pytest.raises(ValidationError, match=r"amplitude \(2,\), omega \(3,\)"):
        element.dynamic_stiffness([1.0, 2.0], [1.0, 2.0, 3.0])
    no_harmonics: list[Any] = [-1, 1.5, True]
    for harmonic in no_harmonics:
        with pytest.raises(ValidationError, match="harmonic is"):
            element.dynamic_stiffness(1.0, 1.0, harmonic=harmonic)


@pytest.mark.parametrize(
    ("element", "missing"),
    [
        (Dahl(sigma=1.0), "f_max"),
        (Dahl(name="pivot"), "pivot_f_max, pivot_sigma"),
        (Mass(), "mass"),
        (Damper(), "damping"),
        (Spring(), "stiffness"),
        (Dahl(1.0) + Mass() + Spring(1.0), "sigma, mass"),
        (LinearSystem(mode, quantity="receptance", parameters={"mass": None}), "mass"),
    ],
)
def test_a_missing_value_is_named(element, missing):
    with pytest.raises(ModelError, match=f"has no value for {missing};"):
        element.dynamic_stiffness(1.0, 1.0)


def test_histories_that_an_element_needs_are_asked_for():
    x: FloatArray = np.array([0.0, 1.0])
    with pytest.raises(ValidationError, match=r"Mass\(mass=0\.3\) needs acceleration"):
        Mass(0.3).force(x)
    with pytest.raises(ValidationError, match=r"Damper\(damping=0\.24\) needs velocity"):
        (Spring(1.0) + Damper(0.24)).force(x)
    with pytest.raises(ValidationError, match=r"velocity\[1\] is nan"):
        Damper(0.24).force(x, velocity=[0.0, np.nan])
    for element in (Damper(0.24), Spring(1.0) + Damper(0.24), Damper(1.0) + Dahl(1.0, 1.0)):
        with pytest.raises(ValidationError, match=r"velocity has shape \(3,\); expected .* \(2,\)"):
            element.force(x, velocity=[0.0, 1.0, 2.0])


def test_names_clash_or_are_refused():
    with pytest.raises(ModelError, match=r"share the parameter names f_max, sigma, alpha"):
        Dahl(1.0, 1.0) + Dahl(2.0, 2.0)
    with pytest.raises(ValidationError, match=r"name is 'two words'"):
        Spring(1.0, name="two words")
    with pytest.raises(ValidationError, match=r"name is 3; expected letters"):
        Spring(1.0, name=3)  # type: ignore[arg-type]  # the point of the test
    with pytest.raises(ModelError, match="at least one element"):
        Model()

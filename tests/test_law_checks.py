"""A user's law is checked when it is first used; every mistake has an error of its own."""

# ruff: noqa: ARG005  # the laws below take every argument
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

import dahl_ident as di
from dahl_ident.errors import DahlIdentError, ModelError, ValidationError

Slope = Callable[..., Any]


def positive(name, unit=""):
    return di.Parameter(name, unit, name, lower=0.0, transform="log")


USUAL = (positive("f_max", "N"), positive("sigma", "N/m"))


def law(slope, parameters=USUAL, **attributes):
    """Return a new class, which nothing has used before."""
    return type("Mine", (di.Friction,), {"slope": slope, "parameters": parameters, **attributes})


def dahl(self, force, direction, velocity, values):
    return values[1] * (1.0 - direction * force / values[0])


SOUND: dict[str, Slope] = {
    "dahl": dahl,
    "kink": lambda _, F, d, v, p: p[1] * (d * F < p[0]),
    "two kinks": lambda _, F, d, v, p: (
        p[1] * ((d * F / p[0] < 0.5) + 0.2 * (d * F / p[0] >= 0.5)) * (d * F / p[0] < 1.0)
    ),
    "two limits": lambda _, F, d, v, p: p[1] * (1.0 - d * F / np.where(d > 0, p[0], 2 * p[0])),
    "power": lambda _, F, d, v, p: (
        p[1] * np.sign(1.0 - d * F / p[0]) * np.abs(1.0 - d * F / p[0]) ** 0.5
    ),
    "no full slip": lambda _, F, d, v, p: p[1] / (1.0 + np.abs(F / p[0]) * (1.0 + d * np.sign(F))),
    "hardens": lambda _, F, d, v, p: p[1] * (0.1 + np.exp(-d * F / p[0])),
    "bilinear": lambda _, F, d, v, p: p[1] * (1e-3 + (d * F < p[0])),
    "overflows far beyond slip": lambda _, F, d, v, p: (
        p[1] * (1.0 - d * F / p[0]) * np.exp(-0.7 * d * F / p[0])
    ),
}

WRONG: dict[str, tuple[Slope, str]] = {
    "nan beyond slip": (
        lambda _, F, d, v, p: p[1] * (1.0 - d * F / p[0]) ** 0.5,
        r"Mine\.slope is nan at force = 0\.2.* N, direction = \+1, f_max = 0\.2, sigma = 3; "
        "expected a finite number",
    ),
    "nan": (lambda _, F, d, v, p: F * np.nan, r"is nan at force = 0 N"),
    "infinite": (lambda _, F, d, v, p: p[1] / np.abs(F), r"is inf at force = 0 N"),
    "infinite at full slip": (
        lambda _, F, d, v, p: p[1] / (1.0 - d * F / p[0]), r"is inf at force = 0\.2 N, direction"
    ),
    "infinite between": (
        lambda _, F, d, v, p: p[1] * (1.0 - d * F / p[0]) / (d * F / p[0] - 0.503) ** 2,
        r"is inf at force = 0\.1006 N, direction = \+1",
    ),
    "infinite after reversal": (
        lambda _, F, d, v, p: p[1] / (1.0 + d * F / p[0]),
        r"is inf at force = -0\.2 N, direction = \+1.* also after the direction has changed",
    ),
    "infinite after reversal, positive around": (
        lambda _, F, d, v, p: p[1] + p[1] / (3.0 + d * F / p[0]) ** 2,
        r"is inf at force = -0\.6 N, direction = \+1",
    ),
    "negative far from rest": (
        lambda _, F, d, v, p: p[1] * (0.1 + 1 / (1 + (F / p[0]) ** 2) - 0.5 * (d * F < -2 * p[0])),
        r"is -.* N/m, negative before full slip, at force = -.*, direction = \+1",
    ),
    "infinite from a force on": (
        lambda _, F, d, v, p: np.where(d * F > 0.5 * p[0], np.inf, p[1] * (1.0 - d * F / p[0])),
        r"is inf at force = 0\.1 N, direction = \+1",
    ),
    "negative": (lambda _, F, d, v, p: -dahl(_, F, d, v, p), r"is -3 N/m at force = 0 N"),
    "zero": (lambda _, F, d, v, p: 0.0 * F, r"is 0 N/m at force = 0 N.* expected a positive slope"),
    "negative after reversal": (
        lambda _, F, d, v, p: p[1] * (1.0 - d * F / p[0]) * (d * F / p[0] + 0.5),
        r"is -3 N/m, negative before full slip, at force = -0\.2 N, direction = \+1",
    ),
    "negative between": (
        lambda _, F, d, v, p: p[1] * np.cos(4.0 * d * F / p[0]),
        r"negative before full slip, .*, and positive again at larger forces",
    ),
    "negative in a part": (
        lambda _, F, d, v, p: (
            p[1] * (1.0 - d * F / p[0]) * (0.5 - d * F / p[0]) * (0.3 - d * F / p[0])
        ),
        r"negative before full slip, at force = 0\.07\d* N, .*, and positive again",
    ),
    "constant number": (lambda _, F, d, v, p: 3.0, r"is 3 N/m for every force .*use di\.Spring"),
    "constant array": (lambda _, F, d, v, p: p[1] * np.ones_like(F), r"a constant number"),
    "largest of all": (
        lambda _, F, d, v, p: p[1] * np.max(1.0 - d * F / p[0]),
        r"a constant number.*\(np\.max takes the largest of a whole array, np\.maximum of each\)",
    ),
    "shape": (
        lambda _, F, d, v, p: np.ones(7),
        r"returned the shape \(7,\) for an array of \(1, \d+\) forces, and 2 values; expected",
    ),
    "dimensions": (lambda _, F, d, v, p: np.ones((2, 3, 4)), r"returned the shape \(2, 3, 4\)"),
    "text": (lambda _, F, d, v, p: "stiff", r"returned 'stiff', numbers of type <U5; expected"),
    "None": (lambda _, F, d, v, p: None, r"returned None; expected dF/dx, N/m: end it with return"),
    "complex": (lambda _, F, d, v, p: 1j * dahl(_, F, d, v, p), r"numbers of type complex128"),
    "if": (
        lambda _, F, d, v, p: p[1] if d > 0 else 2.0 * p[1],
        r"asks a Python question of arrays \(if, .*; write comparisons as factors",
    ),
    "if on a value": (
        lambda _, F, d, v, p: dahl(_, F, d, v, p) if p[0] > 0.0 else p[1] + 0.0 * F,
        r"asks a Python question of arrays",
    ),
    "min": (lambda _, F, d, v, p: p[1] * min(1.0, 1.0 - d * F / p[0]), r"asks a Python question"),
    "math": (lambda _, F, d, v, p: p[1] * math.exp(-d * F), r"TypeError.*; expected plain arithm"),
    "name": (lambda _, F, d, v, p: sgima * F, r"NameError: name 'sgima'"),  # type: ignore[name-defined] # noqa: F821
    "values": (lambda _, F, d, v, p: sum(a * b for a, b, *_ in [(*p, 1)]) + p[2], r"IndexError"),
    "velocity": (
        lambda _, F, d, v, p: p[1] * (1.0 - d * F / p[0] / (1.0 + np.abs(v))),
        r"failed without a velocity .* must declare rate_independent = False",
    ),
    "energy": (
        lambda _, F, d, v, p: p[1] * (1.0 + 0.5 * d * F / p[0]),
        r"creates energy: .* J in each cycle between -0\.131 and 0\.131 N, at f_max = 0\.2",
    ),
    "energy at reversals": (
        lambda _, F, d, v, p: p[1] * (1.0 - 0.5 * (d * F < 0.0)) * (d * F < p[0]),
        r"creates energy",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SOUND)
def test_sound_laws_pass(name):
    cls = law(SOUND[name])
    for given in ((), (1e-6, 1e9), (1e5, 1e-3), (None, 2.0)):
        assert isinstance(cls(*given), di.Friction)


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_are_named(name):
    slope, message = WRONG[name]
    with pytest.raises(ModelError, match=message):
        law(slope)(0.2, 3.0)
    with pytest.raises(ModelError, match=r"Mine\.slope"):
        law(slope)()


def test_the_energy_created_is_that_of_the_loop():
    """The loop between two forces, by another quadrature."""
    f, sigma = 0.2, 3.0
    slope, _ = WRONG["energy"]
    with pytest.raises(ModelError, match="creates energy") as raised:
        law(slope)(f, sigma)
    words = str(raised.value).split()
    created, F = float(words[words.index("energy:") + 1]), float(words[words.index("and") + 1])
    y = np.linspace(-F, F, 200001)
    exact = float(trapezoid(y / sigma * (1 / (1 + y / 2 / f) - 1 / (1 - y / 2 / f)), y))
    assert created == pytest.approx(-exact, rel=0.02)


def test_no_loop_is_an_error_and_not_a_number():
    """The slope is at least sigma (1 + F^2/f^2)/2, so F is infinite within 2 pi f/sigma."""

    def hardening(self, force, direction, velocity, values):
        f, sigma = values
        return sigma * (1.0 + (force / f) ** 2 - 0.5 * direction * np.tanh(force / f))

    mine = law(hardening)(1.0, 1.0)
    assert mine.gain(0.5) > 0.0
    for method in (mine.describing_function, mine.fourier_coefficients, mine.phase):
        with pytest.raises(ModelError, match="has no steady loop at the amplitude 4 m, where its"):
            method([0.5, 4.0, 5.0])


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ((positive("a", "N"), positive("a", "N")), "Mine declares the parameter a 2 times"),
        ((positive("a b", "N"),), "a parameter called 'a b'; expected letters, digits"),
        ((positive("name", "N"),), "a parameter called 'name'"),
        ((positive("lambda", "N"),), "a parameter called 'lambda'; expected"),
        (
            (di.Parameter("a", "N", "", lower=2.0, upper=1.0),),
            r"a has the bounds \(2.0, 1.0\); expected",
        ),
        ((di.Parameter("a", None, ""),), "unit of a is None"),
        ((di.Parameter("a", "N", "", lower="0"),), "a has the bounds"),  # type: ignore[arg-type]
        ((di.Parameter("a", "N", "", prior=5),), "a has the prior 5"),  # type: ignore[arg-type]
        ((di.Parameter("a", "N", "", lower=0.0, upper=1.0, scan=(5.0,)),), "a is scanned at 5"),
        ((di.Parameter("a", "N", "", prior=(2.0, 1.0)),), r"a has the prior \(2.0, 1.0\)"),
        ((di.Parameter("a", "N", "", upper=-1.0, transform="log"),), "its upper bound is -1"),
        (
            (di.Parameter("a", "N", "", lower=-1.0, transform="log"),),
            "its lower bound is -1; expected lower=0.0 or more",
        ),
        ((positive("a", "furlong"),), "unit of a is 'furlong'; expected a product of powers of N"),
        (("f_max", "sigma"), r"parameters is \('f_max', 'sigma'\); expected a tuple of di.Param"),
        ([positive("a", "N")], "expected a tuple"),
        (positive("a", "N"), r"parameters is Parameter\(name='a'.* expected a tuple"),
    ],
)
def test_declarations_are_checked(parameters, message):
    with pytest.raises(ValidationError, match=message):
        law(dahl, parameters)()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"scan": "abc"}, r"a has the scan 'abc'; expected a tuple of numbers, such as \(0.5"),
        ({"scan": ("low", 2.0)}, "expected a tuple of numbers"),
        ({"scan": None}, "expected a tuple of numbers"),
        ({"name": [1, 2]}, "called .* expected letters"),
        ({"description": [1, 2]}, "the description of a is"),
    ],
)
def test_parameters_of_the_wrong_type_are_named(changed, message):
    declared: dict[str, Any] = {"name": "a", "unit": "N", "description": "", **changed}
    with pytest.raises(ValidationError, match=message):
        law(dahl, (di.Parameter(**declared), positive("sigma", "N/m")))()


def test_several_states_are_refused():
    class Two(law(dahl)):  # type: ignore[misc]
        states = ("f", "g")

    with pytest.raises(ValidationError, match=r"Two declares states = \('f', 'g'\); a law has one"):
        Two(0.2, 3.0)


@pytest.mark.parametrize("rate_independent", [True, False])
@pytest.mark.parametrize(
    ("output", "message"),
    [
        (lambda _, F, slope, v, p: None, "output, of Mine is None for one force; expected one"),
        (lambda _, F, slope, v, p: "much", "output, of Mine is 'much' for one force"),
        (lambda _, F, slope, v, p: np.array([F, F]), "output, of Mine is array"),
        (lambda _, F, slope, v, p: F * np.nan, r"Mine\.output is nan at every force"),
        (lambda _, F, slope, v, p: np.sum(F), r"Mine\.output cannot be compiled: with symbols"),
        (lambda _, F, slope, v, p: math.sin(F), "cannot be compiled: TypeError"),
        (lambda _, F, slope, v, p: F if F > 0 else -F, "asks a Python question"),
    ],
)
def test_an_output_that_is_not_one_number_is_named(output, message, rate_independent):
    mine = law(dahl, output=output, rate_independent=rate_independent)(0.2, 3.0)
    with pytest.raises(ModelError, match=message):
        mine.dynamic_stiffness(0.1, 1.0)
    with pytest.raises(ModelError, match=message):
        drive(mine + di.Mass(1.0))


@pytest.mark.parametrize("method", ["rest_stiffness", "force_limits", "force_bounds", "knee"])
def test_methods_that_return_nothing_are_named(method):
    with pytest.raises(ModelError, match=rf"Mine\.{method} returned None; expected .* arra"):
        law(dahl, **{method: lambda _, values: None})(0.2, 3.0)


@pytest.mark.parametrize("more", [{}, {"mechanics": lambda *_: None}])
def test_a_law_of_several_states_is_refused(more):
    with pytest.raises(ModelError, match=r"Mine has 2 states; expected one, the force: .* with \+"):
        law(dahl, n_states=2, **more)(1.0, 1.0)


def test_mechanics_that_return_nothing_are_named():
    mine = law(dahl, mechanics=lambda _, p, x, v, s, states: None)(0.2, 3.0)
    with pytest.raises(ModelError, match=r"Mine\.mechanics returned None; expected an inertia"):
        drive(mine + di.Mass(1.0))


def test_a_law_is_checked_once():
    calls = []

    def slope(self, force, direction, velocity, values):
        calls.append(np.shape(force))
        return dahl(self, force, direction, velocity, values)

    cls = law(slope)
    cls(0.2, 3.0)
    assert 0 < len(calls) < 40
    before = len(calls)
    cls(0.2, 3.0)
    assert len(calls) == before


def test_a_law_that_is_sound_for_some_values_is_not_refused():
    """Bouc-Wen with exponent 1: values decide, not the class."""
    free = tuple(di.Parameter(name, "", name) for name in "abc")

    def slope(self, force, direction, velocity, values):
        a, b, c = values
        return a - np.abs(force) * (b * np.sign(direction * force) + c)

    cls = law(slope, free)
    assert cls(3.0, 0.9, 0.4).gain(1.0) > 0.0
    assert len(cls().parameters) == 3
    with pytest.raises(ModelError, match=r"at force = .* a = -3, b = 0.9, c = 0.4"):
        cls(-3.0, 0.9, 0.4)


def plant(slope):
    return law(slope)(1.0, 3.0) + di.Mass(0.3) + di.Damper(0.24)


def drive(model):
    from dahl_ident.elements import plant_equations

    plant_equations(model)


@pytest.mark.versions
def test_what_cannot_be_compiled_is_named():
    def loops(self, force, direction, velocity, values):
        found = np.zeros(np.broadcast(force, direction, values[0]).shape)
        found[...] = dahl(self, force, direction, velocity, values)
        return found

    def on_type(self, force, direction, velocity, values):
        numbers = isinstance(force, np.ndarray)
        return dahl(self, force, direction, velocity, values) * (1.0 if numbers else 2.0)

    def asks(self, force, direction, velocity, values):
        if isinstance(force, np.ndarray):
            return dahl(self, force, direction, velocity, values)
        return values[1] if direction > 0 else values[0]

    joined = r"joins comparisons by &, \| or ~; write np\.logical_and\(a, b\), np\.logical_or"
    written: tuple[Slope, ...] = (
        lambda _, F, d, v, p: p[1] * np.logical_and(d * F < p[0], d * F > -9.0 * p[0]),
        lambda _, F, d, v, p: p[1] * np.logical_or(d * F < p[0], d * F < -9.0 * p[0]),
        lambda _, F, d, v, p: p[1] * np.logical_not(d * F >= p[0]),
    )
    cases: tuple[tuple[Slope, str], ...] = (
        (loops, "gives another result; expected plain arithmetic"),
        (on_type, "gives another result; expected plain arithmetic"),
        (asks, "asks a Python question"),
        (lambda _, F, d, v, p: p[1] * ((d * F < p[0]) & (d * F > -9.0 * p[0])), joined),
        (lambda _, F, d, v, p: p[1] * ((d * F < p[0]) | (d * F < -9.0 * p[0])), joined),
        (lambda _, F, d, v, p: p[1] * ~(d * F >= p[0]), joined),
    )
    for rounded in (np.ceil, np.rint, lambda m: m // 1.0 + 0.1 * m):

        def stepped(self, force, direction, velocity, values, rounded=rounded):
            return values[1] * rounded(5.0 * np.maximum(1.0 - direction * force / values[0], 0.0))

        cases += ((stepped, r"rounds, or takes a remainder .* expected steps as comparisons"),)
    for slope, message in cases:
        with pytest.raises(DahlIdentError, match=message):
            drive(plant(slope))
    for slope in (SOUND["two limits"], *written):
        drive(plant(slope))

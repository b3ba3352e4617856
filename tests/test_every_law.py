"""One contract over every element class of the package, and over a law that a test defines."""

import json

import control
import numpy as np
import pytest

import dahl_ident as di
from dahl_ident import simulate
from dahl_ident.elements import KINDS, describe_model, model_from_description
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.synthetic import SteppedSine
from tests.derivatives import central_differences
from tests.test_generic_friction import Jenkins

LINEAR = {"mass", "damper", "spring", "linear_system"}
LAWS: dict[str, list[di.Element]] = {
    "dahl": [di.Dahl(1.0, 3.0), di.Dahl(1.0, 3.0, 0.5), di.Dahl(1.0, 3.0, 2.0, asymmetry=0.3)],
    "bouc_wen": [di.BoucWen(3.0, 1.3, 0.5), di.BoucWen(2.0, 0.7, 0.0), di.BoucWen(1.0, 0.0, 2.0)],
    "backlash": [di.Backlash(di.Dahl(1.0, 3.0), 0.5)],
    "iwan": [di.Iwan(1.0, 3.0, -0.5, 0.7)],
    "lugre": [di.LuGre(1.0, 3.0, 1.5, 0.7, 0.1, 0.2)],
    "maxwell_slip": [di.MaxwellSlip([0.1, 0.4, 0.9], [3.0, 2.0, 1.0])],
    "power_damper": [di.PowerDamper(2.0, 0.5)],
    "jenkins": [Jenkins(3.0, 0.3)],
}
EVERY = [law for laws in LAWS.values() for law in laws]
every_law = pytest.mark.parametrize("law", EVERY, ids=[repr(law) for law in EVERY])


def test_every_class_is_in_the_contract():
    package = {kind for kind, cls in KINDS.items() if cls.__module__.startswith("dahl_ident")}
    assert package - LINEAR == set(LAWS) - {"jenkins"}
    assert all(KINDS[kind].equation for kind in package)


LINEAR_PLANT = di.Mass(0.3) + di.Damper(0.24) + di.Spring(7.0)


@pytest.mark.parametrize(
    ("law", "A", "n", "limit"),
    [
        *((law, 1.0, 4096, 2e-5) for law in EVERY),
        *((di.Dahl(0.5, 30.0, alpha), A, 2**14, 1e-7) for alpha in (0.5, 1.0, 2.0)
          for A in (0.03, 0.5)),
        *((one, 0.5, 2**14, 1e-7) for one in (*LINEAR_PLANT.elements,
                                              di.Dahl(0.5, 30.0) + LINEAR_PLANT)),
        (di.Dahl(0.5, 30.0, name="a") + di.Dahl(0.2, 40.0, 2.0, name="b"), 0.03, 2**14, 1e-7),
    ],
    ids=repr,
)  # fmt: skip
def test_the_force_over_time_has_the_harmonics(law, A, n, limit):
    omega, theta = 2.0, 2.0 * np.pi * np.arange(12 * n) / n
    x, v, a = A * np.cos(theta), -A * omega * np.sin(theta), -A * omega**2 * np.cos(theta)
    spectrum = 2.0 / n * np.fft.rfft(law.force(x, velocity=v, acceleration=a)[-n:]) / A
    size = abs(complex(law.dynamic_stiffness(A, omega)))
    for k in (*range(6), 7):
        expected = complex(law.dynamic_stiffness(A, omega, harmonic=k)) * (2.0 if k == 0 else 1.0)
        assert abs(spectrum[k] - expected) < limit * size


@every_law
def test_derivatives_are_differences(law):
    model = di.Model(law).with_free([p.name for p in law.parameters])
    values, A, w = model.known_values(), np.array([0.7, 2.0]), np.array(2.0)
    for k in (0, 1, 2, 3):
        found = model.stiffness_gradient(values, A, w, k)
        size = np.abs(model.stiffness(values, A, w))
        exact = [*(d * v for d, v in zip(found.by_parameter, values, strict=True)),
                 found.by_amplitude * A]  # fmt: skip

        def stiffness(factors, k=k):
            return model.stiffness(list(factors[:-1] * values), factors[-1] * A, w, k)

        slopes = central_differences(stiffness, np.ones(len(values) + 1), 1e-4)
        assert np.all(np.abs(np.array(exact) - slopes) < 1e-5 * size)


UNKNOWN = [
    di.Dahl(asymmetry=None, name="pivot"),
    di.Backlash(di.Dahl(1.0, None, name="pivot"), 0.1),
    di.Backlash(di.Dahl(asymmetry=None)),
    di.PowerDamper(2.0, 0.5, name="oil"),
]
BOUNDED = di.Parameter("sigma", "N/m", "contact stiffness", 3.0, True, 1.0, 9.0, "log")
PLANT = di.Dahl(0.1, alpha=None, name="pivot") + di.Mass(0.3) + di.Damper() + di.Spring(2.0)
SUMS = [PLANT.with_free(["stiffness"]), di.Model(di.Dahl()).with_parameters({"sigma": BOUNDED})]


def described(element):
    return model_from_description(json.loads(json.dumps(describe_model(element))))


@pytest.mark.parametrize("law", [*EVERY, *UNKNOWN, *SUMS], ids=repr)
def test_description_comes_back(law):
    again, model = described(law), di.Model(law)
    assert again.parameters == model.parameters
    assert repr(again) == repr(model)
    assert [type(e) for e in again.elements] == [type(e) for e in model.elements]


@pytest.mark.parametrize(
    "system",
    [
        control.tf([2.0], [0.3, 0.24, 0.3]),
        control.ss([[0.0, 1.0], [-1.0, -0.8]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.1]]),
        control.tf([2], [1, 3], None),
        control.tf([1.0, 0.2], [1.0, -0.5], 1e-3),
        control.FRD(np.array([1.0 + 1.0j, 0.5j, 0.1, 0.01j]), [1.0, 10.0, 100.0, 500.0]),
    ],
    ids=["transfer function", "state space", "whole numbers", "discrete", "FRD"],
)
def test_descriptions_of_linear_systems_come_back(system):
    model, omega = di.LinearSystem(system, quantity="receptance", name="plate"), [1.0, 20.0, 300.0]
    Z = model.dynamic_stiffness(1.0, omega)
    np.testing.assert_allclose(described(model).dynamic_stiffness(1.0, omega), Z, rtol=1e-13)


def test_a_function_has_no_description():
    system = di.LinearSystem(
        lambda k: control.tf([1.0], [k]), quantity="receptance", parameters={"k": None}
    )
    with pytest.raises(ModelError, match="built by a function, which no file can hold"):
        describe_model(system)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            {"kind": "dhal"},
            "has the kind 'dhal'; expected a law .*, or one of .*dahl.*, mass, damper, spring",
        ),
        ({"kind": "mass", "m": 1.0}, "the mass element has the keys m; expected mass"),
        ({"kind": "mass", "mass": {"strat": 1.0}}, "mass has the key 'strat'; .* mean 'start'"),
        *(
            ({"kind": "dahl", "f_max": f_max}, rf"^model\[0\]: {message}")
            for f_max, message in (
                ({"lower": "0.1"}, "lower of f_max: expected real numbers, got '0.1'"),
                ({"upper": 10**400}, "upper of f_max: expected real numbers, got 1000"),
                ({"lower": 2.0, "upper": 1.0}, "f_max has the bounds 2 and 1; expected the lower"),
                ({"free": False, "start": 0.1}, "free of f_max is False; expected true, or a num"),
                ({"assumed": 0.1, "upper": 1.0}, "f_max has the key 'upper'; .* with assumed"),
            )
        ),
        ({"kind": "dahl", "name": True}, "name is True; expected letters, digits and underscores"),
        (
            {"kind": "linear_system", "quantity": "receptance"},
            r"model\[0\]: the linear_system element has the keys quantity; expected quantity",
        ),
        (
            {"kind": "linear_system", "quantity": "receptance", "dt": 0}
            | {"numerator": "2", "denominator": [1]},
            "the linear_system element cannot be built",
        ),
        (
            {"kind": "linear_system", "quantity": "receptance", "dt": 0}
            | {"numerator": [2], "denominator": [1, 3], "nmae": "plate"},
            "has the keys quantity, dt, numerator, denominator, nmae; expected quantity",
        ),
    ],
)
def test_bad_descriptions_name_what_is_wrong(entry, message):
    with pytest.raises((ModelError, ValidationError), match=message):
        model_from_description([entry])


@every_law
def test_it_is_simulated_under_a_prescribed_displacement(law):
    steps = SteppedSine((0.2, 1.0), (1.0,), num_periods=2, settling_periods=1)
    record = simulate(di.Experiment(law, steps), seed=1)
    assert np.all(np.isfinite(np.asarray(record.force)))

"""Models as plain data and back."""

import json

import control
import numpy as np
import pytest

from dahl_ident import LinearSystem
from dahl_ident.elements import (
    Dahl,
    Damper,
    Mass,
    Model,
    Parameter,
    Spring,
    describe_model,
    model_from_description,
)
from dahl_ident.errors import ModelError

OMEGA = np.array([1.0, 20.0, 300.0])


def round_trip(model):
    return model_from_description(json.loads(json.dumps(describe_model(model))))


def test_every_parameter_survives():
    model = Dahl(0.1, alpha=None, name="pivot") + Mass(0.3) + Damper() + Spring(2.0)
    model = model.with_free(["stiffness"])
    assert round_trip(model).parameters == model.parameters
    assert repr(round_trip(model)) == repr(model)


def test_bounds_survive():
    bounded = Parameter("sigma", "N/m", "contact stiffness", 3.0, True, 1.0, 9.0, "log")
    model = Model(Dahl()).with_parameters({"sigma": bounded})
    assert round_trip(model).parameters == model.parameters


@pytest.mark.parametrize(
    "system",
    [
        control.tf([2.0], [0.3, 0.24, 0.3]),
        control.ss([[0.0, 1.0], [-1.0, -0.8]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.1]]),
        control.tf([1.0, 0.2], [1.0, -0.5], 1e-3),
        control.FRD(np.array([1.0 + 1.0j, 0.5j, 0.1, 0.01j]), [1.0, 10.0, 100.0, 500.0]),
    ],
    ids=["transfer function", "state space", "discrete", "FRD"],
)
def test_linear_systems_survive(system):
    model = Model(LinearSystem(system, quantity="receptance", name="plate"))
    Z = model.dynamic_stiffness(1.0, OMEGA)
    np.testing.assert_allclose(round_trip(model).dynamic_stiffness(1.0, OMEGA), Z, rtol=1e-13)


def test_a_function_is_refused():
    system = LinearSystem(
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
        ({"kind": "linear_system", "quantity": "receptance"}, "the linear_system element has no A"),
    ],
)
def test_bad_descriptions_name_what_is_wrong(entry, message):
    with pytest.raises(ModelError, match=message):
        model_from_description([entry])

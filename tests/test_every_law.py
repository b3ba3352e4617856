"""One contract over every element class of the package, and over a law that a test defines."""

import json

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident import simulate
from dahl_ident.elements import KINDS, describe_model, model_from_description
from dahl_ident.synthetic import SteppedSine
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


@every_law
def test_the_force_over_time_has_the_harmonics(law):
    n, A, omega = 4096, 1.0, 2.0
    theta = 2.0 * np.pi * np.arange(12 * n) / n
    x, v = A * np.cos(theta), -A * omega * np.sin(theta)
    spectrum = 2.0 / n * np.fft.rfft(law.force(x, velocity=v)[-n:]) / A
    size = abs(complex(law.dynamic_stiffness(A, omega)))
    for k in range(6):
        expected = complex(law.dynamic_stiffness(A, omega, harmonic=k)) * (2.0 if k == 0 else 1.0)
        assert abs(spectrum[k] - expected) < 2e-5 * size


@every_law
def test_derivatives_are_differences(law):
    model = di.Model(law).with_free([p.name for p in law.parameters])
    values, A, w = model.known_values(), np.array([0.7, 2.0]), np.array(2.0)
    for k in (0, 1, 2, 3):
        found = model.stiffness_gradient(values, A, w, k)
        size = np.abs(model.stiffness(values, A, w))
        for i, value in enumerate(values):
            h = 1e-4 * float(value)
            high, low = (
                model.stiffness([*values[:i], value + s * h, *values[i + 1 :]], A, w, k)
                for s in (1.0, -1.0)
            )
            assert np.all(np.abs(found.by_parameter[i] * value - (high - low) / 2e-4) < 1e-5 * size)
        high, low = (model.stiffness(values, A * (1.0 + s * 1e-4), w, k) for s in (1.0, -1.0))
        assert np.all(np.abs(found.by_amplitude * A - (high - low) / 2e-4) < 1e-5 * size)


UNKNOWN = [
    di.Dahl(asymmetry=None, name="pivot"),
    di.Backlash(di.Dahl(1.0, None, name="pivot"), 0.1),
    di.Backlash(di.Dahl(asymmetry=None)),
    di.PowerDamper(2.0, 0.5, name="oil"),
]


@pytest.mark.parametrize("law", [*EVERY, *UNKNOWN], ids=repr)
def test_description_comes_back(law):
    (again,) = model_from_description(json.loads(json.dumps(describe_model(law)))).elements
    assert again.parameters == law.parameters
    assert repr(again) == repr(law)
    assert type(again) is type(law)


@every_law
def test_it_is_simulated_under_a_prescribed_displacement(law):
    steps = SteppedSine((0.2, 1.0), (1.0,), num_periods=2, settling_periods=1)
    record = simulate(di.Experiment(law, steps), seed=1)
    assert np.all(np.isfinite(np.asarray(record.force)))

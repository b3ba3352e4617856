"""Every law is recovered from records of a multisine, a trapezoidal motion and a ring-down."""

import numpy as np
import pytest
from scipy.stats import norm

import dahl_ident as di
from dahl_ident.elements import Element, Model
from dahl_ident.engine import differentiated
from tests.motions import Driven
from tests.recovery import assert_near
from tests.test_engine import Bilinear
from tests.test_record_fit import RATE, trajectory

MOTIONS = ("multisine", "trapezoid", "ring-down")
LAWS: list[tuple[Element, Element]] = [
    (di.Dahl(0.1, 30.0), di.Dahl()),
    (di.Dahl(0.1, 30.0, alpha=1.5), di.Dahl(alpha=None)),
    (di.Dahl(0.1, 30.0, asymmetry=0.2), di.Dahl(asymmetry=None)),
    (di.BoucWen(30.0, 200.0, 500.0), di.BoucWen()),
    (di.Backlash(di.Dahl(0.1, 60.0), gap=1e-3), di.Backlash(di.Dahl())),
    (di.PowerDamper(0.2, 0.5), di.PowerDamper()),
    (di.MaxwellSlip([1e-3, 4e-3], [20.0, 10.0]), di.MaxwellSlip([1e-3, 4e-3])),
]


def displacement(kind, samples):
    """Return a displacement of about 10 mm."""
    if kind == "ring-down":
        t = np.arange(samples) / RATE
        return np.asarray(1.2e-2 * np.exp(-2.0 * t) * np.cos(6.0 * np.pi * t))
    return trajectory(kind, samples)


def drive(kind, samples):
    """Return a force of about 1 N."""
    t = np.arange(samples) / RATE
    if kind == "trapezoid":
        corners = [0.0, 0.6, 0.6, -0.6, -0.6, 0.6, 0.6, -0.3, 0.0]
        return np.interp(t, np.linspace(0.0, t[-1], len(corners)), corners)
    phases = np.random.default_rng(0).random(57)
    lines = zip(np.arange(3, 60) * RATE / 1024.0, phases, strict=True)
    return np.asarray(0.03 * np.sum([np.sin(2 * np.pi * (f * t + p)) for f, p in lines], axis=0))


def assert_recovered(fit, truth, largest_u=0.3):
    """Check that every free parameter is within 4.5 standard uncertainties, which are small."""
    assert fit.trusted, fit.verdict
    assert_near(fit, truth, 4.5, largest_u)


@pytest.mark.parametrize(
    ("truth", "model", "kind"), [(*law, MOTIONS[i % 3]) for i, law in enumerate(LAWS)]
)
def test_force_from_displacement(truth, model, kind):
    samples = 600
    x = displacement(kind, samples)
    v, _ = differentiated(x, 1.0 / RATE)
    start = 0.02 if truth.has_memory and not isinstance(truth, di.MaxwellSlip) else 0.0
    force = truth.force(x, velocity=v, initial_force=start)
    force = force + 5e-4 * np.random.default_rng(1).standard_normal(samples)
    record = di.Record(np.arange(samples) / RATE, displacement=x, force=force)
    assert_recovered(di.fit(record, model, throw=False), truth)


def driven(kind, whole, samples, noise):
    """Return a record of a plant's displacement, noise in shares of its standard deviation."""
    wave = drive(kind, samples)
    plant = Driven(whole, wave, RATE)
    x = plant.motion(np.zeros(plant.order)).output
    x = x + noise * x.std() * np.random.default_rng(1).standard_normal(samples)
    return di.Record(np.arange(samples) / RATE, displacement=x, force=wave)


NO_DELAY = di.Sensors(delay=norm(0.0, 1e-9))  # trapezoids do not distinguish it from sigma


@pytest.mark.parametrize(  # others in test_cold_records
    ("kind", "samples", "noise", "sensors", "truth", "model", "largest_u"),
    [
        ("trapezoid", 384, 1e-3, None, di.PowerDamper(0.5, 0.5), di.PowerDamper(), 0.3),
        ("multisine", 384, 1e-3, None, di.BoucWen(300.0, 1500.0, 3000.0) + di.Damper(0.5),
         di.BoucWen() + di.Damper(), 0.3),
        # hard to search: a curved valley of stiffness and rates
        ("trapezoid", 512, 1e-3, NO_DELAY, di.BoucWen(300.0, 1500.0, 3000.0) + di.Damper(0.5),
         di.BoucWen() + di.Damper(), 0.3),
        # hard to search: starts with contacts too stiff for the interval
        ("trapezoid", 512, 5e-3, NO_DELAY, di.Dahl(0.1, 300.0, asymmetry=0.2) + di.Damper(0.5),
         di.Dahl(asymmetry=None) + di.Damper(), 0.6),
    ],
)  # fmt: skip
def test_motion_from_force(kind, samples, noise, sensors, truth, model, largest_u):
    whole = Model(truth + di.Mass(0.3) + di.Spring(50.0))
    record = driven(kind, whole, samples, noise)
    fit = di.fit(record, model + di.Mass() + di.Spring(), sensors=sensors)
    assert_recovered(fit, whole, largest_u)


def damped_record(damper):
    """Return a record of Dahl friction and a force of the speed."""
    t = np.arange(1500) / 200.0
    phase = 2.0 * np.sin(0.9 * t) + 5.1 * t
    x, v = 3e-3 * np.sin(phase), 3e-3 * np.cos(phase) * (1.8 * np.cos(0.9 * t) + 5.1)
    force = di.Dahl(0.1, 60.0).force(x) + damper(v)
    noise = 1e-3 * np.random.default_rng(3).standard_normal(t.size)
    return di.Record(t, displacement=x, force=force + noise)


def test_exponent_of_a_damper_stays_between_its_bounds():
    record = damped_record(lambda v: 5e5 * v**3 * np.abs(v))
    fit = di.fit(record, di.Dahl() + di.PowerDamper(), throw=False)
    assert 2.9 < fit.params["exponent"].value <= 3.0
    np.testing.assert_allclose(fit.params["f_max"].value, 0.1, rtol=0.05)


def test_damper_that_vanishes_does_not_stop_the_search():
    record = damped_record(lambda v: -0.2 * v)  # no coefficient above zero helps
    law = di.Dahl(alpha=1.0)
    without = di.fit(record, law, sensors=NO_DELAY, throw=False)
    fit = di.fit(record, law + di.PowerDamper(), sensors=NO_DELAY, throw=False)
    assert str(fit.status) == "not determined"
    assert 0.0 < fit.params["exponent"].value < 3.0
    for name in ("f_max", "sigma"):
        expected = without.params[name]
        assert expected.stderr is not None
        assert abs(fit.params[name].value - expected.value) < 0.3 * expected.stderr


@pytest.mark.parametrize(
    "law",
    [di.MaxwellSlip([1e-3, 8e-3], [20.0, 10.0]), di.Backlash(di.Dahl(0.1, 30.0), gap=1e-3)],
    ids=["two elements", "gap"],
)
def test_slow_residuals_of_another_law_are_not_trusted(law):
    """The records cannot distinguish them from slow noise."""
    rng = np.random.default_rng(4)
    t = np.arange(2000) / 200.0
    for _ in range(6):
        tones = rng.uniform(0.2, 2.5, 12)
        phases = rng.uniform(0.0, 2.0 * np.pi, 12)
        x = 2.4e-3 * np.sin(2.0 * np.pi * tones * t[:, None] + phases).sum(axis=1)
        force = law.force(x) + 1e-3 * rng.standard_normal(t.size)
        fit = di.fit(di.Record(t, displacement=x, force=force), di.Dahl(), throw=False)
        assert not fit.trusted


def test_a_search_ends_at_a_kink_of_the_cost():
    """Next to the minimum, samples change their branch, and the cost rises on both sides."""
    t = np.arange(2000) / 500.0
    x = 3e-2 * (np.sin(2.0 * t) + np.sin(7.3 * t))
    force = Bilinear(100.0, 1.0).force(x) + 5e-3 * np.random.default_rng(5).standard_normal(t.size)
    fit = di.fit(di.Record(t, displacement=x, force=force), Bilinear())
    assert fit.trusted
    assert abs(fit.params["k"].value - 100.0) < 3.0 * fit.params["k"].stderr


@pytest.mark.parametrize("seed", range(3))
def test_elements_of_one_law_are_in_order_of_their_x_c(seed):
    """As for tables; without an order every second fit had the names exchanged."""
    x = trajectory("random", 1200, seed) / 10.0
    force = di.Dahl(4.0, 3e5).force(x) + di.Dahl(3.0, 2e4).force(x)
    force = force + 0.02 * np.random.default_rng(seed).standard_normal(x.size)
    record = di.Record(np.arange(x.size) / RATE, displacement=x, force=force)
    pair = di.fit(record, di.Dahl(name="a") + di.Dahl(name="b"))
    springs = di.fit(record, di.MaxwellSlip(2), throw=False)
    for name, truth in {"a_f_max": 4.0, "a_sigma": 3e5, "b_f_max": 3.0, "b_sigma": 2e4}.items():
        assert pair.params[name].value == pytest.approx(truth, rel=0.1)
    assert springs.params["slip_1"].value < springs.params["slip_2"].value
    again = di.FitResult.from_json(pair.to_json())
    assert again.params["b_f_max"].value == pair.params["b_f_max"].value

"""Linear systems in records: scipy's integrator, exact responses, slopes, recovery, refusals."""

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dahl_ident as di
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.errors import ModelError, ValidationError
from tests.derivatives import central_differences
from tests.motions import Driven, differences, slopes
from tests.recovery import assert_near
from tests.test_forced_motion import RATE, multisine
from tests.test_record_laws import assert_recovered

SAMPLES = 192
M, C, K = 2.0, 10.0, 3e4
M2, C2, K2 = 0.4, 6.0, 2e4  # hung from the mass: an absorber, or the first mode of an arm
S = control.tf("s")
HUNG = M2 * S**2 * (C2 * S + K2) / (M2 * S**2 + C2 * S + K2)
ABSORBER = di.LinearSystem(HUNG, quantity="dynamic_stiffness")
WHOLE = control.feedback(1 / (M * S**2 + C * S + K), HUNG)
ARM = di.LinearSystem(control.ss(WHOLE * (S + 50.0) / (S + 50.0)), quantity="receptance")
"""Both masses as one receptance in state space, which does not have the least order."""
F_MAX, SIGMA = 20.0, 4e4
FRICTION = di.Dahl(F_MAX, SIGMA)
LUMPED = di.Mass(M) + di.Damper(C) + di.Spring(K)
PLACE = 1e-4  # of both masses at the first sample, at rest
MODELS: list[Element] = [FRICTION + LUMPED + ABSORBER, ARM + FRICTION]


def integrated():
    """Return the first mass's motion by DOP853, stopped wherever it turns."""
    _, drive = multisine(SAMPLES)
    times = np.arange(SAMPLES) / RATE
    out, place, now = np.empty((SAMPLES, 2)), 0, 0.0
    y = np.array([PLACE, 0.0, PLACE, 0.0, 0.0])
    s = 1.0 if drive(0.0) - K * PLACE > 0.0 else -1.0
    while place < SAMPLES:

        def rates(t, y, s=s):
            link = C2 * (y[1] - y[3]) + K2 * (y[0] - y[2])
            push = drive(t) - C * y[1] - K * y[0] - link - y[4]
            return [y[1], push / M, y[3], link / M2, SIGMA * (1.0 - s * y[4] / F_MAX) * y[1]]

        def turn(_, y):
            return float(y[1])

        turn.terminal, turn.direction = True, -s  # type: ignore[attr-defined]
        found = solve_ivp(
            rates, (now, times[-1] + 1e-9), y, method="DOP853", rtol=1e-11, atol=1e-14,
            max_step=0.3 / RATE, events=[turn], dense_output=True,
        )  # fmt: skip
        now, y, s = float(found.t[-1]), found.y[:, -1].copy(), -s
        y[1] = 0.0
        here = times[place:][times[place:] <= now]
        if here.size and found.sol is not None:
            out[place : place + here.size] = found.sol(here)[:2].T
            place += here.size
    return out


def driven(model, repeats=1):
    return Driven(model, np.tile(multisine(SAMPLES)[0], repeats), RATE)


def at_rest(element):
    """Return the states that do not change where the displacement stays at `PLACE`."""
    units = np.vstack([np.zeros(element.n_states), np.eye(element.n_states)])
    rates = np.array([element.mechanics([], PLACE, 0.0, 1.0, list(z)).rates for z in units])
    return np.asarray(np.linalg.solve((rates[1:] - rates[0]).T, -rates[0]))


def first_state(model):
    """Return both masses at `PLACE` at rest, without friction."""
    found = [PLACE, 0.0]
    for element in Model(model).elements:
        if isinstance(element, di.LinearSystem):
            found += at_rest(element).tolist()
        else:
            found += [0.0] * element.n_states
    return np.array(found)


@pytest.mark.parametrize("model", MODELS)
def test_motion_against_scipy(model):
    first = first_state(model)
    found = driven(model).motion(first).states
    reference = integrated()
    error = np.abs(found[:, :2] - reference).max(axis=0) / np.abs(reference).max(axis=0)
    assert error.max() < 1e-8


def test_slopes_are_derivatives():
    plant = driven(di.Dahl() + di.Mass() + di.Damper() + di.Spring(K) + ABSORBER)
    starts, values = np.array([PLACE, 0.01, 3.0, 2e-4, -1e-4]), np.array([F_MAX, SIGMA, M, C])
    _, found = slopes(plant, starts, values)
    for i, expected in enumerate(differences(plant, starts, values, 4e-4)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 1e-6, i


def whole_motion(t):
    """Return displacement, velocity, acceleration and the settled force of the absorber."""
    lines = np.array([[31.0, 3e-4, 0.3], [190.0, 1e-4, 1.1], [260.0, 5e-5, -2.0]])
    X = lines[:, 1] * np.exp(1j * lines[:, 2])
    waves = np.exp(1j * np.outer(t, lines[:, 0]))
    s = 1j * lines[:, 0]
    Z = ABSORBER.dynamic_stiffness(0.0, lines[:, 0])
    x, v, a, force = (np.real(waves @ (X * part)) for part in (1.0, s, s**2, Z))
    return x, v, a, force


def test_force_from_displacement_is_the_frequency_response():
    t = np.arange(600) / RATE
    x, v, a, expected = whole_motion(t)
    force = ABSORBER.force(x, velocity=v, acceleration=a, time=t)
    free = ABSORBER.free_responses(t)
    start = np.linalg.lstsq(free, expected - force, rcond=None)[0]
    assert np.abs(force + free @ start - expected).max() < 2e-8 * np.abs(expected).max()
    assert np.abs(free @ start).max() > 0.1 * np.abs(expected).max()
    with pytest.raises(ValidationError, match="evenly spaced times"):
        ABSORBER.force(x, velocity=v, acceleration=a)


def test_lumped_elements_as_a_system_are_those_elements():
    t = np.arange(50) / RATE
    x, v, a, _ = whole_motion(t)
    for quantity in ("receptance", "mobility", "accelerance"):
        s_power = {"receptance": 0, "mobility": 1, "accelerance": 2}[quantity]
        system = di.LinearSystem(control.ss(S**s_power / (M * S**2 + C * S + K)), quantity=quantity)
        assert (system.n_states, system.has_inertia) == (0, True)
        force = system.force(x, velocity=v, acceleration=a)
        expected = LUMPED.force(x, velocity=v, acceleration=a)
        np.testing.assert_allclose(force, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("model", MODELS)
def test_recovered_from_a_driven_multisine(model):
    x = driven(model, 4).motion(first_state(model)).output
    x = x + 1e-3 * x.std() * np.random.default_rng(0).standard_normal(x.size)
    wave = np.tile(multisine(SAMPLES)[0], 4)
    record = di.Record(np.arange(x.size) / RATE, displacement=x, force=wave)
    known = ABSORBER if Model(model).elements[0].has_memory else ARM
    free = di.Dahl() + known
    fit = di.fit(record, free if known is ARM else free + di.Mass() + di.Damper() + di.Spring())
    assert_recovered(fit, Model(model))
    assert fit.predict(record).rms_share < 2e-3
    # from rest, and not from where it was
    assert np.std(fit.simulate(record) - x) < 0.3 * x.std()


def test_recovered_from_a_measured_displacement():
    t = np.arange(2000) / RATE
    x, _, _, force = whole_motion(t)
    force = force + di.Dahl(F_MAX, SIGMA).force(x)
    force = force + 1e-2 * force.std() * np.random.default_rng(0).standard_normal(t.size)
    fit = di.fit(di.Record(t, displacement=x, force=force), di.Dahl() + ABSORBER)
    assert_recovered(fit, Model(FRICTION))


FRD = control.frd(WHOLE, np.geomspace(1.0, 1e3, 20))


@pytest.mark.parametrize(
    ("system", "quantity", "text"),
    [
        (FRD, "receptance", "not a rational function of s"),
        (control.c2d(WHOLE, 1e-3), "receptance", "not a rational function of s"),
        (WHOLE * 100.0 / (S + 100.0), "receptance", r"grows as s\^3; an equation of motion"),
    ],
)
def test_systems_without_an_equation_of_motion(system, quantity, text):
    t = np.arange(64) / RATE
    record = di.Record(t, displacement=np.sin(t), force=np.ones(64))
    element = di.LinearSystem(system, quantity=quantity)
    with pytest.raises(ModelError, match=text) as refusal:
        di.fit(record, di.Dahl() + di.Mass() + element)
    assert "LinearSystem" in str(refusal.value)


def hung(damping, stiffness):
    link = damping * S + stiffness
    return M2 * S**2 * link / (M2 * S**2 + link)


def test_free_parameters_are_found_from_their_starts():
    x = driven(MODELS[0], 2).motion(first_state(MODELS[0])).output
    x = x + 1e-3 * x.std() * np.random.default_rng(0).standard_normal(x.size)
    wave = np.tile(multisine(SAMPLES)[0], 2)
    record = di.Record(np.arange(x.size) / RATE, displacement=x, force=wave)
    starts = {
        name: Parameter(name, "", "of the absorber", value, free=True)
        for name, value in (("damping", 9.0), ("stiffness", 1.6e4))
    }
    absorber = di.LinearSystem(hung, quantity="dynamic_stiffness", parameters=starts, name="hung")
    fit = di.fit(record, di.Dahl(alpha=1.0) + LUMPED + absorber)
    assert_near(fit, (("hung_damping", C2), ("hung_stiffness", K2), ("f_max", F_MAX)), 4.0, 0.1)
    problem = fit.problem
    values = np.array([F_MAX, SIGMA, 5.0, 1.9e4, PLACE, 0.01, 3.0, 2e-4, -1e-4, 0.0])
    exact = problem.predict(values, 0).by
    slopes = central_differences(
        lambda moved: problem.predict(moved, 0, derivatives=False).output,
        values, 1e-5 * np.where(values, np.abs(values), 1e-3),
    )  # fmt: skip
    for name, one, other in zip(problem.names, exact.T, slopes, strict=True):
        assert np.abs(one - other).max() < 1e-4 * np.abs(one).max(), name


def test_free_parameters_and_a_moving_base_are_refused():
    record = di.Record(np.arange(64) / RATE, displacement=np.sin(np.arange(64)), force=np.ones(64))
    free = di.LinearSystem(
        lambda k: control.tf([1.0], [k]), quantity="receptance", parameters={"k": None}
    )
    with pytest.raises(ModelError, match="free parameters moves with a plant"):
        di.fit(record, di.Dahl() + free, output="force")
    with pytest.raises(ModelError, match="k is an argument of a linear system, and has no value"):
        di.fit(record, di.Dahl() + di.Mass(1.0) + free)
    with pytest.raises(ModelError, match="inertia inside"):
        di.fit(record, di.Dahl() + di.Mass() + ABSORBER, excitation="base")


def test_stiffness_that_is_not_stable_has_no_force_over_time():
    beyond = di.LinearSystem((S - 30.0) / (M * S**2 + C * S + K), quantity="receptance")
    t = np.arange(300) / RATE
    x, v, a, _ = whole_motion(t)
    with pytest.raises(ModelError, match="grows beyond all bounds"):
        beyond.force(x, velocity=v, acceleration=a, time=t)

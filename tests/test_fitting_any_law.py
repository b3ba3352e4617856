"""A law that is written in ten lines is estimated like any other: no guess, every method."""

import numpy as np
import pytest
from scipy import optimize

import dahl_ident as di
from dahl_ident.elements import Element
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.fitting import Status, solve, solve_many
from dahl_ident.fitting.ipopt import solve_ipopt
from dahl_ident.problem import ProblemBatch, TableProblem
from tests.friction_tables import driven, relative_noise
from tests.test_generic_friction import jenkins


def positive(name, unit):
    return di.Parameter(name, unit, name, lower=0.0, transform="log")


class ByForce(di.Friction):
    """The elastoplastic element by its stiffness and its limit."""

    parameters = (positive("stiff", "N/m"), positive("f_max", "N"))
    scale_parameters = ("stiff", "f_max")

    def slope(self, force, direction, velocity, values):
        stiff, f_max = values
        return stiff * (direction * force < f_max)


class BySlip(di.Friction):
    """The same by its stiffness and the displacement at which it slips."""

    parameters = (positive("stiff", "N/m"), positive("delta", "m"))
    scale_parameters = ("stiff",)

    def slope(self, force, direction, velocity, values):
        stiff, delta = values
        return stiff * (direction * force < stiff * delta)


class OneWay(di.Friction):
    """Saturates on the rising side only at twice the force."""

    parameters = (positive("stiff", "N/m"), positive("f_max", "N"))
    scale_parameters = ("stiff", "f_max")

    def slope(self, force, direction, velocity, values):
        stiff, f_max = values
        return stiff * (1.0 - direction * force / (f_max * (1.5 + 0.5 * direction)))


class Relaxing(di.Friction):
    """A spring and a damper in series, with a time constant."""

    parameters = (positive("stiff", "N/m"), positive("tau", "s"))
    scale_parameters = ("stiff",)
    rate_independent = False

    def slope(self, force, direction, velocity, values):
        stiff, tau = values
        return stiff - direction * force / (tau * (abs(velocity) + 1e-12))


class Stribeck(di.Friction):
    """Dahl's law whose limit is larger at low speed."""

    parameters = (positive("stiff", "N/m"), positive("f_max", "N"), positive("speed", "m/s"))
    scale_parameters = ("stiff", "f_max")
    rate_independent = False

    def slope(self, force, direction, velocity, values):
        stiff, f_max, speed = values
        limit = f_max * (1.0 + 0.5 * np.exp(-((velocity / speed) ** 2)))
        return stiff * (1.0 - direction * force / limit)


STIFF, DELTA = 30.0, 3e-3
MASS, DAMPING, SPRING = 0.3, 0.24, 0.5
TRUTH = {"stiff": STIFF, "delta": DELTA, "f_max": STIFF * DELTA}
TRUTH |= {"mass": MASS, "damping": DAMPING, "stiffness": SPRING}


def noisy(values, level=0.005, seed=1):
    return values * relative_noise(values.size, level, seed)


def alone():
    A = np.geomspace(3e-4, 1e-1, 30)
    return di.FrequencyResponse(np.ones(30), noisy(jenkins(STIFF, DELTA, A)), A)


def plant(controlled):
    A = np.tile(np.geomspace(1e-3, 3e-2, 5), 4)
    f = np.repeat(np.geomspace(0.3, 3.0, 4), 5)
    omega = 2.0 * np.pi * f
    Z = jenkins(STIFF, DELTA, A) + SPRING - MASS * omega**2 + 1j * DAMPING * omega
    if controlled == "displacement":
        return di.FrequencyResponse(f, noisy(Z), A)
    return driven(f, noisy(1.0 / Z), A * np.abs(Z))


def assert_truth(found):
    assert found.status is Status.CONVERGED
    expected = np.array([TRUTH[name] for name in found.names])
    spread = np.sqrt(np.diagonal(found.values_covariance))
    assert np.all(np.abs(found.values - expected) < 5.0 * spread)
    assert np.all(spread < 0.1 * np.abs(expected))


@pytest.mark.parametrize(
    ("law", "data"),
    [(ByForce, "alone"), (BySlip, "alone"), (BySlip, "displacement"), (ByForce, "force")],
)
def test_a_law_of_ten_lines_is_found_without_a_guess_by_every_method(law, data):
    table = alone() if data == "alone" else plant(data)
    model: Element = law() if data == "alone" else law() + di.Mass() + di.Damper() + di.Spring()
    problem = TableProblem(table, model, steady="describing function")  # which made the data
    by_lm = solve(problem)
    assert_truth(by_lm)
    assert by_lm.method == "lm"
    others = {"ipopt": solve_ipopt(problem), "scipy": solve(problem, method="scipy")}
    for method, other in others.items():
        assert other.method == method
        assert_truth(other)
        assert other.cost == pytest.approx(by_lm.cost, rel=1e-6)
        np.testing.assert_allclose(other.values, by_lm.values, rtol=1e-4)


def test_random_problems_over_twelve_decades_are_recovered():
    rng = np.random.default_rng(5)
    for index in range(12):
        stiff, delta = 10.0 ** rng.uniform(-6.0, 6.0, 2)
        n = int(rng.integers(8, 30))
        A = delta * 10.0 ** np.sort(rng.uniform(-0.3, rng.uniform(0.5, 2.0), n))
        data = di.FrequencyResponse(np.ones(n), noisy(jenkins(stiff, delta, A), 1e-3, index), A)
        law = (ByForce, BySlip)[index % 2]()
        found = solve(TableProblem(data, law))
        truth = np.array([stiff, delta if index % 2 else stiff * delta])
        assert found.success
        spread = np.sqrt(np.diagonal(found.covariance))
        assert np.all(np.abs(np.log(found.values / truth)) < 6.0 * spread + 1e-4)


@pytest.mark.parametrize("law", [ByForce, BySlip])
def test_a_law_that_never_slips_says_which_parameter_runs_away(law):
    A = np.geomspace(1e-7, 1e-5, 20)
    data = di.FrequencyResponse(np.ones(20), noisy(jenkins(STIFF, DELTA, A)), A)
    found = solve(TableProblem(data, law(), noise="absolute"))
    assert found.status is Status.RUNS_AWAY
    lost = found.names[1]
    assert found.values[1] == np.inf
    assert f"{lost} without bound" in found.message
    (kept,) = found.combinations
    assert kept.expression == "stiff"
    assert kept.value == pytest.approx(STIFF, abs=5.0 * kept.stderr)


def test_a_law_that_always_slips_determines_its_force():
    A = np.geomspace(1e5, 1e7, 20) * DELTA
    Z = 1j * np.exp(0.01j) * 4.0 / np.pi * STIFF * DELTA / A  # a stiffness a little below zero
    for law, expression in ((ByForce, "f_max"), (BySlip, "stiff delta")):
        found = solve(
            TableProblem(di.FrequencyResponse(np.ones(20), Z, A), law(), noise="relative")
        )
        assert found.status is Status.RUNS_AWAY
        (kept,) = found.combinations
        assert kept.expression == expression
        assert kept.value == pytest.approx(STIFF * DELTA, rel=0.01)


def test_a_time_constant_or_a_speed_far_from_the_data_leaves_the_stiffness_determined():
    A = np.geomspace(1e-3, 3e-2, 6)
    elastic = np.full(6, STIFF + 0.0j)
    sliding = di.Dahl(STIFF * DELTA, STIFF, 1.0).describing_function(A)
    for law, Z in ((Relaxing, elastic), (Stribeck, sliding)):
        found = di.fit(di.FrequencyResponse(np.ones(6), noisy(Z, 1e-4), A), law(), throw=False)
        assert found.params["stiff"].value == pytest.approx(STIFF, rel=1e-3)
        first, *_, last = found.identifiability.parameters.values()
        assert (first.verdict.known, last.verdict.known) == (True, False)


def test_a_force_that_grows_with_the_speed_is_not_bounded_by_that_at_rest():
    stiff, tau, omega = 30.0, 0.2, 4.0 * np.pi
    plant = Relaxing(stiff, tau) + di.Mass(MASS) + di.Spring(SPRING)
    found = di.response(plant, 2.0, [0.05, 1.0], steady="describing function")
    Z = stiff / (1.0 + 1.0 / (1j * omega * tau)) + SPRING - MASS * omega**2
    np.testing.assert_allclose(found.receptance, 1.0 / Z, rtol=1e-6)


def test_like_elements_of_any_law_are_ordered_by_their_knees():
    A = np.geomspace(1e-4, 1e-1, 24)
    Z = jenkins(20.0, 1e-2, A) + jenkins(30.0, 8e-4, A)
    data = di.FrequencyResponse(np.ones(24), noisy(Z, 1e-3), A)
    found = solve(TableProblem(data, BySlip(name="first") + BySlip(name="second")))
    assert found.names[1::2] == ("first_delta", "second_delta")
    np.testing.assert_allclose(found.values, [30.0, 8e-4, 20.0, 1e-2], rtol=0.03)


def test_a_batch_of_a_law_equals_its_tables_one_by_one():
    A = np.geomspace(3e-4, 1e-1, 20)
    tables = [
        di.FrequencyResponse(np.ones(20), noisy(jenkins(STIFF, d, A), seed=i), A)
        for i, d in enumerate((1e-3, 3e-3, 1e-2))
    ]
    together = solve_many(ProblemBatch(tables, BySlip()))
    for one, table in zip(together, tables, strict=True):
        np.testing.assert_allclose(
            one.values, solve(TableProblem(table, BySlip())).values, rtol=1e-5
        )


def test_method_names_what_runs(monkeypatch):
    calls = []
    original = optimize.least_squares

    def counted(*arguments, **options):
        calls.append(options["x_scale"])
        return original(*arguments, **options)

    monkeypatch.setattr(optimize, "least_squares", counted)
    A = np.geomspace(1e-4, 1e-1, 20)
    data = di.FrequencyResponse(np.ones(20), noisy(di.Dahl(0.1, 30.0).describing_function(A)), A)
    by_lm = di.fit(data, di.Dahl())
    assert (by_lm.method, len(calls)) == ("lm", 0)
    by_scipy = di.fit(data, di.Dahl(), method="scipy")
    assert by_scipy.method == "scipy"
    assert len(calls) >= 1
    np.testing.assert_allclose(by_scipy.optimum.values, by_lm.optimum.values, rtol=1e-6)
    with pytest.raises(ValidationError, match="method is 'newton'; expected lm or scipy"):
        solve(TableProblem(data, di.Dahl()), method="newton")


def test_even_harmonics_take_part_where_a_law_has_them():
    law = OneWay(30.0, 0.1)
    A = np.geomspace(1e-3, 1e-1, 12)
    Z = [law.dynamic_stiffness(a, harmonic=k) for a in A for k in (1, 2)]
    both = di.FrequencyResponse(np.ones(24), Z, np.repeat(A, 2), harmonic=np.tile([1, 2], 12))
    found = solve(TableProblem(both, OneWay(), noise="absolute"))
    np.testing.assert_allclose(found.values, [30.0, 0.1], rtol=1e-6)
    even = di.FrequencyResponse(np.ones(12), Z[1::2], A, harmonic=np.full(12, 2))
    assert solve(TableProblem(even, OneWay(), noise="absolute")).success
    with pytest.raises(DataError, match=r"harmonics 2, and no element of ByForce.* has any"):
        TableProblem(even, ByForce(), noise="absolute")

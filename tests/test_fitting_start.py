"""No guess is needed: the optimum is that of a dense scan, whatever the units."""

import importlib

import numpy as np
import pytest

from dahl_ident import Backlash, BoucWen, Dahl, FrequencyResponse, LinearSystem
from dahl_ident.errors import FitError
from dahl_ident.fitting import solve
from dahl_ident.problem import TableProblem
from tests.random_problems import exponent_free, friction_alone, two_elements

A = np.geomspace(1e-4, 1e-1, 20)


def test_optimum_equals_that_of_a_dense_scan_in_random_problems():
    worst = 0.0
    for problem, least_cost, at_edge in friction_alone(seed=1, count=100):
        found = solve(problem)
        assert found.success is not at_edge
        worst = max(worst, found.cost / least_cost - 1.0)
    assert worst < 1e-9


@pytest.mark.parametrize("problems", [exponent_free, two_elements])
def test_optimum_equals_the_best_of_searches_from_all_over(problems):
    for problem, least_cost, _ in problems(2, 8):
        assert solve(problem).cost / least_cost - 1.0 < 1e-9


@pytest.mark.parametrize("alpha", [0.5, 2.0])
def test_alpha_is_searched_for_as_well(alpha):
    N = Dahl(0.1, 30.0, alpha).describing_function(A)
    problem = TableProblem(FrequencyResponse(np.ones(20), N, A), Dahl(alpha=None))
    np.testing.assert_allclose(solve(problem).values, [0.1, 30.0, alpha], rtol=1e-8)


def test_two_elements_are_told_apart_and_ordered():
    both = Dahl(0.5, 20.0, name="b") + Dahl(0.01, 30.0, name="a")
    N = both.dynamic_stiffness(A, 0.0)
    free = Dahl(name="first") + Dahl(name="second")
    found = solve(TableProblem(FrequencyResponse(np.ones(20), N, A), free))
    assert found.names == ("first_f_max", "first_sigma", "second_f_max", "second_sigma")
    np.testing.assert_allclose(found.values, [0.01, 30.0, 0.5, 20.0], rtol=1e-6)


def test_harmonics_take_part_in_the_start():
    pivot = Dahl(0.1, 30.0)
    Z = [pivot.dynamic_stiffness(a, harmonic=k) for a in A for k in (3, 5)]
    data = FrequencyResponse(np.ones(40), Z, np.repeat(A, 2), harmonic=np.tile([3, 5], 20))
    found = solve(TableProblem(data, Dahl(), noise="absolute"))
    np.testing.assert_allclose(found.values, [0.1, 30.0], rtol=1e-8)


def test_one_friction_parameter_given():
    N = Dahl(0.1, 30.0).describing_function(A)
    data = FrequencyResponse(np.ones(20), N, A)
    assert solve(TableProblem(data, Dahl(f_max=0.1))).values == pytest.approx([30.0], rel=1e-9)
    assert solve(TableProblem(data, Dahl(sigma=30.0))).values == pytest.approx([0.1], rel=1e-9)


def test_a_parameter_that_cannot_be_started_is_named():
    control = importlib.import_module("control")

    def mode(mass):
        return control.tf([1], [mass, 0.0, 10.0])

    system = LinearSystem(mode, quantity="receptance", parameters={"mass": None})
    N = Dahl(0.1, 30.0).describing_function(A) + 10.0
    problem = TableProblem(FrequencyResponse(np.ones(20), N, A), Dahl() + system)
    with pytest.raises(FitError, match="mass has no value to start from"):
        solve(problem)


@pytest.mark.parametrize(("law", "error"), [(Backlash(Dahl(), 1e-3), 1e-2), (BoucWen(), 2e-3)])
def test_curves_of_many_rows_are_interpolated(law, error):
    many = np.geomspace(3e-4, 1e-1, 300)
    table = FrequencyResponse(np.ones(300), np.ones(300, dtype=complex), many)
    values = [np.array([100.0, 10.0]) * (k + 1) for k in range(len(law.parameters) - 1)]
    values.append(np.array([1e-3, 3e-3]) if isinstance(law, Backlash) else values[0])
    values = [
        np.ones(2) if p.name == "alpha" else v for p, v in zip(law.parameters, values, strict=True)
    ]
    found = TableProblem(table, law, noise="relative").stiffness_data.stiffness_of(
        law, values, at_nodes=True
    )
    for node, curve in enumerate(found):
        exact = law.stiffness([v[node] for v in values], many, np.ones(()))
        assert np.max(np.abs(curve - exact)) < error * np.max(np.abs(exact))

"""Many tables at once give what one at a time gives."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.harness import peak_bytes
from dahl_ident import Dahl, FrequencyResponse, Sensors, Spring
from dahl_ident.errors import ValidationError
from dahl_ident.fitting import Status, solve, solve_many
from dahl_ident.problem import ProblemBatch, TableProblem

n = 20


def tables(level, beta, spring, count=25):
    """Return tables over one decade of amplitude; half of them have amplitudes of their own."""
    rng = np.random.default_rng(4)
    made = []
    for index in range(count):
        A = beta * np.geomspace(1.0, 10.0, n) / 300.0
        if index % 2:
            A = A * np.exp(0.2 * rng.normal(size=n))
        Z = Dahl(0.1, 30.0).describing_function(A) + spring
        error = rng.normal(size=n) + 1j * rng.normal(size=n)
        made.append(FrequencyResponse(np.ones(n), Z * np.exp(level * error), A))
    return made


def assert_same(batch, singles):
    for index, one in enumerate(singles):
        assert batch.cost[index] == pytest.approx(one.cost, rel=1e-5)
        if batch.status[index] is not one.status:  # an optimum that hardly differs from its limit
            spread = np.sqrt(np.diagonal(batch.covariance[index]))
            assert one.status.at_infinity
            assert spread.max() > 30.0
            continue
        determined = np.isfinite(np.diagonal(one.covariance))
        spread = np.sqrt(np.diagonal(one.covariance))[determined]
        off = np.abs(batch.theta[index] - one.theta)[determined]
        assert np.all(off <= 1e-4 * spread)
        assert batch.scale[index] == pytest.approx(one.scale, rel=1e-6)
        assert batch.dof[index] == one.dof
        np.testing.assert_array_equal(np.isinf(batch.values[index]), np.isinf(one.values))
        np.testing.assert_allclose(
            np.diagonal(batch.covariance[index])[determined], spread**2, rtol=1e-2
        )


@pytest.mark.parametrize(
    ("model", "level", "beta", "spring", "statuses"),
    [
        (Dahl(), 0.02, 0.3, 0.0, {Status.CONVERGED}),
        (Dahl(alpha=None), 0.005, 0.3, 0.0, {Status.CONVERGED}),
        (Dahl(), 0.02, 1e-4, 0.0, {Status.CONVERGED, Status.NO_LOSS}),
        (Dahl() + Spring(), 0.02, 1e-3, 10.0, {Status.MICROSLIP}),
        (Dahl() + Spring(), 0.02, 1e2, 10.0, {Status.CONVERGED, Status.GROSS_SLIP}),
    ],
)
def test_many_tables_end_as_one_by_one(model, level, beta, spring, statuses):
    made = tables(level, beta, spring)
    found = solve_many(ProblemBatch(made, model))
    assert set(found.status) >= statuses
    assert_same(found, [solve(TableProblem(table, model)) for table in made])


def test_tables_with_bounds_or_priors_are_solved_one_by_one():
    made = tables(0.02, 0.3, 0.0, count=3)
    sensors = Sensors(force_gain=stats.norm(1.0, 0.01))
    found = solve_many(ProblemBatch(made, Dahl(), sensors=sensors))
    assert_same(found, [solve(TableProblem(table, Dahl(), sensors=sensors)) for table in made])


def test_a_start_shared_or_each():
    made = tables(0.02, 0.3, 0.0, count=5)
    batch = ProblemBatch(made, Dahl())
    alone = solve_many(batch)
    for start in (np.log([0.1, 30.0]), np.tile(np.log([0.1, 30.0]), (5, 1))):
        np.testing.assert_allclose(solve_many(batch, start=start).theta, alone.theta, atol=1e-7)
    with pytest.raises(
        ValidationError, match=r"start has shape \(3,\); expected \(2,\) or \(5, 2\)"
    ):
        solve_many(batch, start=np.zeros(3))


def test_bootstrap_spread_equals_the_stated_one():
    problem = TableProblem(tables(0.02, 0.3, 0.0, count=1)[0], Dahl())
    found = solve(problem)
    rng = np.random.default_rng(6)
    error = rng.normal(size=(2000, n)) + 1j * rng.normal(size=(2000, n))
    responses = problem.predict(found.theta) * np.exp(found.scale * error)
    replicates = solve_many(ProblemBatch.replicates(problem, responses), start=found.theta)
    assert replicates.success.all()
    np.testing.assert_allclose(np.cov(replicates.theta.T), found.covariance, rtol=0.12)
    assert replicates.values_covariance.shape == (2000, 2, 2)


def test_many_elements_do_not_exhaust_memory():
    """Two elements have a grid of a thousand nodes, which few tables may share at once."""
    A = np.geomspace(1e-3, 1e-1, n)
    Z = (Dahl(0.1, 30.0, name="a") + Dahl(1.0, 30.0, name="b")).dynamic_stiffness(A)
    batch = ProblemBatch(
        [FrequencyResponse(np.ones(n), Z, A)] * 100, Dahl(name="a") + Dahl(name="b")
    )
    assert peak_bytes(lambda: solve_many(batch)) < 250e6

"""Parallel Jenkins elements: closed forms, Masing's rules, and the density found from data."""

import re

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.optimize import lsq_linear

import dahl_ident as di
from dahl_ident import fit
from dahl_ident.diagnostics.slip_density import slip_density
from dahl_ident.errors import DataError, ModelError, ValidationError
from tests.derivatives import central_differences
from tests.histories import jenkins_force
from tests.recovery import assert_near
from tests.test_generic_friction import Jenkins

SLIPS, STIFF = np.array([0.1, 0.3, 1.0]), np.array([3.0, 2.0, 1.0])
LAW = di.MaxwellSlip(SLIPS, STIFF)


def test_derivatives_are_exact_and_one_sided_at_a_kink():
    A = np.array([0.05, 0.1, 0.2, 0.7, 3.0])
    values = np.array([*STIFF, *SLIPS])
    for k in (1, 3):

        def stiffness(at, k=k):
            """Return the stiffness for values, with a factor of A last."""
            return LAW.stiffness(list(at[:-1]), at[-1] * A, np.zeros(()), k)

        found = LAW.stiffness_gradient(list(values), A, np.zeros(()), k)
        exact = np.array([*found.by_parameter, found.by_amplitude * A])
        point = np.append(values, 1.0)
        slopes = central_differences(stiffness, point, 1e-6 * point)
        for i, kinks in enumerate([[]] * 3 + [[d] for d in SLIPS] + [SLIPS]):
            smooth = np.all([np.abs(A - d) > 0.01 for d in kinks], axis=0) & np.full(5, True)
            np.testing.assert_allclose(exact[i][smooth], slopes[i][smooth], atol=1e-6)
        # at A = d: the element still sticks, so a longer d changes nothing
        for i, step in enumerate(1e-6 * np.diag(values)):
            upward = (stiffness(point + np.append(step, 0.0)) - stiffness(point)) / step.sum()
            np.testing.assert_allclose(exact[i], upward, atol=2e-4)


def test_the_force_over_time_is_that_of_the_sliders():
    rng = np.random.default_rng(0)
    for trial in range(60):
        x = np.cumsum(rng.normal(size=rng.integers(3, 300)) * 10.0 ** rng.uniform(-2.0, 0.0))
        if trial % 3 == 0:
            x = np.round(x, 1)  # loops that close exactly, and pauses
        u = float(rng.choice([0.0, 0.2, -0.7]))
        start = np.clip(STIFF * u, -STIFF * SLIPS, STIFF * SLIPS)
        expected = jenkins_force(x, STIFF, SLIPS, start)
        np.testing.assert_allclose(LAW.force(x, float(start.sum())), expected, atol=1e-11)


def test_no_spring_of_a_record_begins_beyond_its_slip():
    """Both springs slip at the first sample, so noise would put their loads on either side of 1."""
    t = np.arange(0.0, 2.0, 0.005)
    x = 3e-3 * (np.sin(2.0 * np.pi * t) + 0.3 * np.sin(7.0 * t))
    stiffness, slip = np.array([30.0, 10.0]), np.array([7e-4, 3e-3])
    force = jenkins_force(x, stiffness, slip, stiffness * slip)
    for seed in range(2):
        noise = np.random.default_rng(seed).normal(0.0, 2e-3, t.size)
        record = di.Record(t, displacement=x, force=force + noise)
        found = fit(record, di.MaxwellSlip(2), throw=False)
        loads = [found.params[f"initial_load_{i}"].value for i in (1, 2)]
        assert 0.9 < min(loads) <= max(loads) <= 1.0


def test_facts_and_refusals():
    values = [np.asarray(v) for v in (*STIFF, *SLIPS)]
    assert [float(v) for v in LAW.force_limits(values)] == pytest.approx([1.9, 1.9])
    assert [float(v) for v in LAW.knee(values)] == [0.1, 1.0]
    assert LAW.describing_function(0.0) == 6.0
    x, force = LAW.loop(0.5, points=4001)
    assert LAW.dissipated_energy(0.5) == pytest.approx(float(-trapezoid(x, force)), rel=1e-5)
    # each element that slips loses 4 k d (A - d) in a cycle
    assert LAW.dissipated_energy(0.5) == pytest.approx(4 * (0.3 * 0.4 + 0.6 * 0.2))
    with pytest.raises(ModelError, match="remembers more than its present force"):
        LAW.slope(0.0, 1.0, None, values)
    with pytest.raises(ModelError, match="Backlash got"):
        di.Backlash(LAW, 0.1)
    with pytest.raises(ValidationError, match="rising"):
        di.MaxwellSlip([0.2, 0.1])
    with pytest.raises(ValidationError, match="one for each of 2"):
        di.MaxwellSlip([0.1, 0.2], [1.0])
    with pytest.raises(ValidationError, match="initial_force"):
        LAW.force([0.0, 1.0], 2.0)


def table(law, *, noise=0.0, seed=1):
    A, f = np.geomspace(3e-2, 3.0, 24), np.tile([0.5, 1.0], 12)
    rng = np.random.default_rng(seed)
    Z = law.dynamic_stiffness(A, 2.0 * np.pi * f)
    Z = Z * (1.0 + noise * (rng.normal(size=24) + 1j * rng.normal(size=24)) / np.sqrt(2.0))
    return di.FrequencyResponse(f, Z, A)


def test_stiffnesses_are_estimated_at_given_and_at_free_slips():
    found = fit(table(LAW, noise=0.003), di.MaxwellSlip(SLIPS))
    assert_near(found, LAW, 4.0, 0.016)
    two = di.MaxwellSlip([0.1, 1.0], [3.0, 1.0])
    exchanged = {"slip_1": 1.0, "slip_2": 0.1, "stiffness_1": 1.0, "stiffness_2": 3.0}
    for start in (None, exchanged):  # slips rise, wherever the search began
        free = fit(table(two, noise=0.001), di.MaxwellSlip(2), start=start)
        assert [p.value for p in free.params.values()] == pytest.approx(
            [3.0, 1.0, 0.1, 1.0], rel=0.02
        )


def test_the_least_misfit_is_least():
    data = table(LAW + di.Mass(0.1) + di.Damper(0.2), noise=0.01)
    found = slip_density(data, di.Mass(0.1) + di.Damper())
    assert 0.003 < found.least_misfit < 0.0101
    assert found.least_misfit <= found.misfit <= 1.05 * found.least_misfit
    assert found.stiffness.sum() + found.spring == pytest.approx(6.0, rel=0.05)
    assert found.parallel["damping"] == pytest.approx(0.2, rel=0.2)
    # another solver over the same laws, and random laws, leave no less
    A, Z = np.asarray(data.amplitude), data.response + 0.1 * data.omega**2
    jenkins = [di.MaxwellSlip([d], [1.0]).describing_function(A) for d in found.slip.tolist()]
    columns = np.column_stack([*jenkins, 1.0 + 0j * A, 1j * data.omega])
    weights = 1.0 / np.abs(data.response)[:, None]
    matrix, right = columns * weights, Z * weights[:, 0]
    other = lsq_linear(
        np.concatenate([matrix.real, matrix.imag]), np.concatenate([right.real, right.imag]),
        bounds=(0.0, np.inf), tol=1e-12, method="bvls", max_iter=1000,
    )  # fmt: skip
    assert np.sqrt(2.0 * other.cost / 24) == pytest.approx(found.least_misfit, rel=1e-3)
    assert "leaves less than" in found.statement
    law = found.law() + di.Mass(0.1) + di.Damper(found.parallel["damping"])
    left = np.abs(1.0 - law.dynamic_stiffness(A, data.omega) / data.response)
    assert np.sqrt(np.mean(left**2)) == pytest.approx(found.misfit, rel=1e-9)


@pytest.mark.parametrize("damping", [0.4, -0.05])
def test_a_damper_in_parallel_with_a_density_has_either_sign(damping):
    found = slip_density(table(LAW + di.Damper(damping)), di.Damper())
    assert found.parallel["damping"] == pytest.approx(damping, rel=0.02)
    assert found.least_misfit < 0.003


def test_loops_of_dahl_and_of_a_gap_are_no_sum_of_jenkins_elements():
    assert slip_density(table(di.Dahl(1.0, 6.0))).least_misfit > 0.05
    assert slip_density(table(di.Backlash(Jenkins(3.0, 0.3), 0.05))).least_misfit > 0.1
    assert slip_density(table(LAW)).least_misfit < 0.003


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        (LAW, r"The best symmetric .* leaves 0\.\d+ % "),
        (
            di.Dahl(1.0, 6.0) + di.PowerDamper(0.5, 0.5),
            r"leaves less than \d+ % .*: the rest is noise",
        ),
    ],
)
def test_the_verdict_says_what_such_laws_leave(truth, said):
    data = table(truth, noise=0.01)
    found = fit(data, di.Dahl(), throw=False)
    assert re.search(said, found.verdict)
    bound = slip_density(data).least_misfit
    assert f"{100.0 * bound:.2g} % (rms of the fundamental)" in found.verdict


def test_the_density_is_refused():
    data = table(LAW)
    with pytest.raises(ModelError, match="expected linear elements"):
        slip_density(data, di.Dahl())
    with pytest.raises(DataError, match="at least three"):
        slip_density(data.select(rows=np.arange(24) < 2))


def test_the_verdict_is_silent_where_such_laws_leave_more_than_the_model():
    data = table(di.Dahl(1.0, 6.0, alpha=2.0), noise=0.01)
    found = fit(data, di.Dahl(), throw=False)
    assert found.goodness.objections
    assert slip_density(data).least_misfit > found.goodness.rms_misfit
    assert "Jenkins" not in found.verdict

"""Records that a fit describes without a start; independent solvers made them."""

import warnings
from functools import partial

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.errors import DataWarning
from tests import cold_records as cold
from tests.histories import jenkins_force
from tests.recovery import assert_near


def assert_found(case):
    """Check that every free parameter is within three standard uncertainties, none above 30 %."""
    fit = di.fit(case.record, case.model, throw=False)
    assert fit.success, fit.verdict
    assert fit.status.usable, fit.verdict
    assert_near(fit, case.truth, 3.0, 0.3)


CASES = {
    "friction faster than the sampling": partial(cold.driven_dahl, 30000.0, 0, 320),
    "accelerometer": partial(cold.with_accelerometer, 1),
    "backlash": partial(cold.backlash, 2.0, 1),
    "driven LuGre": partial(cold.lugre, 0),
    "driven Maxwell slip": partial(cold.maxwell_slip, 1),
    "first states are searched again": partial(cold.free_decay, "maxwell_slip", "spring", 5),
    **{
        f"decay, {name}": partial(
            cold.free_decay, name, ("mass", "spring")[i % 2], 1, 300 if name == "iwan" else 600
        )
        for i, name in enumerate(cold.DECAYS)
    },
}
LONG_CASES = {
    "friction faster than the sampling, 3": partial(cold.driven_dahl, 30000.0, 3, 768),
    **{f"accelerometer, {seed}": partial(cold.with_accelerometer, seed) for seed in range(2, 8)},
    "backlash, 0.5 x_c": partial(cold.backlash, 0.5, 0),
    "backlash, 6 x_c": partial(cold.backlash, 6.0, 2),
    "driven Iwan": partial(cold.iwan, 1),
}


@pytest.mark.parametrize(
    "make_case",
    [
        *(pytest.param(make, id=name) for name, make in CASES.items()),
        *(pytest.param(m, id=name, marks=pytest.mark.long) for name, m in LONG_CASES.items()),
    ],
)
def test_a_record_is_described_without_a_start(make_case):
    assert_found(make_case())


def assert_lowest(case):
    """Check that a search from the truth does not end significantly lower than one without it."""
    cold_fit = di.fit(case.record, case.model, throw=False)
    assert cold_fit.status.usable, cold_fit.verdict
    varied = [p for p in case.truth.parameters if cold_fit.params[p.name].vary]
    start = {p.name: float(p.value) for p in varied}
    near = di.fit(case.record, case.model, start=start, throw=False)
    lowest = near.optimum.cost
    assert cold_fit.optimum.cost - lowest < 4.0 * lowest / len(case.record), near.verdict


def seeds(*short):
    """Return 30 seeds; all but `short` are for long runs."""
    return [i if i in short else pytest.param(i, marks=pytest.mark.long) for i in range(30)]


@pytest.mark.parametrize("seed", seeds(0, 6))
def test_unknown_slips(seed):
    assert_lowest(cold.unknown_slips(seed))


@pytest.mark.parametrize("seed", seeds(0))
def test_a_stribeck_speed_with_much_noise(seed):
    assert_lowest(cold.lugre(seed, speed=0.06, noise=1e-2))


class StiffnessFirst(di.Friction):
    """A Jenkins element whose stiffness is declared first."""

    parameters = (
        di.Parameter("k", "N/m", "stiffness", lower=0.0, transform="log"),
        di.Parameter("limit", "N", "friction limit", lower=0.0, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        k, limit = values
        return k * (direction * force < limit)


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_a_law_of_a_user_at_any_scale_with_its_stiffness_first(scale):
    t = np.arange(600) / 100.0
    x = 3e-3 * scale * (np.sin(6.0 * t) + np.sin(21.3 * t))
    force = jenkins_force(x, np.array([30.0 / scale]), np.array([0.1 * scale / 30.0]))
    force += 1e-3 * np.random.default_rng(3).standard_normal(t.size)
    fit = di.fit(di.Record(t, displacement=x, force=force), StiffnessFirst())
    assert fit.trusted, fit.verdict
    assert_near(fit, (("k", 30.0 / scale), ("limit", 0.1)), 4.0)


def with_gap(record, low, high):
    return di.Record(
        np.delete(record.time, slice(low, high)),
        displacement=np.delete(record.motion_samples, slice(low, high)),
        force=np.delete(record.force_samples, slice(low, high)),
    )


@pytest.mark.parametrize(
    ("make_case", "low", "high"),
    [
        pytest.param(partial(cold.driven_dahl, 300.0, 0), 350, 430, id="driven Dahl"),
        # springs have forces of their own after the gap
        pytest.param(partial(cold.maxwell_slip, 414), 200, 260, id="Maxwell slip, 414"),
        pytest.param(partial(cold.maxwell_slip, 416), 200, 260, id="Maxwell slip, 416"),
        # beyond full slip the load has no effect, and a search from there once ended 7 u off
        pytest.param(partial(cold.iwan, 3), 150, 200, id="Iwan"),
        # the second part is much smaller than the first, the noise the same
        pytest.param(partial(cold.free_decay, "dahl", "spring", 2), 120, 180, id="free decay"),
        pytest.param(partial(cold.backlash, 2.0, 412), 700, 1100, id="backlash"),
    ],
)
def test_a_record_with_a_gap_is_fitted_in_two_parts(make_case, low, high):
    case = make_case()
    said = r"nothing is known from [\d.]+ to [\d.]+ s; 2 parts are fitted, each from a first state"
    with pytest.warns(DataWarning, match=said):
        assert_found(case._replace(record=with_gap(case.record, low, high)))


def test_a_gap_in_a_force_record_is_not_bridged_if_the_law_has_memory():
    """The displacement turns several times in the gap, so a straight line through it is wrong."""
    case = cold.backlash(0.5, 0)
    record = with_gap(case.record, 400, 700)
    with pytest.warns(DataWarning, match=r"nothing is known from 1\.995 to 3\.5 s"):
        fit = di.fit(record, case.model)
    assert fit.trusted
    assert [part.n for part in fit.data] == [400, 1300]
    assert "a single run" in fit.verdict
    assert_near(fit, case.truth, 3.0)
    again = di.FitResult.from_json(fit.to_json())
    assert again.verdict == fit.verdict


def test_a_gap_is_bridged_if_no_element_has_memory():
    t = np.delete(np.arange(400) / 100.0, slice(150, 220))
    x = 1e-3 * np.sin(7.0 * t)
    force = 50.0 * x + 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        fit = di.fit(di.Record(t, displacement=x, force=force), di.Spring(), throw=False)
    assert fit.data[0].n == t.size
    assert fit.params["stiffness"].value == pytest.approx(50.0, rel=0.01)


def test_short_parts_are_left_out_and_uneven_times_are_not_gaps():
    x = 1e-2 * np.cumsum(np.random.default_rng(0).standard_normal(500))
    force = di.Dahl(0.1, 30.0).force(x) + 1e-3 * np.random.default_rng(1).standard_normal(500)
    t = np.arange(500) / 100.0
    t[490:] += 1.0
    with pytest.warns(DataWarning, match="one part is used.*; 10 samples in shorter parts"):
        fit = di.fit(di.Record(t, displacement=x, force=force), di.Dahl(), throw=False)
    assert fit.data[0].n == 490
    uneven = np.cumsum(np.exp(2.0 * np.random.default_rng(2).standard_normal(500)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        fit = di.fit(di.Record(uneven, displacement=x, force=force), di.Dahl(), throw=False)
    assert fit.data[0].n == 500

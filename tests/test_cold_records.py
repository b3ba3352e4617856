"""Records that a fit solves without a start; independent solvers made them."""

import warnings

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.errors import DataWarning
from tests import cold_records as cold
from tests.recovery import assert_near


def assert_found(case):
    """Check every free parameter: within three standard uncertainties, which say something."""
    fit = di.fit(case.record, case.model, throw=False)
    assert fit.success, fit.verdict
    assert fit.status.usable, fit.verdict
    assert_near(fit, case.truth, 3.0, 0.3)


@pytest.mark.parametrize(
    ("sigma", "seed", "samples"),
    [(30000.0, 0, 320), pytest.param(30000.0, 3, 768, marks=pytest.mark.long)],
)
def test_friction_faster_than_the_sampling(sigma, seed, samples):
    assert_found(cold.fast(sigma, seed, samples))


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(i, marks=pytest.mark.long) for i in range(2, 8))]
)
def test_friction_with_an_accelerometer(seed):
    assert_found(cold.accelerated(seed))


@pytest.mark.parametrize(
    ("gap", "seed"),
    [
        (2.0, 1),
        pytest.param(0.5, 0, marks=pytest.mark.long),
        pytest.param(6.0, 2, marks=pytest.mark.long),
    ],
)
def test_backlash_with_measured_displacement(gap, seed):
    assert_found(cold.play(gap, seed))


def assert_lowest(case):
    """Check that no search from the truth ends lower than a cold one by more than chance."""
    cold_fit = di.fit(case.record, case.model, throw=False)
    assert cold_fit.status.usable, cold_fit.verdict
    varied = [p for p in case.truth.parameters if cold_fit.params[p.name].vary]
    start = {p.name: float(p.value) for p in varied}
    near = di.fit(case.record, case.model, start=start, throw=False)
    lowest = near.optimum.cost
    assert cold_fit.optimum.cost - lowest < 4.0 * lowest / len(case.record), near.verdict


def seeds(*short):
    """Return 30 seeds, all but some for long runs alone."""
    return [i if i in short else pytest.param(i, marks=pytest.mark.long) for i in range(30)]


@pytest.mark.parametrize("seed", seeds(0, 6))
def test_slips_that_are_unknown(seed):
    assert_lowest(cold.unknown_slips(seed))


@pytest.mark.parametrize("seed", seeds(0))
def test_a_stribeck_speed_in_much_noise(seed):
    assert_lowest(cold.lugre(seed, speed=0.06, noise=1e-2))


@pytest.mark.parametrize(
    ("made", "seed"),
    [(cold.lugre, 0), (cold.slips, 1), pytest.param(cold.iwan, 1, marks=pytest.mark.long)],
)
def test_driven_plants(made, seed):
    assert_found(made(seed))


@pytest.mark.parametrize(
    ("name", "known"), [(name, ("mass", "spring")[i % 2]) for i, name in enumerate(cold.DECAYS)]
)
def test_free_decays(name, known):
    assert_found(cold.decay(name, known, 1, 300 if name == "iwan" else 600))


class StiffnessFirst(di.Friction):
    """Jenkins' element with its parameters in the order of a user."""

    parameters = (
        di.Parameter("k", "N/m", "stiffness", lower=0.0, transform="log"),
        di.Parameter("limit", "N", "friction limit", lower=0.0, transform="log"),
    )

    def slope(self, force, direction, velocity, values):
        k, limit = values
        return k * (direction * force < limit)


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_an_own_law_at_any_scale_whatever_the_order_of_its_parameters(scale):
    t = np.arange(600) / 100.0
    x = 3e-3 * scale * (np.sin(6.0 * t) + np.sin(21.3 * t))
    force = np.zeros(t.size)
    for i, step in enumerate(np.diff(x)):  # a spring that slips
        force[i + 1] = np.clip(force[i] + 30.0 / scale * step, -0.1, 0.1)
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


def test_a_gap_in_a_driven_record_makes_two_parts():
    case = cold.fast(300.0, 0)
    said = r"nothing is known from 3\.49 to 4\.3 s; 2 parts are fitted, each from a first state"
    with pytest.warns(DataWarning, match=said):
        assert_found(case._replace(record=with_gap(case.record, 350, 430)))


@pytest.mark.parametrize("seed", [414, 416])
def test_springs_have_forces_of_their_own_after_a_gap(seed):
    case = cold.slips(seed)
    with pytest.warns(DataWarning, match="2 parts are fitted"):
        assert_found(case._replace(record=with_gap(case.record, 200, 260)))


def test_iwan_is_loaded_within_full_slip_after_a_gap():
    """Beyond it the load has no effect, and a search from there once ended 7 u off."""
    case = cold.iwan(3)
    with pytest.warns(DataWarning, match="2 parts are fitted"):
        assert_found(case._replace(record=with_gap(case.record, 150, 200)))


def test_first_states_are_begun_again_as_long_as_it_helps():
    assert_found(cold.decay("maxwell_slip", "spring", 5))


def test_a_free_decay_goes_on_after_a_gap():
    """The second part is much smaller than the first, the noise the same."""
    case = cold.decay("dahl", "spring", 2)
    with pytest.warns(DataWarning, match="2 parts are fitted"):
        assert_found(case._replace(record=with_gap(case.record, 120, 180)))


def test_friction_slips_behind_a_gap_where_a_record_goes_on():
    case = cold.play(2.0, 412)
    with pytest.warns(DataWarning, match="2 parts are fitted"):
        assert_found(case._replace(record=with_gap(case.record, 700, 1100)))


def test_a_gap_in_a_force_record_is_not_bridged_where_friction_remembers():
    """In the gap the displacement turns several times: a straight way through it is wrong."""
    case = cold.play(0.5, 0)
    record = with_gap(case.record, 400, 700)
    with pytest.warns(DataWarning, match=r"nothing is known from 1\.995 to 3\.5 s"):
        fit = di.fit(record, case.model)
    assert fit.trusted
    assert [part.n for part in fit.data] == [400, 1300]
    assert "a single run" in fit.verdict
    assert_near(fit, case.truth, 3.0)
    again = di.FitResult.from_json(fit.to_json())
    assert again.verdict == fit.verdict


def test_a_gap_is_bridged_where_nothing_remembers():
    t = np.delete(np.arange(400) / 100.0, slice(150, 220))
    x = 1e-3 * np.sin(7.0 * t)
    force = 50.0 * x + 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        fit = di.fit(di.Record(t, displacement=x, force=force), di.Spring(), throw=False)
    assert fit.data[0].n == t.size
    assert fit.params["stiffness"].value == pytest.approx(50.0, rel=0.01)


def test_short_parts_are_left_out_and_uneven_times_are_no_gaps():
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

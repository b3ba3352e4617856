"""The describing function's steady response: accuracy, uniqueness, several amplitudes, none."""

import time
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import i1e

from dahl_ident.control_interop import response as any_response
from dahl_ident.control_interop.force_balance import solve
from dahl_ident.elements import Dahl, Damper, Mass, Model, Spring
from dahl_ident.errors import (
    ModelError,
    MultipleSolutionsWarning,
    NoSteadyMotionWarning,
    ValidationError,
)

FIG_7 = Dahl(f_max=0.1, sigma=30.0) + Mass(0.3) + Damper(0.24) + Spring(0.3)
response = partial(any_response, steady="describing function")
WIDE = np.geomspace(1e-12, 1e12, 97)[:, None]


def worst_residual(plant, result):
    """Return abs(X Z/u_0 - 1) over its bound max(1, kappa/4), the largest one found."""
    A, omega = result.amplitude, 2.0 * np.pi * result.frequency_hz
    found = np.isfinite(A)
    friction = Model(*(e for e in plant.elements if isinstance(e, Dahl)))
    N = friction.dynamic_stiffness(np.where(found, A, 1.0))
    Z = plant.dynamic_stiffness(np.where(found, A, 1.0), omega)
    kappa = (np.abs(Z - N) + np.abs(N)) / np.abs(Z)
    residual = np.abs(result.displacement * Z / result.drive - 1.0) / np.maximum(1.0, kappa / 4.0)
    return float(np.max(residual[found]))


def some_plants(count, alphas):
    rng = np.random.default_rng(7)
    plants = []
    for i in range(count):
        f_max, sigma, mass, damping, stiffness = 10.0 ** rng.uniform(-3.0, 3.0, 5)
        damping, stiffness = damping * rng.choice([0.0, 1e-6, 1.0]), stiffness * rng.integers(2)
        law = Dahl(f_max, sigma, alphas[i % len(alphas)])
        plants.append(law + Mass(mass) + Damper(damping) + Spring(stiffness))
    return plants


@pytest.mark.parametrize(
    ("plant", "frequency", "share"),
    [
        *((plant, np.geomspace(1e-3, 1e3, 61), WIDE) for plant in some_plants(30, [1.0])),
        *((plant, np.geomspace(1e-2, 1e2, 9), WIDE[::4])
          for plant in some_plants(8, [0.25, 0.7, 2.0, 4.0])),
    ],
    ids=repr,
)  # fmt: skip
def test_drives_over_24_decades(plant, frequency, share):
    f_max = float(plant.parameters[0].value or 0.0)
    result = response(plant, frequency, f_max * share)
    assert result.amplitude.shape == (share.size, frequency.size)
    assert result.found.all()
    assert "steady amplitude" not in result.message
    assert worst_residual(plant, result) < 1e-12


def test_several_friction_elements_side_by_side():
    friction = Dahl(1.0, 10.0, name="a") + Dahl(0.01, 1e4, name="b") + Dahl(5.0, 2.0, 2.0, name="c")
    plant = friction + Mass(0.3) + Spring(0.01)
    result = response(plant, [0.0, 0.1, 0.9, 25.0], WIDE)
    assert result.found.all()
    assert worst_residual(plant, result) < 1e-12


@pytest.mark.parametrize("levels", [1, 3, 40])
def test_the_phasor_is_as_accurate_as_the_amplitude_however_few_the_points(levels):
    rng = np.random.default_rng(4)
    for plant in some_plants(40, [1.0, 0.5, 2.0]):
        f_max = float(plant.parameters[0].value or 0.0)
        drive = f_max * 10.0 ** rng.uniform(-8.0, 8.0, levels)
        assert worst_residual(plant, response(plant, rng.uniform(0.0, 3.0), drive)) < 1e-12


@pytest.mark.parametrize("exponent", [(30, 30), (30, -30), (-30, 30), (-30, -30)])
def test_extreme_units_pass_without_warning(exponent):
    f_max, sigma = 10.0 ** exponent[0], 10.0 ** exponent[1]
    plant = Dahl(f_max, sigma) + Mass(sigma) + Spring(0.1 * sigma)
    result = response(plant, [0.0, 0.1, 1.0], f_max * WIDE)
    assert result.found.all()
    assert worst_residual(plant, result) < 1e-12


def closed_form(A, omega):
    """Return A abs(Z) of Fig. 7 from scipy's Bessel function."""
    beta = 30.0 * A / 0.1
    tanh = np.tanh(beta)
    real = 2.0 * i1e(beta) * (1.0 + tanh) / beta
    N = 30.0 * complex(real, 4.0 / np.pi * (1.0 - tanh / beta) / beta)
    return float(A * abs(0.3 - 0.3 * omega**2 + 0.24j * omega + N))


def test_amplitude_is_that_of_brentq_on_the_closed_form():
    frequency = np.array([0.01, 0.16, 0.5, 1.58, 3.0])
    drive = np.array([1e-3, 0.05, 0.1, 0.13, 0.2, 5.0])
    ours = response(FIG_7, frequency, drive[:, None]).amplitude
    for i, u0 in enumerate(drive):
        for j, omega in enumerate(2.0 * np.pi * frequency):
            peer = brentq(lambda A, w=omega, u=u0: closed_form(A, w) - u, 1e-7, 1e4, rtol=1e-14)
            assert ours[i, j] == pytest.approx(peer, rel=1e-10)


# several amplitudes


ACTIVE = Dahl(0.1, 30.0) + Mass(0.3) + Damper(-0.24) + Spring(0.3)


def brute_force(plant, frequency_hz, drive):
    """Return where A abs(Z) crosses the drive on a very fine grid."""
    A = np.geomspace(1e-7, 1e4, 2_000_001)
    above = A * np.abs(plant.dynamic_stiffness(A, 2.0 * np.pi * frequency_hz)) > drive
    cell = np.flatnonzero(above[1:] != above[:-1])
    return np.sqrt(A[cell] * A[cell + 1])


@pytest.mark.parametrize("damping", [-0.01, -0.24, -2.0])
def test_all_amplitudes_of_an_active_plant(damping):
    plant = Dahl(0.1, 30.0) + Mass(0.3) + Damper(damping) + Spring(0.3)
    frequency = np.array([0.1, 0.4, 0.8, 1.2, 1.5, 1.59, 2.0])
    drive = np.geomspace(1e-3, 0.5, 12)[:, None]
    result = response(plant, frequency, drive, all_roots=True)
    assert worst_residual(plant, result) < 1e-12
    several = np.argwhere(result.number_of_solutions > 1)
    for i, j in [*several[:4], (0, 0), (11, 6)]:
        roots = result.amplitude[i, j]
        expected = brute_force(plant, frequency[j], float(drive[i, 0]))
        np.testing.assert_allclose(roots[np.isfinite(roots)], expected, rtol=2e-5)
        assert len(expected) == result.number_of_solutions[i, j]


def test_the_default_warns_and_returns_the_smallest():
    frequency, drive = np.linspace(0.05, 3.0, 60), np.geomspace(1e-3, 1.0, 20)[:, None]
    every = response(ACTIVE, frequency, drive, all_roots=True)
    count = int(np.sum(every.number_of_solutions > 1))
    assert count > 3
    assert every.amplitude.shape == (20, 60, int(every.number_of_solutions.max()))
    text = rf"{count} of 1200 points: several steady amplitudes .* the smallest is returned"
    with pytest.warns(MultipleSolutionsWarning, match=text):
        one = response(ACTIVE, frequency, drive)
    np.testing.assert_array_equal(one.amplitude, np.nanmin(every.amplitude, axis=-1))
    assert "several" in one.message
    assert "several" in every.message


def limit_cycle():
    """Return a plant with Z = 0 at amplitude 1 and omega 10, with both numbers."""
    friction = Dahl(1.0, 2.0)
    N = complex(friction.describing_function(1.0))
    return friction + Mass(0.1) + Damper(-N.imag / 10.0) + Spring(10.0 - N.real), 1.0, 10.0


@pytest.mark.parametrize("drive", [1e-9, 1e-14, 1e-17, 1e-20, 1e-30])
def test_a_weakly_driven_limit_cycle_has_two_close_amplitudes_near_the_small_one(drive):
    plant, amplitude, omega = limit_cycle()
    result = response(plant, omega / (2.0 * np.pi), drive, all_roots=True)
    small, *pair = result.amplitude  # that only rounding parts where the drive is less than it
    assert small < 10.0 * drive
    assert len(pair) == 2 or drive < 1e-15
    np.testing.assert_allclose(pair, amplitude, rtol=10.0 * drive + 1e-13)


def test_start_chooses_among_several():
    plant, _, omega = limit_cycle()
    values = plant.known_values()
    every = response(plant, omega / (2.0 * np.pi), 0.01, all_roots=True).amplitude
    for root in every:
        near = solve(plant, values, np.asarray(omega), np.asarray(0.01), start=1.01 * root)
        assert near == pytest.approx(root, rel=1e-14)
    smallest = solve(plant, values, np.asarray(omega), np.asarray(0.01))
    assert smallest == pytest.approx(every[0], rel=1e-14)


# no amplitude


RESONANT = Dahl(1.0, 1.0) + Mass(1.0) + Spring(1.0)


def test_undamped_resonance_has_no_amplitude_above_the_friction_limit():
    drive = np.array([0.5, 1.27, 4.0 / np.pi, 2.0])
    with pytest.warns(NoSteadyMotionWarning, match="2 of 4 points have no steady motion"):
        result = response(RESONANT, 0.5 / np.pi, drive)
    assert result.found.tolist() == [True, True, False, False]
    assert result.number_of_solutions.tolist() == [1, 1, 0, 0]
    assert np.isnan(result.amplitude[2:]).all()
    for part in (result.displacement, result.dynamic_stiffness, result.receptance, result.phase):
        assert np.isfinite(part).tolist() == [True, True, False, False]
    assert result.message.startswith("2 of 4 points: no steady amplitude (an undamped resonance")
    assert result.message.endswith("the first at 0.159155 Hz, drive 1.27324")
    friction = Dahl(1.0, 1.0)
    force = result.amplitude[:2] * friction.gain(result.amplitude[:2])
    np.testing.assert_allclose(force, drive[:2], rtol=1e-12)


def test_friction_that_differs_by_direction_drifts_without_a_spring():
    """Nothing brings the mean displacement back: said at once, and with the right reason."""
    plant = Dahl(0.1, 30.0, asymmetry=0.2) + Mass(1.0) + Damper(0.1)
    begun = time.process_time()
    with pytest.warns(NoSteadyMotionWarning, match="friction differs between the directions"):
        result = any_response(plant, np.geomspace(0.5, 5.0, 60), 0.3)
    assert time.process_time() - begun < 5.0
    assert not result.found.any()
    assert "add a spring" in result.message
    assert any_response(plant + Spring(0.3), 1.0, 0.3).found
    assert any_response(Dahl(0.1, 30.0) + Mass(1.0) + Damper(0.1), 1.0, 0.3).found


def test_resonance_that_rounding_hides_has_no_amplitude_either():
    plant = Dahl(1.0, 1.0) + Mass(0.3) + Spring(0.1)
    omega = np.sqrt(0.1 / 0.3)
    assert 0.1 - 0.3 * omega**2 != 0.0
    with pytest.warns(NoSteadyMotionWarning):
        assert not response(plant, omega / (2.0 * np.pi), 2.0).found
    assert response(plant, 1.0000001 * omega / (2.0 * np.pi), 2.0).found


def test_linear_plant_alone():
    plant = Mass(2.0) + Spring(8.0)
    with pytest.warns(NoSteadyMotionWarning):
        result = response(plant, np.array([0.0, 1.0]) / np.pi, 4.0)
    assert result.amplitude[0] == pytest.approx(0.5)
    assert not result.found[1]


def test_many_parameter_vectors_at_once_are_each_alone():
    rng = np.random.default_rng(3)
    omega, drive = 2.0 * np.pi * np.geomspace(0.05, 3.0, 11), np.geomspace(0.01, 1.0, 11)
    vectors = np.array([float(v) for v in FIG_7.known_values()]) * rng.uniform(0.5, 2.0, (17, 6))
    vectors[:, 2] = 1.0
    together = solve(FIG_7, list(vectors.T[:, :, None]), omega, drive)
    assert together.shape == (17, 11)
    for s, vector in enumerate(vectors):
        alone = solve(FIG_7, [np.asarray(v) for v in vector], omega, drive)
        np.testing.assert_allclose(together[s], alone, rtol=1e-12)


TWO = Dahl(1.0, 5.0, name="a") + Dahl(0.2, 9.0, name="b") + Mass(0.1) + Damper(0.05)


@pytest.mark.parametrize("plant", [FIG_7, TWO], ids=["one", "two"])
@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize("overflow", [np.inf, np.nan])
def test_a_search_that_overflows_gets_no_amplitude(plant, index, overflow):
    vectors = np.tile([float(v) for v in plant.known_values()], (3, 1))
    vectors[1, index] = overflow
    columns = list(vectors.T[:, :, None])
    with np.errstate(invalid="ignore"):  # of the element itself: infinity times zero
        A = solve(plant, columns, 2.0 * np.pi * np.array([0.5, 1.0, 2.0]), np.full(3, 0.1))
    assert np.isnan(A[1]).all()
    assert np.isfinite(A[[0, 2]]).all()


# arguments and results


def test_shapes_broadcast_and_scalars_stay_scalars():
    one = response(FIG_7, 1.0, 0.1)
    assert np.shape(one.amplitude) == ()
    assert isinstance(one.amplitude, float)
    assert abs(one.displacement) == pytest.approx(one.amplitude)
    assert np.angle(one.receptance) == pytest.approx(one.phase)
    grid = response(FIG_7, [[1.0, 2.0]], [[0.1], [0.2], [0.3]])
    for field in (grid.frequency_hz, grid.drive, grid.amplitude, grid.phase, grid.found):
        assert field.shape == (3, 2)
    assert grid.amplitude[0, 0] == one.amplitude
    with pytest.raises(ValueError, match="read-only"):
        grid.amplitude[0] = 1.0
    assert response(FIG_7, [], 0.1).amplitude.shape == (0,)
    assert response(FIG_7, 1.0, [0.1], all_roots=True).dynamic_stiffness.shape == (1, 1)


@pytest.mark.parametrize(
    ("frequency", "drive", "text"),
    [
        ([1.0, -2.0], 1.0, r"frequency_hz\[1\] is -2\.0; expected numbers >= 0"),
        ([1.0, np.nan], 1.0, r"frequency_hz\[1\] is nan; expected finite"),
        (1.0, [[0.1, 0.0]], r"drive\[0, 1\] is 0\.0; expected numbers > 0"),
        (1.0, np.inf, r"drive is inf; expected finite"),
        (1.0, 1.0 + 1.0j, r"drive: expected real numbers, got complex"),
        (1.0, 1e300, r"drive is 1e\+300; expected numbers of at most 1e\+90"),
        (1.0, True, r"drive: expected real numbers, got True"),
        ([1.0, 2.0], [0.1, 0.2, 0.3], r"frequency_hz \(2,\), drive \(3,\)"),
    ],
)
def test_bad_arguments_are_named(frequency, drive, text):
    with pytest.raises(ValidationError, match=text):
        response(FIG_7, frequency, drive)


@given(
    st.lists(st.floats(-89.0, 89.0), min_size=7, max_size=7),
    st.sampled_from([1.0, 0.5, 2.0]),
    st.sampled_from([1.0, -1.0, 0.0]),
)
def test_whatever_is_accepted_is_right_or_refused(exponents, alpha, sign):
    f_max, sigma, mass, damping, stiffness, frequency, drive = (10.0**e for e in exponents)
    plant = Dahl(f_max, sigma, alpha) + Mass(mass) + Damper(sign * damping) + Spring(stiffness)
    try:
        result = response(plant, frequency, [drive], all_roots=True)
    except ValidationError:
        with pytest.raises(ValidationError, match="outside the range of numbers"):
            response(plant, frequency, drive)
        return
    assert result.found.any() or result.message
    if sign >= 0.0 and result.found.any() and result.amplitude[0, 0] < 1e90:
        assert worst_residual(plant, result) < 1e-12


@pytest.mark.parametrize(
    ("plant", "frequency", "drive"),
    [(Mass(1e-90) + Damper(1e-90), 1e-120, 1e90), (Dahl(1e-90, 1e-90) + Mass(1e90), 1e90, 1e-30)],
)
def test_what_numbers_cannot_hold_is_refused(plant, frequency, drive):
    text = r"^point 0 \(1 such points\) has an amplitude of about .* outside the range of numbers"
    with pytest.raises(ValidationError, match=text):
        response(plant, frequency, drive)


def test_a_plant_without_a_value_says_which():
    with pytest.raises(ModelError, match="has no value for sigma, damping"):
        response(Dahl(0.1) + Damper(), 1.0, 0.1)


def test_a_motion_that_is_not_a_sine_is_named():
    stick, slip = response(FIG_7, 0.158, 0.1), response(FIG_7, 1.0, 5.0)
    assert "the third harmonic is about 13 % at 0.158 Hz, drive 0.1" in stick.message
    assert slip.message == ""
    exact = any_response(FIG_7, 0.158, 0.1)
    assert abs(stick.displacement / exact.displacement - 1.0) > 0.5
    assert exact.message == ""


def test_what_is_no_plant_is_named():
    with pytest.raises(ModelError, match=r"expected a model such as Dahl\(\) .*, got str"):
        response("plant", 1.0, 1.0)  # type: ignore[arg-type]  # the point of the test

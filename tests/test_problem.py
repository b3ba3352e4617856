"""Problems of tables: predictions, residuals and derivatives against mpmath and differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpmath import mp
from scipy import stats

from dahl_ident import (
    BoucWen,
    Dahl,
    Damper,
    FrequencyResponse,
    Iwan,
    LuGre,
    Mass,
    MaxwellSlip,
    Record,
    Sensors,
    Spring,
    response,
)
from dahl_ident.arrays import FloatArray
from dahl_ident.errors import DataError, ModelError, ValidationError
from dahl_ident.problem import ProblemBatch, RecordProblem, TableProblem
from tests.derivatives import central_differences

n = 6
A = np.geomspace(3e-4, 3e-2, n)
FREQUENCY = np.geomspace(0.3, 3.0, n)
OMEGA = 2.0 * np.pi * FREQUENCY
DRIVE = np.geomspace(0.02, 1.0, n)
TRUE = (0.1, 30.0, 0.3, 0.24, 0.3)
FREE = Dahl() + Mass() + Damper() + Spring()
RNG = np.random.default_rng(2)
NOISE = np.exp(0.05 * (RNG.normal(size=n) + 1j * RNG.normal(size=n)))


QUANTITIES = {
    "receptance": (0, -1),
    "mobility": (1, -1),
    "accelerance": (2, -1),
    "dynamic_stiffness": (0, 1),
    "mechanical_impedance": (-1, 1),
    "apparent_mass": (-2, 1),
}


def plant():
    f_max, sigma, mass, damping, stiffness = TRUE
    return Dahl(f_max, sigma) + Mass(mass) + Damper(damping) + Spring(stiffness)


def data(quantity="dynamic_stiffness", controlled="displacement"):
    power, exponent = QUANTITIES[quantity]
    R = (1j * OMEGA) ** power * plant().dynamic_stiffness(A, OMEGA) ** exponent * NOISE
    spread = np.abs(R)[:, None, None] ** 2
    return FrequencyResponse(
        FREQUENCY,
        R,
        A,
        DRIVE,
        covariance=spread * np.array([[4e-4, 1e-4], [1e-4, 9e-4]]),
        controlled=controlled,
        quantity=quantity,  # one of the six above
    )


def mp_stiffness(theta, amplitude, omega):
    """Return Z of the plant with mpmath, theta = (ln f_max, ln sigma, mass, damping, stiffness)."""
    f_max, sigma = mp.exp(theta[0]), mp.exp(theta[1])
    b = sigma * amplitude / f_max
    real = 2 * mp.besseli(1, b) / (b * mp.cosh(b))
    imag = 4 / mp.pi * (1 - mp.tanh(b) / b) / b
    linear = theta[4] - theta[2] * omega**2 + mp.mpc(0, 1) * omega * theta[3]
    return sigma * (real + mp.mpc(0, 1) * imag) + linear


def mp_driven(theta, drive, omega, near):
    amplitude = mp.findroot(
        lambda a: a * abs(mp_stiffness(theta, a, omega)) - drive, mp.mpf(near), tol=1e-50
    )
    return mp_stiffness(theta, amplitude, omega)


@pytest.mark.parametrize("controlled", ["displacement", "force"])
def test_predictions_and_derivatives_agree_with_mpmath(controlled):
    problem = TableProblem(data("receptance", controlled), FREE, steady="describing function")
    values = np.array(TRUE) * [1.1, 0.9, 1.05, 0.95, 1.2]
    theta = problem.to_search(values)
    driven = response(
        Dahl(*values[:2]) + Mass(values[2]) + Damper(values[3]) + Spring(values[4]),
        FREQUENCY,
        DRIVE,
        steady="describing function",
    ).amplitude
    with mp.workdps(40):
        for row in (0, 3, 5):
            omega = mp.mpf(float(OMEGA[row]))

            def receptance(*at, row=row, omega=omega):
                if controlled == "force":
                    drive = mp.mpf(float(DRIVE[row]))
                    return 1 / mp_driven(list(at), drive, omega, float(driven[row]))
                return 1 / mp_stiffness(list(at), mp.mpf(float(A[row])), omega)

            at = [mp.mpf(float(t)) for t in theta]
            expected = complex(receptance(*at))
            slopes = [
                complex(mp.diff(receptance, tuple(at), tuple(int(i == p) for i in range(5))))
                for p in range(5)
            ]
            assert problem.predict(theta)[row] == pytest.approx(expected, rel=1e-11)
            found = problem.prediction_jacobian(theta)[row]
            np.testing.assert_allclose(found, slopes, rtol=1e-9)


@pytest.mark.parametrize("noise", ["measured", "relative", "absolute"])
@pytest.mark.parametrize("controlled", ["displacement", "force", "mixed"])
@pytest.mark.parametrize(
    ("quantity", "steady"),
    [
        *((quantity, "describing function") for quantity in QUANTITIES),
        *((quantity, "exact") for quantity in ("accelerance", "dynamic_stiffness")),
        *(
            pytest.param(q, "exact", marks=pytest.mark.long)
            for q in ("receptance", "mobility", "apparent_mass")
        ),
    ],
)
def test_jacobian_is_the_residuals_derivative(quantity, controlled, noise, steady):
    words = np.where(np.arange(n) % 2, "force", "displacement")
    table = data(quantity, words if controlled == "mixed" else controlled)
    sensors = Sensors(stats.norm(1.0, 0.01), None, stats.norm(0.0, 1e-3))
    problem = TableProblem(table, FREE, noise=noise, sensors=sensors, steady=steady)
    error = 2e-5 if problem.is_exact else 1e-9  # of the derivatives' largest
    theta = problem.to_search([0.11, 28.0, 0.31, 0.25, 0.32, 1.01, 0.99, 1e-3])
    r, J = problem.residuals_and_jacobian(theta)
    assert r.shape == (2 * n + 2,)
    step = 1e-4
    for p, direction in enumerate(np.eye(theta.size)):
        shifts = step * np.array([-2.0, -1.0, 1.0, 2.0])
        values = problem.residuals(theta + shifts[:, None] * direction)
        slope = np.array([1.0, -8.0, 8.0, -1.0]) @ values / (12.0 * step)
        np.testing.assert_allclose(J[:, p], slope, rtol=1e-7, atol=error * np.abs(J[:, p]).max())
    quadratic = problem.quadratic(theta)
    same = 1e-6 if problem.is_exact else 1e-12
    assert float(quadratic.cost) == pytest.approx(0.5 * r @ r, rel=same)
    assert np.all(np.abs(quadratic.gradient - J.T @ r) <= same * np.abs(J.T) @ np.abs(r))
    np.testing.assert_allclose(quadratic.hessian, J.T @ J, rtol=same)
    np.testing.assert_allclose(problem.information(theta), J.T @ J, rtol=same)


@pytest.mark.parametrize(
    "law",
    [
        BoucWen(1e12, 1e13, 0.0),
        BoucWen(1e12, 1e13, 0.0) + MaxwellSlip([1e-15], [1.0]),
        MaxwellSlip([1e-13], [1e12]),
        Iwan(0.1, 1e12, chi=0.0, ratio=1.0),
        LuGre(0.1, 1e12, static_ratio=1.0, stribeck_speed=1.0),
    ],
)
def test_a_very_stiff_law_is_dry_friction(law):
    """A driven plant moves as with Dahl friction of the same force, however high the stiffness."""
    rest = Mass() + Damper(0.24) + Spring(0.3)
    table = FrequencyResponse(
        [0.3, 0.7, 1.5], np.full(3, 1.0 - 0.5j), drive=[0.3, 0.5, 0.6], controlled="force",
        quantity="receptance",
    )  # fmt: skip
    expected = TableProblem(table, Dahl(0.1, 1e6, 1.0) + rest, noise="absolute").predict([0.3])
    found = TableProblem(table, law + rest, noise="absolute").predict([0.3])
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("harmonics", [(1,), (1, 3)])
def test_a_problem_near_a_point_is_corrected_to_exact_motions(harmonics):
    """Its error is of second order in the distance, and its derivatives are its own."""
    frequency, drive = (
        np.repeat([0.3, 0.7, 1.5], len(harmonics)),
        np.repeat([0.09, 0.3, 0.6], len(harmonics)),
    )
    table = FrequencyResponse(
        frequency, np.full(frequency.shape, 1.0 - 0.5j), drive=drive, controlled="force",
        quantity="receptance", harmonic=np.tile(harmonics, 3),
        covariance=np.tile(np.diag([4e-4, 9e-4]), (frequency.size, 1, 1)),
        drive_std=0.01 * drive,
    )  # fmt: skip
    problem = TableProblem(table, FREE)
    centre = problem.to_search(TRUE)
    near = problem.near(centre)
    np.testing.assert_allclose(near.predict(centre), problem.predict(centre), rtol=1e-9)
    direction = np.array([1.0, -1.0, 0.02, 0.03, 0.1])
    errors = []
    for size in (0.02, 0.04):
        there = centre + size * direction
        exact = problem.predict(there)
        errors.append(np.abs(near.predict(there) / exact - 1.0).max())
    assert 0.0 < errors[0] < 0.01
    assert errors[1] < 5.0 * errors[0]
    there = centre + 0.04 * direction
    r, J = near.residuals_and_jacobian(there)
    step = 1e-4 * np.eye(5)[:, None] * np.array([-2.0, -1.0, 1.0, 2.0])[:, None]
    values = near.residuals((there + step).reshape(-1, 5)).reshape(5, 4, -1)
    slopes = np.array([1.0, -8.0, 8.0, -1.0]) @ values / 12e-4
    gradient = slopes @ r  # residuals of noisy drives are defined up to a rotation
    np.testing.assert_allclose(J.T @ r, gradient, rtol=1e-5, atol=1e-6 * np.abs(gradient).max())


def test_derivatives_with_a_free_exponent_and_two_friction_elements():
    plant = Dahl(name="a", alpha=None) + Dahl(name="b") + Mass() + Damper()
    table = FrequencyResponse(
        [0.2, 1.0, 2.0] * 3, np.ones(9), drive=[0.3] * 3 + [1.1] * 3 + [4.0] * 3,
        controlled="force", quantity="receptance",
    )  # fmt: skip
    problem = TableProblem(table, plant, noise="absolute", steady="describing function")
    values = {
        "a_f_max": 1.0, "a_sigma": 5.0, "a_alpha": 1.7, "b_f_max": 0.2, "b_sigma": 9.0,
        "mass": 0.1, "damping": 0.05,
    }  # fmt: skip
    theta = problem.to_search([values[name] for name in problem.names])
    slopes = central_differences(problem.predict, theta, 1e-5)
    for ours, slope in zip(problem.prediction_jacobian(theta).T, slopes, strict=True):
        np.testing.assert_allclose(ours, slope, atol=1e-7 * np.abs(slope).max())


def test_derivatives_with_respect_to_the_level():
    """Levels are drives or amplitudes."""
    levels = np.geomspace(1e-3, 0.1, 6)
    controlled = ["force", "displacement"] * 3

    def at(factor):
        table = FrequencyResponse(
            np.full(6, 0.3),
            np.ones(6),
            factor * levels,
            drive=factor * levels,
            controlled=controlled,
        )
        model = Dahl() + Mass() + Damper()
        return TableProblem(table, model, noise="absolute", steady="describing function")

    theta = at(1.0).to_search([0.1, 30.0, 0.3, 0.24])
    (slope,) = central_differences(lambda ln: at(np.exp(ln[0])).predict(theta), [0.0], 1e-5)
    np.testing.assert_allclose(at(1.0).level_slope(theta), slope, rtol=1e-6)


@pytest.mark.parametrize("controlled", ["displacement", "force"])
def test_many_vectors_at_once_equal_one_at_a_time(controlled):
    problem = TableProblem(data("mobility", controlled), FREE)
    theta = problem.to_search(TRUE) + 0.05 * RNG.normal(size=(4, 5))
    same = 1e-5 if problem.is_exact else 1e-10
    for method in (
        problem.predict,
        problem.prediction_jacobian,
        problem.residuals,
        lambda t: problem.residuals_and_jacobian(t)[1],
        problem.log_likelihood,
        problem.information,
        problem.to_values,
    ):
        call: Callable[[FloatArray], Any] = method
        each = np.array([call(t) for t in theta])
        np.testing.assert_allclose(call(theta), each, rtol=same, atol=same * np.abs(each).max())


def test_a_batch_equals_its_tables_one_by_one():
    tables = [
        FrequencyResponse(FREQUENCY * s, Dahl(0.1, 30.0).describing_function(A * s) * NOISE, A * s)
        for s in (1.0, 1.5, 3.0)
    ]
    batch = ProblemBatch(tables, Dahl())
    theta = np.log([[0.1, 30.0], [0.2, 20.0], [0.05, 35.0]])
    each = [TableProblem(table, Dahl()) for table in tables]
    assert batch.n_tables == 3
    for name in ("predict", "residuals", "log_likelihood", "information"):
        singles = [getattr(p, name)(t) for p, t in zip(each, theta, strict=True)]
        np.testing.assert_allclose(getattr(batch, name)(theta), singles, rtol=1e-12)
        taken = getattr(batch.take(np.array([2, 0])), name)(theta[[2, 0]])
        np.testing.assert_allclose(taken, np.array(singles)[[2, 0]], rtol=1e-12)
    np.testing.assert_allclose(batch.table(1).residuals(theta[1]), each[1].residuals(theta[1]))


def test_replicates_share_all_but_the_response():
    problem = TableProblem(data(), FREE)
    responses = data().response * np.array([[1.0], [1.2]])
    batch = ProblemBatch.replicates(problem, responses)
    theta = np.tile(problem.to_search(TRUE), (2, 1))
    np.testing.assert_allclose(batch.residuals(theta)[0], problem.residuals(theta[0]))
    with pytest.raises(
        DataError, match=r"responses have shape \(2, 5\); expected \(replicates, 6\)"
    ):
        ProblemBatch.replicates(problem, responses[:, :5])


@given(force=st.floats(-30.0, 30.0), motion=st.floats(-30.0, 30.0), x=st.floats(-1.0, 1.0))
def test_residuals_do_not_depend_on_units(force, motion, x):
    a, b = 10.0**force, 10.0**motion
    N = Dahl(0.1, 30.0).describing_function(A) * NOISE
    theta = np.log([0.1, 30.0]) + x
    here = TableProblem(FrequencyResponse(np.ones(n), N, A), Dahl())
    there = TableProblem(FrequencyResponse(np.ones(n), N * a / b, A * b), Dahl())
    moved = theta + np.log([a, a / b])
    np.testing.assert_allclose(there.residuals(moved), here.residuals(theta), atol=2e-12)
    np.testing.assert_allclose(
        there.residuals_and_jacobian(moved)[1], here.residuals_and_jacobian(theta)[1], atol=2e-11
    )


@given(values=st.lists(st.floats(1e-30, 1e30), min_size=2, max_size=2))
def test_search_coordinates_round_trip(values):
    problem = TableProblem(FrequencyResponse(np.ones(n), NOISE, A), Dahl())
    np.testing.assert_allclose(problem.to_values(problem.to_search(values)), values, rtol=1e-13)


@pytest.mark.parametrize("channel", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("size", [2e-3, 40.0])
def test_rates_of_either_sign_are_numbers_near_zero_and_logarithms_far_off(channel, size):
    """The coordinate bends at a tenth of the inverse rms displacement, for every channel."""
    t, omega = np.arange(4000) / 1000.0, 2.0 * np.pi
    wave = (
        size
        * np.sin(omega * t)
        * omega ** ("displacement", "velocity", "acceleration").index(channel)
    )
    record = Record(t, **{channel: wave}, force=np.cos(omega * t))
    problem = RecordProblem([record], BoucWen() + Mass(1.0))
    bend = 0.1 / (size / 2.0**0.5)
    for rate in (1e-6 * bend, -0.3 * bend, bend, 1e4 * bend):
        values = np.where(np.array(problem.names) == "q", rate, 1.0)
        coordinate = problem.to_search(values)[problem.names.index("q")]
        assert coordinate == pytest.approx(np.arcsinh(rate / bend), rel=1e-2)
        assert problem.to_values(problem.to_search(values)) == pytest.approx(values)


@pytest.mark.parametrize(
    ("noise", "scale"), [("relative", 0.02), ("absolute", 0.3), ("measured", 1.0)]
)
def test_repetitions_scatter_as_the_noise_does(noise, scale):
    problem = TableProblem(data(), FREE, noise=noise)
    theta = problem.to_search(TRUE)
    draws = problem.draw(theta, scale, 4000, np.random.default_rng(6))
    error = draws - problem.predict(theta)
    if noise == "relative":
        error = np.log(draws / problem.predict(theta))
    covariance = np.broadcast_to(scale**2 * np.eye(2), (n, 2, 2))
    if noise == "measured":
        covariance = data().covariance
    parts = np.stack([error.real, error.imag], axis=-1)
    found = np.einsum("ski,skj->kij", parts, parts) / len(parts)
    size = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    near = 6.0 / len(parts) ** 0.5  # of 18 numbers, one is farther off once in a million times
    assert (np.abs(found - covariance) < near * size[:, :, None] * size[:, None, :]).all()


def test_profiled_likelihood_is_its_maximum_over_the_scale():
    problem = TableProblem(data(), FREE, noise="relative")
    theta = problem.to_search(np.array(TRUE) * 1.05)
    scales = np.geomspace(0.01, 1.0, 2001)
    over_scale = problem.log_likelihood(np.tile(theta, (2001, 1)), scales)
    assert problem.log_likelihood(theta) == pytest.approx(over_scale.max(), abs=1e-3)
    assert problem.log_likelihood(theta) >= over_scale.max()


def test_no_steady_state_has_no_likelihood():
    resonance = 2.0 * np.pi
    table = FrequencyResponse(
        [1.0], [1.0], drive=[1.0], controlled="force", quantity="receptance", amplitude=[1.0]
    )
    undamped = Dahl(sigma=30.0) + Mass(1.0) + Spring(resonance**2)
    problem = TableProblem(table, undamped)
    f_max = np.log([[10.0], [0.1]])  # 0.1 N of friction cannot hold 1 N at resonance
    likelihood = problem.log_likelihood(f_max, 1.0)
    assert np.isfinite(likelihood[0])
    assert likelihood[1] == -np.inf
    assert np.isnan(problem.predict(f_max)[1]).all()


def test_like_elements_are_ordered_by_x_c():
    two = Dahl(name="a") + Dahl(name="b")
    problem = TableProblem(FrequencyResponse(np.ones(n), NOISE, A), two)
    theta = np.log([[1.0, 2.0, 0.1, 3.0], [0.1, 3.0, 1.0, 2.0]])
    np.testing.assert_allclose(problem.in_order(theta), theta[[1, 1]])
    unlike = TableProblem(FrequencyResponse(np.ones(n), NOISE, A), two, fixed={"b_sigma": 1.0})
    np.testing.assert_allclose(unlike.in_order(theta[:, :3]), theta[:, :3])


def test_free_and_fixed_reach_model_and_sensors():
    problem = TableProblem(
        data(), plant(), free=["f_max", "delay"], sensors=Sensors(force_gain=None),
        fixed={"force_gain": 1.1},
    )  # fmt: skip
    assert problem.names == ("f_max", "delay")
    assert problem.sensors.force_gain == 1.1


def row(**columns):
    """Return a table of one row."""
    return FrequencyResponse([1.0], [1.0], **columns)


@pytest.mark.parametrize(
    ("table", "model", "options", "error", "message"),
    [
        (data(), plant(), {}, ModelError, "has no free parameter; leave one out"),
        (data(), FREE, {"free": ["speed"]}, ModelError, "has no parameter speed"),
        (data(), FREE, {"free": ["mass"], "fixed": {"mass": 1.0}}, ModelError,
         "mass is both in free and in fixed"),
        (row(drive=[1.0]), FREE, {}, DataError,
         "row 0 is displacement-controlled, but the data have no amplitude; give it, or say"),
        (row(amplitude=[1.0], controlled="force"), FREE, {}, DataError,
         "row 0 is force-controlled, but the data have no drive"),
        (row(amplitude=[1.0], drive=[1.0], controlled="force", harmonic=3), FREE, {}, DataError,
         "row 0 is force-controlled and holds harmonic 3"),
        (row(amplitude=[1.0], harmonic=2), Dahl(), {}, DataError,
         "rows hold the harmonics 2, and no element of Dahl"),
        (A, FREE, {}, DataError, "data is a ndarray; expected a Frequency"),
        (FrequencyResponse(FREQUENCY, 0.0 * A, A), Dahl(), {"noise": "absolute"}, DataError,
         "every response is 0; there is nothing to estimate from"),
        (data(), FREE, {"free": "alpha"}, ValidationError,
         r"free is 'alpha'; expected a collection of names: \['alpha'\]"),
        (data(), FREE, {"fixed": ["mass"]}, ValidationError,
         r"fixed is \['mass'\]; expected a mapping of names to numbers"),
        (data(), FREE, {"sensors": {"delay": 1e-3}}, ValidationError,
         r"sensors is \{'delay': 0.001\}; expected Sensors"),
    ],
)  # fmt: skip
def test_a_problem_that_cannot_be_estimated_is_refused(table, model, options, error, message):
    with pytest.raises(error, match=message):
        TableProblem(table, model, **options)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ([], "data is empty; expected a sequence"),
        (data(), "data is one table; expected a sequence"),
        ([data(), row(amplitude=[1.0])], "table 1 has 1 row of dynamic_stiffness, table 0 has 6"),
    ],
)
def test_tables_that_are_not_a_batch_are_refused(tables, message):
    with pytest.raises(DataError, match=message):
        ProblemBatch(tables, FREE)


def test_bad_vectors_are_refused():
    problem = TableProblem(data(), FREE)
    with pytest.raises(ValidationError, match="scale is given, but the noise has a known scale"):
        problem.log_likelihood(np.zeros(5), 1.0)
    with pytest.raises(
        ValidationError, match=r"theta has shape \(4,\); expected \(5,\) or \(S, 5\) for f_max, sig"
    ):
        problem.residuals(np.zeros(4))
    with pytest.raises(ValidationError, match=r"f_max is -1.0; expected numbers > 0"):
        problem.to_search([-1.0, 1.0, 1.0, 1.0, 1.0])


def test_priors_that_are_not_normal_are_refused():
    problem = TableProblem(data(), FREE, sensors=Sensors(delay=stats.uniform(0.0, 1.0)))
    with pytest.raises(ValidationError, match="the prior of delay is uniform; least squares takes"):
        problem.residuals(np.zeros(6))

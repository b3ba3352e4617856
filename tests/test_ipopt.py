"""IPOPT: the same optimum as least squares, constraints, errors of the drive."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import control
import numpy as np
import pytest
from scipy import optimize, stats

from dahl_ident import BoucWen, Dahl, Damper, FitResult, LinearSystem, Mass, Parameter, Spring
from dahl_ident import fit as any_fit
from dahl_ident import response as any_response
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.errors import FitError, ModelError, ValidationError
from dahl_ident.fitting import Status, ipopt, solve
from dahl_ident.fitting.ipopt import solve_ipopt
from dahl_ident.problem import TableProblem as AnyProblem
from dahl_ident.sensors import Sensors
from tests.friction_tables import driven, stated
from tests.recovery import assert_near

# closed forms are fast, and predict the same whichever way the search came; exact rows further down
TableProblem: Any = partial(AnyProblem, steady="describing function")
fit = partial(any_fit, steady="describing function")
response = partial(any_response, steady="describing function")

AMPLITUDE = np.geomspace(1e-5, 1e-1, 24)
FRICTION = Dahl(f_max=0.1, sigma=30.0)
PLANT = FRICTION + Mass(0.3) + Damper(0.24) + Spring(0.3)
UNKNOWN_PLANT = Dahl() + Mass() + Damper() + Spring()
LINEAR = Dahl(alpha=1.0)


def noise(n, size=0.02, seed=1):
    rng = np.random.default_rng(seed)
    return np.asarray(size * (rng.standard_normal(n) + 1j * rng.standard_normal(n)))


def friction_data(truth=FRICTION, size=0.02, **columns):
    N = truth.dynamic_stiffness(AMPLITUDE, 2.0 * np.pi)
    measured = N * np.exp(noise(AMPLITUDE.size, size))
    return FrequencyResponse(np.ones(AMPLITUDE.size), measured, AMPLITUDE, **columns)


KNOWN = stated(FRICTION.describing_function(AMPLITUDE), 0.02)
"""The covariance of those data."""


def of_quantity(receptance, frequency_hz, quantity):
    """Return another standard quantity of the same motion."""
    s, R = 2j * np.pi * frequency_hz, receptance
    return {
        "receptance": R, "mobility": s * R, "accelerance": s**2 * R, "dynamic_stiffness": 1.0 / R,
        "mechanical_impedance": 1.0 / (s * R), "apparent_mass": 1.0 / (s**2 * R),
    }[quantity]  # fmt: skip


def plant_data(levels=5, frequencies=12, quantity="receptance", size=0.02):
    drive = np.repeat(np.geomspace(0.02, 5.0, levels), frequencies)
    frequency = np.tile(np.geomspace(0.03, 3.0, frequencies), levels)
    R = of_quantity(response(PLANT, frequency, drive).receptance, frequency, quantity)
    R *= np.exp(noise(drive.size, size))
    return FrequencyResponse(frequency, R, drive=drive, controlled="force", quantity=quantity)


def assert_same(found, expected):
    """The same optimum to 1e-7 of each value or, near zero, of its error; the same covariance."""
    assert found.status is expected.status
    assert found.method == "ipopt"
    spread = np.sqrt(np.diagonal(expected.covariance))
    size = np.where(expected.problem.value_slopes(expected.theta) == 1.0, np.abs(expected.theta), 1)
    assert np.all(np.abs(found.theta - expected.theta) <= 1e-7 * np.maximum(size, spread))
    assert found.cost == pytest.approx(expected.cost, rel=1e-9, abs=1e-20)
    assert found.scale == pytest.approx(expected.scale, rel=1e-9, abs=1e-11)
    if expected.scale > 1e-9:  # else there is rounding alone to estimate it from
        difference = np.abs(found.covariance - expected.covariance)
        assert np.all(difference <= 1e-5 * np.outer(spread, spread))


CASES: dict[str, Callable[[], AnyProblem]] = {
    "relative": lambda: TableProblem(friction_data(), Dahl()),
    "absolute": lambda: TableProblem(friction_data(), Dahl(), noise="absolute"),
    "measured": lambda: TableProblem(friction_data(covariance=KNOWN), Dahl()),
    "few degrees of freedom": lambda: TableProblem(
        friction_data(covariance=KNOWN, dof=5.0), Dahl()
    ),
    "error of the amplitude": lambda: TableProblem(
        friction_data(
            covariance=KNOWN, dof=9.0, amplitude_std=0.03 * AMPLITUDE,
            amplitude_covariance=np.outer(AMPLITUDE / (1.0 + 300.0 * AMPLITUDE), [-4e-3, -2e-3]),
        ),
        Dahl(),
    ),
    "alpha free": lambda: TableProblem(friction_data(), Dahl(alpha=None)),
    "alpha fixed": lambda: TableProblem(friction_data(Dahl(0.1, 30.0, 2.0)), Dahl(alpha=2.0)),
    "two elements": lambda: TableProblem(
        friction_data(Dahl(0.1, 30.0) + Dahl(0.01, 300.0, name="fine")),
        Dahl(name="coarse") + Dahl(name="fine"),
    ),
    "sensors": lambda: TableProblem(
        friction_data(),
        Dahl(),
        sensors=Sensors(
            force_gain=stats.norm(1.01, 0.01), displacement_gain=stats.norm(0.99, 0.02), delay=None
        ),
    ),
    "known linear system": lambda: TableProblem(
        friction_data(FRICTION + Spring(2.0)),
        Dahl() + LinearSystem(control.tf([1.0], [2.0]), quantity="receptance"),
    ),
    "plant": lambda: TableProblem(plant_data(), UNKNOWN_PLANT),
    "plant, mass known": lambda: TableProblem(
        plant_data(quantity="accelerance"),
        Dahl() + Mass(0.3) + Damper() + Spring(),
        sensors=Sensors(delay=None),
    ),
    "plant, any exponent": lambda: TableProblem(
        plant_data(levels=4, frequencies=6), Dahl(alpha=None) + Mass() + Damper() + Spring()
    ),
    "plant in other units": lambda: TableProblem(
        driven(1e3 * plant_data().frequency_hz, 1e-9 * plant_data().response,
               1e6 * plant_data().drive),
        UNKNOWN_PLANT,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
@pytest.mark.versions
def test_same_optimum_as_least_squares(case):
    problem = CASES[case]()
    assert_same(solve_ipopt(problem), solve(problem))


SOFT = BoucWen(30.0, 300.0, 150.0) + Mass(0.3) + Damper(0.5) + Spring(3.0)
UNKNOWN_SOFT = BoucWen(q=300.0, p=150.0) + Mass(0.3) + Damper() + Spring(3.0)


def exact_data(plant):
    drive = np.repeat([0.04, 0.2, 1.0], 5)
    frequency = np.tile(np.geomspace(0.3, 2.0, 5), 3)
    R = any_response(plant, frequency, drive, steady="exact").receptance
    return driven(frequency, R * np.exp(noise(15, 0.005)), drive)


@pytest.mark.parametrize(
    ("plant", "unknown"),
    [(PLANT, UNKNOWN_PLANT), pytest.param(SOFT, UNKNOWN_SOFT, marks=pytest.mark.long)],
    ids=["Dahl", "BoucWen"],
)
def test_exact_steady_motion(plant, unknown):
    """The same optimum as least squares, and on a constraint that of one parameter fewer."""
    problem = AnyProblem(exact_data(plant), unknown)
    assert problem.is_exact
    free = solve_ipopt(problem)
    expected = solve(problem)
    spread = np.sqrt(np.diagonal(expected.covariance))
    assert free.status is expected.status is Status.CONVERGED
    assert np.all(np.abs(free.theta - expected.theta) < 1e-4 * spread)
    held = solve_ipopt(problem, constraints=lambda p: [p["damping"] ** 2 == 0.09])
    fixed = solve(AnyProblem(problem.data, unknown, fixed={"damping": 0.3}))
    assert held.values[problem.names.index("damping")] == pytest.approx(0.3, rel=1e-9)
    assert held.cost == pytest.approx(fixed.cost, rel=1e-6)


@pytest.mark.parametrize("loss", ["huber", "student_t"])
def test_robust_losses(loss):
    data = friction_data(covariance=KNOWN)
    spoiled = data.response * np.where(np.arange(data.n) == 7, 1.3, 1.0)
    problem = TableProblem(replace(data, response=spoiled), Dahl())
    assert_same(solve_ipopt(problem, loss=loss), solve(problem, loss=loss))


def test_bound():
    bound = {"f_max": Parameter("f_max", "N", "", lower=0.12)}
    problem = TableProblem(friction_data(), (Dahl() + Spring(1e-3)).with_parameters(bound))
    found = solve_ipopt(problem)
    assert found.status is Status.AT_BOUND
    assert found.values == pytest.approx(solve(problem).values, rel=1e-6)


@pytest.mark.versions
def test_equality_is_the_estimate_of_the_ratio_fixed():
    problem = TableProblem(friction_data(), Dahl())
    found = solve_ipopt(problem, constraints=lambda p: [p["sigma"] == 250 * p["f_max"]])

    def cost(ln_f_max):
        theta = np.array([ln_f_max, ln_f_max + np.log(250.0)])
        return float(np.sum(problem.residuals(theta) ** 2))

    expected = optimize.minimize_scalar(cost, bracket=(-2.5, -2.0), tol=1e-12)
    assert found.success
    assert found.theta[0] == pytest.approx(expected.x, abs=1e-7)
    assert found.dof == 2 * AMPLITUDE.size - 1
    assert found.scale == pytest.approx(np.sqrt(expected.fun / found.dof), rel=1e-9)
    along = problem.residuals_and_jacobian(found.theta)[1] @ np.ones(2)
    variance = found.scale**2 / (along @ along)
    assert found.covariance == pytest.approx(np.full((2, 2), variance), rel=1e-6)


def test_equality_can_make_an_undetermined_parameter_known():
    problem = TableProblem(friction_data(), Dahl() + Spring(name="own") + Spring(name="other"))
    alone = solve_ipopt(problem)
    assert alone.status is Status.SINGULAR
    by = "own_stiffness", "other_stiffness"
    tied = solve_ipopt(problem, constraints=lambda p: [p[by[0]] == 3 * p[by[1]]])
    assert tied.status is Status.CONVERGED
    assert np.isfinite(tied.covariance).all()
    single = solve(TableProblem(friction_data(), Dahl() + Spring()))
    assert tied.values[2] + tied.values[3] == pytest.approx(single.values[2], abs=1e-6)
    assert tied.values[2] == pytest.approx(3.0 * tied.values[3], rel=1e-9)


def test_inequality_binds_only_where_it_has_to():
    problem = TableProblem(friction_data(), Dahl())
    free = solve(problem)
    loose = solve_ipopt(problem, constraints=lambda p: [p["sigma"] >= 250 * p["f_max"]])
    assert loose.status is Status.CONVERGED
    assert loose.values == pytest.approx(free.values, rel=1e-7)
    tight = solve_ipopt(problem, constraints=lambda p: [p["sigma"] <= 250 * p["f_max"]])
    equal = solve_ipopt(problem, constraints=lambda p: [p["sigma"] == 250 * p["f_max"]])
    assert tight.status is Status.AT_BOUND
    assert "Converged on the constraint sigma<=(250*f_max)" in tight.message
    assert tight.values == pytest.approx(equal.values, rel=1e-6)


def test_a_calibration_does_not_hide_that_a_constraint_binds():
    plain, calibrated = (
        any_fit(friction_data(), Dahl(alpha=1.0), method="ipopt", sensors=sensors,
                constraints=lambda p: [p["sigma"] >= 310 * p["f_max"]])
        for sensors in (None, Sensors(force_gain=stats.norm(1.0, 0.01)))
    )  # fmt: skip
    assert calibrated.optimum.status is Status.AT_BOUND
    assert calibrated.status is plain.status
    chances = [fit.optimum.constraint_cost.p_value for fit in (plain, calibrated)]
    assert chances[1] == pytest.approx(chances[0], rel=1e-3)


def test_constraint_holds_a_plant_together():
    problem = TableProblem(plant_data(4, 6), UNKNOWN_PLANT)

    def ratio(p):
        return [p["damping"] ** 2 == 0.36 * p["mass"] * p["stiffness"]]

    found = solve_ipopt(problem, constraints=ratio)
    _, _, mass, damping, stiffness = found.values
    assert found.success
    assert damping**2 == pytest.approx(0.36 * mass * stiffness, rel=1e-8)

    def tied(x):
        m, k = np.exp(x[2:])
        return np.asarray(problem.residuals(np.array([x[0], x[1], m, 0.6 * np.sqrt(m * k), k])))

    begin = np.log(found.values[[0, 1, 2, 4]]) + 0.05
    expected = optimize.least_squares(tied, begin, xtol=1e-14, ftol=1e-14)
    assert found.cost == pytest.approx(expected.cost, rel=1e-10)


def test_constraint_makes_an_optimum_at_infinity_finite():
    """Microslip with a free spring: sigma and f_max run away together until f_max is held."""
    small = np.geomspace(1e-6, 1e-4, 16)
    N = FRICTION.describing_function(small) * (1.0 + noise(16, 3e-4, seed=4))
    problem = TableProblem(FrequencyResponse(np.ones(16), N, small), Dahl() + Spring())
    alone = solve(problem)
    assert alone.status is Status.MICROSLIP
    assert solve_ipopt(problem).status is Status.MICROSLIP
    held = solve_ipopt(problem, constraints=lambda p: [p["f_max"] == 0.2])
    expected = solve(TableProblem(problem.data, Dahl(f_max=0.2) + Spring()))
    assert held.values[1:] == pytest.approx(expected.values, rel=1e-6)
    assert held.cost == pytest.approx(expected.cost, rel=1e-9)


def test_noise_of_the_drive():
    """Against the joint least squares over parameters and true drives."""
    n, s, own = 24, 0.03, 0.02
    exact = plant_data(4, 6, size=0.0)
    force_error = noise(n, s, seed=8)
    drive = exact.drive * np.exp(force_error.real)
    R = exact.response * np.exp(noise(n, own, seed=9) - force_error)
    C = stated(R, np.hypot(own, s))
    cross = -(s**2) * (R * drive)
    shared = np.stack([cross.real, cross.imag], axis=1)

    def table(true_drive):
        return driven(exact.frequency_hz, R, true_drive, np.hypot(own, s))

    problem = TableProblem(table(drive), UNKNOWN_PLANT)
    found = solve_ipopt(problem, drive_std=s * drive, drive_covariance=shared)
    joint = np.empty((n, 3, 3))
    joint[:, 0, 0], joint[:, 1:, 1:] = s**2, C
    joint[:, 0, 1:] = joint[:, 1:, 0] = shared / drive[:, None]
    whiten = np.linalg.inv(np.linalg.cholesky(joint))

    def residuals(x):
        r = R - TableProblem(table(drive * np.exp(-x[5:])), UNKNOWN_PLANT).predict(x[:5])
        together = np.stack([x[5:], r.real, r.imag], axis=1)
        return np.asarray(np.einsum("nij,nj->ni", whiten, together)).ravel()

    expected = optimize.least_squares(
        residuals, np.concatenate((found.theta + 0.01, np.zeros(n))), x_scale="jac",
        jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15,
    )  # fmt: skip
    assert found.success
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    spread = np.sqrt(np.diagonal(found.covariance))
    assert np.all(np.abs(found.theta - expected.x[:5]) < 1e-5 * spread)
    jacobian = np.asarray(expected.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian)[:5, :5]
    assert np.all(np.abs(found.covariance - covariance) < 1e-5 * np.outer(spread, spread))
    exact_drive = solve_ipopt(problem)
    assert exact_drive.cost > 1.5 * found.cost


@pytest.mark.parametrize(
    ("constraints", "error", "message"),
    [
        (lambda p: [p["sgma"] <= 1], ModelError, "names 'sgma'; the parameters are f_max, sigma"),
        (lambda p: [p["sigma"] / 2], ValidationError, r"constraints\[0\] is .*expected a compar"),
        (lambda p: [p["alpha"] <= 2], ValidationError, r"\(alpha<=2\), holds no free parameter"),
        (lambda p: [1 <= p["sigma"] <= 2], ValidationError, "chains comparisons"),
        (lambda p: [p["sigma"] <= 1, p["sigma"] >= 2], FitError,
         "no parameters satisfy the constraints sigma<=1; 2<=sigma"),
        (lambda p: p["sigma"] == 300.0 * p["f_max"], ValidationError,
         "expected a list of comparisons: lambda p"),
        (dict.clear, ValidationError, "constraints returned None; expected a list of comparisons"),
        ("sigma <= 1", ValidationError, "constraints is 'sigma <= 1'; expected a function: lamb"),
    ],
)  # fmt: skip
def test_bad_constraints(constraints, error, message):
    problem = TableProblem(friction_data(), Dahl())
    with pytest.raises(error, match=message):
        solve_ipopt(problem, constraints=constraints)


def test_no_constraints_in_the_list():
    problem = TableProblem(friction_data(), Dahl())
    assert_same(solve_ipopt(problem, constraints=lambda _: []), solve(problem))


def test_misplaced_errors_of_the_drive():
    with pytest.raises(ValidationError, match="no row is force-controlled"):
        solve_ipopt(TableProblem(friction_data(), Dahl()), drive_std=0.1)
    with pytest.raises(ValidationError, match="relative noise and linear loss"):
        solve_ipopt(TableProblem(plant_data(3, 4), UNKNOWN_PLANT), drive_std=0.1)
    plant = plant_data(3, 4)
    known = replace(plant, covariance=stated(plant.response, 0.01))
    with pytest.raises(ValidationError, match=r"drive_std: expected shape \(12,\), .*got \(3,\)"):
        solve_ipopt(TableProblem(known, UNKNOWN_PLANT), drive_std=[0.1, 0.2, 0.3])
    with pytest.raises(ValidationError, match="without drive_std"):
        solve_ipopt(TableProblem(plant, UNKNOWN_PLANT), drive_covariance=np.zeros((12, 2)))


def test_plant_with_several_amplitudes_stays_on_the_one_measured():
    plant = FRICTION + Mass(0.3) + Damper(-0.4) + Spring(20.0)
    frequency, drive = np.tile(np.linspace(0.3, 2.6, 13), 2), np.repeat([0.05, 0.1], 13)
    every = response(plant, frequency, drive, all_roots=True)
    assert every.number_of_solutions.max() == 3
    largest = (np.arange(frequency.size), every.number_of_solutions - 1)
    R = every.receptance[largest] * np.exp(noise(frequency.size, 0.01))
    data = driven(frequency, R, drive, amplitude=every.amplitude[largest])
    problem = TableProblem(data, UNKNOWN_PLANT)
    assert_same(solve_ipopt(problem), solve(problem))


def test_search_that_runs_out_of_steps_says_so(monkeypatch):
    monkeypatch.setattr(ipopt, "_ITERATIONS", 1)
    problem = TableProblem(friction_data(), Dahl())
    found = solve_ipopt(problem, constraints=lambda p: [p["sigma"] <= 250 * p["f_max"]])
    assert found.status is Status.NOT_CONVERGED
    assert "IPOPT says: it reached the maximum number of iterations." in found.message


@pytest.mark.versions
def test_nothing_is_printed(capfd):
    solve_ipopt(TableProblem(friction_data(), Dahl()), constraints=lambda p: [p["sigma"] <= 29])
    assert capfd.readouterr() == ("", "")


@pytest.mark.long
def test_noise_of_the_drive_is_judged_as_it_was_fitted():
    """Residuals, intervals and errors of an exact model count what its drive is off by."""
    exact = plant_data(3, 4, size=0.0)
    drive = exact.drive * np.exp(noise(12, 0.05, seed=8).real)
    R = exact.response * np.exp(noise(12, 0.02, seed=9))
    data = driven(exact.frequency_hz, R, drive, 0.02)
    plant = Dahl(alpha=1.0) + Mass() + Damper() + Spring()
    result = fit(data, plant, method="ipopt", drive_std=0.05 * drive, throw=False)
    # of the estimate, a third of a standard error from the optimum at most
    squares = float(result.residual @ result.residual)
    assert 0.0 <= squares - 2.0 * result.optimum.cost < 0.1
    assert result.chisqr == pytest.approx(squares, abs=0.1)
    assert result.status.usable
    assert result.errors is not None
    interval = result.conf_interval("profile", 0.9545)
    assert interval.method == "profile"
    assert interval.lower[0][2] < 0.3 < interval.upper[0][2]
    again = FitResult.from_json(result.to_json())
    assert again.data.drive_std == pytest.approx(0.05 * drive)
    assert again.chisqr == pytest.approx(result.chisqr)
    assert "drive_std [N]" in again.data.to_frame().columns


@pytest.mark.parametrize("kind", ["table", "record"])
def test_a_robust_loss_does_not_hide_a_contradicted_constraint(kind):
    rng = np.random.default_rng(3)
    t = np.arange(600) / 100.0
    x = 4e-3 * np.sin(2.0 * np.pi * 0.9 * t) * t / 6.0
    force = Dahl(0.1, 30.0).force(x) + 5e-4 * rng.standard_normal(t.size)
    data = friction_data() if kind == "table" else Record(t, displacement=x, force=force)
    for ratio, status in ((1.0, "trusted"), (1.1, "not described")):

        def tied(p: Any, ratio: float = ratio) -> list[Any]:
            return [p["sigma"] == 300.0 * ratio * p["f_max"]]

        found = any_fit(data, LINEAR, method="ipopt", loss="huber", throw=False, constraints=tied)
        assert str(found.status) == status, found.verdict


def test_an_exponent_that_was_not_given_is_estimated_with_constraints():
    """Held at 1, it would put f_max 9 % off."""
    data = friction_data(Dahl(f_max=0.1, sigma=30.0, alpha=1.4), size=0.005)
    found = fit(data, Dahl(), method="ipopt", constraints=lambda p: [p["f_max"] >= 0.01])
    assert_near(found, (("f_max", 0.1), ("sigma", 30.0), ("alpha", 1.4)), 3.0)
    assert found.params["alpha"].stderr < 0.05
    held = fit(data, Dahl(), fixed={"alpha": 1.4}, method="ipopt", constraints=lambda _: [])
    assert held.params["alpha"].stderr is None


@pytest.mark.parametrize("known", [True, False])
def test_a_constraint_that_the_data_contradict_is_said_so(known):
    data = friction_data(covariance=KNOWN if known else None)

    def tied(ratio):
        def constraints(p):
            return [p["sigma"] == ratio * p["f_max"]]

        return fit(data, LINEAR, method="ipopt", constraints=constraints)

    free = fit(data, LINEAR)
    right, wrong = tied(300.0), tied(330.0)
    assert "contradict" not in right.verdict
    assert "the constraint sigma==(300*f_max)" in right.verdict
    assert str(wrong.status) == "not described"
    assert "The data contradict the constraint sigma==(330*f_max)" in wrong.verdict
    assert "consistent with noise" not in wrong.verdict
    if known:
        residuals = wrong.optimum.residuals
        value = wrong.goodness.of("chi-square")[0].values["value"]
        assert value == pytest.approx(residuals @ residuals, rel=1e-6)
    cost = wrong.optimum.constraint_cost
    rise = 2.0 * (wrong.optimum.cost - free.optimum.cost) / free.optimum.scale**2
    assert cost.rise == pytest.approx(rise, rel=1e-6)
    expected = stats.chi2(1) if known else stats.f(1, free.optimum.dof)
    assert cost.p_value == pytest.approx(float(expected.sf(rise)), rel=1e-6, abs=1e-300)
    refused: tuple[Any, ...] = ("profile", "bootstrap")
    for method in refused:
        with pytest.raises(ValidationError, match=f"method is '{method}', but the fit had constr"):
            wrong.conf_interval(method)
    assert wrong.conf_interval().method == "wald"
    assert FitResult.from_json(wrong.to_json()).verdict == wrong.verdict

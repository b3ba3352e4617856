"""Plans of measurements: optimal, as good as they say, and within every limit."""

import itertools
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dahl_ident as di
from benchmarks import planning
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics import bands, error_sources
from dahl_ident.errors import ValidationError
from dahl_ident.fitting import solve_many
from dahl_ident.planning import forecast
from dahl_ident.planning.candidates import LEAST_CYCLES, BenchTime
from dahl_ident.planning.design import (
    Exchange,
    Objective,
    Term,
    continuous_design,
    packed_information,
)
from dahl_ident.problem import ProblemBatch, TableProblem
from tests.derivatives import central_differences

F_MAX, SIGMA = 0.1, 30.0
X_C = F_MAX / SIGMA
TRUTH = {"f_max": F_MAX, "sigma": SIGMA}
LINEAR = di.Model(di.Dahl(alpha=1.0))
NEAR = {"f_max": (0.099, 0.101), "sigma": (29.7, 30.3)}
KNEE = {"displacement": (0.1 * X_C, 10.0 * X_C), "frequency_hz": 5.0}


def planned(model=LINEAR, time=None, *, limits=KNEE, **changes):
    """Return a plan about the knee of friction known within 1 %, with 1 % of noise."""
    limits = limits if time is None else {**limits, "time": time}
    return di.plan(model, **{"ranges": NEAR, "noise": 0.01, "limits": limits, **changes})


def _objective(seed, K, P, *, targets=0, scatter=0.0, draws=3):
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((draws, K, 2, P)) * rng.lognormal(0.0, 1.0, (1, K, 1, 1))
    offsets = np.broadcast_to(np.eye(2), (draws, K, 2, 2))
    known = np.broadcast_to(1e-9 * np.eye(P), (draws, P, P))
    wanted = rng.standard_normal((draws, P, targets)) if targets else None
    packed = packed_information(rows, offsets, scatter)
    return Objective((Term(packed, known, scatter, wanted),))


def _bench(seed, K):
    rng = np.random.default_rng(seed)
    return BenchTime(
        rng.uniform(1.0, 4.0, K), rng.uniform(0.05, 0.7, K), rng.uniform(0.1, 1.0, K), 0.5, 0.01
    )


class TestContinuousDesign:
    @pytest.mark.parametrize("P", [2, 3, 4])
    def test_the_derivative_of_ln_det_never_exceeds_the_number_of_parameters(self, P):
        objective, time = _objective(P, 200, P, draws=1), 7.0
        f = np.random.default_rng(P).uniform(1.0, 5.0, 200)
        design = continuous_design(objective, f, time, tolerance=1e-3, iterations=4000)
        term = objective.terms[0]
        # by the matrices themselves, not by the derivative that the search used
        packed = term.packed.reshape(200, P, P)
        M = np.einsum("k,kij->ij", design.seconds * f, packed)
        rate = np.einsum("ij,kji->k", np.linalg.inv(M), packed) * f * time
        assert rate.max() <= P * 1.0011
        assert np.all(rate[design.seconds > 0.05 * time] > 0.98 * P)
        assert design.seconds.sum() == pytest.approx(time)

    @pytest.mark.parametrize(("targets", "scatter"), [(0, 0.3), (1, 0.0), (1, 0.3), (3, 0.3)])
    def test_no_other_design_is_better(self, targets, scatter):
        objective = _objective(5, 40, 3, targets=targets, scatter=scatter)
        f, rng = np.ones(40), np.random.default_rng(0)
        design = continuous_design(objective, f, 10.0, tolerance=1e-3, iterations=8000)
        assert design.excess < 1e-2
        for _ in range(200):
            other = design.seconds * rng.lognormal(0.0, 0.5, 40) + rng.exponential(0.02, 40)
            assert objective.at(other * (10.0 / other.sum()))[0] <= design.value + 1e-4

    @pytest.mark.parametrize(
        "change",
        [
            {},
            {"starts": np.array([0, 1])},
            {"targets": None},
            {"targets": None, "departures": 1},
            {"between": np.diag([0.3, 0.0, 0.1])},
        ],
    )
    def test_the_gradient_is_that_of_the_value(self, change):
        objective = _objective(3, 6, 3, targets=3, scatter=0.2)
        objective = replace(objective, terms=(replace(objective.terms[0], **change),))
        cycles = np.random.default_rng(1).uniform(1.0, 9.0, 6)
        gradient = objective.gradient(objective.at(cycles)[1])
        slopes = central_differences(lambda moved: objective.at(moved)[0], cycles, 1e-5)
        assert gradient == pytest.approx(slopes, rel=1e-5)


class TestModelError:
    def _fit(self):
        """Return a fit of Dahl friction to one with another exponent: 5 % of model error."""
        A = np.geomspace(0.2, 5.0, 12) * X_C
        exact = di.Dahl(F_MAX, SIGMA, alpha=1.6).describing_function(A)
        noise = np.random.default_rng(5).standard_normal((2, 12))
        return di.fit(FrequencyResponse(np.ones(12), exact * np.exp(0.002 * noise.T @ [1, 1j]), A),
                      LINEAR)  # fmt: skip

    def test_departures_predict_what_kriging_does(self, monkeypatch):
        monkeypatch.setattr(bands, "_NEGLIGIBLE_SHAPES", 1e-9)
        monkeypatch.setattr(error_sources, "_SMOOTH", 1e-9)
        errors = self._fit().errors
        A, omega = np.geomspace(0.3, 4.0, 4) * X_C, np.full(4, 2.0 * np.pi)
        there = TableProblem(FrequencyResponse(omega / (2.0 * np.pi), np.ones(4), A), LINEAR)
        R = there.predict(errors.theta)
        slopes = there.prediction_jacobian(errors.theta) / R[:, None]
        found = bands.departures(errors, slopes, A, omega, R)
        assert not found.assumed
        lever = np.concatenate([np.stack([slopes.real, slopes.imag], 1), found.columns], axis=-1)
        covariance = lever @ np.linalg.inv(found.information) @ lever.swapaxes(1, 2)
        expected = bands.prediction_error(errors, slopes, A, omega, R, of_a_test=False).covariance
        # shapes of one process, cut off at different places
        assert np.trace(covariance, axis1=1, axis2=2) == pytest.approx(
            np.trace(expected, axis1=1, axis2=2), rel=0.02
        )
        own = np.linalg.inv(found.information)[:2, :2]
        # a plan weighs by all errors, a fit by noise and misfit
        assert own == pytest.approx(errors.state.K[:2, :2], rel=0.02)

    def test_levels_are_spread_by_the_model_error(self):
        fit = self._fit()
        plan = di.plan(fit, limits={**KNEE, "time": 60}, target="response", candidates=25)
        alone = planned(time=60, noise=0.002, candidates=25)
        assert len(plan.steps) > len(alone.steps) + 1
        assert "the model errs as the earlier data show" in str(plan)
        told = plan.expected["f_max"]
        weighed = float(fit.errors.state.K[0, 0]) ** 0.5
        # the fit cuts the shapes off by its own rows
        assert told.before == pytest.approx(weighed, rel=0.15)
        assert told.after > 2.0 * alone.expected["f_max"].after

    def test_time_that_does_not_help_is_not_spent(self):
        plan = planned(scatter=0.02, runs=1, target={"f_max": 0.01}, draws=20, candidates=30)
        assert not plan.reached
        assert plan.seconds < 200.0


class TestLevelsWithFixedCosts:
    @pytest.mark.parametrize("seed", range(8))
    def test_exchange_finds_what_brute_force_finds(self, seed):
        objective, bench, time = _objective(seed, 5, 2), _bench(seed, 5), 16.0
        found = Exchange(objective, bench, np.arange(5)).best(time)
        assert bench.seconds(found.levels, found.cycles) <= time + 1e-9
        best = _brute_force(objective, bench, time, most=3)
        assert found.value >= best - 0.01

    def test_settling_follows_the_transient(self):
        beta = 0.1
        bench = BenchTime(np.ones(1), np.array([np.exp(-4.0 * beta)]), np.ones(1), 0.0, 0.01)
        (cycles,) = bench.settling_cycles([0])
        # Dahl's force along cycles of a sine at beta, a step at a time, from two starts
        path = np.diff(beta * np.sin(np.linspace(0.0, 2.0 * np.pi, 2001)))

        def after(count, force):
            for dx in np.tile(path, count):
                force = np.sign(dx) + (force - np.sign(dx)) * np.exp(-abs(dx))
            return float(force)

        settled, tip = after(60, 0.0), np.tanh(beta)
        left = [abs(after(int(cycles) - k, settled + tip) - settled) / tip for k in (0, 1)]
        assert left[0] <= 0.01 < left[1]


def _brute_force(objective, bench, time, most):
    """Return the best criterion over all sets of levels and whole cycles that use the time."""
    best = -np.inf
    for size in range(1, most + 1):
        for levels in itertools.combinations(range(len(objective.terms[0].packed)), size):
            ordered = bench.order(levels)
            f, room = bench.frequency_hz[ordered], time - bench.fixed(ordered)
            sub = objective.only(ordered)
            ranges = [range(LEAST_CYCLES, max(int(room * x), 1) + 1) for x in f[:-1]]
            designs = []
            for some in itertools.product(*ranges):
                left = room - float((np.array(some) / f[:-1]).sum())
                last = int(np.floor(left * f[-1] + 1e-9))
                if last >= LEAST_CYCLES:
                    designs.append([*some, last])
            if designs:
                best = max(best, float(sub.at(np.array(designs, dtype=float))[0].max()))
    return best


class TestPlan:
    def test_prediction_is_the_covariance_of_the_fit(self):
        plan = planned(time=30, noise=0.02)
        errors = _errors(plan, LINEAR.with_values(TRUTH), 0.02, 200)
        achieved = errors.std(axis=0)
        predicted = [plan.expected[name].after for name in ("f_max", "sigma")]
        # 200 fits give a standard deviation within 5 %: three of these
        assert achieved == pytest.approx(predicted, rel=0.15)

    def test_it_beats_a_logarithmic_grid(self):
        plan = planned(time=25, noise=0.02, target="f_max")
        even = plan.search.expected_after(25.0, grid=True)
        assert even["f_max"].after > 1.5 * plan.expected["f_max"].after

    @pytest.mark.parametrize("model", [LINEAR, pytest.param(di.Dahl(), marks=pytest.mark.long)])
    def test_data_of_the_shortest_plan_can_be_used(self, model):
        """One level would be enough for the friction force, were it certain that it slips."""
        limits = {"displacement": (1e-4, 10.0 * X_C), "frequency_hz": 5.0}
        ranges, target = {"f_max": (0.05, 0.2), "sigma": (15.0, 60.0)}, {"f_max": 0.02}
        plan = di.plan(model, ranges=ranges, limits=limits, noise=0.01, target=target)
        assert plan.reached
        usable = [
            di.fit(_measured(plan, 0.01, seed), model).status.value in ("trusted", "approximate")
            for seed in range(30)
        ]
        assert sum(usable) >= 29
        short = di.plan(model, ranges=ranges, noise=0.01, target=target,
                        limits={**limits, "time": 0.5 * plan.seconds})  # fmt: skip
        assert not short.reached
        assert "too few to tell a wrong model from noise" in str(short)

    @pytest.mark.parametrize("known", [False, pytest.param(True, marks=pytest.mark.long)])
    def test_its_data_alone_can_be_used(self, known):
        """One amplitude, or two levels without a covariance, cannot show a wrong model."""
        limits = {"displacement": (1e-4, 9.0 * X_C), "frequency_hz": 5.0}
        plan = planned(time=60.0, limits=limits, target="f_max", draws=20)
        usable = [
            di.fit(_measured(plan, 0.01, seed, known=known), LINEAR).status.value
            in ("trusted", "approximate")
            for seed in range(20)
        ]
        assert sum(usable) >= 19

    def test_levels_do_not_lean_on_ranges(self):
        """In gross slip two close levels would do for the spring if stiffness were known."""
        plan = di.plan(
            LINEAR + di.Spring(), ranges={**NEAR, "stiffness": (29.7, 30.3)}, noise=0.01, draws=20,
            limits={"displacement": (100.0 * X_C, 1000.0 * X_C), "frequency_hz": 1, "time": 120},
            target="stiffness", candidates=60,
        )  # fmt: skip
        levels = np.array([step.level for step in plan.steps]) / X_C
        assert (levels.min(), levels.max()) == pytest.approx((100.0, 1000.0), rel=0.2)
        # 118 cycles of 1 % at one level, everything else known: 0.092 %
        assert 0.00092 < plan.expected["stiffness"].after < 0.0012

    def test_information_that_cancels_is_no_error(self):
        found = forecast.covariance_of(np.array([[[1e20, 1e20], [1e20, 1e20]]]))
        assert np.all(np.isfinite(found))
        assert np.all(np.diagonal(found[0]) >= 0.0)

    def test_a_target_is_reached_in_the_least_time(self):
        target = {"f_max": 0.004, "f_max/sigma": 0.006}
        plan = planned(target=target, noise=0.02, draws=20)
        assert plan.reached
        assert all(plan.expected[name].after <= u for name, u in target.items())
        less = planned(time=0.93 * plan.seconds, target=target, noise=0.02, draws=20)
        assert not less.reached
        assert less.seconds <= 0.93 * plan.seconds

    def test_a_time_that_rounding_exceeds_still_counts(self):
        """Whole cycles fill the first time tried but for rounding; a tenth is enough."""
        limits = {"displacement": (1e-4, 1e-2), "frequency_hz": 5.0}
        ranges = {"f_max": (0.05, 0.2), "sigma": (15.0, 60.0)}
        wanted = {"f_max": 0.01, "sigma": 0.01}
        plan = di.plan(di.Dahl(), ranges=ranges, limits=limits, noise=0.01, target=wanted,
                       change_over=0.5)  # fmt: skip
        assert plan.reached
        assert plan.seconds < 5.0

    def test_a_plan_takes_at_most_a_month(self):
        plan = planned(noise=0.02, target={"f_max": 1e-9}, draws=10, candidates=20)
        assert not plan.reached
        assert plan.seconds == pytest.approx(30.0 * 86400.0, rel=1e-3)
        assert "no plan takes more than 30 days" in str(plan)

    def test_drives_that_friction_cannot_hold_are_left_out(self):
        plan = di.plan(
            LINEAR, ranges={"f_max": (0.05, 0.2), "sigma": (15.0, 60.0)}, controlled="force",
            noise=0.01, limits={"force": 1.0, "frequency_hz": 5.0, "time": 60.0}, candidates=60,
        )  # fmt: skip
        draws = plan.search.forecast.knowledge.values
        assert max(step.level for step in plan.steps) < draws[:, 0].min()

    def test_earlier_data_shorten_it(self):
        rng = np.random.default_rng(2)
        A = np.geomspace(0.01, 0.3, 12) * X_C
        clean = di.Dahl(F_MAX, SIGMA).describing_function(A)
        noise = np.exp(0.01 * rng.standard_normal((2, 12)).T @ [1.0, 1.0j])
        fit = di.fit(FrequencyResponse(np.ones(12), clean * noise, A), LINEAR)
        target = {"f_max": 0.005, "sigma": 0.005}
        after = di.plan(fit, limits=KNEE, target=target, noise=0.02)
        before = planned(target=target, noise=0.02)
        assert after.seconds < before.seconds
        assert after.expected["sigma"].before == pytest.approx(
            fit.errors.stderr["sigma"] / fit.errors.values["sigma"], rel=0.05
        )
        for name, stated in after.expected.items():
            assert stated.value == pytest.approx(fit.params[name].value, rel=1e-12)
        middle = np.sqrt(NEAR["sigma"][0] * NEAR["sigma"][1])
        assert before.expected["sigma"].value == pytest.approx(middle, rel=1e-12)
        # what is missing is f_max: the plan goes where it shows
        assert max(step.level for step in after.steps) > 2.0 * X_C

    def test_a_range_replaces_what_earlier_data_hardly_determine(self):
        A, stiff = np.array([5e-6, 1e-5, 2e-5]), di.Dahl(100.0, 3e3, alpha=1.0) + di.Damper(5e3)
        response = stiff.dynamic_stiffness(A, 2.0 * np.pi)
        covariance = (0.02 * np.abs(response))[:, None, None] ** 2 * np.eye(2)
        data = FrequencyResponse(np.ones(3), response, A, covariance=covariance)
        fit = di.fit(data, di.Dahl(alpha=1.0) + di.Damper(), throw=False)
        limits = {"frequency_hz": (0.1, 3.0), "time": 200.0, "displacement": (1e-5, 0.05)}
        with pytest.raises(ValidationError, match="does not determine f_max; give ranges="):
            di.plan(fit, limits=limits, draws=10)
        plan = di.plan(fit, limits=limits, draws=10, ranges={"f_max": (10.0, 1e3)})
        assert plan.expected["f_max"].after < 0.2
        assert ((plan.search.forecast.knowledge.values[:, 0] / 100.0) ** 2 < 200.0).all()

    @pytest.mark.parametrize("A", [[5e-3], [1e-3, 3e-3, 6e-3, 2e-2]])  # too few for errors, enough
    def test_ranges_and_earlier_data_are_combined_as_in_bayes_theorem(self, A):
        N = di.Dahl(F_MAX, SIGMA).describing_function(A)
        errors = 0.02 * np.array([0.4 + 0.9j, -0.9 - 0.3j, 0.5 - 0.6j, 0.3 + 0.8j])
        response = N * np.exp(errors[: len(A)])
        variance = (0.02 * np.abs(N)) ** 2
        covariance = variance[:, None, None] * np.eye(2)
        data = FrequencyResponse(np.ones(len(A)), response, A, covariance=covariance)
        fit = di.fit(data, LINEAR, throw=False)
        assert (fit.errors is None) == (len(A) == 1)
        ranges = {"f_max": (1.03 * F_MAX, 1.13 * F_MAX), "sigma": (0.84 * SIGMA, 0.94 * SIGMA)}
        plan = planned(fit, time=20, ranges=ranges, noise=None, draws=400, candidates=20)
        drawn = plan.search.forecast.knowledge.theta
        axes = [np.log(value) + np.linspace(-0.3, 0.3, 201) for value in (F_MAX, SIGMA)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        low, high = np.log(list(ranges.values())).T
        cost = np.sum(((points - 0.5 * (low + high)) / (high - low) * 2.0 * 1.96) ** 2, axis=1)
        f_max, sigma = np.exp(points.T)[..., None]
        predicted = sigma * di.Dahl(1.0, 1.0).describing_function(sigma * A / f_max)
        cost += np.sum(np.abs(predicted - response) ** 2 / variance, axis=1)
        weights = np.exp(0.5 * (cost.min() - cost))
        mean = np.average(points, axis=0, weights=weights)
        std = np.sqrt(np.average((points - mean) ** 2, axis=0, weights=weights))
        assert drawn.mean(axis=0) == pytest.approx(mean, abs=0.25 * std.min())
        assert drawn.std(axis=0) == pytest.approx(std, rel=0.15)

    def test_every_limit_is_kept_and_the_one_that_prevents_is_named(self):
        limits = {"displacement": (1e-4 * X_C, 1e-3 * X_C), "frequency_hz": (1, 5)}
        plan = planned(time=600, limits=limits)
        assert all(step.level <= 1.0001e-3 * X_C for step in plan.steps)
        (text,) = plan.undetermined
        assert text.startswith("f_max stays undetermined")
        assert "the limit of displacement prevents it" in text
        fast = planned(time=60, target="f_max", limits={**KNEE, "speed": 0.05, "force": 0.08})
        for step in fast.steps:
            assert 2.0 * np.pi * step.frequency_hz * step.level <= 0.0501
            N = abs(di.Dahl(F_MAX, SIGMA).describing_function(step.level))
            assert step.level * N <= 0.08 * 1.02

    def test_a_suspected_exponent_is_seen(self):
        plain = planned(time=60, target="f_max")
        careful = planned(time=60, target="f_max", suspects={"alpha": 0.02})
        assert _exponent_error(careful) <= 0.02 < _exponent_error(plain)
        assert careful.reached

    def test_an_assumed_exponent_counts_as_in_a_fit(self):
        plan = planned(di.Dahl(), time=60, noise=0.02)
        assert plan.expected["alpha"].before == pytest.approx(np.log(4.0) / np.sqrt(12.0))
        fit = di.fit(_measured(plan, 0.02, 1), di.Dahl())
        for name in ("f_max", "sigma"):
            found = fit.params[name]
            assert found.stderr / found.value == pytest.approx(plan.expected[name].after, rel=0.25)

    def test_a_suspected_lack_of_symmetry_needs_even_harmonics(self):
        plan = planned(time=60, larger=di.Dahl(asymmetry=0.05), suspects={"asymmetry": 0.02},
                       candidates=40, draws=20)  # fmt: skip
        assert plan.reached

    def test_parameters_of_either_sign_are_planned(self):
        ranges = {"sigma": (29.0, 31.0), "q": (200.0, 400.0), "p": (-100.0, 300.0)}
        plan = planned(di.BoucWen(), time=60, ranges=ranges, draws=20, candidates=40)
        assert all(e.after < 0.25 for e in plan.expected.values())

    def test_a_suspected_gap_is_seen(self):
        larger = di.Backlash(di.Dahl(alpha=1.0), gap=0.5 * X_C)
        plan = planned(time=60, draws=20, larger=larger, suspects={"gap": 0.02}, candidates=40)
        assert plan.reached
        assert sum(step.level > 0.25 * X_C for step in plan.steps) > 1

    def test_levels_within_a_gap_are_no_candidates(self):
        model = di.Backlash(di.Dahl(alpha=1.0))
        ranges = {**NEAR, "gap": (0.3 * X_C, 0.7 * X_C)}
        plan = di.plan(
            model, ranges=ranges, limits={**KNEE, "time": 60}, noise=0.01, candidates=40, draws=20
        )
        assert all(e.after < 0.5 for e in plan.expected.values())
        assert min(step.level for step in plan.steps) > 0.15 * X_C

    def test_scatter_asks_for_more_runs(self):
        one = planned(time=300, target="sigma")
        many = planned(time=300, target="sigma", scatter=0.02)
        assert (one.runs, many.runs > 3) == (1, True)
        assert many.expected["sigma"].scatter_share > 0.5
        assert many.seconds <= 300.0

    def test_friction_that_differs_from_day_to_day_is_measured_on_more_days(self):
        A = np.geomspace(0.1, 10.0, 12) * X_C
        days = [
            FrequencyResponse(
                np.ones(12),
                di.Dahl(f_max, SIGMA).describing_function(A)
                * np.exp(0.003 * np.random.default_rng(i).standard_normal((2, 12)).T @ [1, 1j]),
                A,
                run=[str(i)] * 12,
            )
            for i, f_max in enumerate((0.097, 0.1, 0.104))
        ]
        fit = di.fit(FrequencyResponse.concatenate(days), LINEAR)
        one = di.plan(fit, limits={**KNEE, "time": 600.0}, target="f_max", runs=1, draws=20)
        told = one.expected["f_max"]
        # the mean of four days instead of three
        assert told.after == pytest.approx(told.before * np.sqrt(3.0 / 4.0), rel=0.02)
        assert told.scatter_share > 0.9
        assert "% of f_max" in str(one)
        plan = di.plan(fit, limits=KNEE, target={"f_max": 0.7 * told.before}, draws=20)
        assert (plan.reached, plan.runs) == (True, 4)  # seven days: sqrt(3/7) = 0.65
        alike = di.plan(fit, limits=KNEE, target={"f_max": 0.7 * told.before}, draws=20, scatter=0)
        assert alike.runs == 1

    def test_the_limit_that_makes_a_plan_long_is_named(self):
        """In microslip a tenth of the amplitude takes a hundred times as long."""
        plan = di.plan(
            LINEAR, ranges=NEAR, noise=0.01, target={"f_max": 0.02}, draws=20,
            limits={"displacement": 6e-3 * X_C, "frequency_hz": 1.0},
        )  # fmt: skip
        assert plan.reached
        hours = re.match(r"1 level in \S+ s \((\S+) h\); meets the target", str(plan))[1]
        assert float(hours) == pytest.approx(plan.seconds / 3600.0, rel=0.05)
        share = re.search(r"limit of displacement costs time.* in 1/(\d+) of the", str(plan))[1]
        assert float(share) == pytest.approx(100.0, rel=0.2)

    def test_least_time_with_scatter_takes_as_few_runs_as_needed(self):
        # 2 % between runs leaves 1 % only with more than four
        plan = planned(time=3000, scatter=0.02, between_runs=60.0, target={"f_max": 0.01}, draws=10,
                       candidates=30)  # fmt: skip
        assert (plan.reached, plan.runs) == (True, 5)
        assert plan.seconds < 320.0

    def test_an_expanded_uncertainty_is_wanted_by_name(self):
        standard = planned(target={"f_max": 0.004}, noise=0.02, draws=20)
        expanded = planned(target={"U(f_max)": 0.008}, noise=0.02, draws=20)
        # k = 2.0000 at 95.45 % of a normal distribution
        assert expanded.steps == standard.steps
        told = expanded.expected
        assert told["U(f_max)"].after == pytest.approx(2.0 * told["f_max"].after, rel=1e-4)
        assert "U(...) expanded" in str(expanded)

    def test_few_runs_widen_an_expanded_uncertainty(self):
        plan = planned(time=600, noise=0.001, scatter=0.02, runs=4, target=["U(f_max)"], draws=20,
                       candidates=40)  # fmt: skip
        told = plan.expected
        # Student's t of three degrees of freedom: 3.31 at 95.45 %; scatter is nearly all
        assert told["U(f_max)"].after == pytest.approx(3.31 * told["f_max"].after, rel=0.02)

    def test_a_driven_plant_is_planned_by_its_drive(self):
        plant = LINEAR + di.Mass(0.3) + di.Damper(0.24) + di.Spring(0.3)
        plan = di.plan(
            plant, ranges=NEAR, controlled="force", noise=0.01, draws=20, candidates=50,
            limits={"force": (0.02, 2.0), "frequency_hz": (0.1, 3.0), "time": 400},
        )  # fmt: skip
        errors = _errors(plan, plant.with_values(TRUTH), 0.01, 40)
        predicted = [plan.expected[name].after for name in ("f_max", "sigma")]
        # of 40 tables the error of a standard deviation is 11 %
        assert errors.std(axis=0) == pytest.approx(predicted, rel=0.33)
        assert all(0.02 <= step.level <= 2.0 for step in plan.steps)

    def test_points_with_several_amplitudes_are_avoided(self):
        plant = LINEAR + di.Mass(0.3) + di.Damper(-0.24) + di.Spring(3.0)
        drive, f = np.geomspace(0.05, 1.0, 12), np.full(12, 0.5)
        known = plant.with_values(TRUTH)
        sine: Any = {"steady": "describing function"}
        count = di.response(known, f, drive, all_roots=True, **sine).number_of_solutions
        assert 0 < (count > 1).sum() < 12
        plan = di.plan(
            plant, ranges=NEAR, controlled="force", noise=0.01, draws=20, **sine,
            candidates=[*zip(drive.tolist(), f.tolist(), strict=True)],
            limits={"force": 1.0, "frequency_hz": 1.0, "time": 400},
        )  # fmt: skip
        single = drive[count == 1]
        assert all(np.isclose(single, step.level).any() for step in plan.steps)

    def test_the_waveform_holds_the_plan(self, tmp_path):
        plan = planned(time=20, noise=0.02)
        place = plan.write_waveform(tmp_path / "exciter.csv", 200.0)
        table = np.loadtxt(place, delimiter=",", skiprows=1)
        assert place.read_text().startswith("time [s],displacement [m],step,measured\n")
        assert table[-1, 0] == pytest.approx(plan.seconds, abs=0.01)
        for i, step in enumerate(plan.steps, start=1):
            part = table[(table[:, 2] == i) & (table[:, 3] == 1)]
            assert len(part) == pytest.approx(200.0 * step.measured_cycles / 5.0, abs=1)
            assert np.abs(part[:, 1]).max() == pytest.approx(step.level, rel=0.01)
        with pytest.raises(ValidationError, match="at least ten samples a cycle: 50"):
            plan.write_waveform(tmp_path / "coarse.csv", 10.0)

    def test_text_picture_and_data(self, tmp_path):
        plan = planned(time=20, noise=0.02, draws=10)
        assert f"{len(plan.steps)} levels in" in str(plan)
        assert plan.to_frame()["seconds"].sum() == pytest.approx(plan.seconds)
        assert list(plan.budget().index) == ["f_max", "sigma"]
        saved = json.loads(plan.save(tmp_path / "plan.json").read_text())
        assert saved["expected"]["f_max"]["before"] is None  # nothing is known before
        axis = plan.plot()
        assert len(axis.lines) == 4

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"ranges": {}}, "nothing is known about f_max, sigma; give ranges="),
            ({"limits": {"time": 3}}, r"limits\['frequency_hz'\] is missing"),
            ({"limits": KNEE}, "without a target uncertainty the time is needed"),
            ({"limits": {**KNEE, "time": 0.5}}, "the quickest level takes"),
            ({"limits": {**KNEE, "time": 9, "force": 1e-9}}, "force excludes"),
            ({"noise": None}, "the noise is unknown before any data"),
            ({"noise": {"relativ": 1}}, "noise has relativ; expected relative"),
            ({"target": {"mass": 0.1}}, "target names 'mass'; expected a product of powers, such"),
            ({"target": {"f_max+1": 0.1}}, "expected a parameter, or a product of powers"),
            ({"target": {"f_max": 2.0}}, "below 1: 0.02 is 2 %"),
            ({"suspects": {"gap": 0.1}}, "suspects names gap"),
            ({"ranges": {**NEAR, "c": (1, 2)}}, "ranges names c"),
        ],
    )
    def test_bad_input_says_what_to_do(self, options, message):
        with pytest.raises(ValidationError, match=message.replace("+", r"\+")):
            planned(di.Dahl(), **{"limits": {**KNEE, "time": 30}, "draws": 10, **options})


class TestProof:
    """Small versions of ``python -m benchmarks.planning``, which has the numbers at full size."""

    @pytest.mark.parametrize("index", [0, pytest.param(1, marks=pytest.mark.long)])
    def test_intervals_are_narrower_than_a_grid_makes_them(self, index):
        for row in planning.compare(planning.scenarios()[index], 150, 100 + index):
            # of 150 tables the error of a standard deviation is 5.8 %
            assert row.agreement == pytest.approx(1.0, abs=0.18)
            if row.aim == row.name:
                assert row.gain > planning.GAIN

    @pytest.mark.parametrize("off", [30.0, pytest.param(1.0 / 30.0, marks=pytest.mark.long)])
    def test_a_sequence_recovers_from_a_poor_guess(self, off):
        spent, oracle = planning.sequence(off, seed=0)
        assert spent <= planning.SEQUENCE * oracle

    @pytest.mark.long
    def test_whole_experiments_give_what_was_predicted(self):
        scenario = planning.scenarios()[1]
        plan = scenario.plan(50.0, None)
        got = planning.achieved(scenario, planning.Design.of(plan), 30, 0, whole=True)
        for name, error in got.items():
            # of 30 records the error of a standard deviation is 13 %
            assert error == pytest.approx(plan.expected[name].after, rel=0.4)


def _measured(plan, noise, seed, *, known=True):
    """Return a table measured as the plan says, with its covariance where that is known."""
    A = np.array([step.level for step in plan.steps])
    std = noise / np.sqrt([step.measured_cycles for step in plan.steps])
    pair = np.random.default_rng(seed).standard_normal((2, len(A)))
    response = di.Dahl(F_MAX, SIGMA, alpha=1.0).describing_function(A)
    response = response * np.exp(std * (pair.T @ [1.0, 1.0j]))
    covariance = (std * np.abs(response))[:, None, None] ** 2 * np.eye(2) if known else None
    return FrequencyResponse(np.full(len(A), 5.0), response, A, covariance=covariance)


def _errors(plan, truth, noise, count):
    """Return relative errors of f_max and sigma in fits to tables measured as the plan says."""
    rng = np.random.default_rng(3)
    steps = [step for step in plan.steps for _ in range(plan.runs)]
    level = np.array([step.level for step in steps])
    f = np.array([step.frequency_hz for step in steps])
    std = noise / np.sqrt([step.measured_cycles for step in steps])
    if plan.controlled == "force":
        exact = di.response(truth, f, level, steady="describing function").dynamic_stiffness
    else:
        exact = truth.dynamic_stiffness(level, 2.0 * np.pi * f)
    model = truth.with_free(["f_max", "sigma"])
    tables = []
    for _ in range(count):
        response = exact * np.exp(std * (rng.standard_normal((2, len(f))).T @ [1.0, 1.0j]))
        covariance = (std * np.abs(response))[:, None, None] ** 2 * np.eye(2)
        where: dict[str, Any] = {"drive" if plan.controlled == "force" else "amplitude": level}
        where |= {"covariance": covariance, "controlled": plan.controlled}
        tables.append(FrequencyResponse(f, response, **where))
    batch = ProblemBatch(tables, model, noise="measured")
    found = solve_many(batch).values
    own = [batch.names.index(name) for name in ("f_max", "sigma")]
    return np.asarray(found[:, own] / [F_MAX, SIGMA] - 1.0)


def _exponent_error(plan):
    """Return the standard uncertainty of ln alpha when the plan is fitted with it free."""
    A = np.array([step.level for step in plan.steps])
    std = 0.01 / np.sqrt([step.measured_cycles for step in plan.steps])
    slopes = central_differences(
        lambda ln: np.log(di.Dahl(*np.exp(ln)).describing_function(A)),
        np.log([F_MAX, SIGMA, 1.0]),
        1e-4,
    )
    J = np.hstack([slopes.real / std, slopes.imag / std]).T
    if np.linalg.matrix_rank(J, tol=1e-6 * np.abs(J).max()) < 3:
        return float("inf")
    return float(np.sqrt(np.linalg.inv(J.T @ J)[2, 2]))


def test_a_target_that_the_data_meet_already_is_said_to_be_met():
    fit = di.fit(di.load_dataset("noisy"), di.Dahl(alpha=1.0))
    limits = {"displacement": 0.03, "frequency_hz": 5.0}
    met, open_target = (str(di.plan(fit, limits=limits, target={"f_max": u})) for u in (0.02, 1e-3))
    assert "meets the target, which the data at hand meet already" in met
    assert "at hand" not in open_target

"""Where the uncertainty of a parameter comes from: variances, budget, coverage factor."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from dahl_ident import (
    BoucWen,
    Dahl,
    Damper,
    FrequencyResponse,
    Mass,
    Sensors,
    Spring,
    fit,
    load_dataset,
    posterior,
    response,
)
from dahl_ident.diagnostics import budget, error_model
from dahl_ident.diagnostics.error_sources import repeated_levels
from dahl_ident.diagnostics.mixed_model import MixedModel
from dahl_ident.errors import FitError
from tests.friction_tables import FRICTION, X_C, driven, relative_noise, stated, table


def modelled(data, model=None):
    found = error_model(fit(data, Dahl() if model is None else model).optimum)
    assert found is not None
    return found


def three_days(scatter, seed):
    """Return twelve levels on each of three days whose gain differs."""
    rng = np.random.default_rng(seed)
    A = np.tile(np.geomspace(0.1, 10.0, 12) * X_C, 3)
    gain = np.repeat(np.exp(scatter * rng.standard_normal(3)), 12)
    N = FRICTION.describing_function(A) * gain * relative_noise(36, 0.01, seed + 1)
    return FrequencyResponse(np.ones(36), N, A, run=np.repeat(["mon", "tue", "wed"], 12))


def gross_errors(data, seed, known):
    """Return a table with a tenth of its rows off by ten times the noise or more."""
    rng, factors = np.random.default_rng(seed), np.ones(data.n, dtype=np.complex128)
    factors[rng.choice(data.n, data.n // 10, replace=False)] = 1.0 + rng.uniform(0.1, 0.4)
    C = stated(data.response, 0.01) if known else None
    return replace(data, response=data.response * factors, covariance=C)


class TestVariances:
    @staticmethod
    def model(y, J, day):
        group = np.zeros(len(y), dtype=np.intp)
        return MixedModel(y, J, [day], group, np.zeros(1), 1, np.array([np.inf]))

    @staticmethod
    def days(rows=30, seed=2):
        rng = np.random.default_rng(seed)
        day = np.repeat(np.eye(rows // 5), 5, axis=0)
        J = np.column_stack([np.ones(rows), np.linspace(-1.0, 1.0, rows)])
        y = 2.0 * day @ rng.standard_normal(rows // 5) + rng.standard_normal(rows)
        return y, J, day

    def test_the_restricted_likelihood_is_highest(self):
        """Against a general minimiser on the density of contrasts that J cannot change."""
        y, J, day = self.days()
        contrasts = np.linalg.svd(J, full_matrices=True)[0][:, 2:]

        def minus_log_density(log_s):
            V = np.exp(log_s[0]) * np.eye(30) + np.exp(log_s[1]) * day @ day.T
            law = stats.multivariate_normal(np.zeros(28), contrasts.T @ V @ contrasts)
            return -float(law.logpdf(contrasts.T @ y))

        best = optimize.minimize(minus_log_density, np.zeros(2), method="Nelder-Mead")
        found = self.model(y, J, day).reml(np.ones(1))
        np.testing.assert_allclose(found.variances, np.exp(best.x), rtol=0.02)

    def test_the_gradient_and_the_information_are_those_of_the_likelihood(self):
        """Two groups of noise, one source; expected information from the dense covariance."""
        y, J, day = self.days()
        group, known = np.repeat([0, 1], 15), np.array([0.3, 0.0])
        model = MixedModel(y, J, [day], group, known, 2, np.array([np.inf]))
        s = np.array([0.8, 1.3, 2.0])
        state = model.at(s)
        parts = [np.diag(1.0 * (group == g)) for g in (0, 1)] + [day @ day.T]
        V = np.diag(known[group]) + sum(v * one for v, one in zip(s, parts, strict=True))
        W = np.linalg.inv(V)
        P = W - W @ J @ np.linalg.solve(J.T @ W @ J, J.T @ W)
        for k, one in enumerate(parts):
            slope = 0.5 * (y @ P @ one @ P @ y - np.trace(P @ one))
            assert state.gradient[k] == pytest.approx(slope, rel=1e-9)
            step = 1e-5 * np.eye(3)[k]
            rise = model.at(s + step).log_likelihood - model.at(s - step).log_likelihood
            assert slope == pytest.approx(rise / 2e-5, rel=1e-5)
            for j, other in enumerate(parts):
                known_of = 0.5 * np.trace(P @ one @ P @ other)
                assert state.information[k, j] == pytest.approx(known_of, rel=1e-9)
        np.testing.assert_allclose(state.weighted, P @ y, rtol=1e-9)

    def test_variances_many_decades_apart_keep_their_own_errors(self):
        """Two days apart by much more than the noise: one degree of freedom, 2 s^4 its variance."""
        rng = np.random.default_rng(3)
        day = np.repeat(np.eye(2), 20, axis=0)
        y = day @ [-1e6, 1e6] + rng.standard_normal(40)
        found = self.model(y, np.ones((40, 1)), 1e6 * day).reml(np.ones(1))
        assert found.variances[1] == pytest.approx(2.0, rel=0.01)
        assert found.variances_covariance[1, 1] == pytest.approx(2.0 * 2.0**2, rel=0.02)

    def test_a_source_that_is_not_there_has_no_variance(self):
        y, J, day = self.days()
        found = self.model(y - day @ (day.T @ y) / 5.0, J, day).reml(np.ones(1))
        assert found.variances[1] == 0.0


class TestBudget:
    def test_shares_add_up_and_name_their_type(self):
        for row in (found := budget(fit(table(n=12), Dahl()).optimum)).parameters:
            assert sum(r.share for r in row.rows) == pytest.approx(1.0)
            assert row.u**2 == pytest.approx(sum(r.u**2 for r in row.rows))
            assert pytest.approx(row.k * row.u) == row.U
        kinds = {r.source: r.kind for r in found["f_max"].rows}
        assert kinds["noise"] == "A"
        assert kinds["exponent"] == "B"
        assert found.exact[0] == "force calibration"

    def test_an_exponent_that_was_given_is_no_source(self):
        found = budget(fit(table(n=12), Dahl(alpha=1.0)).optimum)
        assert "exponent" not in {r.source for r in found["f_max"].rows}

    def test_an_exponent_that_was_not_given_widens_what_depends_on_it(self):
        """In microslip f_max follows from alpha sigma^2/f_max: its logarithm is alpha's.

        These data tell a little of the exponent, so that less than its whole range is left.
        """
        data = table(beta=(0.01, 0.1), n=60, noise=3e-3)
        found = budget(fit(data, Dahl()).optimum)["f_max"]
        exponent = next(r for r in found.rows if r.source == "exponent")
        assert exponent.u / found.value == pytest.approx(np.log(4.0) / np.sqrt(12.0), rel=0.2)

    def test_three_days_take_student_with_two_degrees_of_freedom(self):
        scatter = []
        for seed in range(8):
            found = budget(fit(three_days(0.05, 100 + seed), Dahl()).optimum)["sigma"]
            rows = {r.source: r for r in found.rows}
            scatter.append(rows["scatter between runs"].u / found.value)
            assert found.k > 3.0
        assert np.sqrt(np.mean(np.square(scatter))) == pytest.approx(0.05 / np.sqrt(3.0), rel=0.4)

    def test_the_verdict_says_why_two_days_have_wide_intervals(self):
        days = three_days(0.05, 100)
        two = fit(days.select(run=["mon", "tue"]), Dahl())
        (said,) = (str(f) for f in two.findings if f.code == "few_runs")
        k = max(row.k for row in two.budget().values())
        t = stats.t(df=2).ppf(0.97725)
        assert k > 8.0
        assert said.endswith(
            f"so the coverage factor k is up to {k:.3g}; with another run, about {t:.2g}."
        )
        assert said in str(two.verdict)
        assert two.status == "trusted"

    @pytest.mark.parametrize("seed", [103, 113])
    def test_so_it_does_for_two_days_that_agree(self, seed):
        two = fit(three_days(0.0, seed).select(run=["mon", "tue"]), Dahl(alpha=1.0))
        rows = two.budget().values()
        assert "scatter between runs" not in {part.source for row in rows for part in row.rows}
        (said,) = (str(f) for f in two.findings if f.code == "few_runs")
        assert said.startswith("The scatter of 2 runs has 1 degree of freedom, so the coverage ")
        assert f"k is up to {max(row.k for row in rows):.3g}; with another run" in said

    @pytest.mark.parametrize("scatters", [("sigma",), ("f_max", "sigma")])
    def test_each_parameter_of_friction_scatters_on_its_own(self, scatters):
        """Five days of friction in parallel with a spring and a damper, which do not change."""
        levels, f = (x.ravel() for x in np.meshgrid(np.geomspace(3e-4, 3e-2, 14), [1.0, 4.0]))
        rng, days = np.random.default_rng(6), 5
        of_days = {n: v * np.ones(days) for n, v in (("f_max", 0.1), ("sigma", 30.0))}
        for name in scatters:
            of_days[name] = of_days[name] * np.exp(0.04 * rng.standard_normal(days))
        responses = [
            (Dahl(f_max, sigma, 1.0) + Spring(3.0) + Damper(0.1)).dynamic_stiffness(
                levels, 2.0 * np.pi * f
            )
            * np.exp(5e-4 * rng.standard_normal((f.size, 2)) @ [1.0, 1.0j])
            for f_max, sigma in zip(*of_days.values(), strict=True)
        ]
        data = FrequencyResponse(
            np.tile(f, days), np.concatenate(responses), np.tile(levels, days),
            run=np.repeat([f"day {k}" for k in range(days)], f.size),
        )  # fmt: skip
        result = fit(data, Dahl(alpha=1.0) + Spring() + Damper())
        for name in scatters:
            of_mean = np.std(of_days[name], ddof=1) / days**0.5
            parameter = result.params[name]
            assert parameter.stderr == pytest.approx(of_mean, rel=0.15)
            assert parameter.value == pytest.approx(of_days[name].mean(), abs=0.3 * of_mean)
        for name, value in (("stiffness", 3.0), ("damping", 0.1)):
            assert result.params[name].stderr < 0.01 * value

    def test_passes_over_the_levels_are_days_where_they_differ(self):
        """Whoever does not state days gets their uncertainty; most repeats stay repeats."""
        passes = "each of 3 passes over the levels a run of its own"
        data = three_days(0.03, 8)
        stated, found = fit(data, Dahl()), fit(replace(data, run=None), Dahl())
        assert passes in found.verdict
        for name in ("f_max", "sigma"):
            assert found.params[name].stderr == pytest.approx(stated.params[name].stderr, rel=1e-6)
        alike = (replace(three_days(0.0, seed), run=None) for seed in range(12))
        assert sum(passes in fit(one, Dahl()).verdict for one in alike) <= 6  # two, three by chance

    @pytest.mark.parametrize("factors", [(1.0, 1.05), (0.95, 1.0, 1.08)])
    @pytest.mark.parametrize("scatters", ["f_max", "sigma", "gain"])
    def test_runs_that_differ_by_far_more_than_the_noise(self, scatters, factors):
        """What the deviations of runs do to second order is 0.1 %, ten times the noise."""
        rng = np.random.default_rng(5)
        A = np.geomspace(0.5, 40.0, 8) * X_C
        limits = [0.1 * (f if scatters != "sigma" else 1.0) for f in factors]
        slopes = [30.0 * (f if scatters != "f_max" else 1.0) for f in factors]
        laws = [Dahl(*values) for values in zip(limits, slopes, strict=True)]
        N = np.concatenate([law.describing_function(A) for law in laws])
        noise = 1e-4 * np.abs(N) * (rng.standard_normal((2, N.size)).T @ [1.0, 1j])
        run = np.repeat(factors, 8).astype(str)
        data = FrequencyResponse(np.ones(N.size), N + noise, np.tile(A, len(laws)), run=run,
                                 covariance=stated(N, 1e-4))  # fmt: skip
        found = fit(data, Dahl(alpha=1.0))
        assert found.status == "approximate", found.verdict
        assert found.goodness.objections == (str(found.goodness.of("runs differ")[0]),)
        assert found.goodness.of("chi-square")[0].p_value > 1e-3
        f_max = found.errors.values["f_max"] * np.exp(found.errors.runs.each[:, 0])
        f_max *= np.exp(found.errors.runs.each[:, -2])
        np.testing.assert_allclose(f_max, limits, rtol=1e-3)

        wrong = fit(data, Dahl(alpha=0.9))
        assert wrong.status == "not described"

    def test_amplitudes_that_the_response_was_divided_by(self):
        """An error of 5 % there is one of the stiffness in microslip, and none in slip."""
        A = np.geomspace(0.05, 20.0, 24) * X_C
        off, stated = [], []
        for seed in range(40):
            error = np.abs(relative_noise(24, 0.05, seed))
            N = FRICTION.describing_function(A) / error * relative_noise(24, 0.002, 100 + seed)
            found = modelled(FrequencyResponse(np.ones(24), N, A * error), Dahl(alpha=1.0))
            values, errors = found.values, found.stderr
            off.append([np.log(values["f_max"] / 0.1), np.log(values["sigma"] / 30.0)])
            stated.append([errors["f_max"] / 0.1, errors["sigma"] / 30.0])
        scatter, u = np.std(off, axis=0), np.sqrt(np.mean(np.square(stated), axis=0))
        np.testing.assert_allclose(u, scatter, rtol=0.3)  # 11 % is one standard deviation
        assert u[0] < 0.002  # the limit is known from slip

    def test_a_model_error_that_chance_suggests_widens_by_its_size_alone(self):
        """Fifteen rows of noise: k is that of few degrees of freedom in any table, never of one."""
        A = np.geomspace(0.1, 10.0, 15) * X_C
        widest = 0.0
        for seed in range(16):
            N = FRICTION.describing_function(A) * relative_noise(15, 0.01, seed)
            found = fit(FrequencyResponse(np.ones(15), N, A), Dahl()).budget()
            widest = max(widest, *(p.k for p in found.parameters))
        assert 2.3 < widest < stats.t(2.5).ppf(0.97725)

    def test_a_stated_calibration_is_a_type_b_source(self):
        sensors = Sensors(force_gain=stats.norm(1.0, 0.02))
        found = budget(fit(table(n=12), Dahl(alpha=1.0), sensors=sensors).optimum)
        row = next(r for r in found["f_max"].rows if r.source == "force calibration")
        assert row.kind == "B"
        assert row.u / found["f_max"].value == pytest.approx(0.02, rel=0.05)
        assert "force calibration" not in found.exact

    def test_forms(self):
        found = budget(fit(table(n=12), Dahl()).optimum)
        assert "combined" in str(found)
        plain = json.loads(json.dumps(found.to_dict()))["parameters"]["f_max"]
        assert plain["u"] > 0.0
        dof = {row.source: row.dof for row in found["f_max"].rows}
        known = {name: number for name, number in dof.items() if np.isfinite(number)}
        assert known
        stated = {row["source"]: row["dof"] for row in plain["sources"]}
        assert stated == dict.fromkeys(dof) | known
        frame = found.to_frame()
        assert set(frame["source"]) >= {"noise", "combined"}
        numbers = found.numbers()
        assert numbers["f_max"].std_dev == pytest.approx(found["f_max"].u)
        u = np.array([found["f_max"].u, found["sigma"].u])
        slope = np.array([1.0 / found["sigma"].value, -found["f_max"].value])
        slope[1] /= found["sigma"].value ** 2
        ratio = numbers["f_max"] / numbers["sigma"]
        of_ratio = slope @ found.covariance[:2, :2] @ slope
        assert ratio.std_dev == pytest.approx(of_ratio**0.5)
        assert ratio.std_dev != pytest.approx(np.linalg.norm(slope * u), rel=1e-3)  # correlated

    def test_numbers_of_the_gum_tree_calculator(self):
        gtc = pytest.importorskip("GTC", reason="the GUM Tree Calculator is not installed")
        found = budget(fit(table(n=12), Dahl()).optimum)
        mine, theirs = found.numbers(), found.numbers("GTC")
        ratio = theirs["f_max"] / theirs["sigma"]
        assert gtc.uncertainty(ratio) == pytest.approx((mine["f_max"] / mine["sigma"]).std_dev)
        assert gtc.dof(theirs["f_max"]) == pytest.approx(min(p.dof for p in found.parameters))

    def test_only_sources_that_were_estimated_have_degrees_of_freedom(self):
        sensors = Sensors(force_gain=stats.norm(1.0, 0.02))
        rows = budget(fit(table(n=12), Dahl(alpha=1.0), sensors=sensors).optimum)["f_max"].rows
        by_source = {row.source: row for row in rows}
        assert by_source["force calibration"].dof == np.inf
        assert 5.0 < by_source["noise"].dof < 22.01  # 24 numbers, 2 parameters, other sources

    def test_the_factor_of_a_drive_scales_every_force(self):
        rng, u = np.random.default_rng(4), np.tile([0.3, 1.0, 3.0], 4)
        f = np.repeat(np.geomspace(0.2, 2.0, 4), 3)
        model = Spring() + Damper()
        noise = np.exp(1e-3 * rng.standard_normal((12, 2)) @ [1, 1j])
        R = noise / (40.0 + 2j * np.pi * f * 1.5)
        found = fit(driven(f, R, u, drive_factor_uncertainty=0.02), model).budget()
        for name in ("stiffness", "damping"):
            by_source = {row.source: row.u for row in found[name].rows}
            assert by_source["drive factor"] == pytest.approx(0.02 * found[name].value, rel=1e-2)

    def test_at_infinity_what_is_determined_has_a_budget(self):
        result = fit(table(beta=(1e-3, 1e-2), seed=3), Dahl() + Spring(), throw=False)
        assert not result.success
        (only,) = result.budget().parameters
        assert only.name == "sigma + stiffness"
        assert only.value == pytest.approx(30.0, abs=only.U)
        (alone,) = (c for c in result.combinations if c.expression == only.name)
        assert only.u == pytest.approx(alone.stderr, rel=0.05)  # these data have noise alone

    def test_the_exponent_is_no_part_of_what_it_cannot_change(self):
        """In microslip f_max takes the exponent's range, and alpha sigma^2/f_max does not."""
        found = budget(fit(table(beta=(0.01, 0.1), n=60, noise=3e-3), Dahl()).optimum)
        assert found["f_max"].u > 0.3 * found["f_max"].value
        kept = found["alpha sigma^2/f_max"]
        assert kept.value == pytest.approx(30.0**2 / 0.1, abs=kept.U)
        assert kept.u < 0.1 * kept.value

    def test_no_budget_where_no_number_is_left(self):
        with pytest.raises(FitError, match="no uncertainty budget"):
            budget(fit(table(n=1), Dahl(), throw=False).optimum)

    def test_a_budget_or_a_refusal_where_the_iteration_may_leave_every_steady_response(self):
        """Drives near the force limit, where the linearised model steps below it."""
        phase = np.exp(-1j * np.radians([5.0, 20.0, 40.0]))
        for sizes in ([0.03, 0.035, 0.1], [0.03, 0.035, 0.12], [0.03, 0.033, 0.08],
                      [0.031, 0.035, 0.08], [0.028, 0.033, 0.12]):  # fmt: skip
            data = driven(np.ones(3), np.array(sizes) * phase, np.array([0.1, 0.3, 0.4]))
            fitted = fit(data, Dahl(), throw=False)
            if fitted.stated_budget is None:  # which of them, is up to rounding
                with pytest.raises(FitError, match="no uncertainty budget"):
                    fitted.budget()
            else:
                assert np.isfinite(fitted.budget()["f_max"].u)


class TestEstimate:
    def test_a_wrong_exponent_is_found_under_its_range(self):
        data = table(model=Dahl(0.1, 30.0, alpha=1.3), n=12, noise=0.01)
        found = modelled(data)
        for name, truth in (("f_max", 0.1), ("sigma", 30.0), ("alpha", 1.3)):
            assert found.values[name] == pytest.approx(truth, abs=3.0 * found.stderr[name])
        plain = fit(data, Dahl(alpha=1.0)).optimum
        assert abs(plain.values[0] - 0.1) > 5.0 * plain.stderr["f_max"]

    def test_large_tables_give_what_small_ones_give(self):
        data = table(n=240, noise=0.01)
        whole = modelled(data)
        few = modelled(data.select(rows=np.arange(240) % 2 == 0))
        assert whole.stderr["sigma"] * 2.0**0.5 == pytest.approx(few.stderr["sigma"], rel=0.25)

    def test_a_point_that_stands_apart_has_an_error_of_its_own(self):
        """A gross error widens the estimate and does not move it from least squares."""
        data = table(n=12, noise=0.01, seed=4)
        off = data.response.copy()
        off[7] *= 1.1
        found = modelled(replace(data, response=off), Dahl(alpha=1.0))
        left_out = modelled(data.select(rows=np.arange(12) != 7), Dahl(alpha=1.0))
        (row,) = (
            row for row in budget(found.optimum)["sigma"].rows if row.source == "suspicious points"
        )
        assert (row.kind, round(row.dof, 3)) == ("A", 2.0)  # estimated from its gain and phase
        plain = fit(found.problem.data, Dahl(alpha=1.0))
        for i, (name, u) in enumerate(left_out.stderr.items()):
            assert found.values[name] == pytest.approx(plain.optimum.values[i], rel=1e-6)
            assert found.stderr[name] > 0.9 * u
            apart = abs(found.values[name] - left_out.values[name])
            assert apart < 2.0 * found.stderr[name]

    @pytest.mark.parametrize("level_too", [False, True])
    def test_levels_whose_gain_is_wrong(self, level_too):
        """An amplifier's range at each of ten levels of three frequencies, not given as runs."""
        size, inside = 0.05, []
        for seed in range(12):
            rng = np.random.default_rng([3, seed])
            gain = np.repeat(np.exp(size * rng.standard_normal(10)), 3)
            A = np.repeat(np.geomspace(0.1, 10.0, 10), 3) * X_C
            N = FRICTION.describing_function(A * (gain if level_too else 1.0)) * gain
            data = FrequencyResponse(
                np.tile([0.5, 1.0, 2.0], 10), N * relative_noise(30, 0.01, seed), A
            )
            found = modelled(data)
            assert "scatter between repeated levels" in found.contributions
            inside += [
                abs(found.values[name] - truth) < 2.5 * found.stderr[name]
                for name, truth in (("f_max", 0.1), ("sigma", 30.0))
            ]
        assert sum(inside) >= 21  # of 24

    def test_the_misfit_makes_chi_square_its_degrees_of_freedom(self):
        """Against a general minimiser and root finder on residuals made here."""
        A = np.geomspace(0.1, 10.0, 12) * X_C
        N = FRICTION.describing_function(A) * (1.0 + 0.05 * np.sin(np.arange(12)))
        size = 0.002 * np.abs(N)
        covariance = size[:, None, None] ** 2 * np.eye(2)
        data = FrequencyResponse(np.ones(12), N, A, covariance=covariance)
        found = modelled(data, Dahl(alpha=1.0))

        def left(theta, s):
            missed = N - Dahl(*np.exp(theta)).describing_function(A)
            return np.asarray((missed / np.hypot(size, s * np.abs(N))).view(np.float64))

        def excess(s):
            return 2.0 * optimize.least_squares(left, found.theta, args=(s,)).cost - 22.0

        misfit = optimize.brentq(excess, 1e-3, 0.5, xtol=1e-12)
        best = optimize.least_squares(left, found.theta, args=(misfit,), xtol=1e-14, ftol=1e-14)
        np.testing.assert_allclose(
            found.estimate.misfit_variance, (misfit * np.abs(N)) ** 2, rtol=2e-4
        )
        np.testing.assert_allclose(found.theta, best.x, atol=1e-5)

    def test_no_misfit_where_the_model_describes_the_data(self):
        data = load_dataset("noisy")
        assert fit(data, Dahl()).goodness.of("chi-square")
        found = modelled(data, Dahl(alpha=1.0))
        assert not found.estimate.problem.has_misfit
        plain = fit(data, Dahl(alpha=1.0)).optimum
        np.testing.assert_allclose(found.theta, plain.theta, atol=1e-7)

    @pytest.mark.parametrize(
        "loss", ["huber", pytest.param("soft_l1", marks=pytest.mark.long), "student_t"]
    )
    @pytest.mark.parametrize("known", [False, True])
    def test_a_robust_loss_counts_every_source(self, loss, known):
        """As least squares does without the gross errors: exponent, days, noise."""
        for seed in (3, 5):
            data = three_days(0.05, seed)
            clean, robust = (
                fit(one, Dahl(), loss=by)
                for one, by in ((data, "linear"), (gross_errors(data, seed, known), loss))
            )
            assert robust.trusted
            assert robust.assumed == ("alpha",)
            for name in ("f_max", "sigma"):
                one, other = clean.params[name], robust.params[name]
                assert other.stderr == pytest.approx(one.stderr, rel=0.3)
                assert other.stderr > 3.0 * robust.stderr_noise[name]
                assert other.value == pytest.approx(one.value, abs=one.stderr)

    def test_a_robust_loss_changes_little_without_gross_errors(self):
        plain, robust = (fit(table(seed=4), Dahl(), loss=loss) for loss in ("linear", "huber"))
        for name in ("f_max", "sigma"):
            one, other = plain.params[name], robust.params[name]
            assert other.stderr == pytest.approx(one.stderr, rel=0.15)
            assert other.value == pytest.approx(one.value, abs=0.5 * one.stderr)

    def test_harmonics_of_tiny_covariance_do_not_pull(self):
        """Third harmonics 20 % off, their stated error a hundredth of the fundamental's."""
        A = np.geomspace(0.3, 10.0, 12) * X_C
        first = FRICTION.describing_function(A) * relative_noise(12, 0.005, 1)
        own = [np.asarray(v) for v in (0.1, 30.0, 1.0)]
        third = 1.2 * FRICTION.stiffness(own, A, np.zeros(()), 3)
        size = np.concatenate([0.005 * np.abs(first), 5e-5 * np.abs(first)])
        data = FrequencyResponse(
            np.ones(24), np.concatenate([first, third]), np.tile(A, 2),
            harmonic=np.repeat([1, 3], 12), covariance=size[:, None, None] ** 2 * np.eye(2),
        )  # fmt: skip
        found = fit(data, Dahl())
        alone = fit(data.select(rows=data.harmonic == 1), Dahl())
        for name, truth in (("f_max", 0.1), ("sigma", 30.0)):
            p = found.params[name]
            assert p.value == pytest.approx(truth, abs=2.0 * p.stderr)
            assert p.value == pytest.approx(alone.params[name].value, abs=1.5 * p.stderr)

    def test_the_estimate_holds_still_where_a_test_is_left_out(self):
        """Bouc-Wen loops fitted by Dahl: as leaving out tests one by one says, within a factor."""
        A = np.geomspace(0.2, 10.0, 10) * X_C
        N = BoucWen(30.0, 300.0, 150.0).describing_function(A) * relative_noise(10, 0.002, 3)
        data = FrequencyResponse(np.ones(10), N, A, covariance=stated(N, 0.002))
        whole = modelled(data)
        moved = [
            modelled(data.select(rows=np.arange(10) != i)).theta - whole.theta for i in range(10)
        ]
        jackknife = np.sqrt(0.9 * np.sum((moved - np.mean(moved, axis=0)) ** 2, axis=0))
        u = np.sqrt(np.diagonal(whole.covariance))
        assert (np.max(np.abs(moved), axis=0) < 3.0 * u).all()
        assert (u > 0.5 * jackknife).all()

    @pytest.mark.parametrize("seed", [1, 9, 17])
    def test_a_level_that_alone_shows_the_force_limit_is_one_where_the_model_is_right(self, seed):
        """In two of these tables chi-square is larger than its degrees of freedom, by chance."""
        drive, f = np.repeat(np.geomspace(0.02, 1.0, 5), 15), np.tile(np.geomspace(0.3, 3.0, 15), 5)

        def receptance(f_max, sigma, alpha, m, c, k):
            plant = Dahl(f_max, sigma, alpha) + Mass(m) + Damper(c) + Spring(k)
            return response(plant, f, drive).receptance

        truth = np.array([0.1, 30.0, 1.0, 0.3, 0.24, 0.3])
        R, noise = receptance(*truth), np.random.default_rng(seed).standard_normal((2, 75))
        noisy = R * (1.0 + 0.01 * (noise[0] + 1j * noise[1]))
        data = replace(driven(f, noisy, drive, level=drive), covariance=stated(R, 0.01))
        found = fit(data, Dahl() + Mass() + Damper() + Spring())
        changes = [receptance(*(truth * step)) / R - 1.0 for step in 1.0 + 1e-4 * np.eye(6)]
        J = np.array(changes) / 1e-4 / 0.01
        u = truth * np.sqrt(np.diagonal(np.linalg.inv((J @ J.conj().T).real)))
        for name, least in zip(("f_max", "sigma", "alpha", "mass", "damping"), u, strict=False):
            assert found.params[name].stderr == pytest.approx(least, rel=0.25)

    @pytest.mark.parametrize("seed", [0, 1])
    def test_no_source_explains_the_noise_of_a_dense_sweep(self, seed):
        """1,200 numbers of 1 % noise: their variance is known to 4 %."""
        found = modelled(table(beta=(0.01, 1.0), n=600, noise=0.01, seed=seed))
        assert found.rms("noise") ** 2 == pytest.approx(1e-4, rel=4 * 0.041)
        every = {"noise", "model error", "exponent", "jackknife over tests"}
        assert set(found.contributions) <= every
        assert abs(found.values["f_max"] - 0.1) < 5.0 * found.stderr["f_max"] < 0.05


class TestLevels:
    @staticmethod
    def repeated(A):
        """Return how many levels were measured more than once."""
        data = FrequencyResponse(np.ones(A.size), np.full(A.size, 1.0 + 1.0j), A)
        return int((np.bincount(repeated_levels(data)) > 1).sum())

    @pytest.mark.parametrize("scatter", [0.0, 1e-4, 3e-3])
    def test_amplitudes_that_agree_within_their_scatter_are_one(self, scatter):
        rng = np.random.default_rng(3)
        levels = np.repeat(np.geomspace(1e-4, 1e-2, 8), 4)
        assert self.repeated(levels * np.exp(scatter * rng.standard_normal(32))) == 8

    def test_a_dense_sweep_has_none(self):
        rng = np.random.default_rng(4)
        assert not any(self.repeated(np.geomspace(1e-4, 1e-2, n)) for n in (12, 300, 3000))
        spread = [np.exp(rng.uniform(0.0, 4.6, n)) for n in 50 * [12, 30, 100, 300]]
        alarms = sum(self.repeated(A) > 0 for A in spread)
        assert stats.binomtest(alarms, len(spread), 0.01, alternative="greater").pvalue > 0.01


def test_the_estimate_does_not_depend_on_the_unit_of_force():
    """Harmonics of tiny covariances that the model misses: the search is far from the estimate."""
    rng, A = np.random.default_rng(1), np.geomspace(0.1, 10.0, 12) * X_C
    f, law = np.tile([0.5, 2.0], 6), BoucWen(30.0, 300.0, 300.0, exponent=2.0) + Damper(0.3)
    R = np.array([law.dynamic_stiffness(A, 2.0 * np.pi * f, harmonic=k) for k in (1, 3)])
    size = np.abs(R[0]) * np.array([[3e-3], [1e-5]])
    R = (R + size * (rng.standard_normal((2, 12)) + 1j * rng.standard_normal((2, 12)))).ravel()
    found = [
        fit(
            FrequencyResponse(
                np.tile(f, 2), unit * R, np.tile(A, 2), harmonic=np.repeat([1, 3], 12),
                covariance=(unit * size.ravel())[:, None, None] ** 2 * np.eye(2),
            ),
            Dahl() + Damper(), throw=False,
        ).params
        for unit in (1.0, 1e5)
    ]  # fmt: skip
    for name in ("f_max", "sigma", "damping"):
        one, other = (params[name] for params in found)
        assert 1e-5 * other.value == pytest.approx(one.value, abs=0.02 * one.stderr)


@pytest.mark.parametrize("u_gain", [0.0025, 0.01])
def test_a_calibration_adds_to_what_leaving_out_tests_shows(u_gain):
    data = load_dataset("noisy")
    exact = fit(data, Dahl()).params["f_max"]
    sensors = Sensors(force_gain=stats.norm(1.0, u_gain))
    calibrated = fit(data, Dahl(), sensors=sensors)
    assert "jackknife over tests" in [row.source for row in calibrated.budget()["f_max"].rows]
    u = np.hypot(exact.stderr, u_gain * exact.value)
    assert calibrated.params["f_max"].stderr == pytest.approx(u, rel=1e-3)
    draws = posterior(data, Dahl(alpha=1.0), sensors=sensors, method="grid", seed=1)
    alone = posterior(data, Dahl(alpha=1.0), method="grid", seed=1).summary()["std"]["f_max"]
    assert draws.summary()["std"]["f_max"] == pytest.approx(np.hypot(alone, 0.1 * u_gain), rel=0.03)

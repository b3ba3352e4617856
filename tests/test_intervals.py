"""Confidence intervals against closed forms, brute force, other libraries, and each other."""

import functools
import importlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, special, stats

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
    response,
)
from dahl_ident.diagnostics import identifiability
from dahl_ident.errors import ValidationError
from dahl_ident.fitting import Status
from dahl_ident.results import FitResult
from tests.friction_tables import (
    FRICTION,
    X_C,
    amplitudes,
    driven,
    plant_table,
    relative_noise,
    stated,
    table,
)


def spring_table(n=8, seed=3):
    noise = np.random.default_rng(seed).standard_normal((2, n))
    Z = 5.0 + 0.1 * (noise[0] + 1j * noise[1])
    return FrequencyResponse(np.ones(n), Z, np.geomspace(1e-3, 1.0, n))


class TestClosedForm:
    """One spring under constant noise is the mean of n numbers: the textbook's t interval."""

    @pytest.mark.parametrize("method", ["wald", "profile"])
    def test_interval_of_a_mean(self, method):
        data = spring_table()
        result = fit(data, Spring(), noise="absolute")
        n = data.n
        mean = data.response.real.mean()
        squares = ((data.response.real - mean) ** 2).sum() + (data.response.imag**2).sum()
        error = np.sqrt(squares / (2 * n - 1) / n)
        for level, lower, upper in result.conf_interval(method)["stiffness"]:  # parametrised
            t = stats.t.ppf(0.5 + 0.5 * level, 2 * n - 1)
            assert lower == pytest.approx(mean - t * error, abs=1e-7 * error)
            assert upper == pytest.approx(mean + t * error, abs=1e-7 * error)

    def test_limits_are_printed_from_the_lowest_to_the_highest(self):
        found = fit(table(n=8), Dahl(alpha=1.0)).conf_interval("wald")
        for line in str(found).splitlines()[2:]:
            numbers = [float(text) for text in line.split("]")[1].split()]
            assert numbers == sorted(numbers)
            assert len(numbers) == 2 * len(found.levels) + 1

    def test_known_noise_gives_normal_thresholds(self):
        data = replace(spring_table(), covariance=np.tile(0.04 * np.eye(2), (8, 1, 1)))
        (interval,) = fit(data, Spring()).conf_interval("wald", levels=[0.95])["stiffness"]
        half = 1.959963984540054 * 0.2 / np.sqrt(8.0)
        assert 0.5 * (interval.upper - interval.lower) == pytest.approx(half, rel=1e-8)


class TestOtherLibraries:
    def test_lmfit_has_the_same_optimum_errors_and_profile(self):
        lmfit = importlib.import_module("lmfit")
        data = table(n=8)
        result, amplitude = fit(data, Dahl(alpha=1.0)), amplitudes(data)

        def residuals(p):
            N = Dahl(p["f_max"].value, p["sigma"].value).describing_function(amplitude)
            return np.log(data.response / N).view(np.float64)

        parameters = lmfit.Parameters()
        parameters.add("f_max", 0.1)
        parameters.add("sigma", 30.0)
        mini = lmfit.Minimizer(residuals, parameters)
        peer = mini.minimize(ftol=1e-14, xtol=1e-14)
        for i, name in enumerate(("f_max", "sigma")):
            peers = peer.params[name]  # which count noise alone
            assert result.optimum.values[i] == pytest.approx(peers.value, rel=1e-6)
            assert result.optimum.stderr[name] == pytest.approx(peers.stderr, rel=1e-4)
            np.testing.assert_allclose(
                result.optimum.values_covariance[i], peer.covar[i], rtol=2e-4
            )
        found = lmfit.conf_interval(mini, peer, sigmas=[1, 2])
        ours = result.conf_interval("profile", levels=[0.682689492, 0.954499736])
        for name in ("f_max", "sigma"):
            limits = [value for _, value in found[name]]
            (one, two) = ours[name]
            np.testing.assert_allclose(
                [two.lower, one.lower, one.upper, two.upper],
                [limits[0], limits[1], limits[3], limits[4]],
                rtol=3e-6,
            )


class TestProfile:
    def test_limits_lie_where_brute_force_finds_the_threshold(self):
        result = fit(table(n=8, noise=0.1), Dahl(alpha=1.0))
        optimum = result.optimum
        for index, intervals in enumerate(result.conf_interval("profile").values()):
            for level, *limits in intervals:
                q = special.stdtrit(optimum.dof, 0.5 + 0.5 * level)
                for limit in np.log(limits):

                    def squares(other, at=limit, held=index):
                        theta = np.empty(2)
                        theta[held], theta[1 - held] = at, other
                        return float(np.sum(optimum.problem.residuals(theta) ** 2))

                    near = optimum.theta[1 - index]
                    best = optimize.minimize_scalar(
                        squares, bounds=(near - 1.0, near + 1.0), method="bounded",
                        options={"xatol": 1e-10},
                    )  # fmt: skip
                    rise = (best.fun - 2.0 * optimum.cost) / optimum.scale**2
                    assert rise == pytest.approx(q**2, rel=1e-5)

    def test_microslip_leaves_f_max_open_above(self):
        result = fit(table(beta=(1e-4, 1e-3)), Dahl(), throw=False)
        for _, lower, upper in result.conf_interval()["f_max"]:
            assert 0.0 < lower < 0.1
            assert upper == np.inf
        assert np.isfinite(result.conf_interval()["sigma"][-1]).all()

    def test_an_optimum_at_infinity_has_a_lower_limit(self):
        tables = (table(beta=(1e-4, 1e-3), seed=seed) for seed in range(20))
        fits = (fit(data, Dahl(alpha=1.0), throw=False) for data in tables)
        result = next(r for r in fits if r.optimum.status is Status.NO_LOSS)
        one, two, three = result.conf_interval()["f_max"]
        assert 0.0 < three.lower < two.lower < one.lower < np.inf
        assert {one.upper, two.upper, three.upper} == {np.inf}
        theta = result.optimum.theta.copy()
        theta[0] = np.log(two.lower)
        best = optimize.minimize_scalar(
            lambda s: float(np.sum(result.problem.residuals([theta[0], s]) ** 2)),
            bounds=(theta[1] - 0.1, theta[1] + 0.1), method="bounded", options={"xatol": 1e-11},
        )  # fmt: skip
        rise = (best.fun - result.chisqr) / result.scale**2
        assert rise == pytest.approx(special.stdtrit(result.nfree, 0.97725) ** 2, rel=1e-3)

    def test_an_exact_degeneracy_leaves_everything_open(self):
        result = fit(table(), Dahl(), sensors=Sensors(force_gain=None), throw=False)
        for name in ("f_max", "sigma", "force_gain"):
            for interval in result.conf_interval()[name]:
                assert (interval.lower, interval.upper) == (0.0, np.inf)

    def test_a_bound_ends_an_interval(self):
        model = Dahl(alpha=1.0) + Spring()
        (own,) = (p for p in model.parameters if p.name == "f_max")
        bounded = model.with_parameters({"f_max": replace(own, upper=0.1002)})
        data = table(model=Dahl(0.1, 30.0) + Spring(0.3))
        free = fit(data, model).conf_interval("profile")["f_max"][1]
        tied = fit(data, bounded).conf_interval("profile")["f_max"][1]
        assert free.upper > 0.1002
        assert tied.upper == pytest.approx(0.1002)
        assert tied.lower == pytest.approx(free.lower, rel=1e-3)

    @pytest.mark.parametrize(
        "seed", [8, *(pytest.param(s, marks=pytest.mark.long) for s in (4, 53, 204))]
    )
    def test_with_a_hidden_spring_the_limits_are_those_of_a_global_search(self, seed):
        """The profile's valley is bent and long; fits with the value fixed find it from scratch.

        But for the table of seed 4, the optimum lies in microslip with the spring at minus
        infinity, and a second valley, gross slip, holds the limits.
        """
        hidden = table(model=Dahl(0.1, 30.0) + Spring(30.0), beta=(100.0, 1000.0), seed=seed)
        model = Dahl(alpha=1.0) + Spring()
        result = fit(hidden, model, throw=False)
        for name in ("f_max", "sigma", "stiffness"):
            for level, *limits in result.conf_interval("profile")[name]:
                target = special.stdtrit(result.optimum.dof, 0.5 + 0.5 * level) ** 2
                for limit in limits:
                    if 0.0 < limit < np.inf:
                        held = fit(result.data, model, fixed={name: limit}, throw=False)
                        rise = 2.0 * (held.optimum.cost - result.optimum.cost) / result.scale**2
                        assert rise == pytest.approx(target, rel=0.02)

    def test_robust_fits_have_intervals_like_those_of_their_covariance(self):
        result = fit(table(), Dahl(), loss="huber")
        wald, profile = result.conf_interval("wald"), result.conf_interval("profile")
        np.testing.assert_allclose(profile.lower[1], wald.lower[1], rtol=2e-3)
        np.testing.assert_allclose(profile.upper[1], wald.upper[1], rtol=2e-3)

    @settings(max_examples=10)
    @given(
        st.floats(-6.0, 6.0),
        st.floats(0.1, 4.0),
        st.integers(2, 12),
        st.sampled_from([1e-4, 0.01, 0.3]),
        st.integers(0, 10),
    )
    def test_never_raises_and_holds_the_estimate(self, low, decades, n, noise, seed):
        data = table(beta=(10.0**low, 10.0 ** (low + decades)), n=n, noise=noise, seed=seed)
        result = fit(data, Dahl(), throw=False)
        found = result.conf_interval("profile")
        values = np.array([result.params[name].value for name in found])
        for i in np.flatnonzero(np.isfinite(values) & (values > 0.0)):
            assert (found.lower[:, i] <= values[i]).all()
            assert (found.upper[:, i] >= values[i]).all()
            assert (found.lower[1:, i] <= found.lower[:-1, i]).all()
            assert (found.upper[1:, i] >= found.upper[:-1, i]).all()

    @settings(max_examples=10)
    @given(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
    def test_follow_the_units(self, force, length):
        data = table(n=6, noise=0.05)
        N, m = 10.0**force, 10.0**length
        other = FrequencyResponse(data.frequency_hz, data.response * N / m, data.amplitude * m)
        ours, theirs = (fit(d, Dahl()).conf_interval() for d in (data, other))
        factor = np.array([N, N / m, 1.0])
        np.testing.assert_allclose(theirs.lower, ours.lower * factor, rtol=1e-6)
        np.testing.assert_allclose(theirs.upper, ours.upper * factor, rtol=1e-6)


class TestBootstrap:
    def test_agrees_with_the_profile_where_all_is_well(self):
        result = fit(table(n=12), Dahl(alpha=1.0))
        profile, bootstrap = result.conf_interval("profile"), result.conf_interval("bootstrap")
        width = profile.upper[1] - profile.lower[1]
        assert (np.abs(bootstrap.lower[1] - profile.lower[1]) < 0.05 * width).all()
        assert (np.abs(bootstrap.upper[1] - profile.upper[1]) < 0.05 * width).all()

    def test_works_for_driven_plants(self):
        data = plant_table()
        data = data.select(rows=np.arange(data.n) % 3 == 0)
        result = fit(data, Dahl() + Spring(), fixed=None, throw=False)
        found = result.conf_interval("bootstrap", replicates=99)
        assert set(found) == {"f_max", "sigma", "stiffness"}

    def test_the_seed_decides(self):
        result = fit(table(n=8), Dahl())
        drawn = functools.partial(result.conf_interval, "bootstrap", replicates=99)
        one, same, other = (drawn(seed=s) for s in (1, 1, 2))
        np.testing.assert_array_equal(one.lower, same.lower)
        assert (one.lower != other.lower).all()

    def test_is_open_where_replicates_run_away(self):
        result = fit(table(beta=(1e-4, 1e-3)), Dahl(), throw=False)
        found = result.conf_interval("bootstrap", replicates=199)
        assert found["f_max"][0].upper == np.inf
        assert found["sigma"][0].upper < np.inf

    def test_refuses_robust_losses_and_few_replicates(self):
        with pytest.raises(ValidationError, match="robust loss huber"):
            fit(table(), Dahl(), loss="huber").conf_interval("bootstrap")
        with pytest.raises(ValidationError, match="replicates is 5; expected a whole number >= 99"):
            fit(table(), Dahl()).conf_interval("bootstrap", replicates=5)

    def test_few_degrees_of_freedom_a_row(self):
        data, widths = table(), []
        C = stated(data.response, 0.01)
        for dof in (np.inf, 5.0):
            result = fit(replace(data, covariance=C, dof=np.full(30, dof)), Dahl())
            _, low, high = result.conf_interval("bootstrap", replicates=499)["f_max"][1]
            widths.append(high - low)
        assert 1.0 < widths[1] / widths[0] < 2.0


class TestTable:
    def result(self):
        return fit(table(n=8), Dahl())

    def test_methods_side_by_side(self):
        compared = self.result().compare_intervals()
        assert not compared.disagreements
        assert "The methods that count noise alone agree." in str(compared)
        assert "profile intervals (noise scale estimated: t and F with 14 degrees" in str(compared)

    def test_disagreement_is_flagged(self):
        result = fit(table(beta=(1e-3, 1e-2)), Dahl())
        compared = result.compare_intervals(["wald", "profile"])
        flagged = {(d.name, d.side) for d in compared.disagreements}
        assert ("f_max", "upper") in flagged
        assert "sigma" not in {name for name, _ in flagged}
        assert "by wald and open by profile; trust the latter" in str(compared)

    def test_limits_disagree_from_a_fifth_of_the_half_width(self):
        result = fit(table(beta=(0.01, 0.03), n=12), Dahl(alpha=1.0))
        compared = result.compare_intervals(["wald", "profile"], levels=0.95)
        (wald, profile), value = compared.intervals, result.params["f_max"].value
        limits = ((wald.lower, profile.lower), (wald.upper, profile.upper))
        lower, upper = (abs(np.log(w / p) / np.log(p / value))[0, 0] for w, p in limits)
        assert 0.18 < lower < 0.2 < upper < 0.22
        assert [(d.name, d.side) for d in compared.disagreements] == [("f_max", "upper")]

    def test_mapping_and_frame(self):
        found = self.result().conf_interval()
        assert list(found) == ["f_max", "sigma", "alpha"]
        assert len(found) == 3
        assert found.at(0.9545)["sigma"] == found["sigma"][1]
        frame = found.to_frame()
        assert frame.shape == (9, 6)
        assert frame["upper"].iloc[-1] == found.upper[-1, -1]
        with pytest.raises(KeyError, match="mass is not a free parameter"):
            found["mass"]

    def test_impossible_levels_and_methods(self):
        result = self.result()
        for levels in ([0.0], [1.0], [], [2.0], [np.nan]):
            with pytest.raises(ValidationError, match="levels"):
                result.conf_interval(levels=levels)
        with pytest.raises(ValidationError, match="'bayes'; expected one of combined, wald"):
            result.conf_interval("bayes")  # the test's point

    def test_no_degrees_of_freedom_leave_everything_open(self):
        data = FrequencyResponse([1.0], [20.0 + 5.0j], amplitude=[X_C])
        result = fit(data, Dahl(), throw=False)
        assert result.nfree == 0
        for interval in result.conf_interval()["sigma"]:
            assert (interval.lower, interval.upper) == (0.0, np.inf)


class TestOneInterval:
    """Whatever states an estimate states one point, and one uncertainty."""

    @staticmethod
    def fitted(case):
        if case == "described":
            return fit(table(n=12, noise=0.01, seed=3), Dahl())
        if case == "misfit":  # a spring in parallel that the model does not have
            data = table(n=12, noise=0.01, seed=4)
            return fit(replace(data, response=data.response + 0.6), Dahl(), throw=False)
        few = table(beta=(0.3, 3.0), n=4, noise=0.1, seed=4)
        return fit(few, Dahl(), throw=False)

    def test_a_limit_counts_every_source_where_the_other_side_is_open(self):
        data = table(beta=(1e-3, 1e-2), n=40, noise=0.01, seed=2)
        found = fit(replace(data, covariance=stated(data.response, 0.01)), Dahl())
        noise, every = (
            found.conf_interval(method, levels=0.9545)["f_max"][0]
            for method in ("profile", "combined")
        )
        row = found.budget()["f_max"]
        (exponent,) = (part.u / row.value for part in row.rows if part.source == "exponent")
        distance = np.hypot(np.log(row.value / noise.lower), row.k * exponent)
        assert every.lower == pytest.approx(row.value * np.exp(-distance), rel=1e-3)
        assert every.upper == noise.upper == np.inf

    @pytest.mark.parametrize("case", ["described", "misfit", "few and noisy"])
    def test_of_every_parameter(self, case):
        found = self.fitted(case)
        intervals, summary = found.conf_interval().at(0.9545), found.summary()
        again = FitResult.from_json(found.to_json())
        for i, name in enumerate(found.var_names):
            p, row, interval = found.params[name], found.budget()[name], intervals[name]
            assert row.value == pytest.approx(p.value, rel=1e-12)
            assert row.u == pytest.approx(p.stderr, rel=1e-9)
            assert found.covar[i, i] ** 0.5 == pytest.approx(p.stderr, rel=1e-9)
            assert sum(part.u**2 for part in row.rows) == pytest.approx(row.u**2, rel=1e-6)
            half = row.k * row.u
            ends = (p.value - half, p.value + half)
            if row.u > 0.2 * p.value:
                ends = (p.value * np.exp(-half / p.value), p.value * np.exp(half / p.value))
            assert (interval.lower, interval.upper) == pytest.approx(ends, rel=1e-6)
            assert tuple(summary.loc[name, ["value", "lower", "upper"]]) == pytest.approx(
                (p.value, *ends), rel=1e-6
            )
            shown = found.identifiability.parameters[name].interval
            assert shown.lower <= p.value <= shown.upper
            assert found.stderr_noise[name] <= p.stderr * (1.0 + 1e-9)
            assert again.params[name].value == pytest.approx(p.value, rel=1e-9)
            assert again.params[name].stderr == pytest.approx(p.stderr, rel=1e-6)

    @pytest.mark.parametrize("case", ["described", "misfit", "few and noisy"])
    def test_of_every_response(self, case):
        found = self.fitted(case)
        law = Dahl(*(found.params[name].value for name in ("f_max", "sigma", "alpha")))
        A = amplitudes(found.data)
        assert {p.name: p.value for p in found.model.parameters} == {
            name: p.value for name, p in found.params.items()
        }
        predicted = found.predict(1.0, amplitude=A), found.describing_function(A)
        for values in (found.best_fit, *(band.response for band in predicted)):
            np.testing.assert_allclose(values, law.describing_function(A), rtol=1e-9)


@pytest.mark.parametrize("name", ["alpha_2", "outliers"])
def test_every_method_begins_at_the_one_estimate(name):
    """Also where the exponent was assumed, and where a misfit counts."""
    result = fit(load_dataset(name), Dahl())
    stated = {p.name: p.value for p in result.model.parameters}
    assert stated == {name: p.value for name, p in result.params.items()}
    for method in ("combined", "wald", "profile", "bootstrap"):
        found = result.conf_interval(method, replicates=99 if method == "bootstrap" else None)
        for i, each in enumerate(found.names):
            value = result.params[each].value
            assert found.estimate[i] == pytest.approx(value)
            assert (found.lower[:, i] < value).all()
            assert (found.upper[:, i] > value).all()


def test_an_open_parameter_has_one_limit_and_no_expanded_uncertainty():
    result = fit(load_dataset("microslip"), Dahl())
    limits = result.conf_interval()["f_max"][1]
    stated = result.budget()["f_max"]
    assert limits.upper == np.inf
    assert stated.limits == (limits.lower, limits.upper)
    assert f"f_max: at least {limits.lower:.3g} N" in str(identifiability(result))
    assert f"at least {limits.lower:.3g}" in str(result.budget())
    assert result.budget().to_dict()["parameters"]["f_max"]["U"] is None


@pytest.mark.parametrize("runs", [2, 3])
def test_an_interval_is_no_narrower_than_the_means_of_few_runs_say(runs):
    """However well they agree: the textbook's t interval of their means covers as often."""
    rng, size = np.random.default_rng(8), 10
    for _ in range(4):
        Z = 5.0 + 0.1 * rng.standard_normal((2, runs * size)).T @ np.array([1.0, 1.0j])
        run = np.repeat(np.arange(runs), size).astype(str)
        data = FrequencyResponse(np.ones(Z.size), Z, np.tile(np.geomspace(1e-3, 1.0, size), runs),
                                 run=run)  # fmt: skip
        limits = fit(data, Spring(), noise="absolute").conf_interval()["stiffness"][1]
        means = Z.real.reshape(runs, size).mean(axis=1)
        error = np.std(means, ddof=1) / np.sqrt(runs)
        least = stats.t.ppf(0.97725, runs - 1) * error
        assert limits.upper - limits.lower > 1.99 * least


def test_profiles_are_searched_only_where_noise_leaves_a_parameter_vague():
    A, rng = np.geomspace(1e-4, 0.1, 12), np.random.default_rng(1)
    N = BoucWen(30.0, 200.0, 150.0).describing_function(A)
    N *= np.exp(0.005 * (rng.standard_normal(12) + 1j * rng.standard_normal(12)))
    found = fit(FrequencyResponse(np.ones(12), N, A), BoucWen())
    assert str(found.verdict).startswith("Trusted")
    p = found.params["p"]  # not a logarithm: its error counts over its size
    assert 1.0 < p.stderr < 0.1 * abs(p.value)
    assert [one.method for one in found.assessment.computed_intervals(0.9545)] == ["combined"]


def test_profiles_do_not_depend_on_what_was_asked_for_before():
    """Profiles by exact steady motions are searched for the parameters that are asked for."""
    known, f, u = Mass(0.3) + Spring(8.0), np.full(4, 0.4), np.geomspace(0.05, 0.1, 4)
    R = response(FRICTION + known + Damper(1.0), f, u).receptance * relative_noise(4, 0.06, 1)
    model = Dahl(alpha=1.0) + known + Damper()
    first, second = (fit(driven(f, R, u, 0.06), model, throw=False) for _ in range(2))
    first.conf_interval(levels=0.6827)
    late, early = (one.conf_interval("profile", 0.6827) for one in (first, second))
    np.testing.assert_allclose(late.lower, early.lower, rtol=1e-6)
    np.testing.assert_allclose(late.upper, early.upper, rtol=1e-6)


def test_repetitions_are_calibrated_again():
    sensors = Sensors(force_gain=stats.norm(1.0, 0.01))
    result = fit(table(n=12, noise=0.005), Dahl(alpha=1.0), sensors=sensors)
    drawn = result.conf_interval("bootstrap", levels=0.9545, replicates=199)
    known = result.conf_interval("combined", levels=0.9545)
    ratio = (drawn.upper - drawn.lower) / (known.upper - known.lower)
    assert (np.abs(ratio - 1.0) < 0.2).all()

"""Verdicts on what data can determine, each on data made to deserve it."""

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident import (
    Backlash,
    Dahl,
    Damper,
    FrequencyResponse,
    Mass,
    PowerDamper,
    Sensors,
    Spring,
    fit,
)
from dahl_ident.diagnostics import Verdict, VerdictStatus, identifiability
from tests.friction_tables import F_MAX, FRICTION, SIGMA, X_C, plant_table, relative_noise, table

IDENTIFIED, WEAK, NOT = Verdict.IDENTIFIED, Verdict.WEAK, Verdict.NOT_IDENTIFIED


def verdicts(result):
    return {name: p.verdict for name, p in identifiability(result).parameters.items()}


def turned(data):
    return FrequencyResponse(data.frequency_hz, data.response, data.amplitude, motion="rotation")


class TestVerdicts:
    def test_every_parameter(self):
        found = identifiability(fit(table(), Dahl()))
        assert found.headline == "Every parameter is identified."
        assert found.complete
        assert found.determined == ("f_max", "sigma")
        assert not found.combinations
        assert not found.direction

    def test_every_parameter_of_a_plant(self):
        result = fit(plant_table(), Dahl() + Mass() + Damper() + Spring())
        assert set(verdicts(result).values()) == {IDENTIFIED}

    def test_sigma_but_not_f_max(self):
        found = identifiability(fit(table(beta=(1e-4, 1e-3)), Dahl(), throw=False))
        assert found.named(NOT) == ["f_max"]
        assert found.headline == "Only sigma is determined; not f_max."
        text = found.parameters["f_max"].text
        assert text.startswith("f_max: at least 0.0")
        assert "no amplitude up to 3.3e-06 m reaches slip: drive above that" in text

    def test_f_max_but_not_sigma(self):
        found = identifiability(fit(table(beta=(1e6, 1e7)), Dahl(), throw=False))
        assert found.named(IDENTIFIED) == ["f_max"]
        assert found.named(NOT) == ["sigma"]
        text = found.parameters["sigma"].text
        assert "every amplitude from 3.3e+03 m slips" in text
        assert "drive below that" in text

    def test_weakly_between(self):
        found = identifiability(fit(table(beta=(1e4, 1e5)), Dahl()))
        assert found.named(WEAK) == ["sigma"]
        assert found.headline == "Every parameter is determined, but sigma only weakly."

    def test_microslip_with_a_spring(self):
        """A spring as stiff as the contact: the loss and the sum of stiffnesses are left."""
        model = FRICTION + Spring(SIGMA)
        data = table(model=model, beta=(1e-2, 1e-1), noise=0.004)
        found = identifiability(fit(data, Dahl(alpha=1.0) + Spring(), throw=False))
        assert set(found.named(NOT)) == {"f_max", "sigma", "stiffness"}
        combined = {c.name: c for c in found.combinations}
        assert set(combined) == {"sigma^2/f_max", "sigma + stiffness"}
        kappa, total = combined["sigma^2/f_max"], combined["sigma + stiffness"]
        assert abs(kappa.value - SIGMA**2 / F_MAX) < 4.0 * kappa.stderr
        assert abs(total.value - 2.0 * SIGMA) < 4.0 * total.stderr
        assert kappa.unit == "N/m^2"
        assert "free stiffness hides it below 0.00033 m" in found.parameters["f_max"].text
        assert found.headline.startswith("Only sigma^2/f_max and sigma + stiffness are determined")

    def test_what_runs_away_determines_only_what_its_limit_says(self):
        """At f_max = infinity the length f_max/sigma has no value, however the search stands.

        The stiffness rises by 1 %, where friction's would fall: no finite limit is as good.
        """
        A = np.geomspace(1e-2, 1e-1, 30) * X_C
        loss = 4j / (3.0 * np.pi) * SIGMA**2 / F_MAX * A
        Z = 2.0 * SIGMA * (1.0 + 0.01 * (A / A[-1]) ** 2) + loss
        data = FrequencyResponse(np.ones(30), Z * relative_noise(30, 0.01, 1), A)
        result = fit(data, Dahl() + Spring(), throw=False)
        assert np.isinf(result.params["f_max"].value)
        assert identifiability(result).determined == ("sigma^2/f_max", "sigma + stiffness")

    def test_a_stiffness_hidden_by_a_spring_is_no_slip(self):
        """f_max and sigma fade together: the reason is the spring, not amplitudes too large."""
        data = table(model=FRICTION + Spring(SIGMA), beta=(1e-2, 1e-1), noise=0.004)
        text = identifiability(fit(data, Dahl() + Spring(), throw=False)).parameters["sigma"].text
        assert "the free stiffness can take its place: drive far into slip" in text

    def test_friction_lost_in_the_noise_gives_no_advice_on_slip(self):
        """Deep slip with a spring: nothing tells it from microslip, so neither is claimed."""
        data = table(model=FRICTION + Spring(SIGMA), beta=(1e3, 1e4), noise=0.01, seed=11)
        result = fit(data, Dahl() + Spring(), throw=False)
        found, stated = identifiability(result).parameters, result.conf_interval()
        _, limits, widest = stated["f_max"]
        assert np.isinf(widest.upper)
        assert not np.isinf(limits.upper)
        assert found["f_max"].interval == limits  # 95.45 %, as for every parameter
        assert "(95.45 %)" in found["f_max"].text
        for name in ("f_max", "sigma"):
            assert found[name].verdict is NOT
            assert "drive" not in found[name].text
            assert "the free stiffness" in found[name].text
            assert "measure the spring and fix stiffness" in found[name].text

    def test_amplitudes_within_the_gap_do_not_show_it(self):
        law = Backlash(Dahl(F_MAX, SIGMA), 10.0 * X_C)
        data = table(model=law + Spring(SIGMA), beta=(1.0, 4.9), n=8)
        found = fit(data, Backlash(Dahl()) + Spring(), throw=False)
        assert found.verdict.startswith("Not determined.")
        assert {"f_max", "sigma", "gap"} <= set(found.identifiability.named(NOT))

    def test_fundamentals_do_not_show_the_sign_of_an_asymmetry(self):
        data = table(model=Dahl(F_MAX, SIGMA, asymmetry=0.35), noise=0.003)
        found = fit(data, Dahl(alpha=1.0, asymmetry=None), throw=False)
        assert found.status == "not determined"
        assert "asymmetry: its size is 0.3" in found.verdict
        assert "measure the mean force or even harmonics too" in found.verdict

    def test_one_amplitude_at_one_frequency_shows_no_exponent(self):
        data = table(model=PowerDamper(2.0, 0.5), beta=(1.0, 1.0), n=8)
        found = fit(data, PowerDamper(), throw=False)
        assert found.verdict.startswith("Not determined. Nothing is determined")
        assert found.identifiability.named(NOT) == ["coefficient", "exponent"]

    def test_one_unknown_makes_no_combination(self):
        """With sigma known, f_max/sigma says no more than f_max, which its profile leaves open."""
        data = table(beta=(0.03, 0.04), n=2, noise=0.01, seed=4)
        found = identifiability(fit(data, Dahl()))
        assert found.determined == ("sigma",)

    def test_only_the_sum_of_stiffnesses(self):
        data = table(model=FRICTION + Spring(SIGMA), beta=(1e-4, 1e-3), noise=0.001, seed=7)
        found = identifiability(fit(data, Dahl(alpha=1.0) + Spring(), throw=False))
        assert found.determined == ("sigma + stiffness",)

    def test_the_exponent_in_microslip(self):
        model = FRICTION + Spring(1.0)
        data = table(model=model, beta=(1e-2, 1e-1), noise=0.004, n=12)
        found = identifiability(fit(data, Dahl(alpha=None) + Spring(), throw=False))
        assert "alpha sigma^2/f_max" in found.determined
        loss = found.combinations[0]
        assert loss.value == pytest.approx(SIGMA**2 / F_MAX, abs=3.0 * loss.stderr)
        assert "alpha" in found.named(NOT)

    def test_an_unknown_force_gain_leaves_x_c(self):
        result = fit(table(), Dahl(), sensors=Sensors(force_gain=None), throw=False)
        found = identifiability(result)
        (x_c,) = found.combinations
        assert x_c.name == "f_max/sigma"
        assert x_c.value == pytest.approx(X_C, rel=0.02)
        assert "calibrate the force channel, or give force_gain a prior" in str(found)

    def test_an_unknown_displacement_gain_leaves_f_max(self):
        result = fit(table(), Dahl(), sensors=Sensors(displacement_gain=None), throw=False)
        found = identifiability(result)
        assert found.determined == ("f_max",)
        assert set(found.direction) == {"sigma", "displacement_gain"}
        sigma, gain = found.direction["sigma"], found.direction["displacement_gain"]
        assert abs(sigma) == pytest.approx(abs(gain), rel=1e-3)
        assert "calibrate the displacement channel" in str(found)

    def test_a_prior_on_the_gain_restores_everything(self):
        sensors = Sensors(force_gain=stats.norm(1.0, 0.005))
        found = identifiability(fit(table(), Dahl(), sensors=sensors))
        assert found.complete

    def test_two_elements_where_one_suffices(self):
        model = Dahl(name="a") + Dahl(name="b")
        found = identifiability(fit(table(seed=2), model, throw=False))
        assert not found.complete
        assert "can take its place: leave one of the two elements out" in str(found)

    def test_a_damper_hidden_by_noise_is_bounded_not_unknown(self):
        """Its value is zero within its error, but that error is small against the response."""
        f = np.repeat([1.0, 10.0], 15)
        A = np.tile(np.geomspace(0.1, 10.0, 15), 2) * X_C
        N = FRICTION.describing_function(A) * relative_noise(30, 0.001, 1)
        found = verdicts(fit(FrequencyResponse(f, N, A), Dahl() + Damper()))
        assert set(found.values()) == {IDENTIFIED}

    def test_one_point_without_covariance_leaves_the_noise_unknown(self):
        found = identifiability(fit(table(n=1, beta=(1.0, 1.0)), Dahl()))
        assert found.named(NOT) == ["f_max", "sigma"]
        for parameter in found.parameters.values():
            assert "because no residual is left from which to estimate the noise" in parameter.text
            assert "slip" not in parameter.text

    def test_copies_of_rows_tell_nothing_new(self):
        data = table(n=6)
        row = data.select(rows=np.arange(6) == 3)
        once, often = fit(data, Dahl()), fit(FrequencyResponse.concatenate([data] * 4), Dahl())
        assert often.summary().equals(once.summary())
        assert "18 of 24 rows are copies of others, identical to the digit" in often.verdict
        one = fit(FrequencyResponse.concatenate([row] * 6), Dahl())
        assert one.status is VerdictStatus.NOT_DETERMINED
        assert "2 numbers and 2 parameters leave no degree of freedom" in one.verdict
        assert set(verdicts(one).values()) == {NOT}

    def test_rotation_has_its_units(self):
        found = identifiability(fit(turned(table(beta=(1e-4, 1e-3))), Dahl(), throw=False))
        assert " N m (95.45 %)" in found.parameters["f_max"].text
        assert "up to 3.3e-06 rad reaches slip" in found.parameters["f_max"].text
        data = table(model=FRICTION + Spring(SIGMA), beta=(1e-2, 1e-1), noise=0.004)
        found = identifiability(fit(turned(data), Dahl(alpha=1.0) + Spring(), throw=False))
        assert [c.unit for c in found.combinations] == ["N m/rad^2", "N m/rad"]

    @pytest.mark.parametrize(
        "seed", [0, *(pytest.param(s, marks=pytest.mark.long) for s in (6, 9, 10))]
    )
    def test_friction_that_does_not_show_leaves_the_stiffness_seen(self, seed):
        """Where friction may as well be none, sigma and its sum with the spring have no end."""
        data = table(model=FRICTION + Spring(30.0), beta=(1e-3, 1e-2), seed=seed)
        found = identifiability(fit(data, Dahl(alpha=1.0) + Spring(), throw=False))
        (seen,) = found.combinations
        assert seen.name == "the stiffness seen at 1.05e-05 m"
        assert found.headline == f"Only {seen.name} is determined; not f_max, sigma and stiffness."
        middle = np.sqrt(1e-3 * 1e-2) * X_C
        truth = FRICTION.describing_function(middle).real + 30.0
        assert seen.value == pytest.approx(truth, abs=3.0 * seen.stderr)
        of_mean = 0.01 * truth / np.sqrt(30.0)  # by noise alone; other sources may add to it
        assert 0.7 * of_mean < seen.stderr < 4.0 * of_mean
        assert seen.unit == "N/m"


class TestTheory:
    """The table of what data can determine: Cramer-Rao bounds, reached by our Fisher matrix."""

    @pytest.mark.parametrize(
        ("start", "f_max", "sigma"),
        [(0.001, 0.91, 0.002), (0.01, 0.09, 0.002), (10.0, 0.002, 0.014), (100.0, 0.002, 0.046)],
    )
    def test_friction_alone(self, start, f_max, sigma):
        data = table(beta=(start, 10.0 * start), noise=0.0)
        problem = fit(data, Dahl()).problem
        information = problem.information(problem.to_search([F_MAX, SIGMA]), 0.01)
        bound = np.sqrt(np.diagonal(np.linalg.inv(information)))
        assert bound[0] == pytest.approx(f_max, rel=0.25)
        assert bound[1] == pytest.approx(sigma, rel=0.25)

    def test_intervals_have_that_bound(self):
        found = fit(table(beta=(0.01, 0.1)), Dahl())
        assert found.optimum.stderr["f_max"] / F_MAX == pytest.approx(0.09, rel=0.25)
        limits = found.conf_interval("profile", levels=(0.9545,))["f_max"][0]
        assert 0.25 * np.log(limits.upper / limits.lower) == pytest.approx(0.09, rel=0.35)


# Parameters that could be exchanged without a difference are not called identified.

ROWS = 6  # of a harmonic; the loop of each is integrated in every step


class PullPush(di.Friction):
    """Linear Dahl with a limit for pulling and one for pushing: the mirrored law exchanges them."""

    parameters = tuple(
        di.Parameter(name, unit, name, lower=0.0, transform="log")
        for name, unit in (("pull", "N"), ("push", "N"), ("sigma", "N/m"))
    )

    def slope(self, force, direction, velocity, values):
        pull, push, sigma = values
        return sigma * (1.0 - direction * force / (pull * (direction > 0) + push * (direction < 0)))


def data(harmonics, pull, push):
    rng = np.random.default_rng(5)
    A = np.tile(np.geomspace(1e-3, 3e-2, ROWS), len(harmonics))
    k = np.repeat(harmonics, ROWS)
    law = PullPush(pull, push, 30.0)
    Z = np.array([law.dynamic_stiffness(a, harmonic=int(n)) for a, n in zip(A, k, strict=True)])
    size = np.abs(np.tile(Z[:ROWS], len(harmonics)))
    Z = Z + 0.005 * size * (rng.standard_normal(A.size) + 1j * rng.standard_normal(A.size))
    Z[k == 0] = Z[k == 0].real
    return di.FrequencyResponse(
        np.ones(A.size), Z, A, quantity="dynamic_stiffness", harmonic=k,
        covariance=np.tile((0.005 * size)[:, None, None] ** 2 * np.eye(2), (1, 1, 1)),
    )  # fmt: skip


def test_the_fundamental_leaves_the_order_open_and_the_verdict_says_so():
    fit = di.fit(data((1,), 0.06, 0.14), PullPush(), throw=False)
    found = fit.identifiability
    assert found.named(Verdict.NOT_IDENTIFIED) == ["pull", "push"]
    assert found.parameters["sigma"].verdict is Verdict.IDENTIFIED
    assert not fit.trusted
    assert "pull and push are exchangeable: these data are the same for either" in fit.verdict
    assert sorted(fit.optimum.values[:2]) == pytest.approx([0.06, 0.14], rel=0.05)
    assert not found.direction


def test_even_harmonics_decide_it():
    fit = di.fit(data((1, 2), 0.06, 0.14), PullPush(), throw=False)
    assert "exchangeable" not in fit.verdict
    assert fit.identifiability.complete
    assert fit.optimum.values[:2] == pytest.approx([0.06, 0.14], rel=0.05)


def test_parameters_of_other_kinds_are_not_exchanged():
    fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    assert "exchangeable" not in fit.verdict

"""What a fit says: whether to trust it, in the fewest words that hold."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident import (
    Backlash,
    BoucWen,
    Dahl,
    Damper,
    FrequencyResponse,
    Mass,
    MaxwellSlip,
    Sensors,
    Spring,
    compare_models,
    fit,
    load_dataset,
    report,
    response,
)
from dahl_ident.diagnostics import Verdict
from tests.friction_tables import FRICTION, X_C, driven, relative_noise, stated, table

STEPS = np.geomspace(1e-3, 1e-1, 8)  # too few rows for a comparison of bands


def stiffened(rise, noise=0.01, seed=1):
    """Return microslip on a spring whose stiffness rises by a share over the upper half."""
    A = np.geomspace(1e-3, 1e-1, 48) * X_C
    N = FRICTION.describing_function(A)
    upper = np.clip(np.log(A / A[24]) / np.log(A[-1] / A[24]), 0.0, 1.0)
    N = N * relative_noise(48, noise, seed) + 30.0 * rise * upper
    return FrequencyResponse(np.ones(48), N, A)


def rise(data, model=None):
    """Return the rise of stiffness with the amplitude that a fit's goodness holds, or None."""
    made = fit(data, model or Dahl(alpha=1.0) + Spring(), throw=False)
    return next(iter(made.goodness.of("stiffening")), None)


class TestStiffening:
    def test_size_and_place_of_a_rise(self):
        found = rise(stiffened(0.2))
        assert found.values["rise"] == pytest.approx(0.17, abs=0.02)
        assert found.values["low"] < 0.02 * X_C < 0.06 * X_C < found.values["high"]
        assert found.p_value < 1e-9

    def test_the_verdict_says_so(self):
        result = fit(stiffened(0.2), Dahl(alpha=1.0) + Spring(), throw=False)
        assert "stiffness rises with amplitude, by" in result.verdict
        assert "which this law cannot describe" in result.verdict

    def test_noise_alone_seldom_looks_so(self):
        made = [rise(stiffened(0.0, noise=0.05, seed=seed)) for seed in range(30)]
        p = np.array([1.0 if one is None else one.p_value for one in made])
        assert np.mean(p < 0.05) < 0.1

    def test_other_exponents_do_not_look_so(self):
        for alpha in (0.3, 1.0, 2.0):
            found = rise(table(model=Dahl(0.1, 30.0, alpha=alpha)), Dahl(alpha=1.0))
            assert found is None or found.p_value > 0.01

    def test_a_free_mass_takes_a_degree_of_freedom_and_other_elements_none(self):
        A = np.repeat([1e-3, 1e-1], 5) * np.tile(np.geomspace(1.0, 1.05, 5), 2) * X_C
        Z = np.repeat([30.0, 36.0], 5) * (1.0 + 0.01j) * relative_noise(10, 1e-3, 1)
        data = FrequencyResponse(np.ones(10), Z, A)
        assert rise(data, Dahl(alpha=1.0) + Spring()).values["rise"] == pytest.approx(0.2, abs=0.01)
        assert rise(data, Dahl(alpha=1.0) + Spring() + Mass()) is None

    def test_it_needs_friction_and_points(self):
        assert rise(stiffened(0.2), Spring()) is None
        assert rise(table(n=4), Dahl(alpha=1.0)) is None
        few = FrequencyResponse(np.ones(8), np.geomspace(30.0, 1.0, 8) * (1.0 + 0.2j), STEPS)
        assert rise(few, Dahl(alpha=1.0) + Spring() + Mass()) is None


class TestSuspiciousRows:
    def test_rows_that_alone_contradict_ask_for_no_element(self):
        codes = {f.code for f in fit(load_dataset("outliers"), Dahl(), throw=False).findings}
        assert "rows_apart" in codes
        assert "beyond_slip" not in codes

    def test_most_rows_are_not_outliers(self):
        found = fit(load_dataset("alpha_2"), Dahl(alpha=1.0), loss="student_t", throw=False)
        codes = {f.code for f in found.findings}
        assert "misfit" in codes
        assert not codes & {"rows_apart", "suspicious"}


class TestTrust:
    def test_two_points_leave_noise_and_model_alike(self):
        result = fit(table(n=2, noise=0.03), Dahl())
        assert result.identifiability.complete
        assert not result.trusted
        assert "With 2 degrees of freedom a wrong model cannot be distinguished" in result.verdict
        assert "measure more points, or repeat them" in result.verdict

    def test_two_points_of_known_noise_are_judged_by_it(self):
        data = table(n=2, noise=0.01, seed=3)
        known = replace(data, covariance=stated(data.response, 0.01))
        assert fit(known, Dahl()).goodness.judged

    def test_one_amplitude_does_not_test_the_model(self):
        """A spring and a damper without any friction, which two parameters meet all the same."""
        f, A = np.ones(12), np.full(12, 1e-3)
        damped = FrequencyResponse(f, (20.0 + 5.0j) * relative_noise(12, 0.01, 1), A)
        result = fit(damped, Dahl(alpha=1.0))  # with the exponent open, f_max is so as well
        assert result.identifiability.complete
        assert not result.goodness.judged
        assert "so any model fits" in result.verdict
        both = np.where(np.arange(12) < 6, 1e-3, 2e-3)
        tested = fit(FrequencyResponse(f, damped.response, both), Dahl())
        assert tested.goodness.judged
        assert tested.status.value == "not described"  # there is no friction
        assert "does not describe these data" in tested.verdict

    def test_harmonics_test_the_model_at_one_amplitude(self):
        """Two parameters, and four numbers of the fundamental and the third harmonic."""
        k, law = np.tile([1, 3], 6), Dahl(0.1, 30.0)
        exact = np.array([complex(law.dynamic_stiffness(5e-3, harmonic=order)) for order in k])
        response = exact * relative_noise(12, 0.01, 1)
        data = FrequencyResponse(np.ones(12), response, np.full(12, 5e-3), harmonic=k)
        assert fit(data, Dahl(alpha=1.0), throw=False).goodness.judged

    def test_a_law_that_another_one_replaces_is_not_described(self):
        """Of two Jenkins elements one slips at every level: sigma would be half the truth."""
        A = np.geomspace(1.0, 20.0, 8) * X_C
        law = MaxwellSlip([0.3 * X_C, 2.4 * X_C], [20.0, 10.0])
        N = law.describing_function(A) * relative_noise(8, 0.01, 11)
        result = fit(FrequencyResponse(np.ones(8), N, A, covariance=stated(N, 0.01)), Dahl())
        assert 0.05 < result.goodness.rms_misfit < 0.2
        assert result.status.value == "not described"
        assert "law of parallel Jenkins elements (MaxwellSlip, Iwan) leaves 0." in result.verdict

    @pytest.mark.parametrize("noise", ["relative", "absolute"])
    def test_a_scatter_that_no_sensor_has(self, noise):
        result = fit(table(n=12), Spring(), noise=noise)
        assert not result.trusted
        assert "% of the response, more than any sensor's noise" in result.verdict

    def test_much_noise_is_borne(self):
        result = fit(table(n=60, noise=0.1), Dahl())
        assert result.trusted
        assert result.goodness.noise_share == pytest.approx(0.1, rel=0.2)


class TestWords:
    @staticmethod
    @functools.cache
    def unlimited():
        return fit(table(beta=(1e-3, 1e-2), seed=3), Dahl() + Spring(), throw=False)

    def test_an_optimum_at_infinity_is_said_once(self):
        result = self.unlimited()
        assert result.fit_report().count("No finite optimum: ") == 1
        assert result.verdict.count("sigma + stiffness =") == 1
        assert "Here:" not in result.verdict
        assert "Here: f_max without bound" in result.message

    def test_what_is_determined_comes_first_with_its_number(self):
        first, second, *_ = self.unlimited().statements
        assert first.startswith("Not determined. Only ")
        assert second.startswith("Determined: ")
        assert "sigma + stiffness = 30." in second

    def test_each_statement_has_its_line(self):
        result = self.unlimited()
        lines = result.fit_report().splitlines()
        assert tuple(line.strip() for line in lines[1 : 1 + len(result.statements)]) == (
            result.statements
        )

    def test_parameters_without_any_limit_give_way_to_those_with_one(self):
        known = self.unlimited().identifiability
        assert len(known.open) < len(known.parameters)
        assert all("anything" not in parameter.reason for parameter in known.open)

    def test_one_chi_square(self, tmp_path):
        data = table(n=12)
        rough = replace(data, covariance=stated(data.response, 0.01), dof=np.full(12, 4.0))
        found = fit(rough, Dahl())
        text = found.fit_report()
        assert text.count("chi-square ") == 1 + text.count("and chi-square")
        assert f"chi-square {found.chisqr:.4g} with {found.nfree} degrees of freedom" in text
        assert found.redchi == pytest.approx(found.chisqr / found.nfree)
        assert "sum of squares" not in text
        for place in ("r.md", "r.json"):
            report(found, tmp_path / place)
        assert "sum of squares" not in (tmp_path / "r.md").read_text("utf-8")
        shown = json.loads((tmp_path / "r.json").read_text("utf-8"))["fits"][0]
        assert shown["redchi"] == pytest.approx(found.redchi)


class TestComparison:
    def test_chance_does_not_make_another_model_the_best(self):
        for seed in range(3):
            found = compare_models(fit(table(seed=seed), Dahl()))
            assert found.best is found.models[0]

    def test_an_element_without_a_number_is_named(self):
        found = compare_models(fit(table(noise=0.0), Dahl()))
        (two,) = (m for m in found.models if m.name == "two Dahl elements")
        assert "not determined" in two.estimates
        assert "?" not in two.estimates

    def test_a_better_model_that_is_absurd_is_said_to_be(self):
        maker = FRICTION + Spring(-3.0)
        found = compare_models(fit(table(model=maker), Dahl()))
        assert found.best.name == "spring added"
        assert "There stiffness is negative" in found.headline


def _scattered(seed, off=1.0):
    """Return 16 rows with 1 % of noise, two of them off by a factor."""
    A = np.geomspace(1e-4, 1e-2, 16)
    rng = np.random.default_rng(seed)
    noise = 0.01 * (rng.standard_normal(16) + 1j * rng.standard_normal(16))
    R = Dahl(0.1, 30.0).describing_function(A) * np.exp(noise)
    R[rng.choice(16, 2, replace=False)] *= off
    return FrequencyResponse(np.ones(16), R, A)


def test_a_robust_fit_that_moves_an_estimate_is_said_without_suspicious_rows():
    fitted = fit(_scattered(22, 1.1), Dahl())
    assert not fitted.goodness.suspicious
    assert "A robust fit moves sigma by more than one standard uncertainty" in fitted.verdict
    assert str(fitted.status) == "approximate"
    assert fit(_scattered(22), Dahl()).trusted


def test_what_only_a_prior_determines_is_not_called_identified():
    tight = fit(_scattered(3), Dahl(), sensors=Sensors(force_gain=stats.norm(1.0, 0.01)))
    known = tight.identifiability
    assert known.headline == "f_max and sigma are identified; force_gain is known from its prior."
    assert known.parameters["force_gain"].text.endswith("known from its prior")
    assert known.named(Verdict.IDENTIFIED) == ["f_max", "sigma"]
    assert tight.trusted
    # with friction known, the data say far more of the gain than a wide prior
    seen = fit(
        _scattered(3), Dahl(0.1, 30.0, 1.0), sensors=Sensors(force_gain=stats.norm(1.0, 0.3))
    )
    assert seen.identifiability.headline == "Every parameter is identified."


def test_a_prior_that_the_data_contradict_is_named():
    data = _scattered(3)
    data = replace(data, response=1.1 * data.response)
    against = fit(data, Dahl(f_max=0.1), sensors=Sensors(force_gain=stats.norm(1.0, 0.01)))
    assert "The data contradict the prior of force_gain: 1.0" in against.verdict
    off = (against.optimum.values[-1] - 1.0) / 0.01
    assert f"{off:.1f} standard deviations" in against.verdict
    assert not against.trusted


def test_bands_need_not_cover_a_force_in_parallel_on_which_they_are_centred():
    """A weak damper that the model does not have: held-out rows are predicted all the same."""
    f, A = np.repeat(np.geomspace(1.0, 20.0, 6), 6), np.tile(np.geomspace(5e-4, 2e-2, 6), 6)
    exact = (Dahl(0.1, 30.0) + Damper(0.0025)).dynamic_stiffness(A, 2.0 * np.pi * f)
    data = FrequencyResponse(f, exact * relative_noise(36, 0.002, 1), A)
    codes = {finding.code for finding in fit(data, Dahl(alpha=1.0), throw=False).findings}
    assert {"misfit", "held_out"} <= codes
    assert "narrow_bands" not in codes


def test_a_free_delay_states_the_gain_that_it_assumes():
    data = load_dataset("delayed")
    delayed = fit(data, Dahl(), sensors=Sensors(delay=None), throw=False)
    assert "; force calibration and displacement calibration exact" in delayed.verdict
    assert "force_gain" not in delayed.verdict  # it is said once


class TestNamed:
    """What makes a result doubtful has a sentence, and is in the status."""

    def test_a_force_that_friction_cannot_carry(self):
        """A sinusoidal force above the limit, with nothing else to carry it."""
        A = np.geomspace(0.1, 20.0, 14) * X_C
        N = FRICTION.describing_function(A) * relative_noise(14, 0.01, 1)
        for strongest, named in ((0.09, False), (0.12, True)):
            kept = np.abs(N) * A < strongest
            data = driven(np.ones(kept.sum()), 1.0 / N[kept], (np.abs(N) * A)[kept])
            found = fit(data, Dahl(), steady="describing function", throw=False)
            assert ("the force held exceeds friction's limit (0." in found.verdict) is named
            if named:
                assert not found.trusted

    def test_at_a_resonance_harmonics_of_friction_are_carried(self):
        """Mass and spring cancel there, but not at the harmonics that friction has."""
        plant = Dahl(15.0, 2e6, 1.0) + Mass(40.0) + Damper(300.0) + Spring(2e5)
        f = np.tile(np.linspace(9.0, 14.0, 6), 4)
        u = np.repeat([6.0, 12.0, 18.4, 60.0], 6)
        R = response(plant, f, u).receptance * relative_noise(24, 0.005, 3)
        model = Dahl(alpha=1.0) + Mass(40.0) + Damper() + Spring()
        found = fit(driven(f, R, u, 0.005, level=u), model)
        assert "beyond_limit" not in {one.code for one in found.findings}
        assert found.trusted

    def test_points_that_were_all_flagged(self):
        flawed = np.array(["not settled"] * 30)
        every = fit(replace(table(), quality={"verdict": flawed}), Dahl())
        assert str(every.status) == "not determined"
        assert "The extraction flagged every point fitted (" in every.verdict
        flawed[3:] = "good"
        some = fit(replace(table(), quality={"verdict": flawed}), Dahl())
        assert str(some.status) == "approximate"
        assert "The extraction flagged 3 of the points fitted (" in some.verdict

    @pytest.mark.parametrize("column", ["level", "run", "tension"])
    def test_devices_in_one_table(self, column):
        tensions = [20, 40, 60]
        A = np.geomspace(0.3, 10.0, 10) * X_C
        R = np.outer(tensions, FRICTION.describing_function(A)).ravel() / 40.0
        labels = np.repeat([f"{t} lb" for t in tensions], 10)
        data = FrequencyResponse(
            np.ones(30), R * relative_noise(30, 0.01, 2), np.tile(A, 3),
            level=labels if column == "level" else None, run=labels if column == "run" else None,
            quality={column: labels} if column == "tension" else None,
        )  # fmt: skip
        found = fit(data, Dahl())
        assert str(found.status) == "not described"
        expected = "the runs differ (gain by" if column == "run" else f"gain differs with {column}:"
        assert expected in found.verdict
        assert "parallel Jenkins" not in found.verdict

    @pytest.mark.parametrize(
        ("order", "seen"),
        [(np.arange(12), False), (np.arange(12)[::-1], False), (np.arange(12) * 5 % 12, True)],
    )
    def test_a_drift_that_cannot_be_told_from_the_amplitude_is_named(self, order, seen):
        A = (np.geomspace(0.1, 10.0, 12) * X_C)[order]
        N = FRICTION.describing_function(A) * relative_noise(12, 0.01, 3)
        (assumed,) = (t for t in fit(FrequencyResponse(np.ones(12), N, A), Dahl()).verdict.split(
            ". ") if t.startswith("Assumed"))  # fmt: skip
        assert assumed.endswith("a single run." if seen else "a single run without drift.")
        assert len(assumed.split()) <= 25

    def test_gains_and_phases_that_were_held_out(self):
        found = fit(_scattered(22, 1.1), Dahl())
        check = found.cross_validation
        assert check.rows == 16
        text = f"{check.gains} of 16 held-out gains and {check.phases} of 16 phases of fundamentals"
        assert text in found.fit_report()

    def test_the_verdict_is_five_sentences_and_the_rest_stands_below(self):
        """Runs that differ, rows that were flagged or are suspicious, and a wrong law."""
        law = MaxwellSlip([0.3 * X_C, 3.0 * X_C], [25.0, 8.0])
        A = np.tile(np.geomspace(0.3, 10.0, 12) * X_C, 2)
        R = law.describing_function(A) * relative_noise(24, 0.01, 4) * np.repeat([1.0, 1.1], 12)
        R[5] *= 1.3
        data = FrequencyResponse(
            np.ones(24), R, A, run=np.repeat(["a", "b"], 12),
            quality={"verdict": np.array(["not settled", *["good"] * 23])},
        )  # fmt: skip
        found = fit(data, Dahl() + Spring())
        assert len(found.findings) > 5
        assert len(found.judgement.shown) == 5
        below = found.fit_report().partition("Further findings")[2]
        shorter = [text for text in map(str, found.findings) if text not in found.verdict]
        assert len(shorter) == len(found.findings) - 5
        assert all(text in below for text in shorter)
        assert all(len(text.split()) <= 35 for text in map(str, found.judgement.shown))

    @pytest.mark.parametrize("law", [
        MaxwellSlip([0.3 * X_C, 3.0 * X_C], [25.0, 8.0]),
        BoucWen(30.0, 300.0, 300.0, exponent=2.0),
        pytest.param(Backlash(FRICTION, 0.5 * X_C), marks=pytest.mark.long),
    ])  # fmt: skip
    def test_another_law_is_not_described_however_many_its_harmonics(self, law):
        """Or the limit of its force is within the interval: Bouc-Wen's loop is near to Dahl's."""
        rng = np.random.default_rng(3)
        A = np.geomspace(0.3, 10.0, 12) * X_C
        size = 0.01 * np.abs(law.dynamic_stiffness(A))
        noise = size * (rng.standard_normal((2, 12)) + 1j * rng.standard_normal((2, 12)))
        R = noise + np.array([law.dynamic_stiffness(A, harmonic=k) for k in (1, 3)])
        data = FrequencyResponse(
            np.ones(24), R.ravel(), np.tile(A, 2), harmonic=np.repeat([1, 3], 12),
            covariance=np.tile(size, 2)[:, None, None] ** 2 * np.eye(2),
        )  # fmt: skip
        one, both = (fit(data.select(rows=data.harmonic <= k), Dahl(), throw=False) for k in (1, 3))
        assert both.status.rank >= one.status.rank
        for found in (one, both):
            _, low, high = found.conf_interval()["f_max"][1]
            assert str(found.status) == "not described" or low < 0.1 < high


class TestFindings:
    def test_the_status_is_the_worst_severity(self):
        for data in (table(), table(n=2, noise=0.03), stiffened(0.2), table(beta=(1e-3, 1e-2))):
            result = fit(data, Dahl(), throw=False)
            assert result.status == max(
                (finding.severity for finding in result.findings), key=lambda status: status.rank
            )

    def test_they_are_data_and_their_text_is_the_verdict(self):
        wrong = fit(load_dataset("alpha_2"), Dahl(alpha=1.0), throw=False)
        (misfit,) = (finding for finding in wrong.findings if finding.code == "misfit")
        assert misfit.question.value == "described"
        assert misfit.values["rms"] == pytest.approx(0.11, abs=0.005)
        assert str(misfit) in wrong.verdict
        record = misfit.to_dict()
        assert record["severity"] == "not described"
        assert record["text"] == str(misfit)

    def test_an_unusable_result_does_not_list_what_is_assumed(self):
        wrong = fit(load_dataset("alpha_2"), Dahl(alpha=1.0), throw=False)
        assert any(finding.code == "assumed" for finding in wrong.findings)
        assert "Assumed:" not in wrong.verdict
        assert "Assumed:" in fit(table(), Dahl()).verdict


class TestDescribed:
    """The status of laws and devices that one Dahl element is not; never better without noise."""

    @staticmethod
    def status(N, A, *, known, run=None):
        noisy = N * relative_noise(len(A), 0.01, 4)
        C = stated(noisy, 0.01) if known else None
        data = FrequencyResponse(np.ones(len(A)), noisy, A, covariance=C, run=run)
        return fit(data, Dahl(), throw=False)

    @pytest.mark.parametrize("known", [True, False])
    @pytest.mark.parametrize(
        "law",
        [
            BoucWen(30.0, 300.0, 300.0, exponent=2.0),
            MaxwellSlip([2e-3, 5e-3], [20.0, 12.0]),
            Dahl(0.1, 30.0, alpha=0.265),
        ],
    )
    def test_another_law_is_not_trusted(self, law, *, known):
        """Unless twelve rows of unknown noise look like the law, and its numbers are right."""
        A = X_C * np.geomspace(0.1, 10.0, 12)
        found = self.status(law.describing_function(A), A, known=known)
        limits = found.conf_interval()
        right = all(
            limits[name][1].lower < value < limits[name][1].upper
            for name, value in (("f_max", 0.1), ("sigma", 30.0))
        )
        assert not found.trusted or (not known and right)

    @pytest.mark.parametrize("known", [True, False])
    def test_several_devices_are_not_one(self, *, known):
        limits, A = 0.1 * np.geomspace(0.4, 1.7, 6), X_C * np.geomspace(0.2, 8.0, 8)
        N = np.concatenate([Dahl(f, 300.0 * f).describing_function(A) for f in limits])
        run = np.repeat([f"band {i}" for i in range(6)], 8)
        result = self.status(N, np.tile(A, 6), known=known, run=run)
        assert result.status == "not described"
        assert "the runs differ (gain by" in result.verdict

    def test_harmonics_of_another_law_do_not_move_the_estimate(self):
        A, law = X_C * np.geomspace(0.1, 10.0, 12), MaxwellSlip([2e-3, 5e-3], [20.0, 12.0])
        own = [np.asarray(p.value) for p in law.parameters]
        exact = np.concatenate([law.stiffness(own, A, np.zeros(()), k) for k in (1, 3, 5)])
        size = 1e-3 * np.abs(np.tile(exact[:12], 3))
        data = FrequencyResponse(
            np.ones(36), exact + size * (relative_noise(36, 0.7, 4) - 1.0), np.tile(A, 3),
            harmonic=np.repeat([1, 3, 5], 12), covariance=size[:, None, None] ** 2 * np.eye(2),
        )  # fmt: skip
        first, every = fit(data.select(harmonic=1), Dahl()), fit(data, Dahl())
        for name in ("f_max", "sigma"):
            before, after = first.params[name], every.params[name]
            assert after.value == pytest.approx(before.value, abs=before.stderr)


# Masses and dampers that fits of tables find and no device has: said in the verdict.


def device_table(device, seed=0, noise=0.005):
    """Return the response of a device at twelve amplitudes and three frequencies, with noise."""
    rng = np.random.default_rng(seed)
    A, f = (v.ravel() for v in np.meshgrid(np.geomspace(1e-3, 2e-2, 12), [0.5, 1.0, 2.0]))
    Z = sum(
        e.stiffness([np.asarray(v) for v in e.known_values()], A, 2.0 * np.pi * f)
        for e in di.elements.Model(device).elements
    )
    scatter = 1.0 + noise * rng.standard_normal((A.size, 2)) @ [1.0, 1.0j]
    return di.FrequencyResponse(f, Z * scatter, A)


def test_a_negative_damper_is_said_with_what_to_do():
    device = di.Dahl(0.1, 30.0) + di.Damper(-0.1)
    fit = di.fit(device_table(device), di.Dahl() + di.Damper(), throw=False)
    assert not fit.trusted
    damping = fit.params["damping"]
    assert abs(damping.value + 0.1) < 3.0 * damping.stderr
    assert f"damping is negative ({damping.value:.4f}" in fit.verdict
    assert "leave the damper out" in fit.verdict
    sound = di.fit(device_table(di.Dahl(0.1, 30.0) + di.Damper(0.1), 1), di.Dahl() + di.Damper())
    assert sound.trusted
    assert "negative" not in sound.verdict


def test_a_mass_that_rests_on_less_than_the_misfit_is_not_determined():
    law = di.Dahl(0.05, 20.0, name="a") + di.Dahl(0.05, 6.0, name="b") + di.Mass(3e-3)
    fit = di.fit(device_table(law, noise=0.02), di.Dahl() + di.Mass(), throw=False)
    assert fit.status.value == "not described"  # two laws, and one was fitted
    assert "not mass" in fit.verdict
    assert "not determined, because of model error" in fit.verdict
    heavy = di.fit(device_table(law + di.Mass(3.0, name="b"), noise=0.02), di.Dahl() + di.Mass())
    assert "because of model error" not in heavy.verdict


def test_friction_in_one_direction_only_is_doubted():
    """By the law itself, of tables as of records."""
    found = di.fit(di.load_dataset("noisy"), di.Dahl(asymmetry=0.9999), throw=False)
    assert "asymmetry leaves almost no friction in one direction" in found.verdict

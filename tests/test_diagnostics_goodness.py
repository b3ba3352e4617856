"""Tests of tests: they stay silent over noise, and speak of what was put into the data."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, compare_models, fit, response
from dahl_ident.diagnostics import Goodness
from dahl_ident.errors import ValidationError
from dahl_ident.fitting import Status
from tests.friction_tables import (
    FRICTION,
    PLANT,
    X_C,
    amplitudes,
    driven,
    plant_table,
    relative_noise,
    stated,
    table,
)


def judge(data, **options):
    found: Goodness = fit(data, Dahl(alpha=1.0), throw=False, **options).goodness
    return found


def swept_table(fall, noise=0.01, seed=1):
    """Return friction whose stiffness falls by a share from 0.25 to 2 Hz."""
    f = np.repeat([0.25, 0.5, 1.0, 2.0], 8)
    A = np.tile(np.geomspace(0.1, 10.0, 8) * X_C, 4)
    N = FRICTION.describing_function(A)
    slope = np.log(1.0 - fall) / np.log(8.0)
    N = N.real * (f / 0.25) ** slope + 1j * N.imag
    return FrequencyResponse(f, N * relative_noise(32, noise, seed), A)


class TestSilence:
    def test_p_values_are_uniform_and_alarms_are_rare(self):
        found = [judge(table(seed=seed, n=8 + 22 * (seed % 2))) for seed in range(60)]
        # of 60: at 1, 5 and 2 % more than these come once in 3,000, 1,000 and 1,000 times
        assert sum(not g.acceptable for g in found) <= 4
        assert 1 <= sum(bool(g.hints) for g in found) <= 9
        for p in (
            [g.of("trend")[0].p_value for g in found],
            [t.p_value for g in found for t in g.of("exponent")],
        ):
            assert stats.kstest(p, "uniform").pvalue > 1e-3
        runs = [g.of("runs")[0].p_value for g in found if g.of("runs")]
        assert np.mean(np.array(runs) < 0.05) < 0.09
        assert sum(bool(g.suspicious) for g in found) <= 5

    def test_signs_of_few_rows_are_not_counted(self):
        assert not judge(table(n=8)).of("runs")
        assert judge(table(n=12)).of("runs")

    def test_known_noise(self):
        data = table(seed=2)
        found = judge(replace(data, covariance=stated(data.response, 0.01)))
        (test,) = found.of("chi-square")
        assert test.p_value == pytest.approx(stats.chi2(58).sf(test.values["value"]))
        assert found.acceptable

    @pytest.mark.parametrize("dof", [4.0, pytest.param(12.0, marks=pytest.mark.long)])
    def test_noise_known_with_few_degrees_of_freedom(self, dof):
        """Covariances as rough as a few cycles give: chi-square keeps its distribution."""
        rng = np.random.default_rng(5)
        values = []
        for seed in range(30):
            data = table(seed=seed, noise=0.01)
            s2 = (0.01 * np.abs(data.response)) ** 2
            factors = rng.standard_normal((30, int(dof), 2))
            C = np.einsum("nki,nkj->nij", factors, factors) / dof * s2[:, None, None]
            found = judge(replace(data, covariance=C, dof=np.full(30, dof)))
            values.append(found.of("chi-square")[0].p_value)
        assert np.sum(np.array(values) < 0.05) <= 5  # of 30: more come once in 300 times
        assert np.mean(values) == pytest.approx(0.5, abs=0.15)

    def test_a_driven_plant(self):
        result = fit(plant_table(), Dahl() + Mass() + Damper() + Spring())
        assert result.goodness.acceptable
        assert {t.about for t in result.goodness.of("trend")} == {"amplitude", "frequency", "drive"}


class TestDepartures:
    def test_a_trend_with_frequency_has_its_size(self):
        found = judge(swept_table(0.28))
        (trend,) = (t for t in found.of("trend") if t.about == "frequency")
        assert trend.p_value < 1e-6
        assert np.expm1(trend.values["stiffness"].value) == pytest.approx(-0.28, abs=0.08)
        assert not found.acceptable
        assert "which no rate-independent model can describe" in found.headline
        assert "friction's stiffness falls by" in found.headline

    def test_a_trend_is_stated_with_its_error(self):
        found = judge(swept_table(0.6))
        said = re.search(r"stiffness falls by \(?([0-9.]+) ± ([0-9.]+)\)? %", found.headline)
        assert said is not None
        size, error = float(said[1]), float(said[2])
        assert size == pytest.approx(60.0, abs=1.5 * error)
        (trend,) = (t for t in found.of("trend") if t.about == "frequency")
        ends = np.exp(
            trend.values["stiffness"].value
            + trend.values["stiffness"].stderr * np.array([-1.0, 1.0])
        )
        assert error == pytest.approx(50.0 * (ends[1] - ends[0]), rel=0.02)

    def test_a_smooth_departure_has_the_size_of_the_misfit(self):
        """Of friction that rises with a power of the speed."""
        f, A = np.repeat([0.25, 0.5, 1.0, 2.0], 8), np.tile(np.geomspace(0.3, 10.0, 8) * X_C, 4)
        limits = 0.1 * (f * A / X_C) ** 0.2
        N = [Dahl(limit, 30.0).describing_function(a) for limit, a in zip(limits, A, strict=True)]
        found = judge(FrequencyResponse(f, np.array(N) * relative_noise(32, 0.01, 1), A))
        (smooth,) = found.of("smooth")
        assert 0.8 * found.rms_misfit < smooth.values["size"] < found.rms_misfit
        assert smooth.p_value < 1e-3

    def test_ten_scattered_points_show_a_fall_of_stiffness_by_30_percent(self):
        """As the points of a damper do: most such tables are not to be trusted."""
        f = np.array([0.25] * 3 + [0.5] * 3 + [1.0] * 3 + [2.0])
        A = np.array([1.0, 2.0, 3.0] * 3 + [1.0]) * 3.0 * X_C
        N = FRICTION.describing_function(A)
        N = N.real * (f / 0.25) ** (np.log(0.7) / np.log(8.0)) + 1j * N.imag
        found = [
            judge(FrequencyResponse(f, N * relative_noise(10, 0.02, seed), A)) for seed in range(20)
        ]
        alarmed = [g.headline for g in found if not g.acceptable]
        assert sum("over frequency " in text for text in alarmed) >= 12
        known = ("over frequency", "depart smoothly")  # the latter where the trend is too vague
        assert all(any(each in text for each in known) for text in alarmed)

    def test_the_size_does_not_depend_on_the_claimed_noise(self):
        data = swept_table(0.28)
        known = replace(data, covariance=stated(data.response, 1e-3))
        for claimed in (known, replace(known, dof=np.full(32, 5.0))):
            (trend,) = (t for t in judge(claimed).of("trend") if t.about == "frequency")
            assert np.expm1(trend.values["stiffness"].value) == pytest.approx(-0.28, abs=0.08)
            assert trend.p_value < 1e-9

    def test_another_exponent(self):
        found = judge(table(model=Dahl(0.1, 30.0, alpha=1.5)))
        assert found.of("exponent")[0].values["indicated"] == pytest.approx(1.5, rel=0.15)
        assert "these data are not linear Dahl" in found.headline
        free = fit(table(model=Dahl(0.1, 30.0, alpha=1.5)), Dahl(alpha=None)).goodness
        assert free.acceptable
        assert not free.of("exponent")

    def test_the_exponent_s_score_is_close_to_its_estimate(self):
        data = table(model=Dahl(0.1, 30.0, alpha=1.05))
        found, estimate = judge(data), fit(data, Dahl(alpha=None)).params["alpha"]
        assert found.of("exponent")[0].values["indicated"] == pytest.approx(
            estimate.value, abs=0.005
        )
        assert found.of("exponent")[0].values["stderr"] == pytest.approx(estimate.stderr, rel=0.2)

    def test_a_missing_spring(self):
        found = judge(table(model=FRICTION + Spring(1.0)))
        assert not found.acceptable
        assert "these data are not linear Dahl: over amplitude " in found.headline

    def test_noise_larger_than_the_covariance_says(self):
        data = table(noise=0.03)
        known = replace(data, covariance=stated(data.response, 0.01))
        found = judge(known)
        assert not found.acceptable
        assert "chi-square" in found.headline
        unused = judge(known, noise="relative")
        assert unused.scatter == pytest.approx(3.0, rel=0.3)
        assert unused.acceptable
        assert ", but the scatter is 2.6 times what the data's covariance states" in unused.headline
        right = replace(data, covariance=stated(data.response, 0.03))
        assert "scatter" not in judge(right, noise="relative").headline

    def test_a_third_harmonic_of_another_size(self):
        A = np.repeat(np.geomspace(0.5, 20.0, 12), 2) * X_C
        k = np.tile([1, 3], 12)
        F = np.where(
            k == 1, FRICTION.describing_function(A), FRICTION.dynamic_stiffness(A, harmonic=3)
        )
        noise = np.random.default_rng(1).standard_normal((2, 24))
        F1 = np.abs(FRICTION.describing_function(A))
        for factor in (1.0, 1.3):
            R = F * np.where(k == 3, factor, 1.0) + 0.002 * F1 * (noise[0] + 1j * noise[1])
            found = judge(FrequencyResponse(np.ones(24), R, A, harmonic=k))
            assert found.of("third harmonic")[0].values["ratio"] == pytest.approx(factor, abs=0.02)
            assert found.acceptable == (factor == 1.0)

    def test_misfit_is_its_root_mean_square(self):
        result = fit(table(), Dahl())
        expected = np.sqrt(
            np.mean(np.abs(result.data.response - result.best_fit) ** 2 / result.data.gain**2)
        )
        assert result.goodness.rms_misfit == pytest.approx(expected)


class TestOutliers:
    def test_are_listed_with_their_place(self):
        data = table()
        R = data.response.copy()
        R[7] *= 1.1
        R[20] *= np.exp(0.08j)
        named = replace(data, response=R, level=np.array([f"run {i}" for i in range(30)]))
        found = judge(named).suspicious
        assert {point.row for point in found} == {7, 20}
        (first,) = (point for point in found if point.row == 7)
        assert first.deviation > 5.0
        assert "1 Hz, 1.01 mm, level run 7 lies" in str(first)

    def test_robust_fits_list_them_too(self):
        data = table()
        R = data.response.copy()
        R[7] *= 1.1
        found = judge(replace(data, response=R), loss="huber")
        assert [point.row for point in found.suspicious] == [7]
        assert "Suspicious rows: 1 Hz, 1.01 mm; check them" in found.headline
        assert judge(data, loss="huber").suspicious == ()

    def test_none_where_too_few_points(self):
        assert judge(table(n=3)).suspicious == ()


class TestPhysics:
    def test_a_negative_spring_is_told_once(self):
        result = fit(table(model=FRICTION + Spring(-1.0)), Dahl() + Spring())
        assert "stiffness is negative (-" in result.verdict
        assert result.fit_report().count("is negative") == 1

    def test_a_negative_mass_that_was_given_has_no_error(self):
        result = fit(table(), Dahl() + Mass(-1e-6))
        assert result.goodness.warnings == ("mass is negative, as given: -1e-06 kg",)

    def test_a_friction_force_beyond_slip(self):
        data = table(beta=(10.0, 100.0))
        R = data.response.copy()
        R[-1] *= 1.2
        found = fit(replace(data, response=R), Dahl(), throw=False)
        assert "At 1 Hz, 333 mm friction's fundamental is 0.1" in found.verdict
        assert "beyond_slip" not in {one.code for one in fit(data, Dahl(), throw=False).findings}

    def test_units_that_were_mistaken(self):
        """Micrometres taken for metres; peak-to-peak amplitudes next to nominal levels."""
        data = table()
        mistaken = replace(data, response=1e-6 * data.response, amplitude=1e6 * amplitudes(data))
        (text, _) = judge(mistaken).warnings
        assert text.startswith("sigma is 3")
        assert judge(mistaken).warnings[1].startswith("x_c is 3.3")
        assert "check the units of displacement and force" in text
        peak = replace(data, level=amplitudes(data) / 2.0)
        (text,) = judge(peak).warnings
        assert "2 times its nominal level: peak-to-peak" in text
        assert not judge(replace(data, level=amplitudes(data))).warnings

    def test_a_parameter_at_its_bound(self):
        model = Dahl() + Spring()
        (own,) = (p for p in model.parameters if p.name == "f_max")
        bounded = model.with_parameters({"f_max": replace(own, upper=0.09)})
        result = fit(table(model=FRICTION + Spring(1.0)), bounded)
        assert any("At its bound: f_max = 0.09" in w for w in result.goodness.warnings)

    def test_a_nearly_linear_plant_moves_in_a_sine(self):
        plant = FRICTION + Mass(0.3) + Damper(20.0) + Spring(300.0)
        f = np.tile(np.geomspace(0.1, 20.0, 6), 2)
        u = np.repeat([0.05, 0.3], 6)
        R = response(plant, f, u).receptance * relative_noise(12, 0.001, 3)
        assert not fit(driven(f, R, u), Dahl() + Mass() + Damper() + Spring()).goodness.warnings


class TestComparison:
    def test_finds_what_the_data_were_made_of(self):
        makers = {
            "as fitted": FRICTION,
            "spring added": FRICTION + Spring(1.0),
            "two Dahl elements": FRICTION + Dahl(0.1, 3.0, name="other"),
        }
        for name, maker in makers.items():
            assert compare_models(fit(table(model=maker, n=16), Dahl())).best.name == name
        bent = table(model=Dahl(0.1, 30.0, alpha=1.5), n=16)
        assert compare_models(fit(bent, Dahl())).best.name == "as fitted"
        stated = fit(bent, Dahl(alpha=1.0), throw=False)
        assert compare_models(stated).best.name == "exponent free"

    def test_a_parameter_at_infinity_does_not_count(self):
        """Without loss sigma and the noise are all there is: k = 2, as for a spring alone."""
        tables = (table(beta=(1e-4, 1e-3), seed=seed) for seed in range(20))
        results = (fit(data, Dahl(), throw=False) for data in tables)
        lossless = next(r for r in results if r.optimum.status.name == "NO_LOSS")
        spring = fit(lossless.data, Spring())
        assert lossless.aic == pytest.approx(spring.aic, abs=1e-4)
        assert lossless.bic == pytest.approx(spring.bic, abs=1e-4)
        assert lossless.bic == pytest.approx(
            -2.0 * spring.log_likelihood + 2.0 * np.log(60.0), abs=1e-4
        )

    def test_every_model_is_fitted_as_a_fit_of_its_own(self):
        result = fit(table(), Dahl())
        found = compare_models(result)
        spring = fit(table(), Dahl() + Spring(), throw=False)
        for name, alone in (("as fitted", result), ("spring added", spring)):
            (model,) = (m for m in found.models if m.name == name)
            values = dict(zip(model.optimum.names, model.optimum.values, strict=True))
            assert values == pytest.approx(
                {n: p.value for n, p in alone.params.items() if n in values}, rel=1e-4
            )
        assert "alpha" in values
        assert found.headline == "No model compared is better than the one fitted."
        assert list(found.to_frame()["model"]) == [m.name for m in found.models]

    def test_an_element_that_vanishes_leaves_the_other_its_numbers(self):
        for seed in range(12, 20):
            data = table(seed=seed)
            one = fit(data, Dahl())
            two = fit(data, Dahl(name="early") + Dahl(name="late"), throw=False)
            if two.optimum.status is not Status.NO_FRICTION:
                continue
            left, plain = (
                dict(zip(r.optimum.names, r.optimum.values, strict=True)) for r in (two, one)
            )
            kept = "late" if left["early_f_max"] == 0.0 else "early"
            assert left[f"{kept}_f_max"] == pytest.approx(plain["f_max"])
            return
        pytest.fail("no data set makes an element vanish")

    @pytest.mark.parametrize("loss", [pytest.param("huber", marks=pytest.mark.long), "student_t"])
    def test_a_robust_loss_is_that_of_every_model(self, loss):
        """Two rows of thrice the response would make a free exponent look clearly better."""
        clean = table()
        response = clean.response.copy()
        response[[28, 29]] *= 3.0
        result = fit(
            FrequencyResponse(clean.frequency_hz, response, clean.amplitude), Dahl(), loss=loss
        )
        found = compare_models(result)
        assert found.best.name == "as fitted"
        first, same = compare_models(result, {"the same": Dahl()}).models
        assert same.density.gain_over(first.density)[0] == pytest.approx(0.0, abs=1e-3)

    def test_own_models_and_those_that_fail(self):
        data = table(n=3)
        found = compare_models(
            fit(data, Dahl()), {"too much": Dahl() + Spring() + Mass() + Damper() + Dahl(name="b")}
        )
        assert "fewer than" in found.failed["too much"]
        assert "too much could not be fitted" in str(found)
        with pytest.raises(ValidationError, match="models is a list; expected a mapping of names"):
            compare_models(fit(data, Dahl()), [Dahl()])  # type: ignore[arg-type]

    def test_an_exponent_that_is_free_is_also_tried_at_one(self):
        names = [m.name for m in compare_models(fit(table(), Dahl(alpha=None))).models]
        assert "exponent 1" in names
        assert "exponent free" not in names


def test_plant_of_the_helpers_is_that_of_the_paper():
    assert [p.value for p in PLANT.parameters] == [0.1, 30.0, 1.0, 0.3, 0.24, 0.3]


def test_two_frequencies_show_what_depends_on_the_rate():
    slow, fast = table(seed=1), table(seed=2)
    rising = np.concatenate([slow.response, 1.08 * fast.response])
    f, A = np.repeat([1.0, 5.0], 30), np.tile(slow.amplitude, 2)
    both = FrequencyResponse(f, rising, A)
    (text,) = (str(t) for t in judge(both).of("trend") if "over frequency" in str(t))
    rise = float(re.search(r"stiffness rises by (\S+)", text)[1])
    assert rise == pytest.approx(8.0, abs=3.0)


def test_two_mountings_that_differ_are_named():
    data = table(n=30)
    right = np.arange(30) % 2 == 1
    mount = np.where(right, "right", "left")
    differing = np.where(right, 1.0, 1.06) * data.response
    (test,) = judge(replace(data, response=differing, quality={"mount": mount})).of("groups")
    gains = re.findall(r"(\S+) % (below|above) the model at (left|right)", str(test))
    assert [(side, name) for _, side, name in gains] == [("below", "right"), ("above", "left")]
    assert sum(float(size) for size, *_ in gains) == pytest.approx(6.0, abs=1.0)
    assert test.p_value < 1e-6

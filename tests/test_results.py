"""What users hold: names, reports, files and pictures of fits."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from scipy import optimize, stats

import dahl_ident as di
from dahl_ident import compare_models, fit, fit_many, load_dataset, posterior
from dahl_ident.errors import DataError, FitError, ModelError, ValidationError
from dahl_ident.fitting import Status
from tests.friction_tables import FRICTION, amplitudes, plant_table, table


@pytest.fixture(scope="module")
def result():
    return fit(table(), di.Dahl())


@pytest.fixture(scope="module")
def plant():
    return fit(plant_table(), di.Dahl() + di.Mass() + di.Damper() + di.Spring())


@pytest.fixture(scope="module")
def microslip():
    return fit(table(beta=(1e-4, 1e-3)), di.Dahl(), throw=False)


class TestFit:
    def test_names_of_lmfit(self, result):
        f_max = result.params["f_max"]
        optimum = result.optimum
        assert optimum.values[0] == pytest.approx(0.09976, rel=1e-4)
        assert optimum.stderr["f_max"] == pytest.approx(0.00024, rel=0.05)
        # the range of the assumed exponent and noise of the amplitudes widen it
        assert abs(f_max.value - optimum.values[0]) < f_max.stderr
        assert result.stderr_noise["f_max"] < f_max.stderr
        assert 1.2 * 0.00024 < f_max.stderr < 2.0 * 0.00024
        assert (f_max.min, f_max.max, f_max.vary, f_max.unit) == (0.0, np.inf, True, "N")
        assert not result.params["alpha"].vary
        assert result.params["alpha"].stderr == pytest.approx(0.01, rel=0.5)
        assert result.var_names == ["f_max", "sigma"]
        assert (result.ndata, result.nvarys, result.nfree) == (60, 2, 58)
        assert result.covar[0, 0] == pytest.approx(f_max.stderr**2)
        expected = result.covar[0, 1] / np.sqrt(result.covar[0, 0] * result.covar[1, 1])
        assert result.correl["f_max"]["sigma"] == pytest.approx(expected)
        assert result.correl["sigma"]["f_max"] == pytest.approx(expected)
        assert result.success
        assert result.message.startswith("Converged")
        assert result.nfev >= 1
        assert result.method == "lm"
        A = amplitudes(result.data)
        plain = di.Dahl(*optimum.values).dynamic_stiffness(A)
        searched = result.problem.predict(optimum.theta)
        np.testing.assert_allclose(searched, plain, rtol=1e-12)
        combined = result.predict(1.0, amplitude=A).response
        np.testing.assert_allclose(combined, result.best_fit, rtol=1e-12)
        stated = di.Dahl(*(p.value for p in result.params.values()))
        np.testing.assert_allclose(combined, stated.dynamic_stiffness(A), rtol=1e-12)
        np.testing.assert_allclose(combined, result.model.dynamic_stiffness(A), rtol=1e-12)

    def test_residuals_and_their_squares(self, result):
        alpha = result.params["alpha"].value
        friction = di.Dahl(result.params["f_max"].value, result.params["sigma"].value, alpha)
        y = np.log(result.data.response / friction.describing_function(result.data.amplitude))
        range_of_alpha = np.log(4.0) / np.sqrt(12.0)  # uniform in ln alpha, from 0.5 to 2
        prior = result.scale * np.log(alpha) / range_of_alpha
        expected = np.append(y.view(np.float64), prior)
        np.testing.assert_allclose(result.residual, expected, atol=1e-12)
        assert result.chisqr == pytest.approx(np.sum(expected**2))
        assert result.redchi == pytest.approx(result.chisqr / 58.0)
        assert result.scale == pytest.approx(np.sqrt(result.redchi))

    def test_criteria_from_the_density(self, result):
        """ln gain and phase are normal; a density by Re and Im has the Jacobian 1/|R|^2."""
        searched = result.problem.predict(result.optimum.theta)
        y = np.log(result.data.response / searched).view(np.float64)
        s = np.sqrt(np.mean(y**2))
        density = stats.norm(0.0, s).logpdf(y).sum() - 2.0 * np.log(result.data.gain).sum()
        assert result.log_likelihood == pytest.approx(density)
        assert result.aic == pytest.approx(-2.0 * density + 2.0 * 3.0)
        assert result.bic == pytest.approx(-2.0 * density + 3.0 * np.log(60.0))

    def test_criteria_of_a_robust_fit_are_those_of_its_density(self):
        """Student's t with 4 degrees of freedom in (ln gain, phase), by scipy."""
        data = table(n=12)
        result = fit(data, di.Dahl(), loss="student_t")
        searched = result.problem.predict(result.optimum.theta)
        y = np.log(data.response / searched)
        pairs = np.column_stack([y.real, y.imag])

        def deviance(ln_scale):
            shape = np.exp(2.0 * ln_scale) * np.eye(2)
            density = stats.multivariate_t(shape=shape, df=4).logpdf(pairs)
            return -2.0 * float(np.sum(density - 2.0 * np.log(np.abs(data.response))))

        least = optimize.minimize_scalar(deviance, (-6.0, -4.0)).fun
        assert result.aic == pytest.approx(least + 6.0, abs=1e-6)

    def test_rotation_has_its_units_everywhere(self):
        data = table()
        turned = di.FrequencyResponse(
            data.frequency_hz, data.response, data.amplitude, motion="rotation"
        )
        result = fit(turned, di.Dahl() + di.Mass(1e-6))
        units = {name: p.unit for name, p in result.params.items()}
        assert units == {"f_max": "N m", "sigma": "N m/rad", "alpha": "", "mass": "kg m^2"}
        assert " N m, sigma = " in repr(result)
        assert "N m/rad" in result.fit_report()
        assert list(result.summary()["unit"]) == list(units.values())
        assert "f_max [N m]" in str(result.conf_interval("wald"))
        grid = posterior(turned, di.Dahl(alpha=1.0), method="grid")
        assert grid.units[:2] == ("N m", "N m/rad")
        assert " N m (from" in grid.priors["f_max"]

    def test_free_fixed_and_start(self):
        data = table()
        freed = fit(data, di.Dahl(0.1, 30.0), free=["f_max"], fixed={"sigma": 29.0})
        assert freed.var_names == ["f_max"]
        assert freed.params["sigma"].value == 29.0
        assert freed.params["f_max"].init_value == 0.1
        started = fit(data, di.Dahl(), start={"f_max": 0.3})
        assert started.params["f_max"].value == pytest.approx(
            fit(data, di.Dahl()).params["f_max"].value
        )

    def test_no_optimum_is_raised_with_what_was_found(self):
        tables = (table(beta=(1e-4, 1e-3), seed=seed) for seed in range(10))
        data = next(d for d in tables if not fit(d, di.Dahl(), throw=False).success)
        with pytest.raises(FitError, match="f_max grows without bound at constant sigma") as caught:
            fit(data, di.Dahl())
        assert caught.value.result.optimum.status is Status.NO_LOSS
        assert caught.value.result.combinations[0].expression == "sigma"

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"method": "newton"}, "method is 'newton'; expected lm, scipy or ipopt"),
            ({"constraints": list}, "constraints given; only method='ipopt' takes that"),
            (
                {"drive_std": 0.1, "drive_covariance": 0.0},
                "drive_std and drive_covariance given; only method='ipopt' takes that",
            ),
            ({"loss": "cubic"}, "loss is 'cubic'"),
            ({"noise": "white"}, "noise is 'white'"),
        ],
    )
    def test_unknown_options(self, options, message):
        with pytest.raises(ValidationError, match=message):
            fit(table(), di.Dahl(), **options)

    def test_nothing_free(self):
        with pytest.raises(ModelError, match="no free parameter"):
            fit(table(), FRICTION)


class TestMany:
    def test_is_each_fit(self):
        tables = [table(seed=s) for s in range(4)] + [table(beta=(1e-4, 1e-3), seed=5)]
        many = fit_many(tables, di.Dahl())
        assert len(many) == 5
        for i, one in enumerate(many):
            alone = fit(tables[i], di.Dahl(), throw=False)
            assert one.status is alone.status
            assert one.optimum.status is alone.optimum.status is many.status[i]
            np.testing.assert_allclose(one.optimum.values, alone.optimum.values, rtol=1e-6)
            own = [alone.params[name].value for name in many.var_names]
            np.testing.assert_allclose(many.values[i], own, rtol=1e-4)
        np.testing.assert_array_equal(many.success, [s.found_optimum for s in many.status])
        assert many[0].data is tables[0]
        assert [r.data for r in many[1:3]] == tables[1:3]

    def test_frame_and_text(self):
        many = fit_many([table(seed=s) for s in range(3)], di.Dahl())
        frame = many.to_frame()
        names = "f_max f_max_stderr f_max_stderr_noise sigma sigma_stderr sigma_stderr_noise"
        assert list(frame) == [*names.split(), "scale", "status"]
        for i, one in enumerate(many):
            sigma, row = fit(one.data, di.Dahl()).params["sigma"], frame.iloc[i]
            assert row["sigma"] == pytest.approx(sigma.value, rel=1e-4)
            assert row["sigma_stderr"] == pytest.approx(sigma.stderr, rel=1e-3)
            assert 0.0 < row["sigma_stderr_noise"] <= row["sigma_stderr"]
        assert repr(many) == "<FitBatch: 3 fits, free f_max, sigma; 3 converged>"

    def test_records_are_fitted_one_by_one(self):
        t = np.arange(400) / 100.0
        x = 0.01 * np.sin(np.pi * t)
        limits = (0.1, 0.2)
        noise = 1e-3 * np.random.default_rng(0).standard_normal((2, t.size))
        records = [
            di.Record(t, displacement=x, force=di.Dahl(f_max, 30.0, alpha=1.0).force(x) + e)
            for f_max, e in zip(limits, noise, strict=True)
        ]
        many = fit_many(records, di.Dahl(alpha=1.0))
        frame = many.to_frame()
        assert many.success.all()
        for truth, (value, u) in zip(limits, frame[["f_max", "f_max_stderr"]].values, strict=True):
            assert value == pytest.approx(truth, abs=3.0 * u)
            assert u < 0.01 * truth
        alone = fit(records[1], di.Dahl(alpha=1.0))
        assert many[1].params["sigma"].value == alone.params["sigma"].value

    def test_tables_must_agree(self):
        with pytest.raises(DataError, match="table 1 has 8 rows"):
            fit_many([table(), table(n=8)], di.Dahl())


class TestReport:
    def test_verdict_comes_first(self, result):
        text = result.fit_report()
        assert text.splitlines()[0] == "Verdict"
        assert "Trusted. Every parameter is identified." in text.splitlines()[1]
        assert str(result) == text
        for section in ("Parameters", "Derived", "Noise", "Goodness of fit", "Solver"):
            assert f"\n{section}\n" in text
        assert "95.45 % (combined)" in text
        f_max = next(line.split() for line in text.splitlines() if "  f_max  " in line)
        value, error = (float(word) for word in f_max[1:3])
        assert value == pytest.approx(0.1, abs=3.0 * error)
        assert f_max[-1] == "identified"
        assert "estimated with 58 degrees of freedom" in text
        assert "constant variance of (ln gain, phase)" in text

    def test_other_intervals(self, result):
        assert "90 % (wald)" in result.fit_report("wald", 0.9)
        assert "95.45 % (bootstrap)" in result.fit_report("bootstrap")

    def test_one_level_needs_no_sequence(self, result):
        upper = result.conf_interval(levels=0.95)["f_max"][0].upper
        assert upper == result.conf_interval(levels=(0.95,))["f_max"][0].upper

    def test_a_plant_is_compared_on_request_alone(self):
        """Each other model would take as long as the fit, or longer."""
        plant = di.Dahl() + di.Mass(0.3) + di.Damper() + di.Spring()
        wrong = fit(di.load_dataset("frf_levels"), plant, throw=False)
        assert not wrong.goodness.acceptable
        assert "Other models" not in str(wrong)

    def test_a_wrong_model_is_compared_with_others(self):
        wrong = fit(table(model=FRICTION + di.Spring(1.0)), di.Dahl())
        assert not wrong.trusted
        text = wrong.fit_report()
        assert "Other models, for comparison" in text
        assert "spring added would be better" in text

    def test_correlations_of_a_plant(self, plant):
        text = plant.fit_report()
        assert "sigma, mass: +0." in text
        assert "the describing function would be up to" in text
        assert plant.trusted

    def test_priors_losses_and_units_are_told(self):
        sensors = di.Sensors(force_gain=stats.norm(1.0, 0.005))
        told = fit(table(), di.Dahl(), sensors=sensors).fit_report()
        assert "prior of force_gain: 1 ± 0.005" in told
        assert "robust loss: huber" in fit(table(), di.Dahl(), loss="huber").fit_report()
        absolute = fit(table(), di.Dahl(), noise="absolute").fit_report()
        assert "N/m, estimated with" in absolute

    def test_html_is_escaped_and_has_the_same_words(self, result):
        page = result._repr_html_()
        assert page.startswith("<div><h4>Verdict</h4><pre>Trusted.")
        assert page.count("<h4>") == page.count("</h4>") == page.count("<pre>")

    def test_repr_is_one_line(self, result):
        assert repr(result) == (
            "<FitResult: f_max = 0.09957 ± 0.00039 N, sigma = 30.016 ± 0.063 N/m; converged>"
        )

    def test_frame(self, result):
        frame = result.summary()
        assert list(frame.index) == ["f_max", "sigma", "alpha"]
        assert frame.loc["sigma", "value"] == result.params["sigma"].value
        for name, interval in result.conf_interval().at(0.9545).items():
            assert frame.loc[name, ["lower", "upper"]].tolist() == [interval.lower, interval.upper]
        assert not frame["lower"].isna().any()


class TestStorage:
    def check_same(self, one, other):
        np.testing.assert_array_equal(one.optimum.theta, other.optimum.theta)
        np.testing.assert_array_equal(one.optimum.values, other.optimum.values)
        np.testing.assert_array_equal(one.optimum.covariance, other.optimum.covariance)
        assert one.status is other.status
        assert one.combinations == other.combinations
        here, there = json.loads(one.to_json()), json.loads(other.to_json())
        assert here.keys() == there.keys()
        for name in here.keys() - {"estimates", "digest"}:
            assert here[name] == there[name]
        assert one.fit_report() == other.fit_report()

    def test_round_trip(self, result, plant, microslip):
        for one in (result, plant, microslip):
            self.check_same(one, di.FitResult.from_json(one.to_json()))

    def test_everything_a_table_can_hold(self, tmp_path):
        data = table(n=9)
        A = amplitudes(data)
        C = (0.01 * data.gain)[:, None, None] ** 2 * np.array([[1.0, 0.2], [0.2, 1.0]])
        full = di.FrequencyResponse(
            data.frequency_hz,
            data.response,
            A,
            A * data.gain,
            covariance=C,
            dof=[np.inf, *[6.0] * 8],
            amplitude_std=1e-3 * A,
            amplitude_covariance=np.zeros((9, 2)),
            level=["low"] * 9,
            quality={"settled": np.array([True] * 9)},
            provenance={"file": "a.csv", "size": np.int64(3), "path": Path("a")},
        )
        sensors = di.Sensors(force_gain=stats.norm(1.0, 0.005), delay=1e-5)
        one = fit(full, di.Dahl(alpha=None) + di.Spring(0.0), sensors=sensors, throw=False)
        one.save(tmp_path / "fit.json")
        self.check_same(one, di.FitResult.load(tmp_path / "fit.json"))
        back = di.FitResult.load(tmp_path / "fit.json").data
        assert back.provenance == {"file": "a.csv", "size": 3, "path": "a"}
        np.testing.assert_array_equal(back.dof, full.dof)
        assert back.levels == ["low"]

    def test_is_strict_json_with_a_schema(self, microslip):
        content = json.loads(microslip.to_json(), parse_constant=lambda name: pytest.fail(name))
        assert (content["schema"], content["schema_version"]) == ("dahl_ident.fit_result", 5)
        assert content["model"][0] == {
            "kind": "dahl",
            "f_max": "free",
            "sigma": "free",
            "alpha": {"assumed": 1.0},
        }
        stated = {name: (p.value, p.stderr) for name, p in microslip.params.items()}
        saved = content["estimates"]
        assert {n: (float(p["value"]), float(p["stderr"])) for n, p in saved.items()} == stated

    def test_what_is_no_fit(self, result, tmp_path):
        content = json.loads(result.to_json())
        with pytest.raises(DataError, match="is not JSON"):
            di.FitResult.from_json("{")
        with pytest.raises(DataError, match="has the schema None"):
            di.FitResult.from_json("[]")
        with pytest.raises(DataError, match="schema version 6; this version of dahl_ident reads 5"):
            di.FitResult.from_json(json.dumps({**content, "schema_version": 6}))
        del content["optimum"]["theta"]
        facts = {k: v for k, v in content.items() if k != "digest"}
        text = json.dumps(facts, sort_keys=True, separators=(",", ":"))
        content["digest"] = hashlib.sha256(text.encode()).hexdigest()
        (tmp_path / "cut.json").write_text(json.dumps(content))
        with pytest.raises(DataError, match=r"cut.json says .* lacks or garbles 'theta'"):
            di.FitResult.load(tmp_path / "cut.json")
        with pytest.raises(DataError, match=r"lost\.json: the file cannot be read: No such file"):
            di.FitResult.load(tmp_path / "lost.json")
        (tmp_path / "image.json").write_bytes(b"\x89PNG")
        with pytest.raises(
            DataError, match=r"image\.json: the file cannot be read: it is not text"
        ):
            di.FitResult.load(tmp_path / "image.json")

    @pytest.mark.parametrize(
        "change",
        [
            lambda c: c["optimum"]["values"].__setitem__(0, 0.5),
            lambda c: c["optimum"]["covariance"][0].__setitem__(0, 1e-12),
            lambda c: c["data"]["real"].__setitem__(3, 1.0),
            lambda c: c["model"][0].__setitem__("kind", "spring"),
            lambda c: c["optimum"].__setitem__("status", "CONVERGED_"),
            lambda c: c.pop("digest"),
        ],
    )
    def test_what_was_edited_is_refused(self, result, tmp_path, change):
        content = json.loads(result.to_json())
        assert di.FitResult.from_json(json.dumps(content, indent=4, sort_keys=True)).trusted
        change(content)
        (tmp_path / "edited.json").write_text(json.dumps(content))
        with pytest.raises(DataError, match=r"edited.json was changed after the fit was saved"):
            di.FitResult.load(tmp_path / "edited.json")


def xy(line):
    """Return what a line shows, shape (2, n)."""
    return np.array([line.get_xdata(), line.get_ydata()], dtype=np.float64)


def lines(axis, points):
    """Return the lines of so many points."""
    return [line for line in axis.lines if xy(line).shape[1] == points]


class TestPictures:
    def test_over_amplitude_with_a_band(self, result):
        top, bottom = result.plot_fit()
        (line,) = lines(top, 200)
        band = result.predict(1.0, amplitude=xy(line)[0])
        np.testing.assert_allclose(xy(line)[1], np.abs(band.response))
        assert len(top.collections) >= 2  # the band, and the error bars
        assert bottom.get_ylabel() == "phase [degrees]"

    def test_over_frequency_by_levels(self, plant):
        top, _ = plant.plot_fit()
        points = [line for line in lines(top, 12) if line.get_marker() not in ("", "None", "_")]
        curves = lines(top, 200)
        assert len(points) == len(curves) == 5
        part = plant.data.select(level=plant.data.levels[2])
        np.testing.assert_allclose(xy(points[2])[1], part.gain)
        ends = xy(curves[2])[1][[0, -1]]
        f, drive = plant.data.frequency_hz, plant.data.drive
        predicted = np.abs(plant.predict(f, drive=drive).response[24:36])[[0, -1]]
        np.testing.assert_allclose(ends, predicted, rtol=1e-9)

    def test_residuals_in_standard_deviations(self, result):
        axis = result.plot_residuals()
        (gain,) = (x for x in axis.lines if x.get_label() == "ln gain")
        np.testing.assert_allclose(xy(gain)[1], result.residual[:60:2] / result.scale)

    def test_draw_where_they_are_told(self, result):
        figure, axes = plt.subplots(3)
        assert result.plot_fit(axes[:2])[0] is axes[0]
        drawn = result.plot_residuals(axes[2])
        assert isinstance(drawn, Axes)
        assert drawn.figure is figure

    def test_suspicious_points_are_ringed(self):
        data = table()
        R = data.response.copy()
        R[7] *= 1.2
        axis = fit(replace(data, response=R), di.Dahl()).plot_residuals()
        rings = [x for x in axis.lines if x.get_markerfacecolor() == "none"]
        assert len(rings) == 2

    def test_measured_errors_become_error_bars(self):
        data = table()
        C = (0.02 * data.gain)[:, None, None] ** 2 * np.eye(2)
        top, _ = fit(replace(data, covariance=C), di.Dahl()).plot_fit()
        segments = top.collections[-1].get_segments()  # error bars
        heights = [np.ptp(s[:, 1]) for s in segments]
        np.testing.assert_allclose(heights, 0.04 * data.gain, rtol=1e-6)


def test_a_pandas_table_is_fitted_as_it_is_read():
    data = load_dataset("noisy")
    frame = data.to_frame()
    assert fit(frame, di.Dahl()).params["f_max"].value == pytest.approx(
        fit(data, di.Dahl()).params["f_max"].value, rel=1e-12
    )


def test_a_list_of_fits_is_sent_to_the_report():
    found = fit(load_dataset("noisy"), di.Dahl())
    with pytest.raises(
        ValidationError, match=r"got several fits; .* di\.report\(\[fit, \.\.\.\]\)"
    ):
        compare_models([found, found])


@pytest.mark.parametrize("ln_f_max", [441.0, -441.0])
def test_values_beyond_any_parameter_stand_for_infinity_and_zero(ln_f_max):
    """Where a gap swallows the motion, a search may end at a force limit of 1e191."""
    A = np.geomspace(2e-5, 4.5e-4, 10)
    noise = 0.01 * np.random.default_rng(0).standard_normal(10)
    data = di.FrequencyResponse(np.ones(10), 10.0 * np.exp(noise), A)
    found = fit(data, di.Backlash(di.Dahl(alpha=1.0), 1e-3) + di.Spring(), throw=False)
    far = replace(found.optimum, theta=np.array([ln_f_max, -5.0, np.log(10.0)]))
    ended = di.FitResult(far)
    assert ended.status == "not determined"
    assert "f_max=1e+90" in repr(ended.model) or "f_max=1e-90" in repr(ended.model)
    assert "model compared is" in str(compare_models(ended))

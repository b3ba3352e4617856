"""Options of a fit that tables and records share, on records."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import dahl_ident as di
from dahl_ident.errors import DahlIdentError, FitError, ModelError, ValidationError

RNG = np.random.default_rng(0)
X = 1e-3 * np.cumsum(RNG.standard_normal(2000))
TRUE = di.Dahl(0.1, 30.0).force(X)
NOISE = 1e-3 * RNG.standard_normal(2000)
MODEL = di.Dahl(alpha=1.0)


def record(force):
    n = len(force)
    return di.Record(np.arange(n) / 100.0, displacement=X[:n], force=force)


@pytest.fixture(scope="module")
def fit():
    return di.fit(record(TRUE + NOISE), MODEL)


def law_with(label):
    """Return a law whose friction limit has this name."""

    class Own(di.Friction):
        parameters = (
            di.Parameter("k", "N/m", "stiffness", lower=0.0, transform="log"),
            di.Parameter(label, "N", "friction limit", lower=0.0, transform="log"),
        )

        def slope(self, force, direction, velocity, values):
            return values[0] * (1.0 - direction * force / values[1])

    return Own


@pytest.mark.parametrize("label", ["offset", "drift", "initial_force"])
def test_a_parameter_called_as_one_of_the_records_is_refused(label):
    own = law_with(label)
    for model in (own(), own(30.0), own(None, 0.1) + di.Spring()):
        with pytest.raises(ModelError, match=f"{label}, which is also an unknown of a fit of rec"):
            di.fit(record(TRUE + NOISE), model)


def test_unknowns_of_two_elements_have_names_of_their_own():
    own = law_with("limit")
    with pytest.raises(
        ModelError, match="unknown called initial_force in a fit of records; give each"
    ):
        di.fit(record(TRUE + NOISE), MODEL + own())
    problem = di.fit(record(TRUE + NOISE), MODEL + own(3.0, 1e-3, name="own")).problem
    assert {"initial_force", "own_initial_force"} < set(problem.names)


@pytest.mark.parametrize("method", ["scipy", "ipopt"])
def test_every_method_finds_the_same_optimum(method, fit):
    other = di.fit(record(TRUE + NOISE), MODEL, method=method)
    assert other.method == method
    np.testing.assert_allclose(other.optimum.values[:2], fit.optimum.values[:2], rtol=1e-5)


@pytest.fixture(scope="module")
def plain():
    """A fit of a record with outliers, which count like other samples."""
    hit = TRUE + NOISE
    hit[::50] += 0.2
    return di.fit(record(hit), MODEL)


@pytest.mark.parametrize(
    ("loss", "method"),
    [("huber", "lm"), ("soft_l1", "lm"), ("student_t", "lm"), ("huber", "scipy")],
)
def test_robust_losses_ignore_outliers(loss, method, fit, plain):
    robust = di.fit(plain.data, MODEL, loss=loss, method=method)
    u = fit.stderr_noise["f_max"]
    assert abs(robust.params["f_max"].value - 0.1) < 3.0 * u
    assert abs(plain.params["f_max"].value - 0.1) > 5.0 * u
    assert 0.8 * u < robust.stderr_noise["f_max"] < 1.5 * u
    again = di.FitResult.from_json(robust.to_json())
    assert again.stderr_noise["f_max"] == pytest.approx(robust.stderr_noise["f_max"])


@pytest.mark.parametrize("method", ["profile", "bootstrap"])
def test_intervals_by_noise_agree_where_the_problem_is_linear(method, fit):
    comparison = fit.compare_intervals(("wald", method), levels=0.9545)
    for ours, theirs in zip(
        *(one.at(0.9545).items() for one in comparison.intervals), strict=False
    ):
        half = 0.5 * (ours[1].upper - ours[1].lower)
        assert ours[0] == theirs[0]
        assert abs(ours[1].lower - theirs[1].lower) < 0.35 * half
        assert abs(ours[1].upper - theirs[1].upper) < 0.35 * half


def test_likelihood_and_criteria(fit):
    (predicted,) = fit.best_fit
    left = TRUE + NOISE - predicted
    density = norm(0.0, np.sqrt(np.mean(left**2))).logpdf(left).sum()
    assert fit.log_likelihood == pytest.approx(density)
    counted = len(fit.var_names) + 1  # the noise's scale
    assert fit.aic == pytest.approx(2.0 * counted - 2.0 * density)
    assert fit.bic == pytest.approx(np.log(2000.0) * counted - 2.0 * density)


def test_profile_counts_correlated_noise():
    slow = np.convolve(RNG.standard_normal(2100), np.ones(30), "valid")[:2000] * 3e-4
    fit = di.fit(record(TRUE + slow), MODEL)
    (wald,) = (fit.conf_interval("wald", 0.9545)[name][0] for name in ("f_max",))
    (profile,) = (fit.conf_interval("profile", 0.9545)[name][0] for name in ("f_max",))
    white = 4.0 * fit.optimum.stderr["f_max"]
    assert profile.upper - profile.lower == pytest.approx(wald.upper - wald.lower, rel=0.1)
    assert profile.upper - profile.lower > 1.5 * white


def test_a_posterior_by_points_has_the_covariance_of_the_fit():
    part = slice(300)
    short = di.Record(np.arange(300) / 100.0, displacement=X[part], force=(TRUE + NOISE)[part])
    fit = di.fit(short, MODEL)
    posterior = di.posterior(fit, method="grid", tolerance=0.03)
    assert posterior.converged, posterior.message
    for place, name in enumerate(("f_max", "sigma")):
        estimate = fit.params[name]
        assert abs(posterior.mean()[place] - estimate.value) < 0.1 * estimate.stderr
        assert posterior.std()[place] == pytest.approx(estimate.stderr, rel=0.05)
    with pytest.raises(ValidationError, match="no evidence"):
        _ = posterior.log_evidence
    assert "log_evidence" not in posterior.to_dict()


def test_constraints():
    measured = record(TRUE + NOISE)

    def tied(ratio):
        def constraints(p):
            return [p["sigma"] == ratio * p["f_max"]]

        return di.fit(measured, MODEL, method="ipopt", constraints=constraints)

    right, wrong = tied(300.0), tied(310.0)
    for fit, ratio in ((right, 300.0), (wrong, 310.0)):
        sigma, f_max = fit.params["sigma"], fit.params["f_max"]
        assert sigma.value == pytest.approx(ratio * f_max.value)
        assert sigma.stderr == pytest.approx(ratio * f_max.stderr)
        again = di.FitResult.from_json(fit.to_json())
        assert again.params["sigma"].stderr == pytest.approx(sigma.stderr)
        assert str(again.status) == str(fit.status)
    assert right.trusted
    assert "the constraint sigma" in right.verdict
    assert any(finding.code == "constraint" for finding in wrong.findings)
    assert not wrong.trusted


@pytest.mark.parametrize(
    ("data", "option"),
    [
        (record(TRUE), {"noise": "relative"}),
        (record(TRUE), {"steady": "describing function"}),
        (record(TRUE), {"drive_std": 0.1}),
        (record(TRUE), {"excitation": "base"}),
        (di.load_dataset("noisy"), {"output": "force"}),
        (di.load_dataset("noisy"), {"excitation": "base"}),
    ],
)
def test_options_of_the_other_kind_are_refused(data, option):
    with pytest.raises(ValidationError, match=r"is given with (records|a table): .*leave it out"):
        di.fit(data, MODEL, **option)


def test_parts_of_a_table_are_refused_like_other_options():
    fit = di.fit(di.load_dataset("noisy"), MODEL)
    with pytest.raises(ValidationError, match="parts is given with a table: its tests are left"):
        fit.hold_out(3)


def test_an_unknown_excitation_is_refused_at_once():
    with pytest.raises(ValidationError, match="excitation is 'foo'; expected one of force, base"):
        di.fit(record(TRUE), MODEL + di.Mass(), excitation="foo")  # type: ignore[arg-type]


def test_a_table_and_a_record_answer_the_same_questions(fit):
    table = di.fit(di.load_dataset("noisy"), MODEL)
    for one in (fit, table):
        report = one.fit_report()
        titles = ("Verdict", "Parameters", "Derived", "Uncertainty budget", "Noise", "Solver")
        assert [t for t in titles if f"\n{t}\n" in f"\n{report}"] == list(titles)
        assert len(one.fit_report(details=False).splitlines()) <= 15
        assert one.plot("budget") is not None
        assert one.identifiability.complete
        with pytest.raises(ValidationError, match="kind is 'spiral'; expected one of"):
            one.plot("spiral")
    assert str(table.hold_out())
    short = di.fit(record((TRUE + NOISE)[:500]), MODEL)
    assert len(short.hold_out().parts) == 4


def test_fits_with_constraints_have_no_budget_and_hold_nothing_out():
    for data in (record(TRUE + NOISE), di.load_dataset("noisy")):
        tied = di.fit(
            data, MODEL, method="ipopt", constraints=lambda p: [p["sigma"] == 300.0 * p["f_max"]]
        )
        ratio = tied.params["sigma"].value / tied.params["f_max"].value
        assert ratio == pytest.approx(300.0, rel=1e-8)
        assert tied.stated_budget is None
        for refused in (tied.budget, tied.hold_out):
            with pytest.raises(FitError, match="the fit had constraints"):
                refused()
        assert tied.fit_report()
        intervals = tied.conf_interval()
        assert (intervals.method, "constraints" in intervals.note) == ("wald", True)
        assert di.FitResult.from_json(tied.to_json()).conf_interval().note == intervals.note


def test_what_one_kind_alone_has_is_refused_in_one_way(fit):
    table = di.fit(di.load_dataset("noisy"), MODEL)
    with pytest.raises(ValidationError, match="a fit of a table has no prediction of a record"):
        table.predict(record(TRUE))
    with pytest.raises(ValidationError, match="against is 'frequency'; expected time or"):
        fit.plot_residuals(against="frequency")
    with pytest.raises(ModelError, match="has no mass"):
        fit.backbone(1e-3)


def test_a_mass_of_zero_is_no_mass(fit):
    for model, fixed in ((MODEL + di.Mass(0.0), {}), (MODEL + di.Mass(), {"mass": 0.0})):
        with pytest.raises(ModelError, match=r"has a mass of 0, .* give another, or leave it free"):
            di.fit(record(TRUE), model, fixed=fixed, output="motion")
    without = di.fit(record(TRUE + NOISE), MODEL + di.Mass(0.0))
    assert without.params["sigma"].value == pytest.approx(fit.params["sigma"].value, rel=1e-9)


def test_the_model_of_a_fit_is_fitted_again(fit):
    again = di.fit(record(TRUE + NOISE), fit.model)
    for name in ("f_max", "sigma"):
        assert again.params[name].value == pytest.approx(fit.params[name].value, rel=1e-6)
        assert again.params[name].vary


def test_a_fit_of_records_predicts_responses_to_sines(fit):
    A = np.array([1e-3, 4e-3])
    band, truth = fit.describing_function(A), di.Dahl(0.1, 30.0).describing_function(A)
    np.testing.assert_allclose(band.response, fit.model.dynamic_stiffness(A, 1.0), rtol=1e-9)
    for (low, high), true in ((band.real(), truth.real), (band.imag(), truth.imag)):
        assert ((low < true) & (true < high)).all()
    u = [q.stderr / q.value for q in fit.derived(A.tolist()) if q.name.startswith("energy")]
    np.testing.assert_allclose(band.imag_std / band.response.imag, u, rtol=1e-4)
    predicted = fit.predict([1.0, 1.0], amplitude=A, quantity="receptance")
    np.testing.assert_allclose(predicted.response, 1.0 / band.response)
    drawn = di.posterior(fit, seed=1, steps=80).predict([1.0, 1.0], amplitude=A)
    np.testing.assert_allclose(drawn.response, band.response, rtol=1e-2)
    np.testing.assert_allclose(drawn.draws.real.std(axis=0), band.real_std, rtol=0.2)


def test_a_fit_of_a_driven_record_has_a_backbone():
    mass, stiffness, friction = 0.5, 200.0, di.Dahl(0.1, 30.0, alpha=1.0)
    t, tones = np.arange(1500)[:, None] / 200.0, np.array([4.0, 9.1, 15.7])
    waves = 8e-3 * np.sin(tones * t)
    x, acceleration = waves.sum(axis=1), (-(tones**2) * waves).sum(axis=1)
    force = mass * acceleration + stiffness * x + friction.force(x)
    force += 1e-3 * np.random.default_rng(3).standard_normal(x.size)
    driven = di.Record(t[:, 0], displacement=x, force=force)
    fit = di.fit(driven, di.Mass(mass) + di.Spring() + di.Dahl(alpha=1.0), output="force")
    A = np.array([5e-3, 2e-2])
    backbone, N = fit.backbone(A), stiffness + friction.describing_function(A)
    omega = np.sqrt(N.real / mass)
    ratio = N.imag / (2.0 * mass * omega**2)
    away = np.stack([backbone.response.imag - ratio, backbone.frequency_hz - omega / 2.0 / np.pi])
    u = np.sqrt(backbone.covariance[:, [1, 0], [1, 0]].T)
    assert (np.abs(away) < 3.0 * u).all()
    assert (u < [[0.01], [0.1]]).all()
    top, bottom = fit.predict([1.0, 3.0], drive=0.5).gain()
    assert (top < bottom).all()


TABLE: Any = di.load_dataset("noisy")
RECORD: Any = record(TRUE + NOISE)
NONE: Any = None
THREE: Any = 3


@pytest.mark.parametrize("data", [TABLE, RECORD], ids=["table", "record"])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensors": {"force_gain": 1.0}}, "sensors is {'force_gain': 1.0}; expected Sensors"),
        ({"free": 3}, "free is 3; expected a collection of names"),
        ({"free": [3]}, "no parameter 3; it has f_max, sigma"),
        ({"fixed": 3}, "fixed is 3; expected a mapping"),
        ({"start": {"f_max": "a"}}, "start of f_max: expected real numbers"),
        ({"start": {3: 1.0}}, "start names 3; the free parameters are f_max, sigma"),
        ({"loss": None}, "loss is None; expected linear, huber"),
        ({"loss": ["huber"]}, r"loss is \['huber'\]; expected linear, huber"),
        ({"drive_std": np.full(30, 0.1)}, "drive_std"),
    ],
)
def test_options_of_a_wrong_kind_are_refused_in_words(data, options, words):
    with pytest.raises((ModelError, ValidationError), match=words):
        di.fit(data, MODEL, **options)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: di.fit(NONE, MODEL), "data holds a NoneType; expected one FrequencyResponse"),
        (lambda: di.fit([RECORD, TABLE], MODEL), "expected one FrequencyResponse, or a Record or"),
        (lambda: di.fit_many(NONE, MODEL), "None; expected a sequence of at least one table"),
        (lambda: di.posterior(THREE, MODEL), "data holds a int"),
        (lambda: di.Model(THREE), "expected a model such as .*, got int"),
        (lambda: di.compare_models(TABLE), "fit is a FrequencyResponse; expected the result of"),
        (lambda: di.extract(TABLE), "records holds a FrequencyResponse; expected records"),
        (lambda: di.extract(NONE), "records holds a NoneType; expected records"),
        (lambda: di.read_frequency_response(NONE), "the file is None; expected its path"),
        (lambda: di.read_record(THREE), "the file is 3; expected its path"),
        (lambda: di.load_dataset(NONE), "no data set None; there are"),
        (lambda: di.population(NONE), "table is a NoneType; expected a pandas.DataFrame"),
    ],
)
def test_data_of_a_wrong_kind_are_refused_in_words(call, words):
    with pytest.raises(DahlIdentError, match=words):
        call()


def test_models_and_metadata_of_a_wrong_kind_are_refused_in_words(fit, tmp_path):
    with pytest.raises(ModelError, match=r"expected a model such as .*, got int"):
        di.compare_models(fit, {"stiff": THREE})
    with pytest.raises(ValidationError, match="metadata is 3; expected its path"):
        di.report(fit, tmp_path / "report.json", metadata=THREE)
    with pytest.raises(ValidationError, match="a report is None; expected its path"):
        di.report(fit, NONE)


@pytest.mark.parametrize("data", [TABLE, RECORD], ids=["table", "record"])
@pytest.mark.parametrize(
    ("constraints", "texts"),
    [
        (lambda p: [p["sigma"] <= 1, p["sigma"] >= 2], "sigma<=1; 2<=sigma"),
        (lambda p: [p["f_max"] + p["sigma"] <= -5], r"\(f_max\+sigma\)<=-5"),
    ],
)
def test_constraints_without_a_solution_are_named(data, constraints, texts, capfd):
    with pytest.raises(FitError, match=f"no parameters satisfy the constraints {texts} within"):
        di.fit(data, di.Dahl(), method="ipopt", constraints=constraints)
    assert capfd.readouterr() == ("", "")  # casadi prints errors of the model far off


@pytest.mark.parametrize(
    ("sensors", "words"),
    [
        (di.Sensors(force_gain=1.02), "force_gain is 1.02; a fit of records expects a prior"),
        (di.Sensors(force_gain=norm(1.1, 0.01)), r"is a prior about 1.1; .* scipy.stats.norm\(1"),
        (di.Sensors(delay=None), r"delay is free; .* about 0, such as scipy.stats.norm\(0, 1e-4"),
    ],
)
def test_sensors_without_a_prior_about_exact_ones_are_refused(sensors, words):
    with pytest.raises(ValidationError, match=words):
        di.fit(RECORD, MODEL, sensors=sensors)

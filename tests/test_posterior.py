"""The posterior that users hold: against importance points, and in every form it takes."""

import json
from importlib import import_module

import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident.bayes.chain import autocorrelation_time
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.moves import EnsembleMove
from dahl_ident.bayes.priors import joint_prior
from dahl_ident.errors import DataError, SamplingError, ValidationError
from dahl_ident.problem import TableProblem
from dahl_ident.results import Posterior
from tests.bayes_cases import friction_table, harmonic_table, spring_table, with_covariance

LEVELS = np.array([0.02275, 0.16, 0.5, 0.84, 0.97725])


@pytest.fixture(scope="module")
def posterior():
    return di.posterior(friction_table(), di.Dahl(), seed=1, uncertainty="noise")


def scenarios():
    gain = di.Sensors(force_gain=stats.norm(1.0, 0.05))
    return {
        "knee": (friction_table(30, noise=0.01), di.Dahl(), {}),
        "three points": (friction_table(3, noise=0.3), di.Dahl(), {}),
        "microslip": (friction_table(10, 0.003, 0.03, 0.02), di.Dahl(), {}),
        "gross slip": (friction_table(10, 30.0, 300.0), di.Dahl(), {}),
        "known noise": (with_covariance(friction_table(), 0.02), di.Dahl(), {}),
        "gain from a sheet": (friction_table(8), di.Dahl(), {"sensors": gain}),
        "harmonics, noisy amplitudes": (harmonic_table(0.03), di.Dahl(), {}),
        "student's t": (harmonic_table(0.0), di.Dahl(), {"likelihood": "student_t"}),
        "with a spring": (spring_table(0.05), di.Dahl() + di.Spring(), {}),
    }


QUICK = ("knee", "gain from a sheet", "student's t", "with a spring")


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.long) for n in scenarios()]
)
def test_sampling_agrees_with_integration(name):
    data, model, options = scenarios()[name]
    drawn = di.posterior(data, model, seed=3, ess=200.0, **options, uncertainty="noise")
    grid = di.posterior(data, model, **options, method="grid", uncertainty="noise", tolerance=1e-2)
    assert drawn.converged
    ess = drawn.convergence.ess
    D = len(drawn.names)
    # moments in search coordinates, where tails are light
    logs = [p.transform == "log" for p in drawn.problem.parameters] + [True] * (
        D - len(drawn.problem.names)
    )
    values = np.where(logs, np.log(drawn.values), drawn.values)
    for i, parameter in enumerate(drawn.names):
        for level in LEVELS:
            exact = float(grid.quantile(parameter, level))
            exact = np.log(exact) if logs[i] else exact
            share = np.mean(values[:, i] < exact)
            error = np.sqrt(level * (1.0 - level) / ess[i])
            assert abs(share - level) < 4.0 * error, (parameter, level)
        if i < len(drawn.problem.names):
            # moments of what so many draws describe: a thin far tail is drawn together, with the
            # same share of it, to where it begins
            weights, theta = grid.points
            ends = np.array([float(grid.quantile(parameter, level)) for level in (0.01, 0.99)])
            ends = np.log(ends) if logs[i] else ends
            exact, seen = np.clip(theta[:, i], *ends), np.clip(values[:, i], *ends)
            mean = weights @ exact
            variance = weights @ (exact - mean) ** 2
            assert abs(seen.mean() - mean) < 4.0 * np.sqrt(variance / ess[i])
            # the variance is a mean as well, with an autocorrelation time of its own
            squares = (seen - mean) ** 2
            paths = squares.reshape(-1, drawn.get_chain().shape[1], 1)
            error = squares.std() * np.sqrt(autocorrelation_time(paths)[0] / squares.size)
            assert abs(squares.mean() - variance) < 4.0 * error


def test_the_summary_is_that_of_the_draws(posterior):
    table = posterior.summary()
    values = posterior.values
    assert list(table.index) == ["f_max", "sigma", "noise_scale"]
    assert table["unit"].tolist() == ["N", "N/m", ""]
    assert table["mean"].to_numpy() == pytest.approx(values.mean(axis=0))
    assert table["97.7%"].to_numpy() == pytest.approx(np.quantile(values, 0.97725, axis=0))
    std, ess = table["std"].to_numpy(), table["ess"].to_numpy()
    assert table["mcse"].to_numpy() == pytest.approx(std / np.sqrt(ess))
    assert values.shape == (len(posterior.to_frame()), 3)
    assert np.all(table["r_hat"].to_numpy() < 1.01)


@pytest.mark.versions
def test_emcees_names(posterior):
    whole = posterior.get_chain()
    assert whole.shape == (posterior.steps, 128, 3)
    some = posterior.get_chain(discard=100, thin=3)
    np.testing.assert_array_equal(some, whole[100::3])
    flat = posterior.get_chain(discard=100, thin=3, flat=True)
    np.testing.assert_array_equal(flat, some.reshape(-1, 3))
    assert posterior.get_log_prob().shape == whole.shape[:2]
    assert posterior.get_autocorr_time() == pytest.approx(posterior.convergence.tau)
    with pytest.raises(ValidationError, match="discard is -1; expected a whole number >= 0"):
        posterior.get_chain(discard=-1)


def test_a_short_chain_is_marked_and_keeps_its_ess_to_itself():
    short = di.posterior(friction_table(), di.Dahl(), seed=1, steps=60, uncertainty="noise")
    assert not short.converged
    assert str(short).startswith("NOT CONVERGED after 60 steps: ")
    assert "autocorrelation times, expected 50" in short.message
    assert np.isnan(short.summary()["ess"].to_numpy()).all()
    assert "NOT CONVERGED" in repr(short)


def test_a_chain_that_never_moved_is_refused_with_its_chain(monkeypatch):
    def stay(half, guide, random):
        return half, np.full(half.shape[:-1], -np.inf)

    def moves(ensembles, decorrelation):
        return [(EnsembleMove(stay, ensembles), 1.0)]

    monkeypatch.setattr("dahl_ident.bayes.chain.moves_for", moves)
    with pytest.raises(SamplingError, match="walkers never moved in f_max, sigma") as caught:
        di.posterior(friction_table(), di.Dahl(), seed=1, steps=40, uncertainty="noise")
    assert caught.value.posterior.get_chain().shape == (40, 128, 3)


def test_the_report_names_priors(posterior):
    text = str(posterior)
    assert text.startswith("Converged: ")
    assert "f_max: log-uniform from" in text
    assert "noise_scale: 1/s" in text
    assert "MISFIT" not in text
    error = posterior.summary()["mcse"]["f_max"]
    assert f" {error:.2g} " in next(line for line in text.splitlines() if line.startswith("f_max "))


def test_a_prior_dominated_parameter_is_named():
    data = friction_table(10, 0.0003, 0.003, 0.05)
    posterior = di.posterior(data, di.Dahl(), seed=1, uncertainty="noise")
    (rule,) = posterior.prior_influences
    assert rule.name == "f_max"
    assert "f_max is known from its prior: posterior width 0." in str(posterior)


def test_derived_quantities(posterior):
    x_c = posterior.function(lambda f_max, sigma, **_: f_max / sigma)
    exact = posterior.values[:, 0] / posterior.values[:, 1]
    assert x_c["median"] == pytest.approx(np.median(exact))
    assert x_c["std"] == pytest.approx(exact.std(), rel=1e-3)
    with pytest.raises(ValidationError, match="expected one number a draw"):
        posterior.function(lambda **_: 1.0)


def test_prediction_bands_hold_the_best_fit(posterior):
    data = posterior.data
    band = posterior.predict(data.frequency_hz, amplitude=data.amplitude)
    optimum = di.fit(data, di.Dahl()).optimum  # noise alone, at the exponent that is assumed
    best = optimum.problem.predict(optimum.theta)
    for limits, value in (
        (band.gain(0.95), np.abs(best)),
        (band.phase(0.95), np.angle(best)),
        (band.real(0.95), best.real),
        (band.imag(0.95), best.imag),
    ):
        assert (limits[0] < value).all()
        assert (value < limits[1]).all()


def test_every_result_has_one_interface():
    data = friction_table()
    results: list[di.FitResult | Posterior] = [
        di.fit(data, di.Dahl()),
        di.posterior(data, di.Dahl(), seed=1, ess=500.0, max_steps=2000, uncertainty="noise"),
        di.posterior(data, di.Dahl(), method="grid", uncertainty="noise"),
    ]
    fit = results[0]
    assert isinstance(fit, di.FitResult)
    band = fit.predict([1.0, 2.0], amplitude=[0.001, 0.002])
    (x_c, *at) = fit.derived([0.002], 1.0)
    for result in results:
        assert (result.status, result.trusted) == ("trusted", True)
        assert result.verdict.startswith("Trusted. ")
        assert result.statements[0] in result.verdict
        names = ["f_max", "sigma", "alpha"]
        assert [name for name in result.params if name != "noise_scale"] == names
        for name in ("f_max", "sigma"):
            mine, theirs = result.params[name], fit.params[name]
            assert theirs.stderr is not None
            # a fit's errors hold every source, those of a posterior the noise and the priors
            assert abs(mine.value - theirs.value) < theirs.stderr
            expected = theirs.stderr if result is fit else fit.stderr_noise[name]
            assert 0.7 < mine.stderr / expected < 1.5
            assert name in result.summary().index
        other = result.predict([1.0, 2.0], amplitude=[0.001, 0.002])
        for one, two in zip(other.gain(), band.gain(), strict=True):
            np.testing.assert_allclose(one, two, rtol=0.04)  # a fit's holds every source
        assert [q.name for q in result.derived([0.002], 1.0)] == [q.name for q in (x_c, *at)]
        for mine_, theirs_ in zip(result.derived([0.002], 1.0), (x_c, *at), strict=True):
            assert abs(mine_.value - theirs_.value) < 2.0 * theirs_.stderr
            assert 0.2 < mine_.stderr / theirs_.stderr < 1.6
            assert mine_.unit == theirs_.unit
        assert result.plot() is not None
        assert result.budget()["f_max"].u == fit.budget()["f_max"].u
        assert json.loads(result.to_json())["schema"].startswith("dahl_ident.")
        with pytest.raises(ValidationError, match="kind is 'pie'; expected"):
            result.plot("pie")
    assert fit.plot("budget").get_xlabel() == "share of the variance [%]"


@pytest.mark.versions
def test_results_are_saved_and_never_overwritten(tmp_path):
    grid = di.posterior(friction_table(), di.Dahl(), method="grid", uncertainty="noise")
    place = grid.save(tmp_path / "grid.json")
    stored = json.loads(place.read_text())
    assert stored["summary"]["f_max"]["mean"] == grid.params["f_max"].value
    with pytest.raises(DataError, match="the file exists already"):
        grid.save(place)
    with pytest.raises(ValidationError, match=r"a posterior is written as \.json; got '\.txt'"):
        grid.save(tmp_path / "grid.txt")


def test_options_of_the_other_method_are_refused():
    with pytest.raises(ValidationError, match="steps given with method='grid', which has no such"):
        di.posterior(friction_table(), di.Dahl(), method="grid", steps=100, uncertainty="noise")
    with pytest.raises(ValidationError, match="tolerance given with method='mcmc'"):
        di.posterior(friction_table(), di.Dahl(), tolerance=1e-2, uncertainty="noise")
    with pytest.raises(ValidationError, match="method is 'nuts'; expected one of mcmc, grid"):
        di.posterior(friction_table(), di.Dahl(), method="nuts", uncertainty="noise")


def test_predictive_checks_pass_the_right_model_and_fail_the_wrong_one():
    data = with_covariance(friction_table(30, 0.1, 10.0, 0.02), 0.02)
    right = di.posterior(data, di.Dahl(), seed=1, steps=100, uncertainty="noise")
    assert [check.statistic for check in right.checks] == ["size", "largest", "neighbours"]
    assert all(check.passed for check in right.checks)
    wrong = di.posterior(data, di.Dahl(alpha=2.0), seed=1, steps=100, uncertainty="noise")
    failed = {check.statistic for check in wrong.checks if not check.passed}
    assert {"size", "neighbours"} <= failed
    assert "MISFIT: neighbouring rows err in the same direction" in str(wrong)


def test_checks_of_a_right_model_are_calibrated():
    # over many tables, the shares must not be crowded at the end that means a misfit
    shares = []
    for seed in range(8):
        table = friction_table(15, noise=0.05, seed=seed)
        drawn = di.posterior(table, di.Dahl(), seed=1, steps=150, uncertainty="noise")
        shares += [check.share for check in drawn.checks]
    assert np.mean(np.array(shares) < 0.05) < 0.2


def test_student_t_is_a_density():
    # one row: its density over the measured response integrates to 1
    amplitude = np.array([2e-3])
    model = di.Dahl(f_max=0.1, sigma=30.0).describing_function(amplitude)
    covariance = 0.04 * np.eye(2)[None]
    offsets = np.linspace(0.0, 40.0, 401)
    total = 0.0
    for x in offsets:
        row = di.FrequencyResponse(np.ones(1), model + x * 0.2, amplitude, covariance=covariance)
        problem = TableProblem(row, di.Dahl(sigma=30.0))
        density = Density(problem, joint_prior(problem, {"f_max": (0.01, 1.0)}), "student_t")
        value = density.log_likelihood(np.log([[0.1]]), np.ones(1))[0]
        # radial symmetry: integrate over circles
        total += np.exp(value) * 2.0 * np.pi * x * 0.04 * (offsets[1] - offsets[0])
    assert total == pytest.approx(1.0, abs=2e-3)


@pytest.mark.versions
def test_arviz_gets_every_group(posterior):
    exported = posterior.to_arviz()
    groups = set(exported.groups())
    assert {
        "posterior", "prior", "log_likelihood", "observed_data", "posterior_predictive",
    } <= {name.strip("/") for name in groups}  # fmt: skip
    drawn = exported["posterior"]["f_max"].to_numpy()
    assert drawn.shape[0] == 4
    assert np.median(drawn) == pytest.approx(np.median(posterior.values[:, 0]), rel=1e-3)
    arviz = import_module("arviz")
    assert float(arviz.rhat(exported)["f_max"]) < 1.02
    ess = float(arviz.ess(exported)["f_max"])
    assert ess == pytest.approx(posterior.convergence.ess[0], rel=0.3)
    replicated = exported["posterior_predictive"]["real"].to_numpy()
    observed = exported["observed_data"]["real"].to_numpy()
    assert replicated.shape[2:] == observed.shape == (12,)
    assert np.abs(observed).max() < 4.0 * replicated.std()


def test_pictures(posterior):
    assert posterior.plot_corner().shape == (3, 3)
    assert len(posterior.plot_trace()) == 3

"""Moves, convergence and chains, against emcee, closed forms and themselves."""

import re
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import emcee
import numpy as np
import pytest
from scipy import stats

import dahl_ident as di
from dahl_ident.bayes.chain import autocorrelation_time, judge, r_hat
from dahl_ident.bayes.moves import EnsembleMove, differential_evolution, independent, snooker
from dahl_ident.errors import ModelError, SamplingError, ValidationError
from dahl_ident.problem import TableProblem
from tests.bayes_cases import friction_table, spring_table
from tests.friction_tables import FRICTION


def autoregression(steps, walkers, rho, seed=3):
    """Return paths whose autocorrelation time is (1 + rho)/(1 - rho)."""
    random = np.random.default_rng(seed)
    chain = np.empty((steps, walkers, 1))
    chain[0] = random.normal(size=(walkers, 1))
    for step in range(1, steps):
        kick = random.normal(size=(walkers, 1))
        chain[step] = rho * chain[step - 1] + np.sqrt(1.0 - rho**2) * kick
    return chain


def test_autocorrelation_time_is_that_of_emcee_and_of_the_closed_form():
    chain = autoregression(3000, 16, 0.8)
    tau = autocorrelation_time(chain)
    assert tau == pytest.approx(emcee.autocorr.integrated_time(chain, quiet=True), rel=1e-10)
    assert tau[0] == pytest.approx(9.0, rel=0.05)


def test_r_hat_sees_ensembles_apart_and_drift():
    chain = autoregression(2000, 16, 0.5)
    assert r_hat(chain, 4)[0] < 1.002
    apart = chain.copy()
    apart[:, :4] += 1.0
    assert r_hat(apart, 4)[0] > 1.05
    drifting = chain + np.linspace(0.0, 1.0, 2000)[:, None, None]
    assert r_hat(drifting, 4)[0] > 1.02


def test_the_verdict_says_what_is_missing():
    verdict = judge(autoregression(200, 16, 0.9), 4, required=5000.0)
    assert not verdict.converged
    assert "autocorrelation times, expected 50" in verdict.unmet[0]
    assert "effective draws, expected 5000" in verdict.unmet[-1]
    stuck = judge(np.ones((100, 8, 1)), 4, required=10.0)
    assert not stuck.usable
    assert stuck.unmet == ["some walkers never moved"]


@pytest.mark.parametrize("proposal", [independent, differential_evolution, snooker])
def test_every_move_alone_leaves_a_distribution_as_it_is(proposal):
    # skewed, in two dimensions: x gamma, y normal around x^2
    target = stats.gamma(3.0)

    def log_density(x):
        with np.errstate(divide="ignore", invalid="ignore"):
            first = np.where(x[:, 0] > 0.0, 2.0 * np.log(x[:, 0]) - x[:, 0], -np.inf)
        return first - 0.5 * (x[:, 1] - 0.3 * x[:, 0]) ** 2

    random = np.random.default_rng(5)
    x = target.rvs((4 * 40, 1), random_state=random)
    start = np.concatenate([x, 0.3 * x + random.normal(size=x.shape)], axis=1)
    move = EnsembleMove(proposal, 4)
    sampler = emcee.EnsembleSampler(160, 2, log_density, moves=[(move, 1.0)], vectorize=True)
    seeded = np.random.RandomState(7).get_state()
    sampler.run_mcmc(emcee.State(start, random_state=seeded), 1000)
    chain = sampler.get_chain()
    thin = int(np.ceil(4.0 * autocorrelation_time(chain).max()))  # the test wants independence
    draws = chain[::thin].reshape(-1, 2)
    assert stats.kstest(draws[:, 0], target.cdf).pvalue > 1e-3
    assert stats.kstest(draws[:, 1] - 0.3 * draws[:, 0], "norm").pvalue > 1e-3


def test_the_same_seed_gives_the_same_chain():
    data = friction_table()
    first = di.posterior(data, di.Dahl(), seed=4, steps=60, uncertainty="noise")
    again = di.posterior(data, di.Dahl(), seed=4, steps=60, uncertainty="noise")
    other = di.posterior(data, di.Dahl(), seed=5, steps=60, uncertainty="noise")
    np.testing.assert_array_equal(first.get_chain(), again.get_chain())
    assert not np.array_equal(first.get_chain(), other.get_chain())
    unseeded = di.posterior(data, di.Dahl(), steps=60, uncertainty="noise")
    repeated = di.posterior(data, di.Dahl(), steps=60, seed=unseeded.seed, uncertainty="noise")
    np.testing.assert_array_equal(unseeded.get_chain(), repeated.get_chain())


def test_a_pool_gives_the_same_posterior():
    data = friction_table()
    with ThreadPoolExecutor(2) as pool:
        spread = di.posterior(data, di.Dahl(), seed=4, steps=40, pool=pool, uncertainty="noise")
    alone = di.posterior(data, di.Dahl(), seed=4, steps=40, uncertainty="noise")
    np.testing.assert_allclose(spread.get_chain(), alone.get_chain(), rtol=1e-9)


def test_priors_alone_are_recovered_without_likelihood():
    f_max = stats.lognorm(0.3, scale=0.2)
    given: dict[str, Any] = {"f_max": f_max, "sigma": (5.0, 50.0)}
    posterior = di.posterior(friction_table(), di.Dahl(), priors=given, likelihood="none", seed=2)
    assert posterior.names == ("f_max", "sigma")
    thin = int(np.ceil(4.0 * posterior.get_autocorr_time().max()))
    draws = posterior.get_chain(discard=posterior.warm_up, thin=thin, flat=True)
    # other versions draw other numbers from the seed: a bound that chance rarely crosses
    assert stats.kstest(draws[:, 0], f_max.cdf).pvalue > 1e-4
    assert stats.kstest(np.log10(draws[:, 1] / 5.0), "uniform").pvalue > 1e-4


def test_student_t_resists_an_outlier():
    data = friction_table(rows=20, noise=0.01)
    response = data.response.copy()
    response[10] *= 1.8
    dirty = di.FrequencyResponse(data.frequency_hz, response, data.amplitude)
    plain = di.posterior(dirty, di.Dahl(), seed=1, uncertainty="noise").values[:, 0]
    robust = di.posterior(dirty, di.Dahl(), seed=1, likelihood="student_t").values[:, 0]
    assert robust.std() < 0.4 * plain.std()
    assert np.median(robust) == pytest.approx(0.1, abs=0.002)


def test_interchangeable_elements_keep_their_order():
    amplitude = np.geomspace(1e-4, 1e-1, 25)
    truth = di.Dahl(f_max=0.1, sigma=300.0, name="a") + di.Dahl(f_max=0.5, sigma=30.0, name="b")
    random = np.random.default_rng(2)
    noise = 0.01 * (random.normal(size=25) + 1j * random.normal(size=25))
    exact = TableProblem(
        di.FrequencyResponse(np.ones(25), np.ones(25) + 0j, amplitude), truth, free=["a_f_max"]
    ).predict(np.log([0.1]))
    data = di.FrequencyResponse(np.ones(25), exact * np.exp(noise), amplitude)
    model = di.Dahl(name="a") + di.Dahl(name="b")
    posterior = di.posterior(data, model, seed=1, max_steps=1500, uncertainty="noise")
    values = posterior.values
    assert (values[:, 0] / values[:, 1] < values[:, 2] / values[:, 3]).all()
    assert np.median(values[:, 0]) == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("uncertainty", ["noise", "combined"])
def test_sensor_priors_of_any_kind_are_sampled(uncertainty):
    """Least squares takes normal priors alone; the exponent is not given."""
    sensors = di.Sensors(force_gain=stats.uniform(0.95, 0.1))
    posterior = di.posterior(
        friction_table(), di.Dahl(), sensors=sensors, seed=1, uncertainty=uncertainty
    )
    gain = posterior.values[:, posterior.names.index("force_gain")]
    assert 0.95 <= gain.min() < 0.955
    assert 1.045 < gain.max() <= 1.05
    (rule,) = [r for r in posterior.prior_influences if r.name == "force_gain"]
    assert rule.width == pytest.approx(1.0, abs=0.1)


def test_a_curved_ridge_is_walked_along():
    # microslip with a free spring: f_max is open upwards, stiffness = constant - sigma
    data = spring_table(1e-3, 20, 0.003, 0.03)
    posterior = di.posterior(
        data, di.Dahl() + di.Spring(), seed=1, max_steps=3000, uncertainty="noise"
    )
    assert posterior.converged, posterior.message
    sigma = posterior.function(lambda sigma, **_: sigma)
    total = posterior.function(lambda sigma, stiffness, **_: sigma + stiffness)
    assert sigma["97.7%"] - sigma["2.3%"] > 100.0 * (total["97.7%"] - total["2.3%"])
    assert total["median"] == pytest.approx(60.0, abs=4.0 * total["std"])


def test_a_fit_is_taken_over():
    data = friction_table()
    fit = di.fit(data, di.Dahl())
    assert di.posterior(fit, seed=1, steps=50, uncertainty="noise").problem is fit.problem
    with pytest.raises(ValidationError, match="noise, free is given together with a FitResult"):
        di.posterior(fit, noise="absolute", free=["alpha"], uncertainty="noise")


def test_refusals():
    data = friction_table()
    with pytest.raises(ModelError, match="there is no model"):
        di.posterior(data, uncertainty="noise")
    with pytest.raises(ValidationError, match="walkers is 33; expected a whole number >= 48"):
        di.posterior(data, di.Dahl(), walkers=33, uncertainty="noise")
    with pytest.raises(ValidationError, match="walkers is 100; expected a multiple of 8"):
        di.posterior(data, di.Dahl(), walkers=100, uncertainty="noise")
    with pytest.raises(ValidationError, match="likelihood is 'cauchy'; expected one of gaussian"):
        di.posterior(data, di.Dahl(), likelihood="cauchy")
    for ess in (-1.0, np.nan):
        with pytest.raises(ValidationError, match=r"ess is .*; expected"):
            di.posterior(data, di.Dahl(), ess=ess, uncertainty="noise")
    pool: Any = 3
    with pytest.raises(ValidationError, match="pool is 3; expected an object with map"):
        di.posterior(data, di.Dahl(), pool=pool, uncertainty="noise")
    exact = FRICTION.describing_function(np.array([1e-3, 2e-3, 4e-3]))
    perfect = di.FrequencyResponse(np.ones(3), exact, np.array([1e-3, 2e-3, 4e-3]))
    with pytest.raises(SamplingError, match="there is no noise whose scale could be estimated"):
        di.posterior(perfect, di.Dahl(), uncertainty="noise")


# The bar that a long chain shows: how far it is, and how far it has to go.


def test_a_chain_moves_the_bar_to_its_end(monkeypatch):
    from rich import progress

    seen: list[tuple[float, float | None]] = []
    update = progress.Progress.update

    def remember(self, task, **given):
        seen.append((given["completed"], given["total"]))
        update(self, task, **given)

    monkeypatch.setattr(progress.Progress, "update", remember)
    posterior = di.posterior(
        friction_table(), di.Dahl(), seed=1, progress=True, uncertainty="noise"
    )
    steps = [done for done, _ in seen]
    assert steps == sorted(steps)
    assert posterior.steps - steps[-1] < 60
    assert seen[0] == (50, None)
    assert all(total is None or total >= done for done, total in seen)


def test_the_bar_shows_the_time_that_is_left(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    monkeypatch.setenv("COLUMNS", "100")
    di.posterior(friction_table(), di.Dahl(), seed=1, steps=100, progress=True, uncertainty="noise")
    shown = capsys.readouterr()
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.out + shown.err)
    assert re.search(r"sampling .*100/100 \d:\d\d:\d\d", plain)

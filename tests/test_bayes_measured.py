"""Posteriors from measurements made by others; what the model cannot say has to show."""

import numpy as np
import pytest

import dahl_ident as di
from benchmarks.measured import beam_table
from tests.measured import dampers, needs_measured

pytestmark = needs_measured


def test_the_damper_shows_its_misfit():
    data = di.FrequencyResponse.concatenate([di.extract(r, harmonics=(1,)) for r in dampers()])
    posterior = di.posterior(data, di.Dahl(), seed=1, ess=300.0, uncertainty="noise")
    assert posterior.converged
    size = next(check for check in posterior.checks if check.statistic == "size")
    assert not size.passed
    assert not posterior.trusted
    assert size.observed > 3.0 * size.replicated
    assert "MISFIT: the residuals are larger than the noise that the data state" in str(posterior)
    grid = di.posterior(data, di.Dahl(), method="grid", uncertainty="noise", tolerance=1e-2)
    for i, name in enumerate(("f_max", "sigma")):
        middle = float(grid.quantile(name, 0.5))
        assert np.median(posterior.values[:, i]) == pytest.approx(middle, abs=0.1 * grid.std()[i])


@pytest.mark.long
def test_the_bolted_joint_leaves_f_max_to_its_prior():
    beam = beam_table()
    held = beam.select(level=[label for label in beam.levels if "Response" in str(label)])
    data = held.select(rows=np.arange(held.n) % 8 == 0)
    model = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
    posterior = di.posterior(data, model, seed=1, ess=150.0, uncertainty="noise")
    assert posterior.converged, posterior.message
    f_max = next(rule for rule in posterior.prior_influences if rule.name == "f_max")
    assert f_max.at_upper_end
    assert "f_max is known from its prior: posterior width 0." in str(posterior)
    # all the same, the microslip loss and the small-amplitude stiffness are well known
    loss = posterior.function(lambda f_max, sigma, **_: sigma**2 / f_max)
    assert loss["84%"] < 1.4 * loss["16%"]
    assert 3.0e7 < loss["median"] < 5.0e7
    total = posterior.function(lambda sigma, stiffness, **_: sigma + stiffness)
    assert total["84%"] < 1.1 * total["16%"]

"""What misled a fit: wrong signs and single rows are named, and only where they are the cause."""

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, fit, load_dataset
from dahl_ident.diagnostics import VerdictStatus
from dahl_ident.diagnostics.misfit_explanations import neighbourhood
from dahl_ident.errors import FitError
from tests.friction_tables import FRICTION, X_C, plant_table, relative_noise, stated, table

MODEL = Dahl(alpha=1.0) + Mass(0.3) + Damper() + Spring()
BY: Final = "describing function"  # which predicts in a moment, and makes the plant's table


def scaled(data, rows, factors):
    R = data.response.copy()
    R[rows] *= factors
    return replace(data, response=R)


def noisy():
    return load_dataset("noisy")


def test_a_sign_is_named_where_there_is_no_finite_optimum():
    data = replace(noisy(), response=noisy().response.conj())
    with pytest.raises(FitError, match=r"^The mechanism gives energy .* No finite optimum"):
        fit(data, Dahl())


class TestRows:
    def test_side_by_side_the_model_may_fail_there(self):
        """As where a stop is hit; a robust loss would hide it."""
        robust = fit(scaled(table(), [27, 28, 29], [1.3, 1.5, 1.8]), Dahl(), loss="huber")
        assert robust.status is VerdictStatus.APPROXIMATE
        assert "they are neighbours, amplitude from 0.0243 to 0.0333 m" in robust.verdict
        last = fit(scaled(table(), [29], [1.8]), Dahl(), loss="huber")
        assert last.status is VerdictStatus.APPROXIMATE
        assert "it is the first or the last: check" in last.verdict

    def test_rows_at_random_seldom_lie_side_by_side(self):
        optimum, rng = fit(table(), Dahl()).optimum, np.random.default_rng(1)
        for k in (2, 3):
            rows = [rng.choice(30, k, replace=False).tolist() for _ in range(400)]
            assert np.mean([neighbourhood(optimum, some) != "" for some in rows]) < 0.02
        assert neighbourhood(optimum, [28, 29]).startswith("amplitude from")
        assert neighbourhood(optimum, [3]) == ""


class TestSign:
    @pytest.mark.parametrize("turn", [np.conj, np.negative])
    @pytest.mark.parametrize(
        ("data", "model"), [(noisy(), Dahl()), (plant_table(steady=BY), MODEL)]
    )
    def test_is_named(self, turn, data, model):
        right = fit(data, model, steady=BY).goodness
        turned = replace(data, response=turn(data.response))
        wrong = fit(turned, model, throw=False, steady=BY)
        assert "gives energy to its drive" in wrong.statements[0]
        assert "check the sign of the phase" in wrong.statements[0]
        assert "Do not use the numbers of this fit" in wrong.statements[0]
        report = wrong.fit_report()
        assert report.count(wrong.goodness.sign) == 1
        assert "Other models" not in report  # each would be fitted to the wrong sign
        assert not wrong.trusted
        assert right.sign == ""

    def test_is_not_blamed_for_another_departure(self):
        stiff = table(model=FRICTION + Spring(20.0))
        lossless = table(beta=(1e-6, 1e-5))
        for data in (table(model=Dahl(0.1, 30.0, alpha=2.0)), stiff, lossless):
            assert fit(data, Dahl(), throw=False).goodness.sign == ""


def test_the_error_of_an_exponent_asked_for_follows_the_scatter():
    """A covariance that claims a third of the noise narrows the error no more."""
    data = table(model=Dahl(0.1, 30.0, alpha=1.2), noise=0.03)
    tables = (replace(data, covariance=stated(data.response, share)) for share in (0.03, 0.01))
    (honest,), (claimed,) = (fit(t, Dahl(alpha=1.0)).goodness.of("exponent") for t in tables)
    assert claimed.values["stderr"] == pytest.approx(honest.values["stderr"], rel=0.4)
    assert claimed.values["widened"] == pytest.approx(3.0, rel=0.4)
    assert "(error widened " in str(claimed)


def test_a_missing_mass_is_no_wrong_sign():
    """Far above resonance the response has the sign of the mass, and its loss that of all."""
    A = np.geomspace(0.1, 10.0, 30) * X_C
    Z = (FRICTION + Mass(1.0)).dynamic_stiffness(A, 4.0 * np.pi) * relative_noise(30, 0.01, 1)
    found = fit(FrequencyResponse(np.full(30, 2.0), Z, A), Dahl(), throw=False).goodness
    assert found.objections
    assert not found.sign

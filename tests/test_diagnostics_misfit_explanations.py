"""What misled a fit: wrong signs and single rows are named, and only where they are the cause."""

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, fit, load_dataset
from dahl_ident.diagnostics import VerdictStatus
from dahl_ident.diagnostics.misfit_explanations import SIGN_CHANGES, neighbourhood
from dahl_ident.errors import FitError
from tests.friction_tables import FRICTION, X_C, plant_table, relative_noise, stated, table

MODEL = Dahl(alpha=1.0) + Mass(0.3) + Damper() + Spring()
CONJUGATED, NEGATED, BOTH = SIGN_CHANGES
BY: Final = "describing function"  # which predicts in a moment, and makes the plant's table


def scaled(data, rows, factors):
    R = data.response.copy()
    R[rows] *= factors
    return replace(data, response=R)


def noisy():
    return load_dataset("noisy")


def test_a_sign_is_named_where_there_is_no_finite_optimum():
    data = CONJUGATED(noisy())
    with pytest.raises(FitError, match=r"^With the response conjugated .* No finite optimum"):
        fit(data, Dahl())


class TestRows:
    def test_lead_the_verdict_where_they_alone_are_the_cause(self):
        data = load_dataset("outliers")
        found = fit(data, Dahl())
        kept = ~np.isin(np.arange(30), [18, 19, 27])  # as the data set was made
        alone = fit(data.select(rows=kept), Dahl()).goodness.rms_misfit
        first = found.statements[0]
        assert "Only 3 of 30 rows (1 Hz, 24.3 mm; 1 Hz, 6.81 mm; 1 Hz, 5.81 mm) contradict" in first
        assert (
            f"the residuals are consistent with noise ({100.0 * alone:.2g} % rms misfit)" in first
        )
        assert "fit with loss='huber', which down-weights them" in first
        assert "not linear Dahl" not in found.verdict
        assert found.ndata == 60  # none is dropped
        assert fit(data, Dahl(), loss="huber").trusted

    def test_a_single_row(self):
        first = fit(scaled(table(), [7], [2.0]), Dahl()).statements[0]
        assert "Only the row at 1 Hz, 1.01 mm contradicts the model" in first
        assert "without it the residuals are consistent with noise" in first

    @pytest.mark.parametrize(("fall", "explains"), [(2.0, False), (4.5, True)])
    def test_explain_only_where_the_misfit_falls_to_a_third(self, fall, explains):
        # n rows with errors s in gain and phase have a mean square misfit of 2 s^2, to which one
        # that misses by d adds d^2/n; measured by its own size it is off by d/(1 - d)
        n, s = 60, 0.01
        missed = s * np.sqrt(2.0 * n * (fall**2 - 1.0))
        off = missed / (1.0 - missed)
        data = table(n=n, noise=s)
        C = np.eye(2) * (s * np.abs(data.response))[:, None, None] ** 2
        found = fit(scaled(replace(data, covariance=C), [31], [1.0 + off]), Dahl(), throw=False)
        alone = fit(replace(data, covariance=C), Dahl()).goodness.rms_misfit
        assert found.goodness.rms_misfit == pytest.approx(fall * alone, rel=0.25)
        assert ("Only the row at 1 Hz, 3.75 mm contradicts" in found.verdict) == explains

    def test_do_not_lead_where_a_departure_is_left_without_them(self):
        data = scaled(table(model=Dahl(0.1, 30.0, alpha=1.5)), [7, 19], [3.0, 0.3])
        found = fit(data, Dahl(alpha=1.0))
        assert {point.row for point in found.goodness.suspicious} >= {7, 19}
        assert found.goodness.cause == ""
        assert "rms misfit" in found.statements[0]

    def test_do_not_lead_where_they_lie_side_by_side(self):
        """As where a stop is hit: the model may fail there, and a robust loss would hide it."""
        found = fit(scaled(table(), [27, 28, 29], [1.3, 1.5, 1.8]), Dahl())
        assert found.goodness.cause == ""
        assert "do not cover the misfit" in found.verdict
        assert "they are neighbours, amplitude from 0.0243 to 0.0333 m" in found.fit_report()
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
    @pytest.mark.parametrize(
        ("turn", "data", "model"),
        [
            *((turn, noisy(), Dahl()) for turn in SIGN_CHANGES),
            (CONJUGATED, plant_table(steady=BY), MODEL),
        ],
    )
    def test_is_named_with_its_misfit(self, turn, data, model):
        right = fit(data, model, steady=BY).goodness
        wrong = fit(turn(data), model, throw=False, steady=BY)
        assert f"With the response {turn.name} the misfit falls from " in wrong.statements[0]
        assert f"to {100.0 * right.rms_misfit:.2g} % rms: check " in wrong.statements[0]
        assert "Do not use the numbers of this fit" in wrong.statements[0]
        report = wrong.fit_report()
        assert report.count(wrong.goodness.sign) == 1
        assert "Other models" not in report  # each would be fitted to the wrong sign
        assert not wrong.trusted
        assert right.sign == ""

    def test_the_data_s_covariances_turn_with_it(self):
        """Turned by hand, from draws of amplitude, real and imaginary part."""
        draws = np.random.default_rng(1).multivariate_normal(
            np.zeros(3), [[1.0, 0.3, 0.2], [0.3, 2.0, 0.5], [0.2, 0.5, 1.0]], 50
        )
        for turn, signs in ((CONJUGATED, (1, -1)), (NEGATED, (-1, -1)), (BOTH, (-1, 1))):
            before = np.cov(draws.T)
            after = np.cov((draws * [1, *signs]).T)
            data = FrequencyResponse(
                [1.0],
                [100.0 + 50.0j],
                [10.0],
                covariance=before[None, 1:, 1:],
                amplitude_std=[np.sqrt(before[0, 0])],
                amplitude_covariance=before[None, 0, 1:],
            )
            turned = turn(data)
            assert turned.response[0] == complex(100.0 * signs[0], 50.0 * signs[1])
            np.testing.assert_allclose(turned.covariance[0], after[1:, 1:], rtol=1e-12)
            np.testing.assert_allclose(turned.amplitude_covariance[0], after[0, 1:], rtol=1e-12)

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


class TestNoCause:
    def test_a_missing_mass_is_no_wrong_sign(self):
        """Far above resonance the response has the sign of the mass, and its loss that of all."""
        A = np.geomspace(0.1, 10.0, 30) * X_C
        Z = (FRICTION + Mass(1.0)).dynamic_stiffness(A, 4.0 * np.pi) * relative_noise(30, 0.01, 1)
        found = fit(FrequencyResponse(np.full(30, 2.0), Z, A), Dahl(), throw=False).goodness
        assert found.objections
        assert found.cause == ""

    def test_a_missing_mass_is_no_single_bad_row(self):
        A, f = np.tile(np.geomspace(0.1, 10.0, 5) * X_C, 2), np.repeat([1.0, 4.0], 5)
        Z = (FRICTION + Mass(0.01)).dynamic_stiffness(A, 2.0 * np.pi * f)
        found = fit(FrequencyResponse(f, Z * relative_noise(10, 0.01, 0), A), Dahl())
        assert found.goodness.suspicious
        assert found.goodness.cause == ""

    def test_the_last_row_may_be_where_the_model_ends(self):
        found = fit(scaled(table(), [29], [1.5]), Dahl())
        assert [point.row for point in found.goodness.suspicious] == [29]
        assert found.goodness.cause == ""

"""Bands of one more test: tests left out of measured and of synthetic devices lie inside them."""

import numpy as np
import pytest
from scipy import stats

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, fit
from dahl_ident.diagnostics import error_model
from dahl_ident.diagnostics.contributions import NOISE
from dahl_ident.diagnostics.error_sources import rows_of_tests
from dahl_ident.diagnostics.held_out import band_factor
from tests.derivatives import central_differences
from tests.friction_tables import FRICTION, X_C, relative_noise, table


def scattering(seed, n=12, tails=4.0):
    """Return tests that scatter by 4 %, far more than their covariances say, and these are uneven.

    As from records of few cycles: deviations of 0.1 to 1 %, known from few degrees of freedom.
    """
    rng = np.random.default_rng(seed)
    A = np.geomspace(0.2, 10.0, n) * X_C
    scatter = 0.04 * rng.standard_t(tails, (n, 2)) * np.sqrt((tails - 2.0) / tails)
    N = FRICTION.describing_function(A) * np.exp(scatter @ np.array([1.0, 1.0j]))
    stated = np.exp(rng.uniform(np.log(1e-3), np.log(1e-2), n)) * np.abs(N)
    return FrequencyResponse(
        np.ones(n), N, A, covariance=stated[:, None, None] ** 2 * np.eye(2),
        dof=rng.choice([3.2, 6.3, 20.0], n),
    )  # fmt: skip


def microslip(seed, levels=5):
    """Return a mode with a joint far below slip, whose gain differs from level to level."""
    rng = np.random.default_rng(seed)
    f = np.tile(np.linspace(0.30, 0.75, 9), levels)
    A = np.repeat(np.geomspace(0.001, 0.01, levels), 9) * X_C
    plant = FRICTION + Mass(2.0) + Damper(0.3) + Spring(2.0)
    gain = np.exp(0.002 * rng.standard_normal(levels))
    Z = plant.dynamic_stiffness(A, 2.0 * np.pi * f) * np.repeat(gain, 9)
    level = np.repeat([f"level {i}" for i in range(levels)], 9)
    return FrequencyResponse(f, Z * relative_noise(f.size, 3e-4, seed + 50), A, level=level)


def left_out(data, model):
    """Return whether tests lie in the bands of fits to the others, and half widths of these."""
    inside, widths = [], []
    for rows in rows_of_tests(data):
        held = np.isin(np.arange(data.n), rows)
        own = data.select(rows=held)
        assert own.amplitude is not None
        band = fit(data.select(rows=~held), model, throw=False).predict(
            own.frequency_hz, amplitude=own.amplitude
        )
        for measured, (low, high) in (
            (np.abs(own.response), band.gain(0.95)),
            (np.angle(own.response), band.phase(0.95)),
        ):
            inside += ((low <= measured) & (measured <= high)).tolist()
        low, high = band.gain(0.95)
        widths += (0.5 * np.log(high / low)).tolist()
    return inside, widths


class TestFactor:
    def test_is_where_the_predictive_tail_is_as_large(self):
        """Against a search along the tail of the Dirichlet process with Student's t as prior."""
        rng = np.random.default_rng(3)
        for scores in (np.abs(rng.standard_t(2.0, k)) for k in (5, 18, 60, 400)):
            z = np.arange(1.0, 60.0, 1e-3)
            tail = 10.0 * 2.0 * stats.t(7.0).sf(z) + np.sum(scores[:, None] > z, axis=0)
            first = z[np.argmax(tail <= 0.05 * (10.0 + scores.size))]
            expected = max(first, stats.t(7.0).ppf(0.975))
            found = band_factor(scores, np.array([7.0]), 0.95)
            assert found[0] == pytest.approx(expected, abs=2e-3)

    def test_is_that_of_student_without_tests(self):
        found = band_factor(np.empty(0), np.array([4.0, np.inf]), 0.9545)
        np.testing.assert_allclose(found, [stats.t(4).ppf(0.97725), 2.0], rtol=1e-4)


class TestLeftOut:
    @staticmethod
    def errors(n):
        rng = np.random.default_rng(4)
        A = np.repeat(np.geomspace(0.1, 10.0, n // 4), 4) * X_C
        shared = np.repeat(np.exp(0.03 * rng.standard_normal(n // 4)), 4)
        N = FRICTION.describing_function(A) * shared * relative_noise(n, 0.01, 5)
        found = error_model(fit(FrequencyResponse(np.ones(n), N, A), Dahl()).optimum)
        assert found is not None
        return found

    @pytest.mark.parametrize("n", [32, 160])
    def test_is_the_prediction_from_the_others(self, n):
        """Universal kriging by its definition, about the estimate without the test."""
        errors = self.errors(n)
        found = errors.left_out
        m, V = 2 * n, float(errors.noises[0]) * np.eye(2 * n)
        for source, variance in zip(errors.sources, errors.variances.tolist(), strict=True):
            V += variance * source.columns[:m] @ source.columns[:m].T
        units = errors.estimate.relative_units
        for test in (0, 3):
            rows = found.rows[found.test == test]
            b = (2 * rows[:, None] + np.arange(2)).ravel()
            a = np.setdiff1d(np.arange(m), b)
            refit = errors.estimate.without(b)
            J, y = refit.jacobian, refit.y
            assert len(J) > m
            prior, y_prior = J[m:].T @ J[m:], J[m:].T @ y[m:]
            W = np.linalg.inv(V[np.ix_(a, a)])
            C = np.linalg.inv(J[a].T @ W @ J[a] + prior)
            delta = C @ (J[a].T @ W @ y[a] + y_prior)
            across = V[np.ix_(b, a)] @ W
            missed = y[b] - J[b] @ delta - across @ (y[a] - J[a] @ delta)
            lever = J[b] - across @ J[a]
            D = V[np.ix_(b, b)] - across @ V[np.ix_(a, b)] + lever @ C @ lever.T
            for place, row in enumerate(rows):
                i = slice(2 * place, 2 * place + 2)
                k = np.flatnonzero(found.rows == row)[0]
                np.testing.assert_allclose(found.deviation[k], units[row] @ missed[i], rtol=1e-5)
                std = np.sqrt(np.diagonal(units[row] @ D[i, i] @ units[row].T))
                np.testing.assert_allclose(found.std[k], std, rtol=1e-5)

    def test_the_estimate_is_that_of_a_fit_without_the_test(self):
        """One Gauss-Newton step from the whole estimate, which is a fraction of u away."""
        data = table(n=16, noise=0.02, seed=4)
        whole = fit(data, Dahl())
        for row in (0, 7, 15):
            rest = fit(data.select(rows=np.arange(16) != row), Dahl())
            refit = whole.errors.estimate.without(np.array([2 * row, 2 * row + 1]))
            apart = whole.errors.problem.to_values(refit.theta) - list(rest.errors.values.values())
            assert np.all(np.abs(apart) < 0.1 * np.array(list(rest.errors.stderr.values())))

    @pytest.mark.parametrize("n", [32, 160])
    def test_falls_with_each_variance(self, n):
        """The degrees of freedom come from these derivatives; against differences."""
        errors = self.errors(n)
        state, rows = errors.state, np.array([0, 1, 6, 7])
        slopes = central_differences(
            lambda moved: state.model.at(moved).block(rows), state.variances, 1e-5 * state.variances
        )
        for found, slope in zip(state.block_slopes(rows), slopes, strict=True):
            np.testing.assert_allclose(found, -slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max())

    def test_without_tests_there_are_none(self):
        errors = error_model(fit(table(n=2), Dahl(alpha=1.0)).optimum)
        assert errors.left_out is None


class TestTestsThatScatter:
    def test_far_beyond_an_uneven_covariance(self):
        """Bands hold, though the stated covariances say neither how much nor where."""
        inside: list[bool] = []
        for seed in range(4):
            data = scattering(seed)
            found, widths = left_out(data, Dahl())
            misfit = fit(data, Dahl()).goodness.rms_misfit
            assert np.sqrt(np.mean(np.square(widths))) < 4.0 * misfit
            inside += found
        assert 0.88 <= np.mean(inside) < 1.0

    def test_scatter_is_that_of_the_response_however_few_the_degrees_of_freedom(self):
        """Covariances of few degrees of freedom weigh their residuals, not the scatter."""
        found = []
        for seed in range(6):
            data = scattering(100 + seed, n=40, tails=1e6)
            errors = error_model(fit(data, Dahl()).optimum)
            found.append(errors.rms(NOISE))
        assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.04, rel=0.2)


class TestAtInfinity:
    MODEL = Dahl() + Mass() + Damper() + Spring()

    @pytest.mark.long
    def test_what_is_determined_has_budget_and_bands(self):
        truth = 30.0**2 / 0.1
        covered: list[bool] = []
        inside: list[float] = []
        for data in map(microslip, range(20)):
            found = fit(data, self.MODEL, throw=False)
            if found.success:
                continue
            if len(covered) == 3:
                break
            kappa = found.budget()["sigma^2/f_max"]
            covered.append(abs(kappa.value - truth) < kappa.U)
            mass = found.budget()["mass"]
            _, low, high = found.conf_interval()["mass"][1]
            assert (found.params["mass"].value, found.params["mass"].stderr) == (mass.value, mass.u)
            assert (high - low) / 2.0 == pytest.approx(mass.U, rel=0.05)
            assert "sigma + stiffness" in found.budget()
            assert not {"f_max", "sigma", "stiffness", "f_max/sigma"} & set(found.budget())
            check = found.cross_validation
            inside.append(check.inside / check.count)
            assert check.width < 4.0 * found.goodness.rms_misfit
        assert len(covered) >= 3
        assert np.mean(covered) >= 0.75
        assert np.mean(inside) > 0.88

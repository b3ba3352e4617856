"""Bands of predictions and derived quantities, against simulation, differences and closed forms."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import special

import dahl_ident as di
from dahl_ident import extract, fit, load_dataset
from dahl_ident.elements.driven_motion import Steady
from dahl_ident.errors import ModelError, ValidationError
from tests.derivatives import central_differences
from tests.friction_tables import F_MAX, X_C, amplitudes, plant_table, table
from tests.measured import cranks, needs_measured

GRID = np.geomspace(0.05, 20.0, 15) * X_C


@pytest.fixture(scope="module")
def result():
    """Data of a given exponent whose residuals ask for nothing but noise of one size."""
    for seed in range(1, 20):
        found = fit(table(seed=seed), di.Dahl(alpha=1.0))
        if not found.errors.sources and list(found.errors.contributions) == ["noise"]:
            return found
    pytest.fail("every table asks for more than noise")


class TestBands:
    def test_are_those_of_parameters_drawn_from_the_covariance(self, result):
        """The first-order band is the spread of the prediction, each part for itself."""
        rng = np.random.default_rng(0)
        optimum = result.optimum
        drawn = rng.multivariate_normal(optimum.theta, optimum.covariance, 20000)
        f_max, sigma = np.exp(drawn).T
        N = np.array(
            [
                di.Dahl(1.0, s / f).describing_function(GRID) * f
                for f, s in zip(f_max[:4000], sigma[:4000], strict=True)
            ]
        )
        band = result.predict(1.0, amplitude=GRID, noise=False)
        np.testing.assert_allclose(band.real_std, N.real.std(axis=0), rtol=0.05)
        np.testing.assert_allclose(band.imag_std, N.imag.std(axis=0), rtol=0.05)
        np.testing.assert_allclose(band.log_gain_std, np.log(np.abs(N)).std(axis=0), rtol=0.05)
        np.testing.assert_allclose(band.phase_std, np.angle(N).std(axis=0), rtol=0.05)

    def test_limits_take_the_threshold_of_t(self, result):
        band = result.predict(1.0, amplitude=GRID, noise=False)
        t = special.stdtrit(result.nfree, 0.975)
        low, high = band.real(0.95)
        np.testing.assert_allclose(high - low, 2.0 * t * band.real_std)
        low, high = band.imag(0.95)
        np.testing.assert_allclose(0.5 * (high + low), band.response.imag)
        low, high = band.gain(0.95)
        np.testing.assert_allclose(np.log(high / low), 2.0 * t * band.log_gain_std)
        low, high = band.phase(0.95)
        np.testing.assert_allclose(high - low, 2.0 * t * band.phase_std)

    def test_scatter_between_levels_has_their_degrees_of_freedom(self):
        """One-way analysis of variance: the mean of L levels, gain and phase, has 2 (L - 1)."""
        rng, L, n = np.random.default_rng(1), 6, 3
        error = rng.normal(0.0, 0.05, (L, 1, 2)) + rng.normal(0.0, 0.01, (L, n, 2))
        response = (1000.0 + 300.0j) * np.exp(error.reshape(-1, 2) @ [1.0, 1.0j])
        A = np.repeat(np.geomspace(1e-4, 1e-2, L), n)
        linear = fit(
            di.FrequencyResponse(np.full(L * n, 10.0), response, A), di.Spring() + di.Damper()
        )
        between = np.sum((error.mean(axis=1) - error.mean(axis=(0, 1))) ** 2) / (2 * (L - 1))
        band = linear.predict(10.0, amplitude=1e-3, noise=False)
        assert band.log_gain_std == pytest.approx(np.sqrt(between / L), rel=1e-6)
        low, high = band.gain(0.95)
        t = np.log(high / low) / (2.0 * band.log_gain_std)
        assert t == pytest.approx(special.stdtrit(2 * (L - 1), 0.975), rel=1e-6)

    def test_cover_the_true_curve(self):
        truth = di.Dahl(0.1, 30.0).describing_function(GRID)
        inside = []
        for seed in range(30):
            found = fit(table(seed=seed, n=8), di.Dahl())
            low, high = found.predict(1.0, amplitude=GRID, noise=False).gain(0.9545)
            inside.append((low <= np.abs(truth)) & (np.abs(truth) <= high))
        cover = np.mean(inside, axis=0)  # the size of a model error is known badly from 8 rows
        assert cover.min() > 0.87 - 2.0 * np.sqrt(0.87 * 0.13 / 30)
        assert 0.89 < cover.mean() < 0.99

    def test_plant_at_drives(self):
        model = di.Dahl(alpha=1.0) + di.Mass() + di.Damper() + di.Spring()
        result = fit(plant_table(), model, method="ipopt", constraints=lambda p: [p["mass"] >= 0.1])
        assert result.errors is None  # noise alone
        band = result.predict(result.data.frequency_hz, drive=result.data.drive, noise=False)
        np.testing.assert_allclose(band.response, result.best_fit, rtol=1e-9)
        d = central_differences(
            lambda theta: np.log(result.problem.predict(theta)), result.optimum.theta, 1e-6
        )
        expected = np.sqrt(np.einsum("in,ij,jn->n", d.imag, result.optimum.covariance, d.imag))
        np.testing.assert_allclose(band.phase_std, expected, rtol=1e-5)

    def test_another_quantity(self, result):
        stiffness = result.predict(1.0, amplitude=GRID)
        receptance = result.predict(1.0, amplitude=GRID, quantity="receptance")
        np.testing.assert_allclose(receptance.response, 1.0 / stiffness.response, rtol=1e-12)
        np.testing.assert_allclose(receptance.log_gain_std, stiffness.log_gain_std, rtol=1e-9)

    def test_friction_of_a_plant(self):
        sine: Steady = "describing function"
        model = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
        result = fit(plant_table(steady=sine), model, steady=sine)
        law = di.Dahl(*(result.errors.values[name] for name in ("f_max", "sigma", "alpha")))
        band = result.describing_function(GRID)
        np.testing.assert_allclose(band.response, law.describing_function(GRID))
        one = result.describing_function(GRID[3])
        assert (one.response, one.real_std) == pytest.approx((band.response[3], band.real_std[3]))
        noise = np.sqrt(result.optimum.covariance[0, 0])
        assert 0.9 * noise < band.log_gain_std[-1] < 4.0 * noise  # a model error counts

    def test_what_is_determined_has_a_band_where_parameters_have_none(self, result):
        known = result.predict(1.0, amplitude=GRID)
        lost = fit(result.data, di.Dahl(), sensors=di.Sensors(force_gain=None), throw=False)
        band = lost.predict(1.0, amplitude=GRID)
        np.testing.assert_allclose(band.log_gain_std, known.log_gain_std, rtol=0.05)
        assert np.isinf(lost.describing_function(GRID).log_gain_std).all()

    def test_refusals(self, result):
        with pytest.raises(ValidationError, match="give either amplitude"):
            result.predict(1.0)
        with pytest.raises(ValidationError, match="give either amplitude"):
            result.predict(1.0, amplitude=GRID, drive=GRID)
        shapes = r"frequency_hz has shape \(3,\) and amplitude \(2,\); expected one shape"
        with pytest.raises(ValidationError, match=shapes):
            result.predict([1.0, 2.0, 3.0], amplitude=[1e-3, 1e-2])
        with pytest.raises(ModelError, match="no friction law"):
            fit(table(), di.Spring(), throw=False).describing_function(GRID)


class TestMeasured:
    """Each test of a damper is predicted by a fit to the others."""

    @needs_measured
    def test_bands_hold_what_was_left_out(self):
        data = di.FrequencyResponse.concatenate(
            [extract(record, harmonics=[1]) for record in cranks(".A.*")]
        )
        model = di.Dahl() + di.Spring() + di.Damper()
        assert "The extraction flagged every point" in fit(data, model).verdict
        data = replace(data, quality={})  # taken as it is
        whole = fit(data, model)
        assert whole.status.usable
        inside, widths = [], []
        for row in range(0, data.n, 2):
            others = fit(data.select(rows=np.arange(data.n) != row), model, throw=False)
            band = others.predict(data.frequency_hz[row], amplitude=amplitudes(data)[row])
            measured = data.response[row]
            for (low, high), value in (
                (np.log(band.gain(0.95)), np.log(np.abs(measured))),
                (band.phase(0.95), np.angle(measured)),
            ):
                inside.append(bool((low <= value) & (value <= high)))
                widths.append(0.5 * (high - low).item())
        assert 0.88 <= np.mean(inside) <= 1.0
        assert np.sqrt(np.mean(np.square(widths))) < 4.0 * whole.goodness.rms_misfit


class TestHarmonics:
    def test_what_is_missed_of_them_moves_the_estimate_by_no_more_than_it_states(self):
        """A driven plant read as one whose displacement was controlled: its harmonics are wrong."""
        record: Any = load_dataset("plant_recording")
        data = extract(record)
        model = di.Dahl() + di.Mass() + di.Damper() + di.Spring()
        found = fit(data, model, throw=False)
        alone = fit(data.select(rows=data.harmonic == 1), model, throw=False)
        for name, truth in (("f_max", 0.1), ("sigma", 30.0)):
            value, error = found.params[name].value, found.params[name].stderr
            assert value == pytest.approx(truth, abs=2.0 * error)
            assert value == pytest.approx(alone.params[name].value, abs=1.7 * error)
            assert error < 0.1 * truth

    def test_a_gross_error_of_one_leaves_the_bands_of_the_fundamental_alone(self):
        rng = np.random.default_rng(3)
        A = np.geomspace(3e-4, 3e-2, 12)
        own = [np.asarray(v) for v in (0.1, 30.0, 1.0)]
        rows = [
            di.Dahl().stiffness(own, A, np.zeros(()), k)
            * (1.0 + 0.01 * rng.standard_normal((12, 2)) @ [1.0, 1.0j])
            for k in (1, 3)
        ]
        size = np.abs(np.concatenate(rows))
        stds = []
        for factor in (1.0, 3.0):
            rows[1][5] *= factor
            data = di.FrequencyResponse(
                np.ones(24), np.concatenate(rows), np.tile(A, 2), harmonic=np.repeat([1, 3], 12),
                covariance=1e-4 * size[:, None, None] ** 2 * np.eye(2),
            )  # fmt: skip
            found = fit(data, di.Dahl(), throw=False)
            stds.append(found.predict(1.0, amplitude=A).log_gain_std)
        assert "suspicious points" in found.errors.contributions
        np.testing.assert_allclose(stds[1], stds[0], rtol=0.05)


class TestDerived:
    def test_x_c_by_its_formula(self, result):
        (x_c,) = result.derived()
        f, s = result.params["f_max"].value, result.params["sigma"].value
        C = result.covar
        expected = f / s * np.sqrt(C[0, 0] / f**2 + C[1, 1] / s**2 - 2.0 * C[0, 1] / (f * s))
        assert (x_c.name, x_c.unit) == ("x_c", "m")
        assert x_c.value == pytest.approx(f / s)
        assert x_c.stderr == pytest.approx(expected, rel=1e-9)

    def test_energy_stiffness_and_damping_in_closed_form(self, result):
        A, omega = 5e-3, 2.0 * np.pi * 3.0
        f, s = result.params["f_max"].value, result.params["sigma"].value
        found = {q.name: q for q in result.derived([A], frequency_hz=3.0)}
        beta = s * A / f
        energy = 4.0 * f * A * (1.0 - np.tanh(beta) / beta)
        assert found["energy lost in a cycle"].value == pytest.approx(energy, rel=1e-12)
        stiffness = s * 2.0 * special.iv(1, beta) / (beta * np.cosh(beta))
        assert found["equivalent stiffness"].value == pytest.approx(stiffness, rel=1e-12)
        damping = energy / (np.pi * A**2 * omega)
        assert found["equivalent damping"].value == pytest.approx(damping, rel=1e-12)
        slope = central_differences(
            lambda factors: self.energy(f * factors[0], s * factors[1], A), [1.0, 1.0], 1e-6
        )
        expected = np.sqrt(slope @ result.optimum.covariance @ slope)
        assert found["energy lost in a cycle"].stderr == pytest.approx(expected, rel=1e-5)

    @staticmethod
    def energy(f_max, sigma, A):
        beta = sigma * A / f_max
        return 4.0 * f_max * A * (1.0 - float(np.tanh(beta)) / beta)

    def test_names_of_elements_and_units_of_rotation(self):
        data = table(model=di.Dahl(F_MAX, 30.0) + di.Dahl(F_MAX, 3.0, name="other"))
        found = fit(data, di.Dahl(name="early") + di.Dahl(name="late")).derived([1e-3])
        assert [q.name for q in found[:2]] == ["early_x_c", "late_x_c"]
        assert str(found[2]).startswith("energy lost in a cycle at amplitude 0.001 = ")

    def test_no_x_c_where_it_is_infinite(self):
        results = (fit(table(beta=(1e-4, 1e-3), seed=s), di.Dahl(), throw=False) for s in range(10))
        (first, *_) = (r for r in results if not r.success)
        assert first.derived() == ()

    def test_what_is_determined_has_an_error_where_the_parameters_are_not(self):
        """In microslip the stiffness, 24 times measured, is known whatever f_max is."""
        found = fit(table(beta=(1e-6, 1e-4), n=24), di.Dahl(alpha=1.0), throw=False)
        assert not found.success
        stiffness = next(q for q in found.derived([1e-5 * X_C]) if q.unit == "N/m")
        assert stiffness.value == pytest.approx(30.0, abs=3.0 * stiffness.stderr)
        assert stiffness.stderr / 30.0 == pytest.approx(0.01 / np.sqrt(24.0), rel=0.4)

"""Bands of predictions and derived quantities, against simulation, differences and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from dahl_ident import Dahl, Damper, Mass, Sensors, Spring, fit
from dahl_ident.errors import ModelError, ValidationError
from dahl_ident.results import FitResult
from tests.friction_tables import F_MAX, X_C, plant_table, table

GRID = np.geomspace(0.05, 20.0, 15) * X_C


@pytest.fixture(scope="module")
def result() -> FitResult:
    return fit(table(), Dahl())


class TestBands:
    def test_are_those_of_parameters_drawn_from_the_covariance(self, result: FitResult) -> None:
        """The first-order band is the spread of the prediction, each part for itself."""
        rng = np.random.default_rng(0)
        optimum = result.optimum
        drawn = rng.multivariate_normal(optimum.theta, optimum.covariance, 20000)
        f_max, sigma = np.exp(drawn).T
        N = np.array(
            [
                Dahl(1.0, s / f).describing_function(GRID) * f
                for f, s in zip(f_max[:4000], sigma[:4000], strict=True)
            ]
        )
        band = result.predict(1.0, amplitude=GRID)
        np.testing.assert_allclose(band.real_std, N.real.std(axis=0), rtol=0.05)
        np.testing.assert_allclose(band.imag_std, N.imag.std(axis=0), rtol=0.05)
        np.testing.assert_allclose(band.log_gain_std, np.log(np.abs(N)).std(axis=0), rtol=0.05)
        np.testing.assert_allclose(band.phase_std, np.angle(N).std(axis=0), rtol=0.05)

    def test_limits_take_the_threshold_of_t(self, result: FitResult) -> None:
        band = result.predict(1.0, amplitude=GRID)
        t = special.stdtrit(result.nfree, 0.975)
        low, high = band.real(0.95)
        np.testing.assert_allclose(high - low, 2.0 * t * band.real_std)
        low, high = band.imag(0.95)
        np.testing.assert_allclose(0.5 * (high + low), band.response.imag)
        low, high = band.gain(0.95)
        np.testing.assert_allclose(np.log(high / low), 2.0 * t * band.log_gain_std)
        low, high = band.phase(0.95)
        np.testing.assert_allclose(high - low, 2.0 * t * band.phase_std)

    def test_cover_the_true_curve(self) -> None:
        truth = Dahl(0.1, 30.0).describing_function(GRID)
        inside = []
        for seed in range(200):
            low, high = fit(table(seed=seed, n=8), Dahl()).predict(1.0, amplitude=GRID).gain(0.9545)
            inside.append((low <= np.abs(truth)) & (np.abs(truth) <= high))
        cover = np.mean(inside, axis=0)
        assert np.abs(cover - 0.9545).max() < 4.0 * np.sqrt(0.9545 * 0.0455 / 200)

    def test_plant_at_drives(self) -> None:
        result = fit(plant_table(), Dahl() + Mass() + Damper() + Spring())
        band = result.predict(result.data.frequency_hz, drive=result.data.drive)
        np.testing.assert_allclose(band.response, result.best_fit, rtol=1e-9)
        theta, step = result.optimum.theta, 1e-6
        gradient = []
        for i in range(len(theta)):
            moved = [theta.copy(), theta.copy()]
            moved[0][i] += step
            moved[1][i] -= step
            up, down = (np.log(result.problem.predict(m)) for m in moved)
            gradient.append((up - down) / (2.0 * step))
        d = np.array(gradient)
        expected = np.sqrt(np.einsum("in,ij,jn->n", d.imag, result.optimum.covariance, d.imag))
        np.testing.assert_allclose(band.phase_std, expected, rtol=1e-5)

    def test_another_quantity(self, result: FitResult) -> None:
        stiffness = result.predict(1.0, amplitude=GRID)
        receptance = result.predict(1.0, amplitude=GRID, quantity="receptance")
        np.testing.assert_allclose(receptance.response, 1.0 / stiffness.response, rtol=1e-12)
        np.testing.assert_allclose(receptance.log_gain_std, stiffness.log_gain_std, rtol=1e-9)

    def test_friction_of_a_plant(self) -> None:
        result = fit(plant_table(), Dahl() + Mass() + Damper() + Spring())
        f_max, sigma = (result.params[name].value for name in ("f_max", "sigma"))
        band = result.describing_function(GRID)
        np.testing.assert_allclose(band.response, Dahl(f_max, sigma).describing_function(GRID))
        assert band.log_gain_std[-1] == pytest.approx(
            np.sqrt(result.optimum.covariance[0, 0]), rel=0.1
        )

    def test_what_is_determined_has_a_band_where_parameters_have_none(self) -> None:
        result = fit(table(), Dahl(), sensors=Sensors(force_gain=None), throw=False)
        known = fit(table(), Dahl()).predict(1.0, amplitude=GRID)
        band = result.predict(1.0, amplitude=GRID)
        np.testing.assert_allclose(band.log_gain_std, known.log_gain_std, rtol=0.05)
        assert np.isinf(result.describing_function(GRID).log_gain_std).all()

    def test_refusals(self, result: FitResult) -> None:
        with pytest.raises(ValidationError, match="give either amplitude"):
            result.predict(1.0)
        with pytest.raises(ValidationError, match="give either amplitude"):
            result.predict(1.0, amplitude=GRID, drive=GRID)
        shapes = r"frequency_hz has shape \(3,\) and amplitude \(2,\); expected one shape"
        with pytest.raises(ValidationError, match=shapes):
            result.predict([1.0, 2.0, 3.0], amplitude=[1e-3, 1e-2])
        with pytest.raises(ModelError, match="no Dahl element"):
            fit(table(), Spring(), throw=False).describing_function(GRID)


class TestDerived:
    def test_x_c_by_its_formula(self, result: FitResult) -> None:
        (x_c,) = result.derived()
        f, s = result.params["f_max"].value, result.params["sigma"].value
        C = result.covar
        expected = f / s * np.sqrt(C[0, 0] / f**2 + C[1, 1] / s**2 - 2.0 * C[0, 1] / (f * s))
        assert (x_c.name, x_c.unit) == ("x_c", "m")
        assert x_c.value == pytest.approx(f / s)
        assert x_c.stderr == pytest.approx(expected, rel=1e-9)

    def test_energy_stiffness_and_damping_in_closed_form(self, result: FitResult) -> None:
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
        by_f, by_s = (
            (self.energy(f * a, s * b, A) - self.energy(f / a, s / b, A)) / 2e-6
            for a, b in ((1.0 + 1e-6, 1.0), (1.0, 1.0 + 1e-6))
        )
        slope = np.array([by_f, by_s])
        expected = np.sqrt(slope @ result.optimum.covariance @ slope)
        assert found["energy lost in a cycle"].stderr == pytest.approx(expected, rel=1e-5)

    @staticmethod
    def energy(f_max: float, sigma: float, A: float) -> float:
        beta = sigma * A / f_max
        return 4.0 * f_max * A * (1.0 - float(np.tanh(beta)) / beta)

    def test_names_of_elements_and_units_of_rotation(self) -> None:
        data = table(model=Dahl(F_MAX, 30.0) + Dahl(F_MAX, 3.0, name="other"))
        found = fit(data, Dahl(name="early") + Dahl(name="late")).derived([1e-3])
        assert [q.name for q in found[:2]] == ["early_x_c", "late_x_c"]
        assert str(found[2]).startswith("energy lost in a cycle at amplitude 0.001 = ")

    def test_no_x_c_where_it_is_infinite(self) -> None:
        results = (fit(table(beta=(1e-4, 1e-3), seed=s), Dahl(), throw=False) for s in range(10))
        (first, *_) = (r for r in results if not r.success)
        assert first.derived() == ()

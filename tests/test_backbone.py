"""Backbones: natural frequency and damping ratio against amplitude, from file to prediction."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom

import dahl_ident as di
from dahl_ident.errors import DataError, ModelError, ValidationError

F_MAX, SIGMA, STIFFNESS, DAMPING, MASS = 0.5, 4000.0, 9000.0, 0.8, 0.5
TRUTH = {"f_max": F_MAX, "sigma": SIGMA, "stiffness": STIFFNESS, "damping": DAMPING}
MODEL = di.Dahl() + di.Spring() + di.Damper() + di.Mass(MASS)
AMPLITUDES = np.geomspace(1e-5, 3e-3, 25)


def measured(seed=0, noise=1.0):
    """Return natural frequencies and damping ratios worked out from the friction alone."""
    N = di.Dahl(F_MAX, SIGMA).describing_function(AMPLITUDES)
    omega = np.sqrt((STIFFNESS + N.real) / MASS)
    ratio = (DAMPING * omega + N.imag) / (2.0 * MASS * omega**2)
    rng = np.random.default_rng(seed)
    f = omega / (2.0 * np.pi)
    return di.FrequencyResponse.backbone(
        AMPLITUDES,
        f * (1.0 + 2e-4 * noise * rng.standard_normal(f.size)),
        ratio * (1.0 + 0.02 * noise * rng.standard_normal(f.size)),
        frequency_std=2e-4 * f,
        damping_ratio_std=0.02 * ratio,
    )


def test_parameters_are_recovered_within_their_uncertainties():
    runs, inside = 20, dict.fromkeys(TRUTH, 0)
    for seed in range(runs):
        fit = di.fit(measured(seed), MODEL)
        for name, value in TRUTH.items():
            found = fit.params[name]
            inside[name] += abs(found.value - value) < 1.96 * found.stderr
    assert fit.trusted, fit.verdict
    assert min(inside.values()) >= binom.ppf(1e-4, runs, 0.95), inside


def test_prediction_is_the_backbone_again():
    data = measured(noise=0.0)
    fit = di.fit(data, MODEL)
    again = fit.backbone(AMPLITUDES)
    np.testing.assert_allclose(again.frequency_hz, data.frequency_hz, rtol=1e-6)
    np.testing.assert_allclose(again.response.imag, data.response.imag, rtol=1e-5)
    assert (again.covariance[:, 1, 1] < data.covariance[:, 1, 1]).all()
    top, bottom = again.plot()
    assert (top.get_ylabel(), bottom.get_ylabel()) == (
        "natural frequency [Hz]",
        "damping ratio [1]",
    )


def test_phase_resonance_of_an_integrated_motion():
    # at the predicted frequency and amplitude the fundamental of the force leads by 90 degrees
    A = 2e-4
    fit = di.fit(measured(noise=0.0), MODEL)
    row = fit.backbone(A)
    omega = float(row.omega[0])

    def friction(t, F):
        v = A * omega * np.cos(omega * t)
        return np.asarray(SIGMA * v * (1.0 - np.sign(v) * F / F_MAX))

    t = np.linspace(0.0, 2.0 * np.pi / omega, 4001) + 6.0 * np.pi / omega
    F = solve_ivp(
        friction, (0.0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=0.01 / omega
    ).y[0]
    F = F + A * ((STIFFNESS - MASS * omega**2) * np.sin(omega * t))
    F = F + A * DAMPING * omega * np.cos(omega * t)
    wave = F[:-1] * np.exp(-1j * omega * t[:-1])
    Z = 2j * wave.mean() / A
    assert abs(Z.real) < 1e-3 * Z.imag
    assert Z.imag == pytest.approx(2.0 * MASS * omega**2 * row.response.imag[0], rel=1e-3)


def test_read_from_a_file_and_stored(tmp_path):
    data = measured()
    place = tmp_path / "backbone.csv"
    data.to_frame().to_csv(place, index=False)
    read = di.read_frequency_response(place)
    assert read.quantity == "backbone"
    np.testing.assert_allclose(read.response, data.response)
    np.testing.assert_allclose(read.covariance, data.covariance)
    fit = di.fit(read, MODEL)
    again = di.FitResult.from_json(fit.to_json())
    assert again.params["f_max"].value == fit.params["f_max"].value
    assert "damping ratio" in str(read)


def test_a_saved_backbone_keeps_every_column(tmp_path):
    data = di.FrequencyResponse.backbone(
        [1e-4, 1e-3], [21.0, 20.0], [0.02, 0.03], frequency_std=0.01, damping_ratio_std=1e-3,
        drive=[0.1, 0.2], dof=7.0, amplitude_std=[1e-6, 1e-6], level=["a", "b"],
        quality={"settled": [True, False]},
    )  # fmt: skip
    read = di.read_frequency_response(data.save(tmp_path / "backbone.csv"))
    for name in ("response", "drive", "dof", "amplitude_std", "covariance"):
        np.testing.assert_allclose(getattr(read, name), getattr(data, name))
    assert read.levels == ["a", "b"]
    assert read.quality["settled"].tolist() == [True, False]


def test_what_cannot_be_done_is_refused():
    data = measured()
    with pytest.raises(ModelError, match="up to the mass"):
        di.fit(data, di.Dahl() + di.Spring() + di.Mass())
    with pytest.raises(ValidationError, match="only with the modal mass"):
        data.to("receptance")
    with pytest.raises(ValidationError, match="expected a backbone"):
        data.with_mass(1.0).with_mass(1.0)
    with pytest.raises(ValidationError, match="a backbone needs amplitudes"):
        di.FrequencyResponse([1.0], [0.1j], drive=[1.0], quantity="backbone")
    no_mass = di.fit(data.with_mass(MASS), di.Dahl() + di.Spring(), throw=False)
    free = di.fit(data.with_mass(MASS), MODEL)
    with pytest.raises(ModelError, match="no natural frequency"):
        no_mass.backbone(1e-3)
    assert free.params["sigma"].value == pytest.approx(di.fit(data, MODEL).params["sigma"].value)


def test_a_table_that_lacks_a_column_is_refused(tmp_path):
    place = tmp_path / "backbone.csv"
    place.write_text("frequency [Hz],amplitude [mm],damping_ratio\n20,1,0.02\n", "utf-8")
    with pytest.raises(DataError, match="frequency_std and damping_ratio_std"):
        di.read_frequency_response(place)

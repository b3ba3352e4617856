"""Masses and dampers that fits of tables find and no device has: said in the verdict."""

import numpy as np

import dahl_ident as di


def table(device, seed=0, noise=0.005):
    """Return the response of a device at twelve amplitudes and three frequencies, with noise."""
    rng = np.random.default_rng(seed)
    A, f = (v.ravel() for v in np.meshgrid(np.geomspace(1e-3, 2e-2, 12), [0.5, 1.0, 2.0]))
    Z = sum(
        e.stiffness([np.asarray(v) for v in e.known_values()], A, 2.0 * np.pi * f)
        for e in di.elements.Model(device).elements
    )
    scatter = 1.0 + noise * rng.standard_normal((A.size, 2)) @ [1.0, 1.0j]
    return di.FrequencyResponse(f, Z * scatter, A)


def test_a_negative_damper_is_said_with_what_to_do():
    device = di.Dahl(0.1, 30.0) + di.Damper(-0.1)
    fit = di.fit(table(device), di.Dahl() + di.Damper(), throw=False)
    assert not fit.trusted
    damping = fit.params["damping"]
    assert abs(damping.value + 0.1) < 3.0 * damping.stderr
    assert f"damping is negative ({damping.value:.4f}" in fit.verdict
    assert "leave the damper out" in fit.verdict
    sound = di.fit(table(di.Dahl(0.1, 30.0) + di.Damper(0.1), 1), di.Dahl() + di.Damper())
    assert sound.trusted
    assert "negative" not in sound.verdict


def test_a_mass_that_rests_on_less_than_the_misfit_is_not_determined():
    law = di.Dahl(0.05, 20.0, name="a") + di.Dahl(0.05, 6.0, name="b") + di.Mass(3e-3)
    fit = di.fit(table(law, noise=0.02), di.Dahl() + di.Mass(), throw=False)
    assert fit.status.value == "not described"  # two laws, and one was fitted
    assert "not mass" in fit.verdict
    assert "not determined, because of model error" in fit.verdict
    heavy = di.fit(table(law + di.Mass(3.0, name="b"), noise=0.02), di.Dahl() + di.Mass())
    assert "because of model error" not in heavy.verdict


def test_friction_in_one_direction_only_is_doubted():
    """By the law itself, of tables as of records."""
    found = di.fit(di.load_dataset("noisy"), di.Dahl(asymmetry=0.9999), throw=False)
    assert "asymmetry leaves almost no friction in one direction" in found.verdict

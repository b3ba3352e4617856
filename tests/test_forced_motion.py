"""Driven motion: its sensitivities, a moving base, the drive between its samples."""

import numpy as np
import pytest

from dahl_ident.elements import (
    Backlash,
    BoucWen,
    Dahl,
    Damper,
    Element,
    Iwan,
    Mass,
    MaxwellSlip,
    Model,
    Spring,
    plant_equations,
)
from dahl_ident.engine import band_limited
from dahl_ident.errors import FitError, ModelError
from tests import cold_records
from tests.motions import Driven, differences, slopes

RATE = 750.0
BOUC_WEN = BoucWen() + Mass() + Damper() + Spring()
BOUC_WEN_VALUES = np.array([5e4, -300.0, 1900.0, 2.0, 10.0, 5e4])
LINEAR = Mass(2.0) + Damper(10.0) + Spring(3e4)
STIFFNESSES, SLIPS = [2e4, 1e4], [2e-4, 5e-4]
F_MAX, SIGMA, GAP = 20.0, 4e4, 4e-4


def multisine(samples):
    """Return whole periods of a drive of 5 to 150 Hz, and the drive as a function of time."""
    return cold_records.multisine(samples, RATE, 5.0, 150.0, 50.0, seed=0)


def test_a_moving_base_is_a_force_of_minus_mass_times_acceleration():
    wave, first = multisine(192)[0], np.array([1e-4, 0.0, 0.0])
    base = Driven(BOUC_WEN, wave / 2.0, RATE, "base").motion(first, BOUC_WEN_VALUES)
    force = Driven(BOUC_WEN, -wave, RATE).motion(first, BOUC_WEN_VALUES)
    np.testing.assert_allclose(base.output, force.output, atol=1e-9 * np.abs(force.output).max())


def test_sensitivities_are_derivatives():
    driven = Driven(BOUC_WEN, multisine(512)[0], RATE)
    starts = np.array([1e-4, 0.01, 2.0])
    _, found = slopes(driven, starts, BOUC_WEN_VALUES)
    for i, expected in enumerate(differences(driven, starts, BOUC_WEN_VALUES, 1e-3)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 2e-6, i


def test_the_slope_of_a_delay_is_a_difference_of_later_drives():
    wave, drive = multisine(192)
    t, h, first = np.arange(wave.size) / RATE, 1e-6, np.array([1e-4, 0.01, 2.0])
    found = Driven(BOUC_WEN, wave, RATE).motion(first, BOUC_WEN_VALUES, derivatives=True)
    early, late = (
        Driven(BOUC_WEN, np.array([drive(at - d) for at in t]), RATE)
        .motion(first, BOUC_WEN_VALUES, finer=10.0)
        .output
        for d in (-h, h)
    )
    expected = (late - early) / (2.0 * h)
    assert np.abs(found.by_delay - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("law", "values", "start"),
    [
        (MaxwellSlip(2) + LINEAR, [*STIFFNESSES, *SLIPS], [0.3, -0.6]),
        (Backlash(Dahl()) + LINEAR, [F_MAX, SIGMA, GAP], [2.5e-4]),
    ],
)
def test_sensitivities_of_slips_and_gaps_are_derivatives(law, values, start):
    driven = Driven(law, multisine(64)[0], RATE)
    starts = np.array([1e-4, 0.01, *start])
    _, found = slopes(driven, starts, np.array(values))
    for i, expected in enumerate(differences(driven, starts, np.array(values), 1e-3)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 2e-6, i


def test_sliders_of_iwan_start_on_their_backbone():
    law, values = Iwan(), [F_MAX, SIGMA, -0.5, 1.0]
    stiffnesses, places = law.sliders(values)
    for x in (-3e-4, 1e-4, 4e-4, 9e-4):
        forces = [k * np.clip(x, -d, d) for k, d in zip(stiffnesses, places, strict=True)]
        assert law.initial_states(values, [x / places[-1]]) == pytest.approx(forces)


def test_springs_start_with_shares_of_the_forces_at_which_they_slip():
    law = MaxwellSlip(SLIPS, STIFFNESSES)
    values, loads = [*STIFFNESSES, *SLIPS], np.linspace(0.9, -0.7, len(SLIPS))
    expected = [k * d * load for k, d, load in zip(STIFFNESSES, SLIPS, loads, strict=True)]
    assert law.initial_states(values, loads.tolist()) == pytest.approx(expected)


@pytest.mark.parametrize("periodic", [True, False])
def test_drive_between_its_samples(periodic):
    t = np.arange(400 if periodic else 387) / 400.0

    def wave(at):
        slow = 0.0 if periodic else at * (1.0 - at)
        return np.asarray(np.sin(2.0 * np.pi * 5.0 * at) + slow)

    found = band_limited(wave(t), 1.0 / 400.0)
    place = np.array([0.0, 0.3, 0.9])
    values = np.einsum("pk,kn->np", place[:, None] ** np.arange(10), found)
    error = np.abs(values - wave(t[:-1, None] + place / 400.0))
    assert error[20:-20].max() < (1e-11 if periodic else 1e-4)
    assert error.max() < (1e-11 if periodic else 2e-2)


def test_refusals():
    with pytest.raises(ModelError, match="has no mass"):
        plant_equations(Model(Dahl()))

    class Unknown(Spring):
        kind = ""

        def mechanics(self, *args):
            Element.mechanics(self, *args)

    with pytest.raises(ModelError, match="no equation of motion"):
        plant_equations(Unknown() + Mass())
    wave, _ = multisine(256)
    model = Dahl() + Mass() + Damper()
    with pytest.raises(FitError, match="grows beyond all bounds"):
        Driven(model, wave, RATE).motion(np.zeros(3), [1.0, 1e3, 1.0, -1e6])

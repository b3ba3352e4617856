"""Driven motion against scipy's integrator with located events, and its sensitivities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import BoucWen, Dahl, Damper, Element, Mass, Model, Spring
from dahl_ident.elements.equations import plant_equations
from dahl_ident.engine import band_limited
from dahl_ident.errors import FitError, ModelError
from tests.motions import Driven, differences, slopes

RATE = 750.0
BOUC_WEN = BoucWen() + Mass() + Damper() + Spring()
BOUC_WEN_VALUES = np.array([5e4, -300.0, 1900.0, 2.0, 10.0, 5e4])


def multisine(samples: int, seed: int = 0) -> tuple[FloatArray, Callable[[float], float]]:
    """Return whole periods of a drive of 5 to 150 Hz, and the drive as a function of time."""
    rng = np.random.default_rng(seed)
    lines = np.arange(samples // 2)
    lines = lines[(lines * RATE / samples > 5.0) & (lines * RATE / samples < 150.0)]
    amplitudes = np.exp(2j * np.pi * rng.random(lines.size)) * 50.0 * np.sqrt(2.0 / lines.size)

    def drive(t: float) -> float:
        return float(np.real(amplitudes @ np.exp(2j * np.pi * lines * t * RATE / samples)))

    return np.array([drive(i / RATE) for i in range(samples)]), drive


def integrated(
    law: Callable[[float, float], float],
    drive: Callable[[float], float],
    linear: tuple[float, float, float],
    first: FloatArray,
    samples: int,
    inertial: bool,
) -> FloatArray:
    """Return the motion by DOP853, stopped wherever velocity or friction force are zero."""
    m, c, k = linear
    times = np.arange(samples) / RATE
    out, place, at, start = np.empty((samples, 3)), 0, first.copy(), 0.0
    direction = 1.0 if (at[1] or drive(0.0) * (-1.0 if inertial else 1.0)) > 0.0 else -1.0
    loading = direction * at[2] >= 0.0
    while place < samples:

        def rates(t: float, y: FloatArray, s: float = direction) -> list[float]:
            push = -m * drive(t) if inertial else drive(t)
            return [y[1], (push - c * y[1] - k * y[0] - y[2]) / m, law(s * y[2], s) * y[1]]

        def turns(_: float, y: FloatArray) -> float:
            return float(y[1])

        def unloads(_: float, y: FloatArray) -> float:
            return float(y[2])

        turns.terminal = unloads.terminal = True  # type: ignore[attr-defined]
        turns.direction, unloads.direction = -direction, direction  # type: ignore[attr-defined]
        solution = solve_ivp(
            rates,
            (start, times[-1] + 1e-9),
            at,
            method="DOP853",
            rtol=1e-11,
            atol=[1e-15, 1e-12, 1e-11],
            max_step=0.2 / RATE,
            events=[turns] if loading else [turns, unloads],
            dense_output=True,
        )
        start, at = float(solution.t[-1]), solution.y[:, -1].copy()
        here = times[place:][times[place:] <= start]
        if here.size and solution.sol is not None:
            out[place : place + here.size] = solution.sol(here).T
            place += here.size
        if solution.t_events is not None and solution.t_events[0].size:
            direction, at[1] = -direction, 0.0
            loading = direction * at[2] >= 0.0
        elif solution.status == 1:
            loading, at[2] = True, 0.0
    return out


@pytest.mark.parametrize("inertial", [False, True])
def test_bouc_wen_against_scipy(inertial: bool) -> None:
    samples = 192
    wave, drive = multisine(samples)
    if inertial:
        wave = wave / 2.0

    def drives(t: float) -> float:
        return drive(t) / (2.0 if inertial else 1.0)

    first = np.array([1e-4, 0.0, 0.0])
    driven = Driven(BOUC_WEN, wave, RATE, "base" if inertial else "force")
    found = driven.motion(first, BOUC_WEN_VALUES).states

    def law(ahead: float, _: float) -> float:
        return 5e4 - (-300.0 if ahead >= 0.0 else 1900.0) * ahead

    expected = integrated(law, drives, (2.0, 10.0, 5e4), first, samples, inertial)
    error = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)
    assert error.max() < 1e-8


def test_dahl_against_scipy() -> None:
    samples = 192
    wave, drive = multisine(samples, 1)
    model = Dahl(f_max=20.0, sigma=4e4) + Mass(0.5) + Damper(8.0) + Spring(2e4)
    first = np.array([0.0, 0.02, 3.0])
    found = Driven(model, wave, RATE).motion(first).states
    expected = integrated(
        lambda ahead, _: 4e4 * (1.0 - ahead / 20.0), drive, (0.5, 8.0, 2e4), first, samples, False
    )
    error = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)
    assert error.max() < 1e-8


def test_sensitivities_are_derivatives() -> None:
    driven = Driven(BOUC_WEN, multisine(512)[0], RATE)
    starts = np.array([1e-4, 0.01, 2.0])
    _, found = slopes(driven, starts, BOUC_WEN_VALUES)
    for i, expected in enumerate(differences(driven, starts, BOUC_WEN_VALUES, 1e-3)):
        error = np.abs(found[:, i] - expected).max() / np.abs(expected).max()
        assert error < 2e-6, i


@pytest.mark.parametrize("periodic", [True, False])
def test_drive_between_its_samples(periodic: bool) -> None:
    t = np.arange(400 if periodic else 387) / 400.0

    def wave(at: FloatArray) -> FloatArray:
        slow = 0.0 if periodic else at * (1.0 - at)
        return np.asarray(np.sin(2.0 * np.pi * 5.0 * at) + slow)

    found = band_limited(wave(t), 1.0 / 400.0)
    place = np.array([0.0, 0.3, 0.9])
    values = np.einsum("pk,kn->np", place[:, None] ** np.arange(10), found)
    error = np.abs(values - wave(t[:-1, None] + place / 400.0))
    assert error[20:-20].max() < (1e-11 if periodic else 1e-4)
    assert error.max() < (1e-11 if periodic else 2e-2)


def test_refusals() -> None:
    with pytest.raises(ModelError, match="has no mass"):
        plant_equations(Model(Dahl()))

    class Unknown(Spring):
        kind = ""

        def mechanics(self, *args: object) -> None:  # type: ignore[override]
            Element.mechanics(self, *args)  # type: ignore[arg-type]

    with pytest.raises(ModelError, match="no equation of motion"):
        plant_equations(Unknown() + Mass())
    wave, _ = multisine(256)
    model = Dahl() + Mass() + Damper()
    with pytest.raises(FitError, match="grows beyond all bounds"):
        Driven(model, wave, RATE).motion(np.zeros(3), [1.0, 1e3, 1.0, -1e6])

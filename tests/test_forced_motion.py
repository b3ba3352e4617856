"""Driven motion against scipy's integrator with located events, and its sensitivities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import BoucWen, Dahl, Damper, Element, Mass, Model, Spring
from dahl_ident.errors import FitError, ModelError
from dahl_ident.time_domain import ForcedMotion, Plant, band_limited

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
    plant = Plant(BOUC_WEN, "base" if inertial else "force")
    forced = ForcedMotion(plant, band_limited(wave, 1.0 / RATE, 8), 1.0 / RATE)
    found = forced.solve(BOUC_WEN_VALUES, first, np.zeros((samples, 3)))

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
    forced = ForcedMotion(Plant(Model(model), "force"), band_limited(wave, 1 / RATE, 16), 1 / RATE)
    found = forced.solve(np.array([]), first, np.zeros((samples, 3)))
    expected = integrated(
        lambda ahead, _: 4e4 * (1.0 - ahead / 20.0), drive, (0.5, 8.0, 2e4), first, samples, False
    )
    error = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)
    assert error.max() < 1e-8


def test_sensitivities_are_derivatives() -> None:
    wave, _ = multisine(512)
    forced = ForcedMotion(Plant(BOUC_WEN, "force"), band_limited(wave, 1 / RATE, 8), 1 / RATE)
    point = np.concatenate([[1e-4, 0.01, 2.0], BOUC_WEN_VALUES])
    motion = forced.solve(point[3:], point[:3], np.zeros((512, 3)))
    found = forced.sensitivities(point[3:], motion)
    for i in range(point.size):
        h = np.zeros(point.size)
        h[i] = 1e-5 * abs(point[i])
        up, down = (forced.solve((point + s * h)[3:], (point + s * h)[:3], motion) for s in (1, -1))
        expected = (up - down) / (2.0 * h[i])
        error = np.abs(found[:, :, i] - expected).max(axis=0) / np.abs(expected).max(axis=0)
        assert error.max() < 2e-6, point[i]


def test_a_long_record_from_no_guess_is_the_motion_of_its_parts() -> None:
    samples = 4096
    wave, _ = multisine(samples)
    forced = ForcedMotion(Plant(BOUC_WEN, "force"), band_limited(wave, 1 / RATE, 2), 1 / RATE)
    motion = forced.solve(BOUC_WEN_VALUES, np.zeros(3), np.zeros((samples, 3)))
    end = forced.flow(BOUC_WEN_VALUES, motion[:-1], derivatives=0).end
    assert np.abs(end - motion[1:]).max(axis=0) == pytest.approx(0.0, abs=1e-10)
    assert motion[:, 0].std() == pytest.approx(6.6e-4, rel=0.1)


@pytest.mark.parametrize("periodic", [True, False])
def test_drive_between_its_samples(periodic: bool) -> None:
    t = np.arange(400 if periodic else 387) / 400.0

    def wave(at: FloatArray) -> FloatArray:
        slow = 0.0 if periodic else at * (1.0 - at)
        return np.asarray(np.sin(2.0 * np.pi * 5.0 * at) + slow)

    found = band_limited(wave(t), 1.0 / 400.0, 2)
    place = np.array([0.0, 0.3, 0.9])
    values = np.einsum("pk,knr->nrp", place[:, None] ** np.arange(8), found)
    expected = wave(t[:-1, None, None] + (np.arange(2)[:, None] + place) / 800.0)
    error = np.abs(values - expected)
    assert error[40:-40].max() < (1e-12 if periodic else 1e-4)
    assert error.max() < (1e-12 if periodic else 2e-2)


def test_refusals() -> None:
    with pytest.raises(ModelError, match="has no mass"):
        Plant(Model(Dahl()), "force")

    class Unknown(Spring):
        kind = ""

        def mechanics(self, *args: object) -> None:  # type: ignore[override]
            Element.mechanics(self, *args)  # type: ignore[arg-type]

    with pytest.raises(ModelError, match="no equation of motion"):
        Plant(Unknown() + Mass(), "force")
    wave, _ = multisine(256)
    model = Dahl() + Mass() + Damper()
    forced = ForcedMotion(Plant(model, "force"), band_limited(wave, 1 / RATE, 2), 1 / RATE)
    with pytest.raises(FitError, match="grows beyond all bounds"):
        forced.solve(np.array([1.0, 1e3, 1.0, -1e6]), np.zeros(3), np.zeros((256, 3)))

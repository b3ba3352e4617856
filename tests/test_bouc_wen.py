"""Bouc-Wen of exponent 1 against direct integration with located events, and against Dahl."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from dahl_ident.arrays import FloatArray
from dahl_ident.elements import bouc_wen, linear_dahl

LAWS = [(3.0, 1.3, 0.5), (5e4, -300.0, 1900.0), (2.0, 0.7, 0.0), (1.0, 0.0, 2.0), (4.0, -0.5, -0.2)]


def integrated(z: float, span: float, s: float, law: tuple[float, float, float]) -> float:
    """Return z after a path, with the passage through zero located."""
    sigma, q, p = law
    start = 0.0

    def passes(_: float, y: FloatArray) -> float:
        return float(y[0])

    passes.terminal = True  # type: ignore[attr-defined]
    while start < span:
        loading = s * z >= 0.0
        rate = -q if loading else p
        solution = solve_ivp(
            lambda _, y, rate=rate: [s * (sigma + rate * abs(y[0]))],
            (start, span),
            [z],
            method="DOP853",
            rtol=1e-12,
            atol=1e-14 * sigma,
            events=None if loading else passes,
        )
        start = float(solution.t[-1])
        z = 0.0 if solution.status == 1 else float(solution.y[0, -1])
    return z


def stiffness(point: FloatArray, harmonic: int) -> list[complex]:
    """Return N_k/sigma and its derivatives at one amplitude, q and p."""
    A, q, p = (np.asarray(v) for v in point)
    return [complex(v) for v in bouc_wen.stiffness_over_sigma(A, q, p, harmonic)]


def history(x: FloatArray, point: FloatArray) -> FloatArray:
    """Return the force at an initial force, sigma, q and p."""
    start, sigma, q, p = point.tolist()
    return bouc_wen.force_history(x, sigma, q, p, start)


def tip_force(A: float, law: tuple[float, float, float]) -> float:
    """Return the force at the turning point of the steady loop, from the path to zero force."""
    sigma, q, p = law
    path = float(bouc_wen.zero_path(*(np.asarray(v) for v in (A, q, p))))
    return sigma * (np.expm1(p * path) / p if p else path)


def test_check_values() -> None:
    A, q, p = np.array([2.0]), np.array([1.3]), np.array([0.5])
    assert tip_force(2.0, (3.0, 1.3, 0.5)) == pytest.approx(2.2782955, abs=5e-8)
    first = 6.0 * bouc_wen.stiffness_over_sigma(A, q, p, 1)[0][0]
    third = 6.0 * bouc_wen.stiffness_over_sigma(A, q, p, 3)[0][0]
    assert first == pytest.approx(1.9961234 + 1.6865922j, abs=1e-7)
    assert third == pytest.approx(0.3071339 - 0.3003915j, abs=1e-7)


@pytest.mark.parametrize("beta", [1e-9, 1e-3, 0.3, 3.0, 300.0, 1e5])
@pytest.mark.parametrize("harmonic", [1, 3, 101])
def test_equal_rates_are_linear_dahl(beta: float, harmonic: int) -> None:
    one = np.asarray(1.0)
    found = bouc_wen.stiffness_over_sigma(np.asarray(beta), one, one, harmonic)[0]
    if harmonic == 1:
        expected = linear_dahl.describing_function(np.asarray(beta))
    else:
        expected = linear_dahl.harmonic(np.asarray(beta), harmonic) / beta
    assert abs(found - expected) <= 3e-12 * abs(expected) + (1e-15 if harmonic > 1 else 0.0)


@pytest.mark.parametrize("law", LAWS[:4])  # the last gains energy: its loop is unstable
@pytest.mark.parametrize("k", [1, 3])
def test_harmonics_against_the_integrated_loop(law: tuple[float, float, float], k: int) -> None:
    A = 1.5 / max(abs(law[1]), abs(law[2]))
    z = 0.0
    for _ in range(40):  # the loop closes by going round
        z = integrated(z, 2.0 * A, -1.0, law)
        z = integrated(z, 2.0 * A, 1.0, law)
    assert tip_force(A, law) == pytest.approx(z, rel=1e-9)
    at_zero = float(bouc_wen.zero_path(*(np.asarray(v) for v in (A, law[1], law[2]))))
    turn = 2.0 * np.arcsin(np.sqrt(at_zero / 2.0 / A))

    def force(theta: float) -> float:
        return integrated(z, A * (1.0 - np.cos(theta)), -1.0, law) if theta else z

    def part(wave: Callable[[float], float], start: float, stop: float) -> float:
        return float(quad(lambda t: force(t) * wave(k * t), start, stop, epsrel=1e-9)[0])

    halves = ((0.0, turn), (turn, np.pi))
    expected = sum(complex(part(np.cos, *ends), -part(np.sin, *ends)) for ends in halves)
    found = law[0] * A * stiffness(np.array([A, law[1], law[2]]), k)[0]
    assert abs(found - 2.0 / np.pi * expected) < 1e-8 * abs(expected)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("harmonic", [1, 3])
def test_stiffness_derivatives(law: tuple[float, float, float], harmonic: int) -> None:
    _, q, p = law
    point = np.array([1.5 / max(abs(q), abs(p)), q, p])
    found = stiffness(point, harmonic)[1:]
    for i in range(3):
        h = np.zeros(3)
        h[i] = 1e-5 * max(abs(point[i]), 0.1)
        slopes = [
            (stiffness(point + f * h, harmonic)[0] - stiffness(point - f * h, harmonic)[0])
            / (2.0 * f * h[i])
            for f in (1.0, 2.0)
        ]
        expected = (4.0 * slopes[0] - slopes[1]) / 3.0
        assert abs(found[i] - expected) < 1e-8 * max(abs(expected), abs(1.0 / point[0]) * (i == 0))


@pytest.mark.parametrize("law", LAWS)
def test_force_for_any_history(law: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    x = np.cumsum(rng.standard_normal(40)) / max(abs(law[1]), abs(law[2]))
    z = start = 0.3 * law[0] / max(abs(law[1]), abs(law[2]))
    expected = [z]
    for step in np.diff(x):
        z = integrated(z, abs(float(step)), float(np.sign(step)), law)
        expected.append(z)
    found = bouc_wen.force_history(x, *law, start)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())
    # how densely a stretch is sampled does not matter
    fine = np.interp(np.linspace(0, 39, 391), np.arange(40), x)
    np.testing.assert_allclose(
        bouc_wen.force_history(fine, *law, start)[::10],
        found,
        rtol=0.0,
        atol=1e-10 * np.abs(found).max(),
    )


@pytest.mark.parametrize("law", LAWS)
def test_force_derivatives(law: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.standard_normal(300)) * 0.3 / max(abs(law[1]), abs(law[2]))
    point = np.array([0.3 * law[0] / max(abs(law[1]), abs(law[2])), *law])
    force, by_start, by_law = bouc_wen.force_history_gradient(x, *law, point[0])
    np.testing.assert_array_equal(force, history(x, point))
    found = np.column_stack([by_start, by_law])
    for i in range(4):
        h = np.zeros(4)
        h[i] = 1e-6 * max(abs(point[i]), 0.1)
        expected = history(x, point + h) - history(x, point - h)
        expected /= 2.0 * h[i]
        np.testing.assert_allclose(
            found[:, i], expected, rtol=0.0, atol=1e-7 * np.abs(expected).max()
        )

"""Least squares: one cold fit, thousands of tables, bootstrap replicates, a plant.

Run with ``python -m benchmarks.fitting``. The peer minimises the same residuals, with the same
kernel, from a start within 20 % of the truth; ours starts from nothing. "The same" counts: every
comparison first checks that both find the same optimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import lmfit
import numpy as np
from scipy.optimize import brentq, least_squares

from benchmarks.harness import Row, median_of_pairs, print_table, seconds
from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Spring, fit, fit_many, response
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import Element, linear_dahl
from dahl_ident.elements.driven_motion import Steady
from dahl_ident.fitting import solve, solve_many
from dahl_ident.problem import ProblemBatch, TableProblem

TITLE = "Least squares"

_POINTS, _TABLES, _NOISE = 30, 10_000, 0.02
_TRUTH = np.array([0.1, 30.0])
_AMPLITUDE = np.geomspace(1e-4, 1e-1, _POINTS)
_PLANT_TRUTH = np.array([0.1, 30.0, 0.3, 0.24, 0.3])
SINE: Steady = "describing function"
_PLANT = Dahl() + Mass() + Damper() + Spring()
_LEVELS, _FREQUENCIES = 12, 60
_REPLICATES = 1000


def run() -> list[Row]:
    """Return every comparison."""
    return [_cold(), *_fleets(), _budgets(), _bootstrap(), *_plant(), _plant_bootstrap()]


def _noise(*shape: int) -> ComplexArray:
    rng = np.random.default_rng(1)
    return np.exp(_NOISE * (rng.normal(size=shape) + 1j * rng.normal(size=shape)))


def _lmfit_once(amplitude: FloatArray, response: ComplexArray) -> Callable[[], FloatArray]:
    """Return lmfit's minimize of ln(N/N_model) from a good start."""
    parameters = lmfit.Parameters()
    parameters.add("f_max", 1.2 * _TRUTH[0], min=0.0)
    parameters.add("sigma", 0.8 * _TRUTH[1], min=0.0)

    def residual(p: lmfit.Parameters) -> FloatArray:
        f_max, sigma = p["f_max"].value, p["sigma"].value
        N = sigma * linear_dahl.describing_function(sigma * amplitude / f_max)
        return np.asarray(np.log(response / N).view(np.float64))

    def work() -> FloatArray:
        found = lmfit.minimize(residual, parameters)
        return np.array([found.params["f_max"].value, found.params["sigma"].value])

    return work


def _repeated(work: Callable[[], object], times: int) -> Callable[[], None]:
    def repeat() -> None:
        for _ in range(times):
            work()

    return repeat


def _solving(tables: list[FrequencyResponse]) -> Callable[[], object]:
    return lambda: solve_many(ProblemBatch(tables, Dahl()))


def _calling(works: list[Callable[[], FloatArray]]) -> Callable[[], object]:
    return lambda: [work() for work in works]


def _cold() -> Row:
    N = Dahl(*_TRUTH).describing_function(_AMPLITUDE) * _noise(_POINTS)
    data = FrequencyResponse(np.ones(_POINTS), N, _AMPLITUDE)
    peer = _lmfit_once(_AMPLITUDE, N)
    np.testing.assert_allclose(solve(TableProblem(data, Dahl())).values, peer(), rtol=1e-6)
    times = 100
    ours, theirs = median_of_pairs(
        _repeated(lambda: fit(data, Dahl()), times), _repeated(peer, times)
    )
    return Row("one cold fit of 30 points", ours / times, theirs / times, "lmfit.minimize", 1.0)


def _fleets() -> list[Row]:
    shared = np.broadcast_to(_AMPLITUDE, (_TABLES, _POINTS))
    scatter = np.random.default_rng(2).normal(size=(_TABLES, _POINTS))
    rows = []
    for label, amplitude, target in (
        ("shared amplitudes", shared, 30.0),
        ("own amplitudes", _AMPLITUDE * np.exp(0.3 * scatter), 20.0),
    ):
        N = Dahl(*_TRUTH).describing_function(amplitude) * _noise(_TABLES, _POINTS)
        frequency = np.ones(_POINTS)
        tables = [FrequencyResponse(frequency, n, A) for n, A in zip(N, amplitude, strict=True)]
        found = solve_many(ProblemBatch(tables, Dahl()))
        assert found.success.all()
        np.testing.assert_allclose(found.values[7], _lmfit_once(amplitude[7], N[7])(), rtol=1e-6)
        times = 100
        peers = [_lmfit_once(A, n) for A, n in zip(amplitude[:times], N[:times], strict=True)]
        ours, theirs = median_of_pairs(_solving(tables), _calling(peers), repeats=5)
        work = f"{_TABLES:,} tables of 30 points, {label}"
        rows.append(
            Row(work, ours, theirs * _TABLES / times, "lmfit.minimize", target, faster=True)
        )
    return rows


def _budgets() -> Row:
    """Return the time of combined uncertainties; wanted are 200 tables a second."""
    A = _AMPLITUDE[::2]
    N = Dahl(*_TRUTH).describing_function(A)
    noisy = N * _noise(100, len(A))
    tables = [FrequencyResponse(np.ones(len(A)), n, A) for n in noisy]
    best = min(seconds(lambda: fit_many(tables, Dahl()).stderr) for _ in range(3))
    return Row("100 tables of 15 points with all sources of error", best, 0.5, "half a second", 1.0)


def _bootstrap() -> Row:
    N = Dahl(*_TRUTH).describing_function(_AMPLITUDE)
    problem = TableProblem(
        FrequencyResponse(np.ones(_POINTS), N * _noise(_POINTS), _AMPLITUDE), Dahl()
    )
    start = problem.to_search(_TRUTH)

    def ours() -> object:
        responses = problem.predict(start) * _noise(_TABLES, _POINTS)
        return solve_many(ProblemBatch.replicates(problem, responses), start=start)

    ours()
    best = min(seconds(ours) for _ in range(5))
    return Row(f"{_TABLES:,} bootstrap replicates of 30 points", best, 0.5, "half a second", 1.0)


def _plant_of(values: FloatArray) -> Element:
    f_max, sigma, mass, damping, stiffness = values
    return Dahl(f_max, sigma) + Mass(mass) + Damper(damping) + Spring(stiffness)


def _plant_data(levels: int, frequencies: int) -> FrequencyResponse:
    """Return noisy receptances of the plant of Eqn. 53."""
    drive = np.repeat(np.geomspace(1e-3, 1.0, levels), frequencies)
    frequency = np.tile(np.geomspace(0.1, 10.0, frequencies), levels)
    exact = response(_plant_of(_PLANT_TRUTH), frequency, drive).receptance
    return FrequencyResponse(
        frequency,
        exact * _noise(drive.size),
        drive=drive,
        controlled="force",
        quantity="receptance",
    )


def _plant() -> list[Row]:
    data = _plant_data(_LEVELS, _FREQUENCIES)
    frequency, measured, drive = data.frequency_hz, data.response, data.drive
    assert drive is not None
    omega = 2.0 * np.pi * frequency

    def by_response(values: FloatArray) -> FloatArray:
        predicted = response(_plant_of(values), frequency, drive, steady=SINE).receptance
        return np.asarray(np.log(measured / predicted).view(np.float64))

    def by_brentq(values: FloatArray) -> FloatArray:
        f_max, sigma, mass, damping, stiffness = values
        linear = stiffness - mass * omega**2 + 1j * damping * omega

        def root(L: complex, u: float) -> complex:
            def Z(A: float) -> complex:
                beta = np.asarray(sigma * A / f_max)
                return L + complex(sigma * linear_dahl.describing_function(beta))

            return 1.0 / Z(brentq(lambda A: A * abs(Z(A)) - u, 1e-9, 1e3, rtol=1e-12))

        predicted = [root(complex(L), float(u)) for L, u in zip(linear, drive, strict=True)]
        return np.asarray(np.log(measured / np.array(predicted)).view(np.float64))

    start = _PLANT_TRUTH * np.array([1.2, 0.8, 1.2, 0.8, 1.2])

    def peer(residual: Callable[[FloatArray], FloatArray]) -> FloatArray:
        return np.asarray(least_squares(residual, start, x_scale=start).x)

    def ours() -> FloatArray:
        return solve(TableProblem(data, _PLANT, steady=SINE)).values

    np.testing.assert_allclose(ours(), peer(by_response), rtol=1e-5)
    mine, theirs = median_of_pairs(ours, lambda: peer(by_response))
    slow = seconds(lambda: peer(by_brentq))
    work = f"plant, {_LEVELS} levels x {_FREQUENCIES} frequencies, describing function"
    return [
        Row(work, mine, theirs, "least_squares over response()", 4.0, faster=True),
        Row(work, mine, slow, "least_squares over brentq a point", 50.0, faster=True),
    ]


def _plant_bootstrap() -> Row:
    data = _plant_data(5, 12)
    problem = TableProblem(data, _PLANT)
    start = problem.to_search(_PLANT_TRUTH)
    responses = problem.draw(start, _NOISE, _REPLICATES, np.random.default_rng(3))
    few = [replace(data, response=drawn) for drawn in responses[:20]]

    def ours() -> FloatArray:
        return np.asarray(
            solve_many(ProblemBatch.replicates(problem, responses), start=start).values
        )

    def peer() -> FloatArray:
        return np.array([fit(table, _PLANT).optimum.values for table in few])

    np.testing.assert_allclose(ours()[: len(few)], peer(), rtol=1e-5)
    mine, theirs = median_of_pairs(ours, peer, repeats=5)
    work = f"{_REPLICATES:,} bootstrap replicates of a plant, 5 levels x 12 frequencies"
    return Row(work, mine, theirs * _REPLICATES / len(few), "a loop over fit", 10.0, faster=True)


if __name__ == "__main__":
    print_table(TITLE, run())

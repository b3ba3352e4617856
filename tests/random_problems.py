"""Random estimation problems over 12 decades of units, and a dense scan as their oracle."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dahl_ident import Dahl, FrequencyResponse, Model, Spring
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import Element
from dahl_ident.fitting.levenberg_marquardt import minimise
from dahl_ident.problem import TableProblem


class Case(NamedTuple):
    """One problem, and its least cost by a dense scan over x_c, or by searches from many starts."""

    problem: TableProblem
    least_cost: float
    at_edge: bool
    """Whether the scan's least cost lies at the end of its range."""


def friction_alone(seed: int, count: int) -> Iterator[Case]:
    """Yield problems of one Dahl element, noise of 1e-4 to 0.2, beta over up to 7 decades."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        f_max, sigma = 10.0 ** rng.uniform(-6.0, 6.0, 2)
        n = int(rng.integers(5, 40))
        start, decades = 10.0 ** rng.uniform(-2.0, 2.0), rng.uniform(0.3, 3.0)
        A = start * 10.0 ** np.sort(rng.uniform(0.0, decades, n)) * f_max / sigma
        level, N = 10.0 ** rng.uniform(-4.0, -0.7), Dahl(f_max, sigma).describing_function(A)
        error = level * (rng.normal(size=n) + 1j * rng.normal(size=n))
        relative = bool(rng.random() < 0.5)
        measured = N * np.exp(error) if relative else N + error * np.abs(N).mean()
        data = FrequencyResponse(np.ones(n), measured, A)
        problem = TableProblem(data, Dahl(), noise="relative" if relative else "absolute")
        ln_x_c = np.linspace(np.log(A.min()) - 15.0, np.log(A.max()) + 12.0, 500)
        h = Dahl(1.0, 1.0).describing_function(A / np.exp(ln_x_c)[:, None])
        cost, ln_sigma = _log_scan(measured, h) if relative else _linear_scan(measured, h, [])
        yield _case(problem, cost, ln_x_c, ln_sigma)


def friction_and_spring(seed: int, count: int) -> Iterator[Case]:
    """Yield problems of a Dahl element and a free spring, from microslip to gross slip."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        f_max, sigma = 10.0 ** rng.uniform(-6.0, 6.0, 2)
        n = int(rng.integers(6, 40))
        start, decades = 10.0 ** rng.uniform(-4.0, 3.0), rng.uniform(0.3, 3.0)
        A = start * 10.0 ** np.sort(rng.uniform(0.0, decades, n)) * f_max / sigma
        spring = sigma * 10.0 ** rng.uniform(-2.0, 1.0)
        Z = Dahl(f_max, sigma).describing_function(A) + spring
        level = 10.0 ** rng.uniform(-4.0, -1.0) * np.abs(Z).mean()
        measured = Z + level * (rng.normal(size=n) + 1j * rng.normal(size=n))
        data = FrequencyResponse(np.ones(n), measured, A)
        problem = TableProblem(data, _with_spring(), noise="absolute")
        ln_x_c = np.linspace(np.log(A.min()) - 37.0, np.log(A.max()) + 11.0, 1500)
        h = Dahl(1.0, 1.0).describing_function(A / np.exp(ln_x_c)[:, None])
        cost, _ = _linear_scan(measured, h, [np.ones(n, dtype=np.complex128)])
        alone = _spring_alone(measured)
        least = min(float(cost.min()), alone)
        edge = int(cost.argmin()) in (*range(5), *range(1495, 1500)) or alone <= cost.min()
        yield Case(problem, least, edge)


def exponent_free(seed: int, count: int) -> Iterator[Case]:
    """Yield problems of one Dahl element of unknown exponent, seen from stick to slip."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        f_max, sigma = 10.0 ** rng.uniform(-6.0, 6.0, 2)
        A = _around_the_knee(rng) * f_max / sigma
        truth = Dahl(f_max, sigma, float(np.exp(rng.uniform(-1.0, 1.0))))
        problem, x_c, stiffness = _observed(truth, Dahl(alpha=None), A, rng)
        starts = [(x * stiffness, stiffness, a) for x in x_c for a in (0.3, 0.6, 1.0, 2.0, 3.5)]
        yield _searched(problem, np.log(starts))


def two_elements(seed: int, count: int) -> Iterator[Case]:
    """Yield problems of two Dahl elements, whose knees are half a decade or more apart."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        f_max, sigma = 10.0 ** rng.uniform(-6.0, 6.0, 2)
        A = _around_the_knee(rng) * f_max / sigma
        wider, stiffer = 10.0 ** rng.uniform(0.5, 1.5), 10.0 ** rng.uniform(-0.5, 0.5)
        truth = Dahl(f_max, sigma, name="a") + Dahl(f_max * wider, sigma * stiffer, name="b")
        problem, x_c, stiffness = _observed(truth, Dahl(name="a") + Dahl(name="b"), A, rng)
        starts = [
            (x * share * stiffness, share * stiffness, y * rest * stiffness, rest * stiffness)
            for x in x_c
            for y in x_c[x_c > x]
            for share, rest in ((0.3, 0.7), (0.7, 0.3))
        ]
        yield _searched(problem, np.log(starts))


def _around_the_knee(rng: np.random.Generator) -> FloatArray:
    """Return 10 to 30 amplitudes over one to two and a half decades of beta about 1."""
    decades = np.sort(rng.uniform(0.0, rng.uniform(1.0, 2.5), int(rng.integers(10, 30))))
    return np.asarray(10.0 ** (rng.uniform(-1.0, 0.3) + decades))


def _observed(
    truth: Element, model: Element, A: FloatArray, rng: np.random.Generator
) -> tuple[TableProblem, FloatArray, float]:
    """Return a problem with noise of 1e-4 to 0.03, nine x_c to start from, and the stiffness."""
    Z = truth.dynamic_stiffness(A)
    level = 10.0 ** rng.uniform(-4.0, -1.5)
    measured = Z * np.exp(level * (rng.normal(size=A.size) + 1j * rng.normal(size=A.size)))
    problem = TableProblem(FrequencyResponse(np.ones(A.size), measured, A), model)
    return problem, np.geomspace(0.03 * A.min(), 30.0 * A.max(), 9), float(np.abs(Z).max())


def _searched(problem: TableProblem, starts: FloatArray) -> Case:
    """Return the least cost of searches from every start."""
    found = minimise(
        lambda at, _: problem.quadratic(at),
        starts,
        np.ones(len(problem.names), dtype=np.bool_),
        problem.n_residuals,
        steps=150,
    )
    return Case(problem, float(np.nanmin(found.cost)), at_edge=False)


def _with_spring() -> Model:
    return Model(Dahl() + Spring())


def _case(
    problem: TableProblem, cost: FloatArray, ln_x_c: FloatArray, ln_sigma: FloatArray
) -> Case:
    """Polish the scan's least node; what it leads to does not depend on any other start."""
    node = int(cost.argmin())
    theta = np.array([[ln_x_c[node] + ln_sigma[node], ln_sigma[node]]])
    logarithmic = np.ones(2, dtype=np.bool_)
    polished = minimise(
        lambda at, _: problem.quadratic(at), theta, logarithmic, problem.n_residuals
    )
    least = min(float(polished.cost[0]), float(cost[node]))
    return Case(problem, least, node in (0, len(cost) - 1))


def _log_scan(measured: ComplexArray, h: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return the least cost in (ln gain, phase) at each x_c, and ln sigma there."""
    rest = np.log(measured / h)
    ln_sigma = rest.real.mean(axis=1)
    rest -= ln_sigma[:, None]
    return 0.5 * np.sum(np.abs(rest) ** 2, axis=1), ln_sigma


def _linear_scan(
    measured: ComplexArray, h: ComplexArray, others: list[ComplexArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the least cost in (Re, Im) at each x_c by QR, and ln sigma there."""
    columns = np.stack([h, *(np.broadcast_to(c, h.shape) for c in others)], axis=-1)
    real = np.concatenate([columns.real, columns.imag], axis=1)
    size = np.linalg.norm(real, axis=1, keepdims=True)
    Q, R = np.linalg.qr(real / size)
    target = np.concatenate([measured.real, measured.imag])
    along = Q.swapaxes(1, 2) @ target
    sigma = np.linalg.solve(R, along[..., None])[:, 0, 0] / size[:, 0, 0]
    cost = 0.5 * np.sum((target - (Q @ along[..., None])[..., 0]) ** 2, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sigma > 0.0, cost, np.inf), np.log(sigma)


def _spring_alone(measured: ComplexArray) -> float:
    return float(0.5 * np.sum(np.abs(measured - measured.real.mean()) ** 2))

"""Random estimation problems over 12 decades of units, and a dense scan as their oracle."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dahl_ident import Dahl, FrequencyResponse, Problem, Spring
from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.elements import Model
from dahl_ident.elements.model import as_model
from dahl_ident.fitting.levenberg_marquardt import minimise


class Case(NamedTuple):
    """One problem, and its least cost by a dense scan over x_c."""

    problem: Problem
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
        problem = Problem(data, Dahl(), noise="relative" if relative else "absolute")
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
        problem = Problem(data, _with_spring(), noise="absolute")
        ln_x_c = np.linspace(np.log(A.min()) - 37.0, np.log(A.max()) + 11.0, 1500)
        h = Dahl(1.0, 1.0).describing_function(A / np.exp(ln_x_c)[:, None])
        cost, _ = _linear_scan(measured, h, [np.ones(n, dtype=np.complex128)])
        alone = _spring_alone(measured)
        least = min(float(cost.min()), alone)
        edge = int(cost.argmin()) in (*range(5), *range(1495, 1500)) or alone <= cost.min()
        yield Case(problem, least, edge)


def _with_spring() -> Model:
    return as_model(Dahl() + Spring())


def _case(problem: Problem, cost: FloatArray, ln_x_c: FloatArray, ln_sigma: FloatArray) -> Case:
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

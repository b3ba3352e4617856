"""Do the intervals cover, and are the verdicts right? Six scenarios, thousands of data sets.

``python -m benchmarks.coverage`` draws data sets from known parameters, fits each, and counts how
often its intervals hold the truth. A parameter counts as identified where the Cramer-Rao bound of
its logarithm is below 0.25 (see :mod:`dahl_ident.diagnostics.verdicts`).

The bound is local. Where the exact data, without noise, leave another explanation within reach of
the noise, some data sets cannot rule it out and their verdict rightly differs from the bound's. A
bound below 0.25 is therefore **clear** where the profile of the exact data is closed even at
4.3 standard deviations: then the 95.45 % interval is closed in 99 % of the data sets. Coverage is
judged at every identified parameter, RMSE and verdict at the clear ones. ``--small`` is the
version that the tests run.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dahl_ident import Dahl, Damper, FrequencyResponse, Mass, Model, Spring, response
from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.confidence_levels import LEVELS
from dahl_ident.diagnostics.intervals import (
    bootstrap_intervals,
    natural_sizes,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.profile import Profiler
from dahl_ident.diagnostics.verdicts import (
    IDENTIFIED_BELOW,
    NOT_IDENTIFIED_ABOVE,
    Verdict,
    judged,
)
from dahl_ident.fitting import Optimum, Status, solve
from dahl_ident.problem import TableProblem

F_MAX, SIGMA = 0.1, 30.0
X_C = F_MAX / SIGMA
SEED = 2006
DATA_SETS, BOOTSTRAPPED, REPLICATES = 2000, 200, 999
DRIVEN = (600, 12)  # data sets and bootstrapped ones of a plant, whose fits take a second each
SMALL = (32, 8, 199)
METHODS = ("wald", "profile", "bootstrap")
VERDICTS_RIGHT = 0.99
FALSE_ALARM = 0.05  # of the whole table
CLEAR = 2.0 + 2.33  # standard deviations: two, and what 99 of 100 data sets stay within
DESTINATION = Path("docs/validation/coverage.md")


@dataclass(frozen=True)
class Scenario:
    """A mechanism and an experiment on it."""

    name: str
    problem: TableProblem
    truth: FloatArray
    noise: float
    most: tuple[int, int] = (DATA_SETS, BOOTSTRAPPED)

    @property
    def theta(self) -> FloatArray:
        """The truth in search coordinates."""
        return self.problem.to_search(self.truth)


def scenarios() -> list[Scenario]:
    """Return the six scenarios of the validation."""
    dahl, hidden = (F_MAX, SIGMA), (F_MAX, SIGMA, SIGMA)
    return [
        _friction("well-spread amplitudes", 0.1, 10.0, 30, 0.01, dahl),
        _friction("microslip", 1e-4, 1e-3, 30, 0.01, dahl),
        _friction("free spring in gross slip", 100.0, 1000.0, 30, 0.01, hidden),
        _friction("eight points, unknown noise", 0.1, 10.0, 8, 0.01, dahl),
        _friction("10 % noise", 0.1, 10.0, 30, 0.1, dahl),
        _plant("plant of Eqn. 53", 0.01),
    ]


def _friction(
    name: str, low: float, high: float, n: int, noise: float, truth: Sequence[float]
) -> Scenario:
    A = np.geomspace(low, high, n) * X_C
    model = Dahl() + Spring() if len(truth) == 3 else Model(Dahl())
    placeholder = FrequencyResponse(np.ones(n), np.ones(n), A)
    problem = TableProblem(placeholder, model, noise="relative")
    exact = problem.predict(problem.to_search(truth))
    data = FrequencyResponse(np.ones(n), exact, A)
    return Scenario(name, TableProblem(data, model, noise="relative"), np.array(truth), noise)


def _plant(name: str, noise: float) -> Scenario:
    truth = (F_MAX, SIGMA, 0.3, 0.24, 0.3)
    f_max, sigma, mass, damping, stiffness = truth
    exact = Dahl(f_max, sigma) + Mass(mass) + Damper(damping) + Spring(stiffness)
    frequency = np.tile(np.geomspace(0.1, 3.0, 12), 5)
    drive = np.repeat(np.geomspace(0.02, 2.0, 5), 12)
    data = FrequencyResponse(
        frequency,
        response(exact, frequency, drive).receptance,
        drive=drive,
        controlled="force",
        quantity="receptance",
    )
    model = Dahl() + Mass() + Damper() + Spring()
    problem = TableProblem(data, model, noise="relative")
    return Scenario(name, problem, np.array(truth), noise, DRIVEN)


@dataclass
class Tally:
    """What a number of data sets of one scenario gave."""

    count: int = 0
    bootstrapped: int = 0
    covered: dict[str, FloatArray] = field(default_factory=dict)
    """Data sets whose interval holds the truth, by method: (2 levels, P)."""
    squares: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Sum of squared errors, in natural sizes, (P,)."""
    verdicts: list[list[Verdict]] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Count another tally in."""
        self.count += other.count
        self.bootstrapped += other.bootstrapped
        for method, covered in other.covered.items():
            self.covered[method] = self.covered.get(method, 0.0) + covered
        self.squares = self.squares + other.squares if self.squares.size else other.squares
        self.verdicts += other.verdicts


def tally(
    scenario: Scenario, seed: int, first: int, count: int, bootstrapped: int, replicates: int
) -> Tally:
    """Fit `count` data sets; the first `bootstrapped` of them are bootstrapped as well.

    Each data set has its own stream of random numbers, given by `seed` and its index.
    """
    P = len(scenario.truth)
    result = Tally(covered={m: np.zeros((2, P)) for m in METHODS}, squares=np.zeros(P))
    problem, theta = scenario.problem, scenario.theta
    for index in range(first, first + count):
        rng = np.random.default_rng([SEED, seed, index])
        drawn = problem.draw(theta, scenario.noise, 1, rng)
        data = replace(problem.data, response=drawn[0])
        optimum = solve(TableProblem(data, problem.model, noise=problem.noise))
        _count(result, scenario, optimum, index - first < bootstrapped, replicates, index)
    return result


def _count(
    result: Tally, scenario: Scenario, optimum: Optimum, bootstrap: bool, replicates: int, seed: int
) -> None:
    profile = profile_intervals(Profiler(optimum))
    kinds = {"wald": wald_intervals(optimum), "profile": profile}
    if bootstrap:
        kinds["bootstrap"] = bootstrap_intervals(optimum, LEVELS[:2], replicates, seed)
        result.bootstrapped += 1
    for method, found in kinds.items():
        inside = (found.lower[:2] <= scenario.truth) & (scenario.truth <= found.upper[:2])
        result.covered[method] += inside
    size = natural_sizes(_at_truth(scenario))
    result.squares += np.minimum(((optimum.theta - scenario.theta) / size) ** 2, 1e6)
    verdicts = judged(optimum, lambda: profile, None, profile, {}).parameters
    result.verdicts.append([verdicts[name].verdict for name in optimum.names])
    result.count += 1


def _at_truth(scenario: Scenario) -> Optimum:
    """Return an optimum that sits at the truth, for what depends on its place alone."""
    problem = scenario.problem
    information = problem.information(scenario.theta, scenario.noise)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Optimum(
        source=problem, theta=scenario.theta, values=scenario.truth, covariance=covariance,
        scale=scenario.noise, scale_known=False, dof=problem.n_residuals - len(scenario.truth),
        cost=0.0, nfev=0, status=Status.CONVERGED, message="", method="",
    )  # fmt: skip


def cramer_rao(scenario: Scenario) -> FloatArray:
    """Return the least standard deviation of each parameter, in natural sizes."""
    at = _at_truth(scenario)
    return np.asarray(np.sqrt(np.diagonal(at.covariance)) / natural_sizes(at))


def closed_by_exact_data(scenario: Scenario) -> NDArray[np.bool_]:
    """Return which parameters the exact data enclose at so many standard deviations."""
    at = _at_truth(scenario)
    lower, upper = Profiler(at).limits(np.array([CLEAR]))
    return np.asarray(np.isfinite(lower[0]) & np.isfinite(upper[0]))


@dataclass(frozen=True)
class Row:
    """What came out for one parameter of one scenario."""

    scenario: str
    name: str
    data_sets: int
    bootstrapped: int
    bound: float
    clear: bool
    rmse: float
    rmse_limit: float
    coverage: dict[str, FloatArray]
    tolerance: dict[str, FloatArray]
    verdict_right: float | None

    @property
    def identified(self) -> bool:
        """Whether the truth lies where intervals have to cover."""
        return self.bound < IDENTIFIED_BELOW

    @property
    def failures(self) -> list[str]:
        """What does not hold."""
        found = []
        if self.clear and self.verdict_right is not None and self.verdict_right < VERDICTS_RIGHT:
            found.append(f"verdict right in {self.verdict_right:.4f}")
        if not self.identified:
            return found
        if self.clear and self.rmse > self.rmse_limit:
            found.append(f"RMSE {self.rmse / self.bound:.3f} bounds")
        for method in METHODS[1:]:
            off = np.abs(self.coverage[method] - LEVELS[:2])
            if (off > self.tolerance[method]).any():
                found.append(f"{method} covers {self.coverage[method].round(4).tolist()}")
        return found


def rows(scenario: Scenario, result: Tally, cells: int) -> Iterator[Row]:
    """Return a row a parameter; `cells` is the number of coverages judged in the whole table."""
    nominal, quantile = np.array(LEVELS[:2]), special.ndtri(1.0 - FALSE_ALARM / (2.0 * cells))
    bounds, closed = cramer_rao(scenario), closed_by_exact_data(scenario)
    for i, name in enumerate(scenario.problem.names):
        sizes = (result.count, result.count, result.bootstrapped)
        counts = dict(zip(METHODS, np.array(sizes, dtype=np.float64), strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            coverage = {m: result.covered[m][:, i] / counts[m] for m in METHODS}
            tolerance = {
                m: quantile * np.sqrt(nominal * (1.0 - nominal) / counts[m]) + 0.5 / counts[m]
                for m in METHODS
            }
        clear = {True: Verdict.IDENTIFIED, False: Verdict.NOT_IDENTIFIED}
        right = None
        if bounds[i] < IDENTIFIED_BELOW or bounds[i] > NOT_IDENTIFIED_ABOVE:
            wanted = clear[bool(bounds[i] < IDENTIFIED_BELOW)]
            right = float(np.mean([verdicts[i] is wanted for verdicts in result.verdicts]))
        yield Row(
            scenario.name,
            name,
            result.count,
            result.bootstrapped,
            float(bounds[i]),
            bool(bounds[i] > NOT_IDENTIFIED_ABOVE or (bounds[i] < IDENTIFIED_BELOW and closed[i])),
            float(np.sqrt(result.squares[i] / result.count)),
            float((1.03 + 3.0 / np.sqrt(2.0 * result.count)) * bounds[i]),
            coverage,
            tolerance,
            right,
        )


def run(
    count: int = DATA_SETS,
    bootstrapped: int = BOOTSTRAPPED,
    replicates: int = REPLICATES,
    chosen: Sequence[int] = (),
    processes: int | None = None,
) -> list[Row]:
    """Return the whole table, or that of the chosen scenarios."""
    everything = scenarios()
    cells = 4 * sum(int((cramer_rao(s) < IDENTIFIED_BELOW).sum()) for s in everything)
    table: list[Row] = []
    workers = processes or os.cpu_count() or 1
    for index in chosen or range(len(everything)):
        scenario = everything[index]
        sets, resampled = np.minimum((count, bootstrapped), scenario.most)
        edges = np.linspace(0, sets, 4 * workers + 1).astype(int)
        shares = np.diff(np.linspace(0, resampled, 4 * workers + 1).astype(int))
        jobs = [
            (index, int(a), int(b - a), int(share), replicates)
            for a, b, share in zip(edges[:-1], edges[1:], shares, strict=True)
        ]
        total = Tally()
        if workers == 1:
            parts = [_job(job) for job in jobs]
        else:
            with ProcessPoolExecutor(workers) as pool:
                parts = list(pool.map(_job, jobs))
        for part in parts:
            total.add(part)
        table += rows(scenario, total, cells)
    return table


def _job(job: tuple[int, int, int, int, int]) -> Tally:
    index, first, count, bootstrapped, replicates = job
    return tally(scenarios()[index], index, first, count, bootstrapped, replicates)


def as_markdown(table: Sequence[Row]) -> str:
    """Return the table as a page."""
    lines = [
        "# Coverage of the intervals, and verdicts",
        "",
        "Made by `python -m benchmarks.coverage`. Each scenario is simulated many times, and each "
        "data set is fitted; a part of the data sets is also bootstrapped. `bound` is the "
        "Cramer-Rao bound of the parameter's logarithm. Intervals are judged where it is below "
        "0.25, verdicts where it is below 0.25 or above 1; other cells are empty. Wald, profile "
        "and bootstrap: coverage in percent of 68.27 and 95.45 % intervals; values outside the "
        'binomial error (corrected for the number of coverages) are marked (!). "Not clear": even '
        "without noise the data leave another explanation within 4.3 standard deviations, so that "
        "the local bound does not decide and the verdict is not judged; no RMSE is given, because "
        "in some data sets the optimum itself is there, at infinity.",
        "",
        "| scenario | parameter | data sets (bootstrap) | bound | RMSE / bound | Wald | profile | "
        "bootstrap | verdict right |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in table:
        rmse = f"{row.rmse / row.bound:.3f}" if row.identified and row.clear else ""
        right = "" if row.verdict_right is None else f"{100.0 * row.verdict_right:.2f} %"
        right += "" if row.clear or not right else " (not clear)"
        cells = [_covers(row, method) for method in METHODS]
        lines.append(
            f"| {row.scenario} | {row.name} | {row.data_sets} ({row.bootstrapped}) | "
            f"{row.bound:.2g} | {rmse} | {' | '.join(cells)} | {right} |"
        )
    failures = [f"- {r.scenario}, {r.name}: {text}" for r in table for text in r.failures]
    ordered = len(table) * (len(METHODS) + 1)
    left_out = sum(not _covers(row, method) for row in table for method in METHODS)
    left_out += sum(row.verdict_right is None or not row.clear for row in table)
    holds = (
        "Every ordered cell was judged and meets its requirement."
        if not left_out
        else (
            f"{left_out} of {ordered} ordered cells were not judged; all others meet their "
            "requirement."
        )
    )
    lines += ["", holds if not failures else "Requirements that are not met:", *failures]
    return "\n".join(lines) + "\n"


def _covers(row: Row, method: str) -> str:
    if not row.identified or (method == "bootstrap" and not row.bootstrapped):
        return ""
    off = np.abs(row.coverage[method] - LEVELS[:2]) > row.tolerance[method]
    cells = zip(row.coverage[method], off, strict=True)
    return ", ".join(f"{100.0 * c:.2f}{' (!)' if bad else ''}" for c, bad in cells)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="the version of the tests")
    parser.add_argument("--scenario", type=int, action="append", default=[], help="0 to 5")
    parser.add_argument("--count", type=int, default=DATA_SETS)
    options = parser.parse_args()
    count, bootstrapped, replicates = (
        SMALL if options.small else (options.count, BOOTSTRAPPED, REPLICATES)
    )
    page = as_markdown(run(count, bootstrapped, replicates, options.scenario))
    print(page)
    if not options.small and not options.scenario:
        DESTINATION.parent.mkdir(parents=True, exist_ok=True)
        DESTINATION.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()

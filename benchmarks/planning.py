"""Check that plans beat logarithmic grids, and are as good as they say.

``python -m benchmarks.planning`` answers with simulated measurements:

1. *Tables.* In scenarios of :mod:`benchmarks.coverage`, the grid of the scenario is measured with
   two cycles a level, and plans get its bench time. Tables of both are drawn with the noise model
   and fitted. Gain: standard deviation of the grid's estimates over that of the plan's.
2. *Whole experiments.* The waveforms of plan and grid move the friction from rest; noise is added
   to every sample of force; the records are extracted and fitted.
3. *Sequences.* The first guess of x_c is wrong by 30. Plan, measure, posterior, plan again, until
   the predicted uncertainty is what was wanted; against one plan that knows the truth.
4. *Motions in time.* Records of planned motions are simulated and fitted.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import dahl_ident as di
from benchmarks.coverage import F_MAX, SIGMA, X_C
from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.elements import Model
from dahl_ident.fitting import solve_many
from dahl_ident.planning import Plan
from dahl_ident.problem import ProblemBatch
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.synthetic.waveform import WaveformBuilder

SEED = 1707
GAIN, CLOSE, SEQUENCE = 1.5, 0.10, 1.5
ONE_SIGMA = 0.6827  # of a normal distribution within one standard deviation
LINEAR = Model(di.Dahl(alpha=1.0))
CYCLES = 2
CHANGE_OVER = 1.0  # s, as plans assume
SAMPLES = 40.0  # a second, in whole experiments
DRIVEN = 100  # tables of a driven plant, each fitted by its exact steady motion
SEARCHED, MOVED = 200, 200  # tables of each design in gross slip, and records of motions
WHOLE = 500  # whole experiments of a plan
WHOLE_GRIDS = 40  # the same of a grid: its many short windows take most of the time
LONGEST = 1e4  # s, of bench time that whole experiments simulate


@dataclass(frozen=True)
class Scenario:
    """A mechanism, the grid that is usual there, and what is to be found."""

    name: str
    model: Model
    truth: Mapping[str, float]
    limits: Mapping[str, Any]
    levels: int
    noise: float
    names: tuple[str, ...]
    controlled: str = "displacement"

    @property
    def known(self) -> Model:
        """The mechanism with its true values."""
        return self.model.with_values(self.truth)

    def plan(self, time: float, target: Any, **options: Any) -> Plan:
        """Return a plan made close to the truth."""
        ranges = {name: (0.98 * v, 1.02 * v) for name, v in self.truth.items()}
        return di.plan(
            self.model, ranges=ranges, limits={**self.limits, "time": time}, target=target,
            noise=self.noise, controlled=self.controlled, draws=50, **options,
        )  # fmt: skip


def scenarios() -> list[Scenario]:
    """Return scenarios as in the validation of coverage, at 1 Hz where friction is alone."""
    dahl = {"f_max": F_MAX, "sigma": SIGMA}
    spring = {**dahl, "stiffness": SIGMA}
    plant = {**dahl, "mass": 0.3, "damping": 0.24, "stiffness": 0.3}

    def range_of(low: float, high: float) -> dict[str, Any]:
        return {"displacement": (low * X_C, high * X_C), "frequency_hz": 1.0}

    both = ("f_max", "sigma")
    return [
        Scenario("well-spread amplitudes", LINEAR, dahl, range_of(0.1, 10.0), 30, 0.01, both),
        Scenario("eight points", LINEAR, dahl, range_of(0.1, 10.0), 8, 0.01, both),
        Scenario("10 % noise", LINEAR, dahl, range_of(0.1, 10.0), 30, 0.1, both),
        Scenario("microslip", LINEAR, dahl, range_of(1e-4, 1e-3), 30, 0.01, ("sigma",)),
        Scenario("low amplitudes", LINEAR, dahl, range_of(0.02, 2.0), 30, 0.01, both),
        Scenario(
            "free spring", LINEAR + di.Spring(), spring, range_of(0.1, 100.0), 30, 0.01,
            (*both, "stiffness"),
        ),
        Scenario(
            "free spring in gross slip", LINEAR + di.Spring(), spring, range_of(100.0, 1000.0), 30,
            0.01, ("stiffness",),
        ),
        Scenario(
            "plant of Eqn. 53", LINEAR + di.Mass() + di.Damper() + di.Spring(), plant,
            {"force": (0.02, 2.0), "frequency_hz": (0.1, 3.0)}, 60, 0.01, tuple(plant), "force",
        ),
    ]  # fmt: skip


@dataclass(frozen=True)
class Design:
    """Levels, frequencies and cycles of one measurement."""

    level: FloatArray
    frequency_hz: FloatArray
    cycles: FloatArray
    settling: FloatArray

    @classmethod
    def of(cls, plan: Plan) -> Design:
        """Return that of a plan; like runs without scatter are more cycles."""
        steps = plan.steps
        return cls(
            np.array([s.level for s in steps]),
            np.array([s.frequency_hz for s in steps]),
            np.array([float(s.measured_cycles * plan.runs) for s in steps]),
            np.array([float(s.settling_cycles) for s in steps]),
        )


def tables(scenario: Scenario, design: Design, count: int, seed: int) -> list[FrequencyResponse]:
    """Return measurements of a design, drawn with the noise model."""
    rng, f = np.random.default_rng([SEED, seed]), design.frequency_hz
    std = scenario.noise / np.sqrt(design.cycles)
    where: dict[str, Any] = {"amplitude": design.level}
    exact = scenario.known.dynamic_stiffness(design.level, 2.0 * np.pi * f)
    if scenario.controlled == "force":
        where = {"drive": design.level}
        exact = di.response(scenario.known, f, design.level).dynamic_stiffness
    made = []
    for _ in range(count):
        pair = rng.standard_normal((2, len(f)))
        response = exact * np.exp(std * (pair[0] + 1j * pair[1]))
        covariance = (std * np.abs(response))[:, None, None] ** 2 * np.eye(2)
        made.append(
            FrequencyResponse(
                f, response, covariance=covariance, controlled=scenario.controlled, **where
            )
        )
    return made


def achieved(
    scenario: Scenario, design: Design, count: int, seed: int, *, whole: bool = False
) -> dict[str, float]:
    """Return the relative root-mean-square errors of fits to measurements of a design.

    Where an estimate is infinite, the 68.27 % quantile of the errors' sizes. `whole` experiments
    settle from rest and are extracted from samples.
    """
    made = experiments if whole else tables
    batch = ProblemBatch(made(scenario, design, count, seed), scenario.model, noise="measured")
    found = solve_many(batch)
    truth = np.array([scenario.truth[name] for name in batch.names])
    errors = np.where(np.isfinite(found.values), found.values / truth - 1.0, np.inf)
    return dict(zip(batch.names, [_spread(column) for column in errors.T], strict=True))


def _spread(errors: FloatArray) -> float:
    """Return the rms; where an estimate is infinite, the 68.27 % quantile of the sizes."""
    if np.isfinite(errors).all():
        return float(np.sqrt(np.mean(errors**2)))
    return float(np.quantile(np.abs(errors), ONE_SIGMA, method="inverted_cdf"))


def experiments(
    scenario: Scenario, design: Design, count: int, seed: int
) -> list[FrequencyResponse]:
    """Return what whole experiments give: from rest, settling, noisy samples, extraction."""
    rng, run = np.random.default_rng([SEED, 3, seed]), WaveformBuilder(design.frequency_hz[0])
    for A, f, wait, n in zip(
        design.level, design.frequency_hz, design.settling, design.cycles, strict=True
    ):
        run.go_to(A, f, CHANGE_OVER)
        run.stay(wait / f)
        run.measure(n / f)
    wave = run.finish()
    time = np.arange(int(wave.duration * SAMPLES)) / SAMPLES
    x = wave.value(time)
    force = di.Dahl(F_MAX, SIGMA, alpha=1.0).force(x) + scenario.truth.get("stiffness", 0.0) * x
    response = np.empty((count, len(wave.windows)), dtype=np.complex128)
    for i, window in enumerate(wave.windows):
        inside = (time >= window.start - 1e-9) & (time < window.stop - 1e-9)
        size = window.level * abs(scenario.known.dynamic_stiffness(window.level, 2.0 * np.pi))
        std = scenario.noise * size * np.sqrt(0.5 * SAMPLES / window.frequency_hz)
        for k in range(count):
            noisy = force[inside] + std * rng.standard_normal(int(inside.sum()))
            record = Record(time=time[inside], displacement=x[inside], force=noisy)
            found = di.extract(
                record,
                harmonics=[1],
                frequency=window.frequency_hz,
                settling_periods=0,
                min_share=0.1,
            )
            response[k, i] = np.mean(found.response)
    std = scenario.noise / np.sqrt(design.cycles)
    return [
        FrequencyResponse(
            design.frequency_hz, row, design.level,
            covariance=(std * np.abs(row))[:, None, None] ** 2 * np.eye(2),
        )
        for row in response
    ]  # fmt: skip


# Motions in time


def achieved_by_records(
    plan: Plan,
    model: Model,
    truth: Mapping[str, float],
    rate: float,
    noise: float,
    count: int,
    *,
    seed: int,
) -> dict[str, float]:
    """Return the relative root-mean-square errors of fits to simulated records of a plan.

    Each record begins with some force that the fit does not know, and has an offset.
    """  # fmt: skip
    rng, exact = np.random.default_rng([SEED, 5, seed]), []
    for step in plan.steps:
        assert step.motion is not None
        time = np.arange(round(step.measured_cycles * step.motion.period * rate)) / rate
        x = step.motion.displacement(time)
        problem = RecordProblem([Record(time, displacement=x, force=0.0 * x)], model)
        start = {**truth, "initial_force": 0.3 * truth["f_max"], "offset": 0.2 * truth["f_max"]}
        values = np.array([start.get(name, 0.0) for name in problem.names])
        exact.append((time, x, problem.predict(values, 0, derivatives=False).output))
    errors = []
    for _ in range(count):
        records = [
            Record(t, displacement=x, force=force + noise * rng.standard_normal(t.size))
            for t, x, force in exact
        ]
        fit = di.fit(records, model, start=dict(truth))
        errors.append([fit.params[name].value / value - 1.0 for name, value in truth.items()])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    return dict(zip(truth, rms.tolist(), strict=True))


@dataclass(frozen=True)
class Row:
    """A plan for one aim against the grid, at equal time."""

    scenario: str
    aim: str
    name: str
    time: float
    levels: int
    predicted: float
    plan: float
    grid: float
    plan_whole: float
    grid_whole: float
    whole: int

    @property
    def gain(self) -> float:
        """How many times narrower the plan's intervals are."""
        return self.grid / self.plan

    @property
    def gain_whole(self) -> float:
        """The same in whole experiments; NaN where they were not simulated."""
        return self.grid_whole / self.plan_whole

    @property
    def agreement(self) -> float:
        """Predicted over achieved."""
        return self.predicted / self.plan


def compare(scenario: Scenario, count: int, seed: int, whole: int = 0) -> Iterator[Row]:
    """Yield a row a parameter and aim: that parameter alone, and all by D-optimality.

    With `count` tables and `whole` experiments of each design.
    """
    first = scenario.plan(1e6, None, candidates=60)
    bench, grid = first.search.bench, first.search.logarithmic_grid(1e6, scenario.levels)
    assert grid is not None
    levels = grid.levels
    time = bench.seconds(levels, np.full(len(levels), float(CYCLES)))
    options = first.search.forecast.candidates
    even = Design(
        options.level[levels], options.frequency_hz[levels], np.full(len(levels), float(CYCLES)),
        bench.settling_cycles(levels),
    )  # fmt: skip
    base = achieved(scenario, even, count, seed)
    whole = whole if time < LONGEST and scenario.controlled == "displacement" else 0
    some = min(whole, WHOLE_GRIDS)
    base_whole = achieved(scenario, even, some, seed, whole=True) if some else {}
    aims: list[tuple[str, Any]] = [("all", None), *((name, name) for name in scenario.names)]
    for aim, target in aims:
        plan = scenario.plan(time, target)
        assert plan.seconds <= time + 1e-6
        design = Design.of(plan)
        got = achieved(scenario, design, count, seed + 1)
        run = achieved(scenario, design, whole, seed + 2, whole=True) if whole else {}
        for name in scenario.names if target is None else (aim,):
            yield Row(
                scenario.name, aim, name, time, len(plan.steps), plan.expected[name].after,
                got[name], base[name], run.get(name, np.nan), base_whole.get(name, np.nan),
                whole,
            )  # fmt: skip


# Sequences

WANTED = {"f_max": 0.004, "sigma": 0.004}
LIMITS = {"displacement": (0.01 * X_C, 100.0 * X_C), "frequency_hz": 1.0}


def sequence(off: float, seed: int, *, first: float = 20.0, most: int = 12) -> tuple[float, float]:
    """Return seconds of a sequence that believes x_c to be `off` times the truth, and the oracle's.

    Stiffness carries the whole error; 95 % ranges reach a factor of 50 to either side of it, and a
    factor of 3 of f_max.
    """
    truth = {"f_max": F_MAX, "sigma": SIGMA}
    oracle = di.plan(
        LINEAR, ranges={n: (0.999 * v, 1.001 * v) for n, v in truth.items()}, limits=LIMITS,
        target=WANTED, noise=0.02, draws=20,
    )  # fmt: skip
    ranges = {"f_max": (F_MAX / 3.0, 3.0 * F_MAX), "sigma": (SIGMA / off / 50, SIGMA / off * 50)}
    case = Scenario("sequence", LINEAR, truth, LIMITS, 0, 0.02, ("f_max", "sigma"))
    known: Any = LINEAR
    spent, chunk, parts = 0.0, first, []
    for step in range(most):
        own = ranges if step == 0 else None
        plan = di.plan(
            known, ranges=own, limits={**LIMITS, "time": chunk}, target=WANTED, noise=0.02,
            draws=100, seed=seed,
        )  # fmt: skip
        if step and all(plan.expected[n].before <= u for n, u in WANTED.items()):
            break
        spent += plan.seconds
        parts += tables(case, Design.of(plan), 1, 1000 * seed + step)
        known = di.posterior(_joined(parts), LINEAR, method="grid", priors=ranges)
        chunk = max(chunk, 0.5 * spent)
    return spent, oracle.seconds


def _joined(parts: Sequence[FrequencyResponse]) -> FrequencyResponse:
    columns = ("frequency_hz", "response", "amplitude", "covariance")
    whole: dict[str, Any] = {
        n: np.concatenate([getattr(part, n) for part in parts]) for n in columns
    }
    return FrequencyResponse(**whole)


# A measured damper

KNOWN = {"f_max": (10.0, 1e3), "sigma": (1e4, 1e7), "damping": (200.0, 2e4)}
SERIES = {
    "A": [f"ensaio.A.{i}.mat" for i in range(1, 11)],
    "1": [f"ensaio{i}.1.mat" for i in range(1, 11)],
    "validation": [f"ensaio.vali.{i}.mat" for i in range(1, 10)],
}
CHOSEN = 4  # levels of a series
AIMS = {"all parameters": None, "response": "response"}


@dataclass(frozen=True)
class Choices:
    """What fits to four levels of a series predict of its others.

    Attributes
    ----------
    evenly, typical : float
        Relative error by evenly spaced levels, and the median of all choices of four.
    planned : ndarray
        The same by plans that start from each pair of levels.
    better : float
        Share of all ways to add two levels to the pair that a plan's are as good as, mean.
    inside : float
        Share of gains and phases within their 95.45 % bands.
    """

    series: str
    aim: str
    levels: int
    evenly: float
    typical: float
    planned: FloatArray
    better: float
    inside: float


def damper(folder: Path) -> Iterator[Choices]:
    """Yield what plans choose of the measured levels of a damper on a crank, series by series.

    From a fit to two levels, the next one is planned, twice; a fit to the four predicts the
    others, next to four evenly spaced levels and all choices of four.
    """
    model = LINEAR + di.Damper()
    for series, files in SERIES.items():
        levels = sorted((_level(folder / name) for name in files), key=_amplitude)
        numbers = range(len(levels))
        fours = list(itertools.combinations(numbers, CHOSEN))
        every = {four: _predicted(levels, four, model) for four in fours}
        even = tuple(np.linspace(0, len(levels) - 1, CHOSEN).round().astype(int).tolist())
        for aim, target in AIMS.items():
            found, better = [], []
            for pair in itertools.combinations(numbers, 2):
                found.append(every[_chosen(levels, pair, model, target)])
                ways = [every[four][0] for four in fours if set(pair) <= set(four)]
                better.append(np.mean(np.array(ways) >= found[-1][0]))
            inside, count = (sum(one[i] for one in found) for i in (1, 2))
            yield Choices(
                series, aim, len(levels), every[even][0],
                float(np.median([error for error, _, _ in every.values()])),
                np.array([error for error, _, _ in found]), float(np.mean(better)), inside / count,
            )  # fmt: skip


def _level(path: Path) -> FrequencyResponse:
    from scipy.io import loadmat

    content = loadmat(path)
    x, _, force = content["x_F"].T
    time = np.arange(x.size) * content["Ts"].item()
    return di.extract(Record(time, displacement=1e-3 * x, force=force)).select(harmonic=1)


def _amplitude(level: FrequencyResponse) -> float:
    assert level.amplitude is not None
    return float(level.amplitude[0])


def damper_table(choices: Sequence[Choices]) -> str:
    """Return the part of the page on the measured damper."""
    lines = [
        "A measured damper on a crank, three drive voltages of its coil, one a series (9 or 10 "
        "levels near 1 Hz; Dahl and linear damper). From fits to each pair of levels, plans choose "
        "two more, one at a time; the fit to the four predicts the others. Errors are relative to "
        "the response, root mean square over the other levels, and the median over the pairs. "
        "Required: smaller than of four evenly spaced levels (else marked (!)), and inside the "
        "95.45 % bands.",
        "",
        "| series | plan for | plans | evenly spaced | all choices of four | plan better than "
        "evenly | than other additions to the pair | inside the bands |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for aim in AIMS:
        own = [c for c in choices if c.aim == aim]
        for c in own:
            median = float(np.median(c.planned))
            won = float(np.mean(c.planned < c.evenly))
            lines.append(
                _damper_row(c.series, aim, median, c.evenly, c.typical, won, c.better, c.inside)
            )
        means = [
            float(np.mean(one))
            for one in zip(
                *(
                    (
                        float(np.median(c.planned)), c.evenly, c.typical,
                        float(np.mean(c.planned < c.evenly)), c.better, c.inside,
                    )
                    for c in own
                ), strict=True,
            )
        ]  # fmt: skip
        lines.append(_damper_row("mean", aim, *means))
    return "\n".join(lines)


def _damper_row(
    series: str, aim: str, plans: float, evenly: float, typical: float, won: float, better: float,
    inside: float,
) -> str:  # fmt: skip
    missed = "" if plans < evenly else " (!)"
    return (
        f"| {series} | {aim} | {plans:.2%}{missed} | {evenly:.2%} | {typical:.2%} | {won:.0%} "
        f"| {better:.0%} | {inside:.0%} |"
    )


def _chosen(
    levels: Sequence[FrequencyResponse], pair: tuple[int, int], model: Model, target: str | None
) -> tuple[int, ...]:
    chosen = list(pair)
    while len(chosen) < CHOSEN:
        fit = di.fit(_rows(levels, chosen), model, throw=False)
        rest = [i for i in range(len(levels)) if i not in chosen]
        options = [(_amplitude(levels[i]), float(levels[i].frequency_hz[0])) for i in rest]
        plan = di.plan(
            fit, limits={"frequency_hz": (0.1, 3.0), "time": 6.0}, candidates=options, draws=30,
            target=target, ranges=KNOWN, settled=1.0,
        )  # fmt: skip
        (best,) = plan.steps  # no time for two
        chosen.append(rest[int(np.argmin([abs(A - best.level) for A, _ in options]))])
    return tuple(sorted(chosen))


def _predicted(
    levels: Sequence[FrequencyResponse], chosen: Sequence[int], model: Model
) -> tuple[float, int, int]:
    """Return the error of the other levels, and how many gains and phases lie in their bands."""
    fit = di.fit(_rows(levels, chosen), model, throw=False)
    other = _rows(levels, [i for i in range(len(levels)) if i not in chosen])
    band = fit.predict(other.frequency_hz, amplitude=other.amplitude)
    error = np.sqrt(np.mean(np.abs(other.response / band.response - 1.0) ** 2))
    measured = (np.abs(other.response), np.angle(other.response))
    inside = sum(
        int(((low <= value) & (value <= high)).sum())
        for value, (low, high) in zip(measured, (band.gain(), band.phase()), strict=True)
    )
    return float(error), inside, 2 * len(other.response)


def _rows(levels: Sequence[FrequencyResponse], chosen: Sequence[int]) -> FrequencyResponse:
    """Return some levels in one table, without covariances."""
    columns = ("frequency_hz", "response", "amplitude")
    whole: dict[str, Any] = {
        n: np.concatenate([getattr(levels[i], n) for i in chosen]) for n in columns
    }
    return FrequencyResponse(**whole)


def as_markdown(
    rows: Sequence[Row], times: Sequence[tuple[float, float, float]], count: int
) -> str:
    """Return the page."""
    lines = [
        "# Plans against logarithmic grids",
        "",
        "Made by `python -m benchmarks.planning`. A grid measures two cycles at each level of the "
        f"scenario; a plan gets the same bench time. {count} tables of each are simulated and "
        "fitted; the errors are relative, root mean square; where some estimates are infinite, as "
        "in gross slip, the 68.27 % quantile of their sizes. Gain is the grid's error over the "
        "plan's; agreement is the predicted error over the achieved one. Required: a gain of "
        f"{GAIN:g} for the parameter that the plan is for, and agreement within {100 * CLOSE:g} %. "
        "Values that do not meet this are marked (!). Of N data sets the simulation's own error "
        f"(95 %) is 139 %/sqrt(N) of an achieved error: {1.39 / np.sqrt(count):.0%} for {count}. "
        "Columns marked * are whole experiments: Dahl friction (and spring) moved from rest by the "
        f"plan's waveform or the grid's, noise on every sample ({SAMPLES:g} a second), extraction "
        f"of each level, fit; their number is N*, and at least {WHOLE_GRIDS} of the grid. Driven "
        f"plants, of which there are {min(count, DRIVEN)} tables, and bench times of hours are "
        "simulated by tables alone.",
        "",
        "| scenario | plan for | parameter | time [s] | levels | predicted | achieved | grid "
        "| gain | agreement | N* | achieved* | gain* | agreement* |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        own = r.aim == r.name
        cells = [
            r.scenario, r.aim, r.name, f"{r.time:.0f}", str(r.levels), f"{r.predicted:.2e}",
            f"{r.plan:.2e}", f"{r.grid:.2e}", *_judged(r.gain, r.agreement, own),
        ]  # fmt: skip
        if r.whole:
            agreement = r.predicted / r.plan_whole
            cells += [str(r.whole), f"{r.plan_whole:.2e}", *_judged(r.gain_whole, agreement, own)]
        else:
            cells += [""] * 4
        lines.append(f"| {' | '.join(cells)} |")
    if times:
        lines += [
            "",
            "Sequences that start from a wrong x_c and plan again after each measurement, against "
            "one plan from the true parameters (oracle). Required: a ratio of at most "
            f"{SEQUENCE:g}; values above it are marked (!).",
        ]
        lines += ["", "| first x_c / true x_c | sequence [s] | oracle [s] | ratio |"]
        lines += ["|---|---|---|---|"]
        for off, spent, oracle in times:
            bad = " (!)" if spent > SEQUENCE * oracle else ""
            lines.append(f"| {off:g} | {spent:.0f} | {oracle:.0f} | {spent / oracle:.2f}{bad} |")
    return "\n".join(lines) + "\n"


def motions_table(count: int) -> str:
    """Return the part of the page on motions in time."""
    near = {"f_max": (0.98 * F_MAX, 1.02 * F_MAX), "sigma": (0.98 * SIGMA, 1.02 * SIGMA)}
    truth = {"f_max": F_MAX, "sigma": SIGMA}
    both = {**truth, "stiffness": 0.1 * SIGMA, "damping": 0.5}
    wide = {**near, "stiffness": (2.94, 3.06), "damping": (0.49, 0.51)}
    bench = {
        "displacement": (0.03 * X_C, 9.0 * X_C), "speed": 0.05, "acceleration": 1.0,
        "frequency_hz": 5.0,
    }  # fmt: skip
    noise, rate = 0.05 * F_MAX, 100.0
    lines = [
        f"Motions in time: {count} experiments each, records of the planned motions at {rate:g} "
        f"samples a second with white noise of {noise / F_MAX:.0%} of f_max, an unknown force at "
        "the first sample and an offset, fitted in time. Required: agreement within "
        f"{100 * CLOSE:g} %.",
        "",
        "| model | motions | plan for | time [s] | parameter | predicted | achieved | agreement |",
        "|---|---|---|---|---|---|---|---|",
    ]
    cases: list[tuple[str, Model, dict[str, float], Any, float]] = [
        ("Dahl", LINEAR, truth, near, 30.0),
        ("Dahl, spring, damper", LINEAR + di.Spring() + di.Damper(), both, wide, 60.0),
    ]
    for name, model, values, ranges, time in cases:
        for kind, target in itertools.product(("trapezoid", "multisine"), (None, "sigma")):
            plan = di.plan(
                model, ranges=ranges, limits={**bench, "time": time}, target=target,
                noise={"force": noise}, sample_rate=rate, candidates=kind,
            )  # fmt: skip
            got = achieved_by_records(plan, model, values, rate, noise, count, seed=0)
            for p in values if target is None else (target,):
                told = plan.expected[p].after
                apart = "" if abs(told / got[p] - 1.0) <= CLOSE else " (!)"
                lines.append(
                    f"| {name} | {kind} | {target or 'all'} | {plan.seconds:.0f} | {p} "
                    f"| {told:.2e} | {got[p]:.2e} | {told / got[p]:.2f}{apart} |"
                )
    return "\n".join(lines)


def gross_slip(count: int) -> str:
    """Return what is within reach in gross slip: all designs of two to four of seven levels."""
    scenario = next(s for s in scenarios() if s.name == "free spring in gross slip")
    low, high = scenario.limits["displacement"]
    levels, time, found = np.geomspace(low, high, 7), 120.0, {}
    for size in (2, 3, 4):
        for chosen in itertools.combinations(levels, size):
            cycles = np.full(size, np.floor((time - (1.0 + CHANGE_OVER) * size) / size))
            design = Design(np.array(chosen), np.ones(size), cycles, np.ones(size))
            found[chosen] = achieved(scenario, design, count, 77)["stiffness"]
    best = min(found, key=lambda chosen: found[chosen])
    everything = scenario.noise / np.sqrt(time - 1.0 - CHANGE_OVER)
    return (
        f"In gross slip, of all {len(found)} designs of two to four of seven levels with equal "
        f"cycles in {time:g} s, the one with amplitudes of "
        f"{', '.join(f'{A / X_C:.0f}' for A in best)} x_c is best: it achieves {found[best]:.2e} "
        f"of the stiffness ({count} tables each). No design can go below {everything:.2e}, which "
        "one level would reach if f_max and sigma were known exactly."
    )


def _judged(gain: float, agreement: float, own: bool) -> tuple[str, str]:
    """Return gain and agreement, marked where they do not meet what is required."""
    bad = " (!)" if own and not gain >= GAIN else ""
    apart = "" if abs(agreement - 1.0) <= CLOSE else " (!)"
    return f"{gain:.2f}{bad}", f"{agreement:.2f}{apart}"


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the tables")
    parser.add_argument("--write", type=Path, help="page to write")
    given = parser.parse_args()
    count = 50 if given.small else 500
    rows = [
        row
        for i, s in enumerate(scenarios())
        for row in compare(
            s,
            min(count, DRIVEN) if s.controlled == "force" else count,
            10 * i,
            WHOLE * count // 500,
        )
    ]
    seeds = range(2 if given.small else 5)
    times = [(off, *sequence(off, seed)) for off in (30.0, 1.0 / 30.0) for seed in seeds]
    page = as_markdown(rows, times, count)
    page += f"\n{gross_slip(min(count, SEARCHED))}\n\n{motions_table(min(count, MOVED))}\n"
    measured = Path(os.environ.get("DAHL_IDENT_MEASURED_DATA", "absent")) / "mr_damper"
    if measured.is_dir():
        page += f"\n{damper_table(list(damper(measured)))}\n"
    print(page)
    if given.write:
        given.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()

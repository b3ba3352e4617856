"""Check that plans beat logarithmic grids, and are as good as they say.

``python -m benchmarks.planning`` answers with simulated measurements:

1. *Tables.* In scenarios of :mod:`benchmarks.coverage`, the grid of the scenario is measured with
   two cycles a level, and plans get its bench time. Tables of both are drawn with the noise model
   and fitted. Gain: standard deviation of the grid's estimates over that of the plan's.
2. *Whole waveforms.* The plan's waveform moves a Dahl element from rest; noise is added to every
   sample of displacement and force; the record is extracted and fitted.
3. *Sequences.* The first guess of x_c is wrong by 30. Plan, measure, posterior, plan again, until
   the predicted uncertainty is what was wanted; against one plan that knows the truth.
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

SEED = 1707
GAIN, CLOSE, SEQUENCE = 1.5, 0.10, 1.5
LINEAR = Model(di.Dahl(alpha=1.0))
CYCLES = 2


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
        Scenario("low amplitudes", LINEAR, dahl, range_of(0.02, 2.0), 30, 0.01, both),
        Scenario(
            "free spring", LINEAR + di.Spring(), spring, range_of(0.1, 100.0), 30, 0.01,
            (*both, "stiffness"),
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

    @classmethod
    def of(cls, plan: Plan) -> Design:
        """Return that of a plan; like runs without scatter are more cycles."""
        steps = plan.steps
        return cls(
            np.array([s.level for s in steps]),
            np.array([s.frequency_hz for s in steps]),
            np.array([float(s.measured_cycles * plan.runs) for s in steps]),
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


def achieved(scenario: Scenario, design: Design, count: int, seed: int) -> dict[str, float]:
    """Return the relative root-mean-square errors of fits to measurements of a design."""
    batch = ProblemBatch(tables(scenario, design, count, seed), scenario.model, noise="measured")
    found = solve_many(batch)
    truth = np.array([scenario.truth[name] for name in batch.names])
    errors = np.where(np.isfinite(found.values), found.values / truth - 1.0, np.inf)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(np.mean(errors**2, axis=0))
    return dict(zip(batch.names, rms.tolist(), strict=True))


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

    @property
    def gain(self) -> float:
        """How many times narrower the plan's intervals are."""
        return self.grid / self.plan

    @property
    def agreement(self) -> float:
        """Predicted over achieved."""
        return self.predicted / self.plan


def compare(scenario: Scenario, count: int, seed: int) -> Iterator[Row]:
    """Yield a row a parameter and aim: that parameter alone, and all by D-optimality."""
    first = scenario.plan(1e5, None, candidates=60)
    planner: Any = first.planner
    bench, levels = planner.search.bench, planner.search.logarithmic_grid(1e6, scenario.levels)[0]
    time = bench.seconds(levels, np.full(len(levels), float(CYCLES)))
    options = planner.forecast.candidates
    even = Design(
        options.level[levels], options.frequency_hz[levels], np.full(len(levels), float(CYCLES))
    )
    base = achieved(scenario, even, count, seed)
    aims: list[tuple[str, Any]] = [("all", None), *((name, name) for name in scenario.names)]
    for aim, target in aims:
        plan = scenario.plan(time, target)
        assert plan.seconds <= time + 1e-6
        got = achieved(scenario, Design.of(plan), count, seed + 1)
        for name in scenario.names if target is None else (aim,):
            yield Row(
                scenario.name, aim, name, time, len(plan.steps), plan.expected[name].after,
                got[name], base[name],
            )  # fmt: skip


# Whole waveforms

RATE = 200.0


def measured_records(plan: Plan, force_std: float, seed: int) -> list[Record]:
    """Return what a bench records in the plan's windows: Dahl friction from rest, noisy force."""
    rng, wave = np.random.default_rng([SEED, 2, seed]), plan.waveform()
    time = np.arange(int(wave.duration * RATE)) / RATE
    x = wave.value(time)
    force = di.Dahl(F_MAX, SIGMA, alpha=1.0).force(x) + force_std * rng.standard_normal(len(time))
    records = []
    for window in wave.windows:
        inside = (time >= window.start - 1e-9) & (time < window.stop - 1e-9)
        records.append(Record(time=time[inside], displacement=x[inside], force=force[inside]))
    return records


def waveforms(count: int) -> tuple[Plan, FloatArray, FloatArray]:
    """Return a plan with its predicted and achieved relative errors of f_max and sigma."""
    force_std, f = 0.01, 5.0
    per_cycle = force_std * np.sqrt(2.0 * f / RATE)
    plan = di.plan(
        LINEAR, ranges={"f_max": (0.098, 0.102), "sigma": (29.4, 30.6)}, draws=50,
        noise={"force": per_cycle}, change_over=0.6,
        limits={"displacement": (0.1 * X_C, 10.0 * X_C), "frequency_hz": f, "time": 20.0},
    )  # fmt: skip
    errors = []
    for seed in range(count):
        data = di.extract(
            measured_records(plan, force_std, seed),
            harmonics=[1],
            frequency=f,
            settling_periods=0,
        )
        fit = di.fit(data, LINEAR, throw=False)
        errors.append([fit.optimum.values[i] for i in (0, 1)])
    relative = np.array(errors) / [F_MAX, SIGMA] - 1.0
    told = np.array([plan.expected[name].after for name in ("f_max", "sigma")])
    return plan, told, np.sqrt(np.mean(relative**2, axis=0))


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
EVENLY = (0, 3, 6, 9)


def damper(folder: Path) -> str:
    """Return what plans choose of ten measured levels of a damper on a crank, as a paragraph.

    From a fit to two levels, the next one is planned, twice; a fit to the four predicts the other
    six, beside four evenly spaced levels and all choices of four.
    """
    from scipy.io import loadmat

    levels = []
    for i in range(1, 11):
        content = loadmat(folder / f"ensaio.A.{i}.mat")
        x, _, force = content["x_F"].T
        time = np.arange(x.size) * content["Ts"].item()
        record = Record(time, displacement=1e-3 * x, force=force)
        levels.append(di.extract(record).select(harmonic=1))
    model = LINEAR + di.Damper()
    fours: list[tuple[int, ...]] = list(itertools.combinations(range(10), 4))
    every = {four: _predicted(levels, four, model) for four in fours}
    errors = np.array([error for error, _, _ in every.values()])
    lines = [
        f"A measured damper ({len(levels)} levels of 2.9 to 9.1 mm, 0.8 to 1.2 Hz, Dahl and linear "
        f"damper): the median relative error of all {len(every)} choices of four levels in the "
        f"prediction of the others is {np.median(errors):.2%}, that of four evenly spaced ones "
        f"{every[EVENLY][0]:.2%}."
    ]
    for target in (None, "response"):
        chosen = [
            every[_chosen(levels, pair, model, target)]
            for pair in itertools.combinations(range(10), 2)
        ]
        own = np.array([error for error, _, _ in chosen])
        inside, count = sum(i for _, i, _ in chosen), sum(n for _, _, n in chosen)
        missed = "" if np.median(own) < every[EVENLY][0] else " (!)"
        beaten = [
            np.mean([every[four][0] >= error for four in fours if set(pair) <= set(four)])
            for pair, error in zip(itertools.combinations(range(10), 2), own, strict=True)
        ]
        lines.append(
            f"Plans for {'all parameters' if target is None else 'the response'} from fits "
            f"to each pair of levels: {np.median(own):.2%}{missed}, smaller than evenly spaced in "
            f"{np.mean(own < every[EVENLY][0]):.0%}, and no larger than {np.mean(beaten):.0%} of "
            f"all ways to add two levels to the pair; {inside} of {count} gains and phases "
            f"({inside / count:.0%}) lie in their 95.45 % bands."
        )
    return " ".join(lines)


def _chosen(
    levels: Sequence[FrequencyResponse], pair: tuple[int, int], model: Model, target: str | None
) -> tuple[int, ...]:
    chosen = list(pair)
    while len(chosen) < 4:
        fit = di.fit(_rows(levels, chosen), model, throw=False)
        rest = [i for i in range(10) if i not in chosen]
        options = [
            (float(A[0]), float(levels[i].frequency_hz[0]))
            for i in rest
            if (A := levels[i].amplitude) is not None
        ]
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
    other = _rows(levels, [i for i in range(10) if i not in chosen])
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
    rows: Sequence[Row], records: Any, times: Sequence[tuple[float, float, float]], count: int
) -> str:
    """Return the page."""
    lines = [
        "# Plans against logarithmic grids",
        "",
        "Made by `python -m benchmarks.planning`. A grid measures two cycles at each level of the "
        f"scenario; a plan gets the same bench time. {count} tables of each are simulated and "
        "fitted; the errors are relative, root mean square. Gain is the grid's error over the "
        "plan's; agreement is the predicted error over the achieved one. Required: a gain of "
        f"{GAIN:g} for the parameter that the plan is for, and agreement within {100 * CLOSE:g} %. "
        "Values that do not meet this are marked (!). The longer the bench time, the smaller the "
        "effect of settling: against eight levels in 200 s at 1 Hz a plan for all parameters gains "
        "about 1.2 for f_max and 1.1 for sigma.",
        "",
        "| scenario | plan for | parameter | time [s] | levels | predicted | achieved | grid "
        "| gain | agreement |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        bad = " (!)" if r.aim == r.name and r.gain < GAIN else ""
        apart = " (!)" if abs(r.agreement - 1.0) > CLOSE else ""
        lines.append(
            f"| {r.scenario} | {r.aim} | {r.name} | {r.time:.0f} | {r.levels} | {r.predicted:.2e} "
            f"| {r.plan:.2e} | {r.grid:.2e} | {r.gain:.2f}{bad} | {r.agreement:.2f}{apart} |"
        )
    if records is not None:
        plan, told, got = records
        lines += [
            "",
            f"Whole waveforms ({len(plan.steps)} levels in {plan.seconds:.0f} s, started from "
            f"rest, extracted and fitted): predicted over achieved error {told[0] / got[0]:.2f} "
            f"for f_max, {told[1] / got[1]:.2f} for sigma.",
        ]
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


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the tables")
    parser.add_argument("--write", type=Path, help="page to write")
    given = parser.parse_args()
    count = 50 if given.small else 500
    rows = [row for i, s in enumerate(scenarios()) for row in compare(s, count, 10 * i)]
    records = waveforms(20 if given.small else 200)
    seeds = range(2 if given.small else 10)
    times = [(off, *sequence(off, seed)) for off in (30.0, 1.0 / 30.0) for seed in seeds]
    page = as_markdown(rows, records, times, count)
    measured = Path(os.environ.get("DAHL_IDENT_MEASURED_DATA", "absent")) / "mr_damper"
    if measured.is_dir():
        page += f"\n{damper(measured)}\n"
    print(page)
    if given.write:
        given.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()

"""A plan: levels in the order of the run, predicted uncertainties, and the limits that matter."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import FloatArray, positive_number
from dahl_ident.data.storage import place_of, plain_data, write_whole
from dahl_ident.diagnostics.formatting import listed, table
from dahl_ident.errors import ValidationError
from dahl_ident.planning import trajectories
from dahl_ident.planning.candidates import Candidates, evaluate, grid, level_range
from dahl_ident.planning.design import Design, Objective, continuous_design
from dahl_ident.planning.forecast import NOTHING, Expected, Forecast
from dahl_ident.planning.motion_information import evaluate_motions, motions_of
from dahl_ident.planning.question import BenchLimits, PlanRequest, is_expanded
from dahl_ident.planning.search import LONGEST, Search
from dahl_ident.planning.trajectories import PlannedMotion
from dahl_ident.synthetic.waveform import Waveform, WaveformBuilder
from dahl_ident.units import Motion, percent, shown_unit, si_unit

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.plots import Axes

_CURVE = (0.25, 0.5, 1.0, 2.0, 4.0)  # multiples of the plan's time, in the plot
_UNDETERMINED = 0.25  # relative standard uncertainty above which a parameter is not determined
_FEW_LEVELS = 60  # candidates from which the effect of a wider limit is computed
_NEARLY_ALL = 0.99  # fraction of the longest time that counts as all of it, as cycles are whole
_HOURS = 7200.0  # s, from which the time is stated in hours as well
_WIDER = 10.0  # factor by which a limit is widened to find its effect
_COSTLY = _WIDER**0.75  # effect above that of the frequency or the time, its square root
_MODEL_ERROR = {
    "none": "the model is right",
    "estimated": "the model errs as the earlier data show",
    "assumed": "levels chosen as if the model erred by the noise of the earlier data, "
    "which are too few to tell one from the other",
}


@dataclass(frozen=True)
class PlanStep:
    """One level of a run, or one motion in time."""

    level: float  # amplitude of displacement (m) or drive (N), zero to peak
    frequency_hz: float  # of a motion in time, 1/period
    settling_cycles: int  # before measuring
    measured_cycles: int  # of a motion in time, the number of repeats
    seconds: float  # change-over, settling and measuring
    motion: PlannedMotion | None = None  # the motion in time; None for a sine


@dataclass(frozen=True)
class Plan:
    """Which levels to measure, in which order, for how many cycles.

    Made by :func:`dahl_ident.plan`.

    Attributes
    ----------
    controlled : {"displacement", "force"}
        Quantity of which the levels are amplitudes.
    steps : tuple of PlanStep
        Levels or motions of one run, in order.
    runs : int
        Number of equal runs.
    seconds : float
        Total time.
    expected : mapping of str to Expected
        Predicted uncertainty of every parameter and target, without the information in `ranges`.
    target : mapping of str to float
        Relative uncertainties that were asked for; empty if time was given.
    reached : bool
        Whether the plan is predicted to meet all targets, those of suspected parameters included.
    undetermined : tuple of str
        Quantities that the plan does not determine, and the limit that prevents it.
    assumptions : tuple of str
        Assumptions of the prediction.

    Examples
    --------
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl(alpha=1.0))
    >>> plan = di.plan(fit, limits={"displacement": 0.03, "frequency_hz": 5.0, "time": 30.0})
    >>> [step.measured_cycles > 10 for step in plan.steps], plan.seconds <= 30.0
    ([True, True], True)
    """

    controlled: str
    steps: tuple[PlanStep, ...]
    runs: int
    seconds: float
    expected: Mapping[str, Expected]
    target: Mapping[str, float]
    reached: bool
    undetermined: tuple[str, ...]
    assumptions: tuple[str, ...]
    change_over: float
    motion: Motion
    search: Search = field(repr=False, compare=False)

    def to_frame(self) -> pd.DataFrame:
        """Return the table: level, frequency, settling and measured cycles, seconds.

        For motions in time: the motion, its parameters, period, repeats and seconds.

        Returns
        -------
        pandas.DataFrame
            One row for each level or motion, in the order of the run.
        """
        import pandas as pd

        return pd.DataFrame([_row(step) for step in self.steps])

    def budget(self) -> pd.DataFrame:
        """Return the predicted uncertainty of every parameter and target.

        Returns
        -------
        pandas.DataFrame
            Columns ``value, before, after, low, high, scatter_share``; see `Expected`.
        """
        import pandas as pd

        rows = {name: vars(expected) for name, expected in self.expected.items()}
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("quantity")

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain data."""
        return {
            "controlled": self.controlled,
            "runs": self.runs,
            "seconds": self.seconds,
            "steps": [_row(step) for step in self.steps],
            "expected": {name: dict(vars(e)) for name, e in self.expected.items()},
            "target": dict(self.target),
            "reached": self.reached,
            "undetermined": list(self.undetermined),
            "assumptions": list(self.assumptions),
        }

    def waveform(self) -> Waveform:
        """Return one run of sines as a smooth waveform with its measured windows.

        Raises
        ------
        ValidationError
            If the plan holds motions in time; `write_waveform` writes them.
        """
        if self.steps[0].motion is not None:
            raise ValidationError("the plan holds motions in time; write_waveform() writes them")
        run = WaveformBuilder(self.steps[0].frequency_hz)
        for step in self.steps:
            run.go_to(step.level, step.frequency_hz, self.change_over)
            run.stay(step.settling_cycles / step.frequency_hz)
            run.measure(step.measured_cycles / step.frequency_hz)
        return run.finish()

    def write_waveform(
        self, path: str | Path, sample_rate: float, *, overwrite: bool = False
    ) -> Path:
        """Write one run for the exciter: time, value, step and whether it is measured.

        Parameters
        ----------
        path : path
            Ending in ``.csv``.
        sample_rate : float
            Samples a second: at least ten in a cycle of the highest frequency, or in a stroke of
            a trapezoid.
        overwrite : bool, default False
            Replace an existing file.

        Returns
        -------
        Path
            The file, with ``time [s]``, the displacement (m) or the drive (N), the number of the
            step, from 1, and 1 for samples to be measured, otherwise 0.

        Raises
        ------
        ValidationError
            If there are fewer than ten samples a cycle, or the move to the start of a motion
            exceeds the limits of speed or acceleration.
        """
        import pandas as pd

        rate = positive_number(sample_rate, "sample_rate")
        motions = [step.motion for step in self.steps if step.motion is not None]
        fastest = max(
            step.motion.fastest_hz if step.motion else step.frequency_hz for step in self.steps
        )
        if rate < trajectories.SAMPLES_PER_CYCLE * fastest:
            raise ValidationError(
                f"sample_rate is {rate:g}; expected at least ten samples a cycle: "
                f"{trajectories.SAMPLES_PER_CYCLE * fastest:g}"
            )
        if motions:
            self._check_moves(motions)
            time = np.arange(int(np.floor(self.seconds * rate + 1e-6)) + 1) / rate
            repeats = [step.measured_cycles for step in self.steps]
            value, step, measured = trajectories.course(motions, repeats, self.change_over, time)
        else:
            wave = self.waveform()
            time = np.arange(int(np.floor(wave.duration * rate)) + 1) / rate
            value = wave.value(time)
            measured, step = np.zeros(time.size, dtype=bool), np.ones(time.size, dtype=np.int64)
            for i, window in enumerate(wave.windows, start=1):
                measured[(time >= window.start) & (time < window.stop)] = True
                step[time >= window.stop] = min(i + 1, len(wave.windows))
        quantity = "drive" if self.controlled == "force" else "displacement"
        columns = {"time [s]": time, f"{quantity} [{self._unit}]": value, "step": step}
        frame = pd.DataFrame(columns | {"measured": measured.astype(int)})
        place = place_of(path, "a waveform", (".csv",))
        write_whole(place, frame.to_csv(index=False).encode(), overwrite=overwrite)
        return place

    def _check_moves(self, motions: list[trajectories.PlannedMotion]) -> None:
        """Check that the moves to the motions' starts are within the limits of the exciter."""
        limits, position = self.search.question.limits, 0.0
        for i, motion in enumerate(motions, start=1):
            start = float(motion.displacement(np.zeros(1))[0])
            least = trajectories.seconds_of_move(
                abs(start - position), limits.speed[1], limits.acceleration[1]
            )
            if self.change_over < least:
                raise ValidationError(
                    f"change_over is {self.change_over:g} s, and the move to the start of motion "
                    f"{i} takes {least:.3g} s within the limits of speed and acceleration; plan "
                    "with a longer change_over"
                )
            position = start

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the plan as JSON.

        Parameters
        ----------
        path : path
            Ending in ``.json``.
        overwrite : bool, default False
            Replace an existing file.

        Returns
        -------
        Path
        """
        place = place_of(path, "a plan", (".json",))
        plain = plain_data(self.to_dict(), not_finite=lambda _: None)
        write_whole(place, json.dumps(plain, indent=2).encode(), overwrite=overwrite)
        return place

    def curves(self) -> dict[str, tuple[FloatArray, FloatArray, FloatArray]]:
        """Return time, uncertainty by plans and by a logarithmic grid, for each quantity.

        The quantities are the targets, or all parameters if time was given. The grid has ten levels
        with equal cycles; uncertainties are NaN if the time is too short.
        """
        times = self.seconds * np.array(_CURVE)
        search = self.search
        planned = [self.expected if t == self.seconds else search.expected_after(t) for t in times]
        gridded = [search.expected_after(t, grid=True) for t in times]

        def after(name: str, plans: Sequence[Mapping[str, Expected]]) -> FloatArray:
            return np.array([e[name].after if e else np.nan for e in plans])

        return {
            name: (times, after(name, planned), after(name, gridded))
            for name in self.target or self.expected
        }

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot the predicted uncertainty over bench time, and that of a logarithmic grid.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Created if left out.

        Returns
        -------
        Axes
        """
        from dahl_ident.plots import plot_bench_time

        return plot_bench_time(self.curves(), dict(self.target), ax=ax)

    @property
    def _unit(self) -> str:
        return shown_unit("N" if self.controlled == "force" else "m", self.motion)

    def __str__(self) -> str:
        """Return the plan as text."""
        number, sines = len(self.steps), self.steps[0].motion is None
        head = f"{number} {'level' if sines else 'motion'}{'s' if number != 1 else ''}"
        head = f"{self.runs} runs of {head}" if self.runs > 1 else head
        end = "; meets the target" if self.reached else "; does NOT meet the target"
        if all(self.expected[name].before <= most for name, most in self.target.items()):
            end += ", which the data at hand meet already"
        rows = [
            (
                name,
                f"{e.value:.4g}" if np.isfinite(e.value) else "",
                percent(e.before, 3),
                percent(e.after, 3),
                percent(self.target[name], 3) if name in self.target else "",
            )
            for name, e in self.expected.items()
        ]
        hours = f" ({self.seconds / 3600.0:.2g} h)" * (self.seconds >= _HOURS)
        legend = "Relative standard uncertainties"
        if any(map(is_expanded, self.expected)):
            legend += "; U(...) expanded, 95.45 %"
        return "\n".join(
            [
                f"{head} in {self.seconds:.4g} s{hours}{end if self.target else ''}.",
                "",
                self._table(),
                "",
                table([("", "value", "before", "after", "wanted"), *rows]),
                f"{legend}.",
                *(f"{text}." for text in self.undetermined),
                *self._spare(),
                f"Assumed: {'; '.join(self.assumptions)}.",
            ]
        )

    def _spare(self) -> list[str]:
        """Return the gain if the remaining time is used or a limit is wider, and how to use it."""
        time = self.search.question.limits.time
        if self.reached and np.isinf(time):
            widened = {name: _widened(self.search, name) for name in self.target}
            return [
                f"The limit of {limit} costs time: if it were ten times wider, {name} would be as "
                f"certain in 1/{gain**2:.2g} of the time."
                for name, (limit, gain) in widened.items()
                if gain > _COSTLY
            ]
        if not (self.reached and self.seconds < 0.5 * time):
            return []
        with_all = self.search.expected_after(time)
        gain = ", ".join(f"{name} {percent(with_all[name].after, 3)}" for name in self.target)
        lines = [f"{time - self.seconds:.4g} s are left; the whole time would give {gain}."]
        if self.runs == 1:
            lines.append(
                f"Repeat the plan in {min(5, int(time // self.seconds))} runs, each a new "
                "mounting: only runs show the scatter between them; longer ones do not reduce it."
            )
        return lines

    def _table(self) -> str:
        """Return the steps as text, one line each."""
        rows = [_row(step) for step in self.steps]
        names = list(dict.fromkeys(name for row in rows for name in row))
        names.sort(key=lambda name: name in ("period", "repeats", "seconds"))  # these come last
        units = {**trajectories.UNITS, "level": "N" if self.controlled == "force" else "m"}
        headings = [name.removesuffix("_hz").replace("_", " ") for name in names]
        for i, name in enumerate(names):
            if name in units:
                headings[i] += f" [{shown_unit(units[name], self.motion)}]"
        lines = [
            [str(i), *(_as_text(row.get(name, "-")) for name in names)]
            for i, row in enumerate(rows, start=1)
        ]
        return table([["", *headings], *lines])


def _as_text(value: float | str) -> str:
    """Return a number with four digits; a count or a word as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _row(step: PlanStep) -> dict[str, Any]:
    """Return the fields of a step; for a motion, its kind and parameters."""
    fields = dict(vars(step))
    motion = fields.pop("motion")
    if motion is None:
        return fields
    return {
        "motion": motion.kind,
        **motion.parameters,
        "period": motion.period,
        "repeats": step.measured_cycles,
        "seconds": step.seconds,
    }


def candidates_within(
    question: PlanRequest,
    limits: BenchLimits,
    count: int = _FEW_LEVELS,
    lasting: float | None = None,
) -> Candidates:
    """Return the candidates within limits; motions are repeated for `lasting` s."""
    if question.recorded is None:
        return evaluate(question, limits, *grid(question, limits, count))
    motions: Sequence[PlannedMotion] | str = question.motions
    if isinstance(motions, str):
        motions = motions_of(motions, limits, level_range(question, limits))
    return evaluate_motions(question.knowledge, motions, limits, question.recorded, lasting)


def undetermined(
    search: Search, design: Design, expected: Mapping[str, Expected]
) -> tuple[str, ...]:
    """Return a sentence for each quantity that misses its target, with the limit that matters."""
    q = search.question
    missed = {
        name: f"{name} stays undetermined (standard uncertainty {_shown(e.after)})"
        for name, e in expected.items()
        if name not in (*q.target, *q.knowledge.assumed) and not e.after < _UNDETERMINED
    }
    for name, u in q.target.items() if q.has_numbers else ():
        if expected[name].after > 1.001 * u:
            what = "" if is_expanded(name) else "a standard uncertainty of "
            missed[name] = f"{name} reaches {what}{_shown(expected[name].after)}, not {_shown(u)}"
    if q.suspects and search.suspect_ratio(design) > 1.0:
        names = ", ".join(q.suspects)
        missed.setdefault(names, f"the uncertainty of {names} does not meet its target")
    sentences = [f"{text}; {_prevented_by(search, name)}" for name, text in missed.items()]
    if not search.can_be_judged(design):
        sentences.append(
            "these levels are too few to tell a wrong model from noise, so that a fit to them "
            "alone cannot be used; give more time"
        )
    return tuple(sentences)


def _widened(search: Search, name: str) -> tuple[str, float]:
    """Return the limit that, ten times wider, would reduce an uncertainty most, and how far."""
    q, widened = search.question, {"": np.inf}
    base = _least_uncertainty(q, name, q.limits)
    for limit in q.limits.stated:
        low, high = getattr(q.limits, limit)
        wider: dict[str, Any] = {limit: (low / _WIDER, high * _WIDER)}
        with suppress(ValidationError):
            widened[limit] = _least_uncertainty(q, name, replace(q.limits, **wider))
    if np.isfinite(q.limits.time):
        widened["time"] = base / np.sqrt(_WIDER)
    best = min(widened, key=widened.__getitem__)
    return best.removesuffix("_hz"), base / widened[best]


def _prevented_by(search: Search, name: str) -> str:
    """Return the limit that prevents a smaller uncertainty."""
    if name not in search.forecast.directions:
        return "give more time or wider limits"
    limit, gain = _widened(search, name)
    if not limit:
        return "no limit was stated that prevents it"
    if not gain > 1.25:
        if search.forecast.model_error == "estimated":
            return "no limit alone prevents it: use a model that describes the data better"
        return "no limit alone prevents it: reduce the noise, or fix a parameter"
    return (
        f"the limit of {limit} prevents it: ten times wider, it would be {gain:.2g} times smaller"
    )


def _least_uncertainty(question: PlanRequest, name: str, limits: BenchLimits) -> float:
    """Return the uncertainty of a quantity with the best continuous design."""
    candidates = candidates_within(question, limits)
    few = Forecast.of(question, candidates).thinned()
    term = few.term({name: 1.0}, few.before + NOTHING * np.eye(few.before.shape[-1]))
    time = limits.time if np.isfinite(limits.time) else 1000.0
    frequency_hz = candidates.frequency_hz
    design = continuous_design(Objective((term,)), frequency_hz, time, tolerance=0.1)
    return float(np.exp(-0.5 * design.value))


def assumptions_of(search: Search, design: Design) -> tuple[str, ...]:
    """Return the assumptions of the prediction."""
    q, known = search.question, search.question.knowledge
    force, length = (si_unit(kind, known.motion) for kind in ("force", "displacement"))
    texts = []
    differing = [f"{percent(q.scatter, 3)} of gain and phase"] if q.scatter else []
    if known.between is not None:
        sizes = (np.sqrt(known.between) / known.units).tolist()
        named = zip(known.names, sizes, strict=True)
        differing += [f"{percent(size, 3)} of {name}" for name, size in named if size]
    if q.recorded is not None:
        texts.append(
            f"white noise of {q.recorded.noise:.3g} {force} in each sample of force, "
            f"{q.recorded.sample_rate:g} samples a second; a record of each motion is fitted "
            "with its initial state, offset and drift"
        )
        texts += [f"{name} within the range that a fit assumes" for name in known.assumed]
    else:
        noise = f"noise of one cycle: {percent(q.noise.relative, 3)} of the response"
        if q.noise.force:
            noise += f", {q.noise.force:.3g} {force}"
        if q.noise.displacement:
            noise += f", {q.noise.displacement:.3g} {length}"
        texts.append(noise)
        if known.row_noise is not None and known.row_cycles == 1.0:
            texts.append("a row of the earlier data counts as one cycle")
        texts.append(
            f"scatter between runs: {listed(differing)}" if differing else "no scatter between runs"
        )
        if known.assumed:
            texts.append(
                f"{', '.join(known.assumed)} within the range that a fit assumes (fix it in the "
                "model to plan without)"
            )
    texts += [_MODEL_ERROR[search.forecast.model_error], "calibrations are exact"]
    if design.seconds > _NEARLY_ALL * LONGEST and not np.isfinite(q.limits.time):
        texts.append("no plan takes more than 30 days unless a time is given")
    return tuple(texts)


def _shown(u: float) -> str:
    """Return a relative uncertainty in percent."""
    return percent(u, 3) if np.isfinite(u) else "without bound"

"""Records of any motion: residuals sample by sample, with exact derivatives.

There are two kinds. If the output is the force, it is the sum of the elements' forces at the
measured displacement. If the output is the motion, the measured force or base motion drives the
plant's equation of motion. Every record adds unknowns: the state at its first sample, an offset
and, for forces, a drift.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.record import cut
from dahl_ident.elements import Friction, Model, Parameter
from dahl_ident.elements.facts import Path
from dahl_ident.errors import DataError, FitError
from dahl_ident.noise import Rho
from dahl_ident.problem.base import Quadratic
from dahl_ident.problem.record_waves import SHORTEST, RecordWaves, bends, endings
from dahl_ident.problem.space import Interchangeable, Space
from dahl_ident.problem.table_problem import TableProblem

_SAMPLES_PER_CYCLE = 100.0  # of a record that is thinned
_DELAY_STEP = 0.02  # step of the delay, in samples, for difference quotients
_TINY = 1e-300  # replaces a positive value that is zero, which has no logarithm
_VANISHED = 1e4  # gradient over curvature of a value that has vanished: its steps never end


@dataclass(frozen=True)
class Predicted:
    """The predicted samples of a record, with derivatives."""

    output: FloatArray
    by: FloatArray
    """Derivatives with respect to the problem's values, (n, P); P = 0 if they are not wanted."""
    by_delay: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Derivative of a motion with respect to the delay."""


class RecordProblem(RecordWaves):
    """Records of one device and a model: residuals, Jacobian and cost.

    Residuals are measured minus predicted samples over the standard deviation of the output, so
    their scale is unknown. Either each record is a run, or all records are levels of one run. If
    the model integrates, differentiates or has memory, a record is cut at its gaps into parts, each
    with a first state of its own; if it integrates or differentiates, unevenly sampled parts are
    resampled. Both are warned about. The predicted `output` is by default "motion" if the model has
    inertia, otherwise "force". For the output "motion", `excitation` says what the force channel of
    the records is: a force, or the acceleration of the base, m/s^2, to which the motion is
    relative.

    Examples
    --------
    >>> from dahl_ident import Dahl
    >>> x = np.sin(np.arange(40.0))
    >>> force = Dahl(1.0, 3.0).force(x)
    >>> problem = RecordProblem([Record(np.arange(40.0), displacement=x, force=force)], Dahl())
    >>> problem.names
    ('f_max', 'sigma', 'initial_force', 'offset', 'drift')
    """

    arguments = ("records", "model", "output", "excitation", "calibration")
    residuals_per_row, scaled_priors = 1, True
    kind, kind_in_words = "records", "records"
    refused_options: ClassVar[Mapping[str, str]] = {
        "noise": "their noise is estimated from the residuals",
        "steady": "any motion is predicted, sample by sample",
        "drive_std": "noise of the drive is estimated from the record, and counted",
        "drive_covariance": "noise of the drive is estimated from the record, and counted",
        "likelihood": "their posterior has Gaussian noise; against outliers, use the confidence "
        "intervals of a fit with a robust loss",
        "pool": "their posterior needs no predictions",
    }
    around_optimum = True
    n_simulations = 199  # each needs a search of its own; enough for the 95.45 % interval

    @property
    def noise(self) -> str:
        """The model of the residuals: "white", or with a "spectrum", which filters them."""
        return "spectrum" if self.whitening.size > 1 else "white"

    def for_table(self, table: FrequencyResponse) -> TableProblem:
        """Return the problem of the same model for a table."""
        return TableProblem(table, self.model, noise="absolute")

    def shortened(self, samples: int) -> RecordProblem:
        """Return the problem with about `samples` samples in all.

        Measured displacements are thinned as far as slow cycles allow; records that are still too
        long are cut to the part with the largest mean square.
        """
        parts = []
        reduction = self.n_residuals / samples
        for record, y in zip(self.records, self.measured, strict=True):
            step = 1
            if self.output == "force":
                x = np.asarray(record.displacement)
                per_cycle = 2.0 * np.pi * np.std(x) / (np.std(np.diff(x)) or 1.0)
                step = int(np.clip(per_cycle / _SAMPLES_PER_CYCLE, 1.0, np.ceil(reduction)))
            n = max(SHORTEST, int(samples * len(record) // self.n_residuals))
            thinned, wave = cut(record, slice(None, None, step)), y[::step]
            energy = np.concatenate([[0.0], np.cumsum((wave - wave.mean()) ** 2)])
            start = int(np.argmax(energy[n:] - energy[:-n])) if n < wave.size else 0
            parts.append(cut(thinned, slice(start, start + n)))
        return self.like(records=parts)

    def for_records(self, records: Sequence[Record]) -> RecordProblem:
        """Return the problem of other records, with this one's corrections for delay and noise."""
        others = self.like(records=records).smoothed(on=self.is_smoothed).delayed(self.delay)
        return others.without_noise(self.displacement_noise)

    def with_whitening(self, whitening: FloatArray) -> RecordProblem:
        """Return the same problem with filtered residuals."""
        return self.altered(whitening=whitening)

    def with_fixed(self, values: Mapping[str, float]) -> RecordProblem:
        """Return the same problem with other values of fixed parameters."""
        model = self.model.with_values(values)  # equations are shorter where a value is 0 or 1
        return self.altered("system", "coefficients", "first", "latest", model=model)

    def delay_slopes(self, values: FloatArray) -> list[FloatArray]:
        """Return the derivatives of each record's output with respect to the delay, per s."""
        if self.output == "motion":
            return [self.predict(values, i).by_delay for i in range(len(self.records))]
        step = _DELAY_STEP / self.records[0].sample_rate
        low, high = (self.delayed(self.delay + d).outputs(values) for d in (-step, step))
        return [(b - a) / (2.0 * step) for a, b in zip(low, high, strict=True)]

    @property
    def exponents(self) -> list[Parameter]:
        """The fixed exponents of the model, stated or assumed."""
        fixed = [p for p in self.model.parameters if p.prior is not None and not p.free]
        return [p for p in fixed if p.positive]

    def freed(self, names: Iterable[str], noise: float | None = None) -> RecordProblem:
        """Return the same problem with some exponents free.

        If the `noise` of the residuals is given, the exponents' ranges are priors, and bounds.
        """
        freed = {p.name: p.freed() for p in self.exponents if p.name in names}
        ranges = {}
        if noise is not None:
            for name, p in freed.items():
                value, (low, high) = float(p.value or 1.0), p.prior or (1.0, 1.0)
                low, high = min(low, value), max(high, value)
                ranges[name] = np.log(value), np.log(high / low) / 12.0**0.5 / noise
        return self._with_free(self.model.with_parameters(freed), ranges)

    def values_in(self, other: RecordProblem, values: FloatArray) -> FloatArray:
        """Return the values of a problem with other free parameters, which have their values here.

        `values` are those of this problem.
        """
        known = {p.name: p.value for p in self.model.parameters}
        known |= dict(zip(self.names, values.tolist(), strict=True))
        return np.array([known[name] for name in other.names], dtype=np.float64)

    def in_order(self, theta: ArrayLike) -> FloatArray:
        """Return theta with interchangeable elements in order of their knees, as for tables."""
        alike = Interchangeable(self.model, self.names, endings(self.records))
        return alike.in_order(self.space.checked(theta), self.space)

    def held(self, values: Mapping[str, float]) -> RecordProblem:
        """Return the same problem with free parameters assumed to have some values."""
        parameters = {p.name: p for p in self.model.parameters}
        fixed = {n: replace(parameters[n].fixed(v), assumed=True) for n, v in values.items()}
        return self._with_free(self.model.with_parameters(fixed), {})

    def _with_free(self, model: Model, ranges: dict[str, tuple[float, float]]) -> RecordProblem:
        """Return the same problem with other free parameters in the model."""
        free = [p for p in model.parameters if p.free]
        parameters = (*free, *self.parameters[self.n_reported :])
        inside = np.array([p.name not in ranges for p in parameters])
        space = Space(parameters, bends(free, len(parameters), self.records), inside=inside)
        stale = ("system", "coefficients", "first")
        changes = {"free": free, "space": space, "ranges": ranges, "latest": dict(self.latest)}
        return self.altered(*stale, model=model, **changes)

    def filtered(self, waves: FloatArray) -> FloatArray:
        """Return residuals or derivatives, (n, ...), filtered; the filter's start is left out."""
        if self.whitening.size == 1:
            return waves
        from scipy.signal import lfilter

        return np.asarray(lfilter(self.whitening, [1.0], waves, axis=0)[self.whitening.size - 1 :])

    @property
    def n_residuals(self) -> int:  # type: ignore[override]
        """Number of residuals: of all samples except those with which the filter begins."""
        return self.n_samples - len(self.records) * (self.whitening.size - 1)

    n_nonzero = n_residuals

    def to_search(self, values: ArrayLike) -> FloatArray:
        """Return search coordinates; positive values that have vanished count as tiny."""
        array = np.asarray(values, dtype=np.float64)
        return self.space.to_search(np.where(self.space.positive & (array == 0.0), _TINY, array))

    def step_bounds(self, values: FloatArray, *, of_starts: bool) -> tuple[FloatArray, FloatArray]:
        """Return the limits of the search coordinates.

        Exponents with a prior stay within their ranges. Loads of several springs at the first
        sample stay below slip, and with `of_starts` other friction stays below full slip there.
        """
        low, high = np.full((2, values.size), np.inf) * [[-1.0], [1.0]]
        for name, (mean, _) in self.ranges.items():
            i = self.names.index(name)
            span = [mean, *np.log(self.parameters[i].prior or (1.0, 1.0))]
            low[i], high[i] = min(span), max(span)
        pairs = zip(self.model.parameters, self.full_values(values), strict=True)
        by_name = {p.name: np.asarray(value) for p, value in pairs}
        for element in self.with_memory:
            if element.one_state and not of_starts:
                continue
            bounds = element.start_bounds([by_name[p.name] for p in element.parameters])
            prefix = f"{element.name}_" if element.name else ""
            for start, *_ in element.starts:
                for i, name in enumerate(self.names):
                    if name == f"{prefix}{start}" or name.startswith(f"{prefix}{start}_"):
                        low[i], high[i] = bounds
        return low, high

    def predict(self, values: FloatArray, number: int, *, derivatives: bool = True) -> Predicted:
        """Return the predicted samples of record `number`."""
        predict = _force_of if self.output == "force" else _motion_of
        names = self.names if derivatives else ()
        key = np.append(self.full_values(values), self.record_values(values, number)).tobytes()
        latest = self.latest.get(number)
        if latest is None or latest[0] != key or not set(names) <= set(latest[1]):
            latest = key, names, predict(self, values, number, derivatives=derivatives)
            self.latest[number] = latest
        _, columns, prediction = latest
        if not names or names == columns:
            return prediction
        return replace(prediction, by=prediction.by[:, [columns.index(name) for name in names]])

    @cached_property
    def latest(self) -> dict[int, tuple[bytes, tuple[str, ...], Predicted]]:
        """The last prediction of each record, with its values and the names of its derivatives.

        Problems with other free parameters use it as well.
        """
        return {}

    def outputs(self, values: FloatArray) -> list[FloatArray]:
        """Return the predicted output of each record."""
        numbers = range(len(self.records))
        return [self.predict(values, i, derivatives=False).output for i in numbers]

    def fitted(self, theta: FloatArray) -> tuple[FloatArray, ...]:
        """Return the predicted output of each record."""
        return tuple(self.outputs(self.to_values(theta)))

    def split_residuals(self, values: FloatArray) -> list[FloatArray]:
        """Return measured minus predicted output of each record."""
        return [y - p for y, p in zip(self.measured, self.outputs(values), strict=True)]

    def quadratic(
        self,
        theta: FloatArray,
        scale: ArrayLike = 1.0,
        rho: Rho | None = None,
        chart: FloatArray | None = None,
    ) -> Quadratic:
        """Return cost, gradient and Hessian, see ``Problem``; vanished values are held fixed."""
        if theta.ndim == 2:
            parts = [self.quadratic(row, scale, rho, chart) for row in theta]
            return Quadratic(*(np.stack(column) for column in zip(*parts, strict=True)))
        cost, gradient, hessian = super().quadratic(theta, scale, rho)
        if not (np.isfinite(cost) and np.isfinite(hessian).all()):  # the motion is unbounded
            return Quadratic(np.asarray(np.inf), np.zeros(theta.size), np.eye(theta.size))
        threshold = _VANISHED * hessian.diagonal()
        vanished = self.space.positive & (gradient >= threshold)
        vanished |= self.space.angular & (np.abs(gradient) >= threshold)
        gradient[vanished], hessian[vanished], hessian[:, vanished] = 0.0, 0.0, 0.0
        hessian[vanished, vanished] = 1.0
        if chart is not None:
            gradient, hessian = chart.T @ gradient, chart.T @ hessian @ chart
        return Quadratic(cost, gradient, hessian)

    def data_rows(
        self, theta: FloatArray, *, derivatives: bool = True, tails: bool = True
    ) -> FloatArray:
        """Return the filtered residuals of all samples and their derivatives, see ``Problem``."""
        if theta.ndim == 2:
            return np.stack([self.data_rows(row, derivatives=derivatives) for row in theta])
        values = self.space.to_values(theta)
        waves = []
        no_rows = np.full((1 + derivatives * theta.size, self.n_residuals), np.nan)
        if not np.isfinite(values).all() or (self.space.positive & (values == 0.0)).any():
            return no_rows  # a positive value that has underflown
        for number, measured in enumerate(self.measured):
            try:
                predicted = self.predict(values, number, derivatives=derivatives)
            except FitError:
                return no_rows
            wave = (measured - predicted.output)[:, None] / self.output_std
            if derivatives:
                slopes = predicted.by * (self.space.slopes(values) / -self.output_std)
                wave = np.concatenate([wave, slopes], axis=1)
            waves.append(self.filtered(wave))
        return np.concatenate(waves).T

    @property
    def rounding(self) -> FloatArray:
        """Size of residuals that may be pure rounding errors."""
        return np.asarray(self.accuracy)

    @property
    def log_area(self) -> float:
        """Return ln of the volume of a unit cube of residuals, in the units of the output."""
        return -self.n_residuals * float(np.log(self.output_std))

    @cached_property
    def output_std(self) -> float:
        """Standard deviation of all records' output, the unit of the residuals."""
        std = float(np.std(np.concatenate([y - y.mean() for y in self.measured])))
        if std == 0.0:
            raise DataError("the output of the records is constant; nothing can be fitted to it")
        return std


def _force_of(
    problem: RecordWaves, values: FloatArray, number: int, *, derivatives: bool
) -> Predicted:
    """Return the force of a measured displacement at the samples of record `number`."""
    x, v, a = problem.motions[number]
    path = x if problem.paths is None else problem.paths[number]
    record = problem.records[number]
    of_record = problem.record_values(values, number)
    time = record.time - record.time[0]
    offset, drift = of_record[-2:].tolist()
    total = offset + drift * time
    by = np.zeros((x.size, len(problem.parameters) if derivatives else 0))
    start, column = 0, 0
    first = len(problem.free) + number * problem.per_record
    for element, at in problem.model.of(problem.full_values(values)):
        stop = start + (len(element.starts) if element.has_memory else element.n_states)
        states, moved = of_record[start:stop], x
        state: Any = 0.0  # an array for elements of several unknowns
        if isinstance(element, Friction):
            state, moved = states if states.size > 1 else float(states[0]), path
        history = element.history(at, Path(moved, v, a, time), state, slopes=derivatives)
        total = total + history.value
        if derivatives:
            for parameter, slope in zip(element.parameters, history.by_parameter, strict=True):
                if parameter.free:
                    by[:, column] = slope
                    column += 1
            if element.has_memory:
                by[:, first + start : first + stop] = history.by_state.reshape(x.size, -1)
        if element.n_states and not element.has_memory:
            free = element.free_responses(time)
            total = total + free @ states
            if derivatives:
                by[:, first + start : first + stop] = free
        start = stop
    if derivatives:
        by[:, first + start] = 1.0
        by[:, first + start + 1] = time
    return Predicted(total, by)


def _motion_of(
    problem: RecordWaves, values: FloatArray, number: int, *, derivatives: bool
) -> Predicted:
    """Return the motion of a driven plant at the samples of record `number`."""
    from dahl_ident.engine import march

    of_record, free = problem.record_values(values, number), values[: len(problem.free)]
    starts = of_record.size - 1
    at, slopes = (part[0] for part in problem.coefficients(np.array([problem.full_values(values)])))
    slopes = slopes[:, [p.free for p in problem.model.parameters]]
    chosen = np.flatnonzero(slopes.any(axis=1)).tolist()
    first, by_start, by_value = problem.first(of_record[:starts], at)
    time, drive = problem.drives[number]
    motion = march(
        problem.system, time, drive, time, first, at, chosen=chosen, derivatives=derivatives
    )
    by = np.zeros((motion.output.size, len(problem.parameters) if derivatives else 0))
    if derivatives:
        column = free.size + number * problem.per_record
        by_number = motion.by_parameter + motion.by_first @ by_value[:, chosen]
        by[:, : free.size] = by_number @ slopes[chosen]
        by[:, column : column + starts] = motion.by_first @ by_start
        by[:, column + starts] = 1.0
    return Predicted(motion.output + of_record[starts], by, motion.by_delay)

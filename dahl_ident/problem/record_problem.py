"""Records of any motion: residuals sample by sample, with exact derivatives.

Two kinds. Where the force is the output, the measured displacement goes into the elements, and
their forces are added. Where the motion is the output, the measured force or base motion drives the
plant's equation of motion. Every record adds unknowns: the state at its first sample, an offset
and, for forces, a drift.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from dahl_ident.arrays import FloatArray
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.record import at_even_times, cut, unbroken
from dahl_ident.data.rows import one_run
from dahl_ident.elements import Element, Friction, Model, Parameter
from dahl_ident.elements.coefficients import Coefficients
from dahl_ident.elements.equations import FirstState, plant_equations
from dahl_ident.elements.model import as_model
from dahl_ident.errors import DataError, FitError, ModelError, ValidationError
from dahl_ident.noise import Rho
from dahl_ident.problem.base import Problem, Quadratic
from dahl_ident.problem.record_noise import LEADS, in_band, noise_of, travelled
from dahl_ident.problem.record_prediction import Predicted, bends, force_of, motion_of, nuisance
from dahl_ident.problem.space import Space
from dahl_ident.problem.table_problem import TableProblem

if TYPE_CHECKING:
    from dahl_ident.elements.equations import Excitation
    from dahl_ident.engine import System

Output = Literal["force", "motion"]
_SHORTEST = 16  # fewest samples from which noise is estimated
_PER_CYCLE = 100.0  # samples of a cycle that a record keeps where it is thinned
_DELAY_STEP = 0.02  # step of the delay, in samples, for differences
_LEAST = 1e-300  # stands for a positive value that is zero, which has no logarithm
_VANISHED = 1e4  # gradient over curvature from which a value has vanished: its steps never end


class RecordProblem(Problem):
    """Records of one device and a model: residuals, Jacobian and cost.

    Residuals are measured minus predicted samples over the standard deviation of the output, so
    that their scale is unknown. Each record is a run, or each a level of one run. Where the model
    integrates, differentiates or has memory, a record is cut at its gaps into parts with a first
    state each; where anything is integrated or differentiated, unevenly sampled parts are
    resampled. Both with a warning. The `output` that is predicted is by default "motion" where the
    model has inertia, else "force". For the output "motion" the records' force channel is, by
    `excitation`, a force, or the acceleration of the base, m/s^2, the motion being relative to it.

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
    parts, scaled_priors = 1, True
    kind, called = "records", "records"
    refused: ClassVar[Mapping[str, str]] = {
        "noise": "their noise is estimated from the residuals",
        "steady": "any motion is predicted, sample by sample",
        "drive_std": "noise of the drive is estimated from the record, and counted",
        "drive_covariance": "noise of the drive is estimated from the record, and counted",
        "likelihood": "their posterior is that around the fit; fit with a robust loss",
        "pool": "their posterior needs no predictions",
    }
    around_optimum = True
    repetitions = 199  # each of which is searched alone: enough for the 95.45 % interval

    def __init__(
        self,
        records: Sequence[Record],
        model: Element,
        *,
        output: Output | None = None,
        excitation: Excitation = "force",
        calibration: Mapping[str, float] | None = None,
    ) -> None:
        self.calibration = dict(calibration or {})
        self.records = tuple(records)
        if not self.records:
            raise DataError("there is no record; give one or more")
        for record in self.records:
            if not isinstance(record, Record):
                raise ValidationError(
                    f"data holds a {type(record).__name__}; expected a FrequencyResponse, a Record "
                    "or several records (read_frequency_response and read_record read files, "
                    "FrequencyResponse.concatenate joins tables)"
                )
        self.model = as_model(model)
        self.excitation = excitation
        self.output: Output = output or ("motion" if self.model.has_inertia else "force")
        if self.output not in ("force", "motion"):
            raise ValidationError(f"output is {output!r}; expected force or motion")
        if self.output == "force" and not self.coefficients.are_values:
            raise ModelError(
                "a linear system with free parameters moves with a plant, but has no force over "
                "time: fix it, fit the motion, or build it from Mass, Damper and Spring"
            )
        self.free = [p for p in self.model.parameters if p.free]
        if not self.free:
            raise ModelError(f"nothing is free in {self.model!r}; leave a parameter out")
        self.with_memory = [e for e in self.model.elements if isinstance(e, Friction)]
        if len({record.motion for record in self.records}) > 1:
            raise DataError("some records are of translation and some of rotation; fit them apart")
        integrated = self.output == "motion" or not self.model.rate_independent
        runs = [0] * len(self.records) if one_run(self.records) else range(len(self.records))
        self.runs: tuple[int, ...] = tuple(runs)
        """The run of each record; sweeps of one level each, all different, are one run."""
        if integrated or self.with_memory:
            parts = [unbroken(record, _SHORTEST) for record in self.records]
            self.runs = tuple(i for i, some in zip(runs, parts, strict=True) for _ in some)
            self.records = tuple(record for some in parts for record in some)
        if integrated:
            self.records = tuple(at_even_times(record) for record in self.records)
        for number, record in enumerate(self.records, 1):
            self._check(record, f"record {number}" if len(self.records) > 1 else "the record")
        self.motion = self.records[0].motion
        self._check_scale()
        parameters = (*self.free, *nuisance(self.model, self.records, self.output))
        self.space = Space(parameters, bends(self.free, len(parameters), self.records), inside=True)
        self.whitening = np.ones(1)
        """Filter of the residuals; see :func:`~.record_noise.prediction_error_filter`."""
        self.delay = 0.0
        """Time by which the motion lags the force in the records, s; taken out."""
        self.window = 1.0
        """Factor on the window in which displacements are differentiated."""
        self.displacement_noise = 0.0
        """Standard deviation of the displacement, m, within which no movement counts."""
        self.paths: tuple[FloatArray, ...] | None = None

    def _check(self, record: Record, which: str) -> None:
        if len(record) < _SHORTEST:
            raise DataError(f"{which} has {len(record)} samples; expected at least {_SHORTEST}")
        if self.output == "force" and record.displacement is None:
            raise DataError(
                f"{which} has {record.motion_channel} but no displacement, from which the force "
                "would follow; integrate it, or add Mass() to fit the motion"
            )
        if self.output == "motion":
            _ = record.force_samples

    def _check_scale(self) -> None:
        """Refuse a motion that masses and forces, all of them larger, would explain as well."""
        elements = self.model.elements
        if (
            self.output == "force"
            or any((not p.free and p.value and p.dimension[0]) for p in self.model.parameters)
            or not all(any(p.free for p in e.parameters) for e in elements)
        ):
            return
        if self.excitation == "base" or not any(r.force_samples.any() for r in self.records):
            why = "the base moves" if self.excitation == "base" else "the force is zero"
            raise DataError(
                f"{why}, so that the motion determines only the ratios of masses, forces, dampers "
                "and springs; give one of them, such as the mass: Mass(1.0), --mass 1.0"
            )

    @property
    def data(self) -> tuple[Record, ...]:
        """The records."""
        return self.records

    @property
    def noise(self) -> str:
        """The model of the residuals: "white", or filtered by their "spectrum"."""
        return "spectrum" if self.whitening.size > 1 else "white"

    def at(self, table: FrequencyResponse) -> TableProblem:
        """Return what the model predicts for a table."""
        return TableProblem(table, self.model, noise="absolute")

    def shortened(self, samples: int) -> RecordProblem:
        """Return the problem with about `samples` samples in all.

        Measured displacements are thinned as far as slow cycles allow; records still too long are
        cut to their liveliest part.
        """
        parts = []
        spare = self.n_residuals / samples
        for record, y in zip(self.records, self.measured, strict=True):
            step = 1
            if self.output == "force":
                x = np.asarray(record.displacement)
                per_cycle = 2.0 * np.pi * np.std(x) / (np.std(np.diff(x)) or 1.0)
                step = int(np.clip(per_cycle / _PER_CYCLE, 1.0, np.ceil(spare)))
            n = max(_SHORTEST, int(samples * len(record) // self.n_residuals))
            thin, wave = cut(record, slice(None, None, step)), y[::step]
            energy = np.concatenate([[0.0], np.cumsum((wave - wave.mean()) ** 2)])
            start = int(np.argmax(energy[n:] - energy[:-n])) if n < wave.size else 0
            parts.append(cut(thin, slice(start, start + n)))
        return self.like(records=parts)

    def of(self, records: Sequence[Record]) -> RecordProblem:
        """Return the problem of other records, freed of this one's delay and noise."""
        return self.like(records=records).delayed(self.delay).without_noise(self.displacement_noise)

    def weighted(self, whitening: FloatArray) -> RecordProblem:
        """Return the same problem with filtered residuals."""
        return self.altered(whitening=whitening)

    def with_fixed(self, values: Mapping[str, float]) -> RecordProblem:
        """Return the same problem with other values of parameters that are fixed."""
        model = self.model.with_values(values)  # equations are shorter where a value is 0 or 1
        return self.altered("system", "coefficients", "first", "latest", model=model)

    def without_noise(self, noise: float, lead: float = LEADS[1]) -> RecordProblem:
        """Return the same problem, the displacement's noise not counted as travel.

        For the output "force"; see :func:`~.record_noise.travelled`.
        """
        x = self._displacements if noise else []
        paths = tuple(travelled(wave, noise, lead) for wave in x) or None
        return self.altered("latest", displacement_noise=noise, paths=paths)

    def delayed(self, delay: float) -> RecordProblem:
        """Return the same problem, the motion taken to lag the force by so many seconds."""
        delayed = self.altered("motions", "drives", "latest", delay=delay)
        return delayed.without_noise(self.displacement_noise)

    def delay_slopes(self, values: FloatArray) -> list[FloatArray]:
        """Return the derivatives of each record's output with respect to the delay, per s."""
        if self.output == "motion":
            return [self.predict(values, i).by_delay for i in range(len(self.records))]
        step = _DELAY_STEP / self.records[0].sample_rate
        low, high = (self.delayed(self.delay + d).outputs(values) for d in (-step, step))
        return [(b - a) / (2.0 * step) for a, b in zip(low, high, strict=True)]

    @property
    def exponents(self) -> list[Parameter]:
        """The exponents that the model holds, stated or not."""
        known = [p for p in self.model.parameters if p.prior is not None and not p.free]
        return [p for p in known if p.positive]

    def freed(self, names: Iterable[str], noise: float | None = None) -> RecordProblem:
        """Return the same problem with some exponents free.

        With the `noise` of the residuals their ranges are priors, and bounds.
        """
        chosen = {p.name: p.freed() for p in self.exponents if p.name in names}
        ranges = {}
        if noise is not None:
            for name, p in chosen.items():
                usual, (low, high) = float(p.value or 1.0), p.prior or (1.0, 1.0)
                low, high = min(low, usual), max(high, usual)
                ranges[name] = np.log(usual), np.log(high / low) / 12.0**0.5 / noise
        return self._of_model(self.model.with_parameters(chosen), ranges)

    def held(self, values: Mapping[str, float]) -> RecordProblem:
        """Return the same problem with free parameters held, as assumed ones, at some values."""
        known = {p.name: p for p in self.model.parameters}
        fixed = {n: replace(known[n].fixed(v), assumed=True) for n, v in values.items()}
        return self._of_model(self.model.with_parameters(fixed), {})

    def _of_model(self, model: Model, ranges: dict[str, tuple[float, float]]) -> RecordProblem:
        """Return the same problem with other parameters of the model free."""
        free = [p for p in model.parameters if p.free]
        parameters = (*free, *self.parameters[self.n_reported :])
        inside = np.array([p.name not in ranges for p in parameters])
        space = Space(parameters, bends(free, len(parameters), self.records), inside=inside)
        stale = ("system", "coefficients", "first")
        changes = {"free": free, "space": space, "ranges": ranges, "latest": dict(self.latest)}
        return self.altered(*stale, model=model, **changes)

    def differentiated_in(self, window: float) -> RecordProblem:
        """Return the same problem, displacements differentiated in a window of other length."""
        return self.altered("motions", "latest", window=window)

    @property
    def noise_travel(self) -> float:
        """Travel that the displacement's noise would add, over the travel that counts."""
        measured = [np.abs(np.diff(np.asarray(r.displacement))).sum() for r in self.records]
        counted = [np.abs(np.diff(path)).sum() for path in self.paths or ()]
        return float(sum(measured) / sum(counted) - 1.0) if counted else 0.0

    def filtered(self, waves: FloatArray) -> FloatArray:
        """Return residuals or derivatives, (n, ...), filtered; the first `order` are left out."""
        if self.whitening.size == 1:
            return waves
        from scipy.signal import lfilter

        return np.asarray(lfilter(self.whitening, [1.0], waves, axis=0)[self.whitening.size - 1 :])

    @property
    def per_record(self) -> int:
        """Unknowns that each record adds."""
        return (len(self.parameters) - len(self.free)) // len(self.records)

    @property
    def n_reported(self) -> int:
        """The number of the model's parameters; states, offsets and drifts follow."""
        return len(self.free)

    @property
    def calibrations(self) -> Mapping[str, float]:
        """Standard uncertainties of gains and delay of the channels, by the sensors' names."""
        return self.calibration

    @property
    def every_parameter(self) -> tuple[Parameter, ...]:
        """The model's parameters, fixed ones included, and what each record adds."""
        return (*self.model.parameters, *self.parameters[self.n_reported :])

    def unit_sizes(self, dimension: tuple[int, int, int]) -> FloatArray:
        """Return the size of a unit in each record, by powers of force, displacement and time."""
        sizes = []
        for record, y in zip(self.records, self.measured, strict=True):
            if self.output == "force":
                x = np.asarray(record.displacement)
                v = np.gradient(x, record.time)
            else:
                x, v, _ = in_band(record, y)
            push, time = record.force_samples, np.std(x) / np.std(v)
            force = np.std(push if push.any() else v / time)  # a free decay: of unit mass
            sizes.append(np.prod(np.power([force, np.std(x), time], dimension)))
        return np.array(sizes)

    @property
    def extent(self) -> str:
        """The amount of data, in words."""
        n = len(self.records)
        return f"{n} record{'s' if n > 1 else ''}, {self.n_samples} samples"

    @property
    def output_in_words(self) -> str:
        """The output of which a misfit is a share."""
        return f"the {self.output}"

    @property
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where each record comes from."""
        return tuple(record.provenance for record in self.records)

    @property
    def level(self) -> float:
        """Size of the input of all records: of the displacement, or of the drive."""
        force = self.output == "force"
        waves = [np.asarray(r.displacement if force else r.force_samples) for r in self.records]
        return float(np.sqrt(np.mean(np.concatenate([w - w.mean() for w in waves]) ** 2)))

    @property
    def n_samples(self) -> int:
        """Samples of all records."""
        return sum(len(record) for record in self.records)

    @property
    def n_residuals(self) -> int:  # type: ignore[override]
        """Number of residuals: all samples except those with which the filter begins."""
        return self.n_samples - len(self.records) * (self.whitening.size - 1)

    n_numbers = n_residuals

    @cached_property
    def measured(self) -> tuple[FloatArray, ...]:
        """The output of each record."""
        if self.output == "force":
            return tuple(record.force_samples for record in self.records)
        return tuple(record.motion_samples for record in self.records)

    @cached_property
    def motions(self) -> tuple[tuple[FloatArray, FloatArray, FloatArray], ...]:
        """Displacement, velocity and acceleration of each record, for the output "force"."""
        return self._motions_of(self._displacements)

    @property
    def _displacements(self) -> list[FloatArray]:
        """Measured displacements, freed of the delay."""
        x = [np.asarray(record.displacement) for record in self.records]
        if not self.delay:
            return x
        from scipy.interpolate import CubicSpline

        times = [record.time for record in self.records]
        return [
            np.asarray(CubicSpline(t, wave)(t + self.delay))
            for t, wave in zip(times, x, strict=True)
        ]

    def _motions_of(
        self, displacements: Sequence[FloatArray]
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], ...]:
        if all(e.rate_independent for e in self.model.elements):
            return tuple((x, np.zeros(0), np.zeros(0)) for x in displacements)
        from dahl_ident.engine import differentiated

        return tuple(
            (x, *differentiated(x, 1.0 / record.sample_rate, self.window))
            for x, record in zip(displacements, self.records, strict=True)
        )

    @cached_property
    def estimated_noise(self) -> float:
        """Standard deviation of the displacements' white noise, m; see `displacement_noise`."""
        return float(np.median([noise_of(x) for x, _, _ in self.motions]))

    def with_more_noise(self, noise: float, draw: int = 0) -> RecordProblem:
        """Return the same problem, white noise added to the displacements."""
        rng = np.random.default_rng(draw)
        noisy = [x + noise * rng.standard_normal(x.size) for x, _, _ in self.motions]
        return self.altered("latest", motions=self._motions_of(noisy))

    def with_noisier_drive(self, stds: Sequence[float], draw: int) -> RecordProblem:
        """Return the same problem, white noise added to the drive of each record."""
        rng = np.random.default_rng(draw)
        waves = [
            std * rng.standard_normal(len(record))
            for record, std in zip(self.records, stds, strict=True)
        ]
        return self.driven_more(dict(enumerate(waves)))

    def driven_more(self, waves: Mapping[int, FloatArray]) -> RecordProblem:
        """Return the same problem, waves added to the drives of the records with these numbers."""
        from dahl_ident.engine import band_limited

        drives = list(self.drives)
        for number, wave in waves.items():
            time, drive = drives[number]
            more = band_limited(wave, 1.0 / self.records[number].sample_rate)
            drives[number] = time, drive + more
        return self.altered("latest", drives=tuple(drives))

    @cached_property
    def system(self) -> System:
        """The plant's equations of motion, compiled."""
        from dahl_ident.engine import translate

        channel = self.records[0].motion_channel
        return translate(plant_equations(self.coefficients.model, self.excitation, channel))

    @cached_property
    def drives(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Times of the samples, and the drive's polynomials between them, of each record."""
        from dahl_ident.engine import band_limited

        waves = []
        for record in self.records:
            time, interval = record.time - record.time[0], 1.0 / record.sample_rate
            drive = band_limited(record.force_samples, interval)
            if self.delay:  # the motion is compared with that of a drive as much later
                place = np.arange(time.size) - self.delay / interval
                place = np.clip(place, 0.0, time.size - 1.0)
                step = np.clip(np.floor(place).astype(int), 0, time.size - 2)
                late = np.polynomial.polynomial.polyval(place - step, drive[:, step], tensor=False)
                drive = band_limited(late, interval)
            waves.append((time, drive))
        return tuple(waves)

    def to_search(self, values: ArrayLike) -> FloatArray:
        """Return search coordinates; values that have vanished are as small as numbers can be."""
        array = np.asarray(values, dtype=np.float64)
        return self.space.to_search(np.where(self.space.positive & (array == 0.0), _LEAST, array))

    def step_bounds(self, values: FloatArray, *, of_starts: bool) -> tuple[FloatArray, FloatArray]:
        """Return the limits of the search coordinates.

        Exponents with a prior stay within their ranges, loads of several springs at the first
        sample below slip, and on request other friction there below full slip at the values.
        """
        low, high = np.full((2, values.size), np.inf) * [[-1.0], [1.0]]
        for name, (usual, _) in self.ranges.items():
            i = self.names.index(name)
            span = [usual, *np.log(self.parameters[i].prior or (1.0, 1.0))]
            low[i], high[i] = min(span), max(span)
        of_model = zip(self.model.parameters, self.full_values(values), strict=True)
        by_name = {p.name: np.asarray(value) for p, value in of_model}
        for element in self.with_memory:
            if element.one_state and not of_starts:
                continue
            ends = element.start_bounds([by_name[p.name] for p in element.parameters])
            prefix = f"{element.name}_" if element.name else ""
            for start, *_ in element.starts:
                for i, known in enumerate(self.names):
                    if known == f"{prefix}{start}" or known.startswith(f"{prefix}{start}_"):
                        low[i], high[i] = ends
        return low, high

    def full_values(self, values: FloatArray) -> list[float]:
        """Return the value of every parameter of the model, fixed ones included."""
        by_name = dict(zip(self.names, values.tolist(), strict=True))
        return [float(by_name.get(p.name, p.value or 0.0)) for p in self.model.parameters]

    def own(self, values: FloatArray, number: int) -> FloatArray:
        """Return the values that belong to one record alone."""
        start = len(self.free) + number * self.per_record
        return values[start : start + self.per_record]

    def predict(self, values: FloatArray, number: int, *, derivatives: bool = True) -> Predicted:
        """Return the predicted samples of record `number`."""
        predicted = force_of if self.output == "force" else motion_of
        names = self.names if derivatives else ()
        key = np.append(self.full_values(values), self.own(values, number)).tobytes()
        known = self.latest.get(number)
        if known is None or known[0] != key or not set(names) <= set(known[1]):
            known = key, names, predicted(self, values, number, derivatives=derivatives)
            self.latest[number] = known
        _, columns, at = known
        if not names or names == columns:
            return at
        return replace(at, by=at.by[:, [columns.index(name) for name in names]])

    @cached_property
    def latest(self) -> dict[int, tuple[bytes, tuple[str, ...], Predicted]]:
        """The last prediction of each record: values, and names of the differentiated parameters.

        It is asked for more than once, also by problems in which other parameters are free.
        """
        return {}

    @cached_property
    def coefficients(self) -> Coefficients:
        """The map from the parameters to the equations' numbers."""
        return Coefficients(self.model)

    @cached_property
    def first(self) -> FirstState:
        """The map from a record's unknowns to the first states."""
        return FirstState(self.coefficients.model)

    def outputs(self, values: FloatArray) -> list[FloatArray]:
        """Return the predicted output of each record."""
        every = range(len(self.records))
        return [self.predict(values, i, derivatives=False).output for i in every]

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
        """Return cost, gradient and Hessian, see ``Problem``; what has vanished is held."""
        if theta.ndim == 2:
            parts = [self.quadratic(row, scale, rho, chart) for row in theta]
            return Quadratic(*(np.stack(column) for column in zip(*parts, strict=True)))
        cost, gradient, hessian = super().quadratic(theta, scale, rho)
        if not (np.isfinite(cost) and np.isfinite(hessian).all()):  # a motion beyond all bounds
            return Quadratic(np.asarray(np.inf), np.zeros(theta.size), np.eye(theta.size))
        far = _VANISHED * hessian.diagonal()
        vanished = self.space.positive & (gradient >= far)
        vanished |= self.space.angular & (np.abs(gradient) >= far)
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
        lost = np.full((1 + derivatives * theta.size, self.n_residuals), np.nan)
        if not np.isfinite(values).all():
            return lost
        for number, (measured, size) in enumerate(zip(self.measured, self.sizes, strict=True)):
            try:
                predicted = self.predict(values, number, derivatives=derivatives)
            except FitError:
                return lost
            wave = (measured - predicted.output)[:, None] / size
            if derivatives:
                slopes = predicted.by * (self.space.slopes(values) / -size)
                wave = np.concatenate([wave, slopes], axis=1)
            waves.append(self.filtered(wave))
        return np.concatenate(waves).T

    @property
    def rounding(self) -> FloatArray:
        """Size of residuals that may be rounding errors alone."""
        return np.asarray(self.accuracy)

    @property
    def log_area(self) -> float:
        """Return ln of the size of the residuals' units, in that of the output."""
        return -self.n_residuals * float(np.log(self.sizes[0]))

    @cached_property
    def sizes(self) -> tuple[float, ...]:
        """Standard deviation of all records' output: one unit for every residual."""
        size = float(np.std(np.concatenate([y - y.mean() for y in self.measured])))
        if size == 0.0:
            raise DataError("the output of the records is constant; nothing can be fitted to it")
        return (size,) * len(self.records)

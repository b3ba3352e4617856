"""Recorded waves as a fit takes them, and the equations of the plant that they belong to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data import Record
from dahl_ident.data.columns import one_of
from dahl_ident.data.record import at_even_times, unbroken
from dahl_ident.data.rows import one_run
from dahl_ident.elements import Element, Friction, Model, Parameter
from dahl_ident.elements.driven_motion import Coefficients
from dahl_ident.elements.element import as_model
from dahl_ident.elements.equations import FirstState, plant_equations
from dahl_ident.elements.parameter import Dimension
from dahl_ident.errors import DataError, ModelError, ValidationError, argument, spelled
from dahl_ident.problem.base import Problem
from dahl_ident.problem.record_noise import LEADS, in_band, noise_of, travelled
from dahl_ident.problem.space import Space
from dahl_ident.units import counted

if TYPE_CHECKING:
    from dahl_ident.elements.equations import Excitation
    from dahl_ident.engine import System

Output = Literal["force", "motion"]
SHORTEST = 16  # fewest samples from which noise is estimated
_SLOWEST = 0.1  # rate times the size of the motion up to which the rate is searched as a number


class RecordWaves(Problem):
    """Records and a model: what was measured, and the equations that predict it."""

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
                    f"data holds a {type(record).__name__}; expected one FrequencyResponse, or a "
                    "Record or several (read_frequency_response and read_record read files, "
                    "FrequencyResponse.concatenate joins tables)"
                )
        self.model = as_model(model)
        one_of(excitation, "excitation", ("force", "base"))
        self.excitation = excitation
        self.output: Output = output or ("motion" if self.model.has_inertia else "force")
        one_of(self.output, "output", ("force", "motion"))
        if excitation == "base" and self.output == "force":
            raise ValidationError(
                f"{argument('excitation', 'base')} is given with records: their force is predicted "
                "from the displacement; leave it out, or predict the motion of a model with a mass"
            )
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
            parts = [unbroken(record, SHORTEST) for record in self.records]
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
        self.is_smoothed = False
        """Whether displacements are smoothed in such a window, for the output "force"."""
        self.displacement_noise = 0.0
        """Standard deviation of the displacement, m, within which no movement counts."""
        self.paths: tuple[FloatArray, ...] | None = None

    def _check(self, record: Record, which: str) -> None:
        if len(record) < SHORTEST:
            raise DataError(f"{which} has {len(record)} samples; expected at least {SHORTEST}")
        if self.output == "force" and record.displacement is None:
            raise DataError(
                f"{which} has {record.motion_channel} but no displacement, from which the force "
                f"would follow; integrate it, or add {spelled('Mass()', '--mass free')} to "
                "fit the motion"
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
                "and springs; give one of them, such as the mass: "
                f"{spelled('Mass(1.0)', '--mass 1.0')}"
            )

    @property
    def data(self) -> tuple[Record, ...]:
        """The records."""
        return self.records

    def without_noise(self, noise: float, lead: float = LEADS[1]) -> Self:
        """Return the same problem, the displacement's noise not counted as travel.

        For the output "force"; see :func:`~.record_noise.travelled`.
        """
        x = [x for x, _, _ in self.motions] if noise else []
        paths = tuple(travelled(wave, noise, lead) for wave in x) or None
        return self.altered("latest", displacement_noise=noise, paths=paths)

    def smoothed(self, *, on: bool = True) -> Self:
        """Return the same problem, the displacements smoothed, or as measured.

        Noise of a displacement is neither travel nor force where the motion is slower than it.
        """
        return self.altered("motions", "latest", is_smoothed=on)

    def delayed(self, delay: float) -> Self:
        """Return the same problem, the motion taken to lag the force by so many seconds."""
        delayed = self.altered("motions", "drives", "latest", "_windows", delay=delay)
        return delayed.without_noise(self.displacement_noise)

    def differentiated_in(self, window: float) -> Self:
        """Return the same problem, displacements differentiated in a window of other length."""
        return self.altered("motions", "latest", window=window)

    @property
    def noise_travel(self) -> float:
        """Travel that the displacement's noise would add, over the travel that counts."""
        measured = [np.abs(np.diff(np.asarray(r.displacement))).sum() for r in self.records]
        paths = self.paths or [x for x, _, _ in self.motions]
        counted = [np.abs(np.diff(path)).sum() for path in paths]
        return float(sum(measured) / sum(counted) - 1.0)

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
    def delay_std(self) -> float:
        """Standard deviation of the delay, s: as stated, or one sample."""
        return self.calibration.get("delay", 1.0 / self.records[0].sample_rate)

    @property
    def all_parameters(self) -> tuple[Parameter, ...]:
        """The model's parameters, fixed ones included, and what each record adds."""
        return (*self.model.parameters, *self.parameters[self.n_reported :])

    def unit_sizes(self, dimension: Dimension) -> FloatArray:
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
        return f"{counted(len(self.records), 'record')}, {self.n_samples} samples"

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
        slopes: tuple[FloatArray, FloatArray] = np.zeros(0), np.zeros(0)
        rate_independent = all(e.rate_independent for e in self.model.elements)
        if rate_independent and not self.is_smoothed:
            return tuple((x, *slopes) for x in displacements)
        from dahl_ident.engine import differentiated, smoothed

        motions = []
        for x, window, record in zip(displacements, self._windows, self.records, strict=True):
            path = smoothed(x, window) if self.is_smoothed else x
            if not rate_independent:
                width = 2 * max(2, round(self.window * (window // 2))) + 1
                slopes = differentiated(x, 1.0 / record.sample_rate, width)
            motions.append((path, *slopes))
        return tuple(motions)

    @cached_property
    def estimated_noise(self) -> float:
        """Standard deviation of the displacements' white noise, m; see `displacement_noise`."""
        return float(np.median([noise_of(x) for x in self._displacements]))

    @property
    def path_noise(self) -> float:
        """Standard deviation of the noise that smoothing leaves, m."""
        if not self.is_smoothed:
            return self.estimated_noise
        from dahl_ident.engine import noise_left

        return self.estimated_noise * float(np.median([noise_left(w) for w in self._windows]))

    @cached_property
    def _windows(self) -> list[int]:
        """Samples in which the displacements are smoothed."""
        from dahl_ident.engine import filter_window

        return [filter_window(x) for x in self._displacements]

    def with_more_noise(self, noise: float, draw: int = 0) -> Self:
        """Return the same problem, white noise added to the displacements.

        Samples that are equal to the one before stay equal to it: an encoder at rest has no noise.
        """
        rng = np.random.default_rng(draw)
        noisy = []
        for x in self._displacements:
            reading = np.cumsum(np.diff(x, prepend=x[0]) != 0.0)
            noisy.append(x + noise * rng.standard_normal(x.size)[reading])
        return self.altered("latest", motions=self._motions_of(noisy))

    def with_noisier_drive(self, stds: Sequence[float], draw: int) -> Self:
        """Return the same problem, white noise added to the drive of each record."""
        rng = np.random.default_rng(draw)
        waves = [
            std * rng.standard_normal(len(record))
            for record, std in zip(self.records, stds, strict=True)
        ]
        return self.driven_more(dict(enumerate(waves)))

    def driven_more(self, waves: Mapping[int, FloatArray]) -> Self:
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

    def full_values(self, values: FloatArray) -> list[float]:
        """Return the value of every parameter of the model, fixed ones included."""
        by_name = dict(zip(self.names, values.tolist(), strict=True))
        return [float(by_name.get(p.name, p.value or 0.0)) for p in self.model.parameters]

    def record_values(self, values: FloatArray, number: int) -> FloatArray:
        """Return the values that belong to one record alone."""
        start = len(self.free) + number * self.per_record
        return values[start : start + self.per_record]

    @cached_property
    def coefficients(self) -> Coefficients:
        """The map from the parameters to the equations' numbers."""
        return Coefficients(self.model)

    @cached_property
    def first(self) -> FirstState:
        """The map from a record's unknowns to the first states."""
        return FirstState(self.coefficients.model)


def endings(records: Sequence[Record]) -> list[str]:
    """Return what the names of each record's unknowns end in: its number, if there are several."""
    return [f"_{i + 1}" for i in range(len(records))] if len(records) > 1 else [""]


def nuisance(model: Model, records: Sequence[Record], output: str) -> list[Parameter]:
    """Return the unknowns of each record: initial states, an offset and, of forces, a drift."""
    unknowns = []
    channel = records[0].motion_channel
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}[channel]
    for tail in endings(records):
        if output == "motion":
            unknowns.append(Parameter(f"initial_displacement{tail}", "m", "at the first sample"))
            unknowns.append(Parameter(f"initial_velocity{tail}", "m/s", "at the first sample"))
        for element in model.elements:
            name = f"{element.name}_" if element.name else ""
            if element.has_memory:
                unknowns += [
                    Parameter(f"{name}{start}{tail}", unit, meaning)
                    for start, unit, meaning in element.starts
                ]
            else:
                unknowns += [
                    Parameter(f"{name}state_{i + 1}{tail}", "m", "at the first sample")
                    for i in range(element.n_states)
                ]
        if output == "force":
            unknowns.append(Parameter(f"offset{tail}", "N", "constant in the measured force"))
            unknowns.append(Parameter(f"drift{tail}", "N/s", "slope of the measured force"))
        else:
            unknowns.append(Parameter(f"offset{tail}", unit, "constant in the measured motion"))
    occurrences = Counter(p.name for p in unknowns)
    name, count = occurrences.most_common(1)[0]
    if count > 1:
        raise ModelError(
            f"several elements have an unknown called {name} in a fit of records; give each a "
            "name, such as " + spelled("Dahl(name='pivot')", "--element 'dahl(name=pivot)'")
        )
    for p in model.parameters:
        if p.name in occurrences:
            raise ModelError(
                f"{model!r} has a parameter called {p.name}, which is also an unknown of a fit of "
                "records; expected another name: change it in the law's declaration"
            )
    return unknowns


def bends(free: Sequence[Parameter], count: int, records: Sequence[Record]) -> FloatArray:
    """Return the size up to which a parameter is searched as a number, above as a logarithm.

    Rates such as those of Bouc-Wen may have either sign, but above a tenth of the motion's inverse
    size they vary in proportion to a stiffness. 0 for parameters searched in one way only.
    """
    time, length = 1.0, 1.0
    wave = np.concatenate([y - y.mean() for y in (r.motion_samples for r in records)])
    steps = float(np.std(np.diff(wave)))
    if steps > 0.0:
        time = float(np.std(wave)) / steps / records[0].sample_rate
        order = ("displacement", "velocity", "acceleration").index(records[0].motion_channel)
        length = float(np.std(wave)) * time**order
    sizes = np.zeros(count)
    for i, p in enumerate(free):
        if not p.positive and not np.isfinite([p.lower, p.upper]).any():
            force, by_length, by_time = p.dimension
            if not force and (by_length or by_time):
                sizes[i] = _SLOWEST * length**by_length * time**by_time
    return sizes

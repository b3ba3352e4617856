"""The assessment of a fit of records of any motion, and its predictions of other records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.arrays import TINY, FloatArray, IntArray, whole_number
from dahl_ident.data import FrequencyResponse, Record
from dahl_ident.data.record import cut
from dahl_ident.diagnostics.advice import record_advice
from dahl_ident.diagnostics.assessment import Assessment
from dahl_ident.diagnostics.bands import DerivedQuantity, quantities_and_slopes
from dahl_ident.diagnostics.budget import Budget, parameter_budget
from dahl_ident.diagnostics.confidence_levels import (
    CONFIDENCE,
    checked_levels,
    coverage_factor,
    coverage_factors,
    level_text,
    thresholds,
)
from dahl_ident.diagnostics.contributions import ALONG_MOTION, MODEL_ERROR, NOISE, variances
from dahl_ident.diagnostics.formatting import table
from dahl_ident.diagnostics.goodness import Goodness
from dahl_ident.diagnostics.intervals import LARGE, ConfidenceIntervals, around, intervals_of
from dahl_ident.diagnostics.misfit_explanations import force_convention
from dahl_ident.diagnostics.profile import Profiler
from dahl_ident.diagnostics.record_errors import (
    RecordErrors,
    errors_on_constraints,
    record_errors,
)
from dahl_ident.diagnostics.record_sources import ContradictedExponent
from dahl_ident.diagnostics.verdicts import (
    FIRST_ORDER_UP_TO,
    IDENTIFIED_BELOW,
    Identifiability,
    ParameterVerdict,
    Verdict,
    within,
)
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.errors import FitError, ValidationError
from dahl_ident.fitting import solve
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import ConstraintCost, Optimum
from dahl_ident.fitting.record_search import hold_model
from dahl_ident.problem import RecordProblem, TableProblem
from dahl_ident.problem.record_noise import share_in_band
from dahl_ident.units import percent, shown_unit

_POSITIVE = 1e-100  # smallest positive value, or misfit over the response
_LARGE = 0.2  # rms misfit from which the sign of the force is doubted
_SEGMENTS = 50  # of a record: the worst one is 2 % of it
_UNKNOWN = 1e24  # variance of a logarithm that the records do not determine


@dataclass(frozen=True)
class RecordBand:
    """Predicted samples of a record with their uncertainty, each of shape (n,)."""

    time: FloatArray  # s
    output: FloatArray  # predicted force or motion
    stderr: FloatArray  # standard uncertainty from the parameters
    lower: FloatArray  # 95.45 % band of what would be measured, the residuals' scatter included
    upper: FloatArray
    measured: FloatArray  # what the record holds

    @property
    def rms_error(self) -> float:
        """Root mean square of measured minus predicted."""
        return float(np.sqrt(np.mean((self.measured - self.output) ** 2)))

    @property
    def rms_share(self) -> float:
        """RMS of measured minus predicted, over the measured samples' standard deviation."""
        return self.rms_error / float(np.std(self.measured))


@dataclass(frozen=True)
class RecordGoodness(Goodness):
    """Residuals of all records: their size, where they are largest, and their correlation."""

    # root mean square over that of the output, at the drive's frequencies where residuals are
    # weighted by their spectrum
    rms_in_band: float = 0.0
    rms: float = 0.0  # of the residuals, in the output's unit
    worst_record: int = 1  # record, from 1, of the fiftieth of a record with the largest residuals
    worst: str = ""  # that segment in words, with its times in s
    correlation: float = 0.0  # of residuals of neighbouring samples

    @property
    def headline(self) -> str:
        """The size of the residuals; what they consist of is judged with their errors."""
        return f"The residuals are {percent(self.rms_misfit)} rms of the measured output."

    @property
    def details(self) -> list[str]:
        """The numbers as text."""
        return [
            f"unexplained share of variance {self.rms_misfit**2:.3g} "
            f"({percent(self.rms_misfit)} rms)",
            f"residuals {self.rms:.3g} rms; {self.worst}",
            f"correlation of neighbouring residuals {self.correlation:.2f}",
        ]


def record_goodness(problem: RecordProblem, residuals: Sequence[FloatArray]) -> RecordGoodness:
    """Return the statistics of the residuals of records, measured minus predicted output of each.

    Examples
    --------
    >>> from dahl_ident import Dahl, Record
    >>> t = np.arange(100.0)
    >>> record = Record(t, displacement=t, force=np.sin(t))
    >>> problem = RecordProblem([record], Dahl())
    >>> print(record_goodness(problem, [0.1 * np.sin(t)]).details[0])
    unexplained share of variance 0.01 (10 % rms)
    """
    records, measured = problem.records, problem.measured
    joined = np.concatenate(list(residuals))
    total = float(joined @ joined)
    rms = float(np.sqrt(total / joined.size))
    share = total / sum(float(np.sum((y - y.mean()) ** 2)) for y in measured)
    in_band = share
    if problem.whitening.size > 1:
        in_band = share_in_band([r.force_samples for r in records], measured, residuals)
    segments = []
    for number, (record, e) in enumerate(zip(records, residuals, strict=True), 1):
        width = max(1, e.size // _SEGMENTS)
        sums = np.concatenate([[0.0], np.cumsum(e**2)])
        mean = (sums[width:] - sums[:-width]) / width
        first = int(np.argmax(mean))
        last = min(first + width, e.size) - 1
        segments.append((float(mean[first]), number, record.time[first], record.time[last]))
    square, number, start, stop = max(segments, key=lambda segment: segment[0])
    which = f" of record {number}" if len(records) > 1 else ""
    ends = dict.fromkeys((f"{start:.4g}", f"{stop:.4g}"))
    when = f"between {' and '.join(ends)}" if len(ends) > 1 else f"at {start:.4g}"
    worst = (
        f"they are largest {when} s{which}, {square**0.5 / rms if rms else 0.0:.2g} times their rms"
    )
    products = sum(float(e[1:] @ e[:-1]) for e in residuals)
    return RecordGoodness(
        share**0.5,
        rms_in_band=in_band**0.5,
        rms=rms,
        worst_record=number,
        worst=worst,
        correlation=products / total if total else 0.0,
    )


class RecordAssessment(Assessment):
    """A fit of records, with its errors by source."""

    problem: RecordProblem
    alternative = "it has errors, residuals and hold_out() of the samples"
    reduced = None

    @property
    def known(self) -> tuple[Mapping[str, float], Mapping[str, float]]:
        """Estimates and combined standard uncertainties by name, assumed exponents included."""
        errors = self.errors
        at = errors.places((*self.optimum.names, *errors.assumed))
        values, u = errors.values.tolist(), np.sqrt(np.diagonal(errors.covariance)).tolist()
        return {errors.names[i]: values[i] for i in at}, {errors.names[i]: u[i] for i in at}

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of parameters whose values are assumed; the uncertainty counts their ranges."""
        return self.errors.assumed

    @property
    def success(self) -> bool:
        """Whether the search converged, even if the records leave a parameter undetermined."""
        return self.optimum.converged

    @cached_property
    def model(self) -> Model:
        """The model with the estimates put in; parameters stay free or fixed as they were."""
        values = dict(zip(self.optimum.names, self.optimum.values.tolist(), strict=True))
        return self.problem.model.with_values(
            {p.name: p.nearest(values[p.name]) for p in self.problem.free}
        )

    @cached_property
    def _evaluated(self) -> tuple[list[FloatArray], list[FloatArray]]:
        numbers = range(len(self.problem.records))
        predictions = [self.problem.predict(self.optimum.values, i) for i in numbers]
        residuals = [y - p.output for y, p in zip(self.problem.measured, predictions, strict=True)]
        return [p.by for p in predictions], residuals

    @property
    def residuals(self) -> tuple[FloatArray, ...]:
        """Measured minus predicted, record by record."""
        return tuple(self._evaluated[1])

    @cached_property
    def errors(self) -> RecordErrors:
        """The estimate's uncertainty by source."""
        jacobians, residuals = self._evaluated
        loss = loss_named(self.optimum.loss, self.problem.residuals_per_row)
        if loss is not None:  # to first order it is least squares of the scores
            unit = self.problem.output_std * self.optimum.scale
            ends = np.cumsum([e.size for e in residuals])[:-1]
            scores = loss.scores(np.concatenate(residuals) / unit)
            residuals = np.split(unit * scores, ends)
        if self.first_order:
            return errors_on_constraints(self.optimum, jacobians, residuals)
        return record_errors(self.problem, self.optimum.values, residuals)

    @property
    def effective_samples(self) -> float:
        """Samples of white noise with the same information as the residuals."""
        return self.errors.effective

    @cached_property
    def covar(self) -> FloatArray:
        """Covariance of the free values, from all sources together."""
        return self.errors.values_covariance(self.optimum.names)

    @cached_property
    def covar_noise(self) -> FloatArray:
        """Covariance of the free values from the residuals' noise alone."""
        return self.errors.values_covariance(self.optimum.names, NOISE)

    @property
    def stderr_noise(self) -> Mapping[str, float]:
        """Standard error of every free value from the residuals' noise alone."""
        sizes = np.sqrt(self.covar_noise.diagonal()).tolist()
        return dict(zip(self.optimum.names, sizes, strict=True))

    @property
    def estimate(self) -> Optimum:
        """The estimate: the optimum."""
        return self.optimum

    @cached_property
    def by_noise(self) -> Optimum:
        """The optimum with the covariance of correlated noise."""
        slopes = self.problem.value_slopes(self.optimum.theta)
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = self.covar_noise / np.outer(slopes, slopes)
        return replace(
            self.optimum,
            covariance=np.where(np.isnan(covariance), np.inf, covariance),
            dof=int(self.errors.dof_of(NOISE)),
        )

    def combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        """Return intervals that count every source of error.

        They are open where far larger or smaller values describe the records nearly as well.
        """
        array, errors = checked_levels(levels), self.errors
        dof = [errors.dof(direction) for direction in np.eye(len(errors.names))]
        k = coverage_factors(dof, array[:, None])
        u = np.sqrt(np.diagonal(errors.covariance))
        lower, upper = around(errors.problem.space, errors.values, u, k)
        asked, deviance = self._far_deviance
        if asked.size:
            places = errors.places(self.optimum.names[i] for i in asked)
            q = thresholds(self.by_noise, array)
            below, above = deviance[:, None] < q[:, None] ** 2
            lower[:, places] = np.where(below, 0.0, lower[:, places])
            upper[:, places] = np.where(above, np.inf, upper[:, places])
        note = f"every source of the budget, {errors.effective:.0f} effective samples"
        return intervals_of(
            errors, self.optimum.names, errors.assumed, array, errors.values, (lower, upper), note
        )

    @cached_property
    def _far_deviance(self) -> tuple[IntArray, FloatArray]:
        """The parameters that may have an open side, (n,), and their deviances far off, (2, n)."""
        count = 0 if self.first_order else self.problem.n_reported
        with np.errstate(divide="ignore"):
            u = np.sqrt(np.diagonal(self.covar_noise)) / self.optimum.values
        asked = np.flatnonzero((self.problem.space.positive & ~(u <= LARGE))[:count])
        if not asked.size:
            return asked, np.zeros((2, 0))
        return asked, Profiler(self.by_noise).far_deviance(asked)

    @property
    def _directions(self) -> FloatArray:
        """Directions of the free values among all estimates."""
        errors = self.errors
        return np.eye(len(errors.names))[errors.places(self.optimum.names)]

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters of the model the records determine."""
        free, limits = self.problem.free, self.intervals("combined")
        verdicts = {}
        for p, direction in zip(free, self._directions, strict=False):
            u = float(self.errors.std(direction)) / _natural_size(p, self.known[0][p.name])
            U = coverage_factor(self.errors.dof(direction)) * u
            verdict = Verdict.WEAK if 0.5 * U > IDENTIFIED_BELOW else Verdict.IDENTIFIED
            verdicts[p.name] = verdict if u <= FIRST_ORDER_UP_TO else Verdict.NOT_IDENTIFIED
        lost = [name for name, verdict in verdicts.items() if verdict is Verdict.NOT_IDENTIFIED]
        why = record_advice(self.model, self.problem, self.errors, lost)
        parameters = {}
        for (name, verdict), unit in zip(verdicts.items(), limits.units, strict=False):
            _, shown, _ = limits[name]
            text, reason = within(shown, unit), why.get(name, "")
            parameters[name] = ParameterVerdict(name, unit, verdict, shown, text, reason)
        return Identifiability(parameters, (), {})

    @property
    def constraint_cost(self) -> ConstraintCost | None:
        """The cost of constraints, for the effective number of independent samples."""
        cost = self.optimum.constraint_cost
        share = self.errors.effective / self.problem.n_samples
        return cost and replace(cost, rise=cost.rise * share, dof=cost.dof * share)

    @cached_property
    def goodness(self) -> RecordGoodness:
        """Statistics of the residuals, and whether the force's sign explains them."""
        goodness = record_goodness(self.problem, self.residuals)
        if goodness.rms_in_band < _LARGE:
            return goodness
        return replace(goodness, sign=force_convention(self.optimum, goodness.rms_misfit))

    @property
    def exceeds_noise(self) -> bool:
        """Whether the model has a misfit in excess of noise."""
        return not {MODEL_ERROR, ALONG_MOTION}.isdisjoint(self.errors.contributions)

    @property
    def contradicted_exponents(self) -> Iterator[ContradictedExponent]:
        """The exponents that the records contradict, or put outside their range."""
        return iter(self.errors.contradicted)

    @property
    def significant_misfit(self) -> tuple[float, float] | None:
        """The misfit, within runs and in all; None if there is none, or the output is a motion."""
        if self.problem.output == "motion" or not self.exceeds_noise:
            return None
        return (self.goodness.rms_in_band,) * 2

    def force_share(self, element: Element, value: float) -> float:
        """Return the rms force of an element of one parameter, over that of the records."""
        size = np.concatenate([y - y.mean() for y in self.problem.measured]).std()
        force = [
            element.force_history([value], x, v, acceleration=a) for x, v, a in self.problem.motions
        ]
        return float(np.concatenate([f - f.mean() for f in force]).std() / size)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.errors.runs

    def design(self, *, counted: bool) -> dict[str, Any]:
        """Return what is assumed because of the number of records, or is not known."""
        exponents = self.problem.exponents
        unseen = [p.name for p in exponents if p.assumed and p.name not in self.assumed]
        unfound = tuple(unseen) if counted and not self.first_order else ()
        return {"single_run": self.runs < 2, "unfound": unfound}

    @property
    def facts(self) -> dict[str, Any]:
        """Plain data for JSON, see ``Assessment``."""
        return super().facts | {
            "records": len(self.problem.records),
            "samples": self.problem.n_samples,
            "effective_samples": self.errors.effective,
            "share_of_variance_left": self.goodness.rms_misfit**2,
        }

    @property
    def exact(self) -> tuple[str, ...]:
        """Inputs without a stated uncertainty."""
        return self.errors.exact

    @property
    def noise_in_words(self) -> list[str]:
        """How residuals were weighted."""
        weighted = {"spectrum": "weighted by their spectrum", "white": "of constant variance"}
        return [
            f"residuals {weighted[self.problem.noise]}; worth {self.errors.effective:.0f} "
            f"independent samples of {self.problem.n_samples}"
        ]

    @property
    def _budget(self) -> Budget:
        problem, errors, count = self.problem, self.errors, self.problem.n_reported
        parameters = tuple(
            parameter_budget(errors, p.name, shown_unit(p.unit, problem.motion), value, direction)
            for p, value, direction in zip(
                problem.free, self.optimum.values.tolist(), self._directions, strict=False
            )
        )
        return Budget(parameters, self.covar[:count, :count], errors.exact)

    def derived(
        self, amplitudes: Sequence[float], frequency_hz: float | None
    ) -> Iterator[DerivedQuantity]:
        """Yield x_c, energy per cycle, equivalent stiffness and damping."""
        count = self.problem.n_reported
        for name, unit, A, value, slopes in quantities_and_slopes(
            self.problem, self.optimum.values[:count], amplitudes, frequency_hz
        ):
            (variance,) = variances(slopes[None], self.covar[:count, :count])
            yield DerivedQuantity(name, unit, A, value, float(variance) ** 0.5)

    @cached_property
    def device(self) -> tuple[Optimum, None, None]:
        """The estimate as that of a table of one row, whose noise is the model's misfit."""
        row = FrequencyResponse([1.0], [1.0], [1.0], motion=self.problem.motion)
        problem: TableProblem = self.problem.for_table(row).like(noise="relative")
        count = self.problem.n_reported
        values = self.optimum.values[:count]
        least = np.where(problem.space.positive, _POSITIVE, -np.inf)
        theta = problem.to_search(np.maximum(values, least))
        slopes = problem.value_slopes(theta)
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = self.covar[:count, :count] / np.outer(slopes, slopes)
        unknown = ~np.isfinite(covariance)
        covariance[unknown] = np.where(np.eye(count)[unknown] > 0.0, _UNKNOWN, 0.0)
        share = 0.5**0.5 * self.goodness.rms_misfit if self.exceeds_noise else _POSITIVE
        optimum = replace(
            self.optimum,
            source=problem,
            theta=theta,
            values=values,
            covariance=covariance,
            scale=share,
            dof=int(self.errors.least_dof),
        )
        return optimum, None, None

    def predict_record(self, record: Record, initial: str) -> RecordBand:
        """Return what another record should show."""
        count = self.problem.n_reported
        problem, full = self.started(record, self.optimum.values[:count], initial)
        predicted = problem.predict(full, 0)
        variance = variances(predicted.by[:, :count], self.covar[:count, :count])
        return self.band(problem, predicted.output, variance)

    def record_at_draws(self, record: Record, initial: str, draws: FloatArray) -> RecordBand:
        """Return what another record should show, at draws of the model's parameters."""
        outputs = []
        for values in draws:
            problem, full = self.started(record, values, initial)
            outputs.append(problem.predict(full, 0, derivatives=False).output)
        return self.band(problem, np.mean(outputs, axis=0), np.var(outputs, axis=0, ddof=1))

    def started(
        self, record: Record, values: FloatArray, initial: str
    ) -> tuple[RecordProblem, FloatArray]:
        """Return the problem of another record, and the model's `values` with those it adds."""
        problem = self.problem.for_records([record])
        if initial == "fitted":
            return problem, hold_model(problem, values)
        if initial != "rest":
            raise ValidationError(f"initial is {initial!r}; expected fitted or rest")
        full = np.zeros(len(problem.parameters))
        full[: values.size] = values
        return problem, full

    def band(self, problem: RecordProblem, output: FloatArray, variance: FloatArray) -> RecordBand:
        """Return a predicted record with its bands; `variance` is that from the parameters.

        A misfit is proportional to the output, so its scatter grows with the record's level.
        """
        scatter = float(np.mean(np.concatenate(self.residuals) ** 2))
        if self.exceeds_noise:
            scatter *= max(1.0, problem.level / self.problem.level) ** 2
        U = coverage_factor(self.errors.least_dof) * np.sqrt(variance + scatter)
        return RecordBand(
            problem.records[0].time,
            output,
            np.sqrt(variance),
            output - U,
            output + U,
            problem.measured[0],
        )

    def _hold_out(self, parts: int | None) -> HoldOut:
        problem = self.problem
        several = len(self.problem.records) > 1
        if parts is None:
            parts = 1 if several else 4
        if whole_number(parts, "parts", 1) == 1 and not several:
            raise FitError("with the only record left out, nothing is left to fit; give parts=2")
        pieces = [
            (number, cut(record, slice(int(rows[0]), int(rows[-1]) + 1)))
            for number, record in enumerate(problem.records, 1)
            for rows in np.array_split(np.arange(len(record)), parts)
        ]
        start = dict(zip(problem.names[: problem.n_reported], self.optimum.values, strict=False))
        left_out = []
        for k, (number, piece) in enumerate(pieces):
            others = problem.like(records=[other for i, (_, other) in enumerate(pieces) if i != k])
            optimum = solve(others, loss=self.optimum.loss, start=start)
            band = RecordAssessment(optimum).predict_record(piece, "fitted")
            inside = np.mean((band.measured >= band.lower) & (band.measured <= band.upper))
            first, last = float(piece.time[0]), float(piece.time[-1])
            left_out.append(
                HeldOutPart(number, first, last, len(piece), band.rms_share, float(inside))
            )
        return HoldOut(tuple(left_out))


def _natural_size(parameter: Parameter, value: float) -> float:
    """Return the size with which the uncertainty of a parameter is compared.

    It is the value, or for a parameter that may be zero, such as an asymmetry, a larger bound.
    """
    limit = min(parameter.upper, -parameter.lower) if parameter.lower < 0.0 else 0.0
    return max(limit if np.isfinite(limit) else 0.0, abs(value), TINY)


@dataclass(frozen=True)
class HeldOutPart:
    """A part of the records, predicted by a fit to the others."""

    record: int  # number of the record, from 1
    start: float  # s
    stop: float
    samples: int
    rms_share: float  # rms prediction error over the standard deviation of the part's output
    inside: float  # share of its samples within the 95.45 % band


@dataclass(frozen=True)
class HoldOut:
    """The hold-out check of a fit: parts of the records, each left out in turn."""

    parts: tuple[HeldOutPart, ...]

    @property
    def inside(self) -> float:
        """Share of all samples within the 95.45 % bands of their predictions."""
        samples = [part.samples for part in self.parts]
        return float(np.average([part.inside for part in self.parts], weights=samples))

    def __str__(self) -> str:
        inside = f"inside {level_text(CONFIDENCE)} band"
        rows = [["record", "from (s)", "to (s)", "error (% rms)", inside]]
        rows += [
            [
                str(part.record),
                f"{part.start:.4g}",
                f"{part.stop:.4g}",
                percent(part.rms_share).removesuffix(" %"),
                f"{100.0 * part.inside:.1f} %",
            ]
            for part in self.parts
        ]
        return f"{table(rows, ())}\nall samples: {100.0 * self.inside:.1f} % inside"

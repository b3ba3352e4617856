"""The result of a fit to records of any motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.data import Record
from dahl_ident.data.record import cut
from dahl_ident.diagnostics.bands import DerivedQuantity
from dahl_ident.diagnostics.budget import Budget, coverage_factor
from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, checked_levels, percent
from dahl_ident.diagnostics.formatting import interval, rounded, table
from dahl_ident.diagnostics.intervals import ConfidenceIntervals, around
from dahl_ident.diagnostics.judgement import Judgement
from dahl_ident.diagnostics.record_checks import (
    RecordGoodness,
    misses,
    record_goodness,
    record_judgement,
    undetermined,
)
from dahl_ident.diagnostics.record_errors import (
    NOISE,
    RecordErrors,
    errors_on_constraints,
    record_budget,
    record_derived,
    record_errors,
    variances,
)
from dahl_ident.diagnostics.verdicts import Verdict
from dahl_ident.elements import Model
from dahl_ident.errors import FitError, FitInterrupted, ValidationError
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.fitting.record_search import Tell, hold_model, solve_records
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.results.fit_base import Fit
from dahl_ident.results.fit_storage import RECORDS
from dahl_ident.results.hold_out import HeldOutPart, HoldOut
from dahl_ident.results.progress import fit_progress
from dahl_ident.results.result import Parameters
from dahl_ident.units import shown_unit

if TYPE_CHECKING:
    from dahl_ident.plots import Axes


@dataclass(frozen=True)
class RecordBand:
    """Predicted samples of a record with their uncertainty.

    Attributes
    ----------
    time : ndarray, shape (n,)
        s.
    output : ndarray, shape (n,)
        Predicted force or motion.
    stderr : ndarray, shape (n,)
        Standard uncertainty from the parameters.
    lower, upper : ndarray, shape (n,)
        95.45 % band of what would be measured, the residuals' scatter included.
    measured : ndarray, shape (n,)
        What the record holds.
    """

    time: FloatArray
    output: FloatArray
    stderr: FloatArray
    lower: FloatArray
    upper: FloatArray
    measured: FloatArray

    @property
    def rms_error(self) -> float:
        """Root mean square of measured minus predicted."""
        return float(np.sqrt(np.mean((self.measured - self.output) ** 2)))

    @property
    def rms_share(self) -> float:
        """The same over the measured samples' standard deviation."""
        return self.rms_error / float(np.std(self.measured))


class RecordFit(Fit):
    """Result of a fit to records; made by :func:`dahl_ident.fit`.

    Attributes
    ----------
    params : mapping of str to Estimate
        Every parameter of the model, and what each record adds: states, offsets, drifts.
    covar : ndarray
        Covariance of the free values, with the residuals' correlation.
    trusted, status, verdict, statements
        Whether the numbers hold, and why.

    Examples
    --------
    >>> import dahl_ident as di
    >>> x = 1e-3 * np.cumsum(np.random.default_rng(0).standard_normal(500))
    >>> force = di.Dahl(0.1, 30.0).force(x) + 1e-3 * np.random.default_rng(1).standard_normal(500)
    >>> fit = di.fit(di.Record(np.arange(500) / 100.0, displacement=x, force=force), di.Dahl())
    >>> fit.trusted, round(fit.params["f_max"].value, 2)
    (True, 0.1)
    """

    _schema = RECORDS

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).from_json, (self.to_json(),)  # the plant's functions cannot be copied

    @property
    def problem(self) -> RecordProblem:
        """Records and model as they were fitted."""
        problem: RecordProblem = self.optimum.problem
        return problem

    @property
    def records(self) -> tuple[Record, ...]:
        """The records that were fitted."""
        return self.problem.records

    @property
    def provenances(self) -> tuple[Mapping[str, Any] | None, ...]:
        """Where each record comes from."""
        return tuple(record.provenance for record in self.records)

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of parameters that were not given; the uncertainty counts their ranges."""
        return tuple(one.name for one in self.errors.assumed)

    def verdict_on(self, name: str) -> tuple[Verdict, str]:
        """Return whether the records determine a parameter, and what they say of it."""
        lost = [str(f) for f in undetermined(self) if f.values["name"] == name]
        verdict = Verdict.NOT_IDENTIFIED if lost else Verdict.IDENTIFIED
        return verdict, lost[0] if lost else verdict.value

    @property
    def success(self) -> bool:
        """Whether the search converged, also where the records leave a parameter undetermined."""
        return self.optimum.converged

    @cached_property
    def model(self) -> Model:
        """The model with the estimates put in, fixed."""
        values = dict(zip(self.var_names, self.optimum.values.tolist(), strict=True))
        return self.problem.model.with_fixed({p.name: values[p.name] for p in self.problem.free})

    @cached_property
    def _evaluated(self) -> tuple[list[FloatArray], list[FloatArray]]:
        predictions = [
            self.problem.predict(self.optimum.values, i) for i in range(len(self.records))
        ]
        residuals = [y - p.output for y, p in zip(self.problem.measured, predictions, strict=True)]
        return [p.by for p in predictions], residuals

    @property
    def residuals(self) -> tuple[FloatArray, ...]:
        """Measured minus predicted, record by record."""
        return tuple(self._evaluated[1])

    @cached_property
    def errors(self) -> RecordErrors:
        """The estimate's uncertainty, source by source."""
        jacobians, residuals = self._evaluated
        loss = loss_named(self.optimum.loss, self.problem.parts)
        if loss is not None:  # to first order, least squares of these residuals
            units = [size * self.optimum.scale for size in self.problem.sizes]
            z = [(e / unit) ** 2 for e, unit in zip(residuals, units, strict=True)]
            mean = loss.mean_slope(np.concatenate(z))
            residuals = [e * loss.slope(each) / mean for e, each in zip(residuals, z, strict=True)]
        if self.first_order:
            return errors_on_constraints(self.optimum, jacobians, residuals)
        return record_errors(self.problem, self.optimum.values, jacobians, residuals)

    @property
    def covar(self) -> FloatArray:
        """Covariance of the free values, every source together."""
        return self.errors.covariance

    @property
    def stderr_noise(self) -> Mapping[str, float]:
        """Standard error of every free value from the residuals' noise alone."""
        sizes = np.sqrt(self.errors.contributions[NOISE].diagonal()).tolist()
        return MappingProxyType(dict(zip(self.var_names, sizes, strict=True)))

    def _shown(self, unit: str) -> str:
        """Return a unit as it is written for the records' motion."""
        return shown_unit(unit, self.records[0].motion)

    def budget(self) -> Budget:
        """Return the uncertainty budget: each parameter's sources, combined and expanded."""
        stated = record_budget(self.problem, self.optimum.values, self.errors)
        parameters = tuple(replace(p, unit=self._shown(p.unit)) for p in stated.parameters)
        return replace(stated, parameters=parameters)

    @property
    def effective_samples(self) -> float:
        """Samples of white noise that would tell as much as the residuals."""
        return self.errors.effective

    @property
    def weighted(self) -> bool:
        """Whether residuals were weighted by their spectrum, because slow noise prevails."""
        return self.problem.whitening.size > 1

    @cached_property
    def params(self) -> Parameters:
        """Every parameter by name."""
        stderr = dict(zip(self.var_names, np.sqrt(np.diagonal(self.covar)).tolist(), strict=True))
        values = dict(zip(self.var_names, self.optimum.values.tolist(), strict=True))
        return Parameters.of(self.problem, values, stderr)

    @cached_property
    def goodness(self) -> RecordGoodness:
        """Statistics of the residuals."""
        return record_goodness(self.problem, self.residuals)

    @cached_property
    def judgement(self) -> Judgement:
        """Every finding about the fit, and the status that follows from them."""
        return record_judgement(self)

    @cached_property
    def coverage_factor(self) -> float:
        """Half-width of a 95.45 % interval in standard errors: Student's t, effective samples."""
        return coverage_factor(self.errors.dof)

    @cached_property
    def _by_noise(self) -> Optimum:
        slopes = self.problem.value_slopes(self.optimum.theta)
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = self.errors.contributions[NOISE] / np.outer(slopes, slopes)
        return replace(
            self.optimum,
            covariance=np.where(np.isnan(covariance), np.inf, covariance),
            dof=int(self.errors.dof_of(NOISE)),
        )

    def _combined_intervals(self, levels: Sequence[float]) -> ConfidenceIntervals:
        array, values = checked_levels(levels), self.optimum.values
        dof = [self.errors.dof_for(place) for place in range(values.size)]
        k = np.array([[coverage_factor(nu, level) for nu in dof] for level in array.tolist()])
        u = np.sqrt(np.diagonal(self.covar))
        lower, upper = around(self.problem.space, values, u, k)
        note = f"every source of the budget, {self.effective_samples:.3g} effective samples"
        names, units = self.problem.names, tuple(p.unit for p in self.problem.parameters)
        return ConfidenceIntervals("combined", array, names, units, values, lower, upper, note)

    def fit_report(self, *, details: bool = True) -> str:
        """Return the report as text, the verdict first.

        Parameters
        ----------
        details : bool, default True
            False: verdict and the model's parameters alone.

        Returns
        -------
        str
        """
        of_model = {p.name for p in self.problem.model.parameters}
        limits = self.conf_interval().at(CONFIDENCE)
        rows = [["", "value", "stderr", "unit", f"{percent(CONFIDENCE)}", ""]]
        for name, p in self.params.items():
            if not details and name not in of_model:
                continue
            if p.vary:
                within = interval(*limits[name][1:], "")
                rows.append([name, *rounded(p.value, p.stderr), p.unit, within, ""])
            else:
                word = "assumed" if name in self.assumed else "fixed"
                rows.append([name, f"{p.value:g}", "", p.unit, "", word])
        shown = table(rows, (0, 3, 4, 5)).splitlines()
        parts = [("Verdict", self.statements), ("Parameters", shown)]
        if details:
            parts.append(("Uncertainty budget", str(self.budget()).splitlines()))
            parts.append(("Goodness of fit", self.goodness.details))
        return "\n".join(
            f"{title}\n" + "\n".join(f"    {line}" for line in lines) for title, lines in parts
        )

    def __repr__(self) -> str:
        estimates = ", ".join(str(self.params[p.name]) for p in self.problem.free)
        return f"<RecordFit: {estimates}; {self.status.value}>"

    # What follows

    def predict(
        self, record: Any, *, initial: Literal["fitted", "rest"] = "fitted", **other: Any
    ) -> RecordBand:
        """Return what another record of the same device should show.

        Parameters
        ----------
        record : Record
            With the same channels as those fitted.
        initial : {"fitted", "rest"}
            Whether the state at its first sample and the offset are fitted to the record, the
            model's parameters held, or taken as zero.

        Returns
        -------
        RecordBand

        Raises
        ------
        DataError
            If the record lacks a channel.
        FitError
            If the motion grows beyond all bounds.
        ValidationError
            If something else than a record is to be predicted.
        """
        if other or not isinstance(record, Record):
            raise ValidationError(
                "a fit of records predicts a Record; for settled sines ask its model: "
                "fit.model.dynamic_stiffness(amplitude, frequency_hz)"
            )
        count = len(self.problem.free)
        problem, full = self.started(record, self.optimum.values[:count], initial)
        predicted = problem.predict(full, 0)
        by = predicted.by[:, :count]
        variance = variances(by, self.covar[:count, :count])
        return self.band(problem, predicted.output, variance)

    def hold_out(self, parts: int | None = None) -> HoldOut:
        """Return how well parts of the records are predicted by fits to the rest.

        Parameters
        ----------
        parts : int, optional
            In how many parts each record is cut. Left out: several records are left out as a
            whole, one at a time, and a single one is cut in four.

        Returns
        -------
        HoldOut
            Each part left out in turn; printed, a table.

        Raises
        ------
        DataError
            If a part is too short to be fitted.
        FitError
            If nothing is left to fit.
        """
        if parts is None:
            parts = 1 if len(self.records) > 1 else 4
        if whole_number(parts, "parts", 1) * len(self.records) < 2:
            raise FitError("with the only record left out, nothing is left to fit; give parts=2")
        pieces = [
            (number, cut(record, slice(int(rows[0]), int(rows[-1]) + 1)))
            for number, record in enumerate(self.records, 1)
            for rows in np.array_split(np.arange(len(record)), parts)
        ]
        problem = self.problem
        start = {p.name: self.params[p.name].value for p in problem.free}
        parts_left_out = []
        for k, (number, piece) in enumerate(pieces):
            rest = [other for i, (_, other) in enumerate(pieces) if i != k]
            remaining = RecordProblem(
                rest, problem.model, output=problem.output, excitation=problem.excitation,
                calibration=problem.calibration,
            )  # fmt: skip
            fit = RecordFit(solve_records(remaining, loss=self.optimum.loss, start=start))
            band = fit.predict(piece)
            inside = np.mean((band.measured >= band.lower) & (band.measured <= band.upper))
            first, last = float(piece.time[0]), float(piece.time[-1])
            parts_left_out.append(
                HeldOutPart(number, first, last, len(piece), band.rms_share, float(inside))
            )
        return HoldOut(tuple(parts_left_out))

    def started(
        self, record: Record, values: FloatArray, initial: Literal["fitted", "rest"]
    ) -> tuple[RecordProblem, FloatArray]:
        """Return the problem of another record, and all its values; the model's are given."""
        own = self.problem
        problem = RecordProblem(
            [record], own.model, output=own.output, excitation=own.excitation,
            calibration=own.calibration,
        ).delayed(own.delay).without_noise(own.displacement_noise)  # fmt: skip
        if initial == "fitted":
            return problem, hold_model(problem, values)
        if initial != "rest":
            raise ValidationError(f"initial is {initial!r}; expected fitted or rest")
        full = np.zeros(len(problem.parameters))
        full[: values.size] = values
        return problem, full

    def band(self, problem: RecordProblem, output: FloatArray, variance: FloatArray) -> RecordBand:
        """Return a predicted record with its bands, from the variance of what is predicted.

        What a model misses is a share of the output: its scatter grows with the record's level.
        """
        scatter = float(np.mean(np.concatenate(self.residuals) ** 2))
        if misses(self):
            scatter *= max(1.0, _level(problem) / _level(self.problem)) ** 2
        half = self.coverage_factor * np.sqrt(variance + scatter)
        return RecordBand(
            problem.records[0].time, output, np.sqrt(variance), output - half, output + half,
            problem.measured[0],
        )  # fmt: skip

    def simulate(self, record: Record) -> FloatArray:
        """Return the output for a record's input, from rest; its measured output is not used."""
        return self.predict(record, initial="rest").output

    def derived(
        self, amplitudes: Sequence[float] = (), frequency_hz: float | None = None
    ) -> tuple[DerivedQuantity, ...]:
        """Return x_c, energy per cycle, equivalent stiffness and damping, with their errors."""
        values = self.optimum.values
        quantities = record_derived(self.problem, values, self.covar, amplitudes, frequency_hz)
        return tuple(replace(quantity, unit=self._shown(quantity.unit)) for quantity in quantities)

    def plot(self, kind: str | None = None, ax: Any = None, *, record: int = 0) -> Axes:
        """Draw measured and predicted samples, the loop, or the residuals of one record.

        Parameters
        ----------
        kind : {"time", "loop", "residuals", "residuals_displacement"}, default "time"
            "residuals" are drawn over time, "residuals_displacement" against displacement.
        ax : matplotlib Axes, optional
            To draw into, for residuals.
        record : int, default 0
            Which one.

        Returns
        -------
        matplotlib Axes
        """
        from dahl_ident.plots.waveforms import draw_record_fit

        return draw_record_fit(self, kind or "time", record, ax)


def _level(problem: RecordProblem) -> float:
    """Return the size of the input of records: of the displacement, or of the drive."""
    force = problem.output == "force"
    waves = [np.asarray(r.displacement if force else r.force_samples) for r in problem.records]
    return float(np.sqrt(np.mean(np.concatenate([w - w.mean() for w in waves]) ** 2)))


def solved(
    solve: Callable[[Tell | None], Optimum],
    *,
    first_order: bool,
    throw: bool,
    progress: bool,
) -> RecordFit:
    """Return the fit of records by a search that tells how it goes; see :func:`dahl_ident.fit`."""
    try:
        with fit_progress() if progress else nullcontext() as tell:
            fit = RecordFit(solve(tell), first_order=first_order)
    except FitInterrupted as stop:
        raise FitInterrupted(
            f"{stop}; this exception's `result` holds the best values so far",
            RecordFit(stop.result),
        ) from stop
    if throw and not fit.success:
        raise FitError(
            "not converged: the search stopped before it found a minimum; give start=, or fix a "
            "parameter",
            fit,
        )
    return fit

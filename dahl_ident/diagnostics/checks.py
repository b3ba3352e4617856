"""The checks of a fit: each yields findings, the worst of which sets the status.

Determined: every parameter, or which combinations. Described: size and kind of the misfit. Assumed:
what the result depends on and the data cannot test. A check uses quantities that fits of tables and
of records both have, unless it is marked as a check of tables or of records only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial, wraps
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.tabular import warnings_in
from dahl_ident.diagnostics.assessment import TableAssessment
from dahl_ident.diagnostics.contributions import NOISE, RUNS, TESTS
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.estimate import scores_of
from dahl_ident.diagnostics.formatting import with_unit
from dahl_ident.diagnostics.judgement import (
    Finding,
    Judgement,
    Question,
    VerdictStatus,
    assumed,
    described,
    determined,
)
from dahl_ident.diagnostics.misfit_explanations import rms_misfit_of
from dahl_ident.diagnostics.physics import (
    beyond_friction_limit,
    is_single,
    negative_elements,
    steady_findings,
    weak_elements,
)
from dahl_ident.diagnostics.record_assessment import RecordAssessment
from dahl_ident.diagnostics.record_errors import REMEDY
from dahl_ident.errors import FitError
from dahl_ident.extraction.segment_quality import clipped_share, sensor_step
from dahl_ident.fitting.losses import LOSSES
from dahl_ident.fitting.optimum import Optimum
from dahl_ident.noise import squares_of
from dahl_ident.units import si_unit

_LARGEST_RMS = 0.5  # misfit above which the model does not describe half of the response
_LARGEST_RMS_BEYOND_NOISE = 0.2  # the same if the misfit exceeds noise: intervals do not hold
_LARGEST_RMS_OF_WRONG_LAW = 0.05  # the same if another law has a far smaller misfit
_SLOW = 0.3  # effective share of the samples below which a misfit may look like slow noise
_VISIBLE = 0.05  # rms of such a misfit, as a share of the output, from which it is reported
_FEW_DOF = 10.0  # degrees of freedom: an uncertainty is then known to 20 %
_FEW_RUNS, _WIDE = 3, 4.0  # most runs that are few; k twice that of many
_FEWEST_INSIDE = 0.8  # of held-out values in 95 % bands, below which the bands do not hold
_ENOUGH_HELD_OUT = 16  # held-out values: with 16, fewer than 80 % in 95 % bands is a 1 % chance
_MOST_WARNINGS = 5  # warnings shown; more would hide the verdict
_CONTRADICTION = 0.0027  # p-value up to which the data contradict a constraint
_CONTRADICTED = 3.0  # standard deviations of a prior: once in 370 times by chance
_ITERATIONS, _SETTLED = 100, 1e-3  # most of a robust fit; its tolerance in uncertainties

_TRUSTED, _APPROXIMATE, _NOT_DETERMINED, _NOT_DESCRIBED = VerdictStatus
Assessed = TableAssessment | RecordAssessment
_Check = Callable[[Any], Iterable[Finding]]


def _limited(kind: str, check: _Check) -> _Check:
    """Return a check that applies to fits of one kind of data only."""

    @wraps(check)
    def limited(fit: Assessed) -> Iterable[Finding]:
        return check(fit) if fit.problem.kind == kind else ()

    return limited


_of_tables, _of_records = partial(_limited, "table"), partial(_limited, "records")


def judgement(fit: Assessed) -> Judgement:
    """Return the findings of every check, and the status that follows from them.

    Misfit findings of the reduced fit replace those of the fit where they are worse: harmonics or
    a stated covariance may otherwise hide a misfit of the fundamentals. If the data contradict a
    constraint, the residuals are not noise, even if no other test shows it.
    """
    findings = [finding for check in CHECKS for finding in check(fit)]
    if any(finding.code == "constraint" for finding in findings):
        findings = [finding for finding in findings if finding.code != "noise"]
    if fit.reduced is not None:
        worst = max(
            (f.severity.rank for f in findings if f.question is Question.DESCRIBED), default=0
        )
        hidden = [
            f
            for f in judgement(fit.reduced).findings
            if f.question is Question.DESCRIBED and f.severity.rank > worst
        ]
        replaced = {"noise", *(f.code for f in hidden)} if hidden else set()
        findings = [f for f in findings if f.code not in replaced] + hidden
    return Judgement(findings)


# Determined?


def _parameters(fit: Assessed) -> Iterator[Finding]:
    """Yield which parameters or combinations are determined."""
    if fit.goodness.sign:
        return  # with the wrong sign, parameters have no meaning
    optimum, identified = fit.optimum, fit.identifiability
    noise_known = optimum.scale_known or optimum.dof > 0
    if noise_known or identified.complete:
        yield identified.finding
    if noise_known and not identified.complete and identified.combinations:
        yield determined("combinations", combinations=tuple(map(str, identified.combinations)))
    if not fit.success:
        message = optimum.status.value if optimum.status.at_infinity else optimum.message
        yield determined("solver", message=message)
    if optimum.dof <= 0:
        yield determined(
            "no_degrees_of_freedom",
            numbers=optimum.problem.n_residuals,
            parameters=len(optimum.names),
            scale_known=optimum.scale_known,
        )
    if noise_known:
        for why in dict.fromkeys(parameter.why for parameter in identified.open):
            shown = {p.name: p.known_text for p in identified.open if p.why == why}
            yield determined("undetermined_parameters", shown=shown, why=why)


# Described?


def _reservations(fit: Assessed) -> list[Finding]:
    return [finding for check in RESERVATIONS for finding in check(fit)]


@_of_records
def _misfit_of_records(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield whether the model describes the records, then the reservations about the fit."""
    if fit.goodness.sign:
        yield described("sign", _NOT_DESCRIBED, convention=fit.goodness.sign)
        return
    problem, converged = fit.problem, fit.optimum.converged
    limit = _LARGEST_RMS_BEYOND_NOISE if fit.exceeds_noise else _LARGEST_RMS
    too_large = fit.goodness.rms_in_band > limit
    if too_large:
        yield described("records_not_described", _NOT_DESCRIBED, rms=fit.goodness.rms_in_band)
    displaced = all(record.displacement is not None for record in problem.records)
    if problem.output == "motion" and (too_large or not converged) and displaced:
        yield described("motion_may_be_imposed", _NOT_DESCRIBED)
    if fit.exceeds_noise and not too_large:
        follows = fit.errors.misfit.follows if fit.errors.misfit else ""
        kind, remedy = REMEDY.get(follows, ("", ""))
        if kind and all(element.kind != kind for element in problem.model.elements):
            remedy = f"add a {kind}, or {remedy}"
        yield described("records_misfit", _APPROXIMATE, follows=follows, remedy=remedy)
    effective = fit.errors.effective / problem.n_samples
    if not fit.exceeds_noise and effective < _SLOW and fit.goodness.rms_in_band > _VISIBLE:
        yield described("slow_misfit", _APPROXIMATE, rms=fit.goodness.rms_in_band)
    if fit.errors.dof_of(NOISE) < _FEW_DOF:
        few = {"effective": fit.errors.effective, "unknowns": len(problem.names)}
        yield described("few_effective_samples", _APPROXIMATE, **few)
    yield from _reservations(fit)


@_of_tables
def _misfit_of_table(fit: TableAssessment) -> Iterator[Finding]:
    """Yield the misfit, whether bands hold if there are objections, and the reservations."""
    goodness, reservations = fit.goodness, _reservations(fit)
    bands = list[Finding]()
    if not goodness.sign and (goodness.objections or goodness.flagged or reservations):
        bands = list(_bands(fit))
    unusable = (
        (fit.errors is None and fit.is_determined)
        or _stated_exponent_is_wrong(fit)
        or goodness.beyond_any_sensor
        or goodness.is_of_several_devices
        or any(finding.severity is _NOT_DESCRIBED for finding in bands)
    )
    limit = _LARGEST_RMS
    if goodness.objections:
        wrong = goodness.law_is_wrong
        limit = _LARGEST_RMS_OF_WRONG_LAW if wrong else _LARGEST_RMS_BEYOND_NOISE
    large = goodness.rms_misfit > limit
    severity = _NOT_DESCRIBED if unusable or large else _APPROXIMATE
    yield from goodness.findings(severity, counted=severity is _APPROXIMATE and fit.is_determined)
    if large and not goodness.objections:
        yield described("large_misfit", severity, rms=goodness.rms_misfit)
    yield from bands
    yield from reservations


def _stated_exponent_is_wrong(fit: TableAssessment) -> bool:
    """Return whether the data contradict an exponent that the user gave."""
    assumed = {p.name for p in fit.problem.model.parameters if p.assumed}
    return any(
        test.p_value <= fit.goodness.level and test.about not in assumed
        for test in fit.goodness.of("exponent")
    )


def _bands(fit: TableAssessment) -> Iterator[Finding]:
    """Yield whether the bands hold for values that were held out."""
    check = fit.cross_validation
    if check is None:
        return
    enough = check.count >= _ENOUGH_HELD_OUT
    if enough and fit.errors is not None:
        misfit = min(_misfit_within_runs(fit.errors), fit.goodness.rms_misfit)
        if check.width < misfit:  # misfits inside a band have an rms below its half width
            width, rms = check.width, fit.goodness.rms_misfit
            yield described("narrow_bands", _NOT_DESCRIBED, width=width, misfit=rms)
            return
    outside = enough and check.inside < _FEWEST_INSIDE * check.count
    yield check.finding(_NOT_DESCRIBED if outside else _TRUSTED)


def _misfit_within_runs(errors: ErrorModel) -> float:
    """Return the misfit that bands have to cover.

    It includes a smooth departure from the law. It does not include differences between runs,
    because a held-out row is predicted from the other rows of its run, nor a force in parallel with
    the model or a change with speed, on which bands are centred.
    """
    fitted = (errors.within_runs, errors.parallel_to_the_law)
    return min(rms_misfit_of(errors.problem, responses) for responses in fitted)


@_of_tables
def _beyond_limit(fit: TableAssessment) -> Iterator[Finding]:
    """Yield where a force exceeds the limit of friction, except in rows that stand apart."""
    errors, scatter = fit.errors, sum(fit.goodness.runs_scatter.values())
    optimum = fit.optimum if errors is None else errors.at_estimate
    excused = optimum.loss != "linear" or fit.goodness.apart  # outliers are reported as such
    outliers = [p.row for p in fit.goodness.suspicious] if excused else []
    yield from beyond_friction_limit(optimum, scatter, outliers)


def _unphysical(fit: Assessed) -> Iterator[Finding]:
    """Yield every mass, damping or stiffness below zero, and other physical objections."""
    yield from negative_elements(fit.problem, fit.known)
    for element in fit.model.elements:
        values = [p.value or 0.0 for p in element.parameters]
        if np.isfinite(values).all() and not is_single(element):
            for text in element.physical_objections(values):
                yield described("unphysical", _APPROXIMATE, objection=text)


def _weak_elements(fit: Assessed) -> Iterator[Finding]:
    """Yield every mass, damper or spring whose force is smaller than the misfit."""
    if fit.significant_misfit is not None:
        yield from weak_elements(fit.problem, fit.known, fit.force_share, *fit.significant_misfit)


def _constraints(fit: Assessed) -> Iterator[Finding]:
    """Yield the constraints if the data contradict them."""
    cost = fit.constraint_cost
    if cost is not None and cost.p_value <= _CONTRADICTION:
        known = {"noise_known": bool(np.isinf(cost.dof)), "p_value": cost.p_value}
        yield described(
            "constraint", _NOT_DESCRIBED, texts=tuple(cost.texts), rise=cost.rise, **known
        )


def _priors(fit: Assessed) -> Iterator[Finding]:
    """Yield every prior that the data contradict."""
    estimates = dict(zip(fit.optimum.names, fit.optimum.values.tolist(), strict=True))
    for name, prior in fit.problem.priors.items():
        value, mean, std = estimates[name], float(prior.mean()), float(prior.std())
        if abs(value - mean) > _CONTRADICTED * std:
            yield described("prior", _APPROXIMATE, name=name, value=value, mean=mean, std=std)


def _exponents(fit: Assessed) -> Iterator[Finding]:
    """Yield every assumed or stated exponent that the data contradict."""
    for exponent in fit.contradicted_exponents:
        name, value, u = exponent.name, exponent.indicated, exponent.stderr
        if exponent.range is None:
            values = {"held": exponent.fixed, "wanted": with_unit(value, u, "")}
            yield described("stated_exponent", _NOT_DESCRIBED, name=name, **values)
        else:
            low, high = exponent.range
            values = {"value": value, "stderr": u, "low": low, "high": high}
            yield described("beyond_range", _APPROXIMATE, name=name, **values)


@_of_tables
def _moved_by_outliers(fit: TableAssessment) -> Iterator[Finding]:
    """Yield the parameters that a robust fit moves by more than their uncertainty from noise."""
    if fit.optimum.loss != "linear" or fit.errors is None:
        return
    at = fit.by_noise
    moves = zip(robust_values(at), at.values, at.stderr.items(), strict=True)
    moved = tuple(name for robust, value, (name, u) in moves if abs(robust - value) > u)
    if moved:
        rows = tuple(point.name for point in fit.goodness.suspicious)
        yield described("moved", _APPROXIMATE, names=moved, rows=rows)


def robust_values(at: Optimum) -> FloatArray:
    """Return the values (P,) of a robust fit to the model linearised at an estimate.

    The scale of the noise, where it is not stated, is the robust one of
    :mod:`dahl_ident.fitting.losses`.
    """
    problem, loss, scale = at.problem, LOSSES["huber"], at.scale
    (y, J), m = problem.residuals_and_jacobian(at.theta), problem.n_residuals
    move: FloatArray = np.zeros(len(at.theta))
    for _ in range(_ITERATIONS):
        if not problem.scale_known:
            square = squares_of((y + J @ move)[:m] / scale)
            scale *= loss.rescaled(square, m - len(move)) ** 0.5
        unit = np.append(np.full(m, scale), np.ones(len(y) - m))  # priors have a known variance
        scores, columns = scores_of((y + J @ move) / unit, m, loss), J / unit[:, None]
        step = np.linalg.lstsq(columns, -scores, rcond=1e-10)[0]
        move = move + step
        if np.linalg.norm(columns @ step) < _SETTLED:
            break
    return np.asarray(problem.to_values(at.theta + move))


@_of_records
def _delay(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield the removed delay; one that exceeds the residuals is doubtful, unless it was stated."""
    problem = fit.problem
    if not problem.delay:
        return
    moved = problem.delay * np.concatenate(problem.delay_slopes(fit.optimum.values))
    exceeds = bool(np.sqrt(np.mean(moved**2)) > fit.goodness.rms)
    doubtful = exceeds and "delay" not in problem.calibration
    samples = problem.delay * problem.records[0].sample_rate
    lag = {"delay": problem.delay, "samples": samples, "doubtful": doubtful}
    yield described("delay", _APPROXIMATE if doubtful else _TRUSTED, **lag)


@_of_records
def _clipped(fit: RecordAssessment) -> Iterator[Finding]:
    """Yield the channels with clipped samples."""
    shares = dict[str, float]()
    for record in fit.problem.records:
        force = "drive" if record.force is None else "force"
        waves = {record.motion_channel: record.motion_samples, force: record.force_samples}
        for channel, samples in waves.items():
            share = clipped_share(samples, sensor_step(samples))
            weight = len(record) / fit.problem.n_samples
            shares[channel] = shares.get(channel, 0.0) + weight * share
    for channel, share in shares.items():
        if share:
            yield described("clipped", _NOT_DESCRIBED, channel=channel, share=share)


@_of_records
def _size_of_residuals(fit: RecordAssessment) -> Iterator[Finding]:
    problem, goodness = fit.problem, fit.goodness
    size = {"rms": goodness.rms_misfit, "output": problem.output, "worst": goodness.worst}
    yield described("record_residuals", **size)
    if problem.whitening.size > 1:
        yield described("slow_residuals", rms=goodness.rms_in_band)


@_of_records
def _treatment_of_noise(fit: RecordAssessment) -> Iterator[Finding]:
    problem = fit.problem
    if problem.displacement_noise or problem.is_smoothed:
        yield described(
            "displacement_noise",
            treatment="not counted as travel" if problem.displacement_noise else "smoothed out",
            noise=problem.estimated_noise if problem.is_smoothed else problem.displacement_noise,
            unit=si_unit("displacement", problem.motion),
            travel=problem.noise_travel,
        )
    size = {"effective": fit.errors.effective, "samples": problem.n_samples}
    yield described("effective_samples", **size)


# Assumed?


def reading(fit: Any) -> Iterator[Finding]:
    """Yield the warnings on reading the data of a fit or posterior."""
    texts = list(dict.fromkeys(text for p in fit.problem.provenances for text in warnings_in(p)))
    yield from (described("warning", text=text) for text in texts[:_MOST_WARNINGS])
    if len(texts) > _MOST_WARNINGS:
        yield described("more_warnings", count=len(texts) - _MOST_WARNINGS)


def _few_runs(fit: Assessed) -> Iterator[Finding]:
    """Yield that intervals are wide because few runs show the scatter between them."""
    if not fit.counts_sources or not 1 < fit.runs <= _FEW_RUNS:
        return
    with suppress(FitError):  # nothing is determined
        budgets = fit.budget().values()
        wide = [b.k for b in budgets if b.k > _WIDE >= b.k_without(RUNS, TESTS)]
        if wide:
            yield assumed("few_runs", k=max(wide), runs=fit.runs)


def assumptions(fit: Assessed, *, counted: bool = True) -> Iterator[Finding]:
    """Yield one finding with the assumptions that the data of a fit cannot test.

    If only noise is `counted`, other sources of error are among the assumptions.
    """
    counted = counted and fit.counts_sources
    estimates, stderr = fit.known
    ranges, stated = [], dict[str, float]()
    for p in fit.problem.model.parameters:
        if p.prior is None or p.free:
            continue
        if counted and p.name in fit.assumed:
            low, high = p.prior
            known = {"value": estimates[p.name], "stderr": stderr[p.name], "unit": p.unit}
            ranges.append({"name": p.name, "low": low, "high": high, **known})
        elif p.value is not None:
            stated[p.name] = p.value
    cost = fit.constraint_cost
    values = {
        "ranges": tuple(ranges),
        "stated": stated,
        "constraints": () if cost is None else tuple(cost.texts),
        "exact": fit.exact,
        "noise_alone": not counted,
        **fit.design(counted=counted),
    }
    if any(values.values()):
        yield assumed("assumed", **values)


RESERVATIONS: tuple[_Check, ...] = (
    _beyond_limit,
    _unphysical,
    _priors,
    _exponents,
    _moved_by_outliers,
)
"""Reasons not to trust a fit although its residuals may look like noise."""
CHECKS: tuple[_Check, ...] = (
    _constraints,
    _parameters,
    _misfit_of_table,
    _misfit_of_records,
    _weak_elements,
    _of_tables(lambda fit: steady_findings(fit.optimum, fit.model)),
    _clipped,
    _delay,
    _size_of_residuals,
    reading,
    _treatment_of_noise,
    _few_runs,
    assumptions,
)

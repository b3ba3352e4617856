"""The checks of a fit: each yields findings, of which the worst is the status.

Determined: every parameter, or which combinations. Described: size and kind of the misfit. Assumed:
what the result depends on and the data cannot test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.tabular import doubts
from dahl_ident.diagnostics.assessment import Assessment, TableAssessment
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.judgement import (
    Finding,
    Judgement,
    Question,
    VerdictStatus,
    described,
    undetermined,
)
from dahl_ident.diagnostics.misfit_explanations import rms_misfit_of
from dahl_ident.diagnostics.physics import (
    below_zero,
    beyond_friction_limit,
    slight,
    steady_findings,
)
from dahl_ident.elements import Element
from dahl_ident.fitting.losses import LOSSES

_TOO_LARGE = 0.5  # rms misfit: half of the response is not the model's
_FEWEST_INSIDE = 0.8  # of held-out values in 95 % bands, below which the bands do not hold
_ENOUGH_HELD_OUT = 16  # held-out values; of so many, 80 % lie in bands of 95 % once in 100 times
_DOUBTS_SHOWN = 5  # more would hide the verdict
_CHANCE = 0.0027  # probability that data contradict a right constraint or prior as much
_OUTSIDE = 2.0  # standard uncertainties beyond the end of a range
_CONTRADICTED = 3.0  # standard deviations of a prior: once in 370 times by chance
_PASSES, _SETTLED = 100, 1e-3  # of a robust fit: far below the one uncertainty that matters

_TRUSTED, _APPROXIMATE, _, _NOT_DESCRIBED = VerdictStatus


def judgement(fit: TableAssessment) -> Judgement:
    """Return the findings of every check, and with them the status.

    Neither harmonics nor a covariance hide what the fundamentals show without them.
    """
    findings = [finding for check in CHECKS for finding in check(fit)]
    if fit.with_less is not None:
        worst = max(
            (f.severity.rank for f in findings if f.question is Question.DESCRIBED), default=0
        )
        every = judgement(fit.with_less).findings
        hidden = [f for f in every if f.question is Question.DESCRIBED and f.severity.rank > worst]
        replaced = {"noise", *(f.code for f in hidden)} if hidden else set()
        findings = [f for f in findings if f.code not in replaced] + hidden
    return Judgement(findings)


# Determined?


def _parameters(fit: TableAssessment) -> Iterator[Finding]:
    """Yield which parameters or combinations are determined."""
    if fit.goodness.sign:
        return  # what the numbers leave undetermined says nothing of the mechanism
    optimum, known = fit.optimum, fit.identifiability
    can_tell = optimum.scale_known or optimum.dof > 0
    if can_tell or known.complete:
        yield known.finding
    if can_tell and not known.complete and known.combinations:
        yield undetermined("combinations", combinations=tuple(map(str, known.combinations)))
    if not optimum.success:
        message = optimum.status.value if optimum.status.at_infinity else optimum.message
        yield undetermined("solver", message=message)
    if optimum.dof <= 0:
        yield undetermined(
            "no_degrees_of_freedom", numbers=optimum.problem.n_residuals,
            parameters=len(optimum.names), scale_known=optimum.scale_known,
        )  # fmt: skip
    if can_tell:
        for why in dict.fromkeys(parameter.why for parameter in known.open):
            shown = {p.name: p.known_as for p in known.open if p.why == why}
            yield undetermined("undetermined_parameters", shown=shown, why=why)


# Described?


def _is_determined(fit: TableAssessment) -> bool:
    optimum, goodness = fit.optimum, fit.goodness
    determined = optimum.success and optimum.dof > 0 and goodness.judged and not goodness.sign
    return determined and fit.identifiability.complete


def _residuals(fit: TableAssessment) -> Iterator[Finding]:
    """Yield the size and kind of the misfit."""
    goodness = fit.goodness
    lost = (
        (fit.errors is None and _is_determined(fit))
        or _stated_exponent_is_wrong(fit)
        or goodness.beyond_any_sensor
        or goodness.of_several
        or any(finding.severity is _NOT_DESCRIBED for finding in _bands(fit))
    )
    large = goodness.rms_misfit > _TOO_LARGE
    severity = _NOT_DESCRIBED if lost or large else _APPROXIMATE
    yield from goodness.findings(severity, counted=severity is _APPROXIMATE and _is_determined(fit))
    if large and not goodness.objections:
        yield described("large_misfit", severity, rms=goodness.rms_misfit)


def _stated_exponent_is_wrong(fit: TableAssessment) -> bool:
    """Return whether the data contradict an exponent that the user gave."""
    exponent, parameters = fit.goodness.exponent, fit.problem.model.parameters
    if exponent is None or exponent.p_value > fit.goodness.level:
        return False
    return not any(p.assumed for p in parameters if p.name == exponent.name)


def _bands(fit: TableAssessment) -> Iterator[Finding]:
    """Yield whether the bands hold for what was held out, where anything speaks against the fit."""
    goodness = fit.goodness
    if goodness.sign or not (goodness.objections or goodness.flagged or any(_reservations(fit))):
        return
    check = fit.cross_validation
    if check is None:
        return
    enough = check.count >= _ENOUGH_HELD_OUT
    if enough and fit.errors is not None:
        misfit = min(_misfit_within_runs(fit.errors), goodness.rms_misfit)
        if check.width < misfit:  # misfits inside a band have an rms below its half width
            width, rms = check.width, goodness.rms_misfit
            yield described("narrow_bands", _NOT_DESCRIBED, width=width, misfit=rms)
            return
    outside = enough and check.inside < _FEWEST_INSIDE * check.count
    yield check.finding(_NOT_DESCRIBED if outside else _TRUSTED)


def _misfit_within_runs(errors: ErrorModel) -> float:
    """Return the misfit that bands have to cover.

    It is that within runs: a row that was held out leaves other rows of its run. A force in
    addition to the model and a change with speed do not count, as bands are centred on them.
    A smooth departure from the law does: parameters of another law have no uncertainty.
    """
    fitted = (errors.within_runs, errors.parallel_to_the_law)
    return min(rms_misfit_of(errors.problem, each) for each in fitted)


def _reservations(fit: TableAssessment) -> Iterator[Finding]:
    """Yield reasons not to trust a fit although its residuals may look like noise."""
    yield from _beyond_limit(fit)
    yield from below_zero(fit.problem, fit.known)
    yield from _contradicted_priors(fit)
    yield from _beyond_range(fit)
    yield from _moved_by_outliers(fit)


def _beyond_limit(fit: TableAssessment) -> Iterator[Finding]:
    """Yield where a force exceeds what friction can carry; not rows that a loss sets aside."""
    errors, differ = fit.errors, fit.goodness.runs_differ
    scatter = 0.0 if differ is None else sum(differ.scatter.values())
    optimum = fit.optimum if errors is None else errors.at_estimate
    aside = [p.row for p in fit.goodness.suspicious] if optimum.loss != "linear" else []
    yield from beyond_friction_limit(optimum, scatter, aside)


def _slight(fit: TableAssessment) -> Iterator[Finding]:
    """Yield a finding for every mass, damper or spring of less force than the model misses."""
    view = fit.problem.stiffness_data
    rows = view.harmonic == 1
    if not (fit.goodness.objections and _is_determined(fit) and rows.any()):
        return
    misfit = within = fit.goodness.rms_misfit
    if fit.errors is not None:  # differences between runs are not part of the misfit
        within = min(misfit, rms_misfit_of(fit.errors.problem, fit.errors.within_runs))

    def share_of(element: Element, value: float) -> float:
        part = view.of(element, [np.asarray(value)])[rows] / view.stiffness[rows]
        return float(np.sqrt(np.mean(np.abs(part) ** 2)))

    yield from slight(fit.problem, fit.known, share_of, within, misfit)


def constraints(fit: Assessment) -> Iterator[Finding]:
    """Yield the constraints that the data contradict: their cost is not due to chance."""
    cost = fit.constraint_cost
    if cost is not None and cost.p_value <= _CHANCE:
        yield described(
            "constraint", _NOT_DESCRIBED, texts=tuple(cost.texts), rise=cost.rise,
            noise_known=bool(np.isinf(cost.dof)), p_value=cost.p_value,
        )  # fmt: skip


def _contradicted_priors(fit: TableAssessment) -> Iterator[Finding]:
    """Yield every prior that the data contradict."""
    estimates = dict(zip(fit.optimum.names, fit.optimum.values.tolist(), strict=True))
    for name, prior in fit.problem.priors.items():
        value = estimates[name]
        mean = float(prior.mean())
        std = float(prior.std())
        if abs(value - mean) > _CONTRADICTED * std:
            yield described("prior", _APPROXIMATE, name=name, value=value, mean=mean, std=std)


def _beyond_range(fit: TableAssessment) -> Iterator[Finding]:
    """Yield every assumed exponent that the data put outside its range."""
    errors = fit.errors
    if errors is None:
        return
    ranged = {p.name: p.prior for p in errors.problem.parameters}
    for name in errors.problem.ranges:
        low, high = ranged[name] or (0.0, np.inf)
        value, u = errors.values[name], errors.stderr[name]
        if max(low - value, value - high) > _OUTSIDE * u:
            ends = {"low": low, "high": high}
            yield described("beyond_range", _APPROXIMATE, name=name, value=value, stderr=u, **ends)


def _moved_by_outliers(fit: TableAssessment) -> Iterator[Finding]:
    """Yield which parameters a robust fit moves by more than one uncertainty."""
    optimum, errors = fit.optimum, fit.errors
    if optimum.loss != "linear" or errors is None:
        return
    robust, by_noise = robust_values(errors, optimum.scale)
    moved = tuple(
        name for name in optimum.names if abs(robust[name] - errors.values[name]) > by_noise[name]
    )
    if moved:
        rows = tuple(point.name for point in fit.goodness.suspicious)
        yield described("moved", _APPROXIMATE, names=moved, rows=rows)


def robust_values(
    errors: ErrorModel, scale: float
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Return a robust fit's values about the estimate, by iterated weights of a linear model.

    Also the standard errors of the estimate by its weights. Assumed exponents stay where they are.
    The noise's scale, where it is not stated, is the robust one of
    :mod:`dahl_ident.fitting.losses`, from `scale` on.
    """
    problem, loss = errors.estimate.problem, LOSSES["huber"]
    y, J = problem.residuals_and_jacobian(errors.theta)
    free = [i for i, name in enumerate(problem.names) if name not in errors.assumed]
    J, rows = J[:, free], problem.n_residuals // 2
    variance = 1.0 if problem.scale_known else scale**2
    weight = np.ones(len(y))
    weight[2 * rows :] = variance  # priors have a known variance
    known = np.linalg.pinv(J.T @ (weight[:, None] * J) / variance)
    move: FloatArray = np.zeros(len(free))
    for _ in range(_PASSES):
        square = np.sum((y + J @ move)[: 2 * rows].reshape(rows, 2) ** 2, axis=1)
        if not problem.scale_known:
            variance *= loss.rescaled(square / variance, 2 * rows - len(free))
        weight[: 2 * rows] = np.repeat(loss.slope(square / variance), 2)
        weight[2 * rows :] = variance
        root = np.sqrt(weight)
        last = move
        move = np.asarray(np.linalg.lstsq(root[:, None] * J, -root * y, rcond=1e-10)[0])
        if np.linalg.norm(J @ (move - last)) < _SETTLED * np.sqrt(variance):
            break
    theta, std = errors.theta.copy(), np.zeros(len(errors.theta))
    theta[free] += move
    std[free] = np.sqrt(np.diagonal(known))
    std *= np.abs(problem.value_slopes(errors.theta))
    robust = dict(zip(problem.names, problem.to_values(theta).tolist(), strict=True))
    by_noise = dict(zip(problem.names, std.tolist(), strict=True))
    return robust, by_noise


def _steady(fit: TableAssessment) -> Iterator[Finding]:
    yield from steady_findings(fit.optimum, fit.model)


# Assumed?


def reading(fit: Any) -> Iterator[Finding]:
    """Yield the warnings that were shown when the data of a fit or posterior were read."""
    texts = list(dict.fromkeys(text for one in fit.problem.provenances for text in doubts(one)))
    yield from (described("warning", text=text) for text in texts[:_DOUBTS_SHOWN])
    if len(texts) > _DOUBTS_SHOWN:
        yield described("more_warnings", count=len(texts) - _DOUBTS_SHOWN)


def assumed(fit: Assessment) -> Iterator[Finding]:
    """Yield the assumptions of a fit."""
    yield from fit.assumptions()


CHECKS: tuple[Callable[[TableAssessment], Iterable[Finding]], ...] = (
    constraints,
    _parameters,
    _residuals,
    _bands,
    _reservations,
    _slight,
    _steady,
    reading,
    assumed,
)

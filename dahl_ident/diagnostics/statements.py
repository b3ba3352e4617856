"""The verdict on a fit: its status, and one short sentence for each of three questions.

Determined: every parameter, or which combinations. Described: size and kind of the misfit. Assumed:
what the result depends on and the data cannot test. The most serious statement comes first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.data.tabular import doubts
from dahl_ident.diagnostics.budget import taken_as_exact
from dahl_ident.diagnostics.cross_validation import CrossValidation
from dahl_ident.diagnostics.doubtful_elements import below_zero, is_single, slight
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.formatting import listed, p_text, percent, with_unit
from dahl_ident.diagnostics.goodness import Goodness
from dahl_ident.diagnostics.misfit_explanations import rms_misfit_of
from dahl_ident.diagnostics.parameters import parameter_values
from dahl_ident.diagnostics.steady_motion import steady_statements
from dahl_ident.diagnostics.verdict_status import VerdictStatus
from dahl_ident.diagnostics.verdicts import Identifiability
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.losses import LOSSES

_TOO_LARGE = 0.5  # rms misfit: half of the response is not the model's
_FEWEST_INSIDE = 0.8  # of held-out values in 95 % bands, below which the bands do not hold
_NARROWEST = 0.7  # half width of 95 % bands over the rms misfit, which for noise is 1.4
_ENOUGH_HELD_OUT = 16  # values, of which 80 % in bands of 95 % happen once in 100 times
_DOUBTS_SHOWN = 5  # more would hide the verdict
_CHANCE = 0.0027  # that data contradict a right constraint as much, as for a prior
_CONTRADICTED = 3.0  # standard deviations of a prior: once in 370 times by chance
_PASSES, _SETTLED = 100, 1e-3  # of a robust fit: far below the one uncertainty that matters


class Judged(Protocol):
    """The input of a verdict."""

    @property
    def optimum(self) -> Optimum:
        """The solver's result."""

    @property
    def goodness(self) -> Goodness:
        """Tests of the residuals."""

    @property
    def identifiability(self) -> Identifiability:
        """What the data determine."""

    @property
    def errors(self) -> ErrorModel | None:
        """The sources of error."""

    @property
    def cross_validation(self) -> CrossValidation | None:
        """The check of the bands."""


def verdict_status(fit: Judged) -> VerdictStatus:
    """Return whether a fit's numbers can be used."""
    optimum, goodness = fit.optimum, fit.goodness
    if goodness.sign or _contradicted_constraints(fit):
        return VerdictStatus.NOT_DESCRIBED
    determined = optimum.success and optimum.dof > 0 and goodness.judged
    if not determined or not fit.identifiability.complete:
        return VerdictStatus.NOT_DETERMINED
    if goodness.rms_misfit > _TOO_LARGE or _noise_of_no_sensor(goodness):
        return VerdictStatus.NOT_DESCRIBED
    if not any((goodness.objections, goodness.flagged, *_reservations(fit))):
        return VerdictStatus.TRUSTED
    if goodness.objections and (fit.errors is None or _stated_exponent_is_wrong(goodness, optimum)):
        return VerdictStatus.NOT_DESCRIBED
    return VerdictStatus.APPROXIMATE if _bands_hold(fit) else VerdictStatus.NOT_DESCRIBED


def statements(fit: Judged) -> tuple[str, ...]:
    """Return the verdict in its parts: the first gives the status, the others the reasons."""
    status, data = verdict_status(fit), fit.optimum.problem.data
    goodness, known = fit.goodness, fit.identifiability
    if status is VerdictStatus.TRUSTED:
        first = f"Trusted. {known.headline} {goodness.headline}"
        taken = steady_statements(fit.optimum)
        return (first, *taken, *doubted(data.provenance), *assumptions(fit.optimum, fit.errors))
    if status is VerdictStatus.APPROXIMATE:
        found = list(goodness.statements)
        if goodness.described in found and goodness.objections:
            found.remove(goodness.described)
            misfit = f"misfit of {percent(goodness.rms_misfit)} rms"
            found.insert(0, f"The stated uncertainties include a {misfit}: {goodness.departures}.")
        first, *others = (*found, *_reservations(fit), known.headline)
        said = (
            *others, *_slight(fit), *_checked(fit), *steady_statements(fit.optimum),
            *doubted(data.provenance),
        )  # fmt: skip
        return (f"Approximate. {first}", *said, *assumptions(fit.optimum, fit.errors))
    first, *others = _objections(fit)
    taken = steady_statements(fit.optimum)
    return (f"{status.capitalize()}. {first}", *others, *taken, *doubted(data.provenance))


def doubted(*provenances: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield the warnings that were shown when the data were read."""
    found = list(dict.fromkeys(text for one in provenances for text in doubts(one)))
    for text in found[:_DOUBTS_SHOWN]:
        yield f"Warning on reading: {text}."
    if len(found) > _DOUBTS_SHOWN:
        yield f"{len(found) - _DOUBTS_SHOWN} more warnings on reading."


def _noise_of_no_sensor(goodness: Goodness) -> bool:
    return any("more than any sensor's noise" in objection for objection in goodness.objections)


def _stated_exponent_is_wrong(goodness: Goodness, optimum: Optimum) -> bool:
    """Return whether the data contradict an exponent that the user gave."""
    exponent = goodness.exponent
    if exponent is None or exponent.p_value > goodness.level:
        return False
    given = {p.name: p for p in optimum.problem.model.parameters}
    return not given[exponent.name].assumed


def _bands_hold(fit: Judged) -> bool:
    check = fit.cross_validation
    if check is None or check.count < _ENOUGH_HELD_OUT:
        return True
    return not _too_narrow(fit) and check.inside >= _FEWEST_INSIDE * check.count


def _too_narrow(fit: Judged) -> str:
    """Return what is wrong with bands that leave out most of the misfit; empty where they hold.

    The misfit is that within runs: a row that was held out has others of its run beside it.
    Nor do a force beside the model and a change with speed count, on which the bands are centred.
    A smooth departure from the law does: parameters of another law have no uncertainty.
    """
    check, errors = fit.cross_validation, fit.errors
    if check is None or errors is None:
        return ""
    fitted = (errors.near.fitted, errors.beside_the_law)
    misfit = min(rms_misfit_of(errors.problem, each) for each in fitted)
    if check.width >= _NARROWEST * misfit:
        return ""
    return (
        f"The 95 % bands (half width {percent(check.width)}) do not cover the misfit "
        f"({percent(misfit)} rms): no uncertainty can be stated."
    )


def _checked(fit: Judged) -> Iterator[str]:
    check = fit.cross_validation
    if check is not None:
        text = str(check)
        yield f"{text[0].upper()}{text[1:]}."


def _reservations(fit: Judged) -> Iterator[str]:
    """Yield what keeps a fit from being trusted although its residuals may look like noise."""
    yield from _below_zero(fit)
    yield from _contradicted_priors(fit)
    yield from _moved_by_outliers(fit)


def _estimates(fit: Judged) -> tuple[dict[str, float], Mapping[str, float]]:
    """Return the values of all parameters, and standard uncertainties of those estimated."""
    optimum, errors = fit.optimum, fit.errors
    values = parameter_values(optimum)
    values |= dict(zip(optimum.names, optimum.values.tolist(), strict=True))
    return (
        (values, optimum.stderr)
        if errors is None
        else (values | dict(errors.values), errors.stderr)
    )


def _below_zero(fit: Judged) -> Iterator[str]:
    """Yield a statement for every mass, damping or stiffness clearly below zero."""
    values, stderr = _estimates(fit)
    problem = fit.optimum.problem
    single = [e.parameters[0] for e in problem.model.elements if is_single(e)]
    yield from below_zero(single, values, stderr, problem.data.motion)


def _slight(fit: Judged) -> Iterator[str]:
    """Yield a statement for every mass, damper or spring of less force than the model misses."""
    if not fit.goodness.objections:
        return
    values, stderr = _estimates(fit)
    misfit, errors = fit.goodness.rms_misfit, fit.errors
    if errors is not None:  # what an exponent explains is not missed
        misfit = rms_misfit_of(errors.problem, errors.near.fitted)
    view = fit.optimum.problem.stiffness_data
    rows = view.harmonic == 1
    for element in fit.optimum.problem.model.elements:
        if is_single(element) and rows.any():
            (parameter,) = element.parameters
            value = values[parameter.name]
            part = view.of(element, [np.asarray(value)])[rows] / view.stiffness[rows]
            share = float(np.sqrt(np.mean(np.abs(part) ** 2)))
            error = float(stderr.get(parameter.name, 0.0))
            yield from slight(parameter, value, error, share, misfit)


def _contradicted_constraints(fit: Judged) -> str:
    """Return a statement on constraints that the data contradict; empty where they do not."""
    cost = fit.optimum.constraint_cost
    if cost is None or cost.p_value > _CHANCE:
        return ""
    against = "known noise" if np.isinf(cost.dof) else "the noise of the fit without them"
    return (
        f"The data contradict the constraint {listed(cost.texts)}: the sum of squares rises by "
        f"{cost.rise:.3g} times the variance of {against} ({p_text(cost.p_value)}): check the "
        "constraint, or the model."
    )


def _contradicted_priors(fit: Judged) -> Iterator[str]:
    """Yield a statement for every prior that the data contradict."""
    optimum = fit.optimum
    values = dict(zip(optimum.names, optimum.values.tolist(), strict=True))
    for name, prior in optimum.problem.priors.items():
        mean, std = float(prior.mean()), float(prior.std())
        apart = abs(values[name] - mean) / std
        if apart > _CONTRADICTED:
            yield (
                f"The data contradict the prior of {name}: {values[name]:.4g} against "
                f"{mean:g} ± {std:g}, {apart:.1f} standard deviations: check the calibration, or "
                "the model."
            )


def _moved_by_outliers(fit: Judged) -> Iterator[str]:
    """Yield a statement on parameters that a robust fit moves by more than one uncertainty."""
    optimum, errors = fit.optimum, fit.errors
    if optimum.loss != "linear" or errors is None:
        return
    robust, by_noise = _robust_values(errors, optimum.scale)
    moved = [
        name for name in optimum.names if abs(robust[name] - errors.values[name]) > by_noise[name]
    ]
    if moved:
        named = "; ".join(point.name for point in fit.goodness.suspicious[:5])
        rows = named or "the rows with the largest residuals"
        yield (
            f"A robust fit moves {listed(moved)} by more than one standard uncertainty: look at "
            f'{rows}, or fit with loss="huber".'
        )


def _robust_values(
    errors: ErrorModel, scale: float
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Return a robust fit's values about the estimate, by iterated weights of a linear model.

    Also the standard errors of the estimate by its weights. Assumed exponents stay where they are.
    The noise's scale, where it is not stated, is the robust one of
    :mod:`dahl_ident.fitting.losses`, from `scale` on.
    """
    problem, loss = errors.problem, LOSSES["huber"]
    y, J = problem.residuals_and_jacobian(errors.theta, tails=False)
    if problem.scale_known:
        y, J = errors.estimate.weighted(y), errors.estimate.weighted(J)
    free = [i for i, name in enumerate(problem.names) if name not in errors.assumed]
    J, rows = J[:, free], problem.n_residuals // 2
    variance = 1.0 if problem.scale_known else scale**2
    weight = np.ones(len(y))
    weight[2 * rows :] = variance  # priors have their own
    known = np.linalg.pinv(J.T @ (weight[:, None] * J) / variance)
    move: FloatArray = np.zeros(len(free))
    for _ in range(_PASSES):
        square = np.sum((y + J @ move)[: 2 * rows].reshape(rows, 2) ** 2, axis=1)
        if not problem.scale_known:
            variance *= loss.rescaled(square / variance, 2 * rows - len(free))
        weight[: 2 * rows] = np.repeat(loss.slope(square / variance), 2)
        weight[2 * rows :] = variance
        root = np.sqrt(weight)
        last, found = move, np.linalg.lstsq(root[:, None] * J, -root * y, rcond=1e-10)
        move = np.asarray(found[0])
        if np.linalg.norm(J @ (move - last)) < _SETTLED * np.sqrt(variance):
            break
    theta, std = errors.theta.copy(), np.zeros(len(errors.theta))
    theta[free] += move
    std[free] = np.sqrt(np.diagonal(known))
    std *= np.abs(problem.value_slopes(errors.theta))
    values = problem.to_values(theta)
    names = problem.names
    return (
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, std.tolist(), strict=True)),
    )


def assumptions(optimum: Optimum, errors: ErrorModel | None) -> Iterator[str]:
    """Yield one sentence with the assumptions that these data cannot test."""
    parts = []
    for parameter in optimum.problem.model.parameters:
        if parameter.prior is None or parameter.free:
            continue
        low, high = parameter.prior
        if parameter.assumed and errors is not None and parameter.name in errors.assumed:
            found = with_unit(
                errors.values[parameter.name], errors.stderr[parameter.name], parameter.unit
            )
            parts.append(f"{parameter.name} between {low:g} and {high:g} (here {found})")
        elif parameter.value is not None:
            parts.append(f"{parameter.name} = {parameter.value:g} exactly")
    names = {p.name for p in optimum.problem.sensors.parameters if p.free}
    if "delay" in names and "force_gain" not in names:
        parts.append("force_gain = 1 exactly")
    if optimum.constraint_cost is not None:
        parts.append(f"the constraint {listed(optimum.constraint_cost.texts)}")
    exact = taken_as_exact(optimum)
    if exact:
        parts.append(f"{listed(exact)} exact")
    if len(optimum.problem.data.runs or ()) < 2:
        parts.append("a single run")
    if errors is None:
        parts.append("no error but noise (stated uncertainties are from noise alone)")
    if parts:
        yield f"Assumed: {'; '.join(parts)}."


def _objections(fit: Judged) -> Iterator[str]:
    """Yield the objections to a fit, a sentence or more each."""
    optimum, goodness = fit.optimum, fit.goodness
    if goodness.cause:
        yield from goodness.statements
    if goodness.sign:
        return  # what the numbers leave undetermined says nothing of the mechanism
    contradicted = _contradicted_constraints(fit)
    if contradicted:
        yield contradicted
    known = fit.identifiability
    can_tell = optimum.scale_known or optimum.dof > 0
    if can_tell and not known.complete:
        yield known.headline
        if known.combinations:
            yield f"Determined: {'; '.join(map(str, known.combinations))}."
    if not optimum.success:
        yield optimum.status.value if optimum.status.at_infinity else optimum.message
    if optimum.dof <= 0:
        judged = "the model" if optimum.scale_known else "noise and model"
        yield (
            f"{optimum.problem.n_residuals} numbers and {len(optimum.names)} parameters leave no "
            f"degree of freedom to judge {judged}: measure more points."
        )
    if can_tell and not known.complete:
        yield from known.reasons
    if not goodness.acceptable and not goodness.cause:
        yield from goodness.statements
    if not _bands_hold(fit):
        yield _too_narrow(fit) or next(_checked(fit))
    yield from _reservations(fit)

"""Which model describes the data, and the quantities of friction that do not depend on the model.

Candidates follow from the misfit of the fit: a mean force suggests two limits, a response that
changes with frequency a damper, a force that falls with it LuGre's law, any other misfit another
shape of loop. Each is judged by how it predicts tests that it was not fitted to
(:mod:`dahl_ident.diagnostics.held_out`). Of those whose density is within one standard
error of the highest, the simplest is the best. The model fitted stays the best unless another's
density is higher by more than chance explains among many candidates. AIC and BIC are not used: with
harmonics whose covariance is tiny they prefer a model that fits the fundamental badly. If no model
describes the data, the best of them does not either; a model with negative damping does not
describe a mechanism. Each model is fitted as :func:`dahl_ident.fit` fits it, with the range of an
exponent that the user did not give.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy import special

from dahl_ident.arrays import TINY, FloatArray
from dahl_ident.diagnostics.error_model import error_model
from dahl_ident.diagnostics.formatting import listed, table, with_unit
from dahl_ident.diagnostics.held_out import PredictiveDensity, predictive_density
from dahl_ident.diagnostics.information import Information, parameter_values, values_at
from dahl_ident.diagnostics.physics import (
    OF_FRICTION,
    friction_quantities,
    is_spring,
    negative_elements,
)
from dahl_ident.diagnostics.record_channels import RELATIVE_STEP
from dahl_ident.diagnostics.slip_density import FAR_LESS, least_misfit
from dahl_ident.diagnostics.verdicts import NOT_IDENTIFIED_ABOVE
from dahl_ident.elements import (
    Damper,
    Element,
    Mass,
    Model,
    Parameter,
    PowerDamper,
    Spring,
)
from dahl_ident.elements.element import Alternative, as_model
from dahl_ident.errors import DahlIdentError, ValidationError
from dahl_ident.fitting import Optimum, solve
from dahl_ident.fitting.optimum import NO_EFFECT
from dahl_ident.problem import Problem
from dahl_ident.units import percent

_RISE_BY_CHANCE = 4.0  # rise of the log density that the best of ten needless candidates may have
_ASTRAY = 0.5  # misfit above which a search has failed
_RATE_RANGE = 1.05  # least ratio of highest to lowest frequency that can show rate dependence
_GAIN_DEGREE = 8  # degree in ln A of the change of gain that is allowed at every frequency
_FALL_BY_CHANCE = 1e-4  # rate for a force that falls with the frequency, which adds a candidate
_DISTINGUISHED = 3.0  # rms difference over noise averaged over all rows, that distinguishes laws
_RUNAWAY = 100.0  # ratio to the fit's value, above which the data leave a parameter open
_UNUSUAL = 5.0  # factor beyond the usual range of an exponent that no mechanism has
_DISAGREE = 0.2  # relative difference of force limits or stiffnesses that matters to the user
_PLACES = 6  # decimals of a change: less is rounding
_VAGUE = 0.5  # relative standard error from which a parameter is not determined


@dataclass(frozen=True)
class ComparedModel:
    """One model's fit to the data."""

    name: str  # what distinguishes it
    optimum: Optimum  # its estimate
    density: PredictiveDensity  # how it predicts tests left out
    reason: str = ""  # evidence in the data for trying it
    # of the model that was fitted: its parameters as the fit states them, with every source of
    # error; errors of the others are from noise alone
    stated: Mapping[str, Any] | None = None

    @property
    def complexity(self) -> int:
        """Number of free parameters, except exponents estimated within an assumed range."""
        problem = self.optimum.problem
        return len(problem.names) - (len(problem.ranges) if problem.kind == "table" else 0)

    @property
    def estimates(self) -> str:
        """The free parameters in one line; those without an error are not determined."""
        rows = [(p.name, v, e, p.unit) for p, v, e in self._estimated]
        if self.stated is not None:
            stated = self.stated.values()
            rows = [(p.name, p.value, p.stderr, p.unit) for p in stated if p.stderr is not None]
        known = [f"{name} = {with_unit(v, e, unit)}" for name, v, e, unit in rows if np.isfinite(e)]
        unknown = [name for name, _, e, _ in rows if not np.isfinite(e)]
        return ", ".join(known + ([f"{listed(unknown)} not determined"] if unknown else []))

    @property
    def _estimated(self) -> list[tuple[Parameter, float, float]]:
        """The free parameters of the model, with value and standard error of each."""
        optimum, count = self.optimum, self.optimum.problem.n_reported
        parameters = optimum.problem.parameters[:count]
        return list(zip(parameters, optimum.values.tolist(), optimum.stderr.values(), strict=False))

    @cached_property
    def is_determined(self) -> bool:
        """Whether every parameter's standard error is below half of its value, or typical size.

        For a table, every source of error counts. The identical parts of a law, such as those of
        Maxwell slip, need not be determined one by one.
        """
        stderr = self.optimum.stderr
        parts = set[str]()
        for element in self.optimum.problem.model.elements:
            labels = {label for part in element.like_parts for label in part}
            parts |= {element.parameter(label).name for label in labels}

        def size(parameter: Parameter) -> float:
            """Return the typical size of a parameter that may be zero; 0 for others."""
            may_be_zero = parameter.lower < 0.0
            sizes = self.optimum.problem.unit_sizes(parameter.dimension)
            return float(np.median(sizes)) * may_be_zero

        return all(
            np.isfinite(value)
            and (p.name in parts or stderr[p.name] < _VAGUE * max(abs(value), size(p)))
            for p, value, _ in self._estimated
        )

    @property
    def is_physical(self) -> bool:
        """Whether every exponent is near its usual range."""
        return all(
            p.prior[0] / _UNUSUAL < value < p.prior[1] * _UNUSUAL
            for p, value, _ in self._estimated
            if p.is_exponent and p.prior is not None
        )

    @cached_property
    def meaning(self) -> dict[str, float]:
        """Quantities common to all laws: force limit, stiffness at zero force, energies.

        They are those of all elements with memory together: N, N/m, and joules lost in a cycle at
        the smallest, the middle and the largest amplitude; of records, at their rms displacements.
        Infinite if a law never slips, NaN if these data do not determine them.
        """
        problem = self.optimum.problem
        quantities = friction_quantities(problem, parameter_values(self.optimum))
        undetermined = _undetermined(self.optimum, quantities)
        if self.stated is not None:
            quantities = friction_quantities(
                problem, {name: p.value for name, p in self.stated.items()}
            )
        return quantities | dict.fromkeys(undetermined, np.nan)

    @property
    def resemblances(self) -> list[str]:
        """Sentences on elements that these data cannot distinguish from a simpler one."""
        problem, values = self.optimum.problem, parameter_values(self.optimum)
        sentences = []
        for element in problem.model.elements:
            at_element = [values[p.name] for p in element.parameters]
            resemblance = element.resembles(at_element, *_levels(problem))
            if resemblance is not None and resemblance[1] < _DISTINGUISHED * self.density.noise:
                sentences.append(
                    f"{self.name}: at these levels it differs from {resemblance[0]} by "
                    f"{percent(resemblance[1])} rms, too little for these data to distinguish the "
                    "two."
                )
        return sentences


@dataclass(frozen=True)
class ModelComparison:
    """Models side by side; the first is the one that was fitted.

    Examples
    --------
    >>> import dahl_ident as di
    >>> comparison = di.compare_models(di.fit(di.load_dataset("alpha_2"), di.Dahl(alpha=1.0)))
    >>> comparison.best.name
    'exponent free'
    """

    models: tuple[ComparedModel, ...]  # those that could be fitted
    failed: Mapping[str, str]  # why the others could not

    @cached_property
    def best(self) -> ComparedModel:
        """The simplest model within one standard error of the highest predictive density.

        Apart from the one that was fitted, only models count whose parameters are determined and
        physical, and whose force limit and stiffness are below a hundred times those of the fit.
        The model that was fitted is kept where models that the data do not distinguish disagree
        (`undecided`), and where a model that the data do not determine has a far smaller misfit
        (`undetermined`).
        """
        return self.models[0] if self.undecided or self.undetermined else self._simplest

    @cached_property
    def undetermined(self) -> ComparedModel | None:
        """A physical model with far less misfit than the best, which the data do not determine."""
        best = self._simplest
        physical = [model for model in self.models if model.is_physical or model is best]
        likeliest = max(physical, key=lambda model: model.density.total)
        gain, error = likeliest.density.gain_over(best.density)
        far_less = likeliest.density.misfit < FAR_LESS * best.density.misfit
        return likeliest if far_less and gain > max(error, _RISE_BY_CHANCE) else None

    @cached_property
    def undecided(self) -> tuple[ComparedModel, ...]:
        """The simplest of the models that these data do not distinguish, and one that disagrees.

        The second is the likeliest with another force limit or stiffness at zero force. Empty if
        there is none, or if the simplest is the model that was fitted.
        """
        best = self._simplest
        others = [m for m in self._alike if m is not self.models[0] and _disagreement(best, m)]
        if best is self.models[0] or not others:
            return ()
        return best, max(others, key=lambda model: model.density.total)

    @cached_property
    def _likeliest(self) -> ComparedModel:
        return max(filter(self._is_sound, self.models), key=lambda model: model.density.total)

    @cached_property
    def _alike(self) -> list[ComparedModel]:
        """The sound models that these data do not distinguish from the likeliest."""
        alike = []
        for model in self.models:
            gain, error = self._likeliest.density.gain_over(model.density)
            if gain <= max(error, _RISE_BY_CHANCE) and self._is_sound(model):
                alike.append(model)
        return alike

    @property
    def _simplest(self) -> ComparedModel:
        return min(self._alike, key=lambda model: (model.complexity, -model.density.total))

    def _is_sound(self, model: ComparedModel) -> bool:
        """Return whether a model is the one that was fitted, or physical and determined."""
        fitted = self.models[0]
        sizes = [(model.meaning[k], fitted.meaning[k]) for k in OF_FRICTION]
        runs_away = any(b > 0.0 and a > _RUNAWAY * b for a, b in sizes)
        is_sound = model.is_physical and not runs_away and model.is_determined
        return model is fitted or is_sound

    @property
    def headline(self) -> str:
        """The verdict in a sentence or two."""
        first, best = self.models[0], self.best
        output = first.optimum.problem.output_in_words
        if self.undecided:
            simplest, other = self.undecided
            key = _disagreement(simplest, other)
            sizes = listed([f"{m.meaning[key]:.3g}" for m in self.undecided])
            return (
                f"{simplest.name} and {other.name} would both be better, and these data do not "
                f"distinguish them: {key} {sizes}. Neither is recommended."
            )
        if self.undetermined is not None:
            misfit = percent(self.undetermined.density.misfit)
            return (
                f"{self.undetermined.name} would leave far less ({misfit} of {output}), but these "
                "data do not determine its parameters. No model compared is recommended."
            )
        if best is first:
            return "No model compared is better than the one fitted."
        gain, error = best.density.gain_over(first.density)
        text = (
            f"{best.name} would be better: the log density of tests left out is higher by "
            f"{gain:.0f} ± {error:.0f}. It leaves {percent(best.density.misfit)} of {output}, "
            f"and {_noise(best.optimum.problem)}."
        )
        estimates = dict(zip(best.optimum.names, best.optimum.values.tolist(), strict=True))
        negative = negative_elements(best.optimum.problem, (estimates, best.optimum.stderr))
        return " ".join([text, *(f"There {finding}" for finding in negative)])

    def __str__(self) -> str:
        lines = [self.headline, table([self.columns, *self.rows], left=(0, 1))]
        lines.append("Of friction alone, without other elements:")
        lines.append(table([["", *self.common], *self.meanings]))
        lines += [text for m in self.models for text in m.resemblances]
        lines += [f"{name} could not be fitted: {why}" for name, why in self.failed.items()]
        return "\n".join(lines)

    columns = ("model", "reason", "misfit", "harmonics", "dof", "f_max", "sigma", "density")
    """Columns of :attr:`rows`."""

    @property
    def rows(self) -> list[list[str]]:
        """One row a model: misfits, degrees of freedom, changes, log density."""
        first = self.models[0]
        lines = []
        for m in self.models:
            gain, error = m.density.gain_over(first.density)
            changes = [_change(m.meaning[key], first.meaning[key]) for key in OF_FRICTION]
            mark = " (best)" if m is self.best else ""
            stopped = "" if m.optimum.converged else "; the search did not converge"
            lines.append(
                [
                    m.name,
                    m.reason + stopped,
                    percent(m.density.misfit),
                    percent(m.density.harmonic_misfit),
                    str(m.optimum.dof),
                    *changes,
                    ("0" if m is first else f"{gain:+.1f} ± {error:.1f}") + mark,
                ]
            )
        return lines

    @property
    def common(self) -> list[str]:
        """Quantities common to all laws: columns of :attr:`meanings`, after the model."""
        return list(self.models[0].meaning)

    @property
    def meanings(self) -> list[list[str]]:
        """Quantities common to all laws, one row a model."""
        return [[m.name, *(_number(m.meaning[key]) for key in self.common)] for m in self.models]

    def to_frame(self) -> Any:
        """Return a pandas table: one row a model."""
        import pandas as pd

        return pd.DataFrame(
            [
                {
                    "model": m.name,
                    "reason": m.reason,
                    "density": m.density.total,
                    "misfit": m.density.misfit,
                    "harmonic_misfit": m.density.harmonic_misfit,
                    "status": m.optimum.status.name,
                    **m.meaning,
                    **dict(zip(m.optimum.names, m.optimum.values.tolist(), strict=True)),
                }
                for m in self.models
            ]
        )


def _levels(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return amplitudes, m, and angular frequencies, rad/s: of each row, or of each record."""
    return problem.unit_sizes((0, 1, 0)), problem.unit_sizes((0, 0, -1))


def _undetermined(optimum: Optimum, quantities: Mapping[str, float]) -> list[str]:
    """Return the quantities whose logarithm has too large an error, to first order."""
    names, theta = OF_FRICTION, optimum.theta
    if not optimum.converged:
        return list(names)
    at_optimum = np.array([quantities[name] for name in names])
    changes = np.zeros((len(names), len(theta)))
    for i, size in enumerate(np.maximum(1.0, np.abs(theta)).tolist()):
        for step in (-RELATIVE_STEP * size, RELATIVE_STEP * size):
            moved = theta.copy()
            moved[i] += step
            at_moved = friction_quantities(optimum.problem, values_at(optimum.problem, moved))
            with np.errstate(all="ignore"):
                changes[:, i] += np.array([at_moved[n] for n in names]) / at_optimum / (2.0 * step)
    changes = np.clip(np.nan_to_num(changes), -1.0 / NO_EFFECT, 1.0 / NO_EFFECT)
    stds = Information(optimum).std(changes)
    return [n for n, u in zip(names, stds.tolist(), strict=True) if not u <= NOT_IDENTIFIED_ABOVE]


def _disagreement(first: ComparedModel, second: ComparedModel) -> str:
    """Return the quantity of friction on which two models disagree; "" if they agree."""
    for key in OF_FRICTION:
        a, b = first.meaning[key], second.meaning[key]
        if abs(a - b) > _DISAGREE * max(a, b):
            return key
    return ""


def _number(value: float) -> str:
    return "not determined" if np.isnan(value) else f"{value:.3g}"


def _noise(problem: Any) -> str:
    """Return how large the noise of the fundamental is, in words."""
    covariance = problem.data.covariance if problem.scale_known else None
    if covariance is None:
        return "how much of that is noise is not known"
    rows = problem.data.harmonic == 1
    size = np.abs(problem.data.response[rows])
    share = np.trace(covariance[rows], axis1=1, axis2=2) / size**2
    return f"the noise is {percent(float(np.sqrt(np.mean(share))))}"


def _change(value: float, before: float) -> str:
    with np.errstate(all="ignore"):
        ratio = round(float(np.float64(value) / before - 1.0), _PLACES)
    if abs(ratio) > _RUNAWAY:
        return "far more"
    return percent(ratio, sign=True)


def is_compared(fit: Any) -> bool:
    """Return whether a report compares a fit with other models.

    It does if another model may describe the residuals, which none does with a wrong sign, unless
    motions are exact: then it takes minutes.
    """
    goodness = fit.goodness
    return not (goodness.acceptable or goodness.sign or fit.problem.is_exact)


def compare_models(fit: Any, models: Mapping[str, Element] | None = None) -> ModelComparison:
    """Fit other models to the same data and compare how they predict tests left out.

    Parameters
    ----------
    fit : FitResult
        From :func:`dahl_ident.fit`; its data, noise model, sensors and loss are used for all. If
        it is a fit of records, blocks of samples are left out, and each model takes a search.
    models : mapping of str to Element, optional
        Models to compare with, by name. By default, in place of a Dahl element: another exponent,
        two elements, two limits (if there are even harmonics), a gap, Bouc-Wen's and Iwan's law,
        LuGre's if the force falls with the frequency, Maxwell slip if parallel Jenkins elements
        would leave much less; and in addition to it: a spring, a power damper and, if the frequency
        changes, a mass or a damper.

    Returns
    -------
    ModelComparison
        Printed, two tables; `best` is the simplest model within one standard error of the highest
        predictive density.

    Examples
    --------
    >>> import numpy as np
    >>> import dahl_ident as di
    >>> rng = np.random.default_rng(1)
    >>> A = np.geomspace(1e-4, 1e-2, 20)
    >>> N = di.Dahl(f_max=0.1, sigma=30.0, alpha=2.0).describing_function(A)
    >>> noise = np.exp(0.01 * rng.standard_normal((2, 20)).T @ [1.0, 1.0j])
    >>> data = di.FrequencyResponse(np.ones(20), N * noise, A)
    >>> result = di.fit(data, di.Dahl(alpha=1.0), throw=False)
    >>> compare_models(result).best.name
    'exponent free'
    """
    if isinstance(fit, Sequence):
        raise ValidationError(
            "compare_models got several fits; it takes one, and a mapping of names to other models "
            "of its data. What changed between fits of different data is in di.report([fit, ...])"
        )
    if not hasattr(fit, "assessment"):
        raise ValidationError(
            f"fit is a {type(fit).__name__}; expected the result of a fit, such as "
            "compare_models(di.fit(data, model))"
        )
    if not isinstance(models, Mapping | None):
        raise ValidationError(
            f"models is a {type(models).__name__}; expected a mapping of names to models, such as "
            "{'stiff': Dahl() + Spring()}"
        )
    failed: dict[str, str] = {}
    optimum, problem = fit.assessment.estimate, fit.optimum.problem
    fitted = [ComparedModel("as fitted", optimum, predictive_density(optimum), stated=fit.params)]
    if models is None:
        offered = list(_candidates(optimum, problem, fitted[0].density))
    else:
        offered = [(name, "", as_model(model).elements) for name, model in models.items()]
    for name, reason, elements in offered:
        try:
            # limits at infinity are other, simpler candidates
            candidate = solve(
                problem.like(model=Model(*elements)), loss=optimum.loss, limits=models is not None
            )
            errors = error_model(candidate) if problem.kind == "table" else None
            candidate = candidate if errors is None else errors.at_estimate
            density = predictive_density(candidate, optimum)
            if models is None and density.misfit > _ASTRAY > 2.0 * fitted[0].density.misfit:
                failed[name] = (
                    f"its search ended where {percent(density.misfit)} of "
                    f"{problem.output_in_words} is left"
                )
                continue
            fitted.append(ComparedModel(name, candidate, density, reason))
        except DahlIdentError as exc:
            failed[name] = str(exc)
    return ModelComparison(tuple(fitted), failed)


def _candidates(
    optimum: Optimum, problem: Problem, fitted: PredictiveDensity
) -> Iterator[tuple[str, str, Sequence[Element]]]:
    """Yield the name of each candidate, its reason and the model's elements.

    `optimum` is the estimate, with assumed exponents free, and `problem` that of the fit.
    """
    model, values = problem.model, parameter_values(optimum)
    misfit = f"{percent(fitted.misfit)} of {problem.output_in_words} left"
    if np.isfinite(fitted.harmonic_misfit):
        misfit += f", {percent(fitted.harmonic_misfit)} in harmonics"
    smallest = float(_levels(problem)[0].min())
    offers: list[tuple[Element, Mapping[str, Alternative]]] = []
    for e in model.elements:
        at_element = [values[p.name] for p in e.parameters]
        finite = bool(np.all(np.isfinite(at_element)))
        usable = finite and all(at_element[:2])
        unchanged = e.started_at(at_element) if finite else e
        offers.append((unchanged, e.alternatives(at_element, smallest) if usable else {}))
    reasons = dict.fromkeys(("shape", "asymmetry", "speed", "masing"), misfit)
    if problem.response is not None:
        reasons["asymmetry"] = _even(optimum)
        reasons["speed"] = _falling_force(optimum)
        least, reasons["masing"] = least_misfit(optimum), ""
        if least is not None and least < FAR_LESS * fitted.misfit:
            would_leave = f"would leave {percent(least)} of the fundamental"
            reasons["masing"] = f"parallel Jenkins elements {would_leave}"
    exponent_is_assumed = any(p.assumed for e in model.elements for p in e.parameters)
    for name in dict.fromkeys(name for _, offered in offers for name in offered):
        alternatives = [offered[name] for _, offered in offers if name in offered]
        reason = next((reasons[a.shows] for a in alternatives if a.shows != "shape"), misfit)
        is_fitted = name == "exponent free" and exponent_is_assumed
        # two elements that are both replaced by several would have parameters of the same names
        named_twice = len(alternatives) > 1 and any(len(a.elements) > 1 for a in alternatives)
        if reason and not is_fitted and not named_twice:
            yield (
                name,
                reason,
                [
                    element
                    for e, offered in offers
                    for element in (offered[name].elements if name in offered else (e,))
                ],
            )
    if not any(is_spring(e) for e in model.elements):
        yield "spring added", misfit, (model, Spring())
    added: list[Element] = []
    several, span = True, misfit
    if problem.response is not None:
        f = problem.response.frequency_hz
        several = bool(f.max() > _RATE_RANGE * f.min())
        span += f"; frequencies from {f.min():.3g} to {f.max():.3g} Hz"
        if not several:
            span = f"{misfit}; one frequency, so only the amplitude can tell"
    if several:  # at one frequency a mass is a spring
        added += [Mass(), Damper()]
    if several or optimum.loss == "linear":  # outliers at large amplitudes look like a damper
        added.append(PowerDamper(name="added"))  # a law may have an exponent too
    for element in added:
        if all(e.kind != element.kind for e in model.elements):
            yield f"{element.kind.replace('_', ' ')} added", span, (model, element)


def _even(optimum: Optimum) -> str:
    """Return how large the mean force or the even harmonics are; "" if there are none."""
    data = optimum.problem.data
    size = np.sqrt(np.mean(np.abs(data.response[data.harmonic == 1]) ** 2))
    for name, rows in (
        ("mean force", data.harmonic == 0),
        ("second harmonic", data.harmonic == 2),
        ("even harmonics", (data.harmonic % 2 == 0) & (data.harmonic > 2)),
    ):
        if rows.any():
            share = float(np.sqrt(np.mean(np.abs(data.response[rows]) ** 2)) / size)
            return f"{name} {percent(share)} of the fundamental"
    return ""


def _falling_force(optimum: Optimum) -> str:
    """Return how far abs(N) over that of the model falls with the frequency; "" if it does not.

    A straight line over ln f is fitted, whose slope is a parabola in ln A, in addition to a smooth
    dependence on the amplitude.
    """
    problem = optimum.problem
    view, fitted = problem.stiffness_data, problem.predicted_stiffness(optimum.theta).stiffness
    rows = view.harmonic == 1
    rate, ln_A = np.log(view.omega[rows]), np.log(view.amplitude[rows])
    if not np.ptp(rate) > np.log(_RATE_RANGE):
        return ""
    with np.errstate(divide="ignore", invalid="ignore"):
        y = np.log(np.abs(view.stiffness / fitted))[rows]
    unit_range = 2.0 * (ln_A - ln_A.mean()) / max(float(np.ptp(ln_A)), 1e-9)
    degree = min(_GAIN_DEGREE, np.unique(ln_A.round(2)).size - 1)
    smooth = legendre.legvander(unit_range, degree)
    slopes = legendre.legvander(unit_range, min(2, degree))
    X = np.hstack([smooth, slopes * (rate - rate.mean())[:, None]])
    dof, Q = y.size - X.shape[1], slopes.shape[1]
    if dof < 1 or not np.isfinite(y).all():
        return ""
    detrended = y - smooth @ np.linalg.lstsq(smooth, y, rcond=None)[0]
    solution = np.linalg.lstsq(X, y, rcond=None)[0]
    remaining = max(float(np.sum((y - X @ solution) ** 2)), TINY)
    explained = float(detrended @ detrended) - remaining
    p = float(special.fdtrc(Q, dof, explained / Q / (remaining / dof)))
    change = (slopes @ solution[-Q:]) * float(np.ptp(rate))
    fall = -float(change[np.argmax(np.abs(change))])
    if not (p < _FALL_BY_CHANCE and fall > 0.0):
        return ""
    f = view.omega[rows] / (2.0 * np.pi)
    return f"force falls by {percent(fall)} from {f.min():.3g} to {f.max():.3g} Hz"

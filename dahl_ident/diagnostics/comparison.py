"""Which model describes the data, and the quantities of friction that do not depend on the model.

Candidates come from what the fit leaves: a mean force asks for two limits, a response that changes
with frequency for a damper, a force that falls with it for LuGre's law, any other misfit for
another shape of loop. Each is judged by how it predicts tests that it was not fitted to
(:mod:`dahl_ident.diagnostics.predictive_density`). Of those whose density is within one standard
error of the highest, the simplest is the best. The model fitted stays the best unless another's
density exceeds its by more than chance explains among many candidates. AIC and BIC do not count:
over harmonics whose covariance is tiny they prefer a model that spoils the fundamental. If no model
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

from dahl_ident.arrays import FloatArray
from dahl_ident.diagnostics.error_model import error_model
from dahl_ident.diagnostics.formatting import listed, table, with_unit
from dahl_ident.diagnostics.information import Information, parameter_values, values_at
from dahl_ident.diagnostics.physics import is_spring, negative_parameters
from dahl_ident.diagnostics.predictive_density import PredictiveDensity, predictive_density
from dahl_ident.diagnostics.record_channels import RELATIVE_STEP
from dahl_ident.diagnostics.slip_density import FAR_LESS, least_misfit
from dahl_ident.diagnostics.verdicts import NOT_IDENTIFIED_ABOVE
from dahl_ident.elements import (
    Damper,
    Element,
    Friction,
    Mass,
    Model,
    Parameter,
    PowerDamper,
    Spring,
)
from dahl_ident.elements.facts import Alternative
from dahl_ident.errors import DahlIdentError, ValidationError
from dahl_ident.fitting import Optimum, solve
from dahl_ident.problem import Problem
from dahl_ident.units import percent, si_unit

_BY_CHANCE = 4.0  # rise of the log density that the best of ten needless candidates may have
_ASTRAY = 0.5  # misfit at which a search has ended far from any description
_RATES = 1.05  # highest over lowest frequency that can show a dependence on the rate
_SMOOTH = 8  # degree in ln A of the change of gain that is allowed at every frequency
_FALSE_ALARM = 1e-4  # of a force that falls with the frequency: it only adds a candidate
_SEEN = 3.0  # rms differences over noise that has been averaged over all rows
_RUNAWAY = 100.0  # times as large: a candidate's parameter that the data leave open
_UNUSUAL = 5.0  # times beyond the usual range of an exponent: no mechanism's
_DISAGREE = 0.2  # of a force limit or a stiffness: what friction is then depends on the choice
_PLACES = 6  # of a change: less is rounding
_VAGUE = 0.5  # relative standard error from which a parameter is not determined
_OF_FRICTION = "force limit", "stiffness at zero force"  # the same in all laws
_LEVELS = 3  # amplitudes at which the energy of a cycle is tabulated


@dataclass(frozen=True)
class ComparedModel:
    """One model's fit to the data."""

    name: str  # what distinguishes it
    optimum: Optimum  # its estimate
    density: PredictiveDensity  # how it predicts tests left out
    reason: str = ""  # what in the data speaks for trying it
    # of the model that was fitted: its parameters as the fit states them, every source of error
    # counted; the others count noise alone
    stated: Mapping[str, Any] | None = None

    @property
    def complexity(self) -> int:
        """Number of free parameters, except exponents estimated within an assumed range."""
        problem = self.optimum.problem
        return len(problem.names) - (len(problem.ranges) if problem.kind == "table" else 0)

    @property
    def estimates(self) -> str:
        """The free parameters in one line; a number without an error is none."""
        rows = [(p.name, v, e, p.unit) for p, v, e in self._of_device]
        if self.stated is not None:
            every = self.stated.values()
            rows = [(p.name, p.value, p.stderr, p.unit) for p in every if p.stderr is not None]
        known = [f"{name} = {with_unit(v, e, unit)}" for name, v, e, unit in rows if np.isfinite(e)]
        unknown = [name for name, _, e, _ in rows if not np.isfinite(e)]
        return ", ".join(known + ([f"{listed(unknown)} not determined"] if unknown else []))

    @property
    def _of_device(self) -> list[tuple[Parameter, float, float]]:
        """The free parameters of the device, with value and standard error of each."""
        o, count = self.optimum, self.optimum.problem.n_reported
        parameters = o.problem.parameters[:count]
        return list(zip(parameters, o.values.tolist(), o.stderr.values(), strict=False))

    @cached_property
    def is_determined(self) -> bool:
        """Whether the data determine every parameter to a factor, or how near to zero it is.

        For a table, every source of error counts. The like parts of a law, such as those of Maxwell
        slip, need not be determined one by one.
        """
        stderr = self.optimum.stderr
        parts = set[str]()
        for element in self.optimum.problem.model.elements:
            labels = {label for part in element.like_parts for label in part}
            parts |= {element.parameter(label).name for label in labels}

        def size(parameter: Parameter) -> float:
            """Return what a parameter that may be zero is compared with: its unit's size."""
            may_be_zero = parameter.lower < 0.0
            sizes = self.optimum.problem.unit_sizes(parameter.dimension)
            return float(np.median(sizes)) * may_be_zero

        return all(
            np.isfinite(value)
            and (p.name in parts or stderr[p.name] < _VAGUE * max(abs(value), size(p)))
            for p, value, _ in self._of_device
        )

    @property
    def is_physical(self) -> bool:
        """Whether every exponent is near its usual range."""
        return all(
            p.prior is None or any(p.dimension) or not p.positive
            or p.prior[0] / _UNUSUAL < value < p.prior[1] * _UNUSUAL
            for p, value, _ in self._of_device
        )  # fmt: skip

    @cached_property
    def meaning(self) -> dict[str, float]:
        """Quantities common to all laws: force limit, stiffness at zero force, energies.

        Of all elements with memory together: N, N/m, and joules lost in a cycle at the smallest,
        the middle and the largest amplitude, of records at their rms displacements. Infinite where
        a law never slips, NaN where these data do not determine it.
        """
        problem = self.optimum.problem
        every = _meaning(problem, parameter_values(self.optimum))
        undetermined = _undetermined(self.optimum, every)
        if self.stated is not None:
            every = _meaning(problem, {name: p.value for name, p in self.stated.items()})
        return every | dict.fromkeys(undetermined, np.nan)

    @property
    def resemblances(self) -> list[str]:
        """Which element these data cannot distinguish from a simpler one, in sentences."""
        problem, values = self.optimum.problem, parameter_values(self.optimum)
        sentences = []
        for element in problem.model.elements:
            at_element = [values[p.name] for p in element.parameters]
            known = element.resembles(at_element, *_levels(problem))
            if known is not None and known[1] < _SEEN * self.density.noise:
                sentences.append(
                    f"{self.name}: at these levels it differs from {known[0]} by "
                    f"{percent(known[1])} rms, too little for these data to distinguish the two."
                )
        return sentences


@dataclass(frozen=True)
class ModelComparison:
    """Models side by side; the first is the one that was fitted, with what it states.

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
        physical, and whose force limit and stiffness are not a hundred times those of the fit. It
        is the one that was fitted where models that are alike disagree (`undecided`), and where
        one that the data do not determine leaves far less (`undetermined`).
        """
        return self.models[0] if self.undecided or self.undetermined else self._simplest

    @cached_property
    def undetermined(self) -> ComparedModel | None:
        """A physical model that the data do not determine, of far smaller misfit than the best."""
        best = self._simplest
        every = [model for model in self.models if model.is_physical or model is best]
        likeliest = max(every, key=lambda model: model.density.total)
        gain, error = likeliest.density.gain_over(best.density)
        far = likeliest.density.misfit < FAR_LESS * best.density.misfit
        return likeliest if far and gain > max(error, _BY_CHANCE) else None

    @cached_property
    def undecided(self) -> tuple[ComparedModel, ...]:
        """The simplest of models that these data do not distinguish, and one that disagrees.

        The likeliest of those that disagree, on the force limit or on the stiffness at zero force.
        Empty where none does, or where the simplest is the one that was fitted.
        """
        one = self._simplest
        others = [m for m in self._alike if m is not self.models[0] and _disagreement(one, m)]
        if one is self.models[0] or not others:
            return ()
        return one, max(others, key=lambda model: model.density.total)

    @cached_property
    def _likeliest(self) -> ComparedModel:
        falling = sorted(self.models, key=lambda model: -model.density.total)
        return next(m for m in falling if m is self.models[0] or self._is_sound(m))

    @cached_property
    def _alike(self) -> list[ComparedModel]:
        """The sound models that these data do not distinguish from the likeliest."""
        alike = []
        for model in self.models:
            gain, error = self._likeliest.density.gain_over(model.density)
            near = gain <= max(error, _BY_CHANCE)
            if near and (model is self.models[0] or self._is_sound(model)):
                alike.append(model)
        return alike

    @property
    def _simplest(self) -> ComparedModel:
        def complexity(model: ComparedModel) -> tuple[int, float]:
            return model.complexity, -model.density.total

        return min(self._alike, key=complexity)

    def _is_sound(self, model: ComparedModel) -> bool:
        sizes = [(model.meaning[k], self.models[0].meaning[k]) for k in _OF_FRICTION]
        absurd = any(b > 0.0 and a > _RUNAWAY * b for a, b in sizes)
        return model.is_physical and not absurd and model.is_determined

    @property
    def headline(self) -> str:
        """The verdict in a sentence or two."""
        first, best = self.models[0], self.best
        output = first.optimum.problem.output_in_words
        if self.undecided:
            one, two = self.undecided
            key = _disagreement(one, two)
            sizes = listed([f"{m.meaning[key]:.3g}" for m in self.undecided])
            return (
                f"{one.name} and {two.name} would both be better, and these data do not "
                f"distinguish them: {key} {sizes}. Neither is recommended."
            )
        if self.undetermined is not None:
            one = self.undetermined
            return (
                f"{one.name} would leave far less ({percent(one.density.misfit)} of {output}), "
                "but these data do not determine its parameters. No model compared "
                "is recommended."
            )
        if best is first:
            return "No model compared is better than the one fitted."
        gain, error = best.density.gain_over(first.density)
        text = (
            f"{best.name} would be better: the log density of tests left out is higher by "
            f"{gain:.0f} ± {error:.0f}. It leaves {percent(best.density.misfit)} of {output}, "
            f"and {_noise(best.optimum.problem)}."
        )
        absurd = [f"There {warning}." for warning in negative_parameters(best.optimum)]
        return " ".join([text, *absurd])

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
            changes = [_change(m.meaning[key], first.meaning[key]) for key in _OF_FRICTION]
            mark = " (best)" if m is self.best else ""
            lines.append([
                m.name, m.reason, percent(m.density.misfit), percent(m.density.harmonic_misfit),
                str(m.optimum.dof), *changes,
                ("0" if m is first else f"{gain:+.1f} ± {error:.1f}") + mark,
            ])  # fmt: skip
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


def _meaning(problem: Problem, values: Mapping[str, float]) -> dict[str, float]:
    """Return the quantities common to all laws at the parameters' values, see `ComparedModel`."""
    A, rates = _levels(problem)
    sizes = np.geomspace(A.min(), A.max(), _LEVELS if A.max() > A.min() else 1)
    omega = np.asarray(np.exp(np.mean(np.log(rates))))
    limit, stiffness, energy = 0.0, 0.0, np.zeros(sizes.size)
    for element in problem.model.elements:
        if not isinstance(element, Friction):
            continue
        at_element = [np.asarray(values[p.name]) for p in element.parameters]
        with np.errstate(all="ignore"):
            limit += float(np.mean(element.force_limits(at_element)))
            contact = float(element.rest_stiffness(at_element))
            if not contact:  # behind a gap
                contact = float(element.quasi_static_slope(np.zeros(()), 1.0, at_element))
            stiffness += contact
            energy += np.pi * sizes**2 * np.imag(element.stiffness(at_element, sizes, omega))
    sizes_in_common = {"force limit": limit, "stiffness at zero force": stiffness}
    unit = si_unit("displacement", problem.motion)
    return sizes_in_common | {
        f"energy a cycle at {size:.2g} {unit}": float(e)
        for size, e in zip(sizes, energy, strict=True)
    }


def _undetermined(optimum: Optimum, every: Mapping[str, float]) -> list[str]:
    """Return which quantities are not determined, by the first-order error of their logarithms."""
    names, theta = [key for key in every if not key.startswith("energy")], optimum.theta
    if not optimum.converged:
        return names
    before = np.array([every[name] for name in names])
    changes = np.zeros((len(names), len(theta)))
    for i, size in enumerate(np.maximum(1.0, np.abs(theta)).tolist()):
        for step in (-RELATIVE_STEP * size, RELATIVE_STEP * size):
            moved = theta.copy()
            moved[i] += step
            there = _meaning(optimum.problem, values_at(optimum.problem, moved))
            with np.errstate(all="ignore"):
                changes[:, i] += np.array([there[n] for n in names]) / before / (2.0 * step)
    stds = Information(optimum).std(np.nan_to_num(changes))
    return [n for n, u in zip(names, stds.tolist(), strict=True) if not u <= NOT_IDENTIFIED_ABOVE]


def _disagreement(first: ComparedModel, second: ComparedModel) -> str:
    """Return the quantity of friction on which two models disagree; "" where they agree."""
    for key in _OF_FRICTION:
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


def compare_models(fit: Any, models: Mapping[str, Element] | None = None) -> ModelComparison:
    """Fit other models to the same data and compare how they predict tests left out.

    Parameters
    ----------
    fit : FitResult
        From :func:`dahl_ident.fit`; its data, noise model, sensors and loss are used for all.
        Of records, blocks of samples are left out, and each candidate is a search of its own.
    models : mapping of str to Element, optional
        Models to compare with, by a name for each. Left out: for a Dahl element another exponent,
        two elements, two limits (where even harmonics are given), a gap, Bouc-Wen's and Iwan's
        law, LuGre's where the force falls with the frequency, Maxwell slip where parallel Jenkins
        elements would leave much less; a spring and a power damper added and, where the frequency
        changes, a mass and a damper.

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
        offered = [(name, "", (model,)) for name, model in models.items()]
    for name, reason, elements in offered:
        try:
            of_model = problem.like(model=Model(*elements))
            # parameters at their limits at infinity are those of simpler candidates
            candidate = solve(of_model, loss=optimum.loss, limits=models is not None)
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
    optimum: Optimum, problem: Problem, left: PredictiveDensity
) -> Iterator[tuple[str, str, Sequence[Element]]]:
    """Yield the name of each candidate, its reason and the model's elements.

    `optimum` is the estimate, with assumed exponents free, and `problem` that of the fit.
    """
    model, values = problem.model, parameter_values(optimum)
    misfit = f"{percent(left.misfit)} of {problem.output_in_words} left"
    if np.isfinite(left.harmonic_misfit):
        misfit += f", {percent(left.harmonic_misfit)} in harmonics"
    smallest = float(_levels(problem)[0].min())
    offers: list[tuple[Element, Mapping[str, Alternative]]] = []
    for e in model.elements:
        at_element = [values[p.name] for p in e.parameters]
        finite = bool(np.all(np.isfinite(at_element)))
        known = finite and all(at_element[:2])
        stays = e.started(at_element) if finite else e
        offers.append((stays, e.alternatives(at_element, smallest) if known else {}))
    reasons = dict.fromkeys(("shape", "asymmetry", "speed", "masing"), misfit)
    if problem.response is not None:
        reasons["asymmetry"] = _even(optimum)
        reasons["speed"] = _falling_force(optimum)
        reasons["masing"] = _jenkins(optimum, left)
    exponent_is_assumed = any(p.assumed for e in model.elements for p in e.parameters)
    for name in dict.fromkeys(name for _, offered in offers for name in offered):
        taken = [offered[name] for _, offered in offers if name in offered]
        reason = next((reasons[i.shows] for i in taken if i.shows != "shape"), misfit)
        # the fit estimates an assumed exponent; more elements of one law in place of several would
        # share their names
        estimated = name == "exponent free" and exponent_is_assumed
        named_twice = len(taken) > 1 and any(len(instead.elements) > 1 for instead in taken)
        if reason and not estimated and not named_twice:
            yield name, reason, [
                n for e, offered in offers
                for n in (offered[name].elements if name in offered else (e,))
            ]  # fmt: skip
    if not any(is_spring(e) for e in model.elements):
        yield "spring added", misfit, (model, Spring())
    added: list[Element] = []
    several, span = True, misfit
    if problem.response is not None:
        f = problem.response.frequency_hz
        several = bool(f.max() > _RATES * f.min())
        span += f"; frequencies from {f.min():.3g} to {f.max():.3g} Hz"
        if not several:
            span = f"{misfit}; one frequency, so only the amplitude can tell"
    if several:  # at one frequency a mass is a spring
        added += [Mass(), Damper()]
    if several or optimum.loss == "linear":  # else outliers at large amplitudes look like a damper
        added.append(PowerDamper())
    for element in added:
        if all(e.kind != element.kind for e in model.elements):
            yield f"{element.kind.replace('_', ' ')} added", span, (model, element)


def _even(optimum: Optimum) -> str:
    """Return how large mean force and even harmonics are, or "" where there are none."""
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
    """Return how much abs(N) falls with the frequency against the model's; "" where it does not.

    By straight lines over the frequency's logarithm, whose slopes are a parabola of the
    amplitude's, in addition to any smooth dependence on the amplitude.
    """
    problem = optimum.problem
    view, fitted = problem.stiffness_data, problem.predicted_stiffness(optimum.theta).stiffness
    rows = view.harmonic == 1
    rate, ln_A = np.log(view.omega[rows]), np.log(view.amplitude[rows])
    if not np.ptp(rate) > np.log(_RATES):
        return ""
    with np.errstate(divide="ignore", invalid="ignore"):
        y = np.log(np.abs(view.stiffness / fitted))[rows]
    place = 2.0 * (ln_A - ln_A.mean()) / max(float(np.ptp(ln_A)), 1e-9)
    degree = min(_SMOOTH, np.unique(ln_A.round(2)).size - 1)
    smooth = legendre.legvander(place, degree)
    slopes = legendre.legvander(place, min(2, degree))
    X = np.hstack([smooth, slopes * (rate - rate.mean())[:, None]])
    dof, Q = y.size - X.shape[1], slopes.shape[1]
    if dof < 1 or not np.isfinite(y).all():
        return ""
    detrended = y - smooth @ np.linalg.lstsq(smooth, y, rcond=None)[0]
    solution, _, _, _ = np.linalg.lstsq(X, y, rcond=None)
    left = float(np.sum((y - X @ solution) ** 2))
    by_chance = float(
        special.fdtrc(Q, dof, (float(detrended @ detrended) - left) / Q / (left / dof))
    )
    change = (slopes @ solution[-Q:]) * float(np.ptp(rate))
    fall = -float(change[np.argmax(np.abs(change))])
    if not (by_chance < _FALSE_ALARM and fall > 0.0):
        return ""
    f = view.omega[rows] / (2.0 * np.pi)
    return f"force falls by {percent(fall)} from {f.min():.3g} to {f.max():.3g} Hz"


def _jenkins(optimum: Optimum, left: PredictiveDensity) -> str:
    """Return the misfit of parallel Jenkins elements where it is far smaller, else ""."""
    least = least_misfit(optimum)
    if least is None or not least < FAR_LESS * left.misfit:
        return ""
    return f"parallel Jenkins elements would leave {percent(least)} of the fundamental"

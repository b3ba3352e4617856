"""Prior knowledge for a plan, from a model with ranges, a fit, or a posterior.

All in search coordinates: the logarithm of positive parameters, the number itself for others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray, finite_array
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.error_sources import NOISE, RUNS
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.elements.element import as_model
from dahl_ident.errors import ValidationError, choices
from dahl_ident.problem import Problem
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.problem.space import Space
from dahl_ident.sensors import Sensors
from dahl_ident.steady_state import Steady
from dahl_ident.units import Motion

# Least relative standard deviation that the search takes from a range. The fit will not have the
# range: levels chosen with it do not determine what the fit then has to.
_LEANED_ON = 100.0
_MANY = 2000  # draws of a posterior for its covariance: 3 % of each uncertainty (two sigma)
_NORMAL_RANGE = 2.0 * 1.959964  # standard deviations in a 95 % range

Ranges = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Knowledge:
    """Draws of the free parameters and the information that earlier data hold on them."""

    model: Model  # what is measured, and through what
    sensors: Sensors | None
    motion: Motion
    parameters: tuple[Parameter, ...]  # the free ones, P of them
    theta: FloatArray  # (S, P): draws, search coordinates
    # (S, P, P): of the data measured before, at each draw, and of assumed values such as the
    # exponent of ``Dahl()``, which are parameters here as they are in a fit's uncertainty
    information: FloatArray
    # (P, P): information of the ranges, each taken as very wide: it keeps the search defined where
    # a parameter cannot be determined, and a predicted uncertainty does not include it
    prior: FloatArray
    assumed: tuple[str, ...] = ()  # names of the assumed parameters
    # standard deviation of ln gain and of phase of a row of earlier data
    row_noise: float | None = None
    row_cycles: float = 1.0  # cycles that such a row averages, if the data state it; else 1
    problem: Problem | None = None  # of the earlier data
    scatter: float = 0.0  # standard deviation of ln gain and phase between runs in the earlier data
    errors: ErrorModel | None = None  # of an earlier fit
    # standard deviation of a sample of force in earlier records, N
    sample_noise: float | None = None
    steady: Steady = "exact"  # how the response to a force that is held is predicted

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def space(self) -> Space:
        """The search coordinates."""
        return Space(self.parameters)

    @property
    def values(self) -> FloatArray:
        """Draws of the values, shape (S, P)."""
        return self.space.to_values(self.theta)

    def only(self, draws: NDArray[np.intp]) -> Knowledge:
        """Return the knowledge restricted to some of the draws."""
        return replace(self, theta=self.theta[draws], information=self.information[draws])

    def thinned(self, most: int) -> Knowledge:
        """Return the knowledge at no more than `most` of the draws, evenly spread."""
        S = len(self.theta)
        return self.only(np.unique(np.linspace(0, S - 1, min(S, most)).astype(int)))

    def problem_at(
        self,
        levels: FloatArray,
        frequency_hz: FloatArray,
        controlled: str,
        *,
        model: Model | None = None,
        harmonic: int = 1,
        noise: str = "relative",
    ) -> Problem:
        """Return the problem of levels whose response is not yet measured."""
        held: dict[str, Any] = {"drive" if controlled == "force" else "amplitude": levels}
        data = FrequencyResponse(
            frequency_hz, np.ones(len(levels)), controlled=controlled, motion=self.motion,
            harmonic=harmonic, **held,
        )  # fmt: skip
        return Problem(
            data, model or self.model, noise=noise, sensors=self.sensors, steady=self.steady
        )

    def model_values(self) -> list[FloatArray]:
        """Return every parameter of the model at every draw, shape (S, 1) each, or ()."""
        drawn = dict(zip(self.names, self.values.T, strict=True))
        return [
            drawn[p.name][:, None] if p.free else np.asarray(p.value) for p in self.model.parameters
        ]


def gather(source: Any, ranges: Ranges | None, draws: int, seed: int) -> Knowledge:
    """Return the knowledge from a model with ranges, a fit or a posterior."""
    rng = np.random.default_rng(seed)
    if isinstance(source, Element):
        return _of_model(as_model(source), ranges or {}, draws, rng)
    problem, sampled = getattr(source, "problem", None), hasattr(source, "draws")
    if isinstance(problem, RecordProblem):
        fit, values = (source.fit, source.draws(_MANY, seed)) if sampled else (source, None)
        return _of_record_fit(fit, ranges or {}, draws, rng, values)
    if isinstance(problem, Problem) and sampled:
        return _of_posterior(source, ranges or {}, draws, seed)
    if isinstance(problem, Problem) and hasattr(source, "optimum"):
        return _of_fit(source, ranges or {}, draws, rng)
    raise ValidationError(
        f"plan: got a {type(source).__name__}; expected a model such as Dahl(), a fit, or a "
        "posterior"
    )


def _of_model(model: Model, ranges: Ranges, draws: int, rng: np.random.Generator) -> Knowledge:
    free = tuple(p for p in model.parameters if p.free)
    if not free:
        raise ValidationError(
            f"plan: {model!r} has no free parameter, so there is nothing to determine"
        )
    centre, std = _moments(free, ranges)
    missing = [p.name for p, s in zip(free, std, strict=True) if np.isinf(s)]
    if missing:
        wanted = ", ".join(f"{name!r}: (low, high)" for name in missing)
        raise ValidationError(
            f"plan: nothing is known about {', '.join(missing)}; give ranges={{{wanted}}} that "
            "contain the values with 95 % probability"
        )
    theta = _within(centre + std * rng.standard_normal((draws, len(free))), free)
    model, assumed = _with_assumed(model)
    parameters = tuple(p for p in model.parameters if p.free)
    names = [p.name for p in parameters]
    own = [names.index(p.name) for p in free]
    whole = np.array([np.log(p.value or 1.0) for p in parameters]) * np.ones((draws, 1))
    whole[:, own] = theta
    prior = np.zeros(len(names))
    prior[own] = _leaned_on(free, centre, std)
    known = np.broadcast_to(_of_assumed(names, assumed), (draws, len(names), len(names)))
    return Knowledge(
        model, None, "translation", parameters, whole, known, np.diag(prior), tuple(assumed)
    )


def _of_fit(fit: Any, ranges: Ranges, draws: int, rng: np.random.Generator) -> Knowledge:
    optimum, errors = fit.optimum, fit.errors
    problem: Problem = optimum.problem
    centre, std = _moments(problem.parameters, ranges)
    theta = np.array(optimum.theta, dtype=np.float64)
    finite = np.isfinite(theta) & np.isfinite(optimum.values)
    for i in np.flatnonzero(~finite | ~np.isfinite(np.diagonal(optimum.covariance))):
        name = problem.names[i]
        if np.isinf(std[i]):
            raise ValidationError(
                f"plan: the fit does not determine {name}; give ranges={{{name!r}: (low, high)}}, "
                "or plan from the model with ranges="
            )
    prior = _leaned_on(problem.parameters, centre, std)
    if errors is not None:
        return _of_errors(errors, prior, draws, rng)
    theta = np.where(finite, theta, centre)
    scale = optimum.scale if np.isfinite(optimum.scale) else 1.0
    covariance = np.linalg.inv(problem.information(theta, scale) + np.diag(1.0 / std**2))
    # a range counts only where the data say nothing; elsewhere the estimate is the centre
    drawn = rng.multivariate_normal(theta, covariance, draws, method="eigh")
    drawn = _within(drawn, problem.parameters)
    return _with_data(problem, np.vstack([drawn, theta]), scale, prior, at=draws)


def _of_record_fit(
    fit: Any, ranges: Ranges, draws: int, rng: np.random.Generator,
    sampled: FloatArray | None = None,
) -> Knowledge:  # fmt: skip
    """Return the knowledge from a fit of records, whose force follows from the displacement.

    With values sampled from their posterior, (N, P), the draws and the covariance are theirs.
    """
    if ranges:
        raise ValidationError(
            "plan: ranges are given with a fit of records, which determines its parameters; leave "
            "them out, or give the model with ranges="
        )
    problem: RecordProblem = fit.optimum.problem
    if problem.output != "force":
        raise ValidationError(
            "plan: the fit predicts the motion of a driven plant; planned are fits of frequency "
            "responses, and of records whose force was predicted: give the model with ranges="
        )
    P, parameters = len(problem.free), tuple(problem.free)
    space = Space(parameters)
    values = np.asarray(fit.optimum.values)[:P] if sampled is None else sampled[:, :P]
    theta = space.to_search(values)
    if sampled is None:
        slope = space.slopes(values)
        covariance = np.asarray(fit.covar)[:P, :P] / np.outer(slope, slope)
        if not np.isfinite(covariance).all():
            raise ValidationError("plan: the fit does not determine its parameters; give the model")
        drawn = rng.multivariate_normal(theta, covariance, draws, method="eigh")
    else:
        covariance = np.atleast_2d(np.cov(theta, rowvar=False))
        drawn = theta[rng.integers(len(theta), size=draws)]
    return Knowledge(
        problem.model, None, problem.records[0].motion, parameters, _within(drawn, parameters),
        np.broadcast_to(np.linalg.inv(covariance), (draws, P, P)), np.zeros((P, P)),
        sample_noise=float(np.std(np.concatenate(fit.residuals))),
    )  # fmt: skip


def _of_errors(
    errors: ErrorModel, leaned: FloatArray, draws: int, rng: np.random.Generator
) -> Knowledge:
    """Return the knowledge from a fit with all its sources of error."""
    given = errors.optimum.problem
    model, assumed = _with_assumed(given.model)
    kept = [i for i, name in enumerate(errors.names) if name in (*given.names, *assumed)]
    parameters = tuple(errors.problem.parameters[i] for i in kept)
    names = [p.name for p in parameters]
    prior = np.zeros(len(kept))
    prior[[names.index(name) for name in given.names]] = leaned
    part = np.ix_(kept, kept)
    drawn = rng.multivariate_normal(
        errors.theta[kept], errors.covariance[part], draws, method="eigh"
    )
    known = np.linalg.inv(errors.covariance)[part]
    stated, cycles = _row_noise(errors.problem, 0.0)
    return Knowledge(
        model, given.sensors, given.data.motion, parameters, _within(drawn, parameters),
        np.broadcast_to(known, (draws, *known.shape)), np.diag(prior), tuple(assumed),
        float(np.hypot(stated, errors.rms(NOISE))), cycles, errors.problem,
        errors.rms(RUNS), errors, steady=given.steady,
    )  # fmt: skip


def _of_posterior(posterior: Any, ranges: Ranges, draws: int, seed: int) -> Knowledge:
    problem: Problem = posterior.problem
    P = len(problem.names)
    values = np.asarray(posterior.draws(draws, seed))
    scale = values[:, P] if values.shape[1] > P else np.ones(draws)
    centre, std = _moments(problem.parameters, ranges)
    prior = _leaned_on(problem.parameters, centre, std)
    return _with_data(problem, problem.to_search(values[:, :P]), scale, prior)


def _with_data(
    given: Problem, drawn: FloatArray, scale: Any, leaned: FloatArray, at: int | None = None
) -> Knowledge:
    """Return draws with the information of their data, at each draw or at one of them."""
    model, assumed = _with_assumed(given.model)
    problem = given.like(model=model) if assumed else given
    own = [problem.names.index(name) for name in given.names]
    theta = np.array([np.log(p.value or 1.0) for p in problem.parameters]) * np.ones(
        (len(drawn), 1)
    )
    theta[:, own] = drawn
    prior = np.zeros(len(problem.names))
    prior[own] = leaned
    noise, cycles = _row_noise(problem, float(np.median(scale)))
    if at is not None:
        one = problem.information(theta[at], scale)
        theta = np.delete(theta, at, axis=0)
        known = np.broadcast_to(one, (len(theta), *one.shape))
    else:
        known = problem.information(theta, scale)
    known = known + _of_assumed(problem.names, assumed)
    return Knowledge(
        model, problem.sensors, problem.data.motion, problem.parameters, theta, known,
        np.diag(prior), tuple(assumed), noise, cycles, problem,
        steady=problem.steady,
    )  # fmt: skip


def _with_assumed(model: Model) -> tuple[Model, dict[str, float]]:
    """Return the model with its assumed parameters free, and the information of each."""
    assumed = {
        p.name: 12.0 / np.log(p.prior[1] / p.prior[0]) ** 2
        for p in model.parameters
        if p.assumed and not p.free and p.prior is not None
    }
    return (model.with_free(assumed) if assumed else model), assumed


def _of_assumed(names: Sequence[str], assumed: Mapping[str, float]) -> FloatArray:
    return np.diag([assumed.get(name, 0.0) for name in names])


def _leaned_on(parameters: Sequence[Parameter], centre: FloatArray, std: FloatArray) -> FloatArray:
    """Return the information of ranges, none taken as narrower than `_LEANED_ON`."""
    least = _LEANED_ON * np.where(Space(parameters).positive, 1.0, np.abs(centre))
    return np.asarray(1.0 / np.maximum(std, least) ** 2)


def _moments(parameters: Sequence[Parameter], ranges: Ranges) -> tuple[FloatArray, FloatArray]:
    """Return centre and standard deviation of each search coordinate; inf without a range."""
    unknown = set(ranges) - {p.name for p in parameters}
    if unknown:
        raise ValidationError(
            f"ranges names {', '.join(sorted(unknown))}; free are "
            f"{choices((p.name for p in parameters), *unknown)}"
        )
    centre, std = np.zeros(len(parameters)), np.full(len(parameters), np.inf)
    for i, p in enumerate(parameters):
        given = ranges.get(p.name, p.prior)
        if given is None:
            continue
        ends = finite_array(given, f"ranges[{p.name!r}]")
        if ends.shape != (2,) or not ends[0] < ends[1] or (p.positive and ends[0] <= 0):
            above = " above zero" if p.positive else ""
            raise ValidationError(
                f"ranges[{p.name!r}] is {given!r}; expected two rising numbers{above}"
            )
        low, high = Space([p]).to_search(ends[:, None])[:, 0]
        centre[i], std[i] = 0.5 * (low + high), (high - low) / _NORMAL_RANGE
    return centre, std


def _within(theta: FloatArray, parameters: Sequence[Parameter]) -> FloatArray:
    """Return draws moved into the parameters' bounds."""
    return np.clip(theta, *Space(parameters).bounds)


def _row_noise(problem: Problem, scale: float) -> tuple[float, float]:
    """Return the relative noise of a row of the data, and the cycles that it averages."""
    data, size = problem.data, np.abs(problem.data.response)
    cycles = 1.0
    if problem.noise == "relative":
        return scale, cycles
    if problem.noise == "absolute" or data.covariance is None:
        return float(np.sqrt(np.median((scale / size) ** 2))), cycles
    if data.dof is not None and np.isfinite(data.dof).all():
        cycles = float(np.median(data.dof)) + 1.0
    variance = 0.5 * np.trace(data.covariance, axis1=1, axis2=2) / size**2
    return float(np.sqrt(np.median(variance))), cycles

"""Prior knowledge for a plan, from a model with ranges, a fit, or a posterior.

All numbers are in search coordinates: the logarithm of positive parameters, the value of others.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, IntArray, finite_array
from dahl_ident.data import FrequencyResponse
from dahl_ident.diagnostics.contributions import NOISE, RUNS, excess
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.estimate import assumed_exponents
from dahl_ident.diagnostics.intervals import LARGEST_FACTOR
from dahl_ident.elements import Element, Model, Parameter
from dahl_ident.elements.driven_motion import Steady
from dahl_ident.elements.element import as_model
from dahl_ident.errors import HIGH, LOW, ValidationError, argument, choices
from dahl_ident.problem import TableProblem
from dahl_ident.problem.record_problem import RecordProblem
from dahl_ident.problem.space import Space
from dahl_ident.sensors import Sensors
from dahl_ident.units import Motion

# Least relative standard deviation of a range in the search: the later fit does not have the range,
# so levels must determine the parameters without it.
_LEAST_RANGE_STD = 100.0
_POSTERIOR_DRAWS = 2000  # draws for the covariance of a posterior: each uncertainty is known to 3 %
_NORMAL_RANGE = 2.0 * 1.959964  # width of a 95 % range in standard deviations

Ranges = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Knowledge:
    """Draws of the free parameters, and the information of earlier data on them."""

    model: Model
    parameters: tuple[Parameter, ...]  # the P free ones
    theta: FloatArray  # (S, P) draws, search coordinates
    stated: FloatArray  # (P,) values of the source, or middles of ranges; NaN without any
    # (S, P, P) of the earlier data, at each draw, and of assumed values such as the exponent of
    # ``Dahl()``, which are parameters here as in the uncertainty of a fit
    information: FloatArray
    # (P,) information of the ranges, each taken as very wide: the search needs it if a parameter
    # cannot be determined; predicted uncertainties do not include it
    prior: FloatArray
    assumed: tuple[str, ...] = ()  # names of the assumed parameters
    sensors: Sensors | None = None
    motion: Motion = "translation"
    # standard deviation of ln gain and of phase of a row of earlier data
    row_noise: float | None = None
    row_cycles: float = 1.0  # cycles averaged in such a row, if the data state it
    problem: TableProblem | None = None  # of the earlier data
    scatter: float = 0.0  # standard deviation of ln gain and phase between runs in the earlier data
    between: FloatArray | None = None  # (P,) variances of theta between runs, if there are any
    errors: ErrorModel | None = None  # of an earlier fit
    # standard deviation of a sample of force in earlier records, N
    sample_noise: float | None = None
    steady: Steady = "exact"  # how responses to a controlled force are predicted

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

    @property
    def units(self) -> FloatArray:
        """Scale of each search coordinate, (P,): 1 for logarithms, the size of draws for others."""
        return units_of(self.parameters, self.theta)

    def only(self, draws: IntArray) -> Knowledge:
        """Return the knowledge restricted to some of the draws."""
        return replace(self, theta=self.theta[draws], information=self.information[draws])

    def thinned(self, most: int) -> Knowledge:
        """Return the knowledge at no more than `most` of the draws, evenly spread."""
        return self.only(spread(len(self.theta), most))

    def problem_at(
        self,
        levels: FloatArray,
        frequency_hz: FloatArray,
        controlled: str,
        *,
        model: Model | None = None,
        harmonic: int = 1,
        noise: str = "relative",
    ) -> TableProblem:
        """Return the problem of levels whose responses are not measured yet."""
        level: dict[str, Any] = {"drive" if controlled == "force" else "amplitude": levels}
        data = FrequencyResponse(
            frequency_hz,
            np.ones(len(levels)),
            controlled=controlled,
            motion=self.motion,
            harmonic=harmonic,
            **level,
        )
        return TableProblem(
            data, model or self.model, noise=noise, sensors=self.sensors, steady=self.steady
        )

    def model_values(self) -> list[FloatArray]:
        """Return every parameter of the model at every draw, (S, 1), or () if it is fixed."""
        drawn = dict(zip(self.names, self.values.T, strict=True))
        return [
            drawn[p.name][:, None] if p.free else np.asarray(p.value) for p in self.model.parameters
        ]


def spread(count: int, most: int) -> IntArray:
    """Return at most `most` of the numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def units_of(parameters: Sequence[Parameter], theta: FloatArray) -> FloatArray:
    """Return the scale of each search coordinate: 1 for logarithms, else the size of its draws."""
    size = np.median(np.abs(theta), axis=0)
    size = np.where(size > 0.0, size, np.maximum(theta.std(axis=0), 1e-300))
    size = np.where(size > 1e-290, size, 1.0)
    return np.where(Space(parameters).positive, 1.0, size)


def gather(source: Any, ranges: Ranges | None, draws: int, seed: int) -> Knowledge:
    """Return the knowledge from a model with ranges, a fit or a posterior."""
    rng, ranges = np.random.default_rng(seed), ranges or {}
    if isinstance(source, Element):
        return _of_model(as_model(source), ranges, draws, rng)
    problem = getattr(source, "problem", None)
    if problem is None:
        raise ValidationError(
            f"plan: got a {type(source).__name__}; expected a model such as Dahl(), a fit, or a "
            "posterior"
        )
    sampled = hasattr(source, "draws")
    if problem.response is None:
        return _of_records(
            source, source.draws(_POSTERIOR_DRAWS, seed) if sampled else None, ranges, draws, rng
        )
    values = np.asarray(source.draws(draws, seed)) if sampled else None
    return _of_table(source, values, ranges, draws, rng)


def _of_table(
    source: Any, values: FloatArray | None, ranges: Ranges, draws: int, rng: np.random.Generator
) -> Knowledge:
    """Return the knowledge from a fit of a table with all its sources of error, or a posterior."""
    problem = source.problem
    errors: ErrorModel | None = source.errors if values is None else None
    model, assumed = _with_assumed(problem.model)
    centre, std = _moments(problem.parameters, ranges)
    between: FloatArray | None = None
    if values is None:
        theta, optimum = np.array(source.optimum.theta, dtype=np.float64), source.optimum
        finite = np.isfinite(theta) & np.isfinite(optimum.values)
        u = np.sqrt(np.diagonal(optimum.covariance))
        known = finite & (u <= np.where(problem.space.positive, np.log(LARGEST_FACTOR), np.inf))
        for name in itertools.compress(problem.names, ~known & np.isinf(std)):
            raise ValidationError(
                f"plan: the fit does not determine {name}; give "
                f"{argument('ranges', {name: (LOW, HIGH)})}, or plan from the model with "
                f"{argument('ranges')}"
            )
    if errors is not None:
        wider, names = errors.problem, (*problem.names, *assumed)
        kept = [i for i, name in enumerate(errors.names) if name in names]
        parameters, part = tuple(wider.parameters[i] for i in kept), np.ix_(kept, kept)
        information = np.linalg.inv(errors.covariance)[part]
        at, covariance = _with_ranges(
            errors.theta[kept],
            np.linalg.inv(errors.covariance[part]),
            _among(parameters, problem.names, centre, 0.0),
            _among(parameters, problem.names, 1.0 / std**2, 0.0),
        )
        theta = _drawn(rng, at, covariance, draws, parameters)
        stated, cycles = _row_noise(wider, 0.0)
        noise = float(np.hypot(stated, errors.rms(NOISE)))
        pairs = list(zip(errors.sources, errors.variances.tolist(), strict=True))
        of_runs = {s.per_test: variance for s, variance in pairs if s.name == RUNS}
        differing = np.array([of_runs.get(p.name, 0.0) for p in parameters])
        between = differing if differing.any() else None
    else:
        wider = problem.like(model=model) if assumed else problem
        parameters = wider.parameters
        if values is None:
            at = np.where(finite, theta, centre)
            scale: Any = optimum.scale if np.isfinite(optimum.scale) else 1.0
            of_data = problem.information(at, scale)
            at, covariance = _with_ranges(at, of_data, centre, 1.0 / std**2)
            theta = _drawn(rng, at, covariance, draws, problem.parameters)
        else:
            P = len(problem.names)
            scale = values[:, P] if values.shape[1] > P else np.ones(draws)
            theta = at = problem.to_search(values[:, :P])
        theta, at = (_among(parameters, problem.names, part) for part in (theta, at))
        information = wider.information(at, scale) + _of_assumed(parameters, assumed)
        noise, cycles = _row_noise(wider, float(np.median(scale)))
    prior = _of_ranges(problem.parameters, centre, std)
    return Knowledge(
        model,
        parameters,
        theta,
        _stated(source, parameters),
        _repeated(information, draws),
        _among(parameters, problem.names, prior, 0.0),
        tuple(assumed),
        problem.sensors,
        problem.data.motion,
        noise,
        cycles,
        wider,
        0.0 if errors is None else errors.rms(RUNS),
        between,
        errors,
        steady=problem.steady,
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
        needed = argument("ranges", dict.fromkeys(missing, (LOW, HIGH)))
        raise ValidationError(
            f"plan: nothing is known about {', '.join(missing)}; give {needed} that contain the "
            "values with 95 % probability"
        )
    model, assumed = _with_assumed(model)
    parameters = tuple(p for p in model.parameters if p.free)
    names = [p.name for p in free]
    theta = _within(centre + std * rng.standard_normal((draws, len(free))), free)
    return Knowledge(
        model,
        parameters,
        _among(parameters, names, theta),
        Space(parameters).to_values(_among(parameters, names, centre)),
        _repeated(_of_assumed(parameters, assumed), draws),
        _among(parameters, names, _of_ranges(free, centre, std), 0.0),
        tuple(assumed),
    )


def _of_records(
    source: Any, values: FloatArray | None, ranges: Ranges, draws: int, rng: np.random.Generator
) -> Knowledge:
    """Return the knowledge from a fit of records whose force was predicted, or its posterior."""
    if ranges:
        raise ValidationError(
            "plan: ranges are given with a fit of records, which determines its parameters; leave "
            f"them out, or give the model with {argument('ranges')}"
        )
    fit = source if values is None else source.fit
    problem: RecordProblem = fit.optimum.problem
    if problem.output != "force":
        raise ValidationError(
            "plan: the fit predicts the motion of a driven plant; expected a fit of a frequency "
            "response, a fit of records whose force it predicts, or the model with "
            f"{argument('ranges')}"
        )
    errors, assumed = fit.errors, fit.errors.assumed
    parameters, free = tuple(errors.problem.free), tuple(problem.free)
    n, P, every = len(parameters), len(free), Space(parameters)
    best = errors.values[:n]
    slope = every.slopes(best)
    joint = errors.covariance[:n, :n] / np.outer(slope, slope)
    if values is None:
        if not np.isfinite(joint).all():
            raise ValidationError("plan: the fit does not determine its parameters; give the model")
        theta = _drawn(rng, every.to_search(best), joint, draws, parameters)
    else:
        posterior = Space(free).to_search(values[:, :P])
        fitted = np.array([p.name not in assumed for p in parameters])
        slope = slope[fitted]
        # changes of the others with the exponents' uncertainty, and noise
        others = joint[np.ix_(fitted, ~fitted)]
        known = others @ np.linalg.solve(joint[np.ix_(~fitted, ~fitted)], others.T)
        known += fit.assessment.covar_noise[:P, :P] / np.outer(slope, slope)
        covariance = np.atleast_2d(np.cov(posterior, rowvar=False))
        joint[np.ix_(fitted, fitted)] = known + excess(covariance, known)
        drawn = posterior[rng.integers(len(posterior), size=draws)]
        theta = _within(_among(parameters, [p.name for p in free], drawn), parameters)
    return Knowledge(
        problem.model.with_free(assumed),
        parameters,
        theta,
        _stated(source, parameters),
        _repeated(np.linalg.inv(joint), draws),
        np.zeros(len(parameters)),
        assumed,
        motion=problem.records[0].motion,
        sample_noise=float(np.std(np.concatenate(fit.residuals))),
    )


def _with_ranges(
    theta: FloatArray, information: Any, centre: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a normal estimate together with normal ranges."""
    covariance: FloatArray = np.linalg.inv(information + np.diag(precision))
    return theta + covariance @ (precision * (centre - theta)), covariance


def _drawn(
    rng: np.random.Generator,
    centre: FloatArray,
    covariance: FloatArray,
    draws: int,
    parameters: Sequence[Parameter],
) -> FloatArray:
    """Return normal draws within the parameters' bounds."""
    return _within(rng.multivariate_normal(centre, covariance, draws, method="eigh"), parameters)


def _within(theta: FloatArray, parameters: Sequence[Parameter]) -> FloatArray:
    """Return draws clipped to the parameters' bounds."""
    return np.clip(theta, *Space(parameters).bounds)


def _repeated(information: Any, draws: int) -> FloatArray:
    """Return the information at every draw."""
    return np.broadcast_to(information, (draws, *information.shape[-2:]))


def _stated(source: Any, parameters: Sequence[Parameter]) -> FloatArray:
    """Return the values of a fit or posterior, (P,); NaN at a limit."""
    values = np.array([source.params[p.name].value for p in parameters])
    return np.where(np.isfinite(values), values, np.nan)


def _with_assumed(model: Model) -> tuple[Model, dict[str, float]]:
    """Return the model with its assumed exponents free, and the information of their ranges."""
    assumed = {name: std**-2 for name, std in assumed_exponents(model).items()}
    return (model.with_free(assumed) if assumed else model), assumed


def _of_assumed(parameters: Sequence[Parameter], assumed: Mapping[str, float]) -> FloatArray:
    return np.diag([assumed.get(p.name, 0.0) for p in parameters])


def _among(
    parameters: Sequence[Parameter],
    names: Sequence[str],
    part: FloatArray,
    others: float | None = None,
) -> FloatArray:
    """Return an array over all parameters, (..., P), from `part`, an array over those named.

    The others have the number `others`; if that is None, the logarithm of their value.
    """
    numbers = np.array([np.log(p.value or 1.0) if others is None else others for p in parameters])
    numbers = numbers * np.ones((*part.shape[:-1], 1))
    numbers[..., [[p.name for p in parameters].index(name) for name in names]] = part
    return numbers


def _of_ranges(parameters: Sequence[Parameter], centre: FloatArray, std: FloatArray) -> FloatArray:
    """Return the information of ranges, none of them narrower than `_LEAST_RANGE_STD`."""
    least = _LEAST_RANGE_STD * np.where(Space(parameters).positive, 1.0, np.abs(centre))
    return np.asarray(1.0 / np.maximum(std, least) ** 2)


def _moments(parameters: Sequence[Parameter], ranges: Ranges) -> tuple[FloatArray, FloatArray]:
    """Return centre and standard deviation of each search coordinate; inf without a range."""
    unknown = set(ranges) - {p.name for p in parameters}
    if unknown:
        raise ValidationError(
            f"ranges names {', '.join(sorted(unknown))}; the free parameters are "
            f"{choices((p.name for p in parameters), *unknown)}"
        )
    centre, std = np.zeros(len(parameters)), np.full(len(parameters), np.inf)
    for i, p in enumerate(parameters):
        ends = ranges.get(p.name, p.prior)
        if ends is None:
            continue
        pair = finite_array(ends, f"ranges[{p.name!r}]")
        if pair.shape != (2,) or not pair[0] < pair[1] or (p.positive and pair[0] <= 0):
            above = " above zero" if p.positive else ""
            raise ValidationError(
                f"ranges[{p.name!r}] is {ends!r}; expected two rising numbers{above}"
            )
        low, high = Space([p]).to_search(pair[:, None])[:, 0]
        centre[i], std[i] = 0.5 * (low + high), (high - low) / _NORMAL_RANGE
    return centre, std


def _row_noise(problem: TableProblem, scale: float) -> tuple[float, float]:
    """Return the relative noise of a row of the data, and the number of cycles averaged in it."""
    data, size = problem.data, np.abs(problem.data.response)
    if problem.noise == "relative":
        return scale, 1.0
    if problem.noise == "absolute" or data.covariance is None:
        return float(np.sqrt(np.median((scale / size) ** 2))), 1.0
    cycles = 1.0
    if data.dof is not None and np.isfinite(data.dof).all():
        cycles = float(np.median(data.dof)) + 1.0
    variance = 0.5 * np.trace(data.covariance, axis1=1, axis2=2) / size**2
    return float(np.sqrt(np.median(variance))), cycles

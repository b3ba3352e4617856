"""A posterior as weighted draws: of a Markov chain, or at importance points.

Both kinds have coordinates theta with weights, and a message on their convergence.

Walkers start around the least-squares optimum, wider than the posterior. The optimum is moved
inside the prior's support. Its covariance is the inverse of the Fisher information plus the
precision of the prior, so that directions that the data leave undetermined start as wide as the
prior; walkers start from normal draws with twice that spread.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import gammainccinv

from dahl_ident.arrays import FloatArray, cholesky_root, positive_number
from dahl_ident.bayes.chain import Chain, ChainSettings, Convergence, Listener, Pool, run
from dahl_ident.bayes.checkpoint import identity, open_chain
from dahl_ident.bayes.density import Density, LogDensity
from dahl_ident.bayes.importance import (
    Function,
    WeightedDraws,
    WeightedPoints,
    in_blocks,
    integrate,
    interpolated,
)
from dahl_ident.errors import FitError, SamplingError, ValidationError, argument
from dahl_ident.fitting import Optimum, solve
from dahl_ident.fitting.record_search import Tell
from dahl_ident.problem import Problem
from dahl_ident.sensors import Sensors

_MOST_AXES = 3  # most parameters of a grid: the number of points rises exponentially with it

Start = Callable[[int, np.random.Generator], FloatArray]
"""Return points of finite density, given the number of walkers and a random generator."""


@dataclass(frozen=True)
class ChainSample:
    """The draws of a Markov chain, without its warm-up."""

    chain: Chain
    convergence: Convergence
    settings: ChainSettings

    @cached_property
    def draws(self) -> WeightedDraws:
        """All coordinates after warm-up."""
        kept = self.chain.points[self.convergence.discard :]
        return WeightedDraws.alike(kept.reshape(-1, kept.shape[-1]))

    @property
    def converged(self) -> bool:
        """Whether the chain is long enough to be used."""
        return self.convergence.converged

    @property
    def message(self) -> str:
        """Whether the chain has converged, and what is missing if not."""
        steps, warm_up = self.chain.steps, self.convergence.discard
        if self.converged:
            kept = f"{steps - warm_up} steps of {self.settings.walkers} walkers"
            return f"Converged: {kept} after {warm_up} of warm-up."
        return (
            f"NOT CONVERGED after {steps} steps: {'; '.join(self.convergence.unmet)}. The "
            "numbers are provisional: run more steps, or give narrower priors."
        )

    @property
    def facts(self) -> Mapping[str, Any]:
        """Seed and number of steps."""
        steps, warm_up = self.chain.steps, self.convergence.discard
        return {"seed": self.chain.seed, "steps": steps, "warm_up": warm_up}

    def columns(self, std: FloatArray) -> dict[str, FloatArray]:
        """Return Monte Carlo errors, effective numbers of draws, and R-hat."""
        ess = self.convergence.ess if self.converged else np.full(len(std), np.nan)
        return {"mcse": std / np.sqrt(ess), "ess": ess, "r_hat": self.convergence.r_hat}

    def check(self, names: Sequence[str], result: Any) -> None:
        """Raise an error, with the result, if walkers never moved."""
        moving = np.isfinite(self.convergence.tau)
        if moving.all():
            return
        stuck = [name for name, moves in zip(names, moving, strict=True) if not moves]
        raise SamplingError(
            f"some walkers never moved in {', '.join(stuck)} over {self.chain.steps} steps, so "
            "that nothing is known about the chain; it is in this error's `posterior`. Run more "
            "steps, or look for a prior or data that leave next to no room",
            result,
        )


@dataclass(frozen=True)
class PointSample:
    """Deterministic importance points, with the error of every probability."""

    density: LogDensity
    integral: WeightedPoints
    tolerance: float
    sums: Function

    @cached_property
    def draws(self) -> WeightedDraws:
        """The points, an unknown noise scale included."""
        points = self.integral
        if not isinstance(self.density, Density) or not self.density.has_scale:
            return points
        return WeightedDraws(_with_scale(self.density, self.sums, points), points.weights)

    @property
    def converged(self) -> bool:
        """Whether the error is within the tolerance."""
        return self.integral.error <= self.tolerance

    @property
    def message(self) -> str:
        """The error of the integral, and whether it is small enough."""
        points = self.integral
        text = f"error {points.error:.1g} of the probability, {points.evaluations} points"
        if self.converged:
            return f"Converged: {text}."
        return (
            f"NOT CONVERGED: {text}, expected {self.tolerance:.1g}. The numbers are provisional: "
            f"use {argument('method', 'mcmc')}, or give narrower priors."
        )

    @property
    def log_evidence(self) -> float:
        """The logarithm of the evidence."""
        if not self.density.normalised:
            raise ValidationError(
                "a posterior of records has no evidence: their likelihood is known up to a factor"
            )
        return self.integral.log_evidence

    @property
    def facts(self) -> Mapping[str, Any]:
        """The evidence, if there is one, the error, and the number of points."""
        names = (*["log_evidence"] * self.density.normalised, "error", "evaluations")
        return {name: getattr(self.integral, name) for name in names}

    def columns(self, std: FloatArray) -> dict[str, FloatArray]:
        """Return nothing: the error is one number for all parameters."""
        return {}


Sample = ChainSample | PointSample
"""Weighted draws from a posterior, and whether they can be used."""


def sample_chain(
    density: LogDensity,
    start: Start,
    settings: ChainSettings,
    *,
    seed: int | None = None,
    resume: str | os.PathLike[str] | None = None,
    pool: Pool | None = None,
    listeners: Sequence[Listener] = (),
) -> ChainSample:
    """Run a chain; with `resume`, continue the one in that file and store it there.

    The seed of a file is kept; a `seed` that differs from it is refused.
    """
    with ExitStack() as stack:
        stored = None
        if resume is not None:
            file = stack.enter_context(open_chain(resume, identity(density, settings)))
            stored = file.load()
            if stored is not None and seed not in (None, stored.seed):
                raise SamplingError(
                    f"{os.fspath(resume)} was begun with seed {stored.seed}, but seed is {seed}; "
                    "leave it out to resume, or give another file"
                )
            listeners = [*listeners, file]
        random = np.random.default_rng(settings.seed)
        chain = stored or Chain.at(start(settings.walkers, random), settings.seed)
        chain, verdict = run(density, chain, settings, listeners, pool)
    return ChainSample(chain, verdict, settings)


def sample_points(
    density: LogDensity,
    begin: Callable[[], tuple[FloatArray, FloatArray]],
    given: Sequence[str],
    tolerance: float,
    tell: Callable[[int], None] | None = None,
) -> PointSample:
    """Integrate a density of few parameters.

    `begin` returns a centre and a covariance, (P,) and (P, P); `given` are the names of parameters
    that the user left free; `tell` is called with the number of points so far.
    """
    names = density.prior.names
    if len(names) > _MOST_AXES:
        assumed = [name for name in names if name not in given]
        instead = f"give {', '.join(assumed)} or " if assumed else ""
        raise SamplingError(
            f"{len(names)} parameters are free ({', '.join(names)}); a grid takes up to "
            f"{_MOST_AXES}: {instead}fix some, or use {argument('method', 'mcmc')}"
        )
    positive_number(tolerance, "tolerance")
    centre, covariance = begin()
    evaluations = 0

    def counted(function: Function, theta: FloatArray) -> FloatArray:
        nonlocal evaluations
        result = function(theta)
        evaluations += len(theta)
        if tell is not None:
            tell(evaluations)
        return result

    def integral(log_density: Function, error: float) -> WeightedPoints:
        points = integrate(
            log_density,
            density.prior,
            centre,
            covariance,
            density.decorrelation,
            tolerance=tolerance - error,
        )
        return replace(points, error=points.error + error, evaluations=evaluations)

    if density.likelihood == "gaussian":
        residuals_of = partial(counted, density.residuals)
        near = interpolated(density, residuals_of, centre, covariance, 0.5 * tolerance)
        if near is not None:
            log_density = partial(density.marginal, sums=near)
            points = integral(log_density, near.error)
            some = points.drawn(_CHECKED, 0)  # polynomials may have modes of their own
            excess = counted(density.marginal, some) - log_density(some)
            if float(np.abs(np.expm1(excess)).mean()) <= tolerance:
                return PointSample(density, points, tolerance, near)
    points = integral(partial(counted, density.marginal), 0.0)
    return PointSample(density, points, tolerance, density.sums)


def _with_scale(density: Density, sums_of: Function, points: WeightedPoints) -> FloatArray:
    """Return theta of the points with ln s as their last coordinate, (N, P + 1).

    At fixed parameters with sum of squares S over n rows, s^2 has the inverse gamma distribution
    with shape n and scale S/2. Each point has one quantile of it. The probabilities of these
    quantiles, with the points in order of S, are a low-discrepancy sequence, which represents the
    mixture over the points far better than random draws.
    """
    from scipy.stats import qmc

    squares = in_blocks(sums_of, points.theta)
    uniform = qmc.Halton(1, scramble=False).random(len(squares) + 1)[1:, 0]  # the first is zero
    uniform = uniform[np.argsort(np.argsort(squares))]
    rows = density.problem.n_residuals // 2
    ln_s = 0.5 * np.log(0.5 * squares / gammainccinv(rows, uniform))
    return np.column_stack([points.theta, ln_s])


_START_SPREAD = 2.0  # spread of the starts over that of the posterior, above 1 for R-hat
_TRIES = 60  # most draws of a start, each 0.8 as wide as the last
_INSIDE = 1e-3  # distance of a centre from the prior's ends, over its width
_PRIOR_DRAWS = 4096  # draws of the prior: 98 % probability to hit a region of 1e-3 of it
_POSITIONS = 5  # values tried for a parameter outside its prior, each with a fit of the others
# standard uncertainties from an estimate to its prior beyond which the prior excludes it: chance
# takes a normal estimate that far off once in two million times
_EXCLUDED = 5.0
_CHECKED = 256  # points at which an interpolated density is compared with the exact one
_EXACT_DATA = 1e-13  # relative noise below which residuals are rounding


def optimum_of(problem: Problem, tell: Tell | None = None) -> Optimum | None:
    """Return the least-squares optimum; None if a table has too few data."""
    try:
        return solve(_with_normal_priors(problem), tell=tell)
    except FitError:
        if problem.around_optimum:
            raise
        return None


def _with_normal_priors(problem: Any) -> Any:
    """Return the problem with priors of the sensors replaced by normal ones, for least squares."""
    from scipy import stats

    sensed = {p.name: getattr(problem.sensors, p.name) for p in problem.sensors.parameters}
    normal = {n: stats.norm(p.mean(), p.std()) for n, p in problem.priors.items()}
    return problem.like(sensors=Sensors(**sensed | normal)) if normal else problem


def starting_points(
    density: LogDensity, optimum: Optimum | None, walkers: int, random: np.random.Generator
) -> FloatArray:
    """Return `walkers` points of finite density, (walkers, D)."""
    theta, covariance = centre_and_covariance(density, optimum, random)
    centre, root = theta, cholesky_root(covariance)
    if density.has_scale:
        assert isinstance(density, Density)
        centre = np.append(theta, np.log(_scale(density, theta)))
        dof = density.problem.n_residuals - len(theta)
        root = block_diag(root, 1.0 / np.sqrt(2.0 * dof))
    spread = np.full(walkers, _START_SPREAD)
    points = np.empty((walkers, len(centre)))
    missing = np.arange(walkers)
    for _ in range(_TRIES):
        shape = (missing.size, len(centre))
        draws = random.standard_normal(shape) @ root.T
        points[missing] = density.in_order(centre + spread[missing, None] * draws)
        missing = missing[~np.isfinite(density(points[missing]))]
        if not missing.size:
            return points
        spread[missing] *= 0.8
    raise SamplingError(
        f"{missing.size} of {walkers} walkers found no point of finite density around "
        f"{dict(zip(density.names, density.to_values(centre).tolist(), strict=True))}; check that "
        "the priors allow values there"
    )


def centre_and_covariance(
    density: LogDensity, optimum: Optimum | None, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return approximate centre and covariance of the posterior."""
    if density.around is not None:
        _refuse_exclusion(density, *density.around)
        return density.around
    assert isinstance(density, Density)
    theta = _inside(density, optimum, random)
    precision = np.diag([(2.0 / part.width) ** 2 for part in density.prior.priors])
    if density.likelihood != "none":
        if density.errors is None:
            scale = _scale(density, theta)
            precision += _with_normal_priors(density.problem).information(theta, scale)
        else:
            precision += density.errors.information
    size = 1.0 / np.sqrt(np.diagonal(precision))
    return theta, np.linalg.inv(precision * np.outer(size, size)) * np.outer(size, size)


def _refuse_exclusion(density: LogDensity, centre: FloatArray, covariance: FloatArray) -> None:
    """Refuse priors that exclude the data's estimate, around which alone the density is known."""
    low, high = density.prior.limits
    away = np.maximum(low - centre, centre - high) / np.sqrt(np.diagonal(covariance))
    values = density.to_values(centre)
    outside = [
        f"{name} is {value:.4g}, {u:.3g} standard uncertainties outside its prior ({text})"
        for (name, text), value, u in zip(density.priors.items(), values, away, strict=True)
        if u > _EXCLUDED
    ]
    if outside:
        raise SamplingError(
            f"the priors exclude what the data show: {'; '.join(outside)}. Check the prior, its "
            "unit, and the data; to keep the parameter there all the same, fix it"
        )


def _inside(density: Density, optimum: Optimum | None, random: np.random.Generator) -> FloatArray:
    """Return the optimum, moved inside the prior's support, or the best of many prior draws."""
    if optimum is not None and density.likelihood != "none":
        nearest = _moved_inside(density, optimum)
        if np.isfinite(density.highest(nearest[None])).all():
            return nearest
    candidates = density.problem.in_order(density.prior.draw(random, _PRIOR_DRAWS))
    values = density.highest(candidates)
    if not np.isfinite(values).any():
        raise SamplingError(
            f"none of {_PRIOR_DRAWS} draws from the prior gives the data a finite likelihood; "
            "check the priors and the model"
        )
    return np.asarray(candidates[np.argmax(values)])


def _moved_inside(density: Density, optimum: Optimum) -> FloatArray:
    """Return the optimum, or the likeliest of nearby points if it is outside the prior's bulk.

    Such a point has the first parameter outside moved inside, and the others fitted again: in
    microslip, for example, sigma and the spring have to follow a finite f_max.
    """
    problem = density.problem
    low, high = _narrowed(*np.transpose([part.bulk for part in density.prior.priors]))
    nearest = np.clip(optimum.theta, low, high)
    outside = np.flatnonzero(nearest != optimum.theta)
    if not outside.size:
        return nearest
    candidates = [nearest, np.clip(optimum.theta, *_narrowed(*density.prior.limits))]
    first = outside[0]
    positions = np.linspace(nearest[first], 0.5 * (low + high)[first], _POSITIONS)
    for position in positions if len(problem.names) > 1 else ():
        candidate = nearest.copy()
        candidate[first] = position
        value = {problem.names[first]: float(problem.to_values(candidate)[first])}
        reduced = optimum_of(problem.like(fixed=value))
        if reduced is not None:
            candidate[[problem.names.index(name) for name in reduced.names]] = reduced.theta
            candidates.append(np.clip(candidate, low, high))
    values = density.highest(np.array(candidates))
    return candidates[int(np.argmax(values))]


def _narrowed(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    margin = _INSIDE * (high - low)
    return low + margin, high - margin


def _scale(density: Density, theta: FloatArray) -> float:
    """Return the likeliest noise scale at theta; 1 where it is known."""
    if not density.has_scale:
        return 1.0
    squares = float(density.quick.squares(theta[None]).sum())
    scale = float(np.sqrt(squares / density.problem.n_residuals))
    if not scale > _EXACT_DATA:
        raise SamplingError(
            f"the model fits the data to {scale:.1e} of their size, so there is no noise whose "
            "scale could be estimated; data without noise need a covariance for sampling"
        )
    return scale

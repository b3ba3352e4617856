"""Start of the walkers: around the least-squares optimum, wider than the posterior.

The optimum is moved inside the prior's support. Its covariance is the inverse of the Fisher
information plus the prior's own precision, so that directions that the data leave undetermined
start as wide as the prior, and walkers draw from Student's t with twice that spread.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import Density, LogDensity
from dahl_ident.errors import FitError, SamplingError
from dahl_ident.fitting import Optimum, solve
from dahl_ident.fitting.record_search import Tell
from dahl_ident.problem import Problem
from dahl_ident.sensors import Sensors

_WIDER = 2.0  # times the posterior's spread: R-hat needs starts wider than the posterior
_TRIES = 60  # each 0.8 as wide as the last: in the end a millionth of the posterior
_INSIDE = 1e-3  # of the prior's width, kept from its ends
_PRIOR_DRAWS = 4096  # 98 % find a region that holds 1e-3 of the prior
_POSITIONS = 5  # of the offending parameter, each of which takes a fit of the others
_EXACT = 1e-13  # relative noise below which a fit is exact to rounding


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
    centre, root = _with_scale(density, theta, covariance)
    spread = np.full(walkers, _WIDER)
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
    """Return theta near the posterior's centre, and about its covariance."""
    if density.around is not None:
        return density.around
    assert isinstance(density, Density)
    theta = _inside(density, optimum, random)
    precision = np.diag([(2.0 / part.width) ** 2 for part in density.prior.priors])
    if density.likelihood != "none":
        scale = _scale(density, theta)
        if density.errors is None:
            known = _with_normal_priors(density.problem).information(theta, scale)
        else:
            known = density.curvature(theta)[1] / scale**2
        precision = precision + known
    size = 1.0 / np.sqrt(np.diagonal(precision))
    return theta, np.linalg.inv(precision * np.outer(size, size)) * np.outer(size, size)


def _with_scale(
    density: LogDensity, theta: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the centre and a root of the covariance, ln s included where it is sampled."""
    P = len(theta)
    std = np.sqrt(np.diagonal(covariance))
    root = std[:, None] * np.linalg.cholesky(covariance / np.outer(std, std))
    if not density.has_scale:
        return theta, root
    assert isinstance(density, Density)
    wider = np.zeros((P + 1, P + 1))
    wider[:P, :P] = root
    wider[P, P] = 1.0 / np.sqrt(2.0 * (density.problem.n_residuals - P))
    return np.append(theta, np.log(_scale(density, theta))), wider


def _inside(density: Density, optimum: Optimum | None, random: np.random.Generator) -> FloatArray:
    """Return the optimum moved inside the prior's support, or else the best of many prior draws."""
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
    """Return the optimum, or if it is outside the bulk of the prior, the likeliest point nearby.

    That may still be the optimum, or a point with the offending parameter moved inside the prior:
    in microslip, for example, sigma and the spring have to follow an f_max that cannot be infinite.
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
    if density.errors is None:
        squares = float(density.quick.squares(theta[None]).sum())
    else:
        squares = 2.0 * density.curvature(theta)[0]
    scale = float(np.sqrt(squares / density.problem.n_residuals))
    if not scale > _EXACT:
        raise SamplingError(
            f"the model fits the data to {scale:.1e} of their size, so there is no noise whose "
            "scale could be estimated; data without noise need a covariance for sampling"
        )
    return scale

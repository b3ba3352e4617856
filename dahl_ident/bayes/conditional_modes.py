r"""Conditional modes and spreads of a posterior at given values of one parameter.

Modes are found by damped Gauss-Newton steps for many values at once. Each search starts from the
nearest value already solved, along the slope of the mode there, so that a ridge is followed from
the centre of the posterior outwards. A mode need not be exact, because the lattice around it covers
the density wherever its centre is.

Parameters of springs, dampers and masses depend on friction along curves; they are represented by
phi of :mod:`dahl_ident.bayes.decorrelation`, in which these curves are straight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.decorrelation import Decorrelation, decorrelation_of
from dahl_ident.bayes.density import Density
from dahl_ident.problem import Problem
from dahl_ident.sensors import Sensors

_STEPS = 25  # at most; a mode that is not found by then is the best point so far
_NEAR = 0.1  # length of a step, in standard deviations, at which the mode is near enough
_DAMPING = (1e-3, 0.2, 8.0)  # first; factors after a success and after a failure
_SLOPE = 1e-4  # of a search coordinate, for slopes of the decorrelation
_RIDGE = 1e-13  # regularisation of directions that the data do not determine


class _Fit(NamedTuple):
    """The quadratic model of S slices at a point: objective, gradient and Hessian by phi."""

    value: FloatArray
    gradient: FloatArray
    hessian: FloatArray


class ConditionalModes:
    """Slices of the posterior of a problem.

    Parameters
    ----------
    density : Density
        The posterior.
    outer : int
        The axis held.
    centre : ndarray, shape (P,)
        A point near the centre of the posterior, where the search begins.
    """

    def __init__(self, density: Density, outer: int, centre: FloatArray) -> None:
        problem = _without_priors(density.tabulated)
        self.outer = outer
        self._density, self._problem = density, problem
        self._decorrelation = _without(decorrelation_of(problem), outer)
        behind = [] if self._decorrelation is None else self._decorrelation.linear.tolist()
        others = [i for i in range(len(centre)) if i != outer and i not in behind]
        self._inner = [*others, *behind]
        self.followers = len(behind)
        self._prior_mean, self._prior_precision, self._pull = _priors(density)
        self._box = density.prior.limits
        _, fit = self._solved(centre[None])
        self._known = self._decorrelated(centre[None]), self._slopes(fit)

    @property
    def inner(self) -> tuple[int, ...]:
        """The other axes; linear parameters that depend on friction come last."""
        return tuple(self._inner)

    def charts(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return conditional modes and spreads, in phi for axes that depend on friction."""
        modes, fit = self._solved(self._original(self._starts(values)))
        phi, slopes = self._known
        self._known = (
            np.concatenate([phi, self._decorrelated(modes)]),
            np.concatenate([slopes, self._slopes(fit)]),
        )
        free = np.ix_(range(len(values)), self._inner, self._inner)
        return modes, _roots_of_inverse(fit.hessian[free])

    def follow(self, theta: FloatArray) -> FloatArray:
        """Return the values of the dependent axes for given friction."""
        if self._decorrelation is None:
            return theta[:, :0]
        return np.negative(self._decorrelation.shift(theta))

    def _starts(self, values: FloatArray) -> FloatArray:
        """Return phi on the tangent at the nearest value solved before."""
        phi, slopes = self._known
        offset = values[:, None] - phi[:, self.outer]
        nearest = np.abs(offset).argmin(axis=1)
        step = offset[np.arange(len(values)), nearest]
        return np.asarray(phi[nearest] + step[:, None] * slopes[nearest])

    def _solved(self, start: FloatArray) -> tuple[FloatArray, _Fit]:
        """Return modes near starts with the same outer value, and the model there."""
        inner = self._inner
        theta = self._inside(start)
        best = self._model(theta)
        damping = np.full(len(theta), _DAMPING[0])
        active = np.arange(len(theta))
        for _ in range(_STEPS if inner else 0):
            here = _Fit(*(part[active] for part in best))
            step, length = _step(here, inner, damping[active])
            far = ~(length < _NEAR)
            active, step, here = active[far], step[far], _Fit(*(part[far] for part in here))
            if not active.size:
                break
            phi = self._decorrelated(theta[active])
            phi[:, inner] += step
            proposed = self._inside(self._original(phi))
            fit = self._model(proposed)
            better = fit.value < here.value
            took = active[better]
            theta[took] = proposed[better]
            for old, new in zip(best, fit, strict=True):
                old[took] = new[better]
            damping[active] *= np.where(better, _DAMPING[1], _DAMPING[2])
        return theta, best

    def _model(self, theta: FloatArray) -> _Fit:
        """Return minus the log-posterior in its least-squares form, up to a constant."""
        density, problem = self._density, self._problem
        offset = (theta - self._prior_mean) * self._pull
        value = 0.5 * (offset**2 * self._prior_precision).sum(axis=1)
        gradient = offset * self._prior_precision
        chart = self._chart(theta)
        hessian = np.repeat(np.diag(self._prior_precision)[None], len(theta), axis=0)
        if density.likelihood == "none":
            return _Fit(value, gradient, hessian)
        data = density.quadratic(theta, problem, chart)
        cost = np.maximum(data.cost, np.finfo(float).tiny)
        rows = 0.5 * problem.n_residuals
        variance = cost / rows if density.has_scale else np.ones(len(theta))
        value = value + (rows * np.log(cost) if density.has_scale else cost)
        return _Fit(
            np.where(np.isfinite(value), value, np.inf),
            np.nan_to_num(gradient + data.gradient / variance[:, None]),
            np.nan_to_num(hessian + data.hessian / variance[:, None, None]),
        )

    def _chart(self, theta: FloatArray) -> FloatArray:
        """Return dtheta/dphi, (S, P, P)."""
        P = theta.shape[1]
        chart = np.repeat(np.eye(P)[None], len(theta), axis=0)
        if self._decorrelation is not None:
            for axis in range(P):
                if axis not in self._decorrelation.linear:
                    by = np.zeros(P)
                    by[axis] = _SLOPE
                    change = self._decorrelation.shift(theta + by) - self._decorrelation.shift(
                        theta - by
                    )
                    chart[:, self._decorrelation.linear, axis] = -change / (2.0 * _SLOPE)
        return chart

    def _slopes(self, fit: _Fit) -> FloatArray:
        """Return dphi/d(outer) of the mode, (S, P)."""
        inner = self._inner
        slopes = np.zeros_like(fit.gradient)
        slopes[:, self.outer] = 1.0
        if inner:
            H = fit.hessian[np.ix_(range(len(slopes)), inner, inner)]
            slopes[:, inner] = -_solve(H, fit.hessian[:, inner, self.outer])
        return slopes

    def _inside(self, theta: FloatArray) -> FloatArray:
        return np.clip(theta, *self._box)

    def _decorrelated(self, theta: FloatArray) -> FloatArray:
        return (
            theta.copy() if self._decorrelation is None else self._decorrelation.decorrelated(theta)
        )

    def _original(self, phi: FloatArray) -> FloatArray:
        return phi if self._decorrelation is None else self._decorrelation.original(phi)


def _step(fit: _Fit, inner: list[int], damping: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return damped Newton steps of the inner axes, and their lengths in standard deviations."""
    free = np.ix_(range(len(damping)), inner, inner)
    H, g = fit.hessian[free], fit.gradient[:, inner]
    diagonal = np.einsum("sii->si", H)
    damped = H + damping[:, None, None] * diagonal[:, None] * np.eye(len(inner))
    step = -_solve(damped, g)
    return step, np.sqrt(np.abs((step * g).sum(axis=1)))


def _solve(H: FloatArray, g: FloatArray) -> FloatArray:
    """Return H^-1 g, after scaling the rows and columns of H."""
    size = 1.0 / np.sqrt(np.einsum("sii->si", H))
    scaled = H * size[:, :, None] * size[:, None]
    solved = np.linalg.solve(scaled + _RIDGE * np.eye(H.shape[-1]), (g * size)[..., None])[..., 0]
    return np.asarray(size * solved)


def _roots_of_inverse(H: FloatArray) -> FloatArray:
    """Return lower triangular L with L L' = H^-1."""
    size = 1.0 / np.sqrt(np.einsum("sii->si", H))
    scaled = H * size[:, :, None] * size[:, None] + _RIDGE * np.eye(H.shape[-1])
    # with J J' = H of reversed order, (J^-1)' reversed is lower triangular
    reverse = np.linalg.cholesky(scaled[:, ::-1, ::-1])
    root = np.linalg.inv(reverse).swapaxes(-1, -2)[:, ::-1, ::-1]
    return np.asarray(size[:, :, None] * root)


def _without(decorrelation: Decorrelation | None, outer: int) -> Decorrelation | None:
    """Return the decorrelation of the other axes."""
    if decorrelation is None or np.array_equal(decorrelation.linear, [outer]):
        return None
    others = decorrelation.linear != outer
    return replace(
        decorrelation,
        linear=decorrelation.linear[others],
        projection=decorrelation.projection[:, others],
    )


def _without_priors(problem: Problem) -> Problem:
    """Return the problem without the priors of the sensors, which are counted separately."""
    if not problem.priors:
        return problem
    given = {p.name: getattr(problem.sensors, p.name) for p in problem.sensors.parameters}
    sensors = Sensors(**{**given, **dict.fromkeys(problem.priors)})
    return Problem(
        problem.data, problem.model, noise=problem.noise, sensors=sensors, steady=problem.steady
    )


def _priors(density: Density) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return means and precisions of normal priors, and which apply: bounds do not."""
    parts = density.prior.priors
    mean = np.array([float(part.quantile(np.array([0.5]))[0]) for part in parts])
    pulls = np.array([part.distribution is not None for part in parts])
    return mean, (2.0 / density.prior.widths) ** 2, pulls.astype(float)

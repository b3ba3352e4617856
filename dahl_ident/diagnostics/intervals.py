"""Confidence intervals of the parameters.

``combined``
    Every source of the uncertainty budget (:mod:`dahl_ident.diagnostics.budget`), with Student's
    t for its effective degrees of freedom; the default.

Three methods count noise alone, where a misfit in excess of a stated noise counts as noise. From
quick to thorough:

``wald``
    Estimate plus and minus standard errors, in search coordinates (for positive parameters a
    factor). Correct where the problem is nearly linear over the interval.
``profile``
    Where the deviance, with all other parameters optimal, rises to its threshold
    (:mod:`dahl_ident.diagnostics.profile`). Follows curvature; a side on which the data set no
    limit is open.
``bootstrap``
    Fits to simulated repetitions of the measurement, studentised (:func:`bootstrap_intervals`).
    Follows the estimate's actual distribution.

Use: ``wald`` is computed with every fit and suffices while ``compare_intervals`` shows no
disagreement; ``profile`` whenever a parameter is badly determined; ``bootstrap`` to check both.
Where the noise's scale was estimated, thresholds are those of Student's t and F.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from dahl_ident.arrays import BoolArray, FloatArray, whole_number
from dahl_ident.diagnostics.confidence_levels import (
    LEVELS,
    MANY,
    checked_levels,
    coverage_factors,
    level_text,
    thresholds,
)
from dahl_ident.diagnostics.contributions import ErrorContributions
from dahl_ident.diagnostics.error_model import ErrorModel
from dahl_ident.diagnostics.formatting import degrees_text, table
from dahl_ident.diagnostics.profile import Profiler
from dahl_ident.errors import FitError, ValidationError
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import Status
from dahl_ident.fitting.search import repetitions
from dahl_ident.problem.space import Space
from dahl_ident.units import counted

Method = Literal["combined", "wald", "profile", "bootstrap"]
_BY_FACTOR = 0.2  # u of a logarithm, above which limits are value * factor and value / factor
LARGEST_FACTOR = 1e8  # above it there is no limit
LARGE = 0.1  # u of a logarithm from noise alone, above which a side may be open
_SIZE_THAT_MATTERS = 0.1  # of the response, for parameters that may be zero
_DISAGREES = 0.2  # half widths between the limits of two methods
_LIMIT_ROUNDING = 1e-9  # relative difference of limits that is rounding
_FEWEST = 99  # replicates: with fewer, a tail of 1 % has none
_AT_LIMIT = 0.01  # share of diverging replicates above which the interval is symmetric
METHODS: tuple[Method, ...] = get_args(Method)


class Interval(NamedTuple):
    """One confidence interval; an open end is infinite, or zero for a positive parameter."""

    level: float
    lower: float
    upper: float


@dataclass(frozen=True)
class ConfidenceIntervals(Mapping[str, tuple[Interval, ...]]):
    """Intervals of every free parameter at several levels; a mapping by the parameter's name.

    Examples
    --------
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    >>> intervals = fit.conf_interval("profile", levels=(0.95,))
    >>> limits = intervals["f_max"][0]
    >>> print(f"f_max from {limits.lower:.4f} to {limits.upper:.4f} N")
    f_max from 0.0995 to 0.1006 N
    """

    method: Method
    levels: FloatArray  # (L,), rising
    names: tuple[str, ...]  # of the P parameters
    units: tuple[str, ...]
    estimate: FloatArray  # (P,)
    lower: FloatArray  # (L, P): limits in the parameters' units
    upper: FloatArray
    note: str  # what the method assumes, such as the degrees of freedom of its threshold

    def __getitem__(self, name: str) -> tuple[Interval, ...]:
        if name not in self.names:
            raise KeyError(f"{name} is not a free parameter; there are {', '.join(self.names)}")
        i = self.names.index(name)
        rows = zip(self.levels, self.lower[:, i], self.upper[:, i], strict=True)
        return tuple(Interval(float(c), float(a), float(b)) for c, a, b in rows)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def at(self, level: float) -> dict[str, Interval]:
        """Return the intervals of one level, by name."""
        (row,) = np.flatnonzero(np.isclose(self.levels, level))
        return {name: self[name][row] for name in self.names}

    def only(self, level: float) -> ConfidenceIntervals:
        """Return these intervals at one of their levels."""
        row = np.isclose(self.levels, level)
        return replace(self, levels=self.levels[row], lower=self.lower[row], upper=self.upper[row])

    def __str__(self) -> str:
        head = ["", *(f"-{level_text(c)}" for c in self.levels[::-1]), "estimate"]
        head += [level_text(c) for c in self.levels]
        rows = [head]
        for i, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            numbers = [*self.lower[::-1, i], self.estimate[i], *self.upper[:, i]]
            rows.append([f"{name} [{unit}]" if unit else name, *(f"{v:.5g}" for v in numbers)])
        return f"{self.method} intervals ({self.note})\n{table(rows)}"

    def to_frame(self) -> Any:
        """Return a pandas table: one row a parameter and level."""
        import pandas as pd

        rows = [
            {"parameter": name, "unit": unit, "method": self.method, **interval._asdict()}
            for name, unit in zip(self.names, self.units, strict=True)
            for interval in self[name]
        ]
        return pd.DataFrame(rows)


def wald_intervals(optimum: Optimum, levels: Sequence[float] = LEVELS) -> ConfidenceIntervals:
    """Return theta ± q stderr, transformed to parameter values."""
    array = checked_levels(levels)
    error = np.sqrt(np.diagonal(optimum.covariance))
    width = thresholds(optimum, array)[:, None] * error
    width = np.where(np.isfinite(width), width, np.inf)
    return intervals_from_search(
        optimum, "wald", array, optimum.theta - width, optimum.theta + width
    )


def profile_intervals(
    profiler: Profiler, levels: Sequence[float] = LEVELS, asked: BoolArray | None = None
) -> ConfidenceIntervals:
    """Return where the profile of the deviance meets the thresholds; open where it does not.

    If the search is slow, limits are NaN for parameters that were not `asked` for, by default all.
    """
    array = checked_levels(levels)
    lower, upper = profiler.limits(thresholds(profiler.optimum, array), asked)
    return intervals_from_search(profiler.optimum, "profile", array, lower, upper)


def combined_intervals(
    optimum: Optimum,
    errors: ErrorModel,
    levels: Sequence[float],
    profile: Callable[[BoolArray], ConfidenceIntervals],
) -> ConfidenceIntervals:
    """Return intervals that count every source of error: value -+ k u.

    For a positive parameter whose u is above 20 %, the limits are value exp(-+ k u/value). For one
    with an open side, they are those of the profile, widened by the other sources. Assumed
    parameters come after those that were fitted, within their ranges.
    """
    array, every = checked_levels(levels), errors.problem
    estimates, directions = every.to_values(errors.theta), np.eye(len(errors.names))
    u_of_all = errors.std(directions)
    dof_of_all = np.array([errors.dof(direction) for direction in directions])
    k_of_all = coverage_factors(dof_of_all, array[:, None])
    low, high = around(every.space, estimates, u_of_all * every.space.slopes(estimates), k_of_all)
    fitted = errors.places(optimum.names)
    determined = np.array([errors.holds(name) for name in optimum.names])
    values, u, k = estimates[fitted], u_of_all[fitted], k_of_all[:, fitted]
    dof = np.where(determined, dof_of_all[fitted], np.inf)
    positive = optimum.problem.space.positive
    noise = errors.by_noise
    by_noise = np.sqrt(np.diagonal(noise.covariance))
    doubtful = ~determined | ~(by_noise <= LARGE * natural_sizes(noise))
    if doubtful.any():
        shape = profile(doubtful)
        estimates[fitted] = np.where(determined, values, shape.estimate)
        # where one side is open, u says nothing about the other: its limit is that of the profile,
        # moved away from the estimate by the other sources
        unlimited = np.isinf(shape.upper) | np.isinf(shape.lower) | (positive & (shape.lower == 0))
        by_profile = doubtful & (~determined | unlimited.any(axis=0))
        beyond = np.where(determined, np.maximum(u**2 - by_noise**2, 0.0), 0.0)
        for limits, end, sign in ((low, shape.lower, -1.0), (high, shape.upper, 1.0)):
            theta = search_coordinates(noise, end)
            far = np.hypot(theta - noise.theta, k * np.sqrt(beyond))
            moved = noise.problem.to_values(noise.theta + sign * far)
            moved = np.where(np.isfinite(theta) & (beyond > 0.0), moved, end)
            limits[:, fitted] = np.where(by_profile, moved, limits[:, fitted])
    shown = degrees_text(np.where(dof < MANY, dof, np.inf)[determined])
    law = "normal distribution" if shown == "infinite" else f"t with {shown} degrees of freedom"
    note = f"every source of the budget: {law}"
    assumed = tuple(name for name in errors.assumed if errors.holds(name))
    return intervals_of(errors, optimum.names, assumed, array, estimates, (low, high), note)


def intervals_of(
    errors: ErrorContributions,
    fitted: tuple[str, ...],
    assumed: tuple[str, ...],
    levels: FloatArray,
    values: FloatArray,
    limits: tuple[FloatArray, FloatArray],
    note: str,
) -> ConfidenceIntervals:
    """Return the combined intervals of fitted and, within their ranges, of assumed parameters.

    `values` are those of all estimates of `errors`, (Q,), `limits` their lower and upper limits,
    (L, Q). An estimate beyond an end of its range keeps its limit there.
    """
    at = errors.places((*fitted, *assumed))
    parameters = [errors.problem.parameters[i] for i in at]
    ranges = [p.prior if p.name in assumed and p.prior else (-np.inf, np.inf) for p in parameters]
    least, most = np.array(ranges).T
    values, lower, upper = values[at], limits[0][:, at], limits[1][:, at]
    return ConfidenceIntervals(
        "combined",
        levels,
        (*fitted, *assumed),
        tuple(p.unit for p in parameters),
        values,
        np.where(values > least, np.maximum(lower, least), lower),
        np.where(values < most, np.minimum(upper, most), upper),
        note,
    )


def natural_sizes(optimum: Optimum) -> FloatArray:
    """Return the reference of each standard deviation of theta: 1 for logarithms."""
    problem = optimum.problem
    if problem.space.positive.all():
        return np.ones(optimum.theta.size)
    slope = np.abs(problem.prediction_jacobian(optimum.theta))
    response = np.abs(problem.predict(optimum.theta))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = 1.0 / np.nanmax(slope / response, axis=0)
    size = np.maximum(np.abs(optimum.theta), _SIZE_THAT_MATTERS * whole)
    return np.where(problem.space.positive | ~np.isfinite(size) | (size == 0.0), 1.0, size)


def around(
    space: Space, values: FloatArray, u: FloatArray, k: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the limits value -+ k u within the bounds, each (L, P).

    For a positive parameter whose u is above 20 %, they are value exp(-+ k u/value), and open where
    that is a factor of 1e8.
    """
    least, most = (space.to_values(bound) for bound in space.bounds)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        relative = np.where(space.positive, u / values, 0.0)
        by_factor = space.positive & ~(relative <= _BY_FACTOR)
        factor = np.exp(k * relative)
        factor = np.where(factor <= LARGEST_FACTOR, factor, np.inf)
        lower = np.where(by_factor, values / factor, values - k * u)
        upper = np.where(by_factor, values * factor, values + k * u)
    return np.maximum(lower, least), np.minimum(upper, most)


def intervals_from_search(
    optimum: Optimum, method: Method, levels: FloatArray, lower: FloatArray, upper: FloatArray
) -> ConfidenceIntervals:
    """Return intervals with limits in search coordinates, (L, P)."""
    problem, count = optimum.problem, lower.shape[1]  # of records, the model's parameters alone
    theta = np.broadcast_to(optimum.theta, (len(levels), len(optimum.theta))).copy()
    low, high = problem.bounds()
    ends = []
    for limit in (np.maximum(lower, low[:count]), np.minimum(upper, high[:count])):
        theta[:, :count] = limit
        ends.append(problem.to_values(theta)[:, :count])
    if optimum.scale_known:
        law = "normal and chi-square" if problem.gaussian else "Student's t row by row"
        added = ", and the misfit as further noise" if problem.has_misfit else ""
        note = f"noise as given by the data{added}: {law}"
    else:
        note = f"noise scale estimated: t and F with {counted(optimum.dof, 'degree of freedom')}"
    names, units = problem.names[:count], tuple(p.unit for p in problem.parameters[:count])
    return ConfidenceIntervals(
        method, levels, names, units, optimum.values[:count], ends[0], ends[1], note
    )


class Disagreement(NamedTuple):
    """A limit on which two methods differ."""

    name: str
    level: float
    side: str
    methods: tuple[str, str]
    limits: tuple[float, float]

    def __str__(self) -> str:
        first, second = (f"{v:.4g}" if np.isfinite(v) and v else "open" for v in self.limits)
        return (
            f"{self.name}: the {self.side} {level_text(self.level)} limit is {first} by "
            f"{self.methods[0]} and {second} by {self.methods[1]}; trust the latter"
        )


@dataclass(frozen=True)
class IntervalComparison:
    """Intervals of several methods side by side, with the limits on which they disagree.

    Examples
    --------
    >>> import dahl_ident as di
    >>> fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    >>> comparison = fit.compare_intervals(levels=(0.95,))
    >>> [intervals.method for intervals in comparison.intervals], comparison.disagreements
    (['wald', 'bootstrap', 'profile'], ())
    """

    intervals: tuple[ConfidenceIntervals, ...]  # by noise alone, the most trusted last
    disagreements: tuple[Disagreement, ...]  # limits that differ from those of the last
    stated: ConfidenceIntervals  # of the fit, by every source of error

    def __str__(self) -> str:
        parts = [*map(str, (self.stated, *self.intervals))]
        if not self.disagreements:
            return "\n\n".join([*parts, "The methods that count noise alone agree."])
        by_interest = sorted(self.disagreements, key=lambda d: -abs(d.level - LEVELS[1]))
        shown = {(d.name, d.methods[0], d.side): d for d in by_interest}  # one level is enough
        lines = [str(shown[key]) for key in sorted(shown)]
        lines.insert(0, "The methods that count noise alone disagree:")
        return "\n\n".join([*parts, "\n".join(lines)])


def compare(
    optimum: Optimum, intervals: Sequence[ConfidenceIntervals], stated: ConfidenceIntervals
) -> IntervalComparison:
    """Return where each method differs from the last by more than a fifth of a half width."""
    if len(intervals) < 2:
        raise ValidationError(f"{len(intervals)} intervals given; a comparison needs two or more")
    last = intervals[-1]
    disagreements = []
    count = min(map(len, intervals))
    theta = optimum.theta[:count]
    for earlier in intervals[:-1]:
        if not np.array_equal(earlier.levels, last.levels):
            raise ValidationError(f"{earlier.method} and {last.method} intervals differ in level")
        for side in ("lower", "upper"):
            trusted = getattr(last, side)[:, :count]
            compared = getattr(earlier, side)[:, :count]
            trusted_theta = search_coordinates(optimum, trusted)
            compared_theta = search_coordinates(optimum, compared)
            with np.errstate(invalid="ignore"):
                half_width = np.abs(trusted_theta - theta)
                apart = np.abs(trusted_theta - compared_theta) > _DISAGREES * half_width
            apart |= np.isinf(trusted_theta) != np.isinf(compared_theta)
            apart &= ~np.isclose(trusted, compared, rtol=_LIMIT_ROUNDING, atol=0)
            for row, i in np.argwhere(apart).tolist():
                level = float(last.levels[row])
                limits = (compared[row, i], trusted[row, i])
                methods = (earlier.method, last.method)
                disagreements.append(Disagreement(last.names[i], level, side, methods, limits))
    return IntervalComparison(tuple(intervals), tuple(disagreements), stated)


def search_coordinates(optimum: Optimum, values: FloatArray) -> FloatArray:
    """Return search coordinates, infinite where a value has none."""
    positive = optimum.problem.space.positive[: values.shape[-1]]
    with np.errstate(divide="ignore"):
        return np.where(positive, np.log(np.where(positive, values, 1.0)), values)


def _replicate(optimum: Optimum, replicates: int | None, seed: int) -> FloatArray:
    """Return t* of simulated repetitions, (S, P); NaN if one diverges or is not determined."""
    if replicates is None:
        replicates = optimum.problem.n_simulations
    count = whole_number(replicates, "replicates", _FEWEST)
    if optimum.loss != "linear":
        raise ValidationError(
            f"the fit has the robust loss {optimum.loss}, and repetitions with its outliers cannot "
            "be simulated; take profile intervals"
        )
    if optimum.status is Status.NOT_CONVERGED or not np.isfinite(optimum.scale):
        raise FitError("there is no optimum to simulate repetitions from")
    random = np.random.default_rng(whole_number(seed, "seed", 0, np.inf))
    theta, error = repetitions(optimum, count, random)
    known = np.isfinite(theta) & np.isfinite(error) & (error > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, (theta - optimum.theta) / error, np.nan)


def bootstrap_intervals(
    optimum: Optimum, levels: Sequence[float] = LEVELS, replicates: int | None = None, seed: int = 0
) -> ConfidenceIntervals:
    r"""Return studentised bootstrap intervals, from fits to simulated repetitions.

    Responses are drawn from the likelihood at the estimate, with the noise scale that was
    estimated, and every set is fitted like the original. The distribution of

        t* = (theta* - theta_hat) / stderr*

    replaces Student's t: the interval from c to C of it is theta_hat - C stderr to theta_hat - c
    stderr (the studentised bootstrap, or bootstrap-t; Efron and Tibshirani, An Introduction to the
    Bootstrap, 1993, chapter 12). Because each replicate brings its own standard error, the
    estimated noise scale is accounted for.

    Replicates whose optimum lies at infinity have no t*. If their fraction exceeds the probability
    outside the interval, the distribution of t* is not informative, and the interval is open on
    both sides; use the profile there.

    If any parameter diverges in more than a hundredth of the replicates, the estimate lies at or
    near a limit of the model. Which tail of t* is long depends on the side of the limit on which
    the true value lies; a bootstrap from the estimate cannot determine this (Andrews, Econometrica
    68 (2000) 399-405). The size of t* depends on it much less, and the interval is theta_hat -+ C
    stderr, C from the distribution of |t*| (Hall, Journal of the Royal Statistical Society B 50
    (1988) 35-45).
    """
    array = checked_levels(levels)
    tail = 0.5 * (1.0 - array)
    count = optimum.problem.n_reported
    drawn = _replicate(optimum, replicates, seed)[:, :count]
    diverged = np.isnan(drawn)
    symmetric = bool(diverged.any(axis=1).mean() > _AT_LIMIT)
    error = np.sqrt(np.diagonal(optimum.covariance))
    lower, upper = np.full((len(array), count), -np.inf), np.full((len(array), count), np.inf)
    for i in np.flatnonzero(np.isfinite(error[:count])):
        t = drawn[~diverged[:, i], i]
        known = diverged[:, i].mean() <= tail
        if known.any():
            size = np.quantile(np.abs(t), array[known])
            tails = np.quantile(t, [tail[known], 1.0 - tail[known]])
            ends = np.array([-size, size]) if symmetric else tails
            upper[known, i], lower[known, i] = optimum.theta[i] - ends * error[i]
    result = intervals_from_search(optimum, "bootstrap", array, lower, upper)
    note = f"studentised, {len(drawn)} replicates, seed {seed}"
    if symmetric:
        note += "; symmetric, since replicates end at a limit of the model"
    return replace(result, note=note)

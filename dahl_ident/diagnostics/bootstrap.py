r"""Parametric bootstrap: simulated repetitions of the measurement, each of them fitted.

Responses are drawn from the likelihood at the estimate, with the noise scale that was estimated,
and every set is fitted like the original. The distribution of

    t* = (theta* - theta_hat) / stderr*

replaces Student's t: the interval from c to C of it is theta_hat - C stderr to
theta_hat - c stderr (the studentised bootstrap, or bootstrap-t; Efron and Tibshirani, An
Introduction to the Bootstrap, 1993, chapter 12). Because each replicate brings its own standard
error, the estimated noise scale is accounted for.

Replicates whose optimum lies at infinity have no t*. If their fraction exceeds the probability
outside the interval, the distribution of t* is not informative, and the interval is open on both
sides; use the profile there.

If any parameter diverges in more than a hundredth of the replicates, the estimate lies at or near a
limit of the model. Which tail of t* is long depends on the side of the limit on which the true
value lies; a bootstrap from the estimate cannot determine this (Andrews, Econometrica 68 (2000)
399-405). The size of t* depends on it much less, and the interval is theta_hat -+ C stderr, C from
the distribution of |t*| (Hall, Journal of the Royal Statistical Society B 50 (1988) 35-45).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.diagnostics.confidence_levels import LEVELS, checked_levels
from dahl_ident.diagnostics.intervals import ConfidenceIntervals, intervals_from_search
from dahl_ident.errors import FitError, ValidationError
from dahl_ident.fitting import Optimum
from dahl_ident.fitting.optimum import Status
from dahl_ident.fitting.search import repetitions

_FEWEST = 99  # replicates: with fewer, a tail of 1 % has none
_AT_LIMIT = 0.01  # share of diverging replicates above which the interval is symmetric


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
    theta, error = repetitions(optimum, count, np.random.default_rng(whole_number(seed, "seed", 0)))
    known = np.isfinite(theta) & np.isfinite(error) & (error > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known, (theta - optimum.theta) / error, np.nan)


def bootstrap_intervals(
    optimum: Optimum, levels: Sequence[float] = LEVELS, replicates: int | None = None, seed: int = 0
) -> ConfidenceIntervals:
    """Return studentised bootstrap intervals."""
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

"""Confidence levels, and the number of standard errors for each of them.

Where the noise's scale is known, an estimate's error is normal and the rise of -2 ln L follows
chi-square; where the scale was estimated with nu degrees of freedom, they follow Student's t and
F(1, nu). Both follow from one number for each level, the threshold q: the limits are ``theta_hat ±
q stderr``, or lie where the deviance has risen by q^2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from dahl_ident.arrays import FloatArray, array_between
from dahl_ident.errors import ValidationError
from dahl_ident.fitting import Optimum

CONFIDENCE = 0.9545  # of intervals for which no level is stated: k = 2, as for U in JCGM 100
LEVELS = (0.6827, CONFIDENCE, 0.9973)  # one, two and three standard deviations
# Student's t with more degrees of freedom is normal to all digits that a budget shows.
MANY = 1e6


def checked_levels(levels: Sequence[float] | float) -> FloatArray:
    """Return confidence levels as a rising array; raise if they are not valid."""
    array = np.sort(np.atleast_1d(array_between(levels, "levels", 0.0, 1.0)))
    if array.ndim != 1 or array.size == 0 or array[0] <= 0.0 or array[-1] >= 1.0:
        raise ValidationError(
            f"levels is {levels!r}; expected numbers between 0 and 1, such as 0.95"
        )
    return array


def coverage_factor(dof: float) -> float:
    """Return k for the usual confidence."""
    return float(coverage_factors(dof, CONFIDENCE))


def coverage_factors(dof: ArrayLike, levels: ArrayLike) -> FloatArray:
    """Return k of Student's t, or of the normal distribution for infinite degrees of freedom.

    Examples
    --------
    >>> coverage_factors([2.0, np.inf], CONFIDENCE).round(2).tolist()
    [4.53, 2.0]
    """
    upper = 0.5 * (1.0 + np.asarray(levels))
    nu = np.asarray(dof, dtype=np.float64)
    t = special.stdtrit(np.where(np.isinf(nu), np.nan, nu), upper)
    return np.where(np.isinf(nu), special.ndtri(upper), t)


def thresholds(optimum: Optimum, levels: FloatArray) -> FloatArray:
    """Return q of each level: normal where the scale is known, else Student's t (or NaN)."""
    dof = np.inf if optimum.scale_known else optimum.dof if optimum.dof > 0 else np.nan
    return coverage_factors(dof, levels)


def level_text(level: float) -> str:
    """Return a level as text: ``"95.45 %"``."""
    return f"{100.0 * level:.4g} %"

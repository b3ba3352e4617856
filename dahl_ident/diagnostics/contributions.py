"""Contributions of the sources of error to the uncertainty of an estimate.

Each source contributes a covariance, and the covariance of the estimate is their sum
(JCGM 100:2008). Tables and records have different sources.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray

NOISE = "noise"
MODEL_ERROR = "model error"
HARMONICS = "model error of harmonics"
ALONG_MOTION = "model error along the motion"
RUNS = "scatter between runs"
LEVELS = "scatter between repeated levels"
APART = "suspicious points"
TESTS = "jackknife over tests"
TYPE_A = (NOISE, MODEL_ERROR, HARMONICS, ALONG_MOTION, RUNS, LEVELS, APART, TESTS)
"""Sources whose size is estimated from the scatter of the data."""
EXPONENT = "exponent"
DRIVE_FACTOR = "drive factor"
CHANNELS = {
    "force_gain": "force calibration",
    "displacement_gain": "displacement calibration",
    "delay": "delay between the channels",
}
"""Sources by the name of the sensors' parameter."""


class ErrorContributions(ABC):
    """An estimate's covariance by source of error, in the coordinates of the estimate."""

    problem: Any  # the assumed exponents free; its `names` order every array here
    contributions: Mapping[str, FloatArray]  # (Q, Q) each, noise first
    # names of parameters that were assumed: exponents, the force gain for a drive factor
    assumed: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters and assumed exponents."""
        return tuple(self.problem.names)

    def places(self, names: Iterable[str]) -> list[int]:
        """Return the places of parameters in `names`."""
        return [self.names.index(name) for name in names]

    @abstractmethod
    def of_values(self, covariance: FloatArray) -> FloatArray:
        """Return a covariance of the estimates as one of the parameters' values, (Q, Q)."""

    def values_covariance(self, names: Iterable[str], source: str | None = None) -> FloatArray:
        """Return the covariance of the values of some parameters, from one source or from all."""
        at = self.places(names)
        every = self.covariance if source is None else self.contributions[source]
        return np.asarray(self.of_values(every)[np.ix_(at, at)])

    @cached_property
    def covariance(self) -> FloatArray:
        """All sources together, (Q, Q)."""
        return np.asarray(sum(self.contributions.values()))

    def std(self, directions: FloatArray) -> FloatArray:
        """Return the combined standard uncertainty of directions . theta, for (..., Q)."""
        return np.asarray(np.sqrt(variances(directions, self.covariance)))

    @abstractmethod
    def dof(self, direction: FloatArray, source: str | None = None) -> float:
        """Return the effective degrees of freedom of u of direction . theta, or of one source."""


def variances(directions: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the variances of directions . theta, (...), for directions (..., Q).

    Examples
    --------
    >>> variances(np.array([[2.0, 0.0], [0.0, 1.0]]), np.diag([1.0, np.inf])).tolist()
    [4.0, inf]
    """
    endless = np.isinf(np.diagonal(covariance))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    sums = np.maximum(np.einsum("...i,ij,...j->...", directions, finite, directions), 0.0)
    return np.where((directions[..., endless] != 0.0).any(axis=-1), np.inf, sums)


def satterthwaite(variance: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the degrees of freedom of variances whose own variances are `spread`.

    They are 2 variance^2/spread, at least 1, as if both are unbounded; infinite if the spread is
    zero.

    Examples
    --------
    >>> satterthwaite(np.array([1.0, 1.0]), np.array([0.1, 0.0])).tolist()
    [20.0, inf]
    """
    dof = np.full(np.shape(spread), np.inf)
    with np.errstate(invalid="ignore"):
        np.divide(2.0 * variance**2, spread, out=dof, where=spread > 0.0)
    return np.asarray(np.fmax(dof, 1.0))


def positive_part(C: FloatArray) -> FloatArray:
    """Return the positive semidefinite part of a symmetric matrix."""
    values, vectors = np.linalg.eigh(C)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def excess(total: FloatArray, known: FloatArray) -> FloatArray:
    """Return the positive semidefinite part of `total` beyond `known`, scaled to unit diagonal.

    Values whose variance is infinite in either have none.

    Examples
    --------
    >>> total = np.array([[np.inf, 5.0], [5.0, 3.0]])
    >>> excess(total, np.diag([np.inf, 1.0])).round(12).tolist()
    [[0.0, 0.0], [0.0, 2.0]]
    """
    finite = np.isfinite(total.diagonal()) & np.isfinite(known.diagonal())
    total, known = (np.where(np.outer(finite, finite), C, 0.0) for C in (total, known))
    size = np.sqrt(np.maximum(total, known).diagonal())
    units = np.outer(size, size)
    units[units == 0.0] = 1.0
    return np.asarray(positive_part((total - known) / units) * units)

"""What a solver returns: plain numbers, and nothing that a report would add."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import FitError
from dahl_ident.fitting.status import Status
from dahl_ident.problem import Problem, ProblemBatch

_NULL = 1e-13  # eigenvalue of the scaled information below which a direction is undetermined
_PART = 1e-4  # of a parameter in such a direction that matters


@dataclass(frozen=True)
class Combination:
    """A combination of parameters that the data determine although its parts run away."""

    expression: str
    value: float
    stderr: float


@dataclass(frozen=True)
class Optimum:
    """The minimum of a problem's sum of squares.

    Attributes
    ----------
    problem : Problem
        What was solved; its `names` order every array here.
    theta : ndarray, shape (P,)
        Search coordinates. Where the optimum lies at infinity, a finite point so far out that
        the prediction is that of the limit.
    values : ndarray, shape (P,)
        Parameter values; infinite or zero where the optimum has them so.
    covariance : ndarray, shape (P, P)
        Of theta: scale^2 times the inverse Fisher information; infinite where undetermined.
    scale : float
        Standard deviation of the residuals: 1 where the noise model knows it, else estimated as
        (sum of squares / dof)^(1/2).
    scale_known : bool
        Which of the two.
    dof : int
        Residuals, those of priors included, less the parameters determined.
    cost : float
        Half the sum of squares of `residuals`; with a robust loss, half the sum of the losses,
        times scale^2 where the scale is unknown.
    nfev : int
        Evaluations of the residuals, each of all searches at once.
    status : Status
        How the search ended.
    message : str
        The same for the user, with the parameters' names.
    method : str
        The solver.
    loss : str
        "linear", or the robust loss.
    combinations : tuple of Combination
        What is determined where the optimum lies at infinity.
    """

    problem: Problem
    theta: FloatArray
    values: FloatArray
    covariance: FloatArray
    scale: float
    scale_known: bool
    dof: int
    cost: float
    nfev: int
    status: Status
    message: str
    method: str
    loss: str = "linear"
    combinations: tuple[Combination, ...] = field(default=())

    @property
    def success(self) -> bool:
        """Whether there is a finite optimum and it was found."""
        return self.status.found_optimum

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the free parameters."""
        return self.problem.names

    @property
    def residuals(self) -> FloatArray:
        """Whitened residuals, shape (m,), up to the scale where unknown; those of priors last."""
        return self._rows[0]

    @property
    def jacobian(self) -> FloatArray:
        """The derivatives of `residuals` by theta, shape (m, P)."""
        return self._rows[1]

    @cached_property
    def _rows(self) -> tuple[FloatArray, FloatArray]:
        scale = 1.0 if np.isnan(self.scale) else self.scale
        r, J = self.problem.residuals_and_jacobian(self.theta, scale, tails=self.loss == "linear")
        return r * scale, J * scale

    @property
    def values_covariance(self) -> FloatArray:
        """Covariance of the values, propagated to first order, shape (P, P)."""
        return propagated(self.covariance, self.problem.value_slopes(self.theta))

    @property
    def stderr(self) -> Mapping[str, float]:
        """Standard error of each value, by name."""
        errors = np.sqrt(np.diagonal(self.values_covariance))
        return MappingProxyType(dict(zip(self.names, errors.tolist(), strict=True)))

    def raise_unless_found(self) -> Optimum:
        """Return this optimum, or raise FitError with its message."""
        if not self.success:
            raise FitError(self.message)
        return self


@dataclass(frozen=True)
class OptimumBatch:
    """The minima of S problems of one shape; arrays as in :class:`Optimum`, led by S."""

    problem: ProblemBatch
    theta: FloatArray
    values: FloatArray
    covariance: FloatArray
    scale: FloatArray
    scale_known: bool
    dof: int
    cost: FloatArray
    nfev: FloatArray
    status: tuple[Status, ...]

    @property
    def success(self) -> FloatArray:
        """Whether each problem has a finite optimum that was found."""
        return np.array([status.found_optimum for status in self.status])

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the free parameters."""
        return self.problem.names


def inverse(information: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the covariance and which parameters are undetermined.

    Parameters with a part in a null direction of the information have infinite variance and no
    covariance; the others keep what is determined.
    """
    size = np.sqrt(np.diagonal(information))
    size = np.where((size > 0.0) & np.isfinite(size), size, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    null = values <= _NULL * max(1.0, values[-1])
    undetermined = (np.abs(vectors[:, null]) > _PART).any(axis=1)
    vectors = vectors[:, ~null] / size[:, None]
    covariance = (vectors / values[~null]) @ vectors.T
    covariance[undetermined, :] = covariance[:, undetermined] = 0.0
    covariance[undetermined, undetermined] = np.inf
    return covariance, undetermined


def propagated(covariance: FloatArray, slopes: FloatArray) -> FloatArray:
    """Return D covariance D with D = diag(slopes); what is undetermined stays infinite."""
    with np.errstate(invalid="ignore"):
        product = slopes[..., :, None] * covariance * slopes[..., None, :]
    return np.where(np.isnan(product), np.inf, product)

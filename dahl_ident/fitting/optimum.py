"""The result of a solver as plain numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from dahl_ident.arrays import BoolArray, FloatArray, IntArray
from dahl_ident.fitting.losses import Loss, loss_named
from dahl_ident.problem import Problem

_RESCALINGS = 100  # most searches until the noise's scale agrees; five are usual
_SAME_SCALE = 1e-9  # change of ln scale at which it agrees
_LONGEST_SECANT = 20.0  # longest step of the secant, in plain steps
_AT_BOUND = 1e-8  # relative distance from a bound within which an estimate lies at it
UNDETERMINED = 1e-13  # eigenvalue of the information, of unit diagonal, up to which it is rounding
NOTICEABLE_PART = 1e-4  # component in such a direction above which a parameter is undetermined
# root of the information on a parameter, or length of a column, that counts as zero; the fourth
# power of its inverse, as in degrees of freedom, is still a number
NO_EFFECT = 1e-50
_BARELY = 1.001  # scale over that of rounding, below which residuals are rounding errors


class Status(Enum):
    """The outcome of a search; the value is what a report says about it."""

    outcome: str
    """The outcome without its meaning."""
    _value_: str

    def __new__(cls, outcome: str, meaning: str) -> Self:
        """Return a status; its value states both."""
        status = object.__new__(cls)
        status._value_, status.outcome = f"{outcome}: {meaning}", outcome
        return status

    CONVERGED = (
        "Converged",
        "the sum of squares has a minimum here, inside all bounds.",
    )
    AT_BOUND = (
        "Converged with a parameter at its bound",
        "the sum of squares falls beyond it, so the interval is one-sided. Widen the bound, "
        "or fix the parameter.",
    )
    SINGULAR = (
        "Converged, but the data leave a combination of the parameters undetermined",
        "it can change without any change of the prediction. Fix one of the parameters "
        "involved, or give it a prior.",
    )
    MICROSLIP = (
        "No finite optimum",
        "the fit improves as f_max grows without bound at constant sigma^2/f_max, while the "
        "spring takes sigma's place. No amplitude reaches slip: drive harder, or measure "
        "the spring and fix it.",
    )
    NO_LOSS = (
        "No finite optimum",
        "the fit improves as f_max grows without bound at constant sigma. The data show the "
        "stiffness of friction but no loss: drive harder, or reduce the noise.",
    )
    GROSS_SLIP = (
        "No finite optimum",
        "the fit improves as sigma grows without bound at constant f_max. The data show "
        "slip only: use smaller amplitudes, or reduce the noise.",
    )
    SHARP_KNEE = (
        "No finite optimum",
        "the fit improves as alpha tends to zero. Friction turns from stiffness to slip "
        "more sharply than the data resolve: measure more amplitudes near the knee, or fix "
        "alpha.",
    )
    NO_FULL_SLIP = (
        "No finite optimum",
        "the fit improves as alpha and f_max grow without bound at constant f_max/alpha. "
        "The data show no limit of the friction force: drive harder, or fix alpha.",
    )
    NO_FRICTION = (
        "No finite optimum",
        "the fit improves as friction vanishes. The other elements explain the data: use "
        "smaller amplitudes, or leave the element out.",
    )
    RUNS_AWAY = (
        "No finite optimum",
        "the fit improves as a parameter goes to a limit. The amplitudes do not reach what "
        "it describes: measure where its effect is larger, or fix it.",
    )
    NOT_CONVERGED = (
        "Not converged",
        "the search stopped before it found a minimum. The numbers are not an optimum: give "
        "a start, or fix a parameter.",
    )

    @property
    def found_optimum(self) -> bool:
        """Whether the estimate is a finite optimum."""
        return self in (Status.CONVERGED, Status.AT_BOUND)

    @property
    def at_infinity(self) -> bool:
        """Whether the optimum lies at infinite or vanishing parameters."""
        return not self.found_optimum and self not in (Status.SINGULAR, Status.NOT_CONVERGED)


@dataclass(frozen=True)
class DeterminedCombination:
    """A combination of parameters that the data determine although the parameters run away."""

    expression: str
    value: float
    stderr: float


@dataclass(frozen=True)
class ConstraintCost:
    """The rise of the sum of squares due to the active constraints.

    `rise` is divided by the variance of the noise, which has `dof` degrees of freedom, infinite if
    it is known; NaN if the noise is not known.
    """

    texts: tuple[str, ...]
    rise: float
    dof: float

    @property
    def p_value(self) -> float:
        """Probability of at least such a rise if the constraints are right."""
        count = len(self.texts)
        if np.isinf(self.dof):
            return float(special.chdtrc(count, self.rise))
        return float(special.fdtrc(count, self.dof, self.rise / count))


@dataclass(frozen=True)
class Optimum:
    """The minimum of a problem's sum of squares; arrays are in the order of its `names`."""

    source: Problem
    """The problem, or the batch of which it is that of table `index`."""
    theta: FloatArray
    """Search coordinates, (P,). For an optimum at infinity, a finite point so far out that the
    prediction is that of the limit."""
    values: FloatArray
    """Parameter values, (P,); infinite or zero where the optimum lies there."""
    covariance: FloatArray
    """Covariance of theta: scale^2 over the Fisher information; infinite where undetermined."""
    scale: float
    """Standard deviation of the residuals: 1 if the noise model states it, otherwise estimated as
    (sum of squares / dof)^(1/2), but not less than that of rounding errors."""
    scale_known: bool
    dof: int
    """Number of residuals, including those of priors, minus that of determined parameters."""
    cost: float
    """Half the sum of squares of `residuals`; with a robust loss, half the sum of the losses,
    times scale^2 where the scale is unknown."""
    nfev: int
    """Evaluations of the residuals, each of all searches at once."""
    status: Status
    message: str
    """The status for the user, with the parameters' names."""
    method: str
    loss: str = "linear"
    combinations: tuple[DeterminedCombination, ...] = field(default=())
    """The determined combinations where the optimum lies at infinity."""
    constraint_cost: ConstraintCost | None = None
    """None where there are no constraints, or the loss is robust."""
    index: int = 0

    @cached_property
    def problem(self) -> Any:
        """The problem of which this is the optimum."""
        return self.source.table(self.index)

    @property
    def success(self) -> bool:
        """Whether there is a finite optimum and it was found."""
        return self.status.found_optimum

    @property
    def converged(self) -> bool:
        """Whether the search ended at an optimum, finite or not."""
        return self.status is not Status.NOT_CONVERGED

    @property
    def is_exact(self) -> bool:
        """Whether the model fits the data to rounding, so that residuals carry no information."""
        return _is_rounding(self.problem, self.scale)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the free parameters."""
        return self.source.names

    @property
    def residuals(self) -> FloatArray:
        """Whitened residuals, shape (m,), up to the scale where unknown; those of priors last."""
        return self._rows[0]

    @property
    def jacobian(self) -> FloatArray:
        """The derivatives of `residuals` with respect to theta, shape (m, P)."""
        return self._rows[1]

    @cached_property
    def _rows(self) -> tuple[FloatArray, FloatArray]:
        scale = 1.0 if np.isnan(self.scale) else self.scale
        r, J = self.problem.residuals_and_jacobian(self.theta, scale, tails=self.loss == "linear")
        return r * scale, J * scale

    def theta_in(self, problem: Problem) -> FloatArray:
        """Return theta of a problem with more free parameters, which are at their `value`."""
        known = dict(zip(self.names, self.theta, strict=True))
        return np.array(
            [
                known[p.name] if p.name in known else np.log(p.value or 1.0)
                for p in problem.parameters
            ]
        )

    @cached_property
    def log_likelihood(self) -> float:
        """Log-density of the data at theta, for the most likely scale if that is unknown.

        With a robust loss, the density is the one proportional to exp(-rho/2).
        """
        problem = self.problem
        loss = loss_named(self.loss, problem.residuals_per_row)
        if loss is None:
            return float(problem.log_likelihood(self.theta))
        z, scale = problem.squares(self.theta, tails=False), None
        if not self.scale_known:
            least = float(problem.rounding) / self.scale
            scale = self.scale * float(np.sqrt(loss.likeliest(z / self.scale**2, least**2)))
            z = z / scale**2
        squares = problem.squares(self.theta) / (1.0 if scale is None else scale) ** 2
        gaussian = float(problem.log_likelihood(self.theta, scale))
        return gaussian + 0.5 * float((squares - loss.rho(z) - 2.0 * loss.log_area).sum())

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 ln L + 2 k; k counts determined parameters and unknown scale."""
        return -2.0 * self.log_likelihood + 2.0 * self._counted

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 ln L + k ln n, for n residuals and k as in `aic`."""
        return -2.0 * self.log_likelihood + float(np.log(self.problem.n_nonzero)) * self._counted

    @property
    def _counted(self) -> int:
        determined: int = self.problem.n_nonzero + self.problem.n_priors - self.dof
        return determined + (not self.scale_known)

    @property
    def values_covariance(self) -> FloatArray:
        """Covariance of the values, propagated to first order, shape (P, P)."""
        return propagated(self.covariance, self.problem.value_slopes(self.theta))

    @property
    def stderr(self) -> Mapping[str, float]:
        """Standard error of each value, by name."""
        errors = np.sqrt(np.diagonal(self.values_covariance))
        return MappingProxyType(dict(zip(self.names, errors.tolist(), strict=True)))


class OptimumBatch(tuple[Optimum, ...]):
    """The optima of problems of one shape; each of their numbers is an array, of all of them."""

    __slots__ = ()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return np.array([getattr(optimum, name) for optimum in self])


def at_bound(problem: Problem, theta: FloatArray) -> BoolArray:
    """Return which parameters lie at a bound."""
    low, high = problem.bounds()
    with np.errstate(invalid="ignore"):
        near = _AT_BOUND * np.maximum(1.0, np.abs(theta))
        return np.asarray((theta - low <= near) | (high - theta <= near))


def values_at_bounds(problem: Problem, theta: FloatArray, values: FloatArray) -> str:
    """Return a sentence that states the values that lie at a bound; empty if there are none."""
    hits = zip(problem.names, values.tolist(), at_bound(problem, theta), strict=True)
    stated = ", ".join(f"{name} = {value:g}" for name, value, is_hit in hits if is_hit)
    return f"At its bound: {stated}." if stated else ""


def estimated_scale(problem: Problem, cost: ArrayLike, dof: int | IntArray) -> FloatArray:
    """Return the standard deviation of residuals whose half sum of squares is `cost`.

    It is not less than that of rounding errors, and NaN without degrees of freedom.
    """
    variance = 2.0 * np.asarray(cost) / np.where(np.asarray(dof) > 0, dof, np.nan)
    return np.maximum(np.sqrt(variance), problem.rounding)


def _scale_ratio(
    problem: Problem, theta: FloatArray, scale: float, loss: Loss | None, dof: float
) -> float:
    """Return the scale of the residuals at `theta` over the assumed `scale`.

    The former is not less than that of rounding errors; the ratio is 1 without degrees of freedom.
    """
    if dof <= 0:
        return 1.0
    z = problem.squares(theta, tails=loss is None) / scale**2
    variance = float(z.sum()) / dof if loss is None else loss.rescaled(z, dof)
    return max(float(np.sqrt(variance)), float(problem.rounding) / scale)


def agreed_scale(
    problem: Problem,
    loss: Loss | None,
    search: Callable[[float], tuple[FloatArray, float]],
    scale: float,
) -> float:
    """Return the scale of the noise that agrees with the residuals of a search with that scale.

    `search` takes a scale; it returns the theta at which it ends, and the degrees of freedom.
    """
    step, last = 0.0, 0.0
    for _ in range(_RESCALINGS):
        theta, dof = search(scale)
        change = float(np.log(_scale_ratio(problem, theta, scale, loss, dof)))
        if abs(change) < _SAME_SCALE or not np.isfinite(change):
            break
        # the secant's step if it has the same direction, otherwise the plain one
        factor = step / (last - change) if last != change else 1.0
        step = change * (factor if 0.0 < factor < _LONGEST_SECANT else 1.0)
        last, scale = change, scale * float(np.exp(step))
    return scale


def _is_rounding(problem: Problem, scale: float) -> bool:
    return not problem.scale_known and bool(scale < _BARELY * problem.rounding)


def information_of(
    problem: Problem,
    theta: FloatArray,
    scale: float,
    loss: Loss | None,
    dof: int,
    chart: FloatArray | None = None,
) -> FloatArray:
    """Return the inverse of an estimate's covariance; `chart` is dtheta/dphi, (P, Q)."""
    if loss is None:
        return problem.information(theta, scale, chart)
    r, J = problem.residuals_and_jacobian(theta, scale, tails=False)
    if chart is not None:
        J = J @ chart
    m = problem.n_residuals
    kappa = 1.0
    if not _is_rounding(problem, scale):
        kappa = loss.inflation((r[:m] ** 2).reshape(-1, problem.residuals_per_row).sum(axis=1), dof)
    return np.asarray(J[:m].T @ J[:m] / kappa + J[m:].T @ J[m:])


def inverse(information: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the covariance, (..., P, P), and which parameters are undetermined, (..., P).

    Parameters with a component in a null direction of the information have infinite variance and
    zero covariances; those of the other parameters are finite.
    """
    finite = np.isfinite(information)
    if not finite.all():
        information = np.where(finite.all(axis=(-2, -1), keepdims=True), information, 0.0)
    size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    size = np.where(size > NO_EFFECT, size, 1.0)
    sizes = size[..., :, None] * size[..., None, :]
    values, vectors = np.linalg.eigh(information / sizes)
    null = values <= UNDETERMINED * np.maximum(1.0, values[..., -1:])
    inverted = np.where(null, 0.0, 1.0 / np.where(null, 1.0, values))
    covariance = (vectors * inverted[..., None, :]) @ vectors.swapaxes(-1, -2) / sizes
    if not null.any():
        return covariance, null
    undetermined = np.any(np.abs(vectors) * null[..., None, :] > NOTICEABLE_PART, axis=-1)
    return blanked(covariance, undetermined), undetermined


def blanked(covariance: FloatArray, undetermined: BoolArray) -> FloatArray:
    """Return `covariance` with infinite variances and zero covariances of the undetermined."""
    either = undetermined[..., :, None] | undetermined[..., None, :]
    diagonal = either & np.eye(covariance.shape[-1], dtype=np.bool_)
    return np.where(diagonal, np.inf, np.where(either, 0.0, covariance))


def propagated(covariance: FloatArray, slopes: FloatArray) -> FloatArray:
    """Return D covariance D with D = diag(slopes); undetermined variances stay infinite."""
    with np.errstate(invalid="ignore", over="ignore"):
        product = slopes[..., :, None] * covariance * slopes[..., None, :]
    return np.where(np.isnan(product), np.inf, product)

r"""The posterior density of one problem, for many points at once.

A point x holds the search coordinates theta and, where the noise's scale s is unknown, ln s. With
S(theta) the sum of squared residuals of n rows, two residuals each,

    ln p(x) = ln p(theta) - n ln(2 pi s^2) - S(theta)/(2 s^2) + constants,

with the prior 1/s of the scale, flat in ln s. Integrated over s, it is

    ln p(theta) + ln Gamma(n) - n ln(pi S(theta)) - ln 2 + constants.

If rows share errors, :mod:`dahl_ident.bayes.row_errors` replaces it. For data with outliers, rows
may have Student's t distribution in two dimensions with nu = 4 instead, with the density
(1 + |y|^2/(nu s^2))^-(nu/2 + 1) / (2 pi s^2).

**Records.** The output is nearly linear in states, offsets and drifts: the residuals e are
projected onto the complement of their derivatives, so that only the model's parameters theta are
coordinates. With S the remaining sum of squares, nu the effective degrees of freedom of the
residuals and P parameters, the density integrated over the scale of the noise is

    ln p(theta) + constants - (nu + P)/2 ln(1 + (S(theta*) - S(t))/(nu s^2)),    s^2 = S(t)/n.

Residuals of neighbouring samples are correlated, so S has too much information, more on some
parameters than on others. It is therefore evaluated at theta* = t + C (theta - t), with t the
least-squares estimate and C such that the curvature at t is the inverse of the estimate's
covariance, which accounts for the correlation (curvature adjustment of a composite likelihood:
Ribatet, Cooley and Davison, Statistica Sinica 22 (2012) 813-845).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import gammaln, logsumexp

from dahl_ident.arrays import FloatArray, cholesky_root
from dahl_ident.bayes.moves import STRAIGHT, Decorrelation, decorrelation_of
from dahl_ident.bayes.priors import JointPrior
from dahl_ident.bayes.row_errors import RowErrors
from dahl_ident.data.columns import one_of
from dahl_ident.errors import FitError, SamplingError, ValidationError, argument
from dahl_ident.fitting import solve
from dahl_ident.fitting.losses import TAIL_DOF
from dahl_ident.problem import TableProblem
from dahl_ident.problem.record_problem import RecordProblem

LIKELIHOODS = ("gaussian", "student_t", "none")
SCALE = "noise_scale"
_LARGEST_LOG_MISFIT = 300.0  # largest ln s, against overflow of s^2
Sums = Callable[[FloatArray], FloatArray]
_COLUMNS = (  # of a table, on which its likelihood depends
    "quantity",
    "frequency_hz",
    "amplitude",
    "drive",
    "response",
    "covariance",
    "dof",
    "amplitude_std",
    "amplitude_covariance",
    "drive_std",
    "drive_covariance",
    "harmonic",
    "controlled",
)


def added(residuals: FloatArray) -> FloatArray:
    """Return sums of squares, (S, K) -> (S,); infinite for NaN residuals."""
    with np.errstate(invalid="ignore", over="ignore"):
        sums = np.sum(residuals**2, axis=1)
    return np.where(np.isnan(sums), np.inf, sums)


class LogDensity(ABC):
    """A log-posterior over search coordinates; call it with points of shape (S, D)."""

    problem: Any
    prior: JointPrior
    likelihood: str = "gaussian"
    counted: tuple[str, ...]  # the sources of error in the likelihood
    normalised: bool = True  # whether the likelihood is known, and not only up to a factor

    def log_prior(self, theta: FloatArray) -> FloatArray:
        """Return the log-prior of theta, (S, P); -inf outside its support."""
        return self.prior.log_density(theta)

    @abstractmethod
    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return the residuals whose squares are added, (S, P) -> (S, K)."""

    def sums(self, theta: FloatArray) -> FloatArray:
        """Return sums of squares of residuals at theta, (S, P): (S,)."""
        return added(self.residuals(theta))

    @abstractmethod
    def marginal(self, theta: FloatArray, sums: Sums | None = None) -> FloatArray:
        """Return the log-density of theta, (S, P), an unknown scale integrated out.

        `sums` replaces :meth:`sums`.
        """

    @abstractmethod
    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the log-density, (S, D) -> (S,); -inf outside the prior's support."""

    @property
    def has_scale(self) -> bool:
        """Whether ln s is the last coordinate."""
        return False

    @property
    def decorrelation(self) -> Decorrelation:
        """Coordinates in which ridges of the density are straight."""
        return STRAIGHT

    @property
    def around(self) -> tuple[FloatArray, FloatArray] | None:
        """Centre and covariance of the density; None if they are not known."""
        return None

    @property
    @abstractmethod
    def facts(self) -> dict[str, str | Sequence[object]]:
        """Inputs of the density in addition to model and priors: texts, or arrays."""

    def in_order(self, points: FloatArray) -> FloatArray:
        """Return points with interchangeable elements in order."""
        return points

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates' values, D of them."""
        return (*self.prior.names, *[SCALE] * self.has_scale)

    @property
    def logarithmic(self) -> tuple[bool, ...]:
        """Which coordinates are logarithms."""
        return (*(part.logarithmic for part in self.prior.priors), *[True] * self.has_scale)

    @property
    def priors(self) -> dict[str, str]:
        """Every prior in words."""
        texts = {part.parameter.name: str(part) for part in self.prior.priors}
        return texts | ({SCALE: "1/s"} if self.has_scale else {})

    def to_values(self, x: FloatArray) -> FloatArray:
        """Return values at points of shape (..., D), or (..., P) without the scale."""
        logarithmic = self.logarithmic[: x.shape[-1]]
        return np.where(logarithmic, np.exp(np.where(logarithmic, x, 0.0)), x)


@dataclass(frozen=True)
class Density(LogDensity):
    """Log-posterior of the parameters of a table.

    Without `errors`, rows are independent; with them, the likelihood is Gaussian, and an unknown
    scale of the noise is that of the estimate.
    """

    problem: TableProblem
    prior: JointPrior
    likelihood: str = "gaussian"
    errors: RowErrors | None = None

    def __post_init__(self) -> None:
        problem = self.problem
        one_of(self.likelihood, "likelihood", LIKELIHOODS)
        if self.likelihood == "student_t" and not problem.gaussian:
            raise ValidationError(
                f"{argument('likelihood', 'student_t')} is for Gaussian noise with outliers, but "
                "the covariance of these data has few degrees of freedom, which gives Student's t "
                "by itself; leave likelihood out"
            )
        if self.has_scale and problem.n_residuals <= len(problem.names):
            raise SamplingError(
                f"{problem.n_residuals} residuals cannot determine {len(problem.names)} parameters "
                "and the scale of the noise; give the data a covariance, or fix parameters"
            )

    @property
    def counted(self) -> tuple[str, ...]:  # type: ignore[override]  # a fixed attribute of others
        """The sources of error in the likelihood."""
        return ("noise",) if self.errors is None else tuple(self.errors.counted)

    @property
    def facts(self) -> dict[str, str | Sequence[object]]:
        """Data, noise, sensors and shared errors."""
        problem, errors = self.problem, self.errors
        fixed = [(p.name, p.value) for p in problem.sensors.parameters if not p.free]
        parts: Any = "none"
        if errors:
            parts = [errors.centre, errors.moves, errors.shared, errors.factors, errors.sizes]
        return {
            "data": [getattr(problem.data, name) for name in _COLUMNS],
            "noise": problem.noise,
            "sensors": repr(fixed),
            "errors other than noise": parts,
        }

    def in_order(self, points: FloatArray) -> FloatArray:
        """Return points with interchangeable elements in order."""
        P = len(self.problem.names)
        return np.concatenate([self.problem.in_order(points[:, :P]), points[:, P:]], axis=1)

    @property
    def has_scale(self) -> bool:
        """Whether ln s is the last coordinate."""
        known = self.problem.scale_known or self.errors is not None
        return not known and self.likelihood != "none"

    @property
    def decorrelation(self) -> Decorrelation:
        """Coordinates in which ridges between linear elements and friction are straight."""
        return decorrelation_of(self.quick) or STRAIGHT

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta, (S, P), and s, (S,), which is 1 where it is known."""
        P, known = len(self.problem.names), self.errors.scale if self.errors else 1.0
        return x[:, :P], np.exp(x[:, P]) if self.has_scale else np.full(len(x), known)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the log-density, (S, D) -> (S,); -inf outside the prior's support."""
        P = len(self.problem.names)
        result = self.log_prior(x[:, :P])
        if self.has_scale:  # where the scale would overflow, the likelihood is zero
            result[np.abs(x[:, P]) > _LARGEST_LOG_MISFIT] = -np.inf
        inside = result > -np.inf
        if self.likelihood != "none" and inside.any():
            result[inside] += self.log_likelihood(*self.split(x[inside]))
        return result

    def marginal(self, theta: FloatArray, sums: Sums | None = None) -> FloatArray:
        """Return the log-density of theta, (S, P), an unknown scale integrated out."""
        if self.likelihood != "student_t":
            return self.highest(theta, sums)
        if self.has_scale:
            raise ValidationError(
                f"{argument('likelihood', 'student_t')} with an unknown noise scale has no closed "
                "integral over the scale; give the data a covariance, or use sampling"
            )
        return self(theta)

    def highest(self, theta: FloatArray, sums: Sums | None = None) -> FloatArray:
        """Return the Gaussian log-posterior of theta, (S, P), an unknown scale integrated out."""
        result = self.log_prior(theta)
        inside = result > -np.inf
        if self.likelihood != "none" and inside.any():
            squares = (sums or self.sums)(theta[inside])
            result[inside] += self._constant
            if self.errors is not None:
                result[inside] += self._combined(theta[inside], squares)
            elif self.has_scale:
                n = 0.5 * self.problem.n_residuals
                with np.errstate(divide="ignore"):
                    result[inside] -= n * np.log(squares)
                result[inside] += float(gammaln(n) + (n - 1.0) * np.log(2.0))
            else:
                result[inside] -= 0.5 * squares
        return result

    def log_prior(self, theta: FloatArray) -> FloatArray:
        """Return the log-prior; interchangeable elements have support in order of their knees."""
        result = self.prior.log_density(theta)
        ordered = self.problem.in_order(theta)
        if ordered is not theta:
            result = np.where((ordered == theta).all(axis=-1), result, -np.inf)
        return result

    def log_likelihood(self, theta: FloatArray, scale: FloatArray) -> FloatArray:
        """Return ln of the data's density at theta, (S, P), and s, (S,)."""
        m = self.problem.n_residuals
        if self.errors is not None:
            return self._combined(theta, self.sums(theta)) + self._constant
        if self.likelihood != "student_t":
            return self.quick.log_likelihood(theta, scale if self.has_scale else None)
        z = self.quick.squares(theta) / (TAIL_DOF * scale[:, None] ** 2)
        tails = np.log1p(z).sum(axis=-1)
        result = self._constant - m * np.log(scale) - (0.5 * TAIL_DOF + 1.0) * tails
        return np.where(np.isnan(result), -np.inf, result)

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return the residuals whose squares are added, (S, P) -> (S, K)."""
        if self.errors is None:
            return self.quick.whitened(theta)
        with np.errstate(invalid="ignore", over="ignore"):
            return self.errors.weighted(
                self.quick.whitened(self.errors.adjusted(theta), tails=False)
            )

    def _combined(self, theta: FloatArray, sums: FloatArray) -> FloatArray:
        """Return ln of the mean likelihood over the sizes of errors, from sums of squares."""
        assert self.errors is not None
        terms = -0.5 * self.errors.squares(theta, sums) + self.errors.log_weights
        return np.asarray(logsumexp(terms, axis=1))

    @cached_property
    def quick(self) -> TableProblem:
        """The problem for very many evaluations.

        Exact steady motions are expanded to second order about the least-squares optimum.
        """
        problem = self.problem
        if not problem.is_exact:
            return problem
        without_priors = problem.like(sensors=problem.sensors.with_free(list(problem.priors)))
        return problem.near(solve(without_priors).theta)

    @property
    def _constant(self) -> float:
        """The Gaussian log-likelihood at s = 1 without its exponent."""
        return float(self.problem.log_area - 0.5 * self.problem.n_residuals * np.log(2.0 * np.pi))


@dataclass(frozen=True)
class RecordDensity(LogDensity):
    """Log-posterior of the model's free parameters, given records."""

    problem: RecordProblem
    values: FloatArray  # the least-squares estimate: P parameters, then states and offsets
    covariance: FloatArray  # (P, P) of the parameters, from the sources `counted`
    dof: float  # effective degrees of freedom of the residuals
    counted: tuple[str, ...]
    prior: JointPrior
    normalised = False

    @cached_property
    def centre(self) -> FloatArray:
        """Coordinates of the estimate."""
        return np.where(self.logarithmic, np.log(self._slopes), self.values[: len(self.names)])

    @property
    def _slopes(self) -> FloatArray:
        """Derivatives of the values with respect to the coordinates."""
        return np.where(self.logarithmic, self.values[: len(self.names)], 1.0)

    @cached_property
    def root(self) -> FloatArray:
        """A root of the covariance of the coordinates, (P, P)."""
        covariance = self.covariance / np.outer(self._slopes, self._slopes)
        try:
            return cholesky_root(covariance)
        except np.linalg.LinAlgError as exc:
            raise SamplingError(
                "the records do not determine every parameter, so that their likelihood has no "
                "curvature to begin with; fix what the fit's verdict names"
            ) from exc

    @property
    def around(self) -> tuple[FloatArray, FloatArray]:
        """The estimate's coordinates and their covariance."""
        return self.centre, self.root @ self.root.T

    @property
    def facts(self) -> dict[str, str | Sequence[object]]:
        """Samples and estimate."""
        samples = [(r.time, r.motion_samples, r.force_samples) for r in self.problem.records]
        return {"data": [wave for waves in samples for wave in waves], "estimate": [self.values]}

    @cached_property
    def _nuisance(self) -> list[tuple[FloatArray, FloatArray]]:
        """Derivatives of each record: by states and offsets, orthonormal, and by theta."""
        count = len(self.names)
        per_record = self.problem.per_record
        parts = []
        for number in range(len(self.problem.records)):
            by = self.problem.filtered(self.problem.predict(self.values, number).by)
            columns = by[:, count + number * per_record :][:, :per_record]
            basis = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
            parts.append((basis, by[:, :count] * self._slopes))
        return parts

    @cached_property
    def _least(self) -> float:
        return float(np.sum(self._residuals(self.centre) ** 2))

    @cached_property
    def _adjustment(self) -> FloatArray:
        """The matrix C, symmetric in coordinates in which the covariance is the unit matrix."""
        hessian = np.zeros((len(self.names),) * 2)
        for basis, by in self._nuisance:
            unexplained = by - basis @ (basis.T @ by)
            hessian += unexplained.T @ unexplained
        noise = self._least / self.problem.n_residuals
        values, vectors = np.linalg.eigh(self.root.T @ hessian @ self.root / noise)
        inverse_root = vectors @ np.diag(1.0 / np.sqrt(values)) @ vectors.T
        return np.asarray(self.root @ inverse_root @ np.linalg.inv(self.root))

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the log-density, (S, D) -> (S,); -inf outside the prior's support."""
        return self.marginal(x)

    def marginal(self, theta: FloatArray, sums: Sums | None = None) -> FloatArray:
        """Return the log-density of theta, (S, P); the noise's scale is not a coordinate."""
        result = self.log_prior(theta)
        noise = self._least / self.problem.n_residuals
        inside = result > -np.inf
        if inside.any():
            squares = (sums or self.sums)(theta[inside])
            excess = (squares - self._least) / (self.dof * noise)
            power = 0.5 * (self.dof + len(self.names))
            result[inside] -= power * np.log1p(np.maximum(excess, -0.5))
        return result

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return the residuals at theta*, (S, P) -> (S, n), states and offsets projected out."""
        adjusted = self.centre + (theta - self.centre) @ self._adjustment.T
        return np.array([self._residuals(t) for t in adjusted])

    def _residuals(self, theta: FloatArray) -> FloatArray:
        full = self.values.copy()
        full[: theta.size] = self.to_values(theta)
        parts = []
        try:
            for number, y in enumerate(self.problem.measured):
                predicted = self.problem.predict(full, number, derivatives=False)
                e = self.problem.filtered(y - predicted.output)
                basis = self._nuisance[number][0]
                parts.append(e - basis @ (basis.T @ e))
        except FitError:  # the motion grows beyond all bounds
            return np.full(self.problem.n_residuals, np.inf)
        return np.concatenate(parts)

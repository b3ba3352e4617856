r"""The posterior density of a model's parameters, given records of any motion.

States, offsets and drifts of the records are linear in the output, nearly: the residuals e are
projected off their derivatives, so that only the model's parameters theta are coordinates. With S
the sum of squares that is left, nu the effective degrees of freedom of the residuals and P
parameters, the unknown scale of the noise integrated out,

    ln p(theta) + constants - (nu + P)/2 ln(1 + (S(theta*) - S(t))/(nu s^2)),    s^2 = S(t)/n.

Residuals of neighbouring samples are correlated, so S counts too many samples, of some parameters
more than of others. It is therefore taken at theta* = t + C (theta - t), t the least-squares
estimate and C such that the curvature at t is the inverse of the estimate's covariance, in which
the correlation is accounted for (curvature adjustment of a composite likelihood: Ribatet, Cooley
and Davison, Statistica Sinica 22 (2012) 813-845).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.density import LogDensity, Sums
from dahl_ident.bayes.priors import JointPrior
from dahl_ident.errors import FitError, SamplingError
from dahl_ident.problem.record_problem import RecordProblem


@dataclass(frozen=True)
class RecordDensity(LogDensity):
    """Log-posterior of the model's free parameters; call it with points of shape (S, P).

    Attributes
    ----------
    problem : RecordProblem
    values : ndarray
        The least-squares estimate: the model's parameters, then states and offsets.
    covariance : ndarray, shape (P, P)
        Of the model's parameters, every source of error included.
    dof : float
        Effective degrees of freedom of the residuals.
    counted : tuple of str
        The sources of error in the covariance.
    prior : JointPrior
    """

    problem: RecordProblem
    values: FloatArray
    covariance: FloatArray
    dof: float
    counted: tuple[str, ...]
    prior: JointPrior
    likelihood = "gaussian"
    normalised = False

    @property
    def centre(self) -> FloatArray:
        """Coordinates of the estimate."""
        values = self.values[: len(self.names)]
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)), values)

    @cached_property
    def root(self) -> FloatArray:
        """A root of the covariance of the coordinates, (P, P)."""
        chain = np.where(self.logarithmic, 1.0 / self.values[: len(self.names)], 1.0)
        covariance = self.covariance * np.outer(chain, chain)
        size = np.sqrt(covariance.diagonal())
        try:
            return np.asarray(size[:, None] * np.linalg.cholesky(covariance / np.outer(size, size)))
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
        return {"data": [part for one in samples for part in one], "estimate": [self.values]}

    @cached_property
    def _nuisance(self) -> list[tuple[FloatArray, FloatArray]]:
        """Orthonormal derivatives by states and offsets, and those by theta, of each record."""
        count = len(self.names)
        chain = np.where(self.logarithmic, self.values[:count], 1.0)
        parts = []
        for number in range(len(self.problem.records)):
            by = self.problem.filtered(self.problem.predict(self.values, number).by)
            first = count + number * self.problem.per_record
            columns = by[:, first : first + self.problem.per_record]
            basis = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
            parts.append((basis, by[:, :count] * chain))
        return parts

    @cached_property
    def _least(self) -> float:
        return float(np.sum(self._residuals(self.centre) ** 2))

    @cached_property
    def _bend(self) -> FloatArray:
        """C, symmetric in coordinates in which the covariance is the unit matrix."""
        hessian = np.zeros((len(self.names),) * 2)
        for basis, by in self._nuisance:
            rest = by - basis @ (basis.T @ by)
            hessian += rest.T @ rest
        noise = self._least / self.problem.n_residuals
        inner = self.root.T @ hessian @ self.root / noise
        values, vectors = np.linalg.eigh(inner)
        shrunk = vectors @ np.diag(1.0 / np.sqrt(values)) @ vectors.T
        return np.asarray(self.root @ shrunk @ np.linalg.inv(self.root))

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the log-density, (S, D) -> (S,); -inf outside the prior's support."""
        return self.marginal(x)

    def marginal(self, theta: FloatArray, sums: Sums | None = None) -> FloatArray:
        """Return the log-density of theta, (S, P); the noise's scale is no coordinate."""
        result = self.log_prior(theta)
        noise = self._least / self.problem.n_residuals
        inside = result > -np.inf
        if inside.any():
            squares = (sums or self.sums)(theta[inside])[:, 0]
            excess = (squares - self._least) / (self.dof * noise)
            power = 0.5 * (self.dof + len(self.names))
            result[inside] -= power * np.log1p(np.maximum(excess, -0.5))
        return result

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return the residuals at theta*, (S, P) -> (S, n), states and offsets projected out."""
        bent = self.centre + (theta - self.centre) @ self._bend.T
        return np.array([self._residuals(one) for one in bent])

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

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
from dahl_ident.bayes.density import LogDensity
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
        return self._squares(self.centre)

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
        """Return the log-density, (S, P) -> (S,); -inf outside the prior's support."""
        result = self.prior.log_density(x)
        noise = self._least / self.problem.n_residuals
        power = 0.5 * (self.dof + len(self.names))
        for i in np.flatnonzero(result > -np.inf):
            bent = self.centre + self._bend @ (x[i] - self.centre)
            excess = (self._squares(bent) - self._least) / (self.dof * noise)
            result[i] -= power * np.log1p(max(excess, -0.5))
        return result

    def _squares(self, theta: FloatArray) -> float:
        """Return the sum of squared residuals, states and offsets projected out."""
        full = self.values.copy()
        full[: theta.size] = self.to_values(theta)
        total = 0.0
        try:
            for number, y in enumerate(self.problem.measured):
                predicted = self.problem.predict(full, number, derivatives=False)
                e = self.problem.filtered(y - predicted.output)
                basis = self._nuisance[number][0]
                total += float(e @ e) - float(np.sum((basis.T @ e) ** 2))
        except FitError:  # the motion grows beyond all bounds
            return np.inf
        return total if np.isfinite(total) else np.inf

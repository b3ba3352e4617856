"""Robust losses, which down-weight rows far from the model.

A row of a table has two residuals, real and imaginary part or ln gain and phase; a sample of a
record has one. With z the sum of their squares over the noise variance, a row counts as rho(z)
instead of z: proportional to z near the model, and less far from it. So a row is an outlier as a
whole, independently of the coordinates in which its residuals are stated.

- ``huber``: z up to 1.345^2, then growing with |y|;
- ``soft_l1``: 2 (sqrt(1 + z) - 1), similar and smooth;
- ``student_t``: (4 + p) ln(1 + z/4), for p residuals a row: the likelihood of Student's t with 4
  degrees of freedom; points far from the model have almost no influence.

**Scale.** An unknown scale s of the noise has to be robust as well: mean chi(z) = E[chi(z)], with E
the expectation for Gaussian noise and z in units of s^2 (p n - P)/(p n), so that s^2 is the
variance of the noise if there are no outliers. chi = psi^2 = rho'(z)^2 z is Huber's proposal 2; for
student_t, whose psi^2 decreases for large z, chi = rho'(z) z, the scale equation of its likelihood.

**Likelihood**: that of the density proportional to exp(-rho/2), at the likeliest scale.

**Covariance**: s^2 kappa (J' J)^-1 with kappa = mean(psi^2) / mean(psi')^2 (Huber, Robust
Statistics, 1981, section 7.6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from dahl_ident.arrays import FloatArray
from dahl_ident.errors import ValidationError, choices

# residual, in standard deviations, beyond which Huber's loss grows linearly: 95 % efficient for
# Gaussian noise (Huber)
KNEE = 1.345
TAIL_DOF = 4.0  # degrees of freedom of Student's t: heavy tails, but a finite variance
_SCALE_STEPS = 1000  # most steps to the likeliest scale, each of which is cheap
_SAME_SCALE = 1e-12  # relative change of the variance at which the steps end


@dataclass(frozen=True)
class Loss:
    """A loss rho(z) with its first two derivatives."""

    name: str
    rho: Callable[[FloatArray], FloatArray]
    slope: Callable[[FloatArray], FloatArray]
    curvature: Callable[[FloatArray], FloatArray]
    power: int
    """Power of rho' in chi."""
    parts: int = 2
    """Residuals of a row."""

    def __call__(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rho and its first two derivatives."""
        return self.rho(z), self.slope(z), self.curvature(z)

    def chi(self, z: FloatArray) -> FloatArray:
        """Return chi, whose mean determines the scale; it rises with z."""
        return self.slope(z) ** self.power * z

    @cached_property
    def gaussian_chi(self) -> float:
        """The expectation of chi for Gaussian noise, where z/2 has a gamma distribution."""
        nodes, weights = special.roots_genlaguerre(100, 0.5 * self.parts - 1.0)
        return float(weights @ self.chi(2.0 * nodes) / weights.sum())

    def scores(self, y: FloatArray) -> FloatArray:
        """Return residuals (m,) for which least squares gives the same estimate as the loss.

        They are psi(y)/mean(psi'), with y in units of the noise. Their scatter gives the covariance
        of the estimate, and a change of y changes them on average by the same amount. Source:
        Huber, section 7.10.
        """
        z = np.sum(y.reshape(-1, self.parts) ** 2, axis=1)
        return y * np.repeat(self.slope(z) / self.mean_slope(z), self.parts)

    def counts(self, z: FloatArray, dof: float) -> FloatArray:
        """Return the weights of squares for the scale; of noise alone, they sum `z` to `dof`."""
        weight = self.slope(z * (self.parts * z.size / dof)) ** self.power
        return weight * (self.parts / self.gaussian_chi)

    def rescaled(self, z: FloatArray, dof: float) -> float:
        """Return s_new^2/s^2, for squares `z` in units of s^2."""
        return float(np.sum(self.counts(z, dof) * z) / dof)

    @cached_property
    def log_area(self) -> float:
        """Logarithm of the integral of exp(-rho/2) over the residuals, less a Gaussian's."""
        from scipy.integrate import quad

        def density(y: float) -> float:
            return float(y ** (self.parts - 1) * np.exp(-0.5 * self.rho(np.asarray(y**2))))

        gaussian = 2.0 ** (0.5 * self.parts - 1.0) * special.gamma(0.5 * self.parts)
        return float(np.log(quad(density, 0.0, np.inf)[0] / gaussian))

    def likeliest(self, z: FloatArray, least: float) -> float:
        """Return the likeliest s^2 >= `least` for squares `z` with a density exp(-rho(z/s^2)/2)."""
        s2 = 1.0
        for _ in range(_SCALE_STEPS):
            factor = float(np.mean(self.slope(z / s2) * z / s2)) / self.parts
            s2 = max(s2 * factor, least)
            if s2 == least or abs(factor - 1.0) < _SAME_SCALE:
                break
        return s2

    def inflation(self, z: FloatArray, dof: int) -> float:
        """Return kappa, by which the covariance exceeds that of least squares."""
        if dof <= 0:
            return np.inf
        psi2 = (self.slope(z) ** 2 * z).sum() / dof
        return float(psi2 / self.mean_slope(z) ** 2)

    def mean_slope(self, z: FloatArray) -> float:
        """Return the mean derivative of psi with respect to the residuals."""
        return float(np.mean(self.slope(z) + 2.0 / self.parts * self.curvature(z) * z))


def _student_t(parts: int) -> Loss:
    power = TAIL_DOF + parts
    return Loss(
        "student_t",
        lambda z: power * np.log1p(z / TAIL_DOF),
        lambda z: power / (TAIL_DOF + z),
        lambda z: -power / (TAIL_DOF + z) ** 2,
        power=1,
    )


LOSSES = {
    "huber": Loss(
        "huber",
        lambda z: np.where(z <= KNEE**2, z, 2.0 * KNEE * np.sqrt(z) - KNEE**2),
        lambda z: KNEE / np.sqrt(np.maximum(z, KNEE**2)),
        lambda z: np.where(z <= KNEE**2, 0.0, -0.5 * KNEE * np.maximum(z, KNEE**2) ** -1.5),
        power=2,
    ),
    "soft_l1": Loss(
        "soft_l1",
        lambda z: 2.0 * z / (np.sqrt(1.0 + z) + 1.0),
        lambda z: (1.0 + z) ** -0.5,
        lambda z: -0.5 * (1.0 + z) ** -1.5,
        power=2,
    ),
    "student_t": _student_t(2),
}


def loss_named(name: str, parts: int = 2) -> Loss | None:
    """Return the loss called `name` for rows of `parts` residuals, None for "linear"."""
    if name == "linear":
        return None
    if name not in list(LOSSES):  # a list may be asked for objects without a hash
        raise ValidationError(f"loss is {name!r}; expected {choices(['linear', *LOSSES], name)}")
    loss = _student_t(parts) if name == "student_t" else LOSSES[name]
    return replace(loss, parts=parts)

"""Checks of a posterior: whether the model explains the data, and what the prior decides.

Predictive checks: statistics of the whitened residuals at draws from the posterior are compared
with those of replicated residuals, which are noise by construction (Gelman et al., Bayesian Data
Analysis, 2013, chapter 6):

- ``size``: the sum of squares; only where the noise's scale is known;
- ``largest``: the largest squared residual over the mean one: outliers;
- ``neighbours``: the correlation of residuals of rows next to each other, in order of frequency
  and amplitude: a model of the wrong shape leaves runs of residuals of one sign.

A share of 0.01 or less of replicates that are at least as extreme shows a misfit.

The prior determines a parameter where the posterior is nearly as wide as the prior, or where at an
end of the prior there is still as much posterior probability as prior probability, so that the
interval ends where the prior does. If the whole of a narrow posterior lies in such an end, prior
and data contradict each other.

Predicted responses and their bands are computed at the draws, without linearization.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.bayes.density import Density
from dahl_ident.bayes.priors import JointPrior
from dahl_ident.bayes.sample import ChainSample
from dahl_ident.data.storage import library
from dahl_ident.diagnostics.confidence_levels import checked_levels
from dahl_ident.diagnostics.judgement import Finding, VerdictStatus, described, determined
from dahl_ident.fitting.losses import TAIL_DOF

if TYPE_CHECKING:
    from dahl_ident.results.fit_result import FitResult

_NEARLY_AS_WIDE = 0.5  # width over the prior's, from which the data add little
_PRIOR_END = 0.01  # probability of the prior that counts as its end
_PRIOR_DRAWS = 1000  # draws of the prior for ArviZ: probabilities to 1.6 %
_MISFIT = 0.01  # probability at which a check of a right model fails
_MEANING = {
    "size": "the residuals are larger than the noise that the data state",
    "largest": "single rows lie farther off than the noise explains",
    "neighbours": "neighbouring rows err in the same direction, so the model has the wrong shape",
}


@dataclass(frozen=True)
class PredictiveCheck:
    """One statistic: its mean in the data and in replicates, and the share as extreme."""

    statistic: str
    observed: float
    replicated: float
    share: float

    @property
    def passed(self) -> bool:
        """Whether replicates reach the data's value often enough."""
        return self.share > _MISFIT

    def __str__(self) -> str:
        numbers = (
            f"{self.statistic} {self.observed:.3g}, replicated {self.replicated:.3g}, "
            f"share at least as extreme {self.share:.3f}"
        )
        return numbers if self.passed else f"MISFIT: {_MEANING[self.statistic]} ({numbers})"


def predictive_checks(
    density: Density, points: FloatArray, random: np.random.Generator
) -> tuple[PredictiveCheck, ...]:
    """Return the checks at draws from the posterior, (S, D)."""
    theta, scale = density.split(points)
    y = _whitened(density, theta)
    y = np.broadcast_to(y, (len(theta), density.problem.n_residuals // 2)) / scale[:, None]
    data = density.problem.data
    level = data.drive if data.amplitude is None else data.amplitude
    assert level is not None
    order = np.lexsort((level, data.frequency_hz, data.harmonic))
    noise = replicated_noise(density, y.shape, random)
    checks = []
    for name, statistic in _STATISTICS.items():
        if name != "size" or not density.has_scale:
            observed, replicated = statistic(y[:, order]), statistic(noise[:, order])
            means = (float(observed.mean()), float(replicated.mean()))
            share = replicated >= observed
            checks.append(PredictiveCheck(name, *means, float(np.mean(share))))
    return tuple(checks)


def replicated_noise(
    density: Density, shape: tuple[int, int], random: np.random.Generator
) -> ComplexArray:
    """Return whitened residuals as the likelihood has them, the scale taken as 1."""
    noise = random.standard_normal(shape) + 1j * random.standard_normal(shape)
    dof = density.problem.data.dof
    if not density.problem.gaussian and dof is not None:
        # Student's t with the loss (dof + 1) ln(1 + z/dof) for its square
        with np.errstate(invalid="ignore"):
            factor = np.where(np.isfinite(dof), (dof + 1.0) / (dof - 1.0), 1.0)
        noise = noise * np.sqrt(factor)
    if density.likelihood == "student_t":
        noise = noise / np.sqrt(random.chisquare(TAIL_DOF, shape) / TAIL_DOF)
    return np.asarray(noise)


def pointwise_log_likelihood(density: Density, points: FloatArray) -> FloatArray:
    """Return ln of each row's density, (S, n), up to a constant that all rows share.

    The rows add up to the log-likelihood of the data.
    """
    theta, scale = density.split(points)
    z = density.quick.squares(theta) / scale[:, None] ** 2
    if density.likelihood == "student_t":
        rows = -(0.5 * TAIL_DOF + 1.0) * np.log1p(z / TAIL_DOF)
    else:
        rows = -0.5 * z
    constant = density.log_likelihood(theta, scale) - rows.sum(axis=1)
    return np.asarray(rows + constant[:, None] / z.shape[1])


def _size(y: ComplexArray) -> FloatArray:
    return np.asarray(np.sum(np.abs(y) ** 2, axis=1))


_STATISTICS: Mapping[str, Callable[[ComplexArray], FloatArray]] = {
    "size": _size,
    "largest": lambda y: np.max(np.abs(y) ** 2, axis=1) / (_size(y) / y.shape[1]),
    "neighbours": lambda y: np.sum((y[:, 1:] * y[:, :-1].conj()).real, axis=1) / _size(y),
}


@dataclass(frozen=True)
class PriorInfluence:
    """A parameter that the prior determines: its width over the prior's, and the ends it reaches.

    `contradicted` says that the whole posterior lies in the last hundredth of the prior.
    """

    name: str
    width: float
    at_lower_end: bool
    at_upper_end: bool
    contradicted: bool = False

    def finding(self, severity: VerdictStatus) -> Finding:
        """Return the influence as a finding."""
        reached = {"lower": self.at_lower_end, "upper": self.at_upper_end}
        ends = tuple(end for end, is_reached in reached.items() if is_reached)
        known = {"name": self.name, "width": self.width, "contradicted": self.contradicted}
        return determined("prior_influence", severity, ends=ends, **known)

    def __str__(self) -> str:
        return str(self.finding(VerdictStatus.TRUSTED))


def prior_influences(prior: JointPrior, points: FloatArray) -> tuple[PriorInfluence, ...]:
    """Return the parameters that the prior determines, from posterior draws of theta."""
    influences = []
    for part, theta in zip(prior.priors, points.T, strict=False):
        low, high = np.quantile(theta, [0.16, 0.84])
        width = float(high - low) / part.width
        probability = part.probability(theta)
        below, above = np.mean(probability < _PRIOR_END), np.mean(probability > 1.0 - _PRIOR_END)
        at_lower, at_upper = bool(below >= _PRIOR_END), bool(above >= _PRIOR_END)
        if width >= _NEARLY_AS_WIDE or at_lower or at_upper:
            contradicted = bool(max(below, above) > 1.0 - _PRIOR_END)
            name = part.parameter.name
            influences.append(PriorInfluence(name, width, at_lower, at_upper, contradicted))
    return tuple(influences)


def to_arviz(density: Density, sample: ChainSample, seed: int) -> Any:
    """Return InferenceData of ArviZ or a DataTree, whichever the installed ArviZ has.

    A row's observed value is its whitened residual at the posterior mean; replicates are the
    same plus noise of the likelihood, less what parameters differ from the mean.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # ArviZ 0.23 announces 1.0 at import
        arviz = library("arviz", "arviz")
    random = np.random.default_rng(seed)
    # coordinates by ensemble, (ensembles, draws, D), about independent
    ensembles, convergence = sample.settings.ensembles, sample.convergence
    thin = max(1, int(np.ceil(convergence.tau.max())))
    kept = sample.chain.points[convergence.discard :: thin]
    steps, walkers, D = kept.shape
    kept = kept.reshape(steps, ensembles, walkers // ensembles, D)
    kept = kept.transpose(1, 0, 2, 3).reshape(ensembles, -1, D)
    prior = density.problem.in_order(density.prior.draw(random, _PRIOR_DRAWS))
    groups: dict[str, dict[str, Any]] = {
        "posterior": _by_name(density, density.to_values(kept)),
        "prior": _by_name(density, density.problem.to_values(prior)[None]),  # not of the scale
    }
    if density.likelihood != "none":
        flat = kept.reshape(-1, D)
        shape = (*kept.shape[:2], -1)
        theta, scale = density.split(flat)
        observed = _whitened(density, theta.mean(axis=0)[None])
        at_point = _whitened(density, theta)
        noise = scale[:, None] * replicated_noise(density, at_point.shape, random)
        replicated = (observed - at_point + noise).reshape(shape)
        rows = pointwise_log_likelihood(density, flat).reshape(shape)
        groups["log_likelihood"] = {"row": rows}
        groups["observed_data"] = {"real": observed[0].real, "imag": observed[0].imag}
        groups["posterior_predictive"] = {"real": replicated.real, "imag": replicated.imag}
    if int(arviz.__version__.split(".")[0]) >= 1:
        return arviz.from_dict(groups)
    return arviz.from_dict(**groups)


def _whitened(density: Density, theta: FloatArray) -> ComplexArray:
    """Return the data's residuals, real and imaginary part of each row as one number."""
    return np.ascontiguousarray(density.problem.whitened(theta)).view(np.complex128)


def _by_name(density: Density, values: FloatArray) -> dict[str, FloatArray]:
    names = density.names[: values.shape[-1]]
    return {name: values[..., i] for i, name in enumerate(names)}


@dataclass(frozen=True)
class PredictiveBand:
    """A predicted response at draws from the posterior; noise is not included.

    Attributes
    ----------
    draws : ndarray of complex, shape (draws, n)
        The response at each draw.

    Examples
    --------
    >>> import dahl_ident as di
    >>> grid = di.posterior(di.load_dataset("noisy"), di.Dahl(alpha=1.0), method="grid")
    >>> band = grid.predict([1.0, 1.0], amplitude=[0.002, 0.004])
    >>> low, high = band.gain()
    >>> print(abs(band.response).round(1), (high - low).round(1))
    [27.3 22. ] [0.2 0.2]
    """

    draws: ComplexArray

    @property
    def response(self) -> ComplexArray:
        """The posterior mean, shape (n,)."""
        return np.asarray(self.draws.mean(axis=0))

    def gain(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the gain at each point."""
        return _central(np.abs(self.draws), level)

    def phase(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the phase at each point, rad."""
        centre = np.angle(self.response)
        low, high = _central(np.angle(self.draws * np.exp(-1j * centre)), level)
        return centre + low, centre + high

    def real(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the real part at each point."""
        return _central(self.draws.real, level)

    def imag(self, level: float = 0.9545) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limit of the imaginary part at each point."""
        return _central(self.draws.imag, level)


def _central(values: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    tail = 0.5 * (1.0 - float(checked_levels([level])[0]))
    low, high = np.quantile(values, [tail, 1.0 - tail], axis=0)
    return low, high


def contradictions(
    fit: FitResult | None, checks: Sequence[PredictiveCheck], by_checks: bool
) -> tuple[Finding, ...]:
    """Return findings that the data contradict the model: of the checks, or else of the fit."""
    if fit is None or by_checks:
        failed, lost = (c for c in checks if not c.passed), VerdictStatus.NOT_DESCRIBED
        return tuple(described("predictive_check", lost, text=str(check)) for check in failed)
    if fit.status is VerdictStatus.NOT_DETERMINED and fit.goodness.objections:
        return tuple(fit.goodness.findings())
    if fit.status is not VerdictStatus.NOT_DESCRIBED:
        return ()
    return tuple(f for f in fit.findings if f.severity is not VerdictStatus.TRUSTED)

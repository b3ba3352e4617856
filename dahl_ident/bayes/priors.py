"""Priors: one distribution for each free parameter.

A prior is a frozen distribution of scipy.stats over the parameter's value, such as
``scipy.stats.norm(1.0, 0.005)`` for a gain from a calibration sheet, or a pair of bounds. Bounds
mean a log-uniform prior for a positive parameter (every decade is as likely as the next) and a
uniform one for the others. Where the user gives none, bounds are derived from the size of the data.
They are proper and wide enough to have little influence:

- positive parameters: each row of the data gives every unit a size, from its force, its
  displacement amplitude and its angular frequency. Bounds reach from 1e-5 times the smallest to
  1e5 times the largest, because a law's knee can lie decades away from the data;
- parameters of either sign, such as stiffness, damping and mass: up to a thousand times the
  largest size (at a resonance they cancel), or ten times the least-squares estimate;
- parameters that declare a range, such as an exponent: five times wider than that range;
- gains: from 0.1 to 10; delay: half a period of the highest frequency either way.

The priors are part of the result, and reports print them. The unknown scale s of the noise has the
prior 1/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, finite_array
from dahl_ident.elements import Parameter
from dahl_ident.errors import HIGH, LOW, ModelError, ValidationError, argument, choices, spelled
from dahl_ident.problem import Problem

# Factors of the default bounds:
_BEYOND_DATA = 1e5  # over the sizes in the data, of positive parameters: a knee may lie so far away
_PRIOR_SPREAD = 10.0  # over 1, of gains (more is a mistake); over the estimate, of either sign
_BEYOND_RANGE = 5.0  # over the range that a parameter declares
_RESONANCE = 1e3  # a plant's parts over their sum: at a resonance they nearly cancel
_TAIL = 1e-10  # tail probability that is neglected, where a distribution is unbounded


PriorLike = Any
"""A frozen distribution of scipy.stats over the value, or the two ends of a range."""


@dataclass(frozen=True)
class ParameterPrior:
    """The prior of one parameter."""

    parameter: Parameter
    prior: PriorLike  # a distribution of the value, or the ends of a log-uniform or uniform one
    source: str = "given"  # {"given", "sensors", "assumed", "default"}
    # the least-squares value, not finite where unknown: `limits` reach beyond it, because data can
    # outweigh a prior even in its far tail
    estimate: float = float("nan")

    @property
    def logarithmic(self) -> bool:
        """Whether the search coordinate theta is the logarithm of the value."""
        return self.parameter.positive

    @property
    def bounded(self) -> bool:
        """Whether the prior is the ends of a range."""
        return isinstance(self.prior, tuple)

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Ends of theta beyond which the posterior probability is zero or negligible."""
        low, high = self.bulk
        at = self._theta(self.estimate)
        # as far beyond the estimate as the estimate is from the prior
        if not self.bounded and np.isfinite(at):
            first, last = (self._theta(float(self.prior.ppf(q))) for q in (0.0, 1.0))
            low = max(first, min(low, 2.0 * at - low))
            high = min(last, max(high, 2.0 * at - high))
        return low, high

    @cached_property
    def bulk(self) -> tuple[float, float]:
        """Ends of theta beyond which the prior probability is zero or negligible."""
        ends = self.prior if self.bounded else self.prior.ppf([_TAIL, 1.0 - _TAIL])
        low, high = (self._theta(float(end)) for end in ends)
        return low, high

    def _theta(self, value: float) -> float:
        """Return theta of a value, which is clipped to the parameter's bounds."""
        value = min(max(value, self.parameter.lower), self.parameter.upper)
        return float(np.log(max(value, 1e-300))) if self.logarithmic else value

    @cached_property
    def width(self) -> float:
        """Distance in theta between the quantiles 16 % and 84 %."""
        low, high = self.quantile(np.array([0.16, 0.84]))
        return float(high - low)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """Return the log-density over theta; -inf outside its support."""
        if self.bounded:
            low, high = self.limits
            return np.where((theta >= low) & (theta <= high), -np.log(high - low), -np.inf)
        with np.errstate(over="ignore"):
            value = np.exp(theta) if self.logarithmic else theta
        allowed = (value >= self.parameter.lower) & (value <= self.parameter.upper)
        density = np.where(allowed, _log_density(self.prior, value), -np.inf)
        return density + theta if self.logarithmic else density

    def probability(self, theta: FloatArray) -> FloatArray:
        """Return the prior probability below theta."""
        if self.bounded:
            low, high = self.limits
            return np.clip((theta - low) / (high - low), 0.0, 1.0)
        return np.asarray(self.prior.cdf(np.exp(theta) if self.logarithmic else theta))

    def quantile(self, q: FloatArray) -> FloatArray:
        """Return quantiles of theta."""
        low, high = self.limits
        if self.bounded:
            return np.asarray(low + (high - low) * q)
        value = np.asarray(self.prior.ppf(q))
        return np.log(np.maximum(value, np.exp(low))) if self.logarithmic else value

    def __str__(self) -> str:
        unit = f" {self.parameter.unit}" if self.parameter.unit else ""
        if self.bounded:
            kind = "log-uniform" if self.logarithmic else "uniform"
            text = f"{kind} from {self.prior[0]:.4g} to {self.prior[1]:.4g}{unit}"
        else:
            text = _description(self.prior) + unit
        why = {"default": " (from the size of the data)", "assumed": " (its range)"}
        return text + why.get(self.source, "")


@dataclass(frozen=True)
class JointPrior:
    """Independent priors of all free parameters, in the order of the problem's names."""

    priors: tuple[ParameterPrior, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(part.parameter.name for part in self.priors)

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Ends of every theta, each of shape (P,)."""
        low, high = np.array([part.limits for part in self.priors]).T
        return low, high

    def log_density(self, theta: FloatArray) -> FloatArray:
        """Return the joint log-density over theta, (S, P) -> (S,)."""
        each = (part.log_density(theta[:, i]) for i, part in enumerate(self.priors))
        return np.asarray(sum(each, np.zeros(len(theta))))

    def draw(self, random: np.random.Generator, size: int) -> FloatArray:
        """Return independent draws of theta, shape (size, P)."""
        return self.quantiles(random.uniform(size=(size, len(self.priors))))

    def quantiles(self, q: FloatArray) -> FloatArray:
        """Return the quantile of each theta at probabilities of shape (S, P)."""
        return np.stack([p.quantile(q[:, i]) for i, p in enumerate(self.priors)], axis=-1)

    def __str__(self) -> str:
        return "\n".join(f"{part.parameter.name}: {part}" for part in self.priors)


def joint_prior(
    problem: Problem,
    priors: Mapping[str, PriorLike] | None = None,
    estimate: FloatArray | None = None,
    assumed: Mapping[str, PriorLike] | None = None,
) -> JointPrior:
    """Return the prior of every free parameter of the device and of the sensors.

    Sources in order of precedence: given, assumed, sensors; otherwise wide bounds.
    """
    parameters = problem.parameters[: problem.n_reported]
    names = [p.name for p in parameters]
    sources: dict[str, Mapping[str, Any]] = {
        "given": priors or {},
        "assumed": assumed or {},
        "sensors": problem.priors,
    }
    unknown = [name for name in sources["given"] if name not in names]
    if unknown:
        fixed = [name for name in unknown if name in problem.device_parameters]
        free = f"; to estimate {', '.join(fixed)}, give {spelled(f'free={fixed}', 'it as free')}"
        raise ModelError(
            f"there is a prior for {', '.join(unknown)}; the free parameters are "
            f"{choices(names, *unknown)}{free if fixed else ''}"
        )
    parts = []
    for i, parameter in enumerate(parameters):
        at = float("nan") if estimate is None else float(estimate[i])
        source = next((s for s, stated in sources.items() if parameter.name in stated), None)
        if source is None:
            parts.append(ParameterPrior(parameter, _default(problem, parameter, at), "default"))
        else:
            prior = _checked_prior(parameter, sources[source][parameter.name])
            parts.append(ParameterPrior(parameter, prior, source, at))
    return JointPrior(tuple(parts))


def _checked_prior(parameter: Parameter, stated: Any) -> PriorLike:
    """Return a prior as stated; raise if it cannot be one of the parameter."""
    frozen = not hasattr(stated, "freeze")  # a method of distributions that are not frozen
    if frozen and all(hasattr(stated, name) for name in ("logpdf", "cdf", "ppf")):
        _check_support(parameter, stated)
        return stated
    if not isinstance(stated, Sequence) or len(stated) != 2:
        raise ValidationError(
            f"the prior of {parameter.name} is {stated!r}; expected a frozen, continuous "
            "distribution of one number, such as scipy.stats.norm(1.0, 0.005), or a pair "
            "(low, high)"
        )
    low, high = finite_array(stated, f"prior of {parameter.name}").tolist()
    if not low < high or (parameter.positive and low <= 0.0):
        positive = "0 < " if parameter.positive else ""
        raise ValidationError(
            f"the prior of {parameter.name} has the bounds {low:g} and {high:g}; expected "
            f"{positive}low < high"
        )
    if low < parameter.lower or high > parameter.upper:
        raise ValidationError(
            f"the prior of {parameter.name} reaches from {low:g} to {high:g}; the parameter's own "
            f"bounds are {parameter.lower:g} and {parameter.upper:g}"
        )
    return low, high


def _check_support(parameter: Parameter, dist: Any) -> None:
    """Refuse a distribution with noticeable probability outside the parameter's bounds."""
    with np.errstate(divide="ignore", invalid="ignore"):
        outside = float(dist.cdf(parameter.lower)) + 1.0 - float(dist.cdf(parameter.upper))
        median = float(dist.ppf(0.5))
    if np.isnan([outside, median]).any():
        raise ValidationError(
            f"the prior of {parameter.name}, {_name(dist)}, is not defined: its own "
            "parameters are outside its allowed range, such as a standard deviation of 0"
        )
    if outside > 1e-3:
        raise ValidationError(
            f"the prior of {parameter.name}, {_description(dist)}, has {outside:.2g} of its "
            f"probability outside {parameter.lower:g} to {parameter.upper:g}; use one that lies "
            "inside, such as scipy.stats.lognorm for a positive parameter"
        )


def _default(problem: Problem, parameter: Parameter, estimate: float) -> tuple[float, float]:
    """Return wide bounds of the value; `estimate` is not finite where unknown."""
    if parameter.name == "delay":
        half = np.pi * float(problem.unit_sizes((0, 0, 1)).min())
        return -half, half
    if parameter.name in ("force_gain", "displacement_gain"):
        return 1.0 / _PRIOR_SPREAD, _PRIOR_SPREAD
    # the problem shows units of rotation where the data do; dimensions follow those declared
    parameter = next((p for p in problem.model.parameters if p.name == parameter.name), parameter)
    if parameter.prior is not None:
        low, high = parameter.prior  # the range of 95 % probability
        if parameter.positive:
            low, high = low / _BEYOND_RANGE, high * _BEYOND_RANGE
        else:
            beyond = _BEYOND_RANGE * (high - low)
            low, high = low - beyond, high + beyond
    elif not any(parameter.dimension):
        raise _no_default_error(parameter)
    elif parameter.positive:
        sizes = problem.unit_sizes(parameter.dimension)
        seen = sizes[sizes > 0.0]
        if not seen.size:
            raise _no_default_error(parameter)
        low, high = float(seen.min()) / _BEYOND_DATA, float(seen.max()) * _BEYOND_DATA
    else:
        high = _RESONANCE * float(problem.unit_sizes(parameter.dimension).max())
        if np.isfinite(estimate):
            high = max(high, _PRIOR_SPREAD * abs(estimate))
        low = -high
    low, high = max(low, parameter.lower), min(high, parameter.upper)
    if not (np.isfinite([low, high]).all() and low < high):
        raise _no_default_error(parameter)
    return low, high


def _no_default_error(parameter: Parameter) -> ValidationError:
    name = parameter.name
    return ValidationError(
        f"{name} has no default prior, because the data do not show its size; give "
        f"{argument('priors', {name: (LOW, HIGH)}, option='prior')}, or a frozen distribution of "
        "scipy.stats"
    )


def _log_density(distribution: Any, value: FloatArray) -> FloatArray:
    """Return logpdf; that of a normal distribution written out, fifty times as fast as scipy."""
    if _name(distribution) == "norm":
        mean, std = _moments(distribution)
        with np.errstate(over="ignore"):
            z2 = ((value - mean) / std) ** 2
        return np.asarray(-0.5 * z2 - np.log(std * np.sqrt(2.0 * np.pi)))
    return np.asarray(distribution.logpdf(value))


def _name(distribution: Any) -> str:
    return str(getattr(getattr(distribution, "dist", None), "name", type(distribution).__name__))


def _moments(distribution: Any) -> tuple[float, float]:
    return float(distribution.mean()), float(distribution.std())


def _description(distribution: Any) -> str:
    mean, std = _moments(distribution)
    if np.isfinite(std):
        return f"{_name(distribution)}, mean {mean:.6g}, std {std:.4g}"
    low, median, high = (float(distribution.ppf(q)) for q in (0.025, 0.5, 0.975))
    return f"{_name(distribution)}, median {median:.6g}, 95 % from {low:.4g} to {high:.4g}"

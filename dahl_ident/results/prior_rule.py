"""Which parameters the prior determines, not the data.

Two signs: the posterior is nearly as wide as the prior, or at an end of the prior there is still
as much posterior probability as prior probability, so that the interval ends where the prior
does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.priors import JointPrior, ParameterPrior

_NEARLY_AS_WIDE = 0.5
_END = 0.01  # of the prior's probability that counts as its end


@dataclass(frozen=True)
class PriorRule:
    """One such parameter: the posterior's width over the prior's, and the ends it reaches."""

    name: str
    width: float
    at_lower_end: bool
    at_upper_end: bool

    def __str__(self) -> str:
        ends = [
            end
            for end, reached in (("lower", self.at_lower_end), ("upper", self.at_upper_end))
            if reached
        ]
        reach = f", and it reaches the prior's {' and '.join(ends)} end" if ends else ""
        return (
            f"{self.name} is set by its prior: posterior width {self.width:.2f} of the "
            f"prior's{reach}."
        )


def prior_rules(prior: JointPrior, points: FloatArray) -> tuple[PriorRule, ...]:
    """Return the parameters that the prior determines, from posterior draws of theta."""
    found = [_rule(part, points[:, i]) for i, part in enumerate(prior.parts)]
    return tuple(rule for rule in found if rule is not None)


def _rule(part: ParameterPrior, theta: FloatArray) -> PriorRule | None:
    low, high = np.quantile(theta, [0.16, 0.84])
    width = float(high - low) / part.width
    probability = part.probability(theta)
    at_lower = bool(np.mean(probability < _END) >= _END)
    at_upper = bool(np.mean(probability > 1.0 - _END) >= _END)
    if width < _NEARLY_AS_WIDE and not (at_lower or at_upper):
        return None
    return PriorRule(part.parameter.name, width, at_lower, at_upper)

"""Which parameters the prior determines, not the data.

Two signs: the posterior is nearly as wide as the prior, or at an end of the prior there is still
as much posterior probability as prior probability, so that the interval ends where the prior
does. A posterior that is narrow and lies as a whole in such an end is another matter: prior and
data contradict each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dahl_ident.arrays import FloatArray
from dahl_ident.bayes.priors import JointPrior, ParameterPrior
from dahl_ident.diagnostics.judgement import Finding, Question, VerdictStatus

_NEARLY_AS_WIDE = 0.5  # of the width: the data have not even halved it
_END = 0.01  # of the prior's probability that counts as its end


@dataclass(frozen=True)
class PriorInfluence:
    """One such parameter: the posterior's width over the prior's, and the ends it reaches.

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
        values = {
            "name": self.name,
            "width": self.width,
            "ends": tuple(end for end, there in reached.items() if there),
            "contradicted": self.contradicted,
        }
        return Finding(Question.DETERMINED, severity, "prior_influence", values)

    def __str__(self) -> str:
        return str(self.finding(VerdictStatus.TRUSTED))


def prior_influences(prior: JointPrior, points: FloatArray) -> tuple[PriorInfluence, ...]:
    """Return the parameters that the prior determines, from posterior draws of theta."""
    found = [_rule(part, points[:, i]) for i, part in enumerate(prior.priors)]
    return tuple(rule for rule in found if rule is not None)


def _rule(part: ParameterPrior, theta: FloatArray) -> PriorInfluence | None:
    low, high = np.quantile(theta, [0.16, 0.84])
    width = float(high - low) / part.width
    probability = part.probability(theta)
    below, above = np.mean(probability < _END), np.mean(probability > 1.0 - _END)
    at_lower, at_upper = bool(below >= _END), bool(above >= _END)
    if width < _NEARLY_AS_WIDE and not (at_lower or at_upper):
        return None
    contradicted = bool(max(below, above) > 1.0 - _END)
    return PriorInfluence(part.parameter.name, width, at_lower, at_upper, contradicted)

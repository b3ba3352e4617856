"""Whether a fit can be used as it is: every judgement of it, made once."""

from __future__ import annotations

from dataclasses import dataclass

from dahl_ident.diagnostics.goodness import Goodness, goodness
from dahl_ident.diagnostics.intervals import (
    ConfidenceIntervals,
    profile_intervals,
    wald_intervals,
)
from dahl_ident.diagnostics.verdicts import Identifiability, judged
from dahl_ident.results import FitResult


@dataclass(frozen=True)
class Judgement:
    """Intervals by every method, what is determined, and what is left after the fit."""

    fit: FitResult
    wald: ConfidenceIntervals
    profile: ConfidenceIntervals
    identifiability: Identifiability
    goodness: Goodness

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the estimates; warnings alone do not."""
        return not self.objections

    @property
    def objections(self) -> tuple[str, ...]:
        """What does, in words."""
        found = [] if self.fit.success else [self.fit.message]
        if not self.identifiability.complete:
            found.append(self.identifiability.headline)
        if not self.goodness.acceptable:
            found.append(self.goodness.headline)
        return tuple(found)

    @property
    def headlines(self) -> tuple[str, ...]:
        """The verdict: the search, the parameters, the residuals, then warnings."""
        return (
            self.fit.message,
            self.identifiability.headline,
            self.goodness.headline,
            *(f"Warning: {text}" for text in self.goodness.warnings),
        )


def judgement(fit: FitResult) -> Judgement:
    """Return every judgement of a fit."""
    profile = profile_intervals(fit.optimum)
    return Judgement(
        fit,
        wald_intervals(fit.optimum),
        profile,
        judged(fit.optimum, profile),
        goodness(fit.optimum),
    )

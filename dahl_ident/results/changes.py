"""Changes from one fit to the next: differences of parameters with their combined uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from scipy import special

from dahl_ident.diagnostics.contributions import RUNS
from dahl_ident.diagnostics.formatting import rounded
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.errors import FitError, ValidationError
from dahl_ident.results.fit_result import FitResult
from dahl_ident.units import percent

SIGNIFICANT = 0.05  # two-sided probability below which a change is called significant


@dataclass(frozen=True)
class Change:
    """The change of one parameter."""

    parameter: str
    unit: str
    before: str  # name of the earlier fit
    after: str
    change: float  # difference of the estimates
    relative: float  # the change over the earlier estimate
    # standard uncertainty of the change: from both estimates and, for a fit of a single run, from
    # the scatter between runs that the other fit shows
    u: float
    runs_known: bool  # whether `u` includes the scatter between runs
    p: float  # two-sided p-value of no change; NaN if an estimate must not be used

    @property
    def significant(self) -> bool:
        """Whether neither noise nor scatter between runs explains it."""
        return self.runs_known and self.p < SIGNIFICANT

    @property
    def significance(self) -> str:
        """The judgement in words."""
        if not math.isfinite(self.p):
            return "cannot be stated: not both estimates can be used"
        if self.p >= SIGNIFICANT:
            return "not significant"
        return "significant" if self.runs_known else "beyond noise; scatter between runs unknown"

    @property
    def p_number(self) -> str:
        """The probability as a number, or its bound."""
        return "< 0.0001" if self.p < 1e-4 else f"{self.p:.1g}"

    @property
    def p_text(self) -> str:
        """The probability as text, with its symbol."""
        if not math.isfinite(self.p):
            return "-"
        return f"p {self.p_number}" if self.p < 1e-4 else f"p = {self.p_number}"

    def to_dict(self) -> dict[str, Any]:
        """Return the change as plain data."""
        names = {"before": "from", "after": "to"}
        facts = {names.get(name, name): value for name, value in vars(self).items()}
        return facts | {"significant": self.significant}

    def __str__(self) -> str:
        value, error = rounded(self.change, self.u)
        numbers = f"{value} ± {error} {self.unit}".rstrip()
        return (
            f"{self.parameter} from {self.before} to {self.after}: {numbers} "
            f"({percent(self.relative, sign=True)}, {self.p_text}): {self.significance}"
        )


def changes(fits: Mapping[str, FitResult]) -> list[Change]:
    """Return the changes of every parameter that successive fits estimate."""
    return [
        _change(name, *earlier, *later)
        for earlier, later in pairwise(fits.items())
        for name in (p.name for p in earlier[1].model.parameters)
        if name in earlier[1].var_names and name in later[1].var_names
    ]


def headline(changed: list[Change]) -> list[str]:
    """Return sentences on what has changed, and on what the comparison leaves open."""
    known = [c for c in changed if math.isfinite(c.p)]
    sentences = [f"{c}." for c in known if c.p < SIGNIFICANT]
    if not known:
        return ["Whether a parameter changes cannot be stated: none is known in both fits."]
    if not sentences:
        left_out = ", ".join(dict.fromkeys(c.parameter for c in changed if c not in known))
        unknown = f"; of {left_out}, nothing can be stated" if left_out else ""
        return [f"No parameter changes significantly between the measurements{unknown}."]
    if not all(c.runs_known for c in changed):
        sentences.append(
            "Each fit is of a single run, so scatter between runs (a new mounting, another day) "
            "may be the reason: repeat runs, and fit them together."
        )
    return sentences


def is_usable(fit: FitResult, name: str) -> bool:
    """Return whether the uncertainty of a parameter is valid."""
    known = fit.identifiability.parameters[name].verdict.known
    return known and fit.status is not VerdictStatus.NOT_DESCRIBED


def _change(name: str, before: str, earlier: FitResult, after: str, later: FitResult) -> Change:
    earlier_value, later_value = earlier.params[name], later.params[name]
    if earlier_value.unit != later_value.unit:
        raise ValidationError(
            f"{name} is in {earlier_value.unit} of {before} and in {later_value.unit} of {after}"
        )
    scatters = [_scatter(fit, name) for fit in (earlier, later)]
    stated = max((share for share in scatters if share is not None), default=0.0)
    missing = [
        stated * abs(p.value)
        for p, share in zip((earlier_value, later_value), scatters, strict=True)
        if share is None
    ]
    u = math.hypot(earlier_value.stderr or 0.0, later_value.stderr or 0.0, *missing)
    usable = is_usable(earlier, name) and is_usable(later, name) and 0.0 < u < math.inf
    change = later_value.value - earlier_value.value
    relative = change / earlier_value.value if earlier_value.value else math.nan
    p = float(2.0 * special.ndtr(-abs(change) / u)) if usable else math.nan
    runs_known = len(missing) < len(scatters)
    return Change(name, earlier_value.unit, before, after, change, relative, u, runs_known, p)


def _scatter(fit: FitResult, name: str) -> float | None:
    """Return the relative scatter of a parameter between runs; None where there is one run."""
    runs = len(set(fit.problem.runs))
    if runs < 2:
        return None
    try:
        stated = fit.budget()[name]
    except (FitError, KeyError):
        return None
    u = next((row.u for row in stated.rows if row.source == RUNS), 0.0)
    return u * math.sqrt(runs) / abs(stated.value) if stated.value else 0.0

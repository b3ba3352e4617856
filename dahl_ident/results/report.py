"""A fit in words: the verdict first, then every number with its error and where that is from."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dahl_ident.diagnostics.comparison import compare_models
from dahl_ident.diagnostics.formatting import interval, rounded, table, with_unit
from dahl_ident.diagnostics.intervals import ConfidenceIntervals
from dahl_ident.diagnostics.levels import percent

if TYPE_CHECKING:
    from dahl_ident.results.fit_result import FitResult

_CORRELATED = 0.1
_NOISE = {
    "measured": "measured: the data's covariance, scale known",
    "relative": "relative: constant variance of (ln gain, phase)",
    "absolute": "absolute: constant variance of (real, imaginary part)",
}


@dataclass(frozen=True)
class Section:
    """A heading with its lines."""

    title: str
    lines: list[str]


def statements(fit: FitResult) -> tuple[str, ...]:
    """Return whether to trust a fit, then what speaks against it, the gravest first."""
    if fit.trusted:
        return (f"To be trusted. {fit.identifiability.headline} {fit.goodness.headline}",)
    first, *others = _objections(fit)
    return (f"NOT to be trusted. {first}", *others)


def _objections(fit: FitResult) -> Iterator[str]:
    """Yield what speaks against a fit, a sentence or more each."""
    if fit.goodness.cause:
        yield from fit.goodness.statements
    if fit.goodness.sign:
        return  # what the numbers leave undetermined says nothing of the mechanism
    known = fit.identifiability
    can_tell = fit.scale_known or fit.nfree > 0
    if can_tell and not known.complete:
        yield known.headline
        if known.combinations:
            yield f"Determined: {'; '.join(map(str, known.combinations))}."
    if not fit.success:
        yield fit.status.value if fit.status.at_infinity else fit.message
    if fit.nfree <= 0:
        judged = "the model" if fit.scale_known else "noise and model"
        yield (
            f"{fit.nvarys} parameters leave nothing of {fit.ndata} numbers to judge {judged} by: "
            "measure more points."
        )
    if can_tell and not known.complete:
        yield from known.reasons
    if not fit.goodness.acceptable and not fit.goodness.cause:
        yield from fit.goodness.statements


def fit_report(fit: FitResult, intervals: ConfidenceIntervals) -> str:
    """Return the whole report as text."""
    blocks = [
        f"{s.title}\n" + "\n".join(f"    {line}" for line in s.lines) for s in _all(fit, intervals)
    ]
    return "\n".join(blocks)


def as_html(fit: FitResult, intervals: ConfidenceIntervals) -> str:
    """Return the whole report as HTML."""
    parts = []
    for section in _all(fit, intervals):
        body = html.escape("\n".join(section.lines))
        parts.append(f"<h4>{html.escape(section.title)}</h4><pre>{body}</pre>")
    return f"<div>{''.join(parts)}</div>"


def _all(fit: FitResult, intervals: ConfidenceIntervals) -> Iterator[Section]:
    yield Section("Verdict", list(statements(fit)))
    yield Section("Parameters", _parameters(fit, intervals))
    combined = [str(c) for c in fit.identifiability.combinations]
    if combined:
        yield Section("Determined combinations", combined)
    derived = [str(q) for q in fit.derived()]
    if derived:
        yield Section("Derived", derived)
    correlations = _correlations(fit)
    if correlations:
        yield Section("Correlations", correlations)
    yield Section("Noise", _noise(fit))
    yield Section("Goodness of fit", fit.goodness.details or ["no test applies"])
    if not fit.goodness.acceptable:
        yield Section(
            "Other models, compared and not claimed", str(compare_models(fit)).splitlines()
        )
    yield Section("Solver", _solver(fit))


def _parameters(fit: FitResult, intervals: ConfidenceIntervals) -> list[str]:
    level = float(intervals.levels[-1])
    rows = [["", "value", "stderr", "unit", f"{percent(level)} ({intervals.method})", ""]]
    for name, p in fit.params.items():
        if not p.vary:
            rows.append([name, f"{p.value:g}", "", p.unit, "", "fixed"])
            continue
        value, error = rounded(p.value, p.stderr)
        if math.isfinite(p.value) and p.stderr == math.inf and fit.nfree > 0:
            value = "?"  # any other would do as well
        limits = intervals[name][-1]
        positive = p.min == 0.0
        lower = -math.inf if positive and limits.lower == 0.0 else limits.lower
        within = interval(lower, limits.upper, "")
        word = fit.identifiability.parameters[name].verdict.value
        rows.append([name, value, error, p.unit, within, word])
    return [*table(rows, left=(0, 3, 4, 5)).splitlines(), f"({intervals.note})"]


def _correlations(fit: FitResult) -> list[str]:
    pairs = [
        (a, b, c)
        for i, a in enumerate(fit.var_names)
        for b, c in fit.correl[a].items()
        if b in fit.var_names[i + 1 :] and abs(c) >= _CORRELATED
    ]
    pairs.sort(key=lambda pair: -abs(pair[2]))
    return [f"{a}, {b}: {c:+.3f}" for a, b, c in pairs]


def _noise(fit: FitResult) -> list[str]:
    lines = [_NOISE[fit.noise]]
    if not fit.scale_known:
        error = fit.scale / math.sqrt(2.0 * fit.nfree) if fit.nfree > 0 else None
        unit = fit.data.unit if fit.noise == "absolute" else ""
        size = with_unit(fit.scale, error, unit)
        made = "what rounding leaves; the residuals are smaller"
        if not fit.optimum.is_exact:
            made = f"estimated with {fit.nfree} degrees of freedom"
        lines.append(f"scale {size}, {made}")
    loss = fit.optimum.loss
    if loss != "linear":
        lines.append(f"robust loss: {loss}")
    for name, prior in fit.problem.priors.items():
        lines.append(f"prior of {name}: {float(prior.mean()):g} +- {float(prior.std()):g}")
    return lines


def _counted(fit: FitResult) -> str:
    """Return how residuals enter the sum, where that is not by their squares alone."""
    if fit.optimum.loss != "linear":
        return " (robust)"
    return "" if fit.problem.gaussian else " (after Student's t)"


def _solver(fit: FitResult) -> list[str]:
    return [
        f"{fit.method}, {fit.nfev} evaluations; {fit.ndata} numbers, {fit.nvarys} parameters",
        f"{fit.status.outcome}; AIC {fit.aic:.2f}, BIC {fit.bic:.2f}",
        f"sum of squares{_counted(fit)} {fit.chisqr:.5g}, over degrees of freedom {fit.redchi:.5g}",
    ]

"""Reports of a fit as text, HTML and plain data: first the verdict, then the numbers."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Iterator
from typing import Any

from dahl_ident.diagnostics.comparison import compare_models, is_compared
from dahl_ident.diagnostics.confidence_levels import level_text
from dahl_ident.diagnostics.formatting import interval, rounded, table
from dahl_ident.diagnostics.intervals import ConfidenceIntervals
from dahl_ident.results.fitted_model import FittedModel
from dahl_ident.units import counted

_CORRELATED = 0.1  # least correlation shown; smaller ones change an uncertainty by 0.5 %
_BRIEF = 15  # most lines of a short report


def facts(fit: FittedModel) -> dict[str, Any]:
    """Return a fit's statements as plain data, apart from its parameters."""
    budget = fit.stated_budget
    return {
        "status": str(fit.status),
        "trusted": fit.trusted,
        "verdict": fit.verdict,
        "findings": [finding.to_dict() for finding in fit.findings],
        "budget": None if budget is None else budget.to_dict(),
        "determined": [str(c) for c in fit.identifiability.combinations],
        "warnings": list(fit.goodness.warnings),
        **fit.assessment.facts,
    }


_Section = tuple[str, list[str]]  # a heading with its lines


def fit_report(fit: FittedModel, intervals: ConfidenceIntervals, *, details: bool = True) -> str:
    """Return the whole report as text, or verdict and parameters in at most 15 lines."""
    sections = _sections(fit, intervals)
    if details:
        return "\n".join(_lines(sections))
    title, verdict = next(sections)
    parameters = _parameters(fit, intervals, fit.problem.device_parameters)
    numbers = list(_lines([("Parameters", parameters)]))[: _BRIEF - 2]
    room = _BRIEF - 1 - len(numbers)
    if len(verdict) > room:
        verdict = [*verdict[: room - 1], f"({len(verdict) - room + 1} more statements)"]
    return "\n".join([*_lines([(title, verdict)]), *numbers])


def _lines(sections: Iterable[_Section]) -> Iterator[str]:
    for title, lines in sections:
        yield title
        yield from (f"    {line}" for line in lines)


def as_html(fit: FittedModel, intervals: ConfidenceIntervals) -> str:
    """Return the whole report as HTML."""
    parts = [(title, html.escape("\n".join(lines))) for title, lines in _sections(fit, intervals)]
    body = "".join(f"<h4>{title}</h4><pre>{lines}</pre>" for title, lines in parts)
    return f"<div>{body}</div>"


def _sections(fit: FittedModel, intervals: ConfidenceIntervals) -> Iterator[_Section]:
    first, *others = fit.statements
    warnings = [f"Warning: {text}." for text in fit.goodness.warnings]
    yield "Verdict", [first, *warnings, *others]
    yield "Parameters", _parameters(fit, intervals, fit.params)
    further = {
        "Further findings": list(map(str, fit.judgement.supporting)),
        "Determined combinations": list(map(str, fit.identifiability.combinations)),
        "Derived": list(map(str, fit.derived())),
        "Uncertainty budget": str(fit.stated_budget or "").splitlines(),
        "Correlations": _correlations(fit),
    }
    yield from ((title, lines) for title, lines in further.items() if lines)
    loss = fit.optimum.loss
    robust = [] if loss == "linear" else [f"robust loss: {loss}"]
    yield "Noise", [*fit.assessment.noise_in_words, *robust]
    yield "Goodness of fit", fit.goodness.details or ["no test applies"]
    if is_compared(fit):
        yield "Other models, for comparison", str(compare_models(fit)).splitlines()
    yield "Solver", _solver(fit)


def _parameters(
    fit: FittedModel, intervals: ConfidenceIntervals, names: Iterable[str]
) -> list[str]:
    level = float(intervals.levels[-1])
    rows = [["", "value", "stderr", "unit", f"{level_text(level)} ({intervals.method})", ""]]
    for name in names:
        p = fit.params[name]
        if not p.vary:
            shown = rounded(p.value, p.stderr) if p.stderr is not None else (f"{p.value:g}", "")
            within = interval(*intervals[name][-1][1:], "") if name in intervals else ""
            word = "assumed" if name in fit.assumed else "fixed"
            rows.append([name, *shown, p.unit, within, word])
            continue
        value, error = rounded(p.value, p.stderr)
        if math.isfinite(p.value) and p.stderr == math.inf and fit.nfree > 0:
            value = "?"  # undetermined
        within = ""
        if name in intervals:
            limits = intervals[name][-1]
            open_below = p.min == 0.0 and limits.lower == 0.0
            within = interval(-math.inf if open_below else limits.lower, limits.upper, "")
        known = fit.identifiability.parameters.get(name)
        word = "of the record" if known is None else known.verdict.value
        rows.append([name, value, error, p.unit, within, word])
    return [*table(rows, left=(0, 3, 4, 5)).splitlines(), f"({intervals.note})"]


def _correlations(fit: FittedModel) -> list[str]:
    names = fit.var_names[: fit.problem.n_reported]
    pairs = [
        (a, b, c)
        for i, a in enumerate(names)
        for b, c in fit.correl[a].items()
        if b in names[i + 1 :] and abs(c) >= _CORRELATED
    ]
    pairs.sort(key=lambda pair: -abs(pair[2]))
    return [f"{a}, {b}: {c:+.3f}" for a, b, c in pairs]


def _solver(fit: FittedModel) -> list[str]:
    assumed = [p for p in fit.problem.model.parameters if p.assumed]
    at_assumed = "".join(f", at {p.name} = {p.value:g}" for p in assumed)
    lines = [
        f"{fit.method}, {counted(fit.nfev, 'evaluation')}; {fit.ndata} numbers, "
        f"{counted(fit.nvarys, 'parameter')}",
        f"{fit.optimum.status.outcome}; AIC {fit.aic:.2f}, BIC {fit.bic:.2f}{at_assumed}",
    ]
    if fit.scale_known:  # chi-square is among the tests
        return lines
    robust = "" if fit.optimum.loss == "linear" else " (robust)"
    sums = f"{fit.chisqr:.5g}, over degrees of freedom {fit.redchi:.5g}"
    return [*lines, f"sum of squares{robust} {sums}"]

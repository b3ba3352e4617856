"""The tables of a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, level_text
from dahl_ident.diagnostics.formatting import degrees_text, interval, rounded, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.reporting.document import Cell, TextTable, number, words
from dahl_ident.results.changes import is_usable
from dahl_ident.results.posterior_result import QUANTILES
from dahl_ident.units import percent, prefix, si_unit

if TYPE_CHECKING:
    import pandas as pd

    from dahl_ident.arrays import FloatArray
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.diagnostics import ConfidenceIntervals
    from dahl_ident.diagnostics.bands import DerivedQuantity
    from dahl_ident.diagnostics.budget import Budget, ParameterBudget
    from dahl_ident.diagnostics.comparison import ModelComparison
    from dahl_ident.results import FitResult, Posterior

_LARGEST = 3  # sources of uncertainty on the first page
_ASSUMED = "assumed; u counts it"
_NO_PART = 1e-6  # share of the variance that the details leave out: a thousandth of u
_LINEARIZATION_ROWS = 9  # few enough to read, from the smallest amplitude to the largest


def answer(fit: FitResult) -> TextTable:
    """Return every free parameter with its interval; unusable numbers are struck."""
    limits = fit.conf_interval().at(CONFIDENCE)
    described = fit.status is not VerdictStatus.NOT_DESCRIBED
    of_device = fit.var_names[: fit.problem.n_reported]
    rows = []
    for name, p in fit.params.items():
        if name in fit.assumed and p.stderr is not None:
            stated = (*rounded(p.value, p.stderr), "-")
            numbers = (Cell(text, struck=not described) for text in stated)
            rows.append((Cell(name), *numbers, *words(p.unit or "-", p.description, _ASSUMED)))
        if name not in of_device:
            continue
        verdict, reason = fit.verdict_on(name)
        value, error = rounded(p.value, p.stderr)
        lost, limit = not verdict.known, limits[name]
        struck = lost or not described
        closed = lost and bool(np.isfinite([limit.lower, limit.upper]).all())  # a bound holds
        if not lost:
            reason = verdict.value
            if not described:
                reason = "the model does not describe the data: the interval is not valid"
            elif fit.status == VerdictStatus.APPROXIMATE:
                reason += "; u includes the misfit"
        rows.append(
            (
                Cell(name),
                Cell(value, p.value, struck) if np.isfinite(p.value) else Cell("none finite"),
                Cell(error, _finite(p.stderr), struck),
                Cell(interval(limit.lower, limit.upper, ""), struck=not described or closed),
                Cell(p.unit or "-"),
                Cell(p.description),
                Cell(reason),
            )
        )
    header = (
        "parameter", "estimate", "standard uncertainty u", f"{level_text(CONFIDENCE)} interval",
        "unit", "description", "what the data say",
    )  # fmt: skip
    crossed = any(cell.struck for row in rows for cell in row)
    hint = ". Numbers that are crossed out must not be used" if crossed else ""
    return TextTable(f"Estimates with their standard uncertainties{hint}", header, tuple(rows))


def uncertainty(stated: Budget) -> TextTable:
    """Return the combined uncertainty of every parameter with its largest sources."""
    rows = []
    for p in stated.parameters:
        shares = [(row.source, 100.0 * row.share) for row in p.rows[:_LARGEST] if row.u > 0.0]
        sources = [f"{source} {share:.0f} %" for source, share in shares if share >= 0.5]
        rows.append(
            (
                Cell(p.name), _rounded(p.value, p.u), _dof(p.dof), Cell(f"{p.k:.2f}", p.k),
                _expanded(p), Cell(p.unit or "-"), Cell(", ".join(sources) or "-"),
            )
        )  # fmt: skip
    header = (
        "parameter", "combined standard uncertainty u", "degrees of freedom", "k", "U = k u",
        "unit", "largest sources, share of the variance",
    )  # fmt: skip
    return TextTable(
        f"Expanded uncertainties U; k is for {level_text(CONFIDENCE)} coverage", header, tuple(rows)
    )


def budget(stated: Budget) -> TextTable:
    """Return every source of uncertainty of every parameter; the combined one comes first."""
    rows = []
    for p in stated.parameters:
        unit = p.unit or "-"
        rows.append(
            (
                Cell(p.name), Cell("combined"), Cell("-"), _rounded(p.value, p.u), Cell(unit),
                _dof(p.dof), Cell("100 %", 1.0), Cell(f"{p.k:.2f}", p.k), _expanded(p),
            )
        )  # fmt: skip
        rows += [
            (
                Cell(p.name),
                Cell(row.source),
                Cell(row.kind),
                _rounded(p.value, row.u),
                Cell(unit),
                _dof(row.dof),
                Cell(f"{100.0 * row.share:.0f} %", row.share),
                Cell("-"),
                Cell("-"),
            )
            for row in p.rows
            if row.share > _NO_PART
        ]
    header = (
        "parameter", "source", "type", "standard uncertainty u", "unit", "degrees of freedom",
        "share", "k", "U = k u",
    )  # fmt: skip
    return TextTable(
        f"Uncertainty budget; k is for {level_text(CONFIDENCE)} coverage", header, tuple(rows)
    )


def _rounded(value: float, u: float) -> Cell:
    """Return an uncertainty to two digits, written to the same place as its estimate."""
    return Cell(rounded(value, u)[1], u)


def _dof(dof: float) -> Cell:
    return Cell(degrees_text([dof]), dof if np.isfinite(dof) else None)


def priors_in_words(fit: FitResult) -> Iterator[tuple[str, str]]:
    """Yield each parameter with a prior, and the prior as a reader of a certificate knows it."""
    known: Mapping[str, Any] = fit.problem.priors
    for name, prior in known.items():
        unit = fit.params[name].unit
        if isinstance(prior, tuple):
            lower, upper = prior
            yield name, interval(lower, upper, unit)
        elif prior.dist.name == "norm":
            mean, std = (float(value) for value in (prior.mean(), prior.std()))
            yield name, f"normal, {with_unit(mean, std, unit)}"
        else:
            yield name, prior_text(prior)


def prior_text(prior: Any) -> str:
    """Return bounds or a frozen distribution as they are typed."""
    if isinstance(prior, tuple):
        return ":".join(map(repr, prior))
    arguments = [*map(repr, prior.args), *(f"{k}={v!r}" for k, v in prior.kwds.items())]
    return f"{prior.dist.name}({', '.join(arguments)})"


def parameters(
    fit: FitResult, intervals: Sequence[ConfidenceIntervals], drawn: Sequence[Posterior]
) -> TextTable:
    """Return every parameter with its intervals, one column a method."""
    at = [one.at(CONFIDENCE) for one in intervals]
    rows = []
    for name, estimate in fit.params.items():
        value, error = rounded(estimate.value, estimate.stderr)
        bad = name in fit.var_names and not is_usable(fit, name)
        lost = fit.status is VerdictStatus.NOT_DESCRIBED  # then no interval holds either
        row = [
            Cell(name),
            Cell(value, estimate.value, bad)
            if np.isfinite(estimate.value)
            else Cell("none finite"),
            Cell(error if estimate.vary else "fixed", _finite(estimate.stderr), bad),
            Cell(estimate.unit or "-"),
        ]
        if name in fit.assumed:
            row[1:3] = words(value, f"{error}, assumed")
        for method in at:
            limits = method.get(name)
            shown = interval(limits.lower, limits.upper, "") if limits else "-"
            row.append(Cell(shown, struck=bool(limits) and lost))
        row += [Cell(credible_interval(posterior, name)) for posterior in drawn]
        rows.append((*row, Cell(estimate.description)))
    methods = [*(method_name(one) for one in intervals), *("posterior" for _ in drawn)]
    columns = (f"{method} {level_text(CONFIDENCE)}" for method in methods)
    header = ("parameter", "estimate", "standard error", "unit", *columns, "description")
    return TextTable("Estimates and intervals, one column a method", header, tuple(rows))


def method_name(intervals: ConfidenceIntervals) -> str:
    """Return the name of a method in running text."""
    return "Wald" if intervals.method == "wald" else intervals.method


def credible_interval(posterior: Posterior, name: str) -> str:
    """Return the central interval of a posterior, rounded as the others are."""
    if name not in posterior.names:
        return "-"
    lower, upper = posterior.quantile(name, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return interval(float(lower), float(upper), "")


def posterior_summary(posterior: Posterior) -> TextTable:
    """Return the moments and quantiles of a posterior; struck if they must not be used."""
    summary = posterior.summary()
    columns = [name for name in summary.columns if name != "unit"]
    rows = tuple(
        (Cell(str(name)), Cell(str(row["unit"]) or "-"), *_moments(row))
        for name, row in summary.iterrows()
    )
    if not posterior.trusted:
        rows = tuple((*row[:2], *(replace(cell, struck=True) for cell in row[2:])) for row in rows)
    return TextTable("Posterior of each parameter", ("parameter", "unit", *columns), rows)


def _moments(row: pd.Series[Any]) -> Iterator[Cell]:
    """Yield the numbers of one parameter, rounded by its standard deviation."""
    std = float(row["std"])
    for name in ("mean", *QUANTILES):
        value, error = rounded(float(row[name]), std)
        yield Cell(value, float(row[name]))
        if name == "mean":
            yield Cell(error, std)
    for name, digits in (("mcse", 2), ("ess", 4), ("r_hat", 5)):
        if name in row:
            yield number(row[name], digits) if np.isfinite(row[name]) else Cell("-")


def linearization(fit: FitResult) -> TextTable | None:
    """Return equivalent stiffness, damping and loss of the friction against amplitude."""
    friction = any(element.has_memory for element in fit.model.elements)
    if not friction or not all(np.isfinite(e.value) for e in fit.params.values()):
        return None
    problem = fit.problem
    A, rates = (problem.unit_sizes(unit) for unit in ((0, 1, 0), (0, 0, -1)))
    sizes = np.geomspace(A.min(), A.max(), _LINEARIZATION_ROWS if A.max() > A.min() else 1)
    f = float(np.median(rates)) / (2.0 * np.pi)
    columns = dict([_column("amplitude", sizes, si_unit("displacement", problem.motion))])
    derived: dict[str, list[DerivedQuantity]] = {}
    for quantity in fit.derived(sizes.tolist(), f):
        if quantity.amplitude is not None:
            derived.setdefault(quantity.name, []).append(quantity)
    lost = fit.status is VerdictStatus.NOT_DESCRIBED
    for name, along in derived.items():
        power, unit = prefix([quantity.value for quantity in along], along[0].unit)
        texts = (rounded(q.value / power, q.stderr / power) for q in along)
        columns[f"{name} [{unit}]"] = [
            Cell(f"{value} \u00b1 {error}", q.value / power, lost)
            for (value, error), q in zip(texts, along, strict=True)
        ]
    rows = tuple(zip(*columns.values(), strict=True))
    caption = f"Friction as an equivalent spring and damper (damping at {f:.4g} Hz)"
    return TextTable(caption, tuple(columns), rows)


def comparison(compared: ModelComparison) -> TextTable:
    """Return models side by side."""
    rows = tuple(
        (*map(Cell, row), Cell(model.estimates))
        for row, model in zip(compared.rows, compared.models, strict=True)
    )
    return TextTable("Models compared", (*compared.columns, "estimates"), rows)


def meanings(compared: ModelComparison) -> TextTable:
    """Return what means the same in every law."""
    rows = tuple(tuple(map(Cell, row)) for row in compared.meanings)
    columns = ("model", *compared.common)
    return TextTable("Quantities common to all laws", columns, rows)


def measured(data: FrequencyResponse) -> TextTable:
    """Return the data as used in the fit."""
    columns: list[tuple[str, list[Cell]]] = [
        ("frequency [Hz]", [number(v, 5) for v in data.frequency_hz])
    ]
    if data.level is not None:
        numbered = data.level.dtype.kind in "fiu"
        labels = [number(v) if numbered else Cell(str(v)) for v in data.level]
        columns.append(("level", labels))
    for name, kind in (("amplitude", "displacement"), ("drive", "force")):
        values = getattr(data, name)
        if values is not None:
            columns.append(_column(name, values, si_unit(kind, data.motion)))
    columns += [
        (f"gain [{data.unit}]", [number(v, 5) for v in data.gain]),
        ("phase [deg]", [number(v, 4) for v in np.degrees(data.phase)]),
    ]
    if (data.harmonic != 1).any():
        columns.append(("harmonic", [Cell(str(k), float(k)) for k in data.harmonic]))
    return _of_columns("The points as they were fitted", columns)


def extraction(data: FrequencyResponse) -> TextTable:
    """Return how each point was measured from its waveforms."""
    points = data.select(harmonic=1)
    quality = points.quality
    assert points.amplitude is not None  # extraction measures it
    bias = np.hypot(quality["bias_real"], quality["bias_imag"]) / points.gain
    clipped = np.maximum(quality["displacement_clipped"], quality["force_clipped"])
    percents = {
        "bias [%]": bias,
        "harmonics of displacement [%]": quality["displacement_distortion"],
        "sine in power of force [%]": quality["force_share"],
        "clipped samples [%]": clipped,
    }
    columns = [
        ("frequency [Hz]", [number(v, 5) for v in points.frequency_hz]),
        _column("amplitude", points.amplitude, si_unit("displacement", points.motion)),
        ("cycles", [number(v) for v in quality["num_periods"]]),
        ("left out", [number(v) for v in quality["settling_periods"]]),
        ("cycles missing", [number(v) for v in quality["more_periods"]]),
        *((name, [number(100.0 * v, 3) for v in values]) for name, values in percents.items()),
        ("verdict", [Cell(str(v)) for v in quality["verdict"]]),
    ]
    return _of_columns("Quality of each point", columns)


def _column(name: str, values: FloatArray, unit: str) -> tuple[str, list[Cell]]:
    """Return a column of numbers with the prefix of its unit that suits them."""
    power, unit = prefix(values, unit)
    return f"{name} [{unit}]", [number(v / power) for v in values]


def _of_columns(caption: str, columns: Sequence[tuple[str, Sequence[Cell]]]) -> TextTable:
    rows = tuple(zip(*(cells for _, cells in columns), strict=True))
    return TextTable(caption, tuple(name for name, _ in columns), rows)


def goodness(fit: FitResult) -> TextTable:
    """Return the numbers that say how well the model describes the data."""
    scale, sums = "known", []
    if not fit.scale_known:  # else chi-square stands among the tests
        scale = f"{fit.scale:.4g}, estimated"
        sums = [
            (Cell("sum of squares"), number(fit.chisqr)),
            (Cell("sum of squares over degrees of freedom"), number(fit.redchi)),
        ]
    rows = [
        words("data (real numbers)", f"{fit.ndata}"),
        words("degrees of freedom", f"{fit.nfree}"),
        words("rms misfit", percent(fit.goodness.rms_misfit)),
        *sums,
        words("noise scale", scale),
        (Cell("AIC"), number(fit.aic, 6)),
        (Cell("BIC"), number(fit.bic, 6)),
    ]
    return TextTable("Goodness of fit", ("measure", "value"), tuple(rows))


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def _expanded(stated: ParameterBudget) -> Cell:
    """Return U, or the interval where that is not value ± U."""
    return Cell(stated.expanded, stated.U if stated.limits is None else None)

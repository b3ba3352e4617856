"""The tables of a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dahl_ident.diagnostics.confidence_levels import CONFIDENCE, level_text
from dahl_ident.diagnostics.formatting import degrees_text, interval, rounded, with_unit
from dahl_ident.diagnostics.judgement import VerdictStatus
from dahl_ident.reporting.document import Cell, Row, TextTable, estimated, number, words
from dahl_ident.results.changes import is_usable
from dahl_ident.units import percent, prefix, si_unit

if TYPE_CHECKING:
    from dahl_ident.arrays import FloatArray
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.diagnostics import ConfidenceIntervals
    from dahl_ident.diagnostics.bands import DerivedQuantity
    from dahl_ident.diagnostics.budget import Budget, ParameterBudget
    from dahl_ident.diagnostics.comparison import ModelComparison
    from dahl_ident.results import FitResult, Posterior

_LARGEST = 3  # number of sources of uncertainty on the first page
_ASSUMED = "assumed; u counts it"
_NEGLIGIBLE = 1e-6  # share of the variance: a thousandth of u
_DIGITS = {"mcse": 2, "ess": 4, "r_hat": 5}
_LINEARIZATION_ROWS = 9  # amplitudes, from the smallest to the largest


def answer(fit: FitResult) -> TextTable:
    """Return every estimated parameter with its interval; numbers not to be used are struck."""
    limits = fit.conf_interval().at(CONFIDENCE)
    described = fit.status is not VerdictStatus.NOT_DESCRIBED
    of_device = fit.var_names[: fit.problem.n_reported]
    rows: list[Row] = []
    for name, p in fit.params.items():
        is_assumed = name in fit.assumed and p.stderr is not None
        if not is_assumed and name not in of_device:
            continue
        lower, upper = limits[name].lower, limits[name].upper
        known, meaning = True, _ASSUMED
        if not is_assumed:
            judged = fit.identifiability.parameters[name]
            known, meaning = judged.verdict.known, judged.reason
            if known and not described:
                meaning = "the model does not describe the data: the interval is not valid"
            elif known and fit.status is VerdictStatus.APPROXIMATE:
                meaning = f"{judged.verdict.value}; u includes the misfit"
            elif known:
                meaning = judged.verdict.value
        struck = not (known and described)
        # for an undetermined parameter a one-sided limit is valid, a closed interval is not
        closed = bool(np.isfinite([lower, upper]).all())
        invalid = not described or (not known and closed)
        value, error = rounded(p.value, p.stderr)
        rows.append(
            {
                "parameter": name,
                "estimate": estimated(p.value, value, struck=struck),
                "standard uncertainty u": Cell(error, _finite(p.stderr), struck),
                f"{level_text(CONFIDENCE)} interval": Cell(
                    interval(lower, upper, ""), struck=invalid
                ),
                "unit": p.unit or "-",
                "description": p.description,
                "what the data say": meaning,
            }
        )
    crossed = any(isinstance(cell, Cell) and cell.struck for row in rows for cell in row.values())
    hint = ". Numbers that are crossed out must not be used" if crossed else ""
    return TextTable.of(f"Estimates with their standard uncertainties{hint}", rows)


def uncertainty(stated: Budget) -> TextTable:
    """Return the combined uncertainty of every parameter with its largest sources."""
    rows: list[Row] = []
    for p in stated.parameters:
        shares = [(row.source, 100.0 * row.share) for row in p.rows[:_LARGEST] if row.u > 0.0]
        largest = ", ".join(f"{source} {share:.0f} %" for source, share in shares if share >= 0.5)
        rows.append(
            {
                "parameter": p.name,
                "combined standard uncertainty u": _rounded(p.value, p.u),
                "degrees of freedom": _dof(p.dof),
                "k": Cell(f"{p.k:.2f}", p.k),
                "U = k u": _expanded(p),
                "unit": p.unit or "-",
                "largest sources, share of the variance": largest or "-",
            }
        )
    coverage = level_text(CONFIDENCE)
    return TextTable.of(f"Expanded uncertainties U; k is for {coverage} coverage", rows)


def budget(stated: Budget) -> TextTable:
    """Return every source of uncertainty of every parameter; the combined one comes first."""
    rows: list[Row] = []
    for p in stated.parameters:
        combined = ("combined", "-", p.u, p.dof, 1.0)
        for part in (combined, *(tuple(vars(row).values()) for row in p.rows)):
            source, kind, u, dof, share = part
            if share > _NEGLIGIBLE:
                rows.append(
                    {
                        "parameter": p.name,
                        "source": source,
                        "type": kind,
                        "standard uncertainty u": _rounded(p.value, u),
                        "unit": p.unit or "-",
                        "degrees of freedom": _dof(dof),
                        "share": Cell(f"{100.0 * share:.0f} %", share),
                        "k": Cell(f"{p.k:.2f}", p.k) if part is combined else "-",
                        "U = k u": _expanded(p) if part is combined else "-",
                    }
                )
    return TextTable.of(f"Uncertainty budget; k is for {level_text(CONFIDENCE)} coverage", rows)


def _rounded(value: float, u: float) -> Cell:
    """Return an uncertainty with two digits, rounded like its estimate."""
    return Cell(rounded(value, u)[1], u)


def _dof(dof: float) -> Cell:
    return Cell(degrees_text([dof]), dof if np.isfinite(dof) else None)


def priors_in_words(fit: FitResult) -> Iterator[tuple[str, str]]:
    """Yield each parameter with a prior, and the prior in words."""
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
    """Return bounds or a frozen distribution as a user would type them."""
    if isinstance(prior, tuple):
        return ":".join(map(repr, prior))
    arguments = [*map(repr, prior.args), *(f"{k}={v!r}" for k, v in prior.kwds.items())]
    return f"{prior.dist.name}({', '.join(arguments)})"


def parameters(
    fit: FitResult, intervals: Sequence[ConfidenceIntervals], posteriors: Sequence[Posterior]
) -> TextTable:
    """Return every parameter with its intervals, one column for each method."""
    by_method = [of_method.at(CONFIDENCE) for of_method in intervals]
    invalid = fit.status is VerdictStatus.NOT_DESCRIBED
    rows = []
    for name, p in fit.params.items():
        value, error = rounded(p.value, p.stderr)
        struck = name in fit.identifiability.parameters and not is_usable(fit, name)
        shown = estimated(p.value, value, struck=struck)
        u = Cell(error if p.vary else "fixed", _finite(p.stderr), struck)
        if name in fit.assumed:
            shown, u = words(value, f"{error}, assumed")
        within = []
        for limits in (of_method.get(name) for of_method in by_method):
            text = interval(limits.lower, limits.upper, "") if limits else "-"
            within.append(Cell(text, struck=bool(limits) and invalid))
        within += [Cell(credible_interval(posterior, name)) for posterior in posteriors]
        rows.append((Cell(name), shown, u, Cell(p.unit or "-"), *within, Cell(p.description)))
    methods = [*map(method_name, intervals), *["posterior"] * len(posteriors)]
    columns = (f"{method} {level_text(CONFIDENCE)}" for method in methods)
    header = ("parameter", "estimate", "standard error", "unit", *columns, "description")
    return TextTable("Estimates and intervals, one column a method", header, tuple(rows))


def method_name(intervals: ConfidenceIntervals) -> str:
    """Return the name of a method in running text."""
    return "Wald" if intervals.method == "wald" else intervals.method


def credible_interval(posterior: Posterior, name: str) -> str:
    """Return the central interval of a posterior."""
    if name not in posterior.names:
        return "-"
    lower, upper = posterior.quantile(name, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return interval(float(lower), float(upper), "")


def posterior_summary(posterior: Posterior) -> TextTable:
    """Return the moments and quantiles of a posterior; struck if they must not be used."""
    lost = not posterior.trusted
    rows: list[Row] = []
    for name, statistics in posterior.summary().iterrows():
        row: Row = {"parameter": str(name), "unit": str(statistics["unit"]) or "-"}
        for column in statistics.index.drop("unit"):
            value = float(statistics[column])
            text = rounded(value, float(statistics["std"]))[0]
            if column == "std":
                text = rounded(float(statistics["mean"]), value)[1]
            elif column in _DIGITS:
                text = f"{value:.{_DIGITS[column]}g}" if np.isfinite(value) else "-"
            row[str(column)] = Cell(text, _finite(value), struck=lost)
        rows.append(row)
    return TextTable.of("Posterior of each parameter", rows)


def linearization(fit: FitResult) -> TextTable | None:
    """Return equivalent stiffness, damping and loss of the friction over amplitude."""
    friction = any(element.has_memory for element in fit.model.elements)
    if not friction or not all(np.isfinite(e.value) for e in fit.params.values()):
        return None
    problem = fit.problem
    A, rates = (problem.unit_sizes(unit) for unit in ((0, 1, 0), (0, 0, -1)))
    sizes = np.geomspace(A.min(), A.max(), _LINEARIZATION_ROWS if A.max() > A.min() else 1)
    f = float(np.median(rates)) / (2.0 * np.pi)
    columns = _column("amplitude", sizes, si_unit("displacement", problem.motion))
    derived: dict[str, list[DerivedQuantity]] = {}
    for quantity in fit.derived(sizes.tolist(), f):
        if quantity.amplitude is not None:
            derived.setdefault(quantity.name, []).append(quantity)
    lost = fit.status is VerdictStatus.NOT_DESCRIBED
    for name, quantities in derived.items():
        power, unit = prefix([q.value for q in quantities], quantities[0].unit)
        texts = (rounded(q.value / power, q.stderr / power) for q in quantities)
        columns[f"{name} [{unit}]"] = [
            Cell(f"{value} \u00b1 {error}", q.value / power, lost)
            for (value, error), q in zip(texts, quantities, strict=True)
        ]
    caption = f"Friction as an equivalent spring and damper (damping at {f:.4g} Hz)"
    return _of_columns(caption, columns)


def comparison(compared: ModelComparison) -> Iterator[TextTable]:
    """Yield the models side by side, and the quantities common to all laws."""
    rows = zip(compared.rows, compared.models, strict=True)
    cells = tuple(words(*row, model.estimates) for row, model in rows)
    yield TextTable("Models compared", (*compared.columns, "estimates"), cells)
    cells = tuple(words(*row) for row in compared.meanings)
    yield TextTable("Quantities common to all laws", ("model", *compared.common), cells)


def measured(data: FrequencyResponse) -> TextTable:
    """Return the data as used in the fit."""
    columns = {"frequency [Hz]": [number(v, 5) for v in data.frequency_hz]}
    if data.level is not None:
        numbered = data.level.dtype.kind in "fiu"
        columns["level"] = [number(v) if numbered else Cell(str(v)) for v in data.level]
    for name, kind in (("amplitude", "displacement"), ("drive", "force")):
        values = getattr(data, name)
        if values is not None:
            columns |= _column(name, values, si_unit(kind, data.motion))
    columns[f"gain [{data.unit}]"] = [number(v, 5) for v in data.gain]
    columns["phase [deg]"] = [number(v, 4) for v in np.degrees(data.phase)]
    if (data.harmonic != 1).any():
        columns["harmonic"] = [Cell(str(k), float(k)) for k in data.harmonic]
    return _of_columns("The points as they were fitted", columns)


def extraction(data: FrequencyResponse) -> TextTable:
    """Return how each point was measured from its waveforms."""
    points = data.select(harmonic=1)
    quality = points.quality
    assert points.amplitude is not None  # extraction measures it
    counts = {
        "cycles": "num_periods",
        "left out": "settling_periods",
        "cycles missing": "more_periods",
    }
    percents = {
        "bias [%]": np.hypot(quality["bias_real"], quality["bias_imag"]) / points.gain,
        "harmonics of displacement [%]": quality["displacement_distortion"],
        "sine in power of force [%]": quality["force_share"],
        "clipped samples [%]": np.maximum(
            quality["displacement_clipped"], quality["force_clipped"]
        ),
    }
    columns = {
        "frequency [Hz]": [number(v, 5) for v in points.frequency_hz],
        **_column("amplitude", points.amplitude, si_unit("displacement", points.motion)),
        **{name: [number(v) for v in quality[column]] for name, column in counts.items()},
        **{name: [number(100.0 * v, 3) for v in values] for name, values in percents.items()},
        "verdict": [Cell(str(v)) for v in quality["verdict"]],
    }
    return _of_columns("Quality of each point", columns)


def _column(name: str, values: FloatArray, unit: str) -> dict[str, list[Cell]]:
    """Return a column of numbers, with a suitable prefix of its unit."""
    power, unit = prefix(values, unit)
    return {f"{name} [{unit}]": [number(v / power) for v in values]}


def _of_columns(caption: str, columns: Mapping[str, Sequence[Cell]]) -> TextTable:
    return TextTable(caption, tuple(columns), tuple(zip(*columns.values(), strict=True)))


def goodness(fit: FitResult) -> TextTable:
    """Return statistics of the goodness of fit."""
    rows: Row = {
        "data (real numbers)": f"{fit.ndata}",
        "degrees of freedom": f"{fit.nfree}",
        "rms misfit": percent(fit.goodness.rms_misfit),
    }
    if not fit.scale_known:  # otherwise chi-square is among the tests
        rows["sum of squares"] = number(fit.chisqr)
        rows["sum of squares over degrees of freedom"] = number(fit.redchi)
    rows["noise scale"] = "known" if fit.scale_known else f"{fit.scale:.4g}, estimated"
    assumed = [p for p in fit.problem.model.parameters if p.assumed]
    at_assumed = "".join(f" at {p.name} = {p.value:g}" for p in assumed)
    rows |= {f"AIC{at_assumed}": number(fit.aic, 6), f"BIC{at_assumed}": number(fit.bic, 6)}
    listed = [{"measure": name, "value": cell} for name, cell in rows.items()]
    return TextTable.of("Goodness of fit", listed)


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def _expanded(stated: ParameterBudget) -> Cell:
    """Return U, or the interval if it is not value ± U."""
    return Cell(stated.expanded, stated.U if stated.limits is None else None)

"""Numbers with their uncertainty: GTC, uncertainties, LaTeX, draws."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from dahl_ident.arrays import FloatArray, whole_number
from dahl_ident.data.storage import inert, library, place_of
from dahl_ident.diagnostics.budget import ParameterBudget
from dahl_ident.diagnostics.formatting import pair, symbol, tabular, unit
from dahl_ident.errors import FitError

_UNCERTAIN = 0.2  # relative uncertainty above which the logarithm of a positive parameter is drawn


def uncertain(result: Any) -> tuple[dict[str, ParameterBudget], FloatArray]:
    """Return the budgets of the model's free parameters, and the covariance of their values."""
    budget = result.budget()
    free = {p.name for p in result.model.parameters if result.params[p.name].vary}
    kept = [i for i, name in enumerate(budget) if name in free]
    stated = {name: part for name, part in budget.items() if name in free}
    covariance = np.asarray(budget.covariance)[np.ix_(kept, kept)]
    if set(stated) != free or not np.all(np.isfinite(covariance)):
        lost = sorted(free - set(stated)) or sorted(free)
        raise FitError(f"{', '.join(lost)} has no finite uncertainty to export; see the verdict")
    return stated, covariance


def gtc_archive(result: Any) -> str:
    """Return an archive of GTC: each parameter as the sum of its sources.

    Each source has the correlation of two parameters that the budget has for all sources together.
    """
    gtc, persistence = library("GTC", "exports"), library("GTC.persistence", "exports")
    budget, covariance = uncertain(result)
    parts = {name: {row.source: row for row in p.rows if row.u > 0.0} for name, p in budget.items()}
    names = list(budget)
    u = np.array(
        [[parts[n][s].u if s in parts[n] else 0.0 for n in names] for s in _sources(parts)]
    )
    shared = u.T @ u
    totals = [budget[name].value for name in names]
    for source, sizes in zip(_sources(parts), u, strict=True):
        nonzero = [i for i, size in enumerate(sizes) if size > 0.0]
        dof = min(parts[names[i]][source].dof for i in nonzero)
        labels = [f"{names[i]}: {source}" for i in nonzero]
        errors = gtc.multiple_ureal([0.0] * len(nonzero), sizes[nonzero].tolist(), dof, labels)
        for a, i in enumerate(nonzero):
            for b in range(a):
                r = covariance[i, nonzero[b]] / shared[i, nonzero[b]]
                gtc.set_correlation(float(np.clip(r, -1.0, 1.0)), errors[a], errors[b])
            totals[i] = totals[i] + errors[a]
    archive = persistence.Archive()
    archive.add(**{n: gtc.result(total, label=n) for n, total in zip(names, totals, strict=True)})
    return str(persistence.dumps_json(archive)) + "\n"


def _sources(parts: dict[str, dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(source for rows in parts.values() for source in rows))


def ufloat(result: Any) -> str:
    """Return a Python file with correlated numbers."""
    budget, covariance = uncertain(result)
    fixed = {p.name: p.value for p in result.model.parameters if p.name not in budget}
    return "\n".join(
        [
            f"# the fit is {result.status.value}",
            "from uncertainties import correlated_values",
            "",
            *(f"{name} = {value!r}  # fixed" for name, value in fixed.items()),
            f"{', '.join(budget)}, = correlated_values(",
            f"    {[float(p.value) for p in budget.values()]},",
            f"    {covariance.tolist()},",
            ")",
            "",
        ]
    )


def latex(result: Any) -> str:
    """Return a table of values with their expanded uncertainties."""
    try:
        budget = result.budget()
    except FitError:  # there is no finite uncertainty
        budget = {}
    rows, values = [], {p.name: p.value for p in result.model.parameters}
    for name, p in result.params.items():
        part = budget.get(name)
        k = "" if part is None else f"{part.k:.2f}"
        U = None if part is None else part.U
        rows.append((symbol(name), *pair(values.get(name, p.value), U), k, unit(p.unit)))
    return tabular(("", "value", "$U$", "$k$", "unit"), rows)


def draws(result: Any, size: int, seed: int, path: str | Path | None) -> bytes:
    """Return draws of the model's parameters, as CSV, or as Parquet for such a path.

    They are those of a posterior; for a fit they are normal with its covariance, in the logarithm
    of positive parameters of more than 20 % uncertainty.
    """
    import pandas as pd

    count, seed = whole_number(size, "size", 1), whole_number(seed, "seed", 0, np.inf)
    if hasattr(result, "draws"):
        table = dict(zip(result.names, result.draws(count, seed).T, strict=True))
        table = {name: table[name] for name in result.params if name in table}
    else:
        table = _normal(result, count, seed)
        values = {p.name: p.value for p in result.model.parameters}
        table = {name: table.get(name, np.full(count, value)) for name, value in values.items()}
    units = {name: result.params[name].unit for name in table}
    frame = pd.DataFrame(
        {f"{n} [{units[n]}]" if units[n] else n: drawn for n, drawn in table.items()}
    )
    place = None if path is None else place_of(path, "a table of draws", (".csv", ".parquet"))
    if place is None or place.suffix.lower() == ".csv":
        return inert(frame).to_csv(index=False, lineterminator="\n", float_format="%.10g").encode()
    library("pyarrow", "parquet")
    buffer = io.BytesIO()
    frame.to_parquet(buffer, engine="pyarrow", index=False)
    return buffer.getvalue()


def _normal(result: Any, size: int, seed: int) -> dict[str, FloatArray]:
    budget, covariance = uncertain(result)
    values, u = (np.array([getattr(p, name) for p in budget.values()]) for name in ("value", "u"))
    positive = np.array([result.params[name].min == 0.0 for name in budget])
    wide = positive & (u > _UNCERTAIN * np.abs(values))
    scale = np.where(wide, 1.0 / np.where(wide, values, 1.0), 1.0)
    errors = np.random.default_rng(seed).multivariate_normal(
        np.zeros(values.size), covariance * np.outer(scale, scale), size, method="eigh"
    )
    drawn = np.where(wide, values * np.exp(np.where(wide, errors, 0.0)), values + errors)
    return dict(zip(budget, drawn.T, strict=True))

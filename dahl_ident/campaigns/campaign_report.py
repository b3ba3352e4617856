"""Report on a campaign: the population, outlying devices and failures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from dahl_ident.campaigns.population import (
    USABLE,
    Population,
    PopulationParameter,
    assumed_in,
    unit_in,
)
from dahl_ident.diagnostics.formatting import rounded
from dahl_ident.reporting.document import (
    Block,
    Bullets,
    Cell,
    Document,
    Paragraph,
    Picture,
    Section,
    TextTable,
    number,
)

if TYPE_CHECKING:
    import pandas as pd

FORMATS = (".html", ".pdf")
_LISTED = 200
"""Fits whose rows are printed; all of them are in the table of results."""


def campaign_document(
    table: pd.DataFrame, evaluated: Population | None, title: str, reports: str
) -> Document:
    """Return the report's content; links to the fits' reports point into the folder `reports`."""
    statuses = table["status"].value_counts()
    counted = ", ".join(f"{count} {status}" for status, count in statuses.items())
    verdict = [f"{len(table)} fits of {table['device'].nunique()} devices: {counted}."]
    sections = []
    status = "not determined"
    if evaluated is not None:
        status = "trusted" if (table["status"] == "trusted").all() else "approximate"
        for p in evaluated.parameters.values():
            verdict.append(f"{'; '.join(str(p).splitlines())}.")
            sections.append(Section(f"Population: {p.name}", tuple(_population_blocks(p))))
    else:
        verdict.append("Too few devices have usable results: there is no population.")
    sections.append(Section("Fits that cannot be used", (_unusable(table),)))
    sections.append(Section("All fits", tuple(_all_fits(table, reports))))
    facts = {"statuses": {str(k): int(v) for k, v in statuses.items()}}
    return Document(title, status, tuple(verdict), tuple(sections), facts=facts)


def _population_blocks(p: PopulationParameter) -> Iterator[Block]:
    label = f"{p.name} [{p.unit}]" if p.unit else p.name
    measured = f"ln {p.name}" if p.logarithmic else label
    scatters = {"devices": p.between_devices, "runs": p.between_runs}
    yield TextTable(
        f"Scatter of {measured}",
        ("source", "median", "2.3 %", "97.7 %"),
        tuple(
            (Cell(f"scatter between {groups}"), *(number(x, 3) for x in scatter))
            for groups, scatter in scatters.items()
            if scatter[0] or groups == "devices"
        ),
    )

    def devices() -> object:
        from dahl_ident.plots import plot_devices

        return plot_devices(p.devices, p.mean[0], label=label)

    def charts() -> object:
        from dahl_ident.plots import plot_control_charts

        order = "in order of time" if p.ordered else "in the order of the table"
        return plot_control_charts(p.fits, label=measured, x_label=f"fit, {order}")

    outlying = ", ".join(p.outlying) or "none"
    drift = " and EWMA chart" if p.ordered else "; no order in time is stated, so no EWMA chart"
    comparison = ""
    if len(p.devices) < len(p.fits):
        single = int(p.fits["value"].isna().sum())
        comparison = "; each fit is compared with the others of its device"
        if single:
            comparison += f", so that {single} devices with a single fit are not shown"
    yield Picture(
        f"devices_{p.name}",
        f"{p.name} of each device: own estimate, and estimate shrunk towards the population",
        f"{len(p.devices)} devices around {p.mean[0]:.4g}; outside the population: {outlying}",
        devices,
    )
    yield Picture(
        f"charts_{p.name}",
        f"Individuals (limits: three standard deviations from moving ranges){drift}, corrected for "
        f"covariates{comparison}",
        f"{len(p.out_of_control)} of {len(p.fits)} fits lie outside the limits",
        charts,
    )


def _unusable(table: pd.DataFrame) -> Block:
    bad = table[~table["status"].isin(USABLE)]
    if bad.empty:
        return Paragraph("None.")
    reasons = bad["error"].fillna("") if "error" in bad else bad["status"]
    if "statements" in bad:
        reasons = reasons.where(reasons != "", bad["statements"].fillna(""))
    rows = zip(bad["device"][:_LISTED], bad["status"], reasons, strict=False)
    return Bullets(tuple(f"{device}: {status}. {reason}" for device, status, reason in rows))


def _all_fits(table: pd.DataFrame, folder: str) -> Iterator[Block]:
    assumed = assumed_in(table)
    names = sorted((str(c) for c in table if f"u_{c}" in table), key=assumed.__contains__)
    labels = [c for c in ("device", "run") if c in table]
    rows = []
    for _, row in table.head(_LISTED).iterrows():
        cells = [Cell(str(row[c])) for c in (*labels, "status")]
        if "report" in table and isinstance(row["report"], str):
            cells[0] = Cell(cells[0].text, link=f"{folder}/{row['report']}")
        for name in names:
            value, u = float(row[name]), float(row[f"u_{name}"])
            texts = rounded(value, u)
            cells += [
                Cell(text, x) if np.isfinite(x) else Cell("-")
                for text, x in zip(texts, (value, u), strict=True)
            ]
        rows.append(tuple(cells))
    units = {c: unit_in(table, c) for c in names}
    header = [h for c in names for h in (f"{c} [{units[c]}]" if units[c] else c, "u")]
    yield TextTable(
        "Estimates and combined standard uncertainties", (*labels, "status", *header), tuple(rows)
    )
    if len(table) > _LISTED:
        yield Paragraph(f"{len(table) - _LISTED} more fits are in the table of results.")

"""``dahl-ident campaign``: many devices, one table."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dahl_ident.cli import console
from dahl_ident.cli.options import General, Laws, Writing, option, with_option_groups
from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    from dahl_ident.campaigns.definition import Definition

_LINE_EVERY = 60.0
"""Seconds between lines of progress where there is no terminal."""


@with_option_groups
def campaign(
    general: General,
    laws: Laws,
    writing: Writing,
    definition: Annotated[Path, typer.Argument(help="TOML file that defines the campaign.")],
    jobs: Annotated[int | None, option("Processes; by default as many as processors.")] = None,
    scheduler: Annotated[
        str | None, option("Address of a Dask scheduler, tls://host:port.")
    ] = None,
    timeout: Annotated[
        float | None,
        option("Longest time for a device; by default 10 medians, at least 60 s.", unit="s"),
    ] = None,
    memory: Annotated[
        float | None, option("Most memory for a device, GB; by default a fair share.")
    ] = None,
    patience: Annotated[
        float, option("Longest time without an answer of the scheduler.", unit="s")
    ] = 120.0,
    send_files: Annotated[
        bool, option("Send workers the contents of files, not paths.", "--send-files")
    ] = False,
    report: Annotated[Path | None, option("Report on the whole campaign: .html or .pdf.")] = None,
    covariate: Annotated[
        list[str], option("Column on which parameters may depend; repeatable.")
    ] = [],  # noqa: B006 - typer takes lists as lists
    order: Annotated[
        str | None, option("Column that orders fits in time, for control charts.")
    ] = None,
    dry_run: Annotated[bool, option("List what would be done.", "--dry-run")] = False,
    redo: Annotated[bool, option("Repeat all fits if options have changed.", "--redo")] = False,
) -> None:
    """Read, extract and fit the files of many devices into one table.

    An interrupted campaign continues where it stopped; a changed file is fitted again.

    Example: dahl-ident campaign campaign.toml --jobs 4 --report campaign.html
    """
    from dahl_ident.campaigns.definition import read_definition
    from dahl_ident.campaigns.population import USABLE
    from dahl_ident.campaigns.run import campaign as run_campaign

    laws.run()
    read = read_definition(definition)
    _check_report(report, writing.overwrite, covariate, order, read)
    with console.busy("fits") as show:
        update = show if sys.stderr.isatty() else _lines()
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # this command says it itself
        done = run_campaign(
            definition, jobs=jobs, scheduler=scheduler, timeout=timeout, memory=memory,
            patience=patience, send_files=send_files, dry_run=dry_run, redo=redo,
            progress=lambda number, total, _: update(number, total),
        )  # fmt: skip
    if report is not None and not dry_run:
        place = done.report(
            report,
            covariates=covariate,
            order=order,
            title=definition.stem,
            overwrite=writing.overwrite,
        )
        console.note(f"report: {place}")
    if general.json:
        facts = {"finished": list(done.finished), "to_do": list(done.to_do)}
        console.write_json({**facts, "statuses": dict(done.statuses), "folder": str(done.folder)})
    else:
        if dry_run:
            for name in done.to_do:
                console.write(f"to do: {name}")
        console.write(str(done))
        if not dry_run:
            console.write(f"table: {done.folder / 'results.csv'}")
    usable = any(status in USABLE for status in done.statuses)
    console.finish(dry_run or usable, "no fit can be used; the table says why")


def _check_report(
    report: Path | None, overwrite: bool, covariates: list[str], order: str | None, read: Definition
) -> None:
    """Refuse, before anything runs, what the report could not be made from."""
    from dahl_ident.campaigns.campaign_report import FORMATS
    from dahl_ident.data.storage import place_of, refuse_existing

    if report is None:
        if covariates or order:
            raise ValidationError("--covariate and --order are for a report; give --report as well")
        return
    place_of(report, "a campaign's report", FORMATS)
    if not overwrite:
        refuse_existing(report)
    if not report.parent.is_dir():
        raise ValidationError(f"--report {report}: there is no folder {report.parent}")
    known = set.intersection(*(set(task.covariates) for task in read.tasks))
    for name, choice in [*(("--covariate", c) for c in covariates), ("--order", order)]:
        if choice is not None and choice not in known | ({"run"} if name == "--order" else set()):
            there = ", ".join(sorted(known)) or "none"
            raise ValidationError(f"{name} {choice}: the fits have the covariates {there}")
    for column in covariates:
        texts = [v for task in read.tasks if isinstance(v := task.covariates[column], str)]
        if texts:
            raise ValidationError(f"--covariate {column} is {texts[0]!r}; expected numbers")
    unused = sorted(
        name
        for name in known - set(covariates)
        if name != order and all(not isinstance(task.covariates[name], str) for task in read.tasks)
    )
    if unused:
        console.note(
            f"the report does not use {', '.join(unused)}; --covariate {unused[0]} states how "
            "parameters depend on it"
        )


def _lines() -> Callable[[int, int], None]:
    """Print rate and time left once a minute, for logs."""
    began = shown = time.monotonic()

    def update(done: int, total: int) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown >= _LINE_EVERY:
            shown = now
            rate = done / (now - began)
            left = (total - done) / rate / 60.0
            console.note(f"{done} of {total} fits, {rate:.3g} a second, {left:.0f} minutes left")

    return update

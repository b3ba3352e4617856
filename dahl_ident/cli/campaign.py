"""``dahl-ident campaign``: many devices, one table."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from dahl_ident.cli import console
from dahl_ident.cli.options import General, Laws, Writing, setting, with_option_groups
from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    from dahl_ident.campaigns.definition import Definition

_LINE_EVERY = 60.0
"""Seconds between lines of progress where there is no terminal."""


@dataclass(frozen=True)
class Running:
    """How the fits are run; options of ``campaign``."""

    panel: ClassVar[str | None] = None
    jobs: int | None = setting("Processes; by default as many as processors.")
    scheduler: str | None = setting("Address of a Dask scheduler, tls://host:port.")
    timeout: float | None = setting(
        "Longest time for a device; by default 10 medians, at least 60 s.", unit="s"
    )
    memory: float | None = setting("Most memory for a device, GB; by default a fair share.")
    patience: float = setting("Longest time without an answer of the scheduler.", 120.0, unit="s")
    send_files: bool = setting(
        "Send workers the contents of files, not paths.", False, "--send-files"
    )
    dry_run: bool = setting("List what would be done.", False, "--dry-run")
    redo: bool = setting("Repeat all fits if options have changed.", False, "--redo")


@dataclass(frozen=True)
class Reporting:
    """The report on the whole campaign."""

    panel: ClassVar[str | None] = None
    report: Path | None = setting("Report on the whole campaign: .html or .pdf.")
    covariate: list[str] | None = setting("Column on which parameters may depend; repeatable.")
    order: str | None = setting("Column that orders fits in time, for control charts.")

    def check(self, definition: Definition, *, overwrite: bool) -> None:
        """Refuse, before anything runs, what the report could not be made from."""
        from dahl_ident.campaigns.campaign_report import FORMATS
        from dahl_ident.data.storage import place_of

        columns, place = self.covariate or [], self.report
        if place is None:
            if columns or self.order:
                raise ValidationError(
                    "--covariate and --order are for a report; give --report as well"
                )
            return
        place_of(place, "a campaign's report", FORMATS)
        Writing(overwrite).check([place])
        tasks = definition.tasks
        known = set.intersection(*(set(task.covariates) for task in tasks))
        for name, choice in [*(("--covariate", c) for c in columns), ("--order", self.order)]:
            also = {"run"} if name == "--order" else set()
            if choice is not None and choice not in known | also:
                there = ", ".join(sorted(known)) or "none"
                raise ValidationError(f"{name} {choice}: the fits have the covariates {there}")
        texts = {
            column: [v for task in tasks if isinstance(v := task.covariates[column], str)]
            for column in known
        }
        for column in columns:
            if texts[column]:
                raise ValidationError(
                    f"--covariate {column} is {texts[column][0]!r}; expected numbers"
                )
        unused = sorted(c for c in known - {*columns, self.order} if not texts[c])
        if unused:
            console.note(
                f"the report does not use {', '.join(unused)}; --covariate {unused[0]} states how "
                "parameters depend on it"
            )


@with_option_groups
def campaign(
    general: General,
    laws: Laws,
    writing: Writing,
    definition: Annotated[Path, typer.Argument(help="TOML file that defines the campaign.")],
    running: Running,
    reporting: Reporting,
) -> None:
    """Read, extract and fit the files of many devices into one table.

    An interrupted campaign continues where it stopped; a changed file is fitted again.

    Example: dahl-ident campaign campaign.toml --jobs 4 --report campaign.html
    """
    from dahl_ident.campaigns.definition import read_definition
    from dahl_ident.campaigns.population import USABLE
    from dahl_ident.campaigns.run import campaign as run_campaign

    laws.run()
    reporting.check(read_definition(definition), overwrite=writing.overwrite)
    with console.busy("fits") as show:
        update = show if sys.stderr.isatty() else _lines()
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # this command says it itself
        done = run_campaign(
            definition, progress=lambda number, total, _: update(number, total), **vars(running)
        )
    if reporting.report is not None and not running.dry_run:
        how: dict[str, Any] = {"covariates": reporting.covariate or [], "order": reporting.order}
        how |= {"title": definition.stem, "overwrite": writing.overwrite}
        console.note(f"report: {done.report(reporting.report, **how)}")
    if general.json:
        facts = {"finished": list(done.finished), "to_do": list(done.to_do)}
        console.write_json({**facts, "statuses": dict(done.statuses), "folder": str(done.folder)})
    elif running.dry_run:
        console.write("\n".join([*(f"to do: {name}" for name in done.to_do), str(done)]))
    else:
        console.write(f"{done}\ntable: {done.folder / 'results.csv'}")
    usable = any(status in USABLE for status in done.statuses)
    console.finish(running.dry_run or usable, "no fit can be used; the table says why")


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

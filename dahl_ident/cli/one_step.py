"""Commands without options of reading and model: inspect, export, datasets, campaign, app."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, write_data, written
from dahl_ident.cli.estimate import finish, saved_fit
from dahl_ident.cli.options import (
    General,
    Laws,
    OutputFile,
    Seed,
    Writing,
    option,
    setting,
    starting,
    with_option_groups,
)
from dahl_ident.cli.reading import Files
from dahl_ident.errors import ValidationError, choices

if TYPE_CHECKING:
    from dahl_ident.campaigns.definition import Definition

_TEMPLATES = ("report", "options", "columns", "campaign")


@with_option_groups
def inspect(
    files: Files,
    general: General,
    writing: Writing,
    sheet: Annotated[str | None, option("Sheet of an Excel workbook.")] = None,
    output: Annotated[
        Path | None,
        option("Column map to write, .toml, for --columns.", "--output", "-o"),
    ] = None,
) -> None:
    """List channels, units, ranges, sampling and gaps, and propose a column map.

    Example: dahl-ident datasets plant_recording -o - | dahl-ident inspect -
    """
    from dahl_ident.data import inspect as contents_of
    from dahl_ident.data.storage import write_whole

    writing.check([output])
    read_files = [contents_of(file, sheet=sheet) for file in files]
    if output is not None:
        proposed = {contents.column_map: contents.name for contents in read_files}
        if len(proposed) > 1:
            raise typer.BadParameter(
                f"{' and '.join(list(proposed.values())[:2])} need different column maps; "
                "write one for each"
            )
        content = f"{next(iter(proposed))}\n".encode()
        write_whole(output, content, overwrite=writing.overwrite)
    if general.json:
        console.write_json([asdict(contents) for contents in read_files])
        return
    console.write("\n\n".join(repr(contents) for contents in read_files))


@with_option_groups
def export(
    files: Files,
    general: General,
    laws: Laws,
    writing: Writing,
    to: Annotated[
        str,
        option(
            "Format: a simulator, a controller, a paper, or other budgets.",
            one_of="mujoco|mujoco-frictionloss|urdf|modelica|matlab|c|gtc|ufloat|latex|draws",
        ),
    ] = "",
    output: Annotated[str, option("File; - is standard output.", "--output", "-o")] = "-",
    size: Annotated[int, option("Number of draws.")] = 1000,
    seed: Seed = 0,
) -> None:
    """Write a fit saved by fit --save in the form that another program reads.

    Example: dahl-ident export fit.json --to mujoco -o joint.xml
    """
    laws.run()
    if not to:
        raise typer.BadParameter("missing; expected a format, such as --to c", param_hint="--to")
    if general.json:
        raise ValidationError("--json is given, but the format of an export is that of --to")
    if len(files) != 1:
        raise ValidationError(f"{len(files)} files are given; expected one saved fit")
    writing.check([output], files)
    fit = saved_fit(files[0])
    how: dict[str, Any] = {"overwrite": writing.overwrite, "size": size, "seed": seed}
    written(lambda place: Path(fit.export(to, place, **how)), output, ".csv")
    finish(fit)


def _names(incomplete: str) -> list[str]:
    from dahl_ident.synthetic.shipped import data_sets

    return starting(data_sets())(incomplete)


@with_option_groups
def datasets(
    general: General,
    writing: Writing,
    name: Annotated[
        str | None,
        typer.Argument(
            help="Data set to describe or copy; lists all if left out.", autocompletion=_names
        ),
    ] = None,
    output: OutputFile = None,
) -> None:
    """List the shipped synthetic data sets, or copy one to a file.

    Example: dahl-ident datasets noisy -o noisy.csv
    """
    from dahl_ident.synthetic import load_dataset
    from dahl_ident.synthetic.shipped import data_sets

    if output is not None and name is None:
        raise ValidationError("--output needs the name of a data set; leave it out to list them")
    writing.check([output], json=general.json)
    if name is not None:
        data = load_dataset(name)
        if output is not None:
            write_data(data, output, overwrite=writing.overwrite)
        elif general.json:
            console.write_json(data.provenance)
        else:
            console.write(repr(data))
        return
    if general.json:
        console.write_json(
            [
                {k: v for k, v in vars(one).items() if k != "experiment"} | {"kind": one.kind}
                for one in data_sets().values()
            ]
        )
        return
    for one in data_sets().values():
        kind = one.kind.replace("_", " ")
        console.write_wrapped(
            f"{one.name} ({kind}): {one.teaches}. Determines {', '.join(one.identifiable)}."
        )


@with_option_groups
def template(
    writing: Writing,
    name: Annotated[
        str,
        typer.Argument(
            help="report (for --metadata), options (for --config), columns (for --columns) or "
            "campaign.",
            autocompletion=starting(_TEMPLATES),
        ),
    ],
    output: Annotated[str, option("File; - is standard output.", "--output", "-o")] = STANDARD,
) -> None:
    """Print a TOML file with its fields explained, to fill in.

    Example: dahl-ident template report -o report.toml
    """
    from dahl_ident.data.storage import write_whole

    if name not in _TEMPLATES:
        raise ValidationError(
            f"there is no template {name!r}; there are {choices(_TEMPLATES, name)}"
        )
    writing.check([output])
    content = (Path(__file__).parent / "templates" / f"{name}.toml").read_bytes()

    if output == STANDARD:
        console.write(content.decode().removesuffix("\n"))
    else:
        write_whole(Path(output), content, overwrite=writing.overwrite)


@with_option_groups
def app(
    laws: Laws,
    folder: Annotated[
        Path, typer.Argument(help="Folder in which the work is kept, one folder for each.")
    ] = Path(),
    port: Annotated[int, option("Port; 0 takes a free one.", min=0, max=65535)] = 0,
    browser: Annotated[bool, option("Open the page in the browser.")] = True,
) -> None:
    """Open a page in the browser that goes from files to a signed report, on this machine alone.

    Example: dahl-ident app measurements
    """
    try:
        from dahl_ident.app import serve
    except ModuleNotFoundError as exc:
        raise ValidationError(
            f"the page needs {exc.name}, which is not installed; "
            "install it with pip install 'dahl_ident[app]'"
        ) from exc
    if not folder.is_dir():
        raise ValidationError(f"{folder} is not a folder; make it, or give one that is there")
    laws.run()
    serve(folder, port=port, laws=tuple(laws.laws or ()), browser=browser)


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

        columns = self.covariate or []
        place = self.report
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

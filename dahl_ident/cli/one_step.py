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
from dahl_ident.cli.console import STANDARD, write_data, write_output
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
    listings = [contents_of(file, sheet=sheet) for file in files]
    if output is not None:
        file_by_map = {listing.column_map: listing.name for listing in listings}
        if len(file_by_map) > 1:
            raise typer.BadParameter(
                f"{' and '.join(list(file_by_map.values())[:2])} need different column maps; "
                "write one for each"
            )
        content = f"{listings[0].column_map}\n".encode()
        write_whole(output, content, overwrite=writing.overwrite)
    if general.json:
        console.write_json([asdict(listing) for listing in listings])
    else:
        console.write("\n\n".join(map(repr, listings)))


@with_option_groups
def export(
    files: Files,
    general: General,
    laws: Laws,
    writing: Writing,
    to: Annotated[
        str,
        option(
            "Format, for a simulator, a controller, a paper or other budgets: mujoco, "
            "mujoco-frictionloss, urdf, modelica, matlab, c, gtc, ufloat, latex or draws.",
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
    options: dict[str, Any] = {"overwrite": writing.overwrite, "size": size, "seed": seed}
    write_output(lambda path: Path(fit.export(to, path, **options)), output, ".csv")
    finish(fit)


def _complete_name(incomplete: str) -> list[str]:
    from dahl_ident.synthetic.shipped import data_sets

    return starting(data_sets())(incomplete)


@with_option_groups
def datasets(
    general: General,
    writing: Writing,
    name: Annotated[
        str | None,
        typer.Argument(
            help="Data set to describe or copy; lists all if left out.",
            autocompletion=_complete_name,
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
    entries = data_sets().values()
    if general.json:
        kinds = [vars(entry) | {"kind": entry.kind} for entry in entries]
        console.write_json([{k: v for k, v in one.items() if k != "experiment"} for one in kinds])
        return
    for entry in entries:
        console.write_wrapped(
            f"{entry.name} ({entry.kind.replace('_', ' ')}): {entry.teaches}. "
            f"Determines {', '.join(entry.identifiable)}."
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
        Path, typer.Argument(help="Folder with a folder for each piece of work.")
    ] = Path(),
    port: Annotated[int, option("Port; 0 takes a free one.", min=0, max=65535)] = 0,
    browser: Annotated[bool, option("Open the page in the browser.")] = True,
) -> None:
    """Open a page in the browser for all steps from files to a signed report, on this machine only.

    Example: dahl-ident app measurements
    """
    try:
        from dahl_ident.app.server import serve
    except ModuleNotFoundError as exc:
        raise ValidationError(
            f"the page needs {exc.name}, which is not installed; "
            "install it with pip install 'dahl_ident[app]'"
        ) from exc
    if not folder.is_dir():
        raise ValidationError(f"{folder} is not a folder; make it, or give an existing one")
    laws.run()
    serve(folder, port=port, laws=tuple(laws.laws or ()), browser=browser)


_LINE_INTERVAL = 60.0  # s between lines of progress if there is no terminal


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
    patience: float = setting("Longest time without an answer from the scheduler.", 120.0, unit="s")
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
        """Refuse options with which the report could not be made, before any fit is run."""
        from dahl_ident.campaigns.campaign_report import FORMATS
        from dahl_ident.data.storage import place_of

        columns = self.covariate or []
        if self.report is None:
            if columns or self.order:
                raise ValidationError(
                    "--covariate and --order are for a report; give --report as well"
                )
            return
        place_of(self.report, "a campaign's report", FORMATS)
        Writing(overwrite).check([self.report])
        covariates = [task.covariates for task in definition.tasks]
        common = set(covariates[0]).intersection(*covariates)
        choices = [("--covariate", column, common) for column in columns]
        if self.order is not None:
            choices.append(("--order", self.order, common | {"run"}))
        for name, column, allowed in choices:
            if column not in allowed:
                existing = ", ".join(sorted(common)) or "none"
                raise ValidationError(f"{name} {column}: the fits have the covariates {existing}")
        pairs = [pair for values in reversed(covariates) for pair in values.items()]
        texts = {column: value for column, value in pairs if isinstance(value, str)}  # the first
        for column in columns:
            if column in texts:
                raise ValidationError(
                    f"--covariate {column} is {texts[column]!r}; expected numbers"
                )
        if unused := sorted(common - texts.keys() - {*columns, self.order}):
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
        update = show if sys.stderr.isatty() else _line_printer()
        # this command reports lost connections itself
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        result = run_campaign(
            definition, progress=lambda done, total, _: update(done, total), **vars(running)
        )
    if reporting.report is not None and not running.dry_run:
        path = result.report(
            reporting.report,
            covariates=reporting.covariate or [],
            order=reporting.order,
            title=definition.stem,
            overwrite=writing.overwrite,
        )
        console.note(f"report: {path}")
    if general.json:
        fields = ("finished", "to_do", "statuses", "folder")
        console.write_json({name: getattr(result, name) for name in fields})
    elif running.dry_run:
        console.write("\n".join([*(f"to do: {name}" for name in result.to_do), str(result)]))
    else:
        console.write(f"{result}\ntable: {result.folder / 'results.csv'}")
    usable, why = any(status in USABLE for status in result.statuses), ""
    if not (running.dry_run or usable):
        column = "error" if "error" in result.table else "statements"
        why = result.table[column].dropna().iloc[0]
    console.finish(
        running.dry_run or usable, f"no fit can be used; the table says why, such as {why}"
    )


def _line_printer() -> Callable[[int, int], None]:
    """Return a function that prints the progress at most once a minute, for logs."""
    started = last_line = time.monotonic()

    def update(done: int, total: int) -> None:
        nonlocal last_line
        now = time.monotonic()
        if now - last_line >= _LINE_INTERVAL:
            last_line = now
            rate = done / (now - started)
            left = (total - done) / rate / 60.0
            console.note(f"{done} of {total} fits, {rate:.3g} a second, {left:.0f} minutes left")

    return update

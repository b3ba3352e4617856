"""``dahl-ident demo``: all steps on shipped data, from waveforms to a report."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console, extract
from dahl_ident.cli.console import make_folder
from dahl_ident.cli.estimation import as_json, finish
from dahl_ident.cli.options import General, Writing, with_option_groups

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record
    from dahl_ident.results import FitResult, Posterior

_DATASET = "plant_recording"


@with_option_groups
def demo(
    general: General,
    writing: Writing,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the table and the report.")
    ] = Path("out"),
) -> None:
    """Run all steps on a shipped recording of a plant, and compare the result with the true values.

    With --json the steps are printed on standard error.

    Example: dahl-ident demo
    """
    from dahl_ident.synthetic.shipped import load_dataset

    table, page = output / "levels.csv", output / "report.html"
    make_folder(output)
    writing.check([table, page])
    origin = load_dataset(_DATASET).provenance or {}
    with redirect_stdout(sys.stderr) if general.json else nullcontext():
        result, posterior = _chain(origin, table, page, overwrite=writing.overwrite)
    if general.json:
        console.write_json(
            {
                "truth": origin["truth"],
                "fit": as_json(result),
                "posterior": posterior.to_dict(),
                "table": str(table),
                "report": str(page.resolve()),
            }
        )
    for judged in (result, posterior):
        finish(judged)


def _chain(
    origin: Mapping[str, Any], table: Path, page: Path, *, overwrite: bool
) -> tuple[FitResult, Posterior]:
    """Run every step from the recording to the report, and print a heading for each."""
    from dahl_ident.data import inspect, read_record
    from dahl_ident.reporting import report
    from dahl_ident.synthetic.shipped import datasets_directory

    file = datasets_directory() / origin["file"]
    console.heading(f"1. inspect: {file}")
    console.write(repr(inspect(file)))
    record = read_record(file)
    data = _extracted(record)
    data.save(table, overwrite=overwrite)
    result, posterior = _estimated(data, origin["truth"])
    console.heading("6. report")
    command = console.typed_command()
    with console.busy("drawing") as progress:
        report(
            [result, posterior], page, record=record, command=command, overwrite=overwrite,
            progress=progress,
        )  # fmt: skip
    console.write(f"table: {table}\nreport: {page.resolve()}")
    return result, posterior


def _extracted(record: Record) -> FrequencyResponse:
    from dahl_ident.extraction import extract as extract_record

    console.heading("2. extract: waveforms to dynamic stiffness")
    data = extract_record(record, controlled="force")
    extract.show(data)
    return extract.good_points(data)


def _estimated(data: FrequencyResponse, truth: Mapping[str, float]) -> tuple[FitResult, Posterior]:
    from dahl_ident.elements import Dahl, Damper, Mass, Spring
    from dahl_ident.results import fit, posterior

    console.heading("3. fit: friction, mass, damper and spring, nothing known beforehand")
    result = fit(data, Dahl() + Mass() + Damper() + Spring(), throw=False)
    console.write_wrapped(result.fit_report())
    _compare(result, truth)
    console.heading("4. identifiability: what the data determine")
    console.write(str(result.identifiability))
    console.heading("5. posterior: emcee, from the same likelihood")
    chain = posterior(result, seed=1)
    console.write(str(chain))
    return result, chain


def _compare(result: FitResult, truth: Mapping[str, float]) -> None:
    """Print the estimates, the true values and their differences."""
    rows = []
    for name, estimate in result.params.items():
        off = (estimate.value - truth[name]) / estimate.stderr if estimate.stderr else 0.0
        error = f"{estimate.stderr:.2g}" if estimate.stderr else "fixed"
        rows.append((name, f"{estimate.value:.5g}", error, f"{truth[name]:g}", f"{off:+.1f}"))
    header = ("parameter", "estimate", "standard error", "truth", "error / standard error")
    console.table("Compared with the truth", header, rows)

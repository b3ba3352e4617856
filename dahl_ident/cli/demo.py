"""``dahl-ident demo``: the whole chain on shipped data, from waveforms to a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dahl_ident.cli import extract, telling
from dahl_ident.cli.files import progress_bar
from dahl_ident.cli.groups import grouped
from dahl_ident.cli.options import Writing

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record
    from dahl_ident.results import FitResult, Posterior

_DATASET = "plant_recording"


@grouped
def demo(
    writing: Writing,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the table and the report.")
    ] = Path("out"),
) -> None:
    """Run the whole chain on a shipped recording of a plant, the true values beside the result.

    Example: dahl-ident demo
    """
    from dahl_ident.data import inspect, read_record
    from dahl_ident.synthetic.shipped import datasets_directory, load_dataset

    table, page = output / "levels.csv", output / "report.html"
    writing.check([table, page])
    output.mkdir(parents=True, exist_ok=True)
    facts = load_dataset(_DATASET).provenance or {}
    file = datasets_directory() / facts["file"]

    telling.heading(f"1. inspect: {file}")
    telling.say(repr(inspect(file)))
    record = read_record(file)
    data = _extracted(record)
    data.save(table, overwrite=writing.overwrite)
    result, posterior = _estimated(data, facts["truth"])
    telling.heading("6. report")
    with progress_bar() as bar:
        bar.add_task("drawing", total=None)
        _report([result, posterior], page, record, overwrite=writing.overwrite)
    telling.say(f"table: {table}\nreport: {page.resolve()}")
    telling.finish(result.trusted and posterior.converged, result.verdict)


def _extracted(record: Record) -> FrequencyResponse:
    from dahl_ident.extraction import extract as extract_record

    telling.heading("2. extract: waveforms to dynamic stiffness")
    data = extract_record(record, controlled="force", harmonics=[1])
    extract.show(data)
    return extract.good_points(data)


def _estimated(data: FrequencyResponse, truth: Mapping[str, float]) -> tuple[FitResult, Posterior]:
    from dahl_ident.elements import Dahl, Damper, Mass, Spring
    from dahl_ident.results import fit, sample

    telling.heading("3. fit: friction, mass, damper and spring, nothing known beforehand")
    result = fit(data, Dahl() + Mass() + Damper() + Spring(), throw=False)
    telling.say(result.fit_report())
    _compare(result, truth)
    telling.heading("4. identifiability: what the data determine")
    telling.say(str(result.identifiability))
    telling.heading("5. posterior: emcee, from the same likelihood")
    posterior = sample(result, seed=1)
    telling.say(posterior.report())
    return result, posterior


def _report(
    results: Sequence[FitResult | Posterior], page: Path, record: Record, *, overwrite: bool
) -> None:
    from dahl_ident.reporting import report

    command = telling.typed_command()
    report(list(results), page, command=command, record=record, overwrite=overwrite)


def _compare(result: FitResult, truth: Mapping[str, float]) -> None:
    """Print the true values beside the estimates, and how far off they are."""
    rows = []
    for name, estimate in result.params.items():
        off = (estimate.value - truth[name]) / estimate.stderr if estimate.stderr else 0.0
        error = f"{estimate.stderr:.2g}" if estimate.stderr else "fixed"
        rows.append((name, f"{estimate.value:.5g}", error, f"{truth[name]:g}", f"{off:+.1f}"))
    header = ("parameter", "estimate", "standard error", "truth", "off by standard errors")
    telling.table("Beside the truth", header, rows)

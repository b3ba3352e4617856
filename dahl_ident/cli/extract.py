"""``dahl-ident extract``: from waveforms to a table; ``demo``: all steps on shipped data."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from dahl_ident.cli import console
from dahl_ident.cli.console import (
    STANDARD,
    changed,
    option_name,
    write_data,
    write_picture,
)
from dahl_ident.cli.estimate import as_json, finish
from dahl_ident.cli.options import (
    General,
    OutputFile,
    Writing,
    controlled_setting,
    option,
    setting,
    with_option_groups,
)
from dahl_ident.cli.reading import Files, RecordReading
from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse
    from dahl_ident.results import FitResult, Posterior


@dataclass(frozen=True)
class Extracting:
    """Measurement of points; the options of ``extract``."""

    panel: ClassVar[str] = "Extracting"
    frequency: float | None = setting("Excitation frequency if known.", unit="Hz")
    mode: str = setting("auto, steps or sweep.", "auto", one_of="auto|steps|sweep")
    num_periods: int | None = setting("Last periods of each segment to use.")
    settling_periods: int | None = setting("Leading periods of each segment to omit.")
    harmonics: str | None = setting(
        "Harmonics of the force, 0 to 9; by default the odd ones, and the even ones of an "
        "asymmetric force. With force controlled: those of the displacement, by default 1."
    )
    controlled: str = controlled_setting()
    min_share: float = setting("Minimum share of the sine in the power.", 0.6)

    def keywords(self) -> dict[str, Any]:
        """Return the arguments of ``extract``."""
        try:
            harmonics = (
                None if self.harmonics is None else [int(k) for k in self.harmonics.split(",")]
            )
        except ValueError as exc:
            raise ValidationError(
                f"harmonics is {self.harmonics!r}; expected whole numbers such as 1,3,5"
            ) from exc
        return {**vars(self), "harmonics": harmonics}


@with_option_groups
def extract(
    files: Files,
    general: General,
    reading: RecordReading,
    extracting: Extracting,
    writing: Writing,
    output: OutputFile = None,
    plot: Annotated[str | None, option("Plot to write, such as points.png.")] = None,
    level_from_name: Annotated[
        str | None, option("Regular expression for file names; its group is the level.")
    ] = None,
    jobs: Annotated[int, option("Number of processes for several files.")] = 1,
    good_only: Annotated[
        bool, option("Leave out points whose verdict is not good.", "--good-only")
    ] = False,
) -> None:
    """Turn recorded waveforms into dynamic stiffness with covariance and verdicts.

    The exit status is 3 if a point is not good; the table gives the verdict of each point.

    Example: dahl-ident datasets plant_recording -o - | dahl-ident extract - --controlled force
    """
    from dahl_ident.data.readers import groups_in_name, run_names
    from dahl_ident.extraction.sources import FileTask, extract_all

    writing.check([output, plot], files, json=general.json)
    tasks = [
        FileTask(file, None, groups_in_name(file, level_from_name).get("level"), vars(reading))
        for file in files
    ]
    data = extract_all(tasks, extracting.keywords(), jobs, run_names(files))
    if good_only:
        data = good_points(data)
    if output is not None:
        write_data(data, output, overwrite=writing.overwrite)
    if plot is not None:
        write_picture(data.plot(), plot, overwrite=writing.overwrite)
    if general.json:
        console.write_json(data.to_frame().to_dict("records"))
    elif output != STANDARD:
        show(data)
    _note_fast_sweeps(data, files, reading, extracting.controlled)
    judge(data)


def _note_fast_sweeps(
    data: FrequencyResponse, files: list[str], reading: RecordReading, controlled: str
) -> None:
    """Say how to fit waveforms that were swept too fast for a table."""
    import numpy as np

    from dahl_ident.units import percent

    points = _one_row_per_point(data)
    fast = ~points.quality["settled"] & (points.quality["more_periods"] == 0)
    if fast.any():
        bias = np.hypot(points.quality["bias_real"], points.quality["bias_imag"]) / points.gain
        names = changed(reading)
        words = [word for n in names for word in (option_name(n), str(getattr(reading, n)))]
        if controlled == "force":  # the plant has a mass
            words += ["--mass", "free", "--damping", "free", "--stiffness", "free"]
        command = shlex.join(["dahl-ident", "fit", "--record", *files, *words])
        console.note(
            f"{fast.sum()} of {points.n} points were swept too fast to settle, and are biased by "
            f"about {percent(np.median(bias[fast]))} (median), at most "
            f"{percent(bias[fast].max())}. A fit of the waveforms does not have that error: "
            f"{command}"
        )


def good_points(data: FrequencyResponse) -> FrequencyResponse:
    """Return the points whose verdict is good, and name the others."""
    from dahl_ident.data.rows import row_names
    from dahl_ident.errors import ExtractionError

    good = data.quality["verdict"] == "good"
    rows = (~good & (data.harmonic == data.harmonic.min())).nonzero()[0].tolist()
    for i, name in zip(rows, row_names(data, rows), strict=True):
        console.note(f"left out: {name}: {data.quality['verdict'][i]}")
    if not good.any():
        raise ExtractionError("no point is good; without --good-only the table holds them all")
    return data.select(rows=good)


def _one_row_per_point(data: FrequencyResponse) -> FrequencyResponse:
    """Return the fundamental of every point, or the lowest harmonic that was extracted."""
    harmonic = 1 if (data.harmonic == 1).any() else int(data.harmonic.min())
    return data.select(harmonic=harmonic)


def show(data: FrequencyResponse) -> None:
    """Print one row for each point: its level and run if it has them, values and verdict."""
    import numpy as np

    from dahl_ident.units import counted, si_unit

    points = _one_row_per_point(data)
    assert points.amplitude is not None  # extraction measures it
    used = points.quality["num_periods"] - points.quality["settling_periods"]
    columns = {
        "level": [] if points.level is None else [str(label) for label in points.level],
        "run": [] if points.run is None else [str(label) for label in points.run],
        "f [Hz]": [f"{f:.5g}" for f in points.frequency_hz],
        f"A [{si_unit('displacement', data.motion)}]": [f"{A:.4g}" for A in points.amplitude],
        "gain": [f"{g:.4g}" for g in points.gain],
        "phase [deg]": [f"{p:.2f}" for p in np.degrees(points.phase)],
        "periods": [f"{u:g}" for u in used],
        "verdict": [str(v) for v in points.quality["verdict"]],
    }
    shown = {name: cells for name, cells in columns.items() if cells}
    console.table(
        f"{counted(points.n, 'point')} of {points.quantity.replace('_', ' ')} [{points.unit}]",
        list(shown),
        list(zip(*shown.values(), strict=True)),
    )


def judge(data: FrequencyResponse) -> None:
    """End with status 3 if a point is not good, and print which and why."""
    verdicts = _one_row_per_point(data).quality["verdict"]
    bad = [(i, str(v)) for i, v in enumerate(verdicts) if v != "good"]
    named = "; ".join(f"point {i}: {verdict}" for i, verdict in bad[:3])
    more = "" if len(bad) <= 3 else "; ..."
    console.finish(not bad, f"{len(bad)} of {len(verdicts)} points are not good ({named}{more})")


_DATASET = "plant_recording"


@with_option_groups
def demo(
    general: General,
    writing: Writing,
    output: Annotated[
        Path, option("Folder for the table and the report.", "--output", "-o")
    ] = Path("out"),
) -> None:
    """Run all steps on a shipped recording of a plant, and compare the result with the true values.

    With --json the steps are printed on standard error.

    Example: dahl-ident demo
    """
    from dahl_ident.data.storage import make_folder
    from dahl_ident.synthetic.shipped import load_dataset

    table, page = output / "levels.csv", output / "report.html"
    make_folder(output)
    writing.check([table, page])
    origin = load_dataset(_DATASET).provenance or {}
    with redirect_stdout(sys.stderr) if general.json else nullcontext():
        result, posterior = _run_steps(origin, table, page, overwrite=writing.overwrite)
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
    finish(result)
    finish(posterior)


def _run_steps(
    origin: Mapping[str, Any], table: Path, page: Path, *, overwrite: bool
) -> tuple[FitResult, Posterior]:
    """Run every step from the recording to the report, and print a heading for each."""
    from dahl_ident.data import inspect, read_record
    from dahl_ident.elements import Dahl, Damper, Mass, Spring
    from dahl_ident.extraction import extract as extract_record
    from dahl_ident.reporting import report
    from dahl_ident.results import fit, posterior
    from dahl_ident.synthetic.shipped import datasets_directory

    file = datasets_directory() / origin["file"]
    console.heading(f"1. inspect: {file}")
    console.write(repr(inspect(file)))
    record = read_record(file)
    console.heading("2. extract: waveforms to dynamic stiffness")
    data = extract_record(record, controlled="force")
    show(data)
    data = good_points(data)
    data.save(table, overwrite=overwrite)
    console.heading("3. fit: friction, mass, damper and spring, nothing known beforehand")
    result = fit(data, Dahl() + Mass() + Damper() + Spring(), throw=False)
    console.write_wrapped(result.fit_report(), result.status)
    rows = []
    for name, p in result.params.items():
        truth = origin["truth"][name]
        ratio = (p.value - truth) / p.stderr if p.stderr else 0.0
        stderr = f"{p.stderr:.2g}" if p.stderr else "fixed"
        rows.append((name, f"{p.value:.5g}", stderr, f"{truth:g}", f"{ratio:+.1f}"))
    header = ("parameter", "estimate", "standard error", "truth", "error / standard error")
    console.table("Compared with the truth", header, rows)
    console.heading("4. identifiability: what the data determine")
    console.write(str(result.identifiability))
    console.heading("5. posterior: emcee, from the same likelihood")
    chain = posterior(result, seed=1)
    console.write(str(chain))
    console.heading("6. report")
    command = console.typed_command()
    with console.busy("drawing") as progress:
        report(
            [result, chain],
            page,
            record=record,
            command=command,
            overwrite=overwrite,
            progress=progress,
        )
    console.write(f"table: {table}\nreport: {page.resolve()}")
    return result, chain

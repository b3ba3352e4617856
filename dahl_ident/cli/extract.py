"""``dahl-ident extract``: from recorded waveforms to a table of responses with verdicts."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed, option, write_data, write_picture
from dahl_ident.cli.options import (
    General,
    OutputFile,
    Writing,
    controlled_option,
    in_panel,
    one_of,
    quantity,
    with_option_groups,
)
from dahl_ident.cli.reading import Files, RecordReading
from dahl_ident.errors import ValidationError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse

_EXTRACTING = "Extracting"
_extracting = in_panel(_EXTRACTING)


@dataclass(frozen=True)
class Extracting:
    """Measurement of points; the options of ``extract``."""

    frequency: Annotated[
        float | None, quantity("Excitation frequency if known.", "Hz", _EXTRACTING)
    ] = None
    mode: Annotated[str, one_of("auto, steps or sweep.", _EXTRACTING, "auto|steps|sweep")] = "auto"
    num_periods: Annotated[int | None, _extracting("Last periods of each segment to use.")] = None
    settling_periods: Annotated[
        int | None, _extracting("Leading periods of each segment to omit.")
    ] = None
    harmonics: Annotated[
        str | None,
        _extracting(
            "Harmonics to extract, 0 to 9: by default the odd ones, and the even ones of an "
            "asymmetric force; if force is controlled, only 1, and others are of the displacement."
        ),
    ] = None
    controlled: Annotated[str, controlled_option(_EXTRACTING)] = "displacement"
    min_share: Annotated[float, _extracting("Minimum share of the sine in the power.")] = 0.6

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
    plot: Annotated[str | None, typer.Option(help="Plot to write, such as points.png.")] = None,
    level_from_name: Annotated[
        str | None, typer.Option(help="Regular expression for file names; its group is the level.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Number of processes for several files.")] = 1,
    good_only: Annotated[
        bool, typer.Option("--good-only", help="Leave out points whose verdict is not good.")
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
        console.write_json(_rows(data))
    elif output != STANDARD:
        show(data)
    _tell_of_sweeps(data, files, reading, extracting.controlled)
    judge(data)


def _tell_of_sweeps(
    data: FrequencyResponse, files: list[str], reading: RecordReading, controlled: str
) -> None:
    """Say how to fit waveforms that were swept too fast for a table."""
    import numpy as np

    from dahl_ident.units import percent

    points = _one_row_a_point(data)
    fast = ~points.quality["settled"] & (points.quality["more_periods"] == 0)
    if fast.any():
        bias = np.hypot(points.quality["bias_real"], points.quality["bias_imag"]) / points.gain
        named = changed(reading)
        words = [word for n in named for word in (option(n), str(getattr(reading, n)))]
        if controlled == "force":  # which moves a mass
            words += ["--mass", "free", "--damping", "free", "--stiffness", "free"]
        command = shlex.join(["dahl-ident", "fit", "--record", *files, *words])
        console.note(
            f"{fast.sum()} of {points.n} points are of a sweep that friction could not follow, and "
            f"biased by about {percent(np.median(bias[fast]))} (median), at most "
            f"{percent(bias[fast].max())}. Its waveforms can be fitted at once, without that "
            f"error: {command}"
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


def _one_row_a_point(data: FrequencyResponse) -> FrequencyResponse:
    """Return the fundamental of every point, or the lowest harmonic that was asked for."""
    harmonic = 1 if (data.harmonic == 1).any() else int(data.harmonic.min())
    return data.select(harmonic=harmonic)


def show(data: FrequencyResponse) -> None:
    """Print one row for each point, with its run and level where it has them, and its verdict."""
    import numpy as np

    from dahl_ident.units import si_unit

    points = _one_row_a_point(data)
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
        f"{points.n} points of {points.quantity.replace('_', ' ')} [{points.unit}]",
        list(shown),
        list(zip(*shown.values(), strict=True)),
    )


def judge(data: FrequencyResponse) -> None:
    """End with status 3 if a point is not good, and print which and why."""
    verdicts = _one_row_a_point(data).quality["verdict"]
    bad = [(i, str(v)) for i, v in enumerate(verdicts) if v != "good"]
    named = "; ".join(f"point {i}: {verdict}" for i, verdict in bad[:3])
    more = "" if len(bad) <= 3 else "; ..."
    console.finish(not bad, f"{len(bad)} of {len(verdicts)} points are not good ({named}{more})")


def _rows(data: FrequencyResponse) -> list[dict[str, Any]]:
    frame = data.to_frame()
    return [dict(zip(frame.columns, row, strict=True)) for row in frame.to_numpy().tolist()]

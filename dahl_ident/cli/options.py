"""The options that commands share: how files are read and written, how results are printed."""

from __future__ import annotations

import glob
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dahl_ident.cli.config import take_options
from dahl_ident.errors import DataError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse

STANDARD = "-"
_READING = "Reading"


def _existing(files: list[str]) -> list[str]:
    """Refuse files that are not there, before anything heavy is loaded."""
    for file in files:
        if file != STANDARD and not Path(file).exists() and not glob.has_magic(file):
            raise DataError(f"{file}: the file cannot be read: No such file or directory")
    return files


def one_of(*choices: str) -> Callable[[str], str]:
    """Return a check of an option's value; any other is a wrong use of the command."""

    def check(value: str) -> str:
        if value not in choices:
            raise typer.BadParameter(f"{value!r} is not one of {', '.join(choices)}")
        return value

    return check


def _range(text: str | None) -> tuple[float, float] | None:
    """Return the two numbers of ``0.2,0.6``."""
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError as exc:
        raise typer.BadParameter(f"{text!r} is not a pair of numbers such as 0.2,0.6") from exc
    return low, high


def _is_range(text: str | None) -> str | None:
    _range(text)
    return text


Files = Annotated[
    list[str],
    typer.Argument(help="Files to read; - is standard input.", callback=_existing),
]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]


@dataclass(frozen=True)
class General:
    """What every command knows."""

    json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False
    config: Annotated[
        Path | None,
        typer.Option(
            is_eager=True,
            callback=take_options,
            help="TOML file of options; a table named after the command, such as \\[fit], is for "
            "it alone. The command line wins.",
        ),
    ] = None


@dataclass(frozen=True)
class Writing:
    """What becomes of files that are there already."""

    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that are there already.")
    ] = False

    def check(
        self,
        outputs: Sequence[str | Path | None],
        inputs: Sequence[str] = (),
        *,
        json: bool = False,
    ) -> None:
        """Refuse outputs that would destroy something, before any work is done.

        Raises
        ------
        ValidationError
            If an output is one of the inputs, or several things want standard output.
        DataError
            If an output is there already and may not be replaced, or lies in no folder.
        """
        from dahl_ident.data.storage import refuse_existing

        places = [str(output) for output in outputs if output is not None]
        if places.count(STANDARD) + json > 1:
            raise ValidationError(
                "more than one thing wants standard output, - and --json included; give files to "
                "all but one"
            )
        read = {Path(file).resolve() for file in inputs if file != STANDARD}
        for place in map(Path, (place for place in places if place != STANDARD)):
            if place.resolve() in read:
                raise ValidationError(
                    f"{place} is an input and would be overwritten; give the output another name"
                )
            if not self.overwrite:
                refuse_existing(place)
            if not place.parent.is_dir():
                raise DataError(
                    f"{place}: there is no folder {place.parent}; make it, or give another place"
                )


@dataclass(frozen=True)
class Reading:
    """How tables are read; the words of ``read_frequency_response``."""

    columns: Annotated[
        Path | None, typer.Option(help="Column map, a TOML file.", rich_help_panel=_READING)
    ] = None
    quantity: Annotated[
        str | None,
        typer.Option(
            help="What the response is, such as receptance; by default its unit tells.",
            rich_help_panel=_READING,
        ),
    ] = None
    amplitude: Annotated[
        str | None,
        typer.Option(help='Displacement amplitude, "5 um rms".', rich_help_panel=_READING),
    ] = None
    drive: Annotated[
        str | None,
        typer.Option(help='Force amplitude, "0.2 N" or "{level} N".', rich_help_panel=_READING),
    ] = None
    drive_factor: Annotated[
        str | None,
        typer.Option(help='Force for one unit of drive, "12.5 N/V".', rich_help_panel=_READING),
    ] = None
    level: Annotated[
        str | None, typer.Option(help="Label for all rows.", rich_help_panel=_READING)
    ] = None
    level_from_name: Annotated[
        str | None,
        typer.Option(
            help="Regular expression on the file's name; its group is the level.",
            rich_help_panel=_READING,
        ),
    ] = None
    controlled: Annotated[
        str | None,
        typer.Option(
            help="What the laboratory held: displacement or force.", rich_help_panel=_READING
        ),
    ] = None
    frequency_hz: Annotated[
        str | None,
        typer.Option(
            help="Keep this range only, Hz: 0.2,0.6.", callback=_is_range, rich_help_panel=_READING
        ),
    ] = None
    where: Annotated[
        str | None,
        typer.Option(
            help="Keep the rows that meet a condition: 'level > 3 and harmonic == 1'.",
            rich_help_panel=_READING,
        ),
    ] = None
    levels: Annotated[
        str | None, typer.Option(help="Keep these levels only: 1,2,5.", rich_help_panel=_READING)
    ] = None
    runs: Annotated[
        str | None,
        typer.Option(
            help="Keep these runs only: day1,day2. Several files are a run each.",
            rich_help_panel=_READING,
        ),
    ] = None
    sheet: Annotated[
        str | None, typer.Option(help="Sheet of an Excel workbook.", rich_help_panel=_READING)
    ] = None
    passive: Annotated[
        bool,
        typer.Option(
            help="Refuse a table that creates energy as a whole.", rich_help_panel=_READING
        ),
    ] = True

    def read(self, files: list[str]) -> FrequencyResponse:
        """Read the files into one table."""
        from dahl_ident.cli.row_selection import selected
        from dahl_ident.data import read_frequency_response

        given = dict(vars(self))
        where, levels, runs = (given.pop(name) for name in ("where", "levels", "runs"))
        given["frequency_hz"] = _range(self.frequency_hz)
        return selected(read_frequency_response(files, **given), where, levels, runs)

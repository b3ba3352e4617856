"""Common options: reading and writing of files, printing of results."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli.config import take_options
from dahl_ident.errors import DataError, ModelError, UnitError, ValidationError, choices

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse

STANDARD = "-"
_READING = "Reading"


def in_panel(panel: str) -> Callable[[str], Any]:
    """Return what makes options of one panel of the help from their texts."""
    return lambda help_text: typer.Option(help=help_text, rich_help_panel=panel)


reading = in_panel(_READING)


def _existing(patterns: list[str]) -> list[str]:
    """Return the files of all patterns; refuse absent ones before heavy libraries are loaded."""
    files: list[str] = []
    for pattern in patterns:
        if pattern == STANDARD or Path(pattern).exists():
            files.append(pattern)
        elif glob.has_magic(pattern):
            from dahl_ident.extraction.sources import matching

            files += matching(pattern)
        else:
            raise DataError(f"{pattern}: the file cannot be read: No such file or directory")
    return files


def one_of(help_text: str, panel: str | None, values: str) -> Any:
    """Return an option with values such as ``"lm|scipy"``, which the shell completes."""
    names = values.split("|")

    def check(value: str | None) -> str | None:
        if value is not None and value not in names:
            raise typer.BadParameter(f"{value!r} is not one of {choices(names, value)}")
        return value

    return typer.Option(
        help=help_text, callback=check, autocompletion=starting(names), rich_help_panel=panel
    )


def starting(names: Iterable[str]) -> Callable[[str], list[str]]:
    """Return what completes the beginning of a word."""
    return lambda incomplete: [name for name in names if name.startswith(incomplete)]


def steady_option(panel: str) -> Any:
    """Return the option of how the response to a force that is held is predicted."""
    return one_of(
        "Response to a force that is held: exact, or 'describing function' (a sine assumed).",
        panel,
        "exact|describing function",
    )


def noise_option(panel: str) -> Any:
    """Return the option of the noise of the rows."""
    return one_of(
        "measured, relative or absolute; by default measured if a covariance is known.",
        panel,
        "measured|relative|absolute",
    )


def controlled_option(panel: str) -> Any:
    """Return the option of what was held."""
    return one_of("Controlled quantity: displacement or force.", panel, "displacement|force")


def quantity(help_text: str, unit: str, panel: str | None = None) -> Any:
    """Return an option for a number in SI, or one with its unit."""

    def parse(text: str) -> float:
        from dahl_ident.cli.distributions import number

        try:
            return number("it", str(text), unit)
        except (ModelError, UnitError) as exc:
            raise typer.BadParameter(str(exc).removesuffix(", or 'free'")) from exc

    return typer.Option(help=help_text, parser=parse, metavar=f"<{unit}>", rich_help_panel=panel)


Files = Annotated[
    list[str],
    typer.Argument(help="Files to read, or patterns; - is standard input.", callback=_existing),
]
Channel = Annotated[
    str | None,
    reading('Its column, with unit if needed: "x \\[mm]".'),
]
DriveFactor = Annotated[
    str | None,
    reading('Force for one unit of drive, "12.5 N/V".'),
]
DriveFactorUncertainty = Annotated[
    float | None,
    reading("Its relative standard uncertainty."),
]
Sheet = Annotated[str | None, reading("Sheet of an Excel workbook.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]


def _silence(quiet: bool) -> bool:
    from dahl_ident.cli import console

    console.be_quiet(quiet)
    return quiet


@dataclass(frozen=True)
class General:
    """The options of every command."""

    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", "-q", help="Print errors, and what goes to -, alone.", callback=_silence
        ),
    ] = False
    config: Annotated[
        Path | None,
        typer.Option(
            is_eager=True,
            callback=take_options,
            help="TOML file of options; a table named after a command, such as \\[fit], applies to "
            "that command only. The command line has precedence.",
        ),
    ] = None


_LawFiles = Annotated[
    list[Path] | None,
    typer.Option(
        help="Python file with laws of your own, which --element then knows by kind or class name. "
        "The file is run: give only files that you trust. Repeatable.",
        rich_help_panel="Model",
    ),
]


@dataclass(frozen=True)
class Laws:
    """Laws of the user."""

    laws: _LawFiles = None

    def run(self) -> None:
        """Run the files, so that models can name the laws in them."""
        for file in self.laws or ():
            from dahl_ident.elements.law_files import load_laws

            load_laws(file)


@dataclass(frozen=True)
class Writing:
    """The treatment of existing files."""

    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False

    def check(
        self,
        outputs: Sequence[str | Path | None],
        inputs: Sequence[str] = (),
        *,
        json: bool = False,
    ) -> None:
        """Refuse outputs that would destroy files, before any work is done.

        Raises
        ------
        ValidationError
            If an output is one of the inputs, or several outputs are standard output.
        DataError
            If an output exists and may not be replaced, or its folder does not exist.
        """
        from dahl_ident.data.storage import refuse_existing

        places = [str(output) for output in outputs if output is not None]
        if places.count(STANDARD) + json > 1:
            raise ValidationError(
                "more than one output goes to standard output, - and --json included; give files "
                "for all but one"
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
class Channels:
    """What ``read_record`` is told of the channels of a record."""

    time: Channel = None
    displacement: Channel = None
    velocity: Channel = None
    acceleration: Channel = None
    force: Channel = None
    sample_rate: Annotated[
        float | None, quantity("For files without a time column.", "Hz", _READING)
    ] = None
    missing: Annotated[
        str, one_of("Treatment of empty samples: error or drop.", _READING, "error|drop")
    ] = "error"


@dataclass(frozen=True)
class Reading:
    """Reading of tables; the options of ``read_frequency_response``."""

    columns: Annotated[Path | None, reading("Column map, a TOML file.")] = None
    quantity: Annotated[
        str | None,
        reading("Response quantity, such as receptance; by default it follows from the unit."),
    ] = None
    amplitude: Annotated[str | None, reading('Displacement amplitude, "5 um rms".')] = None
    drive: Annotated[
        str | None, reading('Force amplitude, "0.2 N" or "{level} N"; of a record its column.')
    ] = None
    frequency: Annotated[float | None, quantity("Frequency of all rows.", "Hz", _READING)] = None
    sweep: Annotated[
        str | None,
        reading('Frequencies of all rows where no column holds them: "1:100Hz log".'),
    ] = None
    drive_factor: DriveFactor = None
    drive_factor_uncertainty: DriveFactorUncertainty = None
    level: Annotated[str | None, reading("Label for all rows.")] = None
    level_from_name: Annotated[
        str | None, reading("Regular expression for file names; its group is the level.")
    ] = None
    controlled: Annotated[str | None, controlled_option(_READING)] = None
    where: Annotated[
        str | None,
        reading("Keep the rows that meet a condition: '0.2 <= frequency_hz < 5 and level > 3'."),
    ] = None
    levels: Annotated[str | None, reading("Keep only these levels: 1,2,5.")] = None
    runs: Annotated[
        str | None,
        reading(
            "Keep only these runs: day1,day2. Each of several files is a run, or a level if "
            "it holds one of its own."
        ),
    ] = None
    sheet: Sheet = None
    passive: Annotated[bool, reading("Refuse a table with a net gain of energy.")] = True

    def read(self, files: list[str]) -> FrequencyResponse:
        """Read the files into one table."""
        from dahl_ident.cli.row_selection import selected
        from dahl_ident.data import read_frequency_response

        given = dict(vars(self))
        where, levels, runs = (given.pop(name) for name in ("where", "levels", "runs"))
        return selected(read_frequency_response(files, **given), where, levels, runs)

"""Options of reading, and the tables or records that files hold."""

from __future__ import annotations

import glob
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed, option, refuse
from dahl_ident.cli.options import controlled_option, in_panel, one_of, quantity
from dahl_ident.errors import DataError

if TYPE_CHECKING:
    from dahl_ident.data import FrequencyResponse, Record

_READING = "Reading"
_OF_RECORDS = ("columns", "drive", "drive_factor", "drive_factor_uncertainty", "sheet")
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

    def refuse(self) -> None:
        """Refuse these options where tables are read."""
        refuse(
            changed(self),
            "without --record; leave it out, or name the columns of a table in a column map "
            "(--columns)",
        )


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

        how = dict(vars(self))
        where, levels, runs = (how.pop(name) for name in ("where", "levels", "runs"))
        return selected(read_frequency_response(files, **how), where, levels, runs)

    def read_records(self, files: list[str], channels: Channels) -> list[Record]:
        """Read each file as a record; options of tables alone are refused."""
        from dahl_ident.data import read_record

        taken = ", ".join(map(option, _OF_RECORDS))
        refuse(
            [name for name in changed(self) if name not in _OF_RECORDS],
            f"together with records of waveforms; of the options of reading, they take {taken} "
            "and the names of channels, such as --displacement (dahl-ident inspect proposes a "
            "column map)",
        )
        how = vars(channels) | {name: getattr(self, name) for name in _OF_RECORDS}
        return [read_record(name, **how) for name in files]

    def read_any(
        self, files: list[str], channels: Channels | None = None, *, record: bool = False
    ) -> FrequencyResponse | list[Record]:
        """Read a table, or records where the files hold waveforms or `record` says so."""
        from dahl_ident.data.response_table import WaveformsError

        channels = channels or Channels()
        if record:
            return self.read_records(files, channels)
        try:
            data = self.read(files)
        except WaveformsError:
            if STANDARD in files:  # has been read, and cannot be read again
                raise
            console.note("the files hold waveforms: fitted sample by sample, as with --record")
            return self.read_records(files, channels)
        except DataError:
            channels.refuse()
            raise
        channels.refuse()
        return data


@dataclass(frozen=True)
class RecordReading(Channels):
    """Reading of records; the options of ``read_record``."""

    columns: Annotated[Path | None, reading("Column map, a TOML file.")] = None
    drive: Channel = None
    drive_factor: DriveFactor = None
    drive_factor_uncertainty: DriveFactorUncertainty = None
    sheet: Sheet = None

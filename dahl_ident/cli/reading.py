"""Options of reading, and the tables or records that files hold, or the rows chosen of them."""

from __future__ import annotations

import ast
import glob
import operator
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed, option, refuse
from dahl_ident.cli.options import controlled_option, in_panel, one_of, quantity
from dahl_ident.errors import DataError, ValidationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dahl_ident.data import FrequencyResponse, Record

_READING = "Reading"
_OF_RECORDS = ("columns", "drive", "drive_factor", "drive_factor_uncertainty", "sheet")
reading = in_panel(_READING)
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
_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


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


def selected(
    data: FrequencyResponse, where: str | None, levels: str | None, runs: str | None
) -> FrequencyResponse:
    """Return the rows selected by the options --where, --levels and --runs."""
    for name, column, text in (("--levels", "level", levels), ("--runs", "run", runs)):
        if text is not None:
            data = _labelled(data, name, column, [part.strip() for part in text.split(",")])
    if where is None:
        return data
    rows = _Condition(data, where).rows()
    if not rows.any():
        raise ValidationError(f"--where {where!r} selects none of {data.n} rows")
    return data.select(rows=rows)


def _labelled(
    data: FrequencyResponse, option: str, column: str, wanted: list[str]
) -> FrequencyResponse:
    import numpy as np

    labels = getattr(data, column)
    known = [] if labels is None else list(dict.fromkeys(str(label) for label in labels))
    missing = [label for label in wanted if label not in known]
    if missing:
        there = ", ".join(known) if known else f"no {column}s"
        raise ValidationError(f"{option} names {', '.join(missing)}; the data have {there}")
    return data.select(rows=np.array([str(label) in wanted for label in labels]))


class _Condition:
    """A condition on the columns of a table; only comparisons, and, or, not."""

    def __init__(self, data: FrequencyResponse, text: str) -> None:
        import numpy as np

        self._text, self._n = text, data.n
        columns: dict[str, Any] = {
            "frequency_hz": data.frequency_hz,
            "amplitude": data.amplitude,
            "drive": data.drive,
            "gain": data.gain,
            "phase_deg": np.degrees(data.phase),
            "harmonic": data.harmonic,
            "level": data.level,
            "run": data.run,
            **data.quality,
        }
        self._columns = {name: values for name, values in columns.items() if values is not None}

    def rows(self) -> NDArray[np.bool_]:
        """Return which rows meet it."""
        import numpy as np

        try:
            value = self._value(ast.parse(self._text, mode="eval").body)
        except SyntaxError as exc:
            raise self._refused(str(exc.msg)) from exc
        rows = np.asarray(value)
        if rows.dtype != np.bool_ or rows.shape != (self._n,):
            raise self._refused("it contains no comparison")
        return rows

    def _refused(self, why: str) -> ValidationError:
        return ValidationError(
            f"--where is {self._text!r}: {why}; expected comparisons of "
            f"{', '.join(self._columns)}, such as 'level > 3 and harmonic == 1'"
        )

    def _value(self, node: ast.expr) -> Any:
        import numpy as np

        match node:
            case ast.Constant(value=int() | float() | str() as value):
                return value
            case ast.Name(id=name):
                if name not in self._columns:
                    raise self._refused(f"there is no column {name}")
                return self._columns[name]
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return np.logical_not(self._value(operand))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return -value
            case ast.BoolOp(op=op, values=parts):
                join = np.logical_and if isinstance(op, ast.And) else np.logical_or
                return join.reduce([self._value(part) for part in parts])
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [self._value(side) for side in (left, *others)]
                pairs = zip(ops, sides, sides[1:], strict=False)
                return np.logical_and.reduce([self._compared(*pair) for pair in pairs])
            case _:
                raise self._refused(f"{ast.unparse(node)} is not understood")

    def _compared(self, op: ast.cmpop, left: Any, right: Any) -> Any:
        import numpy as np

        if type(op) not in _COMPARE:
            raise self._refused("in, is and the like are not understood")
        sides = [np.asarray(side) for side in (left, right)]
        if any(side.dtype.kind in "fiu" for side in sides):
            try:
                sides = [side.astype(float) for side in sides]
            except ValueError as exc:
                raise self._refused(
                    "a label that is not a number is compared with a number"
                ) from exc
        else:
            sides = [side.astype(str) for side in sides]
        return _COMPARE[type(op)](*sides)

"""Options of reading, and the tables or records that files hold, or the rows chosen of them."""

from __future__ import annotations

import ast
import glob
import operator
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from dahl_ident.cli import console
from dahl_ident.cli.console import STANDARD, changed, option_name, refuse
from dahl_ident.cli.options import controlled_setting, setting
from dahl_ident.errors import DataError, ValidationError

if TYPE_CHECKING:
    from dahl_ident.arrays import BoolArray
    from dahl_ident.data import FrequencyResponse, Record

_OF_RECORDS = ("columns", "drive", "drive_factor", "drive_factor_uncertainty", "sheet")
_COLUMN = 'Its column, with unit if needed: "x \\[mm]".'
_COLUMNS = (
    "frequency_hz", "amplitude", "drive", "gain", "harmonic", "level", "run"
)  # fmt: skip
_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le,
    ast.Gt: operator.gt, ast.GtE: operator.ge,
}  # fmt: skip


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

    panel: ClassVar[str] = "Reading"
    time: str | None = setting(_COLUMN)
    displacement: str | None = setting(_COLUMN)
    velocity: str | None = setting(_COLUMN)
    acceleration: str | None = setting(_COLUMN)
    force: str | None = setting(_COLUMN)
    sample_rate: float | None = setting("For files without a time column.", unit="Hz")
    missing: str = setting(
        "Treatment of empty samples: error or drop.", "error", one_of="error|drop"
    )

    def refuse(self) -> None:
        """Refuse these options where tables are read."""
        refuse(
            changed(self),
            "without --record; leave it out, or name the columns of a table in a column map "
            "(--columns)",
        )


@dataclass(frozen=True)
class _Common:
    """What tables and records are told alike."""

    panel: ClassVar[str] = "Reading"
    columns: Path | None = setting("Column map, a TOML file.")
    drive_factor: str | None = setting('Force for one unit of drive, "12.5 N/V".')
    drive_factor_uncertainty: float | None = setting("Its relative standard uncertainty.")
    sheet: str | None = setting("Sheet of an Excel workbook.")


@dataclass(frozen=True)
class Reading(_Common):
    """Reading of tables; the options of ``read_frequency_response``."""

    quantity: str | None = setting(
        "Response quantity, such as receptance; by default it follows from the unit."
    )
    amplitude: str | None = setting('Displacement amplitude, "5 um rms".')
    drive: str | None = setting('Force amplitude, "0.2 N" or "{level} N"; of a record its column.')
    frequency: float | None = setting("Frequency of all rows.", unit="Hz")
    sweep: str | None = setting(
        'Frequencies of all rows where no column holds them: "1:100Hz log".'
    )
    level: str | None = setting("Label for all rows.")
    level_from_name: str | None = setting(
        "Regular expression for file names; its group is the level."
    )
    controlled: str | None = controlled_setting(None)
    where: str | None = setting(
        "Keep the rows that meet a condition: '0.2 <= frequency_hz < 5 and level > 3'."
    )
    levels: str | None = setting("Keep only these levels: 1,2,5.")
    runs: str | None = setting(
        "Keep only these runs: day1,day2. Each of several files is a run, or a level if it holds "
        "one of its own."
    )
    passive: bool = setting("Refuse a table with a net gain of energy.", True)

    def read(self, files: list[str]) -> FrequencyResponse:
        """Read the files into one table."""
        from dahl_ident.data import read_frequency_response

        how = dict(vars(self))
        where, levels, runs = (how.pop(name) for name in ("where", "levels", "runs"))
        return selected(read_frequency_response(files, **how), where, levels, runs)

    def read_records(self, files: list[str], channels: Channels) -> list[Record]:
        """Read each file as a record; options of tables alone are refused."""
        from dahl_ident.data import read_record

        taken = ", ".join(map(option_name, _OF_RECORDS))
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
class RecordReading(_Common, Channels):
    """Reading of records; the options of ``read_record``."""

    drive: str | None = setting(_COLUMN)


def selected(
    data: FrequencyResponse, where: str | None, levels: str | None, runs: str | None
) -> FrequencyResponse:
    """Return the rows selected by the options --where, --levels and --runs."""
    for name, column, text in (("--levels", "level", levels), ("--runs", "run", runs)):
        if text is not None:
            data = _labelled(data, name, column, [part.strip() for part in text.split(",")])
    if where is None:
        return data
    rows = _rows_where(data, where)
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


def _rows_where(data: FrequencyResponse, text: str) -> BoolArray:
    """Return which rows meet a condition on columns: only comparisons, and, or, not."""
    import numpy as np

    every: dict[str, Any] = {
        **{name: getattr(data, name) for name in _COLUMNS},
        "phase_deg": np.degrees(data.phase),
        **data.quality,
    }
    columns = {name: values for name, values in every.items() if values is not None}

    def refused(why: str) -> ValidationError:
        return ValidationError(
            f"--where is {text!r}: {why}; expected comparisons of {', '.join(columns)}, such as "
            "'level > 3 and harmonic == 1'"
        )

    def value(node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=int() | float() | str() as constant):
                return constant
            case ast.Name(id=name):
                if name not in columns:
                    raise refused(f"there is no column {name}")
                return columns[name]
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return np.logical_not(value(operand))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as size)):
                return -size
            case ast.BoolOp(op=op, values=parts):
                join = np.logical_and if isinstance(op, ast.And) else np.logical_or
                return join.reduce([value(part) for part in parts])
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [value(side) for side in (left, *others)]
                pairs = zip(ops, sides, sides[1:], strict=False)
                return np.logical_and.reduce([compared(*pair) for pair in pairs])
        raise refused(f"{ast.unparse(node)} is not understood")

    def compared(op: ast.cmpop, *sides: Any) -> Any:
        if type(op) not in _COMPARE:
            raise refused("in, is and the like are not understood")
        numbers = any(np.asarray(side).dtype.kind in "fiu" for side in sides)
        try:
            left, right = (np.asarray(side).astype(float if numbers else str) for side in sides)
        except ValueError as exc:
            raise refused("a label that is not a number is compared with a number") from exc
        return _COMPARE[type(op)](left, right)

    try:
        rows = np.asarray(value(ast.parse(text, mode="eval").body))
    except SyntaxError as exc:
        raise refused(str(exc.msg)) from exc
    if rows.dtype != np.bool_ or rows.shape != (data.n,):
        raise refused("it contains no comparison")
    return rows

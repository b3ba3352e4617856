"""Options for reading tables and records, and for selecting rows of a table."""

from __future__ import annotations

import ast
import glob
import operator
from collections.abc import Callable
from dataclasses import dataclass, fields
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

# options of tables that records have as well
_RECORD_OPTIONS = ("columns", "drive", "drive_factor", "drive_factor_uncertainty", "sheet")
_COLUMN = 'Name of its column, with its unit if the header has none: "x \\[mm]".'
# what conditions can name, in addition to phase_deg and the measures of quality
_COLUMNS = ("frequency_hz", "amplitude", "drive", "gain", "harmonic", "level", "run")
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def _existing_files(patterns: list[str]) -> list[str]:
    """Return the files of all patterns; refuse missing ones before heavy libraries are loaded."""
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
    typer.Argument(
        help="Files to read, or patterns; - is standard input.", callback=_existing_files
    ),
]


@dataclass(frozen=True)
class Channels:
    """The channels of a record; options of ``read_record``."""

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


@dataclass(frozen=True)
class Records(Channels):
    """Records in place of tables: that they are records, how they are read, what is predicted."""

    record: bool = setting(
        "The files are records of any motion; each is a run, or a level if each holds a sweep "
        "at one level that no other holds. Files that plainly hold waveforms need no --record.",
        False,
        "--record",
    )
    predicted: str | None = setting(
        "For records: force (from the motion) or motion (from the force); by default motion if "
        "the model has a mass, else force.",
        one_of="force|motion",
    )

    def refuse_for_tables(self) -> None:
        """Refuse these options if the files are tables."""
        refuse(
            changed(self),
            "without --record; leave it out (a column map, --columns, names the columns of a "
            "table)",
        )


@dataclass(frozen=True)
class _Common:
    """Options common to tables and records."""

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

        keywords = dict(vars(self))
        where, levels, runs = map(keywords.pop, ("where", "levels", "runs"))
        data = read_frequency_response(files, **keywords)
        for column, labels in (("level", levels), ("run", runs)):
            if labels is not None:
                data = _with_labels(data, column, [label.strip() for label in labels.split(",")])
        return data if where is None else data.select(rows=_rows_where(data, where))

    def read_records(self, files: list[str], records: Records) -> list[Record]:
        """Read each file as a record; options that only tables have are refused."""
        from dahl_ident.data import read_record

        allowed = ", ".join(map(option_name, _RECORD_OPTIONS))
        refuse(
            [name for name in changed(self) if name not in _RECORD_OPTIONS],
            f"together with records of waveforms; of the options of reading, they take {allowed} "
            "and the names of channels, such as --displacement (dahl-ident inspect proposes a "
            "column map)",
        )
        keywords = {channel.name: getattr(records, channel.name) for channel in fields(Channels)}
        keywords |= {name: getattr(self, name) for name in _RECORD_OPTIONS}
        return [read_record(file, **keywords) for file in files]

    def read_any(self, files: list[str], records: Records) -> FrequencyResponse | list[Record]:
        """Read a table, or records if --record is given or the files contain waveforms."""
        from dahl_ident.data.response_table import WaveformsError

        if records.record:
            return self.read_records(files, records)
        try:
            data = self.read(files)
        except WaveformsError:
            if STANDARD in files:  # which cannot be read a second time
                raise
            console.note("the files hold waveforms: fitted sample by sample, as with --record")
            return self.read_records(files, records)
        except DataError:
            records.refuse_for_tables()
            raise
        records.refuse_for_tables()
        return data


@dataclass(frozen=True)
class RecordReading(_Common, Channels):
    """Reading of records; the options of ``read_record``."""

    drive: str | None = setting(_COLUMN)


def _with_labels(data: FrequencyResponse, column: str, selected: list[str]) -> FrequencyResponse:
    """Return the rows with the selected labels of level or run."""
    import numpy as np

    labels = [] if getattr(data, column) is None else [str(v) for v in getattr(data, column)]
    missing = [label for label in selected if label not in labels]
    if missing:
        existing = ", ".join(dict.fromkeys(labels)) or f"no {column}s"
        raise ValidationError(f"--{column}s names {', '.join(missing)}; the data have {existing}")
    return data.select(rows=np.isin(labels, selected))


def _rows_where(data: FrequencyResponse, text: str) -> BoolArray:
    """Return which rows meet a condition on columns: only comparisons, and, or, not."""
    import numpy as np

    columns = {name: v for name in _COLUMNS if (v := getattr(data, name)) is not None}
    columns |= {"phase_deg": np.degrees(data.phase), **data.quality}

    def error(why: str) -> ValidationError:
        return ValidationError(
            f"--where is {text!r}: {why}; expected comparisons of {', '.join(columns)}, such as "
            "'level > 3 and harmonic == 1'"
        )

    def evaluated(node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=int() | float() | str() as constant):
                return constant
            case ast.Name(id=name):
                if name not in columns:
                    raise error(f"there is no column {name}")
                return columns[name]
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return np.logical_not(evaluated(operand))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as size)):
                return -size
            case ast.BoolOp(op=op, values=parts):
                join = np.logical_and if isinstance(op, ast.And) else np.logical_or
                return join.reduce([evaluated(part) for part in parts])
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [evaluated(side) for side in (left, *others)]
                results = map(compared, ops, sides, sides[1:])
                return np.logical_and.reduce(list(results))
        raise error(f"{ast.unparse(node)} is not understood")

    def compared(op: ast.cmpop, *sides: Any) -> Any:
        if type(op) not in _COMPARISONS:
            raise error("in, is and the like are not understood")
        is_numeric = any(np.asarray(side).dtype.kind in "fiu" for side in sides)
        try:
            left, right = (np.asarray(side).astype(float if is_numeric else str) for side in sides)
        except ValueError as exc:
            raise error("a label that is not a number is compared with a number") from exc
        return _COMPARISONS[type(op)](left, right)

    try:
        rows = np.asarray(evaluated(ast.parse(text, mode="eval").body))
    except SyntaxError as exc:
        raise error(str(exc.msg)) from exc
    if rows.dtype != np.bool_ or rows.shape != (data.n,):
        raise error("it contains no comparison")
    if not rows.any():
        raise ValidationError(f"--where {text!r} selects none of {data.n} rows")
    return rows
